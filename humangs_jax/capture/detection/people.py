"""Finds all people in a photo with BlazePose (https://arxiv.org/abs/2006.10204). It also finds
small people, and people in photos that are not upright.

The result for each person is 33 landmarks in the image, 33 landmarks in metres, and a mask.

LiteRT runs two networks. The detector looks at a square window of the photo. For each person it
finds the middle of the hips, and a second point whose distance from the hips is the body's size.
The landmark network looks at the square around the person, turned so that the person stands
upright.

Pre- and postprocessing are the same as in mediapipe's pose graph, in numpy. Samples are bilinear,
begin at the crop's corner, and have no antialiasing, because the networks depend on this.

Pixels are mediapipe's: (x, y), with the centre of the first pixel at 0. `apps.detect` adds half a
pixel for our convention.

The detector finds people who are at least a third as large as its window. So it looks at the whole
photo and at windows of half the photo's longer side. If nobody large is found there, it also looks
at windows of a quarter of the longer side. Neighbouring windows overlap by half or more. Detections
in several windows count as one person if hips and size agree.

If people stand close together, the detector finds only some of them. So the people who were found
are painted over with the colors around them, and the detector looks again, until it finds nobody
more. See `find_people`.
"""

import contextlib
import dataclasses
import functools
import importlib
import importlib.util
import os
import sys
from collections.abc import Generator, Sequence
from importlib import resources
from typing import Any, NamedTuple

import numpy as np

from humangs_jax.capture.detection.painting import painted_over
from humangs_jax.core.array_types import Bool, Float

_DETECTOR = "pose_detection.tflite"
"""File name of the detector in `assets/blazepose`."""
LANDMARKS = "pose_landmark_heavy.tflite"
"""File name of the landmark network. There are smaller ones, lite and full, but they often exchange
left and right; heavy hardly ever does.
"""
_DETECTOR_SIZE = 224
"""Side of the detector's input, pixels."""
LANDMARK_SIZE = 256
"""Side of the landmark network's input, pixels."""
_LANDMARK_COUNT = 33
"""Number of landmarks of a person."""
_ALIGNMENT = 6
"""Number of further points that the landmark network returns. The first two are the same points as
the detector's: the middle of the hips, and the point that shows the body's size.
"""
ENLARGED = 1.25
"""Side of a crop, divided by twice the distance between the detector's two points."""
_PEAK = 0.5
"""A landmark moves to the centroid of the heatmap around it if the heatmap reaches this value
there. If not, the landmark stays.
"""
WINDOW = 7
"""Side of the window in which the centroid of a heatmap is computed, pixels of the heatmap."""


class Crop(NamedTuple):
    """A square of the photo, which may be turned."""

    center: Float[np.ndarray, "2"]
    """Middle of the square, (2,), pixels."""
    side: float
    """Length of its sides, pixels."""
    angle: float
    """Angle in radians by which the crop's upward axis is turned clockwise."""

    @property
    def turn(self) -> Float[np.ndarray, "2 2"]:
        """Rotation from the crop's axes to the photo's axes, (2, 2)."""
        c, s = np.cos(self.angle), np.sin(self.angle)
        return np.asarray([[c, -s], [s, c]])

    def to_photo(self, points: Float[np.ndarray, "*n 2"]) -> Float[np.ndarray, "*n 2"]:
        """Converts points of the crop to pixels of the photo, (..., 2). The crop reaches from 0 to
        1 in both axes.
        """
        return self.center + (points - 0.5) * self.side @ self.turn.T

    def from_photo(self, pixels: Float[np.ndarray, "*n 2"]) -> Float[np.ndarray, "*n 2"]:
        """Converts pixels of the photo to points of the crop, (..., 2). The crop reaches from 0 to
        1 in both axes.
        """
        return (pixels - self.center) @ self.turn / self.side + 0.5


class Detection(NamedTuple):
    """A person that the detector has found in a window of the photo."""

    score: float
    """Score of the detector, in [0, 1]."""
    hips: Float[np.ndarray, "2"]
    """Middle of the hips, (2,), pixels of the photo."""
    head: Float[np.ndarray, "2"]
    """Point whose distance from the hips is the body's size, (2,), pixels of the photo."""

    def crop(self) -> Crop:
        """Returns the square of the photo that the landmark network looks at for this person."""
        x, y = self.head - self.hips
        return Crop(
            self.hips, 2 * ENLARGED * float(np.hypot(x, y)), float(np.pi / 2 - np.arctan2(-y, x))
        )


