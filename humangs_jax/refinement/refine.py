"""Refinement: the Gaussians of an avatar are fitted to its photos, by rounds of a learned update, then by Adam.

The learned update moves what no photo shows, too; Adam leaves it where it is. `refine` is the whole job on the host: it crops the
photos, sizes buffers, watches the clock and keeps the state with the highest PSNR on pixels that no step saw.
`refine_views` is Adam's part as one pure function of a fixed number of steps, for `jax.jit` and `jax.vmap`.
"""

import contextlib
import dataclasses
import functools
import inspect
import time
from collections.abc import Callable, Generator, Iterator
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from humangs_jax.avatar.avatar import Avatar
from humangs_jax.avatar.frames import posed
from humangs_jax.avatar.low_pass import with_low_pass, with_low_pass_of, without_low_pass
from humangs_jax.body.model import BodyPose
from humangs_jax.core.arguments import checked_arguments
from humangs_jax.core.array_types import Array, Float, Int, Scalar
from humangs_jax.core.compiler_options import compiler_options
from humangs_jax.core.progress import bar as progress_bar
from humangs_jax.data.capture import Capture
from humangs_jax.data.views import SubjectViews
from humangs_jax.objectives.metrics import decibels
from humangs_jax.refinement.config import SPLITS, RefineConfig
from humangs_jax.refinement.crops import crop_to_person, held_out_blocks
from humangs_jax.refinement.density import inner_errors, split, with_room, without_clear
from humangs_jax.refinement.learned import (
    MOST_PHOTOS,
    Graph,
    Refiner,
    Signals,
    colors_alone,
    graph_of,
    load_refiner,
    refiner_round,
    signals_from,
    squared_errors,
    stacked,
    unstacked,
)
from humangs_jax.refinement.objective import (
    Comparison,
    Image,
    Photos,
    PullBack,
    avatar_of,
    compare_photos,
    compared,
    comparison_of,
    drawn_photo,
    image_loss,
    photos_gradient,
    photos_of,
)
from humangs_jax.refinement.parameters import Parameters, RefineState, init_state, parameters_of, update
from humangs_jax.refinement.report import Refinement
from humangs_jax.rendering.splat_config import SPLAT_PRESETS, SplatConfig
from humangs_jax.rendering.splatting import Rendering, plan_buffers

HELD_OUT_PHOTOS = 8
"""With this number of photos or more, one photo is held out, not pixels of each: a test of views that no step sees."""
BUFFER_MARGIN = 1.5
"""Room in the renderer's buffers beyond the need of the start: Gaussians grow. What does not fit is counted, and the buffers
are planned again."""
FASTER_COMPILATION = {"xla_backend_optimization_level": 1}
"""On a CPU: compiles in 0.8 to 0.9 of the time of level 3, and the programs take the same time. Level 0: eight times."""
HOST_SETTINGS = {
    "rounds": 1,
    "steps": 1,
    "seconds": None,
    "image_size": None,
    "views_per_step": 1,
    "held_out": 0.0,
    "full_steps": 1,
    "checks": 1,
    "seed": 0,
}
"""Settings that no compiled program depends on, with the values that programs are compiled for."""
jax.tree_util.register_static(RefineConfig)  # here: its own module is imported by the command line, without JAX


@checked_arguments
def refine(
    avatar: Avatar,
    capture: Capture,
    config: RefineConfig | None = None,
    *,
    mesh: Mesh | None = None,
    progress: bool = False,
    watch: Callable[[Avatar], None] | None = None,
) -> Avatar:
    """The avatar, fitted to the photos of a capture; never worse on them than before. See `refine_with_report`."""
    return refine_with_report(avatar, capture, config, mesh=mesh, progress=progress, watch=watch).avatar


