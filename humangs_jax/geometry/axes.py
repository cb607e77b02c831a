"""Finds which axis of a world points up, and the rotation that turns it to +y. Axes have names such
as "-z".
"""

import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation

from humangs_jax.core.array_types import Float
from humangs_jax.geometry import quaternion

UPRIGHT = {
    "y": (1.0, 0.0, 0.0, 0.0),
    "-y": (0.0, 1.0, 0.0, 0.0),
    "z": (np.sqrt(0.5), -np.sqrt(0.5), 0.0, 0.0),
    "-z": (np.sqrt(0.5), np.sqrt(0.5), 0.0, 0.0),
    "x": (np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5)),
    "-x": (np.sqrt(0.5), 0.0, 0.0, -np.sqrt(0.5)),
}
"""The rotation that turns an axis to +y, a quaternion (wxyz), by the axis's name."""
CLEARLY_UP = 0.5
"""A person stands along an axis of the world if the cosine between this axis and the y axis of the
pelvis is at least this on average.
"""


def upright_matrix(up: str) -> Float[np.ndarray, "3 3"]:
    """Returns the rotation that turns the named axis to +y, a matrix of 0 and +-1, (3, 3)."""
    return np.asarray(quaternion.to_matrix(jnp.asarray(UPRIGHT[up])), np.float64).round()


def nearest_axis(direction: Float[np.ndarray, "3"]) -> tuple[str, float]:
    """Returns the name of the axis along which a vector points most, such as "-z", and the absolute
    value of the vector's component along this axis.
    """
    axis = int(np.argmax(np.abs(direction)))
    sign = "-" if direction[axis] < 0 else ""
    return sign + "xyz"[axis], float(np.abs(direction[axis]))


def standing_axis(root: Float[np.ndarray, "m 3"]) -> str | None:
    """Returns the name of the axis of the world along which a person stands: the y axis of the
    pelvis points along it on average. Returns None if the pelvis points clearly along none of the
    axes, see `CLEARLY_UP`.

    Arguments: root: axis-angle of the pelvis in each frame, (m, 3), radians.
    """
    mean = Rotation.from_rotvec(np.asarray(root, np.float64)).as_matrix()[..., 1].mean(axis=0)
    axis, cosine = nearest_axis(mean)
    return None if cosine < CLEARLY_UP else axis
