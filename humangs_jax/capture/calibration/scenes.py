"""Reads formats that list a camera for each image: COLMAP's models, transforms.json (NeRF,
nerfstudio, GaussianAvatars, VHAP), and the cameras.json that 3DGS writes beside its splats.

A COLMAP model is a folder with cameras.txt, images.txt and, optionally, points3D.txt, or with the
same files as .bin (https://colmap.github.io/format.html). images.txt has two lines for each image:
the pose (world to camera, OpenCV axes, quaternion wxyz) and the points seen, which may be empty.
Pixel centres are at +0.5. Unit and axes of the world are arbitrary.
"""

import dataclasses
import struct
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from humangs_jax.core.array_types import Float
from humangs_jax.data.cameras import (
    CONVENTIONS,
    UNDISTORT_BEFORE,
    WORLD_FROM_CAM,
    WORLD_FROM_CAM_OPENGL,
    CalibratedCamera,
    Calibration,
    CalibrationFile,
    Observations,
    fisheye_lens,
    image_size,
    intrinsics,
    pinhole_lens,
    pose_matrix,
    rotation,
)
from humangs_jax.data.capture_checks import (
    CaptureError,
    checked_text,
    expect,
    file_numbers,
    floats,
    members,
    required,
)
from humangs_jax.data.formats import CameraFormat
from humangs_jax.io.reading import InvalidFileError, read_bytes, reading, shown

Registered = tuple[str, str, str, Sequence[float], np.ndarray]
"""An image of a COLMAP model. The five entries are its position in the file (for errors), its name,
the id of its camera, seven numbers (quaternion w, x, y, z and translation), and its points, (n, 3),
each as x and y in pixels and the id of the 3D point.
"""
_PARAMETERS = {
    "SIMPLE_PINHOLE": ("f", "cx", "cy"),
    "PINHOLE": ("fx", "fy", "cx", "cy"),
    "SIMPLE_RADIAL": ("f", "cx", "cy", "k1"),
    "RADIAL": ("f", "cx", "cy", "k1", "k2"),
    "OPENCV": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2"),
    "OPENCV_FISHEYE": ("fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4"),
    "FULL_OPENCV": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
    "SIMPLE_RADIAL_FISHEYE": ("f", "cx", "cy", "k1"),
    "RADIAL_FISHEYE": ("f", "cx", "cy", "k1", "k2"),
    "SIMPLE_FISHEYE": ("f", "cx", "cy"),
    "FISHEYE": ("fx", "fy", "cx", "cy"),
}
"""Camera models and the names of their parameters, in the order of cameras.txt."""
NUMBERS = dict(zip((0, 1, 2, 3, 4, 5, 6, 8, 9, 14, 15), _PARAMETERS, strict=True))
"""Names of camera models by their numbers in cameras.bin."""
_NOT_READ = {
    7: "FOV",
    10: "THIN_PRISM_FISHEYE",
    11: "RAD_TAN_THIN_PRISM_FISHEYE",
    12: "SIMPLE_DIVISION",
    13: "DIVISION",
    16: "EUCM",
    17: "EQUIRECTANGULAR",
}
"""Names of the other camera models by their numbers, for errors."""


def read_colmap(source: CalibrationFile, format: CameraFormat) -> Calibration:
    """Reads a COLMAP model. There is one camera for each registered image, in the order of the
    images file.

    Raises: CaptureError, which names the file, and the line or the entry if one is wrong.
    ValueError if a line of text lacks words, or if the id of a point is no whole number.
    """
    # a model is text or binary; both are read into the same values
    text = any((source.path / name).is_file() for name in ("images.txt", "cameras.txt"))
    if text:
        suffix, read_cameras, read_images = ".txt", _text_cameras, _text_images
        read_points = _text_points
    else:
        suffix, read_cameras, read_images = ".bin", _binary_cameras, _binary_images
        read_points = _binary_points
    cameras_file, file, points_file = (
        source.path / f"{name}{suffix}" for name in ("cameras", "images", "points3D")
    )
    # an image has a pose, and shares its lens with others
    lenses = dict(read_cameras(cameras_file))
    cameras, seen = [], []
    for where, name, camera_id, pose, points in read_images(file):
        if camera_id not in lenses:
            raise CaptureError(file, where, f"camera {camera_id} is not in {cameras_file.name}")
        pose = _pose(pose, file, where)
        cameras.append(dataclasses.replace(lenses[camera_id], name=name, cam_from_world=pose))
        seen.append(points)
    if not cameras:
        raise CaptureError(file, "", "no image is registered in this model")
    # points that images see, for the check of the calibration
    places = dict(read_points(points_file)) if points_file.is_file() else {}
    rows = [
        (i, x, y, *places[int(p)])
        for i, points in enumerate(seen)
        for x, y, p in points
        if int(p) in places
    ]
    table = np.asarray(rows, np.float64)
    found = None
    if rows:
        owners = table[:, 0].astype(int)
        found = Observations(table[:, 3:6], owners, table[:, 1:3], table[:, 6:])
    return source.calibration(format, cameras, file=file, observations=found)


