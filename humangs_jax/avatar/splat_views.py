"""Draws images of any Gaussians, also of those that other programs made, from a circle of cameras
or from the cameras of a calibration. Large scenes are drawn in bands of rows, in bounded memory.
"""

from collections.abc import Iterator, Mapping
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from humangs_jax.avatar.export import ExportFormat
from humangs_jax.avatar.export.gaussians import world_matrix
from humangs_jax.avatar.frame_settings import FrameSettings
from humangs_jax.avatar.frames import composite_over
from humangs_jax.core.array_types import Float
from humangs_jax.core.arrays import from_host
from humangs_jax.core.progress import COMPILING, bar
from humangs_jax.core.pytree import replace
from humangs_jax.geometry.camera import Camera, intrinsics_from_fov, orbit
from humangs_jax.io.atomic import add_files, check_ours
from humangs_jax.io.images import DRAWN, is_own_output, write_png
from humangs_jax.rendering.buffers import plan_buffers
from humangs_jax.rendering.gaussians import Gaussians
from humangs_jax.rendering.splat_config import (
    DEFAULT_CONFIG,
    SPLAT_PRESETS,
    SplatConfig,
)
from humangs_jax.rendering.splatting import Background, Rendering, render

SHOWN = 0.9
"""Least share of the opaque Gaussians that the images of a circle of cameras contain. The others
may be outliers, far away.
"""
NEARLY_ALL = 0.999
"""Share of the opaque Gaussians that stands for all of them, because a few may be outliers."""
COMPACT = 3.0
"""All opaque Gaussians are shown if the radius that contains nearly all of them is less than this
many times the radius that contains the share `SHOWN`. Then there are no outliers, as in files of a
person alone.
"""
ROOM = 1.1
"""Factor on the least distance from which the cameras see the Gaussians."""
PAIRS = 4_000_000
"""The largest number of (splat, tile) pairs that are drawn at once. They take some hundred
megabytes.
"""


def circle_cameras(
    gaussians: Gaussians, form: ExportFormat, views: int, shot: FrameSettings
) -> dict[str, Camera]:
    """Returns cameras in a circle around the middle of the Gaussians, by name.

    form: the format of the file that the Gaussians are from. At azimuth 0 the first camera sees the
    front of a person that `export` wrote. If the shot has no distance, the images contain all
    opaque Gaussians except outliers. A Gaussian is opaque if its opacity is at least half of the
    largest one.
    """
    means = np.asarray(gaussians.means)[
        np.asarray(gaussians.opacities) >= 0.5 * np.max(gaussians.opacities, initial=0)
    ]
    # most of what is opaque; all of it where nothing lies far away, as of a person
    middle = np.median(means, axis=0) if len(means) else np.zeros(3)
    radius = 1.0
    if len(means):
        radius = np.quantile(np.linalg.norm(means - middle, axis=1), SHOWN)
        low, high = np.quantile(means, [1 - NEARLY_ALL, NEARLY_ALL], axis=0)
        whole = np.quantile(np.linalg.norm(means - (low + high) / 2, axis=1), NEARLY_ALL)
        if whole < COMPACT * radius:
            middle, radius = (low + high) / 2, max(radius, whole)
    distance = shot.distance
    if distance is None:
        distance = ROOM * max(float(radius), 1e-3) / np.sin(np.arctan(min(shot.tangents)))
    # cameras stand around it in the world of the file, whose up axis may be another
    turn = world_matrix(form)
    cameras = orbit(
        from_host(middle @ turn, jnp.float32),
        distance,
        jnp.radians(shot.azimuth + 360 / views * np.arange(views)).astype(jnp.float32),
        float(np.radians(shot.elevation)),
        intrinsics_from_fov(float(np.radians(shot.fov)), *shot.resolution),
        *shot.resolution,
    )
    turned = np.asarray(cameras.cam_from_world).copy()
    turned[:, :3, :3] = turned[:, :3, :3] @ turn.T
    each = replace(cameras, cam_from_world=from_host(turned))
    return {f"view_{i:03d}": camera for i, camera in enumerate(each)}


