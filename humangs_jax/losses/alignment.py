"""Compares an image with a photo in which the person is a few pixels away from the place in the
image. `photos_agree` decides by the scores of several photos whether a change is kept.

A body whose pose is off by centimetres draws everything a few pixels beside where the photo shows
it. Pixel by pixel, detail at the wrong place is a larger error than no detail, so that PSNR prefers
a blurred avatar. Here each window of the image first moves to where it is most like the photo, by
at most `REACH`:

    e(p) = |I(p + d(p)) - P(p)|^2,   d(p) = argmin over |d| <= r of
           variance over q in W(p) of I(q + d) - P(q), plus `RELUCTANCE` |d|^2 / r^2.

Squares and variances are means over the channels. The variance leaves out differences in
brightness between a window and the photo.

`smooth_moves` finds such moves up to 1.5 r and makes them smooth. `moved_photo` then brings the
person of a photo to where the image shows the person. Images are numpy arrays. Their four channels
are red, green, blue and alpha.
"""

from collections.abc import Iterable

import numpy as np
from scipy.ndimage import gaussian_filter, map_coordinates, uniform_filter

from humangs_jax.core.array_types import Bool, Float
from humangs_jax.losses.losses import LARGEST_PSNR

REACH = 0.02
"""Largest move r of `aligned_psnr`, as a share of the person's height in the photo. It is 3.5 cm
for a grown-up.
"""
WINDOW = 0.08
"""Side of a window, as a share of the person's height. It is about the size of a hand. Smaller
windows would also move to where the image is like the photo by chance.
"""
RELUCTANCE = 2e-4
"""The longest move is made only if it lowers the variance in the window by more than this. Shorter
moves need less. So windows without detail stay where they are.
"""
SMOOTHNESS = 0.04
"""Standard deviation of the weights with which neighbouring moves are averaged, as a share of the
person's height.
"""
LARGEST = 128
"""Largest height of a person in a comparison, pixels. Images of larger people are reduced by whole
factors, for speed.
"""
NOBODY = 1e-3
"""Weight of pixels that do not show the person, for smooth moves."""
ASKED = 3
"""Largest number of photos that vote in `photos_agree`. Two that agree are enough."""
CLEAR = 1.0
"""A single photo is enough if its gain exceeds the needed gain by at least this, decibels."""


def _aligned_errors(
    image: Float[np.ndarray, "h w c"], photo: Float[np.ndarray, "h w c"], reach: int, window: int
) -> tuple[Float[np.ndarray, "h w"], Float[np.ndarray, "h w 2"]]:
    """Returns the squared errors e, (h, w), which are means over the channels, and the moves d in
    pixels (y, x), (h, w, 2). See the head of this module.

    Args:
        image: what was drawn.
        photo: what it is compared with.
        reach: the largest move r, pixels.
        window: the side of W, pixels.
    """
    h, w, _ = image.shape
    padded = np.pad(image, ((reach, reach), (reach, reach), (0, 0)), mode="edge")
    lowest = np.full((h, w), np.inf, np.float32)
    errors, moves = np.zeros((h, w), np.float32), np.zeros((h, w, 2), np.float32)
    for dy in range(-reach, reach + 1):
        for dx in range(-reach, reach + 1):
            far = (dy * dy + dx * dx) / max(reach * reach, 1)
            if far > 1:
                continue
            moved = padded[reach + dy : reach + dy + h, reach + dx : reach + dx + w]
            differences = moved - photo
            squared = np.mean(np.square(differences), axis=-1)
            means = uniform_filter(differences, (window, window, 0), mode="nearest")
            cost = uniform_filter(squared, window, mode="nearest") + RELUCTANCE * far
            cost -= np.mean(np.square(means), axis=-1)
            better = cost < lowest
            lowest[better], errors[better], moves[better] = cost[better], squared[better], (dy, dx)
    return errors, moves


