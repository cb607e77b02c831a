"""Searches for the result of `refine`: decides which photos are fitted, by how many iterations of
the learned update, and by how many steps.

With `HELD_OUT_PHOTOS` photos or more, trials come first. A trial leaves one photo out, and fits the
others. The PSNR on the photo that was left out says whether the iterations help, and how many of
the steps help. If the iterations do not help, they are tried without the photo of the largest loss,
which may contradict the others. Then the photos are fitted as the trials say. If there are no
steps, there are trials only if one photo fits much less than the others (`SUSPICIOUS`). Several
photos are left out in turn, see `photos_agree`. The photos that the avatar explains best before it
is refined come first, so that a photo that misleads is never the first.

With fewer photos, blocks of pixels are held out instead, and there are no trials. PSNR is measured
after small moves, see `losses.alignment`, because photos are seldom of one moment.
"""

import collections
import contextlib
import dataclasses
import time
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from typing import Any, NamedTuple, TypeVar, cast

import jax
import numpy as np

from humangs_jax.avatar.animate import (
    with_pixel_footprint,
    with_pixel_footprint_of,
    without_pixel_footprint,
)
from humangs_jax.avatar.avatar import Avatar
from humangs_jax.avatar.frames import posed
from humangs_jax.body.model import BodyPose
from humangs_jax.core.array_types import Array, Float, Int
from humangs_jax.core.arrays import from_host
from humangs_jax.core.compiled import compiled
from humangs_jax.core.processes import Ahead, Call
from humangs_jax.core.progress import bar as progress_bar
from humangs_jax.core.progress import compiling
from humangs_jax.core.pytree import replace
from humangs_jax.data.views import SubjectViews
from humangs_jax.losses.alignment import (
    ASKED,
    aligned_psnr,
    misplaced,
    moved_photo,
    photos_agree,
    smooth_moves,
)
from humangs_jax.losses.losses import LARGEST_PSNR
from humangs_jax.refinement.config import ITERATIONS, RefineConfig
from humangs_jax.refinement.learned import (
    Graph,
    calls_of_update,
    graph_like,
    graph_of,
    learned_update,
)
from humangs_jax.refinement.objective import (
    Comparison,
    Image,
    compare,
    drawn_photo,
    parameters_of,
)
from humangs_jax.refinement.photos import Photo, held_out_blocks, photo_order, photos_of
from humangs_jax.refinement.steps import RefineState, init_state, step
from humangs_jax.rendering.buffers import plan_buffers
from humangs_jax.rendering.gaussians import Gaussians, UnconstrainedGaussians
from humangs_jax.rendering.splat_config import SPLAT_PRESETS, SplatConfig

T = TypeVar("T")

