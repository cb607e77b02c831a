"""Reads expressions from tables of ARKit's shapes, scores of MediaPipe, and animations.

Tables come from Live Link Face, and animations from GLB and VRMA files. Tables and scores have no
body: the person stands with the arms down. The head turns if a table has its rotations.

A table (.csv) has a line of names, then a line of numbers for each frame. Columns may be in any
order; names are compared without case ("EyeBlinkLeft", "eyeBlinkLeft", "eyeBlink_L"). `HeadYaw`,
`HeadPitch`, `HeadRoll` are radians. `Timecode` is HH:MM:SS:FF, with or without parts of a frame.
"""

import csv
import io
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from humangs_jax.body.joints import DEFAULT_FPS, JOINT_NAMES
from humangs_jax.core.array_types import Float
from humangs_jax.io.mesh import read_accessor
from humangs_jax.io.reading import (
    InvalidFileError,
    check_limit,
    check_unpacked,
    read_json,
    read_text,
    reading,
    shown,
)
from humangs_jax.motion import MotionError, Poses, Reading
from humangs_jax.motion.face_tracks import (
    ARKIT,
    FaceTrack,
    arkit_name,
    as_arkit,
    checked_track,
    clipped,
)
from humangs_jax.motion.rules import NO_RATE, frame_times

_ARMS_DOWN = 1.15
"""Angle by which the arms hang down, radians, for a person with a face and no motion."""
_FEWEST = 5
"""Least number of ARKit's shapes in a table, or in the scores of a frame."""
_MOST_COLUMNS = 1000
"""Largest number of columns of a table, of expressions, of meshes with weights, or of values in
which scores are looked for.
"""
_DEEPEST = 5
"""Largest depth at which the scores of a frame may lie inside of objects and lists."""


# Tables
# --------------------------------------------------------------------------------------------------


def read_table(path: Path, options: Reading) -> Poses:
    """Reads a face from a table.

    Raises: FileNotFoundError; FileError if the file cannot be read as text; InvalidFileError if its
    content is wrong. For a value that is no number, the error names the line and the column.
    """
    # the line of names tells which columns are shapes
    rows = csv.reader(io.StringIO(read_text(path)))
    try:
        lines = [row for row in rows if any(word.strip() for word in row)]
    except csv.Error as error:
        raise InvalidFileError(f"line {rows.line_num}: {error}") from None
    names = []
    if lines:
        names = [name.strip() for name in lines[0]]
    shapes = {arkit_name(name): i for i, name in reversed(list(enumerate(names)))}
    shapes.pop(None, None)
    if len(shapes) < _FEWEST or len(names) > _MOST_COLUMNS:
        raise InvalidFileError(
            "expected a line with names of ARKit's shapes such as EyeBlinkLeft, got"
            f" {', '.join(names[:4]) or 'nothing'}"
        )
    # a line for each frame; some programs repeat the names
    lines = [row for row in lines[1:] if [word.strip() for word in row] != names]
    if not lines:
        raise InvalidFileError("expected a line of numbers for each frame, got none")
    check_limit("frames", len(lines), "frames")
    plain = {re.sub(r"[^a-z]", "", name.lower()): i for i, name in enumerate(names)}

    def column(i):
        return np.asarray([_number(row, i, names[i], line) for line, row in enumerate(lines)])

    values = np.zeros((len(lines), len(ARKIT)))
    for name, i in shapes.items():
        values[:, ARKIT.index(str(name))] = column(i)
    # the turn of the head about x, y and z, and the times, where the table has them
    head = np.zeros((len(lines), 3))
    for axis, name in enumerate(("headpitch", "headyaw", "headroll")):
        if name in plain:
            head[:, axis] = column(plain[name])
    codes = []
    if "timecode" in plain:
        at = plain["timecode"]
        codes = [row[at] if at < len(row) else "" for row in lines]
    fps, frames, note = _times(codes, options.fps)
    return _standing(
        values, Rotation.from_euler("YXZ", head[:, [1, 0, 2]]).as_rotvec(), fps, frames, note
    )


def _number(row: Sequence[str], index: int, name: str, line: int) -> float:
    word = row[index].strip() if index < len(row) else ""
    try:
        return float(word)
    except ValueError:
        raise InvalidFileError(
            f"line {line + 2}: {name}: expected a number, got {shown(word)}"
        ) from None


