"""Runs the training loop, the only part of training with side effects.

out/config.json, out/checkpoints/    see `checkpoint`; a run continues from the newest one by itself
out/log.jsonl                        one object per line; {"step", "loss", ...} while training,
                                     {"step", "val_psnr", ...} from validations, {"step", "event",
                                     ...} where something happened
out/tensorboard/                     the same numbers and the validation images, if tensorboardX is
                                     installed
out/sheets/STEP.png                  images of the people of the validation
out/weights.safetensors              the newest weights (float16), averaged ones where `ema_decay`
                                     is set
out/best.safetensors                 the weights of the validation with the highest psnr

If there are several processes, all must see the same folder `out`. All processes write the
checkpoints, and one of them writes everything else.
"""

import contextlib
import dataclasses
import functools
import json
import logging
import math
import os
import signal
import threading
import time
from collections.abc import Callable, Generator, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jax.sharding import Mesh

from humangs_jax.body.model import BodyModel
from humangs_jax.core.array_types import Float
from humangs_jax.core.checks import checked_arguments
from humangs_jax.core.progress import bar, say, stage
from humangs_jax.data.loading import Example, Waiting
from humangs_jax.data.views import gaussian_body
from humangs_jax.io.atomic import only_writer, write_text
from humangs_jax.io.images import DRAWN, write_png
from humangs_jax.io.reading import InvalidFileError, parse_json, read_text, reading
from humangs_jax.losses.loss_networks import NO_NETWORKS, LossNetworks
from humangs_jax.network.parts import Variables
from humangs_jax.network.weights import save_weights
from humangs_jax.training.checkpoint import Checkpoints, save_config
from humangs_jax.training.config import TrainConfig, compiled_for
from humangs_jax.training.forward import sheet, validate, validation_examples
from humangs_jax.training.room import with_measured_room, with_twice_the_room
from humangs_jax.training.sharding import place, replicated, state_shardings, training_mesh, whole
from humangs_jax.training.sources import SourceFactory, bad_samples, captured_people, stage_loader
from humangs_jax.training.state import TrainState, init_state
from humangs_jax.training.step import seed_numbers, train_step, update

logger = logging.getLogger("humangs_jax.training")
MANY_SKIPPED = 20
"""Number of consecutive steps after which the log reports that all were skipped, or that all had a
gradient of 0.
"""
ALL_SKIPPED = "were skipped: `humangs train --diagnose` names the first stage that fails"
NO_GRADIENT = (
    "had a gradient of 0: no loss depends on a parameter any more; a learning rate that is too high"
    " does that"
)

NO_ROOM = "(splat, tile) pairs of a step had no room and were not drawn"
"""Text of the log about a step whose buffers overflowed."""


