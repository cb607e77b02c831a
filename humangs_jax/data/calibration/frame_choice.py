"""Which frames of one video become photos: sharp ones, each of which shows what the others do not.

A phone goes around a person, or the person turns around. Neighbouring frames show the same, and some are blurred by motion. The
video is cut into equal windows of time, of which each offers its sharpest frame. Of these, one after the other is taken: that
which differs most from all that were taken, until none differs. Nothing is drawn by chance.
"""

from collections.abc import Iterable

import numpy as np

from humangs_jax.core.array_types import Float, UInt
from humangs_jax.io.reading import Refused

PHOTOS = 8
"""A person from all sides."""
WINDOWS = 64
LONGER_SIDE = 480
"""Pixels of the frames that are looked at: blur that does not show there does not hurt."""
CELLS = 24
"""Rows and columns of the thumbnails that are compared."""
NOTHING_SHOWN = 3.0
"""Levels of 255: the standard deviation of a frame that is all of one color, but for noise."""
NOTHING_NEW = 0.05
"""Root mean square of the difference of two thumbnails, in standard deviations of one."""


def looked_at(frames: Iterable[UInt[np.ndarray, "h w"]]) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, "n p"]]:
    """Sharpness and thumbnail of each grey frame; the thumbnails have mean 0 and variance 1, or are 0 where nothing is shown.

    Sharpness is the mean square of the Laplacian over the variance of the frame: exposure does not change it.
    """
    sharpness, thumbnails = [], []
    for frame in frames:
        x = frame.astype(np.float32)
        rows, columns = (np.linspace(0, side, CELLS + 1).astype(int)[:-1] for side in x.shape)
        cells = np.add.reduceat(np.add.reduceat(x, rows, axis=0), columns, axis=1)
        cells /= np.add.reduceat(np.add.reduceat(np.ones_like(x), rows, axis=0), columns, axis=1)
        spread = float(x.std())
        if spread < NOTHING_SHOWN or min(x.shape) < 3:
            sharpness.append(0.0)
            thumbnails.append(np.zeros(CELLS * CELLS, np.float32))
            continue
        edges = 4 * x[1:-1, 1:-1] - x[:-2, 1:-1] - x[2:, 1:-1] - x[1:-1, :-2] - x[1:-1, 2:]
        sharpness.append(float((edges**2).mean()) / spread**2)
        thumbnails.append(((cells - cells.mean()) / max(float(cells.std()), NOTHING_SHOWN)).ravel())
    shape = len(sharpness), CELLS * CELLS
    return np.asarray(sharpness, np.float32), np.asarray(thumbnails, np.float32).reshape(shape)


def choose_frames(sharpness: Float[np.ndarray, " n"], thumbnails: Float[np.ndarray, "n p"], most: int) -> list[int]:
    """Numbers of at most so many frames, in order.

    Raises: Refused if no frame shows anything.
    """
    shown = np.flatnonzero(sharpness > 0)
    if not len(shown):
        raise Refused(f"none of its {len(sharpness):,} frames shows anything: expected a video of a person")
    windows = np.array_split(shown, min(len(shown), WINDOWS))
    offered = np.asarray([window[np.argmax(sharpness[window])] for window in windows])
    worth = np.minimum(
        1, sharpness[offered] / np.median(sharpness[offered])
    )  # of a window that is blurred as a whole: less
    chosen, new = [int(np.argmax(worth))], np.full(len(offered), np.inf)
    while len(chosen) < min(most, len(offered)):
        apart = thumbnails[offered] - thumbnails[offered[chosen[-1]]]
        new = np.minimum(new, np.sqrt((apart**2).mean(axis=-1)))
        best = int(np.argmax(worth * new))
        if worth[best] * new[best] < NOTHING_NEW:
            break
        chosen.append(best)
    return sorted(offered[chosen].tolist())
