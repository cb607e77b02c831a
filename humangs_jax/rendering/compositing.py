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

from humangs_jax.core.array_types import Array, Bool, Float, Int, PyTree
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
"""Makes the function that draws, or its gradient, for one grid and one configuration."""
EXACT = lax.Precision.HIGHEST
"""GPUs and TPUs would otherwise round the factors of a product to 10 or 8 bits."""


def pack_splats(
    projected: ProjectedGaussians,
    opacities: Float[Array, " g"],
    features: Float[Array, "g n"],
    alpha_min: float,
) -> Float[Array, "g width"]:
    """Packs splats into rows: x, y (pixels), r00, r01, r11 (1 / pixels), log opacity, features. All
    numbers are finite, also those of splats that are not drawn.
    """
    p = projected
    drawn = p.visible & (opacities >= alpha_min)
    log_opacity = jnp.log(jnp.where(drawn, opacities, 1.0))
    return jnp.stack([p.x, p.y, p.r00, p.r01, p.r11, log_opacity, *features.T], axis=-1)


class Composited(NamedTuple):
    """What lists of splats look like: p pixels of each of t tiles, and what is known of each of g
    splats.
    """

    features: Float[Array, "t n p"]
    """Sum of w f, (t, n, p); 0 where lists are empty."""
    transmittance: Float[Array, "t p"]
    """The final T, (t, p); 1 where lists are empty."""
    lengths: Int[Array, " t"]
    """How many splats of each list were read until all pixels of its tile had ended, (t,)."""
    peaks: Float[Array, " g"]
    """The largest w of each splat, (g,); 0 unless `config.visibility`."""
    medians: Float[Array, "t p"] | None
    """The z of the splat at which T falls to one half, (t, p), metres; infinite where it never
    does. Lists run front to back, so it is the smallest z behind which T is one half or less. None
    unless `config.depth_median`."""


@functools.partial(jax.custom_vjp, nondiff_argnums=(2, 3))
def composite(
    splats: Float[Array, "g width"], lists: TileLists, grid: TileGrid, config: SplatConfig
) -> Composited:
    """Draws lists of splats, which must be in depth order, into tiles.

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
    total = jnp.sum(g * features, axis=1) + cotangents.transmittance * transmittance
    arrays = splats, lists.items, lists.starts, lengths, g, total
    sums = _scheduled(backward_by_blocks, backward_by_chunks, grid, config, *arrays)
    return _splat_gradients(splats, sums), None


composite.defvjp(_composite_fwd, _composite_bwd)


def _scheduled(
    on_cpu: Schedule, elsewhere: Schedule, grid: TileGrid, config: SplatConfig, *arrays: Array
) -> PyTree:
    """Calls what one of two schedules makes: the platform decides when the program is compiled."""
    return lax.platform_dependent(
        *arrays, cpu=on_cpu(grid, config), default=elsewhere(grid, config)
    )


def _splat_gradients(
    splats: Float[Array, "g width"], sums: Float[Array, "g width"]
) -> Float[Array, "g width"]:
    """Returns the gradient of the rows from their sums over pixels: of e (1, dx, dy, dx^2, dx dy,
    dy^2), and of w g.
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