class Landmarks(NamedTuple):
    """What the landmark network finds in a crop."""

    pixels: Float[np.ndarray, "33 2"]
    """Landmarks in the photo, (33, 2), pixels."""
    visibility: Float[np.ndarray, " 33"]
    """Probability that a landmark is seen and not hidden, (33,)."""
    world: Float[np.ndarray, "33 3"]
    """Landmarks relative to the middle of the hips, (33, 3), metres. Axes are the camera's (x
    right, y down, z away). The landmarks are as if the camera looked straight at the person, and
    the person had average size.
    """
    presence: float
    """Probability that the crop shows a person."""
    mask: Float[np.ndarray, "256 256"]
    """Probability that a pixel of the crop shows the person, (256, 256)."""
    crop: Crop
    """The square of the photo that the network looked at."""
    again: Detection
    """The detector's two points, as the landmark network finds them. They give the crop of the next
    look.
    """
    covered: bool = False
    """Whether other people were painted over before this person was found. They may stand in front
    of this person.
    """


def available() -> bool:
    """Returns whether LiteRT is installed."""
    return importlib.util.find_spec("ai_edge_litert") is not None


def load_networks(folder: str, names: Sequence[str]) -> list[Any]:
    """Loads networks from a folder of `assets`, and returns a LiteRT interpreter for each name.
    names: file names of the networks.

    Raises: ImportError, which says what to install, if LiteRT is missing.
    """
    try:
        with _silent():
            # optional, and then unknown to type checkers
            interpreter = importlib.import_module("ai_edge_litert.interpreter").Interpreter
    except ImportError as error:
        raise ImportError(
            "finding people in photos needs LiteRT: pip install 'humangs_jax[photos]' (there is"
            " none for Macs with Intel processors: give keypoints and masks of another program"
            " there, see docs/your_photos.md)"
        ) from error
    place, found = resources.files("humangs_jax") / "assets" / folder, []
    for name in names:
        with _silent():
            content = (place / name).read_bytes()
            network = interpreter(model_content=content, num_threads=1)
            network.allocate_tensors()
        found.append(network)
    return found


def outputs_of(network: Any, values: Float[np.ndarray, "..."]) -> dict[str, np.ndarray]:
    """Runs a network on one input, and returns its outputs by name. Outputs with several axes come
    without their batch axis.
    """
    network.set_tensor(network.get_input_details()[0]["index"], values[None].astype(np.float32))
    network.invoke()
    outputs = {
        output["name"]: network.get_tensor(output["index"])
        for output in network.get_output_details()
    }
    return {name: each[0] if each.ndim > 1 else each for name, each in outputs.items()}


class Networks:
    """The two networks of BlazePose.

    Raises: ImportError, which says what to install, if LiteRT is missing.
    """

    def __init__(self) -> None:
        self._runs = load_networks("blazepose", (_DETECTOR, LANDMARKS))

    def _run(self, which: int, image: Float[np.ndarray, "size size 3"]) -> dict[str, np.ndarray]:
        return outputs_of(self._runs[which], image)

    def detect(self, photo: Float[np.ndarray, "h w 3"], window: Crop) -> list[Detection]:
        """Returns the people that the detector finds in an upright window of a photo. The person
        with the best score comes first.

        photo: values in [0, 1]. Beyond the photo the window is black.
        """
        outputs = self._run(0, 2 * sampled(photo, window, _DETECTOR_SIZE, outside=0.0) - 1)
        scores, raw = _sigmoid(outputs["Identity_1"][:, 0]), outputs["Identity"]
        kept = scores > 0.5
        points = raw[kept] / _DETECTOR_SIZE + np.tile(_anchors()[kept], 6)
        points[:, 2:4] -= _anchors()[kept]  # width and height are no places
        return [
            Detection(float(score), *(window.to_photo(box[i : i + 2]) for i in (4, 6)))
            for score, box in _merged(scores[kept], points)
        ]

    def landmarks(self, photo: Float[np.ndarray, "h w 3"], crop: Crop) -> Landmarks:
        """Returns the landmarks of the person in a crop. photo: values in [0, 1]."""
        outputs = self._run(1, sampled(photo, crop, LANDMARK_SIZE))
        raw = outputs["Identity"].reshape(_LANDMARK_COUNT + _ALIGNMENT, 5).astype(np.float64)
        points = refined(raw[:, :2] / LANDMARK_SIZE, _sigmoid(outputs["Identity_3"]))
        pixels = crop.to_photo(points)
        world = outputs["Identity_4"].reshape(-1, 3)[:_LANDMARK_COUNT].astype(np.float64)
        world[:, :2] = world[:, :2] @ crop.turn.T
        presence = float(outputs["Identity_1"][0])
        return Landmarks(
            pixels=pixels[:_LANDMARK_COUNT],
            visibility=_sigmoid(raw[:_LANDMARK_COUNT, 3]),
            world=world,
            presence=presence,
            mask=_sigmoid(outputs["Identity_2"][..., 0]),
            crop=crop,
            again=Detection(presence, *pixels[_LANDMARK_COUNT : _LANDMARK_COUNT + 2]),
        )


