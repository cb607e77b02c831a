"""The strategy of a fixed number of Gaussians: where it moves them, and unused slots.

Moves do not change the look of the scene.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.special import comb

from humangs_jax.core.pytree import replace
from humangs_jax.geometry.camera import orbit
from humangs_jax.rendering.gaussians import (
    Gaussians,
    UnconstrainedGaussians,
    constrain,
    covariances,
    unconstrain,
)
from humangs_jax.rendering.projection import project_gaussians
from humangs_jax.rendering.splat_config import DEFAULT_CONFIG
from humangs_jax.rendering.splatting import render
from humangs_jax.rendering.tiling import TileGrid, count_pairs, footprints_by
from humangs_jax.scenes import mcmc
from humangs_jax.scenes.steps import begin_scene, drawn_gaussians


def paper(o, n):
    """Returns the paper's equation 9 term by term, in float64."""
    new = 1 - (1 - o) ** (1 / n)
    total = sum(
        comb(i - 1, k) * (-1) ** k * new ** (k + 1) / np.sqrt(k + 1)
        for i in range(1, n + 1)
        for k in range(i)
    )
    return new, o / total


@pytest.mark.parametrize("opacity", [0.006, 0.3, 0.9, 0.995])
def test_opacities_and_scales_of_copies_are_those_of_the_paper(opacity):
    counts = np.asarray([1, 2, 3, 7, 20])
    expected = np.asarray([paper(opacity, int(n)) for n in counts])
    logit = np.log(opacity / (1 - opacity))
    for enabled, tolerance in ((True, 1e-10), (False, 2e-5)):
        with jax.enable_x64(enabled):
            dtype = jnp.float64 if enabled else jnp.float32
            logits, shrink = mcmc.divided(jnp.full(5, logit, dtype), jnp.asarray(counts, dtype))
            np.testing.assert_allclose(jax.nn.sigmoid(logits), expected[:, 0], rtol=tolerance)
            np.testing.assert_allclose(shrink, expected[:, 1], rtol=tolerance)


def test_an_opaque_gaussian_and_many_copies_are_finite():
    logits, shrink = mcmc.divided(jnp.asarray([30.0, -30.0, 2.0]), jnp.asarray([2.0, 9.0, 1e4]))
    assert np.isfinite(logits).all() and np.isfinite(shrink).all() and (shrink > 0).all()


def slots(opacities, used=None):
    """Returns (parameters, used) of round Gaussians in a row, 10 cm apart."""
    n = len(opacities)
    gaussians = Gaussians(
        jnp.stack([0.1 * jnp.arange(n, dtype=jnp.float32), jnp.zeros(n), jnp.zeros(n)], axis=-1),
        jnp.tile(jnp.asarray([1.0, 0, 0, 0]), (n, 1)),
        jnp.full((n, 3), 0.05),
        jnp.full(n, 0.5),
        jnp.linspace(0.1, 0.9, 3 * n).reshape(n, 3),
        harmonics=jnp.ones((n, 3, 3)) * jnp.arange(n)[:, None, None],
    )
    o = jnp.asarray(opacities, jnp.float32)
    parameters = replace(unconstrain(gaussians), opacity_logits=jnp.log(o) - jnp.log1p(-o))
    return parameters, jnp.ones(n, bool) if used is None else jnp.asarray(used)


def test_dead_gaussians_move_onto_opaque_ones_and_take_all_they_have():
    parameters, used = slots([0.8, 0.004, 0.001, 0.005, 0.6])
    moved = jax.jit(mcmc.mcmc_relocate)(jax.random.key(0), parameters, used)
    after, x = constrain(moved.parameters), np.asarray(moved.parameters.means[:, 0])
    assert set(np.round(x[1:4], 4).tolist()) <= {0.0, np.float32(0.4).round(4).item()}
    assert moved.used.all() and moved.moved[1:4].all()
    for i, o in ((0, 0.8), (4, 0.6)):
        here = np.flatnonzero(np.isclose(x, x[i]))
        new, factor = paper(o, len(here))
        np.testing.assert_allclose(after.opacities[here], new, rtol=1e-5)
        np.testing.assert_allclose(after.scales[here], 0.05 * factor, rtol=1e-5)
        for name in ("quats", "color_logits", "harmonics"):
            assert (getattr(moved.parameters, name)[here] == getattr(parameters, name)[i]).all()
        assert bool(moved.moved[i]) == (len(here) > 1)


def test_slots_are_used_one_after_the_other_up_to_the_count():
    parameters, used = slots(
        [0.8, 0.7, 0.001, 0.5, 0.5, 0.5], [True, True, True, False, False, False]
    )
    for count, expected in ((None, 3), (3, 3), (5, 5), (99, 6), (1, 3)):
        found = mcmc.mcmc_relocate(jax.random.key(1), parameters, used, count)
        assert int(found.used.sum()) == expected
        assert (np.asarray(found.used) == (np.arange(6) < expected)).all()
        new = np.asarray(found.parameters.means[2:expected, 0])
        assert (np.isclose(new, 0.0) | np.isclose(new, 0.1)).all()


