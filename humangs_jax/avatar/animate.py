"""Poses the Gaussians of an avatar by blend skinning, without running the network again. Also makes
the low-pass of images a part of the scales, so that an avatar looks the same in images of every
size.

A renderer adds `EPS2D` pixels^2 to the projected variances of each Gaussian, whatever the size of
the image. Gaussians that fit images of one size are therefore too wide in smaller images, and too
narrow in larger ones. Here `EPS2D - MIP_EPS2D` pixels^2 are added to the squared scales. These
pixels are those of the images that the Gaussians were fitted to (after Mip-Splatting,
https://arxiv.org/abs/2311.16493). `Gaussians.pixel_footprint` holds their side in metres. To
Gaussians that have a footprint, renderers add at most `MIP_EPS2D`.
"""

import jax.numpy as jnp
import numpy as np

from humangs_jax.avatar.avatar import Avatar, light_terms, log_brightness, relit
from humangs_jax.avatar.face import moved_gaussians, moved_hidden, with_hidden
from humangs_jax.body.expressions import EYES
from humangs_jax.body.model import (
    BodyPose,
    RestBody,
    blend_transforms,
    expressed,
    joint_transforms,
)
from humangs_jax.core.array_types import Array, Float
from humangs_jax.core.checks import FINITE, check_values, checked_arguments
from humangs_jax.core.compiled import compiled
from humangs_jax.core.loops import over
from humangs_jax.core.pytree import replace
from humangs_jax.core.records import record_values
from humangs_jax.data.views import SubjectViews
from humangs_jax.geometry.camera import project
from humangs_jax.rendering.gaussians import (
    Gaussians,
    factored,
    skin_gaussians,
    widened,
)


@checked_arguments
def skin(avatar: Avatar, pose: BodyPose) -> Gaussians:
    """Returns the avatar in a pose, differentiable in avatar and pose. With affine skinning,
    `deformations` holds the linear part of the blended transforms, multiplied by the stretch of the
    face if the pose has an expression.

    Args:
        avatar: one person.
        pose: rotations (j, 3), axis-angle; translation (3,), metres. If the avatar has a face, the
            pose may have an expression.

    Returns:
        Posed Gaussians, metres. Colors stay, or are re-shaded for the pose if the avatar has a
        light. If the pose has an expression, the Gaussians of teeth, tongue and lids come after the
        others.

    Raises:
        ValueError: if the pose has an expression, and the avatar has no face or a face with another
            number of coefficients.

    Examples:
        >>> image = lambda pose: hg.render(hg.skin(avatar, pose), camera, config).rgb
        >>> loss = lambda pose: jnp.mean((image(pose) - photo) ** 2)
        >>> gradient = jax.grad(loss)(pose)
    """
    # the face moves before the joints do
    if pose.expression is not None:
        avatar, pose = _with_expression(avatar, pose)

    # Gaussians follow the joints, and their colors the light
    joints = joint_transforms(avatar.rest_joints, avatar.parents, pose.rotations, pose.translation)
    gaussians, transforms = avatar.gaussians, blend_transforms(avatar.skinning_weights, joints)
    if avatar.light is not None:
        gaussians = replace(
            gaussians, colors=relit(gaussians.colors, avatar.light, transforms[:, :3, :3])
        )
    return skin_gaussians(gaussians, transforms, avatar.skinning)


def _with_expression(avatar: Avatar, pose: BodyPose) -> tuple[Avatar, BodyPose]:
    """Returns the avatar in T-pose with the pose's expression on its face, and the pose without its
    expression. The rotations of the returned pose contain the turns of joints that the expression
    makes.

    Hidden Gaussians become ordinary Gaussians after the others, and follow the head. Gaussians of
    an eye follow the joint of the eye. Raises: ValueError if the avatar has no face, or if the
    expression has another number of coefficients than the face.
    """
    face, expression = avatar.face, pose.expression
    if face is None or expression is None:
        raise ValueError(
            "pose.expression: this avatar has no face; avatar.with_face() gives it one where its"
            " body is known"
        )
    rest, pose = expressed(
        face.expressions, RestBody(avatar.rest_vertices, avatar.rest_joints), pose
    )
    stretched = avatar.skinning == "affine"  # the other kind of skinning knows no stretch
    moved = moved_gaussians(face, avatar.gaussians, expression, stretched)
    weights, names = avatar.skinning_weights, avatar.joint_names
    head, eyes = names.index("head"), np.asarray([names.index(name) for name in EYES])
    turning = face.eyes * weights[:, head, None]
    weights = weights.at[:, eyes].add(turning).at[:, head].add(-jnp.sum(turning, axis=-1))
    changed = replace(
        avatar,
        gaussians=moved,
        skinning_weights=weights,
        rest_vertices=rest.vertices,
        rest_joints=rest.joints,
    )
    return with_hidden_among(changed, moved_hidden(face, expression)), pose


