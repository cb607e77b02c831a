"""From an example to pictures: photographs -> canonical Gaussians -> posed as each target -> drawn."""

import dataclasses

import jax
import jax.numpy as jnp

from humangs_jax.body.model import BodyModel, shape_body
from humangs_jax.body.skinning import blend_transforms, joint_transforms
from humangs_jax.core.array_types import Array, Float
from humangs_jax.data.loader import Example
from humangs_jax.data.views import SubjectViews, prepare_inputs
from humangs_jax.network.humangs import HumanGSConfig, HumanGSOutputs, Variables, apply_humangs
from humangs_jax.network.vertex_decoder import corrected_skinning_weights
from humangs_jax.rendering.gaussians import skin_gaussians
from humangs_jax.rendering.splatting import Rendering, render
from humangs_jax.training.config import TrainConfig


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
    prepared = jax.lax.stop_gradient(prepare_inputs(body, inputs, model, config.raster))
    return apply_humangs(variables, prepared, model, train, axis_name)


def token_share(config: TrainConfig, views: int) -> HumanGSConfig:
    """The network with the token capacity of a step of so many photographs.

    `model.token_capacity` is for the most of `views.input_counts`; fewer have their share, and a view's share more, as one
    photograph may show more of a person than the others.
    """
    most = max(config.views.input_counts)
    capacity = -(-config.model.token_capacity * (views + 1) // (most + 1))
    return config.model if views >= most else dataclasses.replace(config.model, token_capacity=capacity)


def draw_targets(
    outputs: HumanGSOutputs,
    body: BodyModel,
    targets: SubjectViews,
    backgrounds: Float[Array, "v 3"],
    config: TrainConfig,
) -> Rendering:
    """The Gaussians in the pose and before the camera of every target: a `Rendering` with a leading axis of v."""
    rest = shape_body(body, targets.betas)
    per_vertex = outputs.gaussians.means.shape[0] // body.template.shape[0]
    weights = corrected_skinning_weights(body.skinning_weights, outputs.skinning_offsets, per_vertex)

    def draw(arguments):
        rotations, translation, camera, background = arguments
        joints = joint_transforms(rest.joints, body.parents, rotations, translation)
        posed = skin_gaussians(outputs.gaussians, blend_transforms(weights, joints), config.model.skinning)
        return render(posed, camera, config.splat, background)

    return jax.lax.map(draw, (targets.rotations, targets.translations, targets.cameras, backgrounds))


def white_backgrounds(targets: SubjectViews) -> Float[Array, "v 3"]:
    """White for every target."""
    return jnp.ones((*targets.translations.shape[:-1], 3), targets.images.dtype)


def predict(
    variables: Variables, body: BodyModel, example: Example, config: TrainConfig
) -> tuple[Rendering, HumanGSOutputs]:
    """What the trained network shows of an example's targets, on white, and the Gaussians that it shows."""
    outputs, _ = reconstruct_example(variables, body, example.inputs, config)
    return draw_targets(outputs, body, example.targets, white_backgrounds(example.targets), config), outputs
