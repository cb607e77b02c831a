"""The terms of the training loss: their weights, the table that a step adds up, and the losses, unreduced."""

import functools
from collections.abc import Callable
from typing import Annotated, TypeVar

import jax
import jax.numpy as jnp

from humangs_jax.core.array_types import Array, Float, Scalar
from humangs_jax.core.configuration import Range, Share, Weight, configuration
from humangs_jax.losses.loss_networks import LossNetworks
from humangs_jax.losses.metrics import multiscale_structural_dissimilarity
from humangs_jax.losses.perceptual import lpips, perceptual_loss, vgg16_loss
from humangs_jax.network.parts import Drawn

T = TypeVar("T")
FAR_SURFACE = 0.1
"""Metres."""


@configuration
class LossConfig:
    """Weights of the terms, each a mean over pixels or vertices and over the targets.

    Squared errors make semi-transparent foreground where the network is in doubt; the terms after `lpips` are against it. They
    and the perceptual ones, which need networks that the user has (`losses.loss_networks`), are computed only where their weight
    is not 0.
    """

    squared: Weight = 1.0
    """Squared error of the colors."""
    structural: Weight = 0.2
    """Structural dissimilarity at `structural_scales` sizes."""
    structural_scales: Annotated[int, Range(1, 16)] = 3
    silhouette: Weight = 0.1
    """Squared error of the coverage."""
    tightness: Weight = 0.1
    """Squared tight offsets, normalised units."""
    perceptual: Weight = 0.0
    """Difference of the features of VGG-19."""
    vgg16: Weight = 0.0
    """Difference of the features of VGG-16, with the backbone of LPIPS "vgg"."""
    lpips: Weight = 0.0
    """Learned distance of features."""
    absolute: Weight = 0.0
    """Absolute error of colors."""
    boundary: Weight = 0.0
    """Absolute error of coverage."""
    depth: Weight = 0.0
    """Distance between the surfaces seen, metres; 0 for people on disk, whose depths are unknown."""
    distortion: Weight = 0.0
    """Spread of the weights along the rays."""
    opaque: Weight = 0.0
    """4 o (1 - o) of the opacities o."""
    shells: Weight = 0.0
    """Spread of the distances that a Gaussian mixes, normalised units."""
    random_background: Share = 0.5
    """Share of the targets that are seen against one random color instead of white, so that white Gaussians differ from missing
    ones."""


def loss_terms(
    drawn: Drawn,
    images: Float[Array, "v h w 3"],
    masks: Float[Array, "v h w"],
    depths: Float[Array, "v h w"] | None,
    config: LossConfig,
    networks: LossNetworks,
) -> dict[str, Scalar]:
    """The unweighted terms by the name of their weight, for renderings on the backgrounds of `images`.

    depths: true z of the person, metres, see `surface_distance`. Raises: ValueError if a term has a weight but what it needs is
    missing.
    """
    rgb, alpha, opacities = drawn.rendering.rgb, drawn.rendering.alpha, drawn.opacities
    structural = functools.partial(multiscale_structural_dissimilarity, scales=config.structural_scales)
    losses: dict[str, Array] = {"squared": squared_error(rgb, images), "structural": jax.vmap(structural)(rgb, images)}
    if opacities is not None:
        losses["silhouette"] = squared_error(alpha, masks)
        losses["tightness"] = jnp.zeros(()) if drawn.tight_offsets is None else tightness(drawn.tight_offsets)
    if config.absolute:
        losses["absolute"] = jnp.abs(rgb - images)
    if opacities is not None and config.boundary:
        losses["boundary"] = jnp.abs(alpha - masks)
    if opacities is not None and config.opaque:
        losses["opaque"] = translucency(opacities)
    if opacities is not None and config.distortion:
        losses["distortion"] = _needed(drawn.spread, "distortion", "spread of the rays")
    if opacities is not None and config.shells:
        losses["shells"] = _needed(drawn.shell_spread, "shells", "shell of the reader")
    if opacities is not None and config.depth:
        true = _needed(depths, "depth", "depth of the targets")
        losses["depth"] = surface_distance(drawn.rendering.depth, alpha, true, masks)
    if config.perceptual:
        losses["perceptual"] = _each(perceptual_loss, _needed(networks.perceptual, "perceptual", "VGG-19"), rgb, images)
    if config.vgg16:
        losses["vgg16"] = _each(vgg16_loss, _needed(networks.vgg16, "vgg16", "LPIPS vgg"), rgb, images)
    if config.lpips:
        losses["lpips"] = _each(lpips, _needed(networks.lpips, "lpips", "LPIPS"), rgb, images)
    return {name: jnp.mean(loss) for name, loss in losses.items()}


def _needed(thing: T | None, name: str, title: str) -> T:
    if thing is None:
        raise ValueError(f"loss.{name} is not 0, but there is no {title}")
    return thing


def _each(compare: Callable[..., Scalar], network: T, predicted: Array, targets: Array) -> Float[Array, " v"]:
    """One view after the other: the features of all at once would be the largest arrays of a step."""
    return jax.lax.map(jax.checkpoint(lambda pair: compare(network, *pair)), (predicted, targets))


def squared_error(predicted: Float[Array, "*b"], target: Float[Array, "*b"]) -> Float[Array, "*b"]:
    """Squared difference, elementwise; of images in [0, 1], or of coverages and masks."""
    return jnp.square(predicted - target)


def surface_distance(
    depth: Float[Array, "*b"], alpha: Float[Array, "*b"], target_depth: Float[Array, "*b"], mask: Float[Array, "*b"]
) -> Float[Array, "*b"]:
    """Distance between the surface drawn and the true one, in the unit of the depths, where both are the person's.

    0 where the true one is unknown (0). At most `FAR_SURFACE`: across a silhouette the nearest surfaces are different limbs.
    """
    known = target_depth > 0
    return alpha * mask * known * jnp.minimum(jnp.abs(depth - target_depth), FAR_SURFACE)


def ray_spread(alpha: Float[Array, "*b"], depth: Float[Array, "*b"], squared: Float[Array, "*b"]) -> Float[Array, "*b"]:
    """Distortion of the weights w along a ray: sum over pairs of w_i w_j (z_i - z_j)^2, squared units of z.

    alpha: the sum of w. depth, squared: mean of z and of its square, weighted by w. The loss of 2DGS
    (https://arxiv.org/abs/2403.17888, eq. 13) with squared differences, after mip-NeRF 360 (https://arxiv.org/abs/2111.12077).
    """
    return 2 * alpha**2 * jnp.maximum(squared - depth**2, 0)


def translucency(opacities: Float[Array, " g"]) -> Float[Array, " g"]:
    """4 o (1 - o): 0 for opacities of 0 and 1, 1 between them."""
    return 4 * opacities * (1 - opacities)


def tightness(tight_offsets: Float[Array, "n k 3"]) -> Float[Array, " n"]:
    """Distance of the tight Gaussians from their vertex: squared norm of the offset, averaged over the k of a vertex.

    Offsets are in normalised units (body height 1.8), so the weight of this term does not depend on the subject's size.
    Without tight Gaussians (k = 0) it is 0.
    """
    return jnp.sum(jnp.square(tight_offsets), axis=(-2, -1)) / max(1, tight_offsets.shape[-2])
