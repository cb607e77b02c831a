"""Reads and writes motions: one pose of the body per frame.

`load_motion` reads any format of the table `data.formats.MOTIONS`. A motion in memory
(`body.motion.Motion`) has axis-angles in radians; lengths are in metres, and y is up. It has
SMPL-X's 55 joints. Only files of this package can hold motions of other bodies, with other joints.
`arrays` reads files of arrays by key. `clips` reads skeletons of other programs, and `skeleton`
converts them to our joints. `face_files` reads faces. `rules` has the tables that all readers and
the page share.
"""

import logging
from collections.abc import Callable
from importlib import resources
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from humangs_jax.body.motion import Motion, turned_upright
from humangs_jax.core.array_types import Array, Float
from humangs_jax.core.arrays import from_host
from humangs_jax.core.checks import checked_arguments
from humangs_jax.core.registry import alternatives
from humangs_jax.data.capture_checks import LARGEST_DISTANCE, LARGEST_TURN
from humangs_jax.data.formats import MOTIONS, MotionFormat
from humangs_jax.geometry.axes import UPRIGHT, standing_axis
from humangs_jax.io.arrays import read_npz, write_npz
from humangs_jax.io.reading import FileError, check_limit, open_file, reading
from humangs_jax.motion import rules, skeleton
from humangs_jax.motion.face_tracks import FaceTrack, checked_track

__all__ = ["Motion", "MotionError", "load_motion", "save_motion"]


logger = logging.getLogger(__name__)
_MADE_FROM = "made_from"
"""Key of the text that says what a motion was made from."""
OTHERS = {
    **dict.fromkeys(
        (".mp4", ".mov", ".m4v", ".avi", ".mkv", ".webm", ".gif"),
        ", a video: `humangs motion` finds the motion of the person in it (docs/motions.md)",
    ),
    ".fbx": ": open it in Blender and export a .bvh or .glb",
    ".gltf": ": export it as .glb, which holds all of its numbers",
    ".c3d": (
        ", markers without a skeleton: solve them with the program that recorded them, and export a"
        " .bvh"
    ),
}
"""What the error about a file that cannot be read adds, by the file's suffix."""


class MotionError(FileError):
    """An error about a motion file. Its message is one line with the file, the problem, and the key
    if a key is wrong.
    """


class Reading(NamedTuple):
    """The arguments of `load_motion` that readers need."""

    fps: float | None = None
    """Frames per second, in place of the rate in the file. None: the file's rate."""
    person: int | None = None
    """Number of the person, in a file of several people. None: the only person."""
    clip: str | None = None
    """Name or number of the animation of a GLB file; None: the first."""


class Poses(NamedTuple):
    """Poses and their rate as a reader returns them, in the world of the file."""

    rotations: Float[np.ndarray, "m j 3"]
    """Rotation vectors of the joints, (m, j, 3), radians. j is 55, except in files of this package
    for other bodies.
    """
    translations: Float[np.ndarray, "m 3"]
    """Translations of the body, (m, 3), metres."""
    fps: float
    """Frames per second."""
    up: str = "y"
    """Axis of the file's world that points up, such as "y" or "-z"."""
    fixed: bool = False
    """Whether `up` is certain. If so, the poses are not examined to find the axis, see
    `rules.up_axis`.
    """
    also: tuple[str, ...] = ()
    """Further axes that are up in some files of the format, see `rules.up_axis`."""
    frames: np.ndarray | None = None
    """Numbers of the frames, (m,). `load_motion` fills the gaps between them. None: there are no
    gaps.
    """
    note: str = ""
    """Note for the user about the file, "" if there is none."""
    face: FaceTrack | None = None
    """The face track of the file, None without one."""


