"""Which way is up in the world of a motion, and that world turned so that y is."""

import jax.numpy as jnp
import numpy as np

from humangs_jax.core.array_types import Float
from humangs_jax.geometry import quaternion

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


def upright_matrix(up: str) -> Float[np.ndarray, "3 3"]:
    """The rotation that turns the named axis to +y: a matrix of 0 and +-1."""
    return np.asarray(quaternion.to_matrix(jnp.asarray(UPRIGHT[up])), np.float64).round()


def nearest_axis(direction: Float[np.ndarray, "3"]) -> tuple[str, float]:
    """The name of the axis that a vector points along most, and how far it does."""
    axis = int(np.argmax(np.abs(direction)))
    return ("-" if direction[axis] < 0 else "") + "xyz"[axis], float(np.abs(direction[axis]))


def up_axis(root: Float[np.ndarray, "m 3"], usual: str) -> str:
    """The axis of the world that the pelvis's own y axis points along on average; `usual` if none is clear.

    Arguments: root: axis-angle of the pelvis in each frame.
    """
    mean = np.asarray(quaternion.matrix_from_axis_angle(jnp.asarray(root, jnp.float32)))[..., 1].mean(axis=0)
    axis, cosine = nearest_axis(mean)
    return usual if cosine < CLEARLY_UP else axis


def turned_upright(
    rotations: Float[np.ndarray, "m j 3"],
    translations: Float[np.ndarray, "m 3"],
    up: str,
    pelvis: Float[np.ndarray, "3"] = PELVIS,
) -> tuple[Float[np.ndarray, "m j 3"], Float[np.ndarray, "m 3"]]:
    """Poses and positions in a world turned so that the axis `up` becomes +y. pelvis: the root joint in T-pose, metres."""
    if up == "y":
        return rotations, translations
    turn = upright_matrix(up)
    root = quaternion.from_axis_angle(jnp.asarray(rotations[:, 0], jnp.float32))
    root = np.asarray(quaternion.multiply(jnp.asarray(UPRIGHT[up], jnp.float32), root), np.float64)
    root *= np.where(root[:, :1] < 0, -1, 1)  # the shorter way round
    sine = np.linalg.norm(root[:, 1:], axis=1, keepdims=True)
    angle = 2 * np.arctan2(sine, root[:, :1])
    axis_angle = root[:, 1:] * np.where(sine > 0, angle / np.where(sine > 0, sine, 1), 2)
    rotations = np.concatenate([axis_angle[:, None], rotations[:, 1:]], axis=1)
    return rotations, (translations + pelvis) @ turn.T - pelvis
