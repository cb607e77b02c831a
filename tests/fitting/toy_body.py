"""A body of four joints and eight landmarks: what is fitted to it compiles and runs quickly."""

import jax.numpy as jnp
import numpy as np

from humangs_jax.body.landmarks import LandmarkModel
from humangs_jax.body.model import SurfacePoints

JOINTS = np.asarray([[0, 0, 0], [0, 0.5, 0], [0, 1.0, 0], [0.5, 1.0, 0]], np.float32)


def toy_model():
    """Four joints and eight landmarks: the joints, and a point beside each."""
    beside = JOINTS + np.asarray([0.05, 0.1, 0.15], np.float32)
    points = SurfacePoints(jnp.asarray(beside), jnp.zeros((4, 3, 1)), None, jnp.eye(4))
    names = tuple(f"joint{i}" for i in range(4))
    return LandmarkModel(
        joints=jnp.asarray(JOINTS),
        joint_directions=jnp.asarray(0.1 * JOINTS[..., None]),
        points=points,
        regressor=jnp.eye(8),
        certainty=jnp.ones(8),
        names=(*names, *(f"point{i}" for i in range(4))),
        known=(True,) * 8,
        parents=(-1, 0, 1, 2),
        joint_names=names,
        movers=(0, 1, 2, 3),
    )


MODEL = toy_model()
