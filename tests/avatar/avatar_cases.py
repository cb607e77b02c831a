"""A person of two balls, whose surface, normals and parts are known in closed form."""

import jax.numpy as jnp
import numpy as np
import trimesh

from humangs_jax.avatar.avatar import Avatar
from humangs_jax.rendering.gaussians import Gaussians

CENTRES = np.asarray([[0.0, 0.5, 0.0], [0.0, 1.3, 0.0]])
RADIUS = 0.35
SPLAT = 0.0125
"""Standard deviation of its Gaussians, metres. Vertices are 0.017 m apart: little shines through.
"""
NAMES = ("pelvis", "left_shoulder", "right_shoulder")


def two_balls(subdivisions=4):
    """Returns an avatar of two balls, one above the other, with a Gaussian on each vertex.

    Joint 0 turns the lower ball about its centre, joint 1 the upper one, and joint 2 moves nothing.
    """
    ball = trimesh.creation.icosphere(subdivisions, RADIUS)
    n = len(ball.vertices)
    vertices = np.concatenate([ball.vertices + centre for centre in CENTRES])
    weights = np.zeros((2 * n, 3))
    weights[:n, 0] = weights[n:, 1] = 1
    f32 = lambda x: jnp.asarray(x, jnp.float32)
    count = len(vertices)
    gaussians = Gaussians(
        f32(vertices),
        f32(np.tile([1, 0, 0, 0], (count, 1))),
        f32(np.full((count, 3), SPLAT)),
        f32(np.full(count, 0.95)),
        f32(np.random.default_rng(0).random((count, 3))),
    )
    return Avatar(
        gaussians,
        f32(weights),
        f32(vertices),
        f32([*CENTRES, CENTRES[1]]),
        jnp.asarray(np.concatenate([ball.faces, ball.faces + n]), jnp.int32),
        parents=(-1, 0, 0),
        joint_names=NAMES,
    )
