"""Photos with body poses -> one forward pass -> an avatar."""

import dataclasses

import jax

from humangs_jax.array_types import Array, Int, PyTree
from humangs_jax.avatar.avatar import Avatar
from humangs_jax.body.model import BodyModel, shape_body
from humangs_jax.capacity import round_up
from humangs_jax.data.capture import Capture
from humangs_jax.data.views import SubjectViews, gaussian_body, prepare_inputs, standardize
from humangs_jax.models.humangs import HumanGSConfig, apply_humangs, touched_patches
from humangs_jax.models.vertex_decoder import corrected_skinning_weights


def reconstruct(variables: PyTree, config: HumanGSConfig, capture: Capture) -> Avatar:
    """Reconstruct the person of a capture.

    The photos are brought to the network's image size (white, centred square), the body to the vertices that the weights want
    (`gaussian_body`), and the token capacity to what these photos need. Compiles once per number of
    views, body and capacity, which is rounded up to few sizes.

    Raises: ValueError if the capture has no view.
    """
    if capture.view_count == 0:
        raise ValueError("capture: 0 views; at least one photo is needed")
    body = gaussian_body(capture.body, config)
    views = standardize(capture, config.image_size)
    inputs = _prepare(body, views, config)
    if config.tokens == "foreground":
        capacity = round_up(int(_touched_patches(inputs, config)))
        config = dataclasses.replace(config, token_capacity=capacity)
    return _assemble_compiled(variables, config, body, views, inputs)[0]


def reconstruct_views(
    variables: PyTree, config: HumanGSConfig, body: BodyModel, views: SubjectViews
) -> tuple[Avatar, Int[Array, ""]]:
    """The pure function behind `reconstruct`: one subject's views -> avatar, and the count of foreground patches that did
    not fit into `config.token_capacity`.

    Batch over subjects with `jax.vmap(reconstruct_views, in_axes=(None, None, None, 0))`, with a body from `gaussian_body`.
    """
    return _assemble(variables, config, body, views, prepare_inputs(body, views, config))


def _assemble(variables, config, body, views, inputs):
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


_assemble_compiled = jax.jit(_assemble, static_argnames="config")
_prepare = jax.jit(prepare_inputs, static_argnames="config")
_touched_patches = jax.jit(touched_patches, static_argnames="config")
