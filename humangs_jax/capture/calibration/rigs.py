"""Reads formats that list the values of each camera: OpenCV's K, R and T (AvatarReX, THuman4.0),
EasyMocap, Panoptic, multical, TOML and Qualisys.

In OpenCV's convention a world point X is at R X + T in the camera, and pixel centres are at whole
numbers. There are two layouts. In the first, each camera's values are in a separate map, `{"cam00":
{"K": .., "R": .., "T": .., "imgSize": [W, H]}}`. In the second, the values of all cameras are in
one map, with the camera's name at the end of each key: `K_01`, `dist_01`, `Rot_01` or `R_01`
(matrix or rotation vector), `T_01`, and the list `names`. EasyMocap's intri.yml and extri.yml have
the second layout (https://chingswy.github.io/easymocap-public-doc/database/1_camera.html).

The YAML of OpenCV's FileStorage is not quite YAML: the header is `%YAML:1.0`, and flow maps have no
space after a colon ({ x:1 }). Matrices are `!!opencv-matrix` with rows, cols, dt and data.
https://docs.opencv.org/4.x/da/d56/classcv_1_1FileStorage.html
"""

import functools
import re
import tomllib
import xml.etree.ElementTree as tree
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from humangs_jax.core.array_types import Float
from humangs_jax.data.cameras import (
    UNDISTORT_BEFORE,
    CalibratedCamera,
    Calibration,
    CalibrationFile,
    brown_conrady,
    fisheye_lens,
    image_size,
    intrinsics,
    pinhole_lens,
    pose_matrix,
    rotation,
)
from humangs_jax.data.capture_checks import CaptureError, checked_text, expect, floats
from humangs_jax.data.formats import CameraFormat
from humangs_jax.io.reading import (
    InvalidFileError,
    check_limit,
    check_nesting,
    limits,
    parse_json,
    reading,
)

_FISHEYE = ("fisheye", "is_fisheye", "equidistant")
"""Words that mark a fisheye lens. A file has such a word as a value (of `model`, for example), or
as a key with a true value.
"""


Where = Callable[[str], tuple[Path, str]]
"""Type of a function that takes the key of a camera's value. It returns the file and the name of
the field, for error messages.
"""


def _in_map(file: Path, name: str) -> Where:
    """Returns a `Where` for the keys of the map with this name."""
    return lambda key: (file, f"{name}.{key}")


def recognizes_opencv(source: CalibrationFile) -> bool:
    """Returns whether a file has keys that begin with K_, or a map with K, R or T. The file has to
    look like JSON or YAML.

    Raises: CaptureError if such a file cannot be parsed.
    """
    if not (
        source.text.lstrip().startswith(("{", "%YAML", "---"))
        or source.path.suffix in (".yml", ".yaml")
    ):
        return False
    values = _values(source)
    maps = (value for value in values.values() if isinstance(value, Mapping))
    return any(key.startswith("K_") for key in values) or any(
        {"K", "R", "T"} & set(each) for each in maps
    )


def read_opencv(source: CalibrationFile, format: CameraFormat) -> Calibration:
    """Reads the cameras of one file.

    Raises: CaptureError if there is no camera, or if a value is missing or wrong. The error names
    the key of a wrong value.
    """
    values = _values(source)
    nested = {name: value for name, value in values.items() if isinstance(value, Mapping)}
    if not nested:
        return source.calibration(format, _flat_cameras(values, lambda key: source.path))
    cameras = [_one_camera(name, each, _in_map(source.path, name)) for name, each in nested.items()]
    return source.calibration(format, cameras)


@functools.lru_cache(maxsize=1)
def _values(source: CalibrationFile) -> dict[str, Any]:
    """Returns the values of a file. They are cached, because parsing YAML is slow."""
    return parse_file_storage(source.text, source.path)


