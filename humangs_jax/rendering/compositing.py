"""Composites splats front to back over tiles, with a gradient written by hand.

A splat is a row of numbers (see `splat_rows.pack_splats`). With d the offset of a pixel centre from
the splat's centre,

    raw_k   = exp(log opacity - (r00 dx + r01 dy)^2 - (r11 dy)^2)
    alpha_k = min(alpha_max, raw_k), and 0 where raw_k < alpha_min
    T_k+1   = T_k (1 - alpha_k),  w_k = alpha_k T_k
    C       = sum_k w_k f_k

Here r^T r = conic / 2 and conic = cov2d^-1. T_0 = 1 before the nearest splat, and f_k holds the
splat's features: rgb, z and any others.

A pixel ends before the first splat whose T_k+1 <= transmittance_stop. Apart from log opacity, the
exponent is minus a sum of squares. This part is never positive, and it is accurate for needles. The
quadratic form of the conic would lose digits there.

The gradient runs front to back as well. With g the cotangent of C, g_T the cotangent of the final
T, and Q = g . C + g_T T_end,

    dL/dalpha_k = (g . f_k) T_k - (Q - sum_{i <= k} w_i g . f_i) / (1 - alpha_k)

So nothing has to be saved for each pair: the backward pass recomputes alpha and T in the same order
with the same decisions. The derivative with respect to log alpha is e_k := dL/dalpha_k alpha_k, and
0 where alpha was clamped or skipped. The sums of e_k (1, dx, dy, dx^2, dx dy, dy^2) over pixels
give the gradient of a splat's shape. They are computed as matrix products with monomials about the
tile's centre, and moved to the splat's centre afterwards.

A schedule decides the order of the work: `compositing_on_cpu` or `compositing_on_accelerators`.
Pixels and splats are measured from a tile's centre, so that float32 loses nothing however large the
image is. `vmap` joins the tiles of all images into one list of tiles. So a batch is one call with
more tiles, not a loop over images.
"""

import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
from jax import lax

from humangs_jax.core.array_types import Array, Float, PyTree
from humangs_jax.rendering.compositing_on_accelerators import (
    backward_by_chunks,
    forward_by_chunks,
)
from humangs_jax.rendering.compositing_on_cpu import backward_by_blocks, forward_by_blocks
from humangs_jax.rendering.splat_config import SplatConfig
from humangs_jax.rendering.splat_rows import R00, R01, R11, Composited
from humangs_jax.rendering.tiling import TileGrid, TileLists

Schedule = Callable[[TileGrid, SplatConfig], Callable[..., PyTree]]
"""A function that takes a grid and a configuration. It returns a drawing function or a gradient
function.
"""


@functools.partial(jax.custom_vjp, nondiff_argnums=(2, 3))
def composite(
    splats: Float[Array, "g width"], lists: TileLists, grid: TileGrid, config: SplatConfig
) -> Composited:
    """Returns tiles into which lists of splats are drawn. Each list must be in depth order.

    Features and transmittance are differentiable with respect to `splats`, in reverse mode only.
    """
    return _composite_fwd(splats, lists, grid, config)[0]


def _composite_fwd(
    splats: Array, lists: TileLists, grid: TileGrid, config: SplatConfig
) -> tuple[Composited, PyTree]:
    drawn = _scheduled(forward_by_blocks, forward_by_chunks, grid, config, splats, *lists)
    return drawn, (splats, lists, drawn.features, drawn.transmittance, drawn.lengths)


def _composite_bwd(
    grid: TileGrid, config: SplatConfig, saved: PyTree, cotangents: Composited
) -> tuple[Array, None]:
    splats, lists, features, transmittance, lengths = saved
    g = cotangents.features
    Q = jnp.sum(g * features, axis=1) + cotangents.transmittance * transmittance
    arrays = splats, lists.items, lists.starts, lengths, g, Q
    sums = _scheduled(backward_by_blocks, backward_by_chunks, grid, config, *arrays)
    return _splat_gradients(splats, sums), None


composite.defvjp(_composite_fwd, _composite_bwd)


def _scheduled(
    on_cpu: Schedule, elsewhere: Schedule, grid: TileGrid, config: SplatConfig, *arrays: Array
) -> PyTree:
    """Calls the function that one of two schedules makes, and returns its result. The platform for
    which the program is compiled decides which one.
    """
    return lax.platform_dependent(
        *arrays, cpu=on_cpu(grid, config), default=elsewhere(grid, config)
    )


def _splat_gradients(
    splats: Float[Array, "g width"], sums: Float[Array, "g width"]
) -> Float[Array, "g width"]:
    """Returns the gradient of the rows of splats, (g, width). sums: sums over pixels for each
    splat, of e (1, dx, dy, dx^2, dx dy, dy^2) in the first six columns, and of w g in the others.
    """
    r00, r01, r11 = (splats[:, i] for i in (R00, R01, R11))
    e, ex, ey, exx, exy, eyy = sums[:, :6].T
    # d log alpha = -2 (u du + v dv) with u = r00 dx + r01 dy, v = r11 dy; the sums of e u dx, e u
    # dy, e v dy:
    ux, uy, vy = r00 * exx + r01 * exy, r00 * exy + r01 * eyy, r11 * eyy
    u, v = r00 * ex + r01 * ey, r11 * ey
    columns = [2 * r00 * u, 2 * (r01 * u + r11 * v), -2 * ux, -2 * uy, -2 * vy, e]
    return jnp.concatenate([jnp.stack(columns, axis=-1), sums[:, 6:]], axis=-1)
