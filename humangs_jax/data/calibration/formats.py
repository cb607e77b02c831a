"""The calibration in a file or folder; its content decides the format. COLMAP's text models are read by `colmap`.

transforms.json of NeRF, instant-ngp and nerfstudio: camera-to-world matrices with OpenGL axes.
Intrinsics are the file's or, where a frame has its own, that frame's: fl_x fl_y cx cy w h, or camera_angle_x (the field of
view in radians) about a centred axis. Pixel centres are at +0.5, z is up, lengths are arbitrary. Of videos it says the moment and
the camera of each image (`calibration.moments`), and it may name masks. `aabb_scale`, `scale`, `offset`, `applied_transform` and
the like serve other programs and are ignored.

K, R and T of each camera: OpenCV calibrations (FileStorage or JSON), EasyMocap's pair, AvatarReX and THuman4.0.
A world point X is at R X + T in the camera, pixel centres are at whole numbers (OpenCV). The values of a camera stand

- in a map of its own: `{"cam00": {"K": .., "R": .., "T": .., "imgSize": [W, H]}}`, as in calibration_full.json, or
- beside those of the others with its name behind: `K_01`, `dist_01`, `Rot_01` or `R_01` (matrix or rotation vector), `T_01`,
  `W_01`, `H_01`, with the list `names`, as in EasyMocap's intri.yml and extri.yml
  (https://chingswy.github.io/easymocap-public-doc/database/1_camera.html).
"""

import dataclasses
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from humangs_jax.data.calibration.calibration import (
    CONVENTIONS,
    UNDISTORT_BEFORE,
    WORLD_FROM_CAM_OPENGL,
    CalibratedCamera,
    Calibration,
    brown_conrady,
    image_size,
    intrinsics,
    pose_matrix,
    rotation,
)
from humangs_jax.data.calibration.colmap import read_colmap
from humangs_jax.data.calibration.file_storage import parse_file_storage
from humangs_jax.data.calibration.moments import find_moments
from humangs_jax.data.capture_checks import CaptureError, checked_json, checked_text, floats, required
from humangs_jax.io.reading import reading, shown

EASYMOCAP_FILES = ("intri.yml", "extri.yml")
FILES = ("transforms.json", "calibration_full.json", "calibration.json")
"""Names that a folder is searched for."""
FORMATS = (
    "a COLMAP text model (cameras.txt, images.txt), transforms.json, calibration_full.json, OpenCV's YAML or JSON with K, R "
    "and T of each camera, or EasyMocap's intri.yml and extri.yml"
)


def read_calibration(source: Path, photo_size: Callable[[str], tuple[int, int]]) -> Calibration:
    """The calibration in a file or folder of any supported format.

    photo_size: width and height of the photo of a name, for formats that do not say them.

    Raises: CaptureError, one line that names the file and what was expected.
    """
    if not source.exists():
        raise CaptureError(source, "", "no such file or folder")
    if source.name in EASYMOCAP_FILES:
        source = source.parent
    with reading(source, "calibration", CaptureError):
        return _read_folder(source, photo_size) if source.is_dir() else _read_file(source, photo_size)


def _read_folder(folder, photo_size):
    for model in (folder, folder / "sparse" / "0", folder / "sparse"):
        if (model / "images.txt").is_file() or (model / "cameras.txt").is_file():
            return read_colmap(model)
        if (model / "images.bin").is_file():
            remedy = f"colmap model_converter --input_path {model} --output_path DIR --output_type TXT"
            raise CaptureError(model, "", f"a binary COLMAP model: expected a text model; {remedy}")
    if any((folder / name).is_file() for name in EASYMOCAP_FILES):
        return _read_easymocap(folder)
    for name in FILES:
        if (folder / name).is_file():
            return _read_file(folder / name, photo_size)
    raise CaptureError(folder, "", f"no cameras found: expected {FORMATS}")


