"""K, R and T of each camera: OpenCV calibrations (FileStorage or JSON), EasyMocap's pair, AvatarReX and THuman4.0.

A world point X is at R X + T in the camera, pixel centres are at whole numbers (OpenCV). The values of a camera stand

- in a map of its own: `{"cam00": {"K": .., "R": .., "T": .., "imgSize": [W, H]}}`, as in calibration_full.json, or
- beside those of the others with its name behind: `K_01`, `dist_01`, `Rot_01` or `R_01` (matrix or rotation vector), `T_01`,
  `W_01`, `H_01`, with the list `names`, as in EasyMocap's intri.yml and extri.yml
  (https://chingswy.github.io/easymocap-public-doc/database/1_camera.html).
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from humangs_jax.data.calibration.calibration import CalibratedCamera, Calibration
from humangs_jax.data.calibration.distortion import UNDISTORT_BEFORE, brown_conrady
from humangs_jax.data.calibration.file_storage import parse_file_storage
from humangs_jax.data.calibration.values import floats, image_size, pose_matrix, read_text, rotation
from humangs_jax.data.capture_checks import CaptureError

EASYMOCAP_FILES = ("intri.yml", "extri.yml")
FISHEYE = ("fisheye", "is_fisheye", "equidistant")
"""Values of `model` and the like, or keys that are true, of lenses with another formula."""
SIZE_KEYS = ("imgSize", "image_size")


def read_easymocap(folder: Path) -> Calibration:
    """The cameras of intri.yml and extri.yml. Raises: CaptureError naming file and key."""
    intrinsic, extrinsic = (folder / name for name in EASYMOCAP_FILES)
    inner = parse_file_storage(read_text(intrinsic), intrinsic)
    outer = parse_file_storage(read_text(extrinsic), extrinsic)
    names = outer.get("names", inner.get("names")) or _suffixes(inner)
    files = intrinsic, extrinsic
    cameras = tuple(_camera(str(n), _of_camera(inner, n), _of_camera(outer, n), files, _behind(n)) for n in names)
    return _calibration("EasyMocap calibration", extrinsic, cameras, up="+z")


def read_camera_maps(values: Mapping[str, Any], file: Path) -> Calibration:
    """The cameras of one file. Raises: CaptureError naming the key."""
    nested = {name: value for name, value in values.items() if isinstance(value, Mapping)}
    before = lambda name: lambda key: f"{name}.{key}"
    cameras = [_camera(name, value, value, (file, file), before(name)) for name, value in nested.items()]
    if not nested:
        names = values.get("names") or _suffixes(values)
        single = [(name, _of_camera(values, name)) for name in names]
        cameras = [_camera(str(name), value, value, (file, file), _behind(name)) for name, value in single]
    return _calibration("calibration of K, R, T", file, tuple(cameras))


def has_camera_maps(values: Mapping[str, Any]) -> bool:
    """Whether these look like values that `read_camera_maps` reads."""
    return bool(_suffixes(values)) or any(isinstance(v, Mapping) and {"K", "R", "T"} & set(v) for v in values.values())


def _calibration(kind, file, cameras, up="-y"):
    if not cameras:
        raise CaptureError(file, "", "no camera: expected K, R and T of each, or K_NAME, R_NAME and T_NAME")
    return Calibration(kind, file, cameras, False, "integer", up)


def _behind(name):
    return lambda key: f"{key}_{name}"


def _suffixes(values):
    return [key[2:] for key in values if key.startswith("K_")]


def _of_camera(values, name):
    """`K_01: ..` of all cameras -> `K: ..` of one."""
    end = f"_{name}"
    return {key[: -len(end)]: value for key, value in values.items() if key.endswith(end)}


def _camera(name, inner, outer, files, field):
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