def read_easymocap(source: CalibrationFile, format: CameraFormat) -> Calibration:
    """Reads the cameras of the folder's two files, intri.yml and extri.yml.

    Raises: CaptureError if a file cannot be read, if there is no camera, or if a value is missing
    or wrong. The error names the file, and the key of a wrong value.
    """
    inner, outer = source.path / "intri.yml", source.path / "extri.yml"

    def file_of(key: str) -> Path:
        return outer if key.startswith(("R", "T")) else inner

    values = {}
    for file in (inner, outer):
        content = parse_file_storage(checked_text(file), file)
        values |= {
            key: value for key, value in content.items() if key == "names" or file_of(key) == file
        }
    return source.calibration(format, _flat_cameras(values, file_of), file=outer)


def _flat_cameras(
    values: Mapping[str, Any], file_of: Callable[[str], Path]
) -> list[CalibratedCamera]:
    """Reads cameras from a map of all cameras' values, in which each key ends with a camera's name.
    The list `names` in the map gives the names. Without this list, each key K_NAME gives a name.

    file_of: returns the file that has a key, for errors.

    Raises: CaptureError if there is no camera, or if a value is missing or wrong.
    """
    names = list(values.get("names") or (key[2:] for key in values if key.startswith("K_")))
    if not names:
        raise CaptureError(
            file_of("K"), "", "no camera: expected K, R and T of each, or K_NAME, R_NAME and T_NAME"
        )
    cameras = []
    for name in map(str, names):
        # dist_a_1 is of camera a_1, if there is one, and not of camera 1
        longer = tuple(f"_{other}" for other in names if len(str(other)) > len(name))
        own = {
            key: each
            for key, each in values.items()
            if key.endswith(f"_{name}") and not key.endswith(longer)
        }
        own = {key.removesuffix(f"_{name}"): each for key, each in own.items()}
        cameras.append(
            _one_camera(name, own, lambda key, name=name: (file_of(key), f"{key}_{name}"))
        )
    return cameras


def _renamed_camera(
    name: str, entry: Mapping[str, Any], keys: Mapping[str, str], file: Path, field: str
) -> CalibratedCamera:
    """Reads a camera whose values have other keys than OpenCV's. keys: OpenCV's key by the key of
    the entry. Values with keys that are not in `keys` are ignored. file and field: place of the
    entry, for errors.
    """
    theirs = {ours: key for key, ours in keys.items()} | {
        keys[key]: key for key in entry if key in keys
    }
    values = {ours: entry[key] for ours, key in theirs.items() if key in entry}
    return _one_camera(name, values, lambda key: (file, f"{field}.{theirs.get(key, key)}"))


def _one_camera(name: str, values: Mapping[str, Any], where: Where) -> CalibratedCamera:
    if "K" not in values and {"fx", "fy", "cx", "cy", "T", "R"} <= values.keys():
        values = _of_shelf(values, where)
    # EasyMocap has both: the matrix and the rotation vector
    turn_key = "Rot" if "Rot" in values else "R"
    for key in ("K", turn_key, "T"):
        if key not in values:
            raise CaptureError(*where(key), "missing")
    turn = rotation(values[turn_key], *where(turn_key))
    pose = pose_matrix(turn, floats(values["T"], *where("T"), (3,)))
    K = floats(values["K"], *where("K"), (3, 3))
    lens = _lens(values, where)
    sizes = {key: values[key] for key in ("imgSize", "image_size") if key in values}
    sizes |= {
        w: [values[w], values[h]]
        for w, h in (("width", "height"), ("W", "H"))
        if {w, h} <= values.keys()
    }
    size = next((image_size(value, *where(key)) for key, value in sizes.items()), (None, None))
    return CalibratedCamera(name, K, pose, *size, **lens)


