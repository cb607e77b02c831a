"""Pairs against geometry by brute force: the least d^T cov^-1 d over every tile's rectangle of pixel centres."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from splat_scenes import HEIGHT, WIDTH, camera, random_gaussians

from humangs_jax.rendering import tiling
from humangs_jax.rendering.projection import project
from humangs_jax.rendering.tiling import TileGrid

GRID = TileGrid(WIDTH, HEIGHT, 4)
SAMPLES = 400
"""Points per side of a rectangle in the brute force search."""


@jax.jit
def ellipses(gaussians):
    return tiling.footprints(project(gaussians, camera(np.float32)), tiling.squared_reach(gaussians.opacities))


@functools.partial(jax.jit, static_argnums=(1, 2))
def emit(footprints, max_rows, max_pairs):
    return tiling.emit_pairs(footprints, GRID, max_rows, max_pairs)


@functools.partial(jax.jit, static_argnums=1)
def count(footprints, grid):
    return tiling.count_pairs(footprints, grid)


def least_distance(e, i, tile):
    """min of d^T cov^-1 d over the tile's rectangle: 0 if the centre is inside, else on its border."""
    cov = np.asarray([[e.xx[i], e.xy[i]], [e.xy[i], e.yy[i]]], np.float64)
    low = np.asarray([tile % GRID.columns, tile // GRID.columns]) * GRID.tile_size + 0.5
    high = low + GRID.tile_size - 1
    center = np.asarray([e.x[i], e.y[i]], np.float64)
    if (low <= center).all() and (center <= high).all():
        return 0.0
    s = np.linspace(0, 1, SAMPLES)[:, None]
    corners = [low, np.asarray([high[0], low[1]]), high, np.asarray([low[0], high[1]])]
    border = np.concatenate([a + s * (b - a) for a, b in zip(corners, [*corners[1:], corners[0]], strict=True)])
    d = border - center
    return np.einsum("ni,ij,nj->n", d, np.linalg.inv(cov), d).min()


@pytest.mark.parametrize("seed", [0, 1])
def test_pairs_are_those_whose_ellipse_meets_the_tile(seed):
    e = jax.tree.map(np.asarray, ellipses(random_gaussians(seed, np.float32)))
    pairs = emit(e, 1024, 2048)
    used = np.asarray(pairs.tiles) < GRID.tiles
    emitted = set(zip(np.asarray(pairs.tiles)[used].tolist(), np.asarray(pairs.splats)[used].tolist(), strict=True))
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
    huge = tiling.Footprints(*(jnp.full(3000, x, jnp.float32) for x in (8192.0, 8192.0, 1e10, 0.0, 1e10, 1e20, 10.0)))
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
