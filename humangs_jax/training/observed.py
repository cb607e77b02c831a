"""The loss of one subject with everything that is computed on its way watched, stage by stage.

What is composed here are the functions that `forward` and `step` compose; the modules inside of the encoder are watched from
outside, by Linen's interception. So the numbers are those of the training step, whose loss this is.
"""

import dataclasses
import functools
from typing import Any

import flax.linen as nn
import jax

from humangs_jax.body.model import BodyModel, shape_body
from humangs_jax.body.skinning import blend_transforms, joint_transforms
from humangs_jax.core.array_types import Array, Key, PyTree, Scalar
from humangs_jax.core.pytree import pytree_dataclass, replace, static_field
from humangs_jax.data.loader import Example
from humangs_jax.data.views import SubjectViews, prepare_inputs
from humangs_jax.network.humangs import (
    Encoder,
    HumanGSOutputs,
    assemble,
    decode_heads,
    encode_with_statistics,
    sample_vertices,
)
from humangs_jax.network.tokenizer import Tokenizer
from humangs_jax.network.transformer import Block, Transformer
from humangs_jax.network.upsampler import Upsampler
from humangs_jax.network.vertex_decoder import corrected_skinning_weights
from humangs_jax.objectives.loss_networks import LossNetworks
from humangs_jax.rendering.drawing import Rendering, draw_projected
from humangs_jax.rendering.gaussians import Gaussians, skin_gaussians
from humangs_jax.rendering.projection import project_gaussians
from humangs_jax.training.config import TrainConfig
from humangs_jax.training.forward import token_share
from humangs_jax.training.probes import Named, Recorder, inexact_leaves
from humangs_jax.training.step import change_background, loss_terms, random_backgrounds


@pytree_dataclass
class ObservedStage:
    """values: what a stage gives. cotangents: the gradients that it sends back to what it is given. gradients: of its
    parameters.
    """

    name: str = static_field()
    values: Named
    cotangents: Named
    gradients: Named


@functools.partial(jax.jit, static_argnames="config")
def observe_subject(
    params: PyTree,
    batch_stats: PyTree,
    body: BodyModel,
    example: Example,
    key: Key,
    config: TrainConfig,
    networks: LossNetworks,
) -> tuple[Scalar, list[ObservedStage]]:
    """The loss, as `subject_loss`, and all stages in the order of the forward pass.

    Blocks are neither looped over nor recomputed, so that each can be watched, and all that was seen is kept: this needs
    more memory than a step (the published network at 512 pixels, 4 views each: 2.4 GB are kept).
    """
    transformer = dataclasses.replace(config.model.transformer, scan=False, remat=False)
    config = dataclasses.replace(config, model=dataclasses.replace(config.model, transformer=transformer))

    def loss(params, probes, recorder):
        recorder = recorder or Recorder(probes)
        return _observed_loss(params, batch_stats, body, example, key, config, networks, recorder), recorder.given

    dry = Recorder()  # finds out which stages there are
    jax.eval_shape(lambda params: loss(params, None, dry)[0], params)
    differentiated = jax.value_and_grad(lambda *trees: loss(*trees, None), argnums=(0, 1), has_aux=True)
    (value, given), (gradients, cotangents) = differentiated(params, dry.probes())
    own: dict[str, Named] = {}
    for name, gradient in inexact_leaves(gradients):
        own.setdefault(parameter_stage(name), {})[name] = gradient
    stages = [ObservedStage(name, given[name], cotangents.get(name, {}), own.get(name, {})) for name in dry.given]
    return value, stages


def parameter_stage(name: str) -> str:
    """The stage that uses a parameter, by the parameter's path, as decoder.trunk_0.kernel."""
    part, *inner = name.split(".")
    if part != "encoder":
        return {"readout": "vertex features", "decoder": "raw heads"}[part]
    if inner[0] != "transformer":
        return "maps" if inner[0] == "upsampler" else "tokens"
    return _transformer_stage(inner[1])


def _transformer_stage(module_name):
    names = {"input_norm": "input norm", "norm": "final norm"}
    return names.get(module_name, module_name.replace("_", " "))


