"""The skin of a body as points that are cheap to pose: what fits to surfaces need of a `BodyModel`."""

import jax
import jax.numpy as jnp
import numpy as np

from humangs_jax.array_types import Array, Float, Int
from humangs_jax.body import skinning
from humangs_jax.body.decimation import decimate
from humangs_jax.body.joints import FINGERS
from humangs_jax.body.landmarks import LandmarkModel, landmark_model
from humangs_jax.body.model import BodyModel, BodyPose, pose_features
from humangs_jax.pytree import pytree_dataclass

VERTICES = 7000
"""Evenly spread, of which nearly all can be seen from outside: 1.6 cm apart."""


@pytree_dataclass
class BodySurface:
    """n vertices of a body with j joints.

    points: (n, 3) at rest, metres. point_directions: (n, 3, s). pose_directions: (n, 3, q) or None. weights: (n, j).
    faces: (f, 3). order: (n,) vertices of a number below m are a mesh's of m vertices, evenly spread.
    landmarks: of the same body; joints are these of it.
    """

    points: Float[Array, "n 3"]
    point_directions: Float[Array, "n 3 s"]
    pose_directions: Float[Array, "n 3 q"] | None
    weights: Float[Array, "n j"]
    faces: Int[Array, "f 3"]
    order: Int[Array, " n"]
    covered: Float[Array, " n"]
    landmarks: LandmarkModel


def body_surface(body: BodyModel, names: tuple[str, ...], vertices: int = VERTICES) -> BodySurface:
    """The surface of a body by `vertices` of its vertices (all, if it has fewer), with the landmarks of these names.

    Raises: ValueError if its joints have other names than SMPL-X's.
    """
    small = decimate(body, min(vertices, body.template.shape[0]))
    return BodySurface(
        points=small.template,
        point_directions=small.shape_directions,
        pose_directions=small.pose_directions,
        weights=small.skinning_weights,
        faces=small.faces,
        order=jnp.asarray(np.argsort(np.argsort(np.asarray(small.collapse_order))), jnp.int32),
        covered=1
        - jnp.asarray(np.asarray(small.skinning_weights)[:, _hands(small.joint_names)].sum(axis=1), jnp.float32),
        landmarks=landmark_model(body, names),
    )


def pose_points(
    surface: BodySurface, rows: Int[Array, " r"], betas: Float[Array, " s_used"], pose: BodyPose
) -> tuple[Float[Array, "r 3"], Float[Array, "k 3"], Float[Array, "j 3"]]:
    """Some vertices (r, 3), the landmarks (k, 3) and the joints (j, 3) of a person in a pose, metres."""
    model, s = surface.landmarks, betas.shape[0]
    shaped = lambda mean, directions: (
        mean + jnp.einsum("nas,s->na", directions[..., :s], betas, precision=skinning.EXACT)
    )
    rest = shaped(model.joints, model.joint_directions)
    both = lambda name, own: jnp.concatenate([getattr(surface, name)[rows], own])
    points = shaped(both("points", model.points), both("point_directions", model.point_directions))
    if surface.pose_directions is not None:
        directions = both("pose_directions", model.pose_directions)
        points = points + jnp.einsum("naq,q->na", directions, pose_features(pose.rotations), precision=skinning.EXACT)
    transforms = skinning.joint_transforms(rest, model.parents, pose.rotations, pose.translation)
    joints = skinning.apply_transforms(transforms, rest)
    posed = skinning.apply_transforms(
        skinning.blend_transforms(both("weights", model.point_weights), transforms), points
    )
    count = rows.shape[0]
    landmarks = jnp.matmul(model.regressor, jnp.concatenate([joints, posed[count:]]), precision=skinning.EXACT)
    return posed[:count], landmarks, joints


@jax.jit
def pose_surface(
    surface: BodySurface, betas: Float[Array, " s_used"], pose: BodyPose
) -> tuple[Float[Array, "n 3"], Float[Array, "n 3"]]:
    """All vertices (n, 3), metres, and their unit normals (n, 3), outwards."""
    vertices, _, _ = pose_points(surface, jnp.arange(surface.points.shape[0]), betas, pose)
    return vertices, vertex_normals(vertices, surface.faces)


def vertex_normals(vertices: Float[Array, "n 3"], faces: Int[Array, "f 3"]) -> Float[Array, "n 3"]:
    """(n, 3) unit normals, means of the faces around a vertex by area; 0 at vertices without faces."""
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    across = jnp.cross(b - a, c - a)
    total = jnp.zeros_like(vertices).at[faces.reshape(-1)].add(jnp.repeat(across, 3, axis=0))
    return total / jnp.maximum(jnp.linalg.norm(total, axis=1, keepdims=True), 1e-12)


def _hands(joint_names):
    return [j for j, name in enumerate(joint_names) if name.endswith("_wrist") or any(f in name for f in FINGERS)]
