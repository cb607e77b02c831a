"""Tables of the formats in which avatars are exported for other programs (docs/export.md), and of
the formats of videos.

`gaussians` has the functions that read and write. The formats of Gaussians are in `splats`, `spz`
and `sog`, the formats of the body in `mesh`, and the format of motions in `vrma`.
"""

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

from humangs_jax.core.registry import FOLDER, Format, Formats

Up = Literal["y", "-y", "z"]
"""The axis that points up in a file."""
HERE = "humangs_jax.avatar.export"


@dataclasses.dataclass(frozen=True)
class ExportFormat(Format):
    """A format of exported files. The code of a format of Gaussians is called as code(path,
    gaussians). The code of a format of meshes is called as code(path, files, avatar, motion, up,
    name). `path` is the name that the user gave, `files` are the files to write, and `motion` is
    None for the T-pose. Formats that are only read have no code.
    """

    up: Up = "y"
    """The axis that points up for the programs that read this format."""
    mesh: bool = False
    """Whether the format holds the body as a textured mesh, or its motion alone, and no Gaussians.
    """
    animated: bool = False
    """Whether one file holds all frames of a motion."""
    rest_fields: bool = False
    """Whether the format may have all 45 `f_rest_*` fields, which some importers (Unity) require.
    Then code takes the keyword `rest_fields`.
    """
    versions: tuple[int, ...] = ()
    """The versions that can be written, the usual one first; empty where there is no choice. With
    versions, code takes the keyword `version`.
    """
    backwards: bool = False
    """Whether the format's axes point to the right, up and back, half a turn about y from ours."""
    beside: tuple[str, ...] = ()
    """Suffixes of the further files that are written next to a file of this format, see
    `files_beside`.
    """
    reader: str | Callable[[bytes], Any] = ""
    """The function that reads Gaussians, or its name as "module:function". It takes the bytes of a
    file and a list, to which it appends lines about the file. It raises
    `io.reading.InvalidFileError`. Empty: the format is not read.
    """
    magic: tuple[bytes, ...] = ()
    """The bytes with which files of the format may begin. Empty: the format is recognised by its
    suffix.
    """


EXPORTS = Formats(
    ply=ExportFormat(
        "3DGS",
        f"{HERE}.splats:write_ply",
        (".ply",),
        up="-y",
        rest_fields=True,
        reader=f"{HERE}.splats:read_ply",
        magic=(b"ply",),
    ),
    splat=ExportFormat(
        "antimatter15's viewer and others",
        f"{HERE}.splats:write_splat",
        (".splat",),
        up="-y",
        reader=f"{HERE}.splats:read_splat",
    ),
    spz=ExportFormat(
        "Niantic's, compressed",
        f"{HERE}.spz:write_spz",
        (".spz",),
        backwards=True,
        versions=(3, 4),
        reader=f"{HERE}.spz:read_spz",
        magic=(b"\x1f\x8b\x08", b"NGSP"),
    ),
    glb=ExportFormat(
        "glTF 2.0 with KHR_gaussian_splatting",
        f"{HERE}.splats:write_glb",
        (".glb",),
        reader=f"{HERE}.splats:read_glb",
        magic=(b"glTF",),
    ),
    mesh=ExportFormat(
        "with --mesh the body with texture, skin and motion",
        f"{HERE}.mesh:write_animation",
        (".glb",),
        mesh=True,
        animated=True,
    ),
    vrma=ExportFormat(
        "the motion alone, for VRM characters",
        f"{HERE}.vrma:write_vrma",
        (".vrma",),
        mesh=True,
        animated=True,
    ),
    obj=ExportFormat(
        "the body as a textured mesh in a pose",
        f"{HERE}.mesh:write_poses",
        (".obj",),
        mesh=True,
        beside=(".mtl", ".png"),
    ),
)
"""The formats that can be written, by name. A suffix has at most one format of Gaussians and one of
meshes.
"""

READ_ONLY = Formats(
    sog=ExportFormat(
        "PlayCanvas' SOG, a bundle",
        "",
        (".sog",),
        up="-y",
        reader=f"{HERE}.sog:read_sog",
    ),
    checkpoint=ExportFormat(
        "gsplat's checkpoints",
        "",
        (".pt", ".pth", ".ckpt"),
        up="-y",
        reader=f"{HERE}.splats:read_checkpoint",
    ),
)
"""Formats of Gaussians that are read and not written."""

_CONVERT = "`npx @playcanvas/splat-transform {} scene.ply` makes a .ply of it"
CHECKPOINTS = (
    "of other checkpoints write a .ply with the program that trained it "
    "(gsplat: `simple_trainer.py --save_ply`; nerfstudio: `ns-export gaussian-splat`)"
)
OTHERS = {
    ".ksplat": f"a compressed file of mkkellogg's viewer: {_CONVERT.format('scene.ksplat')}",
    ".lcc": f"XGRIDS' LCC: {_CONVERT.format('scene.lcc')}",
    ".json": (
        "an unbundled SOG, or no Gaussians: `zip -j scene.sog FOLDER/*` makes a bundle of its"
        " folder"
    ),
}
"""What the error says about files that are not read, by suffix."""


@dataclasses.dataclass(frozen=True)
class VideoFormat(Format):
    """A format of videos. Its code is called as code(path, frames, fps, shape of a frame)."""

    transparent: bool = False
    """Whether frames may have alpha."""
    even_sides: bool = False
    """Whether the codec needs even sides. Odd sides get one more row or column."""


_VIDEO = "humangs_jax.avatar.video"
VIDEOS = Formats(
    mp4=VideoFormat("H.264, plays everywhere", f"{_VIDEO}:write_mp4", (".mp4",), even_sides=True),
    webm=VideoFormat(
        "VP9, may be transparent",
        f"{_VIDEO}:write_webm",
        (".webm",),
        transparent=True,
        even_sides=True,
    ),
    gif=VideoFormat("256 colors, endless", f"{_VIDEO}:write_gif", (".gif",)),
    images=VideoFormat(
        "frame_00000.png and so on", f"{_VIDEO}:write_images", (FOLDER,), transparent=True
    ),
)


def files_beside(path: Path, form: ExportFormat) -> list[Path]:
    """Returns the paths of the files that are written next to an output, such as the `.mtl` and the
    `.png` of an `.obj`.

    White space in the output's name becomes "_" in these names, because for many readers of `.obj`
    a name ends at white space.
    """
    stem = "_".join(path.stem.split())
    return [path.with_name(stem + suffix) for suffix in form.beside]


def chosen_format(suffix: str, mesh: bool = False) -> ExportFormat | None:
    """Returns the format in which files with this suffix are written, or None if there is none.
    mesh: whether only formats of meshes count; if not, formats of Gaussians come first.
    """
    found = [
        each for each in EXPORTS.values() if suffix.lower() in each.suffixes and each.mesh >= mesh
    ]
    return min(found, key=lambda each: each.mesh, default=None)
