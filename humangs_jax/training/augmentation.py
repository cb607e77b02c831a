"""Errors of real captures, added to the inputs of training: exposure, masks, cameras, poses and
shape.

The targets stay true. The network learns to place Gaussians well although its photos and bodies are
a little off, as `humangs fit` leaves them.
"""

import math
from typing import Annotated, Any

import jax
import jax.numpy as jnp

from humangs_jax.body.model import BodyModel, shape_body
from humangs_jax.core.array_types import Array, Float, Int, Key
from humangs_jax.core.configuration import Range, Share, Spread, configuration
from humangs_jax.core.pytree import replace
from humangs_jax.data.loading import Example
from humangs_jax.data.views import SubjectViews
from humangs_jax.geometry import quaternion, transform
from humangs_jax.geometry.camera import Camera


@configuration
class Augmentation:
    """Standard deviations of normal distributions, unless a field says otherwise; one draw for each
    photo, or for each example.
    """

    share: Share = 0.0
    """The share of the examples that are disturbed in other ways than by exposure and tint. 0:
    nothing is disturbed at all, and no work is done.
    """
    exposure: Spread = 0.08
    """The spread of the natural logarithm of the gain of each photo."""
    tint: Spread = 0.03
    """The spread of the natural logarithm of the gain of each channel of a photo."""
    mask_pixels: Annotated[int, Range(0, 64)] = 2
    """Masks are eroded or dilated by up to this, uniformly; the color of some background appears
    there.
    """
    camera_degrees: Annotated[float, Range(0, 360)] = 0.25
    """The spread of the turn of a camera about the person, degrees."""
    camera_metres: Spread = 0.002
    """The spread of the shift of a camera along each axis, metres."""
    pose_degrees: Annotated[float, Range(0, 360)] = 0.15
    """The spread of each axis of each joint, degrees, the same in all photos of an example."""
    body_metres: Spread = 0.002
    """The spread of each axis of the translation, metres, the same in all photos of an example."""
    betas: Spread = 0.1
    """The spread of each shape coefficient, the same in all photos of an example; the wrong shape
    is also that of the targets.
    """


def augment(key: Key, example: Example, body: BodyModel, config: Augmentation) -> Example:
    """The example with other exposures, or with all of its inputs and betas disturbed.

    Pure and jittable.
    """
    choice_key, betas_key, views_key = jax.random.split(key, 3)

    def augmented(example):
        inputs, targets = example.inputs, example.targets
        betas = inputs.betas + config.betas * jax.random.normal(
            betas_key, inputs.betas.shape, inputs.betas.dtype
        )
        pelvis = shape_body(body, betas).joints[0]
        inputs = augment_views(views_key, replace(inputs, betas=betas), pelvis, config)
        return replace(example, inputs=inputs, targets=replace(targets, betas=betas))

    def exposed(example):
        views = example.inputs
        outside = 1 - views.masks[..., None]
        images = (
            _gains(views_key, len(views.images), views.images.dtype, config)
            * (views.images - outside)
            + outside
        )
        return replace(example, inputs=replace(views, images=jnp.clip(images, 0, 1)))

    chosen = jax.random.bernoulli(choice_key, config.share)
    return jax.lax.cond(chosen, augmented, exposed, example)


def _gains(key: Key, count: int, dtype: Any, config: Augmentation) -> Float[Array, "v 1 1 3"]:
    """(v, 1, 1, 3), one exposure for each photo."""
    gain_key, tint_key = jax.random.split(key)
    gain = config.exposure * jax.random.normal(gain_key, (count, 1, 1, 1), dtype)
    return jnp.exp(gain + config.tint * jax.random.normal(tint_key, (count, 1, 1, 3), dtype))


def augment_views(
    key: Key, views: SubjectViews, pelvis: Float[Array, "3"], config: Augmentation
) -> SubjectViews:
    """Photos, masks, cameras and poses.

    pelvis: (3,) metres, in the rest pose: cameras turn about the posed one.
    """
    photo_key, camera_key, pose_key, body_key = jax.random.split(key, 4)

    def normal(key, like):
        return jax.random.normal(key, like.shape, like.dtype)

    rotations = views.rotations[0]
    images, masks = augment_photos(photo_key, views.images, views.masks, config)
    return replace(
        views,
        images=images,
        masks=masks,
        cameras=_augment_cameras(camera_key, views.cameras, views.translations + pelvis, config),
        rotations=views.rotations + math.radians(config.pose_degrees) * normal(pose_key, rotations),
        translations=views.translations
        + config.body_metres * normal(body_key, views.translations[0]),
    )


def augment_photos(
    key: Key, images: Float[Array, "v h w 3"], masks: Float[Array, "v h w"], config: Augmentation
) -> tuple[Float[Array, "v h w 3"], Float[Array, "v h w"]]:
    """Photos on white whose exposure, tint and masks are off.

    A photo is m f + (1 - m) of its mask m and the person's color f. It becomes m' (m g f + (1 - m)
    b) + (1 - m') with the gain g, the mask m' and the color b of a background.
    """
    count = len(images)
    gain_key, radius_key, background_key = jax.random.split(key, 3)
    gain = _gains(gain_key, count, images.dtype, config)
    radii = jax.random.randint(radius_key, (count,), -config.mask_pixels, config.mask_pixels + 1)
    backgrounds = jax.random.uniform(background_key, (count, 1, 1, 3), images.dtype)
    cut = _grown(masks, radii, config.mask_pixels)
    outside = 1 - masks[..., None]
    seen = gain * (images - outside) + outside * backgrounds
    return jnp.clip(cut[..., None] * (seen - 1) + 1, 0, 1), cut


def _grown(
    masks: Float[Array, "v h w"], radii: Int[Array, " v"], most: int
) -> Float[Array, "v h w"]:
    """Masks dilated by radii > 0 and eroded by radii < 0, in pixels; squares grow to squares."""
    for radius in range(1, most + 1):
        larger, smaller = _largest_near(masks), -_largest_near(-masks)
        choice = radii[:, None, None]
        masks = jnp.where(choice >= radius, larger, jnp.where(choice <= -radius, smaller, masks))
    return masks


def _largest_near(images: Float[Array, "v h w"]) -> Float[Array, "v h w"]:
    """Maxima over 3 x 3 pixels; what is beyond the border repeats it."""
    for axis in (1, 2):
        size = images.shape[axis]
        before = jnp.take(images, jnp.maximum(jnp.arange(size) - 1, 0), axis)
        after = jnp.take(images, jnp.minimum(jnp.arange(size) + 1, size - 1), axis)
        images = jnp.maximum(jnp.maximum(before, images), after)
    return images


def _augment_cameras(
    key: Key, cameras: Camera, centers: Float[Array, "v 3"], config: Augmentation
) -> Camera:
    """Cameras that are turned about centres (v, 3) of the world, and shifted."""
    turn_key, shift_key = jax.random.split(key)
    dtype = centers.dtype
    turns = math.radians(config.camera_degrees) * jax.random.normal(turn_key, centers.shape, dtype)
    shifts = config.camera_metres * jax.random.normal(shift_key, centers.shape, dtype)
    rotations = quaternion.matrix_from_axis_angle(turns)
    turned = jnp.einsum("vij,vj->vi", rotations, centers, precision="highest")
    moves = transform.make(rotations, centers - turned + shifts)
    moved = jnp.einsum("vij,vjk->vik", cameras.cam_from_world, moves, precision="highest")
    return replace(cameras, cam_from_world=moved)
