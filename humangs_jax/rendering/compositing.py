"""Front-to-back compositing of splats over tiles, and its hand-written gradient.

A splat is a row of numbers (see `pack_splats`). With d the offset of a pixel centre from the
splat's centre,

    raw_k   = exp(log opacity - (r00 dx + r01 dy)^2 - (r11 dy)^2)
    alpha_k = min(alpha_max, raw_k), and 0 where raw_k < alpha_min
    T_k+1   = T_k (1 - alpha_k),  w_k = alpha_k T_k
    C       = sum_k w_k f_k

where r^T r = conic / 2 and conic = cov2d^-1, T_0 = 1 before the nearest splat, and f_k holds the
splat's features, rgb and z.

A pixel ends before the first splat whose T_k+1 <= transmittance_stop. The exponent is a sum of
squares, hence never positive, and accurate for needles, where the conic's quadratic form cancels.

Gradient, front to back as well: with g the cotangent of C, g_T that of the final T, and Q = g . C +
g_T T_end,

    dL/dalpha_k = (g . f_k) T_k - (Q - sum_{i <= k} w_i g . f_i) / (1 - alpha_k),

so that the backward pass saves nothing per pair: it recomputes alpha and T in the same order with
the same decisions. alpha enters as log alpha, whose derivative is dL/dalpha_k alpha_k =: e_k, 0
where alpha was clamped or skipped; the sums over pixels of e_k (1, dx, dy, dx^2, dx dy, dy^2) give
the gradient of a splat's shape. They are matrix products with monomials about the tile's centre
that are moved to the splat's centre afterwards.

The order of the work is a schedule, one for CPUs and one for accelerators. Pixels and splats are
taken relative to a tile's centre, so that nothing is lost in float32 however large the image.
`vmap` joins the tiles of all images into one list of tiles: a batch is one call with more tiles,
not a loop of masked loops.
"""

import functools
import math
from collections.abc import Callable, Iterator
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from humangs_jax.core.array_types import Array, Float, Int, PyTree
from humangs_jax.rendering.projection import ProjectedGaussians
from humangs_jax.rendering.splat_config import SplatConfig
from humangs_jax.rendering.tiling import TileGrid, TileLists, blocks_by_length, expand

X = 0
"""Column of a splat's row with the x of its centre, pixels."""
Y = 1
"""Column with the y of the centre, pixels."""
R00 = 2
"""Column with the entry 00 of r, 1 / pixels."""
R01 = 3
"""Column with the entry 01 of r, 1 / pixels."""
R11 = 4
"""Column with the entry 11 of r, 1 / pixels."""
LOG_OPACITY = 5
"""Column with the logarithm of the opacity."""
FEATURES = slice(6, None)
"""Columns of red, green, blue, z, and any others: their number is static, XLA unrolls them."""
Z = 9
"""The column of z."""
HALF = 0.5
"""The transmittance at the median depth."""
Schedule = Callable[[TileGrid, SplatConfig], Callable[..., PyTree]]
EXACT = lax.Precision.HIGHEST
"""GPUs and TPUs would otherwise round the factors of a product to 10 or 8 bits."""


def pack_splats(
    projected: ProjectedGaussians,
    opacities: Float[Array, " g"],
    features: Float[Array, "g n"],
    alpha_min: float,
) -> Float[Array, "g width"]:
    """Rows x, y (pixels), r00, r01, r11 (1 / pixels), log opacity, features; finite where not
    drawn.
    """
    p = projected
    drawn = p.visible & (opacities >= alpha_min)
    log_opacity = jnp.log(jnp.where(drawn, opacities, 1.0))
    return jnp.stack([p.x, p.y, p.r00, p.r01, p.r11, log_opacity, *features.T], axis=-1)


