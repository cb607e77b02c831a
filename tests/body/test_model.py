import jax
import jax.numpy as jnp
import numpy as np
import pytest
from body_cases import made_up_body, oracle, random_pose
from rounding import bound

from humangs_jax.body.model import BodyPose, pose_body, rest_pose, shape_body

EXACT = 1e-12  # float64 against float64
ATOL = 1e-5  # float32, coordinates of about 3 m with correctives of 54 terms


@jax.jit
def posed(body, betas, rotations, translation):
    dtype = body.template.dtype
    pose = BodyPose(jnp.asarray(rotations, dtype), jnp.asarray(translation, dtype))
    return pose_body(body, shape_body(body, jnp.asarray(betas, dtype)), pose)


@pytest.mark.parametrize("pose_directions", [True, False])
def test_vertices_joints_and_transforms_agree_with_the_oracle(pose_directions):
    betas = np.asarray([0.5, -1.0, 2.0])
    rotations, translation = random_pose(3)
    for x64, exact in ((True, EXACT), (False, bound(ATOL))):
        with jax.enable_x64(x64):
            body = made_up_body(1, pose_directions=pose_directions)
            expected = oracle(body, betas, rotations, translation)
            found = posed(body, betas, rotations, translation)
            for a, b in zip(
                (found.vertices, found.joints, found.joint_transforms), expected, strict=True
            ):
                assert a.dtype == (jnp.float64 if x64 else jnp.float32)
                assert np.abs(np.asarray(a) - b).max() < exact


def test_gradients_at_the_zero_pose_are_finite_and_right():
    with jax.enable_x64(True):
        body = made_up_body(6)
        target = jnp.asarray(np.random.default_rng(0).normal(size=body.template.shape))

        @jax.jit
        def loss(numbers):
            betas, rotations = numbers[:4], numbers[4:].reshape(-1, 3)
            return jnp.sum(
                jnp.square(posed(body, betas, rotations, jnp.zeros(3)).vertices - target)
            )

        zero = jnp.zeros(4 + rest_pose(body).rotations.size)
        gradient = jax.grad(loss)(zero)
        direction, step = jnp.asarray(np.random.default_rng(1).normal(size=zero.shape)), 1e-5
        numeric = (loss(step * direction) - loss(-step * direction)) / (2 * step)
        assert np.isclose(jnp.sum(gradient * direction), numeric, rtol=1e-7)


def test_missing_coefficients_are_zero_and_surplus_ones_refused():
    body = made_up_body(8, dtype=np.float32)
    short, padded = (shape_body(body, jnp.asarray(betas)) for betas in ([0.5], [0.5, 0, 0, 0]))
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
