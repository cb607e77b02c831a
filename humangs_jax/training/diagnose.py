"""Finds the stage of a training step in which numbers stopped being finite.

Stages are the modules of the network, named by their path, and the steps outside of modules that
`parts.tap` marks. An interceptor of Linen keeps what each stage returns. It also adds zeros to what
each stage takes and returns. The gradients with respect to these zeros are the gradients that pass
back at that place.

This runs in one process on one device. It needs the memory of a step that recomputes nothing.
JAX_PLATFORMS=cpu helps if an accelerator has too little memory.
"""

import dataclasses
import functools
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Literal, TypeVar

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np

from humangs_jax.body.model import BodyModel
from humangs_jax.core.array_types import Key, PyTree, Scalar
from humangs_jax.core.progress import bar, text_table, watched
from humangs_jax.core.pytree import inexact_leaves, pytree_dataclass, static_field
from humangs_jax.data.loading import Example
from humangs_jax.data.views import gaussian_body
from humangs_jax.io.reading import parse_json, read_text, reading
from humangs_jax.losses.loss_networks import NO_NETWORKS, LossNetworks
from humangs_jax.network.parts import HumanGSInputs, Tap, Variables
from humangs_jax.training.checkpoint import Checkpoints, load_config
from humangs_jax.training.config import TrainConfig
from humangs_jax.training.sources import SourceFactory, captured_people, stage_loader
from humangs_jax.training.state import TrainState, init_state
from humangs_jax.training.step import seed_numbers, subject_keys, subject_loss, train_step

T = TypeVar("T")
Named = dict[str, Any]
"""Arrays by path in a pytree, or a `Leaf` for each array. The path of a bare array is ""."""
FAILED = ("skipped", "nonfinite")
"""Events of a run's log that a diagnosis looks for."""
PARTS = (("encoder",), ("reader",), ("decoder",))
"""The modules whose submodules are stages, too."""
DEEPEST = 3
"""Largest depth of a module that is a stage: encoder.transformer.block_0 has depth 3."""


@dataclasses.dataclass(frozen=True)
class Leaf:
    """Statistics of one array. All numbers but `bad` and `first` are of its finite entries only."""

    name: str
    """The path of the array in its pytree."""
    bad: int
    """Number of entries that are not finite."""
    first: tuple[int, ...]
    """Index of the first entry that is not finite; () if there is none."""
    smallest: float
    """The smallest entry; +inf if no entry is finite."""
    largest: float
    """The largest entry; -inf if no entry is finite."""
    mean: float
    """The mean magnitude; 0 if no entry is finite."""
    norm: float
    """The Euclidean norm."""

    @classmethod
    def of(cls, name: str, array: np.ndarray) -> "Leaf":
        """Returns the statistics of an array."""
        wrong = ~np.isfinite(array.astype(np.promote_types(array.dtype, np.float32), copy=False))
        finite = array[~wrong].astype(np.float64)
        first = ()
        if wrong.any():
            first = tuple(np.argwhere(wrong)[0].tolist())
        mean = 0.0
        if finite.size:
            mean = float(np.abs(finite).mean())
        extremes = float(finite.min(initial=np.inf)), float(finite.max(initial=-np.inf))
        return cls(name, int(wrong.sum()), first, *extremes, mean, float(np.linalg.norm(finite)))


@pytree_dataclass
class StageReport:
    """The arrays that passed through a stage, forward and back. Each field holds arrays by name, or
    a `Leaf` for each array.
    """

    name: str = static_field()
    """The name of the stage."""
    values: Named
    """What the stage returned. In a report of stored arrays: the arrays."""
    taken: Named = dataclasses.field(default_factory=dict)
    """Gradients with respect to what the stage took."""
    returned: Named = dataclasses.field(default_factory=dict)
    """Gradients with respect to what the stage returned."""
    gradients: Named = dataclasses.field(default_factory=dict)
    """Gradients with respect to the stage's parameters."""

    @property
    def gradient_norm(self) -> float:
        """Euclidean norm of the gradients of the stage's parameters."""
        return math.hypot(*(leaf.norm for leaf in self.gradients.values()))

    @property
    def spoils(self) -> Leaf | None:
        """The first gradient of the stage that is not finite, if all gradients that came back to
        the stage are finite. None: the stage did not spoil a gradient.
        """
        if _first_bad(self.returned):
            return None
        return _first_bad(self.gradients) or _first_bad(self.taken)