def _joined_over_batch(function: Callable[..., PyTree]) -> Callable[..., PyTree]:
    """Under `vmap`, calls a function of (splats, items, starts, more per tile...) once, with the
    tiles of all images.

    It must return arrays per tile or per splat: they are cut into those of the images.
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


def _take_chunk(
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
    """Takes the first k splats of each of b lists, `items[starts : starts + counts]`, which lie on
    `tiles`.

    Returns their numbers (g past the end of a list), rows, centres from that of the tile, and raw
    alphas (0 past the end).
    """
    # numbers and rows of the splats
    slot = jnp.arange(k, dtype=jnp.int32)
    item = items.at[starts[:, None] + slot].get(mode="clip")
    item = jnp.where(slot < counts[:, None], item, splats.shape[0])
    row = lax.optimization_barrier(splats.at[item].get(mode="clip"))
    # their centres, measured from that of the tile (of its image, if several were joined)
    place = tiles % grid.tiles
    cx, cy = (
        (axis * grid.tile_size).astype(row.dtype)[:, None] + 0.5 * grid.tile_size
        for axis in (place % grid.columns, place // grid.columns)
    )
    centre = jnp.stack([row[..., X] - cx, row[..., Y] - cy])
    inside = jnp.arange(k, dtype=jnp.int32) < counts[:, None]
    # raw alpha at the pixels, with the exponent as a sum of squares
    x, y = centre
    r00, r01, r11 = row[..., R00], row[..., R01], row[..., R11]
    offsets = jnp.asarray(grid.offsets(row.dtype))
    u = (r00 * x + r01 * y)[..., None] - r00[..., None] * offsets[0] - r01[..., None] * offsets[1]
    v = (r11 * y)[..., None] - r11[..., None] * offsets[1]
    raw = jnp.where(inside[..., None], jnp.exp(row[..., LOG_OPACITY, None] - u * u - v * v), 0.0)
    return item, row, centre, raw


def _largest_weights(
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


def _visible_alpha(raw: Float[Array, "*b"], config: SplatConfig) -> Float[Array, "*b"]:
    """Returns alpha for its raw value: clamped above, 0 if it is skipped."""
    return jnp.where(raw < config.alpha_min, 0.0, jnp.minimum(raw, config.alpha_max))


def _monomials(grid: TileGrid, dtype: np.dtype | type) -> np.ndarray:
    """Returns 1, x, y, x^2, xy, y^2 of a tile's pixels, (p, 6), measured from its centre."""
    x, y = grid.offsets(dtype)
    return np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=-1)


def _moments_about_splat(
    moments: Float[Array, "*b 6"], x: Float[Array, "*b"], y: Float[Array, "*b"]
) -> Float[Array, "*b 6"]:
    """Returns the moments of (pixel - splat) for those of (pixel - centre of the tile).

    x, y: (splat - centre of the tile), pixels.
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


_product = functools.partial(jnp.matmul, precision=EXACT)
"""Sums over pixels, as a matrix product."""


# Small blocks of tiles, for CPUs
# -------------------------------------------------------------------------------------

# Tiles come by falling list length in blocks of `config.block`; a block takes its lists in chunks
# until the longest list ends or all its pixels have. A chunk's arrays (block, chunk, pixels) stay
# in the cache. Its chain of splats is unrolled, once for each array that the loop carries: XLA
# makes ONE kernel of each, which runs the chain in registers. Once a pixel has stopped, the loop
# carries -T, which keeps the final T. Compile with `core.processes.compiler_options`: sharing small
# kernels out over threads costs more than it gains, and the barriers have to be kept.


class _Chain(NamedTuple):
    """What a block carries from one chunk of its lists to the next."""

    chunk: Array | int
    """Number of the chunk."""
    transmittance: Float[Array, "block p"]
    """T in front of the chunk; -T once a pixel has ended."""
    features: Float[Array, "block n p"]
    """Sum of w f so far."""
    lengths: Int[Array, " block"]
    """How many splats of each list have been read."""
    live: Bool[Array, " block"]
    """Whether a list has splats left and some pixel of its tile has not ended."""
    peaks: Float[Array, " g"]
    """The largest w of each splat so far, in all blocks."""
    medians: Float[Array, "block p"] | None
    """The smallest z so far behind which T is one half or less."""


@functools.lru_cache
def forward_by_blocks(grid: TileGrid, config: SplatConfig) -> Callable[..., Composited]:
    """Makes the function (splats, items, starts, counts) -> `Composited`."""
    block, k, stop = config.block, config.chunk, config.transmittance_stop

    @_joined_over_batch
    def forward(splats, items, starts, counts):
        dtype, t = splats.dtype, counts.shape[0]
        blocks = blocks_by_length(counts, block)

        def draw(b, drawn):
            tile = lax.dynamic_slice_in_dim(blocks.tiles, b * block, block)
            start, count = _lists_of(tile, starts, counts)

            def body(chain):
                i, transmittance, features, lengths, live, peaks, medians = chain
                item, row, _, raw = _take_chunk(
                    splats, items, start + i * k, count - i * k, tile, grid, k
                )
                # one exp a pair: without the barrier each kernel that uses it computes it again
                raw = lax.optimization_barrier(raw)
                alpha = lax.optimization_barrier(_visible_alpha(raw, config))
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
                    highest = _largest_weights(jnp.concatenate(weights, axis=1), tile, grid)
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
                return _Chain(i + 1, transmittance, features, lengths, live, peaks, medians)

            # every pixel of the block starts with T = 1 and no features
            ones = jnp.ones((block, grid.pixels), dtype)
            zeros = jnp.zeros((block, splats.shape[1] - FEATURES.start, grid.pixels), dtype)
            medians = None
            if config.depth_median:
                medians = jnp.full_like(ones, jnp.inf)
            chain = _Chain(0, ones, zeros, jnp.zeros_like(count), count > 0, drawn.peaks, medians)
            chain = lax.while_loop(lambda chain: jnp.any(chain.live), body, chain)

            final = jnp.abs(chain.transmittance)  # the sign marked pixels that had ended

            def placed(of_all, of_block):
                """Puts the block's tiles at their places among all tiles; padding is dropped."""
                return of_all.at[tile].set(of_block, mode="drop", unique_indices=True)

            medians = None
            if config.depth_median:
                medians = placed(drawn.medians, chain.medians)
            features = placed(drawn.features, chain.features)
            transmittance = placed(drawn.transmittance, final)
            lengths = placed(drawn.lengths, chain.lengths)
            return Composited(features, transmittance, lengths, chain.peaks, medians)

        empty = Composited(
            features=jnp.zeros((t, splats.shape[1] - FEATURES.start, grid.pixels), dtype),
            transmittance=jnp.ones((t, grid.pixels), dtype),
            lengths=jnp.zeros(t, jnp.int32),
            peaks=jnp.zeros(splats.shape[0], dtype),
            medians=jnp.full((t, grid.pixels), jnp.inf, dtype) if config.depth_median else None,
        )
        return lax.fori_loop(0, blocks.used, draw, empty)

    return forward