HELD_OUT_PHOTOS = 4
"""With this number of photos or more, a trial holds out a whole photo, which no step of the trial
sees. With fewer, blocks of pixels are held out of each photo.
"""
TRIAL = 1 / 3
"""The part of all steps that trials make, as a share of all steps."""
ALLOWED_LOSS = 0.5
"""Decibels that steps may lose on a photo that is held out. Losing a little there is allowed,
because the final steps use this photo, too. With six validation people, steps lose up to 0.4 on the
photo, and steps on all photos gain at least 0.1 in other views of that pose.
"""
ALLOWED_LOSS_OF_ITERATIONS = 1.0
"""Decibels that the learned update may lose on a photo that is held out. One of eight test people
loses 0.2 on it, and gains 2.1 by iterations on all photos.
"""
SUSPICIOUS = 1.5
"""Iterations without steps need trials if the largest loss of a photo before refinement is at least
this many times the median loss. With right poses and masks, the ratio is 1.0 to 1.3 for eight of
nine people, and 1.55 for one. Half a mask makes 1.6, and a body that is turned by 10 degrees makes
2.1.
"""
STILL = 1.1e-3
"""Photos are moved if their distance from the avatar exceeds this share of the person's height. The
distance is the median over the photos of `misplaced`, between a photo and its image after
iterations on all photos. Photos of one moment have up to 0.0010 (ten synthetic people; loose
clothes have most). Bodies that are off by 1 cm in the mean have 0.0002 to 0.0020, and by 2 cm
0.0009 to 0.0037. If photos of one moment are moved, they lose up to 2 dB (`experiments
misaligned`).
"""
TIMED_STEPS = 3
"""Number of steps that are timed, to plan the number of steps of a run."""
OVERRUN = 1.5
"""A run ends early once it has taken this many times its seconds. Such a run cannot be repeated
exactly.
"""
BUFFER_MARGIN = 1.5
"""Factor on the buffers that the start needs, because Gaussians grow.

Buffers that are still too small are doubled.
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
"""Settings that no compiled program depends on, with the values for which programs are compiled."""


class Clock:
    """The clock of a run: its time without compilation, its number of steps, and its bar."""

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
        """Returns the seconds since the start of the run, without compilation."""
        return time.perf_counter() - self.began - self.compile_seconds

    @contextlib.contextmanager
    def compiling(self) -> Generator[None]:
        """Counts the time inside the context as compilation, not as refinement. Contexts may be
        nested.
        """
        before, began = self.compile_seconds, time.perf_counter()
        try:
            with compiling():
                yield
        finally:
            self.compile_seconds = before + time.perf_counter() - began

    def with_room(self, function: Callable[[SplatConfig], tuple[T, Any]], splat: SplatConfig) -> T:
        """Calls `function` with buffers that have room for everything, and returns its first
        result.

        function: takes a configuration with buffers; returns a result and the number of pairs that
        did not fit. The buffers are doubled until this number is 0.
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
        """Returns the number of steps of the run: the steps of the configuration, or as many as fit
        into its seconds if these are fewer. `TIMED_STEPS` calls of `one_step` measure the time of a
        step.

        The number is fixed before the first step, so the run can be repeated. ahead: seconds that
        other work will take.
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
            if self.limit is None:
                self.planned = fitting
            else:
                self.planned = min(self.limit, fitting)
        return self.planned

    def tick(self, shown: float) -> None:
        """Counts one finished step, moves the bar to `shown`, in [0, 1], and notes in `late`
        whether the run has taken too long.
        """
        self.done += 1
        self.show(shown)
        self.late = self.late or (
            self.seconds is not None and self.elapsed() > OVERRUN * self.seconds
        )

    def show(self, shown: float) -> None:
        """Moves the bar to `shown`, in [0, 1]."""
        self.bar.update(int(100 * shown) - self.bar.n)

    def stopped(self) -> float:
        """Closes the bar at the end of the run, and returns `elapsed`, seconds."""
        self.bar.update(100 - self.bar.n)
        self.bar.close()
        return self.elapsed()


class Task(NamedTuple):
    """The inputs of a run, which stay the same during its search."""

    avatar: Avatar
    """The avatar with the low-pass of the photos."""
    fresh: Avatar
    """The avatar from which the learned update starts. Its scales contain the low-pass of
    `Task.avatar` instead of the low-pass that the avatar came with.
    """
    given: list[Photo]
    """The photos as they were given, with all their pixels. They say whether a state is better."""
    photos: list[Photo]
    """The photos that are fitted, with all their pixels. They are `given`, or `given` after `align`
    has moved them.
    """
    seen: list[Photo]
    """The photos that are fitted, without the pixels that are held out."""
    graph: Graph | None
    """The graph of the learned update; None without iterations."""
    config: RefineConfig
    """The user's configuration."""
    settings: RefineConfig
    """The configuration that programs are compiled for, the same for runs of 5 s and of 15 s."""
    clock: Clock
    """The time and the number of steps of the run."""
    first: tuple["Candidate", float] | None = None
    """The result of iterations on all photos, and its mean loss on them. None if it is not known.
    """
    moved: bool = False
    """Whether the photos were moved, see `align`."""


class Candidate(NamedTuple):
    """A state of the Gaussians that a run has found."""

    state: RefineState
    """The state of the Gaussians."""
    iterations: int
    """How many iterations of the learned update the state has had."""
    used: Int[np.ndarray, " n"]
    """The indices of the photos to fit, (n,)."""
    kept: bool = True
    """Whether the state may be the result of the run. The result is the last such state."""


