"""Computes losses that compare the features of frozen convolutional networks: LPIPS, the published
perceptual loss, and a loss of VGG-16.

A network is a tuple of slices, and a slice is a tuple of layers. The map after the last layer of
each slice is a feature that is compared. The names of layers are torchvision's numbers in its
`features` list ("0", "3.squeeze"). Every convolution has a bias and is followed by a ReLU. A fire
module is a 1x1 convolution whose output enters a 1x1 and a 3x3 convolution.

All functions take single images, and losses take them in [0, 1]. Use `jax.vmap` for batches.
`losses.loss_networks` reads the weights.
"""

import functools
import itertools
from collections.abc import Iterator
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from humangs_jax.core.array_types import Array, Float, Int, Scalar
from humangs_jax.core.numerics import absolute, at_least_float32, safe_sqrt
from humangs_jax.core.pytree import pytree_dataclass, static_field
from humangs_jax.network.maps import convolve


@pytree_dataclass
class Convolution:
    """The parameters of one convolution."""

    kernel: Float[Array, "y x i o"]
    """Kernel, (rows, columns, in, out)."""
    bias: Float[Array, " o"]
    """Bias, (out,)."""


Weights = dict[str, Convolution]
"""Convolutions by the name of their layer."""


class Conv(NamedTuple):
    """A convolution with `padding` zeros on each side, followed by a ReLU."""

    name: str
    """Name of the layer in weights files."""
    inputs: int
    """Number of input channels."""
    outputs: int
    """Number of output channels."""
    size: int = 3
    """Side of the kernel, pixels."""
    stride: int = 1
    """Step between outputs, pixels."""
    padding: int = 1
    """Zeros on each side, pixels."""


class Pool(NamedTuple):
    """A pooling layer: the largest or the mean value of each window. Without `ceil`, rows and
    columns that fill no window are ignored.
    """

    size: int = 3
    """Side of the window, pixels."""
    stride: int = 2
    """Step between windows, pixels."""
    average: bool = False
    """Whether to take the mean instead of the largest value."""
    ceil: bool = False
    """Whether windows that reach beyond the border also count."""


class Fire(NamedTuple):
    """SqueezeNet's fire module: a narrow convolution, then two expanding convolutions side
    by side.
    """

    name: str
    """Name of the module in weights files."""
    inputs: int
    """Number of input channels."""
    squeezed: int
    """Channels of the narrow convolution."""
    outputs: int
    """Channels of both expanding convolutions together."""

    @property
    def convolutions(self) -> tuple[Conv, Conv, Conv]:
        """The narrow convolution, then the two convolutions that take its output."""
        half = self.outputs // 2
        return (
            Conv(f"{self.name}.squeeze", self.inputs, self.squeezed, 1, 1, 0),
            Conv(f"{self.name}.expand1x1", self.squeezed, half, 1, 1, 0),
            Conv(f"{self.name}.expand3x3", self.squeezed, half),
        )


Layer = Conv | Pool | Fire
Slices = tuple[tuple[Layer, ...], ...]


def vgg(depths: tuple[int, ...], feature: tuple[int, ...], average: bool = False) -> Slices:
    """Returns the slices of a VGG whose block b has `depths[b]` convolutions. In each block, the
    map after convolution `feature[b]`, counted from 1, is compared. Layers after the last compared
    map are left out.

    average: whether pools take means.
    """
    slices: list[tuple[Layer, ...]] = []
    layers: list[Layer] = []
    index, inputs = 0, 3
    for block, depth in enumerate(depths):
        outputs = min(64 << block, 512)
        for number in range(1, depth + 1):
            layers.append(Conv(str(index), inputs, outputs))
            index, inputs = index + 2, outputs  # its ReLU has a number too
            if number == feature[block]:
                slices.append(tuple(layers))
                layers = []
        layers.append(Pool(2, 2, average))
        index += 1
    return tuple(slices)  # what follows the last feature is not needed


