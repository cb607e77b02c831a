"""Lenses of cameras: OpenCV's formulas, their range, what is drawn, and cameras moved by twists."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from splat_scenes import HEIGHT, WIDTH, camera, random_gaussians, with_harmonics

from humangs_jax.core.pytree import replace
from humangs_jax.geometry import lens, transform
from humangs_jax.geometry.camera import Camera, pixel_rays, project, stack_cameras
from humangs_jax.rendering.projection import project_gaussians
from humangs_jax.rendering.reference import render_reference
from humangs_jax.rendering.splat_config import SplatConfig
from humangs_jax.rendering.splatting import render

EXACT = 1e-12
FLOAT64 = 1e-9
"""Error after compositing, relative to the largest entry."""
RADIAL = (-0.12, 0.03, 0.01, -0.02, -0.004)
RATIONAL = (*RADIAL, 0.05, -0.02, 0.006, 0.002, -0.001, 0.003, 0.0005)
FISHEYE = (0.05, -0.02, 0.008, -0.001)
LENSES = {
    "radial": ("pinhole", RADIAL[:4]),
    "rational and prism": ("pinhole", RATIONAL),
    "fisheye": ("fisheye", FISHEYE),
    "plain fisheye": ("fisheye", None),
    "orthographic": ("orthographic", None),
}
CONFIG = SplatConfig(block=4, chunk=4, max_pairs=2000)


def lensed(kind, view):
    name, coefficients = LENSES[kind]
    coefficients = None if coefficients is None else jnp.asarray(coefficients, view.K.dtype)
    K = view.K.at[:2, :2].multiply(0.3) if name == "orthographic" else view.K
    return replace(view, lens=name, distortion=coefficients, K=K)


def opencv(points, name, c):
    """Returns cv2.projectPoints or cv2.fisheye.projectPoints for K = 1, by OpenCV's manual."""
    x, y = points[:, 0] / points[:, 2], points[:, 1] / points[:, 2]
    r = np.hypot(x, y)
    if name == "orthographic":
        return points[:, :2]
    if name == "fisheye":
        t = np.arctan(r)
        k = np.zeros(4) if c is None else np.asarray(c)
        bent = t * (1 + k @ np.stack([t**2, t**4, t**6, t**8]))
        return np.stack([x, y], axis=-1) * np.where(r > 0, bent / np.where(r > 0, r, 1), 1)[:, None]
    k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4 = [*c, *[0.0] * 12][:12]
    radial = (1 + k1 * r**2 + k2 * r**4 + k3 * r**6) / (1 + k4 * r**2 + k5 * r**4 + k6 * r**6)
    across = 2 * p1 * x * y + p2 * (r**2 + 2 * x**2), p1 * (r**2 + 2 * y**2) + 2 * p2 * x * y
    prism = s1 * r**2 + s2 * r**4, s3 * r**2 + s4 * r**4
    moved = [a * radial + b + c for a, b, c in zip((x, y), across, prism, strict=True)]
    return np.stack(moved, axis=-1)


@pytest.mark.parametrize("kind", LENSES)
def test_points_fall_where_opencv_puts_them_and_footprints_turn_with_them(kind):
    """The covariance of a tiny Gaussian is found by differences of projected points."""
    with jax.enable_x64(True):
        view = lensed(kind, camera())
        gaussians = random_gaussians(0)
        points = np.asarray(gaussians.means)
        points = points[points[:, 2] > 0.5]
        inside = transform.apply(view.cam_from_world, jnp.asarray(points))
        expected = opencv(np.asarray(inside), *LENSES[kind]) * np.diag(view.K)[:2]
        got, depths = project(view, jnp.asarray(points))
        np.testing.assert_allclose(got, expected + view.K[:2, 2], rtol=EXACT)
        np.testing.assert_allclose(depths, inside[:, 2], rtol=EXACT)

        h = 1e-5
        offsets = h * np.concatenate([np.eye(3), -np.eye(3)])
        seen = np.asarray(project(view, jnp.asarray(points[:, None] + offsets))[0])
        jacobian = np.swapaxes(seen[:, :3] - seen[:, 3:], 1, 2) / (2 * h)  # (n, 2, 3)
        tiny = jax.tree.map(lambda leaf: leaf[: len(points)], replace(gaussians, deformations=None))
        tiny = replace(tiny, means=jnp.asarray(points), scales=jnp.full((len(points), 3), 0.01))
        found = project_gaussians(tiny, view, SplatConfig(eps2d=0.0))
        covariance = 1e-4 * jacobian @ np.swapaxes(jacobian, 1, 2)
        drawn = np.asarray(found.visible)
        assert drawn.sum() > 20
        for entry, (i, j) in (("xx", (0, 0)), ("xy", (0, 1)), ("yy", (1, 1))):
            ours = np.asarray(getattr(found, entry))[drawn]
            np.testing.assert_allclose(ours, covariance[drawn, i, j], rtol=1e-6, atol=1e-6)


