"""Refinement of a toy person, whose Gaussians differ in color from the photos."""

import dataclasses
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from refinement_cases import (
    HEIGHT,
    STEPS,
    WIDTH,
    assert_nearly_all_close,
    squared_error,
    toy_avatar,
    toy_capture,
)

from humangs_jax.avatar.animate import (
    pixel_sizes,
    with_pixel_footprint,
    with_pixel_footprint_of,
    without_pixel_footprint,
)
from humangs_jax.avatar.frames import capture_renderings, posed
from humangs_jax.core.pytree import replace
from humangs_jax.data.capture import load_capture
from humangs_jax.data.prepared import prepare_capture
from humangs_jax.refinement import refine as refinement
from humangs_jax.refinement import search
from humangs_jax.refinement.config import RefineConfig
from humangs_jax.refinement.objective import Comparison, gaussians_of, parameters_of
from humangs_jax.refinement.photos import BLOCK, crop_to_person, held_out_blocks, photo_order
from humangs_jax.refinement.search import Clock
from humangs_jax.refinement.steps import DECAY, OPTIMIZERS, init_state, refine_views, update
from humangs_jax.rendering.buffers import plan_buffers
from humangs_jax.rendering.gaussians import UnconstrainedGaussians
from humangs_jax.rendering.splat_config import SPLAT_PRESETS, SplatConfig
from humangs_jax.rendering.splatting import render

SAME_SIZE = 2e-3  # of alpha, in the mean: flat Gaussians become a little thicker
SAME_GAIN = 0.05  # dB: a report counts the pixels of the crop
# Adam divides by the gradient's size: rounding of gradients near 0 becomes a share of a rate
VMAP_TOLERANCE = 5e-4


@pytest.mark.slow
def test_comes_closer_to_photos_of_a_moving_person(person):
    avatar, capture = person
    so_far = []
    report = refinement.refine_with_report(avatar, capture, STEPS, watch=so_far.append)
    assert report.kept and report.steps == 12
    assert (
        len(so_far) == STEPS.checks
        and (so_far[0].gaussians.colors != so_far[-1].gaussians.colors).any()
    )
    assert report.loss[1] < 0.8 * report.loss[0]
    assert report.psnr[1] > report.psnr[0] + 1
    assert "12 steps" in report.summary()


@pytest.mark.slow
def test_a_share_that_holds_nothing_out_keeps_the_last_state(person):
    report = refinement.refine_with_report(*person, dataclasses.replace(STEPS, held_out=1e-6))
    assert report.kept and report.loss[1] < 0.8 * report.loss[0]


def test_what_no_photo_sees_stays(person):
    avatar, capture = person
    hidden = replace(avatar.gaussians, opacities=avatar.gaussians.opacities.at[:50].set(0.0))
    refined = refinement.refine(replace(avatar, gaussians=hidden), capture, STEPS)
    np.testing.assert_allclose(refined.gaussians.means[:50], avatar.gaussians.means[:50], atol=1e-7)
    assert np.abs(refined.gaussians.means[50:] - avatar.gaussians.means[50:]).max() > 1e-4