class RunLog:
    """Writes the log of a run that continues after `step`, and shows its progress. Records of later
    steps, which a killed run may have left, are dropped.

    recording: whether this process writes and shows anything. It is True in one process only.
    """

    def __init__(
        self, out: str | Path, step: int, total: int, recording: bool = True, progress: bool = True
    ):
        shown = recording and progress
        self.bar = bar(
            shown=shown, total=total, initial=step, unit="step", dynamic_ncols=True, smoothing=0.05
        )
        self._recording = recording
        self._lines = self._board = None
        self._previous = (step, time.perf_counter(), 0.0)
        if recording:
            path = Path(out) / "log.jsonl"
            forget_after(path, step)
            self._lines = open(path, "a", buffering=1)  # noqa: SIM115 (closed in __exit__)
            self._board = _tensorboard(Path(out) / "tensorboard", step)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.bar.close()
        if self._lines is not None:
            with _naming(self._lines.name):
                self._lines.close()
        if self._board is not None:
            with _naming(self._board.logdir):
                self._board.close()

    def steps(
        self, done: int, metrics: dict[str, Any], subjects: int, waiting: Waiting, broken: int
    ) -> None:
        """Logs the metrics of the last step done, with times and rates since the previous call.

        done: number of steps done. subjects: number of subjects in a step. waiting: how long the
        loop has waited for data so far. broken: number of people on disk who could not be used.
        """
        numbers = {name: float(value) for name, value in metrics.items()}
        before, began, waited = self._previous
        now = time.perf_counter()
        self._previous = (done, now, waiting.seconds)
        count = done - before
        if count > 0:
            numbers["seconds_per_step"] = (now - began) / count
            numbers["samples_per_second"] = count * subjects / (now - began)
            numbers["data_seconds_per_step"] = (waiting.seconds - waited) / count
        if broken:
            numbers["broken_folders"] = broken
        self.numbers(done, numbers, "train")
        digits = {"loss": 4, "psnr": 2, "samples_per_second": 2}
        self.bar.set_postfix(
            {name: f"{numbers[name]:.{n}f}" for name, n in digits.items() if name in numbers},
            refresh=False,
        )

    def numbers(self, done: int, numbers: dict[str, float], group: str) -> None:
        """Logs numbers after step `done`, as a line and as curves "group/name" of TensorBoard."""
        self._write({"step": done} | numbers)
        if self._board is not None:
            for name, value in numbers.items():
                self._board.add_scalar(f"{group}/{name}", value, done)

    def image(self, done: int, name: str, image: np.ndarray) -> None:
        """Gives an (h, w, 3) image in [0, 1] to TensorBoard."""
        if self._board is not None:
            self._board.add_image(
                name, (255 * np.clip(image, 0, 1) + 0.5).astype(np.uint8), done, dataformats="HWC"
            )

    def event(self, done: int, event: str, message: str, **details: float | list[str]) -> None:
        """Writes a line about an event to the log, and shows `message` beside the progress bar."""
        self._write({"step": done, "event": event} | details)
        if self._recording:
            say(f"step {done}: {message}")

    def _write(self, record: dict[str, Any]) -> None:
        if self._lines is not None:  # JSON has no NaN

            def finite(x):
                if not isinstance(x, float) or math.isfinite(x):
                    return x
                return None

            with _naming(self._lines.name):
                self._lines.write(
                    json.dumps({name: finite(value) for name, value in record.items()}) + "\n"
                )


class Watch:
    """Reads every step's metrics one step late, so that the device is never idle, and logs steps
    that failed.
    """

    def __init__(self, log: RunLog, state: TrainState):
        self.overflowed = False
        """Whether the step that was read last had no room for some (splat, tile) pairs."""
        self._log, self._pending = log, None
        self._told_of_overflow = False
        self._counts = int(state.opt_state.skipped), int(state.opt_state.nonfinite)
        self._in_a_row = self._without_gradient = 0

    def __call__(
        self, done: int, metrics: dict[str, Any], bad_samples: Callable[[], list[str]] = list
    ) -> None:
        """Reads the metrics of the step before, and keeps the metrics of the step that was just
        begun for the next call.

        done: number of steps, this one included. bad_samples: called if the step failed; it returns
        a line for each bad sample, see `sources`.
        """
        # one step may wait behind the one that runs: enough to keep a device busy, and the run
        # reacts to a signal soon
        self.look()
        names = ("skipped", "nonfinite", "loss", "grad_norm", "overflow")
        self._pending = done, {name: metrics[name] for name in names}, bad_samples

    def look(self) -> None:
        """Reads the metrics of the kept step, and logs the step if it failed."""
        if self._pending is None:
            return
        (done, metrics, bad_samples), self._pending = self._pending, None
        numbers = {name: float(value) for name, value in jax.device_get(metrics).items()}
        # whether the step failed, and how many have in a row
        counts = int(numbers["skipped"]), int(numbers["nonfinite"])
        skipped, replaced = (now > before for now, before in zip(counts, self._counts, strict=True))
        self._counts = counts
        self._in_a_row = self._in_a_row + 1 if skipped else 0
        if numbers["grad_norm"] == 0:
            self._without_gradient = self._without_gradient + 1
        else:
            self._without_gradient = 0
        # once: all steps of a fresh network may overflow, and the lines of the log say how much
        self.overflowed = numbers["overflow"] > 0
        if self.overflowed and not self._told_of_overflow:
            self._told_of_overflow = True
            self._log.event(done, "overflow", f"{numbers['overflow']:.0f} {NO_ROOM}")
        if skipped or replaced:
            samples = bad_samples()
            text = "; ".join(
                [f"loss {numbers['loss']:.4g}, gradient norm {numbers['grad_norm']:.4g}", *samples]
            )
            what = f"gradient entries that were not finite were replaced ({text})"
            if skipped:
                what = f"skipped ({text}), {counts[0]} so far"
            details = numbers | ({"samples": samples} if samples else {})
            self._log.event(done, "skipped" if skipped else "nonfinite", what, **details)
            if samples and jax.process_index():  # whose log is not written
                logger.warning("step %d: %s", done, text)
        # a run whose steps all fail learns nothing: the log says so once
        for count, problem in (
            (self._in_a_row, ALL_SKIPPED),
            (self._without_gradient, NO_GRADIENT),
        ):
            if count == MANY_SKIPPED:
                self._log.event(done, "stuck", f"{MANY_SKIPPED} steps in a row {problem}")


