"""The search of `refine`: which photos are fitted, by how many iterations of the learned update and
how many steps.

With `HELD_OUT_PHOTOS` photos or more, a search is made twice. The trial leaves one photo out and
asks it whether the iterations help, whether they help without the photo that fits least, and how
many of the steps do. Then all photos are fitted as the trial says. Iterations alone are tried only
if one photo fits much less than the others. The photo that is asked is the one that the avatar
explains best before it is refined: a photo that misleads is never asked.

With fewer photos, blocks of pixels are held out instead, and one search is made.
"""

import contextlib
import dataclasses
import time
from collections.abc import Callable, Generator, Iterator, Sequence
from typing import NamedTuple, TypeVar, cast

import jax
import jax.numpy as jnp
import numpy as np

from humangs_jax.avatar.animate import with_low_pass, with_low_pass_of, without_low_pass
from humangs_jax.avatar.avatar import Avatar
from humangs_jax.avatar.frames import posed
from humangs_jax.body.model import BodyPose
from humangs_jax.core.array_types import Array, Float, Int
from humangs_jax.core.progress import bar as progress_bar
from humangs_jax.core.progress import compiling
from humangs_jax.core.pytree import replace
from humangs_jax.data.views import SubjectViews
from humangs_jax.refinement.config import RefineConfig
from humangs_jax.refinement.learned import Graph, graph_of, learned_update
from humangs_jax.refinement.objective import Comparison, compare, parameters_of
from humangs_jax.refinement.photos import Photo, held_out_blocks, photo_order, photos_of
from humangs_jax.refinement.steps import RefineState, init_state, step
from humangs_jax.rendering.buffers import plan_buffers
from humangs_jax.rendering.gaussians import UnconstrainedGaussians
from humangs_jax.rendering.splat_config import SPLAT_PRESETS, SplatConfig

T = TypeVar("T")

HELD_OUT_PHOTOS = 4
"""With this number of photos or more, a whole photo is held out of a trial, not pixels of each:
views that no step sees.
"""
TRIAL = 1 / 3
"""Share of the steps that the trial makes."""
ALLOWED_LOSS = 0.5
"""Decibels that steps may lose on the photo that is held out: it lacks what they learn from it when
all photos are fitted. With six validation people they lose up to 0.4 there, and gain at least 0.1
in other views of that pose by all photos."""
ALLOWED_LOSS_OF_ITERATIONS = 1.0
"""Decibels, too, that the learned update may lose there: one of eight test people loses 0.2
and gains 2.1 by all.
"""
SUSPICIOUS = 1.5
"""Loss of the photo that fits least over the median, before refinement, from which on iterations
alone are tried first. With right poses and masks eight of nine people have 1.0 to 1.3, one 1.55.
Half a mask makes 1.6, a body that is turned by 10 degrees 2.1."""
TIMED_STEPS = 3
"""Steps that are timed to plan how many a run has."""
OVERRUN = 1.5
"""A run ends early, and cannot be repeated, where it takes this many times its seconds."""
BUFFER_MARGIN = 1.5
"""Room in the renderer's buffers beyond the need of the start: Gaussians grow.

Where it does not suffice, it is doubled.
"""
BUFFERS = ("max_pairs", "max_rows")
HOST_SETTINGS = {
    "iterations": 1,
    "steps": 1,
    "head_steps": 1,
    "seconds": None,
    "image_size": None,
    "held_out": 0.0,
    "full_steps": 1,
    "checks": 1,
    "seed": 0,
}
"""Settings that no compiled program depends on, with the values that programs are compiled for."""


