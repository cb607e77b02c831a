"""Kinematic chains and linear blend skinning.

Joint transform of joint j: G_j = (posed frame of j) (rest frame of j)^-1, so that a point x fixed to j moves to G_j x.
With R_j the local rotation, J_j the rest joint and p its parent:

    W_j = W_p R_j,    t_j = t_p + W_p (J_j - J_p),    G_j = [W_j | t_j - W_j J_j + translation].

Rotations turn about the joints in the rest pose, whose frames are all aligned with the world (SMPL's convention).
Products here ask for full precision: accelerators otherwise round float32 factors to 8 or 10 bits, millimetres here.
"""

import jax
import jax.numpy as jnp
import numpy as np

from humangs_jax.core.array_types import Array, Bool, Float
from humangs_jax.core.pytree import pytree_dataclass
from humangs_jax.geometry import quaternion, transform

EXACT = transform.EXACT
THINNING = 8
"""Only every eighth vertex is used: enough to average skinning weights over centimetres."""
BETWEEN = 0.1
"""Share of either leg in the weights around a point from which on it is between them."""
BLOCK = 2048
"""Points whose distances to these vertices are in memory at once."""


def ancestors(parents: tuple[int, ...]) -> list[np.ndarray]:
    """Indices (j,) of every joint's parent, then grandparent, then the fourth, eighth ... ancestor; j where there is none.

    Raises: ValueError if there is not exactly one root (-1), a parent does not exist, or the parents form a cycle.
    """
    count = len(parents)
    if list(parents).count(-1) != 1:
        raise ValueError(f"a body has one root joint with parent -1, got parents {parents}")
    up = np.asarray([*(count if parent == -1 else parent for parent in parents), count])
    if up.min() < 0 or up.max() > count:
        raise ValueError(f"some joints do not descend from the root: parents {parents}")
    iterations = []
    while (up[:-1] < count).any():
        if len(iterations) > count.bit_length():
            raise ValueError(f"some joints do not descend from the root: parents {parents}")
        iterations.append(up[:-1])
        up = up[up]
    return iterations


def joint_transforms(
    rest_joints: Float[Array, "j 3"],
    parents: tuple[int, ...],
    rotations: Float[Array, "j 3"],
    translation: Float[Array, "3"],
) -> Float[Array, "j 4 4"]:
    """G_j of every joint.

    Arguments: rest_joints in metres; parents, root -1; rotations as axis-angle in radians, relative to the parent;
    translation in metres, applied last. Returns: rigid transforms from rest to posed space.

    The chain is composed by doubling: after each round a transform reaches twice as many joints up. Ten levels are four
    iterations, and the program compiles in a third of the time of one that goes level by level.
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
    """Matrix product by multiplying and adding: exact on every backend.

    XLA's CPU compiler (jax 0.10 to 0.12) rejects the batched `dot` that two nested vmaps make of this product.
    """
    return jnp.sum(a[..., :, :, None] * b[..., None, :, :], axis=-2)


def blend_transforms(weights: Float[Array, "n j"], transforms: Float[Array, "j 4 4"]) -> Float[Array, "n 4 4"]:
    """T_n = sum_j w_nj G_j. Its linear part is in general no rotation."""
    return jnp.einsum("nj,jab->nab", weights, transforms, precision=EXACT)


def spread_weights(
    points: Float[Array, "g 3"],
    distances: Float[Array, " g"],
    weights: Float[Array, "g j"],
    vertices: Float[Array, "n 3"],
    vertex_weights: Float[Array, "n j"],
    legs: Bool[Array, "2 j"],
    reach: float,
) -> Float[Array, "g j"]:
    """Skinning weights of points off the skin between the legs, by the body around them and not by one vertex.

    A hem that belongs to the vertices of one leg tears when the legs part. A point at a distance d from the vertex that it
    belongs to takes the mean of the weights of the vertices around it, by a normal kernel whose standard deviation is d. It
    keeps its own where d is less than 3/4 of `reach`, or where one of the legs has no share in that mean: hair and sleeves stay
    as they are. At most a quarter of the points change, those with the largest d. LHM diffuses weights through a grid of voxels
    to the same end (https://arxiv.org/abs/2503.10625).

    Arguments: points in the rest pose, metres. distances: from the vertex of each. weights: of that vertex. legs: the joints of
    each leg.
    """
    near, near_weights = vertices[::THINNING], vertex_weights[::THINNING]
    distances, far = jax.lax.top_k(distances, -(-len(points) // 4))

    def around(point_and_distance):
        point, distance = point_and_distance
        squared = jnp.sum(jnp.square(near - point), axis=-1)
        exponents = -squared / (2 * jnp.square(jnp.maximum(distance, reach / 2)))
        return jnp.einsum("n,nj->j", jax.nn.softmax(exponents), near_weights, precision=EXACT)

    spread = jax.lax.map(around, (points[far], distances), batch_size=BLOCK)
    between = jnp.min(jnp.einsum("gj,lj->gl", spread, legs.astype(spread.dtype), precision=EXACT), axis=-1)
    share = jnp.clip(2 * distances / reach - 1.5, 0, 1) * jnp.clip(between / BETWEEN, 0, 1)
    return weights.at[far].add(share[:, None] * (spread - weights[far]))


# Points of the surface, posed without the rest of it ------------------------------------------------------------------


@pytree_dataclass
class SurfacePoints:
    """p points of a body with j joints; batches and concatenations of them are again such points.

    rest: (p, 3) of the mean shape in T-pose, metres. directions: (p, 3, s) metres per unit of a shape coefficient.
    corrections: (p, 3, q) of the pose's features, see `pose_features`, or None. weights: (p, j) of the skinning.
    """

    rest: Float[Array, "p 3"]
    directions: Float[Array, "p 3 s"]
    corrections: Float[Array, "p 3 q"] | None
    weights: Float[Array, "p j"]


def shaped(
    mean: Float[Array, "p 3"], directions: Float[Array, "p 3 s"], betas: Float[Array, " s_used"]
) -> Float[Array, "p 3"]:
    """Points or joints of a person in T-pose, metres; missing coefficients are 0."""
    return mean + jnp.einsum("pas,s->pa", directions[..., : betas.shape[0]], betas, precision=EXACT)


def pose_points(
    points: SurfacePoints,
    betas: Float[Array, " s_used"],
    features: Float[Array, " q"] | None,
    transforms: Float[Array, "j 4 4"],
) -> Float[Array, "p 3"]:
    """Where the points of a person are, metres. features: of the pose; ignored by bodies without correctives."""
    rest = shaped(points.rest, points.directions, betas)
    if points.corrections is not None:
        rest = rest + jnp.einsum("paq,q->pa", points.corrections, features, precision=EXACT)
    return transform.apply(blend_transforms(points.weights, transforms), rest)
