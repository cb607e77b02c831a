import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.special import ndtr

from humangs_jax.body import model

ATOL = 5e-6  # float32
blend_leg_weights = jax.jit(model.blend_leg_weights, static_argnums=6)


@pytest.mark.parametrize("parents", [(0, 0), (-1, -1), (-1, 2, 1), (-1, 7), (-1, -2), (1, 2, 0)])
def test_what_is_no_tree_is_refused(parents):
    with pytest.raises(ValueError, match="root"):
        model.ancestors(parents)


def test_points_between_two_limbs_go_with_both_and_points_on_them_with_their_own():
    """Two upright rows of vertices stand 20 cm apart; each has a joint."""
    heights = np.linspace(0, 1, 400)
    row = lambda x: np.stack([np.full(400, x), heights, np.zeros(400)], axis=1)
    vertices, joints = np.concatenate([row(-0.1), row(0.1)]), np.repeat(np.eye(2), 400, axis=0)
    points = np.concatenate([row(0.0)[100:200], row(-0.1), row(0.1)])
    own = np.concatenate([joints[:100], joints])
    distances = np.concatenate([np.full(100, 0.1), np.zeros(800)])
    arrays = [jnp.asarray(x, jnp.float32) for x in (points, distances, own, vertices, joints)]
    legs = jnp.eye(2, dtype=bool)
    found = blend_leg_weights(*arrays, legs, 0.04)
    np.testing.assert_allclose(found[:100], 0.5, atol=ATOL)
    np.testing.assert_array_equal(found[100:], own[100:])
    np.testing.assert_allclose(np.sum(found, axis=1), 1, atol=ATOL)
    # two limbs that are no legs
    np.testing.assert_array_equal(
        blend_leg_weights(*arrays, legs[:1].repeat(2, 0) & False, 0.04), own
    )


@pytest.mark.parametrize("distance", [0.05, 0.1])
def test_the_kernel_of_blended_leg_weights_is_as_wide_as_the_distance(distance):
    """Vertices lie along x; those with x > 0 belong to the other leg. Its share at x is the normal
    distribution function of x / distance.
    """
    x = np.linspace(-1, 1, 8000)
    vertices, of = (
        np.stack([x, 0 * x, 0 * x], axis=1),
        np.stack([x <= 0, x > 0], axis=1).astype(float),
    )
    at = distance * np.asarray([-0.8, -0.3, 0.0, 0.6])
    # a quarter of the points change
    points = np.stack([at, 0 * at, 0 * at], axis=1).repeat(4, axis=0)
    distances = np.where(np.arange(16) % 4 == 0, distance, 0.0)
    own = np.tile([1.0, 0.0], (16, 1))
    arrays = [jnp.asarray(each, jnp.float32) for each in (points, distances, own, vertices, of)]
    found = blend_leg_weights(*arrays, jnp.eye(2, dtype=bool), 0.04)
    # every eighth vertex: steps of 2 mm
    np.testing.assert_allclose(found[::4, 1], ndtr(at / distance), atol=0.02)
