"""Adaptive density: shares of the error, halves of a Gaussian, slots."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from refinement_cases import STEPS, toy_avatar, toy_capture

from humangs_jax.body.decimation import decimate
from humangs_jax.body.library import load_body
from humangs_jax.core.pytree import replace
from humangs_jax.geometry import quaternion
from humangs_jax.refinement import refine as refinement
from humangs_jax.refinement.crops import crop_to_person
from humangs_jax.refinement.density import CLEAR, eroded, inner_errors, split, with_room, without_clear
from humangs_jax.refinement.objective import drawn_photo, photos_of
from humangs_jax.refinement.parameters import gaussians_of, init_state, parameters_of
from humangs_jax.rendering.splat_config import SplatConfig

FLOAT32 = 1e-5


@pytest.fixture(scope="module")
def person():
    body = decimate(load_body(), 400)
    return toy_avatar(body, 0.0), toy_capture(body, toy_avatar(body, 0.15), moving=True)


def state_of(avatar):
    return init_state(
        parameters_of(avatar.gaussians, 1, len(avatar.parents)), jnp.ones(len(avatar.gaussians.means)), STEPS
    )


@pytest.mark.slow
def test_errors_are_shared_by_weight(person):
    avatar, capture = person
    views = crop_to_person(capture)
    photos, parameters = photos_of(views, views.masks > 0.2), parameters_of(avatar.gaussians, 3, len(avatar.parents))
    splat = SplatConfig(max_pairs=1 << 14, max_rows=1 << 14)
    for i in range(len(views.images)):
        photo = jax.tree.map(lambda x, i=i: x[i], photos)
        image, pull_back, drawn = drawn_photo(parameters, avatar, photo, splat, poses=False)
        shares = pull_back(inner_errors(image, photo))[1]
        inside = photo.counted & (eroded(photo.masks, 1) > 0.5)  # 3 pixels of 256 are 1 of this image
        total = float(jnp.sum(drawn.alpha * inside * jnp.sum(jnp.abs(drawn.rgb - photo.images), axis=-1)))
        assert int(drawn.overflow) == 0 and float(jnp.min(shares)) >= 0
        assert float(jnp.sum(shares)) == pytest.approx(total, rel=1e-3)


@pytest.mark.slow
def test_halves_have_the_mean_and_the_variance_of_the_whole(person):
    avatar = with_room(person[0], 1.5)
    count = len(person[0].gaussians.means)
    rng = np.random.default_rng(0)
    scales = jnp.asarray(0.005 + 0.03 * rng.random((len(avatar.gaussians.means), 3)), jnp.float32)
    quats = jnp.asarray(rng.normal(size=(len(scales), 4)), jnp.float32)
    avatar = replace(avatar, gaussians=replace(avatar.gaussians, scales=scales, quats=quats))
    errors = jnp.zeros(len(scales)).at[7].set(2.0).at[11].set(1.0)
    state, denser = split(state_of(avatar), avatar, errors, 4)
    before, after = avatar.gaussians, gaussians_of(state.parameters, None)
    used = np.flatnonzero(np.asarray(after.opacities[count:]) > CLEAR) + count
    assert len(used) == 2
    for whole in (7, 11):
        (other,) = [i for i in used if np.allclose(after.colors[i], after.colors[whole])]
        np.testing.assert_allclose((after.means[whole] + after.means[other]) / 2, before.means[whole], atol=FLOAT32)
        np.testing.assert_array_equal(denser.skinning_weights[other], avatar.skinning_weights[whole])
        mixed = sum(
            np.asarray(covariance(after, i)) + outer(after.means[i] - before.means[whole]) for i in (whole, other)
        )
        np.testing.assert_allclose(mixed / 2, covariance(before, whole), atol=1e-7)
    untouched = np.setdiff1d(np.arange(count), [7, 11])
    np.testing.assert_allclose(after.means[untouched], before.means[untouched])


def outer(x):
    return np.outer(x, x)


def covariance(gaussians, i):
    axes = np.asarray(quaternion.to_matrix(quaternion.normalize(gaussians.quats[i])))
    return axes @ np.diag(np.square(gaussians.scales[i])) @ axes.T


@pytest.mark.slow
def test_without_a_free_slot_nothing_is_split(person):
    avatar, _ = person
    state = state_of(avatar)
    after, same = split(state, avatar, jnp.ones(len(avatar.gaussians.means)), 5)
    jax.tree.map(np.testing.assert_array_equal, after, state)
    jax.tree.map(np.testing.assert_array_equal, same, avatar)


@pytest.mark.slow
def test_room_is_invisible_and_goes_again(person):
    avatar, _ = person
    roomy = with_room(avatar, 2.0)
    assert len(roomy.gaussians.means) == 2 * len(avatar.gaussians.means) == len(roomy.skinning_weights)
    jax.tree.map(np.testing.assert_array_equal, without_clear(roomy, 1 / 255), avatar)


@pytest.mark.slow
def test_a_run_that_grows_returns_more_gaussians_and_a_better_image(person):
    avatar, capture = person
    grown = refinement.refine_with_report(avatar, capture, dataclasses.replace(STEPS, growth=1.6))
    count = len(avatar.gaussians.means)
    assert grown.kept and count < len(grown.avatar.gaussians.means) <= 1.6 * count
    assert len(grown.avatar.skinning_weights) == len(grown.avatar.gaussians.means)
    assert grown.loss[1] < 0.9 * grown.loss[0]


def test_growth_out_of_range_is_an_error():
    with pytest.raises(ValueError, match=r"growth 0\.5: expected 1 to 16"):
        dataclasses.replace(STEPS, growth=0.5)
