import jax
import jax.numpy as jnp
import numpy as np
import pytest
from body_cases import made_up_body, oracle, random_pose
from hypothesis import given
from hypothesis import strategies as st
from rounding import bound
from scipy.spatial.transform import Rotation

from humangs_jax.body.model import BodyPose, pose_body, rest_pose, shape_body

EXACT = 1e-12  # float64 against float64
ATOL = 1e-5  # float32, coordinates of about 3 m with correctives of 54 terms

angles = st.floats(-3.0, 3.0, width=32)


@jax.jit
def posed(body, betas, rotations, translation):
    dtype = body.template.dtype
    pose = BodyPose(jnp.asarray(rotations, dtype), jnp.asarray(translation, dtype))
    return pose_body(body, shape_body(body, jnp.asarray(betas, dtype)), pose)


@pytest.mark.parametrize("pose_directions", [True, False])
def test_vertices_joints_and_transforms_agree_with_the_oracle(pose_directions):
    betas = np.asarray([0.5, -1.0, 2.0])
    rotations, translation = random_pose(3)
    with jax.enable_x64(True):
        body = made_up_body(1, pose_directions=pose_directions)
        expected = oracle(body, betas, rotations, translation)
        found = posed(body, betas, rotations, translation)
        for a, b in zip((found.vertices, found.joints, found.joint_transforms), expected, strict=True):
            assert a.dtype == jnp.float64
            assert np.abs(np.asarray(a) - b).max() < EXACT
    body = made_up_body(1, pose_directions=pose_directions, dtype=np.float32)
    found = posed(body, betas, rotations, translation)
    for a, b in zip((found.vertices, found.joints, found.joint_transforms), expected, strict=True):
        assert a.dtype == jnp.float32
        assert np.abs(np.asarray(a) - b).max() < bound(ATOL)


def test_the_zero_pose_is_the_rest_body():
    body = made_up_body(2, dtype=np.float32)
    rest = jax.jit(shape_body)(body, jnp.asarray([1.0, -1.0]))
    found = jax.jit(pose_body)(body, rest, rest_pose(body))
    assert np.allclose(found.vertices, rest.vertices, atol=ATOL)
    assert np.allclose(found.joints, rest.joints, atol=ATOL)
    assert np.allclose(found.joint_transforms, np.eye(4), atol=ATOL)


@given(st.tuples(angles, angles, angles), st.tuples(angles, angles, angles))
def test_turning_the_root_turns_the_body_about_it_and_translation_comes_last(turn, shift):
    body = made_up_body(3, dtype=np.float32)
    rotations, _ = random_pose(4)
    rotations[0] = 0
    still = posed(body, np.zeros(1), rotations, np.zeros(3))
    rotations[0] = turn
    moved = posed(body, np.zeros(1), rotations, np.asarray(shift))
    rigid = Rotation.from_rotvec(turn).as_matrix()
    root = np.asarray(still.joints[0])
    for before, after in ((still.vertices, moved.vertices), (still.joints, moved.joints)):
        expected = (np.asarray(before) - root) @ rigid.T + root + shift
        assert np.abs(np.asarray(after) - expected).max() < 3 * bound(ATOL)


def test_gradients_at_the_zero_pose_are_finite_and_right():
    with jax.enable_x64(True):
        body = made_up_body(6)
        target = jnp.asarray(np.random.default_rng(0).normal(size=body.template.shape))

        def loss(betas, rotations):
            return jnp.sum(jnp.square(posed(body, betas, rotations, jnp.zeros(3)).vertices - target))

        betas, rotations = jnp.zeros(4), jnp.zeros((len(body.parents), 3))
        for index, at in enumerate((betas, rotations)):
            gradient = jax.jit(jax.grad(loss, index))(betas, rotations)
            assert np.isfinite(gradient).all()
            direction = jnp.asarray(np.random.default_rng(1).normal(size=at.shape))
            step = 1e-5
            ends = [[x + (s * step * direction if i == index else 0) for i, x in enumerate((betas, rotations))] for s in (1, -1)]
            numeric = (loss(*ends[0]) - loss(*ends[1])) / (2 * step)
            assert np.isclose(jnp.sum(gradient * direction), numeric, rtol=1e-7)


def test_joints_follow_the_shape():
    body = made_up_body(7, dtype=np.float32)
    betas = jnp.asarray([0.7, -2.0, 0.3, 1.0])
    rest = shape_body(body, betas)
    assert np.allclose(rest.joints, np.asarray(body.joint_regressor) @ np.asarray(rest.vertices), atol=ATOL)
    mean = shape_body(body, jnp.zeros(4))
    assert np.abs(np.asarray(rest.joints - mean.joints)).max() > 0.05


def test_missing_coefficients_are_zero_and_surplus_ones_refused():
    body = made_up_body(8, dtype=np.float32)
    short = shape_body(body, jnp.asarray([0.5]))
    padded = shape_body(body, jnp.asarray([0.5, 0, 0, 0]))
    assert np.allclose(short.vertices, padded.vertices, atol=ATOL)
    with pytest.raises(ValueError, match="5 shape coefficients, but body"):
        shape_body(body, jnp.zeros(5))


def test_vmap_over_shapes_and_poses_equals_a_loop():
    body = made_up_body(5, dtype=np.float32)
    cases = [(np.random.default_rng(i).normal(size=4), *random_pose(i)) for i in range(3)]
    batched = [jnp.asarray(np.stack(x), jnp.float32) for x in zip(*cases, strict=True)]
    found = jax.jit(jax.vmap(posed, (None, 0, 0, 0)))(body, *batched)
    for i, case in enumerate(cases):
        one = posed(body, *case)
        assert np.allclose(found.vertices[i], one.vertices, atol=ATOL)
        assert np.allclose(found.joint_transforms[i], one.joint_transforms, atol=ATOL)
