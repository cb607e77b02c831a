"""Fits the Gaussians of a scene to posed photos by `fit_scene`, with Adam and the strategy of
`scenes.mcmc`.

A scene is an explicit state. Its steps and relocations are pure functions (`scenes.steps`). This
module has the loop around them. A step is compiled for each kind of camera, and again when the
buffers get other sizes.
"""

import os
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from humangs_jax.core.array_types import Array
from humangs_jax.core.checks import checked_arguments, require_concrete
from humangs_jax.core.configuration import config_to_json
from humangs_jax.core.progress import COMPILING, bar
from humangs_jax.core.pytree import replace
from humangs_jax.geometry.camera import Camera, stack_cameras
from humangs_jax.io.arrays import checksum, read_npz, write_npz
from humangs_jax.io.images import named_color
from humangs_jax.io.reading import InvalidFileError, reading
from humangs_jax.losses.losses import decibels
from humangs_jax.rendering.buffers import plan_buffers
from humangs_jax.rendering.gaussians import (
    Gaussians,
)
from humangs_jax.rendering.splat_config import SplatConfig
from humangs_jax.rendering.splatting import render
from humangs_jax.scenes.config import SceneConfig
from humangs_jax.scenes.start import Points, extent_of, first_gaussians, read_photos
from humangs_jax.scenes.steps import (
    SceneState,
    begin_scene,
    compiled_programs,
    drawn_gaussians,
    scene_gaussians,
)

MARGIN = 2.0
"""Size of the buffers divided by what the Gaussians need when the buffers are planned. It leaves
room, because the need grows.
"""
CHECK_EVERY = 25
"""Number of steps from one check of the buffers to the next. A check finds out whether all (splat,
tile) pairs have fit.
"""
SAVE_SECONDS = 60.0
"""Least time between two checkpoints of a running fit, seconds."""
MARK = "humangs_jax scene"
"""Text in a checkpoint by which it is recognised, because a checkpoint may have any name."""


class SceneFit(NamedTuple):
    """What `fit_scene` returns."""

    gaussians: Gaussians
    """The Gaussians of the used slots."""
    steps: int
    """The number of steps since the start, also those of earlier calls with the same checkpoint."""
    seconds: float
    """The time of this call, seconds."""
    psnr: float
    """The mean PSNR of the photos, dB."""
    interrupted: bool
    """Whether Ctrl-C ended the fit. Then the state is in the checkpoint, if there is one."""


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
    """Fits Gaussians to posed photos of a scene that stands still (Kheradmand et al. 2024,
    https://arxiv.org/abs/2404.09591).

    Args:
        images: one for each camera: an array (h, w, 3) of RGB numbers in [0, 1] or bytes, or the
            path of a file. Sizes may differ.
        cameras: one for each image, in the same order, with or without lenses.
        points: points (n, 3) where Gaussians begin, as structure from motion finds them, or a pair
            (points, colors), or Gaussians. None or a pair without points: `SceneConfig.start`
            random points, most of them where many cameras look.
        config: None: `SceneConfig()`.
        background: the color behind the scene: three numbers in [0, 1], a CSS name or "#rrggbb".
        checkpoint: path of a file. The state is written there each minute, at the end and at
            Ctrl-C. The same call continues from that state.
        progress: whether to show a bar.
        watch: a function that is called with the number of steps and the Gaussians after each
            relocation.

    Returns:
        The Gaussians, the number of steps, the seconds, the mean PSNR of the photos, and whether
        Ctrl-C ended the fit.

    Raises:
        ValueError: images that do not fit their cameras, are not in [0, 1] or are too small for
            SSIM; points or colors that are not finite or not (n, 3); an empty array of points; more
            points or Gaussians at the start than the capacity; Gaussians with deformations; a
            background that is no color.
        FileNotFoundError: a path of an image without a file.
        FileError: an image or a checkpoint that cannot be read, or a checkpoint of other photos,
            cameras, points, settings or another background.
        OSError: the checkpoint cannot be written.
        TypeError: an argument of another class; any call inside of `jit`, `vmap` and `grad`.

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
    step, relocate = compiled_programs()
    state = begin_scene(first_gaussians(points, views, config), config.capacity)
    about = ""
    if checkpoint is not None:
        about = _about(config, photos, views, color, state)
    state = _resumed(checkpoint, state, about)
    plans = _plans(drawn_gaussians(state.parameters, state.used), views, config)
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
                plans = _plans(drawn_gaussians(state.parameters, state.used), views, config)
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


def _photo_of_step(step: int, count: int, seed: int) -> int:
    """Returns the index of the photo of a step. Each photo is taken once in every `count` steps, in
    a random order that depends on the seed.
    """
    epoch, place = divmod(step, count)
    return int(np.random.default_rng([seed, epoch]).permutation(count)[place])


def _kind(camera: Camera) -> tuple[Any, ...]:
    """Returns the kind of a camera. Cameras of one kind share programs and buffers."""
    shape = None if camera.distortion is None else camera.distortion.shape
    return camera.width, camera.height, camera.lens, shape


def _plans(
    gaussians: Gaussians, views: Sequence[Camera], config: SceneConfig
) -> dict[tuple[Any, ...], SplatConfig]:
    """Returns the configuration of the renderer, with buffers, for each kind of camera
    (`_kind`).
    """
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
    config: SceneConfig,
    photos: Sequence[np.ndarray],
    views: Sequence[Camera],
    background: Array,
    start: SceneState,
) -> str:
    """Returns a checksum of the photos, cameras, background, first Gaussians and settings of a
    run.
    """
    arrays = {f"photo {i}": photo for i, photo in enumerate(photos)}
    arrays["background"] = np.asarray(background)
    for name, tree in (("cameras", list(views)), ("start", start.parameters)):
        arrays |= {f"{name} {i}": np.asarray(x) for i, x in enumerate(jax.tree.leaves(tree))}
    return checksum(arrays, config_to_json(config), *(str(_kind(camera)) for camera in views))


def _save(path: str | os.PathLike[str], state: SceneState, about: str) -> None:
    leaves = {str(i): leaf for i, leaf in enumerate(jax.tree.leaves(state))}
    write_npz(path, {"mark": MARK, "about": about, **leaves}, compressed=False)


def _resumed(path: str | os.PathLike[str] | None, state: SceneState, about: str) -> SceneState:
    """Returns the state in a checkpoint. Returns the given state if there is no such file, or if
    `path` is None.

    Raises: FileError if the checkpoint is damaged or belongs to another run, or if the file is no
    checkpoint.
    """
    if path is None or not os.path.exists(path):
        return state
    with reading(path, "checkpoint of a scene"):
        arrays, _ = read_npz(Path(path))
        if str(arrays.get("mark")) != MARK:
            raise InvalidFileError("not a checkpoint of fit_scene: expected one, or no file")
        if str(arrays["about"]) != about:
            raise InvalidFileError(
                "of other photos, cameras, points, settings or another background: expected"
                " those it was begun with"
            )
        leaves, tree = jax.tree.flatten(state)
        found = [arrays[str(i)] for i in range(len(leaves))]
        if any(
            a.shape != b.shape or a.dtype != b.dtype for a, b in zip(found, leaves, strict=True)
        ):
            raise InvalidFileError("damaged: arrays of other shapes than its run has")
        return jax.tree.unflatten(tree, list(map(jnp.asarray, found)))