def _lens(values: Mapping[str, Any], where: Where) -> dict[str, Any]:
    """Returns the fields of `CalibratedCamera` that describe the lens. For a fisheye lens they
    include an error. Commands that need photos without distortion raise it later.
    """
    coefficients, at, refusal = None, "", None
    for key, value in values.items():
        if isinstance(value, str):
            fisheye = value.lower() in _FISHEYE
        else:
            fisheye = key.lower() in _FISHEYE and bool(value)
            if key.lower() == "d" or key.lower().startswith("dist"):
                coefficients, at = value, key
        if fisheye:
            refusal = CaptureError(
                *where(key), f"fisheye lenses are not supported: {UNDISTORT_BEFORE}"
            )
    if refusal is not None:
        given = [] if coefficients is None else coefficients
        return fisheye_lens(given, *where(at or "dist"), refusal)
    return {} if coefficients is None else pinhole_lens(coefficients, *where(at))


def _of_shelf(values: Mapping[str, Any], where: Where) -> dict[str, Any]:
    """Returns OpenCV's values of a camera in the format of Shelf and Campus (VoxelPose).

    In this format fx, fy, cx and cy stand alone. The distortion is in k (k1, k2, k3) and p (p1,
    p2). T is the position of the camera in the world.
    """

    def numbers(key: str, *shape: int) -> Float[np.ndarray, "..."]:
        return floats(values[key], *where(key), shape)

    turn, lens = rotation(values["R"], *where("R")), {}
    if "k" in values:
        k = numbers("k", 3)
        p = numbers("p", 2) if "p" in values else (0, 0)
        lens = {"dist": [k[0], k[1], p[0], p[1], k[2]]}
    K = intrinsics(*(float(numbers(key)) for key in ("fx", "fy", "cx", "cy")))
    others = {key: value for key, value in values.items() if key not in ("k", "p")}
    return others | lens | {"K": K, "R": turn, "T": -turn @ numbers("T", 3)}


# FileStorage
# --------------------------------------------------------------------------------------------------

_MATRIX = "opencv-matrix"
"""Tag of matrices in FileStorage."""


def parse_file_storage(text: str, file: Path) -> dict[str, Any]:
    """Parses a FileStorage text and returns its values by key. Matrices are arrays (rows, columns).

    Raises: CaptureError if the text cannot be parsed. It names the line of a fault of the syntax.
    """
    with reading(file, "YAML file", CaptureError):
        if text.lstrip().startswith("{"):
            values = _matrices(parse_json(text), file, "")
        else:
            values = _yaml(text, file)
        if not isinstance(values, dict):
            raise InvalidFileError("expected keys with values")
        return values


def _yaml(text: str, file: Path) -> Any:
    check_limit("slow_text_bytes", len(text), "characters of YAML")
    kept = ["" if line.startswith(("%", "---", "...")) else line for line in text.splitlines()]
    try:
        # keys of flow maps have their value right behind the colon, which YAML does not allow
        spaced = re.sub(r"([{,]\s*\w+):(?=\S)", r"\1: ", "\n".join(kept))
        root = _Loader(spaced).get_single_node()
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        where = f"line {mark.line + 1}" if mark else ""
        raise CaptureError(file, where, error.problem or error) from error
    return {} if root is None else _value(root, file)


class _Loader(yaml.SafeLoader):
    depth = 0

    def compose_node(self, parent: Any, index: Any) -> Any:
        """Returns the next node of the YAML file.

        Raises: MarkedYAMLError for an alias, because a small file can expand to billions of values
        through nested aliases. InvalidFileError if nodes are nested too deeply.
        """
        if self.check_event(yaml.AliasEvent):
            where = self.get_event().start_mark
            raise yaml.MarkedYAMLError(problem="aliases are not supported", problem_mark=where)
        self.depth += 1
        if self.depth > limits().nesting:
            raise InvalidFileError("nested too deeply")
        node = super().compose_node(parent, index)
        self.depth -= 1
        return node


