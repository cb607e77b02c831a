"""Formats with a camera for each camera: OpenCV's K, R and T (AvatarReX, THuman4.0), EasyMocap, Panoptic, TOML, Qualisys.

A world point X is at R X + T in the camera, pixel centres are at whole numbers. The values of a camera stand in a map of its own,
`{"cam00": {"K": .., "R": .., "T": .., "imgSize": [W, H]}}`, or beside those of others with its name behind: `K_01`, `dist_01`,
`Rot_01` or `R_01` (matrix or rotation vector), `T_01`, with the list `names`, as in EasyMocap's intri.yml and extri.yml
(https://chingswy.github.io/easymocap-public-doc/database/1_camera.html).

FileStorage's YAML is not quite YAML: the header is `%YAML:1.0`, and flow maps have no space after a colon ({ x:1 }). Matrices are
`!!opencv-matrix` with rows, cols, dt and data. https://docs.opencv.org/4.x/da/d56/classcv_1_1FileStorage.html
"""

import functools
import re
import tomllib
import xml.etree.ElementTree as tree
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from humangs_jax.core.array_types import Float
from humangs_jax.data.calibration.calibration import (
    UNDISTORT_BEFORE,
    CalibratedCamera,
    Calibration,
    Source,
    brown_conrady,
    image_size,
    intrinsics,
    pose_matrix,
    rotation,
)
from humangs_jax.data.capture_checks import CaptureError, checked_json, checked_text, expect, floats
from humangs_jax.data.formats import CameraFormat
from humangs_jax.io.reading import Refused, check_limit, check_nesting, limits, reading

FISHEYE = ("fisheye", "is_fisheye", "equidistant")
"""Values of `model` and the like, or keys that are true, of lenses with another formula."""
SIZE_KEYS = ("imgSize", "image_size")


def recognizes_opencv(source: Source) -> bool:
    """Whether a file has K, R and T of cameras."""
    if not (source.text.lstrip().startswith(("{", "%YAML", "---")) or source.path.suffix in (".yml", ".yaml")):
        return False
    values = _values(source)
    maps = (value for value in values.values() if isinstance(value, Mapping))
    return bool(_names(values)) or any({"K", "R", "T"} & set(each) for each in maps)


def read_opencv(source: Source, format: CameraFormat) -> Calibration:
    """The cameras of one file. Raises: CaptureError naming the key."""
    values, file = _values(source), source.path
    nested = {name: value for name, value in values.items() if isinstance(value, Mapping)}
    if not nested:
        return source.calibration(format, flat_cameras(values, values, (file, file), values.get("names")))
    before = lambda name: lambda key: f"{name}.{key}"
    cameras = [one_camera(name, value, value, (file, file), before(name)) for name, value in nested.items()]
    return source.calibration(format, cameras)


@functools.lru_cache(maxsize=1)
def _values(source: Source) -> dict[str, Any]:
    """Parsed once: YAML is slow."""
    return parse_file_storage(source.text, source.path)


def flat_cameras(
    inner: Mapping[str, Any], outer: Mapping[str, Any], files: tuple[Path, Path], names: Iterable[object] | None
) -> list[CalibratedCamera]:
    """Cameras whose names stand behind their keys. inner, outer: intrinsic and extrinsic values, of these files.

    names: of the cameras; None: those that have a K. Raises: CaptureError naming file and key.
    """
    names = list(names or _names(inner))
    if not names:
        raise CaptureError(files[0], "", "no camera: expected K, R and T of each, or K_NAME, R_NAME and T_NAME")
    behind = lambda name: lambda key: f"{key}_{name}"
    own = lambda values, name: _of_camera(values, name, names)
    return [one_camera(str(name), own(inner, name), own(outer, name), files, behind(name)) for name in names]


def _names(values: Mapping[str, Any]) -> list[str]:
    return [key[2:] for key in values if key.startswith("K_")]


def _of_camera(values: Mapping[str, Any], name: object, names: list[Any]) -> dict[str, Any]:
    """`K_01: ..` of all cameras -> `K: ..` of one. `dist_a_1` is of camera a_1, if there is one, and not of camera 1."""
    end = f"_{name}"
    longer = tuple(f"_{other}" for other in names if len(str(other)) > len(str(name)))
    own = {key: value for key, value in values.items() if key.endswith(end) and not key.endswith(longer)}
    return {key[: -len(end)]: value for key, value in own.items()}