def aligned_psnr(
    image: Float[np.ndarray, "h w 4"],
    photo: Float[np.ndarray, "h w 4"],
    counted: Bool[np.ndarray, "h w"] | None = None,
) -> float:
    """Returns the PSNR of an image against a photo, dB. The windows of the image are moved first,
    see the head of this module.

    Args:
        image: colors on white, and alpha.
        photo: colors on white, and the mask.
        counted: the pixels whose errors count. None: all pixels. Moves look at all pixels.

    Returns:
        Decibels, over colors and alpha, at most 100. It is 100 if no pixel counts.
    """
    if counted is None:
        counted = np.ones(photo.shape[:2], bool)
    else:
        counted = np.asarray(counted)
    height = _person_height(photo[..., 3])
    factor = max(1, -(-height // LARGEST))
    image, photo = (reduced(np.clip(each, 0, 1), factor) for each in (image, photo))
    weights = reduced(counted[..., None].astype(np.float32), factor)[..., 0]
    if not weights.any():
        return LARGEST_PSNR
    errors, _ = _aligned_errors(image, photo, *sizes(height / factor))
    mean = float(np.sum(errors * weights) / np.sum(weights))
    return min(LARGEST_PSNR, -10 * float(np.log10(max(mean, 1e-30))))


def smooth_moves(
    image: Float[np.ndarray, "h w 4"], photo: Float[np.ndarray, "h w 4"]
) -> Float[np.ndarray, "h w 2"]:
    """Returns the moves in pixels (y, x), (h, w, 2), that bring the person of the photo to where
    the image shows the person.

    The move of a pixel is the mean of the moves of the windows around it. The weights fall with
    the distance, and are small for pixels that do not show the person (`NOBODY`).
    """
    height = _person_height(photo[..., 3])
    factor = max(1, -(-height // LARGEST))
    small, small_photo = (reduced(np.clip(each, 0, 1), factor) for each in (image, photo))
    reach, window = sizes(height / factor)
    # single moves may be larger than `REACH`: the means of neighbours are smaller
    _, moves = _aligned_errors(small, small_photo, round(1.5 * reach), window)
    person = np.maximum(small[..., 3], small_photo[..., 3]) + NOBODY
    spread = SMOOTHNESS * height / factor
    total = gaussian_filter(person, spread)
    smooth = [gaussian_filter(moves[..., axis] * person, spread) / total for axis in (0, 1)]
    places = (np.indices(photo.shape[:2]) + 0.5) / factor - 0.5
    return factor * np.stack([_sampled(each, places) for each in smooth], axis=-1)


def misplaced(image: Float[np.ndarray, "h w 4"], photo: Float[np.ndarray, "h w 4"]) -> float:
    """Returns the mean length of the smooth moves over the person in the photo, as a share of the
    person's height. It is 0 if the photo shows nobody.
    """
    person = photo[..., 3] > 0.5
    if not person.any():
        return 0.0
    lengths = np.linalg.norm(smooth_moves(image, photo), axis=-1)
    return float(lengths[person].mean()) / _person_height(photo[..., 3])


def moved_photo(
    photo: Float[np.ndarray, "h w c"], moves: Float[np.ndarray, "h w 2"]
) -> Float[np.ndarray, "h w c"]:
    """Returns a photo with its pixels moved by (y, x), bilinearly. Beyond its edges the photo
    repeats the pixels of the edge.
    """
    places = np.indices(photo.shape[:2]) - np.moveaxis(moves, -1, 0)
    channels = [_sampled(photo[..., c], places) for c in range(photo.shape[-1])]
    return np.stack(channels, axis=-1).astype(np.float32)


def _sampled(
    image: Float[np.ndarray, "rows columns"], places: Float[np.ndarray, "2 h w"]
) -> Float[np.ndarray, "h w"]:
    return map_coordinates(image, places, order=1, mode="nearest")


def _person_height(mask: Float[np.ndarray, "h w"]) -> int:
    """Returns the number of rows from the first to the last row in which a mask exceeds 0.5. If it
    nowhere does, returns the number of all rows.
    """
    rows = np.flatnonzero((mask > 0.5).any(axis=1))
    if len(rows):
        return int(np.ptp(rows)) + 1
    return len(mask)


def sizes(height: float) -> tuple[int, int]:
    """Returns the largest move (at least 1) and the side of the windows (at least 3), pixels.
    height: height of the person, pixels.
    """
    return max(1, round(REACH * height)), max(3, round(WINDOW * height))


def reduced(image: Float[np.ndarray, "h w c"], factor: int) -> Float[np.ndarray, "rows columns c"]:
    """Returns an image averaged over squares of `factor` pixels a side. Rows and columns that are
    left over at the bottom and the right are cut off.
    """
    rows, columns = (size // factor for size in image.shape[:2])
    squares = image[: rows * factor, : columns * factor]
    squares = squares.reshape(rows, factor, columns, factor, -1)
    return squares.mean(axis=(1, 3), dtype=np.float32)


def photos_agree(gains: Iterable[float], least: float) -> bool:
    """Returns whether a change should be kept. A photo accepts the change if it gains at least
    `least`, otherwise it rejects the change. The result is True if more photos accept than reject.

    At most `ASKED` photos vote. A photo whose pose is off may lose by a change that is right. So if
    there are three photos, it takes two of them to reject the change. But no photo gains a lot by a
    change that is wrong. So one photo that gains at least `least + CLEAR` is enough to accept it,
    unless two photos before it have rejected it. The result is False if as many photos accept as
    reject, and if there are no gains.

    Args:
        gains: for each photo, its new score minus its old score, decibels. They are read one after
            the other, until the result is certain.
        least: the gain that a photo needs, decibels. It is negative if the photo may lose.
    """
    yes = no = 0
    for gain in gains:
        if gain >= least + CLEAR:
            return True
        agrees = gain >= least
        yes, no = yes + agrees, no + (not agrees)
        if 2 * max(yes, no) > ASKED:
            break
    return yes > no