@functools.partial(jax.custom_vjp, nondiff_argnums=(2, 3))
def composite(
    splats: Float[Array, "g width"], lists: TileLists, grid: TileGrid, config: SplatConfig
) -> tuple[
    Float[Array, "t n p"], Float[Array, "t p"], Float[Array, " g"], Float[Array, "t p"] | None
]:
    """Draws lists of splats, which must be in depth order, into tiles.

    Returns (sum of w f, final T) for every pixel of every tile, (0, 1) where lists are empty; the
    largest w of each splat if `config.visibility`, else 0; and if `config.depth_median`, the z of
    the splat at which T falls to one half, infinite where it never does, else None. The first two
    are differentiable with respect to `splats`, in reverse mode only.
    """
    return _composite_fwd(splats, lists, grid, config)[0]


def _composite_fwd(
    splats: Array, lists: TileLists, grid: TileGrid, config: SplatConfig
) -> tuple[PyTree, PyTree]:
    features, transmittance, lengths, peaks, medians = _scheduled(
        forward_by_blocks, forward_by_chunks, grid, config, splats, *lists
    )
    outputs = features, transmittance, peaks, medians
    return outputs, (splats, lists, features, transmittance, lengths)


def _composite_bwd(
    grid: TileGrid, config: SplatConfig, saved: PyTree, cotangents: PyTree
) -> tuple[Array, None]:
    splats, lists, features, transmittance, lengths = saved
    g, g_transmittance, *_ = cotangents
    total = jnp.sum(g * features, axis=1) + g_transmittance * transmittance
    arrays = splats, lists.items, lists.starts, lengths, g, total
    sums = _scheduled(backward_by_blocks, backward_by_chunks, grid, config, *arrays)
    return _splat_gradients(splats, sums), None


composite.defvjp(_composite_fwd, _composite_bwd)


def _scheduled(
    on_cpu: Schedule, elsewhere: Schedule, grid: TileGrid, config: SplatConfig, *arrays: Array
) -> PyTree:
    return lax.platform_dependent(
        *arrays, cpu=on_cpu(grid, config), default=elsewhere(grid, config)
    )


def _splat_gradients(
    splats: Float[Array, "g width"], sums: Float[Array, "g width"]
) -> Float[Array, "g width"]:
    """Gradient of the rows from their sums over pixels of e (1, dx, dy, dx^2, dx dy, dy^2) and of w
    g.
    """
    r00, r01, r11 = (splats[:, i] for i in (R00, R01, R11))
    e, ex, ey, exx, exy, eyy = sums[:, :6].T
    # d log alpha = -2 (u du + v dv) with u = r00 dx + r01 dy, v = r11 dy; the sums of e u dx, e u
    # dy, e v dy:
    ux, uy, vy = r00 * exx + r01 * exy, r00 * exy + r01 * eyy, r11 * eyy
    u, v = r00 * ex + r01 * ey, r11 * ey
    columns = [2 * r00 * u, 2 * (r01 * u + r11 * v), -2 * ux, -2 * uy, -2 * vy, e]
    return jnp.concatenate([jnp.stack(columns, axis=-1), sums[:, 6:]], axis=-1)


# What both schedules share
# -------------------------------------------------------------------------------------------


def joined_over_batch(function: Callable[..., PyTree]) -> Callable[..., PyTree]:
    """Under `vmap`, a function of (splats, items, starts, more per tile...) is called once, with
    the tiles of all images.

    Its outputs must be arrays per tile or per splat; those of the images then follow one another.
    """
    function = jax.custom_batching.custom_vmap(function)

    @function.def_vmap
    def rule(size, batched, *args):
        args = [
            a if b else jnp.broadcast_to(a, (size, *a.shape))
            for a, b in zip(args, batched, strict=True)
        ]
        splats, items, starts, *rest = args
        image = jnp.arange(size, dtype=jnp.int32)[:, None]
        args = [splats, items + image * splats.shape[1], starts + image * items.shape[1], *rest]
        out = function(*(a.reshape(-1, *a.shape[2:]) for a in args))
        out = jax.tree.map(lambda a: a.reshape(size, -1, *a.shape[1:]), out)
        return out, jax.tree.map(lambda _: True, out)

    return function


