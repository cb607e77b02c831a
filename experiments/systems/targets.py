"""Drivers, by what they give for a target: corrected Gaussians, or the image itself.

Avatar files, exports and the viewer know nothing of them: there a person moves by skinning alone,
and the avatar of a network with a driver is the one before any correction.
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
    """Corrects the canonical Gaussians for every pose."""

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
        """The Gaussians of one frame, posed, and before that. variables: the driver's own."""
        target = Target(pose, person_vertices(body, betas, pose))
        driven = cast(
            HumanGSOutputs, self.apply(variables, outputs, target, config.forward_context())
        )
        return skin(make_avatar(driven, body, shape_body(body, betas), config), pose), driven

    @nn.nowrap
    def draw(self, variables, outputs, body, photos, targets, backgrounds, config) -> Drawn:
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
        """See `parts.TargetDecoder`. Their world has to be y-up, unlike that of `reconstruct`."""
        outputs, body, views, config = reconstructed(variables, config, inputs)
        own = part_variables(variables, "driver")
        posed = (
            _posed(self, own, outputs, body, views.betas, pose, config) for pose in _poses(targets)
        )
        return drawn(posed, targets.cameras, background, config)


class PixelDriver(TargetDecoder):
    """Makes the images of targets without Gaussians: on white, the background is not known to it,
    and there is no alpha.

    `__call__` gives the image of a target whose sides are multiples of the encoder's patch size.
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
        """Of targets, a pass each; their photos and masks are not used.

        What is too much of a whole patch is cut off.
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
        images = self.images(variables, outputs, body, targets, config.model)

        def full(rgb):
            return Rendering(
                rgb, jnp.ones(rgb.shape[:2]), jnp.zeros(rgb.shape[:2]), jnp.zeros((), jnp.int32)
            )

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
            images.append(
                np.asarray(_image(self, own, outputs, body, _one_view(views, pose, camera), config))
            )
        return np.clip(np.stack(images), 0, 1), None


def target_queries(
    body: BodyModel, targets: SubjectViews, config: HumanGSConfig
) -> tuple[Float[Array, "v n 3"], Float[Array, "v h w 9"]]:
    """`Target.vertices` and `Target.pixels` of targets, whose photos and masks are not used.

    Sides are whole patches.
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
    """Images and alpha of Gaussians for each camera, as the weights were trained with."""
    how = SPLAT_PRESETS[config.conventions.rendering]
    found = list(draw_gaussians(posed, cameras, jnp.full(3, background), how))
    return np.stack([np.clip(np.asarray(x.rgb), 0, 1) for x in found]), np.stack(
        [np.asarray(x.alpha) for x in found]
    )


def reconstructed(
    variables: Variables, config: HumanGSConfig, inputs: Capture
) -> tuple[HumanGSOutputs, BodyModel, SubjectViews, HumanGSConfig]:
    """What the network makes of a capture; the body and photos that it sees, the configuration with
    buffers that fit.
    """
    body = gaussian_body(inputs.body, config)
    views = to_network_views(
        prepare_capture(inputs).capture, config.image_size, config.runtime.crop
    )
    prepared = _prepare(body, views, config)
    config = fit_buffers(prepared.foreground, prepared.view_count, config)
    return _outputs(variables, prepared, config), body, views, config


def _poses(targets: Capture) -> Any:
    return jax.tree.map(lambda x: jnp.asarray(x)[np.asarray(targets.frames)], targets.poses)


def _one_view(views: SubjectViews, pose: BodyPose, camera: Camera) -> SubjectViews:
    blank = jnp.zeros((1, camera.height, camera.width, 3))
    camera, rotations, translations = jax.tree.map(
        lambda x: x[None], (camera, pose.rotations, pose.translation)
    )
    return SubjectViews(blank, blank[..., 0], camera, rotations, translations, views.betas)


_prepare = jax.jit(prepare_inputs, static_argnames="config")


@functools.partial(jax.jit, static_argnames="config")
def _outputs(variables: Variables, inputs: Any, config: HumanGSConfig) -> HumanGSOutputs:
    return apply_humangs(variables, inputs, config)[0]


@functools.partial(jax.jit, static_argnames=("driver", "config"))
def _image(
    driver: PixelDriver, variables: Variables, outputs: Any, body: Any, target: Any, config: Any
) -> Array:
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
    return driver.posed(variables, outputs, body, betas, pose, config)[0]
