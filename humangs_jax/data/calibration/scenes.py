"""Formats with a camera for each image: COLMAP's models, and transforms.json (NeRF, nerfstudio, GaussianAvatars, VHAP).

COLMAP: a folder with cameras.txt, images.txt and, optionally, points3D.txt, or the same as .bin
(https://colmap.github.io/format.html). images.txt has two lines for each image: the pose (world to camera, OpenCV axes,
quaternion wxyz) and the points seen, which may be empty. Pixel centres are at +0.5; unit and axes of the world are arbitrary.
"""

import dataclasses
import struct
from collections.abc import Callable, Hashable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from humangs_jax.core.array_types import Float
from humangs_jax.data.calibration.calibration import (
    CONVENTIONS,
    UNDISTORT_BEFORE,
    WORLD_FROM_CAM_OPENGL,
    CalibratedCamera,
    Calibration,
    Observations,
    Source,
    brown_conrady,
    image_size,
    intrinsics,
    pose_matrix,
)
from humangs_jax.data.capture_checks import CaptureError, checked_text, floats, required
from humangs_jax.data.formats import CameraFormat
from humangs_jax.io.reading import read_bytes, reading, shown

Registered = tuple[str, np.ndarray, str, str, np.ndarray]
"""Of an image: where it stands, cam_from_world, name, number of the camera, (n, 3) points as x y id."""
PARAMETERS = {
    "SIMPLE_PINHOLE": ("f", "cx", "cy"),
    "PINHOLE": ("fx", "fy", "cx", "cy"),
    "SIMPLE_RADIAL": ("f", "cx", "cy", "k1"),
    "RADIAL": ("f", "cx", "cy", "k1", "k2"),
    "OPENCV": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2"),
}
"""Camera models and their parameters in cameras.txt; in cameras.bin they are numbered in this order."""


def read_colmap(source: Source, format: CameraFormat) -> Calibration:
    """The registered images of a text model, in the order of images.txt. Raises: CaptureError naming file and line."""
    folder = source.path
    binary = not any((folder / name).is_file() for name in ("images.txt", "cameras.txt"))
    suffix = ".bin" if binary else ".txt"
    lenses = (_binary_cameras if binary else _read_cameras)(folder / f"cameras{suffix}")
    file, points_file = folder / f"images{suffix}", folder / f"points3D{suffix}"
    cameras, seen = [], []
    for where, pose, name, camera_id, points in (_binary_images if binary else _read_images)(file):
        if camera_id not in lenses:
            raise CaptureError(file, str(where), f"camera {camera_id} is not in cameras{suffix}")
        cameras.append(dataclasses.replace(lenses[camera_id], name=name, cam_from_world=pose))
        seen.append(points)
    if not cameras:
        raise CaptureError(file, "", "no image is registered in this model")
    places = (_binary_points if binary else _read_points)(points_file) if points_file.is_file() else {}
    return source.calibration(format, cameras, file=file, observations=_observations(seen, places))


def _read_cameras(file: Path) -> dict[str, CalibratedCamera]:
    lenses = {}
    for number, line in _data_lines(file):
        camera_id, model, *values = line.split()
        if model not in PARAMETERS:
            supported = ", ".join(PARAMETERS)
            raise CaptureError(
                file, f"line {number}", f"camera model {model}: expected one of {supported}; else {UNDISTORT_BEFORE}"
            )
        where, names = f"line {number}", PARAMETERS[model]
        if len(values) != 2 + len(names):
            raise CaptureError(file, where, f"{model}: expected WIDTH HEIGHT {' '.join(names)}, got {len(values)} numbers")
        numbers = _numbers(values, file, where)
        lenses[camera_id] = _lens(model, numbers[:2], numbers[2:], file, where)
    return lenses


def _lens(model: str, size: Sequence[float], values: Sequence[float], file: Path, where: str) -> CalibratedCamera:
    p = dict(zip(PARAMETERS[model], values, strict=True))
    K = intrinsics(p.get("fx", p.get("f", 0.0)), p.get("fy", p.get("f", 0.0)), p["cx"], p["cy"])
    distortion = brown_conrady([p.get(key, 0.0) for key in ("k1", "k2", "p1", "p2")], file, where)
    return CalibratedCamera("", K, np.eye(4), *image_size(list(size), file, where), distortion)