VGG16 = vgg((2, 2, 3, 3, 3), (2, 2, 3, 3, 3))
VGG19 = vgg((2, 2, 4, 4, 4), (2, 2, 2, 2, 2), average=True)
ALEXNET: Slices = (
    (Conv("0", 3, 64, 11, 4, 2),),
    (Pool(), Conv("3", 64, 192, 5, 1, 2)),
    (Pool(), Conv("6", 192, 384)),
    (Conv("8", 384, 256),),
    (Conv("10", 256, 256),),
)
SQUEEZENET: Slices = (
    (Conv("0", 3, 64, 3, 2, 0),),
    (Pool(ceil=True), Fire("3", 64, 16, 128), Fire("4", 128, 16, 128)),
    (Pool(ceil=True), Fire("6", 128, 32, 256), Fire("7", 256, 32, 256)),
    (Pool(ceil=True), Fire("9", 256, 48, 384)),
    (Fire("10", 384, 48, 384),),
    (Fire("11", 384, 64, 512),),
    (Fire("12", 512, 64, 512),),
)
BACKBONES: dict[str, Slices] = {"vgg": VGG16, "alex": ALEXNET, "squeeze": SQUEEZENET}
"""Backbones of LPIPS by their names."""


def convolutions(slices: Slices) -> Iterator[Conv]:
    """Yields all convolutions of a network, also in its fire modules."""
    for layer in itertools.chain.from_iterable(slices):
        if isinstance(layer, Fire):
            yield from layer.convolutions
        elif isinstance(layer, Conv):
            yield layer


def channels(slices: Slices) -> tuple[int, ...]:
    """Returns the number of channels of each compared feature map."""
    return tuple(
        [layer for layer in part if not isinstance(layer, Pool)][-1].outputs for part in slices
    )


@functools.cache
def smallest_side(slices: Slices) -> int:
    """Returns the smallest side of an image, pixels, with which every layer finds a whole
    window.
    """

    def fits(side: int) -> bool:
        for layer in itertools.chain.from_iterable(slices):
            if isinstance(layer, Fire):
                continue
            if side + 2 * getattr(layer, "padding", 0) < layer.size:
                return False
            side = _size_after(layer, side)
        return True

    return next(side for side in itertools.count(1) if fits(side))


def _size_after(layer: Conv | Pool, size: Any) -> Any:
    """Returns the size of the maps after a convolution or a pool. size: the size before it, an int
    or an array of several sizes.
    """
    if isinstance(layer, Conv):
        margin = 2 * layer.padding
    else:
        margin = (layer.stride - 1) * layer.ceil
    return (size + margin - layer.size) // layer.stride + 1


def feature_maps(
    weights: Weights,
    slices: Slices,
    image: Float[Array, "h w 3"],
    size: Int[Array, "2"] | None = None,
) -> list[tuple[Float[Array, "y x c"], Int[Array, "2"] | None]]:
    """Returns the compared maps of an image, each with its size. The image's colors must be scaled
    as the network expects.

    Everything is computed in the dtype of the weights.

    size: height and width of the image without padding, if it was padded below and right so that
    images of several sizes share a program. The maps are then equal to the maps of the image
    without padding, with zeros beyond these, and the returned sizes say where the zeros begin.
    None: the image is not padded, and the returned sizes are None.
    Raises: ValueError for an image that is too small for the network.
    """
    height, width, _ = image.shape
    least = smallest_side(slices)
    if min(height, width) < least:
        raise ValueError(
            f"an image of {width} x {height} is too small for this network: {least} pixels a side"
            " needed"
        )
    maps, x = [], _cleared(image.astype(weights["0"].kernel.dtype), size)
    for part in slices:
        for layer in part:
            x, size = _apply(weights, layer, x, size)
        maps.append((x, size))
    return maps


def _cleared(x: Float[Array, "y x c"], size: Int[Array, "2"] | None) -> Float[Array, "y x c"]:
    """Returns a map with zeros beyond its size, as convolutions pad an image with zeros."""
    if size is None:
        return x
    inside = [jnp.arange(side) < n for side, n in zip(x.shape[:2], size, strict=True)]
    return jnp.where((inside[0][:, None] & inside[1])[..., None], x, 0)


def _apply(
    weights: Weights, layer: Layer, x: Float[Array, "y x c"], size: Int[Array, "2"] | None
) -> tuple[Float[Array, "i j d"], Int[Array, "2"] | None]:
    if isinstance(layer, Fire):
        first, *expand = layer.convolutions
        x, size = _apply(weights, first, x, size)
        return (
            jnp.concatenate([_apply(weights, part, x, size)[0] for part in expand], axis=-1),
            size,
        )
    # values are not negative, so a zero beyond the map changes no maximum of a pool
    if isinstance(layer, Pool):
        x = _pool(layer, x)
    else:
        x = _convolve(weights[layer.name], layer, x)
    if size is not None:
        size = _size_after(layer, size)
    return _cleared(x, size), size


