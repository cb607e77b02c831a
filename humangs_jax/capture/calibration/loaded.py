"""Cameras of other tools as they stand in their world, with their lenses, for scenes of
Gaussians (`load_cameras`).
"""

import dataclasses
import functools
import os
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np

from humangs_jax.capture.calibration.importing import photo_size_of
from humangs_jax.core.array_types import Float
from humangs_jax.core.checks import checked_arguments
from humangs_jax.data.cameras import (
    CalibratedCamera,
    Calibration,
    in_capture_convention,
    read_calibration,
)
from humangs_jax.data.capture_checks import CaptureError
from humangs_jax.geometry.camera import Camera
from humangs_jax.io.reading import check_limit, reading


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class SceneCameras(Mapping[str, Camera]):
    """The cameras of a calibration by name, in the order of its file, and the points that it
    found; a mapping.
    """

    cameras: dict[str, Camera]
    """Cameras by name, or by the path of their image where the format has one for each."""
    points: Float[np.ndarray, "n 3"]
    """Points that the calibration found, (n, 3), metres; n = 0 where the format has none."""
    colors: Float[np.ndarray, "n 3"]
    """Colors of the points, (n, 3), RGB in [0, 1]; grey where the format has none."""

    def __getitem__(self, name: str) -> Camera:
        """The camera of that name."""
        return self.cameras[name]

    def __iter__(self) -> Iterator[str]:
        """The names."""
        return iter(self.cameras)

    def __len__(self) -> int:
        """How many cameras there are."""
        return len(self.cameras)

    def __repr__(self) -> str:
        """On one line."""
        return f"SceneCameras({len(self.cameras)} cameras, {len(self.points):,} points)"


@checked_arguments
def load_cameras(
    path: str | os.PathLike[str],
    images: str | os.PathLike[str] | None = None,
    *,
    lenses: bool = True,
    y_up: bool = False,
    scale: float = 1.0,
) -> SceneCameras:
    """The cameras of a calibration of COLMAP, nerfstudio, OpenCV and the others of docs/cameras.md,
    with their lenses.

    Args:
        path: A file or folder; its content decides which format it is.
        images: The folder of the photos, for formats that do not say how large they are.
        lenses: With the distortion that the file has, fisheyes included, as photos show it. False:
            as pinholes, for photos that are undistorted; a fisheye is refused.
        y_up: Turn the world from the axis that the format has up to y. False: it stays that of the
            file, in which Gaussians of other programs stand, too.
        scale: Metres per unit of the file.

    Returns:
        A mapping from names to cameras, pixel centres at +0.5, with the points that the calibration
        found.

    Raises:
        CaptureError: One line that names the file, the field and what was expected.

    Examples:
        >>> cameras = hg.load_cameras("garden/sparse/0")
        >>> photo = hg.render(hg.load_gaussians("garden.ply"), cameras["DSC07956.JPG"]).rgb
    """
    # cameras as captures have them, in the axes of the file unless y is to be up
    source = Path(path)
    folder = None if images is None else Path(images)
    with reading(source, "calibration", CaptureError):
        found = read_calibration(source, functools.partial(_size, source, folder), lenses)
        check_limit("views", len(found.cameras), "cameras")
        found = in_capture_convention(found, scale, found.up if y_up else "+y", found.pixel_centers)
        # a name that several images have gets a number from the second one on
        cameras: dict[str, Camera] = {}
        for each in found.cameras:
            name, count = each.name, 1
            while name in cameras:
                count += 1
                name = f"{each.name} ({count})"
            cameras[name] = _camera(each, source, folder, lenses)
    return SceneCameras(cameras, *_points(found))


def _camera(each: CalibratedCamera, source: Path, folder: Path | None, lenses: bool) -> Camera:
    """Raises: CaptureError for one that is not as cameras are."""
    width, height = each.width, each.height
    if width is None or height is None:
        width, height = _size(source, folder, each.name)
    distortion, lens = (each.distortion, each.lens) if lenses else (None, "pinhole")
    try:
        return Camera.from_opencv(each.K, each.cam_from_world, width, height, distortion, lens)
    except ValueError as error:
        raise CaptureError(source, each.name, error) from None


def _size(source: Path, folder: Path | None, name: str) -> tuple[int, int]:
    if folder is None:
        problem = "the file does not say how large its images are: expected `images`, their folder"
        raise CaptureError(source, name, problem)
    return photo_size_of(folder, source, name)


def _points(found: Calibration) -> tuple[np.ndarray, np.ndarray]:
    """Each point once, and its color."""
    seen = found.observations
    if seen is None:
        return np.zeros((0, 3), np.float32), np.zeros((0, 3), np.float32)
    points, first = np.unique(seen.points, axis=0, return_index=True)
    colors = np.full(points.shape, 0.5) if seen.colors is None else seen.colors[first] / 255
    return points.astype(np.float32), np.clip(colors, 0, 1).astype(np.float32)
