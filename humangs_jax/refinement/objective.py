"""What refinement minimises: the difference of an avatar's renderings from the photos.

The Gaussians are skinned to the pose of each photo, so the photos may show different poses.
"""

import dataclasses
from collections.abc import Callable

import jax
import jax.numpy as jnp
from jax.sharding import Mesh, PartitionSpec

from humangs_jax.avatar.animate import skin
from humangs_jax.avatar.avatar import Avatar
from humangs_jax.body.model import BodyPose
from humangs_jax.core.array_types import Array, Bool, Float, Int, Scalar
from humangs_jax.core.numerics import safe_divide
from humangs_jax.core.pytree import pytree_dataclass, replace
from humangs_jax.data.views import SubjectViews
from humangs_jax.geometry.camera import Camera
from humangs_jax.losses.ssim import structural_dissimilarity
from humangs_jax.refinement.config import RefineConfig
from humangs_jax.refinement.parameters import Parameters, gaussians_of
from humangs_jax.rendering.gaussians import Gaussians
from humangs_jax.rendering.splat_config import SplatConfig
from humangs_jax.rendering.splatting import Rendering, render

Image = tuple[Float[Array, "h w 3"], Float[Array, "h w"]]
"""Colors and alpha."""
PullBack = Callable[[Image], tuple[Parameters, Float[Array, " g"]]]
"""From the gradient with respect to an image to those with respect to the parameters, and to the brightness of each Gaussian."""


@pytree_dataclass
class Photos:
    """Views to compare with (leading axis v), and the pixels of each that count: (v, h, w).

    index: (v,) the number of the view, to which the changes of its pose belong.
    """

    images: Float[Array, "v h w 3"]
    masks: Float[Array, "v h w"]
    counted: Bool[Array, "v h w"]
    cameras: Camera
    rotations: Float[Array, "v j 3"]
    translations: Float[Array, "v 3"]
    index: Int[Array, " v"]


def photos_of(views: SubjectViews, counted: Bool[Array, "v h w"]) -> Photos:
    """All views of a person, with the pixels that count."""
    index = jnp.arange(len(views.images))
    return Photos(views.images, views.masks, counted, views.cameras, views.rotations, views.translations, index)


def avatar_of(parameters: Parameters, avatar: Avatar) -> Avatar:
    """The avatar with the Gaussians that the parameters stand for."""
    return replace(avatar, gaussians=gaussians_of(parameters, avatar.gaussians.low_pass))


def posed_gaussians(parameters: Parameters, avatar: Avatar, photo: Photos, poses: bool) -> Gaussians:
    """The Gaussians in the pose of one photo (without the axis v), corrected as far as it has been refined.

    poses: whether gradients reach the pose; they pass through the transforms of all Gaussians, which takes time.
    """
    if not poses:
        parameters = replace(
            parameters,
            rotations=jax.lax.stop_gradient(parameters.rotations),
            translations=jax.lax.stop_gradient(parameters.translations),
        )
    pose = BodyPose(
        photo.rotations + parameters.rotations[photo.index], photo.translations + parameters.translations[photo.index]
    )
    return skin(avatar_of(parameters, avatar), pose)


def drawn_photo(
    parameters: Parameters, avatar: Avatar, photo: Photos, splat: SplatConfig, poses: bool
) -> tuple[Image, PullBack, Rendering]:
    """The image of one photo (without the axis v), its pull-back, and all that was rendered. poses: see `posed_gaussians`."""

    def draw(parameters, brightness):
        gaussians = posed_gaussians(parameters, avatar, photo, poses)
        rendering = render(replace(gaussians, colors=gaussians.colors + brightness[:, None]), photo.cameras, splat)
        return (rendering.rgb, rendering.alpha), rendering

    return jax.vjp(draw, parameters, jnp.zeros_like(avatar.gaussians.opacities), has_aux=True)


