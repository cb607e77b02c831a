"""What a run of `refine` does on the host: draw a photo, take a step or iterations, compare, with buffers that grow as they must.

Everything but steps on a mesh consists of the same few compiled programs, one photo at a time.
"""

import contextlib
import dataclasses
import functools
import inspect
import time
from collections.abc import Callable, Generator, Iterator, Sequence
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from humangs_jax.avatar.avatar import Avatar
from humangs_jax.avatar.frames import posed
from humangs_jax.body.model import BodyPose
from humangs_jax.core.array_types import Array, Int
from humangs_jax.core.compiling import compiler_options
from humangs_jax.core.pytree import replace
from humangs_jax.data.views import SubjectViews
from humangs_jax.losses.metrics import decibels
from humangs_jax.refinement.config import RefineConfig
from humangs_jax.refinement.crops import held_out_blocks
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
    compared,
    comparison_of,
    drawn_photo,
    image_loss,
    photos_gradient,
    photos_of,
)
from humangs_jax.refinement.parameters import Parameters, RefineState, init_state, parameters_of, update
from humangs_jax.rendering.splat_config import SPLAT_PRESETS, SplatConfig
from humangs_jax.rendering.splatting import Rendering, plan_buffers

T = TypeVar("T", Photos, Comparison)

HELD_OUT_PHOTOS = 4
"""With this number of photos or more, a whole photo is held out of a trial, not pixels of each: views that no step sees."""
BUFFER_MARGIN = 1.5
"""Room in the renderer's buffers beyond the need of the start: Gaussians grow. What does not fit is counted, and the buffers
are planned again."""
BUFFERS = ("max_pairs", "max_rows")
FASTER_COMPILATION = {"xla_backend_optimization_level": 1}
"""On a CPU: compiles in 0.8 to 0.9 of the time of level 3, and the programs take the same time. Level 0: eight times."""
HOST_SETTINGS = {
    "iterations": 1,
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


class Operations:
    """What one call of `refine` works with.

    avatar: the one that is refined. fresh: the same with the scales that the iterations were trained with, without any low-pass.
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
        self.avatar, self.config, self.mesh, self.splat = avatar, config, mesh, splat
        self.fresh = fresh or avatar
        self.began, self.compile_seconds = time.perf_counter(), 0.0
        self.compiled_for = dataclasses.replace(config, **HOST_SETTINGS)  # the same for runs of 5 s and of 15 s
        everything = jnp.ones(views.masks.shape, bool)
        self.whole = len(views.images) >= HELD_OUT_PHOTOS and config.held_out > 0
        held = ~everything if self.whole else held_out_blocks(views, config.held_out, config.seed)
        self.all = photos_of(views, everything)
        self.seen, self.held = photos_of(views, ~held), photos_of(views, held)
        if mesh is not None:  # where each step leaves its results: other places would compile the step twice
            everywhere = NamedSharding(Mesh(mesh.devices, mesh.axis_names), PartitionSpec())
            self.avatar, self.fresh, self.all, self.seen, self.held = jax.device_put(
                (self.avatar, self.fresh, self.all, self.seen, self.held), everywhere
            )
        self.any_held = bool(np.asarray(held).any())  # a small crop may have no block to hold out
        self.use(np.flatnonzero(np.asarray(~held).any(axis=(1, 2))))

    def use(self, photos: np.ndarray) -> None:
        """From now on iterations and steps see these photos, in the order of the seed."""
        self.useful = photos
        self.order = _order(photos, self.config.views_per_step, np.random.default_rng(self.config.seed))

    def elapsed(self) -> float:
        """Seconds since the start, without compilation."""
        return time.perf_counter() - self.began - self.compile_seconds

    def initial(self, avatar: Avatar) -> Parameters:
        """The parameters of an avatar."""
        return jax.jit(parameters_of, static_argnums=(1, 2))(
            avatar.gaussians, len(self.all.images), len(avatar.parents)
        )

    def compile(self, state: RefineState) -> None:
        """Run each part of a run once, so that it is compiled."""
        if self.config.steps != 0:
            self.step(state, 0.0)
        if self.config.iterations:
            self.learned(state.parameters, 1)

    def step(self, state: RefineState, passed: float, share: float = 1.0) -> RefineState:
        """The state after one step, at a share of the rates."""
        chosen = next(self.order)
        find = self.gradient if self.mesh is None else self.shared_gradient
        return compiled(update)(state, find(state.parameters, chosen), passed, self.compiled_for, share)

    def gradient(self, parameters: Parameters, chosen: np.ndarray) -> Parameters:
        """Gradient of the mean loss over some photos."""
        each = []
        for i in chosen:
            photo = compiled(_chosen)(self.seen, i)
            image, pull_back, _ = self.drawn(parameters, photo)
            each.append(compiled(_pulled)(pull_back, compiled(_loss_gradient)(image, photo, self.compiled_for))[0])
        return each[0] if len(each) == 1 else jax.tree.map(lambda *x: sum(x) / len(x), *each)

    def shared_gradient(self, parameters: Parameters, chosen: np.ndarray) -> Parameters:
        """The same, with the photos divided among the devices."""
        gradient, overflow = self.drawn_by_all(parameters, chosen)
        while int(overflow):
            self.enlarge_buffers(parameters)
            gradient, overflow = self.drawn_by_all(parameters, chosen)
        return gradient

    def drawn(self, parameters: Parameters, photo: Photos) -> tuple[Image, PullBack, Rendering]:
        """One photo; the buffers grow if the Gaussians no longer fit."""
        image, pull_back, rendering = self.drawn_once(parameters, photo)
        while int(rendering.overflow):
            self.enlarge_buffers(parameters)
            image, pull_back, rendering = self.drawn_once(parameters, photo)
        return image, pull_back, rendering

    def drawn_once(self, parameters: Parameters, photo: Photos) -> tuple[Image, PullBack, Rendering]:
        """One photo with the buffers as they are.

        Everything but steps on a mesh consists of this and `_pulled`, so that a run compiles one renderer and its transpose.
        """
        splat = dataclasses.replace(self.splat, visibility=True)
        return compiled(drawn_photo)(parameters, self.avatar, photo, splat, self.config.poses)

    def drawn_by_all(self, parameters: Parameters, chosen: np.ndarray) -> tuple[Parameters, Int[Array, ""]]:
        """Gradient and overflow of some photos, shared by the devices of the mesh."""
        photos = compiled(_chosen)(self.seen, chosen)
        gradient, _, overflow = compiled(photos_gradient)(
            parameters, self.avatar, photos, self.compiled_for, self.splat, self.mesh
        )
        return gradient, overflow

    def enlarge_buffers(self, parameters: Parameters) -> None:
        """Room for the Gaussians as they are now, in the corrected poses. It is more than there was."""
        with self.compiling():
            photos, index, before = self.all, self.all.index, self.splat
            photos = replace(
                photos,
                rotations=photos.rotations + parameters.rotations[index],
                translations=photos.translations + parameters.translations[index],
            )
            self.splat = planned(avatar_of(parameters, self.avatar), photos)
            if not _larger(self.splat, before):  # counted a little differently than drawn
                self.splat = dataclasses.replace(before, **{name: 2 * getattr(before, name) for name in BUFFERS})
            image, pull_back, _ = self.drawn_once(parameters, compiled(_chosen)(self.seen, 0))
            compiled(_pulled)(pull_back, image)
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
        return graph_of(np.asarray(self.avatar.gaussians.means))

    def learned(self, parameters: Parameters, iterations: int) -> Parameters:
        """The parameters after iterations of the learned update."""
        start = values = stacked(parameters)
        hidden = jnp.zeros((len(values), Refiner.width))
        used = min(len(self.useful), MOST_PHOTOS)
        chosen = self.useful[np.arange(used) * len(self.useful) // used]
        for _ in range(iterations):
            each = [self.signals(parameters, int(i)) for i in chosen]
            signals = jax.tree.map(lambda *x: jnp.stack(x), *each)
            values, hidden = compiled(refiner_round)(
                load_refiner(), values, start, hidden, signals, self.graph, self.avatar
            )
            parameters = unstacked(values, parameters)
        return parameters

    def signals(self, parameters: Parameters, view: int) -> Signals:
        """Signals of one photo."""
        photo = compiled(_chosen)(self.seen, view)
        image, pull_back, rendering = self.drawn(parameters, photo)
        gradient, _ = compiled(_pulled)(pull_back, compiled(squared_errors)(image, photo))
        _, colors = compiled(_pulled)(pull_back, compiled(colors_alone)(image))
        return compiled(signals_from)(gradient, colors, rendering, photo)

    def state(self, parameters: Parameters, found: Comparison) -> RefineState:
        """The state that Adam's steps start from, and are drawn back to."""
        return compiled(init_state)(parameters, found.visibility, self.compiled_for)

    def compared(self, parameters: Parameters, photos: Photos) -> Comparison:
        """Comparison with each of the photos (leading axis v)."""
        each = []
        for i in range(len(photos.images)):
            photo = compiled(_chosen)(photos, i)
            image, _, rendering = self.drawn(parameters, photo)
            each.append(compiled(compared)(image, rendering, photo, self.compiled_for))
        return jax.tree.map(lambda *x: jnp.stack(x), *each)

    def held_psnr(self, parameters: Parameters) -> float:
        """PSNR over what no step sees, dB."""
        return float(decibels(comparison_of(self.compared(parameters, self.held), self.held).squared))


def only(photos: T, chosen: Sequence[int] | np.ndarray) -> T:
    """Some of the photos, or of what was found about each."""
    return jax.tree.map(lambda x: x[np.asarray(chosen)], photos)


def _larger(splat, before):
    return any(getattr(splat, name) > getattr(before, name) for name in BUFFERS)


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


def planned(avatar: Avatar, photos: SubjectViews | Photos) -> SplatConfig:
    """Buffers for all photos."""
    poses = jax.vmap(BodyPose)(photos.rotations, photos.translations)
    configs = [
        plan_buffers(posed(avatar, poses[i]), photos.cameras[i], SPLAT_PRESETS[avatar.rendering], BUFFER_MARGIN)
        for i in range(len(photos.images))
    ]
    most = {name: max(getattr(config, name) for config in configs) for name in BUFFERS}
    return dataclasses.replace(configs[0], **most)


@functools.cache
def compiled(function: Callable[..., Any]) -> Callable[..., Any]:
    """The function, jitted; settings are static."""
    static = [
        name for name in ("config", "splat", "mesh", "count", "poses") if name in inspect.signature(function).parameters
    ]
    options = compiler_options()
    return jax.jit(function, static_argnames=static, compiler_options=options and options | FASTER_COMPILATION)