@checked_arguments
def refine_with_report(
    avatar: Avatar,
    capture: Capture,
    config: RefineConfig | None = None,
    *,
    mesh: Mesh | None = None,
    progress: bool = False,
    watch: Callable[[Avatar], None] | None = None,
) -> Refinement:
    """`refine`, with the number of steps, the seconds and the gain.

    Arguments:
        avatar: of the person in the photos, on the body of the capture. capture: photos with masks, in any poses. mesh: of one
            axis, whose devices share the `views_per_step` photos of a step. progress: show a bar. watch: gets the avatar so
            far after the rounds and at each of the `checks`; its time counts.

    Ctrl-C ends the run; the best state until then is returned.

    Views whose mask does not show the person are left out, see `usable_views`.

    Raises: ValueError if the capture has no view or no masks or no view that shows the person, its poses have another number of
    joints than the avatar, or the devices of the mesh do not divide `views_per_step`.
    """
    config = config or RefineConfig()
    _check(avatar, capture, config, mesh)
    views = crop_to_person(capture, config.image_size)
    start = with_low_pass_of(avatar, views)
    fresh = with_low_pass(without_low_pass(avatar), cast(Array, start.gaussians.low_pass))
    report = _Run(start, views, config, mesh, _planned(start, views), fresh).go(progress, watch)
    return report if report.kept else dataclasses.replace(report, avatar=avatar)


@checked_arguments
def refine_views(
    avatar: Avatar, views: SubjectViews, config: RefineConfig, splat: SplatConfig, steps: int
) -> tuple[Avatar, Int[Array, ""]]:
    """The pure function behind `refine`: `steps` steps of one photo each, in turns, on all their pixels.

    Static: config (its limits, rounds, `full_steps`, held-out pixels and `growth` are not used), splat (with `max_pairs`, see
    `plan_buffers`), steps. Returns the avatar and the (splat, tile) pairs that did not fit. Batch over people whose arrays have
    the same shapes with `jax.vmap(..., in_axes=(0, 0, None, None, None))`.
    """
    avatar, photos = with_low_pass_of(avatar, views), photos_of(views, jnp.ones(views.masks.shape, bool))
    state = start(avatar, photos, config, splat)

    def one(carry, i):
        state, overflow = carry
        photo = jax.tree.map(lambda x: x[i % len(views.images)][None], photos)
        state, _, missing = refine_step(state, avatar, photo, i / steps, config, splat)
        return (state, overflow + missing), None

    (state, overflow), _ = jax.lax.scan(one, (state, jnp.zeros((), jnp.int32)), jnp.arange(steps))
    return avatar_of(state.parameters, avatar), overflow


def start(avatar: Avatar, photos: Photos, config: RefineConfig, splat: SplatConfig) -> RefineState:
    """The state before the first step. Gaussians that no photo shows get no trust."""
    parameters = parameters_of(avatar.gaussians, len(photos.images), len(avatar.parents))
    return init_state(parameters, compare_photos(parameters, avatar, photos, config, splat).visibility, config)


def refine_step(
    state: RefineState,
    avatar: Avatar,
    photos: Photos,
    progress: Float[Array, ""] | float,
    config: RefineConfig,
    splat: SplatConfig,
) -> tuple[RefineState, Scalar, Int[Array, ""]]:
    """One step on some photos: state, loss before it, overflow. progress: how much of the run is over, in [0, 1]."""
    gradient, loss, overflow = photos_gradient(state.parameters, avatar, photos, config, splat)
    return update(state, gradient, progress, config), loss, overflow


