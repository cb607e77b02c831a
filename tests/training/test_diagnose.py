"""Diagnosis of a step: its numbers are the step's, and a planted fault is named at its place."""

import dataclasses
import functools
import inspect
import json
import re

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from rounding import bound
from target_cases import DRIVEN, PIXELS, SIZE, mapped_tube, small, views
from training_cases import batch_of, random_networks, source_of

from humangs_jax.core.pytree import inexact_leaves, replace
from humangs_jax.data.loading import CaptureCache, Example
from humangs_jax.losses.loss_networks import LossNetworks
from humangs_jax.network.parts import tap
from humangs_jax.training import diagnose
from humangs_jax.training.config import tiny
from humangs_jax.training.diagnose import (
    Diagnosis,
    Fault,
    Leaf,
    Recorder,
    StageReport,
    diagnose_run,
    diagnose_step,
    first_failed_step,
)
from humangs_jax.training.loop import train
from humangs_jax.training.state import init_state
from humangs_jax.training.step import train_step

FLOAT32 = 1e-4
"""Relative error: the stages are fused in another way than in the step."""
BFLOAT16 = 2e-2
"""Relative error in bfloat16."""
CONFIG = tiny()


@pytest.fixture(scope="module")
def batch(body, captures):
    return batch_of(body, captures, CONFIG)


def with_leaf(tree, path, change):
    """Returns the tree with the leaf of this path changed."""
    names = dict(inexact_leaves(tree))
    assert path in names, sorted(names)
    named = lambda p: jax.tree_util.keystr(p, simple=True, separator=".")
    return jax.tree_util.tree_map_with_path(lambda p, x: change(x) if named(p) == path else x, tree)


def planted(value, *index):
    return lambda x: x.at[tuple(index) or (0,) * x.ndim].set(value)


@pytest.mark.slow
def test_the_numbers_are_those_of_the_step(body, batch, variables):
    diagnosis = diagnose_step(init_state(CONFIG, variables), batch, body, CONFIG)
    _, metrics = train_step(init_state(CONFIG, variables), batch, body, CONFIG)
    assert diagnosis.loss == pytest.approx(float(metrics["loss"]), rel=bound(FLOAT32))
    assert diagnosis.gradient_norm == pytest.approx(float(metrics["grad_norm"]), rel=bound(FLOAT32))
    assert diagnosis.fault is None and diagnosis.verdict.startswith("all finite; gradient norm")
    named = {name for stage in diagnosis.stages for name in stage.gradients}
    assert named == {name for name, _ in inexact_leaves(variables["params"])}
    lines = str(diagnosis).splitlines()
    assert lines[-1].startswith("loss ") and len(lines) == 4 + len(diagnosis.stored) + len(
        diagnosis.stages
    )
    spike = dataclasses.replace(diagnosis, skip_norm=1e-9)
    # at the start it has nearly all
    assert re.search("of its square is of stage 'decoder.[a-z]*_out'", spike.verdict)


TOKENS = "encoder.tokenizer.linear"
IN_BATCH = {
    # a pixel of the person; the background is not read
    "inputs.images": ((0, 1, 16, 16, 2), TOKENS),
    "targets.images": ((0, 0, 5, 6, 0), "loss: squared"),
    "targets.masks": ((0, 1, 2, 3), "loss: silhouette"),
    "inputs.betas": ((0, 0), "position maps"),
    "inputs.rotations": ((0, 1, 1, 2), "position maps"),
    "inputs.cameras.cam_from_world": ((0, 1, 0, 3), TOKENS),
    "targets.rotations": ((0, 1, 0, 0), "posed Gaussians"),
    "targets.cameras.K": ((0, 1, 0, 0), "images"),
}


@pytest.mark.slow
@pytest.mark.parametrize("path", IN_BATCH)
def test_a_bad_number_in_the_batch_is_named_and_where_it_enters(body, batch, variables, path):
    index, stage = IN_BATCH[path]
    # an infinite camera may show nothing at all, which is finite
    value = np.nan if "camera" in path else np.inf
    diagnosis = diagnose_step(
        init_state(CONFIG, variables), with_leaf(batch, path, planted(value, *index)), body, CONFIG
    )
    stored, computed = diagnosis.faults
    assert (stored.direction, stored.stage, stored.leaf.name, stored.leaf.bad) == (
        "stored",
        "batch",
        path,
        1,
    )
    assert stored.leaf.first == index[1:] and f"first at {list(index[1:])}" in str(diagnosis)
    # a focal length that is no number shows nothing, which is finite: its gradient is not
    direction = "backward" if path == "targets.cameras.K" else "forward"
    assert (computed.direction, computed.stage) == (direction, stage)


IN_PARAMETERS = {
    "encoder.tokenizer.linear.kernel": TOKENS,
    "encoder.transformer.block_0.norm1.scale": "encoder.transformer.block_0",
    "encoder.transformer.norm.bias": "encoder.transformer.norm",
    "encoder.upsampler.up1.kernel": "encoder.upsampler.up1",
    "reader.kernel": "reader",
    "decoder.trunk_1.kernel": "decoder.trunk_1",
}


