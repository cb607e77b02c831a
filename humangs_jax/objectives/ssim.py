"""Structural similarity (Wang et al., 2004) under a Gaussian window, differentiable, fast on every backend.

Window 11 x 11, sigma 1.5, data range 1, sample covariances (N - 1): the numbers of scikit-image's
`structural_similarity(win_size=11, gaussian_weights=True, data_range=1, channel_axis=-1)`. Only pixels whose whole
window lies in the image count, as there. The window is separable, and a sum of shifted slices is some forty times
faster on a CPU than the depthwise convolution that says the same.
"""

import jax
import jax.numpy as jnp
import numpy as np

from humangs_jax.core.array_types import Array, Float, Scalar

WINDOW = 11
SIGMA = 1.5
STABILIZERS = (0.01**2, 0.03**2)
"""C1 and C2 of the paper, for values in [0, 1]."""
SAMPLE_COVARIANCE = WINDOW**2 / (WINDOW**2 - 1)
MIDDLE = 0.5
"""Moments are taken about this grey: E[x^2] - E[x]^2 of float32 whites would lose four digits to cancellation."""


def window_weights() -> np.ndarray:
    """The normalised window along one axis, (11,) float64."""
    weights = np.exp(-0.5 * ((np.arange(WINDOW) - WINDOW // 2) / SIGMA) ** 2)
    return weights / weights.sum()


def _windowed(x):
    weights = window_weights()
    height, width = x.shape[-3] - WINDOW + 1, x.shape[-2] - WINDOW + 1
    rows = sum(float(weight) * x[..., i : i + height, :, :] for i, weight in enumerate(weights))
    return sum(float(weight) * rows[..., i : i + width, :] for i, weight in enumerate(weights))


@jax.custom_vjp
def blur(x: Float[Array, "*b h w c"]) -> Float[Array, "*b y x c"]:
    """The windowed mean around every pixel whose window lies inside the image: (h - 10, w - 10).

    Raises: ValueError for an image smaller than the window.
    """
    if min(x.shape[-3:-1]) < WINDOW:
        raise ValueError(f"an image of {x.shape[-2]} x {x.shape[-3]} has no {WINDOW} x {WINDOW} window")
    return _windowed(x)


def _blur_transposed(_, gradient):
    # the window is symmetric, so the transpose is the same sum over the zero-padded gradient; left to itself, JAX would
    # pad and add once per slice, which takes four times as long
    margin = (WINDOW - 1, WINDOW - 1)
    return (_windowed(jnp.pad(gradient, [(0, 0)] * (gradient.ndim - 3) + [margin, margin, (0, 0)])),)


blur.defvjp(lambda x: (blur(x), None), _blur_transposed)


def similarity_map(predicted: Float[Array, "h w c"], target: Float[Array, "h w c"]) -> Float[Array, "y x c"]:
    """SSIM per pixel and channel, (h - 10, w - 10, c); 1 where the images agree."""
    x, y = predicted - MIDDLE, target - MIDDLE
    moments = blur(jnp.concatenate([x, y, x * x, y * y, x * y], axis=-1))
    mean_x, mean_y, square_x, square_y, product = jnp.split(moments, 5, axis=-1)
    variances = SAMPLE_COVARIANCE * (square_x + square_y - mean_x * mean_x - mean_y * mean_y)
    covariance = SAMPLE_COVARIANCE * (product - mean_x * mean_y)
    mean_x, mean_y = mean_x + MIDDLE, mean_y + MIDDLE
    luminance = (2 * mean_x * mean_y + STABILIZERS[0]) / (mean_x * mean_x + mean_y * mean_y + STABILIZERS[0])
    return luminance * (2 * covariance + STABILIZERS[1]) / (variances + STABILIZERS[1])


def structural_dissimilarity(predicted: Float[Array, "h w c"], target: Float[Array, "h w c"]) -> Float[Array, "y x c"]:
    """(1 - SSIM) / 2 per pixel and channel, between 0 (the same) and 1 (the inverse)."""
    return 0.5 * (1 - similarity_map(predicted, target))


def halve(image: Float[Array, "h w c"]) -> Float[Array, "y x c"]:
    """The image at half the size, box-averaged; an odd last row or column is left out."""
    height, width, channels = image.shape
    even = image[: height // 2 * 2, : width // 2 * 2]
    return even.reshape(height // 2, 2, width // 2, 2, channels).mean(axis=(1, 3))


def multiscale_structural_dissimilarity(
    predicted: Float[Array, "h w c"], target: Float[Array, "h w c"], scales: int = 3
) -> Scalar:
    """Mean structural dissimilarity over `scales` box-halved sizes of the images, weighing each size the same.

    Raises: ValueError where the smallest size has no whole window (it needs 11 pixels a side).
    """
    total = jnp.mean(structural_dissimilarity(predicted, target))
    for _ in range(scales - 1):
        predicted, target = halve(predicted), halve(target)
        total += jnp.mean(structural_dissimilarity(predicted, target))
    return total / scales