def _read_images(file: Path) -> Iterator[Registered]:
    lines = [(i, line) for i, line in enumerate(checked_text(file).splitlines(), 1) if not line.startswith("#")]
    at = 0
    while at < len(lines):
        number, line = lines[at]
        at += 1
        if not line.strip():
            continue
        parts = line.split(maxsplit=9)  # names may have spaces
        where = f"line {number}"
        if len(parts) < 10:
            raise CaptureError(file, where, "expected IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME")
        values = floats(_numbers(parts[1:8], file, where), file, where, (7,))
        points = lines[at][1].split() if at < len(lines) else []
        at += 1
        if len(points) % 3:
            raise CaptureError(file, f"line {number + 1}", "expected X Y POINT3D_ID of each point (or an empty line)")
        points = np.reshape(_numbers(points, file, f"line {number + 1}"), (-1, 3))
        pose = pose_matrix(_rotation(values[:4], file, where), values[4:])
        yield where, pose, parts[9].strip(), parts[8], points


def _read_points(file: Path) -> dict[int, Sequence[float]]:
    places = {}
    for number, line in _data_lines(file):
        parts = line.split()
        if len(parts) < 4:
            raise CaptureError(file, f"line {number}", "expected POINT3D_ID X Y Z ...")
        places[int(parts[0])] = _numbers(parts[1:4], file, f"line {number}")
    return places


def _observations(seen: Sequence[np.ndarray], places: Mapping[int, Sequence[float]]) -> Observations | None:
    """Points with their pixels, or None where the model has no points."""
    rows = [(i, x, y, int(p)) for i, points in enumerate(seen) for x, y, p in points if int(p) in places]
    if not rows:
        return None
    points = np.asarray([places[row[3]] for row in rows], float)
    return Observations(points, np.asarray([row[0] for row in rows]), np.asarray([row[1:3] for row in rows], float))


# Binary ---------------------------------------------------------------------------------------------------------------


class _Bytes:
    """Numbers of a file, one after the other. Nothing is made before it is known that the file has so much."""

    def __init__(self, file: Path):
        with reading(file, "COLMAP model", CaptureError):
            self.file, self.data, self.at = file, read_bytes(file, "mesh_bytes"), 0

    def read(self, kinds: str) -> tuple[Any, ...]:
        """Values of the kinds of `struct`, little-endian."""
        size = struct.calcsize("<" + kinds)
        self.check(size)
        self.at += size
        return struct.unpack_from("<" + kinds, self.data, self.at - size)

    def count(self, least: int) -> int:
        """A count of what follows; refused if the file is too short for items of `least` bytes."""
        (count,) = self.read("Q")
        self.check(count * least)
        return count

    def check(self, size: int) -> None:
        """Raises: CaptureError if the file is shorter."""
        if self.at + size > len(self.data):
            raise CaptureError(self.file, "", "not a readable COLMAP model: cut short, or damaged")

    def name(self) -> str:
        """Up to the next zero."""
        end = self.data.find(b"\0", self.at)
        if end < 0:
            raise CaptureError(self.file, "", "not a readable COLMAP model: a name without an end")
        text = self.data[self.at : end].decode("utf-8", "replace")
        self.at = end + 1
        return text


def _binary_cameras(file: Path) -> dict[str, CalibratedCamera]:
    data, lenses, models = _Bytes(file), {}, list(PARAMETERS)
    for i in range(data.count(24)):
        camera_id, model, width, height = data.read("iiQQ")
        if not 0 <= model < len(models):
            supported = f"expected one of {', '.join(models)}; else {UNDISTORT_BEFORE}"
            raise CaptureError(file, f"camera {i}", f"camera model {model}: {supported}")
        values = floats(
            list(data.read("d" * len(PARAMETERS[models[model]]))), file, f"camera {i}", (len(PARAMETERS[models[model]]),)
        )
        lenses[str(camera_id)] = _lens(models[model], (float(width), float(height)), values.tolist(), file, f"camera {i}")
    return lenses


