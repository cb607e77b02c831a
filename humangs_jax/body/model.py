"""A body model: shape -> pose -> vertices, for any number of vertices n and joints j.

    rest(beta)  = template + shape_directions beta                      (T-pose, theta = 0)
    joints      = joint_regressor rest(beta)
    posed       = blend skinning of rest(beta) + pose_directions (R - I), then the translation.

Metres, y up, the person faces +z with the left side at +x. SMPL-X is one such model, the CC0 body shipped with the
package another (`humangs_jax.body.library.load_body`).
"""

import jax.numpy as jnp

from humangs_jax.body import skinning
from humangs_jax.core.array_types import Array, Bool, Float, Int
from humangs_jax.core.checks import checked_arguments
from humangs_jax.core.pytree import Batchable, pytree_dataclass, replace, static_field
from humangs_jax.geometry import quaternion, transform


@pytree_dataclass
class Texels:
    """Which point of the body's surface each texel of a map shows; row 0 on top.

    corners: (h, w, 3) vertices of the texel's face. weights: (h, w, 3) of these vertices, of sum 1; 0 where it shows nothing.
    """

    corners: Int[Array, "h w 3"]
    weights: Float[Array, "h w 3"]

    @property
    def covered(self) -> Bool[Array, "h w"]:
        """Which texels show the surface."""
        return jnp.any(self.weights > 0, axis=-1)

    def interpolate(self, values: Float[Array, "n c"]) -> Float[Array, "h w c"]:
        """Values at vertices, as the texels have them; 0 where a texel shows nothing."""
        a, b, c = (self.weights[..., i : i + 1] * values[self.corners[..., i]] for i in range(3))
        return a + b + c


@pytree_dataclass
class BodyModel:
    """An articulated, shapeable triangle mesh: SMPL-X, or the body that comes with the package."""

    template: Float[Array, "n 3"]
    """Mean T-pose, metres."""
    shape_directions: Float[Array, "n 3 s"]
    """Metres per unit of a shape coefficient."""
    pose_directions: Float[Array, "n 3 q"] | None
    """Metres; q = 9 (j - 1) entries of R_j - I, row-major, joints 1 and up."""
    joint_regressor: Float[Array, "j n"]
    """Joints from rest vertices; rows sum to 1."""
    skinning_weights: Float[Array, "n j"]
    """Non-negative, rows sum to 1."""
    faces: Int[Array, "f 3"]
    """Vertex indices, counter-clockwise seen from outside."""
    uvs: Float[Array, "u 2"] | None = None
    """Texture coordinates, v up."""
    uv_faces: Int[Array, "f 3"] | None = None
    """Indices into `uvs`."""
    collapse_order: Int[Array, " n"] | None = None
    """Of progressive decimation, with `collapse_into`: `body.resolution`."""
    collapse_into: Int[Array, " n"] | None = None
    spacing: Float[Array, " n"] | None = None
    """Distance to neighboring vertices relative to the mesh that was subdivided: `body.subdivision`."""
    texels: Texels | None = None
    """A map of the surface, for networks that work on one: `network.parts`."""
    parents: tuple[int, ...] = static_field(default=())
    """Parent of each joint, -1 for the root."""
    joint_names: tuple[str, ...] = static_field(default=())
    shape_names: tuple[str, ...] = static_field(default=())
    """Of the shape directions."""
    name: str = static_field(default="body")
    made_for: tuple | None = static_field(default=None)
    """What `data.views.gaussian_body` has made it for; None: a body as it was read."""


@pytree_dataclass
class BodyPose(Batchable):
    """A pose, or a batch of poses."""

    rotations: Float[Array, "j 3"]
    """Axis-angle of each joint relative to its parent, radians."""
    translation: Float[Array, "3"]
    """Metres, applied last."""


@pytree_dataclass
class RestBody(Batchable):
    """A shaped body in T-pose (theta = 0). vertices: (n, 3) metres. joints: (j, 3) metres."""

    vertices: Float[Array, "n 3"]
    joints: Float[Array, "j 3"]


@pytree_dataclass
class PosedBody(Batchable):
    """A posed body.

    vertices: (n, 3) metres. joint_transforms: (j, 4, 4) from rest to posed space, translation included.
    joints: (j, 3) metres.
    """

    vertices: Float[Array, "n 3"]
    joint_transforms: Float[Array, "j 4 4"]
    joints: Float[Array, "j 3"]


@checked_arguments
def rest_pose(body: BodyModel) -> BodyPose:
    """The T-pose: no rotation, no translation."""
    dtype = body.template.dtype
    return BodyPose(jnp.zeros((len(body.parents), 3), dtype), jnp.zeros(3, dtype))


@checked_arguments
def shape_body(body: BodyModel, betas: Float[Array, " s_used"]) -> RestBody:
    """The T-pose of a person.

    Arguments: betas, coefficients of the first directions; missing ones are 0.
    Raises: ValueError if there are more coefficients than directions.
    """
    used, available = betas.shape[0], body.shape_directions.shape[-1]
    if used > available:
        raise ValueError(f"{used} shape coefficients, but body '{body.name}' has {available} shape directions")
    directions = body.shape_directions[..., :used]
    vertices = body.template + jnp.einsum("nas,s->na", directions, betas, precision=skinning.EXACT)
    return RestBody(vertices, jnp.matmul(body.joint_regressor, vertices, precision=skinning.EXACT))


def without_expression(body: BodyModel) -> BodyModel:
    """The body without the directions of facial expressions, which come last in SMPL-X models: those are no shape of a person."""
    count = sum(not name.startswith("expression_") for name in body.shape_names)
    if not body.shape_names or count == len(body.shape_names):
        return body
    return replace(body, shape_directions=body.shape_directions[..., :count], shape_names=body.shape_names[:count])


def pose_features(rotations: Float[Array, "j 3"]) -> Float[Array, " q"]:
    """R_j - I of joints 1 and up, row-major: what the pose correctives are linear in."""
    matrices = quaternion.matrix_from_axis_angle(rotations[1:])
    return (matrices - jnp.eye(3, dtype=matrices.dtype)).reshape(-1)


def person_vertices(body: BodyModel, betas: Float[Array, " s_used"], pose: BodyPose) -> Float[Array, "n 3"]:
    """Vertices of a person in a pose, metres."""
    return pose_body(body, shape_body(body, betas), pose).vertices


@checked_arguments
def pose_body(body: BodyModel, rest: RestBody, pose: BodyPose) -> PosedBody:
    """Pose a shaped body: correctives, blend skinning, translation."""
    vertices = rest.vertices
    if body.pose_directions is not None:
        features = pose_features(pose.rotations)
        vertices = vertices + jnp.einsum("naq,q->na", body.pose_directions, features, precision=skinning.EXACT)
    transforms = skinning.joint_transforms(rest.joints, body.parents, pose.rotations, pose.translation)
    blended = skinning.blend_transforms(body.skinning_weights, transforms)
    return PosedBody(transform.apply(blended, vertices), transforms, transform.apply(transforms, rest.joints))