def _first_bad(leaves: dict[str, Leaf]) -> Leaf | None:
    return next((leaf for leaf in leaves.values() if leaf.bad), None)


def _stored(name: str, tree: PyTree) -> StageReport:
    return _numbers(StageReport(name, dict(inexact_leaves(tree))))


def _numbers(report: StageReport) -> StageReport:
    """Replaces each array of a report by its `Leaf`."""

    def of(arrays):
        return {name: Leaf.of(name, np.asarray(x)) for name, x in arrays.items()}

    return StageReport(
        report.name, *map(of, (report.values, report.taken, report.returned, report.gradients))
    )


@dataclasses.dataclass(frozen=True)
class Fault:
    """An array that is not finite. It was stored (in the state or the batch), computed by a stage,
    or sent back by a stage as a gradient.
    """

    direction: Literal["stored", "forward", "backward"]
    """How the array came to be: stored, computed (forward) or sent back (backward)."""
    stage: str
    """The name of the stage."""
    leaf: Leaf
    """The statistics of the array."""

    def __str__(self) -> str:
        what = {
            "stored": f"in the {self.stage}",
            "forward": f"first computed by stage '{self.stage}'",
            "backward": f"first in a gradient sent back by stage '{self.stage}'",
        }[self.direction]
        place = list(self.leaf.first)
        return (
            f"not finite {what}: {self.leaf.name or 'its value'}, {self.leaf.bad} entries, first at"
            f" {place}"
        )


@dataclasses.dataclass(frozen=True)
class Diagnosis:
    """The diagnosis of one subject of a step: the first subject with a fault, or else the subject
    with the largest gradient.
    """

    step: int
    """Number of steps that were done before the step that is diagnosed."""
    subject: int
    """The row of the subject in the batch."""
    loss: float
    """The loss of the subject."""
    skip_norm: float
    """Steps whose gradient has a larger norm than this are skipped."""
    stored: tuple[StageReport, ...]
    """Reports of what the step began with: state, loss networks and batch."""
    stages: tuple[StageReport, ...]
    """The stages in the order in which they end."""

    @property
    def gradient_norm(self) -> float:
        """Euclidean norm of the finite entries of this subject's gradient."""
        return math.hypot(*(stage.gradient_norm for stage in self.stages))

    @property
    def faults(self) -> tuple[Fault, ...]:
        """All stored arrays that are not finite, then at most one array of a stage. This is the
        first result that is not finite in the forward pass. If all results are finite, it is the
        first gradient that is not finite in the backward pass.
        """
        stored = [
            Fault("stored", part.name, leaf)
            for part in self.stored
            for leaf in part.values.values()
            if leaf.bad
        ]
        made = [(stage.name, _first_bad(stage.values)) for stage in self.stages]
        forward = [Fault("forward", name, leaf) for name, leaf in made if leaf]
        spoilt = [(stage.name, stage.spoils) for stage in self.stages]
        back = [Fault("backward", name, leaf) for name, leaf in spoilt if leaf]
        inner = [
            fault
            for fault in back
            if not any(other.stage.startswith(f"{fault.stage}.") for other in back)
        ]
        return (*stored, *(forward[:1] or inner[-1:]))

    @property
    def fault(self) -> Fault | None:
        """The first of `faults`, where the trouble began; None if all is finite."""
        return next(iter(self.faults), None)

    @property
    def verdict(self) -> str:
        """The result of the diagnosis, in one line or a few."""
        if self.faults:
            return "\n".join(map(str, self.faults))
        norm = self.gradient_norm
        if norm <= self.skip_norm:
            return (
                f"all finite; gradient norm {norm:.3g} (a step is skipped above {self.skip_norm:g})"
            )
        worst = max(self.stages, key=lambda stage: stage.gradient_norm)
        return (
            f"all finite, but the gradient norm {norm:.3g} is above {self.skip_norm:g}, where a"
            f" step is skipped; {(worst.gradient_norm / norm) ** 2:.0%} of its square is of stage"
            f" '{worst.name}'"
        )

    def __str__(self) -> str:
        # one line for the step, then a row for each stage
        title = (
            f"step {self.step}, subject {self.subject}: loss {self.loss:.6g}, gradient norm"
            f" {self.gradient_norm:.4g}"
        )
        rows = [
            (
                "stage",
                "values: bad",
                "smallest",
                "largest",
                "mean |x|",
                "sent back: bad",
                "parameters: bad",
                "norm",
            )
        ]

        # entries that are not finite: none is 0, and no array at all is an empty cell
        def bad(leaves):
            if leaves:
                return str(sum(leaf.bad for leaf in leaves.values()))
            return ""

        for report in (*self.stored, *self.stages):
            leaves = report.values.values()
            columns = (min, "smallest"), (max, "largest"), (np.mean, "mean")
            numbers = [
                f"{of([getattr(x, name) for x in leaves]):.3g}" if leaves else ""
                for of, name in columns
            ]
            norm = ""
            if report.gradients:
                norm = f"{report.gradient_norm:.3g}"
            rows.append(
                (
                    report.name,
                    bad(report.values),
                    *numbers,
                    bad(report.taken),
                    bad(report.gradients),
                    norm,
                )
            )
        return "\n".join([title, self.verdict, "", *text_table(rows)])


