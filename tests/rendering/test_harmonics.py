"""Colors that depend on the viewing direction: the functions, how they turn, and what is drawn."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.special import sph_harm_y
from splat_scenes import camera, random_gaussians, with_harmonics

from humangs_jax.core.pytree import replace
from humangs_jax.geometry import quaternion, transform
from humangs_jax.rendering import gaussians as harmonics
from humangs_jax.rendering import reference
from humangs_jax.rendering.gaussians import constrain, skin_gaussians, unconstrain
from humangs_jax.rendering.projection import project_gaussians as project
from humangs_jax.rendering.splatting import render

FLOAT64 = 1e-12


def directions(count=50):
    d = np.random.default_rng(0).normal(size=(count, 3))
    return d / np.linalg.norm(d, axis=1, keepdims=True)


def by_scipy(d, degree):
    """Returns real harmonics from scipy's complex ones, with the sign of Condon and Shortley."""
    theta, phi = np.arccos(d[:, 2]), np.arctan2(d[:, 1], d[:, 0])
    found = []
    for n in range(1, degree + 1):
        for m in range(-n, n + 1):
            value = sph_harm_y(n, abs(m), theta, phi)
            if m:
                part = value.real if m > 0 else value.imag
                found.append(np.sqrt(2) * part)
            else:
                found.append(value.real)
    return np.stack(found, axis=-1)


@pytest.mark.parametrize("degree", [1, 2, 3])
def test_the_functions_are_scipys_in_both_renderers(degree):
    d, count = directions(), harmonics.COUNTS[degree]
    expected = by_scipy(d, degree)
    assert expected.shape[1] == count
    np.testing.assert_allclose(
        np.stack(harmonics.basis(*d.T, count), axis=-1), expected, atol=FLOAT64
    )
    with jax.enable_x64(True):
        np.testing.assert_allclose(
            reference._harmonics(jnp.asarray(d), degree), expected, atol=FLOAT64
        )


def test_signs_and_order_are_the_published_ones():
    """They are -y, z, -x; then -yz is second and the zonal one in the middle
    (https://github.com/graphdeco-inria/diff-gaussian-rasterization).
    """
    x, y, z = np.asarray([0.6, 0.0, 0.8]).tolist()
    got = np.stack(harmonics.basis(x, y, z, 15))
    np.testing.assert_allclose(
        got[:3], 0.4886025119029199 * np.asarray([0, 0.8, -0.6]), atol=FLOAT64
    )
    np.testing.assert_allclose(got[5], 0.31539156525252005 * (2 * z * z - x * x), atol=FLOAT64)
    np.testing.assert_allclose(got[6], -1.0925484305920792 * x * z, atol=FLOAT64)
    np.testing.assert_allclose(got[14], -0.5900435899266435 * x**3, atol=FLOAT64)


def test_the_direction_is_from_the_camera_to_the_mean_in_the_world():
    with jax.enable_x64(True):
        gaussians, view = with_harmonics(random_gaussians(0), 15), camera()
        seen = project(gaussians, view)
        centre = np.linalg.inv(view.cam_from_world)[:3, 3]
        d = np.asarray(gaussians.means) - centre
        d /= np.linalg.norm(d, axis=1, keepdims=True)
        added = np.einsum("gk,gkc->gc", by_scipy(d, 3), gaussians.harmonics)
        drawn = np.asarray(seen.visible)
        np.testing.assert_allclose(seen.added_colors[drawn], added[drawn], atol=FLOAT64)
        expected = np.maximum(gaussians.colors + added, 0)[drawn]
        np.testing.assert_allclose(
            seen.seen_from_here(gaussians.colors)[drawn], expected, atol=FLOAT64
        )
        assert (expected == 0).any() and project(random_gaussians(0), view).added_colors is None


@pytest.mark.slow
def test_a_scene_turned_with_its_camera_looks_the_same():
    with jax.enable_x64(True):
        gaussians, view = with_harmonics(random_gaussians(1), 15), camera()
        turn = quaternion.to_matrix(quaternion.normalize(jnp.asarray([0.3, -0.5, 0.7, 0.2])))
        move = transform.make(turn, jnp.asarray([1.0, -2.0, 0.5]))
        moved = skin_gaussians(gaussians, jnp.broadcast_to(move, (len(gaussians.means), 4, 4)))
        moved_view = replace(view, cam_from_world=view.cam_from_world @ jnp.linalg.inv(move))
        colors = project(gaussians, view).added_colors
        np.testing.assert_allclose(project(moved, moved_view).added_colors, colors, atol=1e-10)
        assert (
            np.abs(
                project(replace(moved, harmonics=gaussians.harmonics), moved_view).added_colors
                - colors
            ).max()
            > 0.1
        )


def test_parameters_carry_them_and_other_counts_are_refused():
    gaussians = with_harmonics(random_gaussians(0, np.float32), 3)
    back = constrain(unconstrain(replace(gaussians, deformations=None)))
    np.testing.assert_array_equal(back.harmonics, gaussians.harmonics)
    with pytest.raises(
        ValueError,
        match=r"^harmonics: expected \(g, 3, 3\), \(g, 8, 3\) or \(g, 15, 3\), got \(g, 4, 3\)",
    ):
        render(with_harmonics(gaussians, 4), camera(np.float32))
    with pytest.raises(
        ValueError, match=r"gaussians\.harmonics: expected shape \(32, k, 3\), got \(31, 3, 3\)"
    ):
        render(replace(gaussians, harmonics=gaussians.harmonics[1:]), camera(np.float32))
