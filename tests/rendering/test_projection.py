"""EWA projection against the derivative of the pinhole camera.

It also covers places where float32 and gradients lose accuracy.
"""

import jax
import jax.numpy as jnp
import numpy as np
from rounding import bound
from splat_scenes import camera, few, random_gaussians

from humangs_jax.core.pytree import replace
from humangs_jax.geometry import camera as pinhole
from humangs_jax.geometry import quaternion, transform
from humangs_jax.rendering.gaussians import Gaussians, covariances
from humangs_jax.rendering.projection import project_gaussians
from humangs_jax.rendering.splat_config import EPS2D, SPLAT_PRESETS, SplatConfig
from humangs_jax.rendering.tiling import squared_reach

project = jax.jit(project_gaussians)

FLOAT64 = 1e-9
"""Rounding of float64, which grows by 1/z^2 near the camera."""

FLOAT32 = 1e-5


def test_covariance_is_that_of_the_linearised_camera(float64):
    gaussians, view = random_gaussians(0), camera()
    projected = project(gaussians, view)

    @jax.jit
    def linearised(gaussians):
        position = lambda mean: pinhole.project(view, mean)[0]
        jacobians = jax.vmap(jax.jacfwd(position))(gaussians.means)
        covariance = jacobians @ covariances(gaussians) @ jnp.swapaxes(jacobians, 1, 2)
        return jax.vmap(position)(gaussians.means), covariance + 0.3 * jnp.eye(2)

    centers, expected = linearised(gaussians)
    seen = np.asarray(projected.visible)
    assert not seen[9] and seen[10] and seen.sum() == len(seen) - 1
    planes = (
        projected.x,
        projected.y,
        projected.xx,
        projected.xy,
        projected.yy,
        projected.determinant,
    )
    xx, xy, yy = expected[:, 0, 0], expected[:, 0, 1], expected[:, 1, 1]
    exact = (centers[:, 0], centers[:, 1], xx, xy, yy, xx * yy - xy * xy)
    for plane, expected_plane in zip(planes, exact, strict=True):
        np.testing.assert_allclose(plane[seen], expected_plane[seen], rtol=FLOAT64)
    np.testing.assert_array_equal(projected.means2d[:, 1], projected.y)
    inverses = jnp.linalg.inv(expected)[:, (0, 0, 1), (0, 1, 1)]
    np.testing.assert_allclose(projected.conics[seen], inverses[seen], rtol=FLOAT64, atol=FLOAT64)


def test_moving_world_and_camera_together_changes_nothing(float64):
    gaussians, view = few(random_gaussians(1), np.arange(15, 32)), camera()
    q = quaternion.normalize(jnp.asarray([0.3, -0.5, 0.7, 0.2]))
    move = transform.make(quaternion.to_matrix(q), jnp.asarray([1.0, -2.0, 0.5]))
    moved = replace(
        gaussians,
        means=transform.apply(move, gaussians.means),
        quats=quaternion.multiply(q, gaussians.quats),
        deformations=None,
    )
    moved_view = replace(view, cam_from_world=view.cam_from_world @ transform.invert_rigid(move))
    pair = project(replace(gaussians, deformations=None), view), project(moved, moved_view)
    for a, b in zip(*map(jax.tree.leaves, pair), strict=True):
        np.testing.assert_allclose(a, b, rtol=FLOAT64, atol=FLOAT64)


def test_determinant_of_a_needle_is_accurate_in_float32():
    scales = [[1000.0, 1e-4, 1e-4]] * 3
    quats = [[np.cos(a), 0, 0, np.sin(a)] for a in (0.1, np.pi / 8, 1.0)]  # turned within the image

    def gaussians(dtype):
        return Gaussians(
            *(
                jnp.asarray(a, dtype)
                for a in ([[0.1, 0.2, 2.0]] * 3, quats, scales, [1.0] * 3, [[1.0] * 3] * 3)
            )
        )

    with jax.enable_x64(True):
        exact = project(gaussians(np.float64), camera(np.float64))
    rounded = project(gaussians(np.float32), camera(np.float32))
    np.testing.assert_allclose(rounded.determinant, exact.determinant, rtol=FLOAT32)
    xx, xy, yy = (np.asarray(plane) for plane in (rounded.xx, rounded.xy, rounded.yy))
    # what this guards against
    assert np.abs((xx * yy - xy * xy) / np.asarray(exact.determinant) - 1).max() > 0.01


def test_what_is_not_drawn_is_finite_and_passes_no_gradient():
    gaussians = replace(
        random_gaussians(2, np.float32),
        means=jnp.asarray(
            [[0, 0, -1], [0, 0, 0.01], [0, 0, 0], [1e20, 0, 0.02], [0, 0, 2]], jnp.float32
        )[jnp.arange(32) % 5],
        scales=jnp.full((32, 3), 0.1, jnp.float32).at[jnp.arange(4, 32, 5)].set(1e15),
    )
    view = replace(camera(np.float32), cam_from_world=jnp.eye(4))
    projected = project(gaussians, view)[:-2]
    pull = jax.jit(
        lambda cotangent: jax.vjp(lambda g, v: project(g, v)[:-2], gaussians, view)[1](cotangent)
    )
    assert not project(gaussians, view).visible.any()
    for plane in projected:
        assert np.isfinite(plane).all()
    for leaf in jax.tree.leaves(pull(jax.tree.map(jnp.zeros_like, projected))):
        np.testing.assert_array_equal(leaf, np.zeros_like(leaf))