class Recorder:
    """An interceptor for `nn.intercept_methods` that records the stages of one traced computation,
    in the order in which they end.

    `given` holds the arrays that each stage returned, by the name of the stage.
    probes: two dicts of zeros for each stage. The first is added to what the stage takes, the
    second to what it returns. None: nothing is added, and `shapes` gets the shapes that these zeros
    need.
    """

    def __init__(self, probes: dict[str, tuple[Named, Named]] | None = None):
        self.given: dict[str, Named] = {}
        self.shapes: dict[str, tuple[Named, Named]] = {}
        self._probes = probes

    def __call__(
        self, run: Callable, arguments: tuple, named: dict, context: nn.module.InterceptorContext
    ) -> Any:
        module, (first, *others) = context.module, arguments
        if isinstance(module, Tap):
            if not module.apart:
                return self.watch(str(module.name), *arguments)

            def entry(key):
                return lambda *learned: first(*learned)[key]

            names = jax.eval_shape(lambda: first(*others))
            return {key: self.watch(f"{module.name}: {key}", entry(key), *others) for key in names}
        path = ".".join(module.path)
        if (
            context.method_name != "__call__"
            or module.path[:1] not in PARTS
            or len(module.path) > DEEPEST
        ):
            return run(*arguments, **named)
        if isinstance(first, HumanGSInputs):  # nothing of it depends on parameters
            return self.watch(path, lambda: run(*arguments, **named))
        return self.watch(path, lambda first: run(first, *others, **named), first)

    def watch(self, stage: str, function: Callable, *learned: Any) -> Any:
        result = self._probed(stage, 1, function(*self._probed(stage, 0, learned)))
        self.given[stage] = dict(inexact_leaves(result))
        return result

    def _probed(self, stage: str, side: int, tree: T) -> T:
        leaves = dict(inexact_leaves(tree))
        if self._probes is None:
            self.shapes.setdefault(stage, ({}, {}))[side].update(jax.eval_shape(lambda: leaves))
            return tree
        sums = [x + self._probes[stage][side][name] for name, x in leaves.items()]

        def floating(x):
            return hasattr(x, "dtype") and jnp.issubdtype(x.dtype, jnp.inexact)

        return jax.tree.map(lambda x: sums.pop(0) if floating(x) else x, tree)


@functools.partial(jax.jit, static_argnames="config")
def observe_subject(
    params: PyTree,
    batch_stats: PyTree,
    body: BodyModel,
    example: Example,
    key: Key,
    config: TrainConfig,
    networks: LossNetworks,
) -> tuple[Scalar, list[StageReport]]:
    """Returns the loss of a subject (`subject_loss`) and a report of each stage, in the order in
    which the stages end.

    It runs without `Runtime.scan` and `Runtime.remat`, so that each block can be watched. All
    values are kept, so it needs more memory than a step of training. The published network keeps
    2.4 GB at 512 pixels and 4 views.
    """
    config = dataclasses.replace(config, model=config.model.with_runtime(scan=False, remat="none"))

    def loss(params, probes, recorder):
        recorder = recorder or Recorder(probes)
        with nn.intercept_methods(recorder):
            value, _ = subject_loss(params, batch_stats, body, example, key, config, networks)
        return value, recorder.given | {"loss": {"": value}}

    dry = Recorder()  # finds the stages and their shapes
    jax.eval_shape(lambda params: loss(params, None, dry)[0], params)
    zeros = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), dry.shapes)
    differentiated = jax.value_and_grad(
        lambda *trees: loss(*trees, None), argnums=(0, 1), has_aux=True
    )
    (value, given), (gradients, sent) = differentiated(params, zeros)
    own: dict[str, Named] = {}
    for name, gradient in inexact_leaves(gradients):
        users = [stage for stage in given if name.startswith(f"{stage}.")] or ["driver"]
        own.setdefault(max(users, key=len), {})[name] = gradient

    def report(name, values):
        return StageReport(name, values, *sent.get(name, ({}, {})), own.get(name, {}))

    # a transformation sorts what it returns
    return value, [report(name, given[name]) for name in (*dry.given, "loss")]


