"""Motions in files of arrays: the keys decide the format (`data.formats`), one function for each kind of keys.

SMPL-X has 55 joints (165 numbers), SMPL-H 52 (156), SMPL 24 (72), of which the last two are whole hands; 22 (66) are the body.
What a file does not have (fingers, eyes) is 0.
"""

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from humangs_jax.body.model import JOINT_NAMES
from humangs_jax.core.array_types import Float
from humangs_jax.data.formats import MOTIONS, ArrayKeys
from humangs_jax.data.motion.motion import MotionError, Poses, Reading
from humangs_jax.data.motion.rules import BODY_NUMBERS, COLUMNS, HAND_NUMBERS, MILLIMETRES
from humangs_jax.io.arrays import ArrayFile
from humangs_jax.io.reading import read_json


def read_arrays(path: Path, options: Reading) -> Poses:
    """The poses of a file. Raises: MotionError, naming the key."""
    file, known = _MotionFile(path, options), [each.arrays for each in MOTIONS.values() if each.arrays is not None]
    for form in known:
        if all(key in file.values for key in form.keys):
            rotations, translations = _READERS[form.kind](file, form)
            return Poses(rotations, translations, file.rate(form.rates, form.fps), form.up, form.fixed, form.also)
    expected = ", ".join(dict.fromkeys(form.keys[0] for form in known))
    keys = ", ".join(sorted(file.values)) or "none"
    raise MotionError(path, "", f"no motion: expected one of the keys {expected}, got {keys}")


# Formats ---------------------------------------------------------------------------------------------------------------


Moves = tuple[Float[np.ndarray, "m j 3"], Float[np.ndarray, "m 3"]]
"""Rotations and translations of the frames."""


def _ours(file: "_MotionFile", form: ArrayKeys) -> Moves:
    key = form.poses[0]
    if not file.flat_hand_mean:
        raise MotionError(file.path, key, "our own format holds whole rotations: expected flat_hand_mean=True")
    rotations = file.numbers(key, (None, None, 3))
    return rotations, file.numbers(form.moves[0], (len(rotations), 3))


def _whole(file: "_MotionFile", form: ArrayKeys) -> Moves:
    key = form.poses[0]
    poses = file.numbers(key, None)
    count, columns = len(poses), poses[0].size
    if poses.ndim not in (2, 3) or columns not in COLUMNS:
        expected = ", ".join(f"{number} ({whose})" for number, whose in COLUMNS.items())
        joints = f", {columns // 3} joints" if columns % 3 == 0 else ""
        raise MotionError(file.path, key, f"expected {expected} numbers a frame, got shape {poses.shape}{joints}")
    poses = poses.reshape(count, columns)
    if columns == 3 * len(JOINT_NAMES):
        body_and_face, *hands = np.split(poses, [columns - 2 * HAND_NUMBERS, columns - HAND_NUMBERS], axis=1)
        hands = [file.with_mean(hand, side) for side, hand in enumerate(hands)]
        rotations = np.concatenate([body_and_face, *hands], axis=1).reshape(count, -1, 3)
    else:
        # 66: body. 72: SMPL, whose last two joints are whole hands; we have fingers in their place. 156: body and fingers
        hands = np.split(poses[:, BODY_NUMBERS:], 2, axis=1) if columns == BODY_NUMBERS + 2 * HAND_NUMBERS else None
        hands = hands and [file.with_mean(hand, side) for side, hand in enumerate(hands)]
        rotations = file.assemble(poses[:, :BODY_NUMBERS], hands=hands)
    return rotations, file.numbers(file.first(form.moves), (count, 3))


