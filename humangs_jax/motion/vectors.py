"""Reads motions that are a single array without keys, and rotations of six numbers (MDM).

The shape of the array decides what its numbers are. A row of Motion-X has 322 numbers
(https://github.com/IDEA-Research/Motion-X): root 3, body 63, hands 90, jaw 3, expression 50, shape
of the face 100, translation 3, shape 10. The six numbers of a rotation are the first two rows of
its matrix, before they are made orthonormal (Zhou et al., arXiv 1812.07035).
"""

from collections.abc import Mapping
from typing import Any

import numpy as np

from humangs_jax.core.array_types import Float
from humangs_jax.io.reading import InvalidFileError
from humangs_jax.io.restricted_pickle import as_array
from humangs_jax.motion.rules import COLUMNS

_POSES = "(m,165/156/72/66)"
"""The key under which an array of poses is read."""
_PARTS = {
    "root_orient": (0, 3),
    "pose_body": (3, 66),
    "pose_hand": (66, 156),
    "pose_jaw": (156, 159),
    "trans": (309, 312),
}
_COLUMNS_OF_MOTION_X = 322
_RENDER = (
    "make rotations of them, as MDM's `python -m visualize.render_mesh` does (*_smpl_params.npy)"
)
_FEATURES = {263: "HumanML3D", 251: "KIT-ML"}
"""For each known number of columns of feature vectors, the data set that has it."""
_JOINTS = {22: "HumanML3D's new_joints", 21: "KIT-ML's new_joints"}
"""For each known number of joints in space, the files that have it."""


def values_of(array: np.ndarray) -> dict[str, np.ndarray]:
    """Splits an array into values by key.

    Raises: InvalidFileError, which says what the array is, if it has no known layout.
    """
    shape = array.shape
    columns = shape[-1] if shape else 0
    # rotations, in one of the layouts that are read
    if array.ndim == 2 and columns == _COLUMNS_OF_MOTION_X:
        parts = {key: array[:, first:end] for key, (first, end) in _PARTS.items()}
        return {"(m,322)": array, **parts}
    if array.ndim == 2 and columns in COLUMNS:
        return {_POSES: array}
    if array.ndim == 4 and shape[2:] == (3, 3):
        return {_POSES: array}
    # arrays of other programs that are known, and are no rotations
    if array.ndim == 2 and columns in _FEATURES:
        raise InvalidFileError(
            f"{columns} features a frame of {_FEATURES[columns]}, not rotations: recover the joints"
            f" and {_RENDER}"
        )
    if array.ndim == 3 and columns == 3:
        whose = ""
        if shape[1] in _JOINTS:
            whose = f" ({_JOINTS[shape[1]]})"
        wanted = "expected a row of axis-angles a frame"
        raise InvalidFileError(
            f"{shape[1]} joints in space{whose}, or axis-angles in three axes: {wanted}; {_RENDER}"
        )
    known = ", ".join(map(str, (_COLUMNS_OF_MOTION_X, *COLUMNS)))
    raise InvalidFileError(
        f"an array of shape {shape}: expected (frames, columns) with {known} columns, or a dict of"
        " arrays by name"
    )


def hint_for(values: Mapping[Any, Any]) -> str:
    """Returns a hint about values that are not a motion, or "" if there is no hint."""
    if values.keys() >= {"motion", "text", "lengths"}:
        return f"; these are joints in space that MDM sampled: {_RENDER}"
    return ""


def frames_first(values: Mapping[str, Any], rotations: str, moves: str) -> dict[str, Any]:
    """Returns the values with matrices, (m, j, 3, 3), in place of rotations of six numbers, and
    with frames as the first axis of the positions.

    rotations: key of an array (j, 6, m) or (m, j, 6). moves: key of the positions. If the rotations
    are (j, 6, m), the positions have to be (3, m), and become (m, 3).

    Raises: InvalidFileError, which names the key, if the rotations have another shape or are no
    real numbers.
    """
    six = np.asarray(as_array(values[rotations]))
    last = six.ndim == 3 and six.shape[1] == 6
    if not last and (six.ndim != 3 or six.shape[2] != 6):
        raise InvalidFileError(f"{rotations}: expected shape (24, 6, frames), got {six.shape}")
    if six.dtype.kind not in "fiu":
        raise InvalidFileError(f"{rotations}: expected real numbers, got {six.dtype}")
    if last:
        six = six.transpose(2, 0, 1)
    changed: dict[str, Any] = {rotations: _matrices_of(six)}
    if moves in values:
        places = np.asarray(as_array(values[moves]))
        changed[moves] = places.T if last else places
    return {**values, **changed}


def _matrices_of(six: Float[np.ndarray, "*b 6"]) -> Float[np.ndarray, "*b 3 3"]:
    """Returns rotation matrices from their first two rows. A matrix is not finite if one of these
    rows is 0, or if they are parallel.
    """
    a, b = np.asarray(six[..., :3], np.float64), np.asarray(six[..., 3:], np.float64)
    with np.errstate(all="ignore"):
        first = a / np.linalg.norm(a, axis=-1, keepdims=True)
        across = b - (first * b).sum(axis=-1, keepdims=True) * first
        second = across / np.linalg.norm(across, axis=-1, keepdims=True)
    return np.stack([first, second, np.cross(first, second)], axis=-2)
