"""The commands `humangs animate`, `render` and `view`, which show an avatar.

They write videos and images, and show the avatar in the browser.
"""

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal

from tyro.conf import OmitArgPrefixes, Positional, arg

from humangs_jax.avatar.export import EXPORTS, OTHERS, READ_ONLY, VIDEOS
from humangs_jax.avatar.frame_settings import FrameSettings
from humangs_jax.cli.options import (
    WHOLE,
    OutputPath,
    PartOfMotion,
    Preset,
    UsageError,
    chosen_settings,
    off,
    option_of,
)
from humangs_jax.cli.screen import stage, suggest, tell, wrote
from humangs_jax.core.configuration import LARGEST, Range, at_least
from humangs_jax.core.registry import FOLDER, alternatives
from humangs_jax.data.formats import CAMERAS, MOTIONS

if TYPE_CHECKING:
    from humangs_jax.avatar.avatar import Avatar
    from humangs_jax.body.model import BodyPose
    from humangs_jax.body.motion import Motion
    from humangs_jax.geometry.camera import Camera

_RATE = Range(0.01, 1000.0)
"""Range of frames per second."""
_FINITE = at_least(-LARGEST)
"""Range of all finite numbers."""
_VIDEO = OutputPath(VIDEOS.suffixes, folder=True)
"""Annotation of an option for a video, or for a folder of images."""
_FROM_THE_SIDE = FrameSettings(azimuth=20.0)
"""Default settings of the frames of `humangs animate`."""
_SPLATS = {
    suffix: each
    for each in (*EXPORTS.values(), *READ_ONLY.values())
    if not each.mesh
    for suffix in each.suffixes
}
"""Formats of files of Gaussians, by suffix."""


@dataclasses.dataclass(frozen=True)
class Animate:
    """Animate an avatar with a motion, as a video or PNG files.

    The camera follows the person. Files of motions: docs: motions.
    """

    examples: ClassVar[tuple[str, ...]] = (
        "humangs animate avatar.npz --motion dance.bvh --out dance.mp4",
        "humangs animate avatar.npz --camera path.json --background transparent --out walk.webm",
    )
    avatar: Positional[Path]
    """File written by `humangs reconstruct`."""
    shot: OmitArgPrefixes[FrameSettings] = _FROM_THE_SIDE
    motion: Annotated[
        Path | None,
        arg(
            help=(
                f"{MOTIONS.listed()}; or a video, whose motion is kept beside it as"
                " NAME.motion.npz. Default: the shipped walk."
            )
        ),
    ] = None
    part: OmitArgPrefixes[PartOfMotion] = WHOLE
    out: Annotated[Path, _VIDEO, arg(help=f"The video to write. {VIDEOS.listed()}")] = Path(
        "animation.mp4"
    )
    turn: Annotated[float, _FINITE] = 0.0
    """Angle that the camera travels around the avatar during the motion, degrees."""
    camera: Annotated[
        Path | None,
        arg(
            help=(
                "Cameras of a file instead: one stands still, several are a path over the whole"
                f" motion, around a person on the floor. {CAMERAS.listed()}"
            )
        ),
    ] = None
    follow: Annotated[
        bool,
        off("follow the person: the camera stands still and sees everywhere that the person goes"),
    ] = True
    """Let the camera follow the person."""
    fps: Annotated[float | None, _RATE] = None
    """Frames per second of the video. The motion keeps its speed. Default: the motion's rate."""
    start: float = 0.0
    """Begin at this second of the motion."""
    stop: float | None = None
    """End at this second of the motion. Default: its end."""
    loop: int = 1
    """How often to play the motion. Each repetition starts where the last one ended."""
    preset: Preset | None = None
    """Preset of splatting, from fast to accurate (docs: tradeoff). --splat overrides it."""
    config: Path | None = None
    """Like --preset, with the settings in a file of `humangs tune`."""

    def run(self) -> None:
        if self.camera is not None:
            given = ["turn"] * (self.turn != 0) + ["no-follow"] * (not self.follow)
            _require_no_circle("--camera", self.shot, _FROM_THE_SIDE, given)
        # an output that cannot be written is refused before anything is read
        with stage("starting"):
            from humangs_jax.avatar.attach_face import with_face_for
            from humangs_jax.avatar.avatar import Avatar
            from humangs_jax.avatar.camera_paths import camera_path, file_cameras, one_size
            from humangs_jax.avatar.frames import (
                images,
                motion_poses,
                motion_views,
                trim_and_resample,
            )
            from humangs_jax.avatar.video import check_video, write_video
            from humangs_jax.io.reading import reading

            check_video(self.out, 0, *self.shot.resolution, transparent=self.shot.color() is None)
            shot = _drawn_by(self.shot, self.preset, self.config)
        with stage("reading"):
            avatar = Avatar.load(self.avatar)
            motion = self._motion(avatar)
            avatar = with_face_for(avatar, motion)
            # cut and repeat the motion before cameras are made for its frames
            with reading(self.motion or "the motion", "motion"):
                motion = trim_and_resample(motion, self.start, self.stop, self.fps, self.loop)
            frames = len(motion.translations)
            if self.camera is None:
                # without a camera file the camera goes along, or circles
                poses, cameras = motion_views(avatar, motion, shot, self.turn, self.follow)
            else:
                found = one_size(self.camera, file_cameras(self.camera, shot, upright=True))
                poses, cameras = motion_poses(avatar, motion), camera_path(found, frames)
            check_video(self.out, frames, cameras.width, cameras.height)
        # the same Gaussians are left out of all frames
        avatar = _pruned(avatar, poses, cameras, shot)
        with stage("drawing"):
            written = write_video(
                self.out, images(avatar, poses, cameras, shot, "animate"), motion.fps
            )
        wrote(
            self.out,
            f"{_counted(written, 'frame')} of {_size(self.out, cameras)} at {motion.fps:g} frames"
            " per second",
        )
        suggest(
            "humangs export", self.avatar, "--html avatar.html", *self.part.options(self.motion)
        )

    def _motion(self, avatar: "Avatar") -> "Motion":
        """Reads the motion of a file, or finds the motion in a video.

        Raises: UsageError for options that a video does not take; as `load_motion` for a file, and
        as `motion_beside` for a video.
        """
        from humangs_jax.data.folders import is_video

        if self.motion is None or not is_video(self.motion):
            return self.part.load(self.motion, avatar.rest_joints)
        for name in self.part.given():
            if name != "person":
                raise UsageError(f"{option_of(name)}: is for files of motions, not for a video")
        import numpy as np

        from humangs_jax.apps.video_motion import motion_beside

        return motion_beside(self.motion, np.asarray(avatar.rest_joints), self.part.person)


