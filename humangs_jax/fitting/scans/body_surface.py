"""The skin of a body as points that are cheap to pose: what fits to surfaces need of a `BodyModel`."""

import jax
import jax.numpy as jnp
import numpy as np

from humangs_jax.body.decimation import decimate
from humangs_jax.body.joints import FINGERS
from humangs_jax.body.landmarks import LandmarkModel, landmark_model, landmarks_from, pose_joints
from humangs_jax.body.model import BodyModel, BodyPose, pose_features
from humangs_jax.body.surface_points import SurfacePoints, pose_points
from humangs_jax.core.array_types import Array, Float, Int
from humangs_jax.core.pytree import pytree_dataclass
from humangs_jax.rendering.mesh.position_map import vertex_normals

VERTICES = 7000
"""Evenly spread, of which nearly all can be seen from outside: 1.6 cm apart."""


@pytree_dataclass
class BodySurface:
    """n vertices of a body with j joints.

    points: the vertices. faces: (f, 3). order: (n,) vertices of a number below m are a mesh's of m vertices, evenly spread.
    covered: (n,) 0 on hands, 1 where clothes may be. landmarks: of the same body, with its joints.
    """

    points: SurfacePoints
    faces: Int[Array, "f 3"]
    order: Int[Array, " n"]
    covered: Float[Array, " n"]
    landmarks: LandmarkModel


def body_surface(body: BodyModel, names: tuple[str, ...], vertices: int = VERTICES) -> BodySurface:
    """The surface of a body by `vertices` of its vertices (all, if it has fewer), with the landmarks of these names.

    Raises: ValueError if its joints have other names than SMPL-X's.
    """
    small = decimate(body, min(vertices, body.template.shape[0]))
    hands = np.asarray(small.skinning_weights)[:, _hands(small.joint_names)].sum(axis=1)
    return BodySurface(
        points=SurfacePoints(small.template, small.shape_directions, small.pose_directions, small.skinning_weights),
        faces=small.faces,
        order=jnp.asarray(np.argsort(np.argsort(np.asarray(small.collapse_order))), jnp.int32),
        covered=1 - jnp.asarray(hands, jnp.float32),
        landmarks=landmark_model(body, names),
    )


def pose_vertices(
    surface: BodySurface, rows: Int[Array, " r"], betas: Float[Array, " s_used"], pose: BodyPose
) -> tuple[Float[Array, "r 3"], Float[Array, "k 3"], Float[Array, "j 3"]]:
    """Some vertices (r, 3), the landmarks (k, 3) and the joints (j, 3) of a person in a pose, metres."""
    model, count = surface.landmarks, rows.shape[0]
    transforms, joints = pose_joints(model, betas, pose)
    wanted = jax.tree.map(lambda own, marks: jnp.concatenate([own[rows], marks]), surface.points, model.points)
    posed = pose_points(wanted, betas, pose_features(pose.rotations), transforms)
    return posed[:count], landmarks_from(model, joints, posed[count:]), joints


@jax.jit
def pose_surface(
    surface: BodySurface, betas: Float[Array, " s_used"], pose: BodyPose
) -> tuple[Float[Array, "n 3"], Float[Array, "n 3"]]:
    """All vertices (n, 3), metres, and their unit normals (n, 3), outwards."""
    vertices, _, _ = pose_vertices(surface, jnp.arange(surface.points.rest.shape[0]), betas, pose)
    return vertices, vertex_normals(vertices, surface.faces)


def _hands(joint_names):
    return [j for j, name in enumerate(joint_names) if name.endswith("_wrist") or any(f in name for f in FINGERS)]
