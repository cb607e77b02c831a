"""From an example to images: photos -> canonical Gaussians -> posed as each target -> drawn."""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from humangs_jax.avatar.animate import skin
from humangs_jax.avatar.reconstruct import completed_avatar, make_avatar
from humangs_jax.avatar.targets import frame_outputs, target_pixels
from humangs_jax.body.model import BodyModel, BodyPose
from humangs_jax.core.array_types import Array, Float
from humangs_jax.core.numerics import safe_divide
from humangs_jax.core.pytree import replace
from humangs_jax.data.loading import Example
from humangs_jax.data.views import SubjectViews, prepare_inputs
from humangs_jax.losses.losses import ray_spread
from humangs_jax.network.config import HumanGSConfig
from humangs_jax.network.humangs import apply_humangs
from humangs_jax.network.parts import HumanGSOutputs, Variables
from humangs_jax.network.stages import StageCaller, call
from humangs_jax.rendering.projection import project_gaussians
from humangs_jax.rendering.splatting import Rendering, draw_projected
from humangs_jax.training.config import TrainConfig

RASTERIZED = ("posed_vertices", "canonical_vertices", "position_maps", "depth_maps")
"""What `prepare_inputs` computes, rather than copies."""


def reconstruct_example(
    variables: Variables,
    body: BodyModel,
    inputs: SubjectViews,
    config: TrainConfig,
    train: bool = False,
    axis_name: str | tuple[str, ...] | None = None,
    stage: StageCaller = call,
) -> tuple[HumanGSOutputs, Variables]:
    """Canonical Gaussians of one subject and the batch statistics, see `apply_humangs`."""
    model = token_share(config, len(inputs.images))
    prepared = jax.lax.stop_gradient(prepare_inputs(body, inputs, model))
    computed = stage("position maps", lambda: {name: getattr(prepared, name) for name in RASTERIZED})
    return apply_humangs(variables, replace(prepared, **computed), model, train, axis_name, stage)


def token_share(config: TrainConfig, views: int) -> HumanGSConfig:
    """The network with the token capacity of a step with that number of photos.

    The configured capacity is for the largest of `views.input_counts`. Fewer photos get their share plus that of one view,
    because one photo may show more of a person than the others.
    """
    most, capacity = max(config.views.input_counts), config.model.runtime.token_capacity
    if views >= most:
        return config.model
    return config.model.with_runtime(token_capacity=-(-capacity * (views + 1) // (most + 1)))


class DrawnTargets(NamedTuple):
    """Renderings of the v targets; those of a `PixelDecoder` have alpha 1 and depth 0 everywhere. spread: (v, h, w)
    `losses.ray_spread` in square metres, None unless it has a weight. tight_offsets, opacities: those that a driver gave, of all
    targets one after the other; None: those of the outputs count.
    """

    rendering: Rendering
    spread: Float[Array, "v h w"] | None = None
    tight_offsets: Float[Array, "n t 3"] | None = None
    opacities: Float[Array, " g"] | None = None


def draw_targets(
    outputs: HumanGSOutputs,
    body: BodyModel,
    inputs: SubjectViews,
    targets: SubjectViews,
    backgrounds: Float[Array, "v 3"],
    config: TrainConfig,
    stage: StageCaller = call,
    variables: Variables | None = None,
) -> DrawnTargets:
    """The Gaussians drawn in the pose and from the camera of every target. inputs: the photos that they come from. variables:
    of a network that runs again for every target (a driver, or a decoder that draws pixels, on white whatever the
    backgrounds); others need none.
    """
    poses = (targets.rotations, targets.translations)
    if variables is None:
        if config.model.architecture.runs_per_target:
            raise ValueError("draw_targets: this network runs again for every target and needs its variables")
        variables = {}
    if config.model.architecture.draws_pixels:
        pixels = lambda outputs: _opaque(target_pixels(variables, outputs, body, targets, config.model))
        return DrawnTargets(stage("images", pixels, outputs))

    def pose_all(outputs):
        avatar = completed_avatar(outputs, body, inputs, config.model)
        return jax.lax.map(lambda pose: skin(avatar, BodyPose(*pose)), poses)

    def drive_all(outputs):
        def drive(pose):
            driven = frame_outputs(variables, outputs, body, targets.betas, BodyPose(*pose), config.model)
            avatar = make_avatar(driven, body, targets.betas, config.model)
            return skin(avatar, BodyPose(*pose)), driven.tight_offsets

        return jax.lax.map(drive, poses)

    def project_all(shapes):
        return jax.lax.map(lambda x: project_gaussians(*x, config.splat), (shapes, targets.cameras))

    def draw_all(projected, opacities, colors):
        def draw(arguments):
            one, opacity, color, camera, background = arguments
            gaussians = replace(like, opacities=opacity, colors=color)
            rendering = draw_projected(one, gaussians, camera, config.splat, background)
            if not config.loss.distortion:
                return DrawnTargets(rendering)
            z = one.depths - jax.lax.stop_gradient(jnp.mean(one.depths))  # small numbers have small squares
            gaussians = replace(gaussians, colors=jnp.stack([z, z**2, 0 * z], axis=-1))
            moments = draw_projected(one, gaussians, camera, config.splat, jnp.zeros(3, z.dtype))
            first, second = (safe_divide(moments.rgb[..., i], moments.alpha) for i in (0, 1))
            return DrawnTargets(rendering, ray_spread(moments.alpha, first, second))

        return jax.lax.map(draw, (projected, opacities, colors, targets.cameras, backgrounds))

    driven = {}
    if config.model.architecture.driver is None:
        posed = stage("posed Gaussians", pose_all, outputs)
    else:
        posed, offsets = stage("posed Gaussians", drive_all, outputs)
        flat = lambda x: None if x is None else x.reshape(-1, *x.shape[2:])
        driven = {"tight_offsets": flat(offsets), "opacities": flat(posed.opacities)}
    like = jax.tree.map(lambda x: x[0], posed)
    shapes = replace(posed, opacities=None, colors=None)
    opaque = lambda shapes: replace(shapes, opacities=posed.opacities, colors=posed.colors)
    projected = stage("projected splats", lambda shapes: project_all(opaque(shapes)), shapes)
    drawn = stage("images", draw_all, projected, posed.opacities, posed.colors)
    return drawn._replace(**driven)


def _opaque(images):
    """Renderings that are known as colors only."""
    full = lambda rgb: Rendering(rgb, jnp.ones(rgb.shape[:2]), jnp.zeros(rgb.shape[:2]), jnp.zeros((), jnp.int32))
    return jax.vmap(full)(images)


def white_backgrounds(targets: SubjectViews) -> Float[Array, "v 3"]:
    return jnp.ones((*targets.translations.shape[:-1], 3), targets.images.dtype)


def predict(
    variables: Variables, body: BodyModel, example: Example, config: TrainConfig
) -> tuple[Rendering, HumanGSOutputs]:
    """What the trained network shows of an example's targets, on white, and the Gaussians that it shows."""
    outputs, _ = reconstruct_example(variables, body, example.inputs, config)
    backgrounds = white_backgrounds(example.targets)
    drawn = draw_targets(outputs, body, example.inputs, example.targets, backgrounds, config, variables=variables)
    return drawn.rendering, outputs