def splat_images(
    gaussians: Gaussians, cameras: Mapping[str, Camera], shot: FrameSettings
) -> Iterator[Float[np.ndarray, "h w c"]]:
    """Yields one image for each camera, drawn in bounded memory. Images have alpha if the shot's
    background is transparent.
    """
    preset = "exact" if shot.splat == "as_trained" else shot.splat
    config = SPLAT_PRESETS[preset]
    drawn = (
        render_in_bands(gaussians, camera, config, jnp.zeros(3)) for camera in cameras.values()
    )
    for rendering in bar(drawn, total=len(cameras), desc="render", unit="view", first=COMPILING):
        yield composite_over(rendering, shot.color())


def write_splat_views(
    out: Path, gaussians: Gaussians, cameras: Mapping[str, Camera], shot: FrameSettings
) -> int:
    """Write an image NAME.png for each camera into a folder. The images appear together, and other
    files stay. Returns the number of images.

    Raises: ValueError if a file of the same name was not written by humangs; OSError.
    """

    def write(folder: Path) -> None:
        for name, image in zip(cameras, splat_images(gaussians, cameras, shot), strict=True):
            write_png(folder / f"{name}.png", image, mark=DRAWN)

    check_ours((out / f"{name}.png" for name in cameras), is_own_output)
    add_files(out, write, ours=is_own_output)
    return len(cameras)


# Large scenes in bounded memory
# --------------------------------------------------------------------------------------------------


def render_in_bands(
    gaussians: Gaussians,
    camera: Camera,
    config: SplatConfig = DEFAULT_CONFIG,
    background: Background = None,
    most_pairs: int = PAIRS,
) -> Rendering:
    """Returns what `render` returns, in numpy arrays. The image is drawn in bands of rows, so that
    a band has at most `most_pairs` (splat, tile) pairs. This does not work inside of JAX
    transformations.

    A band is at least one row of tiles high, and may then have more pairs. The image is drawn as a
    whole if the config has a `jacobian_margin`, whose effect depends on the image's height, or if
    values of each Gaussian are wanted (`visibility`, `means2d`, `radii`). Raises: as `render`.
    """
    whole = (
        config.jacobian_margin is not None or config.visibility or config.means2d or config.radii
    )
    planned = plan_buffers(gaussians, camera, config, margin=1.0)
    rows, bands = -(-camera.height // config.tile_size), 1
    cameras = camera
    while not whole and (planned.max_pairs or 0) > most_pairs and bands < rows:
        bands = min(rows, max(bands + 1, -(-bands * (planned.max_pairs or 0) // most_pairs)))
        cameras = banded(camera, -(-rows // bands) * config.tile_size)
        planned = plan_buffers(gaussians, cameras, config, margin=1.0)
    if bands == 1:
        return jax.tree.map(np.asarray, render(gaussians, camera, planned, background))
    drawn = [
        jax.tree.map(np.asarray, render(gaussians, each, planned, background)) for each in cameras
    ]
    joined = {
        name: np.concatenate([getattr(each, name) for each in drawn])[: camera.height]
        for name in ("rgb", "alpha", "depth", "depth_sum", "depth_median", "distortion")
        if getattr(drawn[0], name) is not None
    }
    return replace(drawn[0], **joined)


def banded(camera: Camera, height: int) -> Camera:
    """Returns a camera for each band of `height` rows, from the top. The last band may reach beyond
    the image.
    """
    tops = np.arange(0, camera.height, height)
    shift = (
        jnp.zeros((len(tops), 3, 3), camera.K.dtype).at[:, 1, 2].set(tops.astype(camera.K.dtype))
    )
    each = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (len(tops), *leaf.shape)), camera)
    return replace(each, K=camera.K - shift, height=height)
