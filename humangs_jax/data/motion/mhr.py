"""SAM 3D Body's people: joints of the Momentum Human Rig (MHR) in space, and their rotations.

Joints are metres in the camera's axes (y down) beside `pred_cam_t`; rotations are of a world with y up. The rig's rest pose is in
no file. The one of a joint is taken to be where the joint above it, unturned, has it; twists are 0 on average over the frames.
"""

from typing import Any

import numpy as np

from humangs_jax.core.array_types import Float
from humangs_jax.data.motion.skeleton import Clip
from humangs_jax.geometry.mesh import smallest_turns, unit

JOINTS = {
    1: ("pelvis", -1), 2: ("left_hip", 1), 3: ("left_knee", 2), 4: ("left_ankle", 3), 8: ("left_foot", 4),
    18: ("right_hip", 1), 19: ("right_knee", 18), 20: ("right_ankle", 19), 24: ("right_foot", 20),
    34: ("spine0", 1), 35: ("spine1", 34), 36: ("spine2", 35), 37: ("spine3", 36), 110: ("neck", 37), 113: ("head", 110),
    74: ("left_collar", 37), 75: ("left_shoulder", 74), 76: ("left_elbow", 75), 78: ("left_wrist", 76),
    38: ("right_collar", 37), 39: ("right_shoulder", 38), 40: ("right_elbow", 39), 42: ("right_wrist", 40),
}  # fmt: skip
"""Of the rig's 127: name and the joint above."""
COUNT = 127
Y_UP = np.array([1.0, -1.0, -1.0])


def clip_of_points(file: Any, fps: float) -> Clip:
    """The skeleton in motion of an `ArrayFile`. Raises: the file's error, naming the key."""
    points = _frames(file, "pred_joint_coords", (COUNT, 3))[:, list(JOINTS)]
    if "pred_cam_t" in file.values:
        points = points + _frames(file, "pred_cam_t", (3,), len(points))[:, None]
    else:
        file.said.append("the file has no pred_cam_t: people stay in place")
    index = {joint: i for i, joint in enumerate(JOINTS)}
    parents = tuple(index.get(parent, -1) for _, parent in JOINTS.values())
    places = points * Y_UP
    if "pred_global_rots" in file.values:
        turns = _frames(file, "pred_global_rots", (COUNT, 3, 3), len(points))[:, list(JOINTS)]
    else:
        turns = _carried(places, parents)
    rest = np.zeros(places.shape[1:])
    for i, p in enumerate(parents):
        if p >= 0:
            rest[i] = rest[p] + np.einsum("mba,mb->ma", turns[:, p], places[:, i] - places[:, p]).mean(axis=0)
    names = tuple(name for name, _ in JOINTS.values())
    return Clip(names, parents, rest, turns, places, fps, "y", "; ".join(file.said))


def _frames(file: Any, key: str, shape: tuple[int, ...], count: int | None = None) -> Float[np.ndarray, "m ..."]:
    """Of a file of one frame or of many."""
    values = file.numbers(key, None)
    values = values.reshape(1, *shape) if values.size == np.prod(shape) else values
    if values.shape[1:] != shape and values.shape[2:] == shape and values.shape[1] == 1:
        values = values[:, 0]
    return values if values.shape == (count or len(values), *shape) else file.numbers(key, (count, *shape))


def _carried(places: Float[np.ndarray, "m s 3"], parents: tuple[int, ...]) -> Float[np.ndarray, "m s 3 3"]:
    """Rotations of bones from the first frame on, where a file has none: the smallest turns down the tree."""
    turns = np.tile(np.eye(3), (*places.shape[:2], 1, 1))
    for i, p in enumerate(parents):
        if p >= 0:
            first = unit(places[0, i] - places[0, p])
            turns[:, p] = smallest_turns(turns[:, p] @ first, unit(places[:, i] - places[:, p])) @ turns[:, p]
            turns[:, i] = turns[:, p]
    return turns
