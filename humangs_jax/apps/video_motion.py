"""Finds the motion of a person in a video whose camera stands still.

The person is followed through all frames. Once the person is found in a frame, only the landmark
network looks at the next frame. While the work goes on, the landmarks are kept in a file beside the
result, so that an interrupted run can go on. Then one fit uses all frames
(`capture.fitting.motion_fit`).
"""

import dataclasses
import itertools
import logging
import time
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from scipy.ndimage import gaussian_filter1d

from humangs_jax.apps.check import body_image, overlay, side_tints
from humangs_jax.avatar.avatar import Avatar
from humangs_jax.avatar.video import write_video
from humangs_jax.body.library import load_body
from humangs_jax.body.model import BodyModel, person_vertices
from humangs_jax.body.motion import Motion
from humangs_jax.capture.calibration.videos import color_frames, frame_rate, frame_times
from humangs_jax.capture.detection.face_and_hands import SHAPE_NAMES, FaceAndHands, hand_columns
from humangs_jax.capture.detection.people import (
    BELIEVED,
    Detection,
    Landmarks,
    Networks,
    find_people,
)
from humangs_jax.capture.fitting.motion_fit import MotionFit, betas_of_joints, fit_motion
from humangs_jax.capture.fitting.person_moments import USUAL_FOCAL
from humangs_jax.capture.keypoints.formats import SeenPerson, columns_of
from humangs_jax.capture.keypoints.keypoints import MEDIAPIPE_69, Keypoints
from humangs_jax.core.array_types import Float, UInt
from humangs_jax.core.checks import checked_arguments
from humangs_jax.core.configuration import ArgumentError
from humangs_jax.core.progress import bar
from humangs_jax.core.pytree import replace
from humangs_jax.data.capture_checks import CaptureError
from humangs_jax.geometry.camera import Camera
from humangs_jax.io.arrays import checksum, read_npz, write_npz
from humangs_jax.io.images import DIAGONAL_35MM
from humangs_jax.io.reading import InvalidFileError, check_limit, reading
from humangs_jax.motion import made_from_of, save_motion

logger = logging.getLogger(__name__)
LONGER_SIDE = 1920
"""Frames whose longer side exceeds this are reduced to it, pixels."""


@dataclasses.dataclass(frozen=True)
class _Following:
    """How one person is followed from frame to frame."""

    patience: int = 8
    """Once the person is lost, this number of frames is searched, one after the other. A search
    takes ten times as long as following the person from the frame before.
    """
    rarely: int = 8
    """After `patience` frames without the person, only one of this many frames is searched."""
    farthest: float = 0.6
    """Largest movement of the hips between two frames, as a share of the crop's side. Twice as much
    is allowed if the frame is searched.
    """
    change: float = 1.6
    """Largest factor by which the crop's side changes between two frames."""
    alike: float = 0.6
    """If a second person's crop has at least this share of the largest crop's side, a warning says
    which of them is followed.
    """


_FOLLOWING = _Following()


_NO_FACE = np.full(len(SHAPE_NAMES), np.nan, np.float32)
_FACE_SECONDS, _LEAST_FACES = 0.025, 0.1
"""Two values. Standard deviation of the filter that smooths faces, seconds; a blink takes a tenth
of a second. Least share of frames that have to show a face.
"""
_TALLEST, _SMALLEST = 2.5, 0.4
"""Largest and smallest height of a person that is accepted, metres."""


class VideoFit(NamedTuple):
    """The motion in a video, and what is needed to draw it over the video."""

    fit: MotionFit
    """The person's shape and poses, and the camera."""
    body: BodyModel
    """The body that was fitted."""
    K: Float[np.ndarray, "3 3"]
    """Intrinsics of the camera, (3, 3), pixels of frames of `size`."""
    size: tuple[int, int]
    """Width and height of the frames that were looked at, pixels. Large frames are reduced
    before.
    """


@checked_arguments
def motion_from_video(
    video: str | Path,
    *,
    person: int | None = None,
    height: float | int | None = None,
    avatar: Avatar | None = None,
    focal_mm: float | int | None = None,
) -> Motion:
    """Finds the motion of a person in a video whose camera stands still.

    Args:
        video: the file.
        person: number of the person, from 0. People are counted from the largest to the smallest,
            in the first frame that shows more people than this number. None: the largest.
        height: height of the person, metres. It gives the motion its scale. None: the height of an
            average person.
        avatar: an avatar to which the motion is fitted. Its body takes the place of a body with the
            person's shape, and its size gives the scale.
        focal_mm: focal length of the camera, millimetres on 35-mm film. None: the focal length of a
            usual telephone.

    Returns:
        Poses in a world with y up and the floor at 0, at the rate of the video.

    Raises:
        FileError: if the video cannot be read. The message names it.
        ValueError: if nobody is found, LiteRT is not installed, or an argument is wrong.

    Examples:
        >>> motion = hg.motion_from_video("dance.mp4", height=1.72)
    """
    joints = None
    if avatar is not None:
        joints = np.asarray(avatar.rest_joints)
    found = fit_video(
        Path(video), person=person, height=height, rest_joints=joints, focal_mm=focal_mm
    )
    return found.fit.motion


