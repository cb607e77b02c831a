"""The training step: terms, backgrounds, gradients, and effects of a bad batch."""

import dataclasses
import functools
import inspect
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from rounding import bound
from training_cases import random_networks, source_of, without_upsampler

from humangs_jax.avatar.animate import skin
from humangs_jax.avatar.reconstruct import reconstruct_views
from humangs_jax.body.model import BodyPose
from humangs_jax.core.pytree import replace
from humangs_jax.data.loading import CaptureCache, Loader, ViewSampling
from humangs_jax.losses.loss_networks import LossNetworks
from humangs_jax.network.humangs import init_humangs
from humangs_jax.network.parts import Drawn
from humangs_jax.rendering.splatting import Rendering, render
from humangs_jax.training import step
from humangs_jax.training.augmentation import Augmentation
from humangs_jax.training.config import OptimizerConfig, tiny
from humangs_jax.training.forward import predict, token_share
from humangs_jax.training.state import TrainState, init_state
from humangs_jax.training.step import (
    batch_gradients,
    change_background,
    random_backgrounds,
    seed_numbers,
    train_step,
    update,
)

FLOAT64 = 1e-6
FLOAT32 = 1e-5
CONFIG = tiny()


@pytest.fixture(scope="module")
def source(body, captures):
    return Loader(source_of(CaptureCache(captures, body), CONFIG), CONFIG.batch_size)


def test_a_step_moves_the_parameters_and_tells_of_it(body, source, variables, same):
    before = init_state(CONFIG, variables)
    state, metrics = train_step(init_state(CONFIG, variables), source.batch_at(0), body, CONFIG)
    assert int(state.step) == 1
    moved = jax.tree.map(lambda a, b: bool(jnp.any(a != b)), state.params, before.params)
    assert np.mean(jax.tree.leaves(moved)) > 0.9  # biases that only unused units see may stay
    assert jax.tree.all(
        jax.tree.map(lambda a, b: bool(jnp.any(a != b)), state.batch_stats, before.batch_stats)
    )
    assert all(
        float(metrics[name]) > 0
        for name in ("squared", "structural", "silhouette", "tightness", "grad_norm")
    )
    assert float(metrics["loss"]) == pytest.approx(losses_of(CONFIG)(metrics), rel=bound(FLOAT32))
    assert (
        int(metrics["skipped"]) == int(metrics["dropped_tokens"]) == int(metrics["overflow"]) == 0
    )
    again, _ = train_step(init_state(CONFIG, variables), source.batch_at(0), body, CONFIG)
    assert same(state, again)  # bit for bit


@pytest.mark.slow
def test_it_draws_the_avatars_that_reconstruct_makes(body, source, variables):
    model = CONFIG.model.with_conventions(light=True, pixel_footprint=0.02)
    example = jax.tree.map(lambda x: x[0], source.batch_at(0))
    run, compiled = (
        dataclasses.replace(CONFIG, model=model),
        functools.partial(jax.jit, static_argnames="config"),
    )
    predicted, _ = compiled(predict)(variables, body, example, config=run)
    avatar, _ = compiled(reconstruct_views)(
        variables, body=body, views=example.inputs, config=model
    )
    targets = example.targets
    assert jnp.abs(avatar.light.coefficients).max() > 0.01
    for i, rgb in enumerate(predicted.rendering.rgb):
        pose = BodyPose(targets.rotations[i], targets.translations[i])
        expected = render(skin(avatar, pose), targets.cameras[i], CONFIG.splat, jnp.ones(3)).rgb
        np.testing.assert_allclose(rgb, expected, atol=bound(FLOAT32))


def losses_of(config):
    """Returns a function of a step's metrics that gives the sum of all weighted terms."""
    weights = dataclasses.asdict(config.loss)
    return lambda metrics: sum(
        weights[name] * float(metrics[name]) for name in weights if name in metrics
    )


AGAINST_FOG = {"absolute": 0.2, "boundary": 0.1, "depth": 0.3, "distortion": 1.0, "opaque": 0.003}