def _binary_images(file: Path) -> Iterator[Registered]:
    data = _Bytes(file)
    for i in range(data.count(73)):
        _, *values, camera_id = data.read("i7di")
        name, where = data.name(), f"image {i}"
        values = floats(values, file, where, (7,))
        count = data.count(24)
        rows = np.frombuffer(data.data, np.dtype("<f8,<f8,<i8"), count, data.at)
        data.at += 24 * count
        points = np.asarray([tuple(row) for row in rows.tolist()], np.float64).reshape(count, 3)
        if not np.isfinite(points).all():
            raise CaptureError(file, where, "expected finite pixels")
        yield where, pose_matrix(_rotation(values[:4], file, where), values[4:]), name, str(camera_id), points


def _binary_points(file: Path) -> dict[int, Sequence[float]]:
    data, places = _Bytes(file), {}
    for i in range(data.count(51)):
        point, *place = data.read("Q3d")
        data.read("3Bd")
        data.read(f"{8 * data.count(8)}x")
        places[point] = floats(place, file, f"point {i}", (3,)).tolist()
    return places


# Text -----------------------------------------------------------------------------------------------------------------


def _data_lines(file: Path) -> list[tuple[int, str]]:
    lines = enumerate(checked_text(file).splitlines(), 1)
    return [(number, line) for number, line in lines if line.strip() and not line.startswith("#")]


def _numbers(words: Iterable[str], file: Path, where: str) -> list[float]:
    try:
        return [float(word) for word in words]
    except ValueError as error:
        raise CaptureError(file, where, error) from None


def _rotation(quaternion: Float[np.ndarray, "4"], file: Path, where: str) -> Float[np.ndarray, "3 3"]:
    from scipy.spatial.transform import Rotation

    if not np.any(quaternion):
        raise CaptureError(file, where, "expected a quaternion QW QX QY QZ, got zeros")
    return Rotation.from_quat(quaternion, scalar_first=True).as_matrix()


# transforms.json -------------------------------------------------------------------------------------------------------

CAMERA_MODELS = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE")
MASK_KEYS = ("fg_mask_path", "mask_path")
"""Of VHAP and of nerfstudio."""
MATRICES = ("K", "intrinsic_matrix", "intrinsics", "camera_intrinsics")
"""Keys of a whole K, of a frame or of the file."""
DISTORTION_KEYS = ("k1", "k2", "p1", "p2", "k3")


def recognizes_transforms(source: Source) -> bool:
    """Whether a file is JSON with `frames`."""
    return isinstance(source.json, dict) and "frames" in source.json


def read_transforms(source: Source, format: CameraFormat) -> Calibration:
    """The cameras of `frames`, in their order. Raises: CaptureError naming the key."""
    values, file = source.json, source.path
    frames = values["frames"]
    if not isinstance(frames, list) or not all(isinstance(frame, Mapping) for frame in frames):
        raise CaptureError(file, "frames", "expected a list of JSON objects")
    if not frames:
        raise CaptureError(file, "frames", "expected at least one")
    moments, stations = _find_moments(frames, file)
    mask_key = next((key for key in MASK_KEYS if any(key in frame for frame in frames)), None)
    cameras = [
        dataclasses.replace(
            _frame_camera({**values, **frame}, file, f"frames[{i}].", source.photo_size),
            frame=moments[i],
            mask=_mask_path(frame, mask_key, file, i),
        )
        for i, frame in enumerate(frames)
    ]
    return source.calibration(format, cameras, convention=WORLD_FROM_CAM_OPENGL, stations=stations, mask_key=mask_key)


def _mask_path(frame: Mapping[str, Any], key: str | None, file: Path, i: int) -> str | None:
    path = frame.get(key)
    if key is None or path is None:
        return None
    if not isinstance(path, str) or not path:
        raise CaptureError(file, f"frames[{i}].{key}", f"expected the path of a mask, got {path!r}")
    return path


