"""COLMAP's models: a folder with cameras.txt, images.txt and, optionally, points3D.txt, or the same as .bin.

The format is described at https://colmap.github.io/format.html: images.txt has two lines for each image, the pose
(world to camera, OpenCV axes, quaternion wxyz) and the points seen, which may be empty. Pixel centres are at +0.5; the
length unit and the axes of the world are arbitrary.
"""

import dataclasses
import struct
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from humangs_jax.core.array_types import Float
from humangs_jax.data.calibration.calibration import (
    UNDISTORT_BEFORE,
    CalibratedCamera,
    Calibration,
    Observations,
    Source,
    brown_conrady,
    image_size,
    intrinsics,
    pose_matrix,
)
from humangs_jax.data.capture_checks import CaptureError, checked_text, floats
from humangs_jax.data.formats import CameraFormat
from humangs_jax.io.reading import read_bytes, reading

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


def read(source: Source, format: CameraFormat) -> Calibration:
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
    """Camera id -> camera without name and pose."""
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
    """(line, cam_from_world, name, camera id, (n, 3) points as x y id) of each image."""
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
