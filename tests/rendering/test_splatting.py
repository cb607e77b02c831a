"""The tiled renderer against the reference, and as a JAX function with buffers.

JAX's transformations are jit, vmap, grad, checkpoint and export.
"""

import dataclasses
import functools
import logging

import jax
import jax.export
import jax.numpy as jnp
import numpy as np
import pytest
from compiled_programs import compiled_programs
from hypothesis import given, settings
from hypothesis import strategies as st
from rounding import bound
from splat_scenes import COUNT, HEIGHT, WIDTH, camera, few, random_gaussians, with_harmonics

from humangs_jax.avatar.splat_views import render_in_bands
from humangs_jax.core.pytree import replace
from humangs_jax.geometry.camera import Camera, stack_cameras
from humangs_jax.rendering.buffers import default_pairs, plan_buffers, round_up
from humangs_jax.rendering.projection import project_gaussians
from humangs_jax.rendering.reference import render_reference
from humangs_jax.rendering.splat_config import DEFAULT_CONFIG
from humangs_jax.rendering.splatting import SplatConfig, render, render_views
from humangs_jax.rendering.tiling import TileGrid, count_pairs, footprints_by

FLOAT64 = 1e-9
"""Rounding of float64, relative to the largest entry.

The gradient has 1 / (1 - alpha) <= 1000.
"""

FLOAT32, FLOAT32_GRADIENT = 1e-4, 5e-3
"""Errors of float32 against float64; those of gradients are relative to the largest entry.

Gaussians at the near plane are included.
"""

CHUNKS = SplatConfig(block=4, chunk=4)
"""A configuration with several blocks of several chunks in a small image; it compiles quickly."""

VIEW = (HEIGHT, WIDTH)


def loss_weights():
    """Returns weights of the loss, a random linear function of everything in a rendering."""
    rng = np.random.default_rng(7)
    return rng.normal(size=(*VIEW, 3)), rng.normal(size=VIEW), rng.normal(size=VIEW)


def evaluate(draw, gaussians, view, background):
    """Returns (rendering, gradients with respect to all arguments)."""
    weights = loss_weights()

    def loss(gaussians, K, pose, background):
        r = draw(gaussians, Camera(K, pose, view.width, view.height), background)
        value = sum(
            jnp.sum(w.astype(a.dtype) * a)
            for w, a in zip(weights, (r.rgb, r.alpha, r.depth), strict=True)
        )
        return value, r

    arguments = gaussians, view.K, view.cam_from_world, background
    (_, rendering), gradients = jax.value_and_grad(loss, argnums=(0, 1, 2, 3), has_aux=True)(
        *arguments
    )
    return rendering, gradients


@functools.partial(jax.jit, static_argnames="config")
def tiled(gaussians, view, background, config=CHUNKS):
    return evaluate(lambda g, c, b: render(g, c, config, b), gaussians, view, background)


@jax.jit
def reference(gaussians, view, background):
    return evaluate(
        lambda g, c, b: render_reference(g, c, background=b), gaussians, view, background
    )


def background(dtype=np.float64):
    return jnp.asarray([0.2, 0.5, 0.9], dtype)


def assert_close(ours, expected, tolerance):
    """Compares leaves, relative to the larger of 1 and the largest entry of the leaf."""

    def check(path, a, b):
        a, b = np.asarray(a), np.asarray(b)
        assert np.isfinite(a).all(), path
        np.testing.assert_allclose(
            a, b, rtol=0, atol=tolerance * max(1.0, np.abs(b).max(initial=0)), err_msg=str(path)
        )

    jax.tree_util.tree_map_with_path(check, ours, expected)


@pytest.mark.parametrize("functions", [pytest.param(0, marks=pytest.mark.slow), 15])
@settings(max_examples=8, deadline=None)
@given(seed=st.integers(0, 2**20))
def test_equals_the_reference_with_all_gradients(seed, functions):
    with jax.enable_x64(True):
        gaussians = random_gaussians(seed)
        gaussians = with_harmonics(gaussians, functions) if functions else gaussians
        ours, expected = (f(gaussians, camera(), background()) for f in (tiled, reference))
        assert_close(ours, expected, FLOAT64)
        assert all(np.abs(leaf).max() > 0 for leaf in jax.tree.leaves(expected[1]))