def _convolve(weights: Convolution, layer: Conv, x: Float[Array, "y x c"]) -> Float[Array, "i j d"]:
    if (layer.size, layer.stride, layer.padding) == (3, 1, 1):
        y = convolve(x[None], weights.kernel)
    else:
        stride, padding = (layer.stride,) * 2, [(layer.padding, layer.padding)] * 2
        layout = ("NHWC", "HWIO", "NHWC")
        y = jax.lax.conv_general_dilated(
            x[None], weights.kernel, stride, padding, dimension_numbers=layout
        )
    return jax.nn.relu(y[0] + weights.bias)


def _pool(layer: Pool, x: Float[Array, "y x c"]) -> Float[Array, "i j c"]:
    """Returns the pooled map. It combines strided slices of columns, then of rows, which is seven
    times as fast on a CPU as a windowed reduction and its gradient.
    """
    if layer.ceil:
        missing = [-(side - layer.size) % layer.stride for side in x.shape[:2]]
        x = jnp.pad(x, [(0, missing[0]), (0, missing[1]), (0, 0)], constant_values=-jnp.inf)
    combine = jnp.add if layer.average else _larger
    for axis in (1, 0):
        length = (x.shape[axis] - layer.size) // layer.stride * layer.stride + 1
        slices = [
            jax.lax.slice_in_dim(x, i, i + length, layer.stride, axis) for i in range(layer.size)
        ]
        x = functools.reduce(combine, slices)
    return x / layer.size**2 if layer.average else x


def _larger(x: Float[Array, "*b"], y: Float[Array, "*b"]) -> Float[Array, "*b"]:
    # of equal values (plain backgrounds) the first gets the gradient, as in torch; NaN propagates
    return jnp.where((y > x) | jnp.isnan(y), y, x)


EPSILON = 1e-10
"""Number added to divisors, such as the length of a feature vector, against a division by 0."""


@pytree_dataclass
class Lpips:
    """One network of LPIPS."""

    backbone: Weights
    """The backbone's convolutions."""
    heads: tuple[Float[Array, " _"], ...]
    """Weights of the channels of each compared map, one array (channels,) for each map."""
    net: str = static_field()
    """Name of the backbone, a key of `BACKBONES`."""


def _scaled(image: Array) -> Array:
    """Returns colors in [0, 1] scaled as the backbones of LPIPS expect them."""
    shift = jnp.asarray((-0.030, -0.088, -0.188), image.dtype)
    scale = jnp.asarray((0.458, 0.448, 0.450), image.dtype)
    return (2 * image - 1 - shift) / scale


def _unit(x: Float[Array, "y x c"]) -> Float[Array, "y x c"]:
    """Returns the features of each pixel divided by their length."""
    return x / (safe_sqrt(jnp.sum(jnp.square(x), axis=-1, keepdims=True)) + EPSILON)


def lpips_distances(
    weights: Lpips,
    predicted: Float[Array, "h w 3"],
    target: Float[Array, "h w 3"],
    size: Int[Array, "2"] | None = None,
) -> Float[Array, " _"]:
    """Returns the distance of two images at each depth of the backbone, (depths,). vgg and alex
    have five depths, squeeze has seven. The sum is `lpips`. Raises: as `lpips`.
    """
    maps = [lpips_features(weights, image, size) for image in (predicted, target)]
    return _distances(weights, *maps)


LpipsMaps = list[tuple[Float[Array, "_y _x _c"], Int[Array, "2"] | None]]
"""Unit-length features of an image at each depth, with the sizes of their maps, see
`feature_maps`.
"""


def lpips_features(
    weights: Lpips, image: Float[Array, "h w 3"], size: Int[Array, "2"] | None = None
) -> LpipsMaps:
    """Returns the features of an image that `lpips` compares. size: see `feature_maps`. Raises: as
    `feature_maps`.
    """
    image = at_least_float32(image)
    maps = feature_maps(weights.backbone, BACKBONES[weights.net], _scaled(image), size)
    return [(_unit(at_least_float32(x)), own) for x, own in maps]


def lpips_to(weights: Lpips, predicted: Float[Array, "h w 3"], target: LpipsMaps) -> Scalar:
    """Returns the `lpips` distance between an image and another image. target: the features of the
    other image, as `lpips_features` returns them. Raises: as `feature_maps`.
    """
    return jnp.sum(_distances(weights, lpips_features(weights, predicted), target))


