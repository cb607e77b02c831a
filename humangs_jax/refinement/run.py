"""One run of `refine` on the host: it plans steps, tries them against a photo that they do not see, sizes buffers, keeps time.

With `HELD_OUT_PHOTOS` photos or more, a run is made twice. The trial leaves one photo out and asks it whether the iterations
help, whether they help without the photo that fits least, and how many of the steps do. Then all photos are fitted as the trial
says. Rounds alone are tried only if one photo fits much less than the others.
The photo that is asked is the one that the avatar explains best before it is refined: a photo that misleads is never asked.

With fewer photos, blocks of pixels are held out instead, and one run is made.
"""

import time
from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from humangs_jax.avatar.avatar import Avatar
from humangs_jax.core.array_types import Float
from humangs_jax.core.progress import bar as progress_bar
from humangs_jax.losses.metrics import decibels
from humangs_jax.refinement.objective import avatar_of, comparison_of
from humangs_jax.refinement.operations import Operations, only
from humangs_jax.refinement.parameters import RefineState
from humangs_jax.refinement.report import Refinement

TRIAL = 1 / 3
"""Share of the steps that the trial makes."""
ALLOWED_LOSS = 0.1
"""Decibels that steps may lose on the photo that is held out: it lacks what they learn from it when all photos are fitted."""
ALLOWED_LOSS_OF_ROUNDS = 1.0
"""Decibels, likewise, that the learned update may lose there: one of eight test people loses 0.2 and gains 2.1 by all."""
SUSPICIOUS = 1.5
"""Loss of the photo that fits least over the median, before refinement, from which on iterations alone are tried first. With
right poses and masks eight of nine people have 1.0 to 1.3, one 1.55. Half a mask makes 1.6, a body that is turned by 10 degrees
2.1."""
TIMED_STEPS = 3
"""Steps that are timed to plan how many a run has."""
OVERRUN = 1.5
"""A run ends early, and cannot be repeated, where it takes this many times its seconds."""


class Found(NamedTuple):
    """A state, and how many rounds it has had."""

    state: RefineState
    iterations: int


class Trial(NamedTuple):
    """What a trial says. used: the photos to fit. iterations: how many of the learned update. share: of the steps."""

    used: np.ndarray
    iterations: int
    share: float