def _times(codes: Sequence[str], asked: float | None) -> tuple[float, np.ndarray | None, str]:
    """Returns three values: frames per second; the numbers of the frames, (m,), or None if the
    timecodes do not give them; and a note, "" if there is none.

    codes: the timecode of each frame. asked: the rate that the user gave, or None.
    """
    parts = [re.fullmatch(r"\s*(\d+):(\d+):(\d+)[:;.](\d+(?:\.\d+)?)\s*", code) for code in codes]
    if not parts or any(part is None for part in parts):
        note = NO_RATE.format(DEFAULT_FPS) + ", which --motion-fps (in Python fps=) changes"
        if asked is None:
            return DEFAULT_FPS, None, note
        return asked, None, ""
    clock = np.asarray([[float(x) for x in part.groups()] for part in parts if part is not None])
    seconds, within = clock[:, :3] @ (3600.0, 60.0, 1.0), clock[:, 3]
    # the last number of a timecode stays below the rate; short ones do not tell: Live Link's
    rates = (24.0, 25.0, 30.0, 50.0, 60.0)
    fitting = [rate for rate in rates if rate > np.floor(within.max())]
    rate = 60.0
    if np.ptp(seconds) >= 2 and fitting:
        rate = fitting[0]
    numbers = np.rint(seconds * rate + within)
    steps = np.diff(numbers)
    if not len(steps) or not (steps > 0).all():
        if asked is None:
            asked = rate
        return asked, None, ""
    if asked is None:
        asked = rate / float(steps.min())
    return asked, numbers, ""


def _standing(
    values: Float[np.ndarray, "m e"],
    head: Float[np.ndarray, "m 3"],
    fps: float,
    frames: np.ndarray | None = None,
    note: str = "",
) -> Poses:
    """Returns poses of a person with this face, who stands with the arms down.

    values: coefficients of ARKit's shapes, (m, 52). head: rotations of the head, (m, 3),
    axis-angle, radians.

    Raises: InvalidFileError if a number is not finite.
    """
    track = FaceTrack(ARKIT, clipped(values))
    checked_track(track, len(values))
    if not np.isfinite(head).all():
        raise InvalidFileError("head: expected finite numbers")
    rotations = np.zeros((len(values), len(JOINT_NAMES), 3))
    rotations[:, JOINT_NAMES.index("left_shoulder"), 2] = -_ARMS_DOWN
    rotations[:, JOINT_NAMES.index("right_shoulder"), 2] = _ARMS_DOWN
    rotations[:, JOINT_NAMES.index("head")] = head
    return Poses(
        rotations, np.zeros((len(values), 3)), fps, fixed=True, frames=frames, note=note, face=track
    )


# Scores of MediaPipe
# --------------------------------------------------------------------------------------------------


def has_scores(path: Path) -> bool:
    """Returns whether a JSON file has scores of a face. At least one of them has to be a number.
    `read_scores` raises an error if others are no numbers.

    Raises: FileNotFoundError; FileError if the file cannot be read or is not JSON.
    """
    return _frames_of(read_json(path)) is not None


def read_scores(path: Path, options: Reading) -> Poses:
    """Reads a face from a JSON file of scores. Raises: MotionError."""
    with reading(path, "scores of a face", MotionError):
        content = read_json(path)
        frames = _frames_of(content)
        if frames is None:
            raise InvalidFileError("expected a list of frames with scores of ARKit's shapes")
        check_limit("frames", len(frames), "frames")
        seen = [i for i, frame in enumerate(frames) if frame]
        known = np.zeros((len(seen), len(ARKIT)))
        for row, i in enumerate(seen):
            for name, score in frames[i].items():
                known[row, ARKIT.index(name)] = _number_of(name, score)
        # frames in which nobody was seen lie between the others
        every = np.arange(seen[0], seen[-1] + 1)
        values = np.stack([np.interp(every, seen, column) for column in known.T], axis=1)
        fps, note = options.fps, ""
        given = None
        if isinstance(content, dict):
            given = content.get("fps")
        if fps is None and isinstance(given, int | float) and 0 < given < 1e6:
            fps = float(given)
        if fps is None:
            fps, note = DEFAULT_FPS, NO_RATE.format(DEFAULT_FPS)
        return _standing(values, np.zeros((len(values), 3)), fps, None, note)


