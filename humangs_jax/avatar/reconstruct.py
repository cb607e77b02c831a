"""Photos with body poses -> one forward pass -> an avatar."""

import jax

from humangs_jax.array_types import PyTree
from humangs_jax.avatar.avatar import Avatar
from humangs_jax.body.decimation import decimate
from humangs_jax.body.model import BodyModel, shape_body
from humangs_jax.data.capture import Capture
from humangs_jax.data.views import SubjectViews, prepare_inputs, standardize
from humangs_jax.models.humangs import HumanGSConfig, apply_humangs
from humangs_jax.models.vertex_decoder import corrected_skinning_weights

def reconstruct(variables: PyTree, config: HumanGSConfig, capture: Capture) -> Avatar:
    """Reconstruct the person of a capture.

    The photos are brought to the network's image size (white background, centred square) and the body to the vertex count
    that the weights were trained for (`config.body_vertices`). Compiled once per number of views and body.

    Raises: ValueError if the capture has no view, or if foreground patches exceeded the network's token capacity.
    """
    if len(capture.images) == 0:
        raise ValueError("capture: 0 views; at least one photo is needed")
    body = capture.body
    if config.body_vertices is not None and config.body_vertices < len(body.template):
        body = decimate(body, config.body_vertices)
    views = standardize(capture, config.image_size)
    avatar, dropped = _reconstruct_compiled(variables, config, body, views)
    if int(dropped) > 0:
        raise ValueError(
            f"{int(dropped)} foreground patches do not fit into token_capacity = {config.token_capacity}: "
            "use fewer views, or a configuration with a larger token_capacity"
        )
    return avatar


def reconstruct_views(
    variables: PyTree, config: HumanGSConfig, body: BodyModel, views: SubjectViews
) -> tuple[Avatar, jax.Array]:
    """The pure function behind `reconstruct`: one subject's views -> avatar and the count of patches dropped.

    Batch over subjects with `jax.vmap(reconstruct_views, in_axes=(None, None, None, 0))`.
    """
    inputs = prepare_inputs(body, views, config)
    outputs, _ = apply_humangs(variables, inputs, config)
    rest = shape_body(body, views.betas)
    avatar = Avatar(
        gaussians=outputs.gaussians,
        skinning_weights=corrected_skinning_weights(
            body.skinning_weights, outputs.skinning_offsets, config.decoder.gaussians_per_vertex
        ),
        rest_vertices=rest.vertices,
        rest_joints=rest.joints,
        faces=body.faces,
        parents=body.parents,
        joint_names=body.joint_names,
        skinning=config.skinning,
    )
    return avatar, outputs.dropped_tokens


_reconstruct_compiled = jax.jit(reconstruct_views, static_argnames="config")