@dataclasses.dataclass(frozen=True)
class Render:
    """Render an avatar, or Gaussians of any program, as images or a video.

    Cameras are on a circle, or those of a file or a capture. Images can also be written as layers
    of an EXR file. A video is one turn (docs: video).
    """

    examples: ClassVar[tuple[str, ...]] = (
        "humangs render avatar.npz --capture me --exr --out views",
        "humangs render scene.ply --camera sparse/0 --out views",
    )
    avatar: Positional[Path]
    """File written by `humangs reconstruct`, or a file of Gaussians: .ply, .splat, .spz, .glb, .sog
    or .pt.
    """
    shot: OmitArgPrefixes[FrameSettings]
    camera: Annotated[
        Path | None,
        arg(
            help=(
                "Cameras of a file: of Gaussians in its world, of an avatar around a person who"
                f" stands on the floor. {CAMERAS.listed()}"
            )
        ),
    ] = None
    out: Annotated[
        Path,
        _VIDEO,
        arg(
            help=(
                "Folder for view_000.png and so on, or a video of a turn:"
                f" {alternatives(VIDEOS.where(lambda each: each.suffixes != (FOLDER,)).suffixes)}"
            )
        ),
    ] = Path("views")
    pose: Literal["t", "a"] = "t"
    """T-pose, or A-pose with the arms down. Not with --capture."""
    views: Annotated[int | None, at_least(1)] = None
    """Number of cameras on the circle. Default: 8. For a video, the default makes the turn last 4
    seconds.
    """
    fps: Annotated[float, _RATE] = 24.0
    """Frames per second of a video."""
    capture: Path | None = None
    """Take cameras and poses from this capture folder instead of a circle."""
    exr: bool = False
    """Also write views.exr with one part per view: premultiplied colors, --channels, and the
    camera.
    """
    channels: str = "rgba,z"
    """Channels of views.exr: rgba (always there), z, position, normal, part, separated by commas.
    """
    exr_type: Literal["float", "half"] = "float"
    """Number type of views.exr. With half, depths and positions still have 32 bits."""
    preset: Preset | None = None
    """Preset of splatting, from fast to accurate (docs: tradeoff). --splat overrides it."""
    config: Path | None = None
    """Like --preset, with the settings in a file of `humangs tune`."""

    def run(self) -> None:
        # a video is one turn; images are 8 views of a circle
        video, views = self.out.suffix != "", self.views
        if views is None:
            views = 8
            if video:
                views = max(2, round(4.0 * self.fps))  # a turn of 4 seconds
        if video and self.exr:
            raise UsageError(f"--exr: {self.out} is a video: expected a folder")
        self._require_one_kind_of_cameras()
        # Gaussians of other programs have no body to pose
        if self.avatar.suffix.lower() in (*_SPLATS, *OTHERS):
            return self._render_gaussians(views)
        with stage("starting"):
            from humangs_jax.avatar.avatar import Avatar
            from humangs_jax.avatar.camera_paths import file_cameras, one_size, repeated, standing
            from humangs_jax.avatar.frames import (
                a_pose_of,
                capture_views,
                images,
                rest_pose_of,
                turntable_views,
            )
            from humangs_jax.avatar.layers import ExrLayers, write_views
            from humangs_jax.avatar.video import check_video, write_video
            from humangs_jax.data.capture import load_capture
            from humangs_jax.data.exposure import exposure_gains

            # everything that can be wrong with the options is found before the avatar is read
            check_video(
                self.out,
                views,
                *self.shot.resolution,
                transparent=video and self.shot.color() is None,
            )
            layers = ExrLayers(tuple(self.channels.split(",")), half=self.exr_type == "half")
            layers.check()
            shot = _drawn_by(self.shot, self.preset, self.config)
        with stage("reading"):
            avatar = Avatar.load(self.avatar)
            exposed = names = None
            # cameras of a file, of the capture, or on a circle
            if self.camera is not None:
                found = file_cameras(self.camera, shot, upright=True)
                cameras, names = one_size(self.camera, found), list(found)
                pose = rest_pose_of(avatar) if self.pose == "t" else a_pose_of(avatar)
                pose = standing(avatar, pose)
                poses = repeated(pose, len(names))
            elif self.capture is not None:
                capture = load_capture(self.capture)
                (poses, cameras), exposed = capture_views(avatar, capture), exposure_gains(capture)
            else:
                pose = rest_pose_of(avatar) if self.pose == "t" else a_pose_of(avatar)
                poses, cameras = turntable_views(avatar, pose, views, shot)
        avatar = _pruned(avatar, poses, cameras, shot)
        with stage("drawing"):
            # a video, or one image for each view
            if video:
                written = write_video(
                    self.out, images(avatar, poses, cameras, shot, "render"), self.fps
                )
                what = (
                    f"{_counted(written, 'frame')} of {_size(self.out, cameras)} at {self.fps:g}"
                    " frames per second"
                )
            else:
                exr = layers if self.exr else None
                written = write_views(
                    self.out, avatar, poses, cameras, shot, exr, exposure_gains=exposed, names=names
                )
                what = (
                    f"{_counted(written, 'view')} of {cameras.width} x"
                    f" {cameras.height}{' and views.exr' * self.exr}"
                )
        wrote(self.out, what)
        suggest("humangs animate", self.avatar)

    def _render_gaussians(self, views: int) -> None:
        # options that need a skeleton do not apply
        given = {
            "pose": self.pose != "t",
            "capture": self.capture,
            "exr": self.exr,
            "prune": self.shot.prune,
        }
        for option, value in given.items():
            if value:
                raise UsageError(f"--{option}: {self.avatar} is no avatar, which this needs")
        if self.camera is not None and self.out.suffix:
            raise UsageError("--camera: expected a folder as --out")
        with stage("starting"):
            from humangs_jax import load_gaussians
            from humangs_jax.avatar.camera_paths import file_cameras
            from humangs_jax.avatar.splat_views import (
                circle_cameras,
                splat_images,
                write_splat_views,
            )
            from humangs_jax.avatar.video import check_video, write_video

            check_video(
                self.out,
                views,
                *self.shot.resolution,
                transparent=self.shot.color() is None and self.out.suffix != "",
            )
            shot = _drawn_by(self.shot, self.preset, self.config)
        with stage("reading"):
            gaussians = load_gaussians(self.avatar)
            # a circle around the Gaussians, whose up axis the format tells
            if self.camera is None:
                cameras = circle_cameras(
                    gaussians, _SPLATS[self.avatar.suffix.lower()], views, shot
                )
            else:
                cameras = file_cameras(self.camera, shot)
        with stage("drawing"):
            # a video needs one size of frames, images do not
            if self.out.suffix:
                count = write_video(self.out, splat_images(gaussians, cameras, shot), self.fps)
                size = _size(self.out, next(iter(cameras.values())))
                what = f"{_counted(count, 'frame')} of {size} at {self.fps:g} frames per second"
            else:
                what = _counted(write_splat_views(self.out, gaussians, cameras, shot), "view")
        wrote(self.out, f"{what} of {len(gaussians.means):,} Gaussians")

    def _require_one_kind_of_cameras(self) -> None:
        """Refuses options that do not go with --capture or --camera.

        Raises: UsageError, which names the first such option.
        """
        given = ["views"] * (self.views is not None)
        if self.capture is not None:
            given += ["camera"] * (self.camera is not None) + ["pose"] * (self.pose != "t")
            given += [
                name
                for name in ("size", "width", "height")
                if getattr(self.shot, name) != getattr(FrameSettings(), name)
            ]
            _require_no_circle("--capture", self.shot, FrameSettings(), given)
            if self.out.suffix:
                raise UsageError(
                    f"--out {self.out}: expected a folder: the views of a capture are no video"
                )
        elif self.camera is not None:
            _require_no_circle("--camera", self.shot, FrameSettings(), given)


