"""`humangs motion`: finds the motion of a person in a video."""

import dataclasses
from pathlib import Path
from typing import Annotated, ClassVar

from tyro.conf import Positional, arg

from humangs_jax.cli.options import OutputPath, UsageError
from humangs_jax.cli.screen import stage, suggest, wrote
from humangs_jax.core.configuration import Range, at_least


@dataclasses.dataclass(frozen=True)
class MotionOfVideo:
    """Find the motion of a person in a video whose camera stands still.

    The result moves any avatar: `--motion M.npz` of animate, export and view. If a run is
    interrupted, the same command goes on from there. docs: motions.
    """

    examples: ClassVar[tuple[str, ...]] = (
        "humangs motion dance.mp4 --out dance.npz --height 1.72",
        "humangs motion dance.mp4 --out dance.npz --avatar avatar.npz --check check.mp4",
    )
    video: Positional[Path]
    """A video that shows the whole person."""
    out: Annotated[Path, OutputPath((".npz",))]
    """The motion to write, .npz."""
    person: Annotated[int | None, at_least(0)] = None
    """Number of the person, from 0, counted from the largest. Default: the largest."""
    height: Annotated[float | None, Range(0.4, 2.5)] = None
    """Height of the person, metres, which gives the scale of the motion. Default: a usual
    height.
    """
    avatar: Path | None = None
    """Find the motion for the body of this avatar, in its size."""
    focal_mm: Annotated[float | None, Range(5.0, 2000.0)] = None
    """Focal length of the camera, millimetres on 35-mm film. Default: 29, that of a telephone."""
    check: Annotated[
        Path | None,
        OutputPath((".mp4", ".webm", ".gif")),
        arg(help="Also write a video of the body over the input."),
    ] = None

    def run(self) -> None:
        """Finds the motion and writes it."""
        if self.height is not None and self.avatar is not None:
            raise UsageError("--height: the avatar gives the scale: expected one of both")
        with stage("starting"):
            import numpy as np

            from humangs_jax.apps.video_motion import fit_video, made_from, write_check_video
            from humangs_jax.avatar.avatar import Avatar
            from humangs_jax.io.reading import open_file
            from humangs_jax.motion import made_from_of, save_motion

            # what is wrong with the files is reported before the work
            open_file(self.video).close()
            if self.out.exists() and made_from_of(self.out) is None:
                raise UsageError(
                    f"--out {self.out}: exists, and was not found in a video: expected another name"
                )
            joints = None
            if self.avatar is not None:
                joints = np.asarray(Avatar.load(self.avatar).rest_joints)
        # what was seen is kept beside the result, so that an interrupted run goes on
        kept = self.out.with_name(f"{self.out.stem}.seen.npz")
        with stage("finding the motion"):
            found = fit_video(
                self.video,
                person=self.person,
                height=self.height,
                rest_joints=joints,
                focal_mm=self.focal_mm,
                kept=kept,
            )
        about = made_from(
            self.video, person=self.person, height=self.height, focal_mm=self.focal_mm
        )
        motion = found.fit.motion
        with stage("writing"):
            save_motion(self.out, motion, made_from=about)
        wrote(self.out, f"{len(motion.translations)} frames at {motion.fps:g} a second")
        if self.check is not None:
            with stage("drawing the body"):
                write_check_video(self.check, self.video, found)
            wrote(self.check, "the body over the video")
        kept.unlink(missing_ok=True)
        suggest("humangs animate", self.avatar or Path("avatar.npz"), "--motion", self.out)
