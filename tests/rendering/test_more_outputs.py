"""Outputs of a rendering on request: radii, centres, depths, distortion, antialiased opacities."""

import dataclasses
from unittest import mock

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from splat_scenes import COUNT, HEIGHT, WIDTH, camera, few, random_gaussians

from humangs_jax.core.pytree import replace
from humangs_jax.rendering import compositing
from humangs_jax.rendering.gaussians import Gaussians
from humangs_jax.rendering.projection import project_gaussians
from humangs_jax.rendering.reference import render_reference
from humangs_jax.rendering.splat_config import SplatConfig
from humangs_jax.rendering.splatting import render

FLOAT64 = 1e-9
PLAIN = SplatConfig(block=4, chunk=4, max_pairs=2000)
ALL = dataclasses.replace(
    PLAIN, means2d=True, radii=True, depth_sum=True, depth_median=True, distortion=True
)
DRAWN = ("rgb", "alpha", "depth", "depth_sum", "distortion", "features")


def measured(draw, gaussians, config):
    """Returns (what is drawn, gradients of a random sum of it by all arguments and shifts)."""
    rng = np.random.default_rng(7)
    weights = {name: rng.normal(size=(HEIGHT, WIDTH, 3)) for name in DRAWN}

    def loss(gaussians, K, pose, features, shifts):
        view = replace(camera(), K=K, cam_from_world=pose)
        r = draw(gaussians, view, config, None, features, shifts)
        shown = {name: getattr(r, name).reshape(HEIGHT, WIDTH, -1) for name in DRAWN}
        sums = [jnp.sum(weights[name][..., : x.shape[-1]] * x) for name, x in shown.items()]
        return sum(sums), r

    features = jnp.asarray(rng.normal(size=(COUNT, 2)))
    numbers = gaussians, camera().K, camera().cam_from_world, features, jnp.zeros((COUNT, 2))
    function = jax.jit(jax.value_and_grad(loss, argnums=(0, 1, 2, 3, 4), has_aux=True))
    (_, rendering), gradients = function(*numbers)
    return rendering, gradients


@pytest.mark.slow
@pytest.mark.parametrize("schedule", ["blocks", "chunks"])
def test_everything_that_is_asked_for_equals_the_reference_with_all_gradients(schedule):
    functions = (
        getattr(compositing, f"{direction}_by_{schedule}") for direction in ("forward", "backward")
    )
    chosen = dict(
        zip(
            ("forward_by_blocks", "backward_by_blocks"),
            functions,
            strict=True,
        )
    )
    with jax.enable_x64(True), mock.patch.multiple(compositing, **chosen):
        gaussians = random_gaussians(3)
        config = dataclasses.replace(ALL, antialiased=True, tile_size=4 + (schedule == "chunks"))
        ours, gradients = measured(render, gaussians, config)
        exact, expected = measured(render_reference, gaussians, config)
        for name in (*DRAWN, "depth_median"):
            a, b = getattr(ours, name), getattr(exact, name)
            np.testing.assert_allclose(a, b, atol=FLOAT64 * np.abs(b).max(), err_msg=name)
            assert np.abs(b).max() > 0
        for a, b in zip(jax.tree.leaves(gradients), jax.tree.leaves(expected), strict=True):
            np.testing.assert_allclose(a, b, atol=FLOAT64 * np.abs(b).max())


def test_gaussians_with_footprints_equal_the_reference():
    """Footprints below and above a pixel dim the opacities by different factors."""
    with jax.enable_x64(True):
        gaussians = random_gaussians(3)
        pixels = np.random.default_rng(1).uniform(0, 2, COUNT)
        depths = np.maximum(np.asarray(gaussians.means[:, 2]), 1.0)
        gaussians = replace(
            gaussians, pixel_footprint=jnp.asarray(pixels * depths) / camera().K[0, 0]
        )
        view, weights = camera(), np.random.default_rng(2).normal(size=(HEIGHT, WIDTH, 3))

        def drawn(draw):
            def loss(gaussians):
                rgb = draw(gaussians, view, PLAIN).rgb
                return jnp.sum(weights * rgb), rgb

            return jax.jit(jax.value_and_grad(loss, has_aux=True))(gaussians)

        (_, ours), gradients = drawn(render)
        (_, exact), expected = drawn(render_reference)
        np.testing.assert_allclose(ours, exact, atol=FLOAT64)
        for a, b in zip(jax.tree.leaves(gradients), jax.tree.leaves(expected), strict=True):
            np.testing.assert_allclose(a, b, atol=FLOAT64 * np.abs(b).max())


@pytest.mark.slow
def test_nothing_is_returned_that_was_not_asked_for():
    gaussians = random_gaussians(0, np.float32)
    plain = render(gaussians, camera(np.float32), PLAIN)
    names = ("features", "visibility", "means2d", "radii", "depth_sum", "depth_median")
    assert [getattr(plain, name) for name in (*names, "distortion")] == [None] * 7
    asked = render(gaussians, camera(np.float32), ALL)
    np.testing.assert_array_equal(asked.rgb, plain.rgb)
    np.testing.assert_array_equal(asked.depth, plain.depth)
    empty = render(few(gaussians, np.arange(0)), camera(np.float32), ALL)
    assert empty.means2d.shape == empty.radii.shape == (0, 2)
    assert not empty.depth_median.any() and not empty.distortion.any()