def take_chunk(
    splats: Float[Array, "g width"],
    items: Int[Array, " capacity"],
    starts: Int[Array, " b"],
    counts: Int[Array, " b"],
    tiles: Int[Array, " b"],
    grid: TileGrid,
    k: int,
) -> tuple[
    Int[Array, "b k"], Float[Array, "b k width"], Float[Array, "2 b k"], Float[Array, "b k p"]
]:
    """The first k splats of each of b lists, `items[starts : starts + counts]`, which lie on
    `tiles`.

    Returns their numbers (g past the end of a list), rows, centres from that of the tile, and raw
    alphas (0 past the end).
    """
    slot = jnp.arange(k, dtype=jnp.int32)
    item = items.at[starts[:, None] + slot].get(mode="clip")
    item = jnp.where(slot < counts[:, None], item, splats.shape[0])
    row = lax.optimization_barrier(splats.at[item].get(mode="clip"))
    place = tiles % grid.tiles  # of its image, if several were joined
    cx, cy = (
        (axis * grid.tile_size).astype(row.dtype)[:, None] + 0.5 * grid.tile_size
        for axis in (place % grid.columns, place // grid.columns)
    )
    centre = jnp.stack([row[..., X] - cx, row[..., Y] - cy])
    inside = jnp.arange(k, dtype=jnp.int32) < counts[:, None]
    x, y = centre
    r00, r01, r11 = row[..., R00], row[..., R01], row[..., R11]
    offsets = jnp.asarray(grid.offsets(row.dtype))
    u = (r00 * x + r01 * y)[..., None] - r00[..., None] * offsets[0] - r01[..., None] * offsets[1]
    v = (r11 * y)[..., None] - r11[..., None] * offsets[1]
    raw = jnp.where(inside[..., None], jnp.exp(row[..., LOG_OPACITY, None] - u * u - v * v), 0.0)
    return item, row, centre, raw


def largest_weights(
    weights: Float[Array, "b k p"], tiles: Int[Array, " b"], grid: TileGrid
) -> Float[Array, "b k"]:
    """Returns the largest weight of each splat on those pixels of its tile that lie inside the
    image.
    """
    place = tiles % grid.tiles
    x, y = (0.5 * grid.tile_size + offset for offset in grid.offsets())
    left = jnp.minimum(grid.width - place % grid.columns * grid.tile_size, grid.tile_size)
    above = jnp.minimum(grid.height - place // grid.columns * grid.tile_size, grid.tile_size)
    inside = (x < left[:, None]) & (y < above[:, None])
    return jnp.max(jnp.where(inside[:, None], weights, 0.0), axis=2)


def visible_alpha(raw: Float[Array, "*b"], config: SplatConfig) -> Float[Array, "*b"]:
    """Alpha from its raw value: clamped above, 0 if it is skipped."""
    return jnp.where(raw < config.alpha_min, 0.0, jnp.minimum(raw, config.alpha_max))


def monomials(grid: TileGrid, dtype: np.dtype | type) -> np.ndarray:
    """(p, 6): 1, x, y, x^2, xy, y^2 of a tile's pixels, from its centre."""
    x, y = grid.offsets(dtype)
    return np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=-1)


def moments_about_splat(
    moments: Float[Array, "*b 6"], x: Float[Array, "*b"], y: Float[Array, "*b"]
) -> Float[Array, "*b 6"]:
    """Moments of d = (pixel - splat) from those of (pixel - centre of the tile); x, y: (splat -
    centre).
    """
    m, mx, my, mxx, mxy, myy = (moments[..., i] for i in range(6))
    about = [
        m,
        mx - x * m,
        my - y * m,
        mxx - 2 * x * mx + x * x * m,
        mxy - x * my - y * mx + x * y * m,
    ]
    return jnp.stack([*about, myy - 2 * y * my + y * y * m], axis=-1)


product = functools.partial(jnp.matmul, precision=EXACT)
"""Sums over pixels as a matrix product."""


# Small blocks of tiles, for CPUs
# -------------------------------------------------------------------------------------

# Tiles come by falling list length in blocks of `config.block`; a block takes its lists in chunks
# until the longest list ends or all its pixels have. A chunk's arrays (block, chunk, pixels) stay
# in the cache, and its chain of splats is unrolled, once for each thing that the loop carries: XLA
# makes of each ONE kernel that runs the chain in registers. Once a pixel has stopped, the loop
# carries -T, which keeps the final T. Compile with `core.processes.compiler_options`: sharing small
# kernels out over threads costs more than it gains, and the barriers have to be kept.

LINK = 2
"""Splats of a chunk whose chain one kernel of the backward pass runs. Its outputs for splat j redo
the chain from the last stored link on; storing T after every splat costs more than that."""


@functools.lru_cache
def forward_by_blocks(grid: TileGrid, config: SplatConfig) -> Callable[..., PyTree]:
    """(splats, items, starts, counts) -> features (t, n, p), final T (t, p), used parts of the
    lists (t,), peaks (g,), medians.

    peaks: largest w of each splat; 0 unless `config.visibility`. medians: (t, p) z of the splat at
    which T falls to one half, infinite where it never does; None unless `config.depth_median`.
    Lists run front to back, so it is the smallest z behind which T is one half or less.
    """
    block, k, stop = config.block, config.chunk, config.transmittance_stop

    @joined_over_batch
    def forward(splats, items, starts, counts):
        dtype, t = splats.dtype, counts.shape[0]
        blocks = blocks_by_length(counts, block)

        def draw(b, carry):
            *out, peaks, all_medians = carry
            tile = lax.dynamic_slice_in_dim(blocks.tiles, b * block, block)
            start, count = _lists_of(tile, starts, counts)

            def body(carry):
                i, transmittance, features, lengths, live, peaks, medians = carry
                item, row, _, raw = take_chunk(
                    splats, items, start + i * k, count - i * k, tile, grid, k
                )
                # one exp per pair: XLA would fuse it into each of its consumers
                raw = lax.optimization_barrier(raw)
                alpha = lax.optimization_barrier(visible_alpha(raw, config))
                # features, weights and medians in one chain: `before` is T in front of splat j
                before, weights = transmittance[:, None], []
                for j in range(k):
                    after = before * (1 - alpha[:, None, j])
                    weight = jnp.where(after > stop, alpha[:, None, j] * before, 0.0)
                    features = features + weight * row[:, j, FEATURES, None]
                    weights.append(weight)
                    before = after
                    if medians is not None:
                        reached = (weight[:, 0] > 0) & (after[:, 0] <= HALF)
                        nearer = jnp.minimum(medians, row[:, j, Z, None])
                        medians = jnp.where(reached, nearer, medians)
                # the largest weight of each splat on the pixels of this block
                if config.visibility:
                    highest = largest_weights(jnp.concatenate(weights, axis=1), tile, grid)
                    peaks = peaks.at[item].max(highest, mode="drop")
                # T itself in a second chain; from the stop on its sign is negative
                for j in range(k):
                    after = transmittance * (1 - alpha[:, j])
                    transmittance = jnp.where(
                        after > stop, after, jnp.minimum(transmittance, -transmittance)
                    )
                # a list is alive while it has items left and some pixel of its tile has not ended
                lengths = jnp.where(live, jnp.minimum((i + 1) * k, count), lengths)
                live = (jnp.max(transmittance, axis=1) > 0) & ((i + 1) * k < count)
                return i + 1, transmittance, features, lengths, live, peaks, medians

            # every pixel of the block starts with T = 1 and no features
            ones = jnp.ones((block, grid.pixels), dtype)
            zeros = jnp.zeros((block, splats.shape[1] - FEATURES.start, grid.pixels), dtype)
            medians = None
            if config.depth_median:
                medians = jnp.full_like(ones, jnp.inf)
            carry = 0, ones, zeros, jnp.zeros_like(count), count > 0, peaks, medians
            _, transmittance, features, lengths, _, peaks, medians = lax.while_loop(
                lambda carry: jnp.any(carry[4]), body, carry
            )
            # the block's tiles take their places among all tiles; padding is dropped
            results = features, jnp.abs(transmittance), lengths
            drawn = (
                o.at[tile].set(r, mode="drop", unique_indices=True)
                for o, r in zip(out, results, strict=True)
            )
            if medians is not None:
                all_medians = all_medians.at[tile].set(medians, mode="drop", unique_indices=True)
            return *drawn, peaks, all_medians

        out = (
            jnp.zeros((t, splats.shape[1] - FEATURES.start, grid.pixels), dtype),
            jnp.ones((t, grid.pixels), dtype),
            jnp.zeros(t, jnp.int32),
            jnp.zeros(splats.shape[0], dtype),
            jnp.full((t, grid.pixels), jnp.inf, dtype) if config.depth_median else None,
        )
        return lax.fori_loop(0, blocks.used, draw, out)

    return forward


@functools.lru_cache
def backward_by_blocks(grid: TileGrid, config: SplatConfig) -> Callable[..., PyTree]:
    """(splats, items, starts, lengths, g (t, n, p), Q (t, p)) -> sums over pixels for each splat,
    (g, 6 + n).

    Columns: the moments of e = dL/d log alpha about the splat's centre (1, dx, dy, dx^2, dx dy,
    dy^2), then the gradient of the features, the sums of w g.
    """
    block, k, stop = config.block, config.chunk, config.transmittance_stop

    @joined_over_batch
    def backward(splats, items, starts, lengths, cotangents, totals):
        dtype = splats.dtype
        powers = jnp.asarray(monomials(grid, dtype))
        blocks = blocks_by_length(lengths, block)

        def draw(b, sums):
            tile = lax.dynamic_slice_in_dim(blocks.tiles, b * block, block)
            start, count = _lists_of(tile, starts, lengths)
            g, total = (v.at[tile].get(mode="fill", fill_value=0) for v in (cotangents, totals))
            trips = (jnp.max(count) + k - 1) // k

            def body(carry):
                i, transmittance, seen, sums = carry
                item, row, offset, raw = take_chunk(
                    splats, items, start + i * k, count - i * k, tile, grid, k
                )
                # one exp per pair: XLA would fuse it into each of its consumers
                raw = lax.optimization_barrier(raw)
                # the chain of T front to back, with the decisions of the forward pass
                weights, slopes = [], []
                for j in range(k):
                    if j > 0 and j % LINK == 0:
                        transmittance, seen = lax.optimization_barrier((transmittance, seen))
                    alpha = visible_alpha(raw[:, j], config)
                    after = transmittance * (1 - alpha)
                    weight = jnp.where(after > stop, alpha * transmittance, 0.0)
                    along = sum(
                        row[:, j, 6 + c, None] * g[:, c]
                        for c in range(splats.shape[1] - FEATURES.start)
                    )
                    seen = seen + weight * along
                    slope = (along * transmittance - (total - seen) / (1 - alpha)) * raw[:, j]
                    slopes.append(
                        jnp.where((weight > 0) & (raw[:, j] < config.alpha_max), slope, 0.0)
                    )
                    weights.append(weight)
                    transmittance = after
                weights, slopes = jnp.stack(weights, axis=1), jnp.stack(slopes, axis=1)
                # matrix products: XLA's row reductions are slow on CPUs
                moments = product(slopes.reshape(block * k, -1), powers).reshape(block, k, 6)
                features = product(weights, jnp.moveaxis(g, 1, 2))
                rows = jnp.concatenate([moments_about_splat(moments, *offset), features], axis=-1)
                return i + 1, transmittance, seen, sums.at[item].add(rows, mode="drop")

            ones = jnp.ones((block, grid.pixels), dtype)
            carry = 0, ones, jnp.zeros_like(ones), sums
            return lax.while_loop(lambda carry: carry[0] < trips, body, carry)[3]

        return lax.fori_loop(0, blocks.used, draw, jnp.zeros(splats.shape, dtype))

    return backward


def _lists_of(tile: Array, starts: Array, counts: Array) -> Iterator[Array]:
    return (v.at[tile].get(mode="fill", fill_value=0) for v in (starts, counts))


# Few fat steps, for accelerators
# -------------------------------------------------------------------------------------

# A sequential step costs microseconds there, however little it does. Every list is cut into chunks
# of `CHUNK` splats, and the chunks of ALL lists of all images of a batch, B at once, become arrays
# (B, k, p) (p pixels of a tile). The chain over a list becomes products, because along it only log
# T accumulates:
# log T_j = (sum of the log(1 - alpha) before the chunk) + (strict lower triangle (k, k)) @ log(1 -
# alpha) The sum before the chunk is a product, too, with the 0-1 matrix (B, B) of "earlier chunk of
# the same list", plus what the list that runs on from the step before has come to, all that steps
# hand on. The sums over i <= j of w_i g . f_i of the backward pass are formed by the same two
# products. T agrees with the other schedule's to |log T| eps. Past the stop log T can rise by
# rounding only while alpha is 0; hence the final log T sums log(1 - alpha) over the splats before
# the stop. A NaN spreads to other tiles of its step. Scatter-adds: on a GPU the last bit may differ
# between runs.

CHUNK = 64
"""Splats of a list in one chunk.

The triangular product costs 2 CHUNK flops per pair; half a chunk per list is padding.
"""
STEP_BYTES = 64 << 20
"""Largest size of one of the arrays (B, k, p) of a step; the backward pass holds five of them."""
STEP_CHUNKS = 2048
"""Largest B: the product over earlier chunks costs 2 B / k flops per pair, half of the triangular
one at this B.
"""
_LOG_ZERO = -1e3
"""Stands for log 0 where 1 - alpha_max rounds to 0: its exp is 0, and its product with 0 is 0 and
not NaN.
"""


class Chunks(NamedTuple):
    """All lists cut into chunks of at most `CHUNK`, list by list; chunks that are not needed have
    tile t and count 0.
    """

    tiles: Int[Array, " s"]
    """Tile of each chunk, (s,)."""
    starts: Int[Array, " s"]
    """Place of each chunk's first item in the array of items, (s,)."""
    counts: Int[Array, " s"]
    """Number of items in each chunk, (s,), 0 to `CHUNK`."""
    ends: Int[Array, " s"]
    """How many items of its list come up to the end of each chunk, (s,)."""
    steps: Int[Array, ""]
    """Number of steps of B chunks each that hold any item."""


def cut(starts: Int[Array, " t"], counts: Int[Array, " t"], capacity: int, step: int) -> Chunks:
    """Cuts lists, of `capacity` items at most together, into chunks; their number is a multiple of
    `step`.
    """
    t = counts.shape[0]
    most = _most_chunks(capacity, t)
    slots = expand((counts + CHUNK - 1) // CHUNK, -(-most // step) * step)
    slot = jnp.arange(slots.source.shape[0], dtype=jnp.int32)
    tile = jnp.where(slot < slots.needed, slots.source, t)
    skipped = (slot - slots.first[slots.source]) * CHUNK
    start, count = (v.at[tile].get(mode="fill", fill_value=0) for v in (starts, counts))
    inside = jnp.clip(count - skipped, 0, CHUNK)
    return Chunks(
        tile, start + skipped, inside, skipped + inside, (slots.needed + step - 1) // step
    )


@functools.lru_cache
def forward_by_chunks(grid: TileGrid, config: SplatConfig) -> Callable[..., PyTree]:
    """As `forward_by_blocks`."""
    log_stop = _log_stop(config)

    @joined_over_batch
    def forward(splats, items, starts, counts):
        dtype, t, p = splats.dtype, counts.shape[0], grid.pixels
        step = _chunks_per_step(grid, dtype, items.shape[0], t)
        chunks = cut(starts, counts, items.shape[0], step)

        def draw(i, carry):
            sums, lengths, peaks, medians, tail = carry
            # log(1 - alpha) of all pairs of this step, and log T in front of each
            c = _slice(chunks, i, step)
            item, row, _, raw = take_chunk(splats, items, c.starts, c.counts, c.tiles, grid, CHUNK)
            alpha, fading = _fading(raw, config)
            before, since = _sums_before(fading, c.tiles, tail)
            # a pair counts while T behind it is above the stop
            live = before[:, None] + since + fading > log_stop
            weights = jnp.where(live, alpha * jnp.exp(before[:, None] + since), 0.0)
            features = [
                jnp.sum(weights * row[..., f, None], axis=1)
                for f in range(FEATURES.start, splats.shape[1])
            ]
            # sums of the features and of log(1 - alpha), added to those of the tile's other chunks
            parts = jnp.stack([*features, jnp.sum(jnp.where(live, fading, 0.0), axis=1)], axis=1)
            sums = sums.at[c.tiles].add(parts, mode="drop", indices_are_sorted=True)
            # how far the lists were used: up to the last chunk that some pixel reached
            reached = jnp.where(jnp.max(before, axis=1) > log_stop, c.ends, 0)
            lengths = lengths.at[c.tiles].max(reached, mode="drop", indices_are_sorted=True)
            if config.visibility:
                peaks = peaks.at[item].max(largest_weights(weights, c.tiles, grid), mode="drop")
            if medians is not None:
                reached = (weights > 0) & (before[:, None] + since + fading <= math.log(HALF))
                nearest = jnp.min(jnp.where(reached, row[..., Z, None], jnp.inf), axis=1)
                medians = medians.at[c.tiles].min(nearest, mode="drop", indices_are_sorted=True)
            return sums, lengths, peaks, medians, _tail(c.tiles, before, since + fading)

        # the last of the sums is log T; everything starts empty
        sums = jnp.zeros((t, splats.shape[1] - FEATURES.start + 1, p), dtype)
        lengths = jnp.zeros(t, jnp.int32)
        peaks = jnp.zeros(splats.shape[0], dtype)
        medians = None
        if config.depth_median:
            medians = jnp.full((t, p), jnp.inf, dtype)
        carry = sums, lengths, peaks, medians, _no_tail(t, p, dtype)
        sums, lengths, peaks, medians, _ = lax.fori_loop(0, chunks.steps, draw, carry)
        return sums[:, :-1], jnp.exp(sums[:, -1]), lengths, peaks, medians

    return forward


@functools.lru_cache
def backward_by_chunks(grid: TileGrid, config: SplatConfig) -> Callable[..., PyTree]:
    """As `backward_by_blocks`."""
    log_stop = _log_stop(config)

    @joined_over_batch
    def backward(splats, items, starts, lengths, cotangents, totals):
        dtype, t, p = splats.dtype, lengths.shape[0], grid.pixels
        step = _chunks_per_step(grid, dtype, items.shape[0], t)
        chunks = cut(starts, lengths, items.shape[0], step)
        powers = jnp.asarray(monomials(grid, dtype))

        def draw(i, carry):
            sums, faded_tail, seen_tail = carry
            # alpha and T of all pairs of this step, as in the forward pass
            c = _slice(chunks, i, step)
            item, row, centre, raw = take_chunk(
                splats, items, c.starts, c.counts, c.tiles, grid, CHUNK
            )
            g, total = (v.at[c.tiles].get(mode="fill", fill_value=0) for v in (cotangents, totals))
            alpha, fading = _fading(raw, config)
            before, since = _sums_before(fading, c.tiles, faded_tail)
            transmittance = jnp.exp(before[:, None] + since)
            live = before[:, None] + since + fading > log_stop
            weights = jnp.where(live, alpha * transmittance, 0.0)
            # g . f of each pair, and dL/d log alpha with what the splats behind it add
            along = sum(
                row[..., FEATURES][..., f, None] * g[:, None, f]
                for f in range(splats.shape[1] - FEATURES.start)
            )
            gained = weights * along
            seen_before, seen_since = _sums_before(gained, c.tiles, seen_tail)
            behind = total[:, None] - (seen_before[:, None] + seen_since + gained)
            slopes = (along * transmittance - behind / (1 - alpha)) * raw
            slopes = jnp.where((weights > 0) & (raw < config.alpha_max), slopes, 0.0)

            # sums over pixels, moved from the tile's centre to the splat's
            moments = product(slopes.reshape(-1, p), powers).reshape(step, CHUNK, 6)
            features = product(weights, jnp.moveaxis(g, 1, 2))
            rows = jnp.concatenate([moments_about_splat(moments, *centre), features], axis=-1)
            # the list that runs on into the next step hands on its two sums
            tails = (
                _tail(c.tiles, b, s + own)
                for b, s, own in ((before, since, fading), (seen_before, seen_since, gained))
            )
            return sums.at[item].add(rows, mode="drop"), *tails

        sums, tail = jnp.zeros(splats.shape, dtype), _no_tail(t, p, dtype)
        return lax.fori_loop(0, chunks.steps, draw, (sums, tail, tail))[0]

    return backward


def _most_chunks(capacity: int, t: int) -> int:
    """Full chunks, and for each list one that is not."""
    return capacity // CHUNK + min(t, capacity)


def _chunks_per_step(grid: TileGrid, dtype: np.dtype | type, capacity: int, t: int) -> int:
    fitting = STEP_BYTES // (CHUNK * grid.pixels * np.dtype(dtype).itemsize)
    return max(1, min(fitting, STEP_CHUNKS, _most_chunks(capacity, t)))


def _log_stop(config: SplatConfig) -> float:
    if config.transmittance_stop > 0:
        return math.log(config.transmittance_stop)
    return -math.inf


def _slice(chunks: Chunks, i: Array | int, step: int) -> Chunks:
    parts = (lax.dynamic_slice_in_dim(v, i * step, step) for v in chunks[:-1])
    return Chunks(*parts, chunks.steps)


def _fading(raw: Array, config: SplatConfig) -> tuple[Array, Array]:
    alpha = visible_alpha(raw, config)
    return alpha, jnp.maximum(jnp.log1p(-alpha), _LOG_ZERO)


def _sums_before(
    x: Float[Array, "b k p"], tiles: Int[Array, " b"], tail: tuple[Array, Array]
) -> tuple[Array, Array]:
    """Sums of x (B, k, p) along its lists: of what comes before each chunk (B, p), and from there
    to each splat.
    """
    b, k, _ = x.shape
    triangle = jnp.broadcast_to(jnp.asarray(np.tri(k, k=-1), x.dtype), (b, k, k))
    since = lax.optimization_barrier(jnp.matmul(triangle, x, precision=EXACT))
    chunk = jnp.arange(b)
    earlier = (tiles[:, None] == tiles) & (chunk[:, None] > chunk)
    before = jnp.matmul(earlier.astype(x.dtype), since[:, -1] + x[:, -1], precision=EXACT)
    tail_tile, tail_sum = tail
    return before + jnp.where((tiles == tail_tile)[:, None], tail_sum, 0.0), since


def _tail(tiles: Array, before: Array, through: Array) -> tuple[Array, Array]:
    return tiles[-1], before[-1] + through[-1, -1]


def _no_tail(t: int, p: int, dtype: np.dtype | type) -> tuple[Array, Array]:
    return jnp.asarray(t, jnp.int32), jnp.zeros(p, dtype)
