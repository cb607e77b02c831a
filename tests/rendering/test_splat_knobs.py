"""What each field of SplatConfig does to the image, and the visibility of Gaussians."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from splat_scenes import COUNT, HEIGHT, WIDTH, camera, few, random_gaussians

from humangs_jax.core.pytree import replace
from humangs_jax.geometry.camera import Camera, stack_cameras
from humangs_jax.rendering import buffers
from humangs_jax.rendering.buffers import plan_buffers, plan_near
from humangs_jax.rendering.gaussians import Gaussians
from humangs_jax.rendering.reference import render_reference
from humangs_jax.rendering.splat_config import SPLAT_PRESETS, SplatConfig
from humangs_jax.rendering.splatting import render, visible_gaussians

FLOAT64 = 1e-9
"""Rounding of float64, relative to the largest entry."""

SMALL = SplatConfig(block=4, chunk=4)


def knobs(**values):
    return dataclasses.replace(SMALL, **values)


@pytest.mark.slow
def test_visibility_is_the_largest_weight():
    """A color channel that only Gaussian i has shows the weight of i."""
    with jax.enable_x64(True):
        gaussians = random_gaussians(3)
        weights = jax.vmap(
            lambda i: render_reference(
                replace(gaussians, colors=jnp.zeros((COUNT, 3)).at[i, 0].set(1.0)),
                camera(),
                background=jnp.zeros(3),
            ).rgb[..., 0]
        )(jnp.arange(COUNT))
        rendering = render(gaussians, camera(), knobs(visibility=True))
        np.testing.assert_allclose(rendering.visibility, weights.max(axis=(1, 2)), atol=FLOAT64)
        assert render(gaussians, camera(), SMALL).visibility is None
        empty = render(few(gaussians, np.arange(0)), camera(), knobs(visibility=True))
        assert empty.visibility is not None and empty.visibility.shape == (0,)


def wall_before(gaussians):
    """Returns the Gaussians and an opaque wall of three layers before them.

    One camera looks through the wall, another one past it.
    """
    n = 3
    wall = Gaussians(
        jnp.asarray([[0, 0, 1.0 + 0.01 * i] for i in range(n)]),
        jnp.tile(jnp.asarray([1.0, 0, 0, 0]), (n, 1)),
        jnp.tile(jnp.asarray([5.0, 5.0, 1e-3]), (n, 1)),
        jnp.full(n, 0.999),
        jnp.ones((n, 3)),
        jnp.tile(jnp.eye(3), (n, 1, 1)),
    )
    return jax.tree.map(lambda a, b: jnp.concatenate([a, b]), wall, gaussians)


@pytest.mark.slow
def test_seen_from_keeps_what_any_camera_sees():
    with jax.enable_x64(True):
        scene = wall_before(few(random_gaussians(4), np.arange(15, COUNT)))
        front = camera()
        beyond = replace(front, cam_from_world=front.cam_from_world.at[2, 3].add(-1.3))
        hidden = visible_gaussians(scene, stack_cameras([front]), SMALL)
        assert hidden[0] and not hidden[3:].any()
        assert visible_gaussians(scene, stack_cameras([front, beyond]), SMALL)[3:].any()
        kept = few(scene, np.flatnonzero(hidden))
        limit = np.count_nonzero(~hidden) / 255  # each may have weighed up to 1 / 255
        difference = np.abs(render(kept, front, SMALL).rgb - render(scene, front, SMALL).rgb).max()
        assert difference <= limit
        assert difference < 1e-2


@pytest.mark.slow
def test_extent_cuts_whole_tiles_only():
    with jax.enable_x64(True):
        gaussians = replace(random_gaussians(6), opacities=jnp.full(COUNT, 0.9))
        view = camera(width=96, height=64)
        exact = render(gaussians, view, SMALL)
        wide = render(gaussians, view, knobs(radius_sigma=10.0))
        np.testing.assert_array_equal(wide.rgb, exact.rgb)
        narrow = render(gaussians, view, knobs(radius_sigma=2.0))
        # at most the alpha of one splat beyond two deviations: no pixel here loses more
        assert 1e-3 < np.abs(narrow.rgb - exact.rgb).max() < 0.9 * np.exp(-2)
        assert (
            plan_buffers(gaussians, view, knobs(radius_sigma=2.0)).max_pairs
            < plan_buffers(gaussians, view, SMALL).max_pairs
        )


@pytest.mark.slow
@pytest.mark.parametrize(("name", "most"), [("near_exact", 0.01), ("fast", 0.05), ("inria", 0.02)])
def test_presets_draw_nearly_the_same(name, most):
    gaussians, view = few(random_gaussians(9, np.float32), np.arange(15, COUNT)), camera(np.float32)
    gaussians = replace(
        gaussians, quats=gaussians.quats / jnp.linalg.norm(gaussians.quats, axis=1, keepdims=True)
    )
    exact, ours = (render(gaussians, view, SPLAT_PRESETS[preset]) for preset in ("exact", name))
    assert SPLAT_PRESETS["exact"] == SplatConfig()
    assert 0 < np.abs(ours.rgb - exact.rgb).mean() < most


def test_settings_are_checked():
    several = {
        "radius_sigma": 0.0,
        "square": True,
        "chunk": 0,
        "alpha_min": 0.0,
        "alpha_max": 1.0,
        "near": -1.0,
    }
    for wrong in ({name: value} for name, value in (several | {"max_pairs": 0}).items()):
        with pytest.raises(ValueError, match="SplatConfig"):
            SplatConfig(**wrong)


def test_cameras_of_a_batch_are_planned_together():
    gaussians = random_gaussians(2, np.float32)
    near = camera(np.float32)
    far = Camera(near.K, near.cam_from_world.at[2, 3].add(3.0), WIDTH, HEIGHT)
    both = plan_buffers(gaussians, stack_cameras([near, far]), SMALL)
    assert both == max(
        (plan_buffers(gaussians, c, SMALL) for c in (near, far)), key=lambda c: c.max_pairs
    )


def test_buffers_that_were_planned_before_are_used_again_where_they_are_near(monkeypatch):
    gaussians, view, need = random_gaussians(2, np.float32), camera(np.float32), [900, 4000]
    monkeypatch.setattr(buffers, "_PLANNED", {})
    monkeypatch.setattr(buffers, "_needed", lambda *scene: need)
    first = plan_near(gaussians, view, SMALL)
    assert first == plan_buffers(gaussians, view, SMALL)
    need[:] = 800, 3700
    assert plan_near(gaussians, view, SMALL) == first != plan_buffers(gaussians, view, SMALL)
    for other in ([300, 1000], [1200, 9000]):  # far too large, and too small
        need[:] = other
        assert plan_near(gaussians, view, SMALL) == plan_buffers(gaussians, view, SMALL)