@pytest.mark.slow
@pytest.mark.parametrize("path", IN_PARAMETERS)
def test_a_bad_parameter_is_named_and_the_stage_that_uses_it(body, batch, variables, path):
    state = init_state(CONFIG, variables)
    state = replace(state, params=with_leaf(state.params, path, planted(np.nan)))
    stored, computed = diagnose_step(state, batch, body, CONFIG).faults
    assert (stored.direction, stored.stage, stored.leaf.name, stored.leaf.bad) == (
        "stored",
        "parameters",
        path,
        1,
    )
    assert (computed.direction, computed.stage) == ("forward", IN_PARAMETERS[path])


@pytest.mark.slow
def test_a_stage_that_overflows_from_finite_parameters_is_named(body, batch, variables):
    state, block = init_state(CONFIG, variables), "encoder.transformer.block_1"
    for name in ("mlp_in", "mlp_out"):
        state = replace(
            state, params=with_leaf(state.params, f"{block}.{name}.kernel", lambda x: 1e25 * x)
        )
    (fault,) = diagnose_step(state, batch, body, CONFIG).faults
    assert (fault.direction, fault.stage) == ("forward", block)


@pytest.mark.slow
def test_moments_and_averages_are_looked_at(body, batch, variables):
    config = dataclasses.replace(CONFIG, ema_decay=0.9)
    state = init_state(config, variables)
    assert state.ema_params is not None
    moments = state.opt_state.inner
    for path in [
        path for path, _ in inexact_leaves(moments) if path.endswith("decoder.trunk_0.kernel")
    ]:
        moments = with_leaf(moments, path, planted(np.inf))
    averages = with_leaf(state.ema_params, "decoder.trunk_0.bias", planted(np.nan, 3))
    state = replace(state, opt_state=state.opt_state._replace(inner=moments), ema_params=averages)
    faults = diagnose_step(state, batch, body, CONFIG).faults
    assert [fault.stage for fault in faults] == ["optimizer", "optimizer", "averaged parameters"]
    assert "averaged parameters: decoder.trunk_0.bias, 1 entries, first at [3]" in str(faults[-1])


@pytest.mark.slow
@pytest.mark.parametrize("name", [*PIXELS, *DRIVEN])
def test_networks_that_run_again_for_every_target_are_diagnosed(name):
    """The network is only traced: every parameter's gradient belongs to a stage."""
    config = dataclasses.replace(CONFIG, model=small(name), target_size=SIZE)
    shapes = jax.eval_shape(lambda: init_state(config))
    example = Example(views(), views(seed=1))
    traced = functools.partial(
        inspect.unwrap(diagnose.observe_subject), config=config, networks=LossNetworks()
    )
    observed = jax.eval_shape(
        traced,
        shapes.params,
        shapes.batch_stats,
        mapped_tube(small(name)),
        example,
        jax.random.key(0),
    )[1]
    found = {parameter for stage in observed for parameter in stage.gradients}
    assert found == {parameter for parameter, _ in inexact_leaves(shapes.params)}


@jax.custom_vjp
def nan_gradient(x):
    return x


nan_gradient.defvjp(
    lambda x: (x, None),
    lambda _, g: (
        g.at[(-1,) * g.ndim].set(jnp.nan) if jnp.issubdtype(g.dtype, jnp.inexact) else g,
    ),
)


class Network(nn.Module):
    """A network of two layers, between which gradients become NaN."""

    @nn.compact
    def __call__(self, x):
        x = nn.Dense(3, name="first")(x)
        return nn.Dense(3, name="second")(nan_gradient(x))


def test_gradients_are_known_where_a_stage_takes_and_gives():
    """Stages are modules by their path, and a step beside the network, whose results have separate
    gradients.
    """

    class Whole(nn.Module):
        reader: nn.Module

        def __call__(self, x):
            return self.reader(x)

    network, x = Whole(Network(parent=None)), jnp.asarray([[0.1, 0.2, 0.3]])
    variables = network.init(jax.random.key(0), x)

    def loss(probes=None, recorder=None):
        recorder = recorder or Recorder(probes)
        with nn.intercept_methods(recorder):
            y = network.apply(variables, x)
            terms = tap(
                "loss", lambda y: {"a": jnp.sum(y), "b": jnp.sum(nan_gradient(y))}, y, apart=True
            )
        return terms["a"] + terms["b"], recorder.given

    # a run without probes shows the stages and their shapes
    dry = Recorder()
    loss(recorder=dry)
    assert list(dry.given) == ["reader.first", "reader.second", "reader", "loss: a", "loss: b"]
    zeros = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), dry.shapes)
    # probes of 0 change nothing; their gradients are those of the stages
    sent = jax.grad(lambda probes: loss(probes)[0])(zeros)
    assert float(loss(zeros)[0]) == float(loss()[0])
    fine = {
        name: [all(np.isfinite(g).all() for g in side.values()) for side in both]
        for name, both in sent.items()
    }
    assert fine["loss: a"] == [True, True] and fine["loss: b"] == [False, True]
    assert fine["reader.second"] == fine["reader.first"] == [False, False]


