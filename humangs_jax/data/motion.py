"""Motions: one body pose per frame, read from the files that people have.

=================  =====================================================================  =======================
format             keys                                                                   frames per second
=================  =====================================================================  =======================
ours (.npz)        rotations (m, j, 3), translations (m, 3)                               fps
AMASS (.npz)       poses (m, 165 | 156 | 72 | 66), trans (m, 3)                           mocap_framerate
AIST++ (.pkl|npz)  smpl_poses (m, 72), smpl_trans (m, 3); smpl_scaling (1,) or millimetres  60
THuman4.0,         global_orient (m, 3), body_pose (m, 63), transl (m, 3), and if there   30
AvatarReX (.npz)   are any jaw_pose, leye_pose, reye_pose (m, 3), *_hand_pose (m, 45)
LHM (.json, or a   root_pose (3,), body_pose (21, 3), trans (3,), and if there are any    30
folder of them)    jaw_pose, leye_pose, reye_pose (3,), lhand_pose, rhand_pose (15, 3)
=================  =====================================================================  =======================

In memory: SMPL-X's 55 joints, axis-angle in radians, metres, y up. What a file does not have (fingers, eyes) is 0.
"""

import functools
import re
from collections.abc import Mapping
from importlib import resources
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from humangs_jax.body import skinning
from humangs_jax.body.joints import BODY_NAMES, JOINT_NAMES
from humangs_jax.body.model import BodyPose, RestBody
from humangs_jax.body.smplx import HandBasis
from humangs_jax.core.array_types import Array, Float
from humangs_jax.core.pytree import pytree_dataclass, replace, static_field
from humangs_jax.geometry import quaternion, transform
from humangs_jax.io.npz import read_npz, write_npz
from humangs_jax.io.reading import FileError, reading
from humangs_jax.io.restricted_pickle import as_array, read_pickle
from humangs_jax.io.text import read_json

WALK = "walk.npz"
BODY_NUMBERS = 3 * len(BODY_NAMES)  # 66
HAND_NUMBERS = 45
AIST_FPS, DEFAULT_FPS = 60.0, 30.0
AMASS_RATES = ("mocap_framerate", "mocap_frame_rate", "fps")
MILLIMETRES = 1000.0
PELVIS = np.array([0.0, -0.35, 0.0])
"""Where SMPL-X's root joint (and the shipped body's) is in T-pose, metres: worlds are turned about it. Other
bodies are off by a constant, which `grounded` removes."""
UPRIGHT = {
    "y": (1.0, 0.0, 0.0, 0.0),
    "-y": (0.0, 1.0, 0.0, 0.0),
    "z": (np.sqrt(0.5), -np.sqrt(0.5), 0.0, 0.0),
    "-z": (np.sqrt(0.5), np.sqrt(0.5), 0.0, 0.0),
    "x": (np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5)),
    "-x": (np.sqrt(0.5), 0.0, 0.0, -np.sqrt(0.5)),
}
"""The rotation (quaternion, wxyz) that turns the named axis to +y."""
CLEARLY_UP = 0.5
"""Mean cosine between the pelvis's own up and an axis from which on that axis is taken for the world's up."""


class MotionError(FileError):
    """Something is wrong with a motion file; the message is one line: file, key, and what was expected."""


@pytree_dataclass
class Motion:
    """Poses over time. rotations: (m, j, 3) axis-angle. translations: (m, 3) metres, applied last. fps: static."""

    rotations: Float[Array, "m j 3"]
    translations: Float[Array, "m 3"]
    fps: float = static_field(default=DEFAULT_FPS)

    def pose(self, frame: int) -> BodyPose:
        """One frame."""
        return BodyPose(self.rotations[frame], self.translations[frame])

    def at_rate(self, fps: float | int) -> "Motion":
        """The motion at another frame rate, between two frames interpolated: rotations on the shortest way, positions linearly.

        Raises: ValueError for a rate that is not positive.
        """
        if not (np.isfinite(fps) and fps > 0):
            raise ValueError(f"fps: expected a positive number of frames per second, got {fps}")
        last = len(self.translations) - 1
        count = max(1, round((last + 1) * fps / self.fps))
        times = np.minimum(np.arange(count) * self.fps / fps, last)
        low = np.floor(times).astype(int)
        frames = self.rotations[low], self.translations[low]
        if (times > low).any():
            high = np.minimum(low + 1, last)
            share = jnp.asarray(times - low, jnp.float32)
            frames = _between(*frames, self.rotations[high], self.translations[high], share)
        return replace(self, rotations=frames[0], translations=frames[1], fps=float(fps))


@jax.jit
def _between(rotations, translations, next_rotations, next_translations, share):
    """Frames between frames; those with share 0 as they are."""
    turned = quaternion.interpolate(rotations, next_rotations, share[:, None])
    moved = translations + share[:, None] * (next_translations - translations)
    return jnp.where(share[:, None, None] > 0, turned, rotations), moved


