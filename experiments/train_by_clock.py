"""Trains the shipped network further on an accelerator that is available for minutes. The learning
rate falls with the clock.
"""

import concurrent.futures
import dataclasses
import functools
import json
import math
import os
from collections.abc import Callable
from pathlib import Path
from time import monotonic
from typing import Any

import jax
import jax.numpy as jnp
import optax

from experiments.harness import Run, entry
from humangs_jax.body.library import load_body
from humangs_jax.core.loops import one_after_the_other
from humangs_jax.core.processes import compiler_options
from humangs_jax.core.pytree import replace
from humangs_jax.data.views import gaussian_body
from humangs_jax.losses.loss_networks import load_loss_networks
from humangs_jax.network.weights import load_weights, save_weights
from humangs_jax.synthetic.bank import build_bank
from humangs_jax.synthetic.on_the_fly import OnTheFlyConfig, on_the_fly_example
from humangs_jax.synthetic.subject import seeds_of
from humangs_jax.training import config as presets
from humangs_jax.training.config import TrainConfig
from humangs_jax.training.state import init_state
from humangs_jax.training.step import seed_numbers, update

FOR_EVER = 100_000_000
"""Number of steps of a configuration whose learning rate stays the same."""
WARM_UP, EMA, LOGGED, SAVED, RESERVE = 40, 0.998, 20, 90.0, 6.0
"""Steps until the full learning rate, decay of the averaged weights, steps between lines of the
log, seconds between weights on disk, and seconds that the last weights may take.
"""
PAIRS = 7 << 14
"""Number of (splat, tile) pairs of a target that fit, twice the 45,000 to 50,000 that targets of
the shipped network need at 256 pixels. Pairs that do not fit are counted in the log.
"""
FIRST, SEED = 1000, 0
"""Index of the first person within the training seeds, and seed of order and views."""
LPIPS, DISPLACED, START_SHARE = 0.1, 0.5, 0.5
"""Weight of LPIPS (AlexNet) in the loss, share of the examples whose body is displaced to the
silhouettes of the clothes, and share of the first weights in OUT/mean.safetensors, whose other
share are the trained weights (`train_shipped.py`).
"""


@dataclasses.dataclass(frozen=True)
class Clock:
    """Settings of a run.

    Options:
    init_weights: weights to start from; default: the shipped ones
    minutes: time of the run, with the people and the compilation
    people: people of the training seeds, rendered anew for every step
    batch: people of a step
    learning_rate: peak of the learning rate
    """

    init_weights: Path | None = None
    """Weights to start from, None: the shipped ones."""
    minutes: float = 8.0
    """Minutes of the run, with the people and the compilation."""
    people: int = 450
    """Number of people of the training seeds."""
    batch: int = 8
    """People of a step."""
    learning_rate: float = 3e-4
    """Peak of the learning rate."""


