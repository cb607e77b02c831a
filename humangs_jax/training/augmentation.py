"""Adds errors of real captures to the inputs of training: exposure, masks, cameras, poses and
shape.

Photos, cameras and poses of the targets stay true. So the network learns to place Gaussians well
although its photos and bodies are a little off, as those of `humangs fit` are.
"""

import math
from typing import Annotated

import jax
import jax.numpy as jnp

from humangs_jax.body.model import BodyModel, shape_body
from humangs_jax.core.array_types import Array, Float, Int, Key
from humangs_jax.core.configuration import Range, Share, Spread, configuration
from humangs_jax.core.draws import normal_of, uniform_by_name
from humangs_jax.core.pytree import replace
from humangs_jax.data.loading import Example
from humangs_jax.data.views import SubjectViews
from humangs_jax.geometry import quaternion, transform
from humangs_jax.geometry.camera import Camera


@configuration
class Augmentation:
    """Standard deviations of random errors. The errors are normally distributed unless a field says
    otherwise. They are drawn for each photo or for each example.
    """

    share: Share = 0.0
    """Share of the examples that have all errors. Other examples have errors of exposure and tint
    only. 0: no example has errors, and nothing is computed for them.
    """
    exposure: Spread = 0.08
    """Standard deviation of the natural logarithm of each photo's gain."""
    tint: Spread = 0.03
    """Standard deviation of the natural logarithm of a further gain, one for each channel of each
    photo.
    """
    mask_pixels: Annotated[int, Range(0, 64)] = 2
    """Largest number of pixels by which masks are eroded or dilated. The number is uniformly
    distributed. Where a mask grows, a random background color appears.
    """
    camera_degrees: Annotated[float, Range(0, 360)] = 0.25
    """Standard deviation of the angle by which a camera is turned about the person, for each axis,
    degrees.
    """
    camera_metres: Spread = 0.002
    """Standard deviation of the shift of a camera along each axis, metres."""
    pose_degrees: Annotated[float, Range(0, 360)] = 0.15
    """Standard deviation of the error of each joint's rotation vector, for each axis, degrees. The
    error is the same in all photos of an example.
    """
    body_metres: Spread = 0.002
    """Standard deviation of the error of the translation, for each axis, metres. The error is the
    same in all photos of an example.
    """
    betas: Spread = 0.1
    """Standard deviation of the error of each shape coefficient. The error is the same in all
    photos of an example and in its targets.
    """


Numbers = dict[str, Float[Array, "..."]]
"""The numbers that `random_numbers` returns, by name."""


def random_numbers(key: Key, views: SubjectViews) -> Numbers:
    """Returns all random numbers of an example with inputs `views`, in [0, 1), by name."""
    count, joints = views.rotations.shape[:2]
    shapes = {"chosen": (), "betas": views.betas.shape}
    shapes |= {"gains": (count, 1, 1, 1), "tints": (count, 1, 1, 3)}
    shapes |= {"radii": (count,), "backgrounds": (count, 1, 1, 3)}
    shapes |= {"turns": (count, 3), "shifts": (count, 3)}
    shapes |= {"rotations": (joints, 3), "translation": (3,)}
    return uniform_by_name(key, shapes, views.images.dtype)


def augment(key: Key, example: Example, body: BodyModel, config: Augmentation) -> Example:
    """Returns the example with random errors. With the probability `Augmentation.share` they are in
    photos, masks, cameras, poses and betas, and the targets get the same betas. Otherwise they are
    in the exposure and tint of the input photos only.

    Pure and jittable.
    """
    numbers = random_numbers(key, example.inputs)

    def augmented(example):
        inputs, targets = example.inputs, example.targets
        betas = inputs.betas + config.betas * normal_of(numbers["betas"])
        pelvis = shape_body(body, betas).joints[0]
        inputs = augment_views(numbers, replace(inputs, betas=betas), pelvis, config)
        return replace(example, inputs=inputs, targets=replace(targets, betas=betas))

    def exposed(example):
        views = example.inputs
        outside = 1 - views.masks[..., None]
        images = _gains(numbers, config) * (views.images - outside) + outside
        return replace(example, inputs=replace(views, images=jnp.clip(images, 0, 1)))

    return jax.lax.cond(numbers["chosen"] < config.share, augmented, exposed, example)