@pytest.mark.slow
def test_terms_against_fog_are_added_and_keep_gradients_finite(body, source, variables):
    def weighted(**terms):
        return dataclasses.replace(CONFIG, loss=dataclasses.replace(CONFIG.loss, **terms))

    config, batch = weighted(**AGAINST_FOG), source.batch_at(0)
    lacking = {
        "depth": "depth of the targets",
        "perceptual": "VGG-19",
        "lpips": "LPIPS",
        "vgg16": "LPIPS vgg",
    }
    for name, what in lacking.items():
        with pytest.raises(ValueError, match=f"loss.{name} is not 0, but there is no {what}"):
            train_step(init_state(config, variables), batch, body, weighted(**{name: 1.0}))
    batch = replace(batch, targets=replace(batch.targets, depths=2 * batch.targets.masks))
    _, metrics = train_step(init_state(config, variables), batch, body, config)
    assert all(float(metrics[name]) > 0 for name in AGAINST_FOG)
    assert float(metrics["loss"]) == pytest.approx(losses_of(config)(metrics), rel=bound(FLOAT32))
    assert 0 < float(metrics["grad_norm"]) < np.inf and int(metrics["nonfinite"]) == 0


@pytest.mark.slow
def test_it_learns_a_batch(body, source, variables):
    state, batch, history = init_state(CONFIG, variables), source.batch_at(0), []
    for _ in range(CONFIG.steps):
        state, metrics = train_step(state, batch, body, CONFIG)
        history.append(metrics)
    first, last = (
        {name: float(value) for name, value in metrics.items()}
        for metrics in (history[0], history[-1])
    )
    assert (
        last["silhouette"] < 0.6 * first["silhouette"] and last["squared"] < 0.8 * first["squared"]
    )
    assert last["skipped"] == 0


def test_parameters_of_fewer_bits_are_refused(body, source):
    state = TrainState(
        jnp.zeros((), jnp.int32), {"reader": {"bias": jnp.zeros(3, jnp.bfloat16)}}, {}, (), None
    )
    with pytest.raises(ValueError, match=r"params\.reader\.bias: expected float32, got bfloat16"):
        train_step(state, source.batch_at(0), body, CONFIG)


@pytest.mark.slow
def test_a_batch_gives_the_mean_gradient_of_its_subjects(body, source, variables):
    keys = jax.random.split(jax.random.key(0), 2)
    batch = jax.tree.map(lambda *x: jnp.concatenate(x), source.batch_at(0), source.batch_at(1))
    gradients = functools.partial(
        batch_gradients, variables["params"], variables["batch_stats"], body
    )
    singles = [
        gradients(jax.tree.map(lambda x, i=i: x[i : i + 1], batch), keys[i : i + 1], CONFIG)
        for i in (0, 1)
    ]
    both = gradients(batch, keys, CONFIG)
    for position in (0, 1, 2):  # loss, gradients, batch statistics
        mean = jax.tree.map(lambda a, b: (a + b) / 2, *(x[position] for x in singles))
        close = jax.tree.map(
            lambda a, b: np.linalg.norm(a - b) <= 1e-4 * np.linalg.norm(b) + 1e-9,
            both[position],
            mean,
        )
        assert jax.tree.all(close)
    with pytest.raises(
        ValueError, match="2 subjects per device cannot be divided into microbatches of 3"
    ):
        gradients(batch, keys, dataclasses.replace(CONFIG, microbatch_size=3))


@pytest.mark.slow
def test_subjects_worked_on_at_once_or_one_after_the_other_give_the_same_gradient(body, source):
    keys = jax.random.split(jax.random.key(0), 2)
    batch = jax.tree.map(lambda *x: jnp.concatenate(x), source.batch_at(0), source.batch_at(1))
    # without batch statistics, which are meant to differ
    config = dataclasses.replace(CONFIG, model=without_upsampler(CONFIG.model))
    variables = init_humangs(jax.random.key(0), config.model)
    # in float32 the last bit decides whether a Gaussian counts in a pixel, which is 0.3 % of the
    # gradient of a bias here
    double = lambda x: x.astype(jnp.float64) if jnp.issubdtype(x.dtype, jnp.floating) else x
    with jax.enable_x64(True):
        params, body, batch = jax.tree.map(double, (variables["params"], body, batch))
        results = [
            batch_gradients(
                params, {}, body, batch, keys, dataclasses.replace(config, microbatch_size=size)
            )
            for size in (1, 2)
        ]
    assert float(results[1][0]) == pytest.approx(float(results[0][0]), rel=FLOAT64)
    for a, b in zip(*(jax.tree.leaves(result[1]) for result in results), strict=True):
        assert np.linalg.norm(a - b) <= FLOAT64 * np.linalg.norm(b) + 1e-12


