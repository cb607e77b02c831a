"""Triangle meshes of other programs through trimesh: OBJ, PLY, GLB, STL and OFF. What it would trust is checked before.

A file's textures are read if they are asked for, lie in its folder or in the file itself, and are PNG or JPEG; a texture that
cannot be read is left out, with a warning.
"""

import io
import logging
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from humangs_jax.io.glb import count_of, parse_glb, view_of
from humangs_jax.io.images import image_in
from humangs_jax.io.reading import FileError, Refused, check_limit, inside, read_bytes, reading, shown

logger = logging.getLogger(__name__)

TYPES = ("obj", "ply", "glb", "stl", "off")
"""Suffixes of the formats; trimesh has more, of which some start programs or read XML."""


def read_meshes(path: str | Path, *, textures: bool = False, colors: bool = False) -> list[Any]:
    """The triangle meshes of a file in its common coordinates, as trimesh.Trimesh; empty if it has none.

    Arguments: textures: with materials and textures. colors: with colors of the vertices instead, painted or from a texture;
    grey where they are not known. Materials and textures that the file names but that cannot be read are left out, which is
    logged.
    Raises: FileNotFoundError; FileError if it is damaged, of another format, or asks for more than the limits allow.
    """
    import trimesh

    path = Path(path)
    with reading(path, "mesh"):
        kind = path.suffix.lower().removeprefix(".")
        if kind not in TYPES:
            raise Refused(f"not a mesh that can be read: expected {', '.join(TYPES)}, got {path.suffix or 'no suffix'}")
        data, painted = read_bytes(path, "mesh_bytes"), textures or colors
        stream: Any = io.BytesIO(data)
        if kind == "glb":
            _check_glb(data, painted)
        elif kind == "stl":
            check_limit("parts", data.lower().count(b"endsolid"), "solids")
        elif kind == "obj":  # text of other encodings would be guessed at for a long time
            stream = io.StringIO(_grouped(data.decode("utf-8", "replace"), painted))
        materials: dict[str, Any] = {} if kind in ("stl", "off") else {"skip_materials": not painted}
        resolver = _folder_of(path) if painted else None
        # processing would silently drop what is not finite
        scene = trimesh.load_scene(stream, file_type=kind, resolver=resolver, process=False, **materials)
        if resolver is not None:
            resolver.report(path)
        drawn = [scene.geometry[scene.graph[node][1]] for node in scene.graph.nodes_geometry]
        check_limit("corners", sum(3 * len(getattr(part, "faces", ())) for part in drawn), "corners of triangles")
        images = [image for part in drawn if (image := _texture(part)) is not None]
        check_limit("capture_pixels", sum(image.width * image.height for image in images), "pixels of textures")
        if colors:
            for part in {id(part): part for part in drawn if isinstance(part, trimesh.Trimesh)}.values():
                _paint(part)
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


CHEAPER = 50
"""To look at a vertex, than a corner of a triangle."""
_MATERIAL = re.compile(r"^usemtl\b(.*)$", re.MULTILINE)
_FACES = re.compile(r"^f[ \t].*\n?", re.MULTILINE)
_GROUPS = re.compile(r"^(?:usemtl|o|g|s)\b.*\n?", re.MULTILINE)


def _grouped(text, materials):
    """An OBJ file with the faces of each material together, at its end. Without materials, and for objects and groups, all faces
    are one: trimesh takes longer than linear for each change, even for one that it finds in a comment.
    """
    text = text.replace("\r\n", "\n").replace("\\\n", "")
    begin, *changes = _MATERIAL.split(text) if materials else (_GROUPS.sub("", text),)
    of_material: dict[str, list[str]] = {}
    for name, chunk in zip(changes[::2], changes[1::2], strict=True):
        of_material.setdefault(name.strip(), []).extend(_FACES.findall(chunk))
    check_limit("parts", len(of_material), "materials")
    looks = len(of_material) * text.count("\nv ") // CHEAPER  # trimesh looks at all vertices for each
    check_limit("corners", looks, f"times {CHEAPER} vertices of {len(of_material)} materials")
    others = _GROUPS.sub("", "\n".join([begin, *(_FACES.sub("", chunk) for chunk in changes[1::2])]))
    plain = lambda lines: lines.replace("usemtl", "-")
    faces = [f"usemtl {plain(name)}\n{plain(''.join(lines))}" for name, lines in of_material.items() if lines]
    return "\n".join([plain(others), *faces])