def diagnose_step(
    state: TrainState,
    batch: Example,
    body: BodyModel,
    config: TrainConfig,
    networks: LossNetworks = NO_NETWORKS,
) -> Diagnosis:
    """Returns the diagnosis of the step that `train_step` would make with these arguments. Unlike
    `train_step`, this keeps the state's buffers.

    Subjects are computed one by one. Each has its own batch statistics, even where a microbatch
    would share them.
    """
    config, step = config.at(int(state.step)), int(state.step)
    parts = {
        "parameters": state.params,
        "batch statistics": state.batch_stats,
        "optimizer": state.opt_state.inner,
        "averaged parameters": state.ema_params,
        "loss networks": networks,
    }
    stored = [_stored(name, tree) for name, tree in parts.items() if jax.tree.leaves(tree)]
    keys = subject_keys(seed_numbers(config.seed), state.step, len(batch.inputs.betas))
    found = []
    for subject, key in enumerate(bar(keys, desc="diagnose", unit="subject", shown=watched())):
        example = jax.tree.map(lambda x, i=subject: x[i], batch)
        loss, stages = observe_subject(
            state.params, state.batch_stats, body, example, key, config, networks
        )
        given, reports = (*stored, _stored("batch", example)), tuple(map(_numbers, stages))
        found.append(
            Diagnosis(step, subject, float(loss), config.optimizer.skip_norm, given, reports)
        )
        if found[-1].fault is not None:
            return found[-1]
    return max(found, key=lambda diagnosis: diagnosis.gradient_norm)


def diagnose_run(
    out: str | Path,
    body: BodyModel,
    training: Sequence[str | Path] | SourceFactory,
    *,
    networks: LossNetworks = NO_NETWORKS,
    variables: Variables | None = None,
) -> Diagnosis:
    """Returns the diagnosis of one step of a run: the first step that the run's log calls skipped
    or not finite. If the log has no such step, it is the step after the newest checkpoint.

    The run is repeated from the newest checkpoint before that step, or from the start. body,
    training, networks, variables: as the run had them. Batches are functions of seed and step, so
    the step is repeated bit for bit on the device that the run had. Raises: FileNotFoundError if
    `out` holds no run; ValueError if its configuration, log or checkpoints cannot be used.
    """
    config = load_config(out)
    if isinstance(training, Sequence):
        make_source = captured_people(training, body)
    else:
        make_source = training
    body = gaussian_body(body, config.model)
    # the run may still be writing
    checkpoints = Checkpoints(Path(out) / "checkpoints", read_only=True)
    failed = first_failed_step(Path(out) / "log.jsonl")
    state = init_state(config, variables)
    before = [step for step in checkpoints.steps if failed is None or step <= failed]
    if before:
        state = checkpoints.restore(state, before[-1])
    checkpoints.close()
    begin = int(state.step)
    target = begin if failed is None else failed
    repeated = bar(
        total=target - begin, desc="repeat", unit="step", shown=watched() and target > begin
    )
    for first, last in config.spans(begin, target + 1):
        for step, batch in stage_loader(make_source, config, first).batches(first, last):
            if step == target:
                repeated.close()
                return diagnose_step(state, batch, body, config, networks)
            state, _ = train_step(state, batch, body, config.at(first), networks)
            repeated.update(1)
    raise AssertionError("the last of the steps is diagnosed")


def first_failed_step(log: Path) -> int | None:
    """Returns the number of the first step that a log calls skipped or not finite, counted from 0.
    None if there is no such step or no log. Raises: FileError if the log cannot be read.
    """
    if not log.is_file():
        return None
    with reading(log, "log"):
        records = map(parse_json, read_text(log).splitlines())
        return next(
            (int(record["step"]) - 1 for record in records if record.get("event") in FAILED), None
        )