def fit_video(
    video: Path,
    *,
    person: int | None = None,
    height: float | int | None = None,
    rest_joints: Float[np.ndarray, "j 3"] | None = None,
    focal_mm: float | int | None = None,
    kept: Path | None = None,
) -> VideoFit:
    """Finds the motion as `motion_from_video` does, and returns what is needed to draw it, too.

    Arguments: rest_joints: joints of the avatar at rest, (j, 3), metres. kept: file in which
    landmarks are kept while the work goes on, so that an interrupted run can go on; None: no file.
    Raises: as `motion_from_video`. Also FileError if `kept` is a file of another kind, OSError if
    it cannot be written.
    """
    if height is not None and not _SMALLEST <= height <= _TALLEST:
        raise ArgumentError("height", f"{height:g}: expected metres, {_SMALLEST:g} to {_TALLEST:g}")
    if height is not None and rest_joints is not None:
        raise ArgumentError("height", f"{height:g}: expected no avatar with it, which has a height")
    if focal_mm is not None and not 5 <= focal_mm <= 2000:
        raise ArgumentError("focal_mm", f"{focal_mm:g}: expected millimetres, 5 to 2000")
    if person is not None and person < 0:
        raise ArgumentError("person", f"{person}: expected a number from 0")
    # what the camera saw, with the lens as it is given or usual
    rate, count = rate_and_count(video)
    body = load_body()
    betas = None
    if rest_joints is not None:
        betas = betas_of_joints(body, rest_joints)
    seen, size = look_at_video(video, count, person, kept)
    K = np.eye(3)
    K[0, 0] = K[1, 1] = float(focal_mm or USUAL_FOCAL) / DIAGONAL_35MM * np.hypot(*size)
    K[:2, 2] = np.asarray(size) / 2
    keypoints = Keypoints(seen["points"], seen["confidences"], MEDIAPIPE_69, world=seen["world"])
    lost = int((seen["confidences"].max(1) == 0).sum())
    if lost:
        logger.warning(
            "%s: the person is not found in %d of %d frames, which are interpolated",
            video,
            lost,
            count,
        )

    def watch(stages, total):
        return bar(stages, desc="fitting the motion", unit="stage")

    fit = fit_motion(body, keypoints, K, rate, betas=betas, height=height, watch=watch)
    faces = smooth_faces(seen["face"], rate)
    if faces is not None:
        motion = replace(fit.motion, expressions=jnp.asarray(faces), expression_names=SHAPE_NAMES)
        fit = dataclasses.replace(fit, motion=motion)
    return VideoFit(fit, body, K, size)


def smooth_faces(
    faces: Float[np.ndarray, "m e"], rate: float | int
) -> Float[np.ndarray, "m e"] | None:
    """Smooths the scores of a face over time, (m, e), 0 to 1. Frames without a face, NaN, are
    interpolated. Returns None if less than a tenth of the frames show a face. rate: frames per
    second.
    """
    known = np.flatnonzero(np.isfinite(faces).all(1))
    if len(known) < _LEAST_FACES * len(faces):
        return None
    frames = np.arange(len(faces))
    filled = np.stack([np.interp(frames, known, column[known]) for column in faces.T], axis=1)
    smooth = gaussian_filter1d(filled, max(_FACE_SECONDS * rate, 1e-3), axis=0, mode="nearest")
    return smooth.clip(0, 1).astype(np.float32)


def rate_and_count(video: Path) -> tuple[float, int]:
    """Returns the mean number of frames per second, and the number of frames.

    Raises: FileError that names the video.
    """
    times = frame_times(video)
    count = len(times)
    with reading(video, "video", CaptureError):
        check_limit("frames", count, "frames")
        if count < 2:
            raise InvalidFileError("one frame: expected a video in which somebody moves")
    seconds = times[-1] - times[0]
    if np.isfinite(seconds) and seconds > 0:
        rate = (count - 1) / seconds
    else:
        rate = frame_rate(video)
    if rate is None:
        raise CaptureError(video, "", "says no times of its frames: expected a video with a rate")
    return float(rate), count


# Following
# --------------------------------------------------------------------------------------------------


