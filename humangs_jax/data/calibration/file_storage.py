"""OpenCV's FileStorage, YAML or JSON, as nested dicts, lists, numbers, strings and matrices.

Only what OpenCV writes (and EasyMocap, which imitates it) is read, not all of YAML: block maps and sequences, flow ones
in brackets that may span lines, quoted and plain scalars, and `!!opencv-matrix` with rows, cols, dt and data.
https://docs.opencv.org/4.x/da/d56/classcv_1_1FileStorage.html
"""

import re
from pathlib import Path
from typing import Any

import numpy as np

from humangs_jax.data.capture_checks import CaptureError, checked_json

MATRIX = "opencv-matrix"
NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?")
ENTRY = re.compile(r"""("[^"]*"|'[^']*'|[^\s:"'\[{][^:]*?)\s*:(?:\s+(.*))?$""")
"""`key:` or `key: value`."""


def parse_file_storage(text: str, file: Path) -> dict[str, Any]:
    """The values of a FileStorage text; matrices are (rows, cols) arrays. Raises: CaptureError naming the line."""
    if text.lstrip().startswith("{"):
        values = _matrices(checked_json(file, text), file, "")
    else:
        lines = _logical_lines(text, file)
        values, rest = _block(lines, file) if lines else ({}, [])
        if rest:
            raise CaptureError(file, f"line {rest[0][1]}", "the indentation fits no line above")
    if not isinstance(values, dict):
        raise CaptureError(file, "", "expected keys with values")
    return values


def _logical_lines(text, file):
    """(indentation, line number, content), without comments, flow values joined to one line each."""
    lines, depth = [], 0
    for number, line in enumerate(text.splitlines(), 1):
        content = re.sub(r"(^|\s)#.*", "", line).rstrip()
        if not content.strip() or content.startswith(("%", "---", "...")):
            continue
        if depth:
            lines[-1][2] += " " + content.strip()
        else:
            lines.append([len(content) - len(content.lstrip()), number, content.strip()])
        depth += len(re.findall(r"[\[{]", content)) - len(re.findall(r"[\]}]", content))
    if depth:
        raise CaptureError(file, f"line {lines[-1][1]}", "a bracket is not closed")
    return lines


def _block(lines, file):
    """The map or sequence that begins with lines[0], and the lines after it."""
    indent, values = lines[0][0], None
    while lines and lines[0][0] == indent:
        _, number, content = lines[0]
        is_item = content == "-" or content.startswith("- ")
        values = ([] if is_item else {}) if values is None else values
        entry = None if is_item else ENTRY.match(content)
        if is_item != isinstance(values, list) or not (is_item or entry):
            raise CaptureError(
                file, f"line {number}", f"expected {'an item' if is_item else '`key: value`'}: {content!r}"
            )
        text = content[1:].strip() if entry is None else (entry[2] or "").strip()
        value, lines = _value(text, lines[1:], indent, number, file, allow_level=not is_item)
        if isinstance(values, list):
            values.append(value)
        elif entry is not None:
            values[str(_scalar(entry[1], quoted_only=True))] = value
    return values, lines


def _value(text, rest, indent, number, file, allow_level):
    """The value after a key or a dash: on the same line, or the block on the deeper lines below."""
    tag = re.match(r"!!?(\S+)\s*", text)
    text = text[tag.end() :] if tag else text
    if text:
        value = _flow(text, number, file)
    elif rest and (rest[0][0] > indent or (allow_level and rest[0][0] == indent and rest[0][2].startswith("- "))):
        value, rest = _block(rest, file)
    else:
        value = None
    if tag and tag[1] not in ("map", "seq", "str", "int", "float"):
        value = _matrix(value, tag[1], file, f"line {number}")
    return value, rest


def _flow(text, number, file):
    """A bracketed list or map, or a scalar."""
    if text[0] not in "[{":
        return _scalar(text)
    if text[-1] != {"[": "]", "{": "}"}[text[0]]:
        raise CaptureError(file, f"line {number}", f"expected one closed bracket: {text[:40]!r}")
    parts, depth, start = [], 0, 1
    for i, letter in enumerate(text):
        depth += letter in "[{"
        if (letter == "," and depth == 1) or i == len(text) - 1:
            parts.append(text[start:i].strip())
            start = i + 1
        depth -= letter in "]}"
    parts = [part for part in parts if part]
    if text[0] == "[":
        return [_flow(part, number, file) for part in parts]
    pairs = [part.partition(":") for part in parts]
    return {str(_scalar(key.strip(), quoted_only=True)): _flow(v.strip() or "~", number, file) for key, _, v in pairs}


def _scalar(text, quoted_only=False):
    """A number, .Nan, .Inf, or a string with or without quotes; keys stay strings even if they are digits."""
    if len(text) > 1 and text[0] in "\"'" and text[-1] == text[0]:
        return text[1:-1]
    if quoted_only:
        return text
    if text.lower() in (".nan", ".inf", "-.inf"):
        return float(text.lower().replace(".", ""))
    if NUMBER.fullmatch(text) and not re.fullmatch(r"[+-]?0\d+", text):  # 01 is a camera's name
        return int(text) if re.fullmatch(r"[+-]?\d+", text) else float(text)
    return text


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