class Run(Operations):
    """One call of `refine`. best: what it would return now."""

    def go(
        self, progress: bool, watch: Callable[[Avatar], None] | None, names: Sequence[str] | None = None
    ) -> Refinement:
        """Make the run. names: of the photos; None: numbers."""
        self.began, self.watch, self.done, self.late = time.perf_counter(), watch, 0, False
        self.bar = progress_bar(
            total=100, desc="refine", unit="%", shown=progress, bar_format="{l_bar}{bar}| {elapsed}"
        )
        with self.compiling():
            self.start = self.initial(self.avatar)
            each = self.compared(self.start, self.all)
            self.best = Found(self.state(self.start, comparison_of(each, self.all)), 0)
        steps, interrupted = None, False
        trial = Trial(self.useful, self.config.iterations, 1.0)
        try:
            with self.compiling():
                self.compile(self.best.state)
            if self.whole:
                steps, trial = self.run_with_trial(np.asarray(each.loss))
            else:
                steps = self.run_with_blocks(float(jnp.mean(each.loss)))
        except KeyboardInterrupt:
            interrupted = True
        self.bar.update(100 - self.bar.n)
        self.bar.close()
        seconds = self.elapsed()
        state, iterations = self.best
        fitted, everybody = only(self.all, trial.used), [str(i) for i in range(len(self.all.images))]
        before, after = (
            comparison_of(x, fitted) for x in (only(each, trial.used), self.compared(state.parameters, fitted))
        )
        kept = float(after.loss) < float(before.loss)
        refined = avatar_of(state.parameters, self.avatar) if kept else self.avatar
        if self.mesh is not None:  # back from all devices to the default one
            refined = jax.tree.map(jnp.asarray, jax.device_get(refined))
        pair = (before, after if kept else before)
        return Refinement(
            refined,
            iterations,
            self.done,
            seconds,
            self.compile_seconds,
            loss=(float(pair[0].loss), float(pair[1].loss)),
            psnr=(float(decibels(pair[0].squared)), float(decibels(pair[1].squared))),
            kept=kept,
            interrupted=interrupted,
            planned=None if interrupted or self.late else steps,
            left_out=tuple((names or everybody)[i] for i in range(len(everybody)) if i not in trial.used),
        )

    def run_with_blocks(self, loss: float) -> int:
        """A run whose best state the held-out pixels choose. loss: before it. Returns the number of steps that were planned."""
        highest = self.held_psnr(self.start)
        if self.config.iterations:
            found, reached = self.after_iterations()
            if reached < loss:
                self.best, highest = found, self.held_psnr(found.state.parameters)
            self.show(self.best)
        planned = self.planned_steps(0.0)
        for _, found in self.steps(self.best, planned, planned, (0.0, 1.0)):
            psnr = self.held_psnr(found.state.parameters)
            if psnr > highest or not self.any_held:
                self.best, highest = found, psnr
            self.show(found)
        return planned

    def run_with_trial(self, losses: Float[np.ndarray, " v"]) -> tuple[int, Trial]:
        """A trial without one photo, then a run with all photos as the trial says. losses: of the photos, before it.

        Returns the number of steps that were planned, and what the trial said.
        """
        checked, everybody = int(np.argmin(losses)), np.arange(len(losses))
        if self.iterations_alone and np.max(losses) < SUSPICIOUS * np.median(losses):
            self.best = self.after_iterations()[0]
            self.show(self.best)
            return 0, Trial(everybody, self.best.iterations, 1.0)
        self.held = only(self.all, [checked])
        start, used, before, began = self.best, everybody, self.held_psnr(self.start), self.elapsed()
        for photos in (everybody, np.delete(everybody, int(np.argmax(losses)))) if self.config.iterations else ():
            self.use(photos[photos != checked])
            found, _ = self.after_iterations()
            psnr = self.held_psnr(found.state.parameters)
            if psnr > before - ALLOWED_LOSS_OF_ROUNDS:
                self.best, before, used = found, psnr, photos
                break
            began = self.elapsed()
        # iterations with all photos are still to come
        ahead = (self.elapsed() - began) * len(used) / (len(used) - 1)
        self.use(used[used != checked])
        planned = self.planned_steps(ahead)
        tried = round(TRIAL * planned)
        share = 0.0 if tried else 1.0
        for done, found in self.steps(self.best, tried, tried, (0.0, TRIAL)):
            if self.held_psnr(found.state.parameters) > before - ALLOWED_LOSS:
                share = done / tried
            self.show(found)
        trial = Trial(used, self.best.iterations, share)
        self.use(used)
        begin = start
        if trial.iterations:
            self.best = begin = self.after_iterations()[0]
            self.show(begin)
        rest = planned - tried
        for _, found in self.steps(begin, rest, round(share * rest), (TRIAL, 1.0)):
            self.best = found
            self.show(found)
        return planned, trial

    @property
    def iterations_alone(self) -> bool:
        """Whether no steps are to follow."""
        return self.config.iterations > 0 and self.config.steps == 0

    def after_iterations(self) -> tuple[Found, float]:
        """The state after the iterations, on the photos in use, and the loss on them."""
        parameters, photos = self.learned(self.initial(self.fresh), self.config.iterations), only(self.all, self.useful)
        found = comparison_of(self.compared(parameters, photos), photos)
        return Found(self.state(parameters, found), self.config.iterations), float(found.loss)

    def steps(self, begin: Found, total: int, end: int, shown: tuple[float, float]) -> Iterator[tuple[int, Found]]:
        """The first `end` of `total` steps: how many are done, and the state, at each check and at the end.

        shown: from where to where the bar goes.
        """
        config = self.config
        self.use(self.useful)  # the order of the photos begins again
        state, iterations = begin
        share = min(1.0, config.full_steps / max(total, 1)) if iterations else 1.0
        for done in range(1, end + 1):
            passed = (done - 1) / total
            state = self.step(state, passed, share)
            self.done += 1
            self.bar.update(int(100 * (shown[0] + (shown[1] - shown[0]) * done / total)) - self.bar.n)
            self.late = self.late or (config.seconds is not None and self.elapsed() > OVERRUN * config.seconds)
            if done * config.checks // total > (done - 1) * config.checks // total or done == end or self.late:
                yield done, Found(state, iterations)
            if self.late:
                return

    def planned_steps(self, ahead: float) -> int:
        """How many steps the run has: those of the configuration, or as many as fit into its seconds, by the time of a few.

        A number that is fixed before the first step can be repeated. ahead: seconds that other work will take.
        """
        limit, seconds = self.config.steps, self.config.seconds
        if seconds is None or limit == 0:
            return limit or 0
        began = self.elapsed()
        for _ in range(TIMED_STEPS):
            jax.block_until_ready(self.step(self.best.state, 0.0))
        now = self.elapsed()
        fitting = int(max(seconds - now - ahead, 0.0) * TIMED_STEPS / max(now - began, 1e-9))
        return fitting if limit is None else min(limit, fitting)

    def show(self, found: Found) -> None:
        """Let whoever watches see a state."""
        if self.watch is not None:
            self.watch(avatar_of(found.state.parameters, self.avatar))
