"""Chooses the frames of a video of one person that become photos. They are sharp, and show the
person from different sides.

The frames that show something are cut into windows of time, at most 64 of about equal length. Each
window offers its sharpest frame.

If the person was found in these frames and turns, the circle of directions is cut into equal parts.
Each part gives its best frame: a sharp one, in the usual pose, and near the middle of the part.

Otherwise frames are chosen one after the other, beginning with a sharp one. The next one is the
frame that differs most from all frames chosen before, until no frame differs enough.
"""

from collections.abc import Iterable

import numpy as np

from humangs_jax.core.array_types import Float, Int, UInt
from humangs_jax.io.reading import InvalidFileError

PHOTOS = 8
"""Largest number of photos of a video that are chosen by their looks, with `choose_frames`."""
LONGER_SIDE = 480
"""Longer side to which frames are shrunk before their sharpness is measured, pixels. Blur that
cannot be seen at this size does no harm.
"""
_CELLS = 24
"""Number of rows and of columns of the thumbnails that are compared."""
_NOTHING_SHOWN = 3.0
"""Smallest standard deviation of the grey values (0 to 255) of a frame that shows something. A
frame of one color has only noise, which is smaller.
"""
NOTHING_NEW = 0.05
"""`choose_frames` ends when all remaining frames have less novelty than this. Novelty is the root
mean square difference between the frame's thumbnail and the most similar chosen thumbnail, times
the frame's worth. Thumbnails have a standard deviation of at most 1.
"""


def looked_at(
    frames: Iterable[UInt[np.ndarray, "h w"]],
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, "n p"]]:
    """Returns the sharpness, (n,), and the thumbnail, (n, p), of each grey frame. A thumbnail has
    mean 0, and variance 1 or less. If a frame shows nothing, or has a side of less than 3 pixels,
    its sharpness and its thumbnail are 0.

    Sharpness is the mean square of the Laplacian, divided by the variance of the frame, so that
    exposure does not change it.
    """
    sharpness, thumbnails = [], []
    for frame in frames:
        x = frame.astype(np.float32)
        rows, columns = (np.linspace(0, side, _CELLS + 1).astype(int)[:-1] for side in x.shape)
        cells = np.add.reduceat(np.add.reduceat(x, rows, axis=0), columns, axis=1)
        cells /= np.add.reduceat(np.add.reduceat(np.ones_like(x), rows, axis=0), columns, axis=1)
        spread = float(x.std())
        if spread < _NOTHING_SHOWN or min(x.shape) < 3:
            sharpness.append(0.0)
            thumbnails.append(np.zeros(_CELLS * _CELLS, np.float32))
            continue
        edges = 4 * x[1:-1, 1:-1] - x[:-2, 1:-1] - x[2:, 1:-1] - x[1:-1, :-2] - x[1:-1, 2:]
        sharpness.append(float((edges**2).mean()) / spread**2)
        deviation = max(float(cells.std()), _NOTHING_SHOWN)
        thumbnails.append(((cells - cells.mean()) / deviation).ravel())
    shape = len(sharpness), _CELLS * _CELLS
    return np.asarray(sharpness, np.float32), np.asarray(thumbnails, np.float32).reshape(shape)


def offered_frames(
    sharpness: Float[np.ndarray, " n"],
) -> tuple[Int[np.ndarray, " o"], Float[np.ndarray, " o"]]:
    """Returns the index of the sharpest frame of each window of time, ascending, (o,), and the
    worth of each of these frames, (o,), in (0, 1]. There are at most 64 windows.

    The worth is the frame's sharpness divided by the median sharpness of all returned frames, but 1
    at most.

    Raises: InvalidFileError if no frame shows anything.
    """
    shown = np.flatnonzero(sharpness > 0)
    if not len(shown):
        raise InvalidFileError(
            f"none of its {len(sharpness):,} frames shows anything: expected a video of a person"
        )
    # windows of time, of which each offers its sharpest frame
    windows = np.array_split(shown, min(len(shown), 64))
    offered = np.asarray([window[np.argmax(sharpness[window])] for window in windows])
    return offered, np.minimum(1, sharpness[offered] / np.median(sharpness[offered]))


