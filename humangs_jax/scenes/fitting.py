"""`fit_scene`: Gaussians of a scene from posed photos, with Adam and the strategy of `scenes.mcmc`.

A scene is an explicit state; a step and a relocation are pure functions of it, compiled once for
each size of photos.
"""

import functools
import os
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax

from humangs_jax.core.array_types import Array, Bool, Float, Int, Key, PyTree
from humangs_jax.core.checks import checked_arguments, require_concrete
from humangs_jax.core.configuration import config_to_json
from humangs_jax.core.processes import compiler_options
from humangs_jax.core.progress import COMPILING, bar
from humangs_jax.core.pytree import pytree_dataclass, replace
from humangs_jax.geometry.camera import Camera, stack_cameras
from humangs_jax.io.arrays import checksum, read_npz, write_npz
from humangs_jax.io.images import named_color
from humangs_jax.io.reading import InvalidFileError, reading
from humangs_jax.losses.losses import decibels, structural_dissimilarity
from humangs_jax.rendering.buffers import plan_buffers
from humangs_jax.rendering.gaussians import (
    Gaussians,
    UnconstrainedGaussians,
    constrain,
    unconstrain,
)
from humangs_jax.rendering.splat_config import SplatConfig
from humangs_jax.rendering.splatting import render
from humangs_jax.scenes.config import SceneConfig
from humangs_jax.scenes.mcmc import mcmc_noise, mcmc_penalty, mcmc_relocate
from humangs_jax.scenes.start import Points, extent_of, first_gaussians, read_photos

MARGIN = 2.0
"""Buffers hold this many times the pairs of the Gaussians at the time of planning: they grow."""
CHECK_EVERY = 25
"""Steps after which it is looked at whether all pairs did fit."""
SAVE_SECONDS = 60.0
"""Between two checkpoints."""
HIDDEN = -20.0
"""Logit of the opacity of slots that are not used: none of them meets a tile."""
MARK = "humangs_jax scene"
"""In a checkpoint, whose name may be any."""


@pytree_dataclass
class SceneState:
    """All that steps change."""

    step: Int[Array, ""]
    """Steps that are done."""
    parameters: UnconstrainedGaussians
    """Of all slots."""
    used: Bool[Array, " g"]
    """Which slots are Gaussians."""
    moments: PyTree
    """Of Adam."""
    overflow: Int[Array, ""]
    """Most (splat, tile) pairs of a step that did not fit since the buffers were planned."""


class SceneFit(NamedTuple):
    """What `fit_scene` returns."""

    gaussians: Gaussians
    """Of the used slots."""
    steps: int
    """Done in all, those before a continuation included."""
    seconds: float
    """That this call took."""
    psnr: float
    """Mean over the photos, dB."""
    interrupted: bool
    """Whether Ctrl-C ended it; the state is in the checkpoint, if there is one."""


@checked_arguments
def fit_scene(
    images: Sequence[Any] | Array | np.ndarray,
    cameras: Camera | Sequence[Camera] | Mapping[str, Camera],
    points: Points = None,
    config: SceneConfig | None = None,
    *,
    background: Any = "black",
    checkpoint: str | os.PathLike[str] | None = None,
    progress: bool = False,
    watch: Callable[[int, Gaussians], None] | None = None,
) -> SceneFit:
    """Fit Gaussians to posed photos of a scene that stands still (Kheradmand et al. 2024,
    https://arxiv.org/abs/2404.09591).

    Args:
        images: (h, w, 3) of each camera, RGB in [0, 1] or bytes, or paths of files; sizes may
            differ.
        cameras: one for each image, in the same order, with or without lenses.
        points: (n, 3) where Gaussians begin, as structure from motion finds them, perhaps as
            (points, colors); or Gaussians.
            None: `SceneConfig.start` random points where most cameras look.
        config: None: `SceneConfig()`.
        background: behind the scene, as `render` takes it.
        checkpoint: a file that takes the state each minute, at the end and at Ctrl-C, and from
            which the same call continues.
        progress: Show a bar.
        watch: is called with the number of steps and the Gaussians, whenever some have moved.

    Returns:
        The Gaussians, the number of steps, seconds and the mean PSNR of the photos.

    Raises:
        ValueError: images that do not fit their cameras, or more points than the capacity.
        FileError: a checkpoint that cannot be read, or is of other photos, cameras, points or
            settings.

    Examples:
        >>> cameras = hg.load_cameras("garden/sparse/0")
        >>> photos = [f"garden/images/{name}" for name in cameras]
        >>> points = cameras.points, cameras.colors
        >>> fit = hg.fit_scene(photos, cameras, points, checkpoint="garden.npz", progress=True)
        >>> hg.save_gaussians("garden.ply", fit.gaussians)
    """
    require_concrete("fit_scene", "reads photos and measures buffers", cameras, points)
    # photos and cameras
    began, config = time.perf_counter(), config or SceneConfig()
    if isinstance(cameras, Mapping):
        views = list(cameras.values())
    else:
        views = list(cameras)
    photos, extent = read_photos(images, views, config), extent_of(views)
    color = background
    if isinstance(background, str):
        color = named_color(background)
    color = jnp.asarray(color, jnp.float32)
    # where it begins: the points, or where the checkpoint stopped
    step, relocate = _programs()
    state = begin_scene(first_gaussians(points, views, config), config.capacity)
    about = ""
    if checkpoint is not None:
        about = _about(config, photos, views, state)
    state = _resumed(checkpoint, state, about)
    plans = _plans(_drawn(state.parameters, state.used), views, config)
    key, interrupted, saved = jax.random.key(config.seed), False, time.perf_counter()
    steps = range(int(state.step), config.steps)
    try:
        # one photo a step
        for i in bar(steps, shown=progress, desc="fit", unit="step", first=COMPILING):
            which = _photo_of_step(i, len(photos), config.seed)
            how, one = plans[_kind(views[which])], jax.random.fold_in(key, i)
            state = step(state, views[which], photos[which], color, one, extent, config, how)
            # Gaussians grow: buffers that overflowed are measured anew
            last = i + 1 == config.steps
            if ((i + 1) % CHECK_EVERY == 0 or last) and int(state.overflow):
                plans = _plans(_drawn(state.parameters, state.used), views, config)
                state = replace(state, overflow=jnp.zeros_like(state.overflow))
            # hidden Gaussians move to where they are needed
            moving = i + 1 <= config.relocate_until * config.steps
            if moving and (i + 1) % config.relocate_every == 0:
                state = relocate(state, jax.random.fold_in(one, 1), config.growth)
                if watch is not None:
                    watch(i + 1, scene_gaussians(state))
            if checkpoint is not None and time.perf_counter() - saved > SAVE_SECONDS:
                _save(checkpoint, state, about)
                saved = time.perf_counter()
    except KeyboardInterrupt:
        interrupted = True
    # what is left is kept, also after Ctrl-C
    if checkpoint is not None:
        _save(checkpoint, state, about)
    gaussians = scene_gaussians(state)
    psnr = _mean_psnr(gaussians, views, photos, color, config)
    seconds = time.perf_counter() - began
    return SceneFit(gaussians, int(state.step), seconds, psnr, interrupted)


