"""Cameras, their transforms, and points along a curve."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from humangs_jax.geometry import camera as cameras
from humangs_jax.geometry.camera import Camera, pixel_rays, plucker_rays
from humangs_jax.geometry.transform import along_curve

ATOL = 1e-5
K = np.array([[100.0, 0, 16], [0, 110, 12], [0, 0, 1]])


def ring(n=5, size=32):
    intrinsics = cameras.intrinsics_from_fov(np.pi / 3, size, size)
    azimuths = jnp.linspace(0, 2 * np.pi, n, endpoint=False)
    return cameras.orbit(jnp.asarray([0.1, 0.9, 0.0]), 2.0, azimuths, 0.2, intrinsics, size, size)


def test_orbit_looks_at_its_target_right_side_up():
    for c in ring(3):
        uv, depth = cameras.project(c, jnp.asarray([[0.1, 0.9, 0.0], [0.1, 1.1, 0.0]]))
        assert np.allclose(uv[0], 16, atol=1e-3) and np.isclose(depth[0], 2, atol=ATOL)
        assert uv[1, 1] < uv[0, 1]  # y up in the world is up in the image, whose y points down
    front = ring()[0]
    uv, _ = cameras.project(front, jnp.asarray([[0.3, 0.9, 0.0]]))
    assert uv[0, 0] > 16  # seen from +z, the world's +x is on the right


def test_rays_pass_through_the_pixel_centres_they_belong_to():
    c = ring()[3]
    origin, directions = pixel_rays(c)
    assert np.allclose(c.world_from_cam @ c.cam_from_world, np.eye(4), atol=ATOL) and np.allclose(
        origin, c.center
    )
    assert np.allclose(np.linalg.norm(directions, axis=-1), 1, atol=ATOL)
    uv, _ = cameras.project(c, origin + 1.7 * directions[5, 9])
    assert np.allclose(uv, [9.5, 5.5], atol=1e-3)
    moment, direction = jnp.split(plucker_rays(c), 2, axis=-1)
    assert np.allclose(jnp.sum(moment * direction, -1), 0, atol=ATOL)
    assert np.allclose(moment[5, 9], np.cross(origin, direction[5, 9]), atol=ATOL)


def test_resizing_and_units_keep_the_image():
    c, point = ring()[1], jnp.asarray([0.2, 1.0, 0.1])
    uv, depth = cameras.project(c, point)
    other, _ = cameras.project(c.resized(64, 24), point)  # each axis by its own factor
    scaled, scaled_depth = cameras.project(c.in_units(0.5), point / 0.5)
    assert np.allclose(other, np.asarray(uv) * [2, 0.75], atol=1e-3)
    assert np.allclose(scaled, uv, atol=1e-3) and np.isclose(scaled_depth, depth / 0.5, atol=ATOL)


def test_from_opencv_is_traced_and_differentiated():
    def depth(K, matrix):
        return cameras.project(Camera.from_opencv(K, matrix, 32, 24), jnp.asarray([0.2, 1.0, 2.0]))[
            0
        ].sum()

    K32, matrix = jnp.asarray(K, jnp.float32), jnp.eye(4)
    value, (by_K, by_matrix) = jax.jit(jax.value_and_grad(depth, argnums=(0, 1)))(K32, matrix)
    np.testing.assert_allclose(value, depth(K32, matrix), rtol=1e-6)
    np.testing.assert_allclose(by_K[0, 0], 0.2 / 2, rtol=1e-6)
    assert np.abs(by_matrix[:3, 3]).max() > 1
    assert jax.vmap(lambda K: Camera.from_opencv(K, matrix, 32, 24))(
        jnp.stack([K32] * 3)
    ).K.shape == (3, 3, 3)
    with pytest.raises(ValueError, match=r"K: expected shape \(3, 3\)"):
        jax.jit(lambda K: Camera.from_opencv(K, matrix, 32, 24).K)(jnp.eye(4))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (dict(K=np.eye(4)), r"K: expected shape \(3, 3\)"),
        (dict(cam_from_world=np.eye(3)), r"cam_from_world: expected shape"),
        (dict(K=K * np.nan), "finite"),
        (dict(K=-K), "focal"),
        (dict(K=K.T), "expected"),
        (dict(cam_from_world=np.diag([0, 1, 1, 1.0])), "singular"),
        (dict(cam_from_world=np.diag([-1, 1, 1, 1.0])), "mirrored"),
        (dict(cam_from_world=2 * np.eye(4)), "scaled"),
        (dict(width=0), "at least 1"),
        (dict(K=K * 1e300), "at most 1e\\+07"),
    ],
)
def test_bad_cameras_are_refused_by_name(change, message):
    arguments = dict(K=K, cam_from_world=np.eye(4), width=32, height=24) | change
    with pytest.raises(ValueError, match=message):
        Camera.from_opencv(**arguments)


@pytest.mark.parametrize("kind", [np.asarray, jnp.asarray, np.ndarray.tolist])
def test_a_camera_keeps_float64_where_jax_has_it(kind):
    focal = 100.0 + 1e-9
    intrinsics, matrix = np.diag([focal, focal, 1.0]), np.eye(4)
    with jax.enable_x64(True):
        made = Camera.from_opencv(kind(intrinsics), kind(matrix), 32, 24)
        assert made.K.dtype == made.cam_from_world.dtype == jnp.float64 and made.K[0, 0] == focal
        traced = jax.jit(lambda K: Camera.from_opencv(K, matrix, 32, 24).K)(jnp.asarray(intrinsics))
        assert traced.dtype == jnp.float64 and traced[0, 0] == focal
        assert (
            Camera.from_opencv(
                intrinsics.astype(np.float32), matrix.astype(np.float32), 32, 24
            ).K.dtype
            == jnp.float32
        )
        assert cameras.intrinsics_from_fov(np.float64(0.7), 64, 48)[1, 1] == 24 / np.tan(0.35)
        around = cameras.orbit(jnp.zeros(3), 2.0, jnp.zeros(1), 0.1, made.K, 32, 24)
        assert around.cam_from_world.dtype == around.K.dtype == jnp.float64
    for single in (
        Camera.from_opencv(intrinsics, matrix, 32, 24),
        Camera.from_opencv(K.astype(np.float16), matrix, 32, 24),
    ):
        assert single.K.dtype == single.cam_from_world.dtype == jnp.float32


def test_sides_are_whole_numbers_of_pixels():
    """The check is called alone, because types are checked before it in tests."""
    sides = cameras._pixels(64.0, np.int64(48).item())
    assert sides == (64, 48) and all(type(side) is int for side in sides)
    for wrong in ((32.5, 24), (32, 24.5), (float("nan"), 24), (32, float("inf"))):
        with pytest.raises(
            (ValueError, OverflowError), match=r"whole numbers of pixels, got|at least 1"
        ):
            cameras._pixels(*wrong)


def test_stacking_needs_cameras_of_one_size():
    c = ring()[0]
    assert cameras.stack_cameras([c, c]).K.shape == (2, 3, 3)
    with pytest.raises(ValueError, match="sizes differ"):
        cameras.stack_cameras([c, c.resized(8, 8)])
    with pytest.raises(ValueError, match="no cameras"):
        cameras.stack_cameras([])


def test_the_field_of_view_is_an_argument_of_transformations_too():
    def focal(angle):
        return cameras.intrinsics_from_fov(angle, 64, 48)[1, 1]

    assert np.isclose(jax.jit(focal)(0.7), focal(0.7), rtol=1e-6)
    # of float32 differences
    assert np.isclose(jax.grad(focal)(0.7), (focal(0.701) - focal(0.699)) / 0.002, rtol=1e-2)


def test_neighbours_along_the_curve_are_neighbours_in_space():
    positions = jnp.asarray(np.random.default_rng(0).uniform(-1, 1, (512, 3)), jnp.float32)
    ranks = jax.jit(along_curve, static_argnums=1)(positions, 1.2)
    assert sorted(ranks.tolist()) == list(range(512))
    ordered = np.asarray(positions)[np.argsort(ranks)]
    steps = np.linalg.norm(np.diff(ordered, axis=0), axis=-1).mean()
    assert steps < 0.4 * np.linalg.norm(np.diff(positions, axis=0), axis=-1).mean()
    assert along_curve(
        jnp.asarray([[-9.0, -9.0, -9.0], [0.0, 0.0, 0.0], [9.0, 9.0, 9.0]]), 1.0
    ).tolist() == [0, 1, 2]