def _folder_of(path):
    """What trimesh asks for the files that a mesh names: materials and textures beside it."""
    from trimesh.resolvers import Resolver

    class Folder(Resolver):
        def __init__(self, folder: Path) -> None:
            self.folder, self.read, self.faults = folder, {}, {}

        def get(self, key: str) -> bytes:
            if key not in self.read and key not in self.faults:
                try:
                    check_limit("parts", len(self.read) + len(self.faults), "materials and textures")
                    self.read[key] = self._content(key.strip())
                except (ValueError, OSError) as error:
                    self.faults[key] = str(error)
            if key in self.faults:
                raise FileNotFoundError(self.faults[key])  # trimesh goes on without it
            return self.read[key]

        def _content(self, key: str) -> bytes:
            if not key:
                raise Refused("has no name")
            file = inside(self.folder, key)
            with reading(file, "texture"):
                if file.suffix.lower() == ".mtl":
                    return read_bytes(file, "slow_text_bytes")
                data = read_bytes(file, "image_bytes")
                check_limit("mesh_bytes", sum(map(len, self.read.values())) + len(data), "bytes of textures")
                with image_in(data) as image:
                    image.load()
                return data

        def report(self, path: Path) -> None:
            """Warn of the first file that could not be read, and say how many there are."""
            if self.faults:
                key, why = next(iter(self.faults.items()))
                more = f" (and {len(self.faults) - 1} others)" if len(self.faults) > 1 else ""
                logger.warning("%s: %s", path, FileError("", f"left out {shown(key)}{more}", why))

        def keys(self) -> Iterator[str]:
            return iter(())

        def namespaced(self, namespace: str) -> Any:
            raise Refused("folders in folders are not looked up")

        def write(self, name: str, data: Any) -> None:
            raise Refused("nothing is written")

    return Folder(path.parent)


GREY = 153
"""Of 255: vertices whose color is not known."""


def _paint(mesh):
    """Give a mesh colors of its vertices in place of a texture."""
    from trimesh.visual import ColorVisuals

    count, visual = len(mesh.vertices), mesh.visual
    colors = visual.material.to_color(visual.uv) if visual.kind == "texture" else visual.vertex_colors
    if colors is None or np.shape(colors) not in ((count, 4), (count, 3), (4,)):
        colors = [GREY, GREY, GREY, 255]
    mesh.visual = ColorVisuals(mesh, vertex_colors=np.broadcast_to(colors, (count, np.shape(colors)[-1])))


def _texture(mesh):
    """As a PIL.Image that may not be decoded yet, None if it has none."""
    material = getattr(mesh.visual, "material", None)
    image = getattr(material, "baseColorTexture", None)
    return getattr(material, "image", None) if image is None else image


def _check_glb(data: bytes, textures: bool) -> None:
    """Raises: Refused, KeyError, TypeError, ... for sizes and places that do not fit the file."""
    content, binary = parse_glb(data)
    views = [view_of(view, binary) for view in content.get("bufferViews", [])]
    counts = [count_of(accessor) for accessor in content.get("accessors", [])]
    of_mesh = [sum(_corners(part, counts) for part in mesh["primitives"]) for mesh in content.get("meshes", [])]
    drawn = [node["mesh"] for node in content.get("nodes", []) if "mesh" in node]
    check_limit("corners", max(sum(of_mesh), sum(of_mesh[mesh] for mesh in drawn)), "corners of triangles")
    parts = [len(mesh["primitives"]) for mesh in content.get("meshes", [])]
    check_limit("parts", max(sum(parts), sum(parts[mesh] for mesh in drawn)), "parts of meshes")
    if textures:
        for image in content.get("images", []):
            if "bufferView" in image:
                with image_in(views[image["bufferView"]]):
                    pass
            elif str(image.get("uri", "")).startswith("data:"):
                raise Refused("a texture within the text: expected it as a part of the numbers")


def _corners(part, counts):
    """Corners of a part of a mesh."""
    indices = 3 * counts[part["indices"]] if "indices" in part else 0
    return indices + counts[part["attributes"]["POSITION"]]