def _gains(numbers: Numbers, config: Augmentation) -> Float[Array, "v 1 1 3"]:
    """Returns the gain of each channel of each photo, (v, 1, 1, 3)."""
    gain = config.exposure * normal_of(numbers["gains"])
    return jnp.exp(gain + config.tint * normal_of(numbers["tints"]))


def augment_views(
    numbers: Numbers, views: SubjectViews, pelvis: Float[Array, "3"], config: Augmentation
) -> SubjectViews:
    """Returns the views with errors of photos, masks, cameras and poses.

    numbers: from `random_numbers`. pelvis: (3,) metres, in the rest pose. Cameras turn about the
    posed pelvis.
    """
    turns = math.radians(config.pose_degrees) * normal_of(numbers["rotations"])
    images, masks = augment_photos(numbers, views.images, views.masks, config)
    return replace(
        views,
        images=images,
        masks=masks,
        cameras=_augment_cameras(numbers, views.cameras, views.translations + pelvis, config),
        rotations=views.rotations + turns,
        translations=views.translations + config.body_metres * normal_of(numbers["translation"]),
    )


def augment_photos(
    numbers: Numbers,
    images: Float[Array, "v h w 3"],
    masks: Float[Array, "v h w"],
    config: Augmentation,
) -> tuple[Float[Array, "v h w 3"], Float[Array, "v h w"]]:
    """Returns photos on white with errors of exposure, tint and masks, and these masks.

    A photo with the mask m and the person's color f has the color m f + (1 - m). Let g be the gain,
    b the color of a random background, and m' the mask with errors. The result has the color m' (m
    g f + (1 - m) b) + (1 - m').
    """
    choices = 2 * config.mask_pixels + 1
    radii = jnp.floor(choices * numbers["radii"]).astype(jnp.int32) - config.mask_pixels
    cut = _grown(masks, radii, config.mask_pixels)
    outside = 1 - masks[..., None]
    seen = _gains(numbers, config) * (images - outside) + outside * numbers["backgrounds"]
    return jnp.clip(cut[..., None] * (seen - 1) + 1, 0, 1), cut


def _grown(
    masks: Float[Array, "v h w"], radii: Int[Array, " v"], most: int
) -> Float[Array, "v h w"]:
    """Returns the masks, each dilated by its radius, or eroded if the radius is negative. The
    structuring element is a square.
    radii: pixels. most: largest magnitude of a radius.
    """
    for radius in range(1, most + 1):
        larger, smaller = _largest_near(masks), -_largest_near(-masks)
        choice = radii[:, None, None]
        masks = jnp.where(choice >= radius, larger, jnp.where(choice <= -radius, smaller, masks))
    return masks


def _largest_near(images: Float[Array, "v h w"]) -> Float[Array, "v h w"]:
    """Returns the maxima over 3 x 3 pixels. Beyond the border the pixels of the border count."""
    for axis in (1, 2):
        size = images.shape[axis]
        before = jnp.take(images, jnp.maximum(jnp.arange(size) - 1, 0), axis)
        after = jnp.take(images, jnp.minimum(jnp.arange(size) + 1, size - 1), axis)
        images = jnp.maximum(jnp.maximum(before, images), after)
    return images


def _augment_cameras(
    numbers: Numbers, cameras: Camera, centers: Float[Array, "v 3"], config: Augmentation
) -> Camera:
    """Returns cameras that are turned about centres (v, 3) of the world, and shifted."""
    turns = math.radians(config.camera_degrees) * normal_of(numbers["turns"])
    shifts = config.camera_metres * normal_of(numbers["shifts"])
    rotations = quaternion.matrix_from_axis_angle(turns)
    turned = jnp.einsum("vij,vj->vi", rotations, centers, precision="highest")
    moves = transform.make(rotations, centers - turned + shifts)
    moved = jnp.einsum("vij,vjk->vik", cameras.cam_from_world, moves, precision="highest")
    return replace(cameras, cam_from_world=moved)
