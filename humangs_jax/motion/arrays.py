"""Reads motions from files of named arrays.

The names (keys) decide the format; the table in `data.formats` has the keys of each. Poses have 55
joints in SMPL-X (165 numbers), 52 in SMPL-H (156), and 24 in SMPL (72), of which the last two are
whole hands. The body alone is 22 joints (66 numbers). Rotations are axis-angles, or matrices, which
have three times as many numbers. Rotations that are not in a file (fingers, eyes) are 0.
"""

from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from humangs_jax.body.joints import JOINT_NAMES
from humangs_jax.core.array_types import Float
from humangs_jax.data.formats import CAMERA_MOVES, PLACES, ArrayKeys
from humangs_jax.geometry.mesh import smallest_turns, unit
from humangs_jax.io.arrays import ArrayFile
from humangs_jax.io.reading import InvalidFileError
from humangs_jax.io.restricted_pickle import as_array
from humangs_jax.io.tensors import read_values
from humangs_jax.motion import MotionError, Poses, Reading, skeleton
from humangs_jax.motion.face_tracks import FaceTrack, checked_track
from humangs_jax.motion.people import SHOWN, Person, are_rotations, format_of, read_people
from humangs_jax.motion.rules import (
    ASSUMED_FOCAL,
    COLUMNS,
    FAR,
    HAND_NUMBERS,
    MILLIMETRES,
    NEARER,
    NO_PLACES,
    NO_RATE,
    PELVIS,
    joint_places,
)
from humangs_jax.motion.skeleton import Clip
from humangs_jax.motion.vectors import frames_first

_HEAD = JOINT_NAMES.index("head")
_Rotations = Float[np.ndarray, "m n 3"]
"""Axis-angles of n joints in m frames, radians."""
_SOMA_JOINTS = 77
"""Number of joints of Kimodo's skeleton, which differs from SMPL-X's skeleton."""
_NO_HANDS = "hands of {} numbers are principal coefficients of a model: left flat"
"""The note about hands in a form that is not read."""
_MISSING_RATE = (
    "missing: how many frames are a second? expected --motion-fps (in Python fps=), or this key"
)
"""What the error about a file without a frame rate says."""


def read_arrays(path: Path, options: Reading) -> Poses | skeleton.Clip:
    """Reads one person's poses, or the person's skeleton if the file has points in space.

    Raises: MotionError or InvalidFileError if a value is wrong; MotionError, which lists the
    people, if it is not clear which person is meant; FileError, InvalidFileError or OSError if a
    file cannot be read.
    """
    # the person that is asked for, and the format by its keys
    person = _chosen(path, read_people(path), options.person)
    form = format_of(person.values)
    assert form is not None
    if form.six:
        person = person._replace(
            values=frames_first(person.values, form.poses["all"], form.moves[0])
        )
    file = _MotionFile(path, person, options.fps)
    # points in space are a skeleton; all others are rotations of a body
    if form.kind == "points":
        return _clip_of_points(file, file.rate(form))
    if form.kind == "ours":
        rotations = file.numbers(form.poses["all"], (None, None, 3))
    else:
        rotations = _posed(file, form)
    moves = _placed(file, form, rotations)
    face = _face(file, form, len(rotations))
    frames = None
    if person.frames is not None and len(person.frames) == len(rotations):
        frames = person.frames
    up, also = form.up, form.also
    if "-y" in also and file.of_camera(form.moves):
        up, also = "-y", ("y",)
    return Poses(
        rotations,
        moves,
        file.rate(form),
        up,
        form.fixed,
        also,
        frames,
        "; ".join(file.notes),
        face,
    )


_EXPRESSIONS = ("expressions", "expression", "expressionParameters", "expr")
"""Keys that may hold the expressions of SMPL-X. The first one that a file has is read."""


def _face(file: "_MotionFile", form: ArrayKeys, count: int) -> FaceTrack | None:
    """Returns the expressions of a person, or None if the file has none.

    count: number of frames. If expressions in a file of another program do not fit the frames or
    are too large, a note is added and None is returned.

    Raises: InvalidFileError if expressions in a file of this package do not fit the frames or are
    too large; MotionError if expressions of any file are no numbers.
    """
    ours = form.kind == "ours"
    key = "expressions" if ours else file.first(_EXPRESSIONS)
    if key not in file.values:
        return None
    values = np.atleast_1d(file.numbers(key, None))
    if values.ndim == 1 and not ours:  # one face for all frames
        values = np.broadcast_to(values, (count, len(values)))
    if values.shape[:1] == (count,) and not ours:
        values = values.reshape(count, -1)
    if ours:
        named = [str(name) for name in np.ravel(file.values.get("expression_names", ()))]
        names = tuple(named)
    else:
        names = tuple(f"expression_{i}" for i in range(values.shape[-1]))
    track = FaceTrack(names, values)
    try:
        checked_track(track, count)
    except InvalidFileError as error:
        if ours:
            raise
        file.notes.append(f"{key} is left out: {error}")
        return None
    return track