@pytest.mark.slow
def test_features_are_drawn_beside_the_colors():
    """Gradients of all are those of the reference."""
    rng = np.random.default_rng(4)
    with jax.enable_x64(True):
        gaussians, view = random_gaussians(13), camera()
        features, weights = (
            jnp.asarray(rng.normal(size=(COUNT, 5))),
            jnp.asarray(rng.normal(size=(*VIEW, 5))),
        )

        def loss(gaussians, features, draw, config):
            rendering = draw(gaussians, view, config, features=features)
            return jnp.sum(weights * rendering.features), rendering

        found = jax.jit(
            jax.value_and_grad(loss, argnums=(0, 1), has_aux=True), static_argnums=(2, 3)
        )
        ours, expected = (
            found(gaussians, features, draw, CHUNKS) for draw in (render, render_reference)
        )
        assert_close(ours, expected, FLOAT64)
    with pytest.raises(ValueError, match=r"features: expected shape \(32, n\), got \(31, 5\)"):
        render(random_gaussians(13, np.float32), camera(np.float32), features=jnp.zeros((31, 5)))


@pytest.mark.slow
@pytest.mark.parametrize("most", [60, 1])
def test_an_image_in_bands_is_the_image(most):
    gaussians, view = random_gaussians(3, np.float32), camera(np.float32)
    whole, banded = render(gaussians, view), render_in_bands(gaussians, view, most_pairs=most)
    for name in ("rgb", "alpha", "depth"):
        got, expected = getattr(banded, name), np.asarray(getattr(whole, name))
        assert got.shape == expected.shape
        np.testing.assert_allclose(got, expected, atol=FLOAT32)