def test_nothing_moves_where_nothing_is_seen():
    parameters, used = slots([0.001, 0.002, 0.003])
    found = mcmc.mcmc_relocate(jax.random.key(0), parameters, used, 3)
    assert not found.moved.any()
    for a, b in zip(jax.tree.leaves(found.parameters), jax.tree.leaves(parameters), strict=True):
        np.testing.assert_array_equal(a, b)


def test_sources_are_chosen_by_their_opacity():
    opacities = np.concatenate([[0.9, 0.3], np.full(4000, 1e-3)])
    parameters, used = slots(opacities)
    found = mcmc.mcmc_relocate(jax.random.key(3), parameters, used)
    at_first = np.isclose(found.parameters.means[2:, 0], 0.0).mean()
    assert at_first == pytest.approx(0.75, abs=0.03)


def test_a_scene_looks_the_same_after_relocation():
    """A Gaussian and its copies have one place: the ray through the middle has the same color, and
    those beside it nearly.
    """
    parameters, used = slots([0.8, 0.001, 0.001, 0.001])
    K = jnp.asarray([[300.0, 0, 16], [0, 300.0, 16], [0, 0, 1]])
    view = orbit(jnp.zeros(3), 3.0, jnp.zeros(1), 0.0, K, 32, 32)[0]
    found = mcmc.mcmc_relocate(jax.random.key(0), parameters, used)
    before, after = (render(constrain(p), view) for p in (parameters, found.parameters))
    assert found.moved.all()
    assert float(jnp.abs(before.alpha - after.alpha).max()) < 0.06
    assert float(jnp.abs(before.alpha[15:17, 15:17] - after.alpha[15:17, 15:17]).max()) < 0.01


def test_noise_follows_the_covariance_and_spares_what_is_opaque():
    count = 20_000
    parameters, used = slots([0.001] * count, [True] * (count - 1) + [False])
    log_scales = jnp.log(jnp.tile(jnp.asarray([0.1, 0.02, 0.01]), (count, 1)))
    quats = jnp.tile(jnp.asarray([0.9, 0.1, -0.3, 0.2]), (count, 1))
    parameters = replace(parameters, log_scales=log_scales, quats=quats)
    moved = jax.jit(mcmc.mcmc_noise)(jax.random.key(0), parameters, used, 2.0)
    moves = np.asarray(moved.means - parameters.means)
    assert not moves[-1].any()
    share = 1 / (1 + np.exp(-100 * (0.005 - 0.001)))
    covariance = np.asarray(covariances(constrain(parameters))[0], np.float64)
    expected = (2 * share) ** 2 * covariance @ covariance
    measured = np.cov(moves[:-1].T)
    np.testing.assert_allclose(measured, expected, atol=0.06 * np.abs(expected).max())
    opaque = replace(parameters, opacity_logits=jnp.full(count, 3.0))
    still = mcmc.mcmc_noise(jax.random.key(0), opaque, used, 2.0)
    assert float(jnp.abs(still.means - opaque.means).max()) < 1e-12


def test_the_penalty_is_the_mean_over_used_slots_and_so_is_its_gradient():
    with jax.enable_x64(True):
        parameters, used = slots([0.8, 0.2, 0.5], [True, True, False])
        parameters = jax.tree.map(lambda x: x.astype(jnp.float64), parameters)
        penalty = lambda p: mcmc.mcmc_penalty(p, used, 0.3, 0.7)
        assert float(penalty(parameters)) == pytest.approx(0.3 * 0.5 + 0.7 * 0.05, rel=1e-6)
        gradient = jax.grad(penalty)(parameters)
        assert not gradient.opacity_logits[2] and not gradient.log_scales[2].any()
        direction = jax.tree.map(
            lambda x: jnp.asarray(np.random.default_rng(0).normal(size=x.shape)), parameters
        )
        moved = lambda t: penalty(jax.tree.map(lambda x, d: x + t * d, parameters, direction))
        slope = (moved(1e-6) - moved(-1e-6)) / 2e-6
        along = sum(
            jnp.sum(a * b)
            for a, b in zip(jax.tree.leaves(gradient), jax.tree.leaves(direction), strict=True)
        )
        np.testing.assert_allclose(along, slope, rtol=1e-7)


def test_unused_slots_meet_no_tile_and_change_no_pixel():
    parameters, _ = slots([0.8, 0.6, 0.7])
    few = constrain(parameters)
    state = begin_scene(few, 64)
    many = drawn_gaussians(state.parameters, state.used)
    K = jnp.asarray([[100.0, 0, 16], [0, 100.0, 16], [0, 0, 1]])
    view = orbit(jnp.zeros(3), 2.0, jnp.zeros(1), 0.0, K, 32, 32)[0]
    pairs = [
        count_pairs(
            footprints_by(project_gaussians(each, view), each.opacities, DEFAULT_CONFIG),
            TileGrid(32, 32, 8),
        )[1]
        for each in (few, many)
    ]
    assert int(pairs[0]) == int(pairs[1]) > 0
    np.testing.assert_array_equal(render(few, view).rgb, render(many, view).rgb)
    assert isinstance(state.parameters, UnconstrainedGaussians) and int(state.used.sum()) == 3