def _observed_loss(params, batch_stats, body, example, key, config, networks, recorder):
    """`step.subject_loss`."""
    model, variables = token_share(config, len(example.inputs.images)), {"params": params, "batch_stats": batch_stats}
    inputs = jax.lax.stop_gradient(prepare_inputs(body, example.inputs, model, config.raster))
    computed = ("posed_vertices", "canonical_vertices", "position_maps", "depth_maps")
    recorder.give("position maps", {name: getattr(inputs, name) for name in computed})
    with nn.intercept_methods(functools.partial(_watch, recorder)):
        encoding, updated = encode_with_statistics(variables, inputs, model, train=True)
    recorder.give("maps", encoding)
    recorder.give("maps", {"batch_stats": updated})

    # only what depends on parameters is taken: nobody asks for other gradients, so they may be anything
    features = sample_vertices(variables, recorder.take("vertex features", encoding), inputs, model)
    recorder.give("vertex features", features)
    learned = recorder.take("raw heads", {"local": features.local, "global_token": features.global_token})
    raw = decode_heads(variables, replace(features, **learned), inputs.canonical_vertices, model)
    raw = recorder.take("canonical Gaussians", recorder.give("raw heads", raw))
    outputs = recorder.give("canonical Gaussians", assemble(raw, features, inputs.canonical_vertices, model))
    backgrounds = random_backgrounds(key, len(example.targets.translations), config.loss.random_background)
    backgrounds = backgrounds.astype(example.targets.images.dtype)
    drawn = _observed_drawing(outputs, body, example.targets, backgrounds, config, recorder)
    images = change_background(example.targets, backgrounds)
    return _observed_terms(drawn, outputs, images, example.targets, config, networks, recorder)


def _observed_drawing(
    outputs: HumanGSOutputs,
    body: BodyModel,
    targets: SubjectViews,
    backgrounds: Array,
    config: TrainConfig,
    recorder: Recorder,
) -> Rendering:
    """`forward.draw_targets`, all targets through one stage after the other."""
    rest = shape_body(body, targets.betas)
    outputs = recorder.take("posed Gaussians", outputs)
    per_vertex = outputs.gaussians.means.shape[0] // body.template.shape[0]
    weights = corrected_skinning_weights(body.skinning_weights, outputs.skinning_offsets, per_vertex)

    def pose(arguments):
        joints = joint_transforms(rest.joints, body.parents, *arguments)
        return skin_gaussians(outputs.gaussians, blend_transforms(weights, joints), config.model.skinning)

    def draw(arguments):
        posed, (projected, opacities, colors), camera, background = arguments
        posed = replace(posed, opacities=opacities, colors=colors)
        return draw_projected(projected, posed, camera, config.splat, background)

    posed = jax.lax.map(pose, (targets.rotations, targets.translations))
    recorder.give("posed Gaussians", posed)
    shape: Gaussians = recorder.take("projected splats", replace(posed, opacities=None, colors=None))
    shape = replace(shape, opacities=posed.opacities, colors=posed.colors)
    projected = jax.lax.map(lambda x: project_gaussians(*x, config.splat), (shape, targets.cameras))
    recorder.give("projected splats", projected)
    splats = recorder.take("pictures", (projected, posed.opacities, posed.colors))
    drawn = jax.lax.map(draw, (posed, splats, targets.cameras, backgrounds))
    recorder.give("pictures", {"rgb": drawn.rgb, "alpha": drawn.alpha})
    return drawn


def _observed_terms(drawn, outputs, images, targets, config, networks, recorder):
    """The weighted sum of `step.loss_terms`, each term a stage of its own."""

    def term(name):
        """One term; the networks of the others are left alone."""
        others = {other: 0.0 for other in ("perceptual", "lpips") if other != name}
        seen = {"rgb": drawn.rgb, "alpha": drawn.alpha, "tight_offsets": outputs.tight_offsets}
        seen = recorder.take(f"loss: {name}", seen)
        pictures = replace(drawn, rgb=seen["rgb"], alpha=seen["alpha"])
        tight = replace(outputs, tight_offsets=seen["tight_offsets"])
        terms = loss_terms(pictures, tight, images, targets, dataclasses.replace(config.loss, **others), networks)
        return recorder.give(f"loss: {name}", terms[name])

    names = jax.eval_shape(lambda x: loss_terms(x, outputs, images, targets, config.loss, networks), drawn)
    terms = recorder.take("loss", {name: term(name) for name in names})
    return recorder.give("loss", sum(getattr(config.loss, name) * value for name, value in terms.items()))


def _watch(recorder: Recorder, run: Any, arguments: tuple, named: dict, context: Any) -> Any:
    """Interceptor of Linen methods: the encoder's modules take and give."""
    module = context.module
    if context.method_name != "__call__":
        return run(*arguments, **named)
    if isinstance(module, Encoder):
        recorder.give("pixels", arguments[0])
        return run(*arguments, **named)
    if isinstance(module, Tokenizer):
        return recorder.give("tokens", run(*arguments, **named))
    if isinstance(module, Upsampler):
        return run(recorder.take("maps", arguments[0]), *arguments[1:], **named)
    if isinstance(module, Block) or (isinstance(module, nn.LayerNorm) and isinstance(module.parent, Transformer)):
        stage = _transformer_stage(module.name)
        return recorder.give(stage, run(recorder.take(stage, arguments[0]), *arguments[1:], **named))
    return run(*arguments, **named)