@pytest.mark.slow
def test_gradients_are_derivatives():
    """Expected are central differences; at this seed no decision flips and no alpha is clamped."""
    with jax.enable_x64(True):
        gaussians, step = random_gaussians(11), 1e-6
        gaussians = replace(gaussians, opacities=gaussians.opacities.at[:15].multiply(0.9))
        arguments = gaussians, camera(), background()
        gradients = tiled(*arguments)[1]
        rng = np.random.default_rng(3)
        weights = loss_weights()

        def loss(arguments):
            r = tiled(*arguments)[0]
            return sum(
                float(np.sum(w * np.asarray(a)))
                for w, a in zip(weights, (r.rgb, r.alpha, r.depth), strict=True)
            )

        leaves, structure = jax.tree.flatten(arguments)
        slopes = jax.tree.leaves(gradients)
        assert [a.shape for a in leaves] == [a.shape for a in slopes]
        # one random direction in each array of the arguments
        for i, slope in enumerate(slopes):
            direction = jnp.asarray(rng.normal(size=slope.shape))
            moved = [
                jax.tree.unflatten(
                    structure, [*leaves[:i], leaves[i] + s * direction, *leaves[i + 1 :]]
                )
                for s in (step, -step)
            ]
            difference = (loss(moved[0]) - loss(moved[1])) / (2 * step)
            np.testing.assert_allclose(jnp.vdot(slope, direction), difference, rtol=1e-4, atol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize(
    "config", [SplatConfig(), SplatConfig(tile_size=5, block=3, chunk=1)], ids=["default", "tile 5"]
)
def test_the_schedule_does_not_change_the_image(config):
    with jax.enable_x64(True):
        gaussians = random_gaussians(5)
        expected = reference(gaussians, camera(), background())[0]
        assert_close(render(gaussians, camera(), config, background()), expected, FLOAT64)


@pytest.mark.slow
def test_every_knob_means_the_same_as_in_the_reference():
    config = dataclasses.replace(
        CHUNKS,
        near=2.5,
        eps2d=0.1,
        alpha_min=0.05,
        alpha_max=0.8,
        transmittance_stop=0.02,
        jacobian_margin=0.0,
    )
    with jax.enable_x64(True):
        gaussians = random_gaussians(6)
        ours, expected = (
            f(gaussians, camera(), config, background()) for f in (render, render_reference)
        )
        assert_close(ours, expected, FLOAT64)


@pytest.mark.slow
def test_float32_differs_only_by_rounding_and_by_decisions():
    gaussians, view = random_gaussians(8, np.float32), camera(np.float32)
    ours = tiled(gaussians, view, background(np.float32))
    with jax.enable_x64(True):
        exact = jax.tree.map(
            lambda a: jnp.asarray(np.asarray(a, np.float64)),
            (gaussians, view, background(np.float32)),
        )
        expected = reference(*exact)
    error = np.abs(np.asarray(ours[0].rgb) - np.asarray(expected[0].rgb)).max(axis=-1)
    # pixels at which alpha = 1/255, the stop or the order fell the other way
    assert np.sum(error > bound(FLOAT32)) <= 2
    assert error.max() < 2 / 255
    assert_close(ours[1], jax.tree.map(np.asarray, expected[1]), FLOAT32_GRADIENT)
    assert ours[0].rgb.dtype == np.float32


@pytest.mark.slow
def test_coincident_depths_are_drawn_by_index():
    with jax.enable_x64(True):
        gaussians = random_gaussians(10)
        level = replace(camera(), cam_from_world=jnp.eye(4))
        flat = replace(gaussians, means=gaussians.means.at[:, 2].set(3.0))
        image, reverse = (
            tiled(g, level, background())[0] for g in (flat, few(flat, np.arange(COUNT)[::-1]))
        )
        assert_close(image, reference(flat, level, background())[0], FLOAT64)
        # the order is visible, and is that of the index
        assert np.abs(image.rgb - reverse.rgb).max() > 0.01


def views(dtype=np.float32):
    tilts = [camera(dtype).cam_from_world.at[0, 3].add(0.1 * i) for i in range(3)]
    return stack_cameras([replace(camera(dtype), cam_from_world=tilt) for tilt in tilts])


@pytest.mark.slow
def test_batches_of_subjects_and_views_equal_the_loop():
    """Gradients are of a sum over nested vmaps, through a checkpoint."""
    with jax.enable_x64(True):
        subjects, cameras = [random_gaussians(seed) for seed in (1, 2)], views(np.float64)
        draw = jax.checkpoint(lambda g, c, b: render(g, c, CHUNKS, b))

        @jax.jit
        def together(batch):
            def loss(batch):
                renderings = jax.vmap(jax.vmap(draw, (None, 0, None)), (0, None, None))(
                    batch, cameras, background()
                )
                outputs = renderings.rgb, renderings.alpha, renderings.depth
                return sum(
                    jnp.sum(w * a) for w, a in zip(loss_weights(), outputs, strict=True)
                ), renderings

            (_, renderings), gradients = jax.value_and_grad(loss, has_aux=True)(batch)
            return renderings, gradients

        renderings, gradients = together(jax.tree.map(lambda *leaves: jnp.stack(leaves), *subjects))
        # renderings are those of single calls, gradients their sum over views
        for i, subject in enumerate(subjects):
            singles = [tiled(subject, cameras[j], background()) for j in range(3)]
            for j, (rendering, _) in enumerate(singles):
                assert_close(
                    jax.tree.map(lambda leaf, i=i, j=j: leaf[i, j], renderings), rendering, FLOAT64
                )
            total = jax.tree.map(
                lambda *leaves: sum(leaves), *(gradient[0] for _, gradient in singles)
            )
            assert_close(jax.tree.map(lambda leaf, i=i: leaf[i], gradients), total, FLOAT64)


@pytest.mark.slow
def test_render_views_equals_the_loop_and_fits_the_largest_view():
    with jax.enable_x64(True):
        gaussians, cameras = random_gaussians(1), views(np.float64)
        renderings = render_views(gaussians, cameras, CHUNKS, background())
        for i in range(3):
            single = tiled(gaussians, cameras[i], background())[0]
            assert_close(jax.tree.map(lambda leaf, i=i: leaf[i], renderings), single, FLOAT64)


def needed(gaussians, view):
    """Returns the number of pairs that an error message asks for."""
    with pytest.raises(ValueError, match="max_pairs >= ") as error:
        render(gaussians, view, dataclasses.replace(CHUNKS, max_pairs=1))
    return int(str(error.value).split("max_pairs >= ")[1].split()[0])


@pytest.mark.slow
def test_overflow_is_counted_under_jit_and_refused_eagerly():
    gaussians, view = random_gaussians(2, np.float32), camera(np.float32)
    pairs = needed(gaussians, view)
    config = dataclasses.replace(CHUNKS, max_pairs=pairs - 20, max_rows=256)
    assert jax.jit(render, static_argnums=2)(gaussians, view, config).overflow == 20
    with pytest.raises(
        ValueError, match=rf"20 .*max_pairs >= {pairs} .*got max_pairs = {pairs - 20}"
    ):
        render(gaussians, view, config)


@pytest.mark.parametrize("draw", [render, pytest.param(render_views, marks=pytest.mark.slow)])
def test_traced_calls_warn_of_what_did_not_fit_where_asked(draw, caplog):
    gaussians, cameras = (
        random_gaussians(0, np.float32),
        camera(np.float32) if draw is render else views(),
    )
    small = dataclasses.replace(CHUNKS, max_pairs=64)
    asking = dataclasses.replace(small, warn_overflow=True)

    def loss(opacities, config):
        return draw(replace(gaussians, opacities=opacities), cameras, config).rgb.sum()

    def program(config):
        return str(jax.make_jaxpr(jax.grad(loss), static_argnums=1)(gaussians.opacities, config))

    assert "callback" not in program(small) and "debug_callback" in program(asking)
    drawn = jax.jit(loss, static_argnums=1)
    with caplog.at_level(logging.WARNING):
        jax.block_until_ready(drawn(0 * gaussians.opacities, asking))  # nothing to draw: all fits
        jax.effects_barrier()
        assert not caplog.records
        jax.block_until_ready(drawn(gaussians.opacities, asking))
        jax.effects_barrier()
    (record,) = caplog.records
    assert "pairs of a view did not fit and were not drawn: max_pairs = 64" in record.message


def test_fitted_buffers_hold_every_view():
    gaussians, cameras = random_gaussians(2, np.float32), views()
    config = plan_buffers(gaussians, cameras, CHUNKS, margin=1.0)
    most = max(needed(gaussians, cameras[i]) for i in range(3))
    assert most <= config.max_pairs < 1.5 * most
    # never more than every Gaussian in every tile
    assert default_pairs(COUNT, WIDTH, HEIGHT) == COUNT * 6
    assert default_pairs(50_000, 512, 512) == 12 * 50_000 + 16 * 4096


def test_lowers_for_every_platform():
    gaussians, view = with_harmonics(random_gaussians(0, np.float32), 15), camera(np.float32)
    function = jax.grad(lambda gaussians, view: jnp.sum(render(gaussians, view, CHUNKS).rgb))
    exported = jax.export.export(jax.jit(function), platforms=("cpu", "cuda", "tpu"))(
        gaussians, view
    )
    assert "callback" not in exported.mlir_module()


@functools.partial(jax.jit, static_argnames=("camera_size",))
def pairs_in(gaussians, view, camera_size):
    """Returns the number of pairs in an image of this size."""
    projected = project_gaussians(gaussians, view)
    footprints = footprints_by(projected, gaussians.opacities, DEFAULT_CONFIG)
    return count_pairs(footprints, TileGrid(*camera_size, DEFAULT_CONFIG.tile_size))[1]


def test_buffers_are_planned_by_one_program_whatever_the_size_and_number_of_images():
    gaussians = random_gaussians(COUNT, dtype=np.float32)
    view = camera(np.float32)
    each = [view.resized(40, 24), view.resized(72, 56)]
    with compiled_programs() as programs:
        found = [plan_buffers(gaussians, one, margin=1.0).max_pairs for one in each]
        both = plan_buffers(gaussians, stack_cameras([each[1]] * 3), margin=1.0).max_pairs
    assert len(programs) <= 1  # none if an earlier test had such Gaussians
    needed = [int(pairs_in(gaussians, one, (one.width, one.height))) for one in each]
    assert found == [round_up(pairs) for pairs in needed] and both == found[1]
    assert 64 < found[0] < found[1]
