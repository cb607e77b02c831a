"""`humangs export`: writes files of an avatar for other programs."""

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal

from tyro.conf import OmitArgPrefixes, Positional, arg

from humangs_jax.avatar.export import EXPORTS, Up, chosen_format, files_beside
from humangs_jax.cli.options import WHOLE, OutputPath, PartOfMotion, UsageError, require_file
from humangs_jax.cli.screen import stage, suggest, wrote
from humangs_jax.core.registry import alternatives

if TYPE_CHECKING:
    from humangs_jax.avatar.avatar import Avatar
    from humangs_jax.body.motion import Motion

_DOWN = alternatives(EXPORTS.where(lambda each: each.up == "-y").suffixes)
"""Suffixes of files in which y points down."""


@dataclasses.dataclass(frozen=True)
class Export:
    """Export Gaussians, a textured mesh, or an HTML viewer.

    The avatar is in T-pose, or in one or many frames of a motion. Programs and formats: docs:
    export.
    """

    examples: ClassVar[tuple[str, ...]] = (
        "humangs export avatar.npz --html avatar.html",
        "humangs export avatar.npz --out person.glb --mesh --motion dance.bvh",
    )
    avatar: Positional[Path]
    """File written by `humangs reconstruct`."""
    out: Annotated[
        Path | None,
        arg(
            help=(
                f"File to write: {EXPORTS.listed()}. Default: avatar.ply without --html, none"
                " with it."
            )
        ),
    ] = None
    html: Annotated[Path | None, OutputPath((".html",))] = None
    """The HTML viewer to write: one file that needs no network (docs: viewer)."""
    mesh: bool = False
    """Write the body instead of the Gaussians. A .glb file then has a skin, and --motion as an
    animation.
    """
    motion: Path | None = None
    """The motion that the viewer plays (default: the shipped walk) or that poses --out (default:
    T-pose). docs: motions.
    """
    part: OmitArgPrefixes[PartOfMotion] = WHOLE
    frame: int | None = None
    """Number of the frame of the motion, from 0. Default: the first."""
    frames: str | None = None
    """Several frames: a:b:step as in Python, ":" for all.

    X.ply becomes X_0000.ply, X_0005.ply and so on.
    """
    up: Annotated[
        Up | None,
        arg(
            help=(
                f"The axis that points up in the file. Default: -y for {_DOWN}, as their viewers"
                " expect, else y."
            )
        ),
    ] = None
    rest: bool = False
    """Add the 45 f_rest fields of 3DGS, all zero, which some importers (Unity) require."""
    spz_version: Literal[3, 4] | None = None
    """Version of a .spz file. Default: 3, which more programs read."""

    def run(self) -> None:
        out = self.out
        if out is None and self.html is None:
            out = Path("avatar.ply")
        self._check(out)
        with stage("starting"):
            from humangs_jax.avatar.attach_face import with_face_for
            from humangs_jax.avatar.avatar import Avatar

            avatar = Avatar.load(self.avatar)
            motion = None
            if self.motion is not None:
                motion = self.part.load(self.motion, avatar.rest_joints)
                # a motion with expressions needs an avatar with a face
                avatar = with_face_for(avatar, motion)
        # the page has the whole motion, whichever frame --out has
        if self.html is not None:
            self._write_page(self.html, avatar, motion)
        if out is not None:
            self._write_file(out, avatar, motion)
        # suggest the other thing that this motion can be used for
        played = self.part.options(self.motion)
        if self.html is None:
            suggest("humangs export", self.avatar, "--html avatar.html", *played)
        else:
            suggest("humangs animate", self.avatar, *played, "--out video.mp4")

    def _check(self, out: Path | None) -> None:
        """Refuses options that do not go together, before anything is read.

        Raises: UsageError.
        """
        form = None
        if out is not None:
            # a mesh goes into fewer formats than Gaussians
            suffixes = EXPORTS.where(lambda each: each.mesh >= self.mesh).suffixes
            require_file(out, suffixes, read=(self.avatar, self.motion))
            form = chosen_format(out.suffix, self.mesh)
        self.part.check(self.motion)
        # frames are of a motion
        for option, value in (("--frame", self.frame), ("--frames", self.frames)):
            if value is not None and (self.motion is None or out is None):
                raise UsageError(f"{option} {value}: expected --motion and --out with it")
        if self.frame is not None and self.frames is not None:
            raise UsageError(f"--frame {self.frame}: does not go with --frames")
        if self.frame is not None and form is not None and form.animated:
            raise UsageError(
                f"--frame {self.frame}: does not go with a file that holds the whole motion: use"
                " --frames"
            )
        # what only some formats have
        if self.rest and form is not None and not form.rest_fields:
            raise UsageError(f"--rest: {out} has no such fields: expected a file of 3DGS")
        if self.spz_version is not None and (form is None or not form.versions):
            raise UsageError(
                f"--spz-version {self.spz_version}: expected a name of --out that ends in .spz"
            )

    def _write_page(self, path: Path, avatar: "Avatar", motion: "Motion | None") -> None:
        with stage("making the page"):
            from humangs_jax.viewer.page import write_page

            size = write_page(path, avatar, motion, self.avatar.stem, self._motion_name())
        count = len(avatar.gaussians.means)
        wrote(path, f"{count:,} Gaussians, {size / 1e6:.1f} MB; open it in a browser")

    def _write_file(self, out: Path, avatar: "Avatar", motion: "Motion | None") -> None:
        from humangs_jax.avatar.export.gaussians import export
        from humangs_jax.core.pytree import replace

        form = chosen_format(out.suffix, self.mesh)
        assert form is not None  # its suffix was checked
        numbers = None
        # the frames of the motion that are written
        if motion is not None:
            frames = self._frames(len(motion.translations), form.animated)
            part = motion.part(slice(frames.start, frames.stop, frames.step))
            motion = replace(part, fps=motion.fps / frames.step)
            # many frames of a format of one pose are many files, with numbers in their names
            if self.frames is not None and not form.animated:
                numbers = frames
        with stage("writing"):
            files = export(
                out,
                avatar,
                motion,
                numbers,
                mesh=form.mesh,
                up=self.up,
                rest_fields=self.rest,
                version=self.spz_version,
                name=self._motion_name() or "motion",
            )
        # say what was written
        what = f"{len(avatar.gaussians.means):,} Gaussians"
        if form.mesh:
            what = f"{len(avatar.faces):,} triangles"
        if motion is not None and form.animated:
            what += f", {len(motion.translations)} frames"
        what += ", feet on 0"
        if form.beside:
            what += f"; {' and '.join(file.name for file in files_beside(out, form))} belong to it"
        written = str(out)
        if len(files) > 1:
            written = f"{files[0]} to {files[-1].name}: {len(files)} files"
        wrote(written, what)

    def _motion_name(self) -> str | None:
        return None if self.motion is None else self.motion.stem

    def _frames(self, count: int, animated: bool) -> range:
        """Returns the numbers of the frames that are written.

        count: number of frames of the motion. animated: whether the file can hold a motion.

        Raises: UsageError if --frame is out of range; ValueError for wrong --frames.
        """
        from humangs_jax.avatar.export.gaussians import frame_range

        if self.frames is not None:
            return frame_range(self.frames, count)
        if animated:
            return range(count)
        frame = self.frame or 0
        if not 0 <= frame < count:
            raise UsageError(f"--frame {frame}: {self.motion} has {count} frames, from 0")
        return range(frame, frame + 1)
