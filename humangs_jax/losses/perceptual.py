"""The published perceptual loss: L1 between the features of a VGG-19 with average pooling, at five depths, and pixels.

Colors enter as 255 * rgb - (123.68, 116.779, 103.939), which is what the weights of the original VGG-19 expect (those of
MatConvNet's file and of the released checkpoint; torchvision's expect other scales and make another loss of it). The
features are those after the second ReLU of each block. Losses are for ONE image; batch with `jax.vmap`.
"""

import jax
import jax.numpy as jnp

from humangs_jax.core.array_types import Array, Float, Scalar
from humangs_jax.core.numerics import absolute, at_least_float32
from humangs_jax.core.pytree import pytree_dataclass
from humangs_jax.losses.backbones import Weights, feature_maps, vgg

VGG19 = vgg((2, 2, 4, 4, 4), (2, 2, 2, 2, 2), average=True)
MEAN_COLOR = (123.68, 116.779, 103.939)
DIVISORS = (1.0, 2.6, 4.8, 3.7, 5.6, 0.15)
"""Divisors of the errors of the pixels and of the five depths."""


@pytree_dataclass
class Vgg19:
    """The convolutions of VGG-19 that the loss looks at (14 of 16), by torchvision's numbers."""

    weights: Weights


def perceptual_errors(vgg: Vgg19, predicted: Float[Array, "h w 3"], target: Float[Array, "h w 3"]) -> Float[Array, "6"]:
    """Mean absolute differences of the pixels in [0, 255] and of the features at the five depths.

    Images are in [0, 1]. No gradient flows into the target. Raises: ValueError for images under 16 pixels a side.
    """
    target = jax.lax.stop_gradient(target)
    images = [255 * image for image in at_least_float32((predicted, target))]
    mean = jnp.asarray(MEAN_COLOR, images[0].dtype)
    maps = [[x for x, _ in feature_maps(vgg.weights, VGG19, image - mean)] for image in images]
    pairs = zip(*([image, *features] for image, features in zip(images, maps, strict=True)), strict=True)
    return jnp.stack([jnp.mean(absolute(x - y)) for x, y in map(at_least_float32, pairs)])


def perceptual_loss(vgg: Vgg19, predicted: Float[Array, "h w 3"], target: Float[Array, "h w 3"]) -> Scalar:
    """The weighted sum of `perceptual_errors`."""
    errors = perceptual_errors(vgg, predicted, target)
    return jnp.sum(errors / jnp.asarray(DIVISORS, errors.dtype)) / 255