def one_camera(
    name: str, inner: Mapping[str, Any], outer: Mapping[str, Any], files: tuple[Path, Path], field: Callable[[str], str]
) -> CalibratedCamera:
    """A camera of its intrinsic and extrinsic values, and their files. `field` makes keys those of the file, for errors."""
    if "K" not in inner and {"fx", "fy", "cx", "cy", "T", "R"} <= inner.keys():
        inner = outer = _of_shelf(inner, files[0], field)
    inner_file, outer_file = files
    turn_key = "Rot" if "Rot" in outer else "R"  # EasyMocap has both: the matrix and the rotation vector
    for key, values, file in (("K", inner, inner_file), (turn_key, outer, outer_file), ("T", outer, outer_file)):
        if key not in values:
            raise CaptureError(file, field(key), "missing")
    turn = rotation(outer[turn_key], outer_file, field(turn_key))
    translation = floats(outer["T"], outer_file, field("T"), (3,))
    K = floats(inner["K"], inner_file, field("K"), (3, 3))
    distortion = _distortion(inner, inner_file, field)
    width, height = _size(inner, inner_file, field)
    return CalibratedCamera(name, K, pose_matrix(turn, translation), width, height, distortion)


def _renamed_camera(name: str, entry: Mapping[str, Any], keys: Mapping[str, str], file: Path, prefix: str) -> CalibratedCamera:
    """A camera of an entry whose `keys` are those of OpenCV by other names."""
    values = {ours: entry[theirs] for theirs, ours in keys.items() if theirs in entry}
    theirs = {ours: name for name, ours in keys.items()}
    return one_camera(name, values, values, (file, file), lambda key: f"{prefix}.{theirs.get(key, key)}")


def _of_shelf(values: Mapping[str, Any], file: Path, field: Callable[[str], str]) -> dict[str, Any]:
    """Shelf and Campus (VoxelPose): focal lengths and centres by name, a lens as k and p; T is where the camera stands."""
    fx, fy, cx, cy = (float(floats(values[key], file, field(key), ())) for key in ("fx", "fy", "cx", "cy"))
    turn = rotation(values["R"], file, field("R"))
    place = floats(np.ravel(values["T"]).tolist(), file, field("T"), (3,))
    lens = {}
    if "k" in values:
        k = floats(np.ravel(values["k"]).tolist(), file, field("k"), (3,))
        p = floats(np.ravel(values.get("p", [0, 0])).tolist(), file, field("p"), (2,))
        lens = {"dist": [k[0], k[1], p[0], p[1], k[2]]}
    others = {key: value for key, value in values.items() if key not in ("k", "p")}
    return others | lens | {"K": intrinsics(fx, fy, cx, cy), "R": turn, "T": -turn @ place}


def _distortion(values: Mapping[str, Any], file: Path, field: Callable[[str], str]) -> Float[np.ndarray, "5"] | None:
    """The coefficients of `D`, `dist`, `distCoeff`, ...; lenses that they do not describe are refused."""
    coefficients = None
    for key, value in values.items():
        fisheye = value.lower() in FISHEYE if isinstance(value, str) else key.lower() in FISHEYE and bool(value)
        if fisheye:
            raise CaptureError(file, field(key), f"fisheye lenses are not supported: {UNDISTORT_BEFORE}")
        if (key.lower() == "d" or key.lower().startswith("dist")) and not isinstance(value, str):
            coefficients = brown_conrady(value, file, field(key))
    return coefficients


def _size(values: Mapping[str, Any], file: Path, field: Callable[[str], str]) -> tuple[int | None, int | None]:
    for key in SIZE_KEYS:
        if key in values:
            return image_size(values[key], file, field(key))
    for pair in (("width", "height"), ("W", "H")):
        if all(key in values for key in pair):
            return image_size([values[key] for key in pair], file, field(pair[0]))
    return None, None


# FileStorage -----------------------------------------------------------------------------------------------------------

MATRIX = "opencv-matrix"
YAML_TAG = "tag:yaml.org,2002:"
"""What `!!` stands for."""
NUMBER = re.compile(r"[+-]?(\d+(\.\d*)?|\.\d+)([eE][+-]?\d+)?")
TIGHT_KEY = re.compile(r"([{,]\s*\w+):(?=\S)")
"""A key of a flow map with its value right behind the colon."""


def parse_file_storage(text: str, file: Path) -> dict[str, Any]:
    """The values of a FileStorage text; matrices are (rows, cols) arrays. Raises: CaptureError naming the line."""
    try:
        if text.lstrip().startswith("{"):
            values = _matrices(checked_json(file, text), file, "")
        else:
            with reading(file, "YAML file", CaptureError):
                check_limit("slow_text_bytes", len(text), "characters of YAML")
            kept = ["" if line.startswith(("%", "---", "...")) else line for line in text.splitlines()]
            root = _Loader(TIGHT_KEY.sub(r"\1: ", "\n".join(kept))).get_single_node()
            values = {} if root is None else _value(root, file)
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        raise CaptureError(file, f"line {mark.line + 1}" if mark else "", error.problem or error) from error
    except (yaml.YAMLError, RecursionError) as error:
        raise CaptureError(file, "", f"not readable as YAML: {error}") from error
    if not isinstance(values, dict):
        raise CaptureError(file, "", "expected keys with values")
    return values