@entry
def train_by_clock(run: Run, out: Path, how: Clock = Clock()) -> None:
    """Trains the shipped network further for minutes on people rendered on the fly, and writes the
    averaged weights to OUT/weights.safetensors.

    The step compiles while other processes make the people. One program serves all numbers of
    photos.

    Raises: ValueError if no time is left to train.
    """
    began = monotonic()
    body, (variables, model) = load_body(), load_weights(how.init_weights)

    def clock():
        return monotonic() - began

    carrier, config = gaussian_body(body, model), configured(how)
    # the network of the weights, with the room for tokens of the preset
    model_config = dataclasses.replace(model, runtime=config.model.runtime)
    config = dataclasses.replace(config, model=model_config)
    networks = load_loss_networks(lpips_net="alex", installed=True)
    state, average = (init_state(config, variables) for _ in range(2))
    average = average.params
    # other processes make the people while the step compiles, for the shapes of one of them
    make = functools.partial(build_bank, body=body, split="train", displaced=carrier)
    seeds, processes = seeds_of("train", FIRST, how.people), max(1, (os.cpu_count() or 1) - 1)
    with concurrent.futures.ThreadPoolExecutor(1) as pool:
        wanted = pool.submit(make, seeds, processes=processes)
        examples = examples_of(config, how)
        batch = jax.eval_shape(examples, make(seeds[:1]), 0)
        given = carrier, networks, seed_numbers(SEED)
        step = stepper(config).lower(state, average, batch, *given, 1.0).compile()
        compiled = clock()
        print(f"compiled after {compiled:.0f} s", flush=True)
        bank = wanted.result()
    examples = jax.jit(examples).lower(bank, 0).compile()
    print(f"{bank.people} people after {clock():.0f} s", flush=True)

    # steps until the end, at a rate that falls with the time that is left
    out.mkdir(parents=True, exist_ok=True)
    start, saved, done, end, metrics = clock(), clock(), 0, 60 * how.minutes - RESERVE, {}
    with open(out / "log.jsonl", "w", buffering=1) as log:
        while clock() < end:
            now = clock()
            left = 0.5 * (1 + math.cos(math.pi * (now - start) / (end - start)))
            rate = min(1.0, (done + 1) / WARM_UP) * left
            batch = examples(bank, done)
            # the clock must not run ahead of the device, so the step before has to be done
            jax.block_until_ready(metrics)
            state, average, metrics = step(state, average, batch, *given, rate)
            done += 1
            if done % LOGGED == 0:
                numbers = {name: float(value) for name, value in jax.device_get(metrics).items()}
                line = {"step": done, "seconds": clock(), "rate": rate} | numbers
                log.write(json.dumps(line) + "\n")
                if numbers["overflow"]:
                    print(f"step {done}: {numbers['overflow']:.0f} pairs had no room", flush=True)
            if now - saved > SAVED:
                saved, made = now, state_variables(average, state)
                save_weights(out / "weights.safetensors", made, model, "float16")
    if not done:
        raise ValueError(
            f"--minutes {how.minutes:g}: people and compilation took {start:.0f} s, nothing is left"
            " for training"
        )
    # the averaged weights, and their mean with those of the start
    trained = state_variables(average, state)
    mean = jax.tree.map(lambda a, b: START_SHARE * a + (1 - START_SHARE) * b, variables, trained)
    for name, made in {"weights": trained, "mean": mean}.items():
        save_weights(out / f"{name}.safetensors", made, model, "float16")
    row = {
        "steps": done,
        "step": 1e3 * (clock() - start) / done,
        "people a second": how.batch * done / (clock() - start),
    }
    settings = {"device": jax.devices()[0].device_kind} | dataclasses.asdict(how)
    record = {
        "settings": settings,
        "rows": {f"training, {how.batch} people a step": row | {"s until compiled": compiled}},
    }
    (out / "run.json").write_text(json.dumps(record, default=str))


def configured(how: Clock) -> TrainConfig:
    """Returns the preset `small` with a constant learning rate, which the clock lowers."""
    config = presets.small()
    optimizer = dataclasses.replace(
        config.optimizer, learning_rate=how.learning_rate, warmup_steps=0
    )
    return dataclasses.replace(
        config,
        loss=dataclasses.replace(config.loss, lpips=LPIPS),
        optimizer=optimizer,
        splat=dataclasses.replace(config.splat, max_pairs=PAIRS),
        # one program for all blocks: half of the products that an accelerator tries out
        model=config.model.with_runtime(scan=not one_after_the_other()),
        steps=FOR_EVER,
        batch_size=how.batch,
        microbatch_size=how.batch,
        ema_decay=None,
    )


def examples_of(config: TrainConfig, how: Clock) -> Callable[..., Any]:
    """Returns the function (bank, step) -> batch of the step."""
    views = config.views
    drawn = OnTheFlyConfig(
        input_views=max(views.input_counts),
        view_counts=views.input_counts,
        target_views=views.target_count,
        input_size=config.model.conventions.image_size,
        target_size=config.target_size,
        mixed_pose_share=views.mixed_pose_share,
        depths=True,
        displaced_share=DISPLACED,
    )
    if jax.default_backend() != "cpu":
        drawn = dataclasses.replace(
            drawn, views_at_once=drawn.input_views + drawn.target_views, pixels_per_step=1 << 30
        )

    def examples(bank, step):
        keys = jax.random.split(jax.random.fold_in(jax.random.key(SEED), step), how.batch)
        return jax.lax.map(lambda key: on_the_fly_example(bank, key, drawn), keys)

    return examples


def stepper(config: TrainConfig) -> Any:
    """Returns a compiled step of `training.step.update` at a share of the learning rate.

    An update is proportional to the learning rate, so the share scales the change of the weights.
    The step returns the new state, the averaged weights and the metrics.
    """

    def step(state, average, batch, body, networks, seed, rate):
        new, metrics = update(state, batch, body, networks, seed, config)
        params = jax.tree.map(lambda a, b: a + rate * (b - a), state.params, new.params)
        decay = jnp.minimum(EMA, (1 + state.step) / (10 + state.step))
        average = optax.incremental_update(params, average, 1 - decay)
        return replace(new, params=params), average, metrics

    return jax.jit(step, donate_argnums=(0, 1), compiler_options=compiler_options())


def state_variables(average: Any, state: Any) -> Any:
    """Returns the variables of a network with averaged weights."""
    return {"params": average, "batch_stats": state.batch_stats}