def forget_after(path: Path, step: int) -> None:
    """Drops the lines of steps after `step` from a log, and a last line that is incomplete. If
    writing fails, the log is as before. Without a file at `path`, nothing is done.

    Raises: FileError if the file is no text, is too large, or has a line other than the last that
    is no record.
    """
    if not path.is_file():
        return
    kept = []
    with reading(path, "log of a run"):
        lines = read_text(path).splitlines()
        for number, line in enumerate(lines, 1):
            try:
                if parse_json(line)["step"] <= step:
                    kept.append(line)
            except (ValueError, LookupError, TypeError) as error:
                if number < len(lines):  # of the last one a kill may have left a part
                    raise InvalidFileError(
                        f"line {number}: expected an object with a step"
                    ) from error
    write_text(path, "".join(f"{line}\n" for line in kept))


@contextlib.contextmanager
def _naming(path: Any) -> Generator[None]:
    """Turns an OSError, as from a full disk, into an OSError that names the file."""
    try:
        yield
    except OSError as error:
        raise OSError(error.errno, error.strerror, str(path)) from error


def _tensorboard(folder: Path, step: int) -> Any:
    try:
        from tensorboardX import SummaryWriter
    except ImportError:  # optional: the log has the same numbers
        return None
    return SummaryWriter(str(folder), purge_step=step + 1, flush_secs=10)


# Records
# --------------------------------------------------------------------------------------------------


VALIDATED = 8
"""Default number of subjects in a validation."""
SHOWN = 4
"""Number of validation subjects on the sheet."""
DROPPED = {
    "dropped_tokens": (
        "patches without room, mean: model.runtime.token_capacity is too small for these photos"
    ),
    "overflow": "(splat, tile) pairs without room, mean: they were not drawn",
}
"""For two metrics of a validation, the text that explains a value other than 0."""


class TrainingInterrupted(KeyboardInterrupt):
    """`train` raises this after Ctrl-C or SIGTERM (several processes: after SIGTERM). The state is
    saved, and the same call continues the run.

    It is a KeyboardInterrupt, so that a loop of several runs stops, too. state: the saved state.
    """

    def __init__(self, state: TrainState, steps: int):
        super().__init__(
            f"after {int(state.step)} of {steps} steps, which are saved: the same call goes on"
        )
        self.state = state


@dataclasses.dataclass(frozen=True)
class _Validations:
    """What the validations of a run look at. Each process validates with arrays of its own."""

    people: SourceFactory | None
    """Function that makes a source of the people. None: there are no validations."""
    count: int
    """Number of people that a validation looks at."""
    body: BodyModel
    """Body that carries the Gaussians."""
    networks: LossNetworks
    """Networks of the metrics that need them."""


