"""Reads and writes GLB files, the binary form of glTF 2.0, within limits, and reads textured OBJ
files of scans by trimesh.

GLB is JSON that describes arrays, and one block of their bytes
(https://registry.khronos.org/glTF/specs/2.0/glTF-2.0.html#glb-file-format-specification). Files
that an OBJ file names are checked before trimesh gets them. Textures are read if they lie in the
folder of the OBJ file and are PNG or JPEG. A texture that cannot be read is left out, with a
warning.
"""

import io
import json
import logging
import os
import re
import struct
from pathlib import Path
from typing import Any

import numpy as np

from humangs_jax.io.atomic import write_bytes
from humangs_jax.io.images import image_in
from humangs_jax.io.reading import (
    FileError,
    InvalidFileError,
    check_limit,
    check_unpacked,
    inside,
    parse_json,
    read_bytes,
    reading,
    shown,
)

logger = logging.getLogger(__name__)

GLB_START = 0x46546C67
"""First word of a GLB file, "glTF"."""
JSON_CHUNK = 0x4E4F534A
"""Kind of the chunk with the JSON text."""
BINARY_CHUNK = 0x004E4942
"""Kind of the chunk with the numbers."""
COLUMNS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}
COMPONENTS = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
"""Type of the numbers for each component type of an accessor
(https://registry.khronos.org/glTF/specs/2.0/glTF-2.0.html#accessor-data-types).
"""
VERTICES = 34962
"""Target of a buffer view that a graphics card reads as vertices."""
INDICES = 34963
"""Target of a buffer view that a graphics card reads as indices."""


def parse_glb(data: bytes, limit: str = "slow_text_bytes") -> tuple[dict[str, Any], bytes]:
    """Returns the JSON of a GLB file, and the block of bytes that the JSON describes.

    Arguments: limit: name of the limit on the JSON's size. The default suits files whose JSON is
    short.
    Raises: InvalidFileError, KeyError, TypeError, ... for a file that is no GLB, is damaged, is
    larger than the limits allow, or leaves numbers in another file.
    """
    # the header, and the chunk of JSON
    start, _, _, length, kind = struct.unpack_from("<IIIII", data.ljust(20, b"\0"))
    if start != GLB_START or kind != JSON_CHUNK:
        raise InvalidFileError("not a mesh or skeleton that can be read: no GLB file")
    check_limit(limit, length, "bytes of JSON in a GLB")
    if 20 + length > len(data):
        raise InvalidFileError("a GLB file that is cut short")
    try:
        text = data[20 : 20 + length].decode()
    except UnicodeDecodeError:
        raise InvalidFileError("a GLB file with damaged JSON") from None
    content = parse_json(text)

    # the chunk of numbers, which may be missing; up to seven bytes of padding may follow
    binary = b""
    if len(data) >= 28 + length:
        size, kind = struct.unpack_from("<II", data, 20 + length)
        if 28 + length + size > len(data):
            raise InvalidFileError("a GLB file that is cut short")
        binary = data[28 + length : 28 + length + size]
        if kind != BINARY_CHUNK or len(data) - (28 + length + size) not in range(8):
            raise InvalidFileError("a GLB file with other chunks than JSON and one of numbers")

    # all numbers must be in this file, and not grow beyond the limits when they are unpacked
    if any("uri" in buffer for buffer in content.get("buffers", [])):
        raise InvalidFileError(
            "numbers in another file: expected a GLB file that holds all of its numbers"
        )
    accessors = content.get("accessors", [])
    check_unpacked(len(data), sum(count_of(accessor) * _width(accessor) for accessor in accessors))
    return content, binary


def _view_of(view: dict[str, Any], binary: bytes) -> bytes:
    """Returns the bytes of a buffer view. Raises: InvalidFileError, KeyError."""
    compressed = [name for name in view.get("extensions", {}) if name.endswith("_compression")]
    if compressed:
        raise InvalidFileError(f"compressed ({compressed[0]}): export the file without compression")
    start, size, step = view.get("byteOffset", 0), view["byteLength"], view.get("byteStride", 1)
    if not all(type(n) is int and n >= 0 for n in (start, size)) or start + size > len(binary):
        raise InvalidFileError(f"{size} bytes from {start}, but there are {len(binary)}")
    if view["buffer"] != 0 or type(step) is not int or step < 1:
        raise InvalidFileError("a view of numbers that are not in this file, or without a step")
    return binary[start : start + size]


