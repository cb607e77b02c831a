import jax
import jax.numpy as jnp
import numpy as np
import pytest

from humangs_jax.geometry.camera import Camera, intrinsics_from_fov, project
from humangs_jax.sampling.pixel_aligned import (
    DEPTH_TOLERANCE,
    photo_colors,
    pool_views,
    project_vertices,
    sample_views,
    visible_vertices,
)

SIZE = (32, 16)
AXIS_CAMERA = Camera(intrinsics_from_fov(0.9, *SIZE), jnp.eye(4), *SIZE)
CONVENTIONS = ["half_pixel", "mixed"]


def test_projection_is_the_cameras():
    points = jnp.asarray(np.random.default_rng(0).uniform([-1, -1, 1], [1, 1, 3], (20, 3)), jnp.float32)
    pixels, depths = project_vertices(AXIS_CAMERA, points)
    expected, z = project(AXIS_CAMERA, points)
    assert np.allclose(pixels, expected, atol=1e-3) and np.allclose(depths, z)  # 1e-6 in z moves a pixel by 1e-5


@pytest.mark.parametrize("z", [0.0, -1e-6, 1e-6, -2e-6, 1e-30, -1.0, -1e-3])
def test_projection_is_finite_in_and_behind_the_camera_plane(z):
    points = jnp.asarray([[0.0, 0.0, z], [0.3, -0.2, z], [1e3, 1e3, z]])
    pixels, gradient = jax.vjp(lambda p: project_vertices(AXIS_CAMERA, p)[0], points)
    assert np.isfinite(pixels).all() and np.isfinite(gradient(jnp.ones_like(pixels))[0]).all()


@pytest.mark.parametrize("convention", CONVENTIONS)
def test_visibility(convention):
    depth_map = jnp.full(SIZE[::-1], -1.0).at[4:12, 8:24].set(2.0)
    pixels = jnp.asarray([[16.0, 8], [16, 8], [16, 8], [2, 2], [40, 8], [16, -1], [16, 8]])
    depths = jnp.asarray([2.0, 2 + 0.9 * DEPTH_TOLERANCE, 2 + 1.1 * DEPTH_TOLERANCE, 2, 2, 2, -1])
    expected = [True, True, False, False, False, False, False]  # seen, just so, hidden, background, outside x 2, behind
    assert np.array_equal(visible_vertices(pixels, depths, depth_map, SIZE, convention), expected)


def test_visibility_reads_the_pixel_that_holds_the_vertex():
    depth_map = jnp.full(SIZE[::-1], -1.0).at[7, 30].set(2.0)
    pixels, depths = jnp.asarray([[30.1, 7.9], [29.9, 7.5], [31.1, 7.5], [30.5, 8.1]]), jnp.full(4, 2.0)
    assert np.array_equal(visible_vertices(pixels, depths, depth_map, SIZE, "half_pixel"), [True, False, False, False])
    nearest = np.round(np.asarray(pixels) / SIZE * (np.asarray(SIZE) - 1))  # published
    expected = (nearest == [30, 7]).all(-1)
    assert np.array_equal(visible_vertices(pixels, depths, depth_map, SIZE, "mixed"), expected)


def test_pooling_averages_the_views_that_count():
    samples = jnp.asarray([[[1.0, 2], [3, 4]], [[5, 6], [7, 8]], [[9, 9], [9, 9]]])
    weights = jnp.asarray([[1.0, 0], [1, 0], [0, 0]])
    assert np.allclose(pool_views(samples, weights), [[3, 4], [0, 0]])


def test_photo_colors_are_grey_where_nothing_is_seen():
    samples = jnp.asarray([[[1.0, 0, 0], [1, 1, 1]], [[0, 0, 1], [1, 1, 1]]])
    colors = photo_colors(samples, jnp.asarray([[True, False], [True, False]]))
    assert np.allclose(colors, [[0.5, 0, 0.5], [0.5, 0.5, 0.5]])


@pytest.mark.parametrize("convention", CONVENTIONS)
def test_maps_are_read_at_the_projections(convention):
    maps = jnp.asarray(np.random.default_rng(2).random((2, 8, 16, 3)), jnp.float32)
    sampled = sample_views(maps, jnp.asarray([[[17.0, 9.0]], [[1.0, 1.0]]]), SIZE, convention)
    assert sampled.shape == (2, 1, 3)
    if convention == "half_pixel":
        assert np.allclose(sampled[:, 0], [maps[0, 4, 8], maps[1, 0, 0]], atol=1e-6)
    else:
        x, y = 17 / 32 * 15, 9 / 16 * 7
        a, b = x - 7, y - 3
        corner = lambda i, j: maps[0, 3 + j, 7 + i] * (a if i else 1 - a) * (b if j else 1 - b)
        assert np.allclose(sampled[0, 0], sum(corner(i, j) for i in (0, 1) for j in (0, 1)), atol=1e-5)