def with_hidden_among(avatar: Avatar, hidden: Gaussians) -> Avatar:
    """Returns the avatar without its face, but with the Gaussians `hidden` after its own Gaussians.
    They follow the head. hidden: the hidden Gaussians of the face, which may have been moved.
    """
    face, names = avatar.face, avatar.joint_names
    assert face is not None
    weights = avatar.skinning_weights
    on_head = jnp.zeros((len(hidden.means), len(names)), weights.dtype)
    on_head = on_head.at[:, names.index("head")].set(1)
    light = avatar.light
    if light is not None:  # hidden ones have their colors in the light of the photos, too
        shading = log_brightness(light_terms(face.hidden_normals), light.coefficients)
        light = replace(
            light,
            normals=jnp.concatenate([light.normals, face.hidden_normals]),
            shading=jnp.concatenate([light.shading, shading]),
        )
    return replace(
        avatar,
        gaussians=with_hidden(avatar.gaussians, hidden),
        skinning_weights=jnp.concatenate([weights, on_head]),
        light=light,
        face=None,
    )


@checked_arguments
def animate(avatar: Avatar, pose: BodyPose) -> Gaussians:
    """Returns the avatar in a pose, as Gaussians without `deformations`.

    The linear deformation is factored into quaternions and scales. These are not differentiable
    where two scales coincide. Use `skin` to optimise.

    Args:
        avatar: one person.
        pose: rotations (j, 3), axis-angle; translation (3,), metres. If the avatar has a face, the
            pose may have an expression.

    Returns:
        Posed Gaussians, metres.

    Raises:
        ValueError: as `skin`; also if the pose has another number of joints than the avatar, or is
            a batch of poses. Outside of JAX transformations also if values are not finite or out of
            range; the message names the array.

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
    # values that are not finite would only show as an empty image
    moves = {
        "pose.rotations": (pose.rotations, FINITE),
        "pose.translation": (pose.translation, FINITE),
        "avatar.rest_joints": (avatar.rest_joints, FINITE),
        "pose.expression": (pose.expression, FINITE),
    }
    drawn = record_values(avatar.gaussians, "gaussians") | record_values(avatar.light, "light")
    check_values("animate", drawn | moves)
    return _animate(avatar, pose)


@compiled()
def _animate(avatar: Avatar, pose: BodyPose) -> Gaussians:
    return factored(skin(avatar, pose))


# The low-pass
# --------------------------------------------------------------------------------------------------


def with_pixel_footprint(avatar: Avatar, pixel: Float[Array, "*g"] | float) -> Avatar:
    """Returns the avatar with the low-pass of images in its scales.

    pixel: side of an image's pixel at the Gaussians, metres: one number, or one for each Gaussian.
    The avatar is returned as it is if its `rendering` is not "exact", or if its scales contain a
    low-pass already.
    """
    gaussians = avatar.gaussians
    if avatar.rendering != "exact" or gaussians.pixel_footprint is not None:
        return avatar
    pixel_footprint = jnp.broadcast_to(
        jnp.asarray(pixel, gaussians.scales.dtype), gaussians.opacities.shape
    )
    return replace(
        avatar,
        gaussians=replace(
            gaussians,
            scales=widened(gaussians.scales, pixel_footprint),
            pixel_footprint=pixel_footprint,
        ),
    )


def without_pixel_footprint(avatar: Avatar) -> Avatar:
    """Returns the avatar without the low-pass in its scales. This undoes `with_pixel_footprint`,
    except that no scale is below 10 micrometres.
    """
    gaussians = avatar.gaussians
    scales = widened(gaussians.scales, gaussians.pixel_footprint, -1)
    return replace(avatar, gaussians=replace(gaussians, scales=scales, pixel_footprint=None))


def with_pixel_footprint_of(avatar: Avatar, views: SubjectViews) -> Avatar:
    """Returns the avatar with the low-pass of the photos that it will be fitted to.

    The `pixel_footprint` of a Gaussian is reduced to the side of the photos' pixels at the Gaussian
    (`pixel_sizes`) if it is larger than that. The scales stay, so a part of them that was low-pass
    is now an ordinary part, which a fit can reduce. Images whose pixels are larger than the new
    `pixel_footprint` then show this Gaussian fainter; all others show it as before.

    If the avatar has no low-pass yet, `with_pixel_footprint` adds that of the photos.
    """
    return replace(avatar, gaussians=_pixel_footprint_of(avatar, views))


@compiled()
def _pixel_footprint_of(avatar: Avatar, views: SubjectViews) -> Gaussians:
    gaussians, sizes = avatar.gaussians, pixel_sizes(avatar, views)
    if gaussians.pixel_footprint is None:
        return with_pixel_footprint(avatar, sizes).gaussians
    return replace(gaussians, pixel_footprint=jnp.minimum(gaussians.pixel_footprint, sizes))


@compiled()
def pixel_sizes(avatar: Avatar, views: SubjectViews) -> Float[Array, " g"]:
    """Returns the side of a photo's pixel at each Gaussian, metres. Of the photos that contain a
    Gaussian, the one with the smallest pixels there counts.

    Gaussians outside of all photos get the largest value of the others, or 0 if there are no
    others.
    """

    def in_photo(photo):
        rotations, translation, camera = photo
        pixels, depths = project(camera, skin(avatar, BodyPose(rotations, translation)).means)
        inside = (pixels >= 0) & (pixels <= jnp.asarray([camera.width, camera.height]))
        return jnp.where(jnp.all(inside, axis=-1) & (depths > 0), depths / camera.K[0, 0], jnp.inf)

    photos = views.rotations, views.translations, views.cameras
    smallest = jnp.min(over(in_photo, photos), axis=0)
    found = jnp.isfinite(smallest)
    return jnp.where(found, smallest, jnp.max(jnp.where(found, smallest, 0.0)))