def sampled(
    photo: Float[np.ndarray, "h w 3"], crop: Crop, size: int, outside: float | None = None
) -> Float[np.ndarray, "size size 3"]:
    """Returns (size, size) samples of a crop of the photo, bilinearly interpolated, (size, size,
    3). outside: value beyond the photo. None: the value at the photo's edge.
    """
    steps = np.arange(size) / size
    points = crop.to_photo(np.stack(np.meshgrid(steps, steps), axis=-1))
    return bilinear(photo, points, outside)


def bilinear(
    image: Float[np.ndarray, "h w *c"],
    points: Float[np.ndarray, "a b 2"],
    outside: float | None = None,
) -> Float[np.ndarray, "a b *c"]:
    """Returns the image interpolated at points (x, y), (a, b, ...). Whole numbers are the centres
    of pixels. outside: value beyond the image. None: the value at the image's edge.
    """
    height, width = image.shape[:2]
    x, y = points[..., 0], points[..., 1]
    inside = (x > -1) & (x < width) & (y > -1) & (y < height)
    x, y = x.clip(0, width - 1), y.clip(0, height - 1)
    left = np.minimum(x.astype(int), max(width - 2, 0))
    top = np.minimum(y.astype(int), max(height - 2, 0))
    right, bottom = np.minimum(left + 1, width - 1), np.minimum(top + 1, height - 1)
    shape = x.shape + (1,) * (image.ndim - 2)
    u, v = (x - left).reshape(shape).astype(np.float32), (y - top).reshape(shape).astype(np.float32)
    upper = image[top, left] * (1 - u) + image[top, right] * u
    lower = image[bottom, left] * (1 - u) + image[bottom, right] * u
    values = upper * (1 - v) + lower * v
    if outside is None:
        return values
    return np.where(inside.reshape(shape), values, np.float32(outside))


def refined(
    points: Float[np.ndarray, "n 2"], heatmaps: Float[np.ndarray, "m m n"]
) -> Float[np.ndarray, "n 2"]:
    """Returns points, (n, 2), on the scale on which the heatmap reaches from 0 to 1. Each point is
    moved to the centroid of its heatmap in a window around the point. A point stays if its heatmap
    has no peak in this window, or if the point lies outside of the heatmap.
    """
    size, half, moved = len(heatmaps), WINDOW // 2, points.copy()
    for i, (column, row) in enumerate(np.trunc(points * size).astype(int)):
        if not (0 <= column < size and 0 <= row < size):
            continue
        rows, columns = (
            np.arange(max(0, at - half), min(size, at + half + 1)) for at in (row, column)
        )
        heights = heatmaps[rows[:, None], columns, i].astype(np.float64)
        if heights.max() >= _PEAK:
            centroid = np.asarray([heights.sum(0) @ columns, heights.sum(1) @ rows]) / heights.sum()
            moved[i] = centroid / size
    return moved


def mask_at(found: Landmarks, pixels: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, " n"]:
    """Returns a person's mask at pixels of the photo, (n,), 0 to 1. It is 0 outside of the crop."""
    return bilinear(found.mask, found.crop.from_photo(pixels)[None] * LANDMARK_SIZE, outside=0.0)[0]