class _BackwardChain(NamedTuple):
    """What a block carries from one chunk of its lists to the next, in the backward pass."""

    chunk: Array | int
    """Number of the chunk."""
    transmittance: Float[Array, "block p"]
    """T in front of the chunk."""
    seen: Float[Array, "block p"]
    """Sum of w g . f so far."""
    sums: Float[Array, "g width"]
    """What is returned, of all splats so far."""


@functools.lru_cache
def backward_by_blocks(grid: TileGrid, config: SplatConfig) -> Callable[..., Array]:
    """Makes the function (splats, items, starts, lengths, g (t, n, p), Q (t, p)) -> sums over
    pixels for each splat, (g, 6 + n).

    Columns: the moments of e = dL/d log alpha about the splat's centre (1, dx, dy, dx^2, dx dy,
    dy^2), then the gradient of the features, the sums of w g.
    """
    block, k, stop = config.block, config.chunk, config.transmittance_stop

    @_joined_over_batch
    def backward(splats, items, starts, lengths, cotangents, totals):
        dtype = splats.dtype
        powers = jnp.asarray(_monomials(grid, dtype))
        blocks = blocks_by_length(lengths, block)

        def draw(b, sums):
            tile = lax.dynamic_slice_in_dim(blocks.tiles, b * block, block)
            start, count = _lists_of(tile, starts, lengths)
            g, total = (v.at[tile].get(mode="fill", fill_value=0) for v in (cotangents, totals))
            trips = (jnp.max(count) + k - 1) // k

            def body(chain):
                i, transmittance, seen, sums = chain
                item, row, offset, raw = _take_chunk(
                    splats, items, start + i * k, count - i * k, tile, grid, k
                )
                # one exp a pair: without the barrier each kernel that uses it computes it again
                raw = lax.optimization_barrier(raw)
                # the chain of T front to back, with the decisions of the forward pass
                weights, slopes = [], []
                for j in range(k):
                    # a kernel runs the chain of two splats: what it computes for splat j redoes the
                    # chain from the last stored T on; storing T after every splat costs more
                    if j > 0 and j % 2 == 0:
                        transmittance, seen = lax.optimization_barrier((transmittance, seen))
                    alpha = _visible_alpha(raw[:, j], config)
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
                moments = _product(slopes.reshape(block * k, -1), powers).reshape(block, k, 6)
                features = _product(weights, jnp.moveaxis(g, 1, 2))
                rows = jnp.concatenate([_moments_about_splat(moments, *offset), features], axis=-1)
                following = i + 1
                sums = sums.at[item].add(rows, mode="drop")
                return _BackwardChain(following, transmittance, seen, sums)

            ones = jnp.ones((block, grid.pixels), dtype)
            chain = _BackwardChain(0, ones, jnp.zeros_like(ones), sums)
            return lax.while_loop(lambda chain: chain.chunk < trips, body, chain).sums

        return lax.fori_loop(0, blocks.used, draw, jnp.zeros(splats.shape, dtype))

    return backward


