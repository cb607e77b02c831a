"""Front-to-back compositing of splats over tiles, and its hand-written gradient.

A splat is a row of `SPLAT_WIDTH` numbers (see `pack_splats`). With d the offset of a pixel centre from the splat's
centre,

    raw_k   = exp(log opacity - (r00 dx + r01 dy)^2 - (r11 dy)^2)                    r^T r = conic / 2, conic = cov2d^-1
    alpha_k = min(alpha_max, raw_k), and 0 where raw_k < alpha_min
    T_k+1   = T_k (1 - alpha_k),  w_k = alpha_k T_k                                  T_0 = 1, nearest splat first
    C       = sum_k w_k f_k                                                          f_k: features, rgb and z

and a pixel ends before the first splat whose T_k+1 <= transmittance_stop. The exponent is a sum of squares, hence never
positive, and accurate for needles, where the conic's quadratic form cancels.

Gradient, front to back as well: with g the cotangent of C, g_T that of the final T, and Q = g . C + g_T T_end,

    dL/dalpha_k = (g . f_k) T_k - (Q - sum_{i <= k} w_i g . f_i) / (1 - alpha_k),

so that the backward pass saves nothing per pair: it recomputes alpha and T in the same order with the same decisions.
alpha enters as log alpha, whose derivative is dL/dalpha_k alpha_k =: e_k, 0 where alpha was clamped or skipped; the
sums over pixels of e_k (1, dx, dy, dx^2, dx dy, dy^2) give the gradient of a splat's shape. They are matrix products
with monomials about the tile's centre that are moved to the splat's centre afterwards.

The order of the work is that of `schedules`: small blocks on CPUs, fat chunks elsewhere. `vmap` joins the tiles of all images
into one list of tiles, so a batch is one call with more tiles, not a loop of masked loops.
"""

import functools

import jax
import jax.numpy as jnp
from jax import lax

from humangs_jax.core.array_types import Array, Float
from humangs_jax.rendering import schedules
from humangs_jax.rendering.projection import ProjectedGaussians
from humangs_jax.rendering.schedules import R00, R01, R11
from humangs_jax.rendering.splat_config import SplatConfig
from humangs_jax.rendering.tiling import TileGrid, TileLists


def pack_splats(
    projected: ProjectedGaussians, opacities: Float[Array, " g"], features: Float[Array, "g 4"], alpha_min: float
) -> Float[Array, "g 10"]:
    """Rows x, y (pixels), r00, r01, r11 (1 / pixels), log opacity, features; finite where not drawn."""
    p = projected
    drawn = p.visible & (opacities >= alpha_min)
    log_opacity = jnp.log(jnp.where(drawn, opacities, 1.0))
    return jnp.stack([p.x, p.y, p.r00, p.r01, p.r11, log_opacity, *features.T], axis=-1)


@functools.partial(jax.custom_vjp, nondiff_argnums=(2, 3))
def composite(
    splats: Float[Array, "g 10"], lists: TileLists, grid: TileGrid, config: SplatConfig
) -> tuple[Float[Array, "t 4 p"], Float[Array, "t p"], Float[Array, " g"]]:
    """Draws lists of splats, which must be in depth order, into tiles.

    Returns (sum of w f, final T) for every pixel of every tile, (0, 1) where lists are empty; and the largest w of each
    splat if `config.visibility`, else 0. The first two are differentiable with respect to `splats`, in reverse mode only.
    """
    return _composite_fwd(splats, lists, grid, config)[0]


def _composite_fwd(splats, lists, grid, config):
    features, transmittance, lengths, peaks = _scheduled("forward", grid, config, splats, *lists)
    return (features, transmittance, peaks), (splats, lists, features, transmittance, lengths)


def _composite_bwd(grid, config, saved, cotangents):
    splats, lists, features, transmittance, lengths = saved
    g, g_transmittance, _ = cotangents
    total = jnp.sum(g * features, axis=1) + g_transmittance * transmittance
    sums = _scheduled("backward", grid, config, splats, lists.items, lists.starts, lengths, g, total)
    return _splat_gradients(splats, sums), None


composite.defvjp(_composite_fwd, _composite_bwd)


def _scheduled(direction, grid, config, *arrays):
    on_cpu, elsewhere = (getattr(schedules, f"{direction}_by_{order}")(grid, config) for order in ("blocks", "chunks"))
    return lax.platform_dependent(*arrays, cpu=on_cpu, default=elsewhere)


def _splat_gradients(splats, sums):
    """Gradient of the rows from their sums over pixels of e (1, dx, dy, dx^2, dx dy, dy^2) and of w g."""
    r00, r01, r11 = (splats[:, i] for i in (R00, R01, R11))
    e, ex, ey, exx, exy, eyy = sums[:, :6].T
    # d log alpha = -2 (u du + v dv) with u = r00 dx + r01 dy, v = r11 dy; the sums of e u dx, e u dy, e v dy:
    ux, uy, vy = r00 * exx + r01 * exy, r00 * exy + r01 * eyy, r11 * eyy
    u, v = r00 * ex + r01 * ey, r11 * ey
    columns = [2 * r00 * u, 2 * (r01 * u + r11 * v), -2 * ux, -2 * uy, -2 * vy, e]
    return jnp.concatenate([jnp.stack(columns, axis=-1), sums[:, 6:]], axis=-1)