def mask_in_photo(found: Landmarks, width: int, height: int) -> Float[np.ndarray, "height width"]:
    """Returns a person's mask at the size of the photo, (height, width), 0 to 1. It is 0 outside of
    the crop.
    """
    mask = np.zeros((height, width), np.float32)
    window = mask_window(found, width, height)
    mask[window] = mask_in_window(found, window)
    return mask


Window = tuple[slice, slice]
"""A part of a photo: its rows and columns."""


def mask_window(found: Landmarks, width: int, height: int, margin: int = 0) -> Window:
    """Returns the part of a photo that contains a person's crop, with a margin of `margin` pixels.
    The part may be empty.
    """
    corners = found.crop.to_photo(np.asarray([[0.0, 0], [0, 1], [1, 0], [1, 1]]))
    left, top = (np.floor(corners.min(0)).astype(int) - margin).clip(0, [width, height]).tolist()
    right, bottom = (
        (np.ceil(corners.max(0) + 1).astype(int) + margin).clip(0, [width, height]).tolist()
    )
    return slice(top, max(bottom, top)), slice(left, max(right, left))


def mask_in_window(found: Landmarks, window: Window) -> Float[np.ndarray, "h w"]:
    """Returns a person's mask in a part of the photo, (h, w), 0 to 1. It is 0 outside of the
    crop.
    """
    from PIL import Image

    rows, columns = window
    width, height = columns.stop - columns.start, rows.stop - rows.start
    if not (width and height):
        return np.zeros((height, width), np.float32)
    corners = np.asarray([[0.0, 0], [1, 0], [0, 1]]) + np.asarray([columns.start, rows.start])
    origin, right_of, below = found.crop.from_photo(corners) * LANDMARK_SIZE
    across, down = right_of - origin, below - origin
    # Pillow counts from corners of pixels and adds the half pixel of the target itself; it is ten
    # times faster than numpy
    start = origin + 0.5 - (across + down) / 2
    affine = tuple(np.stack([across, down, start], axis=-1).ravel().tolist())
    picture = Image.fromarray(found.mask.astype(np.float32))
    return np.array(
        picture.transform(
            (width, height), Image.Transform.AFFINE, affine, Image.Resampling.BILINEAR
        )
    )