@dataclasses.dataclass(frozen=True)
class _Run:
    """What stays the same during a call of `train`."""

    config: TrainConfig
    """Configuration of the run, with all its stages."""
    people: SourceFactory
    """Function that makes a source of the people to train on."""
    body: BodyModel
    """Body that carries the Gaussians, on all devices."""
    networks: LossNetworks
    """Networks of the losses that need them, on all devices."""
    mesh: Mesh | None
    """Devices among which the run is divided. None: there is only one."""
    validations: _Validations
    """What validations look at."""
    end: int
    """Number of steps of the run after which the call returns."""
    out: Path
    """Folder of the run."""
    leading: bool
    """Whether this process writes the log, the sheets and the weights. It is True in one process
    only.
    """
    checkpoints: Checkpoints
    """Checkpoints of the run, which all processes write."""


@dataclasses.dataclass
class _Current:
    """Where a run stands. Its steps change this record."""

    state: TrainState
    """State after the last step done."""
    best_score: float | None
    """Highest psnr of a validation so far. None: no validation had one."""
    waiting: Waiting = dataclasses.field(default_factory=Waiting)
    """Time that this call has waited for data."""
    stopped: bool = False
    """Whether the run was asked to stop before its end."""


@checked_arguments
def train(
    config: TrainConfig,
    body: BodyModel,
    training: Sequence[str | Path] | SourceFactory,
    out: str | Path,
    *,
    validation: Sequence[str | Path] | SourceFactory = (),
    validated: int = VALIDATED,
    variables: Variables | None = None,
    networks: LossNetworks = NO_NETWORKS,
    fsdp: int | None = None,
    stop_at: int | None = None,
    progress: bool = True,
) -> TrainState:
    """Trains a network for `config.steps` steps, on all devices of all processes. If `out` holds a
    checkpoint, training continues from the newest one.

    After Ctrl-C or SIGTERM the current step is finished, the state is saved, and
    `TrainingInterrupted` is raised. If there are several processes, only SIGTERM has this effect. A
    second Ctrl-C interrupts at once.

    Args:
        config: configuration of the run.
        body: body that the captures' parameters belong to. The Gaussians are on the
            `gaussian_body` that is made from it.
        training: people to train on: capture folders, or a function that makes another source of
            examples (see `training.sources`).
        out: folder of checkpoints, logs, sheets and weights.
        validation: other people, in the same two forms. Empty: there are no validations.
        validated: number of people that a validation looks at: the first ones of `validation`.
        variables: variables that a new run starts from, for instance shipped weights. None: random
            variables of `config.seed`.
        networks: networks of the losses that need them.
        fsdp: number of devices that share one copy of the state, see `sharding.training_mesh`.
            None: all devices.
        stop_at: number of steps of the run after which the call saves the state and returns. A
            later call continues the run. None: `config.steps`.
        progress: whether a progress bar is shown.

    Returns:
        The state after the last step.

    Raises:
        TrainingInterrupted: after Ctrl-C or SIGTERM.
        TypeError: for arguments of other classes.
        ValueError: if `out` belongs to a run of another configuration, if its configuration, log or
            checkpoints cannot be used, or if a checkpoint cannot be written. Also if no capture can
            be used, devices, batch and microbatch do not divide each other, the network of a loss
            is missing, or the sizes of a later stage do not fit.
        OSError: if another process trains into `out`, or a file other than a checkpoint cannot be
            written.

    Examples:
        >>> people = ["people/0000001", "people/0000002"]
        >>> state = hg.train(config, hg.load_body(), people, "runs/mine")
    """
    out, leading = Path(out), jax.process_index() == 0
    (out / "sheets").mkdir(parents=True, exist_ok=True)
    alone = only_writer(out) if leading else contextlib.nullcontext()
    with alone:
        save_config(out, config, write=leading)

        # captures' parameters belong to the body as it was given
        people = _as_source_factory(training, body)
        unseen = _as_source_factory(validation, body) if validation else None
        body = gaussian_body(body, config.model)
        validations = _Validations(unseen, validated, body, networks)

        # several devices share the state, and each has the whole body and the networks
        mesh = training_mesh(fsdp)
        if mesh.size == 1:
            mesh = None
        state = init_state(config, variables)
        checkpoints = Checkpoints(out / "checkpoints", config.keep_checkpoints)
        current = _resumed(state, mesh, checkpoints)
        del state  # so that its memory is free when the first step has replaced it
        if mesh is not None:
            body, networks = place((body, networks), replicated(mesh))

        begin = int(current.state.step)
        end = config.steps
        if stop_at is not None:
            end = min(config.steps, stop_at)
        run = _Run(
            config=config,
            people=people,
            body=body,
            networks=networks,
            mesh=mesh,
            validations=validations,
            end=end,
            out=out,
            leading=leading,
            checkpoints=checkpoints,
        )

        stages = config.spans(begin, end)
        for first, _ in stages[1:]:
            _rehearse(run, current.state, first)
        with (
            stop_requested() as stopping,
            RunLog(out, begin, config.steps, leading, progress) as log,
        ):
            watch = Watch(log, current.state)
            for first, last in stages:
                _run_stage(run, current, first, last, log, watch, stopping)
                if current.stopped:
                    break
            watch.look()
            checkpoints.close()
            # a single process may be asked to stop after its last step; several agree only on steps
            if jax.process_count() == 1 and stopping(end):
                current.stopped = True
        if current.stopped:
            raise TrainingInterrupted(current.state, config.steps)
        return current.state