def _lens(
    model: str, size: Sequence[float | int], values: Sequence[float], file: Path, where: str
) -> CalibratedCamera:
    names = _PARAMETERS[model]
    p = dict(zip(names, floats(values, file, where, (len(names),)).tolist(), strict=True))
    focal = p.get("f", 0.0)
    K = intrinsics(p.get("fx", focal), p.get("fy", focal), p["cx"], p["cy"])
    if model.endswith("FISHEYE"):
        coefficients = [p.get(f"k{i}", 0.0) for i in (1, 2, 3, 4)]
        lens = fisheye_lens(coefficients, file, where, _refusal(model, file, where))
    else:
        keys = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
        lens = pinhole_lens([p.get(key, 0.0) for key in keys], file, where)
    return CalibratedCamera("", K, np.eye(4), *image_size(size, file, where), **lens)


def _check_camera_model(model: str, file: Path, where: str) -> None:
    if model not in _PARAMETERS:
        raise _refusal(model, file, where)


def _refusal(model: str, file: Path, where: str) -> CaptureError:
    supported = ", ".join(tuple(_PARAMETERS)[:5])  # the others have lenses that nobody undistorts
    return CaptureError(
        file, where, f"camera model {model}: expected one of {supported}; else {UNDISTORT_BEFORE}"
    )


def _pose(values: Sequence[float], file: Path, where: str) -> Float[np.ndarray, "4 4"]:
    from scipy.spatial.transform import Rotation

    quaternion, translation = np.split(floats(values, file, where, (7,)), [4])
    if not quaternion.any():
        raise CaptureError(file, where, "expected a quaternion QW QX QY QZ, got zeros")
    return pose_matrix(Rotation.from_quat(quaternion, scalar_first=True).as_matrix(), translation)


# Text
# --------------------------------------------------------------------------------------------------


def _lines(file: Path) -> Iterator[tuple[str, str]]:
    """Yields the position of each line, such as "line 3", and the line. Lines that begin with # are
    left out; empty lines are not.

    Raises: CaptureError, as `checked_text`.
    """
    lines = enumerate(checked_text(file).splitlines(), 1)
    return ((f"line {number}", line) for number, line in lines if not line.startswith("#"))


def _numbers(words: Iterable[str], file: Path, where: str) -> list[float]:
    try:
        return [float(word) for word in words]
    except ValueError as error:
        raise CaptureError(file, where, error) from None


def _text_cameras(file: Path) -> Iterator[tuple[str, CalibratedCamera]]:
    for where, line in _lines(file):
        if not line.strip():
            continue
        camera_id, model, *values = line.split()
        _check_camera_model(model, file, where)
        if len(values) != 2 + len(_PARAMETERS[model]):
            wanted = f"WIDTH HEIGHT {' '.join(_PARAMETERS[model])}"
            raise CaptureError(
                file, where, f"{model}: expected {wanted}, got {len(values)} numbers"
            )
        numbers = _numbers(values, file, where)
        yield camera_id, _lens(model, numbers[:2], numbers[2:], file, where)


