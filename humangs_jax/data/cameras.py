"""A calibration of any format in memory: its cameras, their conversion to the convention of
captures, lens distortion, and checks.

Readers return a `Calibration`. Its cameras have OpenCV's axes (x right, y down, z forward). The
world's up axis and the place of pixel centres are those of the format. So is the unit of length,
unless the reader has converted lengths to metres. `in_capture_convention` changes these to metres,
y up and pixel centres at +0.5.
"""

import dataclasses
import functools
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np

from humangs_jax.core.array_types import Float, Int
from humangs_jax.data.capture_checks import (
    CaptureError,
    checked_json,
    checked_text,
    file_numbers,
    floats,
)
from humangs_jax.data.formats import CAMERAS, CameraFormat
from humangs_jax.data.unknown import binary_kind, described
from humangs_jax.io.reading import limits, reading

ROUNDED_ROTATION = 5e-3
"""Largest difference of an entry of R R^T from the identity at which R counts as a rounded
rotation. Rounding to three decimals (EasyMocap) stays below it. Rounded rotations are replaced by
the nearest rotation.
"""
LARGEST_COEFFICIENT = 1e100
"""Coefficients of a lens are clipped to this magnitude where the reach of the lens is computed, so
that the numbers stay finite.
"""
ROTATION_TO_Y_UP = {
    "+x": ((0, -1, 0), (1, 0, 0), (0, 0, 1)),
    "-x": ((0, 1, 0), (-1, 0, 0), (0, 0, 1)),
    "+y": ((1, 0, 0), (0, 1, 0), (0, 0, 1)),
    "-y": ((1, 0, 0), (0, -1, 0), (0, 0, -1)),
    "+z": ((1, 0, 0), (0, 0, 1), (0, -1, 0)),
    "-z": ((1, 0, 0), (0, 0, -1), (0, 1, 0)),
}
"""For each axis that may point up in the source, the rotation that takes it to +y."""
OPENGL_FROM_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])
"""The matrix that turns camera axes with y down and z forward into axes with y up and z backward.
It is its own inverse.
"""
CAM_FROM_WORLD = "cam_from_world, OpenCV axes"
"""Convention of matrices that take points of the world to the axes of the camera (x right, y down,
z forward).
"""
WORLD_FROM_CAM = "world_from_cam, OpenCV axes"
"""Convention of matrices that take points from the axes of the camera (x right, y down, z forward)
to the world.
"""
CAM_FROM_WORLD_OPENGL = "cam_from_world, OpenGL axes"
"""Convention of matrices that take points of the world to the axes of the camera (x right, y up, z
backward).
"""
WORLD_FROM_CAM_OPENGL = "world_from_cam, OpenGL axes"
"""Convention of matrices that take points from the axes of the camera (x right, y up, z backward)
to the world.
"""
CONVENTIONS = {
    CAM_FROM_WORLD: lambda matrix: matrix,
    WORLD_FROM_CAM: np.linalg.inv,
    CAM_FROM_WORLD_OPENGL: lambda matrix: OPENGL_FROM_OPENCV @ matrix,
    WORLD_FROM_CAM_OPENGL: lambda matrix: OPENGL_FROM_OPENCV @ np.linalg.inv(matrix),
}
"""The meanings that a matrix in a file may have, each with a function from the matrix to
cam_from_world with OpenCV's axes.
"""
PixelCenters = Literal["integer", "half"]
"""Where the centre of the first pixel is: at (0, 0), as OpenCV has it, or at (0.5, 0.5)."""


@dataclasses.dataclass(frozen=True, eq=False)
class CalibratedCamera:
    """One camera. In formats with one camera for each image, the camera of one image."""

    name: str
    """The name of the camera, or the image's path as the file has it."""
    K: Float[np.ndarray, "3 3"]
    """The camera matrix, (3, 3), pixels."""
    cam_from_world: Float[np.ndarray, "4 4"]
    """From the world to the camera, (4, 4), OpenCV axes."""
    width: int | None = None
    """The width of the image, pixels; None where the format does not say."""
    height: int | None = None
    """The height of the image, pixels; None where the format does not say."""
    distortion: Float[np.ndarray, " coefficients"] | None = None
    """Coefficients of the lens in OpenCV's order: k1 k2 p1 p2 k3. Cameras with a `refusal` have
    other coefficients: 8 or 12, or at least 4 of a fisheye. None: the lens does not distort.
    """
    frame: int = 0
    """The frame of the image, counted from 0, where there is one camera for each image."""
    mask: str | None = None
    """The path of the image's mask, where there is one camera for each image."""
    lens: str = "pinhole"
    """The kind of the lens, as `geometry.lens` names it."""
    refusal: CaptureError | None = None
    """The error to raise if photos of this camera have to be undistorted. It is set if this package
    cannot undistort them (fisheyes, more than five coefficients). None: it can.
    """


