"""The accelerator's schedule of compositing against the CPU's.

Lists are the renderer's own and made-up ones.
"""

from unittest import mock

import jax
import jax.export
import jax.numpy as jnp
import numpy as np
import pytest
from compositing_rounding import analyse
from hypothesis import given
from hypothesis import strategies as st

from humangs_jax.rendering import compositing_on_accelerators as accelerators
from humangs_jax.rendering import compositing_on_cpu as cpu
from humangs_jax.rendering.splat_config import SplatConfig
from humangs_jax.rendering.tiling import TileGrid, TileLists

EXACT = 1e-10
"""Largest float64 error, relative to the largest entry.

In float32 each entry has its bound, see compositing_rounding.py.
"""

K = accelerators.CHUNK
GRID = TileGrid(21, 13, 8)  # six tiles
LENGTHS = (0, 3 * K + 5, K, K + 1, 2 * K - 1, 1)
SPLATS, CAPACITY = 4 * K, 6 * 4 * K
THIN = cpu.forward_by_blocks, cpu.backward_by_blocks
FAT = accelerators.forward_by_chunks, accelerators.backward_by_chunks
PER_STEP = 3
"""Chunks in a step: lists continue from step to step, and the last step has padding."""


def by_hand(seed, lengths, dtype, grid=GRID, opacities=(0.05, 1.0)):
    """Returns (splats around the first tiles, lists in depth order of these `lengths`)."""
    rng, tile = np.random.default_rng(seed), grid.tile_size
    xy = rng.uniform(-0.6, 3.1, (SPLATS, 2)) * tile
    shape = rng.uniform([0.16, -0.8, 0.16], 0.8, (SPLATS, 3)) / tile
    log_opacity = np.log(rng.uniform(*opacities, (SPLATS, 1)))
    log_opacity[::50] = 0  # alpha is clamped
    splats = np.concatenate([xy, shape, log_opacity, rng.uniform(size=(SPLATS, 4))], axis=-1)
    items = np.concatenate([np.sort(rng.choice(SPLATS, n, replace=False)) for n in lengths])
    items = np.pad(items, (0, CAPACITY - len(items)), constant_values=3)
    counts = np.asarray(lengths)
    lists = TileLists(
        *(jnp.asarray(a, jnp.int32) for a in (items, np.cumsum(counts) - counts, counts))
    )
    return jnp.asarray(splats, dtype), lists


def cotangents(grid, dtype):
    rng = np.random.default_rng(5)
    shapes = (grid.tiles, 4, grid.pixels), (grid.tiles, grid.pixels)
    return [jnp.asarray(rng.normal(size=shape).astype(np.float32), dtype) for shape in shapes]


def schedule(functions, splats, lists, grid=GRID, config=None, per_step=1024):
    """Returns everything that a schedule computes, for a random cotangent."""
    config = config or SplatConfig(tile_size=grid.tile_size, block=4, chunk=4, visibility=True)
    forward, backward = functions
    with mock.patch.object(accelerators, "STEP_CHUNKS", per_step):
        features, transmittance, lengths, peaks, _ = forward(grid, config)(splats, *lists)
        g, g_transmittance = cotangents(grid, splats.dtype)
        total = jnp.sum(g * features, axis=1) + g_transmittance * transmittance
        sums = backward(grid, config)(splats, lists.items, lists.starts, lengths, g, total)
    return features, transmittance, sums, peaks, lengths


run = jax.jit(schedule, static_argnums=(0, 3, 4, 5))


def assert_equal(ours, expected, counts, tolerance=EXACT):
    """Compares channels, and columns of the sums, each relative to its size."""
    for name, a, b in zip(
        ("features", "transmittance", "sums", "peaks"), ours, expected, strict=False
    ):
        assert a.dtype == b.dtype and a.shape == b.shape
        axes = (0, 2) if name == "features" else 0
        error = np.abs(np.asarray(a) - b).max(axis=axes) / np.maximum(
            np.abs(b).max(axis=axes), 1e-30
        )
        assert (error <= tolerance).all(), (name, error)
    assert_lengths(ours[-1], expected[-1], counts)


def assert_lengths(ours, expected, counts):
    """Compares the used lengths of lists, in whole chunks: this schedule's are the larger ones."""
    used, needed = np.asarray(ours), np.asarray(expected)
    assert (needed <= used).all() and (used < needed + K).all() and (used <= counts).all()


def assert_rounded(found, exact):
    """Checks float32 results against the bounds of their float64 analysis."""
    # no alpha at its threshold, no pixel at its stop: float32 decides as float64
    assert exact.decided
    for name, a, b, most in zip(
        ("features", "transmittance", "sums", "peaks"), found, exact, exact.bounds, strict=False
    ):
        assert a.dtype == np.float32 and a.shape == b.shape
        excess = np.abs(np.asarray(a, np.float64) - b) / np.maximum(most, 1e-30)
        assert (excess <= 1).all(), (name, excess.max())


def assert_equal_in_float32(splats, lists, grid, config, per_step=1024):
    """Compares each schedule with the same numbers in float64, entry by entry.

    Errors of up to 0.2 of the images' bounds were measured, and 0.04 of those of the sums, whose
    first columns cancel. A wrong formula would show in float64, to 1e-10.
    """
    ours, expected = (
        run(FAT, splats, lists, grid, config, per_step),
        run(THIN, splats, lists, grid, config),
    )
    g = [np.asarray(a, np.float64) for a in cotangents(grid, np.float32)]
    config = config or SplatConfig(visibility=True)
    exact = analyse(np.asarray(splats, np.float64), lists, grid, config, *g)
    for found in (ours, expected):
        assert_rounded(found, exact)
    assert_lengths(ours[-1], expected[-1], lists.counts)
    # so tight that a wrong decision, 4e-3, would show
    for values, most in zip(exact[:2], exact.bounds, strict=False):
        assert np.median(most[values != 0] / values[values != 0]) < 1e-4
    return ours, expected


