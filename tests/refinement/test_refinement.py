"""Refinement on a toy person: a body whose Gaussians differ in colour from its photos."""

import dataclasses
import itertools
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from refinement_cases import HEIGHT, STEPS, WIDTH, assert_nearly_all_close, toy_avatar, toy_capture

from humangs_jax.avatar.frames import capture_renderings
from humangs_jax.avatar.low_pass import pixel_sizes, with_low_pass, with_low_pass_of, without_low_pass
from humangs_jax.body.decimation import decimate
from humangs_jax.body.library import load_body
from humangs_jax.core.pytree import replace
from humangs_jax.data.capture import load_capture
from humangs_jax.refinement import refine as refinement
from humangs_jax.refinement.config import RefineConfig
from humangs_jax.refinement.crops import BLOCK, crop_to_person
from humangs_jax.refinement.parameters import gaussians_of, parameters_of
from humangs_jax.rendering.splat_config import SPLAT_PRESETS, SplatConfig
from humangs_jax.rendering.splatting import plan_buffers, render

SAME_SIZE = 2e-3  # of alpha, in the mean: flat Gaussians become a little thicker
SAME_GAIN = 0.05  # dB: a report counts the pixels of the crop
VMAP_TOLERANCE = 5e-4  # Adam divides by the gradient's size: rounding of gradients near 0 becomes a share of a rate


@pytest.fixture(scope="module")
def body():
    return decimate(load_body(), 400)


@pytest.fixture(scope="module")
def person(body):
    """The avatar to be refined, and photos of the same one in other colours."""
    return toy_avatar(body, 0.0), toy_capture(body, toy_avatar(body, 0.15), moving=True)


@pytest.mark.slow
def test_comes_closer_to_photos_of_a_moving_person(person):
    avatar, capture = person
    so_far = []
    report = refinement.refine_with_report(avatar, capture, STEPS, watch=so_far.append)
    assert report.kept and report.steps == 12
    assert len(so_far) == STEPS.checks and (so_far[0].gaussians.colors != so_far[-1].gaussians.colors).any()
    assert report.loss[1] < 0.8 * report.loss[0]
    assert report.psnr[1] > report.psnr[0] + 1
    assert "12 steps" in report.summary()


@pytest.mark.slow
def test_a_share_that_holds_nothing_out_keeps_the_last_state(person):
    report = refinement.refine_with_report(*person, dataclasses.replace(STEPS, held_out=1e-6))
    assert report.kept and report.loss[1] < 0.8 * report.loss[0]


def test_what_no_photo_sees_stays(body, person):
    avatar, capture = person
    hidden = replace(avatar.gaussians, opacities=avatar.gaussians.opacities.at[:50].set(0.0))
    refined = refinement.refine(replace(avatar, gaussians=hidden), capture, STEPS)
    np.testing.assert_allclose(refined.gaussians.means[:50], avatar.gaussians.means[:50], atol=1e-7)
    assert np.abs(refined.gaussians.means[50:] - avatar.gaussians.means[50:]).max() > 1e-4


@pytest.mark.slow
def test_never_worse_than_the_start(person):
    avatar, capture = person
    truth = toy_capture(capture.body, avatar)
    report = refinement.refine_with_report(avatar, truth, dataclasses.replace(STEPS, steps=3))
    assert not report.kept and report.loss[0] == report.loss[1]
    jax.tree.map(np.testing.assert_array_equal, report.avatar, avatar)