def look_at_video(
    video: Path, count: int, person: int | None, kept: Path | None
) -> tuple[dict[str, np.ndarray], tuple[int, int]]:
    """Looks for a person in each frame. Returns arrays by name, with a row per frame, and the width
    and height of the frames, pixels.

    The arrays `points`, `confidences` and `world` are as in `Keypoints`. `again` has the points of
    hips and head around which the next frame is cut, (m, 2, 2), pixels. `face` has the scores of
    the face.

    Arguments: count: number of frames, for the progress bar. person: number of the person; None:
    the largest. kept: file for landmarks, see `fit_video`.
    Raises: ValueError if nobody is found, or LiteRT is not installed. Also FileError if `kept` is a
    file of another kind, OSError if it cannot be written.
    """
    about = made_from(video, person=person, side=LONGER_SIDE)
    rows, last = _earlier(kept, about), None
    if rows:
        logger.info("%s: %d frames were looked at before", video, len(rows))
        if rows[-1]["confidences"].any():
            hips, head = rows[-1]["again"]
            last = Detection(1.0, hips, head)
    frames = iter(color_frames(video, LONGER_SIDE, None))
    size = (0, 0)
    for frame in itertools.islice(frames, len(rows)):
        size = frame.shape[1::-1]
    shown = bar(frames, desc="following the person", unit="frame", total=count, initial=len(rows))
    saved, follower, parts = time.monotonic(), _Follower(person, last), FaceAndHands()
    try:
        for frame in shown:
            size = frame.shape[1::-1]
            photo = frame.astype(np.float32) / 255
            found = follower.look(photo)
            rows.append(_row(photo, found, parts))
            # what was seen is kept every 15 seconds
            if kept is not None and time.monotonic() - saved > 15.0:
                _keep(kept, about, rows)
                saved = time.monotonic()
    except BaseException:  # Ctrl-C, too: the next run goes on from here
        if kept is not None and rows:
            _keep(kept, about, rows)
        raise
    if not any(row["confidences"].any() for row in rows):
        raise ValueError(f"{video}: {follower.told()}")
    for line in follower.lines:
        logger.warning("%s: %s", video, line)
    if kept is not None:
        _keep(kept, about, rows)
    return {key: np.stack([row[key] for row in rows]) for key in rows[0]}, size


class _Follower:
    """Finds one person in frame after frame."""

    def __init__(self, person: int | None, last: Detection | None) -> None:
        try:
            self.networks = Networks()
        except ImportError as error:
            raise ValueError(str(error)) from error  # one line
        self.person, self.last = person, last
        self.most, self.missed, self.lines = 0, 0, []

    def look(self, photo: Float[np.ndarray, "h w 3"]) -> Landmarks | None:
        """Finds the person in the next frame. Returns None if nobody is found who may be the same
        person, or if the frame is not searched (see `_Following.rarely`).
        """
        found = None
        if self.last is not None and not self.missed:
            found = self.networks.landmarks(photo, self.last.crop())
            if found.presence < BELIEVED.presence or not self._same(found.again):
                found = None
        if found is None and (
            self.missed < _FOLLOWING.patience or self.missed % _FOLLOWING.rarely == 0
        ):
            found = self._searched(photo)
        self.missed = self.missed + 1 if found is None else 0
        if found is not None:
            self.last = found.again
        return found

    def _searched(self, photo: Float[np.ndarray, "h w 3"]) -> Landmarks | None:
        people = find_people(self.networks, photo)
        self.most = max(self.most, len(people))
        if self.last is None:
            number = self.person or 0
            if number >= len(people):
                return None
            alike = [p for p in people if p.crop.side >= _FOLLOWING.alike * people[0].crop.side]
            if self.person is None and len(alike) > 1:
                self.lines.append(
                    f"{len(alike)} people: the largest is followed; --person 1 is the next"
                )
            return people[number]
        near, hips = [p for p in people if self._same(p.again, patience=2.0)], self.last.hips

        def distance(each):
            return float(np.hypot(*(each.again.hips - hips)))

        return min(near, key=distance, default=None)

    def _same(self, now: Detection, patience: float = 1.0) -> bool:
        """Returns whether a detection may be the person of the last frame. patience: factor on the
        distance that is allowed.
        """
        assert self.last is not None
        before, after = self.last.crop(), now.crop()
        ratio = max(before.side, after.side) / max(min(before.side, after.side), 1e-6)
        away = float(np.hypot(*(after.center - before.center)))
        return away < patience * _FOLLOWING.farthest * before.side and ratio < _FOLLOWING.change

    def told(self) -> str:
        """Says in one line why nobody was followed."""
        if self.most:
            return f"--person {self.person}: at most {self.most} people are seen in a frame"
        return "nobody is found: expected a person who is seen as a whole"


