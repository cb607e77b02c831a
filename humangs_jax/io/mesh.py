"""Triangle meshes of other programs through trimesh: OBJ, PLY, GLB, STL and OFF. What it would trust is checked before.

A file's textures are read if they are asked for, lie in its folder or in the file itself, and are PNG or JPEG; a texture that is
not there is left out, as trimesh does.
"""

import io
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from humangs_jax.io.glb import count_of, parse_glb, view_of
from humangs_jax.io.images import image_in
from humangs_jax.io.reading import Refused, check_limit, inside, read_bytes, reading

TYPES = ("obj", "ply", "glb", "stl", "off")
"""Suffixes of the formats; trimesh has more, of which some start programs or read XML."""


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
            if part.vertices.shape[1:] != (3,) or part.faces.shape[1:] != (3,):
                raise Refused(
                    f"vertices {part.vertices.shape}, faces {part.faces.shape}: expected three numbers for each"
                )
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


def _check_glb(data: bytes, textures: bool) -> None:
    """Raises: Refused, KeyError, TypeError, ... for sizes and places that do not fit the file."""
    content, binary = parse_glb(data)
    views = [view_of(view, binary) for view in content.get("bufferViews", [])]
    counts = [count_of(accessor) for accessor in content.get("accessors", [])]
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


def _corners(part, counts):
    """Corners of a part of a mesh, at least 1,000: that is what any part costs."""
    indices = 3 * counts[part["indices"]] if "indices" in part else 0
    return max(1000, indices + counts[part["attributes"]["POSITION"]])
