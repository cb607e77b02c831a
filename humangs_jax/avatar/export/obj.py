"""The body of an avatar as Wavefront `.obj`, with `.mtl` and a texture in `.png` beside it.

https://www.loc.gov/preservation/digital/formats/fdd/fdd000507.shtml
"""

from pathlib import Path

import numpy as np

from humangs_jax.avatar.export.mesh import BodyMesh
from humangs_jax.avatar.export.world import Up, up_matrix
from humangs_jax.io.atomic import write_text
from humangs_jax.io.images import write_png


def write_material(path: Path, mesh: BodyMesh) -> Path:
    """Write the `.mtl` and the `.png` that an `.obj` of this path names; several poses share them. Returns the `.mtl`'s path."""
    texture, material = path.with_suffix(".png"), path.with_suffix(".mtl")
    write_png(texture, mesh.texture.astype(np.float32) / 255)
    write_text(material, f"newmtl skin\nKa 0 0 0\nKd 1 1 1\nKs 0 0 0\nillum 1\nmap_Kd {texture.name}\n")
    return material


def write_obj(path: Path, mesh: BodyMesh, material: Path | None = None, up: Up = "y") -> None:
    """Write a mesh; the file appears whole or not at all.

    Arguments: material: what `write_material` wrote beside it; None writes it. up: the axis that points up in the file.
    """
    material = write_material(path, mesh) if material is None else material
    turn = up_matrix(up)
    rows = lambda key, values: [f"{key} " + " ".join(f"{x:.6g}" for x in row) for row in values.tolist()]
    corners = [" ".join(f"{i}/{i}/{i}" for i in face) for face in (mesh.faces + 1).tolist()]
    lines = [
        f"# written by humangs_jax: metres, {up} up",
        f"mtllib {material.name}",
        "o body",
        *rows("v", mesh.vertices @ turn.T),
        *rows("vt", mesh.uvs),
        *rows("vn", mesh.normals @ turn.T),
        "usemtl skin",
        *(f"f {corner}" for corner in corners),
    ]
    write_text(path, "\n".join(lines) + "\n")