@dataclasses.dataclass(frozen=True, eq=False)
class Observations:
    """Points that the cameras saw while they were calibrated. There is a row for each time that a
    camera saw a point. To check a calibration, the points are projected and compared with `pixels`.
    """

    points: Float[np.ndarray, "n 3"]
    """Place of the point in the world, (n, 3), in the calibration's unit."""
    cameras: Int[np.ndarray, " n"]
    """Index of the camera that saw the point, (n,)."""
    pixels: Float[np.ndarray, "n 2"]
    """Place at which the camera saw the point, (n, 2), pixels, distortion included."""
    colors: Float[np.ndarray, "n 3"] | None = None
    """The color of the point, (n, 3), 0 to 255; None where the format has none."""


@dataclasses.dataclass(frozen=True, eq=False)
class Calibration:
    """Everything that a calibration says."""

    format: str
    """The name of the format that it was read as."""
    file: Path
    """The file that errors name."""
    cameras: tuple[CalibratedCamera, ...]
    """The cameras, at least one."""
    per_image: bool
    """Whether `cameras` has an entry for each image. False: it has one for each real camera, which
    may have taken many images.
    """
    pixel_centers: PixelCenters
    """Where the centre of the first pixel is in this format, unless the user says otherwise."""
    up: str
    """The world's up axis in this format, unless the user says otherwise."""
    observations: Observations | None = None
    """The points that the cameras saw while they were calibrated. None if there are none, or if the
    format has none.
    """
    convention: str = CAM_FROM_WORLD
    """What the matrices in the file mean, a key of `CONVENTIONS`."""
    stations: int | None = None
    """The number of cameras that took the images, where the format says it. None: one for each of
    `cameras`.
    """
    mask_key: str | None = None
    """The key under which the file names masks; None if it does not."""
    upright: bool = False
    """Whether it is certain that the cameras belong to photos that were turned by their EXIF
    orientation. If False, the sizes of photos and cameras decide.
    """
    estimated: bool = False
    """Whether the cameras were found from the person."""
    unit: float | None = None
    """Metres per unit of length. None: the format states no unit, or its reader converts lengths to
    metres.
    """

    def with_cameras(self, kept: Sequence[int]) -> "Calibration":
        """Returns the calibration of the cameras with these indices, and of the points that they
        saw. Frames are numbered again from 0, without gaps.
        """
        cameras = [self.cameras[i] for i in kept]
        frames = {frame: i for i, frame in enumerate(sorted({camera.frame for camera in cameras}))}
        cameras = [dataclasses.replace(camera, frame=frames[camera.frame]) for camera in cameras]
        seen = self.observations
        if seen is not None:
            new = np.full(len(self.cameras), -1)
            new[list(kept)] = np.arange(len(kept))
            own = new[seen.cameras] >= 0
            colors = None
            if seen.colors is not None:
                colors = seen.colors[own]
            seen = Observations(seen.points[own], new[seen.cameras[own]], seen.pixels[own], colors)
            if not own.any():
                seen = None
        stations = None
        if self.stations is not None:
            stations = min(self.stations, len(cameras))
        return dataclasses.replace(
            self, cameras=tuple(cameras), observations=seen, stations=stations
        )


@dataclasses.dataclass(frozen=True, eq=False)
class CalibrationFile:
    """The file that a reader of a calibration format gets."""

    path: Path
    """The path of a file, or of the folder where a format has several files."""
    photo_size: Callable[[str], tuple[int, int]]
    """Takes the name of a photo, and returns the photo's width and height. Some readers need it if
    the file does not say the size.
    """

    @functools.cached_property
    def text(self) -> str:
        """The text of the file. Raises: CaptureError."""
        return checked_text(self.path)

    @functools.cached_property
    def json(self) -> Any:
        """The value of a file that begins like a JSON object or like a list of objects, else None.

        Raises: CaptureError.
        """
        if re.match(r"\s*(\{|\[\s*\{)", self.text):
            return checked_json(self.path, self.text)
        return None

    def calibration(
        self,
        format: CameraFormat,
        cameras: Sequence[CalibratedCamera],
        file: Path | None = None,
        **more: Any,
    ) -> Calibration:
        """Returns a calibration of these cameras with the conventions of the format. file: the file
        that errors name; None: `path`.
        """
        what = (
            format.about,
            file or self.path,
            tuple(cameras),
            format.per_image,
            format.pixel_centers,
            format.up,
        )
        return Calibration(*what, unit=format.unit, **more)


