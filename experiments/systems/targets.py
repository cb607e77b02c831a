"""Base classes of drivers that correct Gaussians for a target, and of drivers that make its image.

Avatar files, exports and the viewer do not use drivers. There a person moves by skinning alone, and
the avatar of a network with a driver is the one before any correction.
"""

import functools
from collections.abc import Iterable
from typing import Any, cast

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np

from humangs_jax.avatar.animate import skin
from humangs_jax.avatar.frames import draw_gaussians
from humangs_jax.avatar.reconstruct import fit_buffers, make_avatar
from humangs_jax.body.model import BodyModel, BodyPose, person_vertices, shape_body
from humangs_jax.core.array_types import Array, Float
from humangs_jax.core.pytree import replace
from humangs_jax.data.capture import Capture
from humangs_jax.data.prepared import prepare_capture
from humangs_jax.data.views import (
    SubjectViews,
    gaussian_body,
    prepare_inputs,
    to_network_views,
)
from humangs_jax.geometry.camera import Camera
from humangs_jax.network.config import HumanGSConfig
from humangs_jax.network.encoder import encoder_pixels
from humangs_jax.network.humangs import apply_humangs, part_variables
from humangs_jax.network.parts import Drawn, HumanGSOutputs, Target, TargetDecoder, Variables
from humangs_jax.rendering.gaussians import Gaussians
from humangs_jax.rendering.splat_config import SPLAT_PRESETS
from humangs_jax.rendering.splatting import Rendering
from humangs_jax.training.forward import draw_posed


class GaussianDriver(TargetDecoder):
    """A driver that corrects the canonical Gaussians for every pose."""

    @nn.nowrap
    def posed(
        self,
        variables: Variables,
        outputs: HumanGSOutputs,
        body: BodyModel,
        betas: Float[Array, " s"],
        pose: BodyPose,
        config: HumanGSConfig,
    ) -> tuple[Gaussians, HumanGSOutputs]:
        """Returns the posed Gaussians of one frame, and the outputs before they are posed.

        `variables` are those of the driver.
        """
        target = Target(pose, person_vertices(body, betas, pose))
        applied = self.apply(variables, outputs, target, config.forward_context())
        driven = cast(HumanGSOutputs, applied)
        return skin(make_avatar(driven, body, shape_body(body, betas), config), pose), driven

    @nn.nowrap
    def draw(self, variables, outputs, body, photos, targets, backgrounds, config) -> Drawn:
        """See `parts.TargetDecoder`."""

        def one(pose):
            posed, driven = self.posed(
                variables, outputs, body, targets.betas, BodyPose(*pose), config.model
            )
            return posed, driven.tight_offsets

        posed, offsets = jax.lax.map(one, (targets.rotations, targets.translations))

        def flat(x):
            return None if x is None else x.reshape(-1, *x.shape[2:])

        found = draw_posed(posed, targets, backgrounds, config)
        return found._replace(opacities=flat(posed.opacities), tight_offsets=flat(offsets))

    @nn.nowrap
    def show(
        self, variables, config, inputs, targets, background
    ) -> tuple[np.ndarray, Float[np.ndarray, "v h w"]]:
        """See `parts.TargetDecoder`. The world of the captures has to be y-up, unlike in
        `reconstruct`.
        """
        outputs, body, views, config = reconstructed(variables, config, inputs)
        own = part_variables(variables, "driver")
        arguments = self, own, outputs, body, views.betas
        posed = (_posed(*arguments, pose, config) for pose in _poses(targets))
        return drawn(posed, targets.cameras, background, config)


class PixelDriver(TargetDecoder):
    """A driver that makes the images of targets without Gaussians.

    Images are on white, because the driver does not know the background, and have no alpha.
    `__call__` returns the image of a target whose sides are multiples of the encoder's patch size.
    """

    has_alpha = False

    @nn.nowrap
    def images(
        self,
        variables: Variables,
        outputs: HumanGSOutputs,
        body: BodyModel,
        targets: SubjectViews,
        config: HumanGSConfig,
    ) -> Float[Array, "v h w 3"]:
        """Returns the images of targets, made by one pass each.

        The photos and masks of the targets are not used. Pixels of whole patches beyond the image
        are cut off.
        """
        vertices, pixels = target_queries(body, targets, config)

        @jax.checkpoint
        def one(target):
            return self.apply(
                variables,
                outputs,
                Target(BodyPose(*target[:2]), *target[2:]),
                config.forward_context(),
            )

        arguments = (targets.rotations, targets.translations, vertices, pixels)
        return jax.lax.map(one, arguments)[:, : targets.cameras.height, : targets.cameras.width]

    @nn.nowrap
    def draw(self, variables, outputs, body, photos, targets, backgrounds, config) -> Drawn:
        """See `parts.TargetDecoder`."""
        images = self.images(variables, outputs, body, targets, config.model)

        def full(rgb):
            alpha, depth = jnp.ones(rgb.shape[:2]), jnp.zeros(rgb.shape[:2])
            return Rendering(rgb, alpha, depth, jnp.zeros((), jnp.int32))

        return Drawn(jax.vmap(full)(images))

    @nn.nowrap
    def show(self, variables, config, inputs, targets, background) -> tuple[np.ndarray, None]:
        """See `parts.TargetDecoder`. Raises: ValueError for another background than white."""
        if background != 1:
            raise ValueError(
                f"a network that draws pixels shows people on white; background {background:g} was"
                " asked for"
            )
        outputs, body, views, config = reconstructed(variables, config, inputs)
        own, images = part_variables(variables, "driver"), []
        for pose, camera in zip(_poses(targets), targets.cameras, strict=True):
            target = _one_view(views, pose, camera)
            images.append(np.asarray(_image(self, own, outputs, body, target, config)))
        return np.clip(np.stack(images), 0, 1), None


