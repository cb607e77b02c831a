"""Composites on CPUs, in small blocks of tiles. For symbols see `rendering.compositing`.

Tiles are ordered by list length, longest first, and taken in blocks of `config.block`. A block
takes its lists in chunks until, in every tile, the list or all pixels have ended. The arrays of a
chunk (block, chunk, pixels) stay in the cache. The chain of splats in a chunk is unrolled. The
forward pass has two chains, one for T and one for everything else, so that XLA makes ONE kernel of
each chain, which runs in registers. Once a pixel has ended, the loop carries -T, which keeps the
final T.

Compile with `core.processes.compiler_options`. Its options keep XLA from removing the optimization
barriers. They also keep XLA from dividing small kernels among threads, which would cost more than
it gains.
"""

import functools
from collections.abc import Callable, Iterator
from typing import NamedTuple

import jax.numpy as jnp
from jax import lax

from humangs_jax.core.array_types import Array, Bool, Float, Int
from humangs_jax.rendering.splat_config import SplatConfig
from humangs_jax.rendering.splat_rows import (
    FEATURES,
    HALF,
    Composited,
    Z,
    joined_over_batch,
    largest_weights,
    moments_about_splat,
    monomials,
    product,
    take_chunk,
    visible_alpha,
)
from humangs_jax.rendering.tiling import TileGrid, TileLists, blocks_by_length


class _Chain(NamedTuple):
    """The values that a block carries from one chunk of its lists to the next."""

    chunk: Array | int
    """Number of the chunk."""
    transmittance: Float[Array, "block p"]
    """T in front of the chunk, (block, p). It is -T once a pixel has ended."""
    features: Float[Array, "block n p"]
    """Sum of w f so far."""
    lengths: Int[Array, " block"]
    """Number of splats of each list that have been read."""
    live: Bool[Array, " block"]
    """Whether a list has splats left and some pixel of its tile has not ended."""
    peaks: Float[Array, " g"]
    """The largest w of each splat so far, in all blocks, (g,)."""
    medians: Float[Array, "block p"] | None
    """The smallest z, among the splats so far, behind which T is one half or less, (block, p). None
    unless `config.depth_median`.
    """


@functools.lru_cache
def forward_by_blocks(grid: TileGrid, config: SplatConfig) -> Callable[..., Composited]:
    """Returns the drawing function (splats, items, starts, counts) -> `Composited`. Tile t has the
    splats `items[starts[t] : starts[t] + counts[t]]`.
    """

    @joined_over_batch
    def forward(splats, items, starts, counts):
        t, p, dtype = counts.shape[0], grid.pixels, splats.dtype
        n = splats.shape[1] - FEATURES.start
        blocks = blocks_by_length(counts, config.block)

        def draw_block(b, drawn):
            tiles = lax.dynamic_slice_in_dim(blocks.tiles, b * config.block, config.block)
            lists = TileLists(items, *_lists_of(tiles, starts, counts))

            # every pixel of the block starts with T = 1 and no features
            ones = jnp.ones((config.block, p), dtype)
            zeros = jnp.zeros((config.block, n, p), dtype)
            medians = jnp.full_like(ones, jnp.inf) if config.depth_median else None
            unread = jnp.zeros_like(lists.counts)
            chain = _Chain(0, ones, zeros, unread, lists.counts > 0, drawn.peaks, medians)
            chain = lax.while_loop(
                lambda chain: jnp.any(chain.live),
                lambda chain: _draw_chunk(chain, splats, lists, tiles, grid, config),
                chain,
            )

            def placed(of_all, of_block):
                """Returns `of_all`, the values of all tiles, with the tiles of this block replaced
                by `of_block`. Padding tiles are dropped.
                """
                return of_all.at[tiles].set(of_block, mode="drop", unique_indices=True)

            final = jnp.abs(chain.transmittance)  # the sign marked pixels that had ended
            medians_of_tiles = None
            if config.depth_median:
                medians_of_tiles = placed(drawn.medians, chain.medians)
            return Composited(
                features=placed(drawn.features, chain.features),
                transmittance=placed(drawn.transmittance, final),
                lengths=placed(drawn.lengths, chain.lengths),
                peaks=chain.peaks,
                medians=medians_of_tiles,
            )

        empty = Composited(
            features=jnp.zeros((t, n, p), dtype),
            transmittance=jnp.ones((t, p), dtype),
            lengths=jnp.zeros(t, jnp.int32),
            peaks=jnp.zeros(splats.shape[0], dtype),
            medians=jnp.full((t, p), jnp.inf, dtype) if config.depth_median else None,
        )
        return lax.fori_loop(0, blocks.used, draw_block, empty)

    return forward