# The state, and what makes the next one

ADAM = optax.scale_by_adam(eps=1e-15)


def begin_scene(gaussians: Gaussians, capacity: int) -> SceneState:
    """A state whose first slots are these Gaussians.

    Raises: ValueError for more than the capacity.
    """
    count = len(gaussians.opacities)
    if count > capacity:
        raise ValueError(f"points: {count:,} are more than SceneConfig.capacity {capacity:,}")

    def pad(leaf):
        return jnp.pad(leaf, [(0, capacity - count)] + [(0, 0)] * (leaf.ndim - 1))

    parameters, used = jax.tree.map(pad, unconstrain(gaussians)), jnp.arange(capacity) < count
    zero = jnp.zeros((), jnp.int32)
    return SceneState(zero, parameters, used, ADAM.init(parameters), zero)


def scene_gaussians(state: SceneState) -> Gaussians:
    """The Gaussians of the used slots; outside of transformations."""
    used = np.flatnonzero(state.used)
    return jax.tree.map(lambda leaf: leaf[used], constrain(state.parameters))


def _drawn(parameters: UnconstrainedGaussians, used: Bool[Array, " g"]) -> Gaussians:
    logits = jnp.where(used, parameters.opacity_logits, HIDDEN)
    return constrain(replace(parameters, opacity_logits=logits))


@functools.cache
def _programs() -> tuple[Callable[..., SceneState], Callable[..., SceneState]]:
    """The step and the relocation, compiled.

    A state is not donated: Ctrl-C may come before there is the next one.
    """
    step = jax.jit(scene_step, static_argnums=(6, 7), compiler_options=compiler_options())
    return step, jax.jit(relocate_scene)


def scene_step(
    state: SceneState,
    camera: Camera,
    photo: Array,
    background: Float[Array, "3"],
    key: Key,
    extent: Float[Array, ""],
    config: SceneConfig,
    splat: SplatConfig,
) -> SceneState:
    """One photo, one step of Adam, and noise."""
    target = photo.astype(jnp.float32) / (255 if photo.dtype == jnp.uint8 else 1)

    # the error of the image, and what MCMC charges for opaque and large Gaussians
    def loss(parameters):
        drawn = render(_drawn(parameters, state.used), camera, splat, background)
        absolute = jnp.mean(jnp.abs(drawn.rgb - target))
        structural = jnp.mean(structural_dissimilarity(drawn.rgb, target))
        error = (1 - config.structural) * absolute + config.structural * 2 * structural
        penalty = mcmc_penalty(
            parameters, state.used, config.opacity_penalty, config.scale_penalty / extent
        )
        return error + penalty, drawn.overflow

    # Adam, whose rates fall with the steps; those of positions are relative to the extent of the
    # scene
    gradient, overflow = jax.grad(loss, has_aux=True)(state.parameters)
    updates, moments = ADAM.update(gradient, state.moments)
    done = state.step / config.steps
    rates = {name: getattr(config.rates, name) for name in _names(state.parameters)}
    shares = {name: config.other_final_share**done for name in rates}
    shares["means"] = config.final_share**done * extent
    moved = {
        name: getattr(state.parameters, name) - rate * shares[name] * getattr(updates, name)
        for name, rate in rates.items()
    }
    parameters = replace(state.parameters, **moved)
    noise = config.noise * rates["means"] * shares["means"] / jnp.square(extent)
    parameters = mcmc_noise(key, parameters, state.used, noise)
    overflow = jnp.maximum(state.overflow, overflow)
    return SceneState(state.step + 1, parameters, state.used, moments, overflow)