def _read_file(file, photo_size):
    text = checked_text(file)
    if not text.strip():
        raise CaptureError(file, "", f"empty: expected {FORMATS}")
    if text.lstrip().startswith("{"):
        values = checked_json(file, text)
        if "frames" in values:
            return _read_transforms(values, file, photo_size)
    if text.lstrip().startswith(("{", "%YAML", "---")) or file.suffix in (".yml", ".yaml"):
        values: Mapping = parse_file_storage(text, file)
        if _has_camera_maps(values):
            return _read_camera_maps(values, file)
    raise CaptureError(file, "", f"not a known format: expected {FORMATS}")


# transforms.json ------------------------------------------------------------------------------------------------------

CAMERA_MODELS = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE")
MASK_KEYS = ("fg_mask_path", "mask_path")
"""Of VHAP and of nerfstudio."""
DISTORTION_KEYS = ("k1", "k2", "p1", "p2", "k3")


def _read_transforms(
    values: Mapping[str, Any], file: Path, photo_size: Callable[[str], tuple[int, int]]
) -> Calibration:
    """The cameras of `frames`, in their order.

    photo_size: width and height of the photo of a file_path, asked where the file has no w and h.

    Raises: CaptureError naming the key.
    """
    frames = values["frames"]
    if not isinstance(frames, list) or not all(isinstance(frame, Mapping) for frame in frames):
        raise CaptureError(file, "frames", "expected a list of JSON objects")
    if not frames:
        raise CaptureError(file, "frames", "expected at least one")
    moments, stations = find_moments(frames, file)
    mask_key = next((key for key in MASK_KEYS if any(key in frame for frame in frames)), None)
    cameras = tuple(
        dataclasses.replace(
            _frame_camera({**values, **frame}, file, f"frames[{i}].", photo_size),
            frame=moments[i],
            mask=_mask_path(frame, mask_key, file, i),
        )
        for i, frame in enumerate(frames)
    )
    axes = WORLD_FROM_CAM_OPENGL
    kind = Calibration("transforms.json", file, cameras, True, "half", "+z", convention=axes)
    return dataclasses.replace(kind, stations=stations, mask_key=mask_key)


def _mask_path(frame, key, file, i):
    path = frame.get(key)
    if key is None or path is None:
        return None
    if not isinstance(path, str) or not path:
        raise CaptureError(file, f"frames[{i}].{key}", f"expected the path of a mask, got {path!r}")
    return path


def _frame_camera(values, file, prefix, photo_size):
    name = required(values, "file_path", file, prefix)
    if not isinstance(name, str) or not name:
        raise CaptureError(file, f"{prefix}file_path", f"expected the path of a photo, got {shown(name)}")
    pose = floats(required(values, "transform_matrix", file, prefix), file, f"{prefix}transform_matrix", (4, 4))
    _check_model(values, file, prefix)
    if "w" in values or "h" in values:
        size = [required(values, key, file, prefix) for key in ("w", "h")]
        width, height = image_size(size, file, f"{prefix}w, h")
    elif {"fl_x", "cx", "cy"} <= values.keys():
        width, height = None, None
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
        raise CaptureError(file, f"{prefix}camera_model", f"{shown(model)}: {expected}")
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
        elif f"camera_angle_{axis}" in values and side is not None:
            focal[axis] = 0.5 * side / np.tan(0.5 * _number(values, f"camera_angle_{axis}", file, prefix))
    if not focal:
        raise CaptureError(file, f"{prefix}fl_x", "missing: expected fl_x or camera_angle_x")
    fx, fy = focal.get("x", focal.get("y")), focal.get("y", focal.get("x"))
    cx = _number(values, "cx", file, prefix) if "cx" in values else 0.5 * width
    cy = _number(values, "cy", file, prefix) if "cy" in values else 0.5 * height
    return intrinsics(fx, fy, cx, cy)


# K, R and T -----------------------------------------------------------------------------------------------------------

FISHEYE = ("fisheye", "is_fisheye", "equidistant")
"""Values of `model` and the like, or keys that are true, of lenses with another formula."""
SIZE_KEYS = ("imgSize", "image_size")