@functools.cache
def _anchors() -> Float[np.ndarray, "a 2"]:
    grids = []
    # strides of the grids, pixels, and how many anchors a cell has
    for stride, copies in ((8, 2), (16, 2), (32, 6)):
        middles = (np.arange(_DETECTOR_SIZE // stride) + 0.5) * stride / _DETECTOR_SIZE
        grids.append(
            np.stack(np.meshgrid(middles, middles), axis=-1).reshape(-1, 2).repeat(copies, axis=0)
        )
    return np.concatenate(grids)


def _merged(
    scores: Float[np.ndarray, " n"], boxes: Float[np.ndarray, "n 12"]
) -> list[tuple[float, np.ndarray]]:
    """Merges detections in one window that show the same person (weighted non-maximum suppression).
    Detections that overlap with the best one are averaged, weighted by score. Returns for each
    person the best score and the mean box, (12,). The best person comes first.
    """
    left, merged = np.argsort(-scores), []
    while len(left):
        # detections of one window that overlap by more are one person
        same = _overlaps(boxes[left[0]], boxes[left]) > 0.3
        same[0] = True
        weights = scores[left[same], None]
        merged.append(
            (float(scores[left[0]]), (boxes[left[same]] * weights).sum(0) / weights.sum())
        )
        left = left[~same]
    return merged


def _overlaps(
    box: Float[np.ndarray, "12"], boxes: Float[np.ndarray, "n 12"]
) -> Float[np.ndarray, " n"]:
    low = np.maximum(box[:2] - box[2:4] / 2, boxes[:, :2] - boxes[:, 2:4] / 2)
    high = np.minimum(box[:2] + box[2:4] / 2, boxes[:, :2] + boxes[:, 2:4] / 2)
    shared = np.prod(np.maximum(high - low, 0), axis=1)
    return shared / np.maximum(np.prod(box[2:4]) + np.prod(boxes[:, 2:4], axis=1) - shared, 1e-12)


def _sigmoid(x: np.ndarray) -> np.ndarray:
    return 1 / (1 + np.exp(-np.clip(x, -80, 80)))


@contextlib.contextmanager
def _silent() -> Generator[None]:
    """Context manager that suppresses standard error, because LiteRT's C++ code prints a line there
    when it starts.
    """
    sys.stderr.flush()
    try:
        kept = os.dup(2)
    except OSError:  # closed
        yield
        return
    with open(os.devnull, "w") as nowhere:
        os.dup2(nowhere.fileno(), 2)
    try:
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)


# All people of a photo
# -------------------------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class _SearchConfig:
    """Constants for the search for people in a photo."""

    shares: tuple[float, float] = (1.0, 0.5)
    """Sides of the windows in which people are always looked for, as shares of the photo's longer
    side.
    """
    small_shares: tuple[float, ...] = (0.25,)
    """Sides of further windows, as shares of the photo's longer side. They are used if nobody large
    is found in the others. Most windows are of this kind.
    """
    large: float = 0.4
    """The smaller windows are used only if the sides of all crops are shorter than this share of
    the photo's longer side.

    Windows of half the longer side find people who are at least a sixth as large as the longer
    side, with crops of a fifth of it. So a person who is found only in smaller windows has at most
    a quarter of the pixels of a large person, and is not the main person of the photo.
    """
    smallest: float = 0.06
    """Smallest side of a crop, as a share of the photo's longer side. Smaller detections are people
    in the background, or nobody.
    """
    most_crops: int = 16
    """Largest number of detections in one search that the landmark network looks at. Only those
    with the best scores are kept.
    """
    same_hips: float = 0.15
    """Two detections can be one person if their hips are nearer than this share of the larger
    crop's side.
    """
    same_size: float = 1.6
    """Two detections can be one person if the ratio of their crops' sides is below this number."""
    most_looks: int = 4
    """Largest number of times that the landmark network looks at one person."""
    settled: float = 0.05
    """Largest drift of a crop that counts as settled on the person, as a share of the crop's side.
    See `_settled`.
    """
    larger: float = 1.25
    """Largest factor by which a crop may grow from one look to the next. A larger crop makes the
    mask coarser, because the mask always has 256 pixels a side.
    """


SEARCH = _SearchConfig()


@dataclasses.dataclass(frozen=True)
class _Believed:
    """Limits that decide whether what the landmark network found counts as a person.

    They were measured on 8 photos of a laboratory with 2 to 3 people each. False detections there
    are legs, lamps and chairs.
    """

    presence: float = 0.95
    """Smallest presence of a person. False detections had 0.69 to 0.88, people at least 0.999."""
    on_mask: float = 0.8
    """Smallest share of the landmarks inside the photo that lie on the person's mask. False
    detections had 0.33 to 0.76, people 0.94.
    """
    on_rest: float = 0.6
    """Replaces `on_mask` if other people are painted over. It is smaller, because masks then have
    holes.
    """
    shared: float = 0.5
    """Largest share of one person's mask that another person's mask may cover. False detections had
    0.77 to 0.94, people 0.02.
    """
    size: float = 0.4
    """Smallest side of a crop if the person was found after others were painted over, as a share of
    the largest crop's side. In photos of two to six people, smaller crops showed the remains of a
    person whose mask ends too early.
    """


BELIEVED = _Believed()


MARGINS = (1 / 150, 1 / 100)
"""How far the painted area reaches beyond a mask, as shares of the photo's longer side. The second
value is tried if the first one shows nobody more. If the area is too small, a rim remains that
looks like a person. If the area is too large, it hides people who stand behind.
"""
SEEN = 0.5
"""A pixel belongs to the person if the mask exceeds this probability."""


def find_people(networks: Networks, photo: Float[np.ndarray, "h w 3"]) -> list[Landmarks]:
    """Returns the people in a photo. The person with the largest crop comes first. photo: values in
    [0, 1].

    People who were found are painted over, and the detector looks at the photo again. This ends
    when both `MARGINS` have shown nobody more, or after eight paintings. If nobody is found at
    first, nothing is painted over.
    """
    longest = max(photo.shape[:2])
    detections = window_detections(networks, photo, SEARCH.shares)
    found = _people(networks, photo, detections)
    if not any(person.crop.side >= SEARCH.large * longest for person in found):
        smaller = window_detections(networks, photo, SEARCH.small_shares)
        if smaller:
            found = _people(networks, photo, detections + smaller)
    margins = list(MARGINS) if found else []
    for _ in range(8):  # paintings at most
        if not margins:
            break
        further = _hidden_people(networks, photo, found, margins[0])
        found += further
        if not further:
            margins.pop(0)
    return sorted(found, key=lambda person: -person.crop.side)


def _hidden_people(
    networks: Networks, photo: Float[np.ndarray, "h w 3"], found: list[Landmarks], margin: float
) -> list[Landmarks]:
    """Returns the further people that are found when the people in `found` are painted over. Their
    masks are 0 where the masks of the people in `found` are 1.
    """
    height, width = photo.shape[:2]
    painted, covered = _painted_over(photo, found, margin)
    detections = window_detections(networks, painted, SEARCH.shares)
    least = BELIEVED.size * max(person.crop.side for person in found)
    further = [
        person
        for person in _people(networks, painted, detections, covered)
        if person.crop.side >= least
        and not any(_shared(person, other, width, height) > BELIEVED.shared for other in found)
    ]
    return [person._replace(mask=_without(person, found), covered=True) for person in further]


def _painted_over(
    photo: Float[np.ndarray, "h w 3"], found: list[Landmarks], margin: float
) -> tuple[Float[np.ndarray, "h w 3"], Bool[np.ndarray, "h w"]]:
    """Returns a photo in which the people in `found` are replaced by the colors around them, and
    which pixels were replaced, (h, w). margin: as in `painted_over`.
    """
    height, width = photo.shape[:2]
    covered = np.zeros((height, width), bool)
    for person in found:
        window = mask_window(person, width, height)
        # the detector's masks end at 0.4
        covered[window] |= mask_in_window(person, window) > 0.4
    return painted_over(photo, covered, margin)


def _without(person: Landmarks, found: list[Landmarks]) -> Float[np.ndarray, "256 256"]:
    """Returns a person's mask, (256, 256). It is 0 where the masks of other people are 1."""
    steps = np.arange(LANDMARK_SIZE) / LANDMARK_SIZE
    pixels = person.crop.to_photo(np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2))
    mask = person.mask.ravel().copy()
    for other in found:
        mask *= 1 - mask_at(other, pixels)
    return mask.reshape(LANDMARK_SIZE, LANDMARK_SIZE)