def test_no_distortion_is_the_pinhole_and_the_axis_of_a_fisheye_is_smooth():
    with jax.enable_x64(True):
        gaussians, view = random_gaussians(0), camera()
        plain = project_gaussians(gaussians, view)
        straight = project_gaussians(gaussians, replace(view, distortion=jnp.zeros(5)))
        for name in ("x", "y", "xx", "xy", "yy", "r00", "r01", "r11"):
            ours, expected = getattr(straight, name), getattr(plain, name)
            np.testing.assert_allclose(ours, expected, rtol=1e-9, atol=1e-12)
        near = jnp.asarray([0.0, 1e-9, 1e-4, 0.0316, 0.0317, 0.5])
        x, _, slopes = lens.distorted_with_slopes("fisheye", None, near, jnp.zeros(6))
        np.testing.assert_allclose(x, np.arctan(near), rtol=1e-13)
        np.testing.assert_allclose(slopes[0][0], 1 / (1 + near**2), rtol=1e-11)
        curved = jax.grad(lambda u: lens.distorted_with_slopes("fisheye", None, u, u)[2][0][0])
        assert np.isfinite(curved(0.0))


def test_what_a_lens_would_fold_back_is_not_drawn():
    """r (1 - 0.1 r^2) grows up to r^2 = 10 / 3; a fisheye without coefficients reaches all that is
    in front.
    """
    u = jnp.asarray([0.0, 1.0, 1.82, 1.84, 10.0, 1e30, jnp.nan])
    reached = lens.within_reach("pinhole", jnp.asarray([-0.1, 0.0, 0.0, 0.0]), u, 0 * u)
    assert reached.tolist() == [True, True, True, False, False, False, False]
    assert lens.within_reach("fisheye", None, u, 0 * u).tolist() == [True] * 6 + [False]
    view = replace(camera(np.float32), distortion=jnp.asarray([-0.1, 0.0, 0.0, 0.0]))
    gaussians = random_gaussians(0, np.float32)
    beside = replace(gaussians, means=gaussians.means.at[:, 0].set(1e3))
    assert not project_gaussians(beside, view).visible.any()


def all_gradients(draw, gaussians, view):
    weights = np.random.default_rng(7).normal(size=(HEIGHT, WIDTH, 3))

    def loss(gaussians, K, pose, distortion):
        seen = replace(view, K=K, cam_from_world=pose, distortion=distortion)
        rendering = draw(gaussians, seen, CONFIG)
        return jnp.sum(weights * rendering.rgb) + jnp.sum(rendering.depth), rendering

    numbers = gaussians, view.K, view.cam_from_world, view.distortion
    function = jax.jit(jax.value_and_grad(loss, argnums=(0, 1, 2, 3), has_aux=True))
    (_, rendering), gradients = function(*numbers)
    return rendering.rgb, rendering.depth, gradients


