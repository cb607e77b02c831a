"""Samples feature maps at fractional positions, and convolves them with 3x3 kernels. Outside of a
map there are zeros.

Positions are texel indices (x, y): (0, 0) is the CENTRE of the first texel, x runs along the width.
There are two conventions for the texel index of a position u in [0, W], pixels (pixel centres at
+0.5), in an image that a grid of w texels covers:

- half-pixel (correct): texels are areas, index = u * w / W - 0.5;
- mixed (published): u / W * 2 - 1 treats pixels as areas, then `align_corners=True` treats texels
  as points, index = u / W * (w - 1). The two differ by up to half a texel, zero in the middle.

Convolving a grid and then sampling it bilinearly is linear, so the two may change places: sample
the 3x3 neighbourhood, then apply the kernel, once per position instead of once per texel. With K_ab
the kernel's taps, x the grid (zeros outside) and w the bilinear weights of the four texels c around
a position (0 for texels that do not exist),

    sum_c w_c (bias + sum_ab K_ab x[c + (a, b) - 1])
        = bias * sum_c w_c + sum_ab K_ab (sum_c w_c x[c + (a, b) - 1]).

The gradient of a convolution consists of two more convolutions. XLA's CPU backend rewrites them
into a form that its library knows, but only outside of loops. In a loop, such as the one over the
subjects of a batch, they ran thirty times slower. So they are written here in the form of the
library: batch, two axes of space, channels.
"""

from typing import Any, Literal

import flax.linen as nn
import jax
import jax.numpy as jnp
from flax.linen.dtypes import promote_dtype
from jax import lax

from humangs_jax.core.array_types import Array, Float

LAYOUT = ("NHWC", "HWIO", "NHWC")
KERNEL = 3
REACH = KERNEL // 2 + 1
"""Texels of zeros that are put around a map. Interpolation reads texels up to one outside of the
map, and the kernel reads the neighbours of these texels.
"""
OUTSIDE = -4.0
"""A texel index that lies outside of every map, as its 3 x 3 neighbourhood does. Reading there
gives zeros, and the gradient costs nothing.
"""
PixelGrid = Literal["half_pixel", "mixed"]


def texel_indices(
    pixels: Float[Array, "*p 2"],
    image_size: tuple[int, int],
    grid_size: tuple[int, int],
    convention: PixelGrid,
) -> Float[Array, "*p 2"]:
    """Returns texel indices (x, y) in a grid that covers an image. pixels: positions (x, y) on the
    image, pixels. Sizes are (width, height).
    """
    image, grid = jnp.asarray(image_size, pixels.dtype), jnp.asarray(grid_size, pixels.dtype)
    if convention == "half_pixel":
        return pixels * (grid / image) - 0.5
    return pixels / image * (grid - 1)


def sample_bilinear(
    grid: Float[Array, "h w c"], indices: Float[Array, "*p 2"], origin: float = 0.0
) -> Float[Array, "*p c"]:
    """Returns the grid's values at texel indices, interpolated bilinearly between texel centres.
    Texels outside of the grid count as zeros.

    origin: number that is added to both coordinates of `indices`. With `indices` relative to the
    middle of the grid, float32 keeps more digits of their fractions. Positions that are outside by
    a texel or more, infinite or NaN give zero with zero gradient.
    """
    height, width, channels = grid.shape
    size = jnp.asarray([width, height], indices.dtype)
    absolute = indices + origin
    inside = jnp.all((absolute > -1) & (absolute < size), axis=-1, keepdims=True)
    # outside: weight one on a texel that does not exist
    corner = jnp.floor(jnp.where(inside, absolute, -1.0))
    fraction = jnp.where(inside, indices, corner - origin) - (corner - origin)
    x0, y0 = jnp.moveaxis(corner.astype(jnp.int32), -1, 0)
    texels = grid.reshape(height * width, channels)

    # weights of the texels at x0 and x0 + 1, and at y0 and y0 + 1
    along_x = (1 - fraction[..., 0], fraction[..., 0])
    along_y = (1 - fraction[..., 1], fraction[..., 1])
    total = jnp.zeros((), jnp.result_type(grid, indices))
    for dy in (0, 1):
        for dx in (0, 1):
            x, y = x0 + dx, y0 + dy
            exists = (x >= 0) & (x < width) & (y >= 0) & (y < height)
            weight = jnp.where(exists, along_x[dx] * along_y[dy], 0.0)
            # a gradient adds nothing for a texel that does not exist, instead of zeros to one place
            texel = texels.at[jnp.where(exists, y * width + x, len(texels))].get(
                mode="fill", fill_value=0
            )
            total = total + weight[..., None] * texel
    return total


def sample_nearest(grid: Float[Array, "h w"], indices: Float[Array, "*p 2"]) -> Float[Array, "*p"]:
    """Returns the value of the texel nearest to each position; zero outside of the grid. Halves are
    rounded to the even index.
    """
    height, width = grid.shape
    nearest = jnp.round(indices)
    size = jnp.asarray([width, height], indices.dtype)
    inside = jnp.all((nearest >= 0) & (nearest < size), axis=-1)
    x, y = jnp.moveaxis(jnp.where(inside[..., None], nearest, 0.0).astype(jnp.int32), -1, 0)
    return jnp.where(inside, grid[y, x], 0.0)