def _as_source_factory(
    people: Sequence[str | Path] | SourceFactory, body: BodyModel
) -> SourceFactory:
    """Returns a function that makes a source of people. people: such a function, or capture
    folders.
    """
    if isinstance(people, Sequence):
        return captured_people(people, body)
    return people


def _resumed(state: TrainState, mesh: Mesh | None, checkpoints: Checkpoints) -> _Current:
    """Returns where the newest checkpoint stands, or the start of a new run if there is none. The
    state is divided among the devices of the mesh.

    state: the state of a run that begins.
    """
    if mesh is not None:
        state = place(state, state_shardings(state, mesh))
    if not checkpoints.steps:
        return _Current(state, best_score=None)
    state = checkpoints.restore(state)
    best_score = None
    if checkpoints.best_step is not None:
        best_score = checkpoints.score(checkpoints.best_step)
    return _Current(state, best_score)


def _run_stage(
    run: _Run,
    current: _Current,
    first: int,
    last: int,
    log: RunLog,
    watch: Watch,
    stopping: Callable[[int], bool],
) -> None:
    """Does the steps from `first` to `last` - 1, which have one configuration. If the run is asked
    to stop, the function saves the state after the current step and returns.

    stopping: see `stop_requested`.
    """
    config, part = run.config, run.config.at(first)
    loader = stage_loader(run.people, config, first, run.mesh)
    examples = []
    if run.validations.people is not None:
        examples = validation_examples(run.validations.people, part, run.validations.count)

    with contextlib.closing(loader.batches(first, last, waiting=current.waiting)) as batches:
        for step, batch in batches:
            # one look at the first batch, which costs little while its arrays are in memory
            if step == first and run.mesh is None:
                for line in bad_samples(loader, step, batch):
                    log.event(step, "sample", line, samples=[line])
                part = with_measured_room(part, current.state.variables, run.body, batch)

            # the step, which is compiled when a stage begins
            with stage("compiling the step") if step == first else contextlib.nullcontext():
                current.state, metrics = train_step(
                    current.state, batch, run.body, part, run.networks, run.mesh
                )
            done = step + 1

            # whether the step before failed, or had too little room
            watch(done, metrics, functools.partial(bad_samples, loader, step))
            if watch.overflowed and part.splat.max_pairs != config.splat.max_pairs:
                part = with_twice_the_room(part, run.body)
                log.event(done, "room", f"{NO_ROOM}: there is twice the room from now on")

            # log lines, validations and checkpoints are due at intervals and at the end
            current.stopped = stopping(done)
            ending = current.stopped or done == run.end
            if ending or done % config.log_every == 0:
                broken = len(loader.source.broken)
                log.steps(done, jax.device_get(metrics), part.batch_size, current.waiting, broken)
            log.bar.update(1)

            validating = run.validations.people is not None and (
                done % config.validate_every == 0 or done == config.steps
            )
            if validating or ending or done % config.checkpoint_every == 0:
                variables = current.state.variables
                if run.mesh is not None:
                    variables = whole(variables, run.mesh)
                score = None
                if validating:
                    score = _validated(run, part, variables, examples, done, log)
                _save(run, current, part, variables, score)
            if current.stopped:
                return


