"""Which frame and which camera the images of a transforms.json belong to.

Scenes that stand still say nothing about it. Videos do: `timestep_index` and `camera_index` (GaussianAvatars, VHAP), `time`
(D-NeRF). Images of one moment are one frame; images that one camera took are different moments.
"""

from collections.abc import Hashable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from humangs_jax.data.capture_checks import CaptureError, floats

MOMENT_KEYS = ("timestep_index", "timestep", "timestep_index_original", "time", "timestamp", "time_id", "timestep_id")
CAMERA_KEYS = ("camera_index", "camera_id", "cam_id", "camera_label")
SAME_TIME = 1e-6
"""Times that differ by less are one moment written twice."""
SAME_POSE = 1e-9


def find_moments(frames: Sequence[Mapping[str, Any]], file: Path) -> tuple[list[int], int | None]:
    """The frame of each image, counted from 0 in the order of time, and how many cameras there are (None: one for each image).

    Raises: CaptureError naming the key, for a value in some images only, for what is no time, for two images of one camera and
    one moment, and for several images of a camera where nothing tells which were taken together.
    """
    moments, cameras = _values(frames, MOMENT_KEYS, file), _values(frames, CAMERA_KEYS, file)
    key, times = moments if moments is not None else ("", None)
    owner, owners = cameras if cameras is not None else ("", _numbered([_pose_of(frame) for frame in frames]))
    count = len(set(owners))
    if times is None:
        if count == len(frames):
            return [0] * len(frames), None
        if count > 1:
            _refuse_unknown_moments(owner, owners, file)
        return list(range(len(frames))), 1
    ranks = _ranks(times, key, file)
    if cameras is not None:
        _check_taken_once(owner, owners, key, ranks, file)
    return ranks, count if cameras is not None or count < len(frames) else None


def _values(frames, keys, file):
    """The first key that an image has, and its value in all of them; None if there is none."""
    key = next((key for key in keys if any(key in frame for frame in frames)), None)
    if key is None:
        return None
    values = []
    for i, frame in enumerate(frames):
        value = frame.get(key)
        if key not in frame:
            raise CaptureError(file, f"frames[{i}].{key}", "missing, but other frames have it: expected all or none")
        if isinstance(value, bool) or not isinstance(value, str | int | float):
            raise CaptureError(file, f"frames[{i}].{key}", f"expected a number or a name, got {value!r}")
        if not isinstance(value, str):
            value = float(floats(value, file, f"frames[{i}].{key}", ()))
        values.append(value)
    return key, values


def _ranks(times, key, file):
    if len({isinstance(time, str) for time in times}) > 1:
        raise CaptureError(file, key, "expected numbers or names, got both")
    known = sorted(set(times))
    if not isinstance(known[0], str):
        gaps = np.diff(known, prepend=-np.inf) > SAME_TIME * max(1.0, abs(known[-1]))
        rank = dict(zip(known, (np.cumsum(gaps) - 1).tolist(), strict=True))
    else:
        rank = {time: i for i, time in enumerate(known)}
    return [rank[time] for time in times]


def _pose_of(frame):
    """What tells cameras apart that have no name."""
    try:
        return tuple(np.round(np.asarray(frame["transform_matrix"], float).ravel() / SAME_POSE).tolist())
    except (KeyError, TypeError, ValueError, OverflowError):
        return object()  # said when the matrix is read


def _numbered(things: Sequence[Hashable]) -> list[int]:
    number = {thing: i for i, thing in enumerate(dict.fromkeys(things))}
    return [number[thing] for thing in things]


def _refuse_unknown_moments(owner, owners, file):
    first = next(value for i, value in enumerate(owners) if value in owners[:i])
    rows = [i for i, value in enumerate(owners) if value == first]
    same = f"the {owner} {first:g}" if isinstance(first, float) else f"the {owner} {first}"
    which = same if owner else "the same camera pose"
    problem = f"frames[{rows[0]}] and frames[{rows[1]}] have {which}, so they show different moments"
    raise CaptureError(
        file, "frames", f"{problem}: expected timestep_index or time in each frame to tell which are of one"
    )


def _check_taken_once(owner, owners, key, ranks, file):
    seen: dict[tuple, int] = {}
    for i, taken in enumerate(zip(owners, ranks, strict=True)):
        if (other := seen.setdefault(taken, i)) != i:
            problem = f"the {owner} and {key} of frames[{other}]: expected one photo of a camera at a moment"
            raise CaptureError(file, f"frames[{i}]", problem)
