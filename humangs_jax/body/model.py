"""A body model: shape -> pose -> vertices, for any number of vertices n and joints j.

    rest(beta)  = template + shape_directions beta                      (T-pose, theta = 0)
    joints      = joint_regressor rest(beta)
    posed       = blend skinning of rest(beta) + pose_directions (R - I), then the translation.

G_j = (posed frame of joint j) (rest frame of j)^-1 moves a point that is fixed to j. With R_j the
local rotation, J_j the rest joint and p its parent:

    W_j = W_p R_j,    t_j = t_p + W_p (J_j - J_p),    G_j = [W_j | t_j - W_j J_j + translation].

Rotations turn about the joints in the rest pose, whose frames are all aligned with the world
(SMPL's convention). Products ask for full precision. Otherwise accelerators round float32 factors
to 8 or 10 bits, which would move vertices by millimetres.

Metres, y up, the person faces +z with the left side at +x. SMPL-X is one such model, the CC0 body
shipped with the package another (`humangs_jax.body.library.load_body`).
"""

import jax
import jax.numpy as jnp
import numpy as np

from humangs_jax.body.expressions import Expressions
from humangs_jax.core.array_types import Array, Bool, Float, Int
from humangs_jax.core.checks import checked_arguments
from humangs_jax.core.compiled import compiled
from humangs_jax.core.pytree import Batchable, pytree_dataclass, replace, static_field
from humangs_jax.geometry import quaternion, transform

# Skinning
# --------------------------------------------------------------------------------------------------


EXACT = transform.EXACT


def ancestors(parents: tuple[int, ...]) -> list[np.ndarray]:
    """Returns arrays of indices, (j,) each: of every joint's parent, then of its second, fourth,
    eighth ... ancestor. The index is j where there is no such ancestor.

    Raises: ValueError unless all joints descend from one root (-1).
    """
    count, found = len(parents), []
    wrong = ValueError(
        f"parents {parents}: expected joints that all descend from one root, whose parent is -1"
    )
    if list(parents).count(-1) != 1 or not set(parents) <= set(range(-1, count)):
        raise wrong
    up = np.asarray([*(count if parent == -1 else parent for parent in parents), count])
    while (up[:-1] < count).any():
        if len(found) > count.bit_length():
            raise wrong
        found.append(up[:-1])
        up = up[up]
    return found


def joint_transforms(
    rest_joints: Float[Array, "j 3"],
    parents: tuple[int, ...],
    rotations: Float[Array, "j 3"],
    translation: Float[Array, "3"],
) -> Float[Array, "j 4 4"]:
    """Returns the rigid transforms G_j of every joint from rest to posed space, (j, 4, 4).

    Arguments: rest_joints in metres; parents, -1 for the root; rotations as axis-angle in radians,
    relative to the parent; translation in metres, applied last.

    The chain is composed by doubling: after each round a transform includes twice as many
    ancestors. Ten levels take four rounds, and the program compiles in a third of the time of one
    that goes level by level.

    Raises: as `ancestors`.
    """
    local = quaternion.matrix_from_axis_angle(rotations)
    iterations = ancestors(parents)
    root = parents.index(-1)
    bones = rest_joints - rest_joints[np.asarray([max(parent, 0) for parent in parents])]
    bones = bones.at[root].set(rest_joints[root])
    world, position = local, bones
    for up in iterations:
        above = jnp.concatenate([world, jnp.eye(3, dtype=world.dtype)[None]])[up]
        from_above = jnp.concatenate([position, jnp.zeros((1, 3), position.dtype)])[up]
        position = from_above + jnp.sum(above * position[..., None, :], axis=-1)
        world = _product(above, world)
    offset = position - jnp.einsum("jab,jb->ja", world, rest_joints, precision=EXACT) + translation
    return transform.make(world, offset)


def _product(a: Float[Array, "*b i j"], b: Float[Array, "*b j k"]) -> Float[Array, "*b i k"]:
    """Returns the product of matrices by multiplying and adding, which has full precision on every
    backend.

    XLA's CPU compiler (jax 0.10 to 0.12) rejects the batched `dot` that two nested vmaps make of
    this product.
    """
    return jnp.sum(a[..., :, :, None] * b[..., None, :, :], axis=-2)


def blend_transforms(
    weights: Float[Array, "n j"], transforms: Float[Array, "j 4 4"]
) -> Float[Array, "n 4 4"]:
    """Returns T_n = sum_j w_nj G_j for each vertex, (n, 4, 4). Its linear part is in general no
    rotation.
    """
    return jnp.einsum("nj,jab->nab", weights, transforms, precision=EXACT)