class Clock:
    """The time of a run without compilation, its number of steps and its bar: all that a run
    keeps beside its states.
    """

    def __init__(self, config: RefineConfig, progress: bool = False):
        self.limit, self.seconds = config.steps, config.seconds
        self.began, self.compile_seconds = time.perf_counter(), 0.0
        self.done, self.planned, self.late = 0, None, False
        self.bar = progress_bar(
            total=100,
            desc="refine",
            unit="%",
            shown=progress,
            bar_format="{l_bar}{bar}| {elapsed}{postfix}",
        )

    def elapsed(self) -> float:
        """Seconds since the start, without compilation."""
        return time.perf_counter() - self.began - self.compile_seconds

    @contextlib.contextmanager
    def compiling(self) -> Generator[None]:
        """Time spent within counts as compilation, not as refinement. May be nested."""
        before, began = self.compile_seconds, time.perf_counter()
        try:
            with compiling():
                yield
        finally:
            self.compile_seconds = before + time.perf_counter() - began

    def with_room(
        self, function: Callable[[SplatConfig], tuple[T, Array]], splat: SplatConfig
    ) -> T:
        """The result of a function of buffers, which also returns what did not fit: they are
        doubled until all does.
        """
        result, overflow = function(splat)
        with self.compiling() if int(overflow) else contextlib.nullcontext():
            while int(overflow):
                splat = dataclasses.replace(
                    splat, **{name: 2 * getattr(splat, name) for name in BUFFERS}
                )
                result, overflow = function(splat)
        return result

    def plan(self, one_step: Callable[[], RefineState], ahead: float = 0.0) -> int:
        """How many steps the run has: those of the configuration, or as many as fit into its
        seconds, by the time of a few.

        A number that is fixed before the first step can be repeated. ahead: seconds that other work
        will take.
        """
        self.planned = self.limit or 0
        if self.seconds is not None and self.limit != 0:
            began = self.elapsed()
            for _ in range(TIMED_STEPS):
                jax.block_until_ready(one_step())
            now = self.elapsed()
            fitting = int(
                max(self.seconds - now - ahead, 0.0) * TIMED_STEPS / max(now - began, 1e-9)
            )
            self.planned = fitting if self.limit is None else min(self.limit, fitting)
        return self.planned

    def tick(self, shown: float) -> None:
        """A step is done. shown: where the bar is, in [0, 1]."""
        self.done += 1
        self.show(shown)
        self.late = self.late or (
            self.seconds is not None and self.elapsed() > OVERRUN * self.seconds
        )

    def show(self, shown: float) -> None:
        """Move the bar."""
        self.bar.update(int(100 * shown) - self.bar.n)

    def stopped(self) -> float:
        """`elapsed`, at the end of the run: closes the bar."""
        self.bar.update(100 - self.bar.n)
        self.bar.close()
        return self.elapsed()


class Task(NamedTuple):
    """What a run works with."""

    avatar: Avatar
    """The avatar with the low-pass of the photos."""
    fresh: Avatar
    """The same with the scales that the learned update was trained with: the low-pass that the
    avatar came with is undone.
    """
    photos: list[Photo]
    """The photos, with all their pixels."""
    seen: list[Photo]
    """The photos without the pixels that are held out."""
    graph: Graph | None
    """The graph of the learned update; None without iterations."""
    config: RefineConfig
    """The user's configuration."""
    settings: RefineConfig
    """The configuration that programs are compiled for, the same for runs of 5 s and of 15 s."""
    clock: Clock
    """The time and the number of steps of the run."""


class Found(NamedTuple):
    """What a run has found."""

    state: RefineState
    """The state of the Gaussians."""
    iterations: int
    """How many iterations of the learned update the state has had."""
    used: Int[np.ndarray, " n"]
    """The numbers of the photos to fit, (n,)."""
    kept: bool = True
    """Whether the state is the best so far."""


def prepare(
    avatar: Avatar, views: SubjectViews, config: RefineConfig, clock: Clock
) -> tuple[Task, Found, Comparison]:
    """The task, the start and its comparison with each photo."""
    start = with_low_pass_of(avatar, views)
    fresh = with_low_pass(without_low_pass(avatar), cast(Array, start.gaussians.low_pass))
    photos, held = list(photos_of(views)), np.zeros(views.masks.shape, bool)
    if len(photos) < HELD_OUT_PHOTOS:
        held = held_out_blocks(views.masks.shape, config.held_out, config.seed)
    seen = [
        replace(photo, counted=photo.counted & ~h) for photo, h in zip(photos, held, strict=True)
    ]
    graph = graph_of(np.asarray(start.gaussians.means)) if config.iterations else None
    settings = dataclasses.replace(config, **HOST_SETTINGS)
    task = Task(start, fresh, photos, seen, graph, config, settings, clock)
    parameters, splat = _parameters_of(start.gaussians), planned(start, views)
    each = comparison(task, parameters, photos, splat)
    state = init_state(parameters, each.together(), settings, splat)
    return task, Found(state, 0, np.arange(len(photos))), each