def wall(depths, opacities):
    """Returns wide Gaussians on the axis, one behind the other; the nearest is not the first."""
    n = len(depths)
    return Gaussians(
        jnp.stack([jnp.zeros(n), jnp.zeros(n), jnp.asarray(depths, float)], axis=-1),
        jnp.tile(jnp.asarray([1.0, 0, 0, 0]), (n, 1)),
        jnp.full((n, 3), 50.0),
        jnp.asarray(opacities, float),
        jnp.ones((n, 3)),
    )


def test_the_median_depth_is_where_half_of_the_light_is_left():
    with jax.enable_x64(True):
        # T after each, from the nearest: 0.7, 0.49, 0.441
        config = dataclasses.replace(ALL, alpha_min=1e-6)
        half = render(wall([3.0, 2.0, 4.0], [0.3, 0.3, 0.1]), camera(), config)
        middle = HEIGHT // 2, WIDTH // 2
        assert half.depth_median[middle] == pytest.approx(3.1)
        none = render(wall([3.0, 2.0, 4.0], [0.1, 0.3, 0.1]), camera(), config)
        assert none.depth_median[middle] == 0
        np.testing.assert_allclose(half.depth_sum, half.depth * half.alpha, rtol=1e-12)


@pytest.mark.slow
def test_the_median_depth_passes_no_gradient_and_a_small_step_does_not_change_its_kind():
    with jax.enable_x64(True):
        gaussians = wall([3.0, 2.0, 4.0], [0.3, 0.3, 0.1])

        def total(o):
            return jnp.sum(render(replace(gaussians, opacities=o), camera(), ALL).depth_median)

        gradient = jax.jit(jax.grad(total))(gaussians.opacities)
        assert (gradient == 0).all()
        assert total(gaussians.opacities + 1e-7) == pytest.approx(total(gaussians.opacities))


def test_distortion_is_the_sum_over_pairs():
    with jax.enable_x64(True):
        found = render(wall([3.0, 2.0, 4.0], [0.3, 0.3, 0.1]), camera(), ALL)
        alphas, depths = np.asarray([0.3, 0.3, 0.1]), np.asarray([2.1, 3.1, 4.1])
        w = alphas * np.cumprod([1, 0.7, 0.7])
        expected = (w[:, None] * w * (depths[:, None] - depths) ** 2).sum()
        middle = HEIGHT // 2, WIDTH // 2
        assert found.distortion[middle] == pytest.approx(expected, rel=1e-3)  # walls are round


@pytest.mark.slow
def test_radii_are_half_the_box_outside_of_which_nothing_is_drawn():
    with jax.enable_x64(True):
        gaussians, view = random_gaussians(3), camera()
        rendering = render(gaussians, view, ALL)
        projected = project_gaussians(gaussians, view)
        radii = np.asarray(rendering.radii)
        y, x = np.mgrid[:HEIGHT, :WIDTH] + 0.5
        for i in range(COUNT):
            alone = render(jax.tree.map(lambda leaf, i=i: leaf[i : i + 1], gaussians), view, PLAIN)
            seen = np.asarray(alone.alpha) > 0
            beside = np.abs(x - projected.x[i]) > radii[i, 0]
            beside |= np.abs(y - projected.y[i]) > radii[i, 1]
            assert not (seen & beside).any()
            assert not seen.any() or (radii[i] > 0).all()
        assert (radii[[9, 13, 14]] == 0).all() and (radii > 0).any()
        np.testing.assert_array_equal(rendering.means2d, projected.means2d)


@pytest.mark.slow
def test_shifts_move_the_image_and_their_shape_is_checked():
    gaussians, view = random_gaussians(3, np.float32), camera(np.float32)
    moved = render(gaussians, view, shifts=jnp.full((COUNT, 2), 2.0)).rgb
    there = replace(view, K=view.K.at[:2, 2].add(2.0))
    np.testing.assert_allclose(moved, render(gaussians, there).rgb, atol=1e-5)
    with pytest.raises(ValueError, match=r"shifts: expected shape \(32, 2\), got \(3, 2\)"):
        render(gaussians, view, shifts=jnp.zeros((3, 2)))


@pytest.mark.slow
def test_antialiased_opacities_keep_what_a_small_gaussian_weighs():
    """The weight of a blob far below a pixel is opacity times area, whatever eps2d is."""
    with jax.enable_x64(True):
        point = replace(wall([2.0], [1.0]), scales=jnp.full((1, 3), 0.004))
        view = replace(camera(), K=camera().K.at[0, 0].set(22.0).at[1, 1].set(22.0))
        config = dataclasses.replace(PLAIN, antialiased=True, alpha_min=1e-9)
        area = 2 * np.pi * (22.0 * 0.004 / 2.1) ** 2
        thin = render(point, view, config).alpha.sum()
        thick = render(point, view, dataclasses.replace(config, antialiased=False)).alpha.sum()
        assert thin == pytest.approx(area, rel=0.06) and thick > 100 * thin  # of few pixels
        flat = replace(point, scales=jnp.zeros((1, 3)))
        total = lambda g: render(g, view, config).alpha.sum()
        assert all(np.isfinite(x).all() for x in jax.tree.leaves(jax.grad(total)(flat)))
