"""Views of any Gaussians, those of other programs too: from a circle of cameras, or from the cameras of a calibration."""

import logging
from collections.abc import Iterator, Mapping
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from humangs_jax.avatar.export import Up
from humangs_jax.avatar.export.gaussians import up_matrix
from humangs_jax.avatar.frames import image_of
from humangs_jax.avatar.shot import Shot
from humangs_jax.core.array_types import Float
from humangs_jax.core.progress import bar
from humangs_jax.core.pytree import replace
from humangs_jax.data.calibration.calibration import in_capture_convention, read_calibration
from humangs_jax.geometry.camera import Camera, intrinsics_from_fov, orbit
from humangs_jax.io.atomic import add_files
from humangs_jax.io.images import write_png
from humangs_jax.io.reading import check_limit, reading
from humangs_jax.rendering.buffers import plan_buffers
from humangs_jax.rendering.gaussians import Gaussians
from humangs_jax.rendering.splat_config import DEFAULT_CONFIG, SPLAT_PRESETS, SplatConfig
from humangs_jax.rendering.splatting import Background, Rendering, render

logger = logging.getLogger(__name__)
SHOWN = 0.9
"""Of the opaque Gaussians, those that a circle of cameras is made to show: outliers are far away."""
MARGIN = 1.1
PAIRS = 4_000_000
"""(splat, tile) pairs that are drawn at once: some hundred megabytes."""


def circle_cameras(gaussians: Gaussians, up: Up, views: int, shot: Shot) -> dict[str, Camera]:
    """Cameras around the middle of the Gaussians, by name. up: of their world. Without a distance all of them fit."""
    means = np.asarray(gaussians.means)[np.asarray(gaussians.opacities) >= 0.5 * np.max(gaussians.opacities, initial=0)]
    middle = np.median(means, axis=0) if len(means) else np.zeros(3)
    radius = np.quantile(np.linalg.norm(means - middle, axis=1), SHOWN) if len(means) else 1.0
    distance = MARGIN * max(float(radius), 1e-3) / np.sin(np.arctan(min(shot.tangents)))
    turn = up_matrix(up)  # the file's world from one with y up
    cameras = orbit(
        jnp.asarray(middle @ turn, jnp.float32),
        distance if shot.distance is None else shot.distance,
        jnp.radians(shot.azimuth + 360 / views * np.arange(views)).astype(jnp.float32),
        float(np.radians(shot.elevation)),
        intrinsics_from_fov(float(np.radians(shot.fov)), *shot.resolution),
        *shot.resolution,
    )
    turned = np.asarray(cameras.cam_from_world).copy()
    turned[:, :3, :3] = turned[:, :3, :3] @ turn.T
    each = replace(cameras, cam_from_world=jnp.asarray(turned))
    return {f"view_{i:03d}": camera for i, camera in enumerate(each)}


def file_cameras(path: Path, shot: Shot) -> dict[str, Camera]:
    """The cameras of a calibration in the world of its file, by unique names; lens distortion is left out, which is logged.

    Images are as large as the file says. Where it does not say, or the shot has a width or a height, they are those of the shot.
    Raises: CaptureError, one line that names the file.
    """
    with reading(path, "calibration"):
        found = read_calibration(path, lambda name: shot.resolution)
        check_limit("views", len(found.cameras), "cameras")
        found = in_capture_convention(found, 1.0, "+y", found.pixel_centers)  # the axes stay those of the file
    if any(camera.distortion is not None and np.any(camera.distortion) for camera in found.cameras):
        logger.warning("%s: images are drawn without the distortion of lenses", path)
    cameras: dict[str, Camera] = {}
    for each in found.cameras:
        size = each.width or shot.resolution[0], each.height or shot.resolution[1]
        camera = Camera.from_opencv(each.K, each.cam_from_world, *size)
        if shot.width or shot.height:
            camera = camera.resized(shot.width or size[0], shot.height or size[1])
        plain = stem = Path(each.name.replace("\\", "/")).stem.lstrip(".") or "view"
        while stem in cameras:
            stem = f"{plain}_{len(cameras)}"
        cameras[stem] = camera
    return cameras


def splat_images(gaussians: Gaussians, cameras: Mapping[str, Camera], shot: Shot) -> Iterator[Float[np.ndarray, "h w c"]]:
    """One image for each camera, in bounded memory; with alpha where the shot's background is transparent."""
    config = SPLAT_PRESETS["exact" if shot.splat == "as_trained" else shot.splat]
    for camera in bar(list(cameras.values()), desc="render", unit="view"):
        yield image_of(render_in_bands(gaussians, camera, config, jnp.zeros(3)), shot.color())


def write_splat_views(out: Path, gaussians: Gaussians, cameras: Mapping[str, Camera], shot: Shot) -> int:
    """Images NAME.png in a folder, which appear together; other files stay. Returns how many. Raises: OSError."""

    def write(folder: Path) -> None:
        for name, image in zip(cameras, splat_images(gaussians, cameras, shot), strict=True):
            write_png(folder / f"{name}.png", image)

    add_files(out, write)
    return len(cameras)


# Large scenes in bounded memory: the image in bands of rows, one after the other, each with buffers of the same size -------


def render_in_bands(
    gaussians: Gaussians,
    camera: Camera,
    config: SplatConfig = DEFAULT_CONFIG,
    background: Background = None,
    most_pairs: int = PAIRS,
) -> Rendering:
    """The image of `render`, as arrays of numpy, drawn in as many bands as keep each below `most_pairs`; for calls outside of
    transformations.

    Bands of one row of tiles may still need more: they get it. Configurations whose image depends on its height (a
    `jacobian_margin`, a `scale`, `visibility`) are drawn whole. Raises: as `render`.
    """
    whole = config.jacobian_margin is not None or config.scale != 1 or config.visibility
    planned = plan_buffers(gaussians, camera, config, margin=1.0)
    rows, bands = -(-camera.height // config.tile_size), 1
    cameras = camera
    while not whole and (planned.max_pairs or 0) > most_pairs and bands < rows:
        bands = min(rows, max(bands + 1, -(-bands * (planned.max_pairs or 0) // most_pairs)))
        cameras = banded(camera, -(-rows // bands) * config.tile_size)
        planned = plan_buffers(gaussians, cameras, config, margin=1.0)
    if bands == 1:
        return jax.tree.map(np.asarray, render(gaussians, camera, planned, background))
    drawn = [jax.tree.map(np.asarray, render(gaussians, each, planned, background)) for each in cameras]
    joined = {
        name: np.concatenate([getattr(each, name) for each in drawn])[: camera.height] for name in ("rgb", "alpha", "depth")
    }
    return replace(drawn[0], **joined)


def banded(camera: Camera, height: int) -> Camera:
    """Cameras of the bands of so many rows, from the top; the last may reach beyond the image."""
    tops = np.arange(0, camera.height, height)
    shift = jnp.zeros((len(tops), 3, 3), camera.K.dtype).at[:, 1, 2].set(tops.astype(camera.K.dtype))
    poses = jnp.broadcast_to(camera.cam_from_world, (len(tops), 4, 4))
    return replace(camera, K=camera.K - shift, cam_from_world=poses, height=height)
