"""All people of a photo, small ones too, whichever way up the photo is.

The detector finds people from a third of its window's side on, so it looks at the whole photo and at windows of a half of its
longer side that overlap by half, and, where nobody in these is large, of a quarter. What several windows find is one person if
the landmarks agree.

Masks have 256 pixels a side; a guided filter moves their edges to the photo's (He, Sun, Tang, Guided image filtering, 2013):
within each window the mask is an affine function of the photo's colors, of a reduced photo (Fast guided filter, 2015).
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy import ndimage

from humangs_jax.core.array_types import Bool, Float
from humangs_jax.detection.blazepose import LANDMARK_SIZE, Crop, Detection, Landmarks, Networks, mask_at, mask_in_photo
from humangs_jax.io.images import resized

SHARES, SMALL_SHARES = (1.0, 0.5), (0.25,)
"""Sides of the windows over the photo's longer side; the second, most of all windows, where nobody is large."""
LARGE = 0.4
"""Of the photo's longer side. Windows of a half find people from a sixth of it on, whose crops are a fifth: whoever needs smaller
windows has at most a quarter of the pixels of a person with a crop of two fifths, and is not the one who is meant."""
SMALLEST = 0.06
"""Of the photo's longer side: a person whose crop is smaller is somebody in the background, or nobody."""
MOST_CROPS = 16
"""The landmark network looks at, best detections first."""
SAME_HIPS, SAME_SIZE = 0.15, 1.6
"""Two detections are one person if their hips are nearer than this share of the larger crop, and the sides of the crops differ
by at most this factor."""
LEAST_PRESENCE, LEAST_ON_MASK, MOST_SHARED = 0.95, 0.8, 0.5
"""Of a person: presence; share of the landmarks in the photo that lie on the mask; share of the smaller mask that both have.
Measured on 8 photos of a laboratory with 2 to 3 people each: legs, lamps and chairs that the detector takes for people have 0.69
to 0.88, 0.33 to 0.76 or 0.77 to 0.94; people 0.999, 0.94 and 0.02 at the worst."""
LARGER = 1.25
"""Side of the second crop over the first, at the most: the mask has 256 pixels a side, whatever the side."""
MOST_LOOKS, SETTLED = 4, 0.05
"""Looks of the landmark network at a person, at most, and the drift of the crop (see `_settled`) below which it has found it."""
SEEN = 0.5
"""Probability from which on a pixel of a mask is a person's."""


class DetectedPerson(NamedTuple):
    """A person in a photo.

    pixels: (33, 2) landmarks, the centre of the first pixel at (0.5, 0.5). visibility: (33,) in [0, 1]. world: (33, 3) metres
    from the middle of the hips in the camera's axes, of a person of average size. presence: in [0, 1]. mask: (h, w) probability.
    side: pixels of the crop that holds the person.
    """

    pixels: Float[np.ndarray, "33 2"]
    visibility: Float[np.ndarray, " 33"]
    world: Float[np.ndarray, "33 3"]
    presence: float
    mask: Float[np.ndarray, "h w"]
    side: float


def detect_people(networks: Networks, photo: Float[np.ndarray, "h w 3"]) -> list[DetectedPerson]:
    """The people of a photo with values in [0, 1], the largest first."""
    height, width = photo.shape[:2]
    longest = max(height, width)
    detections = window_detections(networks, photo, SHARES)
    found = _people(networks, photo, detections)
    if not any(person.crop.side >= LARGE * longest for person in found):
        smaller = window_detections(networks, photo, SMALL_SHARES)
        found = _people(networks, photo, detections + smaller) if smaller else found
    return [
        DetectedPerson(
            person.pixels + 0.5,
            person.visibility,
            person.world,
            person.presence,
            mask_in_photo(person, width, height),
            person.crop.side,
        )
        for person in found
    ]


def _people(networks: Networks, photo: Float[np.ndarray, "h w 3"], detections: list[Detection]) -> list[Landmarks]:
    """The landmarks of those detections that are people, the largest first."""
    height, width = photo.shape[:2]
    found = []
    best_first = sorted(detections, key=lambda detection: -detection.score)
    for detection in distinct(best_first, max(height, width))[:MOST_CROPS]:
        person, drift = _settled(networks, photo, detection.crop())
        if person.presence >= LEAST_PRESENCE and _on_mask(person, width, height) >= LEAST_ON_MASK:
            found.append((drift, person))
    kept: list[Landmarks] = []
    # crops far off that still drift towards a person have wrong landmarks: the one that settled speaks for the person
    for _, person in sorted(found, key=lambda pair: pair[0] > SETTLED):  # among these the detector's best
        if not any(_shared(*pair, width, height) > MOST_SHARED for o in kept for pair in ((person, o), (o, person))):
            kept.append(person)
    return sorted(kept, key=lambda person: -person.crop.side)


def _settled(networks: Networks, photo: Float[np.ndarray, "h w 3"], crop: Crop) -> tuple[Landmarks, float]:
    """Landmarks of a crop that they confirm, and how far they would still move it, a share of its side.

    The landmark network knows hips and size better than the detector. It looks at least twice.
    """
    look, drift = networks.landmarks(photo, crop), np.inf
    for _ in range(MOST_LOOKS - 1):
        if look.presence < LEAST_PRESENCE or drift < SETTLED:
            break
        again = look.again.crop()
        crop = again._replace(side=min(again.side, LARGER * crop.side))
        look = networks.landmarks(photo, crop)
        after = look.again.crop()
        drift = (np.hypot(*(after.center - crop.center)) + abs(after.side - crop.side)) / crop.side
    return look, float(drift)