class _Trial(NamedTuple):
    """A fit that leaves out one photo, which then says whether the fit helps."""

    left_out: int
    """The index of the photo."""
    begin: Candidate
    """The state from which the steps of the trial begin."""


def prepare(
    avatar: Avatar, views: SubjectViews, config: RefineConfig, clock: Clock
) -> tuple[Task, Candidate, Comparison]:
    """Returns the task, the state at the start, and its comparison with each photo."""
    start = with_pixel_footprint_of(avatar, views)
    fresh = replace(avatar, gaussians=_fresh(avatar, start.gaussians.pixel_footprint))
    photos, held = list(photos_of(views)), np.zeros(views.masks.shape, bool)
    if len(photos) < HELD_OUT_PHOTOS:
        held = held_out_blocks(views.masks.shape, config.held_out, config.seed)
    seen = [
        replace(photo, counted=from_host(np.asarray(photo.counted) & ~h))
        for photo, h in zip(photos, held, strict=True)
    ]
    graph = None
    if config.iterations:
        graph = graph_of(np.asarray(start.gaussians.means))
    settings = dataclasses.replace(config, **HOST_SETTINGS)
    task = Task(start, fresh, photos, photos, seen, graph, config, settings, clock)
    parameters, splat = unconstrained(start.gaussians), planned(start, views)
    if graph is not None:
        Ahead().add(calls_of_update(parameters, start, seen, graph, splat))
    each = comparison(task, parameters, photos, splat)
    state = init_state(parameters, each.together(), settings, splat)
    return task, Candidate(state, 0, np.arange(len(photos))), each


def calls_of_photos(avatar: Avatar, views: SubjectViews) -> Iterator[Call]:
    """Yields the programs of iterations on these photos that take long to compile. `prepare` starts
    to compile the same programs.
    """
    start = with_pixel_footprint_of(avatar, views)
    parameters, graph = unconstrained(start.gaussians), graph_like(len(start.gaussians.means))
    photos = list(photos_of(views))
    yield from calls_of_update(parameters, start, photos, graph, planned(start, views))


@compiled()
def _fresh(avatar: Avatar, pixel_footprint: Float[Array, " g"] | None) -> Gaussians:
    """Returns the Gaussians of `Task.fresh`."""
    return with_pixel_footprint(
        without_pixel_footprint(avatar), cast(Array, pixel_footprint)
    ).gaussians


def planned(avatar: Avatar, views: SubjectViews) -> SplatConfig:
    """Returns the configuration with which the photos are drawn. Its buffers have room for
    `BUFFER_MARGIN` times what any of the photos needs.
    """
    poses = jax.vmap(BodyPose)(views.rotations, views.translations)
    configs = [
        plan_buffers(posed(avatar, pose), camera, SPLAT_PRESETS[avatar.rendering], BUFFER_MARGIN)
        for pose, camera in zip(poses, views.cameras, strict=True)
    ]
    most = {name: max(getattr(config, name) for config in configs) for name in BUFFERS}
    return dataclasses.replace(configs[0], visibility=True, **most)


# The search
# --------------------------------------------------------------------------------------------------


def align(task: Task, start: Candidate, each: Comparison) -> tuple[Task, Comparison]:
    """Moves the photos so that they show the person where the start draws the person. Returns the
    task with these photos, and the comparison of the start with each of them. If the photos agree,
    or if there are fewer than `ITERATIONS` iterations, it moves nothing, and returns `each`
    unchanged.

    Iterations fit photos of one moment to a small part of a pixel. If the person has moved from
    photo to photo, or a pose or a camera is off, the result of iterations lies between the photos.
    Then smooth moves bring the photos to the start, so that detail is fitted and not a blurred mean
    of the photos.
    """
    if task.config.iterations < ITERATIONS:  # fewer leave more than that
        return task, each
    first = iterated(task, start, start.used)
    photos = [_side_by_side(photo.image, photo.mask) for photo in task.photos]
    off = map(misplaced, images_of(task, first[0], task.photos), photos)
    if np.median(list(off)) < STILL:
        return task._replace(first=first), each
    moved, seen = [], []
    for image, photo, all, own in zip(
        images_of(task, start, task.photos), photos, task.photos, task.seen, strict=True
    ):
        there = moved_photo(photo, smooth_moves(image, photo))
        colors, mask = from_host(there[..., :3]), from_host(there[..., 3])
        moved.append(replace(all, image=colors, mask=mask))
        seen.append(replace(own, image=colors, mask=mask))
    each = comparison(task, start.state.parameters, moved, start.state.splat)
    return task._replace(photos=moved, seen=seen, moved=True), each


