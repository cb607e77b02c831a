"""The convolutional networks whose features losses compare, as tables of layers: VGG, AlexNet, SqueezeNet 1.1.

A network is a tuple of slices, a slice a tuple of layers; the map after the last layer of each slice is a feature that is
compared. Layers carry torchvision's numbers in its `features` list as names ("0", "3.squeeze"). Every convolution has a
bias and is followed by a ReLU; a fire module is a 1x1 convolution whose output a 1x1 and a 3x3 convolution share.
"""

import functools
import itertools
from collections.abc import Iterator
from typing import NamedTuple

import jax
import jax.numpy as jnp

from humangs_jax.core.array_types import Array, Float, Int
from humangs_jax.core.pytree import pytree_dataclass
from humangs_jax.network.convolution import convolve


@pytree_dataclass
class Convolution:
    """kernel (rows, columns, in, out) and bias of one convolution."""

    kernel: Float[Array, "y x i o"]
    bias: Float[Array, " o"]


Weights = dict[str, Convolution]
"""Convolutions by the name of their layer."""


class Conv(NamedTuple):
    """A convolution with `padding` zeros on each side, and its ReLU."""

    name: str
    inputs: int
    outputs: int
    size: int = 3
    stride: int = 1
    padding: int = 1


class Pool(NamedTuple):
    """Largest or mean value of a window; without `ceil`, rows and columns that fill no window are ignored."""

    size: int = 3
    stride: int = 2
    average: bool = False
    ceil: bool = False


class Fire(NamedTuple):
    """SqueezeNet's module: `outputs` is that of both expanding convolutions together."""

    name: str
    inputs: int
    squeezed: int
    outputs: int

    @property
    def squeeze(self) -> Conv:
        """The convolution that comes first."""
        return Conv(f"{self.name}.squeeze", self.inputs, self.squeezed, 1, 1, 0)

    @property
    def expand(self) -> tuple[Conv, Conv]:
        """The two that look at its output."""
        half = self.outputs // 2
        return (
            Conv(f"{self.name}.expand1x1", self.squeezed, half, 1, 1, 0),
            Conv(f"{self.name}.expand3x3", self.squeezed, half),
        )


Layer = Conv | Pool | Fire
Slices = tuple[tuple[Layer, ...], ...]


def vgg(depths: tuple[int, ...], feature: tuple[int, ...], average: bool = False) -> Slices:
    """A VGG whose block b has `depths[b]` convolutions, of which the one numbered `feature[b]` (from 1) is compared."""
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
VGG16 = vgg((2, 2, 3, 3, 3), (2, 2, 3, 3, 3))


def convolutions(slices: Slices) -> Iterator[Conv]:
    """All convolutions of a network, including those of the fire modules."""
    for layer in itertools.chain.from_iterable(slices):
        if isinstance(layer, Fire):
            yield layer.squeeze
            yield from layer.expand
        elif isinstance(layer, Conv):
            yield layer


def channels(slices: Slices) -> tuple[int, ...]:
    """Number of channels of each compared feature map."""
    return tuple([layer for layer in part if not isinstance(layer, Pool)][-1].outputs for part in slices)


@functools.cache
def smallest_side(slices: Slices) -> int:
    """Pixels that an image must have per side for every layer to find a whole window."""

    def fits(side: int) -> bool:
        for layer in itertools.chain.from_iterable(slices):
            if isinstance(layer, Fire):
                continue
            side += 2 * layer.padding if isinstance(layer, Conv) else 0
            if side < layer.size:
                return False
            up = layer.stride - 1 if isinstance(layer, Pool) and layer.ceil else 0
            side = (side - layer.size + up) // layer.stride + 1
        return True

    return next(side for side in itertools.count(1) if fits(side))


def feature_maps(
    weights: Weights, slices: Slices, image: Float[Array, "h w 3"], size: Int[Array, "2"] | None = None
) -> list[tuple[Float[Array, "y x c"], Int[Array, "2"] | None]]:
    """The compared maps of an image whose colors are scaled as the network expects them, each with its size.

    size: the image's own height and width, where it was padded below and right so that images of several sizes share a program.
    The maps are then those of the image without padding, padded with zeros, and their sizes say where they end. Without it the
    sizes are None.
    Computed in the dtype of the weights. Raises: ValueError for an image that is too small for the network.
    """
    height, width, _ = image.shape
    if min(height, width) < (least := smallest_side(slices)):
        raise ValueError(f"an image of {width} x {height} is too small for this network: {least} pixels a side needed")
    maps, x = [], _cleared(image.astype(weights["0"].kernel.dtype), size)
    for part in slices:
        for layer in part:
            x, size = _apply(weights, layer, x, size)
        maps.append((x, size))
    return maps


def _cleared(x, size):
    """A map with zeros beyond its size: what a convolution finds outside of an image."""
    if size is None:
        return x
    inside = [jnp.arange(side) < n for side, n in zip(x.shape[:2], size, strict=True)]
    return jnp.where((inside[0][:, None] & inside[1])[..., None], x, 0)


def _apply(weights, layer, x, size):
    if isinstance(layer, Pool):
        up = layer.stride - 1 if layer.ceil else 0
        # values are not negative, so a zero beyond the map changes no maximum
        size = None if size is None else (size - layer.size + up) // layer.stride + 1
        return _cleared(_pool(layer, x), size), size
    if isinstance(layer, Fire):
        x, size = _convolve(weights, layer.squeeze, x, size)
        parts = [_convolve(weights, part, x, size)[0] for part in layer.expand]
        return jnp.concatenate(parts, axis=-1), size
    return _convolve(weights, layer, x, size)


def _convolve(weights, layer, x, size):
    kernel, bias = weights[layer.name].kernel, weights[layer.name].bias
    size = None if size is None else (size + 2 * layer.padding - layer.size) // layer.stride + 1
    if (layer.size, layer.stride, layer.padding) == (3, 1, 1):
        y = convolve(x[None], kernel)[0]
    else:
        stride, padding = (layer.stride,) * 2, [(layer.padding, layer.padding)] * 2
        y = jax.lax.conv_general_dilated(x[None], kernel, stride, padding, dimension_numbers=("NHWC", "HWIO", "NHWC"))
        y = y[0]
    return _cleared(jax.nn.relu(y + bias), size), size


def _pool(layer, x):
    """Columns, then rows, by strided slices: seven times as fast on a CPU as a windowed reduction and its gradient."""
    if layer.ceil:
        missing = [-(side - layer.size) % layer.stride for side in x.shape[:2]]
        x = jnp.pad(x, [(0, missing[0]), (0, missing[1]), (0, 0)], constant_values=-jnp.inf)
    combine = jnp.add if layer.average else _larger
    for axis in (1, 0):
        length = (x.shape[axis] - layer.size) // layer.stride * layer.stride + 1
        slices = [jax.lax.slice_in_dim(x, i, i + length, layer.stride, axis) for i in range(layer.size)]
        x = functools.reduce(combine, slices)
    return x / layer.size**2 if layer.average else x


def _larger(x, y):
    # of equal values (plain backgrounds) the first gets the gradient, as in torch; NaN propagates
    return jnp.where((y > x) | jnp.isnan(y), y, x)
