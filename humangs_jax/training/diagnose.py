"""Finds the stage of a training step in which numbers stopped being finite.

    print(diagnose_step(state, batch, body, config))       # one step
    print(diagnose_run("runs/small", load_body(), people)) # the first step of a run that failed

For one process and device. It needs the memory of a step that recomputes nothing; JAX_PLATFORMS=cpu helps where an
accelerator has too little.
"""

import dataclasses
import functools
from collections.abc import Sequence
from pathlib import Path

import flax.linen as nn
import jax

from humangs_jax.body.model import BodyModel
from humangs_jax.core.array_types import Key, PyTree, Scalar
from humangs_jax.core.progress import bar, watched
from humangs_jax.core.pytree import pytree_dataclass, static_field
from humangs_jax.data.loading import Example
from humangs_jax.data.views import gaussian_body
from humangs_jax.io.reading import parse_json, read_text, reading
from humangs_jax.losses.loss_networks import LossNetworks
from humangs_jax.network.parts import Variables
from humangs_jax.network.stages import Named, Recorder, inexact_leaves
from humangs_jax.training.checkpoint import Checkpoints, load_config
from humangs_jax.training.config import TrainConfig
from humangs_jax.training.diagnosis import Diagnosis, StageReport, leaves
from humangs_jax.training.sources import MakeSource, captured_people, stage_loader
from humangs_jax.training.state import TrainState, init_state
from humangs_jax.training.step import NO_NETWORKS, seed_numbers, subject_keys, subject_loss, train_step

FAILED = ("skipped", "nonfinite")
"""Events of a run's log that a diagnosis looks for."""


NEAREST = {
    "encoder": ("encoding",),
    "reader": ("vertex features",),
    "decoder": ("posed Gaussians", "images"),
    "driver": ("posed Gaussians",),
}
"""Stages for the parameters of parts that have no stages of their own: the first that the network has."""


@pytree_dataclass
class ObservedStage:
    """values: what a stage gives. cotangents: the gradients that it sends back to what it takes. gradients: of its parameters."""

    name: str = static_field()
    values: Named
    cotangents: Named
    gradients: Named


@functools.partial(jax.jit, static_argnames="config")
def observe_subject(
    params: PyTree,
    batch_stats: PyTree,
    body: BodyModel,
    example: Example,
    key: Key,
    config: TrainConfig,
    networks: LossNetworks,
) -> tuple[Scalar, list[ObservedStage]]:
    """The loss (`subject_loss`), and all its stages in the order of the forward pass.

    Blocks are neither looped over nor recomputed, so that each can be watched, and everything is kept: this needs more
    memory than a step (the published network at 512 pixels, 4 views each: 2.4 GB are kept).
    """
    config = dataclasses.replace(config, model=config.model.with_runtime(scan=False, remat="none"))

    def loss(params, probes, recorder):
        recorder = recorder or Recorder(probes)
        with nn.intercept_methods(recorder.watch):
            value, _ = subject_loss(params, batch_stats, body, example, key, config, networks, stage=recorder)
        return value, recorder.given

    dry = Recorder()  # finds the stages and their shapes
    jax.eval_shape(lambda params: loss(params, None, dry)[0], params)
    differentiated = jax.value_and_grad(lambda *trees: loss(*trees, None), argnums=(0, 1), has_aux=True)
    (value, given), (gradients, cotangents) = differentiated(params, dry.probes())
    own: dict[str, Named] = {}
    for name, gradient in inexact_leaves(gradients):
        stages = (parameter_stage(name), *NEAREST[name.split(".")[0]])
        own.setdefault(next(stage for stage in stages if stage in dry.given), {})[name] = gradient
    stages = [ObservedStage(name, given[name], cotangents.get(name, {}), own.get(name, {})) for name in dry.given]
    return value, stages