def load_motion(
    path: str | Path | None = None,
    *,
    up: str = "auto",
    fps: float | int | None = None,
    hands: HandBasis | None = None,
    flat_hand_mean: bool = True,
) -> Motion:
    """Read a motion; the keys decide the format.

    Arguments:
        path: None for the walk that comes with the package; else a file, or a folder of LHM's JSON files.
        up: axis of the file's world that points up ("y", "-y", "z", ...); the motion is turned so that y does. "auto"
            asks the poses: the axis along which the pelvis stands upright on average, and if none is clear the format's
            own (AMASS z, others y). Our own format and AIST++ are y-up and never turned by "auto".
        fps: frames per second in place of those in the file.
        hands: hand basis of an SMPL-X model, needed for hands of fewer than 45 numbers (principal coefficients) and for
            `flat_hand_mean` False, which adds the mean hand (only to hands that a file has). Our own format holds
            whole rotations: there is nothing to add.

    Raises: MotionError, one line naming file and key.
    """
    if up not in ("auto", *UPRIGHT):
        raise ValueError(f"up: expected auto, {', '.join(UPRIGHT)}, got {up!r}")
    if hands is None and not flat_hand_mean:
        raise ValueError("flat_hand_mean=False needs the mean hand: pass hands")
    if path is None:
        with resources.as_file(resources.files("humangs_jax") / "assets" / WALK) as file:
            return load_motion(file, up=up, fps=fps)
    with reading(path, "motion", MotionError):
        return _load(path, up, fps, hands, flat_hand_mean)


def _load(path, up, fps, hands, flat_hand_mean):
    file = _MotionFile(path, hands, flat_hand_mean)
    for key, read in _FORMATS.items():
        if key in file.values:
            rotations, translations, file_fps, usual_up = read(file)
            break
    else:
        keys = ", ".join(sorted(file.values)) or "none"
        raise MotionError(path, "", f"no motion: expected one of the keys {', '.join(_FORMATS)}, got {keys}")
    rate = file_fps if fps is None else float(fps)
    if not (np.isfinite(rate) and rate > 0):
        raise MotionError(path, "fps", f"expected a positive number of frames per second, got {rate}")
    if up == "auto":
        up = "y" if usual_up is None else _up_axis(rotations[:, 0], usual_up)
    rotations, translations = _turn(rotations, translations, UPRIGHT[up])
    return Motion(jnp.asarray(rotations, jnp.float32), jnp.asarray(translations, jnp.float32), rate)


def save_motion(path: str | Path, motion: Motion) -> None:
    """Write our own format, compressed; the file appears whole or not at all."""
    write_npz(path, {"rotations": motion.rotations, "translations": motion.translations, "fps": motion.fps})


def grounded(motion: Motion, rest: RestBody, parents: tuple[int, ...]) -> Motion:
    """The motion moved by a constant so that the person starts at x = z = 0 and, at its lowest, stands on y = 0.

    Arguments:
        rest, parents: of the body that will move. Its lowest joint is asked, and as far below it as in T-pose is the sole.
    """
    joints = _joint_paths(rest.joints, parents, motion.rotations, motion.translations)
    sole = rest.joints[:, 1].min() - rest.vertices[:, 1].min()
    shift = jnp.stack([joints[0, 0, 0], joints[..., 1].min() - sole, joints[0, 0, 2]])
    return replace(motion, translations=motion.translations - shift)


@functools.partial(jax.jit, static_argnames="parents")
def _joint_paths(rest_joints, parents, rotations, translations):
    """(m, j, 3) joints in space."""
    transforms = jax.vmap(skinning.joint_transforms, in_axes=(None, None, 0, 0))
    transforms = transforms(rest_joints, parents, rotations, translations)
    return transform.apply(transforms, rest_joints)


# Formats: each returns rotations (m, 55, 3), translations (m, 3), frames per second, the format's up axis or None (y) ----


def _ours(file):
    if not file.flat_hand_mean:
        raise MotionError(file.path, "rotations", "our own format holds whole rotations: expected flat_hand_mean=True")
    rotations = file.numbers("rotations", (None, None, 3))
    translations = file.numbers("translations", (len(rotations), 3))
    return rotations, translations, file.rate(("fps",), None), None


