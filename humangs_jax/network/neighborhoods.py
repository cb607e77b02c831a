"""What a 3x3 convolution would read of a grid at fractional positions.

Convolving a grid and then sampling it bilinearly is linear, so the two may change places: sample the 3x3 neighbourhood,
then apply the kernel, once per position instead of once per texel. With K_ab the kernel's taps, x the grid (zeros
outside) and w the bilinear weights of the four texels c around a position (none for texels that do not exist),

    sum_c w_c (bias + sum_ab K_ab x[c + (a, b) - 1])  =  bias * sum_c w_c  +  sum_ab K_ab (sum_c w_c x[c + (a, b) - 1]).
"""

import jax.numpy as jnp

from humangs_jax.core.array_types import Array, Float

KERNEL = 3
REACH = KERNEL // 2 + 1
"""Texels of padding: a position may lie half outside, and its neighbours one texel further."""


def sample_neighborhoods(
    grid: Float[Array, "h w c"], indices: Float[Array, "p 2"]
) -> tuple[Float[Array, "p 3*3*c"], Float[Array, " p"]]:
    """(neighbourhoods, coverage): the two sums over c above, taps row-major with channels fastest, and sum_c w_c.

    indices: texel indices (x, y), see `network.bilinear`. Positions that are outside by a texel or more, infinite or
    NaN give zeros with zero gradient.
    """
    height, width, channels = grid.shape
    size = jnp.asarray([width, height], indices.dtype)
    inside = jnp.all((indices > -1) & (indices < size), axis=-1)
    corner = jnp.floor(jnp.where(inside[:, None], indices, -1.0))
    fraction = jnp.where(inside[:, None], indices, corner) - corner
    # per axis, the weights of the two texels
    first = jnp.where((corner >= 0) & inside[:, None], 1 - fraction, 0.0)
    second = jnp.where((corner + 1 < size) & inside[:, None], fraction, 0.0)

    x0, y0 = jnp.moveaxis(corner.astype(jnp.int32), -1, 0)
    padded = jnp.pad(grid, ((REACH, REACH), (REACH, REACH), (0, 0)))
    row_length = width + 2 * REACH
    rows = padded.reshape(-1, channels)
    top_left = (y0 + REACH - 1) * row_length + x0 + REACH - 1
    texel = lambda i, j: rows.at[top_left + i * row_length + j].get(mode="promise_in_bounds")
    across = []  # of each of the four texel rows, three taps
    for i in range(KERNEL + 1):
        row = [texel(i, j) for j in range(KERNEL + 1)]
        across.append([first[:, :1] * row[b] + second[:, :1] * row[b + 1] for b in range(KERNEL)])
    taps = [
        first[:, 1:] * across[a][b] + second[:, 1:] * across[a + 1][b] for a in range(KERNEL) for b in range(KERNEL)
    ]
    return jnp.concatenate(taps, axis=-1), jnp.prod(first + second, axis=-1)