def sample_neighborhoods(
    grid: Float[Array, "h w c"], indices: Float[Array, "p 2"]
) -> tuple[Float[Array, "p 3*3*c"], Float[Array, " p"]]:
    """Returns the interpolated values at the 3 x 3 places around each position, one texel apart,
    (p, 9 c), and the coverage of each position, (p,). The 9 places are in row-major order, and
    channels run fastest.

    The coverage is the sum of the bilinear weights of the texels that exist. It is 1 away from the
    border. indices: texel indices (x, y), see `network.maps`. Positions that are outside by a texel
    or more, infinite or NaN give zeros with zero gradient.
    """
    height, width, channels = grid.shape
    size = jnp.asarray([width, height], indices.dtype)
    inside = jnp.all((indices > -1) & (indices < size), axis=-1)
    corner = jnp.floor(jnp.where(inside[:, None], indices, -1.0))
    fraction = jnp.where(inside[:, None], indices, corner) - corner
    # per axis, the weights of the two texels
    first = jnp.where((corner >= 0) & inside[:, None], 1 - fraction, 0.0)
    second = jnp.where((corner + 1 < size) & inside[:, None], fraction, 0.0)

    # 4 x 4 texels around each position, of the grid with zeros around it
    x0, y0 = jnp.moveaxis(corner.astype(jnp.int32), -1, 0)
    padded = jnp.pad(grid, ((REACH, REACH), (REACH, REACH), (0, 0)))
    row_length = width + 2 * REACH
    rows = padded.reshape(-1, channels)
    top_left = (y0 + REACH - 1) * row_length + x0 + REACH - 1
    top_left = jnp.where(inside, top_left, len(rows))

    def texel(i, j):
        # what lies outside adds nothing to a gradient, instead of zeros to one place
        return rows.at[top_left + i * row_length + j].get(mode="fill", fill_value=0)

    # three taps of each of the four texel rows, then three of these
    across = []
    for i in range(KERNEL + 1):
        row = [texel(i, j) for j in range(KERNEL + 1)]
        across.append([first[:, :1] * row[b] + second[:, :1] * row[b + 1] for b in range(KERNEL)])
    taps = [
        first[:, 1:] * across[a][b] + second[:, 1:] * across[a + 1][b]
        for a in range(KERNEL)
        for b in range(KERNEL)
    ]
    return jnp.concatenate(taps, axis=-1), jnp.prod(first + second, axis=-1)


def convolve_neighborhoods(
    neighborhoods: Float[Array, "n k"],
    coverages: Float[Array, " n"],
    kernel: Float[Array, "3 3 c d"],
    bias: Float[Array, " d"],
    dtype: Any = None,
) -> Float[Array, "n d"]:
    """Returns the convolution at n positions, (n, d): the kernel times each neighbourhood, plus the
    bias times the coverage. A neighbourhood and its coverage may also be means over several
    positions. The products are in `dtype`, the result has the type of the coverages.
    """
    x, kernel = promote_dtype(neighborhoods, kernel, dtype=dtype)
    products = jnp.matmul(
        x, kernel.reshape(-1, kernel.shape[-1]), preferred_element_type=coverages.dtype
    )
    return products + coverages[:, None] * bias


def convolve(
    x: Float[Array, "v h w c"], kernel: Float[Array, "k k c d"]
) -> Float[Array, "v h w d"]:
    """Returns the convolution of maps with a 3x3 kernel, with zeros outside of the maps."""
    return lax.platform_dependent(x, kernel, cpu=_convolve_on_cpu, default=_convolve)


def _convolve(
    x: Float[Array, "v h w c"], kernel: Float[Array, "k l c d"]
) -> Float[Array, "v h w d"]:
    return lax.conv_general_dilated(x, kernel, (1, 1), "SAME", dimension_numbers=LAYOUT)


@jax.custom_vjp
def _convolve_on_cpu(
    x: Float[Array, "v h w c"], kernel: Float[Array, "k l c d"]
) -> Float[Array, "v h w d"]:
    return _convolve(x, kernel)


def _backward(
    residuals: tuple[Float[Array, "v h w c"], Float[Array, "k l c d"]],
    cotangent: Float[Array, "v h w d"],
) -> tuple[Float[Array, "v h w c"], Float[Array, "k l c d"]]:
    x, kernel = residuals
    x_gradient = _convolve(cotangent, jnp.swapaxes(kernel[::-1, ::-1], 2, 3))
    # channels of x are the batch, views are what is contracted, the cotangent's pixels are the
    # window
    maps, window = jnp.transpose(x, (3, 1, 2, 0)), jnp.transpose(cotangent, (1, 2, 0, 3))
    kernel_gradient = lax.conv_general_dilated(
        maps, window, (1, 1), [(1, 1), (1, 1)], dimension_numbers=LAYOUT
    )
    return x_gradient, jnp.transpose(kernel_gradient, (1, 2, 0, 3))


_convolve_on_cpu.defvjp(lambda x, kernel: (_convolve(x, kernel), (x, kernel)), _backward)


class Convolution(nn.Module):
    """A 3x3 convolution with a bias, from (v, h, w, c) to (v, h, w, features). It has the
    parameters of `nn.Conv`.
    """

    features: int
    """Number of output channels."""
    kernel_init: nn.initializers.Initializer
    """Initializer of the kernel."""
    dtype: Any = None
    """Type of the arithmetic; None: the type of input and parameters."""

    @nn.compact
    def __call__(self, x: Float[Array, "v h w c"]) -> Float[Array, "v h w d"]:
        kernel = self.param(
            "kernel", self.kernel_init, (KERNEL, KERNEL, x.shape[-1], self.features)
        )
        bias = self.param("bias", nn.initializers.zeros, (self.features,))
        x, kernel, bias = promote_dtype(x, kernel, bias, dtype=self.dtype)
        return convolve(x, kernel) + bias