@dataclasses.dataclass(frozen=True)
class View:
    """Show an avatar moving in the browser.

    Serves the HTML viewer on this machine until Ctrl-C. docs: viewer.
    """

    examples: ClassVar[tuple[str, ...]] = (
        "humangs view avatar.npz --motion dance.bvh",
        "humangs view avatar.npz --port 8000 --no-browser",
    )
    avatar: Positional[Path]
    """File written by `humangs reconstruct`."""
    motion: Path | None = None
    """The motion that the avatar plays. Default: the shipped walk."""
    part: OmitArgPrefixes[PartOfMotion] = WHOLE
    port: Annotated[int, Range(0, 65535)] = 0
    """Port on 127.0.0.1. 0: any free port."""
    browser: Annotated[bool, off("open a browser; the address is printed")] = True
    """Open a browser."""

    def run(self) -> None:
        self.part.check(self.motion)
        with stage("making the page"):
            from humangs_jax.avatar.attach_face import with_face_for
            from humangs_jax.avatar.avatar import Avatar
            from humangs_jax.viewer.page import page_html, serve

            avatar = Avatar.load(self.avatar)
            motion, name = None, None
            if self.motion is not None:
                motion, name = self.part.load(self.motion, avatar.rest_joints), self.motion.stem
                avatar = with_face_for(avatar, motion)
            text = page_html(avatar, motion, self.avatar.stem, name)
        serve(text, self.port, self.browser)