def _text_images(file: Path) -> Iterator[Registered]:
    lines = _lines(file)
    for where, line in lines:
        if not line.strip():
            continue
        parts = line.split(maxsplit=9)  # names may have spaces
        if len(parts) < 10:
            raise CaptureError(file, where, "expected IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME")
        below, line = next(lines, (where, ""))
        words = line.split()
        if len(words) % 3:
            raise CaptureError(
                file, below, "expected X Y POINT3D_ID of each point (or an empty line)"
            )
        points = np.reshape(_numbers(words, file, below), (-1, 3))
        yield where, parts[9].strip(), parts[8], _numbers(parts[1:8], file, where), points


def _text_points(file: Path) -> Iterator[tuple[int, Sequence[float]]]:
    for where, line in _lines(file):
        if line.strip():
            number, *words = line.split()[:7]
            place = floats(_numbers(words[:3], file, where), file, where, (3,))
            grey = [128.0, 128.0, 128.0]  # a line may have no color
            color = _numbers(words[3:], file, where) if len(words) == 6 else grey
            yield int(number), [*place.tolist(), *color]


# Binary: read inside `reading`, which names the file
# -------------------------------------------------------------------


class _Bytes:
    """Reads the numbers of a file one after the other, little-endian.

    Raises: InvalidFileError if the file ends too early.
    """

    def __init__(self, file: Path):
        self.data, self.at = read_bytes(file, "mesh_bytes"), 0

    def take(self, size: int) -> bytes:
        """Returns the next `size` bytes."""
        self.at += size
        if self.at > len(self.data):
            raise InvalidFileError("not a readable COLMAP model: cut short, or damaged")
        return self.data[self.at - size : self.at]

    def read(self, kinds: str) -> tuple[Any, ...]:
        """Returns the next values in the file. kinds: their types, in the letters of `struct`."""
        return struct.unpack("<" + kinds, self.take(struct.calcsize("<" + kinds)))

    def name(self) -> str:
        """Returns the text up to the next zero byte."""
        end = self.data.find(b"\0", self.at)
        size = (end if end >= 0 else len(self.data)) - self.at
        return self.take(size + 1)[:-1].decode("utf-8", "replace")


def _binary_cameras(file: Path) -> Iterator[tuple[str, CalibratedCamera]]:
    with reading(file, "COLMAP model", CaptureError):
        data = _Bytes(file)
        for i in range(*data.read("Q")):
            camera_id, number, width, height = data.read("iiQQ")
            model = NUMBERS.get(number) or _NOT_READ.get(number, f"number {number}")
            _check_camera_model(model, file, f"camera {i}")
            values = data.read("d" * len(_PARAMETERS[model]))
            yield str(camera_id), _lens(model, (width, height), values, file, f"camera {i}")


def _binary_images(file: Path) -> Iterator[Registered]:
    with reading(file, "COLMAP model", CaptureError):
        data = _Bytes(file)
        for i in range(*data.read("Q")):
            _, *pose, camera_id = data.read("i7di")
            name, (count,) = data.name(), data.read("Q")
            rows = np.frombuffer(data.take(24 * count), np.dtype("<f8,<f8,<i8"))
            points = np.asarray(rows.tolist(), np.float64).reshape(-1, 3)
            if not np.isfinite(points).all():
                raise CaptureError(file, f"image {i}", "expected finite pixels")
            yield f"image {i}", name, str(camera_id), pose, points


def _binary_points(file: Path) -> Iterator[tuple[int, Sequence[float]]]:
    with reading(file, "COLMAP model", CaptureError):
        data = _Bytes(file)
        for i in range(*data.read("Q")):
            point, x, y, z, red, green, blue, _, track = data.read("Q3d3BdQ")
            data.take(8 * track)
            place = floats((x, y, z), file, f"point {i}", (3,))
            yield point, [*place.tolist(), red, green, blue]


# transforms.json
# --------------------------------------------------------------------------------------------------

_CAMERA_MODELS = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL")
"""Values of `camera_model` for lenses that can be undistorted."""
_FISHEYE_MODEL = "OPENCV_FISHEYE"
"""Value of `camera_model` for a fisheye lens."""
_OTHER_LENSES = ("ftheta_p0", "latlong", "equirectangular", "orthographic")
"""Keys that mark a lens that is not read, in files of instant-ngp."""
_MATRICES = ("K", "intrinsic_matrix", "intrinsics", "camera_intrinsics")
"""Keys that may hold a complete matrix K, in a frame or in the file."""