def compile_parts(task: Task, start: Candidate) -> Candidate:
    """Makes one iteration and one step, if the run has any, so that their programs are compiled.
    Returns the start, with buffers that have room for the step.
    """
    if task.config.iterations:
        updated(task, start, start.used, 1)
    if task.config.steps == 0:
        return start
    state = stepped(task, start.state, start.used[0])
    return start._replace(state=replace(start.state, splat=state.splat))


def search(task: Task, start: Candidate, each: Comparison) -> Iterator[Candidate]:
    """Yields the states that a run finds, in order. The last one that is `kept` is the result.
    each: the comparison of the start with each photo.
    """
    held_photo = len(task.photos) >= HELD_OUT_PHOTOS and task.config.held_out > 0
    method = _search_by_photo if held_photo else _search_by_blocks
    yield from method(task, start, np.asarray(each.loss))


def _search_by_blocks(
    task: Task, start: Candidate, losses: Float[np.ndarray, " v"]
) -> Iterator[Candidate]:
    """Yields the states of a search in which held-out pixels choose the best one.

    Where no pixels are held out, the loss on all pixels decides whether the iterations are kept,
    and the last state of the steps is kept. losses: the loss of the start on each photo.
    """
    hidden = [
        replace(all, counted=from_host(np.asarray(all.counted) & ~np.asarray(seen.counted)))
        for all, seen in zip(task.given, task.seen, strict=True)
    ]
    # a small crop may have no block to hold out
    any_hidden = any(np.asarray(photo.counted).any() for photo in hidden)
    best, highest = start, psnr_of(task, start, hidden)
    if task.config.iterations:
        found, loss = iterated(task, start, start.used)
        psnr = psnr_of(task, found, hidden)
        if any_hidden:
            better = psnr > highest
        else:
            better = loss < np.mean(losses)
        if better:
            best, highest = found, psnr
        yield best
    total = task.clock.plan(lambda: stepped(task, best.state, best.used[0]))
    for found in steps(task, best, best.used, total, total, (0.0, 1.0)):
        psnr = psnr_of(task, found, hidden)
        kept = psnr > highest or not any_hidden
        if kept:
            highest = psnr
        yield found._replace(kept=kept)


def _search_by_photo(
    task: Task, start: Candidate, losses: Float[np.ndarray, " v"]
) -> Iterator[Candidate]:
    """Yields the states of trials, which each leave one photo out, then the states of the final
    fit. The final fit has the photos, the iterations and the steps that helped in the trials.
    Without steps there are no trials, unless one photo contradicts the others. losses: the loss of
    the start on each photo.
    """
    clock = task.clock
    # iterations alone need no trial, unless one photo contradicts the others
    if task.config.steps == 0 and np.max(losses) < SUSPICIOUS * np.median(losses):
        clock.planned = 0
        yield iterated(task, start, np.arange(len(losses)))[0]
        return

    # whether the iterations help, and on which photos
    best, trials, ahead = _iterations_that_help(task, start, losses)
    used = best.used
    if best.iterations:
        yield best

    # how many of the steps help: the trials continue with an equal number of steps each
    first_photo = used[used != trials[0].left_out][0]
    total = clock.plan(lambda: stepped(task, best.state, first_photo), ahead)
    length = round(TRIAL * total / len(trials))
    gains = collections.defaultdict(list)
    for number, (left_out, begin) in enumerate(trials):
        before = psnr_of(task, begin, [task.given[left_out]])
        shown = TRIAL * number / len(trials), TRIAL * (number + 1) / len(trials)
        for found in steps(task, begin, used[used != left_out], length, length, shown):
            gain = psnr_of(task, found, [task.given[left_out]]) - before
            gains[int(found.state.done)].append(gain)
            yield found._replace(kept=False)
    share = _share_that_helps(gains, length)

    # the fit to all photos, with what helped
    begin = start
    if best.iterations:
        begin, _ = iterated(task, start, used)
        yield begin
    left = total - length * len(trials)
    yield from steps(task, begin, used, left, round(share * left), (TRIAL, 1.0))