def _validated(
    run: _Run,
    part: TrainConfig,
    variables: Variables,
    examples: list[Example],
    done: int,
    log: RunLog,
) -> float | None:
    """Validates the network after `done` steps, and reports metrics and images. Returns the psnr,
    which is the score of these variables, or None if it is NaN.

    part: configuration of the stage. examples: see `validation_examples`.
    """
    validations = run.validations
    numbers, images = validate(variables, validations.body, examples, part, validations.networks)
    if run.leading:
        _report(log, run.out, done, numbers, sheet(examples[:SHOWN], images[:SHOWN]))
    if math.isnan(numbers["psnr"]):
        return None
    return numbers["psnr"]


def _save(
    run: _Run,
    current: _Current,
    part: TrainConfig,
    variables: Variables,
    score: float | None,
) -> None:
    """Writes the weights and a checkpoint, and the best weights if `score` is the highest so far.

    part: configuration of the stage. score: see `_validated`; None: there was no validation.
    """
    # weights record the tokens that they were trained with
    model = part.model.with_conventions(tokens=part.model.tokens)
    if run.leading:
        save_weights(run.out / "weights.safetensors", variables, model, "float16")
    if score is not None and (current.best_score is None or score > current.best_score):
        current.best_score = score
        if run.leading:
            save_weights(run.out / "best.safetensors", variables, model, "float16")
    run.checkpoints.save(current.state, score)


def _rehearse(run: _Run, state: TrainState, step: int) -> None:
    """Traces a step of a later stage, so that sizes that do not fit raise before the run and not in
    the middle of it.
    """
    batch = stage_loader(run.people, run.config, step, run.mesh).batch_at(step)
    part = run.config.at(step)
    one = functools.partial(update, config=compiled_for(part), mesh=run.mesh)
    jax.eval_shape(one, state, batch, run.body, run.networks, seed_numbers(part.seed))


def _report(
    log: RunLog, out: Path, done: int, numbers: dict[str, float], image: Float[np.ndarray, "h w 3"]
) -> None:
    log.numbers(done, {f"val_{name}": value for name, value in numbers.items()}, "validation")
    write_png(out / "sheets" / f"{done:07d}.png", image, mark=DRAWN)
    log.image(done, "validation/sheet", image)

    def why(name, value):
        if value and name in DROPPED:
            return f" ({DROPPED[name]})"
        return ""

    say(
        f"step {done}: " + ", ".join(f"{name} {x:.4g}{why(name, x)}" for name, x in numbers.items())
    )


@contextlib.contextmanager
def stop_requested() -> Generator[Callable[[int], bool], None, None]:
    """Yields a function that takes the number of steps done and returns whether the run should stop
    now. All processes must call the function after every step.

    A single process stops after Ctrl-C or SIGTERM, and a second signal has its usual effect. It
    receives signals in its main thread only. Several processes stop after SIGTERM, which announces
    that a machine is taken away. They may receive it at different steps, so jax's coordination
    service agrees on a step
    (https://docs.jax.dev/en/latest/_autosummary/jax.experimental.multihost_utils.html).
    """
    if jax.process_count() > 1:
        from jax.experimental import multihost_utils

        yield multihost_utils.reached_preemption_sync_point
        return
    stop = threading.Event()

    def handle(number, _frame):
        if stop.is_set():
            signal.signal(number, previous[number])
            os.kill(os.getpid(), number)
            return
        # the handler stays: with that of the command line again, saving would have to be done
        # within seconds
        stop.set()
        logger.warning("stopping after this step; what is done is saved")

    # threads other than the main one may not handle signals
    caught = ()
    if threading.current_thread() is threading.main_thread():
        caught = (signal.SIGINT, signal.SIGTERM)
    previous = {number: signal.signal(number, handle) for number in caught}
    try:
        yield lambda _: stop.is_set()
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)
