"""Moves the edges of the detector's masks to the edges of the photo.

The masks have 256 pixels a side. They are sharpened by a guided filter (He, Sun, Tang, Guided image
filtering, 2013). In each window of the filter, the mask is an affine function of the photo's
colors. The functions are fitted to a reduced photo (Fast guided filter, 2015).
"""

import numpy as np
from scipy import ndimage

from humangs_jax.core.array_types import Float
from humangs_jax.io.images import resized

_RADIUS = 2.0
"""Half side of the filter's windows, pixels of the detector's mask."""


def sharpened(
    mask: Float[np.ndarray, "h w"], photo: Float[np.ndarray, "h w 3"], pixel: float
) -> Float[np.ndarray, "h w"]:
    """Returns a mask whose edges follow the edges of the photo, (h, w), 0 to 1.

    mask: the detector's mask at the size of the photo, (h, w), 0 to 1. photo: values in [0, 1].
    pixel: width of one pixel of the detector's mask, in pixels of the photo.
    """
    rows, columns = (np.flatnonzero((mask > 0).any(axis)) for axis in (1, 0))
    if not len(rows):
        return mask
    # the window around the mask, with what the filter sees of its surroundings
    margin = filter_margin(pixel)
    window = tuple(
        slice(max(int(each[0]) - margin, 0), int(each[-1]) + 1 + margin) for each in (rows, columns)
    )
    # the detector's masks are 0.4 at the person's edge: at 0.5 they are 3 % too small, and lose
    # hands and feet
    guide, own = photo[window], np.clip(mask[window] * 0.5 / 0.4, 0, 1)
    height, width = own.shape
    # the filter's coefficients, of the reduced photo
    # two pixels of the reduced photo for one of the detector's mask
    reduced = min(1.0, 2.0 / pixel)
    size = max(1, round(reduced * width)), max(1, round(reduced * height))
    small_guide, small_mask = guide, own
    if reduced < 1:
        small_guide, small_mask = resized(guide, *size), resized(own, *size)
    slopes, offsets = _affine(small_guide, small_mask, max(1, round(_RADIUS * reduced * pixel)))

    def enlarged(values):
        """Returns values of the reduced photo at the size of the window."""
        return resized(values, width, height) if reduced < 1 else values

    # one color at a time: all together take gigabytes of a large photo
    found = enlarged(offsets).copy()
    for color in range(3):
        found += enlarged(slopes[..., color]) * guide[..., color]
    result = np.zeros_like(mask)
    # the filter's masks rise half as steeply as true ones
    result[window] = np.clip(2.0 * (found - 0.5) + 0.5, 0, 1)
    return result


def filter_margin(pixel: float) -> int:
    """Returns the width of a margin, pixels of the photo. `sharpened` reads the photo in the
    bounding box of the pixels where the mask is above 0, and in this margin around the box. pixel:
    see `sharpened`.
    """
    return int(np.ceil(2 * _RADIUS * pixel))


def _affine(
    guide: Float[np.ndarray, "h w 3"], mask: Float[np.ndarray, "h w"], radius: int
) -> tuple[Float[np.ndarray, "h w 3"], Float[np.ndarray, "h w"]]:
    """Returns slopes, (h, w, 3), and offsets, (h, w). At each pixel, the mask is about the sum of
    slopes * colors, plus the offset. Slopes and offsets are the means of the coefficients of all
    windows that contain the pixel. radius: half side of the windows, pixels.
    """
    side = 2 * radius + 1

    def mean(x):
        """Returns the mean of x over the window around each pixel."""
        return ndimage.uniform_filter(x, (side, side) + (0,) * (x.ndim - 2), mode="nearest")

    # least squares in each window: covariance of colors and mask over that of the colors
    colors, level = mean(guide), mean(mask)
    together = mean(guide * mask[..., None]) - colors * level[..., None]
    spread = (
        mean(guide[..., :, None] * guide[..., None, :])
        - colors[..., :, None] * colors[..., None, :]
    )
    # 1e-4: a variance of colors that is no edge
    solved = np.linalg.solve(spread + 1e-4 * np.eye(3), together[..., None].astype(float))
    slopes = solved[..., 0]
    offsets = level - (slopes * colors).sum(-1)
    return mean(slopes).astype(np.float32), mean(offsets).astype(np.float32)