def _value(node: yaml.Node, file: Path) -> Any:
    """Returns the Python value of a YAML node. Numbers are parsed here, and not by the YAML
    library, so that the name 01 of a camera stays text.
    """
    if isinstance(node, yaml.ScalarNode):
        value = _scalar(node.value) if node.style is None else node.value
    elif isinstance(node, yaml.SequenceNode):
        value = [_value(item, file) for item in node.value]
    else:
        value = {str(key.value): _value(item, file) for key, item in node.value}
    if node.tag in yaml.SafeLoader.yaml_constructors:
        return value
    tag = node.tag.removeprefix("tag:yaml.org,2002:")  # what `!!` stands for
    return _matrix(value, tag, file, f"line {node.start_mark.line + 1}")


def _scalar(text: str) -> int | float | str | None:
    if text.lower() in (".nan", ".inf", "-.inf"):
        return float(text.lower().replace(".", ""))
    number = re.fullmatch(r"[+-]?(\d+(\.\d*)?|\.\d+)([eE][+-]?\d+)?", text)
    if number and not re.fullmatch(r"[+-]?0\d+", text):
        return int(text) if re.fullmatch(r"[+-]?\d+", text) else float(text)
    return text if text not in ("", "~", "null") else None


def _matrix(value: Any, tag: str, file: Path, where: str) -> Float[np.ndarray, "rows columns"]:
    if tag != _MATRIX:
        raise CaptureError(file, where, f"type {tag!r} is not supported: expected {_MATRIX}")
    try:
        # dt is "d", or "3d" with three channels
        channels = int(re.sub(r"\D.*", "", str(value["dt"])) or 1)
        rows, columns = int(value["rows"]), int(value["cols"]) * channels
        return np.asarray(value["data"], np.float64).reshape(rows, columns)
    except (KeyError, TypeError, ValueError) as error:
        raise CaptureError(
            file, where, f"not a matrix of rows, cols, dt and data: {error}"
        ) from error


def _matrices(value: Any, file: Path, field: str) -> Any:
    """Returns JSON values. Each map in them that describes a matrix is replaced by an array, (rows,
    columns).
    """
    if isinstance(value, list):
        return [_matrices(item, file, field) for item in value]
    if not isinstance(value, dict):
        return value
    if "type_id" in value:
        return _matrix(value, value["type_id"], file, field)
    return {key: _matrices(item, file, f"{field}.{key}".lstrip(".")) for key, item in value.items()}


# CMU Panoptic: a list `cameras` of K, distCoef, R, t (centimetres) and resolution
# --------------------------------------


def recognizes_panoptic(source: CalibrationFile) -> bool:
    """Returns whether a file has a list "cameras", and no "frames"."""
    return (
        isinstance(source.json, dict)
        and isinstance(source.json.get("cameras"), list)
        and "frames" not in source.json
    )


def read_panoptic(source: CalibrationFile, format: CameraFormat) -> Calibration:
    """Reads the cameras in the file's list "cameras".

    Raises: CaptureError if a value is missing or wrong. The error names its key.
    """
    # Panoptic's keys -> OpenCV's
    keys = {
        "K": "K",
        "distCoef": "dist",
        "R": "R",
        "T": "T",
        "t": "T",
        "resolution": "imgSize",
    }
    cameras, file = [], source.path
    for i, entry in enumerate(source.json["cameras"]):
        expect(entry, dict, file, f"cameras[{i}]")
        cameras.append(
            _renamed_camera(str(entry.get("name", i)), entry, keys, file, f"cameras[{i}]")
        )
    return source.calibration(format, cameras)


# multical: `cameras` with lenses, and `camera_poses` from one camera to another
# -------------------------------------------

_RELATIVE = "_to_"
"""Text between the names of two cameras in a key. The key "a_to_b" has the pose (R, T) of camera a
relative to b, with X_a = R X_b + T.
"""


def recognizes_multical(source: CalibrationFile) -> bool:
    """Returns whether a file has maps "cameras" and "camera_poses"."""
    return isinstance(source.json, dict) and all(
        isinstance(source.json.get(key), dict) for key in ("cameras", "camera_poses")
    )