class _Loader(yaml.SafeLoader):
    depth = 0

    def compose_node(self, parent: Any, index: Any) -> Any:
        """The next node; no aliases, which a small file can nest to billions of values."""
        if self.check_event(yaml.AliasEvent):
            where = self.get_event().start_mark
            raise yaml.MarkedYAMLError(problem="aliases are not supported", problem_mark=where)
        self.depth += 1
        if self.depth > limits().nesting:
            raise yaml.MarkedYAMLError(problem="nested too deeply", problem_mark=self.peek_event().start_mark)
        node = super().compose_node(parent, index)
        self.depth -= 1
        return node


def _value(node: yaml.Node, file: Path) -> Any:
    """The value of a node; numbers are read here, because YAML takes the camera's name 01 for one."""
    if isinstance(node, yaml.ScalarNode):
        value = _scalar(node.value) if node.style is None else node.value
    elif isinstance(node, yaml.SequenceNode):
        value = [_value(item, file) for item in node.value]
    else:
        value = {str(key.value): _value(item, file) for key, item in node.value}
    if node.tag in yaml.SafeLoader.yaml_constructors:
        return value
    return _matrix(value, node.tag.removeprefix(YAML_TAG), file, f"line {node.start_mark.line + 1}")


def _scalar(text: str) -> int | float | str | None:
    if text.lower() in (".nan", ".inf", "-.inf"):
        return float(text.lower().replace(".", ""))
    if NUMBER.fullmatch(text) and not re.fullmatch(r"[+-]?0\d+", text):
        return int(text) if re.fullmatch(r"[+-]?\d+", text) else float(text)
    return text if text not in ("", "~", "null") else None


def _matrix(value: Any, tag: str, file: Path, where: str) -> Float[np.ndarray, "rows columns"]:
    if tag != MATRIX:
        raise CaptureError(file, where, f"type {tag!r} is not supported: expected {MATRIX}")
    try:
        return np.asarray(value["data"], np.float64).reshape(int(value["rows"]), _columns(value))
    except (KeyError, TypeError, ValueError) as error:
        raise CaptureError(file, where, f"not a matrix of rows, cols, dt and data: {error}") from error


def _columns(value: Mapping[str, Any]) -> int:
    """Columns times channels; dt is "d", or "3d" with three channels."""
    channels = re.match(r"\d*", str(value["dt"]))
    return int(value["cols"]) * int(channels[0] if channels and channels[0] else 1)


def _matrices(value: Any, file: Path, field: str) -> Any:
    """JSON values with the maps that stand for matrices replaced by arrays."""
    if isinstance(value, list):
        return [_matrices(item, file, field) for item in value]
    if not isinstance(value, dict):
        return value
    if "type_id" in value:
        return _matrix(value, value["type_id"], file, field)
    return {key: _matrices(item, file, f"{field}.{key}".lstrip(".")) for key, item in value.items()}


# EasyMocap -------------------------------------------------------------------------------------------------------------


def read_easymocap(source: Source, format: CameraFormat) -> Calibration:
    """The cameras of both files. Raises: CaptureError naming file and key."""
    files = source.path / "intri.yml", source.path / "extri.yml"
    inner, outer = (parse_file_storage(checked_text(file), file) for file in files)
    cameras = flat_cameras(inner, outer, files, outer.get("names", inner.get("names")))
    return source.calibration(format, cameras, file=files[1])


# CMU Panoptic: a list `cameras` of K, distCoef, R, t (centimetres) and resolution --------------------------------------

PANOPTIC_KEYS = {"K": "K", "distCoef": "dist", "R": "R", "T": "T", "t": "T", "resolution": "imgSize"}


def recognizes_panoptic(source: Source) -> bool:
    """Whether a file has a list of cameras."""
    return isinstance(source.json, dict) and isinstance(source.json.get("cameras"), list) and "frames" not in source.json


def read_panoptic(source: Source, format: CameraFormat) -> Calibration:
    """The cameras of the list. Raises: CaptureError naming the key."""
    cameras, file = [], source.path
    for i, entry in enumerate(source.json["cameras"]):
        expect(entry, dict, file, f"cameras[{i}]")
        cameras.append(_renamed_camera(str(entry.get("name", i)), entry, PANOPTIC_KEYS, file, f"cameras[{i}]"))
    return source.calibration(format, cameras)


