"""Loads cameras of other tools, with their lenses, for scenes of Gaussians (`load_cameras`). The
cameras keep the axes of their world, unless `y_up` is set.
"""

import dataclasses
import functools
import os
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np

from humangs_jax.capture.calibration.photos import photo_of, photo_size
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
    """The cameras of a calibration as a mapping from their names, in the order of the file. It also
    has the points that the calibration found.
    """

    cameras: dict[str, Camera]
    """Cameras by name, or by the path of their image if the format has a camera for each image. If
    a name is repeated, the second camera gets " (2)" after its name, the third " (3)", and so on.
    """
    points: Float[np.ndarray, "n 3"]
    """Points that the calibration found, (n, 3), in the unit and the axes of the cameras. Only
    points that an image shows are here. n = 0 if there are none.
    """
    colors: Float[np.ndarray, "n 3"]
    """Colors of the points, (n, 3), RGB in [0, 1]. Grey if the calibration has no colors."""

    def __getitem__(self, name: str) -> Camera:
        """Returns the camera of this name."""
        return self.cameras[name]

    def __iter__(self) -> Iterator[str]:
        """Yields the names."""
        return iter(self.cameras)

    def __len__(self) -> int:
        """Returns the number of cameras."""
        return len(self.cameras)

    def __repr__(self) -> str:
        """Returns the numbers of cameras and points, in one line."""
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
    """Returns the cameras of a calibration, with their lenses. The calibration may come from
    COLMAP, nerfstudio, OpenCV or another tool in docs/cameras.md.

    Args:
        path: File or folder. The format is found from its content.
        images: Folder of the photos, for formats that do not state the photos' sizes.
        lenses: Whether the cameras keep the lens distortion of the file, also of fisheyes, as the
            photos show it. False: the cameras are pinholes, for photos that are undistorted. A
            lens that `humangs import cameras` cannot undistort, such as a fisheye, then raises an
            error.
        y_up: Whether the world is turned so that the format's up axis becomes y. False: the axes
            of the file are kept. Gaussians that other programs fitted to these cameras have these
            axes.
        scale: Metres per unit of the file.

    Returns:
        A mapping from names to cameras, with pixel centres at +0.5, and the points that the
        calibration found.

    Raises:
        CaptureError: One line that names the file, the field if one is wrong, and the problem.

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
    """Returns a camera of the calibration. If the file does not state the size of the camera's
    images, the size of the photo is used.

    Raises: CaptureError if the size is not known, or if `Camera` refuses the values.
    """
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
    return photo_size(photo_of(folder, name, source))


def _points(found: Calibration) -> tuple[np.ndarray, np.ndarray]:
    """Returns the distinct points of a calibration, (n, 3), and their colors, (n, 3), RGB in [0,
    1].
    """
    seen = found.observations
    if seen is None:
        return np.zeros((0, 3), np.float32), np.zeros((0, 3), np.float32)
    points, first = np.unique(seen.points, axis=0, return_index=True)
    colors = np.full(points.shape, 0.5) if seen.colors is None else seen.colors[first] / 255
    return points.astype(np.float32), np.clip(colors, 0, 1).astype(np.float32)
