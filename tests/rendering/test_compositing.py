"""Compositing of made-up lists of splats and its gradient, against the formula and autodiff."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from splat_scenes import tile_centers

from humangs_jax.rendering.compositing import composite
from humangs_jax.rendering.splat_config import SplatConfig
from humangs_jax.rendering.tiling import TileGrid, TileLists

EXACT = 1e-10
"""Rounding of float64 sums over 16 pixels."""

GRID = TileGrid(12, 8, 4)  # six tiles
LENGTHS = [4, 0, 5, 1, 0, 2]
CONFIG = SplatConfig(tile_size=4, block=2, chunk=2)


pytestmark = pytest.mark.usefixtures("float64")


def make(seed):
    """Returns (nine splats, lists); the first few in depth order are on each tile."""
    rng = np.random.default_rng(seed)
    x, y = rng.uniform(7, 12, 9), rng.uniform(0, 4, 9)
    shape = np.stack(
        [rng.uniform(0.05, 0.2, 9), rng.uniform(-0.1, 0.1, 9), rng.uniform(0.05, 0.2, 9)]
    )
    log_opacity = np.log(np.asarray([1.0, 0.99, 0.9, 1.0, 0.99, 0.9, 0.5, 0.4, 0.3]))
    splats = np.concatenate(
        [np.stack([x, y, *shape, log_opacity], axis=-1), rng.uniform(size=(9, 4))], axis=-1
    )
    items = np.concatenate(
        [np.sort(rng.choice(9, n, replace=False)) for n in LENGTHS] + [np.full(4, 7)]
    )
    counts = np.asarray(LENGTHS)
    lists = TileLists(
        *(jnp.asarray(a, jnp.int32) for a in (items, np.cumsum(counts) - counts, counts))
    )
    return jnp.asarray(splats), lists


def formula(splats, lists):
    """Returns (features, transmittances) by the formula, splat by splat on each tile."""
    offsets, centers = GRID.offsets(np.float64), tile_centers(GRID)
    features, transmittances = [], []
    for tile, (start, count) in enumerate(
        zip(np.asarray(lists.starts), np.asarray(lists.counts), strict=True)
    ):
        pixels = centers[tile][:, None] + offsets
        total, transmittance, ended = (
            jnp.zeros((4, GRID.pixels)),
            jnp.ones(GRID.pixels),
            np.zeros(GRID.pixels, bool),
        )
        for item in np.asarray(lists.items)[start : start + count]:
            x, y, r00, r01, r11, log_opacity, *f = splats[item]
            dx, dy = pixels[0] - x, pixels[1] - y
            raw = jnp.exp(log_opacity - (r00 * dx + r01 * dy) ** 2 - (r11 * dy) ** 2)
            alpha = jnp.where(raw < 1 / 255, 0.0, jnp.where(raw < 0.999, raw, 0.999))
            ended = ended | (transmittance * (1 - alpha) <= 1e-4)
            alpha = jnp.where(ended, 0.0, alpha)
            total = total + jnp.asarray(f)[:, None] * alpha * transmittance
            transmittance = transmittance * (1 - alpha)
        features.append(total)
        transmittances.append(transmittance)
    return jnp.stack(features), jnp.stack(transmittances)


@functools.cache
def weights():
    rng = np.random.default_rng(9)
    return rng.normal(size=(6, 4, 16)), rng.normal(size=(6, 16))


def value_and_gradient(draw, splats):
    def loss(splats):
        out = draw(splats)
        return sum(jnp.sum(w * o) for w, o in zip(weights(), out, strict=True)), out

    (_, out), gradient = jax.value_and_grad(loss, has_aux=True)(splats)
    return *out, gradient


def test_equals_the_formula_with_its_gradient():
    splats, lists = make(1)
    tiled = jax.jit(
        lambda splats, lists: value_and_gradient(
            lambda s: composite(s, lists, GRID, CONFIG)[:2], splats
        )
    )
    exact = jax.jit(lambda splats: value_and_gradient(lambda s: formula(s, lists), splats))
    expected = exact(splats)
    for ours, exactly in zip(tiled(splats, lists), expected, strict=True):
        assert np.abs(exactly).max() > 0.1
        np.testing.assert_allclose(ours, exactly, atol=EXACT)
    assert 1e-4 < expected[1].min() < 1e-3  # some pixels came to their end


def test_empty_lists_leave_their_tiles_blank():
    splats, lists = make(1)
    features, transmittance, *_ = jax.jit(lambda s, l: composite(s, l, GRID, CONFIG))(splats, lists)
    for tile in (1, 4):
        assert not features[tile].any() and (transmittance[tile] == 1).all()


@pytest.mark.slow
def test_a_batch_is_drawn_as_one():
    batch = [make(seed) for seed in (1, 2)]
    splats, lists = jax.tree.map(lambda *leaves: jnp.stack(leaves), *batch)
    run = jax.jit(
        lambda splats, lists: value_and_gradient(
            lambda s: composite(s, lists, GRID, CONFIG)[:2], splats
        )
    )
    together = jax.jit(jax.vmap(run))(splats, lists)
    one_scene = jax.jit(jax.vmap(run, in_axes=(None, 0)))(splats[0], lists)
    for i in range(2):
        for a, b in zip(together, run(*batch[i]), strict=True):
            np.testing.assert_allclose(a[i], b, atol=EXACT)
        for a, b in zip(one_scene, run(splats[0], batch[i][1]), strict=True):
            np.testing.assert_allclose(a[i], b, atol=EXACT)
