"""Composites on accelerators, in few large steps. For symbols see `rendering.compositing`.

On accelerators, a sequential step costs microseconds, however little it does. So every list is cut
into chunks of `CHUNK` splats. B chunks, from all lists of all images of a batch, are processed at
once as arrays (B, k, p), with k splats of a chunk and p pixels of a tile. Along a list only log T
accumulates, so the chain over the list becomes products:

    log T_j = (sum of the log(1 - alpha) before the chunk)
              + (strict lower triangle (k, k)) @ log(1 - alpha)

The sum before the chunk is a product, too, with the 0-1 matrix (B, B) that says "earlier chunk of
the same list". The first list of a step may continue from the step before. A step therefore hands
on the sum of its last list, and the next step adds it. The backward pass forms the sums over i <= j
of w_i g . f_i by the same two products.

The relative difference between this T and the T of the schedule for CPUs is about |log T| eps.
After a pixel has ended, rounding can lift its running log T above the stop again only where alpha
is 0. Such splats add nothing. Hence the final log T is the sum of log(1 - alpha) over the splats
before the stop. A NaN spreads to other tiles of its step. The values of a splat are summed by
scattering, so on a GPU the last bit may differ between runs.
"""

import functools
import math
from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import lax

from humangs_jax.core.array_types import Array, Float, Int
from humangs_jax.geometry.transform import EXACT
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
from humangs_jax.rendering.tiling import TileGrid, expand

CHUNK = 64
"""Number of splats of a list in one chunk. The triangular product costs 2 CHUNK flops per pair. On
average, half a chunk per list is padding.
"""
STEP_BYTES = 64 << 20
"""Largest size of one of the arrays (B, k, p) of a step, bytes. The backward pass holds five of
them.
"""
STEP_CHUNKS = 2048
"""Largest B, the number of chunks in a step. The product over earlier chunks costs 2 B / k flops
per pair. At this B that is half of what the triangular product costs.
"""


class Chunks(NamedTuple):
    """All lists cut into chunks of at most `CHUNK` splats, list by list. Unused chunks have count 0
    and the tile number t, which is the number of tiles.
    """

    tiles: Int[Array, " s"]
    """Tile of each chunk, (s,)."""
    starts: Int[Array, " s"]
    """Index of each chunk's first item in the array of items, (s,)."""
    counts: Int[Array, " s"]
    """Number of items in each chunk, (s,), 0 to `CHUNK`."""
    ends: Int[Array, " s"]
    """Number of items of the chunk's list up to the end of the chunk, (s,)."""
    steps: Int[Array, ""]
    """Number of steps of B chunks each that hold any item."""