def _chosen(path: Path, people: list[Person], number: int | None) -> Person:
    """Returns the person with this number. If no number is given, returns the only person. The
    number is the person's name in the file. If no name is a number, it is the index of the person.

    Raises: MotionError, which lists the people, if nobody has this number, or if there is no number
    and more than one person.
    """
    names = [person.name for person in people]
    if number is None and len(people) == 1:
        return people[0]
    if number is not None:
        if str(number) in names:
            return people[names.index(str(number))]
        if 0 <= number < len(people) and not any(name.isdigit() for name in names):
            return people[number]
    counted = ", ".join(
        f"{person.name or 0} ({_frames(person)} frames)" for person in people[:SHOWN]
    )
    counted += ", ..." if len(people) > SHOWN else ""
    if number is not None:
        raise MotionError(path, f"person {number}", f"no such person: expected one of {counted}")
    raise MotionError(
        path,
        "",
        f"{len(people)} people: {counted}: expected the option or argument person, the number"
        " of one",
    )


def _frames(person: Person) -> int:
    """Returns the number of frames that show the person. It is 0 if the format is unknown."""
    form = format_of(person.values)
    if form:
        return max(len(np.atleast_1d(as_array(person.values[key]))) for key in form.keys)
    return 0


# Rotations
# --------------------------------------------------------------------------------------------------


def _posed(file: "_MotionFile", form: ArrayKeys) -> _Rotations:
    """Returns the rotations of all joints (m, 55, 3), from the keys of the parts of the body.

    The array under the first key decides the number of frames m.

    Raises: MotionError if an array is wrong.
    """
    rotations: _Rotations | None = None
    for place, key in form.poses.items():
        if rotations is not None and key not in file.values:
            continue
        values = file.numbers(key, None)
        # a single pose has no axis of frames
        if rotations is None:
            single = values.ndim == 1 or (
                place == "root" and values.shape == (3, 3) and are_rotations(values)
            )
            rotations = np.zeros((1 if single else len(values), len(JOINT_NAMES), 3))
        # a row of numbers a frame, or none where the frames are not those of the others
        count = len(rotations)
        if count == 1 or len(np.atleast_1d(values)) == count:
            flat = values.reshape(count, -1)
        else:
            flat = np.zeros((count, 0))
        if place == "all":
            part = _all(file, form, key, values, flat)
        else:
            part = _part(file, place, key, values, flat)
        # the root's own rotation comes before that about the origin
        if form.pivot == "origin" and place == "all":
            part = part.copy()
            about, own = (Rotation.from_rotvec(turns[:, 0]) for turns in (rotations, part))
            part[:, 0] = (about * own).as_rotvec()
        first = PLACES[place][0]
        rotations[:, first : first + part.shape[1]] = part
    assert rotations is not None
    return rotations


def _part(
    file: "_MotionFile",
    place: str,
    key: str,
    values: np.ndarray,
    flat: Float[np.ndarray, "m columns"],
) -> _Rotations:
    """Returns the rotations of one part of the body, (m, joints, 3). If a hand has fewer than 45
    numbers, which are coefficients of a hand model, its rotations are 0, and a note is added.

    place: name of the part in `PLACES`. values: the array under the key. flat: the same array with
    one row for each frame.

    Raises: MotionError if the array does not fit the number of joints of the part, or if its
    matrices are no rotations.
    """
    most, (count, width) = PLACES[place][1], flat.shape
    of_smpl = place in ("limbs", "body")
    counts = (most, most + 2) if of_smpl else (most,)
    for joints in counts:
        if width in (3 * joints, 9 * joints):
            return _axis_angles(file, key, flat, joints)[:, :most]
    if 3 * most == HAND_NUMBERS and 0 < width < HAND_NUMBERS:
        file.notes.append(f"{key}: {_NO_HANDS.format(width)}")
        return np.zeros((count, most, 3))
    shapes = f"({count}, {3 * most})"
    if of_smpl:
        shapes += f", or ({count}, {3 * most + 6}) of SMPL"
    raise MotionError(file.path, key, f"expected shape {shapes}, got {values.shape}")


