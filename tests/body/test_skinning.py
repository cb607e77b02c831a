import jax
import jax.numpy as jnp
import numpy as np
import pytest
from body_cases import PARENTS, random_pose, world_frames
from rounding import bound
from scipy.special import ndtr

from humangs_jax.body import model
from humangs_jax.geometry import transform

EXACT = 1e-12  # float64 against float64
ATOL = 5e-6  # float32, chains of 4 joints, lengths of about 1

joint_transforms = jax.jit(model.joint_transforms, static_argnums=1)


def test_ancestors_are_one_two_four_joints_up_and_end_beyond_the_root():
    count = len(PARENTS)
    above = lambda j, steps: j if j == count or not steps else above(PARENTS[j] if PARENTS[j] >= 0 else count, steps - 1)
    iterations = model.ancestors(PARENTS)
    for i, up in enumerate(iterations):
        assert list(up) == [above(j, 2**i) for j in range(count)]
    assert all(above(j, 2 ** len(iterations)) == count for j in range(count))


@pytest.mark.parametrize("parents", [(0, 0), (-1, -1), (-1, 2, 1), (-1, 7), (-1, -2), (1, 2, 0)])
def test_what_is_no_tree_is_refused(parents):
    with pytest.raises(ValueError, match="root"):
        model.ancestors(parents)


@pytest.mark.parametrize("seed", range(3))
def test_joint_transforms_are_frame_products(seed):
    joints = np.random.default_rng(seed + 10).normal(size=(len(PARENTS), 3))
    rotations, translation = random_pose(seed)
    expected = []
    for frame, joint in zip(world_frames(joints, PARENTS, rotations), joints, strict=True):
        rest = np.eye(4)
        rest[:3, 3] = joint
        moved = frame @ np.linalg.inv(rest)
        moved[:3, 3] += translation
        expected.append(moved)
    with jax.enable_x64(True):
        args = [jnp.asarray(x) for x in (joints, rotations, translation)]
        found = joint_transforms(args[0], PARENTS, *args[1:])
        assert found.dtype == jnp.float64
        assert np.abs(np.asarray(found) - expected).max() < EXACT
    args = [jnp.asarray(x, jnp.float32) for x in (joints, rotations, translation)]
    found = joint_transforms(args[0], PARENTS, *args[1:])
    assert np.abs(np.asarray(found) - expected).max() < bound(ATOL)


def test_one_joint_is_a_rotation_about_it():
    joint = jnp.asarray([[0.3, -0.2, 0.5]])
    transforms = joint_transforms(joint, (-1,), jnp.asarray([[0.0, np.pi / 2, 0.0]]), jnp.asarray([0, 1.0, 0]))
    moved = transform.apply(transforms, joint + jnp.asarray([[0, 0, 1.0]]))
    assert np.allclose(moved, joint + jnp.asarray([[1.0, 1.0, 0]]), atol=ATOL)  # about +y, z goes to x


def test_blending_is_a_weighted_sum():
    rng = np.random.default_rng(0)
    weights, transforms = rng.uniform(size=(6, 3)), rng.normal(size=(3, 4, 4))
    expected = [sum(w * t for w, t in zip(row, transforms, strict=True)) for row in weights]
    found = model.blend_transforms(jnp.asarray(weights, jnp.float32), jnp.asarray(transforms, jnp.float32))
    assert np.allclose(found, expected, atol=ATOL)
    points = rng.normal(size=(6, 3))
    applied = transform.apply(found, jnp.asarray(points, jnp.float32))
    loop = [t[:3, :3] @ p + t[:3, 3] for t, p in zip(expected, points, strict=True)]
    assert np.allclose(applied, loop, atol=ATOL)


def test_points_between_two_limbs_go_with_both_and_points_on_them_with_their_own():
    """Two upright rows of vertices, a joint each, 20 cm apart."""
    heights = np.linspace(0, 1, 400)
    row = lambda x: np.stack([np.full(400, x), heights, np.zeros(400)], axis=1)
    vertices, joints = np.concatenate([row(-0.1), row(0.1)]), np.repeat(np.eye(2), 400, axis=0)
    points = np.concatenate([row(0.0)[100:200], row(-0.1), row(0.1)])
    own = np.concatenate([joints[:100], joints])
    distances = np.concatenate([np.full(100, 0.1), np.zeros(800)])
    run = jax.jit(model.spread_weights, static_argnums=6)
    arrays = [jnp.asarray(x, jnp.float32) for x in (points, distances, own, vertices, joints)]
    legs = jnp.eye(2, dtype=bool)
    found = run(*arrays, legs, 0.04)
    np.testing.assert_allclose(found[:100], 0.5, atol=ATOL)
    np.testing.assert_array_equal(found[100:], own[100:])
    np.testing.assert_allclose(np.sum(found, axis=1), 1, atol=ATOL)
    np.testing.assert_array_equal(run(*arrays, legs[:1].repeat(2, 0) & False, 0.04), own)  # two limbs that are no legs


@pytest.mark.parametrize("distance", [0.05, 0.1])
def test_the_kernel_of_spread_weights_is_as_wide_as_the_distance(distance):
    """Vertices along x, those with x > 0 of the other leg: its share at x is the normal distribution function of x / distance."""
    x = np.linspace(-1, 1, 8000)
    vertices, of = np.stack([x, 0 * x, 0 * x], axis=1), np.stack([x <= 0, x > 0], axis=1).astype(float)
    at = distance * np.asarray([-0.8, -0.3, 0.0, 0.6])
    points = np.stack([at, 0 * at, 0 * at], axis=1).repeat(4, axis=0)  # a quarter of the points change
    distances = np.where(np.arange(16) % 4 == 0, distance, 0.0)
    own = np.tile([1.0, 0.0], (16, 1))
    arrays = [jnp.asarray(each, jnp.float32) for each in (points, distances, own, vertices, of)]
    found = model.spread_weights(*arrays, jnp.eye(2, dtype=bool), 0.04)
    np.testing.assert_allclose(found[::4, 1], ndtr(at / distance), atol=0.02)  # every eighth vertex: steps of 2 mm