def cut(starts: Int[Array, " t"], counts: Int[Array, " t"], capacity: int, step: int) -> Chunks:
    """Returns the chunks of lists, which together have at most `capacity` items. The number of
    chunks is a multiple of `step`.
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
    """A sum along a list that continues from one step into the next."""

    tile: Int[Array, ""]
    """Tile of the list."""
    sum: Float[Array, " p"]
    """Sum at the pixels of the tile so far."""


class _Step(NamedTuple):
    """The values that one step of the forward pass hands to the next."""

    sums: Float[Array, "t n+1 p"]
    """Sums of w f, and after them the sum of log(1 - alpha), which is the final log T, (t, n + 1,
    p).
    """
    lengths: Int[Array, " t"]
    """Number of splats of each list that have been read, (t,), as in `Composited`."""
    peaks: Float[Array, " g"]
    """The largest w of each splat so far, (g,), as in `Composited`."""
    medians: Float[Array, "t p"] | None
    """The smallest z, among the splats so far, behind which T is one half or less, (t, p), as in
    `Composited`. None unless `config.depth_median`.
    """
    tail: _Tail
    """Sum of log(1 - alpha) of the last list so far, which may continue in the next step."""


@functools.lru_cache
def forward_by_chunks(grid: TileGrid, config: SplatConfig) -> Callable[..., Composited]:
    """Returns the drawing function (splats, items, starts, counts) -> `Composited`, as
    `forward_by_blocks` does.
    """
    log_stop = _log_stop(config)

    @joined_over_batch
    def forward(splats, items, starts, counts):
        dtype, t, p = splats.dtype, counts.shape[0], grid.pixels
        step = _chunks_per_step(grid, dtype, items.shape[0], t)
        chunks = cut(starts, counts, items.shape[0], step)

        def draw(i, handed):
            sums, lengths, peaks, medians, tail = handed
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
    """Returns the gradient function (splats, items, starts, lengths, g, Q) -> sums over pixels for
    each splat, as `backward_by_blocks` does.
    """
    log_stop = _log_stop(config)

    @joined_over_batch
    def backward(splats, items, starts, lengths, g_of_tiles, Q_of_tiles):
        dtype, t, p = splats.dtype, lengths.shape[0], grid.pixels
        step = _chunks_per_step(grid, dtype, items.shape[0], t)
        chunks = cut(starts, lengths, items.shape[0], step)
        powers = jnp.asarray(monomials(grid, dtype))

        def draw(i, handed):
            sums, faded_tail, seen_tail = handed
            c = _slice(chunks, i, step)
            item, row, centre, raw = take_chunk(
                splats, items, c.starts, c.counts, c.tiles, grid, CHUNK
            )
            g, Q = (v.at[c.tiles].get(mode="fill", fill_value=0) for v in (g_of_tiles, Q_of_tiles))
            # alpha, T and w of all pairs of this step, as in the forward pass
            alpha, fading = _fading(raw, config)
            before, since = _sums_before(fading, c.tiles, faded_tail)
            transmittance = jnp.exp(before[:, None] + since)
            live = before[:, None] + since + fading > log_stop
            weights = jnp.where(live, alpha * transmittance, 0.0)
            # dL/dalpha of each pair; `behind` is Q - sum_{i <= k} w_i g . f_i
            g_dot_f = sum(
                row[..., FEATURES][..., f, None] * g[:, None, f]
                for f in range(splats.shape[1] - FEATURES.start)
            )
            w_g_dot_f = weights * g_dot_f
            seen_before, seen_since = _sums_before(w_g_dot_f, c.tiles, seen_tail)
            behind = Q[:, None] - (seen_before[:, None] + seen_since + w_g_dot_f)
            dL_dalpha = g_dot_f * transmittance - behind / (1 - alpha)
            # e = dL/d log alpha, 0 where alpha was clamped or skipped
            e = dL_dalpha * raw
            e = jnp.where((weights > 0) & (raw < config.alpha_max), e, 0.0)

            # sums over pixels: moments of e, moved from the tile's centre to the splat's, and w g
            moments = product(e.reshape(-1, p), powers).reshape(step, CHUNK, 6)
            feature_gradients = product(weights, jnp.moveaxis(g, 1, 2))
            moments = moments_about_splat(moments, *centre)
            rows = jnp.concatenate([moments, feature_gradients], axis=-1)
            sums = sums.at[item].add(rows, mode="drop")
            # the list that runs on into the next step hands on its two sums
            faded_tail = _tail(c.tiles, before, since + fading)
            seen_tail = _tail(c.tiles, seen_before, seen_since + w_g_dot_f)
            return sums, faded_tail, seen_tail

        sums, tail = jnp.zeros(splats.shape, dtype), _no_tail(t, p, dtype)
        return lax.fori_loop(0, chunks.steps, draw, (sums, tail, tail))[0]

    return backward


def _most_chunks(capacity: int, t: int) -> int:
    """Returns the largest number of chunks that t lists can have: full chunks, and for each list
    one that is not full. capacity: number of items of all lists.
    """
    return capacity // CHUNK + min(t, capacity)


def _chunks_per_step(grid: TileGrid, dtype: np.dtype | type, capacity: int, t: int) -> int:
    """Returns B, the number of chunks in a step. `STEP_BYTES`, `STEP_CHUNKS` and the number of
    chunks limit it.
    """
    fitting = STEP_BYTES // (CHUNK * grid.pixels * np.dtype(dtype).itemsize)
    return max(1, min(fitting, STEP_CHUNKS, _most_chunks(capacity, t)))


def _log_stop(config: SplatConfig) -> float:
    """Returns the logarithm of T at which a pixel ends, or minus infinity if pixels never end."""
    if config.transmittance_stop > 0:
        return math.log(config.transmittance_stop)
    return -math.inf


def _slice(chunks: Chunks, i: Array | int, step: int) -> Chunks:
    """Returns the chunks of step i. step: number of chunks in a step."""
    parts = (lax.dynamic_slice_in_dim(v, i * step, step) for v in chunks[:-1])
    return Chunks(*parts, chunks.steps)


def _fading(raw: Array, config: SplatConfig) -> tuple[Array, Array]:
    """Returns alpha and log(1 - alpha), both with the shape of `raw`. The logarithm is always
    finite.
    """
    alpha = visible_alpha(raw, config)
    # -1000 stands for log 0 where 1 - alpha_max rounds to 0: its exp is 0, 0 times it is no NaN
    return alpha, jnp.maximum(jnp.log1p(-alpha), -1e3)


def _sums_before(
    x: Float[Array, "b k p"], tiles: Int[Array, " b"], tail: _Tail
) -> tuple[Array, Array]:
    """Returns two sums of x (B, k, p) along its lists. The first, (B, p), is of everything before
    each chunk. The second, (B, k, p), is of everything before each splat within its chunk.

    tail: sum of the list that continues from the step before.
    """
    b, k, _ = x.shape
    triangle = jnp.broadcast_to(jnp.asarray(np.tri(k, k=-1), x.dtype), (b, k, k))
    since = lax.optimization_barrier(jnp.matmul(triangle, x, precision=EXACT))
    chunk = jnp.arange(b)
    earlier = (tiles[:, None] == tiles) & (chunk[:, None] > chunk)
    before = jnp.matmul(earlier.astype(x.dtype), since[:, -1] + x[:, -1], precision=EXACT)
    return before + jnp.where((tiles == tail.tile)[:, None], tail.sum, 0.0), since


def _tail(tiles: Array, before: Array, through: Array) -> _Tail:
    """Returns the tail of a step: the tile of its last list, and the list's sum up to the end of
    the step. tiles: tile of each chunk, (B,). before: sums before the chunks, (B, p). through: sums
    from the beginning of a chunk through each splat, (B, k, p).
    """
    return _Tail(tiles[-1], before[-1] + through[-1, -1])


def _no_tail(t: int, p: int, dtype: np.dtype | type) -> _Tail:
    """Returns the tail for the first step. Its tile number t belongs to no list."""
    return _Tail(jnp.asarray(t, jnp.int32), jnp.zeros(p, dtype))
