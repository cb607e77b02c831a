"""Triangle meshes of other programs through trimesh: OBJ, PLY, GLB, STL and OFF. What it would trust is checked before.

A file's textures are read if they are asked for, lie in its folder or in the file itself, and are PNG or JPEG; a texture that is
not there is left out, as trimesh does.
"""

import io
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from humangs_jax.io.images import image_in
from humangs_jax.io.reading import Refused, check_limit, check_unpacked, inside, read_bytes, reading
from humangs_jax.io.text import parse_json

TYPES = ("obj", "ply", "glb", "stl", "off")
"""Suffixes of the formats; trimesh has more, of which some start programs or read XML."""
GLB_START, JSON_CHUNK, BINARY_CHUNK = 0x46546C67, 0x4E4F534A, 0x004E4942
COLUMNS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}
COMPONENT_BYTES = {5120: 1, 5121: 1, 5122: 2, 5123: 2, 5125: 4, 5126: 4}
"""https://registry.khronos.org/glTF/specs/2.0/glTF-2.0.html#accessor-data-types"""


def read_meshes(path: str | Path, textures: bool = False) -> list[Any]:
    """The triangle meshes of a file in its common coordinates, as trimesh.Trimesh; empty if it has none.

    Raises: FileNotFoundError; FileError if it is damaged, of another format, or asks for more than the limits allow.
    """
    import trimesh

    path = Path(path)
    with reading(path, "mesh"):
        kind = path.suffix.lower().removeprefix(".")
        if kind not in TYPES:
            raise Refused(f"not a mesh that can be read: expected {', '.join(TYPES)}, got {path.suffix or 'no suffix'}")
        data = read_bytes(path, "mesh_bytes")
        if kind == "glb":
            _check_glb(data, textures)
        # text of other encodings would be guessed at for a long time
        stream = io.StringIO(data.decode("utf-8", "replace")) if kind == "obj" else io.BytesIO(data)
        materials: dict[str, Any] = {} if kind in ("stl", "off") else {"skip_materials": not textures}
        resolver = _folder_of(path) if textures else None
        # processing would silently drop what is not finite
        scene = trimesh.load_scene(stream, file_type=kind, resolver=resolver, process=False, **materials)
        shown = [scene.geometry[scene.graph[node][1]] for node in scene.graph.nodes_geometry]
        check_limit("corners", sum(3 * len(getattr(part, "faces", ())) for part in shown), "corners of triangles")
        parts = [part for part in scene.dump() if isinstance(part, trimesh.Trimesh) and len(part.faces)]
        for part in parts:
            low, high = int(part.faces.min()), int(part.faces.max())
            if low < 0 or high >= len(part.vertices):
                raise Refused(f"a face has the corner {low if low < 0 else high}, but there are {len(part.vertices)}")
        return parts


def _folder_of(path):
    """What trimesh asks for the files that a mesh names: materials and textures beside it."""
    from trimesh.resolvers import Resolver

    class Folder(Resolver):
        def __init__(self, folder: Path) -> None:
            self.folder = folder

        def get(self, key: str) -> bytes:
            file = inside(self.folder, key.strip())
            if file.suffix.lower() == ".mtl":
                return read_bytes(file, "slow_text_bytes")
            data = read_bytes(file, "image_bytes")
            with image_in(data):
                return data

        def keys(self) -> Iterator[str]:
            return iter(())

        def namespaced(self, namespace: str) -> Any:
            raise Refused("folders in folders are not looked up")

        def write(self, name: str, data: Any) -> None:
            raise Refused("nothing is written")

    return Folder(path.parent)


# GLB ------------------------------------------------------------------------------------------------------------------


def _check_glb(data: bytes, textures: bool) -> None:
    """Raises: Refused, KeyError, TypeError, ... for sizes and places that do not fit the file.

    https://registry.khronos.org/glTF/specs/2.0/glTF-2.0.html#glb-file-format-specification
    """
    start, _, _, length, kind = struct.unpack_from("<IIIII", data.ljust(20, b"\0"))
    if start != GLB_START or kind != JSON_CHUNK:
        raise Refused("not a mesh that can be read: no GLB file")
    check_limit("slow_text_bytes", length, "bytes of JSON in a GLB")
    content = parse_json(data[20 : 20 + length].decode())
    binary = b""
    if len(data) >= 28 + length:
        size, kind = struct.unpack_from("<II", data, 20 + length)
        binary = data[28 + length : 28 + length + size]
        if kind != BINARY_CHUNK or len(data) - (28 + length + size) not in range(8):
            raise Refused("a GLB file with other chunks than JSON and one of numbers")
    if any("uri" in buffer for buffer in content.get("buffers", [])):
        raise Refused("numbers in another file: expected a GLB file that holds all of its own")
    views = [_view(view, binary) for view in content.get("bufferViews", [])]
    accessors = content.get("accessors", [])
    counts = [_count(accessor) for accessor in accessors]
    sizes = [COLUMNS[accessor["type"]] * COMPONENT_BYTES[accessor["componentType"]] for accessor in accessors]
    check_unpacked(len(data), sum(count * size for count, size in zip(counts, sizes, strict=True)))
    of_mesh = [sum(_corners(part, counts) for part in mesh["primitives"]) for mesh in content.get("meshes", [])]
    shown = [of_mesh[node["mesh"]] for node in content.get("nodes", []) if "mesh" in node]
    check_limit("corners", max(sum(of_mesh), sum(shown)), "corners of triangles")
    if textures:
        for image in content.get("images", []):
            if "bufferView" in image:
                with image_in(views[image["bufferView"]]):
                    pass
            elif str(image.get("uri", "")).startswith("data:"):
                raise Refused("a texture within the text: expected it as a part of the numbers")


def _view(view, binary):
    start, size, step = view.get("byteOffset", 0), view["byteLength"], view.get("byteStride", 1)
    if not all(type(n) is int and n >= 0 for n in (start, size)) or start + size > len(binary):
        raise Refused(f"{size} bytes from {start}, but there are {len(binary)}")
    if view["buffer"] != 0 or type(step) is not int or step < 1:
        raise Refused("a view of numbers that are not in this file, or without a step")
    return binary[start : start + size]


def _corners(part, counts):
    """Corners of a part of a mesh, at least 1,000: that is what any part costs."""
    indices = 3 * counts[part["indices"]] if "indices" in part else 0
    return max(1000, indices + counts[part["attributes"]["POSITION"]])


def _count(accessor):
    count, start = accessor["count"], accessor.get("byteOffset", 0)
    if not all(type(n) is int and n >= 0 for n in (count, start)):
        raise Refused(f"{count!r} numbers from {start!r}")
    return count