def image_loss(image: Image, photo: Photos, config: RefineConfig) -> Scalar:
    """Loss of one photo (without the axis v): L1 of colors, structural dissimilarity, L1 of coverage; means over the crop.

    A pixel that does not count takes the photo's value, so that it contributes nothing anywhere.
    """
    rgb = jnp.where(photo.counted[..., None], image[0], photo.images)
    alpha = jnp.where(photo.counted, image[1], photo.masks)
    return (
        jnp.mean(jnp.abs(rgb - photo.images))
        + config.structural * jnp.mean(structural_dissimilarity(rgb, photo.images))
        + config.silhouette * jnp.mean(jnp.abs(alpha - photo.masks))
    )


@pytree_dataclass
class Comparison:
    """Comparison of an avatar with photos. loss: mean over them. squared: mean squared error of the pixels that count.

    visibility: (g,) the largest weight of each Gaussian on any pixel of the photos. overflow: what the buffers had no room for.
    """

    loss: Scalar
    squared: Scalar
    visibility: Float[Array, " g"]
    overflow: Int[Array, ""]


def compare_photos(
    parameters: Parameters, avatar: Avatar, photos: Photos, config: RefineConfig, splat: SplatConfig
) -> Comparison:
    """Comparison with the photos, one after the other."""
    splat = dataclasses.replace(splat, visibility=True)

    def one(photo):
        image, _, rendering = drawn_photo(parameters, avatar, photo, splat, config.poses)
        return compared(image, rendering, photo, config)

    return comparison_of(jax.lax.map(one, photos), photos)


def compared(image: Image, rendering: Rendering, photo: Photos, config: RefineConfig) -> Comparison:
    """One photo. squared: sum over its pixels."""
    squared = jnp.mean(jnp.square(jnp.clip(image[0], 0, 1) - photo.images), axis=-1)
    assert rendering.visibility is not None
    loss = image_loss(image, photo, config)
    return Comparison(loss, jnp.sum(squared * photo.counted), rendering.visibility, rendering.overflow)


def comparison_of(each: Comparison, photos: Photos) -> Comparison:
    """Comparison with all photos, from that with each (leading axis v)."""
    return Comparison(
        jnp.mean(each.loss),
        safe_divide(jnp.sum(each.squared), jnp.sum(photos.counted, dtype=each.squared.dtype)),
        jnp.max(each.visibility, axis=0),
        jnp.sum(each.overflow),
    )


def photos_gradient(
    parameters: Parameters,
    avatar: Avatar,
    photos: Photos,
    config: RefineConfig,
    splat: SplatConfig,
    mesh: Mesh | None = None,
) -> tuple[Parameters, Scalar, Int[Array, ""]]:
    """Gradient of the mean over the photos, the mean and the overflow. mesh: of one axis, whose devices share the photos."""

    def total(parameters, avatar, photos):
        def one(photo):
            image, pull_back, rendering = drawn_photo(parameters, avatar, photo, splat, config.poses)
            value, error = jax.value_and_grad(image_loss)(image, photo, config)
            return pull_back(error)[0], value, rendering.overflow

        # unrolled: a CPU runs the loops of the renderer more slowly inside of another loop
        each = [one(jax.tree.map(lambda x, i=i: x[i], photos)) for i in range(len(photos.images))]
        return jax.tree.map(lambda *x: sum(x[1:], x[0]), *each)

    count = len(photos.images)
    if mesh is None:
        gradient, value, overflow = total(parameters, avatar, photos)
    else:
        (axis,) = mesh.axis_names
        mesh = Mesh(mesh.devices, mesh.axis_names)  # automatic axes: the compiler shards what lies outside
        everywhere = PartitionSpec()
        share = jax.shard_map(
            lambda *arguments: jax.lax.psum(total(*arguments), axis),
            mesh=mesh,
            in_specs=(everywhere, everywhere, PartitionSpec(axis)),
            out_specs=everywhere,
            check_vma=False,
        )
        gradient, value, overflow = share(parameters, avatar, photos)
    return jax.tree.map(lambda x: x / count, gradient), value / count, overflow