def _amass(file):
    poses = file.numbers("poses", (None, None))
    count, columns = poses.shape
    if columns == 3 * len(JOINT_NAMES):
        body_and_face, *hands = np.split(poses, [columns - 2 * HAND_NUMBERS, columns - HAND_NUMBERS], axis=1)
        hands = [file.with_mean(hand, side) for side, hand in enumerate(hands)]
        rotations = np.concatenate([body_and_face, *hands], axis=1).reshape(count, -1, 3)
    elif columns in (BODY_NUMBERS, 72, BODY_NUMBERS + 2 * HAND_NUMBERS):
        # 66: body. 72: SMPL, whose last two joints are whole hands; we have fingers in their place. 156: body and fingers
        hands = np.split(poses[:, BODY_NUMBERS:], 2, axis=1) if columns == BODY_NUMBERS + 2 * HAND_NUMBERS else None
        hands = hands and [file.with_mean(hand, side) for side, hand in enumerate(hands)]
        rotations = file.assemble(poses[:, :BODY_NUMBERS], hands=hands)
    else:
        raise MotionError(file.path, "poses", f"expected 165, 156, 72 or 66 columns, got {columns}")
    return rotations, file.numbers("trans", (count, 3)), file.rate(AMASS_RATES, None), "z"


def _aist(file):
    poses = file.numbers("smpl_poses", None)
    poses = poses.reshape(len(poses), -1) if poses.ndim == 3 else poses
    if poses.ndim != 2 or poses.shape[1] != 72:
        raise MotionError(file.path, "smpl_poses", f"expected shape (frames, 72), got {poses.shape}")
    scale = MILLIMETRES
    if "smpl_scaling" in file.values:
        scale = float(file.numbers("smpl_scaling", None).reshape(-1)[0])
        if not scale > 0:
            raise MotionError(file.path, "smpl_scaling", f"expected a positive number, got {scale}")
    translations = file.numbers("smpl_trans", (len(poses), 3)) / scale
    return file.assemble(poses[:, :BODY_NUMBERS]), translations, file.rate(("fps",), AIST_FPS), None


def _smpl_params(file):
    orient = file.numbers("global_orient", (None, 3))
    count = len(orient)
    body = np.concatenate([orient, file.numbers("body_pose", (count, BODY_NUMBERS - 3))], axis=1)
    face = [file.numbers(key, (count, 3), optional=True) for key in ("jaw_pose", "leye_pose", "reye_pose")]
    hands = [file.hand(f"{side}_hand_pose", count, i) for i, side in enumerate(("left", "right"))]
    translations = file.numbers("transl", (count, 3))
    return file.assemble(body, face, hands), translations, file.rate(("fps", *AMASS_RATES), DEFAULT_FPS), "y"


def _lhm(file):
    root = file.numbers("root_pose", None)
    count = len(root)
    root = file.numbers("root_pose", (count, 3))
    body = np.concatenate([root, file.numbers("body_pose", (count, 21, 3)).reshape(count, -1)], axis=1)
    face = [file.numbers(key, (count, 3), optional=True) for key in ("jaw_pose", "leye_pose", "reye_pose")]
    hands = [file.hand(key, count, i) for i, key in enumerate(("lhand_pose", "rhand_pose"))]
    return file.assemble(body, face, hands), file.numbers("trans", (count, 3)), DEFAULT_FPS, "y"


_FORMATS = {"rotations": _ours, "smpl_poses": _aist, "poses": _amass, "root_pose": _lhm, "body_pose": _smpl_params}
"""Readers by a key that only their format has; the first that fits is used."""