def _all(
    file: "_MotionFile",
    form: ArrayKeys,
    key: str,
    values: np.ndarray,
    flat: Float[np.ndarray, "m columns"],
) -> _Rotations:
    """Returns the rotations of poses whose joints are all under one key, (m, joints, 3), starting
    with the root. Joints are in the order of SMPL-X; later joints may be missing.

    SMPL's poses give the 22 joints of the body. Poses of SMPL-H also give the fingers. values,
    flat: as in `_part`.

    Raises: MotionError if no known layout has that many numbers, or if matrices are no rotations.
    """
    count, width = flat.shape
    # layouts of single programs: root, body, hands and jaw; without the root; with coefficients of
    # hands
    if form.pivot == "head" and width == 3 * 53:
        pose = flat.reshape(count, 53, 3)
        return np.concatenate(
            [pose[:, :22], pose[:, 52:], np.zeros_like(pose[:, :2]), pose[:, 22:52]], axis=1
        )
    if form.pivot == "origin" and width == 69:
        return np.pad(flat, ((0, 0), (3, 0))).reshape(count, -1, 3)[:, :22]
    if form.pivot == "origin" and width in (78, 87):
        file.notes.append(_NO_HANDS.format(6))
        return np.concatenate([flat[:, :66], flat[:, 78:]], axis=1).reshape(count, -1, 3)
    # axis-angles or matrices of the joints of a body model
    if width in (75, *COLUMNS, *(3 * number for number in COLUMNS)):
        joints = width // 3 if width in (75, *COLUMNS) else width // 9
        pose = _axis_angles(file, key, flat, joints)
        # the last two of 24 are whole hands, the last three of 25 jaw and eyes
        if joints < 52:
            return pose if joints == 25 else pose[:, :22]
        if joints == len(JOINT_NAMES):
            face = pose[:, 22:25]
        else:
            face = np.zeros((count, 3, 3))
        return np.concatenate([pose[:, :22], face, pose[:, -30:]], axis=1)
    words = ", ".join(f"{number} ({whose})" for number, whose in COLUMNS.items())
    joints = f", {width // 3} joints" if width % 3 == 0 else ""
    if values.shape[1:] == (_SOMA_JOINTS, 3, 3):
        joints = f", {_SOMA_JOINTS} joints of SOMA: write a .bvh of them"
    raise MotionError(
        file.path, key, f"expected {words} numbers a frame, got shape {values.shape}{joints}"
    )


def _axis_angles(
    file: "_MotionFile", key: str, flat: Float[np.ndarray, "m columns"], joints: int
) -> _Rotations:
    """Returns axis-angles (m, joints, 3) for rows of axis-angles or of rotation matrices.

    Raises: MotionError if matrices are not rotations.
    """
    if flat.shape[1] == 3 * joints:
        return flat.reshape(len(flat), joints, 3)
    matrices = flat.reshape(-1, 3, 3)
    if not are_rotations(matrices):
        raise MotionError(
            file.path,
            key,
            f"expected rotation matrices, got others than rotations in shape {flat.shape}",
        )
    return Rotation.from_matrix(matrices).as_rotvec().reshape(len(flat), joints, 3)


# Positions
# --------------------------------------------------------------------------------------------------


def _placed(
    file: "_MotionFile", form: ArrayKeys, rotations: _Rotations
) -> Float[np.ndarray, "m 3"]:
    """Returns the translations of the body, (m, 3), metres.

    If the file has cameras, translations and the root's rotations are converted from the axes of
    the camera to the world. The root's rotations in `rotations` are changed in place.

    Raises: MotionError if the positions or the cameras are wrong, or if positions are missing
    without which the format cannot be read. FileError if the file of the cameras cannot be read.
    """
    # a file may have no positions
    count, key = len(rotations), file.first(form.moves)
    if key not in file.values and form.stays and key not in file.pickled:
        file.notes.append(NO_PLACES.format(", ".join(form.moves[:3])))
        return np.zeros((count, 3))
    # a weak perspective: scales, then metres beside the axis
    moves = file.numbers(key, None)
    if moves.size == 4 * count and moves.shape[0] == count:
        file.notes.append(f"{key} does not tell how far away people are: they stay at one distance")
        moves = np.concatenate([moves.reshape(count, 4)[:, 2:], np.zeros((count, 1))], axis=1)
    if moves.size != 3 * count or moves.shape[-1] != 3 or (count > 1 and len(moves) != count):
        raise MotionError(file.path, key, f"expected shape ({count}, 3), got {moves.shape}")
    moves = moves.reshape(count, 3)
    if file.of_camera(form.moves) and np.median(moves[:, 2]) > FAR:
        file.notes.append(NEARER.format(key, ASSUMED_FOCAL))
        moves = moves / [1, 1, ASSUMED_FOCAL]
    # in metres
    if form.scaling is not None:
        scale = MILLIMETRES
        if form.scaling in file.values:
            scale = float(file.numbers(form.scaling, None).reshape(-1)[0])
        if not scale > 0:
            raise MotionError(file.path, form.scaling, f"expected a positive number, got {scale}")
        moves = moves / scale
    # of the pelvis, from those of the origin, the pelvis or the head
    if form.pivot == "origin":
        root = file.numbers(form.poses["root"], None).reshape(count, 3)
        return moves + Rotation.from_rotvec(root).apply(PELVIS) - PELVIS
    if form.pivot == "joint":
        moves = moves - PELVIS
    if form.pivot == "head":
        joints = skeleton.shipped_joints()
        moves = moves - joint_places(joints, rotations, np.zeros((count, 3)))[:, _HEAD]
    # from the axes of a camera that moves to those of the world
    camera = _cameras(file, count)
    if camera is None:
        return moves
    turns, places = camera
    root = Rotation.from_rotvec(rotations[:, 0])
    rotations[:, 0] = (Rotation.from_matrix(turns) * root).as_rotvec()
    return np.einsum("mab,mb->ma", turns, moves + PELVIS) + places - PELVIS


