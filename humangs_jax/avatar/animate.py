"""Canonical Gaussians -> posed Gaussians, by blend skinning alone: the network is not run again.
And the low-pass of images as a part of the scales, so that an avatar looks the same in images of
every size.

A renderer adds `EPS2D` pixels^2 to the variances of each Gaussian, whatever the size of the image.
Gaussians that fit images of one size are therefore too wide in smaller images, and too narrow in
larger ones. Here all but `MIP_EPS2D` of it goes into the scales, for the size of the images that
they fit (after Mip-Splatting, https://arxiv.org/abs/2311.16493), and `Gaussians.low_pass` tells
renderers so.
"""

import jax
import jax.numpy as jnp

from humangs_jax.avatar.avatar import Avatar, light_values, relit
from humangs_jax.body.model import BodyPose, blend_transforms, joint_transforms
from humangs_jax.core.array_types import Array, Float
from humangs_jax.core.checks import FINITE, check_values, checked_arguments
from humangs_jax.core.pytree import replace
from humangs_jax.data.views import SubjectViews
from humangs_jax.geometry.camera import project
from humangs_jax.rendering.gaussians import (
    Gaussians,
    factored,
    gaussian_values,
    skin_gaussians,
    widened,
)


@checked_arguments
def skin(avatar: Avatar, pose: BodyPose) -> Gaussians:
    """The avatar in a pose, differentiable in avatar and pose; affine skinning leaves its linear
    part in `deformations`.

    Args:
        avatar: one person.
        pose: rotations (j, 3), axis-angle; translation (3,), metres.

    Returns:
        Posed Gaussians, metres. Colors stay, or are re-shaded for the pose if the avatar has a
        light.

    Examples:
        >>> image = lambda pose: hg.render(hg.skin(avatar, pose), camera, config).rgb
        >>> loss = lambda pose: jnp.mean((image(pose) - photo) ** 2)
        >>> gradient = jax.grad(loss)(pose)
    """
    joints = joint_transforms(avatar.rest_joints, avatar.parents, pose.rotations, pose.translation)
    gaussians, transforms = avatar.gaussians, blend_transforms(avatar.skinning_weights, joints)
    if avatar.light is not None:
        gaussians = replace(
            gaussians, colors=relit(gaussians.colors, avatar.light, transforms[:, :3, :3])
        )
    return skin_gaussians(gaussians, transforms, avatar.skinning)


@checked_arguments
def animate(avatar: Avatar, pose: BodyPose) -> Gaussians:
    """The avatar in a pose, as Gaussians that means, quats and scales describe completely.

    The linear deformation is factored into quaternions and scales. These are not differentiable
    where two scales coincide: optimise through `skin`.

    Args:
        avatar: one person.
        pose: rotations (j, 3), axis-angle; translation (3,), metres.

    Returns:
        Posed Gaussians, metres.

    Raises:
        ValueError: if the pose has another number of joints than the avatar; outside of
            transformations, also for values that are not finite or out of range, naming the array.

    Examples:
        >>> image = hg.render(hg.animate(avatar, capture.pose(0)), camera).rgb
    """
    joints = len(avatar.parents)
    if pose.rotations.shape != (joints, 3) or pose.translation.shape != (3,):
        found = f"rotations {pose.rotations.shape}, translation {pose.translation.shape}"
        raise ValueError(
            f"animate: expected one pose of {joints} joints, got {found}; use jax.vmap for a batch"
            " of poses"
        )
    moves = {
        "pose.rotations": (pose.rotations, FINITE),
        "pose.translation": (pose.translation, FINITE),
        "avatar.rest_joints": (avatar.rest_joints, FINITE),
    }
    check_values("animate", gaussian_values(avatar.gaussians) | light_values(avatar.light) | moves)
    return _animate(avatar, pose)


@jax.jit
def _animate(avatar: Avatar, pose: BodyPose) -> Gaussians:
    return factored(skin(avatar, pose))


# The low-pass
# --------------------------------------------------------------------------------------------------


def with_low_pass(avatar: Avatar, pixel: Float[Array, "*g"] | float) -> Avatar:
    """The avatar whose scales contain the low-pass of images with pixels of this size in metres.

    One that is drawn by other conventions than "exact", or has a low-pass already, is returned as
    it is.
    """
    gaussians = avatar.gaussians
    if avatar.rendering != "exact" or gaussians.low_pass is not None:
        return avatar
    low_pass = jnp.broadcast_to(
        jnp.asarray(pixel, gaussians.scales.dtype), gaussians.opacities.shape
    )
    return replace(
        avatar,
        gaussians=replace(gaussians, scales=widened(gaussians.scales, low_pass), low_pass=low_pass),
    )


def without_low_pass(avatar: Avatar) -> Avatar:
    """The avatar that `with_low_pass` had."""
    gaussians = avatar.gaussians
    scales = widened(gaussians.scales, gaussians.low_pass, -1)
    return replace(avatar, gaussians=replace(gaussians, scales=scales, low_pass=None))


def with_low_pass_of(avatar: Avatar, views: SubjectViews) -> Avatar:
    """The avatar with the low-pass of the photos that it will be fitted to, unless its own is that
    of smaller pixels.

    It looks as before: the excess of its own low-pass is now an ordinary part of the scales, which
    a fit can reduce.
    """
    gaussians, sizes = avatar.gaussians, pixel_sizes(avatar, views)
    if gaussians.low_pass is None:
        return with_low_pass(avatar, sizes)
    return replace(
        avatar, gaussians=replace(gaussians, low_pass=jnp.minimum(gaussians.low_pass, sizes))
    )


@jax.jit
def pixel_sizes(avatar: Avatar, views: SubjectViews) -> Float[Array, " g"]:
    """Metres that a pixel of the photos shows at each Gaussian, in the photo that shows it largest.

    Gaussians outside of all frames get the largest value of the others.
    """

    def in_photo(photo):
        rotations, translation, camera = photo
        pixels, depths = project(camera, skin(avatar, BodyPose(rotations, translation)).means)
        inside = (pixels >= 0) & (pixels <= jnp.asarray([camera.width, camera.height]))
        return jnp.where(jnp.all(inside, axis=-1) & (depths > 0), depths / camera.K[0, 0], jnp.inf)

    smallest = jnp.min(
        jax.lax.map(in_photo, (views.rotations, views.translations, views.cameras)), axis=0
    )
    found = jnp.isfinite(smallest)
    return jnp.where(found, smallest, jnp.max(jnp.where(found, smallest, 0.0)))