def planned(avatar: Avatar, views: SubjectViews) -> SplatConfig:
    """How photos are drawn, with buffers for all of them."""
    poses = jax.vmap(BodyPose)(views.rotations, views.translations)
    configs = [
        plan_buffers(posed(avatar, pose), camera, SPLAT_PRESETS[avatar.rendering], BUFFER_MARGIN)
        for pose, camera in zip(poses, views.cameras, strict=True)
    ]
    most = {name: max(getattr(config, name) for config in configs) for name in BUFFERS}
    return dataclasses.replace(configs[0], visibility=True, **most)


# The search
# --------------------------------------------------------------------------------------------------


def search(task: Task, start: Found, each: Comparison) -> Iterator[Found]:
    """What a run finds, one after the other: the last that is kept is its result. each:
    comparison of the start with photos.
    """
    with task.clock.compiling():  # each part once, so that it is compiled
        if task.config.steps != 0:
            start = start._replace(
                state=replace(start.state, splat=stepped(task, start.state, start.used[0]).splat)
            )
        if task.config.iterations:
            updated(task, start, start.used, 1)
    held_photo = len(task.photos) >= HELD_OUT_PHOTOS and task.config.held_out > 0
    yield from (search_by_photo if held_photo else search_by_blocks)(
        task, start, np.asarray(each.loss)
    )


def search_by_blocks(task: Task, start: Found, losses: Float[np.ndarray, " v"]) -> Iterator[Found]:
    """The held-out pixels choose the best state. Where there are none, the loss on all pixels
    decides on the iterations, and the last state of the steps is kept. losses: of the photos, at
    first.
    """
    hidden = [
        replace(all, counted=all.counted & ~seen.counted)
        for all, seen in zip(task.photos, task.seen, strict=True)
    ]
    # a small crop may have no block to hold out
    any_hidden = any(photo.counted.any() for photo in hidden)
    best, highest = start, psnr_of(task, start, hidden)
    if task.config.iterations:
        found, loss = iterated(task, start, start.used)
        psnr = psnr_of(task, found, hidden)
        better = psnr > highest if any_hidden else loss < np.mean(losses)
        if better:
            best, highest = found, psnr
        yield best
    total = task.clock.plan(lambda: stepped(task, best.state, best.used[0]))
    for found in steps(task, best, best.used, total, total, (0.0, 1.0)):
        psnr = psnr_of(task, found, hidden)
        kept = psnr > highest or not any_hidden
        highest = psnr if kept else highest
        yield found._replace(kept=kept)


def search_by_photo(task: Task, start: Found, losses: Float[np.ndarray, " v"]) -> Iterator[Found]:
    """A trial without one photo, then a fit of all photos as the trial says. losses: of the
    photos, at first.
    """
    config, clock, everybody = task.config, task.clock, np.arange(len(losses))
    # iterations alone need no trial, unless one photo contradicts the others
    if config.steps == 0 and np.max(losses) < SUSPICIOUS * np.median(losses):
        clock.planned = 0
        yield iterated(task, start, everybody)[0]
        return
    # the photo that fits best checks the others: it is surely right
    checked = int(np.argmin(losses))
    asked = [task.photos[checked]]
    best, before, began = start, psnr_of(task, start, asked), clock.elapsed()
    # iterations on all photos, or without the one that fits least
    for used in (
        (everybody, np.delete(everybody, int(np.argmax(losses)))) if config.iterations else ()
    ):
        found, _ = iterated(task, start, used[used != checked])
        psnr = psnr_of(task, found, asked)
        if psnr > before - ALLOWED_LOSS_OF_ITERATIONS:
            best, before = found._replace(used=used), psnr
            break
        began = clock.elapsed()
    used, others = best.used, best.used[best.used != checked]
    ahead = (
        (clock.elapsed() - began) * len(used) / len(others)
    )  # iterations with all photos are still to come
    if best.iterations:
        yield best
    # the trial: after which steps the photo that they do not see is still good
    total = clock.plan(lambda: stepped(task, best.state, others[0]), ahead)
    tried = round(TRIAL * total)
    share = 0.0 if tried else 1.0
    for found in steps(task, best, others, tried, tried, (0.0, TRIAL)):
        if psnr_of(task, found, asked) > before - ALLOWED_LOSS:
            share = int(found.state.done) / tried
        yield found._replace(kept=False)
    # the same share of the steps on all photos, from the start
    begin = start
    if best.iterations:
        begin, _ = iterated(task, start, used)
        yield begin
    yield from steps(task, begin, used, total - tried, round(share * (total - tried)), (TRIAL, 1.0))


