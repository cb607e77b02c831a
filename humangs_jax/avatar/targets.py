"""Images by networks that run again for every target: with a driver, or with a decoder that draws pixels.

Training and evaluation make their images here. Avatar files, exports and the viewer do not use this module: there a person
moves by skinning alone, and the avatar of a network with a driver is the one before any correction.
"""

import functools
from collections.abc import Iterator

import jax
import jax.numpy as jnp
import numpy as np

from humangs_jax.avatar.animate import skin
from humangs_jax.avatar.frames import draw_gaussians
from humangs_jax.avatar.reconstruct import fit_buffers, make_avatar
from humangs_jax.body.model import BodyModel, BodyPose, person_vertices
from humangs_jax.core.array_types import Array, Float
from humangs_jax.core.pytree import replace
from humangs_jax.data.capture import Capture
from humangs_jax.data.exposure import equal_exposure
from humangs_jax.data.views import SubjectViews, gaussian_body, prepare_inputs, standardize
from humangs_jax.geometry.camera import Camera
from humangs_jax.network.config import HumanGSConfig
from humangs_jax.network.encoder import encoder_pixels
from humangs_jax.network.humangs import apply_humangs, draw_pixels, drive_outputs
from humangs_jax.network.parts import HumanGSOutputs, Variables
from humangs_jax.rendering.gaussians import Gaussians
from humangs_jax.rendering.splat_config import SPLAT_PRESETS


def frame_outputs(
    variables: Variables,
    outputs: HumanGSOutputs,
    body: BodyModel,
    betas: Float[Array, " s"],
    pose: BodyPose,
    config: HumanGSConfig,
) -> HumanGSOutputs:
    """Canonical Gaussians of one frame, corrected by the driver for its pose; `make_avatar` and `animate.skin` pose them."""
    return drive_outputs(variables, outputs, pose, person_vertices(body, betas, pose), config)


def target_queries(body: BodyModel, targets: SubjectViews, config: HumanGSConfig) -> Float[Array, "v h w 9"]:
    """What a `PixelDecoder` gets of targets: rays and canonical positions of the body. Their photos and masks are not used."""
    hidden = replace(targets, images=jnp.zeros_like(targets.images), masks=jnp.zeros_like(targets.masks))
    queries = encoder_pixels(prepare_inputs(body, hidden, config), config.run())[..., 3:]
    return jax.lax.stop_gradient(queries)


def target_pixels(
    variables: Variables, outputs: HumanGSOutputs, body: BodyModel, targets: SubjectViews, config: HumanGSConfig
) -> Float[Array, "v h w 3"]:
    """Images of targets by a `PixelDecoder`, on white. Sides need not be multiples of the patch: what is too much is cut off."""
    patch, cameras = config.architecture.encoder.patch_size, targets.cameras
    height, width = -(-cameras.height // patch) * patch, -(-cameras.width // patch) * patch
    views = len(targets.rotations)
    whole = replace(
        targets,
        images=jnp.zeros((views, height, width, 3), targets.images.dtype),
        masks=jnp.zeros((views, height, width), targets.images.dtype),
        cameras=replace(cameras, width=width, height=height),
        view_count=None,
    )
    images = draw_pixels(variables, outputs, target_queries(body, whole, config), config)
    return images[:, : cameras.height, : cameras.width]


def show_targets(
    variables: Variables, config: HumanGSConfig, inputs: Capture, targets: Capture, background: float = 1.0
) -> tuple[Float[np.ndarray, "v h w 3"], Float[np.ndarray, "v h w"] | None]:
    """Images and alpha of the person of `inputs` in the views of `targets`, by a network that runs for each of them.
    Their world has to be y-up, unlike that of `reconstruct`.

    Raises: ValueError for another background than white with a network that draws pixels: it has no alpha.
    """
    if config.architecture.draws_pixels and background != 1:
        raise ValueError(f"a network that draws pixels shows people on white; background {background:g} was asked for")
    body = gaussian_body(inputs.body, config)
    views = standardize(equal_exposure(inputs), config.image_size, config.runtime.crop)
    prepared = _prepare(body, views, config)
    config = fit_buffers(prepared, config)
    outputs = _outputs(variables, prepared, config)
    frames = np.asarray(targets.frames)
    poses = jax.tree.map(lambda x: jnp.asarray(x)[frames], targets.poses)
    if config.architecture.draws_pixels:
        images = [
            _pixels(variables, outputs, body, _one_view(views, pose, camera), config)
            for pose, camera in zip(poses, targets.cameras, strict=True)
        ]
        return np.clip(np.stack([np.asarray(image) for image in images]), 0, 1), None
    posed: Iterator[Gaussians] = (_posed(variables, outputs, body, views.betas, pose, config) for pose in poses)
    how = SPLAT_PRESETS[config.conventions.rendering]
    drawn = list(draw_gaussians(posed, targets.cameras, jnp.full(3, background), how))
    images = np.stack([np.clip(np.asarray(one.rgb), 0, 1) for one in drawn])
    return images, np.stack([np.asarray(one.alpha) for one in drawn])


def _one_view(views: SubjectViews, pose: BodyPose, camera: Camera) -> SubjectViews:
    """A target without a photo."""
    blank = jnp.zeros((1, camera.height, camera.width, 3))
    camera, rotations, translations = jax.tree.map(lambda x: x[None], (camera, pose.rotations, pose.translation))
    return SubjectViews(blank, blank[..., 0], camera, rotations, translations, views.betas)


_prepare = jax.jit(prepare_inputs, static_argnames="config")


@functools.partial(jax.jit, static_argnames="config")
def _outputs(variables, inputs, config):
    return apply_humangs(variables, inputs, config)[0]


@functools.partial(jax.jit, static_argnames="config")
def _pixels(variables, outputs, body, target, config):
    return target_pixels(variables, outputs, body, target, config)[0]


@functools.partial(jax.jit, static_argnames="config")
def _posed(variables, outputs, body, betas, pose, config):
    driven = frame_outputs(variables, outputs, body, betas, pose, config)
    return skin(make_avatar(driven, body, betas, config), pose)
