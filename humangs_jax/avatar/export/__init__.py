"""An avatar in the files that other people's programs open (docs/export.md): the table of their formats.

`files.export` writes a file, `gaussians` and `mesh` hold what each format is made of.
"""

import dataclasses
from typing import Literal

from humangs_jax.core.registry import Format, Formats

Up = Literal["y", "-y", "z"]
"""The axis that points up in a file."""
HERE = "humangs_jax.avatar.export"


@dataclasses.dataclass(frozen=True)
class ExportFormat(Format):
    """One format. code: called as code(path, gaussians), of meshes as code(paths, avatar, poses or motion, up, name)."""

    up: Up = "y"
    """The axis that the readers of this format take for up."""
    mesh: bool = False
    """It holds the body as a textured mesh, not Gaussians."""
    animated: bool = False
    """One file holds all frames of a motion."""
    rest_fields: bool = False
    """It may have the 45 zero `f_rest_*` fields that some importers (Unity) require: code(path, gaussians, rest_fields)."""


EXPORTS = Formats(
    ply=ExportFormat("3DGS", f"{HERE}.gaussians:write_ply", (".ply",), up="-y", rest_fields=True),
    splat=ExportFormat("antimatter15's viewer and others", f"{HERE}.gaussians:write_splat", (".splat",), up="-y"),
    spz=ExportFormat("Niantic's, compressed", f"{HERE}.gaussians:write_spz", (".spz",)),
    glb=ExportFormat("glTF 2.0 with KHR_gaussian_splatting", f"{HERE}.gaussians:write_glb", (".glb",)),
    mesh=ExportFormat(
        *("the body as a textured mesh with skin and motion", f"{HERE}.mesh:write_animation", (".glb",)),
        **{"mesh": True, "animated": True},
    ),
    obj=ExportFormat("the body as a textured mesh in a pose", f"{HERE}.mesh:write_poses", (".obj",), mesh=True),
)
"""By name; a suffix has at most one format of Gaussians and one of meshes."""


def chosen_format(suffix: str, mesh: bool = False) -> ExportFormat | None:
    """The format of files with this suffix, None for none. mesh: of meshes alone, else of Gaussians where there is one."""
    found = [each for each in EXPORTS.values() if suffix.lower() in each.suffixes and each.mesh >= mesh]
    return min(found, key=lambda each: each.mesh, default=None)
