"""`humangs demo`, `reconstruct`, `refine`, `animate`, `render`, `export`: from photos to an avatar, and what to do with one."""

import dataclasses
import math
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from tyro.conf import Positional

from humangs_jax.cli.options import (
    LARGEST_IMAGE,
    refine_limits,
    require_at_least,
    require_avatar,
    require_between,
    require_folder,
    require_parent,
    require_suffix,
)
from humangs_jax.cli.screen import stage, suggest, warn, wrote

if TYPE_CHECKING:
    from humangs_jax.avatar.avatar import Avatar
    from humangs_jax.data.capture import Capture


@dataclasses.dataclass(frozen=True)
class Demo:
    """Reconstruct the person that comes with the package from four photos, render new views, animate the avatar."""

    out: Path = Path("demo_out")
    """Folder for the images, the video, the avatar and report.json."""
    weights: Path | None = None
    """Network weights (.safetensors). Default: the shipped ones."""
    size: int = 256
    """Side of the animation's frames in pixels."""
    refine: float = 10.0
    """Seconds for which the avatar is fitted to its photos; 0 for none."""

    def run(self) -> None:
        require_at_least(0, refine=self.refine)
        require_between(16, LARGEST_IMAGE, size=self.size)
        require_folder(self.out)
        with stage("starting"):
            from humangs_jax.apps.demo import run_demo, summary
            from humangs_jax.refinement.config import RefineConfig

        refine = RefineConfig(seconds=self.refine) if self.refine else None
        report = run_demo(self.out, weights=self.weights, frame_size=self.size, refine=refine)
        wrote(self.out, summary(report))
        suggest("humangs view", self.out / "avatar.npz")


@dataclasses.dataclass(frozen=True)
class Reconstruct:
    """Reconstruct an avatar from a capture folder (photos, cameras, body poses: docs/capture_format.md)."""

    capture: Positional[Path]
    """Folder with capture.json. "demo_capture", if there is no such folder: the one that comes with the package."""
    out: Path = Path("avatar.npz")
    """The avatar file to write; an avatar that is there is replaced."""
    weights: Path | None = None
    """Network weights (.safetensors). Default: the shipped ones."""
    tokens: Literal["as_trained", "all", "foreground"] = "as_trained"
    """The patches of the photos that the network reads: all, or those that show the person, which is several times
    faster. For weights trained with the other setting it is an approximation (docs/performance_reconstruction.md)."""
    dtype: Literal["as_trained", "float32", "bfloat16"] = "as_trained"
    """Number type of the encoder's matrix products ("as_trained": float32). bfloat16 is faster on GPU and TPU."""
    refine: str | None = None
    """Fit the avatar to the photos afterwards for so long: seconds ("15s") or steps ("100steps"); see `humangs refine`."""
    check: bool = True
    """Look first whether photos, cameras and poses belong together, the quick part of `humangs check`; --no-check skips it."""

    def run(self) -> None:
        limits = None if self.refine is None else refine_limits(self.refine, "--refine")
        require_avatar(self.out)
        with stage("starting"):
            from humangs_jax.avatar.reconstruct import reconstruct
            from humangs_jax.network.weights import load_weights

        photos = _read_capture(self.capture, self.check)
        with stage("loading the network"):
            variables, config = load_weights(self.weights)
        tokens = None if self.tokens == "as_trained" else self.tokens
        dtype = "float32" if self.dtype == "as_trained" else self.dtype
        config = config.with_execution(tokens=tokens, dtype=dtype)
        with stage("reconstructing"):
            avatar = reconstruct(variables, config, photos)
            avatar.gaussians.means.block_until_ready()
        if limits is None:
            _save(avatar, self.out, f"from {photos.view_count} photos")
        else:
            _refine_and_save(avatar, photos, self.out, **limits)


