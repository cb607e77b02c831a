import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation, Slerp

from humangs_jax.geometry import quaternion

ATOL = 2e-6  # products of a few float32 numbers of magnitude one
seeds = st.integers(0, 2**31)
batches = st.sampled_from([(), (1,), (3, 1, 2, 1)])


def unit(seed, batch):
    q = np.random.default_rng(seed).normal(size=(*batch, 4))
    return jnp.asarray(q / np.linalg.norm(q, axis=-1, keepdims=True), jnp.float32)


def close(a, b, atol=ATOL):
    a, b = np.asarray(a), np.asarray(b)
    return np.isfinite(a).all() and np.isfinite(b).all() and np.allclose(a, b, rtol=0, atol=atol)


@given(seeds, batches)
def test_multiplication_is_composition(seed, batch):
    p, q = unit(seed, batch), unit(seed + 1, batch)
    product = quaternion.to_matrix(quaternion.multiply(p, q))
    assert close(product, quaternion.to_matrix(p) @ quaternion.to_matrix(q))


@pytest.mark.slow
@given(seeds, batches)
def test_matrices_are_rotations_and_convert_back(seed, batch):
    q = unit(seed, batch)
    m = quaternion.to_matrix(q)
    assert close(m @ jnp.swapaxes(m, -1, -2), jnp.broadcast_to(jnp.eye(3), m.shape))
    back = quaternion.from_matrix(m)
    assert close(back * jnp.sign(jnp.sum(back * q, -1, keepdims=True)), q)


@pytest.mark.slow
@given(seeds, batches, st.sampled_from(["any", "same", "opposite", "almost opposite"]))
def test_between_turns_one_direction_into_the_other_the_short_way(seed, batch, case):
    a, b = (unit(seed + i, batch)[..., :3] for i in range(2))
    a, b = (x / jnp.linalg.norm(x, axis=-1, keepdims=True) for x in (a, b))
    b = {"any": b, "same": a, "opposite": -a, "almost opposite": -a + 0.01 * b}[case]
    b = b / jnp.linalg.norm(b, axis=-1, keepdims=True)
    q = quaternion.between(a, b)
    turned = jnp.einsum("...ij,...j->...i", quaternion.to_matrix(q), a)
    assert close(turned, b, atol=1e-4 if case == "almost opposite" else 1e-5)  # a + b, 0.01 long, has five digits
    assert close(jnp.linalg.norm(q, axis=-1), jnp.ones(batch))
    assert np.all(q[..., 0] >= 0)  # at most half a turn
    if case == "same":
        assert close(q, jnp.broadcast_to(jnp.asarray(quaternion.IDENTITY), q.shape), atol=1e-5)


@pytest.mark.parametrize("axis", range(3))
def test_half_turns_convert_back(axis):
    q = jnp.zeros(4).at[axis + 1].set(1.0)
    assert close(jnp.abs(quaternion.from_matrix(quaternion.to_matrix(q))), q)


@given(seeds, st.floats(-7, 1))
def test_axis_angle_agrees_with_the_matrix_exponential(seed, exponent):
    from scipy.linalg import expm

    v = np.random.default_rng(seed).normal(size=3)
    v *= 10.0**exponent / np.linalg.norm(v)
    skew = np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])
    m = quaternion.matrix_from_axis_angle(jnp.asarray(v, jnp.float32))
    assert close(m, expm(skew), atol=5e-6)
    assert close(quaternion.to_matrix(quaternion.from_axis_angle(jnp.asarray(v, jnp.float32))), expm(skew), atol=5e-6)


def test_derivative_at_no_rotation_is_the_generator():
    jacobian = jax.jacobian(quaternion.matrix_from_axis_angle)(jnp.zeros(3))
    assert close(jacobian[..., 2], jnp.asarray([[0, -1.0, 0], [1, 0, 0], [0, 0, 0]]))
    assert close(jax.jacobian(quaternion.from_axis_angle)(jnp.zeros(3))[1:], 0.5 * jnp.eye(3))


@pytest.mark.slow
def test_zero_quaternion_is_the_identity_with_finite_gradient():
    assert close(quaternion.normalize(jnp.zeros(4)), jnp.asarray(quaternion.IDENTITY))
    gradient = jax.grad(lambda q: quaternion.to_matrix(quaternion.normalize(q)).sum())(jnp.zeros(4))
    assert np.isfinite(gradient).all()
    assert np.isfinite(jax.grad(lambda m: quaternion.from_matrix(m).sum())(jnp.eye(3))).all()


def test_interpolation_goes_the_shortest_way_at_an_even_speed():
    """scipy's Slerp, through half a turn and between rotation vectors that are far apart but nearly one rotation."""
    rng = np.random.default_rng(5)
    a, b = rng.normal(0, 1.5, (2, 20, 3)).astype(np.float32)
    a[0], b[0] = [0, 3.1, 0], [0, -3.1, 0]
    a[1], b[1] = 0, 0
    share = np.linspace(0, 1, 20, dtype=np.float32)
    got = Rotation.from_rotvec(np.asarray(jax.jit(quaternion.interpolate)(a, b, share)))
    ways = [Slerp([0, 1], Rotation.from_rotvec([x, y]))(t) for x, y, t in zip(a, b, share, strict=True)]
    assert max((one.inv() * other).magnitude() for one, other in zip(got, ways, strict=True)) < 1e-5