# TOML of Caliscope, Anipose and Pose2Sim: a table of each camera -------------------------------------------------------

TOML_KEYS = {"matrix": "K", "rotation": "R", "translation": "T", "distortions": "dist", "size": "imgSize", "fisheye": "fisheye"}
"""Names in the tables, and those of OpenCV's files."""


def recognizes_toml(source: Source) -> bool:
    """Whether a file is called so and has tables of cameras."""
    return source.path.suffix.lower() == ".toml" and bool(_tables(source))


def read_toml(source: Source, format: CameraFormat) -> Calibration:
    """The cameras of a file, but for those to be ignored or never placed. Raises: CaptureError naming the key."""
    cameras, file = [], source.path
    for key, table in _tables(source).items():
        if table.get("ignore") is True:
            continue
        name = str(table.get("name", key.rsplit(".", 1)[-1]))
        cameras.append(_renamed_camera(name, table, TOML_KEYS, file, key))
    if not cameras:
        raise CaptureError(file, "", "every camera is to be ignored")
    return source.calibration(format, cameras)


@functools.lru_cache(maxsize=1)
def _tables(source: Source) -> dict[str, Mapping[str, Any]]:
    check_limit("slow_text_bytes", len(source.text), "characters of TOML")
    try:
        content = tomllib.loads(source.text)
    except tomllib.TOMLDecodeError as error:
        raise Refused(f"not valid TOML: {error}") from error
    check_nesting(content)
    found = {}
    for key, value in content.items():
        if isinstance(value, dict) and key == "cameras":
            found |= {f"cameras.{name}": expect(each, dict, source.path, f"cameras.{name}") for name, each in value.items()}
        elif isinstance(value, dict) and ("matrix" in value or "rotation" in value):
            found[key] = value
    return found


# Qualisys Track Manager's XML ------------------------------------------------------------------------------------------

SUBPIXELS = 64.0
METRES = 1e-3
LENS = ("radialDistortion1", "radialDistortion2", "tangentalDistortion1", "tangentalDistortion2")


def recognizes_qualisys(source: Source) -> bool:
    """Whether a file is XML of a calibration with fields of view."""
    text = source.text.lstrip()
    return text.startswith("<") and "<transform" in text and "focalLengthU" in text


def read_qualisys(source: Source, format: CameraFormat) -> Calibration:
    """The cameras of a file. Raises: CaptureError naming the camera and what is missing."""
    check_limit("slow_text_bytes", len(source.text), "characters of XML")
    if re.search(r"<!(DOCTYPE|ENTITY)", source.text):
        raise Refused("XML with entities, which are not read")
    try:
        root = tree.fromstring(source.text)
    except tree.ParseError as error:
        raise Refused(f"not valid XML: {error}") from error
    elements = [each for each in root.iter("camera") if each.find("transform") is not None]
    cameras = [_camera(element, f"camera {i}", source) for i, element in enumerate(elements)]
    if not cameras:
        raise CaptureError(source.path, "", "no camera with a transform")
    return source.calibration(format, cameras)


def _camera(element: tree.Element, field: str, source: Source) -> CalibratedCamera:
    def number(part: str, key: str) -> float:
        found = element.find(part)
        text = None if found is None else found.get(key)
        try:
            value = float(text or "")
        except ValueError:
            raise CaptureError(source.path, f"{field}.{part}.{key}", f"expected a number, got {text!r}") from None
        if not np.isfinite(value) or abs(value) > 1e12:
            raise CaptureError(source.path, f"{field}.{part}.{key}", f"expected a finite number, got {value}")
        return value

    turn = np.asarray([[number("transform", f"r{i}{j}") for j in (1, 2, 3)] for i in (1, 2, 3)])
    turn = np.diag([1.0, -1, -1]) @ turn
    place = METRES * np.asarray([number("transform", axis) for axis in "xyz"])
    view = {side: number("fov_video", side) for side in ("left", "top", "right", "bottom")}
    focal = [number("intrinsic", f"focalLength{axis}") / SUBPIXELS for axis in "UV"]
    center = [number("intrinsic", f"centerPoint{axis}") / SUBPIXELS for axis in "UV"]
    K = intrinsics(*focal, center[0] - view["left"], center[1] - view["top"])
    size = [view["right"] - view["left"] + 1, view["bottom"] - view["top"] + 1]
    width, height = image_size(size, source.path, f"{field}.fov_video")
    lens = brown_conrady([number("intrinsic", key) for key in LENS], source.path, f"{field}.intrinsic")
    name = element.get("serial") or element.get("name") or field
    return CalibratedCamera(name, K, pose_matrix(turn, -turn @ place), width, height, lens)
