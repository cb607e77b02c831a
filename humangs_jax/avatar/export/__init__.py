"""An avatar in the files that other people's programs open (docs/export.md), and videos of it: the tables of their formats.

`files.export` writes a file, `gaussians` and `mesh` hold what each format is made of.
"""

import dataclasses
from typing import Literal

from humangs_jax.core.registry import FOLDER, Format, Formats

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


@dataclasses.dataclass(frozen=True)
class VideoFormat(Format):
    """One format. code: called as code(path, frames, fps, shape of a frame)."""

    transparent: bool = False
    """Its frames may have alpha."""


_VIDEO = "humangs_jax.avatar.video"
VIDEOS = Formats(
    mp4=VideoFormat("H.264, plays everywhere", f"{_VIDEO}:write_mp4", (".mp4",)),
    webm=VideoFormat("VP9, may be transparent", f"{_VIDEO}:write_webm", (".webm",), transparent=True),
    gif=VideoFormat("256 colors, endless", f"{_VIDEO}:write_gif", (".gif",)),
    images=VideoFormat("frame_00000.png and so on", f"{_VIDEO}:write_images", (FOLDER,), transparent=True),
)


def chosen_format(suffix: str, mesh: bool = False) -> ExportFormat | None:
    """The format of files with this suffix, None for none. mesh: of meshes alone, else of Gaussians where there is one."""
    found = [each for each in EXPORTS.values() if suffix.lower() in each.suffixes and each.mesh >= mesh]
    return min(found, key=lambda each: each.mesh, default=None)
