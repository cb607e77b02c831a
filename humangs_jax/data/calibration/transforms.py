"""transforms.json of NeRF, instant-ngp and nerfstudio: camera-to-world matrices with OpenGL axes.

Intrinsics are the file's or, where a frame has its own, that frame's: fl_x fl_y cx cy w h, or camera_angle_x (the field of
view in radians) about a centred axis. Pixel centres are at +0.5, z is up, lengths are arbitrary. `aabb_scale`, `scale`,
`offset`, `applied_transform` and the like serve other programs and are ignored.
"""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from humangs_jax.data.calibration.calibration import CONVENTIONS, WORLD_FROM_CAM_OPENGL, CalibratedCamera, Calibration
from humangs_jax.data.calibration.distortion import UNDISTORT_BEFORE, brown_conrady
from humangs_jax.data.calibration.values import floats, image_size, intrinsics, required
from humangs_jax.data.capture_checks import CaptureError

CAMERA_MODELS = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE")
DISTORTION_KEYS = ("k1", "k2", "p1", "p2", "k3")


def read_transforms(values: Mapping[str, Any], file: Path, photo_size: Callable[[str], tuple[int, int]]) -> Calibration:
    """The cameras of `frames`, in their order.

    photo_size: width and height of the photo of a file_path, asked where the file has no w and h.

    Raises: CaptureError naming the key.
    """
    frames = values["frames"]
    if not isinstance(frames, list) or not all(isinstance(frame, Mapping) for frame in frames):
        raise CaptureError(file, "frames", "expected a list of JSON objects")
    if not frames:
        raise CaptureError(file, "frames", "expected at least one")
    cameras = tuple(_camera({**values, **frame}, file, f"frames[{i}].", photo_size) for i, frame in enumerate(frames))
    return Calibration("transforms.json", file, cameras, True, "half", "+z", convention=WORLD_FROM_CAM_OPENGL)


def _camera(values, file, prefix, photo_size):
    name = required(values, "file_path", file, prefix)
    if not isinstance(name, str) or not name:
        raise CaptureError(file, f"{prefix}file_path", f"expected the path of a photo, got {name!r}")
    pose = floats(required(values, "transform_matrix", file, prefix), file, f"{prefix}transform_matrix", (4, 4))
    _check_model(values, file, prefix)
    if "w" in values or "h" in values:
        size = [required(values, key, file, prefix) for key in ("w", "h")]
        width, height = image_size(size, file, f"{prefix}w, h")
    else:
        width, height = photo_size(name)
    K = _intrinsics(values, width, height, file, prefix)
    coefficients = [_number(values, key, file, prefix) if key in values else 0.0 for key in DISTORTION_KEYS]
    distortion = brown_conrady(coefficients, file, f"{prefix}k1")
    try:
        cam_from_world = CONVENTIONS[WORLD_FROM_CAM_OPENGL](pose)
    except np.linalg.LinAlgError:
        raise CaptureError(
            file, f"{prefix}transform_matrix", "expected a rigid transform, got a singular one"
        ) from None
    return CalibratedCamera(name, K, cam_from_world, width, height, distortion)


def _check_model(values, file, prefix):
    """Lenses that the five coefficients do not describe are refused."""
    model = values.get("camera_model", "OPENCV")
    if model not in CAMERA_MODELS:
        expected = f"expected {', '.join(CAMERA_MODELS)}; else {UNDISTORT_BEFORE}"
        raise CaptureError(file, f"{prefix}camera_model", f"{model!r}: {expected}")
    if values.get("is_fisheye"):
        raise CaptureError(file, f"{prefix}is_fisheye", f"fisheye lenses are not supported: {UNDISTORT_BEFORE}")
    if values.get("k4"):
        raise CaptureError(file, f"{prefix}k4", f"expected 0; else {UNDISTORT_BEFORE}")


def _number(values, key, file, prefix):
    return float(floats(values[key], file, f"{prefix}{key}", ()))


def _intrinsics(values, width, height, file, prefix):
    """K; square pixels and a centred axis where the file does not say otherwise."""
    focal = {}
    for axis, side in (("x", width), ("y", height)):
        if f"fl_{axis}" in values:
            focal[axis] = _number(values, f"fl_{axis}", file, prefix)
        elif f"camera_angle_{axis}" in values:
            focal[axis] = 0.5 * side / np.tan(0.5 * _number(values, f"camera_angle_{axis}", file, prefix))
    if not focal:
        raise CaptureError(file, f"{prefix}fl_x", "missing: expected fl_x or camera_angle_x")
    fx, fy = focal.get("x", focal.get("y")), focal.get("y", focal.get("x"))
    cx = _number(values, "cx", file, prefix) if "cx" in values else 0.5 * width
    cy = _number(values, "cy", file, prefix) if "cy" in values else 0.5 * height
    return intrinsics(fx, fy, cx, cy)
