"""Quaternions, rotation matrices, and singular values of 3x3 matrices."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rounding import bound
from scipy.spatial.transform import Rotation, Slerp

from humangs_jax.geometry import quaternion
from humangs_jax.geometry.quaternion import left_singular_vectors

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
    # a + b, 0.01 long, has five digits
    assert close(turned, b, atol=1e-4 if case == "almost opposite" else 1e-5)
    assert close(jnp.linalg.norm(q, axis=-1), jnp.ones(batch))
    assert np.all(q[..., 0] >= 0)  # at most half a turn
    if case == "same":
        assert close(q, jnp.broadcast_to(jnp.asarray(quaternion.IDENTITY), q.shape), atol=1e-5)


def test_half_turns_convert_back():
    q = jnp.eye(4)[1:]
    assert close(jnp.abs(quaternion.from_matrix(quaternion.to_matrix(q))), q)


@given(seeds, st.floats(-7, 1))
def test_axis_angle_agrees_with_the_matrix_exponential(seed, exponent):
    from scipy.linalg import expm

    v = np.random.default_rng(seed).normal(size=3)
    v *= 10.0**exponent / np.linalg.norm(v)
    skew = np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])
    m = quaternion.matrix_from_axis_angle(jnp.asarray(v, jnp.float32))
    assert close(m, expm(skew), atol=5e-6)
    assert close(
        quaternion.to_matrix(quaternion.from_axis_angle(jnp.asarray(v, jnp.float32))),
        expm(skew),
        atol=5e-6,
    )


def test_derivative_at_no_rotation_is_the_generator():
    both = lambda v: (quaternion.matrix_from_axis_angle(v), quaternion.from_axis_angle(v))
    matrix, q = jax.jit(jax.jacfwd(both))(jnp.zeros(3))
    assert close(matrix[..., 2], jnp.asarray([[0, -1.0, 0], [1, 0, 0], [0, 0, 0]])) and close(
        q[1:], 0.5 * jnp.eye(3)
    )


@pytest.mark.slow
def test_zero_quaternion_is_the_identity_with_finite_gradient():
    assert close(quaternion.normalize(jnp.zeros(4)), jnp.asarray(quaternion.IDENTITY))
    gradient = jax.grad(lambda q: quaternion.to_matrix(quaternion.normalize(q)).sum())(jnp.zeros(4))
    assert np.isfinite(gradient).all()
    assert np.isfinite(jax.grad(lambda m: quaternion.from_matrix(m).sum())(jnp.eye(3))).all()


def test_interpolation_goes_the_shortest_way_at_an_even_speed():
    """Expected is scipy's Slerp, through half a turn and between distant rotation vectors of nearly
    one rotation.
    """
    rng = np.random.default_rng(5)
    a, b = rng.normal(0, 1.5, (2, 20, 3)).astype(np.float32)
    a[0], b[0] = [0, 3.1, 0], [0, -3.1, 0]
    a[1], b[1] = 0, 0
    share = np.linspace(0, 1, 20, dtype=np.float32)
    got = Rotation.from_rotvec(np.asarray(jax.jit(quaternion.interpolate)(a, b, share)))
    ways = [
        Slerp([0, 1], Rotation.from_rotvec([x, y]))(t) for x, y, t in zip(a, b, share, strict=True)
    ]
    assert max((one.inv() * other).magnitude() for one, other in zip(got, ways, strict=True)) < 1e-5


FLOAT32_TOLERANCE = (
    2e-5  # a dozen roundings of 6e-8 in each of six sweeps, relative to the largest singular value
)
FLOAT64_TOLERANCE = 1e-13


@pytest.mark.slow
@pytest.mark.parametrize(
    ("dtype", "tolerance"), [(np.float32, FLOAT32_TOLERANCE), (np.float64, FLOAT64_TOLERANCE)]
)
@settings(deadline=None, max_examples=20)
@given(seed=st.integers(0, 2**31), stretch=st.floats(0, 6))
def test_factors_rebuild_the_gram_matrix(dtype, tolerance, seed, stretch):
    rng = np.random.default_rng(seed)
    m = (rng.normal(size=(7, 3, 3)) * 10.0 ** rng.uniform(-stretch, 0, (7, 1, 3))).astype(dtype)
    with jax.enable_x64(dtype == np.float64):
        u, s = map(np.asarray, left_singular_vectors(jnp.asarray(m)))
    gram = np.einsum("bik,bjk->bij", m.astype(np.float64), m.astype(np.float64))
    rebuilt = np.einsum(
        "bik,bk,bjk->bij", u.astype(np.float64), s.astype(np.float64) ** 2, u.astype(np.float64)
    )
    scale = np.abs(gram).max(axis=(1, 2), keepdims=True)
    assert np.abs(rebuilt - gram).max() <= bound(tolerance) * scale.max()
    assert np.abs(np.einsum("bki,bkj->bij", u, u) - np.eye(3)).max() < bound(tolerance) * 10
    assert np.allclose(np.linalg.det(u), 1, atol=tolerance * 10)
    expected = np.linalg.svd(m.astype(np.float64), compute_uv=False)
    assert np.allclose(np.sort(s, -1)[:, ::-1], expected, rtol=0, atol=tolerance * expected.max())


def test_degenerate_matrices_give_rotations():
    cases = np.stack(
        [
            np.zeros((3, 3)),
            np.eye(3),
            np.outer([1, 2, 3], [1, 0, 1]),
            np.diag([1, 1e-20, 0]),
            -np.eye(3),
        ]
    )
    for m, u, s in zip(
        cases,
        *map(np.asarray, jax.jit(left_singular_vectors)(jnp.asarray(cases, jnp.float32))),
        strict=True,
    ):
        assert np.allclose(u.T @ u, np.eye(3), atol=FLOAT32_TOLERANCE) and np.isclose(
            np.linalg.det(u), 1, atol=FLOAT32_TOLERANCE
        )
        assert np.allclose(
            u @ np.diag(s**2) @ u.T, m @ m.T, atol=FLOAT32_TOLERANCE * max(1, np.abs(m @ m.T).max())
        )
