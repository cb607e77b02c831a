import jax
import jax.numpy as jnp
import numpy as np
import pytest

from humangs_jax.geometry.camera import Camera, intrinsics_from_fov, project
from humangs_jax.network.pixel_aligned import (
    DEPTH_TOLERANCE,
    dropped_reads,
    photo_colors,
    project_vertices,
    sum_over_views,
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


def read_row(grid, positions):
    """A stand-in for a lookup: the first row of the map, plus the positions."""
    return {"row": grid[0, 0] + positions[:, :1], "first": positions[:, 0]}


def views_to_read(views=3, vertices=6):
    rng = np.random.default_rng(3)
    maps = jnp.asarray(rng.normal(size=(views, 2, 2, 4)), jnp.float32)
    positions = jnp.asarray(rng.normal(size=(views, vertices, 2)), jnp.float32)
    weights = jnp.asarray([[1.0, 0, 1, 0, 0, 1], [0, 0, 1, 1, 0, 0], [0, 0, 0, 0, 0, 0]])
    return maps, positions, weights


@pytest.mark.parametrize("capacity", [None, 6, 3])
def test_reads_are_summed_over_the_views_that_count(capacity):
    maps, positions, weights = views_to_read()
    sums = sum_over_views(read_row, maps, positions, weights, capacity)
    row = np.einsum("vn,vnc->nc", weights, maps[:, 0, 0][:, None] + positions[..., :1])
    assert np.allclose(sums["row"], row, atol=1e-6)
    assert np.allclose(sums["first"], np.sum(weights * positions[..., 0], axis=0), atol=1e-6)
    assert dropped_reads(weights, capacity) == 0


def test_reads_beyond_the_capacity_are_left_out_and_counted():
    maps, positions, weights = views_to_read()
    sums = sum_over_views(read_row, maps, positions, weights, 2)
    without_the_last = weights.at[0, 5].set(0)
    assert np.allclose(sums["row"], sum_over_views(read_row, maps, positions, without_the_last)["row"], atol=1e-6)
    assert dropped_reads(weights, 2) == 1 and dropped_reads(weights, 1) == 3


def test_gradients_of_reads_do_not_depend_on_the_capacity():
    maps, positions, weights = views_to_read()

    def gradient(capacity):
        total = lambda m, p: jnp.sum(jnp.sin(sum_over_views(read_row, m, p, weights, capacity)["row"]))
        return jax.grad(total, (0, 1))(maps, positions)

    for ours, reference in zip(gradient(4), gradient(None), strict=True):
        assert np.allclose(ours, reference, atol=1e-6) and np.abs(reference).max() > 0


@pytest.mark.slow
def test_photo_colors_are_grey_where_nothing_is_seen():
    images = jnp.zeros((2, 4, 4, 3)).at[0].set(jnp.asarray([1.0, 0, 0])).at[1].set(jnp.asarray([0, 0, 1.0]))
    pixels = jnp.full((2, 3, 2), 2.0)
    visible = jnp.asarray([[True, False, False], [True, True, False]])
    colors = photo_colors(images, pixels, visible, "half_pixel")
    assert np.allclose(colors, [[0.5, 0, 0.5], [0, 0, 1], [0.5, 0.5, 0.5]])