def read_calibration(
    path: Path, photo_size: Callable[[str], tuple[int, int]], any_lens: bool = False
) -> Calibration:
    """Read the calibration in a file or folder. Its content decides which of the `CAMERAS` formats
    it has; formats of several files are known by the file names.

    photo_size: as in `CalibrationFile`. any_lens: whether to accept lenses whose photos this
    package cannot undistort.

    Raises: CaptureError, one line that names the file and what was expected.
    """
    calibration = _read(path, photo_size)
    if not calibration.cameras:
        raise CaptureError(calibration.file, "", "has no camera: expected at least one")
    refusals = (camera.refusal for camera in calibration.cameras if camera.refusal is not None)
    refusal = None if any_lens else next(refusals, None)
    if refusal is not None:
        raise refusal
    return calibration


def _read(path: Path, photo_size: Callable[[str], tuple[int, int]]) -> Calibration:
    if not path.exists():
        raise CaptureError(path, "", "no such file or folder")
    with reading(path, "calibration", CaptureError):
        if path.is_dir():
            format, file = CAMERAS.found(path) or (None, None)
        else:
            format, file = CAMERAS.of_name(path), path
        if file is None:
            raise CaptureError(path, "", f"no cameras found: expected {CAMERAS.listed()}")
        if format is not None and format.folder:
            return format(CalibrationFile(file.parent, photo_size), format)
        source = CalibrationFile(file, photo_size)
        found = binary_kind(file)
        format = None
        if found is None or file.suffix.lower() in CAMERAS.suffixes:
            format = CAMERAS.of_content(source)
        if format is None:
            if found is None:
                found = described(source.text)
            raise CaptureError(file, found, f"not a known format: expected {CAMERAS.listed()}")
        return format(source, format)


def in_capture_convention(
    calibration: Calibration, scale: float, up: str, pixel_centers: str
) -> Calibration:
    """Returns the calibration with cameras and points in metres, y up and pixel centres at +0.5.
    Rotations that were rounded become orthonormal, see `nearest_rotation`.

    Arguments:
        scale: metres per unit of the source.
        up: the axis of the source that points up, a key of `ROTATION_TO_Y_UP`.
        pixel_centers: "integer" adds 0.5 to the principal point, "half" leaves it.
    """
    turn = np.asarray(ROTATION_TO_Y_UP[up], float)
    shift = 0.5 if pixel_centers == "integer" else 0.0
    seen = calibration.observations
    if seen is not None:
        seen = dataclasses.replace(
            seen, points=scale * seen.points @ turn.T, pixels=seen.pixels + shift
        )
    cameras = []
    for camera in calibration.cameras:
        K, pose = camera.K.copy(), camera.cam_from_world.copy()
        K[:2, 2] += shift
        pose[:3, :3] = nearest_rotation(pose[:3, :3]) @ turn.T
        pose[:3, 3] *= scale
        cameras.append(dataclasses.replace(camera, K=K, cam_from_world=pose))
    return dataclasses.replace(
        calibration, cameras=tuple(cameras), observations=seen, up="+y", pixel_centers="half"
    )


def nearest_rotation(matrix: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "3 3"]:
    """Returns the rotation nearest to a rounded rotation matrix. A matrix that mirrors, or that
    deviates by more than rounding explains, is returned as it is.
    """
    if np.abs(matrix @ matrix.T - np.eye(3)).max() > ROUNDED_ROTATION or np.linalg.det(matrix) < 0:
        return matrix
    u, _, vt = np.linalg.svd(matrix)
    return u @ vt


# Values of files
# --------------------------------------------------------------------------------------------------


def image_size(value: Any, file: object, field: str) -> tuple[int, int]:
    """Returns width and height in whole pixels, read from `value`.

    Raises: CaptureError unless these are two positive whole numbers within the limit `side`.
    """
    width, height = floats(value, file, field, (2,)).tolist()
    if not (
        width.is_integer()
        and height.is_integer()
        and min(width, height) > 0
        and max(width, height) <= limits().side
    ):
        raise CaptureError(
            file, field, f"expected width and height in pixels, got {width:g} x {height:g}"
        )
    return int(width), int(height)