def _row(
    photo: Float[np.ndarray, "h w 3"], found: Landmarks | None, parts: Any
) -> dict[str, np.ndarray]:
    """Returns the arrays that are kept of a frame. If nobody was found, all but `face` are 0.
    `face` is NaN without a person, or if the face is not seen or too small.
    """
    if found is None:
        shapes = {"points": (2,), "confidences": (), "world": (3,)}
        count = len(MEDIAPIPE_69.names)
        row = {key: np.zeros((count, *shape), np.float32) for key, shape in shapes.items()}
        return row | {"again": np.zeros((2, 2), np.float32), "face": _NO_FACE}
    hands = hand_columns(parts.hands(photo, found.pixels, found.visibility), found.world)
    face = parts.face(photo, found.pixels)
    points = np.column_stack([found.pixels, found.visibility])
    columns = columns_of(SeenPerson(points, found.world, found.presence, hands), hands=True)
    values = {
        "points": columns[:, :2] + 0.5,  # the centre of the networks' first pixel is at 0
        "confidences": columns[:, 2],
        "world": columns[:, 3:],
        "again": np.stack([found.again.hips, found.again.head]),
        "face": _NO_FACE if face is None else face,
    }
    return {key: np.asarray(value, np.float32) for key, value in values.items()}


def made_from(video: Path, **options: Any) -> str:
    """Returns a checksum of everything on which a result depends: the video file as it is now, and
    the options.
    """
    status = video.stat()
    known = {"name": video.name, "bytes": status.st_size, "modified": status.st_mtime_ns}
    return checksum({}, *(f"{key}={value}" for key, value in (known | options).items()))


def _keep(kept: Path, about: str, rows: list[dict[str, np.ndarray]]) -> None:
    arrays = {key: np.stack([row[key] for row in rows]) for key in rows[0]}
    write_npz(kept, {"about": about, **arrays}, compressed=False)


def _earlier(kept: Path | None, about: str) -> list[dict[str, np.ndarray]]:
    """Reads the rows of an interrupted run with the same video and person. Returns an empty list if
    there are none.

    Raises: FileError if the file is of another kind.
    """
    if kept is None or not kept.exists():
        return []
    with reading(kept, "landmarks of a video"):
        arrays, _ = read_npz(kept)
        if not {"about", "points", "again"} <= set(arrays):
            raise InvalidFileError("exists, and is not ours: expected no file of that name")
    if str(arrays.pop("about")) != about:
        return []
    return [{key: each[i] for key, each in arrays.items()} for i in range(len(arrays["points"]))]


# Results
# --------------------------------------------------------------------------------------------------


def write_check_video(out: Path, video: Path, found: VideoFit) -> int:
    """Writes the video with the body drawn over it, with a longer side of at most 720 pixels.
    Returns the number of frames. Raises: as `write_video`; FileError if the video cannot be read.
    """
    # pixels of the longer side of a check video
    frames = color_frames(video, 720, None)
    poses = found.fit.motion
    drawn = bar(
        _drawn(frames, found), desc="drawing the body", unit="frame", total=len(poses.translations)
    )
    return write_video(out, drawn, poses.fps)


def _drawn(
    frames: Iterable[UInt[np.ndarray, "h w 3"]], found: VideoFit
) -> Iterator[Float[np.ndarray, "h w 3"]]:
    import jax

    posed, tints = jax.jit(person_vertices), side_tints(found.body)
    betas, motion = jnp.asarray(found.fit.betas, jnp.float32), found.fit.motion
    for i, frame in enumerate(itertools.islice(frames, len(motion.translations))):
        height, width = frame.shape[:2]
        K = np.diag([width / found.size[0], height / found.size[1], 1.0]) @ found.K
        camera = Camera.from_opencv(K, found.fit.cam_from_world, width, height)
        vertices = posed(found.body, betas, motion.pose(i))
        image = body_image(vertices, found.body.faces, tints, camera)
        yield overlay(frame / 255.0, image).clip(0, 1)


def motion_beside(video: Path, rest_joints: Float[np.ndarray, "j 3"], person: int | None) -> Motion:
    """Returns the motion of the person in a video for the body of an avatar. The motion is kept
    beside the video as NAME.motion.npz, and read from there the next time.

    Arguments: rest_joints: joints of the avatar at rest, (j, 3), metres. person: number of the
    person; None: the largest.
    Raises: ValueError if a file of that name is not ours. Also as `motion_from_video`.
    """
    from humangs_jax.motion import load_motion

    out = video.with_name(f"{video.stem}.motion.npz")
    about = made_from(video, person=person, joints=checksum({"joints": rest_joints}))
    known = made_from_of(out) if out.exists() else about
    if known is None:
        raise ValueError(
            f"{out}: exists, and is not of this command: the motion of {video.name} belongs there:"
            " move it away"
        )
    if known != about or not out.exists():
        kept = out.with_suffix(".seen.npz")
        found = fit_video(video, person=person, rest_joints=rest_joints, kept=kept)
        save_motion(out, found.fit.motion, made_from=about)
        kept.unlink(missing_ok=True)
    return load_motion(out, rest_joints=rest_joints)