def _cameras(
    file: "_MotionFile", count: int
) -> tuple[Float[np.ndarray, "m 3 3"], Float[np.ndarray, "m 3"]] | None:
    """Returns the rotations (m, 3, 3) and positions (m, 3) of the camera in the world. None if
    there are no cameras, neither in the file nor in a camera.npy beside it.

    m is 1 if one camera stands for all frames, else the number of frames.

    Raises: MotionError if the cameras do not fit the frames, or if their matrices are no rotations.
    FileError if camera.npy cannot be read.
    """
    # one camera, or one of each frame
    if "cam2world" in file.values:
        shape = (count, 4, 4) if file.array("cam2world").ndim == 3 else (4, 4)
        matrices = file.numbers("cam2world", shape).reshape(-1, 4, 4)
        turns, places = matrices[:, :3, :3], matrices[:, :3, 3]
    elif "pred_rotmat" in file.values:
        # cameras are in a file beside that of the person, for the frames in which the person was
        # seen
        folders = (file.path, *file.path.parents[:2])
        beside = next(
            (each / "camera.npy" for each in folders if (each / "camera.npy").is_file()), None
        )
        if beside is None:
            file.notes.append("no camera.npy beside it: people move as the camera sees them")
            return None
        camera = ArrayFile(beside, read_values(beside), error=MotionError)
        own = file.integers(file.first(("frame", "frames")), (count,))
        kind = "world" if "world_cam_R" in camera else "pred"
        turns = camera.numbers(f"{kind}_cam_R", (None, 3, 3))
        places = camera.numbers(f"{kind}_cam_T", (None, 3))
        if own.min() < 0 or own.max() >= min(len(turns), len(places)):
            raise MotionError(
                beside,
                f"{kind}_cam_R",
                f"expected one for each of {own.max() + 1} frames, got {len(turns)}",
            )
        turns, places = turns[own], places[own]
    else:
        return None
    if not are_rotations(turns):
        raise MotionError(file.path, "", "expected rotation matrices of cameras")
    return turns, places


class _MotionFile(ArrayFile):
    """The arrays of one person, the rate that the user gave, and notes for the user."""

    def __init__(self, path: Path, person: Person, fps: float | None):
        super().__init__(path, person.values, person.pickled, MotionError)
        self.fps = fps
        self.notes: list[str] = []

    def first(self, keys: tuple[str, ...]) -> str:
        """Returns the first of the keys that the file has, or keys[0] if it has none."""
        return next((key for key in keys if key in self.values), keys[0])

    def of_camera(self, moves: tuple[str, ...]) -> bool:
        """Says whether the file's positions are in the coordinates of a camera. moves: keys that
        positions may have. The first one that the file has counts.
        """
        key = self.first(moves)
        return key in CAMERA_MOVES and key in self.values

    def rate(self, form: ArrayKeys) -> float:
        """Returns the frames per second that the user gave. If the user gave none, returns the rate
        of the file, or else the default of the format.

        Raises: MotionError if there is none of these, or if the file's rate is not positive.
        """
        if self.fps is not None:
            return self.fps
        key = self.first(form.rates) if form.rates else ""
        if key in self.values:
            rate = float(self.numbers(key, None).reshape(-1)[0])
            if not (rate > 0 and np.isfinite(1 / rate)):
                raise MotionError(
                    self.path, key, f"expected a positive number of frames per second, got {rate}"
                )
            return rate
        if form.fps is None:
            raise MotionError(self.path, key, _MISSING_RATE)
        if not form.fixed:
            self.notes.append(
                f"{NO_RATE.format(form.fps)}, which --motion-fps (in Python fps=) changes"
            )
        return form.fps