class _Run:
    """What one call of `refine` works with.

    avatar: the one that is refined. fresh: the same with the scales that the rounds were trained with, without any low-pass.
    """

    def __init__(
        self,
        avatar: Avatar,
        views: SubjectViews,
        config: RefineConfig,
        mesh: Mesh | None,
        splat: SplatConfig,
        fresh: Avatar | None = None,
    ):
        self.avatar, self.config, self.mesh, self.splat = with_room(avatar, config.growth), config, mesh, splat
        self.original, self.fresh = avatar, with_room(fresh or avatar, config.growth)
        self.compile_seconds = 0.0
        self.compiled_for = dataclasses.replace(config, **HOST_SETTINGS)  # the same for runs of 5 s and of 15 s
        everything = jnp.ones(views.masks.shape, bool)
        count = len(views.images)
        if count >= HELD_OUT_PHOTOS and config.held_out:
            checked = jnp.zeros(count, bool).at[np.random.default_rng(config.seed).integers(count)].set(True)
            held = everything & checked[:, None, None]
        else:
            held = held_out_blocks(views, config.held_out, config.seed)
        self.all = photos_of(views, everything)
        self.seen, self.held = photos_of(views, ~held), photos_of(views, held)
        if mesh is not None:  # where each step leaves its results: other places would compile the step twice
            everywhere = NamedSharding(Mesh(mesh.devices, mesh.axis_names), PartitionSpec())
            self.avatar, self.fresh, self.all, self.seen, self.held = jax.device_put(
                (self.avatar, self.fresh, self.all, self.seen, self.held), everywhere
            )
        self.any_held = bool(np.asarray(held).any())  # a small crop may have no block to hold out
        self.useful = np.flatnonzero(np.asarray(~held).any(axis=(1, 2)))
        self.order = _order(self.useful, config.views_per_step, np.random.default_rng(config.seed))

    def go(self, progress: bool, watch: Callable[[Avatar], None] | None) -> Refinement:
        config, began = self.config, time.perf_counter()
        elapsed = lambda: time.perf_counter() - began - self.compile_seconds
        views, joints = len(self.all.images), len(self.avatar.parents)
        initial = jax.jit(parameters_of, static_argnums=(1, 2))
        with self.compiling():
            parameters = initial(self.avatar.gaussians, views, joints)
            before = self.compared(parameters, self.all)
            state = self.state(parameters, before)
            best, highest = (state, self.avatar), self.held_psnr(state)
        rounds, done, interrupted = 0, 0, False
        bar = progress_bar(total=100, desc="refine", unit="%", shown=progress, bar_format="{l_bar}{bar}| {elapsed}")
        try:
            with self.compiling():
                self.compile(state)
            if config.rounds:
                parameters = self.learned(initial(self.fresh.gaussians, views, joints), config.rounds)
                found = self.compared(parameters, self.all)
                if float(found.loss) < float(before.loss):
                    state, rounds = self.state(parameters, found), config.rounds
                    best, highest = (state, self.avatar), self.held_psnr(state)
                if watch is not None:
                    watch(avatar_of(state.parameters, self.avatar))
            checked, splits = 0, list(SPLITS) if config.growth > 1 else []
            now = first = elapsed()
            passed = self.passed(0, now)
            while passed < 1:
                if splits and passed >= splits[0]:
                    state, self.avatar = self.denser(state)
                    splits.pop(0)
                state = self.step(state, passed, self.share(done, now - first, first) if rounds else 1.0)
                done, now = done + 1, elapsed()
                passed = self.passed(done, now)
                if passed >= (checked + 1) / config.checks:
                    checked = int(passed * config.checks)
                    psnr = self.held_psnr(state)
                    if psnr > highest or not self.any_held:
                        best, highest = (state, self.avatar), psnr
                    if watch is not None:
                        watch(avatar_of(state.parameters, self.avatar))
                bar.update(int(100 * passed) - bar.n)
            bar.update(100 - bar.n)
        except KeyboardInterrupt:
            interrupted = True
        bar.close()
        seconds = elapsed()
        state, self.avatar = best
        after = self.compared(state.parameters, self.all)
        kept = float(after.loss) < float(before.loss)
        refined = self.original
        if kept:
            refined = avatar_of(state.parameters, self.avatar)
            refined = refined if config.growth == 1 else without_clear(refined, self.splat.alpha_min)
        if self.mesh is not None:  # back from all devices to the default one
            refined = jax.tree.map(jnp.asarray, jax.device_get(refined))
        pair = (before, after if kept else before)
        return Refinement(
            refined,
            rounds,
            done,
            seconds,
            self.compile_seconds,
            loss=(float(pair[0].loss), float(pair[1].loss)),
            psnr=(float(decibels(pair[0].squared)), float(decibels(pair[1].squared))),
            kept=kept,
            interrupted=interrupted,
        )

    def compile(self, state: RefineState) -> None:
        """Run each part of a run once, so that it is compiled."""
        if self.config.steps != 0:
            self.step(state, 0.0)
        if self.config.rounds:
            self.learned(state.parameters, 1)
        if self.config.growth > 1:
            self.denser(state)

    def step(self, state: RefineState, passed: float, share: float = 1.0) -> RefineState:
        """The state after one step, at a share of the rates."""
        chosen = next(self.order)
        find = self.gradient if self.mesh is None else self.shared_gradient
        return _compiled(update)(state, find(state.parameters, chosen), passed, self.compiled_for, share)

    def gradient(self, parameters: Parameters, chosen: np.ndarray) -> Parameters:
        """Gradient of the mean loss over some photos."""
        each = []
        for i in chosen:
            photo = _compiled(_chosen)(self.seen, i)
            image, pull_back, _ = self.drawn(parameters, photo)
            each.append(_compiled(_pulled)(pull_back, _compiled(_loss_gradient)(image, photo, self.compiled_for))[0])
        return each[0] if len(each) == 1 else jax.tree.map(lambda *x: sum(x) / len(x), *each)

    def shared_gradient(self, parameters: Parameters, chosen: np.ndarray) -> Parameters:
        """The same, with the photos divided among the devices."""
        gradient, overflow = self.drawn_by_all(parameters, chosen)
        if int(overflow):
            self.enlarge_buffers(parameters)
            gradient, _ = self.drawn_by_all(parameters, chosen)
        return gradient

    def drawn(self, parameters: Parameters, photo: Photos) -> tuple[Image, PullBack, Rendering]:
        """One photo; the buffers grow if the Gaussians no longer fit."""
        image, pull_back, rendering = self.drawn_once(parameters, photo)
        if int(rendering.overflow):
            self.enlarge_buffers(parameters)
            image, pull_back, rendering = self.drawn_once(parameters, photo)
        return image, pull_back, rendering

    def drawn_once(self, parameters: Parameters, photo: Photos) -> tuple[Image, PullBack, Rendering]:
        """One photo with the buffers as they are.

        Everything but steps on a mesh consists of this and `_pulled`, so that a run compiles one renderer and its transpose.
        """
        splat = dataclasses.replace(self.splat, visibility=True)
        return _compiled(drawn_photo)(parameters, self.avatar, photo, splat, self.config.poses)

    def drawn_by_all(self, parameters: Parameters, chosen: np.ndarray) -> tuple[Parameters, Int[Array, ""]]:
        """Gradient and overflow of some photos, shared by the devices of the mesh."""
        photos = _compiled(_chosen)(self.seen, chosen)
        gradient, _, overflow = _compiled(photos_gradient)(
            parameters, self.avatar, photos, self.compiled_for, self.splat, self.mesh
        )
        return gradient, overflow

    def enlarge_buffers(self, parameters: Parameters) -> None:
        """Room for the Gaussians as they are now."""
        with self.compiling():
            self.splat = _planned(avatar_of(parameters, self.avatar), self.all)
            image, pull_back, _ = self.drawn_once(parameters, _compiled(_chosen)(self.seen, 0))
            _compiled(_pulled)(pull_back, image)
            if self.mesh is not None:
                self.drawn_by_all(parameters, np.resize(self.useful, self.config.views_per_step))

    @contextlib.contextmanager
    def compiling(self) -> Generator[None]:
        """Time spent within counts as compilation, not as refinement. May be nested."""
        before, began = self.compile_seconds, time.perf_counter()
        try:
            yield
        finally:
            self.compile_seconds = before + time.perf_counter() - began

    @functools.cached_property
    def graph(self) -> Graph:
        """The graph of the avatar's own Gaussians."""
        return graph_of(np.asarray(self.original.gaussians.means))

    def learned(self, parameters: Parameters, rounds: int) -> Parameters:
        """The parameters after rounds of the learned update. Slots without a Gaussian (`growth`) stay empty."""
        count = len(self.original.gaussians.means)
        everything = stacked(parameters)
        start = values = everything[:count]
        hidden = jnp.zeros((count, Refiner.width))
        used = min(len(self.useful), MOST_PHOTOS)
        chosen = self.useful[np.arange(used) * len(self.useful) // used]
        for _ in range(rounds):
            each = [self.signals(parameters, int(i)) for i in chosen]
            signals = jax.tree.map(lambda *x: jnp.stack(x)[:, :count], *each)
            values, hidden = _compiled(refiner_round)(
                load_refiner(), values, start, hidden, signals, self.graph, self.original
            )
            parameters = unstacked(everything.at[:count].set(values), parameters)
        return parameters

    def signals(self, parameters: Parameters, view: int) -> Signals:
        """Signals of one photo."""
        photo = _compiled(_chosen)(self.seen, view)
        image, pull_back, rendering = self.drawn(parameters, photo)
        gradient, _ = _compiled(_pulled)(pull_back, _compiled(squared_errors)(image, photo))
        _, colors = _compiled(_pulled)(pull_back, _compiled(colors_alone)(image))
        return _compiled(signals_from)(gradient, colors, rendering, photo)

    def denser(self, state: RefineState) -> tuple[RefineState, Avatar]:
        """The state and the avatar after the Gaussians with the largest errors were split."""
        errors = jnp.zeros(len(state.trust))
        for i in range(len(self.seen.images)):
            photo = _compiled(_chosen)(self.seen, i)
            image, pull_back, _ = self.drawn(state.parameters, photo)
            errors += _compiled(_pulled)(pull_back, _compiled(inner_errors)(image, photo))[1]
        count = round((self.config.growth - 1) * len(self.original.gaussians.means) / len(SPLITS))
        return _compiled(split)(state, self.avatar, errors, count)

    def state(self, parameters: Parameters, found: Comparison) -> RefineState:
        """The state that Adam's steps start from, and are drawn back to."""
        return _compiled(init_state)(parameters, found.visibility, self.compiled_for)

    def compared(self, parameters: Parameters, photos: Photos) -> Comparison:
        """Comparison with the photos."""
        each = []
        for i in range(len(photos.images)):
            photo = _compiled(_chosen)(photos, i)
            image, _, rendering = self.drawn(parameters, photo)
            each.append(_compiled(compared)(image, rendering, photo, self.compiled_for))
        return _compiled(comparison_of)(jax.tree.map(lambda *x: jnp.stack(x), *each), photos)

    def held_psnr(self, state: RefineState) -> float:
        """PSNR over the pixels that no step sees, dB."""
        return float(decibels(self.compared(state.parameters, self.held).squared))

    def share(self, done: int, seconds: float, first: float) -> float:
        """Factor on the rates: `full_steps` over the number of steps that the run is expected to have, at most 1.

        It is 0 before the first step of a run that only `seconds` limits. seconds: taken by the `done` steps. first: taken
        before them.
        """
        ends: list[float] = [] if self.config.steps is None else [self.config.steps]
        if self.config.seconds is not None and done:
            ends.append(done * (self.config.seconds - first) / max(seconds, 1e-9))
        return min(1.0, self.config.full_steps / min(ends, default=np.inf))

    def passed(self, steps: int, seconds: float) -> float:
        """How much of the run is over, in [0, 1]."""
        limits = ((steps, self.config.steps), (seconds, self.config.seconds))
        return min(1.0, max(done / limit if limit else 1.0 for done, limit in limits if limit is not None))


def _chosen(photos, views):
    return jax.tree.map(lambda x: x[views], photos)


def _loss_gradient(image, photo, config):
    return jax.grad(image_loss)(image, photo, config)


def _pulled(pull_back, image):
    return pull_back(image)


def _order(views: np.ndarray, size: int, rng: np.random.Generator) -> Iterator[np.ndarray]:
    """Views of one step after the other: each round takes all of them in a new order."""
    waiting = np.zeros(0, int)
    while True:
        while len(waiting) < size:
            waiting = np.concatenate([waiting, rng.permutation(views)])
        yield waiting[:size]
        waiting = waiting[size:]


def _planned(avatar: Avatar, photos: SubjectViews | Photos) -> SplatConfig:
    """Buffers for all photos."""
    poses = jax.vmap(BodyPose)(photos.rotations, photos.translations)
    configs = [
        plan_buffers(posed(avatar, poses[i]), photos.cameras[i], SPLAT_PRESETS[avatar.rendering], BUFFER_MARGIN)
        for i in range(len(photos.images))
    ]
    most = lambda name: max(getattr(config, name) for config in configs)
    return dataclasses.replace(configs[0], max_pairs=most("max_pairs"), max_rows=most("max_rows"))


@functools.cache
def _compiled(function: Callable[..., Any]) -> Callable[..., Any]:
    static = [
        name for name in ("config", "splat", "mesh", "count", "poses") if name in inspect.signature(function).parameters
    ]
    options = compiler_options()
    return jax.jit(function, static_argnames=static, compiler_options=options and options | FASTER_COMPILATION)


def _check(avatar, capture, config, mesh):
    if capture.view_count == 0:
        raise ValueError("refine: the capture has 0 views; at least one photo is needed")
    if capture.masks is None:
        raise ValueError("refine: the capture has no masks; without them the background would be fitted, too")
    joints = capture.poses.rotations.shape[1]
    if joints != len(avatar.parents):
        raise ValueError(f"refine: the capture's poses have {joints} joints, the avatar has {len(avatar.parents)}")
    if mesh is not None and (len(mesh.axis_names) != 1 or config.views_per_step % mesh.size):
        raise ValueError(
            f"refine: views_per_step {config.views_per_step} cannot be divided among a mesh of {dict(mesh.shape)}"
        )