def _frame_camera(
    values: Mapping[str, Any], file: Path, prefix: str, photo_size: Callable[[str], tuple[int, int]]
) -> CalibratedCamera:
    name = required(values, "file_path", file, prefix)
    if not isinstance(name, str) or not name:
        raise CaptureError(file, f"{prefix}file_path", f"expected the path of a photo, got {shown(name)}")
    pose = floats(required(values, "transform_matrix", file, prefix), file, f"{prefix}transform_matrix", (4, 4))
    _check_model(values, file, prefix)
    if "w" in values or "h" in values:
        size = [required(values, key, file, prefix) for key in ("w", "h")]
        width, height = image_size(size, file, f"{prefix}w, h")
    elif {"fl_x", "cx", "cy"} <= values.keys() or not values.keys().isdisjoint(MATRICES):
        width, height = None, None
    else:
        width, height = photo_size(name)
    K = _intrinsics(values, width, height, file, prefix)
    coefficients = [_number(values, key, file, prefix) if key in values else 0.0 for key in DISTORTION_KEYS]
    distortion = brown_conrady(coefficients, file, f"{prefix}k1")
    try:
        cam_from_world = CONVENTIONS[WORLD_FROM_CAM_OPENGL](pose)
    except np.linalg.LinAlgError:
        raise CaptureError(file, f"{prefix}transform_matrix", "expected a rigid transform, got a singular one") from None
    return CalibratedCamera(name, K, cam_from_world, width, height, distortion)


def _check_model(values: Mapping[str, Any], file: Path, prefix: str) -> None:
    """Lenses that the five coefficients do not describe are refused."""
    model = values.get("camera_model", "OPENCV")
    if model not in CAMERA_MODELS:
        expected = f"expected {', '.join(CAMERA_MODELS)}; else {UNDISTORT_BEFORE}"
        raise CaptureError(file, f"{prefix}camera_model", f"{shown(model)}: {expected}")
    if values.get("is_fisheye"):
        raise CaptureError(file, f"{prefix}is_fisheye", f"fisheye lenses are not supported: {UNDISTORT_BEFORE}")
    if values.get("k4"):
        raise CaptureError(file, f"{prefix}k4", f"expected 0; else {UNDISTORT_BEFORE}")


def _number(values: Mapping[str, Any], key: str, file: Path, prefix: str) -> float:
    return float(floats(values[key], file, f"{prefix}{key}", ()))


def _intrinsics(
    values: Mapping[str, Any], width: int | None, height: int | None, file: Path, prefix: str
) -> Float[np.ndarray, "3 3"]:
    """K; square pixels and a centred axis where the file does not say otherwise."""
    key = next((key for key in MATRICES if key in values), None)
    if key is not None and "fl_x" not in values:
        return floats(values[key], file, f"{prefix}{key}", (3, 3))
    focal = {}
    for axis, side in (("x", width), ("y", height)):
        if f"fl_{axis}" in values:
            focal[axis] = _number(values, f"fl_{axis}", file, prefix)
        elif f"camera_angle_{axis}" in values and side is not None:
            focal[axis] = 0.5 * side / np.tan(0.5 * _number(values, f"camera_angle_{axis}", file, prefix))
    if not focal:
        raise CaptureError(file, f"{prefix}fl_x", "missing: expected fl_x or camera_angle_x, or K")
    fx, fy = focal.get("x", focal.get("y")), focal.get("y", focal.get("x"))
    assert {"cx", "cy"} <= values.keys() or None not in (width, height)  # the caller has asked the photo
    cx, cy = (
        _number(values, key, file, prefix) if key in values else 0.5 * (side or 0)
        for key, side in (("cx", width), ("cy", height))
    )
    return intrinsics(fx, fy, cx, cy)


# Moments ---------------------------------------------------------------------------------------------------------------

MOMENT_KEYS = ("timestep_index", "timestep", "timestep_index_original", "time", "timestamp", "time_id", "timestep_id")
CAMERA_KEYS = ("camera_index", "camera_id", "cam_id", "camera_label")
SAME_TIME = 1e-6
"""Times that differ by less are one moment written twice."""
SAME_POSE = 1e-9


