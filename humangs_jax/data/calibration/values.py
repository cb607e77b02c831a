"""Values of calibration files, checked: numbers in float64, rotations, poses; every fault is a `CaptureError`."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from humangs_jax.core.array_types import Float
from humangs_jax.data.capture_checks import CaptureError, numbers


def read_text(file: Path) -> str:
    """The text of a file. Raises: CaptureError if there is none or it is not text."""
    try:
        return file.read_text(encoding="utf-8-sig")
    except FileNotFoundError:
        raise CaptureError(file, "", "no such file") from None
    except (OSError, UnicodeDecodeError) as error:
        raise CaptureError(file, "", f"not a readable text file: {error}") from error


def parse_json(text: str, file: Path) -> Any:
    """The values of a JSON text. Raises: CaptureError naming the line."""
    try:
        return json.loads(text)
    except json.JSONDecodeError as error:
        raise CaptureError(file, f"line {error.lineno}", f"not valid JSON: {error.msg}") from error


def required(mapping: Mapping[str, Any], key: str, file: object, prefix: str = "") -> Any:
    """mapping[key]. Raises: CaptureError if it is missing."""
    if key not in mapping:
        raise CaptureError(file, f"{prefix}{key}", "missing")
    return mapping[key]


def floats(value: Any, file: object, field: str, shape: tuple[int, ...]) -> Float[np.ndarray, "*shape"]:
    """Finite float64 numbers, however nested, reshaped to `shape` in row-major order."""
    array = numbers(value, file, field)
    if array.size != np.prod(shape):
        wanted = " x ".join(map(str, shape)) or "one"
        raise CaptureError(file, field, f"expected {wanted} numbers, got shape {array.shape}")
    return np.asarray(value, np.float64).reshape(shape)


def image_size(value: Any, file: object, field: str) -> tuple[int, int]:
    """Width and height in whole pixels."""
    width, height = floats(value, file, field, (2,)).tolist()
    if not (width.is_integer() and height.is_integer() and width > 0 and height > 0):
        raise CaptureError(file, field, f"expected width and height in pixels, got {width:g} x {height:g}")
    return int(width), int(height)


def intrinsics(fx: float, fy: float, cx: float, cy: float) -> Float[np.ndarray, "3 3"]:
    """K of focal lengths and principal point, pixels."""
    return np.asarray([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], np.float64)


def pose_matrix(rotation: Float[np.ndarray, "3 3"], translation: Float[np.ndarray, "3"]) -> Float[np.ndarray, "4 4"]:
    """[[R, t], [0, 0, 0, 1]]."""
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, translation
    return pose


def rotation_from_vector(vector: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 3"]:
    """Rodrigues' formula: axis times angle in radians -> rotation matrix, as cv2.Rodrigues."""
    angle = float(np.linalg.norm(vector))
    if angle == 0:
        return np.eye(3)
    x, y, z = vector / angle
    cross = np.asarray([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


def rotation(value: Any, file: object, field: str) -> Float[np.ndarray, "3 3"]:
    """A rotation given as 9 numbers of its matrix, or as the 3 of a rotation vector."""
    if numbers(value, file, field).size == 3:
        return rotation_from_vector(floats(value, file, field, (3,)))
    return floats(value, file, field, (3, 3))
