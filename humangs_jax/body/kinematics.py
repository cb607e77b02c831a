"""Poses joints with numpy, for files and for decisions on the host."""

from collections.abc import Sequence

import numpy as np

from humangs_jax.core.array_types import Float


def posed_tree(
    turns: Float[np.ndarray, "*m j 3 3"],
    bones: Float[np.ndarray, "*m j 3"],
    parents: Sequence[int],
) -> tuple[Float[np.ndarray, "*m j 3 3"], Float[np.ndarray, "*m j 3"]]:
    """Returns rotations (..., j, 3, 3) and positions (..., j, 3) of joints in space, by numpy.
    `body.model.joint_transforms` computes transforms from such a tree in JAX.

    turns: rotations of joints relative to their parents. bones: vector from the parent to each
    joint in the rest pose; for the root its position. parents: -1 for roots; each comes before its
    children.
    """
    world, places = np.array(turns, float), np.array(bones, float)
    for joint, parent in enumerate(parents):
        if parent >= 0:
            above = world[..., parent, :, :]
            world[..., joint, :, :] = above @ turns[..., joint, :, :]
            moved = (above @ bones[..., joint, :, None])[..., 0]
            places[..., joint, :] = places[..., parent, :] + moved
    return world, places


def bones_of(joints: Float[np.ndarray, "j 3"], parents: Sequence[int]) -> Float[np.ndarray, "j 3"]:
    """For each joint, returns the vector from its parent in the rest pose, (j, 3). For a root,
    returns its position.
    """
    above = np.asarray(parents)
    return np.where(above[:, None] < 0, joints, joints - joints[above])