def intrinsics(fx: float, fy: float, cx: float, cy: float) -> Float[np.ndarray, "3 3"]:
    """Returns the camera matrix K of focal lengths and a principal point, pixels."""
    return np.asarray([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], np.float64)


def pose_matrix(
    rotation: Float[np.ndarray, "3 3"], translation: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "4 4"]:
    """Returns the matrix [[R, t], [0, 0, 0, 1]]."""
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, translation
    return pose


def rotation(value: Any, file: object, field: str) -> Float[np.ndarray, "3 3"]:
    """Returns the 3 x 3 matrix of a rotation in a file. value: the 9 numbers of the matrix, or the
    3 numbers of a rotation vector (cv2.Rodrigues). A matrix is not checked to be a rotation.

    Raises: CaptureError if these are not 9 or 3 finite numbers.
    """
    from scipy.spatial.transform import Rotation

    values = file_numbers(value, file, field)
    if values.size == 3:
        return Rotation.from_rotvec(values.ravel()).as_matrix()
    return floats(values, file, field, (3, 3))


# Lenses
# --------------------------------------------------------------------------------------------------
# Brown and Conrady's distortion with OpenCV's coefficients k1 k2 p1 p2 k3 (calib3d): of a point (x,
# y) = (X / Z, Y / Z) in front of the camera, with r^2 = x^2 + y^2, the lens makes
#
#     x' = x (1 + k1 r^2 + k2 r^4 + k3 r^6) + 2 p1 x y + p2 (r^2 + 2 x^2)
#     y' = y (1 + k1 r^2 + k2 r^4 + k3 r^6) + p1 (r^2 + 2 y^2) + 2 p2 x y

UNDISTORT_BEFORE = (
    "undistort the photos before (cv2.undistort, cv2.fisheye or colmap image_undistorter)"
)
COUNTS = (4, 5, 8, 12, 14)
"""The numbers of coefficients that OpenCV's calibration writes. From the sixth on, these are k4 k5
k6, s1..s4, tx ty.
"""


def brown_conrady(values: Any, file: object, field: str) -> Float[np.ndarray, "5"] | None:
    """Returns k1 k2 p1 p2 k3 of OpenCV's list of coefficients; None if all are 0.

    Raises: CaptureError as `pinhole_lens`, and if a coefficient beyond the first five is not 0.
    """
    fields = pinhole_lens(values, file, field)
    if "refusal" in fields:
        raise fields["refusal"]
    return fields["distortion"]


def pinhole_lens(values: Any, file: object, field: str) -> dict[str, Any]:
    """Returns the fields of a `CalibratedCamera` for OpenCV's list of coefficients.

    Raises: CaptureError unless these are 4, 5, 8, 12 or 14 finite numbers, and if one of the last
    two of 14 (a tilted sensor) is not 0.
    """
    values = file_numbers(values, file, field).ravel()
    if len(values) not in COUNTS:
        raise CaptureError(file, field, f"expected k1 k2 p1 p2 [k3], got {len(values)} numbers")
    beyond = f"coefficients beyond k1 k2 p1 p2 k3 are not supported: {UNDISTORT_BEFORE}"
    refusal = CaptureError(file, field, beyond)
    if values[12:].any():
        raise refusal
    if values[5:].any():
        return {"distortion": values[: 8 if not values[8:].any() else 12], "refusal": refusal}
    five = np.pad(values[:5], (0, max(0, 5 - len(values))))
    return {"distortion": five if values.any() else None}


def fisheye_lens(values: Any, file: object, field: str, refusal: CaptureError) -> dict[str, Any]:
    """Returns the fields of a `CalibratedCamera` for the coefficients k1 k2 k3 k4 of a fisheye.
    Missing coefficients become 0. Coefficients after k4 are kept unless all of them are 0.

    refusal: the error to raise if photos have to be undistorted. Raises: CaptureError unless the
    coefficients are finite numbers.
    """
    values = file_numbers(values, file, field).ravel()
    if values[4:].any():
        coefficients = values
    else:
        coefficients = np.pad(values[:4], (0, max(0, 4 - len(values))))
    return {"distortion": coefficients, "lens": "fisheye", "refusal": refusal}


