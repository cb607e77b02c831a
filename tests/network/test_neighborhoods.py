import jax
import jax.numpy as jnp
import numpy as np
import pytest

from humangs_jax.network.bilinear import sample_bilinear, sample_neighborhoods

FLOAT64_TOLERANCE = 1e-12
"""The same sums in another order."""
HEIGHT, WIDTH, CHANNELS, FEATURES = 5, 7, 3, 4


def convolved(grid, kernel, bias):
    """3x3, zeros outside, by the definition."""
    padded = np.pad(grid, ((1, 1), (1, 1), (0, 0)))
    taps = [padded[a : a + HEIGHT, b : b + WIDTH] @ kernel[a, b] for a in range(3) for b in range(3)]
    return sum(taps) + bias


@pytest.mark.slow
@pytest.mark.parametrize("where", ["inside", "border", "corners", "outside"])
def test_reading_before_the_convolution_is_reading_after_it(where):
    rng = np.random.default_rng(0)
    grid = rng.normal(size=(HEIGHT, WIDTH, CHANNELS))
    kernel, bias = rng.normal(size=(3, 3, CHANNELS, FEATURES)), rng.normal(size=FEATURES)
    positions = {
        "inside": rng.uniform([1, 1], [WIDTH - 2, HEIGHT - 2], (40, 2)),
        "border": rng.uniform([-1.5, -1.5], [WIDTH + 0.5, HEIGHT + 0.5], (200, 2)),
        "corners": np.asarray([[x, y] for x in (-1, -0.5, 0, WIDTH - 1, WIDTH - 0.5) for y in (-0.99, 0, HEIGHT - 1)]),
        "outside": np.asarray([[-1.0, 2], [3, HEIGHT], [1e9, 0], [-1e30, 3], [np.inf, 1], [2, np.nan]]),
    }[where]
    with jax.enable_x64(True):
        neighborhoods, coverages = sample_neighborhoods(jnp.asarray(grid), jnp.asarray(positions))
        ours = neighborhoods @ kernel.reshape(-1, FEATURES) + coverages[:, None] * bias
        expected = sample_bilinear(jnp.asarray(convolved(grid, kernel, bias)), jnp.asarray(positions))
    assert np.abs(ours - expected).max() < FLOAT64_TOLERANCE
    assert (np.abs(ours).max() > 0) == (where != "outside")


@pytest.mark.slow
def test_gradients_are_finite_wherever_one_reads():
    positions = jnp.asarray([[2.0, 2.0], [-1.0, 0.0], [-0.5, 4.5], [1e30, 0], [np.nan, 1], [WIDTH - 1, HEIGHT - 1]])
    grid = jnp.asarray(np.random.default_rng(1).normal(size=(HEIGHT, WIDTH, CHANNELS)), jnp.float32)
    total = lambda grid, positions: sum(jnp.sum(jnp.sin(x)) for x in sample_neighborhoods(grid, positions))
    of_grid, of_positions = jax.grad(total, (0, 1))(grid, positions)
    assert np.isfinite(of_grid).all() and np.isfinite(of_positions).all()
    assert np.array_equal(of_positions[3:5], np.zeros((2, 2))) and np.abs(of_grid).max() > 0