def target_queries(
    body: BodyModel, targets: SubjectViews, config: HumanGSConfig
) -> tuple[Float[Array, "v n 3"], Float[Array, "v h w 9"]]:
    """Returns `Target.vertices` and `Target.pixels` of targets.

    Photos and masks of the targets are not used. Sides are rounded up to whole patches.
    """
    patch, cameras = config.architecture.encoder.patch_size, targets.cameras
    height, width = -(-cameras.height // patch) * patch, -(-cameras.width // patch) * patch
    blank = jnp.zeros((len(targets.rotations), height, width, 3), targets.images.dtype)
    cameras = replace(cameras, width=width, height=height)
    hidden = replace(targets, images=blank, masks=blank[..., 0], cameras=cameras, view_count=None)
    views = jax.lax.stop_gradient(prepare_inputs(body, hidden, config))
    return views.posed_vertices, encoder_pixels(views, config.forward_context())[..., 3:]


def drawn(
    posed: Iterable[Gaussians], cameras: Camera, background: float, config: HumanGSConfig
) -> tuple[Float[np.ndarray, "v h w 3"], Float[np.ndarray, "v h w"]]:
    """Draws Gaussians for each camera, in the way that the weights were trained with, and returns
    images and alpha.
    """
    how = SPLAT_PRESETS[config.conventions.rendering]
    found = list(draw_gaussians(posed, cameras, jnp.full(3, background), how))
    images = np.stack([np.clip(np.asarray(x.rgb), 0, 1) for x in found])
    return images, np.stack([np.asarray(x.alpha) for x in found])


def reconstructed(
    variables: Variables, config: HumanGSConfig, inputs: Capture
) -> tuple[HumanGSOutputs, BodyModel, SubjectViews, HumanGSConfig]:
    """Returns the network's outputs for a capture, the body and the views that it sees, and the
    configuration with buffers that fit.
    """
    body = gaussian_body(inputs.body, config)
    capture = prepare_capture(inputs).capture
    views = to_network_views(capture, config.image_size, config.runtime.crop)
    prepared = _prepare(body, views, config)
    config = fit_buffers(prepared.foreground, prepared.view_count, config)
    return _outputs(variables, prepared, config), body, views, config


def _poses(targets: Capture) -> Any:
    """Returns the pose of each view of a capture."""
    return jax.tree.map(lambda x: jnp.asarray(x)[np.asarray(targets.frames)], targets.poses)


def _one_view(views: SubjectViews, pose: BodyPose, camera: Camera) -> SubjectViews:
    """Returns one target without photo and mask, of the person of some views."""
    blank = jnp.zeros((1, camera.height, camera.width, 3))
    camera, rotations, translations = jax.tree.map(
        lambda x: x[None], (camera, pose.rotations, pose.translation)
    )
    return SubjectViews(blank, blank[..., 0], camera, rotations, translations, views.betas)


_prepare = jax.jit(prepare_inputs, static_argnames="config")


@functools.partial(jax.jit, static_argnames="config")
def _outputs(variables: Variables, inputs: Any, config: HumanGSConfig) -> HumanGSOutputs:
    """Compiled: runs the network."""
    return apply_humangs(variables, inputs, config)[0]


@functools.partial(jax.jit, static_argnames=("driver", "config"))
def _image(
    driver: PixelDriver, variables: Variables, outputs: Any, body: Any, target: Any, config: Any
) -> Array:
    """Compiled: makes the image of one target."""
    return driver.images(variables, outputs, body, target, config)[0]


@functools.partial(jax.jit, static_argnames=("driver", "config"))
def _posed(
    driver: GaussianDriver,
    variables: Variables,
    outputs: Any,
    body: Any,
    betas: Any,
    pose: Any,
    config: Any,
) -> Gaussians:
    """Compiled: returns the posed Gaussians of one frame."""
    return driver.posed(variables, outputs, body, betas, pose, config)[0]
