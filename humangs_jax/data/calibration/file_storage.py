"""OpenCV's FileStorage, YAML or JSON, as nested dicts, lists, numbers, strings and matrices.

Its YAML is not quite YAML: the header is `%YAML:1.0`, and flow maps have no space after a colon ({ x:1 }). Matrices are
`!!opencv-matrix` with rows, cols, dt and data. https://docs.opencv.org/4.x/da/d56/classcv_1_1FileStorage.html
"""

import re
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from humangs_jax.data.capture_checks import CaptureError, checked_json
from humangs_jax.io.reading import check_limit, limits, reading

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


def _scalar(text):
    """A number, .Nan, .Inf, None or a string."""
    if text.lower() in (".nan", ".inf", "-.inf"):
        return float(text.lower().replace(".", ""))
    if NUMBER.fullmatch(text) and not re.fullmatch(r"[+-]?0\d+", text):
        return int(text) if re.fullmatch(r"[+-]?\d+", text) else float(text)
    return text if text not in ("", "~", "null") else None


def _matrix(value, tag, file, where):
    if tag != MATRIX:
        raise CaptureError(file, where, f"type {tag!r} is not supported: expected {MATRIX}")
    try:
        return np.asarray(value["data"], np.float64).reshape(int(value["rows"]), _columns(value))
    except (KeyError, TypeError, ValueError) as error:
        raise CaptureError(file, where, f"not a matrix of rows, cols, dt and data: {error}") from error


def _columns(value):
    """Columns times channels; dt is "d", or "3d" with three channels."""
    channels = re.match(r"\d*", str(value["dt"]))
    return int(value["cols"]) * int(channels[0] if channels and channels[0] else 1)


def _matrices(value, file, field):
    """JSON values with the maps that stand for matrices replaced by arrays."""
    if isinstance(value, list):
        return [_matrices(item, file, field) for item in value]
    if not isinstance(value, dict):
        return value
    if "type_id" in value:
        return _matrix(value, value["type_id"], file, field)
    return {key: _matrices(item, file, f"{field}.{key}".lstrip(".")) for key, item in value.items()}