def blend_leg_weights(
    points: Float[Array, "g 3"],
    distances: Float[Array, " g"],
    weights: Float[Array, "g j"],
    vertices: Float[Array, "n 3"],
    vertex_weights: Float[Array, "n j"],
    legs: Bool[Array, "2 j"],
    reach: float,
) -> Float[Array, "g j"]:
    """Returns skinning weights (g, j) of points off the skin. Points between the legs get mean
    weights of the body around them, so that a hem does not tear when the legs part.

    The mean for a point is taken over every eighth vertex, with a normal kernel around the point.
    The standard deviation of the kernel is d, the distance of the point from its vertex. The
    weights move towards the mean by a share, the product of two factors. The first factor rises
    from 0 at d = 3/4 `reach` to 1 at d = 5/4 `reach`. The second factor is ten times the smaller of
    the two legs' shares in the mean, at most 1. So hair and sleeves keep their weights. At most a
    quarter of the points change, those with the largest d. LHM diffuses weights through a grid of
    voxels for the same purpose (https://arxiv.org/abs/2503.10625).

    Arguments: points: in the rest pose, metres. distances: of each point from its vertex, metres.
    weights: of the vertex of each point. vertices, vertex_weights: of the body in the rest pose.
    legs: whether each joint belongs to each leg, (2, j). reach: metres.
    """
    # every eighth vertex is enough to average skinning weights over centimetres
    near, near_weights = vertices[::8], vertex_weights[::8]
    distances, far = jax.lax.top_k(distances, -(-len(points) // 4))

    def around(point_and_distance):
        point, distance = point_and_distance
        squared = jnp.sum(jnp.square(near - point), axis=-1)
        exponents = -squared / (2 * jnp.square(jnp.maximum(distance, reach / 2)))
        return jnp.einsum("n,nj->j", jax.nn.softmax(exponents), near_weights, precision=EXACT)

    # 2048 points at once: their distances to all these vertices are in memory
    spread = jax.lax.map(around, (points[far], distances), batch_size=2048)
    # a point is between the legs where each has at least a tenth of the weight
    of_legs = jnp.einsum("gj,lj->gl", spread, legs.astype(spread.dtype), precision=EXACT)
    between = jnp.clip(jnp.min(of_legs, axis=-1) / 0.1, 0, 1)
    share = jnp.clip(2 * distances / reach - 1.5, 0, 1) * between
    return weights.at[far].add(share[:, None] * (spread - weights[far]))


# Points of the surface, posed without the rest of it
# ------------------------------------------------------------------


@pytree_dataclass
class SurfacePoints:
    """p points of a body with j joints. They can be posed without the rest of the body, and joined
    with others.
    """

    rest: Float[Array, "p 3"]
    """The points of the mean shape in T-pose, (p, 3), metres."""
    directions: Float[Array, "p 3 s"]
    """Change of the points per unit of a shape coefficient, (p, 3, s), metres."""
    corrections: Float[Array, "p 3 q"] | None
    """Change of the points per unit of the pose's features, (p, 3, q), see `pose_features`, or
    None.
    """
    weights: Float[Array, "p j"]
    """Skinning weights, (p, j)."""


def surface_points(body: "BodyModel") -> SurfacePoints:
    """Returns all vertices of a body as points."""
    return SurfacePoints(
        body.template, body.shape_directions, body.pose_directions, body.skinning_weights
    )


def shaped(
    mean: Float[Array, "p 3"], directions: Float[Array, "p 3 s"], betas: Float[Array, " s_used"]
) -> Float[Array, "p 3"]:
    """Returns the points or joints of a person in T-pose, (p, 3), metres. Missing coefficients
    count as 0.
    """
    return mean + jnp.einsum("pas,s->pa", directions[..., : betas.shape[0]], betas, precision=EXACT)


def pose_points(
    points: SurfacePoints,
    betas: Float[Array, " s_used"],
    features: Float[Array, " q"] | None,
    transforms: Float[Array, "j 4 4"],
) -> Float[Array, "p 3"]:
    """Returns the points of a person in a pose, (p, 3), metres.

    features: `pose_features` of the pose, ignored by points without `corrections`. transforms: of
    the joints, from rest to posed space.
    """
    rest = shaped(points.rest, points.directions, betas)
    if points.corrections is not None:
        rest = rest + jnp.einsum("paq,q->pa", points.corrections, features, precision=EXACT)
    return transform.apply(blend_transforms(points.weights, transforms), rest)


# Posing
# --------------------------------------------------------------------------------------------------


@pytree_dataclass
class Texels:
    """The point of the body's surface that each texel of a map shows. Row 0 is the top."""

    corners: Int[Array, "h w 3"]
    """Vertices of the texel's face, (h, w, 3)."""
    weights: Float[Array, "h w 3"]
    """Weights of these vertices, (h, w, 3), of sum 1; 0 where the texel shows nothing."""

    @property
    def covered(self) -> Bool[Array, "h w"]:
        """Whether each texel shows the surface, (h, w)."""
        return jnp.any(self.weights > 0, axis=-1)

    def interpolate(self, values: Float[Array, "n c"]) -> Float[Array, "h w c"]:
        """Returns values at vertices (n, c) interpolated for each texel, (h, w, c); 0 where a texel
        shows nothing.
        """
        a, b, c = (self.weights[..., i : i + 1] * values[self.corners[..., i]] for i in range(3))
        return a + b + c


@pytree_dataclass
class BodyModel:
    """An articulated, shapeable triangle mesh: SMPL-X, or the body that comes with the package."""

    template: Float[Array, "n 3"]
    """Vertices of the mean T-pose, metres."""
    shape_directions: Float[Array, "n 3 s"]
    """Change of the vertices per unit of a shape coefficient, (n, 3, s), metres."""
    pose_directions: Float[Array, "n 3 q"] | None
    """Change of the vertices per unit of the pose's features, (n, 3, q), metres, or None. The q = 9
    (j - 1) features are the entries of R_j - I, row-major, of joints 1 and up.
    """
    joint_regressor: Float[Array, "j n"]
    """Weights of the rest vertices in each joint; rows sum to 1."""
    skinning_weights: Float[Array, "n j"]
    """Weights of the joints for each vertex, not negative; rows sum to 1."""
    faces: Int[Array, "f 3"]
    """Vertex indices, counter-clockwise seen from outside."""
    uvs: Float[Array, "u 2"] | None = None
    """Texture coordinates, (u, 2), v up."""
    uv_faces: Int[Array, "f 3"] | None = None
    """Indices into `uvs` of the corners of each face, (f, 3)."""
    collapse_order: Int[Array, " n"] | None = None
    """Rank of each vertex in progressive decimation, (n,). 0 stays longest, n - 1 vanishes first.
    None: `body.resolution` computes the ranks when they are needed.
    """
    collapse_into: Int[Array, " n"] | None = None
    """Vertex that each vertex moves onto when it vanishes, (n,). A vertex that never vanishes has
    its own number. None: as for `collapse_order`.
    """
    relative_vertex_spacing: Float[Array, " n"] | None = None
    """Spacing of the vertices around each vertex, divided by the spacing in another mesh, (n,). The
    other mesh is the one before long edges were split (`body.resolution.split_long_edges`), or the
    one that weights were trained with (`data.views.gaussian_body`). None: 1 everywhere.
    """
    texels: Texels | None = None
    """The point of the surface that each texel of a map shows, for networks that work on a map, see
    `network.parts`.
    """
    expressions: Expressions | None = None
    """Expressions of the body's face. None: the face is rigid."""
    parents: tuple[int, ...] = static_field(default=())
    """Parent of each joint, -1 for the root."""
    joint_names: tuple[str, ...] = static_field(default=())
    """Names of the j joints."""
    shape_names: tuple[str, ...] = static_field(default=())
    """Names of the s shape directions."""
    name: str = static_field(default="body")
    """Name of the body in messages."""
    remesh_key: tuple | None = static_field(default=None)
    """If `data.views.gaussian_body` has made this body: the result of `data.views.remesh_key` that
    says how. Otherwise None.
    """


@pytree_dataclass
class BodyPose(Batchable):
    """A pose, or a batch of poses."""

    rotations: Float[Array, "j 3"]
    """Axis-angle of each joint relative to its parent, radians."""
    translation: Float[Array, "3"]
    """Translation, metres, applied last."""
    expression: Float[Array, " e"] | None = None
    """A coefficient for each of the body's expressions, (e,), mostly in [0, 1]. None: a face at
    rest, which costs no computation.
    """


@pytree_dataclass
class RestBody(Batchable):
    """A body with a person's shape, in T-pose (theta = 0)."""

    vertices: Float[Array, "n 3"]
    """Vertices, (n, 3), metres."""
    joints: Float[Array, "j 3"]
    """Joints, (j, 3), metres."""


@pytree_dataclass
class PosedBody(Batchable):
    """A body in a pose."""

    vertices: Float[Array, "n 3"]
    """Vertices, (n, 3), metres."""
    joint_transforms: Float[Array, "j 4 4"]
    """Transforms from rest to posed space, (j, 4, 4), translation included."""
    joints: Float[Array, "j 3"]
    """Joints, (j, 3), metres."""


@checked_arguments
def rest_pose(body: BodyModel) -> BodyPose:
    """Returns the pose of a T-pose: no rotation, no translation, no expression."""
    dtype = body.template.dtype
    return BodyPose(jnp.zeros((len(body.parents), 3), dtype), jnp.zeros(3, dtype))


@checked_arguments
def shape_body(body: BodyModel, betas: Float[Array, " s_used"]) -> RestBody:
    """Returns the body of a person in T-pose.

    Arguments: betas: coefficients of the first shape directions; missing ones count as 0.
    Raises: ValueError if there are more coefficients than directions.
    """
    used, available = betas.shape[0], body.shape_directions.shape[-1]
    if used > available:
        raise ValueError(
            f"{used} shape coefficients, but body '{body.name}' has {available} shape directions"
        )
    return _shaped_body(body.template, body.shape_directions, body.joint_regressor, betas)


@compiled()
def _shaped_body(
    template: Float[Array, "n 3"],
    directions: Float[Array, "n 3 s"],
    regressor: Float[Array, "j n"],
    betas: Float[Array, " s_used"],
) -> RestBody:
    vertices = shaped(template, directions, betas)
    return RestBody(vertices, jnp.matmul(regressor, vertices, precision=EXACT))


def without_expression(body: BodyModel) -> BodyModel:
    """Returns the body without the shape directions of facial expressions, which are no part of a
    person's shape. They come last in SMPL-X models.
    """
    count = sum(not name.startswith("expression_") for name in body.shape_names)
    if not body.shape_names or count == len(body.shape_names):
        return body
    return replace(
        body,
        shape_directions=body.shape_directions[..., :count],
        shape_names=body.shape_names[:count],
    )


def expressed(
    expressions: Expressions | None, rest: RestBody, pose: BodyPose
) -> tuple[RestBody, BodyPose]:
    """Returns the rest body with a pose's expression applied, and the pose without the expression.
    The expression's turns of joints are added to the rotations of the returned pose.

    Raises: ValueError if the pose has another number of coefficients than the body has expressions.
    """
    if pose.expression is None:
        return rest, pose
    count = 0
    if expressions is not None:
        count = len(expressions.names)
    if expressions is None or pose.expression.shape != (count,):
        raise ValueError(
            f"pose.expression: expected {count} coefficients, the expressions of this body, got"
            f" shape {pose.expression.shape}"
        )

    def moved(directions):
        return jnp.einsum("mae,e->ma", directions, pose.expression, precision=EXACT)

    vertices = rest.vertices.at[expressions.vertices].add(moved(expressions.directions))
    joints, rotations = rest.joints, pose.rotations
    if expressions.joint_directions is not None:
        joints = joints + moved(expressions.joint_directions)
    if expressions.joint_turns is not None:
        rotations = rotations + moved(expressions.joint_turns)
    return RestBody(vertices, joints), BodyPose(rotations, pose.translation)


def pose_features(rotations: Float[Array, "j 3"]) -> Float[Array, " q"]:
    """Returns R_j - I of joints 1 and up, row-major, (q,). Pose correctives are linear in these
    features.
    """
    matrices = quaternion.matrix_from_axis_angle(rotations[1:])
    return (matrices - jnp.eye(3, dtype=matrices.dtype)).reshape(-1)


def person_vertices(
    body: BodyModel, betas: Float[Array, " s_used"], pose: BodyPose
) -> Float[Array, "n 3"]:
    """Returns the vertices of a person in a pose, (n, 3), metres. Raises: as `shape_body` and
    `pose_body`.
    """
    return pose_body(body, shape_body(body, betas), pose).vertices


@checked_arguments
def pose_body(body: BodyModel, rest: RestBody, pose: BodyPose) -> PosedBody:
    """Returns a shaped body in a pose. Expression, pose correctives, blend skinning and translation
    are applied in this order.

    Raises: ValueError if the pose has another number of coefficients than the body has expressions.
    """
    rest, pose = expressed(body.expressions, rest, pose)
    vertices = rest.vertices
    if body.pose_directions is not None:
        features = pose_features(pose.rotations)
        vertices = vertices + jnp.einsum(
            "naq,q->na", body.pose_directions, features, precision=EXACT
        )
    transforms = joint_transforms(rest.joints, body.parents, pose.rotations, pose.translation)
    blended = blend_transforms(body.skinning_weights, transforms)
    return PosedBody(
        transform.apply(blended, vertices), transforms, transform.apply(transforms, rest.joints)
    )
