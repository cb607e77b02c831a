"""Which frames of a video of one person become photos: sharp ones, from all sides.

Each of equal windows of time offers its sharpest frame. Where the person was found in these, the
circle of directions from which they see the body is cut into equal parts, and each part gives the
frame that is sharpest and whose pose is the usual one. Else that frame is taken which differs most
from all that were taken, until none does.
"""

from collections.abc import Iterable

import numpy as np

from humangs_jax.core.array_types import Float, Int, UInt
from humangs_jax.io.reading import InvalidFileError

PHOTOS = 8
"""Photos of a video in which nobody was found: a person from all sides."""
LONGER_SIDE = 480
"""Pixels of the frames that are looked at: blur that does not show there does not hurt."""
_CELLS = 24
"""Rows and columns of the thumbnails that are compared."""
_NOTHING_SHOWN = 3.0
"""Levels of 255: the standard deviation of a frame that is all of one color, but for noise."""
NOTHING_NEW = 0.05
"""Root mean square of the difference of two thumbnails, in standard deviations of one."""


def looked_at(
    frames: Iterable[UInt[np.ndarray, "h w"]],
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, "n p"]]:
    """Sharpness and thumbnail of each grey frame; the thumbnails have mean 0 and variance 1, or are
    0 where nothing is shown.

    Sharpness is the mean square of the Laplacian over the variance of the frame: exposure does not
    change it.
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
    """Numbers of the sharpest frame of each window of time, in order, and what each is worth, in
    (0, 1]: of a window that is blurred as a whole less.

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
    """Numbers of at most `most` frames that look different, in order: where nobody tells which way
    the person faces.

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
"""Photos of a video: twice as many as the network reads, for the poses and for steps of
refinement.
"""
USUAL = 0.15
"""Share of the person's size by which a pose differs from the usual one when its frame is worth
half.
"""
WORTHLESS = 0.1
"""Least worth of a frame in which the person strikes another pose than in most."""


def directions_of(
    world: Float[np.ndarray, "n k 3"], names: tuple[str, ...]
) -> Float[np.ndarray, " n"]:
    """Radians about the vertical by which the person is turned in each frame, from landmarks in the
    camera's axes (x right, y down, z away); 0 faces the camera.
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
    """How much the pose of each frame differs from the median pose, a share of the person's
    size. seen: weights of landmarks.
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
    """Rows of at most `most` frames, in order, evenly spread over the directions that there are;
    none if these do not turn.

    Arguments: directions: radians. worth: of each frame, 0 for one that is not to be taken.
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
    """Radians of the circle without its largest gap between directions."""
    sorted_ = np.sort(np.mod(directions, 2 * np.pi))
    gaps = np.diff(np.append(sorted_, sorted_[0] + 2 * np.pi))
    return float(2 * np.pi - gaps.max())