def _scaled(file: "_MotionFile", form: ArrayKeys) -> Moves:
    key = form.poses[0]
    poses = file.numbers(key, None)
    poses = poses.reshape(len(poses), -1) if poses.ndim == 3 else poses
    if poses.ndim != 2 or poses.shape[1] != 72:
        raise MotionError(file.path, key, f"expected shape (frames, 72), got {poses.shape}")
    scale = MILLIMETRES
    if form.scaling is not None and form.scaling in file.values:
        scale = float(file.numbers(form.scaling, None).reshape(-1)[0])
        if not scale > 0:
            raise MotionError(file.path, form.scaling, f"expected a positive number, got {scale}")
    return file.assemble(poses[:, :BODY_NUMBERS]), file.numbers(form.moves[0], (len(poses), 3)) / scale


def _parts(file: "_MotionFile", form: ArrayKeys) -> Moves:
    root, body, *others = form.poses
    orient = file.numbers(root, None)
    count = len(orient)
    orient = file.numbers(root, (count, 3))
    given = file.numbers(body, None)
    pose = given.reshape(len(given), -1)
    if pose.shape not in ((count, BODY_NUMBERS - 3), (count, 69)):  # 69: SMPL, whose last two joints are whole hands
        expected = f"expected shape ({count}, {BODY_NUMBERS - 3}), or ({count}, 69) of SMPL"
        raise MotionError(file.path, body, f"{expected}, got {given.shape}")
    pose = np.concatenate([orient, pose[:, : BODY_NUMBERS - 3]], axis=1)
    face = [file.optional(key, (count, 3)) for key in others[:3]]
    hands = [file.hand(key, count, side) for side, key in enumerate(others[3:])]
    return file.assemble(pose, face, hands), file.numbers(form.moves[0], (count, 3))


_READERS = {"ours": _ours, "whole": _whole, "scaled": _scaled, "parts": _parts}


class _MotionFile(ArrayFile):
    """The values of a motion file, and how its hands are written."""

    def __init__(self, path: Path, options: Reading):
        self.hands, self.flat_hand_mean, self.fps = options
        if path.is_dir() or path.suffix.lower() == ".json":
            super().__init__(path, _read_json_frames(path), error=MotionError)
        else:
            file = ArrayFile.open(path, MotionError)
            super().__init__(path, file.values, file.pickled, MotionError)

    def optional(self, key: str, shape: tuple[int | None, ...] | None) -> Float[np.ndarray, "..."] | None:
        """As `numbers`; None if the file has no such key."""
        return self.numbers(key, shape) if key in self.values else None

    def first(self, keys: tuple[str, ...]) -> str:
        """The first key that the file has; the first of all if it has none."""
        return next((key for key in keys if key in self.values), keys[0])

    def rate(self, keys: tuple[str, ...], default: float | None) -> float:
        """Frames per second: those asked for, or under the first of the keys that is there."""
        if self.fps is not None:
            return self.fps
        key = self.first(keys) if keys else ""
        if key in self.values:
            rate = float(self.numbers(key, None).reshape(-1)[0])
            if not (rate > 0 and np.isfinite(1 / rate)):
                raise MotionError(self.path, key, f"expected a positive number of frames per second, got {rate}")
            return rate
        if default is None:
            raise MotionError(self.path, key, "missing: how many frames are a second?")
        return default

    def hand(self, key: str, count: int, side: int) -> Any:
        """(m, 45) axis-angle numbers of a hand, or None if the file has none."""
        pose = self.optional(key, None)
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

    def assemble(
        self,
        body: Float[np.ndarray, "m 66"],
        face: Sequence[Float[np.ndarray, "m 3"] | None] | None = None,
        hands: Sequence[Float[np.ndarray, "m 45"] | None] | None = None,
    ) -> Float[np.ndarray, "m j 3"]:
        """(m, 55, 3) from (m, 66) and parts that may be None."""
        zeros = lambda columns: np.zeros((len(body), columns))
        face = [zeros(3) if part is None else part for part in face or [None] * 3]
        hands = [zeros(HAND_NUMBERS) if hand is None else hand for hand in hands or [None] * 2]
        return np.concatenate([body, *face, *hands], axis=1).reshape(len(body), -1, 3)


def _read_json_frames(path: Path) -> dict[str, list[Any]]:
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