def _iterations_that_help(
    task: Task, start: Candidate, losses: Float[np.ndarray, " v"]
) -> tuple[Candidate, list[_Trial], float]:
    """Tries whether the learned update helps, and on which photos. Returns three values:

    The state after the first trial's update. Its `used` are the photos on which the update helps.
    The trials, which the steps continue. The seconds that the update on all of `used` will take.

    The update is tried on all photos, then without the photo of the largest loss. If neither helps,
    or if there are no iterations, the state is the start, two trials begin at the start, and the
    seconds are 0.
    """
    asked = [int(view) for view in np.argsort(losses, kind="stable")[:ASKED]]
    all_photos = np.arange(len(losses))
    choices = []
    if task.config.iterations:
        choices = [all_photos, np.delete(all_photos, int(np.argmax(losses)))]
    for used in choices:
        began = task.clock.elapsed()
        trials = _trials_of_iterations(task, start, used, asked)
        if trials:
            # a trial has one photo fewer than the update that is still to come
            seconds_of_trial = (task.clock.elapsed() - began) / len(trials)
            ahead = seconds_of_trial * len(used) / (len(used) - 1)
            return trials[0].begin._replace(used=used), trials, ahead
    return start, [_Trial(view, start) for view in asked[:2]], 0.0


def _trials_of_iterations(
    task: Task, start: Candidate, used: Int[np.ndarray, " n"], asked: Sequence[int]
) -> list[_Trial]:
    """Returns trials of the learned update on the photos `used`; none if the update does not help.
    Each trial leaves out one of the photos `asked`, until it is certain whether the update helps.
    """
    trials = []

    def gains() -> Iterator[float]:
        """Yields the decibels that each photo gains when it is left out."""
        for view in asked:
            before = psnr_of(task, start, [task.given[view]])
            found, _ = iterated(task, start, used[used != view])
            trials.append(_Trial(view, found))
            yield psnr_of(task, found, [task.given[view]]) - before

    if photos_agree(gains(), -ALLOWED_LOSS_OF_ITERATIONS):
        return trials
    return []


def _share_that_helps(gains: Mapping[int, Sequence[float]], length: int) -> float:
    """Returns the largest share of the steps that helps, in [0, 1]; 1 if no step was tried.

    gains: for some numbers of steps of a trial, the decibels that the photos have gained after that
    number. length: the number of steps of a trial.
    """
    if length == 0:
        return 1.0
    helpful = [done for done, each in gains.items() if np.mean(each) > -ALLOWED_LOSS]
    return max(helpful, default=0) / length


def steps(
    task: Task,
    begin: Candidate,
    photos: Int[np.ndarray, " n"],
    total: int,
    end: int,
    shown: tuple[float, float],
) -> Iterator[Candidate]:
    """Makes the first `end` of `total` steps on some photos. Yields the state at each check and at
    the end. Ends early if the run takes too long (`OVERRUN`). shown: places of the progress bar
    before the first and after the last of the `total` steps, in [0, 1].
    """
    config, clock = task.config, task.clock
    share = 1.0
    if begin.iterations:
        share = min(1.0, config.full_steps / max(total, 1))
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
    """Returns the state after a step on one photo."""

    def stepped(splat: SplatConfig) -> tuple[RefineState, Array]:
        new = step(replace(state, splat=splat), task.seen[view], task.avatar, task.settings)
        return new, new.overflow

    return task.clock.with_room(stepped, state.splat)