def read_multical(source: CalibrationFile, format: CameraFormat) -> Calibration:
    """Reads the lenses and the poses of the cameras.

    A pose that is not relative to another camera is relative to the world. If poses are relative to
    a camera that has no pose, the axes of this camera are the world's.

    Raises: CaptureError if a value or a pose is missing or wrong. The error names its key.
    """
    file, lenses = source.path, source.json["cameras"]
    poses: dict[str, Float[np.ndarray, "4 4"]] = {}
    waiting: dict[str, tuple[str, Float[np.ndarray, "4 4"]]] = {}
    for key, entry in source.json["camera_poses"].items():
        field = f"camera_poses.{key}"
        expect(entry, dict, file, field)
        for part in ("R", "T"):
            if part not in entry:
                raise CaptureError(file, f"{field}.{part}", "missing")
        turn = rotation(entry["R"], file, f"{field}.R")
        pose = pose_matrix(turn, floats(entry["T"], file, f"{field}.T", (3,)))
        name, base = _related(key, lenses)
        if base is None:
            poses[name] = pose
        else:
            waiting[name] = base, pose
    # a camera may be placed by one that is itself placed by another
    for base in [base for base, _ in waiting.values() if base not in waiting]:
        poses.setdefault(base, np.eye(4))
    for _ in range(len(waiting)):
        ready = [name for name, (base, _) in waiting.items() if base in poses]
        for name in ready:
            base, pose = waiting.pop(name)
            poses.setdefault(name, pose @ poses[base])
    cameras = []
    for name, lens in lenses.items():
        expect(lens, dict, file, f"cameras.{name}")
        if name not in poses:
            raise CaptureError(
                file, f"camera_poses.{name}", "missing: where does this camera stand?"
            )
        values = lens | {"R": poses[name][:3, :3].tolist(), "T": poses[name][:3, 3].tolist()}
        cameras.append(_one_camera(name, values, _in_map(file, f"cameras.{name}")))
    return source.calibration(format, cameras)


def _related(key: str, names: Mapping[str, Any]) -> tuple[str, str | None]:
    """Splits a key of `camera_poses` into the name of the camera whose pose it has, and the name of
    the camera to which the pose is relative. The second is None if the pose is relative to the
    world. names: names of all cameras.
    """
    parts = key.split(_RELATIVE)
    for i in range(1, len(parts)):
        name, base = _RELATIVE.join(parts[:i]), _RELATIVE.join(parts[i:])
        if name in names and base in names:
            return name, base
    return key, None


# TOML of Caliscope, Anipose and Pose2Sim: a table of each camera
# -------------------------------------------------------


def recognizes_toml(source: CalibrationFile) -> bool:
    """Returns whether a file has the suffix .toml and tables of cameras.

    Raises: TOMLDecodeError if a file with this suffix is no TOML. InvalidFileError if it is too
    long or nested too deeply. CaptureError if a camera in `cameras` is no table.
    """
    return source.path.suffix.lower() == ".toml" and bool(_tables(source))


def read_toml(source: CalibrationFile, format: CameraFormat) -> Calibration:
    """Reads the cameras of a file. Cameras with `ignore = true` are left out.

    Raises: CaptureError if all cameras are left out, or if a value is missing or wrong. The error
    names the key of a wrong value. InvalidFileError if the file is too long or nested too deeply.
    TOMLDecodeError if it is no TOML.
    """
    cameras, file = [], source.path
    for key, table in _tables(source).items():
        if table.get("ignore") is True:
            continue
        name = str(table.get("name", key.rsplit(".", 1)[-1]))
        # keys of a table -> OpenCV's
        keys = {
            "matrix": "K",
            "rotation": "R",
            "translation": "T",
            "distortions": "dist",
            "size": "imgSize",
            "fisheye": "fisheye",
        }
        cameras.append(_renamed_camera(name, table, keys, file, key))
    if not cameras:
        raise CaptureError(file, "", "every camera is to be ignored")
    return source.calibration(format, cameras)