def choose_frames(
    sharpness: Float[np.ndarray, " n"], thumbnails: Float[np.ndarray, "n p"], most: int
) -> list[int]:
    """Returns the indices of at most `most` frames that look different, ascending. It serves videos
    in which the person's directions are not known, or hardly differ.

    sharpness and thumbnails: see `looked_at`.
    Raises: InvalidFileError if no frame shows anything.
    """
    offered, worth = offered_frames(sharpness)
    chosen, new = [int(np.argmax(worth))], np.full(len(offered), np.inf)
    while len(chosen) < min(most, len(offered)):
        apart = thumbnails[offered] - thumbnails[offered[chosen[-1]]]
        new = np.minimum(new, np.sqrt((apart**2).mean(axis=-1)))
        best = int(np.argmax(worth * new))
        if worth[best] * new[best] < NOTHING_NEW:
            break
        chosen.append(best)
    return sorted(offered[chosen].tolist())


FRAMES = 16
"""Largest number of photos of a video that are chosen by direction. The network reads half as many.
The others help poses and refinement.
"""
USUAL = 0.15
"""A frame's worth is halved if its pose differs from the usual pose by this share of the person's
size. See `unusual`.
"""
WORTHLESS = 0.1
"""Smallest factor by which a frame's worth is multiplied because of an unusual pose."""


def directions_of(
    world: Float[np.ndarray, "n k 3"], names: tuple[str, ...]
) -> Float[np.ndarray, " n"]:
    """Returns the angle about the vertical by which the person is turned in each frame, (n,),
    radians. It is 0 for a person who faces the camera.

    world: landmarks in the camera's axes (x right, y down, z away), (n, k, 3). names: names of the
    landmarks.
    """

    def from_right_to_left(part: str) -> Float[np.ndarray, "n 3"]:
        return world[:, names.index(f"left_{part}")] - world[:, names.index(f"right_{part}")]

    across = from_right_to_left("shoulder") + from_right_to_left("hip")
    return np.arctan2(across[:, 2], across[:, 0])


def unusual(
    world: Float[np.ndarray, "n k 3"],
    directions: Float[np.ndarray, " n"],
    seen: Float[np.ndarray, "n k"],
) -> Float[np.ndarray, " n"]:
    """Returns how much the pose of each frame differs from the median pose of all frames, (n,).
    This is the mean distance between the landmarks of both poses, weighted by `seen`, as a share of
    the person's size. All poses are first turned to face the camera.

    world: landmarks in the camera's axes, (n, k, 3). directions: see `directions_of`. seen: weights
    of the landmarks, (n, k).
    """
    c, s = np.cos(directions), np.sin(directions)
    turned = np.stack(
        [
            c[:, None] * world[..., 0] + s[:, None] * world[..., 2],
            world[..., 1],
            c[:, None] * world[..., 2] - s[:, None] * world[..., 0],
        ],
        axis=-1,
    )
    usual = np.median(turned, axis=0)
    size = float(np.ptp(usual, axis=0).max())
    off = np.linalg.norm(turned - usual, axis=-1)
    return (seen * off).sum(axis=1) / np.maximum(seen.sum(axis=1), 1e-9) / max(size, 1e-9)


def choose_by_direction(
    directions: Float[np.ndarray, " n"], worth: Float[np.ndarray, " n"], most: int
) -> list[int]:
    """Returns the ascending indices of at most `most` frames, spread evenly over the directions
    from which the person was filmed. The result is empty if these directions cover less than a
    quarter turn.

    Arguments: directions: direction of each frame, (n,), radians. worth: worth of each frame, (n,).
    Frames of worth 0 are not taken.
    """
    rows = np.flatnonzero(worth > 0)
    # somebody who is filmed from one side moves, but does not turn: directions have to cover a
    # quarter turn
    if not len(rows) or _covered(directions[rows]) < np.pi / 2:
        return []
    front = directions[rows[np.argmin(np.abs(np.angle(np.exp(1j * directions[rows]))))]]
    part = 2 * np.pi / most
    places = (directions[rows] - front) / part
    numbers = np.round(places).astype(int) % most
    off = np.abs(places - np.round(places))
    chosen = []
    for number in np.unique(numbers):
        own = rows[numbers == number]
        chosen.append(int(own[np.argmax(worth[own] * (1 - off[numbers == number]))]))
    return sorted(chosen)


def _covered(directions: Float[np.ndarray, " n"]) -> float:
    """Returns the angle that the directions cover, radians: a full turn minus the largest gap
    between neighbouring directions.
    """
    sorted_ = np.sort(np.mod(directions, 2 * np.pi))
    gaps = np.diff(np.append(sorted_, sorted_[0] + 2 * np.pi))
    return float(2 * np.pi - gaps.max())
