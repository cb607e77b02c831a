"""The training loop: the one place of this package's training with side effects.

out/config.json, out/checkpoints/    see `checkpoint`; a run continues from the newest one by itself
out/log.jsonl                        one line per `log_every` steps and per validation
out/sheets/STEP.png                  what the network shows of people it was not trained on
out/weights.safetensors              the newest weights (float16), averaged ones where `ema_decay` is set
out/best.safetensors                 those of the best validation
"""

import contextlib
import json
import logging
import signal
import threading
import time
from collections.abc import Generator, Sequence
from pathlib import Path

import jax

from humangs_jax.body.model import BodyModel
from humangs_jax.data.loader import CaptureCache, ExampleSource
from humangs_jax.data.views import gaussian_body
from humangs_jax.models.humangs import Variables
from humangs_jax.models.weights import save_weights
from humangs_jax.training.checkpoint import Checkpoints, save_config
from humangs_jax.training.config import TrainConfig
from humangs_jax.training.state import TrainState, init_state
from humangs_jax.training.step import train_step
from humangs_jax.training.validation import validate, validation_examples, write_sheet

logger = logging.getLogger(__name__)

VALIDATED = 8
"""Subjects that a validation looks at."""
SHOWN = 4
"""Subjects of those in the picture."""


def train(
    config: TrainConfig,
    body: BodyModel,
    training: Sequence[str | Path],
    out: str | Path,
    *,
    validation: Sequence[str | Path] = (),
    variables: Variables | None = None,
    stop_at: int | None = None,
    progress: bool = True,
) -> TrainState:
    """Train until `config.steps`, from the newest checkpoint in `out` if there is one.

    Arguments:
        body: the model that the captures' parameters belong to; made into the model's `gaussian_body` here.
        training, validation: capture folders; no validation without the latter.
        variables: where to start a new run, for instance shipped weights; None for fresh ones.
        stop_at: end after this step as if interrupted.
        progress: show a progress bar.

    Ctrl-C and SIGTERM finish the step, save and return; a second Ctrl-C interrupts at once.
    Raises: ValueError if `out` belongs to a run of another configuration, or no capture can be used.
    """
    out = Path(out)
    (out / "sheets").mkdir(parents=True, exist_ok=True)
    save_config(out, config)
    body = gaussian_body(body, config.model)
    size = config.model.image_size
    source = ExampleSource(
        CaptureCache(training, body), config.views, size, config.target_size, config.batch_size, config.seed
    )
    examples = validation_examples(CaptureCache(validation, body), config, VALIDATED) if validation else []

    checkpoints = Checkpoints(out / "checkpoints", config.keep_checkpoints)
    state = init_state(config, variables)
    best = None
    if checkpoints.steps:
        state, best_step = checkpoints.restore(state), checkpoints.best_step
        best = None if best_step is None else checkpoints.score(best_step)
    start, end = int(state.step), config.steps if stop_at is None else min(config.steps, stop_at)

    log = _Log(out / "log.jsonl")
    with _stop_on_signal() as stop, log, _bar(config.steps, start, progress) as bar:
        batches, pending = source.batches(start, end), None
        for step, batch in batches:
            state, metrics = train_step(state, batch, body, config)
            # one step may wait behind the one that runs: enough to keep a device busy, and a signal is obeyed soon
            jax.block_until_ready(pending)
            pending = metrics
            done = step + 1
            if done % config.log_every == 0 or done == end:
                numbers = log.write_step(done, metrics, broken=len(source.cache.broken))
                bar.set_postfix(loss=f"{numbers['loss']:.4f}", psnr=f"{numbers['psnr']:.2f}", refresh=False)
            bar.update(1)
            last, score = stop.is_set() or done == end, None
            if examples and (done % config.validate_every == 0 or done == config.steps):
                numbers, pictures = validate(state.variables, body, examples, config)
                log.write({"step": done} | {f"val_{name}": value for name, value in numbers.items()})
                write_sheet(out / "sheets" / f"{done:07d}.png", examples[:SHOWN], pictures[:SHOWN])
                bar.write(f"step {done}: " + ", ".join(f"{name} {value:.4g}" for name, value in numbers.items()))
                score = numbers["psnr"]
                if best is None or score > best:
                    best = score
                    save_weights(out / "best.safetensors", state.variables, config.model, "float16")
            if last or score is not None or done % config.checkpoint_every == 0:
                checkpoints.save(state, score)
                save_weights(out / "weights.safetensors", state.variables, config.model, "float16")
            if last:
                batches.close()
                break
    checkpoints.close()
    return state


class _Log:
    """JSON lines, appended; times are measured between the lines of steps."""

    def __init__(self, path):
        self._path = path

    def __enter__(self):
        self._file = open(self._path, "a", buffering=1)
        self._previous = None
        return self

    def __exit__(self, *_):
        self._file.close()

    def write(self, numbers):
        self._file.write(json.dumps(numbers) + "\n")

    def write_step(self, done, metrics, broken):
        numbers = {"step": done} | {name: float(value) for name, value in jax.device_get(metrics).items()}
        now = time.perf_counter()
        if self._previous is not None:
            steps, seconds = done - self._previous[0], now - self._previous[1]
            numbers["seconds_per_step"] = seconds / max(steps, 1)
        self._previous = (done, now)
        if broken:
            numbers["broken_folders"] = broken
        self.write(numbers)
        return numbers


def _bar(total, start, shown):
    from tqdm import tqdm

    return tqdm(total=total, initial=start, disable=not shown, unit="step", dynamic_ncols=True, smoothing=0.05)


@contextlib.contextmanager
def _stop_on_signal() -> Generator[threading.Event, None, None]:
    """An event that SIGINT and SIGTERM set; the second SIGINT is a KeyboardInterrupt again."""
    stop = threading.Event()
    if threading.current_thread() is not threading.main_thread():  # only the main thread may catch signals
        yield stop
        return

    def handle(number, _frame):
        stop.set()
        signal.signal(number, previous[number])
        logger.warning("stopping after this step; what is done is saved")

    previous = {number: signal.signal(number, handle) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield stop
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)
