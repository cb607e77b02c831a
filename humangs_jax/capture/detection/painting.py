"""Paints over people in photos with the colors around them."""

import numpy as np
from scipy import ndimage

from humangs_jax.core.array_types import Bool, Float
from humangs_jax.io.images import resized

_LEAST_NEAR = 1e-3
"""Weight of the mean color of the wider surroundings. It matters only where almost no kept pixel is
near.
"""


def painted_over(
    photo: Float[np.ndarray, "h w 3"], covered: Bool[np.ndarray, "h w"], margin: float
) -> tuple[Float[np.ndarray, "h w 3"], Bool[np.ndarray, "h w"]]:
    """Returns the photo with covered pixels replaced by the colors around them, and which pixels
    were replaced, (h, w). The replaced area is a little larger than the covered area, because
    pixels just outside may still show the person.

    A plain color would have an outline, which the detector takes for the outline of a person.

    Arguments: margin: how far the replaced area reaches beyond the covered pixels, as a share of
    the photo's longer side.
    """
    height, width = photo.shape[:2]
    # the detector sees no more than 512 pixels
    scale = min(1.0, 512 / max(height, width))
    size = max(1, round(scale * width)), max(1, round(scale * height))
    longest = max(size)
    share = resized(covered.astype(np.float32), *size)
    grown = 2 * max(1, round(margin * longest)) + 1
    small = ndimage.maximum_filter(share > 0.25, size=grown)
    kept, colors = (~small).astype(np.float32), resized(photo, *size)

    # means of what is kept, weighted by a Gaussian: first of what is near, then, where there is
    # nothing, of what is far
    near, near_weight = _spread(colors, kept, longest / 32)
    far, far_weight = _spread(colors, kept, longest / 8)
    distant = far / np.maximum(far_weight, 1e-6)[..., None]
    fill = (near + _LEAST_NEAR * distant) / (near_weight + _LEAST_NEAR)[..., None]
    fill = np.clip(fill, 0, 1).astype(np.float32)
    painted = resized(small.astype(np.float32), width, height) > 0.5
    return np.where(painted[..., None], resized(fill, width, height), photo), painted


def _spread(
    colors: Float[np.ndarray, "h w 3"], kept: Float[np.ndarray, "h w"], sigma: float
) -> tuple[Float[np.ndarray, "h w 3"], Float[np.ndarray, "h w"]]:
    """Returns the sum of the colors of kept pixels nearby, weighted by a Gaussian, (h, w, 3), and
    the sum of the weights, (h, w). kept: 1 for kept pixels, else 0. sigma: standard deviation of
    the Gaussian, pixels.
    """
    summed = [ndimage.gaussian_filter(colors[..., c] * kept, sigma) for c in range(3)]
    return np.stack(summed, axis=-1), ndimage.gaussian_filter(kept, sigma)
