"""LPIPS (Zhang et al., 2018, version 0.1): distances of unit-length features, weighed per channel by learned heads.

    d = sum over slices of the mean over pixels of sum_c w_c (x_c / |x| - y_c / |y|)^2

Images in [0, 1] are brought to [-1, 1] and then to the colors that the backbones were trained on. For ONE image; batch
with `jax.vmap`.
"""

import jax.numpy as jnp

from humangs_jax.core.array_types import Array, Float, Int, Scalar
from humangs_jax.core.numerics import at_least_float32, safe_sqrt
from humangs_jax.core.pytree import pytree_dataclass, static_field
from humangs_jax.losses.backbones import ALEXNET, SQUEEZENET, VGG16, Slices, Weights, feature_maps

BACKBONES: dict[str, Slices] = {"vgg": VGG16, "alex": ALEXNET, "squeeze": SQUEEZENET}
SHIFT = (-0.030, -0.088, -0.188)
SCALE = (0.458, 0.448, 0.450)
"""Mean and scale of colors in [-1, 1] that the backbones expect."""
EPSILON = 1e-10
"""Added to the length of a feature vector."""


@pytree_dataclass
class Lpips:
    """A backbone's convolutions, the weight of each channel of its compared maps, and which backbone it is."""

    backbone: Weights
    heads: tuple[Float[Array, " _"], ...]
    net: str = static_field()


def _unit(x: Float[Array, "y x c"]) -> Float[Array, "y x c"]:
    return x / (safe_sqrt(jnp.sum(jnp.square(x), axis=-1, keepdims=True)) + EPSILON)


def lpips_distances(
    weights: Lpips, predicted: Float[Array, "h w 3"], target: Float[Array, "h w 3"], size: Int[Array, "2"] | None = None
) -> Float[Array, " _"]:
    """The distance at each depth of the backbone: five for vgg and alex, seven for squeeze. See `lpips`."""
    images = at_least_float32((predicted, target))
    shift, scale = (jnp.asarray(x, images[0].dtype) for x in (SHIFT, SCALE))
    slices = BACKBONES[weights.net]
    maps = [feature_maps(weights.backbone, slices, (2 * image - 1 - shift) / scale, size) for image in images]
    distances = []
    for head, (x, own), (y, _) in zip(weights.heads, *maps, strict=True):
        x, y = at_least_float32((x, y))
        different = jnp.sum(head * jnp.square(_unit(x) - _unit(y)), axis=-1)
        distances.append(jnp.mean(different) if own is None else jnp.sum(different) / (own[0] * own[1]))
    return jnp.stack(distances)


def lpips(
    weights: Lpips, predicted: Float[Array, "h w 3"], target: Float[Array, "h w 3"], size: Int[Array, "2"] | None = None
) -> Scalar:
    """The distance of two images in [0, 1]; 0 for equal ones.

    size: height and width of the images where both were padded below and right: the distance is that of the images without
    padding, so that images of several sizes share a program.
    Raises: ValueError for images that are too small (16 pixels a side for vgg, 31 for alex, 25 for squeeze).
    """
    return jnp.sum(lpips_distances(weights, predicted, target, size))
