"""Texture lookup against a plain loop, and images whose pixels are known."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from humangs_jax.geometry.camera import Camera, orbit
from humangs_jax.rendering.mesh.texturing import render_textured_mesh, sample_texture

ROUNDING = 2e-6
"""Texel positions of up to 16 texels in float32, times colour steps of up to 1."""
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


WIDTH, HEIGHT = 9, 7
UVS = jnp.asarray([UPPER_LEFT, (1.0, 1.0), (0.0, 0.0), LOWER_RIGHT])
FACES = jnp.asarray([[0, 1, 2], [1, 3, 2]])


def rectangle(left, top, right, bottom, depth=1.0):
    """Seen by `flat_camera` with these edges, in pixels; texture upright."""
    corners = jnp.asarray([[left, top, 1.0], [right, top, 1.0], [left, bottom, 1.0], [right, bottom, 1.0]])
    return corners * depth


def flat_camera():
    return Camera.from_opencv(np.eye(3), np.eye(4), WIDTH, HEIGHT)


@pytest.mark.slow
def test_a_texel_per_pixel_gives_the_texture_back():
    texture = jax.random.uniform(jax.random.key(0), (HEIGHT, WIDTH, 3))
    vertices = rectangle(0, 0, WIDTH, HEIGHT, depth=2.0)
    rgb, alpha, depth = render_textured_mesh(vertices, FACES, UVS, FACES, texture, flat_camera())
    np.testing.assert_allclose(rgb, texture, atol=10 * ROUNDING)
    np.testing.assert_array_equal(alpha, 1)
    np.testing.assert_allclose(depth, 2, rtol=1e-6)


def test_supersampling_measures_coverage():
    """A rectangle from 2.25 to 6.5 by 1.5 to 4.75 pixels: covered shares are quarters, which 4 x 4 samples find exactly."""
    texture = jnp.broadcast_to(jnp.asarray([0.2, 0.4, 0.6]), (2, 2, 3))
    background = jnp.asarray([1.0, 0.0, 0.5])
    vertices = rectangle(2.25, 1.5, 6.5, 4.75, depth=3.0)
    rgb, alpha, depth = render_textured_mesh(
        vertices, FACES, UVS, FACES, texture, flat_camera(), background=background, supersample=4
    )
    along_x, along_y = np.array([0, 0, 0.75, 1, 1, 1, 0.5, 0, 0]), np.array([0, 0.5, 1, 1, 0.75, 0, 0])
    expected = np.outer(along_y, along_x)
    np.testing.assert_allclose(alpha, expected, atol=ROUNDING)
    mixed = expected[..., None] * [0.2, 0.4, 0.6] + (1 - expected[..., None]) * [1.0, 0.0, 0.5]
    np.testing.assert_allclose(rgb, mixed, atol=ROUNDING)
    np.testing.assert_allclose(depth, np.where(expected > 0, 3.0, 0.0), rtol=1e-6)


@pytest.mark.slow
def test_supersampling_is_the_mean_of_a_finer_image():
    supersample = 3
    texture = jax.random.uniform(jax.random.key(1), (5, 5, 3))
    vertices = jnp.asarray([[-1, -1, 2.0], [1, -0.8, 1.5], [-0.7, 1, 1.8], [1.1, 0.9, 2.5]])
    camera = Camera.from_opencv([[6, 0, 4.4], [0, 6, 3.6], [0, 0, 1]], np.eye(4), WIDTH, HEIGHT)
    fine = camera.resized(WIDTH * supersample, HEIGHT * supersample)
    rgb, alpha, _ = render_textured_mesh(vertices, FACES, UVS, FACES, texture, camera, supersample=supersample)
    fine_rgb, fine_alpha, _ = render_textured_mesh(vertices, FACES, UVS, FACES, texture, fine)
    mean = lambda x: x.reshape(HEIGHT, supersample, WIDTH, supersample, -1).mean((1, 3))
    np.testing.assert_allclose(rgb, mean(fine_rgb), atol=ROUNDING)
    np.testing.assert_allclose(alpha, mean(fine_alpha)[..., 0], atol=ROUNDING)
    assert ((alpha > 0) & (alpha < 1)).any()


@pytest.mark.slow
def test_vmap_over_views_and_gradient_of_the_texture():
    texture = jax.random.uniform(jax.random.key(2), (4, 4, 3))
    K = jnp.asarray([[8.0, 0, 4.5], [0, 8.0, 3.5], [0, 0, 1]])
    cameras = orbit(jnp.zeros(3), 3.0, jnp.asarray([0.0, 0.7]), 0.1, K, WIDTH, HEIGHT)
    vertices = jnp.asarray([[-1, 1, 0.0], [1, 1, 0], [-1, -1, 0], [1, -1, 0]])

    def drawn(texture):
        draw = lambda camera: render_textured_mesh(vertices, FACES, UVS, FACES, texture, camera)
        return jax.vmap(draw)(cameras)

    def total(texture):
        rgb, alpha, _ = drawn(texture)
        return rgb.sum(), (rgb, alpha)

    gradient, (rgb, alpha) = jax.jit(jax.grad(total, has_aux=True))(texture)
    one = render_textured_mesh(vertices, FACES, UVS, FACES, texture, cameras[1])
    np.testing.assert_allclose(rgb[1], one[0], atol=1e-5)
    # every covered sample hands its unit of gradient to the texels
    np.testing.assert_allclose(gradient.sum(), 3 * alpha.sum(), rtol=1e-5)


def test_float64():
    with jax.enable_x64(True):
        texture, uv = np.random.default_rng(0).uniform(size=(3, 5, 2)), np.random.default_rng(1).uniform(size=(1, 2, 2))
        image = sample_texture(jnp.asarray(texture), jnp.asarray(uv))
        assert image.dtype == jnp.float64
        np.testing.assert_allclose(image[0], [lookup(texture, *point) for point in uv[0]], atol=1e-14)