def iterated(task: Task, start: Candidate, used: Int[np.ndarray, " n"]) -> tuple[Candidate, float]:
    """Returns the state after the learned update on some photos, and its mean loss on them."""
    if task.first is not None and len(used) == len(task.photos):
        return task.first
    parameters = updated(task, start, used, task.config.iterations)
    splat = start.state.splat
    found = comparison(task, parameters, [task.photos[i] for i in used], splat).together()
    state = init_state(parameters, found, task.settings, splat)
    return Candidate(state, task.config.iterations, used), float(found.loss)


def updated(
    task: Task, start: Candidate, used: Int[np.ndarray, " n"], iterations: int
) -> UnconstrainedGaussians:
    """Returns the parameters after `iterations` of the learned update on some photos."""
    fresh, photos = unconstrained(task.fresh.gaussians), [task.seen[i] for i in used]

    def updated(splat: SplatConfig) -> tuple[UnconstrainedGaussians, Array]:
        assert task.graph is not None
        return learned_update(fresh, task.avatar, photos, task.graph, iterations, splat)

    return task.clock.with_room(updated, start.state.splat)


def comparison(
    task: Task, parameters: UnconstrainedGaussians, photos: Sequence[Photo], splat: SplatConfig
) -> Comparison:
    """Returns the comparison of the Gaussians with each of the photos (leading axis v), as numpy
    arrays.
    """

    def compared(splat: SplatConfig) -> tuple[Comparison, int]:
        each = [compare(parameters, task.avatar, photo, task.settings, splat) for photo in photos]
        each = jax.tree.map(lambda *x: np.stack(x), *each)  # numbers for decisions on the host
        return each, int(np.sum(each.overflow))

    return task.clock.with_room(compared, splat)


def avatar_comparison(
    task: Task, avatar: Avatar, photos: Sequence[Photo], splat: SplatConfig
) -> Comparison:
    """Returns the comparison of an avatar with each of the photos, drawn with the avatar's own
    low-pass.
    """
    parameters = unconstrained(avatar.gaussians)
    return comparison(task._replace(avatar=avatar), parameters, photos, splat)


def psnr_of(task: Task, found: Candidate, photos: Sequence[Photo]) -> float:
    """Returns the mean `aligned_psnr` of a state, dB, over the photos that have pixels that count.
    It is `LARGEST_PSNR` if no photo has any.

    photos: as they were given. If `align` has moved the photos, each is moved here to what the
    state draws, because a photo that was moved to the start would favour the start.
    """
    scores = []
    for image, photo in zip(images_of(task, found, photos), photos, strict=True):
        counted = np.asarray(photo.counted)
        if not counted.any():
            continue
        shown = _side_by_side(photo.image, photo.mask)
        if task.moved:
            shown = moved_photo(shown, smooth_moves(image, shown))
        scores.append(aligned_psnr(image, shown, counted=counted))
    if scores:
        return float(np.mean(scores))
    return LARGEST_PSNR


def images_of(
    task: Task, found: Candidate, photos: Sequence[Photo]
) -> list[Float[np.ndarray, "h w 4"]]:
    """Returns the images of a state from the cameras of some photos. Each has colors and alpha, (h,
    w, 4).
    """
    parameters = found.state.parameters

    def drawn(splat: SplatConfig) -> tuple[list[Image], int]:
        splat = dataclasses.replace(splat, visibility=True)  # the program that comparisons have
        each = [drawn_photo(parameters, task.avatar, photo, splat) for photo in photos]
        overflow = sum(int(rendering.overflow) for _, _, rendering in each)
        return [image for image, _, _ in each], overflow

    return [_side_by_side(*image) for image in task.clock.with_room(drawn, found.state.splat)]


def _side_by_side(
    colors: Float[Array, "h w 3"], alpha: Float[Array, "h w"]
) -> Float[np.ndarray, "h w 4"]:
    return np.concatenate([np.asarray(colors), np.asarray(alpha)[..., None]], axis=-1)


unconstrained = compiled()(parameters_of)
"""`parameters_of` as a compiled program: the parameters that refinement moves."""