@dataclasses.dataclass(frozen=True)
class Refine:
    """Fit an avatar to the photos of a capture: sharper where photos show it, unchanged where none does.

    Ctrl-C ends it early; the best avatar until then is written.
    """

    avatar: Positional[Path]
    """File written by `humangs reconstruct` from these photos."""
    capture: Positional[Path]
    """Folder with capture.json: may have more or larger photos than the network saw."""
    out: Path = Path("refined.npz")
    """The avatar file to write; an avatar that is there is replaced."""
    limit: str = "15s"
    """How long: seconds ("15s") or steps ("100steps"), after a compilation of some seconds."""
    image_size: int | None = None
    """Reduce photos whose longer side is larger, pixels. Default: photos as they are."""
    refine_poses: bool = False
    """Also refine the pose of each photo: for poses from `humangs fit`, which are millimetres off."""
    growth: float = 1.0
    """The number of Gaussians may grow by this factor: those with the largest errors are split."""
    check: bool = True
    """Look first whether photos, cameras and poses belong together, the quick part of `humangs check`; --no-check skips it."""

    def run(self) -> None:
        limits = refine_limits(self.limit, "--limit")
        require_between(16, LARGEST_IMAGE, image_size=self.image_size)
        require_between(1, 100, growth=self.growth)
        require_avatar(self.out, inputs=(self.avatar,))
        with stage("starting"):
            from humangs_jax.avatar.avatar import Avatar

            avatar = Avatar.load(self.avatar)
        photos = _read_capture(self.capture, self.check)
        settings = {"image_size": self.image_size, "poses": self.refine_poses, "growth": self.growth}
        _refine_and_save(avatar, photos, self.out, **settings, **limits)


def _read_capture(path: Path, check: bool) -> "Capture":
    """A capture, after warnings about what looks wrong in it."""
    with stage("reading the capture"):
        from humangs_jax.data.capture import load_capture

        photos = load_capture(path)
    if check:
        with stage("checking it"):
            from humangs_jax.apps.quick_check import likely_mistakes

            mistakes = likely_mistakes(photos)
        for mistake in mistakes:
            warn(mistake)
        if mistakes:
            warn(f"go on at your own risk: `humangs check {path}` draws the body over each photo")
    return photos


def _refine_and_save(avatar: "Avatar", photos: "Capture", out: Path, **settings: Any) -> None:
    """Refine with a progress bar, write the result, say what it took. Raises: KeyboardInterrupt, after that, if one ended it."""
    with stage("refining"):
        from humangs_jax.refinement.config import RefineConfig
        from humangs_jax.refinement.refine import refine_with_report

        refinement = refine_with_report(avatar, photos, RefineConfig(**settings), progress=True)
    _save(refinement.avatar, out, f"from {photos.view_count} photos, {refinement.summary()}")
    if refinement.interrupted:
        raise KeyboardInterrupt


def _save(avatar: "Avatar", out: Path, how: str) -> None:
    """Write an avatar and say so."""
    with stage("writing"):
        avatar.save(out)
    wrote(out, f"{len(avatar.gaussians.means):,} Gaussians {how}")
    suggest("humangs view", out)


@dataclasses.dataclass(frozen=True)
class Animate:
    """Animate an avatar with a motion of SMPL-X poses and write a video (.mp4 or .gif)."""

    avatar: Positional[Path]
    """File written by `humangs reconstruct`."""
    motion: Path | None = None
    """.npz (ours, AMASS, AIST++, THuman4.0, AvatarReX) or LHM's .json. Default: the shipped walk."""
    out: Path = Path("animation.mp4")
    """The video to write."""
    size: int = 512
    """Side of the frames in pixels."""
    azimuth: float = 20.0
    """Degrees; 0 looks at the avatar's front."""
    turn: float = 0.0
    """Degrees that the camera travels around the avatar during the motion."""

    def run(self) -> None:
        require_parent(self.out)
        require_suffix(self.out, (".mp4", ".gif"))
        require_between(16, LARGEST_IMAGE, size=self.size)
        require_between(-math.inf, math.inf, azimuth=self.azimuth, turn=self.turn)
        from humangs_jax.avatar.avatar import Avatar
        from humangs_jax.avatar.frames import motion_frames
        from humangs_jax.avatar.video import write_video
        from humangs_jax.data.motion import load_motion

        avatar, motion = Avatar.load(self.avatar), load_motion(self.motion)
        frames = motion_frames(avatar, motion, self.size, azimuth=self.azimuth, turn=self.turn)
        with stage("drawing"):
            write_video(self.out, frames, motion.fps)
        wrote(self.out, f"{len(motion.translations)} frames at {motion.fps:g} frames per second")