@pytest.mark.slow
@pytest.mark.parametrize("kind", LENSES)
def test_images_and_all_gradients_are_those_of_the_reference(kind):
    with jax.enable_x64(True):
        gaussians = with_harmonics(random_gaussians(3), 8)
        view = lensed(kind, camera())
        ours = all_gradients(render, gaussians, view)
        exact = all_gradients(render_reference, gaussians, view)
        for a, b in zip(jax.tree.leaves(ours), jax.tree.leaves(exact), strict=True):
            np.testing.assert_allclose(a, b, atol=FLOAT64 * np.abs(b).max())
        if view.distortion is not None:
            assert (np.asarray(ours[2][3])[:4] != 0).all()


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["rational and prism", "fisheye", "orthographic"])
def test_gradients_through_a_lens_are_derivatives(kind):
    """The direction moves means, K, pose and coefficients; nothing is close to a decision."""
    with jax.enable_x64(True):
        smooth = SplatConfig(
            block=4, chunk=4, max_pairs=2000, alpha_min=1e-9, transmittance_stop=0.0
        )
        gaussians = replace(random_gaussians(4), opacities=jnp.full(32, 0.3))
        view, rng = lensed(kind, camera()), np.random.default_rng(1)
        numbers = gaussians.means, view.K, view.cam_from_world, view.distortion
        steps = jax.tree.map(lambda x: rng.normal(size=x.shape), numbers)
        steps[0][9:11] = 0  # behind the camera, and at the near plane
        weights = rng.normal(size=(HEIGHT, WIDTH, 3))

        def along(t):
            means, K, pose, c = jax.tree.map(lambda x, d: x + t * d, numbers, steps)
            seen = replace(view, K=K, cam_from_world=pose, distortion=c)
            return jnp.sum(weights * render(replace(gaussians, means=means), seen, smooth).rgb)

        value = jax.jit(along)
        h = 1e-6
        measured = (value(h) - value(-h)) / (2 * h)
        np.testing.assert_allclose(jax.jit(jax.grad(along))(0.0), measured, rtol=1e-5)


def test_cameras_check_and_keep_their_lens():
    K, pose = np.diag([20.0, 20.0, 1.0]), np.eye(4)
    seen = Camera.from_opencv(K, pose, 8, 6, FISHEYE, "fisheye")
    assert seen.lens == "fisheye" and seen.distortion.shape == (4,) and not seen.is_plain
    half = seen.resized(4, 3)
    np.testing.assert_array_equal(half.distortion, seen.distortion)
    assert stack_cameras([seen, seen])[1].lens == "fisheye"
    with pytest.raises(ValueError, match=r"pinhole lens: expected 4 or 5 or 8 or 12.*got 6"):
        Camera.from_opencv(K, pose, 8, 6, np.zeros(6))
    with pytest.raises(
        ValueError, match="lens: expected pinhole, fisheye, orthographic, got 'eye'"
    ):
        Camera.from_opencv(K, pose, 8, 6, lens="eye")
    with pytest.raises(ValueError, match="orthographic lens: expected none, got 4"):
        Camera.from_opencv(K, pose, 8, 6, FISHEYE, "orthographic")
    with pytest.raises(ValueError, match="finite"):
        Camera.from_opencv(K, pose, 8, 6, [np.nan, 0, 0, 0])
    with pytest.raises(ValueError, match="lenses differ"):
        stack_cameras([seen, Camera.from_opencv(K, pose, 8, 6)])
    with pytest.raises(ValueError, match=r"pixel_rays is for pinhole.*a lens that is fisheye"):
        pixel_rays(seen)


def test_an_orthographic_camera_in_other_units_sees_the_same():
    with jax.enable_x64(True):
        view = lensed("orthographic", camera())
        points = jnp.asarray(np.random.default_rng(0).uniform(1, 2, (5, 3)))
        there, _ = project(view.in_units(2.5), points / 2.5)
        np.testing.assert_allclose(there, project(view, points)[0], rtol=EXACT)


def test_twists_are_the_exponential_of_rigid_motions():
    from scipy.linalg import expm

    with jax.enable_x64(True):
        exponential = jax.jit(transform.from_twist)
        for size in (0.0, 1e-9, 1e-3, 0.3, 0.6, 3.0):
            twist = size * np.random.default_rng(1).normal(size=6)
            x, y, z = twist[:3]
            generator = np.zeros((4, 4))
            generator[:3, :3] = [[0, -z, y], [z, 0, -x], [-y, x, 0]]
            generator[:3, 3] = twist[3:]
            ours = exponential(jnp.asarray(twist))
            np.testing.assert_allclose(ours, expm(generator), atol=1e-13)
        slope = jax.jit(jax.jacrev(transform.from_twist))(jnp.zeros(6))
        assert np.isfinite(slope).all()
        np.testing.assert_array_equal(slope[:3, 3, 3:], np.eye(3))
        moved = camera().moved(jnp.asarray([0.1, -0.2, 0.3, 0.4, 0.5, 0.6]))
        R = np.asarray(moved.cam_from_world[:3, :3])
        np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-14)
