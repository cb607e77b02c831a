"""transforms.json of NeRF, instant-ngp, nerfstudio, GaussianAvatars and VHAP.

Camera-to-world matrices with OpenGL's axes. Intrinsics are the file's or, where a frame has its own, the frame's: fl_x fl_y cx cy
w h, or camera_angle_x (radians) about a centred axis. Pixel centres are at +0.5, z is up, lengths are arbitrary. `aabb_scale`,
`scale`, `offset`, `applied_transform` and the like serve other programs and are ignored.

Of videos it says the moment and the camera of each image, `timestep_index` and `camera_index` (GaussianAvatars, VHAP) or `time`
(D-NeRF). Images of one moment are one frame; images that one camera took are different moments. It may name masks.
"""

import dataclasses
from collections.abc import Callable, Hashable, Mapping, Sequence
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
    Source,
    brown_conrady,
    image_size,
    intrinsics,
)
from humangs_jax.data.capture_checks import CaptureError, floats, required
from humangs_jax.data.formats import CameraFormat
from humangs_jax.io.reading import shown

CAMERA_MODELS = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE")
MASK_KEYS = ("fg_mask_path", "mask_path")
"""Of VHAP and of nerfstudio."""
MATRICES = ("K", "intrinsic_matrix", "intrinsics", "camera_intrinsics")
"""Keys of a whole K, of a frame or of the file."""
DISTORTION_KEYS = ("k1", "k2", "p1", "p2", "k3")


def recognizes(source: Source) -> bool:
    """Whether a file is JSON with `frames`."""
    return isinstance(source.json, dict) and "frames" in source.json


def read(source: Source, format: CameraFormat) -> Calibration:
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
