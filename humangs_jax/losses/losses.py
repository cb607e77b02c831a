"""Computes the terms of the training loss, and metrics of an image against a photo. Images are (h,
w, 3), in [0, 1].
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import Annotated, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from humangs_jax.core.array_types import Array, Float, Int, Scalar
from humangs_jax.core.configuration import Range, Share, Weight, configuration
from humangs_jax.core.numerics import safe_divide
from humangs_jax.losses.loss_networks import LossNetworks
from humangs_jax.losses.perceptual import (
    Lpips,
    lpips_features,
    lpips_to,
    perceptual_loss,
    vgg16_loss,
)
from humangs_jax.network.parts import Drawn

T = TypeVar("T")
FAR_SURFACE = 0.1
"""Distance between surfaces beyond which the depth loss does not grow, metres."""


@configuration
class LossConfig:
    """Weights of the terms of the loss. Each term is a mean over the targets and their pixels, over
    the vertices, or over the Gaussians.

    Squared errors make a semi-transparent foreground where the network is in doubt. The terms from
    `absolute` to `opaque` work against that. These terms, and the perceptual terms, are computed
    only if their weight is not 0. Perceptual terms need networks that the user has
    (`losses.loss_networks`).
    """

    squared: Weight = 1.0
    """Squared error of the colors."""
    structural: Weight = 0.2
    """Structural dissimilarity at `structural_scales` sizes."""
    structural_scales: Annotated[int, Range(1, 16)] = 3
    """Number of sizes of the images. Each size is half of the one before."""
    silhouette: Weight = 0.1
    """Squared error of the coverage (alpha against mask)."""
    tightness: Weight = 0.1
    """Squared distance of tight Gaussians from their vertex, normalised units squared."""
    perceptual: Weight = 0.0
    """Difference of the features of VGG-19."""
    vgg16: Weight = 0.0
    """Difference of the features of VGG-16, with the backbone of LPIPS "vgg"."""
    lpips: Weight = 0.0
    """LPIPS distance."""
    absolute: Weight = 0.0
    """Absolute error of the colors."""
    boundary: Weight = 0.0
    """Absolute error of the coverage."""
    depth: Weight = 0.0
    """Distance between the drawn and the true surface, metres. It is 0 for people on disk, whose
    depths are unknown.
    """
    distortion: Weight = 0.0
    """Spread of the weights along the rays."""
    opaque: Weight = 0.0
    """4 o (1 - o) of the opacities o, which is largest for half-transparent Gaussians."""
    random_background: Share = 0.5
    """Share of the targets that are drawn on a random color instead of white, so that white
    Gaussians differ from missing Gaussians.
    """


def loss_terms(
    drawn: Drawn,
    images: Float[Array, "v h w 3"],
    masks: Float[Array, "v h w"],
    depths: Float[Array, "v h w"] | None,
    config: LossConfig,
    networks: LossNetworks,
) -> dict[str, Scalar]:
    """Returns the unweighted terms of the loss, scalars, by the name of their weight. The
    renderings must be drawn on the backgrounds of `images`. If `drawn` has no opacities, only terms
    that compare colors are returned.

    depths: true z of the person, metres, see `surface_distance`.

    Raises: ValueError if a term has a weight but what it needs is missing, or if the images are too
    small for `structural_scales` or for a network.
    """
    rgb, alpha, opacities = drawn.rendering.rgb, drawn.rendering.alpha, drawn.opacities
    structural = functools.partial(
        multiscale_structural_dissimilarity, scales=config.structural_scales
    )
    # terms that are always computed
    losses: dict[str, Array] = {
        "squared": squared_error(rgb, images),
        "structural": jax.vmap(structural)(rgb, images),
    }
    if opacities is not None:
        losses["silhouette"] = squared_error(alpha, masks)
        if drawn.tight_offsets is None:
            losses["tightness"] = jnp.zeros(())
        else:
            losses["tightness"] = tightness(drawn.tight_offsets)
    # terms with a weight alone; those of opacities only where Gaussians were drawn
    if config.absolute:
        losses["absolute"] = jnp.abs(rgb - images)
    if opacities is not None and config.boundary:
        losses["boundary"] = jnp.abs(alpha - masks)
    if opacities is not None and config.opaque:
        losses["opaque"] = translucency(opacities)
    if opacities is not None and config.distortion:
        losses["distortion"] = _needed(
            drawn.rendering.distortion, "distortion", "distortion of the rays"
        )
    if opacities is not None and config.depth:
        true = _needed(depths, "depth", "depth of the targets")
        losses["depth"] = surface_distance(drawn.rendering.depth, alpha, true, masks)
    # terms of networks
    if config.perceptual:
        losses["perceptual"] = _each(
            perceptual_loss, _needed(networks.perceptual, "perceptual", "VGG-19"), rgb, images
        )
    if config.vgg16:
        losses["vgg16"] = _each(
            vgg16_loss, _needed(networks.vgg16, "vgg16", "LPIPS vgg"), rgb, images
        )
    if config.lpips:
        losses["lpips"] = _each_lpips(_needed(networks.lpips, "lpips", "LPIPS"), rgb, images)
    return {name: jnp.mean(loss) for name, loss in losses.items()}


def _needed(thing: T | None, name: str, title: str) -> T:
    """Returns `thing`, which the term `name` needs. Raises: ValueError if it is None; `title` says
    what is missing.
    """
    if thing is None:
        raise ValueError(f"loss.{name} is not 0, but there is no {title}")
    return thing


def _each(
    compare: Callable[..., Scalar], network: T, predicted: Array, targets: Array
) -> Float[Array, " v"]:
    """Returns the loss of each view, (v,). Views are compared one after the other, because the
    features of all views at once would be the largest arrays of a step.
    """
    return jax.lax.map(jax.checkpoint(lambda pair: compare(network, *pair)), (predicted, targets))


def _each_lpips(
    network: Lpips, predicted: Float[Array, "v h w 3"], targets: Float[Array, "v h w 3"]
) -> Float[Array, " v"]:
    """Returns the LPIPS distance of each view, (v,). The features of the target are computed only
    once.

    VGG's feature maps would be the largest arrays of a step. So with VGG the views are compared one
    after the other, and the features of the predicted image are computed again for gradients. Other
    networks compare all views at once.
    """

    def one(pair: tuple[Array, Array]) -> Scalar:
        image, target = pair
        truth = jax.lax.stop_gradient(lpips_features(network, target))
        compare = lambda image: lpips_to(network, image, truth)
        return jax.checkpoint(compare)(image) if network.net == "vgg" else compare(image)

    if network.net == "vgg":
        return jax.lax.map(one, (predicted, targets))
    return jax.vmap(lambda *pair: one(pair))(predicted, targets)


def squared_error(predicted: Float[Array, "*b"], target: Float[Array, "*b"]) -> Float[Array, "*b"]:
    """Returns the elementwise squared difference of images in [0, 1], or of coverages and masks."""
    return jnp.square(predicted - target)


def surface_distance(
    depth: Float[Array, "*b"],
    alpha: Float[Array, "*b"],
    target_depth: Float[Array, "*b"],
    mask: Float[Array, "*b"],
) -> Float[Array, "*b"]:
    """Returns the distance of each pixel between the drawn and the true surface, metres, times
    alpha and mask.

    It is 0 where the true depth is 0, which means unknown. It is at most `FAR_SURFACE`, because
    beside a silhouette the two surfaces may belong to different limbs.
    """
    known = target_depth > 0
    return alpha * mask * known * jnp.minimum(jnp.abs(depth - target_depth), FAR_SURFACE)


def translucency(opacities: Float[Array, " g"]) -> Float[Array, " g"]:
    """Returns 4 o (1 - o) for opacities o. It is 0 for opacities of 0 and 1, and 1 for an opacity
    of 1/2.
    """
    return 4 * opacities * (1 - opacities)


def tightness(tight_offsets: Float[Array, "n k 3"]) -> Float[Array, " n"]:
    """Returns the squared distance of the tight Gaussians from their vertex, averaged over the k
    Gaussians of each vertex, (n,).

    Offsets are in normalised units (body height 1.8), so the weight of this term does not depend on
    the subject's size. Without tight Gaussians (k = 0) the distance is 0.
    """
    return jnp.sum(jnp.square(tight_offsets), axis=(-2, -1)) / max(1, tight_offsets.shape[-2])


# Metrics
# --------------------------------------------------------------------------------------------------


LARGEST_PSNR = 100.0
"""PSNR that is reported for equal images, dB. Their true PSNR is infinite and would spoil
any mean.
"""
SEMI_TRANSPARENT = (0.05, 0.9)
"""Alphas between these two values count as semi-transparent."""
BOUNDARY = 3 / 256
"""Half the width of the band at the silhouette, relative to the height of the image."""


def decibels(mean_squared_error: Float[Array, "*b"]) -> Float[Array, "*b"]:
    """Returns the PSNR of mean squared errors of values in [0, 1], at most 100 dB."""
    return -10 * jnp.log10(jnp.maximum(mean_squared_error, 10 ** (-LARGEST_PSNR / 10)))


def psnr(predicted: Float[Array, "h w c"], target: Float[Array, "h w c"]) -> Scalar:
    """Returns the peak signal-to-noise ratio over the whole image, dB. The prediction is clipped to
    [0, 1].
    """
    return decibels(jnp.mean(jnp.square(jnp.clip(predicted, 0, 1) - target)))


def masked_psnr(
    predicted: Float[Array, "h w c"], target: Float[Array, "h w c"], mask: Float[Array, "h w"]
) -> Scalar:
    """Returns the PSNR over the pixels of a mask, dB. The error of each pixel is weighted by the
    mask. The prediction is clipped to [0, 1]. The result is `LARGEST_PSNR` if the mask is empty.
    """
    errors = jnp.mean(jnp.square(jnp.clip(predicted, 0, 1) - target), axis=-1)
    return decibels(safe_divide(jnp.sum(errors * mask), jnp.sum(mask)))


def semi_transparent(alpha: Float[Array, "h w"], mask: Float[Array, "h w"]) -> Scalar:
    """Returns the share of the pixels with mask above a half whose alpha lies between the values of
    `SEMI_TRANSPARENT`. It is 0 if there are no such pixels.
    """
    inside = mask > 0.5
    partly = (alpha > SEMI_TRANSPARENT[0]) & (alpha < SEMI_TRANSPARENT[1]) & inside
    return jnp.sum(partly) / jnp.maximum(jnp.sum(inside), 1)


def silhouette_iou(alpha: Float[Array, "h w"], mask: Float[Array, "h w"]) -> Scalar:
    """Returns the intersection over union of the pixels with alpha above a half and the pixels with
    mask above a half. It is 1 if both are empty.
    """
    drawn, inside = alpha > 0.5, mask > 0.5
    union = jnp.sum(drawn | inside)
    return jnp.where(union > 0, jnp.sum(drawn & inside) / jnp.maximum(union, 1), 1.0)


def boundary_band(mask: np.ndarray) -> Float[np.ndarray, "h w"]:
    """Returns 1 in the band along the silhouette of a mask (h, w), and 0 elsewhere, (h, w). The
    band reaches `BOUNDARY` times the height of the image to either side. Computed on the host.
    """
    from scipy.ndimage import distance_transform_edt

    inside = np.asarray(mask) > 0.5
    distance = np.where(inside, distance_transform_edt(inside), distance_transform_edt(~inside))
    return (distance <= BOUNDARY * len(inside)).astype(np.float32)


# Structural similarity (Wang et al., 2004): differentiable and fast on every backend. Windows
# differ between papers. `GAUSSIAN` and `UNIFORM` give the numbers of scikit-image's
# `structural_similarity(data_range=1, channel_axis=-1)`, the first with `win_size=11,
# gaussian_weights=True`; `TORCHMETRICS` those of torchmetrics'
# `StructuralSimilarityIndexMeasure(data_range=1.0)`, which has the covariances of the original code
# (N instead of N - 1). Only pixels whose whole window lies in the image count. The window is
# separable, and a sum of shifted slices is some forty times faster on a CPU than the depthwise
# convolution.

STABILIZERS = (0.01**2, 0.03**2)
"""C1 and C2 of the paper, for values in [0, 1]."""
MIDDLE = 0.5
"""Grey that is subtracted from images before moments are taken. Otherwise E[x^2] - E[x]^2 of white
would lose four digits in float32 to cancellation.
"""


@dataclasses.dataclass(frozen=True)
class SsimWindow:
    """The window over which SSIM takes means and variances."""

    size: int = 11
    """Side of the window, pixels, odd."""
    sigma: float | None = 1.5
    """Standard deviation of the weights, pixels; None: all weights are equal."""
    sample: bool = True
    """Whether covariances are divided by N - 1 instead of N."""

    @property
    def weights(self) -> np.ndarray:
        """The normalised weights along one axis, (size,) float64."""
        if self.sigma is None:
            return np.full(self.size, 1 / self.size)
        weights = np.exp(-0.5 * ((np.arange(self.size) - self.size // 2) / self.sigma) ** 2)
        return weights / weights.sum()

    @property
    def covariance_factor(self) -> float:
        """Factor on covariances, 1 unless `sample` is set. Covariances are computed with the
        divisor N, and the factor makes the divisor N - 1.
        """
        if self.sample:
            return self.size**2 / (self.size**2 - 1)
        return 1.0


GAUSSIAN = SsimWindow()
UNIFORM = SsimWindow(7, None)
TORCHMETRICS = SsimWindow(sample=False)


def _windowed(x: Float[Array, "*b h w c"], window: SsimWindow) -> Float[Array, "*b y x c"]:
    """Returns the weighted sum over each window that lies inside the image. Shifted slices are
    summed along the first axis, then along the second.
    """
    height, width = x.shape[-3] - window.size + 1, x.shape[-2] - window.size + 1
    rows = jnp.asarray(
        sum(float(weight) * x[..., i : i + height, :, :] for i, weight in enumerate(window.weights))
    )
    return jnp.asarray(
        sum(float(weight) * rows[..., i : i + width, :] for i, weight in enumerate(window.weights))
    )


@functools.partial(jax.custom_vjp, nondiff_argnums=(1,))
def blur(x: Float[Array, "*b h w c"], window: SsimWindow = GAUSSIAN) -> Float[Array, "*b y x c"]:
    """Returns the weighted means over the windows that lie inside the image, (..., h - size + 1, w
    - size + 1, c).

    Raises: ValueError for an image smaller than the window.
    """
    if min(x.shape[-3:-1]) < window.size:
        raise ValueError(
            f"an image of {x.shape[-2]} x {x.shape[-3]} has no {window.size} x {window.size} window"
        )
    return _windowed(x, window)


def _blur_transposed(
    window: SsimWindow, _: None, gradient: Float[Array, "*b y x c"]
) -> tuple[Float[Array, "*b h w c"]]:
    # the window is symmetric, so the transpose is the same sum over the zero-padded gradient; left
    # to itself, JAX would pad and add once per slice, which takes four times as long
    margin = (window.size - 1, window.size - 1)
    return (
        _windowed(
            jnp.pad(gradient, [(0, 0)] * (gradient.ndim - 3) + [margin, margin, (0, 0)]), window
        ),
    )


blur.defvjp(lambda x, window: (blur(x, window), None), _blur_transposed)


def similarity_map(
    predicted: Float[Array, "h w c"], target: Float[Array, "h w c"], window: SsimWindow = GAUSSIAN
) -> Float[Array, "y x c"]:
    """Returns the SSIM per pixel and channel, (h - size + 1, w - size + 1, c). It is 1 where the
    images agree. Raises: as `blur`.
    """
    x, y = predicted - MIDDLE, target - MIDDLE
    moments = blur(jnp.concatenate([x, y, x * x, y * y, x * y], axis=-1), window)
    mean_x, mean_y, square_x, square_y, product = jnp.split(moments, 5, axis=-1)
    variances = window.covariance_factor * (square_x + square_y - mean_x * mean_x - mean_y * mean_y)
    covariance = window.covariance_factor * (product - mean_x * mean_y)
    mean_x, mean_y = mean_x + MIDDLE, mean_y + MIDDLE
    luminance = (2 * mean_x * mean_y + STABILIZERS[0]) / (
        mean_x * mean_x + mean_y * mean_y + STABILIZERS[0]
    )
    return luminance * (2 * covariance + STABILIZERS[1]) / (variances + STABILIZERS[1])


def mean_similarity(similarities: Float[Array, "y x c"], count: Int[Array, "2"]) -> Scalar:
    """Returns the mean of the first count[0] rows and count[1] columns of a similarity map. This is
    for images that were padded below and right.
    """
    inside = [jnp.arange(side) < n for side, n in zip(similarities.shape[:2], count, strict=True)]
    counted = jnp.where(inside[0][:, None] & inside[1], jnp.mean(similarities, axis=-1), 0.0)
    # rows first: one float32 sum over a million values would lose digits
    return jnp.sum(jnp.sum(counted, axis=1) / count[1]) / count[0]


def structural_dissimilarity(
    predicted: Float[Array, "h w c"], target: Float[Array, "h w c"]
) -> Float[Array, "y x c"]:
    """Returns (1 - SSIM) / 2 for each channel and each place of the window inside of the image,
    shaped as by `similarity_map`: from 0 (equal images) to 1 (inverse images). Raises: as `blur`.
    """
    return 0.5 * (1 - similarity_map(predicted, target))


def halve(image: Float[Array, "h w c"]) -> Float[Array, "y x c"]:
    """Returns an image at half its size, averaged over boxes of 2 x 2 pixels. An odd last row or
    column is left out.
    """
    height, width, channels = image.shape
    even = image[: height // 2 * 2, : width // 2 * 2]
    return even.reshape(height // 2, 2, width // 2, 2, channels).mean(axis=(1, 3))


def multiscale_structural_dissimilarity(
    predicted: Float[Array, "h w c"], target: Float[Array, "h w c"], scales: int = 3
) -> Scalar:
    """Returns the mean structural dissimilarity over `scales` sizes of the images. Each size is
    half of the one before, and all sizes have the same weight.

    Raises: ValueError if the smallest size has no whole window (it needs 11 pixels a side).
    """
    total = jnp.mean(structural_dissimilarity(predicted, target))
    for _ in range(scales - 1):
        predicted, target = halve(predicted), halve(target)
        total += jnp.mean(structural_dissimilarity(predicted, target))
    return total / scales