def count_of(accessor: dict[str, Any]) -> int:
    """Returns the number of elements of an accessor. Raises: InvalidFileError, KeyError."""
    count, start = accessor["count"], accessor.get("byteOffset", 0)
    if not all(type(n) is int and n >= 0 for n in (count, start)):
        raise InvalidFileError(f"{shown(count)} numbers from {shown(start)}")
    return count


def read_accessor(content: dict[str, Any], binary: bytes, index: int) -> np.ndarray:
    """Returns the array of an accessor, (count, columns), float64. Normalized integers become
    numbers in [-1, 1].

    Raises: InvalidFileError, KeyError, TypeError, ... for anything that does not fit the file.
    """
    accessor = content["accessors"][_index(index)]
    if "sparse" in accessor or "bufferView" not in accessor:
        raise InvalidFileError("numbers that are mostly zeros (sparse): expected all of them")
    view = content["bufferViews"][_index(accessor["bufferView"])]
    data, columns = _view_of(view, binary), COLUMNS[accessor["type"]]
    dtype = np.dtype(COMPONENTS[accessor["componentType"]])
    count, start, width = count_of(accessor), accessor.get("byteOffset", 0), _width(accessor)
    step = view.get("byteStride", width)
    if step < width or (count and start + (count - 1) * step + width > len(data)):
        raise InvalidFileError(
            f"{count} elements of {width} bytes from {start}, but there are {len(data)} bytes"
        )
    array = np.ndarray((count, columns), dtype, data, start, (step, dtype.itemsize)).astype(
        np.float64
    )
    if accessor.get("normalized") and dtype.kind != "f":
        array = np.maximum(array / np.iinfo(dtype.str).max, -1.0)
    return array


def _index(value: Any) -> int:
    """Returns an index of JSON, after a check that it is not negative: Python would count it from
    the end.

    Raises: InvalidFileError.
    """
    if type(value) is not int or value < 0:
        raise InvalidFileError(f"{shown(value)} is no index")
    return value


def _width(accessor: dict[str, Any]) -> int:
    """Returns the number of bytes of an accessor's element."""
    return COLUMNS[accessor["type"]] * np.dtype(COMPONENTS[accessor["componentType"]]).itemsize


# Writing
# --------------------------------------------------------------------------------------------------


