"""Canonical Gaussians -> posed Gaussians, by blend skinning alone: the network is not run again."""

import jax

from humangs_jax.avatar.avatar import Avatar
from humangs_jax.body.model import BodyPose
from humangs_jax.body.skinning import blend_transforms, joint_transforms
from humangs_jax.rendering.gaussians import Gaussians, factored, skin_gaussians


def skin(avatar: Avatar, pose: BodyPose) -> Gaussians:
    """Posed Gaussians, differentiable in avatar and pose; affine skinning leaves its linear part in `deformations`."""
    transforms = joint_transforms(avatar.rest_joints, avatar.parents, pose.rotations, pose.translation)
    return skin_gaussians(avatar.gaussians, blend_transforms(avatar.skinning_weights, transforms), avatar.skinning)


@jax.jit
def animate(avatar: Avatar, pose: BodyPose) -> Gaussians:
    """Posed Gaussians that means, quats and scales describe completely (the linear deformation is factored into them).

    The factors are not differentiable where two scales coincide: optimise through `skin`.
    """
    return factored(skin(avatar, pose))