def recognizes_transforms(source: CalibrationFile) -> bool:
    """Returns whether a file is a JSON object with "frames"."""
    return isinstance(source.json, dict) and "frames" in source.json


def read_transforms(source: CalibrationFile, format: CameraFormat) -> Calibration:
    """Reads the cameras of `frames`, in their order.

    Raises: CaptureError if a value is missing or wrong. The error names its key.
    """
    values, file = source.json, source.path
    (frames,) = members(values, file, frames=list)
    if not frames:
        raise CaptureError(file, "frames", "expected at least one")
    for i, frame in enumerate(frames):
        expect(frame, dict, file, f"frames[{i}]")
    # the mask of VHAP, and of nerfstudio
    mask_key = next(
        (key for key in ("fg_mask_path", "mask_path") if any(key in frame for frame in frames)),
        None,
    )
    cameras = [
        _frame_camera(values | frame, file, f"frames[{i}].", source.photo_size)
        for i, frame in enumerate(frames)
    ]
    masks = [frame.get(mask_key) for frame in frames]
    for i, mask in enumerate(masks):
        if mask is not None:
            expect(mask, str, file, f"frames[{i}].{mask_key}")
    moments, stations = _find_moments(frames, cameras, file)
    placed = [
        dataclasses.replace(c, frame=f, mask=m)
        for c, f, m in zip(cameras, moments, masks, strict=True)
    ]
    return source.calibration(
        format, placed, convention=WORLD_FROM_CAM_OPENGL, stations=stations, mask_key=mask_key
    )


def _frame_camera(
    values: Mapping[str, Any], file: Path, prefix: str, photo_size: Callable[[str], tuple[int, int]]
) -> CalibratedCamera:
    """Returns the camera of one image, from the values of its frame and of the whole file.

    Raises: CaptureError if values are missing or wrong.
    """
    (name,) = members(values, file, prefix.rstrip("."), file_path=str)
    lens = _frame_lens(values, file, prefix)

    # the size of the image, where the file says it or the intrinsics depend on it
    size = None
    if "w" in values or "h" in values:
        sides = [required(values, key, file, prefix) for key in ("w", "h")]
        size = image_size(sides, file, f"{prefix}w, h")
    elif not ({"fl_x", "cx", "cy"} <= values.keys() or values.keys() & set(_MATRICES)):
        size = photo_size(name)
    K = _frame_intrinsics(values, size, file, prefix)
    width, height = size or (None, None)
    matrix = file_numbers(
        required(values, "transform_matrix", file, prefix), file, f"{prefix}transform_matrix"
    )
    if matrix.shape == (3, 4):  # nerfstudio and instant-ngp read no more than three rows
        matrix = np.vstack([matrix, [0.0, 0.0, 0.0, 1.0]])
    pose = floats(matrix, file, f"{prefix}transform_matrix", (4, 4))
    try:
        cam_from_world = CONVENTIONS[WORLD_FROM_CAM_OPENGL](pose)
    except np.linalg.LinAlgError:
        raise CaptureError(
            file, f"{prefix}transform_matrix", "expected a rigid transform, got a singular one"
        ) from None
    return CalibratedCamera(name, K, cam_from_world, width, height, **lens)


def _frame_intrinsics(
    values: Mapping[str, Any], size: tuple[int, int] | None, file: Path, prefix: str
) -> Float[np.ndarray, "3 3"]:
    """Returns K, from a complete matrix or from focal lengths (or angles of view) and a principal
    point. If the file has one focal length, it holds for both axes. If the file has no principal
    point, it is the middle of the image.

    Raises: CaptureError if a value is wrong, or if the file has no matrix, no focal length and no
    angle of view.
    """
    for key in _MATRICES:
        if key in values and "fl_x" not in values:
            return floats(values[key], file, f"{prefix}{key}", (3, 3))
    focal = {
        axis: _number(values, f"fl_{axis}", file, prefix) for axis in "xy" if f"fl_{axis}" in values
    }
    for axis, side in zip("xy", size or (), strict=False):
        if axis not in focal and f"camera_angle_{axis}" in values:
            angle = _number(values, f"camera_angle_{axis}", file, prefix)
            focal[axis] = 0.5 * side / np.tan(0.5 * angle)
    if not focal:
        raise CaptureError(file, f"{prefix}fl_x", "missing: expected fl_x or camera_angle_x, or K")
    either = next(iter(focal.values()))
    center = [
        _number(values, key, file, prefix) if key in values else 0.5 * side
        for key, side in zip(("cx", "cy"), size or (0, 0), strict=True)
    ]
    return intrinsics(focal.get("x", either), focal.get("y", either), *center)