class GlbWriter:
    """Writes a GLB file. Arrays and other bytes are added one by one to its block of bytes."""

    def __init__(self) -> None:
        self.data, self.views, self.accessors = bytearray(), [], []

    def bytes_(self, data: bytes, target: int | None = None) -> int:
        """Adds bytes at a multiple of 4, and returns the index of their buffer view. target:
        VERTICES, INDICES or None.
        """
        self.data += bytes(-len(self.data) % 4)
        view = {"buffer": 0, "byteOffset": len(self.data), "byteLength": len(data)}
        if target is not None:
            view["target"] = target
        self.views.append(view)
        self.data += data
        return len(self.views) - 1

    def array(
        self, kind: str, values: np.ndarray, target: int | None = None, bounds: bool = False
    ) -> int:
        """Adds an array, as float32 unless it has unsigned integers, and returns the index of its
        accessor.

        Arguments: kind: a key of COLUMNS. target: as in `bytes_`. bounds: whether to record the
        smallest and the largest number of each column. glTF asks for them for positions and times.
        """
        dtype = values.dtype if values.dtype.kind == "u" else "<f4"
        values = np.ascontiguousarray(values, dtype)
        component = next(
            code for code, name in COMPONENTS.items() if np.dtype(name) == values.dtype
        )
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

    def sparse(self, values: np.ndarray) -> int:
        """Adds an array (n, 3), of which most rows are 0, as float32. Returns the index of its
        accessor. Only rows that are not 0 are in the file.
        """
        rows = np.flatnonzero(values.any(axis=1))
        accessor = {
            "componentType": 5126,
            "count": len(values),
            "type": "VEC3",
            "min": values.min(axis=0).tolist(),
            "max": values.max(axis=0).tolist(),
        }
        if len(rows):
            indices = self.bytes_(rows.astype("<u4").tobytes())
            accessor["sparse"] = {
                "count": len(rows),
                "indices": {"bufferView": indices, "componentType": 5125},
                "values": {"bufferView": self.bytes_(values[rows].astype("<f4").tobytes())},
            }
        self.accessors.append(accessor)
        return len(self.accessors) - 1

    def write(self, path: str | os.PathLike[str], document: dict[str, Any]) -> None:
        """Writes the file from the glTF document and all arrays that were added. If writing fails,
        the path stays as it was.

        document: glTF's JSON without the arrays; `asset` is added if it is missing. Raises:
        ValueError if a number in the JSON is not finite; OSError.
        """
        self.data += bytes(-len(self.data) % 4)
        document = {"asset": {"version": "2.0", "generator": "humangs_jax"}} | document
        document |= {
            "accessors": self.accessors,
            "bufferViews": self.views,
            "buffers": [{"byteLength": len(self.data)}],
        }
        # JSON has no NaN
        text = json.dumps(document, separators=(",", ":"), allow_nan=False).encode()
        text += b" " * (-len(text) % 4)
        chunks = struct.pack("<II", len(text), JSON_CHUNK) + text
        chunks += struct.pack("<II", len(self.data), BINARY_CHUNK) + bytes(self.data)
        write_bytes(path, struct.pack("<III", GLB_START, 2, 12 + len(chunks)) + chunks)


def read_obj(path: str | Path) -> list[Any]:
    """Returns the triangle meshes of an OBJ file as trimesh.Trimesh, with materials and textures.
    There is at least one mesh.

    Materials and textures that cannot be read are left out, and a warning is logged.
    Raises: FileNotFoundError; FileError if the file has no triangles, is damaged, or asks for more
    than the limits allow.
    """
    import trimesh

    path = Path(path)
    with reading(path, "mesh"):
        if path.suffix.lower() != ".obj":
            raise InvalidFileError(
                f"not a mesh that can be read: expected .obj, got {path.suffix!r}"
            )
        data, resolver = read_bytes(path, "mesh_bytes"), _Folder(path.parent)
        # text of other encodings would be guessed at for a long time
        stream = io.StringIO(_grouped(data.decode("utf-8", "replace")))
        # processing would silently drop what is not finite
        scene = trimesh.load_scene(
            stream,
            file_type="obj",
            resolver=resolver,  # ty: ignore[invalid-argument-type]
            process=False,
            skip_materials=False,
        )
        resolver.report(path)
        drawn = [scene.geometry[scene.graph[node][1]] for node in scene.graph.nodes_geometry]
        corners = sum(3 * len(getattr(part, "faces", ())) for part in drawn)
        check_limit("corners", corners, "corners of triangles")
        materials = [getattr(part.visual, "material", None) for part in drawn]
        images = [getattr(each, "image", None) for each in materials]
        texels = sum(image.width * image.height for image in images if image)
        check_limit("capture_pixels", texels, "pixels of textures")
        parts = [
            part for part in scene.dump() if isinstance(part, trimesh.Trimesh) and len(part.faces)
        ]
        if not parts:
            raise InvalidFileError("no triangles: expected the surface of a scan")
        for part in parts:
            if part.vertices.shape[1:] != (3,) or part.faces.shape[1:] != (3,):
                raise InvalidFileError(
                    f"vertices {part.vertices.shape}, faces {part.faces.shape}: expected three"
                    " numbers for each"
                )
            low, high = int(part.faces.min()), int(part.faces.max())
            if low < 0 or high >= len(part.vertices):
                wrong = low if low < 0 else high
                raise InvalidFileError(
                    f"a face has the corner {wrong}, but there are {len(part.vertices)}"
                )
        return parts