def _distances(weights: Lpips, predicted: LpipsMaps, target: LpipsMaps) -> Float[Array, " _"]:
    """Returns the distances of two images' features at all depths, (depths,)."""
    distances = []
    for head, (x, own), (y, _) in zip(weights.heads, predicted, target, strict=True):
        different = jnp.sum(head * jnp.square(x - y), axis=-1)
        if own is None:
            distances.append(jnp.mean(different))
        else:
            distances.append(jnp.sum(different) / (own[0] * own[1]))
    return jnp.stack(distances)


def lpips(
    weights: Lpips,
    predicted: Float[Array, "h w 3"],
    target: Float[Array, "h w 3"],
    size: Int[Array, "2"] | None = None,
) -> Scalar:
    """Returns the LPIPS distance of two images (Zhang et al., 2018, version 0.1): the distance of
    their unit-length features, weighted per channel by learned heads.

        d = sum over slices of the mean over pixels of sum_c w_c (x_c / |x| - y_c / |y|)^2

    size: height and width of the images without padding, if both were padded below and right, see
    `feature_maps`. The padding does not change the distance.
    Raises: ValueError for images that are too small (16 pixels a side for vgg, 31 for alex, 25 for
    squeeze).
    """
    return jnp.sum(lpips_distances(weights, predicted, target, size))


def vgg16_loss(
    weights: Lpips, predicted: Float[Array, "h w 3"], target: Float[Array, "h w 3"]
) -> Scalar:
    """Returns the mean absolute difference of two images' features of VGG-16, relative to the mean
    of the target's features, averaged over five depths.

    weights: the weights of LPIPS "vgg", whose heads are not used. `perceptual_loss` needs the
    weights of the original VGG-19; this loss works with the weights of the extra `lpips`. LPIPS
    compares the directions of features; this loss compares their sizes, too. No gradient flows into
    the target. Raises: ValueError for images under 16 pixels a side, and for another network.
    """
    if weights.net != "vgg":
        raise ValueError(f"vgg16_loss: expected LPIPS vgg, got {weights.net}")
    images = at_least_float32((predicted, jax.lax.stop_gradient(target)))
    maps = [
        [x for x, _ in feature_maps(weights.backbone, VGG16, _scaled(image))] for image in images
    ]
    pairs = map(at_least_float32, zip(*maps, strict=True))
    return jnp.mean(
        jnp.stack([jnp.mean(absolute(x - y)) / (jnp.mean(y) + EPSILON) for x, y in pairs])
    )


DIVISORS = (1.0, 2.6, 4.8, 3.7, 5.6, 0.15)
"""Divisors of the errors of the pixels and of the features at five depths."""


@pytree_dataclass
class Vgg19:
    """The convolutions of VGG-19 that the perceptual loss looks at (14 of 16)."""

    weights: Weights
    """The convolutions, by the numbers of torchvision's layers."""


def perceptual_errors(
    vgg: Vgg19, predicted: Float[Array, "h w 3"], target: Float[Array, "h w 3"]
) -> Float[Array, "6"]:
    """Returns the mean absolute differences of two images, (6,): of their pixels in [0, 255], and
    of their features of VGG-19 (with average pooling) at five depths.

    Colors enter as 255 * rgb - (123.68, 116.779, 103.939). The weights of the original VGG-19
    expect this. They are in MatConvNet's file and in the released checkpoint. torchvision's weights
    expect other scales, and would make another loss. Features are taken after the second ReLU of
    each block. No gradient flows into the target. Raises: ValueError for images under 16 pixels a
    side.
    """
    target = jax.lax.stop_gradient(target)
    images = [255 * image for image in at_least_float32((predicted, target))]
    mean = jnp.asarray((123.68, 116.779, 103.939), images[0].dtype)
    maps = [[x for x, _ in feature_maps(vgg.weights, VGG19, image - mean)] for image in images]
    pairs = zip(
        *([image, *features] for image, features in zip(images, maps, strict=True)), strict=True
    )
    return jnp.stack([jnp.mean(absolute(x - y)) for x, y in map(at_least_float32, pairs)])


def perceptual_loss(
    vgg: Vgg19, predicted: Float[Array, "h w 3"], target: Float[Array, "h w 3"]
) -> Scalar:
    """Returns the published perceptual loss. Each of the `perceptual_errors` is divided by its
    entry of `DIVISORS`. The loss is the sum of the quotients, divided by 255.

    Raises: as `perceptual_errors`.
    """
    errors = perceptual_errors(vgg, predicted, target)
    return jnp.sum(errors / jnp.asarray(DIVISORS, errors.dtype)) / 255