@checked_arguments
def load_motion(
    path: str | Path | None = None,
    *,
    up: str = "auto",
    fps: float | int | None = None,
    person: int | None = None,
    clip: str | int | None = None,
    rest_joints: Float[Array, "j 3"] | Float[np.ndarray, "j 3"] | None = None,
) -> Motion:
    """Reads a motion; suffix and content of the file decide the format (docs/motions.md).

    Args:
        path: None for the shipped walk; else a file or a folder of one of `data.formats.MOTIONS`.
        up: axis that points up in the file's world ("y", "-y", "z" and so on). The motion is
            turned so that y points up. "auto": the axis that is usual in the format. If the motion
            shows that people stand along another axis (`rules.up_axis`), this axis is taken, and a
            warning names it.
        fps: frames per second, in place of the rate in the file.
        rest_joints: joints of the body that will move, in T-pose, (j, 3), metres, such as
            `avatar.rest_joints`. Skeletons of other programs are converted to this body. A motion
            with another number of joints raises an error. None: skeletons are converted to the
            shipped body, and the number of joints is not checked.
        person: the number of the person, in a file of several people: as in the file, or counted
            from 0 if the file has no numbers. None: the only person.
        clip: the name of the animation, or its number from 0, in a GLB file of several. None: the
            first.

    Returns:
        Rotations, translations and frames per second, and expressions if the file has a face.

    Raises:
        MotionError: if the file cannot be read, or if a value in it or an argument is wrong. One
            line that names the file, and the key if a key is wrong.
        ValueError: for an unknown `up`.

    Examples:
        >>> motion = hg.load_motion("dance.bvh", rest_joints=avatar.rest_joints)
    """
    if up not in ("auto", *UPRIGHT):
        raise ValueError(f"up: expected auto, {', '.join(UPRIGHT)}, got {up!r}")
    # the walk that comes with the package
    if path is None:
        with resources.as_file(resources.files("humangs_jax") / "assets" / "walk.npz") as file:
            return load_motion(file, up=up, fps=fps, rest_joints=rest_joints)
    if fps is not None and not (np.isfinite(fps) and fps > 0):
        raise MotionError(
            path, "fps", f"expected a positive number of frames per second, got {fps}"
        )
    with reading(path, "motion", MotionError):
        rate = None if fps is None else float(fps)
        options = Reading(rate, person, None if clip is None else str(clip))
        return _load(Path(path), up, options, rest_joints)


def _load(path: Path, up: str, options: Reading, rest_joints: np.ndarray | Array | None) -> Motion:
    """Reads and checks the motion of a file. Raises: MotionError; InvalidFileError; further errors
    of the readers.
    """
    read = _reader(path)

    def body():
        """Returns the joints of the body that will move, (j, 3). Without `rest_joints`, reads the
        shipped body.
        """
        if rest_joints is None:
            return skeleton.shipped_joints()
        return np.asarray(rest_joints, np.float64)

    # skeletons are brought to the body, poses are turned upright; numbers without sense are refused
    # below
    with np.errstate(all="ignore"):
        found = read(path, options)
        if isinstance(found, skeleton.Clip):
            rate = skeleton.whole_rate(found.fps)
            rotations, translations, note = skeleton.retargeted(found, body(), up)
        else:
            rate = found.fps
            if up == "auto":
                axis, note = _up_of(found, body)
            else:
                axis, note = up, ""
            rotations, translations = turned_upright(found.rotations, found.translations, axis)
    # joints, sizes and rates that a motion can have
    if rest_joints is not None and rotations.shape[1] != len(rest_joints):
        raise MotionError(
            path, "rotations", f"expected {len(rest_joints)} joints, got {rotations.shape[1]}"
        )
    # what is no float32 is infinite from here on
    with np.errstate(over="ignore"):
        rotations, translations = rotations.astype(np.float32), translations.astype(np.float32)
    if not np.isfinite(rotations).all():
        raise MotionError(path, "", "expected rotations and a skeleton of finite size")
    largest = np.abs(rotations).max()
    if largest > LARGEST_TURN:
        raise MotionError(
            path, "rotations", f"expected radians, at most {LARGEST_TURN:g}, got {largest:.4g}"
        )
    farthest = np.abs(translations).max()
    if not farthest <= LARGEST_DISTANCE:
        limit = f"at most {LARGEST_DISTANCE:g} from the origin"
        raise MotionError(path, "", f"expected metres, {limit}, got {farthest:g}")
    check_limit("frames", len(rotations), "frames")
    if options.fps is not None:
        rate = options.fps
    check_limit("rate", rate, "frames per second")
    # one frame in more than a minute and a half is no motion
    if rate < 0.01:
        raise MotionError(path, "", f"{rate:g} frames per second: expected at least 0.01")
    names, faces = (), None
    if found.face is not None:
        names, values = checked_track(found.face, len(rotations))
        faces = from_host(values)
    motion = Motion(from_host(rotations), from_host(translations), rate, faces, names)
    # the warnings about the file
    if isinstance(found, Poses) and found.frames is not None:
        motion, filled = _without_gaps(motion, found.frames, path)
        note = "; ".join(filter(None, (note, filled)))
    note = "; ".join(filter(None, (found.note, note)))
    if note:
        logger.warning("%s: %s", path, note)
    return motion


