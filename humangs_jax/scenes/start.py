"""Prepares the start of `fit_scene`: photos that fit their cameras, and Gaussians at points."""

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
from scipy.spatial import KDTree

from humangs_jax.core.array_types import Array, Float
from humangs_jax.core.pytree import replace
from humangs_jax.geometry.camera import Camera, project
from humangs_jax.io.images import read_image
from humangs_jax.losses.losses import GAUSSIAN
from humangs_jax.rendering.gaussians import COUNTS, Gaussians
from humangs_jax.scenes.config import SceneConfig

START_OPACITY = 0.5
"""Opacity of Gaussians that begin at points."""
START_SHARE = 0.5
"""Scale of Gaussians that begin at points, as a share of the mean distance to the three nearest
points.
"""
PARALLEL = 1e-3
"""Axes of cameras count as parallel if the mean squared sine of their angles to a common direction
is below this.
"""
CANDIDATES = 16
"""The number of random points for each Gaussian that begins at a random point. The places of all
Gaussians are chosen among all these points.
"""
SMALLEST = 1e-4
"""The least scale of a Gaussian at the start, as a share of the extent of the cameras. Without it,
the scale would be 0 where points coincide.
"""
Points = Gaussians | np.ndarray | Array | tuple[Any, Any] | None
"""The points where Gaussians begin: points (n, 3), a pair of points and colors (n, 3) in [0, 1], or
Gaussians. None stands for random points.
"""


def read_photos(images: Any, views: Sequence[Camera], config: SceneConfig) -> list[np.ndarray]:
    """Returns the photos of `fit_scene`, (h, w, 3) each, as bytes or float32 in [0, 1].

    Raises: ValueError for another number or size than the cameras have, for values beyond [0, 1],
    or for photos smaller than the window of SSIM if SSIM is in the loss; FileNotFoundError or
    FileError for a path that cannot be read.
    """
    if len(images) != len(views) or not views:
        raise ValueError(
            f"images: expected one for each of {len(views)} cameras, got {len(images)}"
        )
    photos = []
    for i, (image, camera) in enumerate(zip(images, views, strict=True)):
        if isinstance(image, str | os.PathLike):
            image = np.rint(255 * read_image(Path(image))[0]).astype(np.uint8)
        image = np.asarray(image)
        expected = (camera.height, camera.width, 3)
        if image.shape != expected:
            raise ValueError(f"images[{i}]: expected shape {expected}, got {image.shape}")
        if image.dtype != np.uint8:
            image = image.astype(np.float32)
            if not (image.min() >= 0 and image.max() <= 1):  # nor NaN
                raise ValueError(f"images[{i}]: expected numbers in [0, 1], or bytes")
        if config.structural and min(image.shape[:2]) < GAUSSIAN.size:
            side = f"{camera.width} x {camera.height}"
            raise ValueError(
                f"images[{i}]: {side} is too small for SceneConfig.structural: set it to 0"
            )
        photos.append(image)
    return photos


def extent_of(views: Sequence[Camera]) -> Float[Array, ""]:
    """Returns the largest distance of a camera from the mean of all cameras' centres, metres. It is
    1 if all stand in one place.
    """
    centers = np.stack([np.asarray(camera.center) for camera in views])
    reach = float(np.linalg.norm(centers - centers.mean(axis=0), axis=1).max())
    return jnp.float32(reach if reach > 0 else 1.0)


def first_gaussians(points: Points, views: Sequence[Camera], config: SceneConfig) -> Gaussians:
    """Returns the first Gaussians of a scene. They have harmonics of the configured degree, unless
    the given Gaussians have harmonics already.

    Raises: ValueError for points or colors that are not finite or not of shape (n, 3), and for an
    empty array of points.
    """
    gaussians = points
    if not isinstance(gaussians, Gaussians):
        gaussians = _at_points(*_points(points, views, config), float(extent_of(views)))
    if gaussians.harmonics is None and config.degree:
        shape = (len(gaussians.opacities), COUNTS[config.degree], 3)
        gaussians = replace(gaussians, harmonics=jnp.zeros(shape, gaussians.means.dtype))
    return gaussians