def test_zero_quaternion_is_the_identity_and_degenerate_scales_have_gradients():
    gaussians = random_gaussians(4, np.float32)
    identity = replace(gaussians, quats=gaussians.quats.at[:].set(jnp.asarray([1.0, 0, 0, 0])))
    zero = replace(
        gaussians, quats=jnp.zeros_like(gaussians.quats), scales=gaussians.scales.at[::3].set(0)
    )
    for a, b in zip(
        project(zero, camera(np.float32)), project(identity, camera(np.float32)), strict=True
    ):
        np.testing.assert_array_equal(np.delete(a, np.s_[::3]), np.delete(b, np.s_[::3]))
    total = lambda g: sum(jnp.sum(plane) for plane in project(g, camera(np.float32))[:-2])
    for leaf in jax.tree.leaves(jax.jit(jax.grad(total))(zero)):
        assert np.isfinite(leaf).all()


def test_clamped_jacobian_bounds_the_footprint_beside_a_near_camera(float64):
    """INRIA's Jacobian is that of the point at 1.3 times half the field of view."""
    ball = replace(
        few(random_gaussians(5), np.asarray([15])), deformations=None, scales=jnp.full((1, 3), 0.01)
    )
    view = camera()
    view = replace(view, K=view.K.at[0, 2].set(view.width / 2), cam_from_world=jnp.eye(4))
    beside = replace(ball, means=jnp.asarray([[2.0, 0.1, 0.2]]))
    margin = SPLAT_PRESETS["inria"].jacobian_margin
    free, clamped = (project(beside, view, SplatConfig(jacobian_margin=m)) for m in (None, margin))
    focal = view.K[0, 0]
    at = 1.3 * 0.5 * view.width / focal
    np.testing.assert_allclose(
        clamped.xx[0], (0.01 * focal / 0.2) ** 2 * (1 + at**2) + EPS2D, rtol=FLOAT64
    )
    assert clamped.xx[0] < 0.1 * free.xx[0]
    np.testing.assert_array_equal(clamped.x, free.x)  # the centre stays where it is


def test_reach_is_where_alpha_meets_its_threshold(float64):
    opacities = jnp.asarray([1.0, 0.3, 1 / 255, 0.0])
    reach = squared_reach(opacities)
    np.testing.assert_allclose(opacities[:2] * jnp.exp(-reach[:2] / 2), 1 / 255, rtol=FLOAT64)
    np.testing.assert_array_equal(reach[2:], [0, 0])


def test_gradient_along_the_long_axis_of_a_needle_is_accurate_in_float32():
    """The needle has 12 million pixels by 600.

    Autodiff through the determinant makes the gradient along as large as that across.
    """
    n = 6
    angles = np.linspace(0.1, 1.5, n)
    quats = np.stack([np.cos(angles), 0 * angles, 0.1 + 0 * angles, np.sin(angles)], axis=-1)
    arrays = [[0.1, 0.2, 2.0]] * n, quats, [[1e6, 50.0, 50.0]] * n, [1.0] * n, [[1.0] * 3] * n
    d = np.random.default_rng(0).normal(size=(2, n)) * 5

    @jax.jit
    def gradients(gaussians, view, d):
        def exponents(gaussians):
            p = project(gaussians, view)
            u, v = p.r00 * d[0] + p.r01 * d[1], p.r11 * d[1]
            return jnp.sum(0.1 * u * u + 0.2 * u * v + v * v)

        gradient = jax.grad(exponents)(gaussians)
        return gradient.scales * gaussians.scales, gradient.quats

    values = {}
    for dtype in (np.float32, np.float64):
        with jax.enable_x64(dtype == np.float64):
            gaussians = Gaussians(*(jnp.asarray(np.asarray(a, np.float32), dtype) for a in arrays))
            view = jax.tree.map(
                lambda a, dtype=dtype: jnp.asarray(np.asarray(a), dtype), camera(np.float32)
            )
            values[dtype] = [
                np.asarray(a) for a in gradients(gaussians, view, jnp.asarray(d, dtype))
            ]
    for found, exact in zip(values[np.float32], values[np.float64], strict=True):
        assert np.linalg.norm(found - exact) < bound(FLOAT32) * np.linalg.norm(exact)
    long, thin = (
        np.abs(values[np.float64][0][:, 0]).max(),
        np.abs(values[np.float64][0][:, 1:]).max(),
    )
    assert long < 1e-3 * thin  # so that it could drown
    assert np.abs(values[np.float32][0] - values[np.float64][0])[:, 0].max() < 1e-3 * long
