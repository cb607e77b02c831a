"""Places and rotations of joints in a pose."""

import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation

from humangs_jax.body.joints import PARENTS
from humangs_jax.body.kinematics import bones_of, posed_tree
from humangs_jax.body.model import joint_transforms


def test_the_tree_in_numpy_is_that_of_the_body_model():
    rng = np.random.default_rng(0)
    joints, rotations = rng.normal(size=(55, 3)), 0.5 * rng.normal(size=(2, 55, 3))
    turns = Rotation.from_rotvec(rotations.reshape(-1, 3)).as_matrix().reshape(2, 55, 3, 3)
    bones = np.broadcast_to(bones_of(joints, PARENTS), (2, 55, 3))
    world, places = posed_tree(turns, bones, PARENTS)
    for frame in range(2):
        given = (jnp.asarray(x, jnp.float32) for x in (joints, rotations[frame], np.zeros(3)))
        rest, turned, origin = given
        transforms = np.asarray(joint_transforms(rest, PARENTS, turned, origin))
        np.testing.assert_allclose(world[frame], transforms[:, :3, :3], atol=1e-5)
        ends = np.einsum("jab,jb->ja", transforms[:, :3, :3], joints) + transforms[:, :3, 3]
        np.testing.assert_allclose(places[frame], ends, atol=1e-4)