WITH_NETWORKS = dataclasses.replace(
    CONFIG, loss=dataclasses.replace(CONFIG.loss, perceptual=0.5, lpips=0.25, vgg16=0.1)
)


@pytest.mark.slow
@pytest.mark.parametrize("dtype", ["float32", "bfloat16"])
def test_losses_of_networks_are_part_of_the_loss(body, source, variables, dtype):
    networks = random_networks()
    config = dataclasses.replace(WITH_NETWORKS, model=CONFIG.model.with_runtime(dtype=dtype))
    state, metrics = train_step(
        init_state(config, variables), source.batch_at(0), body, config, networks
    )
    assert float(metrics["loss"]) == pytest.approx(losses_of(config)(metrics), rel=bound(FLOAT32))
    assert all(float(metrics[name]) > 0 for name in ("perceptual", "lpips", "vgg16"))
    assert int(state.opt_state.skipped) == int(state.opt_state.nonfinite) == 0
    first = float(metrics["perceptual"])
    for _ in range(20):
        state, metrics = train_step(state, source.batch_at(0), body, config, networks)
    assert float(metrics["perceptual"]) < first


def test_backgrounds_are_exchanged_like_those_of_photos():
    masks = np.random.default_rng(0).random((2, 4, 4), np.float32)
    color, backgrounds = np.float32([0.2, 0.5, 0.9]), np.float32([[0.1, 0.2, 0.3], [1.0, 1.0, 1.0]])
    images = masks[..., None] * color + (1 - masks[..., None])
    expected = masks[..., None] * color + (1 - masks[..., None]) * backgrounds[:, None, None]
    found = change_background(*map(jnp.asarray, (images, masks, backgrounds)))
    np.testing.assert_allclose(found, expected, atol=FLOAT32)


def test_the_share_of_random_backgrounds_is_kept():
    keys = jax.random.split(jax.random.key(0), 200)

    def draw(share):
        return np.asarray(jax.jit(jax.vmap(lambda key: random_backgrounds(key, 3, share)))(keys))

    white = (draw(0.25) == 1).all(axis=-1)
    assert 0.68 < white.mean() < 0.82  # 600 draws of probability 0.75: four standard deviations
    assert (draw(0.0) == 1).all()


def test_fewer_photos_have_their_share_of_the_token_capacity():
    config = dataclasses.replace(tiny(), views=ViewSampling(input_counts=(1, 4, 6)))
    config = dataclasses.replace(config, model=config.model.with_runtime(token_capacity=70))
    assert [token_share(config, views).runtime.token_capacity for views in (6, 4, 1)] == [
        70,
        50,
        20,
    ]


# what a step does with its parts, each of which is exchanged for a plain one; types are not checked
# there


PLAIN = dataclasses.replace(
    CONFIG,
    optimizer=OptimizerConfig(learning_rate=1.0, warmup_steps=0, weight_decay=0.0),
    ema_decay=0.99,
)


@pytest.fixture
def plain_update(monkeypatch):
    """Returns a function (state, loss) -> (state after `update`, keys of a batch of 2 subjects).

    The gradient is 1, and statistics grow by 1.
    """

    def updated(state, loss=0.0):
        keys = []

        def gradients(params, batch_stats, body, batch, subjects, *_):
            keys.append(jax.random.key_data(subjects))
            return (
                jnp.asarray(loss),
                jax.tree.map(jnp.ones_like, params),
                jax.tree.map(lambda x: x + 1, batch_stats),
                {},
            )

        monkeypatch.setattr(step, "batch_gradients", gradients)
        batch = SimpleNamespace(inputs=SimpleNamespace(betas=jnp.zeros((2, 1))))
        return inspect.unwrap(update)(state, batch, None, LossNetworks(), seed_numbers(0), PLAIN)[
            0
        ], keys[-1]

    return updated