def _frame_lens(values: Mapping[str, Any], file: Path, prefix: str) -> dict[str, Any]:
    """Returns the fields of `CalibratedCamera` that describe the lens. For a fisheye lens they
    include an error. Commands that need photos without distortion raise it later.

    Raises: CaptureError for a lens that cannot be read.
    """
    model, refusal = values.get("camera_model", "OPENCV"), None
    if model not in _CAMERA_MODELS:
        expected = f"expected {', '.join(_CAMERA_MODELS)}; else {UNDISTORT_BEFORE}"
        refusal = CaptureError(file, f"{prefix}camera_model", f"{shown(model)}: {expected}")
        if model != _FISHEYE_MODEL:
            raise refusal
    for key in _OTHER_LENSES:
        if values.get(key, False) is not False:
            problem = "expected a pinhole with the lens k1 k2 p1 p2 k3, or a fisheye"
            raise CaptureError(file, f"{prefix}{key}", problem)
    if values.get("is_fisheye") and refusal is None:
        problem = f"fisheye lenses are not supported: {UNDISTORT_BEFORE}"
        refusal = CaptureError(file, f"{prefix}is_fisheye", problem)

    def coefficients(*keys: str) -> list[float]:
        return [_number(values, key, file, prefix) if key in values else 0.0 for key in keys]

    if refusal is not None:
        return fisheye_lens(coefficients("k1", "k2", "k3", "k4"), file, f"{prefix}k1", refusal)
    beyond = coefficients("k4", "k5", "k6")
    # with k5 or k6, k4 is in OpenCV's denominator; alone it is Brown's (nerfstudio, Metashape)
    if beyond[0] and not any(beyond[1:]):
        problem = f"a radial coefficient of r^8 is not supported: {UNDISTORT_BEFORE}"
        raise CaptureError(file, f"{prefix}k4", problem)
    return pinhole_lens([*coefficients("k1", "k2", "p1", "p2", "k3"), *beyond], file, f"{prefix}k1")


def _number(values: Mapping[str, Any], key: str, file: Path, prefix: str) -> float:
    return float(floats(values[key], file, f"{prefix}{key}", ()))


# cameras.json of 3DGS
# --------------------------------------------------------------------------------------------------


def recognizes_splatting(source: CalibrationFile) -> bool:
    """Returns whether a file is a JSON list whose first entry has a name, a place and a rotation of
    3DGS.
    """
    first = source.json[:1] if isinstance(source.json, list) else []
    return bool(first) and {"img_name", "position", "rotation"} <= first[0].keys()


def read_splatting(source: CalibrationFile, format: CameraFormat) -> Calibration:
    """Reads the cameras of the list. `rotation` and `position` place the camera in the world, with
    OpenCV's axes. The principal point is the middle of the image.

    Raises: CaptureError if a value is missing or wrong. The error names its key.
    """
    cameras, file = [], source.path
    for i, entry in enumerate(source.json):
        prefix = f"[{i}]."
        expect(entry, dict, file, f"[{i}]")
        (name,) = members(entry, file, f"[{i}]", img_name=str)
        sides = [required(entry, key, file, prefix) for key in ("width", "height")]
        width, height = image_size(sides, file, f"{prefix}width, height")
        focal = []
        for key in ("fx", "fy"):
            required(entry, key, file, prefix)
            focal.append(_number(entry, key, file, prefix))
        turn = rotation(required(entry, "rotation", file, prefix), file, f"{prefix}rotation").T
        place = required(entry, "position", file, prefix)
        pose = pose_matrix(turn, -turn @ floats(place, file, f"{prefix}position", (3,)))
        K = intrinsics(*focal, 0.5 * width, 0.5 * height)
        cameras.append(CalibratedCamera(name, K, pose, width, height))
    return source.calibration(format, cameras, convention=WORLD_FROM_CAM)