def _people(
    networks: Networks,
    photo: Float[np.ndarray, "h w 3"],
    detections: list[Detection],
    covered: Bool[np.ndarray, "h w"] | None = None,
) -> list[Landmarks]:
    """Returns the landmarks of the detections that are people. The person with the largest crop
    comes first.

    covered: where the photo was painted over, (h, w). Landmarks there do not count when landmarks
    are compared with the mask. A person with more than half of the landmarks there is discarded.
    """
    height, width = photo.shape[:2]
    found = []
    best_first = sorted(detections, key=lambda detection: -detection.score)
    for detection in distinct(best_first, max(height, width))[: SEARCH.most_crops]:
        person, drift = _settled(networks, photo, detection.crop())
        on_mask = _on_mask(person, width, height, covered)
        least = BELIEVED.on_mask if covered is None else BELIEVED.on_rest
        if person.presence >= BELIEVED.presence and on_mask >= least:
            found.append((drift, person))
    # crops far off that still drift towards a person have wrong landmarks: the one that settled
    # speaks for the person, and among these the detector's best
    found.sort(key=lambda pair: pair[0] > SEARCH.settled)
    kept: list[Landmarks] = []
    for _, person in found:
        shares = [
            _shared(*pair, width, height)
            for other in kept
            for pair in ((person, other), (other, person))
        ]
        if max(shares, default=0.0) <= BELIEVED.shared:
            kept.append(person)
    return sorted(kept, key=lambda person: -person.crop.side)


def _settled(
    networks: Networks, photo: Float[np.ndarray, "h w 3"], crop: Crop
) -> tuple[Landmarks, float]:
    """Looks at a person several times with the landmark network. Returns the landmarks of the last
    look, and the drift: how far the next crop would be from the last one in position and size, as a
    share of the crop's side. The drift is infinite after a single look.

    Each look gives the crop of the next one. This ends when the crop hardly moves, when the
    presence is low, or after `SEARCH.most_looks` looks. There are at least two looks if the
    presence is not low, because the network knows hips and size better than the detector does.
    """
    look, drift = networks.landmarks(photo, crop), np.inf
    for _ in range(SEARCH.most_looks - 1):
        if look.presence < BELIEVED.presence or drift < SEARCH.settled:
            break
        again = look.again.crop()
        crop = again._replace(side=min(again.side, SEARCH.larger * crop.side))
        look = networks.landmarks(photo, crop)
        after = look.again.crop()
        drift = (np.hypot(*(after.center - crop.center)) + abs(after.side - crop.side)) / crop.side
    return look, float(drift)


