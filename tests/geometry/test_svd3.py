import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rounding import bound

from humangs_jax.geometry.quaternion import left_singular_vectors

FLOAT32_TOLERANCE = 2e-5  # a dozen roundings of 6e-8 in each of six sweeps, relative to the largest singular value
FLOAT64_TOLERANCE = 1e-13


@pytest.mark.slow
@pytest.mark.parametrize(("dtype", "tolerance"), [(np.float32, FLOAT32_TOLERANCE), (np.float64, FLOAT64_TOLERANCE)])
@settings(deadline=None, max_examples=20)
@given(seed=st.integers(0, 2**31), stretch=st.floats(0, 6))
def test_factors_rebuild_the_gram_matrix(dtype, tolerance, seed, stretch):
    rng = np.random.default_rng(seed)
    m = (rng.normal(size=(7, 3, 3)) * 10.0 ** rng.uniform(-stretch, 0, (7, 1, 3))).astype(dtype)
    with jax.enable_x64(dtype == np.float64):
        u, s = map(np.asarray, left_singular_vectors(jnp.asarray(m)))
    gram = np.einsum("bik,bjk->bij", m.astype(np.float64), m.astype(np.float64))
    rebuilt = np.einsum("bik,bk,bjk->bij", u.astype(np.float64), s.astype(np.float64) ** 2, u.astype(np.float64))
    scale = np.abs(gram).max(axis=(1, 2), keepdims=True)
    assert np.abs(rebuilt - gram).max() <= bound(tolerance) * scale.max()
    assert np.abs(np.einsum("bki,bkj->bij", u, u) - np.eye(3)).max() < bound(tolerance) * 10
    assert np.allclose(np.linalg.det(u), 1, atol=tolerance * 10)
    expected = np.linalg.svd(m.astype(np.float64), compute_uv=False)
    assert np.allclose(np.sort(s, -1)[:, ::-1], expected, rtol=0, atol=tolerance * expected.max())


@pytest.mark.parametrize(
    "m", [np.zeros((3, 3)), np.eye(3), np.outer([1, 2, 3], [1, 0, 1]), np.diag([1, 1e-20, 0]), -np.eye(3)]
)
def test_degenerate_matrices_give_rotations(m):
    u, s = map(np.asarray, left_singular_vectors(jnp.asarray(m, jnp.float32)))
    assert np.allclose(u.T @ u, np.eye(3), atol=FLOAT32_TOLERANCE) and np.isclose(
        np.linalg.det(u), 1, atol=FLOAT32_TOLERANCE
    )
    assert np.allclose(u @ np.diag(s**2) @ u.T, m @ m.T, atol=FLOAT32_TOLERANCE * max(1, np.abs(m @ m.T).max()))
