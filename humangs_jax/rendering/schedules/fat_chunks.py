"""Compositing in few fat steps, the schedule for accelerators (GPU, TPU). The maths and its notation: `compositing`.

There a sequential step costs microseconds however little it does, so nothing may be sequential along a list. Every list
is cut into chunks of `CHUNK` splats, and the chunks of ALL lists of all images of a batch, B of them at once, become
arrays (B, k, p) (p pixels of a tile). Nothing is padded to the longest list, empty tiles
have no chunk, and the number of steps is that of chunks / B: it does not depend on how long the longest list is.

The chain over a list becomes products, because along it only log T accumulates:

    log T_j = (sum of the log(1 - alpha) before the chunk) + (strict lower triangle (k, k)) @ log(1 - alpha)

and the sum before the chunk is likewise one product, with the 0-1 matrix (B, B) of "earlier chunk of the same list",
plus what the list that runs on from the step before has come to: that vector (p,) is all that steps hand on. In the
backward pass the sums over i <= j of w_i g . f_i are formed by the same two products.

Exactness. The alphas are computed as by the other schedule, so the same are skipped and clamped; T comes from sums of
log1p(-alpha) instead of products of 1 - alpha, which agrees to |log T| eps: a pixel's stop may differ
only within that. (Measured on person scenes in float32 against float64: no less exact than the products.) The exponent
is not a product of six coefficients with six monomials of the pixels, because the elementwise sum of squares is fused
into exp at no traffic, where a product has to write (B, k, p) first; because it cannot become positive; and because it
does not cancel: with the six monomials T is off by up to 2e-4 of itself on these scenes, without them by 6e-6. (For long
needles both are bounded by the rounding of u at the tile's centre, 1e-3 at 1,000 pixels from the splat's.) Stopped
pixels need no memory of it: past the stop log T can rise by rounding only while alpha is 0, which counts for nothing;
hence the final log T sums log(1 - alpha) over the splats before the stop, instead of picking a value. A NaN spreads to
other tiles of its step through the products with zeros.

Cost, as XLA compiles it for an H100 (counted, not timed): a step is 21 kernels forward and 29 backward, reading or
writing an array (B, k, p) 8 and 17 times. Per pair of a splat and a pixel of its tile: one exp, then a log and an exp;
products of 2 k + 2 B / k flops forward, twice that backward. The last chunk of a list is padded: 3 to 20 % more pairs. A
person of 52,375 Gaussians takes 3 steps at 512 x 512, its lists up to 5,000 splats long (5,653 chunks, 23 million
pairs, 0.8 and 1.7 GB at a tile size of 8; 2,687, 44 million, 1.6 and 3.4 GB at 16) and 6 to 8 at 1024 x 1024.

Sums over lists and over splats are scatter-adds: on a GPU their order, hence the last bit, may differ between runs.
"""

import functools
import math
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import lax

from humangs_jax.core.array_types import Array, Int
from humangs_jax.rendering.schedules.splat_rows import (
    EXACT,
    FEATURE_COUNT,
    FEATURES,
    SPLAT_WIDTH,
    joined_over_batch,
    largest_weights,
    moments_about_splat,
    monomials,
    product,
    raw_alpha,
    take_rows,
    visible_alpha,
)
from humangs_jax.rendering.splat_config import SplatConfig
from humangs_jax.rendering.tiling import TileGrid, expand

CHUNK = 64
"""Splats of a list in one chunk. The triangular product costs 2 CHUNK flops per pair; half a chunk per list is padding."""

STEP_BYTES = 64 << 20
"""Largest size of one of the arrays (B, k, p) of a step; the backward pass holds five of them."""

STEP_CHUNKS = 2048
"""Largest B: the product over earlier chunks costs 2 B / k flops per pair, half of the triangular one at this B."""

_LOG_ZERO = -1e3
"""Stands for log 0 where 1 - alpha_max rounds to 0: its exp is 0, and its product with 0 is 0 and not NaN."""