def distort(
    points: Float[np.ndarray, "*n 2"], coefficients: Float[np.ndarray, "5"]
) -> Float[np.ndarray, "*n 2"]:
    """Returns where the lens puts points (x, y) of the plane z = 1."""
    k1, k2, p1, p2, k3 = coefficients
    x, y = points[..., 0], points[..., 1]
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    moved = (
        x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
        y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
    )
    return np.stack(moved, axis=-1)


def undistort(
    image: Float[np.ndarray, "h w *c"],
    K: Float[np.ndarray, "3 3"],
    coefficients: Float[np.ndarray, "5"],
    fill: float,
    box: tuple[slice, slice] = (slice(None), slice(None)),
) -> Float[np.ndarray, "h w *c"]:
    """Returns the photo that a pinhole camera with the same K (pixel centres at +0.5) would have
    taken, interpolated bilinearly, float32.

    Pixels get the value `fill` if the photo does not show them, or if they lie outside of `box`
    (rows, columns).
    """
    from skimage.transform import warp

    height, width = image.shape[:2]
    columns, rows = np.meshgrid(np.arange(width)[box[1]] + 0.5, np.arange(height)[box[0]] + 0.5)
    where = np.moveaxis(
        _in_photo(np.stack([columns, rows], axis=-1), K, coefficients) - 0.5, -1, 0
    )[::-1]
    channels = np.atleast_3d(image).transpose(2, 0, 1)
    warped = [
        warp(c, where, order=1, mode="constant", cval=fill, preserve_range=True) for c in channels
    ]
    result = np.full(image.shape, fill, np.float32)
    result[box] = np.stack(warped, axis=-1).reshape(result[box].shape)
    return result


def undistort_person(
    image: Float[np.ndarray, "h w 3"],
    mask: Float[np.ndarray, "h w"],
    K: Float[np.ndarray, "3 3"],
    coefficients: Float[np.ndarray, "5"],
) -> tuple[Float[np.ndarray, "h w 3"], Float[np.ndarray, "h w"]]:
    """Returns a photo on white and its mask, both without distortion. Only pixels near the person
    are computed, because this is faster. The others become white, with 0 in the mask.
    """
    step = 16
    rows, columns = (np.arange(0.0, size + step, step) for size in mask.shape)
    source = _in_photo(np.stack(np.meshgrid(columns, rows), axis=-1), K, coefficients)
    person = np.argwhere(mask > 0)[:, ::-1]
    # a cell more than the person on every side
    near = []
    if len(person):
        near = [((source > person.min(0) - step) & (source < person.max(0) + step)).all(axis=-1)]
    if not np.any(near):
        return np.ones_like(image), np.zeros_like(mask)
    box = [
        slice(max(0, each.min() - 1) * step, (each.max() + 1) * step)
        for each in np.nonzero(near[0])
    ]
    both = undistort(np.dstack([1 - image, mask]), K, coefficients, 0.0, (box[0], box[1]))
    return 1 - both[..., :3], both[..., 3]


def _in_photo(
    pixels: Float[np.ndarray, "*n 2"],
    K: Float[np.ndarray, "3 3"],
    coefficients: Float[np.ndarray, "5"],
) -> Float[np.ndarray, "*n 2"]:
    """Returns the places of points in a distorted photo, pixels, (*n, 2). pixels: the places of
    these points in the photo of a pinhole camera with the same K.

    Pixel centres are at +0.5. Points that the lens cannot show are put far outside.
    """
    plane = (pixels - K[:2, 2]) / np.diag(K)[:2]
    source = distort(plane, coefficients) * np.diag(K)[:2] + K[:2, 2]
    source[(plane**2).sum(axis=-1) >= _squared_reach(coefficients)] = -1e4
    return source


def _squared_reach(coefficients: Sequence[float | int] | np.ndarray) -> float:
    """Returns the squared radius r^2 on the plane z = 1 up to which the distorted radius, r (1 + k1
    r^2 + ..), grows. Returns infinity if it always grows.

    Beyond this radius the formula folds the image back over itself.
    """
    k1, k2, _, _, k3 = np.clip(coefficients, -LARGEST_COEFFICIENT, LARGEST_COEFFICIENT)
    # 1 / r^2, so that tiny coefficients are not divided by
    roots = np.roots([1, 3 * k1, 5 * k2, 7 * k3])
    real = roots[(np.abs(roots.imag) <= 1e-9 * np.abs(roots.real)) & (roots.real > 0)].real
    return 1 / real.max() if len(real) else np.inf