def _drawn_by(shot: FrameSettings, preset: Preset | None, config: Path | None) -> FrameSettings:
    settings = chosen_settings(preset, config)
    return shot if settings is None else settings.shot(shot)


def _pruned(
    avatar: "Avatar", poses: "BodyPose", cameras: "Camera", shot: FrameSettings
) -> "Avatar":
    """Returns the avatar without the Gaussians that no image shows, if --prune is given, and prints
    their number.
    """
    from humangs_jax.avatar.frames import splatting_of, without_unseen

    if not shot.prune:
        return avatar
    with stage("looking for unseen Gaussians"):
        seen = without_unseen(avatar, poses, cameras, splatting_of(shot, avatar), progress="look")
    every = len(avatar.gaussians.means)
    tell(f"{every - len(seen.gaussians.means):,} of {every:,} Gaussians are in no image")
    return seen


def _require_no_circle(
    option: str, shot: FrameSettings, usual: FrameSettings, given: list[str]
) -> None:
    """Refuses options of a circle of cameras beside an option that brings cameras.

    option: the option that brings cameras. usual: settings of frames that no option has changed.
    given: names of further given options that do not go with it.

    Raises: UsageError, which names the first refused option.
    """
    where = ("azimuth", "elevation", "distance", "fov")
    refused = [name for name in where if getattr(shot, name) != getattr(usual, name)] + given
    if refused:
        own = "cameras and poses" if option == "--capture" else "cameras"
        raise UsageError(f"--{refused[0]}: not with {option}, which has the {own}")


def _counted(count: int, word: str) -> str:
    return f"{count} {word}{'' if count == 1 else 's'}"


def _size(path: Path, camera: "Camera") -> str:
    """Returns the size of the images in a file, as text such as "512 x 512".

    A video may have one row or column more than the images that are drawn.
    """
    from humangs_jax.avatar.video import video_size

    width, height = video_size(path, camera.width, camera.height)
    return f"{width} x {height}"