def window_detections(
    networks: Networks, photo: Float[np.ndarray, "h w 3"], shares: Sequence[float]
) -> list[Detection]:
    """Returns what the detector finds in all windows of a photo. shares: sides of the windows, as
    shares of the photo's longer side.
    """
    height, width = photo.shape[:2]
    return [
        each for window in windows(width, height, shares) for each in networks.detect(photo, window)
    ]


def windows(
    width: int, height: int, shares: Sequence[float] = (*SEARCH.shares, *SEARCH.small_shares)
) -> list[Crop]:
    """Returns the upright squares of a photo in which the detector looks, in pixels of the photo.

    shares: sides of the squares, as shares of the photo's longer side. A square of share 1 contains
    the whole photo. Smaller squares cover the photo together, and neighbours overlap by half or
    more.
    """
    longest, found = max(width, height), []
    for share in shares:
        side = share * longest
        rows, columns = _starts(height, side), _starts(width, side)
        found += [Crop(np.asarray([x, y]) + side / 2, side, 0.0) for y in rows for x in columns]
    return found


def _starts(size: int, side: float) -> Float[np.ndarray, " n"]:
    """Returns the positions where windows begin along one axis of a photo, (n,), pixels. size:
    length of the photo along this axis, pixels. side: side of the windows, pixels.

    If one window is at least as long as the photo, there is only this one, in the middle. Otherwise
    windows are spread evenly and overlap by half or more.
    """
    if size <= side:
        return np.asarray([(size - side) / 2])
    count = int(np.ceil(2 * (size - side) / side)) + 1
    return np.linspace(0, size - side, count)


def distinct(detections: list[Detection], longest: int) -> list[Detection]:
    """Returns the best detection of each person. Detections with a crop smaller than
    `SEARCH.smallest` are left out. detections: ordered, the best first. longest: longer side of the
    photo, pixels.
    """
    kept: list[Detection] = []
    for detection in detections:
        side = detection.crop().side
        if side >= SEARCH.smallest * longest and not any(
            _same_detection(detection, other) for other in kept
        ):
            kept.append(detection)
    return kept


def _same_detection(a: Detection, b: Detection) -> bool:
    sides = sorted((a.crop().side, b.crop().side))
    return (
        float(np.hypot(*(a.hips - b.hips))) < SEARCH.same_hips * sides[1]
        and sides[1] < SEARCH.same_size * sides[0]
    )


def _on_mask(
    person: Landmarks, width: int, height: int, covered: Bool[np.ndarray, "h w"] | None = None
) -> float:
    """Returns the share of the landmarks inside the photo that lie on the person's mask. Landmarks
    where the photo is painted over do not count. The result is 0 if no landmark is left, or if more
    than half of those inside the photo are painted over.
    """
    points = person.pixels[_inside(person.pixels, width, height)]
    if covered is not None:
        column, row = np.round(points).astype(int).T
        hidden = covered[row, column]
        if 2 * hidden.sum() > len(points):
            return 0.0
        points = points[~hidden]
    return float(np.mean(mask_at(person, points) > SEEN)) if len(points) else 0.0


def _shared(person: Landmarks, other: Landmarks, width: int, height: int) -> float:
    """Returns the share of a person's mask that another person's mask covers too. width and height:
    size of the photo, pixels.
    """
    own = person.crop.to_photo(np.argwhere(person.mask > SEEN)[:, ::-1] / LANDMARK_SIZE)
    own = own[_inside(own, width, height)]
    return float(np.mean(mask_at(other, own) > SEEN)) if len(own) else 0.0


def _inside(pixels: Float[np.ndarray, "n 2"], width: int, height: int) -> Bool[np.ndarray, " n"]:
    """Returns which of the positions lie inside the photo, (n,)."""
    return np.all((pixels > -0.5) & (pixels < np.asarray([width, height]) - 0.5), axis=-1)