def _grouped(text: str) -> str:
    """Returns the text of an OBJ file with the faces of each material together, at its end. Lines
    that begin objects, groups and smoothing groups are removed.

    trimesh's time grows faster than linearly with the number of changes of material, object and
    group. It even counts changes in comments.
    Raises: InvalidFileError beyond a limit.
    """
    text = text.replace("\r\n", "\n").replace("\\\n", "")
    faces = re.compile(r"^f[ \t].*\n?", re.MULTILINE)
    begin, *changes = re.split(r"^usemtl\b(.*)$", text, flags=re.MULTILINE)
    of_material: dict[str, list[str]] = {}
    for name, chunk in zip(changes[::2], changes[1::2], strict=True):
        of_material.setdefault(name.strip(), []).extend(faces.findall(chunk))
    check_limit("parts", len(of_material), "materials")
    # trimesh looks at all vertices for each material; a look is cheaper than a corner of a triangle
    cheaper = 50
    looks = len(of_material) * text.count("\nv ") // cheaper
    check_limit("corners", looks, f"times {cheaper} vertices of {len(of_material)} materials")
    # all other lines, without those of objects and groups
    others = "\n".join([begin, *(faces.sub("", chunk) for chunk in changes[1::2])])
    others = re.sub(r"^(?:o|g|s)\b.*\n?", "", others, flags=re.MULTILINE)

    def plain(lines):
        return lines.replace("usemtl", "-")

    drawn = [
        f"usemtl {plain(name)}\n{plain(''.join(lines))}"
        for name, lines in of_material.items()
        if lines
    ]
    return "\n".join([plain(others), *drawn])


class _Folder:
    """A resolver that gives trimesh the files that a mesh names: materials and textures in its
    folder.

    A file that is refused is reported as missing, and trimesh continues without it.
    """

    def __init__(self, folder: Path) -> None:
        self.folder, self.read, self.faults = folder, {}, {}

    def get(self, key: str) -> bytes:
        if key not in self.read and key not in self.faults:
            try:
                check_limit("parts", len(self.read) + len(self.faults), "materials and textures")
                names = _names_in(key.strip())
                found = [name for name in names if (self.folder / name).exists()]
                self.read[key] = self._content([*found, names[0]][0])
            except (ValueError, OSError) as error:
                self.faults[key] = str(error)
        if key in self.faults:
            raise FileNotFoundError(self.faults[key])
        return self.read[key]

    __getitem__ = get

    def _content(self, key: str) -> bytes:
        if not key:
            raise InvalidFileError("has no name")
        file = inside(self.folder, key)
        with reading(file, "texture"):
            if file.suffix.lower() == ".mtl":
                return read_bytes(file, "slow_text_bytes")
            data = read_bytes(file, "image_bytes")
            check_limit(
                "mesh_bytes", sum(map(len, self.read.values())) + len(data), "bytes of textures"
            )
            with image_in(data) as image:
                image.load()
            return data

    def report(self, path: Path) -> None:
        """Logs a warning about the first file that could not be read, with the number of others."""
        if self.faults:
            key, why = next(iter(self.faults.items()))
            more = ""
            if len(self.faults) > 1:
                more = f" (and {len(self.faults) - 1} others)"
            logger.warning("%s: %s", path, FileError("", f"left out {shown(key)}{more}", why))


def _names_in(text: str) -> list[str]:
    """Returns the file names that the name of a material or texture may stand for, the likeliest
    first.

    The first is the name unchanged, with its spaces. The second is the name without the options of
    textures and without quotes. In the third, slashes replace the backslashes of Windows. The last
    is the first of several .mtl files in one line.
    """
    # before the name of a texture stand options, as `-s 1 1 1` or `-clamp on`
    options = r"^(?:-\w+(?:\s+(?:on|off|[lrgbmz]|[-+.\deE]+))+\s+)+"
    plain = re.sub(options, "", text).strip().strip("\"'").replace("\\ ", " ")
    first = re.match(r"\S+\.mtl\b", plain, re.IGNORECASE)
    names = [text, plain, plain.replace("\\", "/")]
    if first:
        names.append(first[0])
    return list(dict.fromkeys(names))
