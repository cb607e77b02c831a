"""Chooses the sizes of splatting's buffers: how many (splat, tile) pairs and (splat, row of tiles)
pairs fit. Sizes are measured on a scene, or guessed for traced calls. Pairs that do not fit are
reported.
"""

import dataclasses
import functools
import logging

import jax
import jax.numpy as jnp
import numpy as np

from humangs_jax.core.array_types import Array, Int
from humangs_jax.core.checks import checked_arguments, require_concrete
from humangs_jax.core.compiled import compiled
from humangs_jax.core.numerics import at_least_float32
from humangs_jax.core.pytree import replace
from humangs_jax.geometry.camera import Camera
from humangs_jax.rendering.gaussians import Gaussians
from humangs_jax.rendering.projection import project_gaussians
from humangs_jax.rendering.splat_config import DEFAULT_CONFIG, SplatConfig, splat_config
from humangs_jax.rendering.tiling import TileGrid, count_pairs, footprints_by

logger = logging.getLogger(__name__)


class BufferOverflowError(ValueError):
    """A view needs larger buffers than its configuration has."""


def round_up(size: int, smallest: int = 64) -> int:
    """Returns the size, or `smallest` if that is larger, rounded up to (4, 5, 6 or 7) 2^i. Similar
    scenes then share one compilation. If the size is larger than `smallest`, at most a fifth of the
    result is spare.
    """
    size = max(size, smallest)
    unit = 1 << max(0, (size - 1).bit_length() - 3)
    return -(-size // unit) * unit


def default_pairs(g: int, width: int, height: int, tile_size: int = 8) -> int:
    """Returns the room for (splat, tile) pairs that a traced call gets if `SplatConfig.max_pairs`
    is None. It is enough for a person, and never more than can be needed.

    g: number of Gaussians. width, height, tile_size: pixels.
    """
    # a person of 50,000 Gaussians needs 6 tiles per Gaussian at 512 x 512 and 15 at 1024 x 1024,
    # where its 16,384 tiles add another 5 each
    tiles = TileGrid(width, height, tile_size).tiles
    return max(1, min(g * tiles, 12 * g + 16 * tiles))


def with_default_buffers(gaussians: Gaussians, camera: Camera, config: SplatConfig) -> SplatConfig:
    """Returns the configuration for a traced call. If `max_pairs` is None, it becomes
    `default_pairs`.
    """
    if config.max_pairs is not None:
        return config
    pairs = default_pairs(gaussians.means.shape[0], camera.width, camera.height, config.tile_size)
    return dataclasses.replace(config, max_pairs=pairs)


@checked_arguments
def plan_buffers(
    gaussians: Gaussians,
    cameras: Camera,
    config: SplatConfig | str = DEFAULT_CONFIG,
    margin: float = 1.25,
) -> SplatConfig:
    """Returns a configuration whose buffers have room for `margin` times what a camera needs. In a
    batch, the most demanding camera counts.

    Sizes are rounded up to (4, 5, 6 or 7) 2^i, so that similar scenes share one compilation.
    `plan_buffers` measures concrete arrays, so call it outside of transformations.

    No margin is enough for Gaussians that are optimised for long, because they grow. If pairs no
    longer fit, a traced call returns a `Rendering.overflow` above 0, and logs a warning if
    `SplatConfig.warn_overflow` is set. Then plan again from the current Gaussians; the program
    compiles again.

    Args:
        gaussians: one set.
        cameras: one, or a batch.
        config: the configuration that the buffers are added to, or a preset's name.
        margin: size of the buffers, relative to the need.

    Returns:
        `config` with `max_pairs` and `max_rows`.

    Raises:
        TypeError: inside of `jit`, `vmap` and `grad`, and for arguments of other classes.
        ValueError: for a batch of sets, Gaussians whose arrays do not fit each other, and an
            unknown name of a preset.

    Examples:
        >>> config = hg.plan_buffers(gaussians, cameras, margin=2.0)
    """
    require_concrete("plan_buffers", "measures what a scene needs", gaussians, cameras)
    config = splat_config(config)
    rows, pairs = (round_up(int(most * margin)) for most in _needed(gaussians, cameras, config))
    return dataclasses.replace(config, max_rows=rows, max_pairs=pairs)


ROOMY = 2.0
"""Largest size of planned buffers that are used for another view, relative to what the view needs.
Larger buffers would cost more time than another compilation.
"""
_PLANNED: dict[tuple[SplatConfig, int, int], list[tuple[int, int]]] = {}
"""`max_rows` and `max_pairs` of the buffers planned in this process, by configuration, width and
height.
"""


def plan_near(gaussians: Gaussians, camera: Camera, config: SplatConfig) -> SplatConfig:
    """Returns a configuration with buffers for one camera. Buffers from an earlier call are used
    again if everything fits and neither buffer is larger than `ROOMY` times the need. Drawing with
    such buffers costs less than another compilation.
    """
    rows, pairs = _needed(gaussians, camera, config)
    known = _PLANNED.setdefault((config, camera.width, camera.height), [])
    for most_rows, most_pairs in known:
        if rows <= most_rows <= ROOMY * rows and pairs <= most_pairs <= ROOMY * pairs:
            return dataclasses.replace(config, max_rows=most_rows, max_pairs=most_pairs)
    planned = plan_buffers(gaussians, camera, config)
    known.append((planned.max_rows or 0, planned.max_pairs or 0))
    return planned


def raise_on_overflow(
    overflow: Int[Array, "*v"], gaussians: Gaussians, cameras: Camera, config: SplatConfig
) -> None:
    """Raises BufferOverflowError if a view has overflowed. The error says what size is needed."""
    missing = int(np.max(np.asarray(overflow), initial=0))
    if missing:
        rows, pairs = _needed(gaussians, cameras, config)
        raise BufferOverflowError(
            f"{missing} (splat, tile) pairs of a view did not fit: it needs max_pairs >= {pairs}"
            f" and max_rows >= {rows}, got max_pairs = {config.max_pairs}, max_rows ="
            f" {config.max_rows}"
        )


def warn_of_overflow(overflow: Int[Array, "*v"], config: SplatConfig) -> None:
    """Makes a traced program log a warning when it runs and a view has overflowed, if the
    configuration asks for it.
    """
    if config.warn_overflow:  # else nothing is added to the program
        warn = functools.partial(_warn, max_pairs=config.max_pairs, max_rows=config.max_rows)
        jax.debug.callback(warn, jnp.max(overflow, initial=0))


def _warn(missing: Array | np.ndarray, max_pairs: int | None, max_rows: int | None) -> None:
    """Logs a warning with the number of pairs that did not fit, if there are any."""
    if missing > 0:
        logger.warning(
            "%d (splat, tile) pairs of a view did not fit and were not drawn: max_pairs = %s,"
            " max_rows = %s. Larger buffers: plan_buffers with the Gaussians as they are now",
            missing,
            max_pairs,
            max_rows,
        )


def _needed(gaussians: Gaussians, cameras: Camera, config: SplatConfig) -> list[int]:
    """Returns the largest numbers of rows and of pairs that any view needs."""
    gaussians, cameras = at_least_float32((gaussians, cameras))
    # one program for all buffers, images of every size, and every number of cameras
    config = dataclasses.replace(config, max_pairs=None, max_rows=None)
    size = np.asarray([cameras.width, cameras.height], np.int32)
    sizeless = replace(cameras, width=1, height=1)
    each_camera = sizeless if sizeless.batch_shape else [sizeless]
    each = [needed_by(gaussians, camera, size, config) for camera in each_camera]
    rows, pairs = np.asarray(each, int).reshape(-1, 2).max(axis=0, initial=0)
    return [int(rows), int(pairs)]


@compiled(static=["config"])
def needed_by(
    gaussians: Gaussians, camera: Camera, size: Int[Array, "2"], config: SplatConfig
) -> tuple[Int[Array, ""], Int[Array, ""]]:
    """Returns the numbers of rows and pairs that an image of `size` (width, height) of a camera
    needs. The camera's size and the buffers of `config` are ignored.
    """
    camera = replace(camera, width=size[0], height=size[1])
    projected = project_gaussians(gaussians, camera, config)
    footprints = footprints_by(projected, projected.dimmed(gaussians.opacities), config)
    return count_pairs(footprints, TileGrid(camera.width, camera.height, config.tile_size))