def number(name, bad=0):
    return {name: Leaf(name, bad, (1, 2), -1.0, 1.0, 0.5, 1.0)}


def test_going_back_the_innermost_last_stage_with_good_gradients_behind_it_is_blamed():
    good = {
        "values": number("out"),
        "returned": number("out"),
        "taken": number("in"),
        "gradients": number("kernel"),
    }
    spoilt = good | {"taken": number("in", 3), "returned": number("out", 1)}
    stages = {
        "tokenizer": good | {"gradients": number("kernel", 1)},  # going back, it comes later
        "encoder.block_0": spoilt,
        "encoder.block_1": good | {"gradients": number("kernel", 2)},
        "encoder.norm": good,
        "encoder": good | {"taken": number("in", 3)},
        "loss": good,
    }

    def diagnosis_of(stages):
        return Diagnosis(
            7, 0, 1.0, 100.0, (), tuple(StageReport(name, **x) for name, x in stages.items())
        )

    assert diagnosis_of(stages).fault == Fault(
        "backward", "encoder.block_1", number("kernel", 2)["kernel"]
    )
    between = stages | {"encoder.block_1": good | {"returned": number("out", 1)}}
    assert diagnosis_of(between).fault == Fault("backward", "encoder", number("in", 3)["in"])
    worse = stages | {name: good | {"values": number("", 1)} for name in ("encoder.norm", "loss")}
    assert diagnosis_of(worse).fault == Fault("forward", "encoder.norm", number("", 1)[""])


def test_numbers_of_arrays():
    leaf = Leaf.of("x", np.asarray([[3.0, np.inf], [np.nan, -4.0]], np.float32))
    assert leaf == Leaf("x", 2, (0, 1), -4.0, 3.0, 3.5, 5.0)
    assert Leaf.of("x", np.zeros((0, 3))).norm == 0 and Leaf.of("x", np.asarray(np.nan)).first == ()
    half = Leaf.of("x", np.asarray(jnp.asarray([1e30, jnp.nan], jnp.bfloat16)))
    assert half.bad == 1 and half.norm == pytest.approx(1e30, rel=1e-2)


@pytest.mark.slow
def test_a_run_is_repeated_up_to_its_first_bad_step(body, captures, variables, tmp_path):
    def source(at):
        return lambda config: source_of(cache, config, spoilt_at=at)

    cache = CaptureCache(captures, body)
    train(CONFIG, body, source(3), tmp_path, variables=variables, stop_at=5, progress=False)
    lines = [json.loads(line) for line in (tmp_path / "log.jsonl").read_text().splitlines()]
    events = [line for line in lines if "samples" in line]
    assert [(event["step"], len(event["samples"])) for event in events] == [(4, 1)]
    assert (
        "targets.images" in events[0]["samples"][0]
        and str(captures[0].parent) in events[0]["samples"][0]
    )
    diagnosis = diagnose_run(tmp_path, body, source(3), variables=variables)
    assert diagnosis.step == 3 and first_failed_step(tmp_path / "log.jsonl") == 3
    assert diagnosis.fault is not None and diagnosis.fault.leaf.name == "targets.images"
    (tmp_path / "log.jsonl").write_text("")
    healthy = diagnose_run(tmp_path, body, source(99))
    assert healthy.step == 5 and healthy.fault is None


@pytest.mark.slow
def test_losses_of_networks_are_stages_and_their_weights_are_looked_at(body, batch, variables):
    networks = random_networks()
    loss = dataclasses.replace(CONFIG.loss, perceptual=0.5, lpips=0.25)
    config = dataclasses.replace(
        CONFIG, loss=loss, model=CONFIG.model.with_runtime(dtype="bfloat16")
    )
    whole = diagnose_step(init_state(config, variables), batch, body, config, networks)
    _, metrics = train_step(init_state(config, variables), batch, body, config, networks)
    assert whole.fault is None and whole.loss == pytest.approx(float(metrics["loss"]), rel=BFLOAT16)
    stages = {stage.name: stage for stage in whole.stages}
    for name in ("perceptual", "lpips"):
        assert stages[f"loss: {name}"].values[""].mean == pytest.approx(
            float(metrics[name]), rel=BFLOAT16
        )
    networks = with_leaf(networks, "lpips.heads.2", planted(jnp.nan, 5))
    stored, computed = diagnose_step(
        init_state(config, variables), batch, body, config, networks
    ).faults
    assert (stored.stage, stored.leaf.name, stored.leaf.first) == (
        "loss networks",
        "lpips.heads.2",
        (5,),
    )
    assert (computed.direction, computed.stage) == ("forward", "loss: lpips")
