import jax
import jax.numpy as jnp
import numpy as np
import pytest

from humangs_jax.core.pytree import replace
from humangs_jax.geometry import quaternion, transform
from humangs_jax.rendering.gaussians import Gaussians, covariances, skin_gaussians

RTOL = 1e-10
"""float64 throughout."""


def random_gaussians(rng, count=12):
    uniform = lambda *shape: jnp.asarray(rng.uniform(0.1, 0.9, shape))
    quats = quaternion.normalize(jnp.asarray(rng.normal(size=(count, 4))))
    return Gaussians(uniform(count, 3), quats, uniform(count, 3), uniform(count), uniform(count, 3))


def rotations(rng, count=12):
    return quaternion.to_matrix(quaternion.normalize(jnp.asarray(rng.normal(size=(count, 4)))))


def test_affine_skinning_moves_means_and_covariances_by_the_whole_transform():
    rng = np.random.default_rng(0)
    with jax.enable_x64(True):
        gaussians = random_gaussians(rng)
        first, second = (
            transform.make(jnp.asarray(rng.normal(size=(12, 3, 3))), jnp.ones((12, 3)) * 0.3) for _ in "ab"
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
        gaussians, rigid = random_gaussians(rng), transform.make(rotations(rng), jnp.asarray(rng.normal(size=(12, 3))))
        affine, rotation = (skin_gaussians(gaussians, rigid, mode) for mode in ("affine", "rotation"))
        np.testing.assert_allclose(covariances(affine), covariances(rotation), rtol=1e-8, atol=RTOL)
        np.testing.assert_allclose(affine.means, rotation.means, rtol=RTOL)
        np.testing.assert_allclose(jnp.linalg.norm(rotation.quats, axis=-1), 1, rtol=RTOL)


def test_a_blend_of_rotations_leaves_a_short_quaternion():
    """As published: half a turn of 90 degrees and none at all is no rotation, and the norm shows it."""
    rng = np.random.default_rng(2)
    quarter = quaternion.matrix_from_axis_angle(jnp.asarray([0.0, 0.0, np.pi / 2]))
    blend = transform.make(0.5 * (quarter + jnp.eye(3)), jnp.zeros(3))
    gaussians = jax.tree.map(lambda x: x.astype(jnp.float32), random_gaussians(rng))
    gaussians = replace(gaussians, quats=jnp.tile(jnp.asarray([1.0, 0, 0, 0]), (12, 1)))
    quats = skin_gaussians(gaussians, jnp.broadcast_to(blend, (12, 4, 4)), "rotation").quats
    w = np.sqrt(1 + 0.5 + 0.5 + 1) / 2
    assert np.allclose(quats[0], [w, 0, 0, 0.5 * 2 / (4 * w)], atol=1e-6) and np.linalg.norm(quats[0]) < 0.95


def test_what_is_refused():
    gaussians = jax.tree.map(lambda x: x.astype(jnp.float32), random_gaussians(np.random.default_rng(3)))
    still = jnp.broadcast_to(jnp.eye(4), (12, 4, 4))
    with pytest.raises(ValueError, match="deformed already"):
        skin_gaussians(skin_gaussians(gaussians, still), still, "rotation")