def _find_moments(frames: Sequence[Mapping[str, Any]], file: Path) -> tuple[list[int], int | None]:
    """The frame of each image, counted from 0 in the order of time, and how many cameras there are (None: one for each image).

    Raises: CaptureError naming the key, for a value in some images only, for what is no time, for two images of one camera and
    one moment, and for several images of a camera where nothing tells which were taken together.
    """
    moments, cameras = _values(frames, MOMENT_KEYS, file), _values(frames, CAMERA_KEYS, file)
    key, times = moments if moments is not None else ("", None)
    owner, owners = cameras if cameras is not None else ("", _numbered([_pose_of(frame) for frame in frames]))
    count = len(set(owners))
    if times is None:
        if count == len(frames):
            return [0] * len(frames), None
        if count > 1:
            _refuse_unknown_moments(owner, owners, file)
        return list(range(len(frames))), 1
    ranks = _ranks(times, key, file)
    if cameras is not None:
        _check_taken_once(owner, owners, key, ranks, file)
    return ranks, count if cameras is not None or count < len(frames) else None


def _values(frames: Sequence[Mapping[str, Any]], keys: Sequence[str], file: Path) -> tuple[str, list[str | float]] | None:
    """The first key that an image has, and its value in all of them; None if there is none."""
    key = next((key for key in keys if any(key in frame for frame in frames)), None)
    if key is None:
        return None
    values = []
    for i, frame in enumerate(frames):
        value = frame.get(key)
        if key not in frame:
            raise CaptureError(file, f"frames[{i}].{key}", "missing, but other frames have it: expected all or none")
        if isinstance(value, bool) or not isinstance(value, str | int | float):
            raise CaptureError(file, f"frames[{i}].{key}", f"expected a number or a name, got {value!r}")
        if not isinstance(value, str):
            value = float(floats(value, file, f"frames[{i}].{key}", ()))
        values.append(value)
    return key, values


def _ranks(times: list[Any], key: str, file: Path) -> list[int]:
    if len({isinstance(time, str) for time in times}) > 1:
        raise CaptureError(file, key, "expected numbers or names, got both")
    known = sorted(set(times))
    if not isinstance(known[0], str):
        gaps = np.diff(known, prepend=-np.inf) > SAME_TIME * max(1.0, abs(known[-1]))
        rank = dict(zip(known, (np.cumsum(gaps) - 1).tolist(), strict=True))
    else:
        rank = {time: i for i, time in enumerate(known)}
    return [rank[time] for time in times]


def _pose_of(frame: Mapping[str, Any]) -> Hashable:
    """What tells cameras apart that have no name."""
    try:
        return tuple(np.round(np.asarray(frame["transform_matrix"], float).ravel() / SAME_POSE).tolist())
    except (KeyError, TypeError, ValueError, OverflowError):
        return object()  # said when the matrix is read


def _numbered(things: Sequence[Hashable]) -> list[int]:
    number = {thing: i for i, thing in enumerate(dict.fromkeys(things))}
    return [number[thing] for thing in things]


def _refuse_unknown_moments(owner: str, owners: Sequence[Any], file: Path) -> None:
    first = next(value for i, value in enumerate(owners) if value in owners[:i])
    rows = [i for i, value in enumerate(owners) if value == first]
    same = f"the {owner} {first:g}" if isinstance(first, float) else f"the {owner} {first}"
    which = same if owner else "the same camera pose"
    problem = f"frames[{rows[0]}] and frames[{rows[1]}] have {which}, so they show different moments"
    raise CaptureError(file, "frames", f"{problem}: expected timestep_index or time in each frame to tell which are of one")


def _check_taken_once(owner: str, owners: Sequence[Any], key: str, ranks: Sequence[int], file: Path) -> None:
    seen: dict[tuple, int] = {}
    for i, taken in enumerate(zip(owners, ranks, strict=True)):
        if (other := seen.setdefault(taken, i)) != i:
            problem = f"the {owner} and {key} of frames[{other}]: expected one photo of a camera at a moment"
            raise CaptureError(file, f"frames[{i}]", problem)