def _lists_of(tile: Array, starts: Array, counts: Array) -> Iterator[Array]:
    """Gives starts and lengths of the lists of some tiles; padding has empty lists."""
    return (v.at[tile].get(mode="fill", fill_value=0) for v in (starts, counts))


# Few fat steps, for accelerators
# -------------------------------------------------------------------------------------

# A sequential step costs microseconds there, however little it does. So every list is cut into
# chunks of `CHUNK` splats, and the chunks of ALL lists of all images of a batch, B at once, become
# arrays (B, k, p) (p pixels of a tile). The chain over a list becomes products, because along it
# only log T accumulates:
#
#     log T_j = (sum of the log(1 - alpha) before the chunk)
#               + (strict lower triangle (k, k)) @ log(1 - alpha)
#
# The sum before the chunk is a product, too, with the 0-1 matrix (B, B) of "earlier chunk of the
# same list". To it comes the sum of the list that runs on from the step before, which is all that
# steps hand on. The sums over i <= j of w_i g . f_i of the backward pass are formed by the same two
# products.
#
# T agrees with the other schedule's to |log T| eps. Past the stop log T can rise by rounding only
# while alpha is 0; hence the final log T sums log(1 - alpha) over the splats before the stop. A NaN
# spreads to other tiles of its step. Sums over splats are scattered: on a GPU the last bit may
# differ between runs.

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


class _Tail(NamedTuple):
    """A sum along the list that runs on from one step into the next."""

    tile: Int[Array, ""]
    """Tile of the list."""
    sum: Float[Array, " p"]
    """Sum at the pixels of the tile so far."""


class _Step(NamedTuple):
    """What one step of the forward pass hands to the next."""

    sums: Float[Array, "t n+1 p"]
    """Sums of w f, and behind them that of log(1 - alpha), the final log T."""
    lengths: Int[Array, " t"]
    """How many splats of each list have been read, as in `Composited`."""
    peaks: Float[Array, " g"]
    """The largest w of each splat so far, as in `Composited`."""
    medians: Float[Array, "t p"] | None
    """The smallest z so far behind which T is one half or less, as in `Composited`."""
    tail: _Tail
    """log T of the last list."""


@functools.lru_cache
def forward_by_chunks(grid: TileGrid, config: SplatConfig) -> Callable[..., Composited]:
    """Makes the same function as `forward_by_blocks`."""
    log_stop = _log_stop(config)

    @_joined_over_batch
    def forward(splats, items, starts, counts):
        dtype, t, p = splats.dtype, counts.shape[0], grid.pixels
        step = _chunks_per_step(grid, dtype, items.shape[0], t)
        chunks = cut(starts, counts, items.shape[0], step)

        def draw(i, handed):
            sums, lengths, peaks, medians, tail = handed
            # log(1 - alpha) of all pairs of this step, and log T in front of each
            c = _slice(chunks, i, step)
            item, row, _, raw = _take_chunk(splats, items, c.starts, c.counts, c.tiles, grid, CHUNK)
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
                peaks = peaks.at[item].max(_largest_weights(weights, c.tiles, grid), mode="drop")
            if medians is not None:
                reached = (weights > 0) & (before[:, None] + since + fading <= math.log(HALF))
                nearest = jnp.min(jnp.where(reached, row[..., Z, None], jnp.inf), axis=1)
                medians = medians.at[c.tiles].min(nearest, mode="drop", indices_are_sorted=True)
            return _Step(sums, lengths, peaks, medians, _tail(c.tiles, before, since + fading))

        # the last of the sums is log T; everything starts empty
        sums = jnp.zeros((t, splats.shape[1] - FEATURES.start + 1, p), dtype)
        lengths = jnp.zeros(t, jnp.int32)
        peaks = jnp.zeros(splats.shape[0], dtype)
        medians = None
        if config.depth_median:
            medians = jnp.full((t, p), jnp.inf, dtype)
        empty = _Step(sums, lengths, peaks, medians, _no_tail(t, p, dtype))
        last = lax.fori_loop(0, chunks.steps, draw, empty)
        features, transmittance = last.sums[:, :-1], jnp.exp(last.sums[:, -1])
        return Composited(features, transmittance, last.lengths, last.peaks, last.medians)

    return forward


