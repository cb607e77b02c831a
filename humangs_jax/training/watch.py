"""Reports the steps of a run that failed."""

from typing import Any

import jax

from humangs_jax.training.log import RunLog
from humangs_jax.training.state import TrainState

MANY_SKIPPED = 20
"""Number of consecutive skipped steps that is reported."""


class Watch:
    """Reads every step's metrics one step late, so that the device is never idle, and reports failed steps."""

    def __init__(self, log: RunLog, state: TrainState):
        self._log, self._pending = log, None
        self._skipped, self._nonfinite = int(state.opt_state.skipped), int(state.opt_state.nonfinite)
        self._in_a_row = 0

    def __call__(self, done: int, metrics: dict[str, Any]) -> None:
        """The metrics of the step that was just begun; done: steps with it."""
        # one step may wait behind the one that runs: enough to keep a device busy, and the run reacts to a signal soon
        self.look()
        names = ("skipped", "nonfinite", "loss", "grad_norm")
        self._pending = done, {name: metrics[name] for name in names}

    def look(self) -> None:
        """At the step that waits."""
        if self._pending is None:
            return
        done, metrics = self._pending
        self._pending = None
        numbers = {name: float(value) for name, value in jax.device_get(metrics).items()}
        skipped, nonfinite = int(numbers["skipped"]), int(numbers["nonfinite"])
        was_skipped, was_nonfinite = skipped > self._skipped, nonfinite > self._nonfinite
        self._skipped, self._nonfinite = skipped, nonfinite
        self._in_a_row = self._in_a_row + 1 if was_skipped else 0
        if not (was_skipped or was_nonfinite):
            return
        text = f"loss {numbers['loss']:.4g}, gradient norm {numbers['grad_norm']:.4g}"
        if was_skipped:
            self._log.event(done, "skipped", f"skipped ({text}), {skipped} so far", **numbers)
        else:
            self._log.event(
                done, "nonfinite", f"gradient entries that were not finite were replaced ({text})", **numbers
            )
        if self._in_a_row == MANY_SKIPPED:
            advice = f"{MANY_SKIPPED} steps in a row were skipped: `humangs train --diagnose` names the first stage that fails"
            self._log.event(done, "stuck", advice)
