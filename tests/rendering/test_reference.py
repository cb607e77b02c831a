"""The reference renderer against closed forms: one Gaussian, two Gaussians, thresholds."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from humangs_jax.geometry.camera import Camera
from humangs_jax.rendering.gaussians import Gaussians
from humangs_jax.rendering.reference import render_reference

EXACT = 1e-12
"""Rounding of a handful of float64 operations."""

FOCAL, SIZE = 10.0, 9


pytestmark = pytest.mark.usefixtures("float64")


def axis_camera():
    """Returns a camera of 9 x 9 pixels with the pixel (4, 4) on its axis."""
    return Camera(
        jnp.asarray([[FOCAL, 0, 4.5], [0, FOCAL, 4.5], [0, 0, 1.0]]), jnp.eye(4), SIZE, SIZE
    )


def on_axis(depths, opacities, colors, scale=0.2):
    """Returns four Gaussians on the axis, for one compiled shape; the rest is transparent."""
    n, more = 4, 4 - len(depths)
    depths, opacities, colors = (
        [*depths, *[9.0] * more],
        [*opacities, *[0.0] * more],
        [*colors, *[[0.0] * 3] * more],
    )
    means = jnp.stack([jnp.zeros(n), jnp.zeros(n), jnp.asarray(depths, float)], axis=-1)
    quats = jnp.tile(jnp.asarray([1.0, 0, 0, 0]), (n, 1))
    return Gaussians(
        means,
        quats,
        jnp.full((n, 3), scale),
        jnp.stack([jnp.asarray(opacity, float) for opacity in opacities]),
        jnp.asarray(colors, float),
    )


def test_one_isotropic_gaussian_is_a_round_blob():
    gaussians = on_axis([2.0], [0.8], [[1.0, 0.5, 0.0]])
    rendering = render_reference(gaussians, axis_camera(), background=jnp.zeros(3))
    variance = (FOCAL * 0.2 / 2) ** 2 + 0.3
    y, x = np.mgrid[:SIZE, :SIZE] - 4.0
    alpha = 0.8 * np.exp(-(x * x + y * y) / (2 * variance))
    alpha[alpha < 1 / 255] = 0
    assert (alpha == 0).any()
    np.testing.assert_allclose(rendering.alpha, alpha, atol=EXACT)
    np.testing.assert_allclose(rendering.rgb, alpha[..., None] * [1.0, 0.5, 0.0], atol=EXACT)
    np.testing.assert_allclose(rendering.depth, np.where(alpha > 0, 2.0, 0.0), atol=EXACT)


def test_nearer_covers_farther_whatever_the_order():
    gaussians = on_axis([3.0, 2.0], [0.6, 0.5], [[1.0, 0, 0], [0, 1.0, 0]])
    rendering = render_reference(gaussians, axis_camera())
    # on white
    np.testing.assert_allclose(rendering.rgb[4, 4], [0.3 + 0.2, 0.5 + 0.2, 0.2], atol=EXACT)
    np.testing.assert_allclose(rendering.alpha[4, 4], 0.8, atol=EXACT)
    np.testing.assert_allclose(rendering.depth[4, 4], (0.5 * 2 + 0.3 * 3) / 0.8, atol=EXACT)


def test_a_pixel_ends_before_the_splat_that_would_exhaust_it():
    # T: 1e-2, 2e-4, then 8e-5 <= 1e-4: neither the third nor anything after it counts
    opacities = [
        0.99,
        0.98,
        0.6,
        0.5,
    ]
    rendering = render_reference(
        on_axis([1.0, 2.0, 3.0, 4.0], opacities, [[0.0] * 3] * 4), axis_camera()
    )
    np.testing.assert_allclose(rendering.rgb[4, 4], 2e-4, atol=EXACT)


def test_alpha_is_clamped_and_then_has_no_gradient():
    def middle(opacity):
        return render_reference(on_axis([2.0], [opacity], [[0.0] * 3]), axis_camera()).alpha[4, 4]

    slope_at = jax.jit(jax.value_and_grad(middle))
    value, slope = slope_at(1.0)
    np.testing.assert_allclose(value, 0.999, atol=EXACT)
    assert slope == 0
    assert slope_at(0.9)[1] == 1