def _draw_chunk(
    chain: _Chain,
    splats: Float[Array, "g width"],
    lists: TileLists,
    tiles: Int[Array, " block"],
    grid: TileGrid,
    config: SplatConfig,
) -> _Chain:
    """Draws the next chunk of each list of a block. Returns the values for the chunk after it.

    lists: the lists of the block, one for each of its `tiles`.
    """
    i, k = chain.chunk, config.chunk
    item, row, _, raw = take_chunk(
        splats, lists.items, lists.starts + i * k, lists.counts - i * k, tiles, grid, k
    )
    # one exp a pair: without the barrier each kernel that uses it computes it again
    raw = lax.optimization_barrier(raw)
    alpha = lax.optimization_barrier(visible_alpha(raw, config))

    # the first chain: everything but T
    features, medians, weights = _blend(chain, row, alpha, config.transmittance_stop)
    peaks = chain.peaks
    if config.visibility:
        highest = largest_weights(jnp.concatenate(weights, axis=1), tiles, grid)
        peaks = peaks.at[item].max(highest, mode="drop")

    # the second chain: T
    transmittance = _fade(chain.transmittance, alpha, config.transmittance_stop)

    # how far the lists were read, and which of them go on
    lengths = jnp.where(chain.live, jnp.minimum((i + 1) * k, lists.counts), chain.lengths)
    live = (jnp.max(transmittance, axis=1) > 0) & ((i + 1) * k < lists.counts)
    return _Chain(i + 1, transmittance, features, lengths, live, peaks, medians)


def _blend(
    chain: _Chain, row: Float[Array, "block k width"], alpha: Float[Array, "block k p"], stop: float
) -> tuple[Array, Array | None, list[Array]]:
    """Blends the splats of a chunk, one after the other. Returns the features and the medians
    behind the chunk, as in `_Chain`, and the weight w of each splat, k arrays (block, 1, p).

    T is computed here and once more in `_fade`, because XLA then makes one kernel of each chain.
    """
    features, medians, weights = chain.features, chain.medians, []
    before = chain.transmittance[:, None]  # T in front of splat j; negative in pixels that ended
    for j in range(alpha.shape[1]):
        after = before * (1 - alpha[:, None, j])
        weight = jnp.where(after > stop, alpha[:, None, j] * before, 0.0)
        features = features + weight * row[:, j, FEATURES, None]
        weights.append(weight)
        before = after
        if medians is not None:
            reached = (weight[:, 0] > 0) & (after[:, 0] <= HALF)
            nearer = jnp.minimum(medians, row[:, j, Z, None])
            medians = jnp.where(reached, nearer, medians)
    return features, medians, weights


def _fade(
    transmittance: Float[Array, "block p"], alpha: Float[Array, "block k p"], stop: float
) -> Float[Array, "block p"]:
    """Returns T behind a chunk, (block, p). Where a pixel has ended, it is minus the final T.

    transmittance: T in front of the chunk, negative in the same way.
    """
    for j in range(alpha.shape[1]):
        after = transmittance * (1 - alpha[:, j])
        transmittance = jnp.where(after > stop, after, _ended(transmittance))
    return transmittance


def _ended(transmittance: Array) -> Array:
    """Returns -T for pixels that end here, with T > 0, or that have ended, with -T already."""
    return jnp.minimum(transmittance, -transmittance)


