"""Texture lookup against a plain loop."""

import jax
import jax.numpy as jnp
import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from humangs_jax.rendering.mesh.rasterizer import sample_texture

ROUNDING = 2e-6
"""Texel positions of up to 16 texels in float32, times color steps of up to 1."""
UPPER_LEFT, LOWER_RIGHT = (0.0, 1.0), (1.0, 0.0)


def lookup(texture, u, v):
    """Bilinear, texel by texel, v up, border repeated."""
    height, width = texture.shape[:2]
    x, y = np.clip(u * width - 0.5, 0, width - 1), np.clip((1 - v) * height - 0.5, 0, height - 1)
    total = 0
    for row in range(height):
        for column in range(width):
            total = total + max(0, 1 - abs(x - column)) * max(0, 1 - abs(y - row)) * texture[row, column]
    return total


@settings(max_examples=8, deadline=None)
@given(st.integers(0, 10_000))
def test_lookup_equals_loop(seed):
    rng = np.random.default_rng(seed)
    texture, uv = rng.uniform(size=(3, 5, 2)).astype(np.float32), rng.uniform(-0.3, 1.3, (4, 6, 2)).astype(np.float32)
    expected = [[lookup(texture.astype(np.float64), *uv[i, j]) for j in range(6)] for i in range(4)]
    np.testing.assert_allclose(sample_texture(jnp.asarray(texture), jnp.asarray(uv)), expected, atol=ROUNDING)


def test_corners_of_the_texture():
    texture = jnp.arange(12.0).reshape(3, 4, 1)
    uv = jnp.asarray([[UPPER_LEFT, LOWER_RIGHT, (0.0, 0.0), (1.0, 1.0)]])
    np.testing.assert_array_equal(sample_texture(texture, uv)[0, :, 0], [0, 11, 8, 3])


def test_a_texture_of_one_texel():
    image = sample_texture(jnp.full((1, 1, 3), 0.25), jnp.asarray([[[0.2, 0.7], [-3.0, 9.0]]]))
    np.testing.assert_array_equal(image, 0.25)


def test_gradient_is_the_weights_of_the_texels():
    texture, uv = jnp.zeros((4, 4, 1)), jnp.asarray([[[0.5, 0.5], [0.0, 0.0]]])
    gradient = jax.grad(lambda t: sample_texture(t, uv).sum())(texture)[..., 0]
    expected = np.zeros((4, 4))
    expected[1:3, 1:3] = 0.25
    expected[3, 0] = 1
    np.testing.assert_allclose(gradient, expected, atol=ROUNDING)


def test_float64():
    with jax.enable_x64(True):
        texture, uv = np.random.default_rng(0).uniform(size=(3, 5, 2)), np.random.default_rng(1).uniform(size=(1, 2, 2))
        image = sample_texture(jnp.asarray(texture), jnp.asarray(uv))
        assert image.dtype == jnp.float64
        np.testing.assert_allclose(image[0], [lookup(texture, *point) for point in uv[0]], atol=1e-14)