@functools.lru_cache(maxsize=1)
def _tables(source: CalibrationFile) -> dict[str, Mapping[str, Any]]:
    check_limit("slow_text_bytes", len(source.text), "characters of TOML")
    content = tomllib.loads(source.text)
    check_nesting(content)
    found = {}
    for key, value in content.items():
        if isinstance(value, dict) and key == "cameras":
            found |= {
                f"cameras.{name}": expect(each, dict, source.path, f"cameras.{name}")
                for name, each in value.items()
            }
        elif isinstance(value, dict) and ("matrix" in value or "rotation" in value):
            found[key] = value
    return found


# Qualisys Track Manager's XML
# ------------------------------------------------------------------------------------------

_SUBPIXELS = 64.0
"""Focal lengths and principal points in the file are in units of 1/64 pixel."""
_LENS = ("radialDistortion1", "radialDistortion2", "tangentalDistortion1", "tangentalDistortion2")
"""XML attributes of the Brown-Conrady coefficients, in the order k1, k2, p1, p2."""


def recognizes_qualisys(source: CalibrationFile) -> bool:
    """Returns whether a file is XML with the transforms and focal lengths of Qualisys."""
    text = source.text.lstrip()
    return text.startswith("<") and "<transform" in text and "focalLengthU" in text


def read_qualisys(source: CalibrationFile, format: CameraFormat) -> Calibration:
    """Reads the cameras of the file that have a transform.

    Raises: CaptureError if no camera has a transform, or if a number of a camera is missing or
    wrong. For a number, the error names the attribute and the index of the camera, counted from 0
    among the cameras with a transform. InvalidFileError if the XML declares entities or is too
    long. ParseError if the file is no XML.
    """
    check_limit("slow_text_bytes", len(source.text), "characters of XML")
    if re.search(r"<!(DOCTYPE|ENTITY)", source.text):
        raise InvalidFileError("XML with entities, which are not read")
    elements = [
        each
        for each in tree.fromstring(source.text).iter("camera")
        if each.find("transform") is not None
    ]
    cameras = [_camera(element, f"camera {i}", source) for i, element in enumerate(elements)]
    if not cameras:
        raise CaptureError(source.path, "", "no camera with a transform")
    return source.calibration(format, cameras)


def _camera(element: tree.Element, field: str, source: CalibrationFile) -> CalibratedCamera:
    def number(part: str, key: str) -> float:
        text = getattr(element.find(part), "attrib", {}).get(key, "")
        try:
            return float(floats(float(text), source.path, f"{field}.{part}.{key}", ()))
        except ValueError:
            raise CaptureError(
                source.path, f"{field}.{part}.{key}", f"expected a finite number, got {text!r}"
            ) from None

    turn = np.diag([1.0, -1, -1]) @ [
        [number("transform", f"r{i}{j}") for j in (1, 2, 3)] for i in (1, 2, 3)
    ]
    place = 1e-3 * np.asarray([number("transform", axis) for axis in "xyz"])  # millimetres
    left, top, right, bottom = (
        number("fov_video", side) for side in ("left", "top", "right", "bottom")
    )
    focal = [number("intrinsic", f"focalLength{axis}") / _SUBPIXELS for axis in "UV"]
    center = [number("intrinsic", f"centerPoint{axis}") / _SUBPIXELS for axis in "UV"]
    K = intrinsics(*focal, center[0] - left, center[1] - top)
    size = image_size([right - left + 1, bottom - top + 1], source.path, f"{field}.fov_video")
    lens = brown_conrady(
        [number("intrinsic", key) for key in _LENS], source.path, f"{field}.intrinsic"
    )
    name = element.get("serial") or element.get("name") or field
    return CalibratedCamera(name, K, pose_matrix(turn, -turn @ place), *size, lens)