def _names(parameters: UnconstrainedGaussians) -> list[str]:
    return [name for name, leaf in vars(parameters).items() if leaf is not None]


def relocate_scene(state: SceneState, key: Key, growth: Float[Array, ""] | float) -> SceneState:
    """Dead Gaussians move, more slots are used, and Adam forgets those that are others now."""
    count = jnp.ceil(growth * jnp.sum(state.used)).astype(jnp.int32)
    found = mcmc_relocate(key, state.parameters, state.used, count)

    def forgotten(leaf):
        if leaf.ndim == 0:
            return leaf
        moved = found.moved.reshape(found.moved.shape + (1,) * (leaf.ndim - 1))
        return jnp.where(moved, 0.0, leaf)

    moments = jax.tree.map(forgotten, state.moments)
    return replace(state, parameters=found.parameters, used=found.used, moments=moments)


# Of the loop


def _photo_of_step(step: int, count: int, seed: int) -> int:
    """Each photo once in every `count` steps, in an order that only the step and the seed
    decide.
    """
    epoch, place = divmod(step, count)
    return int(np.random.default_rng([seed, epoch]).permutation(count)[place])


def _kind(camera: Camera) -> tuple[Any, ...]:
    """Cameras of one kind share programs and buffers."""
    shape = None if camera.distortion is None else camera.distortion.shape
    return camera.width, camera.height, camera.lens, shape


def _plans(
    gaussians: Gaussians, views: Sequence[Camera], config: SceneConfig
) -> dict[tuple[Any, ...], SplatConfig]:
    """Buffers for the cameras of each kind."""
    kinds: dict[tuple[Any, ...], list[Camera]] = {}
    for camera in views:
        kinds.setdefault(_kind(camera), []).append(camera)
    return {
        kind: plan_buffers(gaussians, stack_cameras(each), config.splat, margin=MARGIN)
        for kind, each in kinds.items()
    }


def _mean_psnr(
    gaussians: Gaussians,
    views: Sequence[Camera],
    photos: Sequence[np.ndarray],
    background: Array,
    config: SceneConfig,
) -> float:
    plans, found = _plans(gaussians, views, config), []
    for camera, photo in zip(views, photos, strict=True):
        drawn = render(gaussians, camera, plans[_kind(camera)], background).rgb
        target = photo / 255 if photo.dtype == np.uint8 else photo
        found.append(float(decibels(jnp.mean(jnp.square(drawn - target)))))
    return float(np.mean(found))


# Checkpoints


def _about(
    config: SceneConfig, photos: Sequence[np.ndarray], views: Sequence[Camera], start: SceneState
) -> str:
    """What a run depends on, as a checksum."""
    arrays = {f"photo {i}": photo for i, photo in enumerate(photos)}
    for name, tree in (("cameras", list(views)), ("start", start.parameters)):
        arrays |= {f"{name} {i}": np.asarray(x) for i, x in enumerate(jax.tree.leaves(tree))}
    return checksum(arrays, config_to_json(config), *(str(_kind(camera)) for camera in views))


def _save(path: str | os.PathLike[str], state: SceneState, about: str) -> None:
    leaves = {str(i): leaf for i, leaf in enumerate(jax.tree.leaves(state))}
    write_npz(path, {"mark": MARK, "about": about, **leaves}, compressed=False)


def _resumed(path: str | os.PathLike[str] | None, state: SceneState, about: str) -> SceneState:
    """The state of a checkpoint, if there is one.

    Raises: FileError for one of another run, or another file.
    """
    if path is None or not os.path.exists(path):
        return state
    with reading(path, "checkpoint of a scene"):
        arrays, _ = read_npz(Path(path))
        if str(arrays.get("mark")) != MARK:
            raise InvalidFileError("not a checkpoint of fit_scene: expected one, or no file")
        if str(arrays["about"]) != about:
            raise InvalidFileError(
                "of other photos, cameras, points or settings: expected those it was begun with"
            )
        leaves, tree = jax.tree.flatten(state)
        found = [arrays[str(i)] for i in range(len(leaves))]
        if any(
            a.shape != b.shape or a.dtype != b.dtype for a, b in zip(found, leaves, strict=True)
        ):
            raise InvalidFileError("damaged: arrays of other shapes than its run has")
        return jax.tree.unflatten(tree, list(map(jnp.asarray, found)))