def _without_gaps(motion: Motion, frames: np.ndarray, path: Path) -> tuple[Motion, str]:
    """Fills frames in which nobody was seen, by interpolation between the frames around them. The
    motion stays as it is if the steps between numbers of frames are not multiples of the smallest
    step.

    frames: number of each frame of the motion, (m,). Returns: the motion, and a note about filled
    frames, "" if none was filled.

    Raises: MotionError if the numbers of the frames do not increase or are not finite;
    InvalidFileError for more frames than the limit.
    """
    steps = np.diff(np.asarray(frames, float))
    if not len(steps):
        return motion, ""
    if not (np.isfinite(steps).all() and (steps > 0).all()):
        raise MotionError(path, "frames", "expected increasing numbers of frames")
    step = float(steps.min())
    count = float(steps.sum()) / step + 1
    if count <= len(frames) + 0.5 or (steps % step > 1e-6).any():
        return motion, ""
    check_limit("frames", count, "frames")
    every = np.arange(round(count))
    motion = motion._at(np.interp(every, np.cumsum([0, *steps]) / step, np.arange(len(frames))))
    missing = f"{len(every) - len(frames)} of {len(every)} frames"
    return motion, f"the file lacks {missing}: filled in between"


def _reader(path: Path) -> MotionFormat:
    """Returns the format of a file, by its suffix or, for archives of arrays, by its content.

    Raises: MotionError if there is no such file, or if its format is unknown; OSError, FileError or
    InvalidFileError if it cannot be read.
    """
    if not path.exists():
        raise MotionError(path, "", "no such file")
    found = MOTIONS.recognized(path)
    if found is None and path.is_file() and not MOTIONS.of(path):
        with open_file(path) as file:
            found = None
            if file.read(2) == b"PK":
                found = MOTIONS["humangs"]
    if found is None:
        got = path.suffix or "no suffix"
        hint = OTHERS.get(path.suffix.lower(), "")
        raise MotionError(
            path,
            "",
            f"no motion: expected a file {alternatives(MOTIONS.suffixes)}, got {got}{hint}",
        )
    return found


def _up_of(poses: Poses, body: Callable[[], np.ndarray]) -> tuple[str, str]:
    """Returns the axis that is up in the world of poses, and a note, see `rules.up_axis`.

    body: function that returns the joints of the body at rest, (j, 3).
    """
    rotations, translations, usual = poses.rotations, poses.translations, poses.up
    stands = None
    if not poses.fixed:
        stands = standing_axis(rotations[:, 0])
    if stands is None or stands == usual:
        return usual, ""
    joints = body()
    if len(joints) != rotations.shape[1]:  # refused later
        return usual, ""
    chosen = rules.sampled_frames(len(rotations))
    points = rules.joint_places(joints, rotations[chosen], translations[chosen])
    return rules.up_axis(points, stands, usual, poses.fps, poses.also)


def save_motion(path: str | Path, motion: Motion, *, made_from: str | None = None) -> None:
    """Writes a motion as a compressed npz file in the package's format. If writing fails, the path
    stays as it was.

    made_from: what the motion was made from; `made_from_of` returns it. Raises: OSError.
    """
    arrays: dict[str, Any] = {
        "rotations": motion.rotations,
        "translations": motion.translations,
        "fps": motion.fps,
    }
    if made_from is not None:
        arrays[_MADE_FROM] = made_from
    if motion.expressions is not None:
        arrays["expressions"] = motion.expressions
        arrays["expression_names"] = np.asarray(motion.expression_names)
    write_npz(path, arrays)


def made_from_of(path: Path) -> str | None:
    """Returns what a motion was made from, as `save_motion` recorded it. None if the file has no
    such record or cannot be read.
    """
    try:
        arrays, _ = read_npz(path)
    except (ValueError, OSError):
        return None
    if _MADE_FROM in arrays:
        return str(arrays[_MADE_FROM])
    return None