# Moments
# --------------------------------------------------------------------------------------------------


def _find_moments(
    frames: Sequence[Mapping[str, Any]], cameras: Sequence[CalibratedCamera], file: Path
) -> tuple[list[int], int]:
    """Returns the number of each image's moment, counted from 0 in the order of time, and the
    number of cameras.

    Raises: CaptureError if only some images have a time or only some have a camera name, if a time
    or a camera name is neither a number nor text, if some times are numbers and others text, if two
    images have the same camera name and the same time, or if the file has no times and one of
    several cameras has several images.
    """
    # which moment and which camera an image is of, by the first of these keys that is there
    of_time = (
        "timestep_index",
        "timestep",
        "timestep_index_original",
        "time",
        "timestamp",
        "time_id",
        "timestep_id",
    )
    key, times = _values(frames, of_time, file)
    of_camera = ("camera_index", "camera_id", "cam_id", "camera_label")
    owner, owners = _values(frames, of_camera, file)
    # a camera without a name is known by its pose, but for rounding
    if not owner:
        owners = [
            tuple(np.round(camera.cam_from_world / 1e-9).ravel().tolist()) for camera in cameras
        ]
    first: dict[Any, int] = {}
    again = [(first.setdefault(each, i), i) for i, each in enumerate(owners)]
    repeated = next(((a, b) for a, b in again if a != b), None)
    # without times, one camera has a moment for each image, and several cameras one moment
    if not key and len(first) == 1:
        return list(range(len(frames))), 1
    if not key and repeated is not None:
        which = f"the {owner} {owners[repeated[0]]}" if owner else "the same camera pose"
        problem = (
            f"frames[{repeated[0]}] and frames[{repeated[1]}] have {which}, so they show different"
            " moments"
        )
        raise CaptureError(
            file,
            "frames",
            f"{problem}: expected timestep_index or time in each frame to tell which are of one",
        )
    # at most one image of a camera at a moment
    ranks = _ranks(times, key, file) if key else [0] * len(frames)
    taken: dict[Any, int] = {}
    for i, moment in enumerate(zip(owners, ranks, strict=True)):
        other = taken.setdefault(moment, i)
        if owner and other != i:
            problem = (
                f"the {owner} and {key} of frames[{other}]: expected one photo of a camera at a"
                " moment"
            )
            raise CaptureError(file, f"frames[{i}]", problem)
    return ranks, len(first)


def _values(
    frames: Sequence[Mapping[str, Any]], keys: Sequence[str], file: Path
) -> tuple[str, list[Any]]:
    """Returns the first of `keys` that any image has, and its value in each image, which is a
    number or text. If no image has any of the keys, it returns "" and an empty list.

    Raises: CaptureError if only some images have the key, or if a value is neither a finite number
    nor text.
    """
    key = next((key for key in keys if any(key in frame for frame in frames)), "")
    values = []
    if not key:
        return key, values
    for i, frame in enumerate(frames):
        if key not in frame:
            raise CaptureError(
                file,
                f"frames[{i}].{key}",
                "missing, but other frames have it: expected all or none",
            )
        value = frame[key]
        if not isinstance(value, str):
            floats(expect(value, float, file, f"frames[{i}].{key}"), file, f"frames[{i}].{key}", ())
        values.append(value)
    return key, values


def _ranks(times: Sequence[Any], key: str, file: Path) -> list[int]:
    if len({isinstance(time, str) for time in times}) > 1:
        raise CaptureError(file, key, "expected numbers or names, got both")
    known = sorted(set(times))
    ranks = range(len(known))
    if not isinstance(known[0], str):
        # times that differ by less are one moment written twice
        tolerance = 1e-6 * max(1.0, abs(known[-1]))
        ranks = np.cumsum(np.diff(known, prepend=known[0]) > tolerance).tolist()
    rank = dict(zip(known, ranks, strict=True))
    return [rank[time] for time in times]
