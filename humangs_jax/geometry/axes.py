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
"""Least mean cosine between the up direction of a person's pelvis and an axis of the world at which
the person stands along that axis.
"""


def upright_matrix(up: str) -> Float[np.ndarray, "3 3"]:
    """Returns the rotation that turns the named axis to +y, a matrix of 0 and +-1, (3, 3)."""
    return np.asarray(quaternion.to_matrix(jnp.asarray(UPRIGHT[up])), np.float64).round()


def nearest_axis(direction: Float[np.ndarray, "3"]) -> tuple[str, float]:
    """Returns the name of the axis along which a vector points most, and the size of the vector's
    component there.
    """
    axis = int(np.argmax(np.abs(direction)))
    sign = "-" if direction[axis] < 0 else ""
    return sign + "xyz"[axis], float(np.abs(direction[axis]))


def standing_axis(root: Float[np.ndarray, "m 3"]) -> str | None:
    """Returns the name of the world's axis along which the y axis of the pelvis points on average.
    Returns None if no axis is clearly that one, see `CLEARLY_UP`.

    Arguments: root: axis-angle of the pelvis in each frame, (m, 3), radians.
    """
    mean = Rotation.from_rotvec(np.asarray(root, np.float64)).as_matrix()[..., 1].mean(axis=0)
    axis, cosine = nearest_axis(mean)
    return None if cosine < CLEARLY_UP else axis
