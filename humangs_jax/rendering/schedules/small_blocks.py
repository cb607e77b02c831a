"""Compositing in small blocks of tiles, the schedule for CPUs. The maths and its notation: `compositing`.

Tiles come by falling list length in blocks of `config.block` (`tiling.blocks_by_length`); a block takes its lists in
chunks until the longest list ends or all its pixels have. A chunk's arrays (block, chunk, pixels) stay in the cache, and
its chain of splats is unrolled, once for each thing that the loop carries: XLA makes of each ONE kernel that runs the
chain in registers. T only falls, so "T_k+1 > stop" needs no flag for stopped pixels; once a pixel has stopped, the
loop carries -T, which keeps the final T and marks the pixel as done.

The blocks are small because padding is what small lists cost: a block works as long as its longest list, and stops
early only when all its pixels are done. Compile with `core.compiling`: its kernels take microseconds, so
that sharing each out over threads costs more than it gains, and the barriers below have to be kept.
"""

import functools

import jax.numpy as jnp
from jax import lax

from humangs_jax.rendering.schedules.splat_rows import (
    FEATURE_COUNT,
    FEATURES,
    SPLAT_WIDTH,
    joined_over_batch,
    largest_weights,
    moments_about_splat,
    monomials,
    product,
    take_chunk,
    visible_alpha,
)
from humangs_jax.rendering.splat_config import SplatConfig
from humangs_jax.rendering.tiling import TileGrid, blocks_by_length

LINK = 2
"""Splats of a chunk whose chain one kernel of the backward pass runs. Its outputs for splat j redo the chain from the
last stored link on; storing T after every splat costs more than that."""


@functools.lru_cache
def forward(grid: TileGrid, config: SplatConfig):
    """(splats, items, starts, counts) -> features (t, 4, p), final T (t, p), used parts of the lists (t,), peaks (g,).

    peaks: largest w of each splat; 0 unless `config.visibility`.
    """
    block, k, stop = config.block, config.chunk, config.transmittance_stop

    @joined_over_batch
    def forward(splats, items, starts, counts):
        dtype, t = splats.dtype, counts.shape[0]
        blocks = blocks_by_length(counts, block)

        def draw(b, carry):
            *out, peaks = carry
            tile = lax.dynamic_slice_in_dim(blocks.tiles, b * block, block)
            start, count = _lists_of(tile, starts, counts)

            def body(carry):
                i, transmittance, features, lengths, live, peaks = carry
                item, row, _, raw = take_chunk(splats, items, start + i * k, count - i * k, tile, grid, k)
                alpha = lax.optimization_barrier(visible_alpha(raw, config))
                before, weights = transmittance[:, None], []
                for j in range(k):
                    after = before * (1 - alpha[:, None, j])
                    weight = jnp.where(after > stop, alpha[:, None, j] * before, 0.0)
                    features = features + weight * row[:, j, FEATURES, None]
                    weights.append(weight)
                    before = after
                if config.visibility:
                    highest = largest_weights(jnp.concatenate(weights, axis=1), tile, grid)
                    peaks = peaks.at[item].max(highest, mode="drop")
                for j in range(k):
                    after = transmittance * (1 - alpha[:, j])
                    transmittance = jnp.where(after > stop, after, jnp.minimum(transmittance, -transmittance))
                lengths = jnp.where(live, jnp.minimum((i + 1) * k, count), lengths)
                live = (jnp.max(transmittance, axis=1) > 0) & ((i + 1) * k < count)
                return i + 1, transmittance, features, lengths, live, peaks

            ones = jnp.ones((block, grid.pixels), dtype)
            zeros = jnp.zeros((block, FEATURE_COUNT, grid.pixels), dtype)
            carry = 0, ones, zeros, jnp.zeros_like(count), count > 0, peaks
            _, transmittance, features, lengths, _, peaks = lax.while_loop(lambda carry: jnp.any(carry[4]), body, carry)
            results = features, jnp.abs(transmittance), lengths
            drawn = (o.at[tile].set(r, mode="drop", unique_indices=True) for o, r in zip(out, results, strict=True))
            return *drawn, peaks

        out = (
            jnp.zeros((t, FEATURE_COUNT, grid.pixels), dtype),
            jnp.ones((t, grid.pixels), dtype),
            jnp.zeros(t, jnp.int32),
            jnp.zeros(splats.shape[0], dtype),
        )
        return lax.fori_loop(0, blocks.used, draw, out)

    return forward


@functools.lru_cache
def backward(grid: TileGrid, config: SplatConfig):
    """(splats, items, starts, lengths, g (t, 4, p), Q (t, p)) -> sums over pixels for each splat, (g, 10).

    They are those of e (1, dx, dy, dx^2, dx dy, dy^2), d from the splat's centre, and of w g.
    """
    block, k, stop = config.block, config.chunk_backward, config.transmittance_stop

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
                item, row, offset, raw = take_chunk(splats, items, start + i * k, count - i * k, tile, grid, k)
                weights, slopes = [], []
                for j in range(k):
                    if j > 0 and j % LINK == 0:
                        transmittance, seen = lax.optimization_barrier((transmittance, seen))
                    alpha = visible_alpha(raw[:, j], config)
                    after = transmittance * (1 - alpha)
                    weight = jnp.where(after > stop, alpha * transmittance, 0.0)
                    along = sum(row[:, j, 6 + c, None] * g[:, c] for c in range(FEATURE_COUNT))
                    seen = seen + weight * along
                    slope = (along * transmittance - (total - seen) / (1 - alpha)) * raw[:, j]
                    slopes.append(jnp.where((weight > 0) & (raw[:, j] < config.alpha_max), slope, 0.0))
                    weights.append(weight)
                    transmittance = after
                weights, slopes = jnp.stack(weights, axis=1), jnp.stack(slopes, axis=1)
                # matrix products: XLA's row reductions are slow on CPUs
                moments = product(slopes.reshape(block * k, -1), powers, config).reshape(block, k, 6)
                features = product(weights, jnp.moveaxis(g, 1, 2), config)
                rows = jnp.concatenate([moments_about_splat(moments, *offset), features], axis=-1)
                return i + 1, transmittance, seen, sums.at[item].add(rows, mode="drop")

            ones = jnp.ones((block, grid.pixels), dtype)
            carry = 0, ones, jnp.zeros_like(ones), sums
            return lax.while_loop(lambda carry: carry[0] < trips, body, carry)[3]

        return lax.fori_loop(0, blocks.used, draw, jnp.zeros((splats.shape[0], SPLAT_WIDTH), dtype))

    return backward


def _lists_of(tile, starts, counts):
    """First item and length of the lists of a block; its padding has none."""
    return (v.at[tile].get(mode="fill", fill_value=0) for v in (starts, counts))
