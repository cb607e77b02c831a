"""Records of a run: JSON lines, the same numbers for TensorBoard, and a progress bar.

out/log.jsonl       one object per line; {"step", "loss", ...} while training, {"step", "val_psnr", ...} from validations,
                    {"step", "event", ...} where something happened
out/tensorboard/    the numbers and the validation images, if tensorboardX is installed
"""

import contextlib
import json
import logging
import math
import time
from collections.abc import Callable, Generator
from pathlib import Path
from typing import Any

import jax
import numpy as np

from humangs_jax.core.progress import bar, say
from humangs_jax.data.loading import Waiting
from humangs_jax.io.atomic import write_text
from humangs_jax.io.reading import Refused, parse_json, read_text, reading
from humangs_jax.training.state import TrainState

logger = logging.getLogger("humangs_jax.training")
FLUSH_SECONDS = 10
MANY_SKIPPED = 20
"""Number of consecutive steps that is reported if all were skipped, or all had a gradient of 0."""


class RunLog:
    """The records of a run that continues after `step`: records of later steps, from a run that was killed, are dropped.

    recording: False in all processes but one; then nothing is written or shown.
    """

    def __init__(self, out: str | Path, step: int, total: int, recording: bool = True, progress: bool = True):
        shown = recording and progress
        self.bar = bar(shown=shown, total=total, initial=step, unit="step", dynamic_ncols=True, smoothing=0.05)
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

    def steps(self, done: int, metrics: dict[str, Any], subjects: int, waiting: Waiting, broken: int) -> None:
        """Numbers of the last step done. subjects: per step; seconds and samples a second are since the last line."""
        numbers = {name: float(value) for name, value in metrics.items()}
        before, began, waited = self._previous
        now = time.perf_counter()
        self._previous = (done, now, waiting.seconds)
        if (count := done - before) > 0:
            numbers["seconds_per_step"] = (now - began) / count
            numbers["samples_per_second"] = count * subjects / (now - began)
            numbers["data_seconds_per_step"] = (waiting.seconds - waited) / count
        if broken:
            numbers["broken_folders"] = broken
        self.numbers(done, numbers, "train")
        shown = {"loss": f"{numbers['loss']:.4f}", "psnr": f"{numbers['psnr']:.2f}"}
        if "samples_per_second" in numbers:
            shown["samples/s"] = f"{numbers['samples_per_second']:.2f}"
        self.bar.set_postfix(shown, refresh=False)

    def numbers(self, done: int, numbers: dict[str, float], group: str) -> None:
        """Numbers after a step, as a line and as curves "group/name"."""
        self._write({"step": done} | numbers)
        if self._board is not None:
            for name, value in numbers.items():
                self._board.add_scalar(f"{group}/{name}", value, done)

    def image(self, done: int, name: str, image: np.ndarray) -> None:
        """An (h, w, 3) image in [0, 1] for TensorBoard."""
        if self._board is not None:
            self._board.add_image(name, (255 * np.clip(image, 0, 1) + 0.5).astype(np.uint8), done, dataformats="HWC")

    def event(self, done: int, event: str, message: str, **details: float | list[str]) -> None:
        """Something worth knowing, as a line and beside the progress bar."""
        self._write({"step": done, "event": event} | details)
        if self._recording:
            say(f"step {done}: {message}")

    def _write(self, record: dict[str, Any]) -> None:
        if self._lines is not None:  # JSON has no NaN
            finite = lambda x: x if not isinstance(x, float) or math.isfinite(x) else None
            with _naming(self._lines.name):
                self._lines.write(json.dumps({name: finite(value) for name, value in record.items()}) + "\n")


class Watch:
    """Reads every step's metrics one step late, so that the device is never idle, and reports failed steps."""

    def __init__(self, log: RunLog, state: TrainState):
        self._log, self._pending = log, None
        self._counts = int(state.opt_state.skipped), int(state.opt_state.nonfinite)
        self._in_a_row = self._without_gradient = 0

    def __call__(self, done: int, metrics: dict[str, Any], bad_samples: Callable[[], list[str]] = list) -> None:
        """The metrics of the step that was just begun; done: steps with it. bad_samples: asked if it failed, see `sources`."""
        # one step may wait behind the one that runs: enough to keep a device busy, and the run reacts to a signal soon
        self.look()
        names = ("skipped", "nonfinite", "loss", "grad_norm")
        self._pending = done, {name: metrics[name] for name in names}, bad_samples

    def look(self) -> None:
        """Read the metrics of the pending step, and report it if it failed."""
        if self._pending is None:
            return
        (done, metrics, bad_samples), self._pending = self._pending, None
        numbers = {name: float(value) for name, value in jax.device_get(metrics).items()}
        counts = int(numbers["skipped"]), int(numbers["nonfinite"])
        skipped, replaced = (now > before for now, before in zip(counts, self._counts, strict=True))
        self._counts = counts
        self._in_a_row = self._in_a_row + 1 if skipped else 0
        self._without_gradient = self._without_gradient + 1 if numbers["grad_norm"] == 0 else 0
        if self._without_gradient == MANY_SKIPPED:
            advice = "no loss depends on a parameter any more; a learning rate that is too high does that"
            self._log.event(done, "stuck", f"{MANY_SKIPPED} steps in a row had a gradient of 0: {advice}")
        if skipped or replaced:
            samples = bad_samples()
            text = "; ".join([f"loss {numbers['loss']:.4g}, gradient norm {numbers['grad_norm']:.4g}", *samples])
            event = "skipped" if skipped else "nonfinite"
            what = f"skipped ({text}), {counts[0]} so far"
            if not skipped:
                what = f"gradient entries that were not finite were replaced ({text})"
            self._log.event(done, event, what, **numbers, **({"samples": samples} if samples else {}))
            if samples and jax.process_index():  # whose log is not written
                logger.warning("step %d: %s", done, text)
        if self._in_a_row == MANY_SKIPPED:
            advice = f"{MANY_SKIPPED} steps in a row were skipped: `humangs train --diagnose` names the first stage that fails"
            self._log.event(done, "stuck", advice)


def forget_after(path: Path, step: int) -> None:
    """Drop the lines of later steps, and a last line that was not written to its end; the file changes whole or not.

    Raises: FileError for a file that is no log: no text, too large, or with another line that is no record.
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
                    raise Refused(f"line {number}: expected an object with a step") from error
    write_text(path, "".join(f"{line}\n" for line in kept))


@contextlib.contextmanager
def _naming(path: Any) -> Generator[None]:
    """A full disk becomes an error that names the file."""
    try:
        yield
    except OSError as error:
        raise OSError(error.errno, error.strerror, str(path)) from error


def _tensorboard(folder: Path, step: int) -> Any:
    try:
        from tensorboardX import SummaryWriter
    except ImportError:  # optional: the log has the same numbers
        return None
    return SummaryWriter(str(folder), purge_step=step + 1, flush_secs=FLUSH_SECONDS)