def test_refined_avatars_look_the_same_at_other_sizes(person):
    """As an image of the photos' size, reduced, does; and at that size as the optimised Gaussians do."""
    avatar, capture = person
    refined = refinement.refine(avatar, capture, STEPS)
    raw = without_low_pass(refined)
    camera, pose = capture.cameras[0], capture.pose(0)
    drawn = lambda a, camera: render(refinement.posed(a, pose), camera, SPLAT_PRESETS[a.rendering]).alpha
    assert refined.gaussians.low_pass is not None and avatar.gaussians.low_pass is None
    assert jnp.abs(drawn(refined, camera) - drawn(raw, camera)).mean() < SAME_SIZE
    reduced = drawn(raw, camera).reshape(HEIGHT // 2, 2, WIDTH // 2, 2).mean(axis=(1, 3))
    errors = [
        float(jnp.abs(drawn(a, camera.resized(WIDTH // 2, HEIGHT // 2)) - reduced).mean()) for a in (refined, raw)
    ]
    assert errors[0] < 0.7 * errors[1]
    again = refinement.refine(refined, capture, dataclasses.replace(STEPS, steps=2))
    np.testing.assert_allclose(again.gaussians.low_pass, refined.gaussians.low_pass, rtol=0.01)


def squared_error(avatar, capture):
    drawn = [np.asarray(r.rgb) for r in capture_renderings(avatar, capture)[1]]
    return float(np.mean(np.square(np.clip(drawn, 0, 1) - capture.images)))


@pytest.mark.parametrize("times", [1 / 3, 3])
def test_steps_start_from_what_the_photos_show_of_an_avatar(person, times):
    """Also if its low-pass is that of smaller or larger pixels than theirs."""
    avatar, capture = person
    views = crop_to_person(capture)
    own = with_low_pass(avatar, times * pixel_sizes(avatar, views))
    start = with_low_pass_of(own, views)
    assert squared_error(start, capture) == squared_error(own, capture)
    expected = own.gaussians.low_pass * min(1, 1 / times)
    np.testing.assert_allclose(start.gaussians.low_pass, expected, rtol=1e-5)
    report = refinement.refine_with_report(own, capture, STEPS)
    errors = [squared_error(own, capture), squared_error(report.avatar, capture)]
    np.testing.assert_allclose(np.diff(report.psnr), -10 * np.diff(np.log10(errors)), atol=SAME_GAIN)
    assert report.kept and errors[1] < errors[0]
    views_alone, _ = refinement.refine_views(own, views, STEPS, SplatConfig(max_pairs=1 << 14, max_rows=1 << 13), 0)
    np.testing.assert_allclose(squared_error(views_alone, capture), errors[0], rtol=1e-3)


def test_photos_from_near_and_far_are_fitted_together(body, person):
    """The far ones have larger pixels, which do not blur what the near one shows."""
    avatar, _ = person
    photos = toy_capture(body, toy_avatar(body, 0.1), distance=jnp.asarray([2.5, 5.0, 12.0]))
    report = refinement.refine_with_report(avatar, photos, STEPS)
    assert report.kept and squared_error(report.avatar, photos) < 0.7 * squared_error(avatar, photos)
    nearest = pixel_sizes(avatar, crop_to_person(photos))
    np.testing.assert_array_equal(report.avatar.gaussians.low_pass, nearest)
    assert jnp.median(nearest) < 0.5 * 12.0 / float(photos.cameras.K[0, 0, 0])  # heads and feet are not in all frames


def test_what_no_photo_has_in_its_frame_has_the_pixels_of_the_rest(person):
    avatar, capture = person
    away = replace(avatar, gaussians=replace(avatar.gaussians, means=avatar.gaussians.means.at[0].add(50.0)))
    sizes = pixel_sizes(away, crop_to_person(capture))
    assert sizes[0] == sizes[1:].max()


def test_interruption_returns_the_best_state(person, monkeypatch):
    avatar, capture = person
    step, calls = refinement._Run.step, []

    def interrupted(self, state, *when):
        calls.append(when)
        if len(calls) > 9:
            raise KeyboardInterrupt
        return step(self, state, *when)

    monkeypatch.setattr(refinement._Run, "step", interrupted)
    report = refinement.refine_with_report(avatar, capture, STEPS)
    assert report.interrupted and report.steps == 8 and report.kept and "interrupted" in report.summary()


@pytest.mark.slow
def test_pure_function_maps_over_people(body, person):
    avatar, capture = person
    views = crop_to_person(capture)
    other = replace(avatar, gaussians=replace(avatar.gaussians, colors=1 - avatar.gaussians.colors))
    splat = plan_buffers(avatar.gaussians, views.cameras, margin=3.0)
    run = lambda avatar, views: refinement.refine_views(avatar, views, STEPS, splat, 4)
    stacked = jax.tree.map(lambda *x: jnp.stack(x), avatar, other), jax.tree.map(lambda x: jnp.stack([x, x]), views)
    batch, overflow = jax.jit(jax.vmap(run))(*stacked)
    assert not overflow.any()
    for i, one in enumerate((avatar, other)):
        alone, _ = jax.jit(run)(one, views)
        assert_nearly_all_close(jax.tree.map(lambda x, i=i: x[i], batch), alone, VMAP_TOLERANCE)


def test_parameters_invert(person):
    gaussians = person[0].gaussians
    back = gaussians_of(parameters_of(gaussians, 2, 55), None)
    for got, expected in zip(jax.tree.leaves(back), jax.tree.leaves(gaussians), strict=True):
        np.testing.assert_allclose(got, expected, rtol=1e-5)


@pytest.mark.slow
def test_crops_show_the_same_pixels(person):
    avatar, capture = person
    wide = np.pad(capture.images, ((0, 0), (40, 40), (30, 70), (0, 0)), constant_values=1.0)
    masks = np.pad(capture.masks, ((0, 0), (40, 40), (30, 70)))
    K = np.asarray(capture.cameras.K) + np.asarray([[0, 0, 30], [0, 0, 40], [0, 0, 0]])
    cameras = replace(capture.cameras, K=jnp.asarray(K, jnp.float32), width=WIDTH + 100, height=HEIGHT + 80)
    views = crop_to_person(dataclasses.replace(capture, images=wide, masks=masks, cameras=cameras))
    assert views.masks.shape[1] < HEIGHT + 80 and views.masks.shape[2] < WIDTH + 100
    assert views.masks.sum() == pytest.approx(masks.sum(), rel=1e-6)
    posed = refinement.posed(avatar, capture.pose(1))
    drawn = render(posed, views.cameras[1], background=jnp.ones(3))
    whole = render(posed, cameras[1])
    rows, columns = (np.asarray(cameras.K[1] - views.cameras.K[1])[i, 2].astype(int) for i in (1, 0))
    height, width = drawn.alpha.shape
    np.testing.assert_allclose(drawn.rgb, whole.rgb[rows : rows + height, columns : columns + width], atol=1e-5)


def test_specks_of_a_mask_do_not_widen_the_crops():
    capture = load_capture("demo_capture")
    masks = capture.masks.copy()
    masks[2, :2, :3] = masks[3, -1, -1] = 1
    crops, specked = crop_to_person(capture), crop_to_person(dataclasses.replace(capture, masks=masks))
    assert crops.images.shape[1:3] != capture.images.shape[1:3]
    np.testing.assert_array_equal(specked.images, crops.images)
    np.testing.assert_array_equal(specked.cameras.K, crops.cameras.K)


@pytest.mark.parametrize(
    ("settings", "named"),
    [
        ({"steps": None, "seconds": None}, "steps, seconds"),
        ({"rounds": 0, "steps": 0}, "rounds 0, steps 0"),
        ({"rounds": -1}, "rounds -1"),
        ({"seconds": 0.0}, "seconds"),
        ({"decay": 2.0}, "decay"),
        ({"visible": 0.0}, "visible"),
        ({"full_steps": 0}, "full_steps"),
    ],
)
def test_wrong_settings_are_named(settings, named):
    with pytest.raises(ValueError, match=named):
        RefineConfig(**settings)


def test_wrong_captures_are_named(body, person):
    avatar, capture = person
    with pytest.raises(ValueError, match="0 views"):
        refinement.refine(avatar, capture.select([]))
    with pytest.raises(ValueError, match="no masks"):
        refinement.refine(avatar, dataclasses.replace(capture, masks=None))
    few = dataclasses.replace(capture, poses=replace(capture.poses, rotations=capture.poses.rotations[:, :20]))
    with pytest.raises(ValueError, match="20 joints, the avatar has 55"):
        refinement.refine(avatar, few)


SHARED = """
import sys
sys.path.insert(0, sys.argv[1])
import jax
jax.config.update("jax_platforms", "cpu")
jax.config.update("jax_num_cpu_devices", 2)
import dataclasses
import numpy as np
from humangs_jax.body.decimation import decimate
from humangs_jax.body.library import load_body
from humangs_jax.refinement.refine import refine_with_report
from refinement_cases import STEPS, assert_nearly_all_close, toy_avatar, toy_capture
body = decimate(load_body(), 400)
avatar = toy_avatar(body, 0.0)
capture = toy_capture(body, toy_avatar(body, 0.15), views=2)
config = dataclasses.replace(STEPS, rounds=1, steps=3, views_per_step=2)
alone = refine_with_report(avatar, capture, config)
shared = refine_with_report(avatar, capture, config, mesh=jax.make_mesh((2,), ("photos",)))
assert alone.kept and shared.kept
assert shared.avatar.gaussians.means.devices() == alone.avatar.gaussians.means.devices()
assert_nearly_all_close(shared.avatar, alone.avatar, float(sys.argv[2]))
"""


@pytest.mark.slow
def test_devices_share_the_photos_of_a_step():
    done = subprocess.run(
        [sys.executable, "-c", SHARED, str(Path(__file__).parent), str(VMAP_TOLERANCE)], capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr


def test_a_mesh_of_two_axes_is_refused(person):
    with pytest.raises(ValueError, match="views_per_step 1"):
        refinement.refine(*person, STEPS, mesh=jax.make_mesh((1, 1), ("photos", "rows")))


def run_of(person, config=STEPS, views=3):
    avatar, capture = person
    crops = crop_to_person(capture.select(range(views)))
    return refinement._Run(avatar, crops, config, None, plan_buffers(avatar.gaussians, crops.cameras, margin=3.0))


def test_long_runs_after_rounds_take_smaller_steps(person):
    by_clock = run_of(person, dataclasses.replace(STEPS, rounds=2, steps=None, seconds=10.0, full_steps=50))
    assert by_clock.share(0, 0.0, 1.0) == 0  # 1 s of rounds, then 9 s of steps
    assert by_clock.share(20, 1.0, 1.0) == pytest.approx(50 / 180) and by_clock.share(20, 4.5, 1.0) == 1
    by_steps = run_of(person, dataclasses.replace(STEPS, rounds=2, steps=12, full_steps=6))
    assert by_steps.share(0, 0.0, 1.0) == by_steps.share(3, 1.0, 1.0) == 0.5
    both = run_of(person, dataclasses.replace(STEPS, rounds=2, steps=100, seconds=10.0, full_steps=50))
    assert both.share(0, 0.0, 1.0) == both.share(20, 1.0, 1.0) == 0.5 and both.share(20, 3.0, 1.0) == 50 / 60


def test_a_clock_ends_the_steps_after_the_rounds(person, monkeypatch):
    ticks = itertools.count()
    monkeypatch.setattr(refinement, "time", SimpleNamespace(perf_counter=lambda: 0.1 * next(ticks)))
    report = refinement.refine_with_report(*person, dataclasses.replace(STEPS, rounds=1, steps=None, seconds=1.0))
    assert report.rounds == 1 and 5 < report.steps < 10
    assert report.seconds == pytest.approx(1.1, abs=0.15)


def test_compiling_for_larger_buffers_does_not_count(person, monkeypatch):
    clock, compile, planned = SimpleNamespace(now=0.0), refinement._Run.compile, refinement._planned

    def then_small(self, state):
        compile(self, state)
        self.splat = dataclasses.replace(self.splat, max_pairs=64)

    def slowly(avatar, photos):
        clock.now += 100
        return planned(avatar, photos)

    monkeypatch.setattr(refinement, "time", SimpleNamespace(perf_counter=lambda: clock.now))
    monkeypatch.setattr(refinement._Run, "compile", then_small)
    monkeypatch.setattr(refinement, "_planned", slowly)
    report = refinement.refine_with_report(*person, dataclasses.replace(STEPS, steps=2))
    assert clock.now == 200  # once before the run, once within
    assert (report.seconds, report.compile_seconds) == (0, 100)


def test_of_many_photos_one_is_held_out_whole_and_never_drawn(person, monkeypatch):
    monkeypatch.setattr(refinement, "HELD_OUT_PHOTOS", 3)
    run = run_of(person, dataclasses.replace(STEPS, held_out=0.05, views_per_step=2))
    held = np.asarray(run.held.counted).all(axis=(1, 2))
    assert held.sum() == 1 and not np.asarray(run.held.counted)[~held].any()
    np.testing.assert_array_equal(run.seen.counted, ~run.held.counted)
    drawn = np.concatenate([next(run.order) for _ in range(5)])
    assert set(drawn) == set(np.flatnonzero(~held))


@pytest.mark.slow
def test_blocks_are_held_out_of_steps_and_checked(person):
    run = run_of(person, dataclasses.replace(STEPS, held_out=0.3))
    held = np.asarray(run.held.counted)
    np.testing.assert_array_equal(run.seen.counted, ~held)
    assert 0.1 < held.mean() < 0.5
    blocks = held[:, : held.shape[1] // BLOCK * BLOCK, : held.shape[2] // BLOCK * BLOCK]
    blocks = blocks.reshape(len(held), -1, BLOCK, blocks.shape[2] // BLOCK, BLOCK)
    np.testing.assert_array_equal(blocks.any(axis=(2, 4)), blocks.all(axis=(2, 4)))
    assert set(np.concatenate([next(run.order) for _ in range(3)])) == {0, 1, 2}


@pytest.mark.slow
def test_refined_poses_explain_photos_of_poses_that_are_off(person):
    avatar, _ = person
    capture = toy_capture(person[1].body, avatar)
    off = replace(capture.poses, translation=capture.poses.translation + 0.02)
    config = dataclasses.replace(STEPS, steps=30, rates=dataclasses.replace(STEPS.rates, translations=2e-3))
    run = lambda poses: refinement.refine_with_report(
        avatar, dataclasses.replace(capture, poses=off), dataclasses.replace(config, poses=poses)
    )
    fixed, moved = run(False), run(True)
    assert moved.psnr[1] > fixed.psnr[1] + 1
    assert (
        np.abs(moved.avatar.gaussians.means - avatar.gaussians.means).mean()
        < np.abs(fixed.avatar.gaussians.means - avatar.gaussians.means).mean()
    )


@pytest.mark.slow
def test_buffers_that_are_too_small_are_planned_again(person):
    run = run_of(person)
    run.splat = dataclasses.replace(run.splat, max_pairs=64, max_rows=64)
    report = run.go(progress=False, watch=None)
    assert run.splat.max_pairs > 64
    assert report.steps == STEPS.steps