def _frames_of(content: Any) -> list[dict[str, Any]] | None:
    """Returns the scores of each frame by name, empty where nobody was seen. See `_scores_of`.

    None: the content has no scores.
    """
    if isinstance(content, dict):
        lists = [value for value in content.values() if isinstance(value, list)]
        read = [_frames_of(value) for value in lists]
        found = [frames for frames in read if frames is not None]
        return found[0] if found else None
    if not isinstance(content, list):
        return None
    frames = [_scores_of(each, 0) for each in content]
    return frames if any(frames) else None


def _scores_of(frame: Any, depth: int) -> dict[str, Any]:
    """Returns the scores of one frame by ARKit's names, with values as in the file; empty if there
    are no scores.

    The scores may be an object of numbers by name or a list of categories, at most `_DEEPEST`
    levels down. At least `_FEWEST` shapes must have a value. At least one value must be a number,
    because other files have texts or lists under these names.
    """
    if depth > _DEEPEST:
        return {}
    # an object of scores, a list of categories, or either further inside
    if isinstance(frame, dict):
        named = {arkit_name(str(name)): value for name, value in frame.items()}
        inner = list(frame.values())
    elif isinstance(frame, list):
        named = {}
        for each in frame:
            if isinstance(each, dict) and "score" in each:
                keys = ("categoryName", "category_name", "displayName", "display_name", "name")
                name = next((str(each[key]) for key in keys if each.get(key)), "")
                named[arkit_name(name)] = each["score"]
        inner = frame
    else:
        return {}
    named.pop(None, None)
    if len(named) >= _FEWEST and any(map(_is_number, named.values())):
        return {str(name): value for name, value in named.items()}
    for each in inner[:_MOST_COLUMNS]:
        found = _scores_of(each, depth + 1)
        if found:
            return found
    return {}


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _number_of(name: str, score: Any) -> float:
    if not _is_number(score):
        raise InvalidFileError(f"{name}: expected a number, got {shown(score)}")
    return float(score)


# Animations
# --------------------------------------------------------------------------------------------------


def animated_face(
    content: dict[str, Any],
    binary: bytes,
    animation: Mapping[str, Any],
    times: Float[np.ndarray, " m"],
) -> tuple[FaceTrack | None, str]:
    """Returns the expressions of a GLB or VRMA file's animation as ARKit's shapes, and a note.

    The note lists expressions that are neither ARKit's shapes nor presets, "" if there are none.
    The face is None if the animation has no expressions, or none that is known. times: times of the
    frames, (m,), seconds.

    Raises: InvalidFileError if the animation's numbers are wrong, or if there are too many
    expressions.
    """
    tracks = _expression_tracks(content, binary, animation) or _weight_tracks(
        content, binary, animation
    )
    if not tracks:
        return None, ""
    names = tuple(tracks)
    check_unpacked(len(binary), 8 * len(times) * len(names))
    values = np.stack(
        [np.interp(times, keys, weights) for keys, weights in tracks.values()], axis=1
    )
    if not np.isfinite(values).all():
        raise InvalidFileError("animation: expected finite weights of shapes")
    track, unknown = as_arkit(FaceTrack(names, values))
    if not unknown:
        return track, ""
    listed = ", ".join(unknown[:6]) + (", ..." if len(unknown) > 6 else "")
    return track, f"{len(unknown)} shapes are none of ARKit's and left out ({listed})"


Weights = dict[str, tuple[np.ndarray, np.ndarray]]
"""For each name of a shape, increasing times in seconds (k,) and the weights at them (k,)."""


def _keys_of(
    content: dict[str, Any], binary: bytes, animation: Mapping[str, Any], channel: Mapping[str, Any]
) -> tuple[np.ndarray, np.ndarray]:
    """Reads the times (k,), seconds, and the values (k, c) of a channel.

    Raises: InvalidFileError if times do not increase, or if there is not one row of values for each
    time.
    """
    sampler = animation["samplers"][channel["sampler"]]
    times = read_accessor(content, binary, sampler["input"])[:, 0]
    values = read_accessor(content, binary, sampler["output"])
    if not len(times) or not (np.diff(times) > 0).all() or values.size % len(times):
        raise InvalidFileError(
            "animation: expected one row of weights for each of increasing times"
        )
    if sampler.get("interpolation") == "CUBICSPLINE":
        if values.size % (3 * len(times)):
            raise InvalidFileError("animation: expected tangents beside each row of weights")
        values = values.reshape(len(times), 3, -1)[:, 1]  # between the tangents
    return times, values.reshape(len(times), -1)