def steps(
    task: Task,
    begin: Found,
    photos: Int[np.ndarray, " n"],
    total: int,
    end: int,
    shown: tuple[float, float],
) -> Iterator[Found]:
    """The first `end` of `total` steps on some photos: the state at each check and at the end.
    shown: from where to where the bar goes.
    """
    config, clock = task.config, task.clock
    share = min(1.0, config.full_steps / max(total, 1)) if begin.iterations else 1.0
    state = replace(begin.state, done=0, total=total, share=share)
    for done, view in enumerate(photo_order(photos, end, config.seed), 1):
        state = stepped(task, state, view)
        clock.tick(shown[0] + (shown[1] - shown[0]) * done / total)
        if (
            done * config.checks // total > (done - 1) * config.checks // total
            or done == end
            or clock.late
        ):
            yield begin._replace(state=state)
        if clock.late:
            return


# What it is made of: the pure functions of `steps`, `learned` and `objective`, with buffers in
# which all fits ------------


def stepped(task: Task, state: RefineState, view: int | np.integer) -> RefineState:
    """The state after a step on one photo."""

    def stepped(splat: SplatConfig) -> tuple[RefineState, Array]:
        new = step(replace(state, splat=splat), task.seen[view], task.avatar, task.settings)
        return new, new.overflow

    return task.clock.with_room(stepped, state.splat)


def iterated(task: Task, start: Found, used: Int[np.ndarray, " n"]) -> tuple[Found, float]:
    """The state after the learned update on some photos, and the loss on them."""
    parameters = updated(task, start, used, task.config.iterations)
    splat = start.state.splat
    found = comparison(task, parameters, [task.photos[i] for i in used], splat).together()
    state = init_state(parameters, found, task.settings, splat)
    return Found(state, task.config.iterations, used), float(found.loss)


def updated(
    task: Task, start: Found, used: Int[np.ndarray, " n"], iterations: int
) -> UnconstrainedGaussians:
    """The parameters after iterations of the learned update on some photos."""
    fresh, photos = _parameters_of(task.fresh.gaussians), [task.seen[i] for i in used]

    def updated(splat: SplatConfig) -> tuple[UnconstrainedGaussians, Array]:
        assert task.graph is not None
        return learned_update(fresh, task.avatar, photos, task.graph, iterations, splat)

    return task.clock.with_room(updated, start.state.splat)


def comparison(
    task: Task, parameters: UnconstrainedGaussians, photos: Sequence[Photo], splat: SplatConfig
) -> Comparison:
    """Comparison with each of the photos (leading axis v)."""

    def compared(splat: SplatConfig) -> tuple[Comparison, Array]:
        each = [compare(parameters, task.avatar, photo, task.settings, splat) for photo in photos]
        each = jax.tree.map(lambda *x: jnp.stack(x), *each)
        return each, jnp.sum(each.overflow)

    return task.clock.with_room(compared, splat)


def avatar_comparison(
    task: Task, avatar: Avatar, photos: Sequence[Photo], splat: SplatConfig
) -> Comparison:
    """`comparison` of an avatar with each of the photos, drawn with the low-pass that it has."""
    parameters = _parameters_of(avatar.gaussians)
    return comparison(task._replace(avatar=avatar), parameters, photos, splat)


def psnr_of(task: Task, found: Found, photos: Sequence[Photo]) -> float:
    """PSNR over what no step sees, dB."""
    return float(
        comparison(task, found.state.parameters, photos, found.state.splat).together().psnr
    )


_parameters_of = jax.jit(parameters_of)