def _points(
    points: Any, views: Sequence[Camera], config: SceneConfig
) -> tuple[np.ndarray, np.ndarray]:
    """Returns the points and the colors of the first Gaussians, (n, 3) each.

    Raises: as `first_gaussians`.
    """
    rng = np.random.default_rng(config.seed)
    if points is None or (isinstance(points, tuple) and len(points[0]) == 0):
        return _seen_points(views, config.start, rng), rng.uniform(0, 1, (config.start, 3))
    colors = None
    if isinstance(points, tuple):
        points, colors = points
    points = np.asarray(points, np.float64)
    if colors is None:
        colors = np.full(points.shape, 0.5)
    else:
        colors = np.asarray(colors, np.float64)
    for name, array in (("points", points), ("colors of points", colors)):
        if array.shape != (len(points), 3) or not len(points) or not np.isfinite(array).all():
            raise ValueError(f"{name}: expected finite numbers (n, 3), got shape {array.shape}")
    return points, colors


def _seen_points(
    views: Sequence[Camera], count: int, rng: np.random.Generator
) -> Float[np.ndarray, "n 3"]:
    """Returns `count` random points in a cube around the point at which the cameras look
    (`_middle`). The cube reaches `extent_of(views)` to each side of that point. Points that more
    cameras see are likelier.

    The chance of a point is in proportion to the fourth power of the number of cameras that see it.
    If the cameras stand around an object, most points lie near it and few between it and the
    cameras. In a room they lie everywhere.
    """
    middle, reach = _middle(views), float(extent_of(views))
    points = middle + rng.uniform(-reach, reach, (CANDIDATES * count, 3))
    seen = np.zeros(len(points))
    for camera in views:
        pixels, depths = project(camera, jnp.asarray(points, jnp.float32))
        inside = (pixels > 0) & (pixels < jnp.asarray([camera.width, camera.height]))
        seen += np.asarray(jnp.all(inside, axis=-1) & (depths > 0))
    share = seen**4 + 1e-9 * seen.max() + 1e-9  # some are left where nothing is seen
    chosen = rng.choice(len(points), count, replace=False, p=share / share.sum())
    return points[chosen]


def _middle(views: Sequence[Camera]) -> Float[np.ndarray, "3"]:
    """Returns the point with the least mean squared distance to the axes of the cameras. If the
    axes are parallel (`PARALLEL`), returns the point on the first camera's axis at the distance
    `extent_of(views)` in front of that camera.
    """
    poses = np.stack([np.asarray(camera.cam_from_world, np.float64) for camera in views])
    centers, axes = np.stack([np.asarray(camera.center) for camera in views]), poses[:, 2, :3]
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    normal = across.mean(axis=0)
    if np.linalg.eigvalsh(normal)[0] < PARALLEL:
        return centers[0] + float(extent_of(views)) * axes[0]
    return np.linalg.solve(normal, np.einsum("vij,vj->i", across, centers) / len(views))


def _at_points(points: np.ndarray, colors: np.ndarray, extent: float) -> Gaussians:
    """Returns round Gaussians at points. Their scales are `START_SHARE` times the mean distance to
    the three nearest points, between `SMALLEST` times the extent and the extent. The extent takes
    the place of that distance if there is only one point.
    """
    near = min(4, len(points))
    distances = np.full((len(points), 1), extent)
    if near > 1:
        distances = KDTree(points).query(points, k=near)[0][:, 1:]
    size = np.clip(START_SHARE * distances.mean(axis=1), SMALLEST * extent, extent)
    count = len(points)
    return Gaussians(
        jnp.asarray(points, jnp.float32),
        jnp.tile(jnp.asarray([1.0, 0.0, 0.0, 0.0]), (count, 1)),
        jnp.asarray(np.tile(size[:, None], (1, 3)), jnp.float32),
        jnp.full(count, START_OPACITY),
        jnp.asarray(np.clip(colors, 0, 1), jnp.float32),
    )
