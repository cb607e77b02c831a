"""Kinematic chains and linear blend skinning.

Joint transform of joint j: G_j = (posed frame of j) (rest frame of j)^-1, so that a point x fixed to j moves to G_j x.
With R_j the local rotation, J_j the rest joint and p its parent:

    W_j = W_p R_j,    t_j = t_p + W_p (J_j - J_p),    G_j = [W_j | t_j - W_j J_j + translation].

Rotations turn about the joints in the rest pose, whose frames are all aligned with the world (SMPL's convention).
Products here ask for full precision: accelerators otherwise round float32 factors to 8 or 10 bits, millimetres here.
"""

import jax.numpy as jnp
import numpy as np

from humangs_jax.core.array_types import Array, Float
from humangs_jax.geometry import quaternion, transform

EXACT = transform.EXACT


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
    rounds = []
    while (up[:-1] < count).any():
        if len(rounds) > count.bit_length():
            raise ValueError(f"some joints do not descend from the root: parents {parents}")
        rounds.append(up[:-1])
        up = up[up]
    return rounds


def joint_transforms(
    rest_joints: Float[Array, "j 3"],
    parents: tuple[int, ...],
    rotations: Float[Array, "j 3"],
    translation: Float[Array, "3"],
) -> Float[Array, "j 4 4"]:
    """G_j of every joint.

    Arguments: rest_joints in metres; parents, root -1; rotations as axis-angle in radians, relative to the parent;
    translation in metres, applied last. Returns: rigid transforms from rest to posed space.

    The chain is composed by doubling: after each round a transform reaches twice as many joints up. Ten levels are four rounds,
    and the program compiles in a third of the time of one that goes level by level.
    """
    local = quaternion.matrix_from_axis_angle(rotations)
    rounds = ancestors(parents)
    root = parents.index(-1)
    bones = rest_joints - rest_joints[np.asarray([max(parent, 0) for parent in parents])]
    bones = bones.at[root].set(rest_joints[root])
    world, position = local, bones
    for up in rounds:
        above = jnp.concatenate([world, jnp.eye(3, dtype=world.dtype)[None]])[up]
        from_above = jnp.concatenate([position, jnp.zeros((1, 3), position.dtype)])[up]
        position = from_above + jnp.sum(above * position[..., None, :], axis=-1)
        world = _product(above, world)
    offset = position - jnp.einsum("jab,jb->ja", world, rest_joints, precision=EXACT) + translation
    return transform.make(world, offset)


def _product(a, b):
    """Matrix product by multiplying and adding: exact on every backend.

    XLA's CPU compiler (jax 0.10 to 0.12) rejects the batched `dot` that two nested vmaps make of this product.
    """
    return jnp.sum(a[..., :, :, None] * b[..., None, :, :], axis=-2)


def blend_transforms(weights: Float[Array, "n j"], transforms: Float[Array, "j 4 4"]) -> Float[Array, "n 4 4"]:
    """T_n = sum_j w_nj G_j. Its linear part is in general no rotation."""
    return jnp.einsum("nj,jab->nab", weights, transforms, precision=EXACT)
