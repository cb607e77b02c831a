"""Extremes that must not end a run: nothing to see, one view, distant Gaussians, bad photos.

Others are one Gaussian on each vertex and very high learning rates.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from training_cases import batch_of

from humangs_jax.core.pytree import replace
from humangs_jax.training.config import tiny
from humangs_jax.training.state import init_state
from humangs_jax.training.step import train_step

CONFIG = tiny()
OUTSIDE = 100.0
"""Metres that move any subject out of any image."""


@pytest.fixture(scope="module")
def batch(body, captures):
    return batch_of(body, captures, CONFIG)


def finite(tree):
    return all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(tree))


def step_without_harm(state, batch, body, config=CONFIG):
    """Returns (state, metrics) after another step, which had nothing to repair or skip."""
    before = int(state.opt_state.skipped)
    state, metrics = train_step(state, batch, body, config)
    metrics = {name: float(value) for name, value in metrics.items()}
    assert finite(metrics) and metrics["nonfinite"] == 0 and metrics["skipped"] == before, metrics
    assert finite((state.params, state.opt_state, state.batch_stats))
    return state, metrics


def without_person(views, which):
    """Returns the views, of which those of `which` show background alone.

    The body stands beside these photos. The leading axis is that of subjects.
    """
    cameras = views.cameras
    return replace(
        views,
        images=views.images.at[:, which].set(1.0),
        masks=views.masks.at[:, which].set(0.0),
        cameras=replace(
            cameras, cam_from_world=cameras.cam_from_world.at[:, which, 0, 3].add(OUTSIDE)
        ),
    )


EVERY, SECOND = slice(None), slice(1, 2)


@pytest.mark.parametrize(
    "which",
    [
        {"inputs": SECOND},
        {"targets": SECOND},
        {"inputs": EVERY},
        {"inputs": EVERY, "targets": EVERY},
    ],
    ids=str,
)
def test_views_of_background_alone(body, batch, variables, which):
    seen = replace(
        batch,
        **{views: without_person(getattr(batch, views), some) for views, some in which.items()},
    )
    _, metrics = step_without_harm(init_state(CONFIG, variables), seen, body)
    if which.get("targets") == EVERY:
        # background is drawn as it was in the photo
        assert metrics["squared"] < 1e-9 and metrics["silhouette"] < 1e-9


@pytest.mark.parametrize("offset", [(OUTSIDE, 0, 0), (0, 0, OUTSIDE), (0, 0, 1e6)], ids=str)
def test_a_subject_outside_of_the_frame_or_behind_the_camera(body, batch, variables, offset):
    """The photos show a person where the poses say that there is none."""
    moved = lambda views: replace(views, translations=views.translations + jnp.asarray(offset))
    step_without_harm(
        init_state(CONFIG, variables),
        replace(batch, inputs=moved(batch.inputs), targets=moved(batch.targets)),
        body,
    )


def test_a_camera_inside_of_the_body(body, batch, variables):
    inside = batch.targets.cameras.cam_from_world.at[:, :, :3, 3].set(0.0)
    targets = replace(batch.targets, cameras=replace(batch.targets.cameras, cam_from_world=inside))
    step_without_harm(init_state(CONFIG, variables), replace(batch, targets=targets), body)


def test_black_photos_and_masks_that_cover_all(body, batch, variables):
    def full(views):
        return replace(views, images=jnp.zeros_like(views.images), masks=jnp.ones_like(views.masks))

    step_without_harm(
        init_state(CONFIG, variables), replace(batch, inputs=full(batch.inputs)), body
    )
    step_without_harm(
        init_state(CONFIG, variables), replace(batch, targets=full(batch.targets)), body
    )


@pytest.mark.parametrize(
    ("views", "value"),
    [("inputs", np.nan), ("targets", np.inf), ("inputs", 1e30), ("targets", 1e30)],
)
def test_a_bad_photo_costs_its_step_and_the_run_goes_on(body, batch, variables, views, value, same):
    """The bad pixel is one of the person, so that the network sees it."""
    row, column = np.argwhere(np.asarray(getattr(batch, views).masks[0, 0]) > 0.9)[0]
    shown = getattr(batch, views)
    bad = replace(
        batch, **{views: replace(shown, images=shown.images.at[0, 0, row, column].set(value))}
    )
    before = init_state(CONFIG, variables)
    state, metrics = train_step(init_state(CONFIG, variables), bad, body, CONFIG)
    assert finite(state.params) and finite(state.batch_stats) and finite(state.opt_state.inner)
    if not np.isfinite(value):
        assert int(metrics["skipped"]) == int(metrics["nonfinite"]) == 1
        assert same(state.params, before.params) and same(
            state.opt_state.inner, before.opt_state.inner
        )
    skipped = int(metrics["skipped"])
    state, metrics = train_step(state, batch, body, CONFIG)
    assert (
        int(state.step) == 2
        and int(metrics["skipped"]) == skipped
        and np.isfinite(float(metrics["loss"]))
    )
    assert not same(state.params, before.params)


def with_geometry(state, free_offset=0.0, log_scale=None):
    """Returns a state whose free Gaussians start at an offset, and all of them at a scale.

    The offset is from the vertex; `log_scale` goes through a softplus.
    """
    bias = state.params["decoder"]["geometry_out"]["bias"]
    rows = bias.reshape(-1, 10)
    rows = rows.at[1:, :3].set(free_offset)
    if log_scale is not None:
        rows = rows.at[:, 7:].set(log_scale)
    params = jax.tree.map(lambda x: x, state.params)
    params["decoder"]["geometry_out"]["bias"] = rows.reshape(-1)
    return replace(state, params=params)


@pytest.mark.parametrize("log_scale", [-1e4, 10.0, 1e30])
def test_gaussians_of_no_size_and_of_any(body, batch, variables, log_scale):
    step_without_harm(
        with_geometry(init_state(CONFIG, variables), log_scale=log_scale), batch, body
    )


def decoder_of(**changes):
    decoder = dataclasses.replace(CONFIG.model.architecture.decoder, **changes)
    return dataclasses.replace(CONFIG, model=CONFIG.model.with_parts(decoder=decoder))


@pytest.mark.slow
@pytest.mark.parametrize(("tight", "free"), [(1, 0), (0, 1)], ids=["tight", "free"])
def test_one_gaussian_per_vertex(body, batch, tight, free):
    config = decoder_of(tight=tight, free=free)
    state = init_state(config)
    for _ in range(3):
        state, _ = step_without_harm(state, batch, body, config)


@pytest.mark.slow
def test_one_view(body, captures):
    views = dataclasses.replace(CONFIG.views, input_counts=(1,), target_count=1)
    config = dataclasses.replace(CONFIG, views=views)
    state = init_state(config)
    for step in range(3):
        state, _ = step_without_harm(state, batch_of(body, captures, config, step), body, config)
    batch = batch_of(body, captures, config)
    step_without_harm(
        state, replace(batch, inputs=without_person(batch.inputs, EVERY)), body, config
    )


@pytest.mark.slow
def test_hundreds_of_free_gaussians_per_vertex_far_away(body, batch):
    """Offsets have no bound: near, distant, beyond float32's squares, and near again."""
    config = decoder_of(tight=1, free=200, offset_scale=None)
    for offset in (0.0, 10.0, 1e4, 1e12, 1e25):
        state = with_geometry(init_state(config), free_offset=offset)
        _, metrics = train_step(state, batch, body, config)
        assert finite(metrics) and int(metrics["nonfinite"]) == 0, (offset, metrics)
        assert int(metrics["overflow"]) == 0


@pytest.mark.slow
def test_a_hundred_times_the_learning_rate(body, captures):
    rate = 100 * CONFIG.optimizer.learning_rate
    config = dataclasses.replace(
        CONFIG, optimizer=dataclasses.replace(CONFIG.optimizer, learning_rate=rate)
    )
    state, skipped = init_state(config), 0
    batches = [batch_of(body, captures, config, step) for step in range(3)]
    for step in range(CONFIG.steps):
        state, metrics = train_step(state, batches[step % 3], body, config)
        assert np.isfinite(float(metrics["grad_norm"]))
        assert int(metrics["skipped"]) - skipped == (
            float(metrics["grad_norm"]) > config.optimizer.skip_norm
        )
        skipped = int(metrics["skipped"])
    assert int(state.step) == CONFIG.steps and finite(
        (state.params, state.opt_state, state.batch_stats)
    )
    assert np.isfinite(float(metrics["loss"]))
