"""GLB, the binary form of glTF 2.0: JSON that describes arrays, and one block of their bytes. Parsed within limits, and written.

https://registry.khronos.org/glTF/specs/2.0/glTF-2.0.html#glb-file-format-specification
"""

import json
import os
import struct
from typing import Any

import numpy as np

from humangs_jax.io.atomic import write_bytes
from humangs_jax.io.reading import Refused, check_limit, check_unpacked, shown
from humangs_jax.io.text import parse_json

GLB_START, JSON_CHUNK, BINARY_CHUNK = 0x46546C67, 0x4E4F534A, 0x004E4942
COLUMNS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}
COMPONENTS = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
"""https://registry.khronos.org/glTF/specs/2.0/glTF-2.0.html#accessor-data-types"""
VERTICES, INDICES = 34962, 34963
"""Targets of views of a buffer: what a graphics card reads it as."""


def parse_glb(data: bytes, limit: str = "slow_text_bytes") -> tuple[dict[str, Any], bytes]:
    """The JSON of a GLB file and the bytes that it describes.

    Arguments: limit: of the JSON. That of scans is low, because trimesh, which loads them, is slow.
    Raises: Refused, KeyError, TypeError, ... for sizes that do not fit the file or are more than the limits allow.
    """
    start, _, _, length, kind = struct.unpack_from("<IIIII", data.ljust(20, b"\0"))
    if start != GLB_START or kind != JSON_CHUNK:
        raise Refused("not a mesh or skeleton that can be read: no GLB file")
    check_limit(limit, length, "bytes of JSON in a GLB")
    content = parse_json(data[20 : 20 + length].decode())
    binary = b""
    if len(data) >= 28 + length:
        size, kind = struct.unpack_from("<II", data, 20 + length)
        binary = data[28 + length : 28 + length + size]
        if kind != BINARY_CHUNK or len(data) - (28 + length + size) not in range(8):
            raise Refused("a GLB file with other chunks than JSON and one of numbers")
    if any("uri" in buffer for buffer in content.get("buffers", [])):
        raise Refused("numbers in another file: expected a GLB file that holds all of its own")
    accessors = content.get("accessors", [])
    check_unpacked(len(data), sum(count_of(accessor) * _width(accessor) for accessor in accessors))
    return content, binary


def view_of(view: dict[str, Any], binary: bytes) -> bytes:
    """The bytes that a view of the buffer names. Raises: Refused."""
    start, size, step = view.get("byteOffset", 0), view["byteLength"], view.get("byteStride", 1)
    if not all(type(n) is int and n >= 0 for n in (start, size)) or start + size > len(binary):
        raise Refused(f"{size} bytes from {start}, but there are {len(binary)}")
    if view["buffer"] != 0 or type(step) is not int or step < 1:
        raise Refused("a view of numbers that are not in this file, or without a step")
    return binary[start : start + size]


def count_of(accessor: dict[str, Any]) -> int:
    """How many elements an accessor says that it has. Raises: Refused."""
    count, start = accessor["count"], accessor.get("byteOffset", 0)
    if not all(type(n) is int and n >= 0 for n in (count, start)):
        raise Refused(f"{shown(count)} numbers from {shown(start)}")
    return count


def read_accessor(content: dict[str, Any], binary: bytes, index: int) -> np.ndarray:
    """The array (count, columns) of an accessor; integers that stand for numbers up to 1 are converted.

    Raises: Refused, KeyError, TypeError, ... for what does not fit the file.
    """
    accessor = content["accessors"][_index(index)]
    if "sparse" in accessor or "bufferView" not in accessor:
        raise Refused("numbers that are mostly zeros (sparse): expected all of them")
    view = content["bufferViews"][_index(accessor["bufferView"])]
    data, columns = view_of(view, binary), COLUMNS[accessor["type"]]
    dtype = np.dtype(COMPONENTS[accessor["componentType"]])
    count, start, width = count_of(accessor), accessor.get("byteOffset", 0), _width(accessor)
    step = view.get("byteStride", width)
    if step < width or (count and start + (count - 1) * step + width > len(data)):
        raise Refused(f"{count} elements of {width} bytes from {start}, but there are {len(data)} bytes")
    array = np.ndarray((count, columns), dtype, data, start, (step, dtype.itemsize)).astype(np.float64)
    if accessor.get("normalized") and dtype.kind != "f":
        array = np.maximum(array / np.iinfo(dtype.str).max, -1.0)
    return array


def _index(value):
    """An index as JSON should have it: Python would count negative ones from the end."""
    if type(value) is not int or value < 0:
        raise Refused(f"{shown(value)} is no index")
    return value


def _width(accessor):
    return COLUMNS[accessor["type"]] * np.dtype(COMPONENTS[accessor["componentType"]]).itemsize


# Writing ----------------------------------------------------------------------------------------------------------------


class GlbWriter:
    """Arrays and other bytes, gathered into one block as they are added."""

    def __init__(self) -> None:
        self.data, self.views, self.accessors = bytearray(), [], []

    def bytes_(self, data: bytes, target: int | None = None) -> int:
        """Index of the view of some bytes, which start at a multiple of 4."""
        self.data += bytes(-len(self.data) % 4)
        view = {"buffer": 0, "byteOffset": len(self.data), "byteLength": len(data)}
        self.views.append(view if target is None else view | {"target": target})
        self.data += data
        return len(self.views) - 1

    def array(self, kind: str, values: np.ndarray, target: int | None = None, bounds: bool = False) -> int:
        """Index of the accessor of an array: float32 unless it has unsigned integers.

        Arguments: kind: as in COLUMNS. bounds: also tell the least and the largest of each column, as positions and times must.
        """
        values = np.ascontiguousarray(values, values.dtype if values.dtype.kind == "u" else "<f4")
        component = next(code for code, name in COMPONENTS.items() if np.dtype(name) == values.dtype)
        accessor = {
            "bufferView": self.bytes_(values.tobytes(), target),
            "componentType": component,
            "count": len(values),
            "type": kind,
        }
        if bounds:
            columns = values.reshape(len(values), -1)
            accessor |= {"min": columns.min(0).tolist(), "max": columns.max(0).tolist()}
        self.accessors.append(accessor)
        return len(self.accessors) - 1

    def write(self, path: str | os.PathLike, document: dict[str, Any]) -> None:
        """Write the file with a glTF document to which arrays, buffer and `asset` are added. It appears whole or not at all."""
        self.data += bytes(-len(self.data) % 4)
        document = {"asset": {"version": "2.0", "generator": "humangs_jax"}} | document
        document |= {
            "accessors": self.accessors,
            "bufferViews": self.views,
            "buffers": [{"byteLength": len(self.data)}],
        }
        text = json.dumps(document, separators=(",", ":"), allow_nan=False).encode()  # JSON has no NaN
        text += b" " * (-len(text) % 4)
        chunks = struct.pack("<II", len(text), JSON_CHUNK) + text
        chunks += struct.pack("<II", len(self.data), BINARY_CHUNK) + bytes(self.data)
        write_bytes(path, struct.pack("<III", GLB_START, 2, 12 + len(chunks)) + chunks)