@dataclasses.dataclass(frozen=True)
class Render:
    """Render an avatar in its T-pose from a circle of cameras, or in the poses and from the cameras of a capture."""

    avatar: Positional[Path]
    """File written by `humangs reconstruct`."""
    out: Path = Path("views")
    """Folder for view_000.png and so on."""
    views: int = 8
    """Number of cameras on the circle."""
    size: int = 512
    """Side of the images in pixels (circle only)."""
    capture: Path | None = None
    """Take cameras and poses from this capture folder instead."""
    exr: bool = False
    """Also write views.exr: float32 RGBA (premultiplied), depth Z and camera matrices, one part per view."""

    def run(self) -> None:
        require_folder(self.out)
        require_between(16, LARGEST_IMAGE, size=self.size)
        from humangs_jax.avatar.avatar import Avatar
        from humangs_jax.avatar.frames import capture_renderings, turntable_renderings, write_renderings
        from humangs_jax.data.capture import load_capture

        avatar = Avatar.load(self.avatar)
        with stage("rendering"):
            if self.capture is not None:
                cameras, renderings = capture_renderings(avatar, load_capture(self.capture))
            else:
                cameras, renderings = turntable_renderings(avatar, self.views, self.size)
        with stage("writing"):
            written = write_renderings(self.out, cameras, renderings, exr=self.exr)
        wrote(self.out, f"{written} views")


@dataclasses.dataclass(frozen=True)
class Export:
    """Export an avatar: a page that shows it moving in any browser (--html), or a file for Gaussian viewers (--out): 3DGS .ply,
    .splat, or .glb with KHR_gaussian_splatting, in the T-pose or in one frame of a motion.
    """

    avatar: Positional[Path]
    """File written by `humangs reconstruct`."""
    out: Path | None = None
    """File to write: .ply, .splat or .glb. Default: avatar.ply without --html, none with it."""
    html: Path | None = None
    """The page to write: one .html file that needs no network (docs/viewer.md)."""
    motion: Path | None = None
    """Page: the motion it plays (default: the shipped walk). --out: pose it by this motion (default: T-pose)."""
    frame: int = 0
    """--out: which frame of the motion."""
    up: Literal["y", "-y", "z"] | None = None
    """--out: the axis that points up in the file; the feet stand on 0. Default: -y, as splat viewers expect; .glb: y, as glTF
    wants."""
    rest: bool = False
    """.ply: add the 45 zero f_rest fields that some importers (Unity) require."""

    def run(self) -> None:
        out = Path("avatar.ply") if self.out is None and self.html is None else self.out
        for option, path, suffixes in (("--out", out, (".ply", ".splat", ".glb")), ("--html", self.html, (".html",))):
            if path is not None:
                require_parent(path, option)
                require_suffix(path, suffixes, option)
        from humangs_jax.avatar.animate import animate
        from humangs_jax.avatar.avatar import Avatar
        from humangs_jax.avatar.export import grounded_gaussians, turned, write_glb, write_ply, write_splat
        from humangs_jax.data.motion import load_motion

        avatar = Avatar.load(self.avatar)
        motion = None if self.motion is None else load_motion(self.motion)
        if motion is not None and not 0 <= self.frame < len(motion.translations):
            raise ValueError(f"--frame {self.frame}: {self.motion} has {len(motion.translations)} frames, from 0")
        if self.html is not None:
            from humangs_jax.viewer.page import write_page

            name = None if self.motion is None else self.motion.stem
            size = write_page(self.html, avatar, motion, self.avatar.stem, name)
            wrote(self.html, f"{len(avatar.gaussians.means):,} Gaussians, {size / 1e6:.1f} MB; open it in a browser")
        if out is not None:
            suffix = out.suffix.lower()
            gaussians = avatar.gaussians if motion is None else animate(avatar, motion.pose(self.frame))
            up = self.up or ("y" if suffix == ".glb" else "-y")
            gaussians = turned(grounded_gaussians(gaussians), up)
            if suffix == ".ply":
                write_ply(out, gaussians, spherical_harmonics_rest=self.rest)
            else:
                {".splat": write_splat, ".glb": write_glb}[suffix](out, gaussians)
            wrote(out, f"{len(gaussians.means):,} Gaussians, {up} up, feet on 0")


@dataclasses.dataclass(frozen=True)
class View:
    """Show an avatar moving in the browser: serves the page of `humangs export --html` on this machine until Ctrl-C."""

    avatar: Positional[Path]
    """File written by `humangs reconstruct`."""
    motion: Path | None = None
    """The motion it plays. Default: the shipped walk."""
    port: int = 0
    """Port on 127.0.0.1; 0 for any free one."""
    browser: bool = True
    """Open the browser; --no-browser only prints the address."""

    def run(self) -> None:
        from humangs_jax.avatar.avatar import Avatar
        from humangs_jax.data.motion import load_motion
        from humangs_jax.viewer.page import page_html, serve

        motion = None if self.motion is None else load_motion(self.motion)
        name = None if self.motion is None else self.motion.stem
        with stage("making the page"):
            text = page_html(Avatar.load(self.avatar), motion, self.avatar.stem, name)
        serve(text, self.port, self.browser)