@pytest.mark.slow
def test_refined_avatars_look_the_same_at_other_sizes(person):
    """They look like a reduced image of the photos' size, and like the optimised Gaussians at that
    size.
    """
    avatar, capture = person
    refined = refinement.refine(avatar, capture, STEPS)
    raw = without_pixel_footprint(refined)
    camera, pose = capture.cameras[0], capture.pose(0)
    drawn = lambda a, camera: render(posed(a, pose), camera, SPLAT_PRESETS[a.rendering]).alpha
    assert (
        refined.gaussians.pixel_footprint is not None and avatar.gaussians.pixel_footprint is None
    )
    assert jnp.abs(drawn(refined, camera) - drawn(raw, camera)).mean() < SAME_SIZE
    reduced = drawn(raw, camera).reshape(HEIGHT // 2, 2, WIDTH // 2, 2).mean(axis=(1, 3))
    errors = [
        float(jnp.abs(drawn(a, camera.resized(WIDTH // 2, HEIGHT // 2)) - reduced).mean())
        for a in (refined, raw)
    ]
    assert errors[0] < 0.7 * errors[1]
    again = refinement.refine(refined, capture, dataclasses.replace(STEPS, steps=2))
    np.testing.assert_allclose(
        again.gaussians.pixel_footprint, refined.gaussians.pixel_footprint, rtol=0.01
    )


@pytest.mark.slow
@pytest.mark.parametrize("times", [1 / 3, 3])
def test_steps_start_from_what_the_photos_show_of_an_avatar(person, times):
    """This also holds if its low-pass is that of smaller or larger pixels."""
    avatar, capture = person
    views = crop_to_person(prepare_capture(capture))
    own = with_pixel_footprint(avatar, times * pixel_sizes(avatar, views))
    start = with_pixel_footprint_of(own, views)
    # those of smaller pixels are dimmed where a photo shows the person smaller than another does
    np.testing.assert_allclose(
        squared_error(start, capture), squared_error(own, capture), rtol=0.01
    )
    expected = own.gaussians.pixel_footprint * min(1, 1 / times)
    np.testing.assert_allclose(start.gaussians.pixel_footprint, expected, rtol=1e-5)
    report = refinement.refine_with_report(own, capture, STEPS)
    errors = [squared_error(own, capture), squared_error(report.avatar, capture)]
    np.testing.assert_allclose(
        np.diff(report.psnr), -10 * np.diff(np.log10(errors)), atol=SAME_GAIN
    )
    assert report.kept and errors[1] < errors[0]
    views_alone, _ = refine_views(
        own, views, STEPS, SplatConfig(max_pairs=1 << 14, max_rows=1 << 13), 0
    )
    # dimmed, as above
    np.testing.assert_allclose(squared_error(views_alone, capture), errors[0], rtol=0.01)


@pytest.mark.slow
def test_photos_from_near_and_far_are_fitted_together(body, person):
    """The larger pixels of the far photos do not blur what the near one shows."""
    avatar, _ = person
    photos = toy_capture(body, toy_avatar(body, 0.1), distance=jnp.asarray([2.5, 5.0, 12.0]))
    report = refinement.refine_with_report(avatar, photos, STEPS)
    assert report.kept and squared_error(report.avatar, photos) < 0.8 * squared_error(
        avatar, photos
    )
    nearest = pixel_sizes(avatar, crop_to_person(prepare_capture(photos)))
    np.testing.assert_array_equal(report.avatar.gaussians.pixel_footprint, nearest)
    # heads and feet are not in all frames
    assert jnp.median(nearest) < 0.5 * 12.0 / float(photos.cameras.K[0, 0, 0])


def test_what_no_photo_has_in_its_frame_has_the_pixels_of_the_rest(person):
    avatar, capture = person
    away = replace(
        avatar, gaussians=replace(avatar.gaussians, means=avatar.gaussians.means.at[0].add(50.0))
    )
    sizes = pixel_sizes(away, crop_to_person(prepare_capture(capture)))
    assert sizes[0] == sizes[1:].max()


def test_interruption_returns_the_best_state(person, monkeypatch):
    calls = []

    def interrupted(own, *arguments):
        calls.append(arguments)
        if len(calls) > 9:
            raise KeyboardInterrupt
        return own(*arguments)

    stepping(monkeypatch, interrupted)
    report = refinement.refine_with_report(*person, STEPS)
    assert (
        report.interrupted
        and report.steps == 8
        and report.kept
        and "interrupted" in report.summary()
    )


@pytest.mark.slow
def test_pure_function_maps_over_people(person):
    avatar, capture = person
    views = crop_to_person(prepare_capture(capture))
    other = replace(avatar, gaussians=replace(avatar.gaussians, colors=1 - avatar.gaussians.colors))
    splat = plan_buffers(avatar.gaussians, views.cameras, margin=3.0)
    run = lambda avatar, views: refine_views(avatar, views, STEPS, splat, 4)
    stacked = (
        jax.tree.map(lambda *x: jnp.stack(x), avatar, other),
        jax.tree.map(lambda x: jnp.stack([x, x]), views),
    )
    batch, overflow = jax.jit(jax.vmap(run))(*stacked)
    assert not overflow.any()
    for i, one in enumerate((avatar, other)):
        alone, _ = jax.jit(run)(one, views)
        assert_nearly_all_close(jax.tree.map(lambda x, i=i: x[i], batch), alone, VMAP_TOLERANCE)


def test_parameters_invert(person):
    gaussians = person[0].gaussians
    back = gaussians_of(parameters_of(gaussians), None)
    for got, expected in zip(jax.tree.leaves(back), jax.tree.leaves(gaussians), strict=True):
        np.testing.assert_allclose(got, expected, rtol=1e-5)


@pytest.mark.slow
def test_crops_show_the_same_pixels(person):
    avatar, capture = person
    wide = np.pad(capture.images, ((0, 0), (40, 40), (30, 70), (0, 0)), constant_values=1.0)
    masks = np.pad(capture.masks, ((0, 0), (40, 40), (30, 70)))
    K = np.asarray(capture.cameras.K) + np.asarray([[0, 0, 30], [0, 0, 40], [0, 0, 0]])
    cameras = replace(
        capture.cameras, K=jnp.asarray(K, jnp.float32), width=WIDTH + 100, height=HEIGHT + 80
    )
    views = crop_to_person(
        prepare_capture(dataclasses.replace(capture, images=wide, masks=masks, cameras=cameras))
    )
    assert views.masks.shape[1] < HEIGHT + 80 and views.masks.shape[2] < WIDTH + 100
    assert views.masks.sum() == pytest.approx(masks.sum(), rel=1e-6)
    gaussians = posed(avatar, capture.pose(1))
    drawn = render(gaussians, views.cameras[1], background=jnp.ones(3))
    whole = render(gaussians, cameras[1])
    rows, columns = (
        np.asarray(cameras.K[1] - views.cameras.K[1])[i, 2].astype(int) for i in (1, 0)
    )
    height, width = drawn.alpha.shape
    np.testing.assert_allclose(
        drawn.rgb, whole.rgb[rows : rows + height, columns : columns + width], atol=1e-5
    )


def test_specks_of_a_mask_do_not_widen_the_crops():
    capture = load_capture("demo_capture")
    masks = capture.masks.copy()
    masks[2, :2, :3] = masks[3, -1, -1] = 1
    crops, specked = (
        crop_to_person(prepare_capture(capture)),
        crop_to_person(prepare_capture(dataclasses.replace(capture, masks=masks))),
    )
    assert crops.images.shape[1:3] != capture.images.shape[1:3]
    # the whole person is in each
    np.testing.assert_allclose(
        np.sum(crops.masks, axis=(1, 2)), capture.masks.sum(axis=(1, 2)), rtol=0.01
    )
    np.testing.assert_array_equal(specked.images, crops.images)
    np.testing.assert_array_equal(specked.cameras.K, crops.cameras.K)


@pytest.mark.parametrize(
    ("settings", "named"),
    [
        ({"steps": None, "seconds": None}, "steps, seconds"),
        ({"iterations": 0, "steps": 0, "head_steps": 0}, "iterations 0, steps 0"),
        ({"iterations": -1}, "iterations -1"),
        ({"seconds": 0.0}, "seconds"),
        ({"visible": 0.0}, "visible"),
        ({"full_steps": 0}, "full_steps"),
    ],
)
def test_wrong_settings_are_named(settings, named):
    with pytest.raises(ValueError, match=named):
        RefineConfig(**settings)


def test_wrong_captures_are_named(person):
    avatar, capture = person
    with pytest.raises(ValueError, match="0 views"):
        refinement.refine(avatar, capture.select([]))
    with pytest.raises(ValueError, match="no masks"):
        refinement.refine(avatar, dataclasses.replace(capture, masks=None))
    few = dataclasses.replace(
        capture, poses=replace(capture.poses, rotations=capture.poses.rotations[:, :20])
    )
    with pytest.raises(ValueError, match="20 joints, the avatar has 55"):
        refinement.refine(avatar, few)


def stepping(monkeypatch, changed):
    """Replaces `search.step` by a function of it and its arguments."""
    own = search.step
    monkeypatch.setattr(search, "step", lambda *arguments: changed(own, *arguments))


@pytest.mark.parametrize(("iterations", "share"), [(2, 0.5), (0, 1.0)])
def test_long_runs_after_iterations_take_smaller_steps(iterations, share, person, monkeypatch):
    taken = []

    def recorded(own, state, *_):
        taken.append((int(state.done), int(state.total), float(state.share)))
        return replace(state, done=state.done + 1)

    stepping(monkeypatch, recorded)
    monkeypatch.setattr(
        search, "learned_update", lambda parameters, *_: (parameters, jnp.zeros((), int))
    )
    monkeypatch.setattr(
        search, "iterated", lambda task, start, used: (start._replace(iterations=iterations), 0.0)
    )
    refinement.refine(*person, dataclasses.replace(STEPS, iterations=iterations, full_steps=6))
    assert taken[1:] == [(i, 12, share) for i in range(12)]  # the first one compiles


@pytest.fixture
def clock(monkeypatch):
    """Returns a clock that each step and each iteration moves by a tenth of a second."""
    clock, learned = SimpleNamespace(now=0.0, slower=1.0), search.learned_update

    def timed(own, *arguments):
        clock.now += 0.1 * clock.slower
        return own(*arguments)

    def iterations(parameters, avatar, photos, graph, count, *how):
        clock.now += 0.1 * count
        return learned(parameters, avatar, photos, graph, count, *how)

    monkeypatch.setattr(search, "time", SimpleNamespace(perf_counter=lambda: clock.now))
    stepping(monkeypatch, timed)
    monkeypatch.setattr(search, "learned_update", iterations)
    return clock


def test_a_machine_that_slows_down_cuts_a_run_short(person, clock, monkeypatch):
    plan = Clock.plan

    def then_slow(self, *arguments):
        planned = plan(self, *arguments)
        clock.slower = 4.0
        return planned

    monkeypatch.setattr(Clock, "plan", then_slow)
    report = refinement.refine_with_report(
        *person, dataclasses.replace(STEPS, steps=None, seconds=2.0)
    )
    assert report.planned is None and report.seconds < 1.5 * 2.0 + 0.5 and 0 < report.steps < 10


def test_buffers_are_doubled_until_all_fits_and_that_counts_as_compilation(clock):
    def draw(splat):
        clock.now += 10
        return splat, jnp.asarray(max(0, 350 - splat.max_pairs))

    timer = Clock(STEPS)
    enough = timer.with_room(draw, SplatConfig(max_pairs=64, max_rows=8))
    assert (enough.max_pairs, enough.max_rows) == (512, 64)
    assert (timer.elapsed(), timer.compile_seconds) == (10, 30)


def seen_by_steps(monkeypatch):
    """Returns a list to which each step of later runs adds its view."""
    seen, own = [], search.stepped
    monkeypatch.setattr(
        search,
        "stepped",
        lambda task, state, view: seen.append(int(view)) or own(task, state, view),
    )
    return seen


def test_the_best_explained_photos_are_held_out_of_trials_and_then_fitted(four, monkeypatch):
    avatar, capture = four
    seen = seen_by_steps(monkeypatch)
    report = refinement.refine_with_report(
        avatar, capture, dataclasses.replace(STEPS, held_out=0.05)
    )
    assert report.kept and report.steps == report.planned == 12 and not report.left_out
    trials, fit = (seen[1:3], seen[3:5]), seen[5:]  # the first one compiles
    errors = np.square(
        np.stack([r.rgb for r in capture_renderings(avatar, capture)[1]]) - capture.images
    )
    held = np.argsort(errors.mean(axis=(1, 2, 3)))[:2]
    assert all(view not in trial for view, trial in zip(held, trials, strict=True))
    assert set(fit) == {0, 1, 2, 3}


def test_a_trial_that_loses_leaves_the_avatar_alone(four, monkeypatch):
    """Steps and iterations fit the photos they see and spoil the one that is held out."""
    avatar, capture = four
    unchanged = lambda found: not found.iterations and not int(found.state.done)
    monkeypatch.setattr(
        search, "psnr_of", lambda task, found, photos: 20.0 if unchanged(found) else 10.0
    )
    seen = seen_by_steps(monkeypatch)
    report = refinement.refine_with_report(
        avatar, capture, dataclasses.replace(STEPS, iterations=1, held_out=0.05)
    )
    assert (report.kept, report.iterations, report.left_out, len(seen)) == (False, 0, (), 1 + 4)
    jax.tree.map(np.testing.assert_array_equal, report.avatar, avatar)


def shifted(capture, pixels):
    """Returns the capture with each photo moved in another direction."""
    steps = [(pixels, 0), (0, pixels), (-pixels, 0), (0, -pixels)]

    def moved(stack):
        return np.stack([np.roll(x, step, (0, 1)) for x, step in zip(stack, steps, strict=True)])

    return dataclasses.replace(capture, images=moved(capture.images), masks=moved(capture.masks))


@pytest.mark.parametrize("pixels", [0, 1])
def test_photos_that_are_off_by_pixels_are_moved_to_where_the_avatar_is(body, pixels, monkeypatch):
    avatar = toy_avatar(body, 0.0)
    capture = shifted(toy_capture(body, avatar, views=4), pixels)
    monkeypatch.setattr(search, "iterated", lambda task, start, used: (start, 0.0))
    config = dataclasses.replace(STEPS, iterations=4)
    task, start, each = search.prepare(
        avatar, crop_to_person(prepare_capture(capture)), config, search.Clock(config)
    )
    aligned, after = search.align(task, start, each)
    assert aligned.moved is (pixels > 0)
    if not pixels:
        assert aligned.photos is task.photos and after is each
    else:
        assert (after.loss < 0.5 * each.loss).all()
        jax.tree.map(
            np.testing.assert_array_equal,
            [(photo.image, photo.mask) for photo in aligned.seen],
            [(photo.image, photo.mask) for photo in aligned.photos],
        )


def test_a_held_out_photo_is_compared_where_each_state_draws_the_person(body, monkeypatch):
    """A photo that was moved to the start would favour it over a state beside it."""
    avatar = toy_avatar(body, 0.0)
    capture = shifted(toy_capture(body, avatar, views=4), 2)
    monkeypatch.setattr(search, "iterated", lambda task, start, used: (start, 0.0))
    config = dataclasses.replace(STEPS, iterations=4)
    task, start, each = search.prepare(
        avatar, crop_to_person(prepare_capture(capture)), config, search.Clock(config)
    )
    task, _ = search.align(task, start, each)
    assert task.moved
    # the first photo has moved down by two pixels: this state draws it there
    down = 2 * 3.6 * 2 * np.tan(np.pi / 12) / HEIGHT
    parameters = start.state.parameters
    lower = replace(parameters, means=parameters.means - jnp.asarray([0.0, down, 0.0]))
    beside = start._replace(state=replace(start.state, parameters=lower))
    scores = [search.psnr_of(task, state, task.given[:1]) for state in (start, beside)]
    assert scores[1] > scores[0]  # the moved photo prefers the start by 1.9 dB


def test_a_photo_that_contradicts_the_others_is_left_out_and_named(four, monkeypatch):
    """Its name is that among all views of the capture, one of which shows nobody."""
    avatar, capture = four
    capture = capture.select([0, 0, 1, 2, 3])
    images, masks = np.array(capture.images), np.array(capture.masks)
    masks[0], images[3] = 0, 1 - images[3]
    updated = search.updated

    def spoilt(task, start, used, iterations):
        found = updated(task, start, used, iterations)
        return replace(found, color_logits=found.color_logits - 9.0) if 2 in used else found

    monkeypatch.setattr(search, "updated", spoilt)
    seen = seen_by_steps(monkeypatch)
    misleading = dataclasses.replace(
        capture, images=images, masks=masks, names=("a", "b", "c", "d", "e")
    )
    report = refinement.refine_with_report(
        avatar, misleading, dataclasses.replace(STEPS, iterations=1, held_out=0.05)
    )
    assert report.left_out == ("d",) and "without d, which" in report.summary()
    assert report.iterations == 1 and 2 not in seen[1:]


@pytest.mark.parametrize(
    ("held_out", "psnrs", "loss", "kept"),
    [
        # the photos that are seen are fitted, the held-out pixels get worse
        (0.3, (30.0, 25.0), 0.0, 0),
        (0.3, (30.0, 31.0), 9.0, 2),
        (0.0, (100.0, 100.0), 0.0, 2),  # nothing is held out: all pixels decide
        (0.0, (100.0, 100.0), 9.0, 0),
    ],
)
def test_held_out_pixels_decide_on_the_iterations_of_few_photos(
    held_out, psnrs, loss, kept, person, monkeypatch
):
    values = iter(psnrs)
    monkeypatch.setattr(search, "psnr_of", lambda *of: next(values))
    monkeypatch.setattr(search, "updated", lambda *of: None)
    monkeypatch.setattr(
        search, "iterated", lambda task, start, used: (start._replace(iterations=2), loss)
    )
    settings = dataclasses.replace(STEPS, iterations=2, steps=0, held_out=held_out)
    avatar, capture = person
    views, clock = crop_to_person(prepare_capture(capture)), search.Clock(settings)
    task, start, each = search.prepare(avatar, views, settings, clock)
    best = [start, *(state for state in search.search(task, start, each) if state.kept)][-1]
    assert best.iterations == kept


def test_what_makes_the_photos_worse_is_not_returned(person, monkeypatch):
    """This also holds if nothing is held out, so that the search keeps its last state."""

    def worse(own, state, *_):
        return replace(
            state, parameters=replace(state.parameters, means=state.parameters.means + 0.2)
        )

    stepping(monkeypatch, worse)
    report = refinement.refine_with_report(*person, dataclasses.replace(STEPS, steps=2))
    assert not report.kept and report.loss[0] == report.loss[1]
    jax.tree.map(np.testing.assert_array_equal, report.avatar, person[0])


def test_blocks_of_pixels_are_held_out_and_every_photo_has_its_turn():
    held = held_out_blocks((3, 4 * BLOCK, 6 * BLOCK), 0.3, 0)
    blocks = held.reshape(3, 4, BLOCK, 6, BLOCK)
    np.testing.assert_array_equal(blocks.any(axis=(2, 4)), blocks.all(axis=(2, 4)))
    assert 0.1 < held.mean() < 0.5 and held_out_blocks((3, 7, 9), 0.3, 0).shape == (3, 7, 9)
    order = photo_order(np.asarray([0, 2, 5]), 8, 0)
    assert len(order) == 8 and set(order[:3]) == set(order[3:6]) == {0, 2, 5}


# Steps
# --------------------------------------------------------------------------------------------------


def few(**changes):
    """Returns (state of two Gaussians, gradient of ones, settings).

    With these settings a step is the gradient times a rate.
    """
    names = {"means": 3, "quats": 4, "log_scales": 3, "opacity_logits": None, "color_logits": 3}
    arrays = {name: jnp.ones((2,) if n is None else (2, n)) for name, n in names.items()}
    parameters = UnconstrainedGaussians(**arrays)
    config = RefineConfig(**{"optimizer": "sgd"} | changes)
    found = Comparison(
        jnp.zeros(()), jnp.zeros(()), jnp.ones(()), jnp.asarray([0.0, 0.005]), jnp.zeros((), int)
    )
    return (
        init_state(parameters, found, config, SplatConfig()),
        jax.tree.map(jnp.ones_like, parameters),
        config,
    )


def test_gaussians_move_as_far_as_the_photos_show_them():
    state, gradient, config = few(visible=0.01)
    moved = update(state, gradient, config).parameters
    for name in ("means", "quats", "log_scales", "opacity_logits", "color_logits"):
        steps = np.asarray(getattr(moved, name) - 1).reshape(2, -1)
        assert not steps[0].any()  # no photo shows it
        np.testing.assert_allclose(
            steps[1], -0.5 * getattr(config.rates, name), atol=1e-6 + DECAY * 1e-2
        )


@pytest.mark.parametrize("done", [0, 5, 10])
def test_rates_fall_by_a_cosine_to_a_tenth(done):
    state, gradient, config = few(visible=0.005)
    state = replace(state, done=done, total=10, share=0.5)
    moved = update(state, gradient, config).parameters.color_logits[1]
    expected = 0.5 * config.rates.color_logits * (0.55 + 0.45 * np.cos(np.pi * done / 10))
    np.testing.assert_allclose(1 - np.asarray(moved), expected, atol=1e-7)


@pytest.mark.parametrize("optimizer", OPTIMIZERS)
def test_every_optimizer_goes_downhill(optimizer):
    state, gradient, config = few(optimizer=optimizer)
    for _ in range(2):
        state = update(state, gradient, config)
    colors = np.asarray(state.parameters.color_logits)
    assert (
        np.isfinite(colors).all()
        and (colors[1] < 1).all()
        and (int(state.done), colors[0, 0]) == (2, 1)
    )
