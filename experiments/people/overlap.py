"""Where a posed body is inside itself: generalised winding numbers (van Oosterom & Strackee's solid angles) of its own mesh.

Just outside of a surface the winding number is 0, and 1 where that point is inside of another part as well.
"""

import jax
import jax.numpy as jnp
import numpy as np

from humangs_jax.body.decimation import decimate
from humangs_jax.body.model import BodyModel, BodyPose, pose_body, shape_body
from humangs_jax.core.array_types import Array, Bool, Float, Int
from humangs_jax.people.kinematics import Rotations
from humangs_jax.rendering.mesh.position_map import vertex_normals

OUTSIDE = 2e-3
"""Metres along the normal at which a vertex asks."""
INSIDE = 0.6
"""Winding number above which a point is inside: meshes are not quite closed (mouth, eyes)."""
AT_ONCE = 64


def winding_numbers(
    points: Float[Array, "q 3"], vertices: Float[Array, "n 3"], faces: Int[Array, "f 3"]
) -> Float[Array, " q"]:
    """How often the mesh winds around each point (q, 3): sum of the signed solid angles of its faces over 4 pi."""
    corners = vertices[faces]
    dot = lambda x, y: jnp.sum(x * y, axis=-1)

    def one(point):
        a, b, c = (corners[:, i] - point for i in range(3))
        la, lb, lc = (jnp.linalg.norm(x, axis=-1) for x in (a, b, c))
        below = la * lb * lc + dot(a, b) * lc + dot(b, c) * la + dot(c, a) * lb
        return jnp.sum(2 * jnp.arctan2(dot(a, jnp.cross(b, c)), below)) / (4 * jnp.pi)

    return jax.lax.map(one, points, batch_size=AT_ONCE)


class OverlapMeter:
    """Asks the vertices of a body, decimated to `count`; those that are inside in T-pose already do not count."""

    def __init__(self, body: BodyModel, count: int = 1600):
        self.body = decimate(body, count)
        self.rest = shape_body(self.body, jnp.zeros(0))
        self.at_rest = np.zeros(len(self.body.template), bool)
        self.at_rest = self.inside(np.zeros((len(body.parents), 3)))

    def inside(self, rotations: Rotations) -> Bool[np.ndarray, " n"]:
        """The vertices (n,) that a pose of rotation vectors (j, 3) puts inside another part of the body."""
        return np.asarray(_inside(self.body, self.rest, jnp.asarray(rotations, jnp.float32))) & ~self.at_rest


@jax.jit
def _inside(body, rest, rotations):
    vertices = pose_body(body, rest, BodyPose(rotations, jnp.zeros(3))).vertices
    points = vertices + OUTSIDE * vertex_normals(vertices, body.faces)
    return winding_numbers(points, vertices, body.faces) > INSIDE