class Chunks(NamedTuple):
    """All lists cut into chunks of at most `CHUNK`, list by list; chunks that are not needed have tile t and count 0.

    tiles, starts, counts: of each chunk. ends: how far into its list it reaches. steps: of B chunks that hold any.
    """

    tiles: Int[Array, " s"]
    starts: Int[Array, " s"]
    counts: Int[Array, " s"]
    ends: Int[Array, " s"]
    steps: Int[Array, ""]


def cut(starts: Int[Array, " t"], counts: Int[Array, " t"], capacity: int, step: int) -> Chunks:
    """Cuts lists, of `capacity` items at most together, into chunks; their number is a multiple of `step`."""
    t = counts.shape[0]
    most = _most_chunks(capacity, t)
    slots = expand((counts + CHUNK - 1) // CHUNK, -(-most // step) * step)
    slot = jnp.arange(slots.source.shape[0], dtype=jnp.int32)
    tile = jnp.where(slot < slots.needed, slots.source, t)
    skipped = (slot - slots.first[slots.source]) * CHUNK
    start, count = (v.at[tile].get(mode="fill", fill_value=0) for v in (starts, counts))
    inside = jnp.clip(count - skipped, 0, CHUNK)
    return Chunks(tile, start + skipped, inside, skipped + inside, (slots.needed + step - 1) // step)


@functools.lru_cache
def forward(grid: TileGrid, config: SplatConfig):
    """(splats, items, starts, counts) -> features (t, 4, p), final T (t, p), used parts of the lists (t,), peaks (g,).

    peaks: largest w of each splat; 0 unless `config.visibility`.
    """
    log_stop = _log_stop(config)

    @joined_over_batch
    def forward(splats, items, starts, counts):
        dtype, t, p = splats.dtype, counts.shape[0], grid.pixels
        step = _chunks_per_step(grid, dtype, items.shape[0], t)
        chunks = cut(starts, counts, items.shape[0], step)

        def draw(i, carry):
            sums, lengths, peaks, tail = carry
            c = _slice(chunks, i, step)
            item, row, _, raw = _take(splats, items, c, grid)
            alpha, fading = _fading(raw, config)
            before, since = _sums_before(fading, c.tiles, tail)
            live = before[:, None] + since + fading > log_stop
            weights = jnp.where(live, alpha * jnp.exp(before[:, None] + since), 0.0)
            features = [jnp.sum(weights * row[..., f, None], axis=1) for f in range(FEATURES.start, FEATURES.stop)]
            parts = jnp.stack([*features, jnp.sum(jnp.where(live, fading, 0.0), axis=1)], axis=1)
            sums = sums.at[c.tiles].add(parts, mode="drop", indices_are_sorted=True)
            reached = jnp.where(jnp.max(before, axis=1) > log_stop, c.ends, 0)
            lengths = lengths.at[c.tiles].max(reached, mode="drop", indices_are_sorted=True)
            if config.visibility:
                peaks = peaks.at[item].max(largest_weights(weights, c.tiles, grid), mode="drop")
            return sums, lengths, peaks, _tail(c.tiles, before, since + fading)

        sums, lengths = jnp.zeros((t, FEATURE_COUNT + 1, p), dtype), jnp.zeros(t, jnp.int32)
        carry = sums, lengths, jnp.zeros(splats.shape[0], dtype), _no_tail(t, p, dtype)
        sums, lengths, peaks, _ = lax.fori_loop(0, chunks.steps, draw, carry)
        return sums[:, :FEATURE_COUNT], jnp.exp(sums[:, FEATURE_COUNT]), lengths, peaks

    return forward


@functools.lru_cache
def backward(grid: TileGrid, config: SplatConfig):
    """(splats, items, starts, lengths, g (t, 4, p), Q (t, p)) -> sums over pixels for each splat, (g, 10).

    They are those of e (1, dx, dy, dx^2, dx dy, dy^2), d from the splat's centre, and of w g.
    """
    log_stop = _log_stop(config)

    @joined_over_batch
    def backward(splats, items, starts, lengths, cotangents, totals):
        dtype, t, p = splats.dtype, lengths.shape[0], grid.pixels
        step = _chunks_per_step(grid, dtype, items.shape[0], t)
        chunks = cut(starts, lengths, items.shape[0], step)
        powers = jnp.asarray(monomials(grid, dtype))

        def draw(i, carry):
            sums, faded_tail, seen_tail = carry
            c = _slice(chunks, i, step)
            item, row, centre, raw = _take(splats, items, c, grid)
            g, total = (v.at[c.tiles].get(mode="fill", fill_value=0) for v in (cotangents, totals))
            alpha, fading = _fading(raw, config)
            before, since = _sums_before(fading, c.tiles, faded_tail)
            transmittance = jnp.exp(before[:, None] + since)
            live = before[:, None] + since + fading > log_stop
            weights = jnp.where(live, alpha * transmittance, 0.0)
            along = sum(row[..., FEATURES][..., f, None] * g[:, None, f] for f in range(FEATURE_COUNT))
            gained = weights * along
            seen_before, seen_since = _sums_before(gained, c.tiles, seen_tail)
            behind = total[:, None] - (seen_before[:, None] + seen_since + gained)
            slopes = (along * transmittance - behind / (1 - alpha)) * raw
            slopes = jnp.where((weights > 0) & (raw < config.alpha_max), slopes, 0.0)

            moments = product(slopes.reshape(-1, p), powers, config).reshape(step, CHUNK, 6)
            features = product(weights, jnp.moveaxis(g, 1, 2), config)
            rows = jnp.concatenate([moments_about_splat(moments, *centre), features], axis=-1)
            tails = (
                _tail(c.tiles, b, s + own) for b, s, own in ((before, since, fading), (seen_before, seen_since, gained))
            )
            return sums.at[item].add(rows, mode="drop"), *tails

        sums, tail = jnp.zeros((splats.shape[0], SPLAT_WIDTH), dtype), _no_tail(t, p, dtype)
        return lax.fori_loop(0, chunks.steps, draw, (sums, tail, tail))[0]

    return backward


def _most_chunks(capacity, t):
    """Full chunks, and for each list one that is not."""
    return capacity // CHUNK + min(t, capacity)


def _chunks_per_step(grid, dtype, capacity, t):
    fitting = STEP_BYTES // (CHUNK * grid.pixels * np.dtype(dtype).itemsize)
    return max(1, min(fitting, STEP_CHUNKS, _most_chunks(capacity, t)))


def _log_stop(config):
    return math.log(config.transmittance_stop) if config.transmittance_stop > 0 else -math.inf


def _slice(chunks, i, step):
    parts = (lax.dynamic_slice_in_dim(v, i * step, step) for v in chunks[:-1])
    return Chunks(*parts, chunks.steps)


def _take(splats, items, c, grid):
    """Of each chunk: the numbers, rows and centres of its splats, and raw alphas, which XLA fuses where it likes."""
    item, row, centre = take_rows(splats, items, c.starts, c.counts, c.tiles, grid, CHUNK)
    inside = jnp.arange(CHUNK, dtype=jnp.int32) < c.counts[:, None]
    return item, row, centre, raw_alpha(row, centre, inside, grid)


def _fading(raw, config):
    """alpha and log(1 - alpha)."""
    alpha = visible_alpha(raw, config)
    return alpha, jnp.maximum(jnp.log1p(-alpha), _LOG_ZERO)


def _sums_before(x, tiles, tail):
    """Sums of x (B, k, p) along its lists: of what comes before each chunk (B, p), and from there to each splat."""
    b, k, _ = x.shape
    triangle = jnp.broadcast_to(jnp.asarray(np.tri(k, k=-1), x.dtype), (b, k, k))
    since = lax.optimization_barrier(jnp.matmul(triangle, x, precision=EXACT))
    chunk = jnp.arange(b)
    earlier = (tiles[:, None] == tiles) & (chunk[:, None] > chunk)
    before = jnp.matmul(earlier.astype(x.dtype), since[:, -1] + x[:, -1], precision=EXACT)
    tail_tile, tail_sum = tail
    return before + jnp.where((tiles == tail_tile)[:, None], tail_sum, 0.0), since


def _tail(tiles, before, through):
    """The list that the last chunk belongs to, and its sum up to there."""
    return tiles[-1], before[-1] + through[-1, -1]


def _no_tail(t, p, dtype):
    return jnp.asarray(t, jnp.int32), jnp.zeros(p, dtype)
