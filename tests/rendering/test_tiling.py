"""Tile lists against plain numpy: the same pairs in the same order, with either kind of key.

Pairs of splats are checked by brute force as well: the least d^T cov^-1 d over the rectangle of
pixel centres of every tile.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from splat_scenes import HEIGHT, WIDTH, camera, random_gaussians, tile_centers

from humangs_jax.rendering import tiling
from humangs_jax.rendering.projection import project_gaussians as project
from humangs_jax.rendering.tiling import TileGrid

FEW = settings(max_examples=10, deadline=None)


@pytest.mark.slow
@pytest.mark.parametrize("n", [1, 2, 63, 64, 65, 1000, 70_000])
def test_cumsum_is_exact(n):
    x = np.random.default_rng(n).integers(0, min(1 << 18, (1 << 30) // n), n).astype(np.int32)
    np.testing.assert_array_equal(tiling.cumsum(jnp.asarray(x)), np.cumsum(x))


@pytest.mark.slow
def test_cumsum_saturates_instead_of_wrapping():
    x = np.full(40_000, (1 << 18) - 1, np.int32)  # 1e10 in all
    np.testing.assert_array_equal(
        tiling.cumsum(jnp.asarray(x)), np.minimum(np.cumsum(x, dtype=np.int64), tiling.SUM_LIMIT)
    )


@pytest.mark.slow
@FEW
@given(st.lists(st.integers(0, 5), min_size=40, max_size=40), st.sampled_from([1, 60, 250]))
def test_expand_equals_repeat(counts, capacity):
    counts = np.asarray(counts, np.int32)
    expansion = tiling.expand(jnp.asarray(counts), capacity)
    expected = np.repeat(np.arange(len(counts)), counts)[:capacity]
    np.testing.assert_array_equal(expansion.source[: len(expected)], expected)
    np.testing.assert_array_equal(expansion.first, np.cumsum(counts) - counts)
    assert expansion.needed == counts.sum()  # exact, whatever the capacity


@pytest.mark.parametrize("item_count", [50, 1 << 30])  # packed into one uint32; two keys
def test_lists_hold_the_pairs_of_each_tile_in_order(item_count):
    rng, tile_count = np.random.default_rng(0), 12
    items = np.sort(rng.choice(item_count, 200)).astype(np.int32)
    tiles = rng.integers(0, tile_count + 1, 200).astype(np.int32)  # tile_count: no tile
    order = rng.permutation(200)
    lists = tiling.sort_into_tiles(
        jnp.asarray(tiles[order]), jnp.asarray(items[order]), tile_count, item_count
    )
    for tile in range(tile_count):
        start, count = int(lists.starts[tile]), int(lists.counts[tile])
        np.testing.assert_array_equal(lists.items[start : start + count], items[tiles == tile])


def test_packed_key_of_full_width_keeps_the_pairs_of_no_tile_last():
    tile_count, item_count = (1 << 16) - 1, 1 << 16  # (tile_count + 1) << 16 is exactly 2^32
    tiles = jnp.asarray([tile_count, tile_count - 1, 0, tile_count - 1], jnp.int32)
    items = jnp.asarray([item_count - 1, item_count - 1, 7, 3], jnp.int32)
    lists = tiling.sort_into_tiles(tiles, items, tile_count, item_count)
    np.testing.assert_array_equal(lists.items[:3], [7, 3, item_count - 1])
    assert lists.starts[tile_count - 1] == 1 and lists.counts[tile_count - 1] == 2


@FEW
@given(st.lists(st.integers(0, 9), min_size=30, max_size=30), st.sampled_from([1, 7, 8]))
def test_blocks_come_by_falling_length_and_skip_empty_tiles(counts, block):
    counts = np.asarray(counts, np.int32)
    blocks = tiling.blocks_by_length(jnp.asarray(counts), block)
    tiles = np.asarray(blocks.tiles)
    assert len(tiles) % block == 0
    np.testing.assert_array_equal(np.sort(tiles)[: len(counts)], np.arange(len(counts)))
    assert (tiles[len(counts) :] == len(counts)).all()
    assert (np.diff(counts[tiles[: len(counts)]]) <= 0).all()
    visited = tiles[: int(blocks.used) * block]
    assert set(np.flatnonzero(counts)) <= set(visited)
    assert int(blocks.used) == -(-np.count_nonzero(counts) // block)


@pytest.mark.parametrize(
    ("width", "height", "tile_size"), [(16, 8, 8), (13, 21, 8), (1, 1, 8), (5, 3, 1), (7, 30, 16)]
)
def test_pixel_positions_are_those_of_the_image(width, height, tile_size):
    grid = TileGrid(width, height, tile_size)
    y, x = np.mgrid[:height, :width] + 0.5
    tiles = tile_centers(grid)[:, :, None] + grid.offsets()
    np.testing.assert_array_equal(
        tiling.tiles_to_image(jnp.asarray(tiles), grid), np.stack([x, y], axis=-1)
    )


GRID = TileGrid(WIDTH, HEIGHT, 4)
SAMPLES = 400
"""Points along each side of a rectangle in the search by brute force."""


@jax.jit
def ellipses(gaussians):
    return tiling.footprints(
        project(gaussians, camera(np.float32)), tiling.squared_reach(gaussians.opacities)
    )


@functools.partial(jax.jit, static_argnums=(1, 2))
def emit(footprints, max_rows, max_pairs):
    return tiling.emit_pairs(footprints, GRID, max_rows, max_pairs)


@functools.partial(jax.jit, static_argnums=1)
def count(footprints, grid):
    return tiling.count_pairs(footprints, grid)


def least_distance(e, i, tile):
    """Returns the least d^T cov^-1 d over a tile's rectangle.

    It is 0 if the centre is inside, and else on the border.
    """
    cov = np.asarray([[e.xx[i], e.xy[i]], [e.xy[i], e.yy[i]]], np.float64)
    low = np.asarray([tile % GRID.columns, tile // GRID.columns]) * GRID.tile_size + 0.5
    high = low + GRID.tile_size - 1
    center = np.asarray([e.x[i], e.y[i]], np.float64)
    if (low <= center).all() and (center <= high).all():
        return 0.0
    s = np.linspace(0, 1, SAMPLES)[:, None]
    corners = [low, np.asarray([high[0], low[1]]), high, np.asarray([low[0], high[1]])]
    border = np.concatenate(
        [a + s * (b - a) for a, b in zip(corners, [*corners[1:], corners[0]], strict=True)]
    )
    d = border - center
    return np.einsum("ni,ij,nj->n", d, np.linalg.inv(cov), d).min()


@pytest.mark.parametrize("seed", [0, 1])
def test_pairs_are_those_whose_ellipse_meets_the_tile(seed):
    e = jax.tree.map(np.asarray, ellipses(random_gaussians(seed, np.float32)))
    pairs = emit(e, 1024, 2048)
    used = np.asarray(pairs.tiles) < GRID.tiles
    emitted = set(
        zip(
            np.asarray(pairs.tiles)[used].tolist(),
            np.asarray(pairs.splats)[used].tolist(),
            strict=True,
        )
    )
    assert len(emitted) == used.sum() == int(pairs.needed) and pairs.overflow == 0
    close = 0.02  # sampling of the border, and the slack
    for i in np.flatnonzero(e.reach > 0):
        for tile in range(GRID.tiles):
            ratio = least_distance(e, i, tile) / e.reach[i]
            if abs(ratio - 1) > close:
                assert ((tile, i) in emitted) == (ratio < 1), (i, tile, ratio)
    assert not {i for _, i in emitted} & set(np.flatnonzero(e.reach == 0))


def test_counting_agrees_with_emitting():
    e = ellipses(random_gaussians(2, np.float32))
    rows, pairs = count(e, GRID)
    assert pairs == emit(e, 1024, 2048).needed
    assert emit(e, int(rows), int(pairs)).overflow == 0


@pytest.mark.parametrize(("max_rows", "max_pairs"), [(1024, 50), (20, 2048), (1, 1)])
def test_overflow_counts_exactly_what_is_missing(max_rows, max_pairs):
    e = ellipses(random_gaussians(2, np.float32))
    pairs = emit(e, max_rows, max_pairs)
    assert pairs.needed == emit(e, 1024, 2048).needed
    assert pairs.needed - pairs.overflow == np.sum(np.asarray(pairs.tiles) < GRID.tiles)
    assert pairs.overflow > 0


def test_counts_saturate():
    huge = tiling.Footprints(
        *(jnp.full(3000, x, jnp.float32) for x in (8192.0, 8192.0, 1e10, 0.0, 1e10, 1e20, 10.0))
    )
    rows, pairs = count(huge, TileGrid(16384, 16384, 16))  # 3000 x 2^20 tiles
    assert rows == 3000 * 1024 and pairs == 1 << 30


@pytest.mark.parametrize("count", [1, 2, 1000, 70_000])
def test_depth_order_is_a_stable_argsort(count):
    rng = np.random.default_rng(0)
    depths = np.exp(rng.normal(size=count)).astype(np.float32)
    depths[rng.integers(0, count, count // 2)] = np.float32(1.5)  # ties
    depths[rng.integers(0, count, count // 4)] = np.inf
    order = jax.jit(tiling.depth_order)(jnp.asarray(depths))
    np.testing.assert_array_equal(order, np.argsort(depths, kind="stable"))