@pytest.mark.slow
@pytest.mark.parametrize(
    ("dtype", "tile_size", "per_step"),
    [(np.float64, 8, 1024), (np.float64, 16, PER_STEP), (np.float32, 16, 1024)],
)
def test_equals_the_other_schedule(dtype, tile_size, per_step):
    with jax.enable_x64(dtype == np.float64):
        grid = TileGrid(6 * tile_size, tile_size, tile_size)
        splats, lists = by_hand(1, LENGTHS, dtype, grid, opacities=(0.02, 0.3))
        if dtype == np.float32:
            ours, expected = assert_equal_in_float32(splats, lists, grid, None, per_step)
        else:
            ours, expected = (
                run(FAT, splats, lists, grid, None, per_step),
                run(THIN, splats, lists, grid),
            )
            assert_equal(ours, expected, lists.counts)
        ended = np.asarray(expected[-1])
        # the whole tile ends inside a chunk that is not its first
        assert K < ended[1] < 3 * K and ended[1] % K != 0
        assert not ours[0][0].any() and (ours[1][0] == 1).all()  # the empty list


@pytest.mark.slow
@given(
    seed=st.integers(0, 2**16),
    lengths=st.lists(
        st.sampled_from([0, 1, K - 1, K, K + 1, 2 * K, 3 * K + 7, 4 * K]), min_size=6, max_size=6
    ),
    faint=st.booleans(),
)
def test_equals_the_other_schedule_on_any_lists(seed, lengths, faint):
    with jax.enable_x64(True):
        splats, lists = by_hand(
            seed, lengths, np.float64, opacities=(0.004, 0.02) if faint else (0.05, 1.0)
        )
        ours, expected = run(FAT, splats, lists, GRID, None, PER_STEP), run(THIN, splats, lists)
        assert_equal(ours, expected, lists.counts)


@pytest.mark.slow
def test_a_batch_is_one_call():
    with jax.enable_x64(True):
        batch = [
            by_hand(seed, lengths, np.float64)
            for seed, lengths in ((1, LENGTHS), (2, LENGTHS[::-1]))
        ]
        splats, lists = jax.tree.map(lambda *leaves: jnp.stack(leaves), *batch)
        together = jax.jit(jax.vmap(lambda s, l: schedule(FAT, s, l, per_step=PER_STEP)))(
            splats, lists
        )
        for i, (splats, lists) in enumerate(batch):
            expected = run(THIN, splats, lists)
            assert_equal([o[i] for o in together], expected, lists.counts)


@pytest.mark.slow
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("stop", [0.0, 1e-4])
def test_opaque_to_the_last_bit(dtype, stop):
    """1 - alpha_max is 0 in float32; its logarithm must not make a NaN elsewhere."""
    with jax.enable_x64(dtype == np.float64):
        config = SplatConfig(alpha_max=1 - 1e-9, transmittance_stop=stop, visibility=True)
        splats, lists = by_hand(3, LENGTHS, dtype, opacities=(0.9, 1.0))
        ours = run(FAT, splats, lists, GRID, config)
        assert all(np.isfinite(a).all() for a in ours)
        if stop > 0 and dtype == np.float32:
            assert_equal_in_float32(splats, lists, GRID, config)
        elif stop > 0:
            assert_equal(ours, run(THIN, splats, lists, GRID, config), lists.counts)


@given(st.lists(st.integers(0, 3 * K), min_size=5, max_size=5), st.integers(0, 100))
def test_chunks_cover_the_lists(counts, gap):
    starts = np.cumsum([gap, *counts[:-1]])
    capacity = 15 * K + 100
    chunks = cut(jnp.asarray(starts, jnp.int32), jnp.asarray(counts, jnp.int32), capacity, 4)
    expected = [
        (t, starts[t] + first, min(K, counts[t] - first), min(first + K, counts[t]))
        for t in range(5)
        for first in range(0, counts[t], K)
    ]
    n = len(expected)
    assert len(chunks.tiles) % 4 == 0 and chunks.steps == -(-n // 4) <= len(chunks.tiles) // 4
    np.testing.assert_array_equal(np.stack(chunks[:4], axis=-1)[:n], np.reshape(expected, (n, 4)))
    assert (chunks.tiles[n:] == 5).all() and not chunks.counts[n:].any()


cut = jax.jit(accelerators.cut, static_argnums=(2, 3))


def test_steps_are_bounded_in_memory():
    for tile_size, dtype in ((8, np.float32), (16, np.float32), (32, np.float32), (16, np.float64)):
        b = accelerators._chunks_per_step(TileGrid(512, 512, tile_size), dtype, 1 << 20, 1024)
        assert 1 <= b <= accelerators.STEP_CHUNKS
        assert b * K * tile_size**2 * np.dtype(dtype).itemsize <= accelerators.STEP_BYTES
    # no more than there can be
    assert accelerators._chunks_per_step(GRID, np.float32, 2 * K, 6) == 8


@pytest.mark.parametrize("platform", ["cuda", "tpu"])
def test_lowers_for(platform):
    splats, lists = by_hand(1, LENGTHS, np.float32)
    exported = jax.export.export(jax.jit(lambda s, l: schedule(FAT, s, l)), platforms=[platform])(
        splats, lists
    )
    assert exported.platforms == (platform,)