# Points in space: SAM 3D Body
# ------------------------------------------------------------------------------------------

RIG = {
    1: ("pelvis", -1),
    2: ("left_hip", 1),
    3: ("left_knee", 2),
    4: ("left_ankle", 3),
    8: ("left_foot", 4),
    18: ("right_hip", 1),
    19: ("right_knee", 18),
    20: ("right_ankle", 19),
    24: ("right_foot", 20),
    34: ("spine0", 1),
    35: ("spine1", 34),
    36: ("spine2", 35),
    37: ("spine3", 36),
    110: ("neck", 37),
    113: ("head", 110),
    74: ("left_collar", 37),
    75: ("left_shoulder", 74),
    76: ("left_elbow", 75),
    78: ("left_wrist", 76),
    38: ("right_collar", 37),
    39: ("right_shoulder", 38),
    40: ("right_elbow", 39),
    42: ("right_wrist", 40),
}
"""The joints of SAM 3D Body's rig that are read. For each index in the rig, the joint's name, and
the index of its parent, -1 if there is none.
"""
RIG_JOINTS = 127
"""Number of joints of SAM 3D Body's rig."""


def _clip_of_points(file: Any, fps: float) -> Clip:
    """Reads a moving skeleton from the points of a `_MotionFile`. fps: frames per second.

    Raises: MotionError, which names the wrong key.
    """
    points = _of_frames(file, "pred_joint_coords", (RIG_JOINTS, 3))[:, list(RIG)]
    if "pred_cam_t" in file.values:
        points = points + _of_frames(file, "pred_cam_t", (3,), len(points))[:, None]
    else:
        file.notes.append("the file has no pred_cam_t: people stay in place")
    index = {joint: i for i, joint in enumerate(RIG)}
    parents = tuple(index.get(parent, -1) for _, parent in RIG.values())
    places = points * np.array([1.0, -1.0, -1.0])  # y up
    if "pred_global_rots" in file.values:
        turns = _of_frames(file, "pred_global_rots", (RIG_JOINTS, 3, 3), len(points))[:, list(RIG)]
    else:
        turns = _carried(places, parents)
    rest = np.zeros(places.shape[1:])
    for i, p in enumerate(parents):
        if p >= 0:
            rest[i] = rest[p] + np.einsum(
                "mba,mb->ma", turns[:, p], places[:, i] - places[:, p]
            ).mean(axis=0)
    names = tuple(name for name, _ in RIG.values())
    return Clip(names, parents, rest, turns, places, fps, "y", "; ".join(file.notes))


def _of_frames(
    file: Any, key: str, shape: tuple[int, ...], count: int | None = None
) -> Float[np.ndarray, "m ..."]:
    """Reads an array that has values of a given shape for each frame, and returns it with frames as
    its first axis.

    The array of a single frame may lack the axis of frames. An axis of length 1 for the person is
    removed. count: number of frames. None: any.

    Raises: MotionError, which names the key, if the array has another shape or is missing.
    """
    values = file.numbers(key, None)
    if values.size == np.prod(shape):
        values = values.reshape(1, *shape)
    if values.shape[1:] != shape and values.shape[2:] == shape and values.shape[1] == 1:
        values = values[:, 0]
    if values.shape == (count or len(values), *shape):
        return values
    return file.numbers(key, (count, *shape))


def _carried(
    places: Float[np.ndarray, "m s 3"], parents: tuple[int, ...]
) -> Float[np.ndarray, "m s 3 3"]:
    """Returns the rotations of the joints from the first frame to each frame, (m, s, 3, 3), for a
    file with points alone.

    A joint turns as the joint above it. Then it gets the smallest turns that make its bones point
    as in the frame, one bone after the other.
    """
    turns = np.tile(np.eye(3), (*places.shape[:2], 1, 1))
    for i, p in enumerate(parents):
        if p >= 0:
            first = unit(places[0, i] - places[0, p])
            turns[:, p] = (
                smallest_turns(turns[:, p] @ first, unit(places[:, i] - places[:, p])) @ turns[:, p]
            )
            turns[:, i] = turns[:, p]
    return turns