def _expression_tracks(
    content: dict[str, Any], binary: bytes, animation: Mapping[str, Any]
) -> Weights:
    """Reads the weights of expressions in a VRMA file. The weight is the x of the translation of
    the expression's node.

    Raises: InvalidFileError if there are too many expressions, or if their numbers are wrong.
    """
    extension = (content.get("extensions") or {}).get("VRMC_vrm_animation", {})
    expressions = {}
    if isinstance(extension, dict):
        expressions = extension.get("expressions", {})
    nodes = {
        entry["node"]: str(name)
        for group in ("preset", "custom")
        for name, entry in (expressions.get(group) or {}).items()
        if isinstance(entry, dict) and type(entry.get("node")) is int
    }
    if len(nodes) > _MOST_COLUMNS:
        raise InvalidFileError(f"{len(nodes)} expressions: expected at most {_MOST_COLUMNS}")
    tracks = {}
    for channel in animation["channels"]:
        name = nodes.get(channel["target"].get("node"))
        if name is None or name in tracks:
            continue
        if channel["target"]["path"] == "translation":
            times, values = _keys_of(content, binary, animation, channel)
            tracks[name] = times, values[:, 0]
    return tracks


def _weight_tracks(content: dict[str, Any], binary: bytes, animation: Mapping[str, Any]) -> Weights:
    """Reads the weights of a mesh's morph targets in a GLB file, by the targets' names.

    The mesh is the one with most names of ARKit's shapes.

    Raises: InvalidFileError if too many meshes have weights, or if the numbers are wrong.
    """
    found: list[Weights] = []
    channels = [each for each in animation["channels"] if each["target"]["path"] == "weights"]
    if len(channels) > _MOST_COLUMNS:
        raise InvalidFileError(
            f"{len(channels)} meshes with weights: expected at most {_MOST_COLUMNS}"
        )
    for channel in channels:
        node = content["nodes"][channel["target"]["node"]]
        mesh = content["meshes"][node["mesh"]]
        times, values = _keys_of(content, binary, animation, channel)
        names = _target_names(mesh, values.shape[1])
        found.append({name: (times, values[:, i]) for i, name in enumerate(names)})

    def known(tracks):
        return sum(arkit_name(name) is not None for name in tracks)

    return max(found, key=known, default={})


def _target_names(mesh: Mapping[str, Any], count: int) -> list[str]:
    """Returns the names of a mesh's morph targets. If the file does not have `count` names, returns
    their numbers.
    """
    places = [mesh, *mesh.get("primitives", [])]
    for place in places:
        names = (place.get("extras") or {}).get("targetNames")
        if isinstance(names, list) and len(names) == count:
            return [str(name) for name in names]
    return [str(i) for i in range(count)]


def face_alone(
    content: dict[str, Any], binary: bytes, animation: Mapping[str, Any], note: str
) -> Poses | None:
    """Reads an animation that moves a face and turns no node. Returns None for any other animation,
    for tracks without increasing times, and for tracks that `frame_times` cannot bring to one rate.
    note: text to which the note about the face is added.

    Raises: InvalidFileError if the weights are wrong.
    """
    if any(channel["target"]["path"] == "rotation" for channel in animation["channels"]):
        return None
    inputs = [
        read_accessor(content, binary, animation["samplers"][channel["sampler"]]["input"])[:, 0]
        for channel in animation["channels"]
    ]
    for keys in inputs:
        if not len(keys) or not np.isfinite(keys).all() or not (np.diff(keys) > 0).all():
            return None
    found = frame_times(inputs) if inputs else None
    if found is None:
        return None
    times, fps = found
    track, unknown = animated_face(content, binary, animation, times)
    if track is None:
        return None
    note = "; ".join(filter(None, (note, unknown)))
    return _standing(track.values, np.zeros((len(times), 3)), fps, None, note)