@functools.lru_cache
def backward_by_chunks(grid: TileGrid, config: SplatConfig) -> Callable[..., Array]:
    """Makes the same function as `backward_by_blocks`."""
    log_stop = _log_stop(config)

    @_joined_over_batch
    def backward(splats, items, starts, lengths, cotangents, totals):
        dtype, t, p = splats.dtype, lengths.shape[0], grid.pixels
        step = _chunks_per_step(grid, dtype, items.shape[0], t)
        chunks = cut(starts, lengths, items.shape[0], step)
        powers = jnp.asarray(_monomials(grid, dtype))

        def draw(i, handed):
            sums, faded_tail, seen_tail = handed
            # alpha and T of all pairs of this step, as in the forward pass
            c = _slice(chunks, i, step)
            item, row, centre, raw = _take_chunk(
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
            moments = _product(slopes.reshape(-1, p), powers).reshape(step, CHUNK, 6)
            features = _product(weights, jnp.moveaxis(g, 1, 2))
            rows = jnp.concatenate([_moments_about_splat(moments, *centre), features], axis=-1)
            # the list that runs on into the next step hands on its two sums
            sums = sums.at[item].add(rows, mode="drop")
            faded_tail = _tail(c.tiles, before, since + fading)
            seen_tail = _tail(c.tiles, seen_before, seen_since + gained)
            return sums, faded_tail, seen_tail

        sums, tail = jnp.zeros(splats.shape, dtype), _no_tail(t, p, dtype)
        return lax.fori_loop(0, chunks.steps, draw, (sums, tail, tail))[0]

    return backward


def _most_chunks(capacity: int, t: int) -> int:
    """Returns how many chunks t lists can have: full ones, and for each list one that is not."""
    return capacity // CHUNK + min(t, capacity)


def _chunks_per_step(grid: TileGrid, dtype: np.dtype | type, capacity: int, t: int) -> int:
    """Returns B: what `STEP_BYTES` and `STEP_CHUNKS` allow, and no more than there are chunks."""
    fitting = STEP_BYTES // (CHUNK * grid.pixels * np.dtype(dtype).itemsize)
    return max(1, min(fitting, STEP_CHUNKS, _most_chunks(capacity, t)))


def _log_stop(config: SplatConfig) -> float:
    """Returns the log T at which a pixel ends."""
    if config.transmittance_stop > 0:
        return math.log(config.transmittance_stop)
    return -math.inf


def _slice(chunks: Chunks, i: Array | int, step: int) -> Chunks:
    """Returns the chunks of step i."""
    parts = (lax.dynamic_slice_in_dim(v, i * step, step) for v in chunks[:-1])
    return Chunks(*parts, chunks.steps)


def _fading(raw: Array, config: SplatConfig) -> tuple[Array, Array]:
    """Returns alpha and log(1 - alpha), which is finite."""
    alpha = _visible_alpha(raw, config)
    # -1000 stands for log 0 where 1 - alpha_max rounds to 0: its exp is 0, 0 times it is no NaN
    return alpha, jnp.maximum(jnp.log1p(-alpha), -1e3)


def _sums_before(
    x: Float[Array, "b k p"], tiles: Int[Array, " b"], tail: _Tail
) -> tuple[Array, Array]:
    """Returns the sums of x (B, k, p) along its lists: of all that comes before each chunk, (B, p),
    and from there to the splat before each one, (B, k, p).
    """
    b, k, _ = x.shape
    triangle = jnp.broadcast_to(jnp.asarray(np.tri(k, k=-1), x.dtype), (b, k, k))
    since = lax.optimization_barrier(jnp.matmul(triangle, x, precision=EXACT))
    chunk = jnp.arange(b)
    earlier = (tiles[:, None] == tiles) & (chunk[:, None] > chunk)
    before = jnp.matmul(earlier.astype(x.dtype), since[:, -1] + x[:, -1], precision=EXACT)
    return before + jnp.where((tiles == tail.tile)[:, None], tail.sum, 0.0), since


def _tail(tiles: Array, before: Array, through: Array) -> _Tail:
    """Returns the sum of the step's last list: before its chunk, and through the chunk."""
    return _Tail(tiles[-1], before[-1] + through[-1, -1])


def _no_tail(t: int, p: int, dtype: np.dtype | type) -> _Tail:
    """Returns the tail that the first step gets: no list has its tile."""
    return _Tail(jnp.asarray(t, jnp.int32), jnp.zeros(p, dtype))
