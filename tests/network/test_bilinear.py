import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from humangs_jax.network.bilinear import sample_bilinear, sample_nearest, texel_indices

RTOL32 = 1e-5
"""Three float32 products and sums of numbers of order one."""
RTOL64 = 1e-12


def oracle(grid, indices):
    """Sum over ALL texels of tent(x - i) tent(y - j): bilinear interpolation, zeros outside."""
    height, width, _ = grid.shape
    tent = lambda x: np.maximum(0, 1 - np.abs(x))
    wx, wy = tent(indices[:, :1] - np.arange(width)), tent(indices[:, 1:] - np.arange(height))
    return np.einsum("py,px,yxc->pc", wy, wx, grid)


@pytest.mark.parametrize(("height", "width"), [(1, 1), (1, 6), (5, 4)])
def test_agrees_with_a_sum_over_all_texels(height, width):
    rng = np.random.default_rng(height)
    grid = rng.normal(size=(height, width, 3))
    indices = rng.uniform(-2, 8, (60, 2))
    indices[:20] = np.round(indices[:20])  # on texel centres, edges and one texel outside
    with jax.enable_x64(True):
        ours = jax.jit(sample_bilinear)(jnp.asarray(grid), jnp.asarray(indices))
        assert ours.dtype == jnp.float64
        np.testing.assert_allclose(ours, oracle(grid, indices), rtol=RTOL64, atol=RTOL64)
    ours = jax.jit(sample_bilinear)(jnp.asarray(grid, jnp.float32), jnp.asarray(indices, jnp.float32))
    np.testing.assert_allclose(ours, oracle(grid, indices), rtol=RTOL32, atol=RTOL32)


def test_far_and_broken_positions_read_zero_with_zero_gradient():
    bad = [np.inf, -np.inf, np.nan, 1e30, -1e30, 3e9]
    positions = jnp.asarray([p for x in bad for p in ([x, 1.0], [1.0, x], [x, x])])
    read = lambda p: jnp.sum(sample_bilinear(jnp.ones((4, 5, 2)), p))
    values, gradients = jax.jit(jax.vmap(jax.value_and_grad(read)))(positions)
    assert np.array_equal(values, np.zeros(18)) and np.array_equal(gradients, np.zeros((18, 2)))
    assert np.array_equal(sample_nearest(jnp.ones((4, 5)), positions), np.zeros(18))


def test_gradients_agree_with_differences():
    rng = np.random.default_rng(1)
    with jax.enable_x64(True):
        grid, indices = jnp.asarray(rng.normal(size=(4, 5, 2))), jnp.asarray(rng.uniform(0.1, 2.9, (6, 2)))
        check_grads(jax.jit(sample_bilinear), (grid, indices), order=1, modes=("rev",), atol=1e-6, rtol=1e-6)


def test_nearest_rounds_halves_to_even():
    grid = jnp.arange(1.0, 7.0)[None]
    indices = jnp.asarray([[0.5, 0], [1.5, 0], [2.5, 0], [3.5, 0], [-0.5, 0], [5.5, 0], [2.0, 0.5], [2.0, 0.6]])
    assert np.array_equal(sample_nearest(grid, indices), [1, 3, 3, 5, 1, 0, 3, 0])


def test_conventions():
    """Half-pixel indices see the same image at every resolution; the mixed ones miss it by less than half a texel."""
    pixels = jnp.asarray([[0.5, 0.5], [8.0, 4.0], [15.5, 7.5]])
    half = texel_indices(pixels, (16, 8), (16, 8), "half_pixel")
    assert np.allclose(half, pixels - 0.5)
    assert np.allclose(texel_indices(pixels, (16, 8), (4, 2), "half_pixel"), pixels / 4 - 0.5)
    mixed = texel_indices(pixels, (16, 8), (4, 2), "mixed")
    ndc = pixels / jnp.asarray([16, 8]) * 2 - 1
    assert np.allclose(mixed, (ndc + 1) / 2 * jnp.asarray([3, 1]))
    assert np.allclose(mixed[1], texel_indices(pixels, (16, 8), (4, 2), "half_pixel")[1])  # equal in the middle only


def test_half_pixel_sampling_reproduces_a_ramp_at_any_resolution():
    ramp = lambda n, size: (jnp.arange(n) + 0.5) * size / n  # each texel holds its centre's pixel position
    pixels = jnp.asarray([[3.0, 5.0], [7.25, 2.0]])
    for n in (4, 16):
        grid = jnp.broadcast_to(ramp(n, 16.0)[None, :, None], (n, n, 1))
        sampled = jax.jit(sample_bilinear)(grid, texel_indices(pixels, (16, 16), (n, n), "half_pixel"))
        assert np.allclose(sampled[:, 0], pixels[:, 0], atol=1e-5)