def window_detections(networks: Networks, photo: Float[np.ndarray, "h w 3"], shares: Sequence[float]) -> list[Detection]:
    """What the detector finds in the windows with these shares of the longer side."""
    height, width = photo.shape[:2]
    return [each for window in windows(width, height, shares) for each in networks.detect(photo, window)]


def windows(width: int, height: int, shares: Sequence[float] = (*SHARES, *SMALL_SHARES)) -> list[Crop]:
    """Upright squares that cover a photo: one around it, then smaller ones that overlap by half, without those beside it."""
    longest, found = max(width, height), []
    for share in shares:
        side = share * longest
        steps = [1 if size <= side else int(np.ceil(2 * (size - side) / side)) + 1 for size in (width, height)]
        starts = [
            np.asarray([(size - side) / 2]) if count == 1 else np.linspace(0, size - side, count)
            for size, count in zip((width, height), steps, strict=True)
        ]
        found += [Crop(np.asarray([x, y]) + side / 2, side, 0.0) for y in starts[1] for x in starts[0]]
    return found


def distinct(detections: list[Detection], longest: int) -> list[Detection]:
    """Detections of different people, of those given best first."""
    kept: list[Detection] = []
    for detection in detections:
        side = detection.crop().side
        if side >= SMALLEST * longest and not any(_same_detection(detection, other) for other in kept):
            kept.append(detection)
    return kept


def _same_detection(a: Detection, b: Detection) -> bool:
    sides = sorted((a.crop().side, b.crop().side))
    return float(np.hypot(*(a.hips - b.hips))) < SAME_HIPS * sides[1] and sides[1] < SAME_SIZE * sides[0]


def _on_mask(person: Landmarks, width: int, height: int) -> float:
    """The share of the landmarks in the photo that lie on the mask; 0 if none lies in the photo."""
    inside = _inside(person.pixels, width, height)
    return float(np.mean(mask_at(person, person.pixels[inside]) > SEEN)) if inside.any() else 0.0


def _shared(person: Landmarks, other: Landmarks, width: int, height: int) -> float:
    """The share of the person's mask in the photo that another person has, too."""
    own = person.crop.to_photo(np.argwhere(person.mask > SEEN)[:, ::-1] / LANDMARK_SIZE)
    own = own[_inside(own, width, height)]
    return float(np.mean(mask_at(other, own) > SEEN)) if len(own) else 0.0


def _inside(pixels: Float[np.ndarray, "n 2"], width: int, height: int) -> Bool[np.ndarray, " n"]:
    return np.all((pixels > -0.5) & (pixels < np.asarray([width, height]) - 0.5), axis=-1)


LEVEL = 0.4
"""Of the detector's masks at the person's edge: at 0.5 they are 3 % too small, and lose hands and feet."""
RADIUS, EPSILON = 2.0, 1e-4
"""Of the filter: half side of its windows in pixels of the detector's mask, and variance of colors that is no edge."""
STEEPER = 2.0
"""The filter's masks rise more slowly than true ones by this factor."""
MOST = 2.0
"""Pixels of the reduced photo for one of the detector's mask."""


def sharpened(mask: Float[np.ndarray, "h w"], photo: Float[np.ndarray, "h w 3"], pixel: float) -> Float[np.ndarray, "h w"]:
    """A mask with its edges at those of the photo. pixel: pixels of the photo for one of the detector's mask."""
    rows, columns = (np.flatnonzero((mask > 0).any(axis)) for axis in (1, 0))
    if not len(rows):
        return mask
    margin = int(np.ceil(2 * RADIUS * pixel))
    window = tuple(slice(max(int(each[0]) - margin, 0), int(each[-1]) + 1 + margin) for each in (rows, columns))
    guide, own = photo[window], np.clip(mask[window] * 0.5 / LEVEL, 0, 1)
    height, width = own.shape
    reduced = min(1.0, MOST / pixel)
    size = max(1, round(reduced * width)), max(1, round(reduced * height))
    small = (resized(guide, *size), resized(own, *size)) if reduced < 1 else (guide, own)
    slopes, offsets = _affine(*small, max(1, round(RADIUS * reduced * pixel)))
    if reduced < 1:
        slopes, offsets = resized(slopes, width, height), resized(offsets, width, height)
    found, result = np.sum(slopes * guide, axis=-1) + offsets, np.zeros_like(mask)
    result[window] = np.clip(STEEPER * (found - 0.5) + 0.5, 0, 1)
    return result


def _affine(
    guide: Float[np.ndarray, "h w 3"], mask: Float[np.ndarray, "h w"], radius: int
) -> tuple[Float[np.ndarray, "h w 3"], Float[np.ndarray, "h w"]]:
    """Slopes (h, w, 3) and offsets (h, w) of the mask as a function of the colors, means over the windows of each pixel."""
    side = 2 * radius + 1
    mean = lambda x: ndimage.uniform_filter(x, (side, side) + (0,) * (x.ndim - 2), mode="nearest")
    colors, level = mean(guide), mean(mask)
    together = mean(guide * mask[..., None]) - colors * level[..., None]
    spread = mean(guide[..., :, None] * guide[..., None, :]) - colors[..., :, None] * colors[..., None, :]
    slopes = np.linalg.solve(spread + EPSILON * np.eye(3), together[..., None].astype(float))[..., 0]
    offsets = level - (slopes * colors).sum(-1)
    return mean(slopes).astype(np.float32), mean(offsets).astype(np.float32)
