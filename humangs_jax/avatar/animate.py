"""Canonical Gaussians -> posed Gaussians, by blend skinning alone: the network is not run again."""

import jax

from humangs_jax.avatar.avatar import Avatar
from humangs_jax.avatar.light import light_values, relit
from humangs_jax.body.model import BodyPose
from humangs_jax.body.skinning import blend_transforms, joint_transforms
from humangs_jax.core.checks import FINITE, check_values, checked_arguments
from humangs_jax.core.pytree import replace
from humangs_jax.rendering.gaussians import Gaussians, factored, gaussian_values, skin_gaussians


@checked_arguments
def skin(avatar: Avatar, pose: BodyPose) -> Gaussians:
    """Posed Gaussians, differentiable in avatar and pose; affine skinning leaves its linear part in `deformations`.

    Colors stay, or are those of the avatar's light.
    """
    joints = joint_transforms(avatar.rest_joints, avatar.parents, pose.rotations, pose.translation)
    gaussians, transforms = avatar.gaussians, blend_transforms(avatar.skinning_weights, joints)
    if avatar.light is not None:
        gaussians = replace(gaussians, colors=relit(gaussians.colors, avatar.light, transforms[:, :3, :3]))
    return skin_gaussians(gaussians, transforms, avatar.skinning)


@checked_arguments
def animate(avatar: Avatar, pose: BodyPose) -> Gaussians:
    """Posed Gaussians that means, quats and scales describe completely (the linear deformation is factored into them).

    The factors are not differentiable where two scales coincide: optimise through `skin`.

    Raises: ValueError if the pose has another number of joints than the avatar; outside of transformations, also for values
    that are not finite or out of range, naming the array.
    """
    joints = len(avatar.parents)
    if pose.rotations.shape != (joints, 3) or pose.translation.shape != (3,):
        found = f"rotations {pose.rotations.shape}, translation {pose.translation.shape}"
        raise ValueError(
            f"animate: expected one pose of {joints} joints, got {found}; use jax.vmap for a batch of poses"
        )
    moves = {
        "pose.rotations": (pose.rotations, FINITE),
        "pose.translation": (pose.translation, FINITE),
        "avatar.rest_joints": (avatar.rest_joints, FINITE),
    }
    check_values("animate", gaussian_values(avatar.gaussians) | light_values(avatar.light) | moves)
    return _animate(avatar, pose)


@jax.jit
def _animate(avatar, pose):
    return factored(skin(avatar, pose))
