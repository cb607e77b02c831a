"""Metrics of a predicted image against a photo, both (h, w, 3) in [0, 1]."""

import jax.numpy as jnp
import numpy as np

from humangs_jax.core.array_types import Array, Float, Scalar
from humangs_jax.core.numerics import safe_divide

LARGEST_PSNR = 100.0
"""dB reported for equal images, whose PSNR is infinite and would spoil any mean."""
FOG = (0.05, 0.9)
"""Alphas between these are semi-transparent foreground."""
BOUNDARY = 3 / 256
"""Half the width of the band at the silhouette, of the image's side."""


def decibels(mean_squared_error: Float[Array, "*b"]) -> Float[Array, "*b"]:
    """PSNR of mean squared errors of values in [0, 1], at most 100 dB."""
    return -10 * jnp.log10(jnp.maximum(mean_squared_error, 10 ** (-LARGEST_PSNR / 10)))


def psnr(predicted: Float[Array, "h w c"], target: Float[Array, "h w c"]) -> Scalar:
    """Peak signal-to-noise ratio over the whole frame in dB, of the prediction clipped to [0, 1]."""
    return decibels(jnp.mean(jnp.square(jnp.clip(predicted, 0, 1) - target)))


def masked_psnr(predicted: Float[Array, "h w c"], target: Float[Array, "h w c"], mask: Float[Array, "h w"]) -> Scalar:
    """PSNR in dB over the pixels of a mask, each counted by its coverage; 100 where the mask is empty."""
    errors = jnp.mean(jnp.square(jnp.clip(predicted, 0, 1) - target), axis=-1)
    return decibels(safe_divide(jnp.sum(errors * mask), jnp.sum(mask)))


def semi_transparent(alpha: Float[Array, "h w"], mask: Float[Array, "h w"]) -> Scalar:
    """Share of the pixels of a mask where alpha is neither near 0 nor near 1, see `FOG`; 0 where the mask is empty."""
    inside = mask > 0.5
    partly = (alpha > FOG[0]) & (alpha < FOG[1]) & inside
    return jnp.sum(partly) / jnp.maximum(jnp.sum(inside), 1)


def silhouette_iou(alpha: Float[Array, "h w"], mask: Float[Array, "h w"]) -> Scalar:
    """Intersection over union of the pixels where alpha and where the mask is above a half; 1 where both are empty."""
    drawn, inside = alpha > 0.5, mask > 0.5
    union = jnp.sum(drawn | inside)
    return jnp.where(union > 0, jnp.sum(drawn & inside) / jnp.maximum(union, 1), 1.0)


def boundary_band(mask: np.ndarray) -> Float[np.ndarray, "h w"]:
    """1 in the band to either side of the silhouette of a mask (h, w), see `BOUNDARY`, 0 elsewhere; on the host."""
    from scipy.ndimage import distance_transform_edt

    inside = np.asarray(mask) > 0.5
    distance = np.where(inside, distance_transform_edt(inside), distance_transform_edt(~inside))
    return (distance <= BOUNDARY * len(inside)).astype(np.float32)


def boundary_psnr(predicted: np.ndarray, target: np.ndarray, mask: np.ndarray) -> float:
    """PSNR in dB of two (h, w, 3) images in the `boundary_band` of a mask (h, w)."""
    return float(masked_psnr(jnp.asarray(predicted), jnp.asarray(target), jnp.asarray(boundary_band(mask))))
