"""From an example to images: photos -> canonical Gaussians -> posed as each target -> drawn."""

import jax
import jax.numpy as jnp

from humangs_jax.avatar.animate import skin
from humangs_jax.avatar.reconstruct import completed_avatar
from humangs_jax.body.model import BodyModel, BodyPose
from humangs_jax.core.array_types import Array, Float
from humangs_jax.core.numerics import safe_divide
from humangs_jax.core.pytree import replace
from humangs_jax.data.loading import Example
from humangs_jax.data.views import SubjectViews, prepare_inputs
from humangs_jax.losses.losses import ray_spread
from humangs_jax.network.config import HumanGSConfig
from humangs_jax.network.humangs import apply_humangs, part_variables
from humangs_jax.network.parts import Drawn, HumanGSOutputs, Variables, stage
from humangs_jax.rendering.gaussians import Gaussians
from humangs_jax.rendering.projection import project_gaussians
from humangs_jax.rendering.splatting import draw_projected
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
) -> tuple[HumanGSOutputs, Variables]:
    """Canonical Gaussians of one subject and the batch statistics, see `apply_humangs`."""
    model = token_share(config, len(inputs.images))
    prepared = jax.lax.stop_gradient(prepare_inputs(body, inputs, model))
    computed = stage("position maps", lambda: {name: getattr(prepared, name) for name in RASTERIZED})
    return apply_humangs(variables, replace(prepared, **computed), model, train, axis_name)


def token_share(config: TrainConfig, views: int) -> HumanGSConfig:
    """The network with the token capacity of a step with that number of photos.

    The configured capacity is for the largest of `views.input_counts`. Fewer photos get their share plus that of one view,
    because one photo may show more of a person than the others.
    """
    most, capacity = max(config.views.input_counts), config.model.runtime.token_capacity
    if views >= most:
        return config.model
    return config.model.with_runtime(token_capacity=-(-capacity * (views + 1) // (most + 1)))


def draw_targets(
    variables: Variables,
    outputs: HumanGSOutputs,
    body: BodyModel,
    inputs: SubjectViews,
    targets: SubjectViews,
    backgrounds: Float[Array, "v 3"],
    config: TrainConfig,
) -> Drawn:
    """The Gaussians drawn in the pose and from the camera of every target. inputs: the photos that they come from."""
    driver = config.model.architecture.driver
    if driver is not None:
        own, given = part_variables(variables, "driver"), (body, inputs, targets, backgrounds, config)
        return stage("driver", lambda outputs: driver.draw(own, outputs, *given), outputs)

    def pose(outputs):
        avatar = completed_avatar(outputs, body, inputs, config.model)
        return jax.lax.map(lambda pose: skin(avatar, BodyPose(*pose)), (targets.rotations, targets.translations))

    posed = stage("posed Gaussians", pose, outputs)
    drawn = draw_posed(posed, targets, backgrounds, config)
    drawn = drawn._replace(opacities=outputs.gaussians.opacities, tight_offsets=outputs.tight_offsets)
    return drawn._replace(shell_spread=outputs.shell_spread)


def draw_posed(posed: Gaussians, targets: SubjectViews, backgrounds: Float[Array, "v 3"], config: TrainConfig) -> Drawn:
    """Gaussians posed for each target, from its camera. posed: with a leading axis v."""

    def project(shapes):
        shapes = replace(shapes, opacities=posed.opacities, colors=posed.colors)
        return jax.lax.map(lambda x: project_gaussians(*x, config.splat), (shapes, targets.cameras))

    def draw(projected, opacities, colors):
        return jax.lax.map(one, (projected, opacities, colors, targets.cameras, backgrounds))

    def one(target):
        splats, opacities, colors, camera, background = target
        gaussians = replace(jax.tree.map(lambda x: x[0], posed), opacities=opacities, colors=colors)
        rendering = draw_projected(splats, gaussians, camera, config.splat, background)
        if not config.loss.distortion:
            return Drawn(rendering)
        z = splats.depths - jax.lax.stop_gradient(jnp.mean(splats.depths))  # small numbers have small squares
        gaussians = replace(gaussians, colors=jnp.stack([z, z**2, 0 * z], axis=-1))
        moments = draw_projected(splats, gaussians, camera, config.splat, jnp.zeros(3, z.dtype))
        first, second = (safe_divide(moments.rgb[..., i], moments.alpha) for i in (0, 1))
        return Drawn(rendering, ray_spread(moments.alpha, first, second))

    projected = stage("projected splats", project, replace(posed, opacities=None, colors=None))
    return stage("images", draw, projected, posed.opacities, posed.colors)


def white_backgrounds(targets: SubjectViews) -> Float[Array, "v 3"]:
    """One per target."""
    return jnp.ones((*targets.translations.shape[:-1], 3), targets.images.dtype)


def predict(
    variables: Variables, body: BodyModel, example: Example, config: TrainConfig
) -> tuple[Drawn, HumanGSOutputs]:
    """What the trained network shows of an example's targets, on white, and the Gaussians that it shows."""
    outputs, _ = reconstruct_example(variables, body, example.inputs, config)
    white = white_backgrounds(example.targets)
    return draw_targets(variables, outputs, body, example.inputs, example.targets, white, config), outputs