class _MotionFile:
    """The values of a motion file by key, with errors that name both."""

    def __init__(self, path: str | Path, hands: HandBasis | None, flat_hand_mean: bool):
        self.path, self.hands, self.flat_hand_mean = Path(path), hands, flat_hand_mean
        if not self.path.exists():
            raise MotionError(path, "", "no such file")
        self.pickled: tuple[str, ...] = ()
        suffix = self.path.suffix.lower()
        if self.path.is_dir() or suffix == ".json":
            self.values: Mapping[str, Any] = _read_json_frames(self.path)
        elif suffix in (".pkl", ".pickle"):
            self.values = read_pickle(self.path)
        else:
            self.values, self.pickled = read_npz(self.path)

    def numbers(self, key: str, shape: tuple[int | None, ...] | None, optional: bool = False) -> Any:
        """Finite float64 numbers; None in `shape` is any size but 0, None for it any shape with at least one frame."""
        if key not in self.values:
            if optional:
                return None
            reason = "a pickled object, which is never read" if key in self.pickled else "missing"
            raise MotionError(self.path, key, reason)
        try:
            array = as_array(self.values[key])
            if array.dtype.kind not in "fiu":
                raise ValueError
            array = array.astype(np.float64)
        except (ValueError, TypeError, OverflowError):
            raise MotionError(self.path, key, "expected numbers") from None
        if shape is not None:
            wanted = ", ".join("any" if size is None else str(size) for size in shape)
            fits = array.ndim == len(shape) and all(b in (None, a) for a, b in zip(array.shape, shape, strict=True))
            if not fits:
                raise MotionError(self.path, key, f"expected shape ({wanted}), got {array.shape}")
        if array.size == 0:
            raise MotionError(self.path, key, f"expected at least one frame, got shape {array.shape}")
        if not np.isfinite(array).all():
            where = [int(i) for i in np.argwhere(~np.isfinite(array))[0]]
            raise MotionError(self.path, key, f"expected finite numbers, got {array[tuple(where)]} at index {where}")
        return array

    def rate(self, keys: tuple[str, ...], default: float | None) -> float:
        """Frames per second under the first of the keys that is there."""
        for key in keys:
            if key in self.values:
                rate = float(self.numbers(key, None).reshape(-1)[0])
                if not rate > 0:
                    raise MotionError(self.path, key, f"expected a positive number of frames per second, got {rate}")
                return rate
        if default is None:
            raise MotionError(self.path, keys[0], "missing: how many frames are a second?")
        return default

    def hand(self, key: str, count: int, side: int) -> Any:
        """(m, 45) axis-angle numbers of a hand, or None if the file has none."""
        pose = self.numbers(key, None, optional=True)
        if pose is None:
            return None
        pose = pose.reshape(len(pose), -1)
        if len(pose) != count or pose.shape[1] > HAND_NUMBERS:
            raise MotionError(self.path, key, f"expected shape ({count}, {HAND_NUMBERS}), got {pose.shape}")
        if pose.shape[1] < HAND_NUMBERS:
            if self.hands is None:
                problem = (
                    f"{pose.shape[1]} numbers are principal coefficients: they need the hand basis of a model (hands)"
                )
                raise MotionError(self.path, key, problem)
            pose = pose @ np.asarray(self.hands.components)[side, : pose.shape[1]]
        return self.with_mean(pose, side)

    def with_mean(self, hand: Any, side: int) -> Any:
        """A hand's pose (m, 45) from that of a file, which may be relative to the mean hand."""
        return hand if self.flat_hand_mean or self.hands is None else hand + np.asarray(self.hands.means)[side]

    def assemble(self, body, face=None, hands=None):
        """(m, 55, 3) from (m, 66) and parts that may be None."""
        zeros = lambda columns: np.zeros((len(body), columns))
        face = [zeros(3) if part is None else part for part in face or [None] * 3]
        hands = [zeros(HAND_NUMBERS) if hand is None else hand for hand in hands or [None] * 2]
        return np.concatenate([body, *face, *hands], axis=1).reshape(len(body), -1, 3)


def _read_json_frames(path):
    """One JSON file per frame (a folder: all of them, in the order of their numbers), stacked by key."""
    files = [path]
    if path.is_dir():
        natural = lambda file: [int(x) if x.isdigit() else x for x in re.split(r"(\d+)", file.name)]
        files = sorted(path.glob("*.json"), key=natural)
        if not files:
            raise MotionError(path, "", "no .json file in this folder")
    frames = []
    for file in files:
        frame = read_json(file)
        if not isinstance(frame, dict):
            raise MotionError(file, "", f"expected a JSON object, got {type(frame).__name__}")
        if missing := set(frames[0] if frames else ()) - set(frame):
            raise MotionError(file, min(missing), f"missing, but {files[0].name} has it")
        frames.append(frame)
    return {key: [frame[key] for frame in frames] for key in frames[0]}


def _up_axis(root, usual):
    """The axis of the world that the pelvis's own y axis points along on average."""
    mean = np.asarray(quaternion.matrix_from_axis_angle(jnp.asarray(root, jnp.float32)))[..., 1].mean(axis=0)
    axis = int(np.argmax(np.abs(mean)))
    if abs(mean[axis]) < CLEARLY_UP:
        return usual
    return ("-" if mean[axis] < 0 else "") + "xyz"[axis]


def _turn(rotations, translations, q):
    """The motion in a world turned by the quaternion q."""
    if q == UPRIGHT["y"]:
        return rotations, translations
    turn = np.asarray(quaternion.to_matrix(jnp.asarray(q)), np.float64).round()
    root = quaternion.from_axis_angle(jnp.asarray(rotations[:, 0], jnp.float32))
    root = np.asarray(quaternion.multiply(jnp.asarray(q, jnp.float32), root), np.float64)
    root *= np.where(root[:, :1] < 0, -1, 1)  # the shorter way round
    sine = np.linalg.norm(root[:, 1:], axis=1, keepdims=True)
    angle = 2 * np.arctan2(sine, root[:, :1])
    axis_angle = root[:, 1:] * np.where(sine > 0, angle / np.where(sine > 0, sine, 1), 2)
    rotations = np.concatenate([axis_angle[:, None], rotations[:, 1:]], axis=1)
    return rotations, (translations + PELVIS) @ turn.T - PELVIS
