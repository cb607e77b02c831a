"""Front-to-back compositing of splats over tiles, and its hand-written gradient.

A splat is a row of `SPLAT_WIDTH` numbers (see `pack_splats`). With d the offset of a pixel centre from the splat's
centre,

    raw_k   = exp(log opacity - (r00 dx + r01 dy)^2 - (r11 dy)^2)                    r^T r = conic / 2, conic = cov2d^-1
    alpha_k = min(alpha_max, raw_k), and 0 where raw_k < alpha_min
    T_k+1   = T_k (1 - alpha_k),  w_k = alpha_k T_k                                  T_0 = 1, nearest splat first
    C       = sum_k w_k f_k                                                          f_k: features, rgb and z

and a pixel ends before the first splat whose T_k+1 <= transmittance_stop. The exponent is a sum of squares, hence never
positive, and accurate for needles, where the conic's quadratic form cancels.

Schedule. Tiles come by falling list length in blocks (`tiling.blocks_by_length`); a block takes its lists in chunks
until the longest list ends or all its pixels have. T only falls, so "T_k+1 > stop" needs no memory of having stopped;
the loop carries T as its negative once a pixel has, which keeps the final T and tells that the pixel is done.

Gradient, front to back as well: with g the cotangent of C, g_T that of the final T, and Q = g . C + g_T T_end,

    dL/dalpha_k = (g . f_k) T_k - (Q - sum_{i <= k} w_i g . f_i) / (1 - alpha_k),

so that the backward pass saves nothing per pair: it recomputes alpha and T in the same order with the same decisions.
alpha enters as log alpha, whose derivative is dL/dalpha_k alpha_k =: e_k, 0 where alpha was clamped or skipped; the
sums over pixels of e_k (1, dx, dy, dx^2, dx dy, dy^2) give the gradient of a splat's shape. They are matrix products
with monomials about the tile's centre (XLA's CPU row reductions are slow) that are moved to the splat's centre
afterwards.

`vmap` joins the tiles of all images into one list of tiles, so a batch is one call with more tiles, not a loop of
masked loops.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from humangs_jax.array_types import Array, Float
from humangs_jax.rendering.projection import ProjectedGaussians
from humangs_jax.rendering.splat_config import SplatConfig
from humangs_jax.rendering.tiling import TileGrid, TileLists, blocks_by_length

X, Y, R00, R01, R11, LOG_OPACITY = range(6)
FEATURES = slice(6, 10)
FEATURE_COUNT = 4
"""Red, green, blue and z. A constant: XLA unrolls them."""
SPLAT_WIDTH = 10

_EXACT = lax.Precision.HIGHEST  # GPUs and TPUs would otherwise round the factors of a product to 10 or 8 bits


def pack_splats(
    projected: ProjectedGaussians, opacities: Float[Array, " g"], features: Float[Array, "g 4"], alpha_min: float
) -> Float[Array, "g 10"]:
    """Rows x, y (pixels), r00, r01, r11 (1 / pixels), log opacity, features; finite where not drawn."""
    p = projected
    drawn = p.visible & (opacities >= alpha_min)
    yy, determinant = jnp.where(drawn, p.yy, 1.0), jnp.where(drawn, p.determinant, 1.0)
    xy = jnp.where(drawn, p.xy, 0.0)
    # the Cholesky factor of conic / 2 = [[yy, -xy], [-xy, xx]] / (2 determinant); its Schur complement is 1 / (2 yy).
    # Divided by yy, not by the determinant: the gradient of a quotient holds the denominator's square, and that of a
    # determinant overflows float32 from 7e4 pixels on, which made these gradients 0.
    r00 = lax.rsqrt(2 * (determinant / yy))
    r11 = lax.rsqrt(2 * yy)
    log_opacity = jnp.log(jnp.where(drawn, opacities, 1.0))
    return jnp.stack([p.x, p.y, r00, -r00 * xy / yy, r11, log_opacity, *features.T], axis=-1)


@functools.partial(jax.custom_vjp, nondiff_argnums=(2, 3))
def composite(
    splats: Float[Array, "g 10"], lists: TileLists, grid: TileGrid, config: SplatConfig
) -> tuple[Float[Array, "t 4 p"], Float[Array, "t p"]]:
    """Draws lists of splats, which must be in depth order, into tiles.

    Returns (sum of w f, final T) for every pixel of every tile; tiles with empty lists have (0, 1). Differentiable with
    respect to `splats`, in reverse mode only.
    """
    return _composite_fwd(splats, lists, grid, config)[0]


def _composite_fwd(splats, lists, grid, config):
    features, transmittance, lengths = _forward(grid, config)(splats, *lists)
    return (features, transmittance), (splats, lists, features, transmittance, lengths)


def _composite_bwd(grid, config, saved, cotangents):
    splats, lists, features, transmittance, lengths = saved
    g, g_transmittance = cotangents
    total = jnp.sum(g * features, axis=1) + g_transmittance * transmittance
    sums = _backward(grid, config)(splats, lists.items, lists.starts, lengths, g, total)
    return _splat_gradients(splats, sums), None


composite.defvjp(_composite_fwd, _composite_bwd)


def _splat_gradients(splats, sums):
    """Gradient of the rows from their sums over pixels of e (1, dx, dy, dx^2, dx dy, dy^2) and of w g."""
    r00, r01, r11 = (splats[:, i] for i in (R00, R01, R11))
    e, ex, ey, exx, exy, eyy = sums[:, :6].T
    # d log alpha = -2 (u du + v dv) with u = r00 dx + r01 dy, v = r11 dy; the sums of e u dx, e u dy, e v dy:
    ux, uy, vy = r00 * exx + r01 * exy, r00 * exy + r01 * eyy, r11 * eyy
    u, v = r00 * ex + r01 * ey, r11 * ey
    columns = [2 * r00 * u, 2 * (r01 * u + r11 * v), -2 * ux, -2 * uy, -2 * vy, e]
    return jnp.concatenate([jnp.stack(columns, axis=-1), sums[:, 6:]], axis=-1)


def _joined_over_batch(function):
    """Under `vmap`, a function of (splats, items, starts, more per tile...) is called once, with the tiles of all
    images.

    Its outputs must be arrays per tile or per splat; those of the images then follow one another.
    """
    function = jax.custom_batching.custom_vmap(function)

    @function.def_vmap
    def rule(size, batched, *args):
        args = [a if b else jnp.broadcast_to(a, (size, *a.shape)) for a, b in zip(args, batched, strict=True)]
        splats, items, starts, *rest = args
        image = jnp.arange(size, dtype=jnp.int32)[:, None]
        args = [splats, items + image * splats.shape[1], starts + image * items.shape[1], *rest]
        out = function(*(a.reshape(-1, *a.shape[2:]) for a in args))
        out = jax.tree.map(lambda a: a.reshape(size, -1, *a.shape[1:]), out)
        return out, jax.tree.map(lambda _: True, out)

    return function


def _block_of(tile, starts, counts, grid):
    """First pair, number of pairs and centre (2, B) of the tiles of one block; the block's padding has no pairs."""
    start, count = (v.at[tile].get(mode="fill", fill_value=0) for v in (starts, counts))
    place = tile % grid.tiles  # of its image, if several were joined
    return start, count, jnp.stack([place % grid.columns, place // grid.columns]) * grid.tile_size + grid.tile_size / 2


def _take_chunk(splats, items, block, offsets, i, k):
    """Splats i k .. i k + k of each list: their numbers, rows (B, k, 10) and raw alphas (B, k, p), 0 past the end."""
    start, count, (cx, cy) = block
    slot = i * k + jnp.arange(k, dtype=jnp.int32)
    item = items.at[start[:, None] + slot].get(mode="clip")
    item = jnp.where(slot < count[:, None], item, splats.shape[0])
    row = lax.optimization_barrier(splats.at[item].get(mode="clip"))
    cx, cy = cx[:, None].astype(row.dtype), cy[:, None].astype(row.dtype)
    x, y, r00, r01, r11 = row[..., X] - cx, row[..., Y] - cy, row[..., R00], row[..., R01], row[..., R11]
    u = (r00 * x + r01 * y)[..., None] - r00[..., None] * offsets[0] - r01[..., None] * offsets[1]
    v = (r11 * y)[..., None] - r11[..., None] * offsets[1]
    raw = jnp.exp(row[..., LOG_OPACITY, None] - u * u - v * v)
    raw = jnp.where((slot < count[:, None])[..., None], raw, 0.0)
    # One kernel with one exp per pair: without the barrier XLA would fuse exp into each of its consumers.
    return item, row, jnp.stack([x, y]), lax.optimization_barrier(raw)


def _alpha(raw, config):
    return jnp.where(raw < config.alpha_min, 0.0, jnp.minimum(raw, config.alpha_max))


@functools.lru_cache
def _forward(grid: TileGrid, config: SplatConfig):
    """(splats, items, starts, counts) -> features (t, 4, p), final T (t, p), how much of each list was used (t,)."""
    block, k, stop = config.block, config.chunk, config.transmittance_stop

    @_joined_over_batch
    def forward(splats, items, starts, counts):
        dtype, t = splats.dtype, counts.shape[0]
        offsets = jnp.asarray(grid.offsets(dtype))
        blocks = blocks_by_length(counts, block)

        def draw(b, out):
            tile = lax.dynamic_slice_in_dim(blocks.tiles, b * block, block)
            tiles = _block_of(tile, starts, counts, grid)
            count = tiles[1]

            def body(carry):
                i, transmittance, features, lengths, _ = carry
                _, row, _, raw = _take_chunk(splats, items, tiles, offsets, i, k)
                alpha = lax.optimization_barrier(_alpha(raw, config))
                # Unrolled, once for each carry: each becomes ONE kernel with its own chain of T in registers.
                before = transmittance[:, None]
                for j in range(k):
                    after = before * (1 - alpha[:, None, j])
                    weight = jnp.where(after > stop, alpha[:, None, j] * before, 0.0)
                    features = features + weight * row[:, j, FEATURES, None]
                    before = after
                live = jnp.max(transmittance, axis=1) > 0
                lengths = jnp.where(live, jnp.minimum((i + 1) * k, count), lengths)
                for j in range(k):
                    after = transmittance * (1 - alpha[:, j])
                    transmittance = jnp.where(after > stop, after, jnp.minimum(transmittance, -transmittance))
                again = (jnp.max(transmittance) > 0) & ((i + 1) * k < jnp.max(count))
                return i + 1, transmittance, features, lengths, again

            ones = jnp.ones((block, grid.pixels), dtype)
            zeros = jnp.zeros((block, FEATURE_COUNT, grid.pixels), dtype)
            carry = (0, ones, zeros, jnp.zeros_like(count), jnp.max(count) > 0)
            _, transmittance, features, lengths, _ = lax.while_loop(lambda carry: carry[-1], body, carry)
            results = features, jnp.abs(transmittance), lengths
            return tuple(o.at[tile].set(r, mode="drop", unique_indices=True) for o, r in zip(out, results, strict=True))

        out = (
            jnp.zeros((t, FEATURE_COUNT, grid.pixels), dtype),
            jnp.ones((t, grid.pixels), dtype),
            jnp.zeros(t, jnp.int32),
        )
        return lax.fori_loop(0, blocks.used, draw, out)

    return forward


@functools.lru_cache
def _backward(grid: TileGrid, config: SplatConfig):
    """(splats, items, starts, lengths, g (t, 4, p), Q (t, p)) -> the sums of `_splat_gradients`, (g, 10)."""
    block, k, stop = config.block, config.chunk_backward, config.transmittance_stop

    @_joined_over_batch
    def backward(splats, items, starts, lengths, cotangents, totals):
        dtype = splats.dtype
        offsets = jnp.asarray(grid.offsets(dtype))
        monomials = jnp.asarray(_monomials(grid, dtype))
        blocks = blocks_by_length(lengths, block)

        def draw(b, sums):
            tile = lax.dynamic_slice_in_dim(blocks.tiles, b * block, block)
            tiles = _block_of(tile, starts, lengths, grid)
            g, total = (v.at[tile].get(mode="fill", fill_value=0) for v in (cotangents, totals))
            trips = (jnp.max(tiles[1]) + k - 1) // k

            def body(carry):
                i, transmittance, seen, sums = carry
                item, row, offset, raw = _take_chunk(splats, items, tiles, offsets, i, k)
                weights, slopes = [], []
                for j in range(k):
                    alpha = _alpha(raw[:, j], config)
                    after = transmittance * (1 - alpha)
                    weight = jnp.where(after > stop, alpha * transmittance, 0.0)
                    along = sum(row[:, j, 6 + c, None] * g[:, c] for c in range(FEATURE_COUNT))
                    seen = seen + weight * along
                    slope = (along * transmittance - (total - seen) / (1 - alpha)) * raw[:, j]
                    slopes.append(jnp.where((weight > 0) & (raw[:, j] < config.alpha_max), slope, 0.0))
                    weights.append(weight)
                    transmittance = after
                weights, slopes = jnp.stack(weights, axis=1), jnp.stack(slopes, axis=1)
                moments = jnp.matmul(slopes.reshape(block * k, -1), monomials, precision=_EXACT).reshape(block, k, 6)
                features = jnp.matmul(weights, jnp.moveaxis(g, 1, 2), precision=_EXACT)
                chunk = jnp.concatenate([_about_splat(moments, *offset), features], axis=-1)
                return i + 1, transmittance, seen, sums.at[item].add(chunk, mode="drop")

            ones = jnp.ones((block, grid.pixels), dtype)
            carry = (0, ones, jnp.zeros_like(ones), sums)
            return lax.while_loop(lambda carry: carry[0] < trips, body, carry)[3]

        return lax.fori_loop(0, blocks.used, draw, jnp.zeros((splats.shape[0], SPLAT_WIDTH), dtype))

    return backward


def _monomials(grid, dtype):
    x, y = grid.offsets(dtype)
    return np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=-1)


def _about_splat(moments, x, y):
    """Moments of d = (pixel - splat) from those of (pixel - centre of the tile); x, y: (splat - centre)."""
    m, mx, my, mxx, mxy, myy = (moments[..., i] for i in range(6))
    return jnp.stack(
        [
            m,
            mx - x * m,
            my - y * m,
            mxx - 2 * x * mx + x * x * m,
            mxy - x * my - y * mx + x * y * m,
            myy - 2 * y * my + y * y * m,
        ],
        axis=-1,
    )
