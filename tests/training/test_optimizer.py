"""The optimizer's groups of parameters, schedule and guard."""

import dataclasses
import functools
import typing

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from rounding import bound

from humangs_jax.training.state import (
    INFINITY_STAND_IN,
    OptimizerConfig,
    decayed,
    finite_gradients,
    gradient_norm,
    learning_rate,
    make_optimizer,
)

FLOAT32 = 1e-6
CONFIG = OptimizerConfig(learning_rate=0.1, warmup_steps=0)
PARAMS = {
    "kernel": jnp.ones((2, 3)),
    "bias": jnp.ones(3),
    "texture": jnp.ones((3, 2, 2, 2)),
    "scale": jnp.ones(2),
}


@functools.partial(jax.jit, static_argnames="config")
def stepped(gradients, config=CONFIG, value=1.0, state=None):
    optimizer = make_optimizer(config, 100)
    state = optimizer.init(PARAMS) if state is None else state
    updates, state = optimizer.update(gradients, state, PARAMS, value=jnp.asarray(value))
    return optax.apply_updates(PARAMS, updates), state


def filled(value):
    return {name: np.full(x.shape, value, np.float32) for name, x in PARAMS.items()}


def test_weight_decay_acts_on_two_axes_and_more():
    assert decayed(PARAMS) == {"kernel": True, "bias": False, "texture": True, "scale": False}
    params, _ = stepped(filled(0.0))
    shrunk = 1 - CONFIG.learning_rate * CONFIG.weight_decay
    for name, leaf in params.items():
        np.testing.assert_allclose(leaf, shrunk if decayed(PARAMS)[name] else 1.0, rtol=FLOAT32)


@pytest.mark.parametrize("size", [1e-3, 0.1, 0.5, 3.0, 16.0])  # beyond, the step is skipped
def test_moments_see_clipped_gradients_and_the_first_step_is_adams(size):
    params, state = stepped(filled(size))
    first = [x for x in jax.tree.leaves(state.inner) if x.ndim][: len(PARAMS)]
    norm = float(gradient_norm(first)) / (1 - CONFIG.betas[0])
    unclipped = size * np.sqrt(sum(x.size for x in PARAMS.values()))
    assert float(state.norm) == pytest.approx(unclipped, rel=bound(FLOAT32))
    assert norm == pytest.approx(min(unclipped, CONFIG.clip_norm), rel=1e-4)
    # eps of Adam against the clipped
    np.testing.assert_allclose(params["bias"], 1 - CONFIG.learning_rate, rtol=1e-5)


@pytest.mark.parametrize(
    ("gradient", "value"),
    [(1e4, 1.0), (0.1, np.nan), (0.1, np.inf)],
    ids=["large", "nan loss", "infinite loss"],
)
def test_a_bad_step_changes_nothing_and_is_counted(gradient, value):
    _, before = stepped(filled(0.1))
    params, state = stepped(filled(gradient), value=value, state=before)
    assert int(before.skipped) == 0 and int(state.skipped) == 1
    assert jax.tree.all(jax.tree.map(lambda a, b: bool(jnp.all(a == b)), params, PARAMS))
    assert jax.tree.all(jax.tree.map(lambda a, b: bool(jnp.all(a == b)), state.inner, before.inner))
    params, state = stepped(filled(0.1), state=state)
    assert int(state.skipped) == 1 and not bool(jnp.all(params["bias"] == 1))


def test_gradients_become_finite_and_finite_ones_stay():
    finite, others = [0.0, -1e-45, 3e38, -2.5], [np.nan, np.inf, -np.inf]
    cleaned = finite_gradients({"x": jnp.asarray([*finite, *others], jnp.float32)})["x"]
    expected = np.asarray([*finite, 0.0, INFINITY_STAND_IN, -INFINITY_STAND_IN], np.float32)
    np.testing.assert_array_equal(cleaned, expected)


def test_bad_entries_alone_skip_no_step():
    gradients = filled(0.1)
    gradients["bias"] = np.asarray([np.nan, np.inf, -np.inf], np.float32)
    params, state = stepped(gradients)
    assert int(state.skipped) == 0
    assert float(params["bias"][0]) == 1.0 and float(params["bias"][1]) < 1 < float(
        params["bias"][2]
    )


def test_schedule_warms_up_and_ends_at_zero():
    rate = learning_rate(OptimizerConfig(learning_rate=0.4, warmup_steps=10), 110)
    assert [float(rate(i)) for i in (0, 5, 10)] == pytest.approx([0.0, 0.2, 0.4])
    assert float(rate(60)) == pytest.approx(0.2, rel=1e-5) and float(rate(110)) == pytest.approx(
        0.0, abs=1e-9
    )
    shorter_than_its_warm_up = learning_rate(
        OptimizerConfig(learning_rate=0.4, warmup_steps=3000), 4
    )
    assert float(shorter_than_its_warm_up(4)) == pytest.approx(0.4)


@pytest.mark.parametrize("name", typing.get_args(typing.get_type_hints(OptimizerConfig)["name"]))
def test_every_optimizer_by_name_goes_downhill_and_keeps_the_guard(name):
    config = dataclasses.replace(CONFIG, name=name, weight_decay=0.0)
    params, state = stepped(filled(0.5), config)
    assert all(np.isfinite(x).all() and (x < 1).all() for x in jax.tree.leaves(params))
    same, skipped = stepped(filled(1e4), config, state=state)
    assert int(skipped.skipped) == 1 and jax.tree.all(
        jax.tree.map(lambda a, b: bool(jnp.all(a == b)), same, PARAMS)
    )


@pytest.mark.parametrize("name", ["adamw", "nadamw", "lion", "lamb"])
def test_elsewhere_than_on_a_cpu_the_steps_are_the_same_and_so_is_the_state(monkeypatch, name):
    """A run that began on one kind of device continues on the other."""
    config = dataclasses.replace(CONFIG, name=name)
    generator = np.random.default_rng(0)
    gradients = [
        {key: generator.normal(size=x.shape).astype(np.float32) for key, x in PARAMS.items()}
        for _ in range(3)
    ]
    _, middle = stepped.__wrapped__(gradients[0], config)
    here = stepped.__wrapped__(gradients[1], config, state=middle)
    skipped = stepped.__wrapped__(gradients[2], config, np.nan, here[1])
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    there = stepped.__wrapped__(gradients[1], config, state=middle)
    assert jax.tree.structure(there) == jax.tree.structure(here)
    # a norm over all entries in another order, then a handful of roundings
    near = functools.partial(np.testing.assert_allclose, rtol=8 * FLOAT32, atol=FLOAT32)
    jax.tree.map(near, there, here)
    jax.tree.map(near, stepped.__wrapped__(gradients[2], config, np.nan, there[1]), skipped)
