"""Gaussians that skinning moves, and Gaussians as free parameters and back."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import humangs_jax as hg
from humangs_jax.core.pytree import replace
from humangs_jax.geometry import quaternion, transform
from humangs_jax.rendering.gaussians import (
    COLOR_MARGIN,
    OPACITY_MARGIN,
    Gaussians,
    covariances,
    skin_gaussians,
)

RTOL = 1e-10
"""Rounding of float64."""


def some_gaussians(rng, count=12):
    uniform = lambda *shape: jnp.asarray(rng.uniform(0.1, 0.9, shape))
    quats = quaternion.normalize(jnp.asarray(rng.normal(size=(count, 4))))
    return Gaussians(uniform(count, 3), quats, uniform(count, 3), uniform(count), uniform(count, 3))


def rotations(rng, count=12):
    return quaternion.to_matrix(quaternion.normalize(jnp.asarray(rng.normal(size=(count, 4)))))


def test_affine_skinning_moves_means_and_covariances_by_the_whole_transform():
    rng = np.random.default_rng(0)
    with jax.enable_x64(True):
        gaussians = some_gaussians(rng)
        first, second = (
            transform.make(jnp.asarray(rng.normal(size=(12, 3, 3))), jnp.ones((12, 3)) * 0.3)
            for _ in "ab"
        )
        moved = skin_gaussians(skin_gaussians(gaussians, first), second)
        both = second @ first
        linear = both[:, :3, :3]
        np.testing.assert_allclose(moved.means, transform.apply(both, gaussians.means), rtol=RTOL)
        expected = linear @ covariances(gaussians) @ jnp.swapaxes(linear, 1, 2)
        np.testing.assert_allclose(covariances(moved), expected, rtol=1e-8, atol=RTOL)
        assert moved.colors is gaussians.colors


def test_both_modes_agree_on_rigid_transforms():
    rng = np.random.default_rng(1)
    with jax.enable_x64(True):
        gaussians, rigid = (
            some_gaussians(rng),
            transform.make(rotations(rng), jnp.asarray(rng.normal(size=(12, 3)))),
        )
        affine, rotation = (
            skin_gaussians(gaussians, rigid, mode) for mode in ("affine", "rotation")
        )
        np.testing.assert_allclose(covariances(affine), covariances(rotation), rtol=1e-8, atol=RTOL)
        np.testing.assert_allclose(affine.means, rotation.means, rtol=RTOL)
        np.testing.assert_allclose(jnp.linalg.norm(rotation.quats, axis=-1), 1, rtol=RTOL)


def test_a_blend_of_rotations_leaves_a_short_quaternion():
    """As published: the mean of a quarter turn and none is no rotation, and the norm shows it."""
    rng = np.random.default_rng(2)
    quarter = quaternion.matrix_from_axis_angle(jnp.asarray([0.0, 0.0, np.pi / 2]))
    blend = transform.make(0.5 * (quarter + jnp.eye(3)), jnp.zeros(3))
    gaussians = jax.tree.map(lambda x: x.astype(jnp.float32), some_gaussians(rng))
    gaussians = replace(gaussians, quats=jnp.tile(jnp.asarray([1.0, 0, 0, 0]), (12, 1)))
    quats = skin_gaussians(gaussians, jnp.broadcast_to(blend, (12, 4, 4)), "rotation").quats
    w = np.sqrt(1 + 0.5 + 0.5 + 1) / 2
    assert (
        np.allclose(quats[0], [w, 0, 0, 0.5 * 2 / (4 * w)], atol=1e-6)
        and np.linalg.norm(quats[0]) < 0.95
    )


def test_what_is_deformed_has_no_parameters_and_no_rotation():
    gaussians = jax.tree.map(
        lambda x: x.astype(jnp.float32), some_gaussians(np.random.default_rng(3))
    )
    still = jnp.broadcast_to(jnp.eye(4), (12, 4, 4))
    deformed = skin_gaussians(gaussians, still)
    with pytest.raises(ValueError, match="deformed already"):
        skin_gaussians(deformed, still, "rotation")
    with pytest.raises(ValueError, match="factored"):
        hg.unconstrain(deformed)


ROUNDING = 2e-6
"""Rounding of a logarithm and an exponential, a logit and a sigmoid, in float32."""
COUNT = 50


def within_bounds():
    rng = np.random.default_rng(0)
    array = lambda x: jnp.asarray(x, jnp.float32)
    means, quats = array(rng.normal(size=(COUNT, 3))), array(rng.normal(size=(COUNT, 4)))
    scales, colors = (
        array(rng.uniform(0.001, 0.3, (COUNT, 3))),
        array(rng.uniform(0.02, 0.98, (COUNT, 3))),
    )
    return hg.Gaussians(means, quats, scales, array(rng.uniform(0.01, 0.99, COUNT)), colors)


def test_there_and_back():
    before = within_bounds()
    after = hg.constrain(hg.unconstrain(before))
    for name in ("means", "quats", "scales", "opacities", "colors"):
        np.testing.assert_allclose(getattr(after, name), getattr(before, name), atol=ROUNDING)


def test_bounds_are_met_within_the_margins():
    edge = replace(
        within_bounds(),
        opacities=jnp.ones(COUNT),
        colors=jnp.zeros((COUNT, 3)),
        scales=jnp.zeros((COUNT, 3)),
    )
    after = hg.constrain(hg.unconstrain(edge))
    np.testing.assert_allclose(after.opacities, 1 - OPACITY_MARGIN, atol=ROUNDING)
    np.testing.assert_allclose(after.colors, COLOR_MARGIN, atol=ROUNDING)
    assert (after.scales > 0).all()


def test_parameters_of_constants_have_types_of_their_own():
    """Weakly typed parameters would compile a step of an optimizer twice."""
    n = 4
    flat = Gaussians(
        jnp.zeros((n, 3)),
        jnp.ones((n, 4)),
        jnp.full((n, 3), 0.03),
        jnp.full(n, 0.7),
        jnp.full((n, 3), 0.5),
    )
    assert jax.tree.leaves(flat)[3].weak_type and not any(
        leaf.weak_type for leaf in jax.tree.leaves(hg.unconstrain(flat))
    )
