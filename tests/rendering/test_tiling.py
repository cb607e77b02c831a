"""Tile lists against plain numpy: the same pairs in the same order, whether the packed key fits or not."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from humangs_jax.rendering import tiling
from humangs_jax.rendering.tiling import TileGrid

FEW = settings(max_examples=10, deadline=None)


@pytest.mark.slow
@pytest.mark.parametrize("n", [1, 2, 63, 64, 65, 1000, 70_000])
def test_cumsum_is_exact(n):
    x = np.random.default_rng(n).integers(0, min(1 << 18, (1 << 30) // n), n).astype(np.int32)
    np.testing.assert_array_equal(tiling.cumsum(jnp.asarray(x)), np.cumsum(x))


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


def test_expand_of_nothing():
    assert tiling.expand(jnp.zeros(0, jnp.int32), 4).needed == 0
    assert tiling.expand(jnp.zeros(3, jnp.int32), 4).needed == 0


@pytest.mark.parametrize("item_count", [50, 1 << 30])  # packed into one uint32; two keys
def test_lists_hold_the_pairs_of_each_tile_in_order(item_count):
    rng, tile_count = np.random.default_rng(0), 12
    items = np.sort(rng.choice(item_count, 200)).astype(np.int32)
    tiles = rng.integers(0, tile_count + 1, 200).astype(np.int32)  # tile_count: no tile
    order = rng.permutation(200)
    lists = tiling.sort_into_tiles(jnp.asarray(tiles[order]), jnp.asarray(items[order]), tile_count, item_count)
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


@pytest.mark.parametrize(("width", "height", "tile_size"), [(16, 8, 8), (13, 21, 8), (1, 1, 8), (5, 3, 1), (7, 30, 16)])
def test_image_and_tiles_are_inverse_for_any_size(width, height, tile_size):
    grid = TileGrid(width, height, tile_size)
    image = jnp.asarray(np.random.default_rng(0).normal(size=(height, width, 3)), jnp.float32)
    tiles = tiling.image_to_tiles(image, grid)
    assert tiles.shape == (grid.tiles, 3, grid.pixels)
    np.testing.assert_array_equal(tiling.tiles_to_image(tiles, grid), image)


def test_pixel_positions_are_those_of_the_image():
    grid = TileGrid(13, 21, 8)
    y, x = np.mgrid[:21, :13] + 0.5
    tiles = grid.centers()[:, :, None] + grid.offsets()
    np.testing.assert_array_equal(tiling.tiles_to_image(jnp.asarray(tiles), grid), np.stack([x, y], axis=-1))


@pytest.mark.slow
def test_everything_batches():
    counts = jnp.asarray(np.random.default_rng(0).integers(0, 4, (3, 20)), jnp.int32)

    def run(counts):
        expansion = tiling.expand(counts, 64)
        slot = jnp.arange(64, dtype=jnp.int32)
        tiles = jnp.where(slot < expansion.needed, (slot * 7) % 5, 5)
        return expansion, tiling.sort_into_tiles(tiles, expansion.source, 5, 20)

    batched = jax.vmap(run)(counts)
    for i in range(3):
        jax.tree.map(lambda a, b, i=i: np.testing.assert_array_equal(a[i], b), batched, run(counts[i]))