def _read_easymocap(folder: Path) -> Calibration:
    """The cameras of intri.yml and extri.yml. Raises: CaptureError naming file and key."""
    intrinsic, extrinsic = (folder / name for name in EASYMOCAP_FILES)
    inner = parse_file_storage(checked_text(intrinsic), intrinsic)
    outer = parse_file_storage(checked_text(extrinsic), extrinsic)
    names = outer.get("names", inner.get("names")) or _suffixes(inner)
    files = intrinsic, extrinsic
    of = lambda values, name: _of_camera(values, name, names)
    cameras = tuple(_map_camera(str(n), of(inner, n), of(outer, n), files, _behind(n)) for n in names)
    return _calibration("EasyMocap calibration", extrinsic, cameras, up="+z")


def _read_camera_maps(values: Mapping[str, Any], file: Path) -> Calibration:
    """The cameras of one file. Raises: CaptureError naming the key."""
    nested = {name: value for name, value in values.items() if isinstance(value, Mapping)}
    before = lambda name: lambda key: f"{name}.{key}"
    cameras = [_map_camera(name, value, value, (file, file), before(name)) for name, value in nested.items()]
    if not nested:
        names = values.get("names") or _suffixes(values)
        single = [(name, _of_camera(values, name, names)) for name in names]
        cameras = [_map_camera(str(name), value, value, (file, file), _behind(name)) for name, value in single]
    return _calibration("calibration of K, R, T", file, tuple(cameras))


def _has_camera_maps(values: Mapping[str, Any]) -> bool:
    """Whether these look like values that `_read_camera_maps` reads."""
    return bool(_suffixes(values)) or any(isinstance(v, Mapping) and {"K", "R", "T"} & set(v) for v in values.values())


def _calibration(kind, file, cameras, up="-y"):
    if not cameras:
        raise CaptureError(file, "", "no camera: expected K, R and T of each, or K_NAME, R_NAME and T_NAME")
    return Calibration(kind, file, cameras, False, "integer", up)


def _behind(name):
    return lambda key: f"{key}_{name}"


def _suffixes(values):
    return [key[2:] for key in values if key.startswith("K_")]


def _of_camera(values, name, names):
    """`K_01: ..` of all cameras -> `K: ..` of one. `dist_a_1` is of camera a_1, if there is one, and not of camera 1."""
    end = f"_{name}"
    longer = tuple(f"_{other}" for other in names if len(str(other)) > len(str(name)))
    own = {key: value for key, value in values.items() if key.endswith(end) and not key.endswith(longer)}
    return {key[: -len(end)]: value for key, value in own.items()}


def _map_camera(name, inner, outer, files, field):
    """A camera of its intrinsic and extrinsic values, and their files. `field` makes keys those of the file, for errors."""
    inner_file, outer_file = files
    for key, file in (("K", inner_file), ("R", outer_file), ("T", outer_file)):
        values = inner if key == "K" else outer
        if key not in values and not (key == "R" and "Rot" in values):
            raise CaptureError(file, field(key), "missing")
    turn_key = "Rot" if "Rot" in outer else "R"  # EasyMocap has both: the matrix and the rotation vector
    turn = rotation(outer[turn_key], outer_file, field(turn_key))
    translation = floats(outer["T"], outer_file, field("T"), (3,))
    K = floats(inner["K"], inner_file, field("K"), (3, 3))
    distortion = _distortion(inner, inner_file, field)
    width, height = _size(inner, inner_file, field)
    return CalibratedCamera(name, K, pose_matrix(turn, translation), width, height, distortion)


def _distortion(values, file, field):
    """The coefficients of `D`, `dist`, `distCoeff`, ...; lenses that they do not describe are refused."""
    coefficients = None
    for key, value in values.items():
        fisheye = value.lower() in FISHEYE if isinstance(value, str) else key.lower() in FISHEYE and bool(value)
        if fisheye:
            raise CaptureError(file, field(key), f"fisheye lenses are not supported: {UNDISTORT_BEFORE}")
        if (key.lower() == "d" or key.lower().startswith("dist")) and not isinstance(value, str):
            coefficients = brown_conrady(value, file, field(key))
    return coefficients


def _size(values, file, field):
    for key in SIZE_KEYS:
        if key in values:
            return image_size(values[key], file, field(key))
    for pair in (("width", "height"), ("W", "H")):
        if all(key in values for key in pair):
            return image_size([values[key] for key in pair], file, field(pair[0]))
    return None, None