def parameter_stage(name: str) -> str:
    """The stage that uses a parameter, by the parameter's path, as decoder.trunk_0.kernel."""
    part, *inner = name.split(".")
    if part != "encoder":
        return {"reader": "vertex features", "decoder": "raw heads", "driver": "posed Gaussians"}[part]
    if inner[0] == "transformer":
        return {"input_norm": "input norm", "norm": "final norm"}.get(inner[1], inner[1].replace("_", " "))
    return {"tokenizer": "tokens", "class_token": "tokens", "upsampler": "maps"}.get(inner[0], "encoding")


def diagnose_step(
    state: TrainState, batch: Example, body: BodyModel, config: TrainConfig, networks: LossNetworks = NO_NETWORKS
) -> Diagnosis:
    """Diagnose the step that `train_step` would make of these arguments; the state is not given away.

    It works subject by subject: each has its own batch statistics, even where a microbatch would share them.
    """
    config = config.at(int(state.step))
    parts = {
        "parameters": state.params,
        "batch statistics": state.batch_stats,
        "optimizer": state.opt_state.inner,
        "averaged parameters": state.ema_params,
        "loss networks": networks,
    }
    stored = [StageReport(name, leaves(tree)) for name, tree in parts.items() if jax.tree.leaves(tree)]
    keys = subject_keys(seed_numbers(config.seed), state.step, len(batch.inputs.betas))
    found = []
    for subject, key in enumerate(bar(keys, desc="diagnose", unit="subject", shown=watched())):
        example = jax.tree.map(lambda x, i=subject: x[i], batch)
        loss, stages = observe_subject(state.params, state.batch_stats, body, example, key, config, networks)
        diagnosis = Diagnosis(
            step=int(state.step),
            subject=subject,
            loss=float(loss),
            skip_norm=config.optimizer.skip_norm,
            stored=(*stored, StageReport("batch", leaves(example))),
            stages=tuple(StageReport(x.name, *map(leaves, (x.values, x.cotangents, x.gradients))) for x in stages),
        )
        if diagnosis.fault is not None:
            return diagnosis
        found.append(diagnosis)
    return max(found, key=lambda diagnosis: diagnosis.gradient_norm)


def diagnose_run(
    out: str | Path,
    body: BodyModel,
    training: Sequence[str | Path] | MakeSource,
    *,
    networks: LossNetworks = NO_NETWORKS,
    variables: Variables | None = None,
) -> Diagnosis:
    """Repeat the first step of a run that its log calls skipped or not finite, from the newest checkpoint before it.

    Without such a step: the one that would come next. body, training, networks, variables: as the run had them.
    Batches are functions of seed and step, so that on the device that the run had the step is repeated bit for bit.
    Raises: FileNotFoundError without a run in `out`.
    """
    config = load_config(out)
    make_source = captured_people(training, body) if isinstance(training, Sequence) else training
    body = gaussian_body(body, config.model)
    checkpoints = Checkpoints(Path(out) / "checkpoints", read_only=True)  # the run may still be writing
    failed = first_failed_step(Path(out) / "log.jsonl")
    state = init_state(config, variables)
    before = [step for step in checkpoints.steps if failed is None or step <= failed]
    if before:
        state = checkpoints.restore(state, before[-1])
    checkpoints.close()
    step = int(state.step)
    steps = 1 if failed is None else failed + 1 - step
    repeated = bar(total=steps - 1, desc="repeat", unit="step", shown=watched() and steps > 1)
    for first, last in config.spans(step, step + steps):
        part, loader = config.at(first), stage_loader(make_source, config, first)
        for step, batch in loader.batches(first, last):
            if step + 1 < (last if failed is None else failed + 1):
                state, _ = train_step(state, batch, body, part, networks)
                repeated.update(1)
            else:
                repeated.close()
                return diagnose_step(state, batch, body, config, networks)
    raise AssertionError("the last of the steps is diagnosed")


def first_failed_step(log: Path) -> int | None:
    """Number of the first step that a log calls skipped or not finite, counted from 0; None if there is none."""
    if not log.is_file():
        return None
    with reading(log, "log"):
        for line in read_text(log).splitlines():
            record = parse_json(line)
            if record.get("event") in FAILED:
                return int(record["step"]) - 1
        return None