class _BackwardChain(NamedTuple):
    """The values that a block carries from one chunk of its lists to the next, in the backward
    pass.
    """

    chunk: Array | int
    """Number of the chunk."""
    transmittance: Float[Array, "block p"]
    """T in front of the chunk."""
    seen: Float[Array, "block p"]
    """Sum of w g . f so far."""
    sums: Float[Array, "g width"]
    """The sums for each splat that `backward_by_blocks` describes, over the chunks and blocks so
    far.
    """


@functools.lru_cache
def backward_by_blocks(grid: TileGrid, config: SplatConfig) -> Callable[..., Array]:
    """Returns the gradient function (splats, items, starts, lengths, g (t, n, p), Q (t, p)) -> sums
    over pixels for each splat, (g, 6 + n).

    The first six columns are the moments of e = dL/d log alpha about the splat's centre: 1, dx, dy,
    dx^2, dx dy, dy^2. The others are the gradient of the features, the sums of w g.
    """
    block, k, stop = config.block, config.chunk, config.transmittance_stop

    @joined_over_batch
    def backward(splats, items, starts, lengths, g_of_tiles, Q_of_tiles):
        dtype = splats.dtype
        powers = jnp.asarray(monomials(grid, dtype))
        blocks = blocks_by_length(lengths, block)

        def draw(b, sums):
            tile = lax.dynamic_slice_in_dim(blocks.tiles, b * block, block)
            start, count = _lists_of(tile, starts, lengths)
            g, Q = (v.at[tile].get(mode="fill", fill_value=0) for v in (g_of_tiles, Q_of_tiles))
            trips = (jnp.max(count) + k - 1) // k

            def body(chain):
                i, transmittance, seen, sums = chain
                item, row, centre, raw = take_chunk(
                    splats, items, start + i * k, count - i * k, tile, grid, k
                )
                # one exp a pair: without the barrier each kernel that uses it computes it again
                raw = lax.optimization_barrier(raw)
                # the chain of T front to back, with the decisions of the forward pass
                weights, e = [], []
                for j in range(k):
                    # a kernel runs the chain of two splats: what it computes for splat j redoes the
                    # chain from the last stored T on; storing T after every splat costs more
                    if j > 0 and j % 2 == 0:
                        transmittance, seen = lax.optimization_barrier((transmittance, seen))
                    alpha = visible_alpha(raw[:, j], config)
                    after = transmittance * (1 - alpha)
                    weight = jnp.where(after > stop, alpha * transmittance, 0.0)
                    g_dot_f = sum(
                        row[:, j, 6 + c, None] * g[:, c]
                        for c in range(splats.shape[1] - FEATURES.start)
                    )
                    seen = seen + weight * g_dot_f
                    dL_dalpha = g_dot_f * transmittance - (Q - seen) / (1 - alpha)
                    # e = dL/d log alpha, 0 where alpha was clamped or skipped
                    e_j = dL_dalpha * raw[:, j]
                    e.append(jnp.where((weight > 0) & (raw[:, j] < config.alpha_max), e_j, 0.0))
                    weights.append(weight)
                    transmittance = after
                weights, e = jnp.stack(weights, axis=1), jnp.stack(e, axis=1)
                # matrix products: XLA's row reductions are slow on CPUs
                moments = product(e.reshape(block * k, -1), powers).reshape(block, k, 6)
                feature_gradients = product(weights, jnp.moveaxis(g, 1, 2))
                moments = moments_about_splat(moments, *centre)
                rows = jnp.concatenate([moments, feature_gradients], axis=-1)
                following = i + 1
                sums = sums.at[item].add(rows, mode="drop")
                return _BackwardChain(following, transmittance, seen, sums)

            ones = jnp.ones((block, grid.pixels), dtype)
            chain = _BackwardChain(0, ones, jnp.zeros_like(ones), sums)
            return lax.while_loop(lambda chain: chain.chunk < trips, body, chain).sums

        return lax.fori_loop(0, blocks.used, draw, jnp.zeros(splats.shape, dtype))

    return backward


def _lists_of(tile: Array, starts: Array, counts: Array) -> Iterator[Array]:
    """Returns two arrays, the starts and the lengths of the lists of some tiles. Padding tiles get
    empty lists.
    """
    return (v.at[tile].get(mode="fill", fill_value=0) for v in (starts, counts))
