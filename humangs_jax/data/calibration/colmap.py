"""COLMAP's text models: a folder with cameras.txt, images.txt and, optionally, points3D.txt.

The format is described at https://colmap.github.io/format.html: images.txt has two lines for each image, the pose
(world to camera, OpenCV axes, quaternion wxyz) and the points seen, which may be empty. Pixel centres are at +0.5; the
length unit and the axes of the world are arbitrary.
"""

import dataclasses
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

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

PARAMETERS = {
    "SIMPLE_PINHOLE": ("f", "cx", "cy"),
    "PINHOLE": ("fx", "fy", "cx", "cy"),
    "SIMPLE_RADIAL": ("f", "cx", "cy", "k1"),
    "RADIAL": ("f", "cx", "cy", "k1", "k2"),
    "OPENCV": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2"),
}
"""Camera models and their parameters in cameras.txt."""


def read(source: Source, format: CameraFormat) -> Calibration:
    """The registered images of a text model, in the order of images.txt. Raises: CaptureError naming file and line."""
    folder = source.path
    if not any((folder / name).is_file() for name in ("images.txt", "cameras.txt")):
        remedy = f"colmap model_converter --input_path {folder} --output_path DIR --output_type TXT"
        raise CaptureError(folder, "", f"a binary COLMAP model: expected a text model; {remedy}")
    lenses = _read_cameras(folder / "cameras.txt")
    file = folder / "images.txt"
    cameras, seen = [], []
    for number, pose, name, camera_id, points in _read_images(file):
        if camera_id not in lenses:
            raise CaptureError(file, f"line {number}", f"camera {camera_id} is not in cameras.txt")
        cameras.append(dataclasses.replace(lenses[camera_id], name=name, cam_from_world=pose))
        seen.append(points)
    if not cameras:
        raise CaptureError(file, "", "no image is registered in this model")
    observations = _observations(seen, folder / "points3D.txt")
    return source.calibration(format, cameras, file=file, observations=observations)


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
            raise CaptureError(
                file, where, f"{model}: expected WIDTH HEIGHT {' '.join(names)}, got {len(values)} numbers"
            )
        size = image_size(_numbers(values[:2], file, where), file, where)
        p = dict(zip(names, _numbers(values[2:], file, where), strict=True))
        K = intrinsics(p.get("fx", p.get("f", 0.0)), p.get("fy", p.get("f", 0.0)), p["cx"], p["cy"])
        distortion = brown_conrady([p.get(key, 0.0) for key in ("k1", "k2", "p1", "p2")], file, where)
        lenses[camera_id] = CalibratedCamera("", K, np.eye(4), *size, distortion)
    return lenses


def _read_images(file: Path) -> Iterator[tuple[int, np.ndarray, str, str, np.ndarray]]:
    """(line number, cam_from_world, name, camera id, (n, 3) points as x y id) of each image."""
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
        yield number, pose, parts[9].strip(), parts[8], points


def _observations(seen: Sequence[np.ndarray], file: Path) -> Observations | None:
    """Points with their pixels, or None where the model has no points."""
    if not file.is_file():
        return None
    places = {}
    for number, line in _data_lines(file):
        parts = line.split()
        if len(parts) < 4:
            raise CaptureError(file, f"line {number}", "expected POINT3D_ID X Y Z ...")
        places[int(parts[0])] = _numbers(parts[1:4], file, f"line {number}")
    rows = [(i, x, y, int(p)) for i, points in enumerate(seen) for x, y, p in points if int(p) in places]
    if not rows:
        return None
    points = np.asarray([places[row[3]] for row in rows], float)
    return Observations(points, np.asarray([row[0] for row in rows]), np.asarray([row[1:3] for row in rows], float))


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