def test_every_step_and_every_subject_has_random_numbers_of_its_own(plain_update):
    state = init_state(PLAIN, {"params": {"x": jnp.zeros(3)}, "batch_stats": {}})
    seen = []
    for _ in range(3):
        state, keys = plain_update(state)
        seen += [tuple(key) for key in np.asarray(keys)]
    assert len(set(seen)) == 6


def test_the_average_forgets_where_it_started(plain_update):
    """With a decay of 0.99 alone, 90 % of the start would remain after 10 steps."""
    state = replace(
        init_state(PLAIN, {"params": {"x": jnp.full(1, 100.0)}, "batch_stats": {}}),
        params={"x": jnp.zeros(1)},
    )
    for _ in range(10):
        state, _ = plain_update(state)
    assert abs(float(state.ema_params["x"][0])) < 20  # of the 100 that the average began with


def test_statistics_of_a_bad_step_are_not_kept(plain_update):
    state = init_state(
        PLAIN, {"params": {"x": jnp.zeros(1)}, "batch_stats": {"mean": jnp.zeros(1)}}
    )
    for loss, mean in ((0.0, 1), (np.nan, 1), (0.0, 2)):
        state, _ = plain_update(state, loss)
        assert float(state.batch_stats["mean"][0]) == mean


@pytest.mark.parametrize("size", [1, 2, 4])
def test_a_gradient_is_the_mean_over_subjects_whatever_the_microbatch(monkeypatch, size):
    def loss(params, batch_stats, body, example, key, config, networks, axis_name):
        value = params["x"] * example
        return value, (batch_stats, {"loss": value, "dropped_tokens": example, "overflow": example})

    monkeypatch.setattr(step, "subject_loss", loss)
    weights, keys = jnp.asarray([1.0, 2.0, 4.0, 9.0]), jax.random.split(jax.random.key(0), 4)
    config = dataclasses.replace(CONFIG, microbatch_size=size)
    value, gradients, _, metrics = inspect.unwrap(step.local_gradients)(
        {"x": jnp.asarray(3.0)}, {}, None, weights, keys, config
    )
    # means of weights, times 3
    assert float(gradients["x"]) == 4.0 and float(value) == float(metrics["loss"]) == 12.0
    assert float(metrics["dropped_tokens"]) == float(metrics["overflow"]) == 16.0  # sums


def test_augmentation_and_backgrounds_do_not_share_random_numbers(monkeypatch, source, body):
    """Else the color of the background would tell how the photos were disturbed."""
    keys = {}

    def take(name, value):
        return lambda key, *_: keys.update({name: jax.random.key_data(key)}) or value

    example = jax.tree.map(lambda x: x[0], source.batch_at(0))
    views = example.targets
    rendering_of = lambda rgb, alpha: Rendering(rgb, alpha, alpha, jnp.zeros((), jnp.int32))
    rendering = jax.vmap(rendering_of)(views.images, views.masks)
    outputs = SimpleNamespace(dropped_tokens=jnp.zeros((), jnp.int32))
    monkeypatch.setattr(step, "augment", take("augment", example))
    monkeypatch.setattr(
        step, "random_backgrounds", take("backgrounds", jnp.ones((len(views.images), 3)))
    )
    monkeypatch.setattr(step, "reconstruct_example", lambda *_: (outputs, {}))
    monkeypatch.setattr(step, "draw_targets", lambda *_: Drawn(rendering))
    config = dataclasses.replace(CONFIG, augmentation=Augmentation(share=0.5))
    inspect.unwrap(step.subject_loss)({}, {}, body, example, jax.random.key(0), config)
    assert set(keys) == {"augment", "backgrounds"} and not np.array_equal(*keys.values())
