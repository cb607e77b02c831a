"""Corrects canonical Gaussians for one driving frame, and has the driver of LCA-style systems, an
MLP that predicts the corrections.

LCA (Large-scale Codec Avatars, 2026, https://arxiv.org/abs/2604.02320) has no public code. Its
paper describes a transformer over image and anchor tokens, an MLP that predicts canonical
Gaussians, an MLP that corrects them for the driving signal, and skinning. In our reading the second
MLP takes the features of a vertex, as the first one does, and the rotations of all joints but the
root.
"""

from typing import NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp

from experiments.systems.targets import GaussianDriver
from humangs_jax.body.model import BodyPose
from humangs_jax.core.array_types import Array, Float
from humangs_jax.core.configuration import Count, Layers, Spread, Width, part
from humangs_jax.core.numerics import inverse_sigmoid
from humangs_jax.core.pytree import replace
from humangs_jax.geometry import quaternion
from humangs_jax.network.parts import ForwardContext, HumanGSOutputs, Target, VertexFeatures
from humangs_jax.network.vertex_decoder import COLOR_MARGIN, LAST_STD
from humangs_jax.rendering.gaussians import Gaussians

CHANNELS = 14
"""Numbers of a correction: 3 of the offset, 4 of the quaternion, 3 of the logarithm of the scale, 1
of the logit of the opacity, and 3 of the logits of the color.
"""
SCALING = 2.0
"""Bound of the corrections of the logarithm of a scale."""


class Corrected(NamedTuple):
    """Corrected Gaussians of one frame."""

    gaussians: Gaussians
    """The Gaussians in the canonical pose."""
    offsets: Float[Array, "g 3"]
    """Offsets of the means, in the unit of `offset_scale`."""


def apply_corrections(
    gaussians: Gaussians, raw: Float[Array, "g 14"], offset_scale: float
) -> Corrected:
    """Corrects Gaussians by `CHANNELS` numbers each.

    Numbers of 0 change nothing, except that colors are kept `COLOR_MARGIN` away from 0 and 1.
    Gaussians of opacity 0 keep it. Offsets are in canonical axes, and tanh bounds them to
    `offset_scale` metres.
    """
    offsets, rotations, scales, opacities, colors = jnp.split(raw, (3, 7, 10, 11), axis=-1)
    offsets = offset_scale * jnp.tanh(offsets)
    rotations = quaternion.normalize(rotations + jnp.asarray(quaternion.IDENTITY, raw.dtype))
    opaque = gaussians.opacities > 0
    base = jnp.where(opaque, gaussians.opacities, 0.5)
    moved = replace(
        gaussians,
        means=gaussians.means + offsets,
        quats=quaternion.multiply(rotations, gaussians.quats),
        scales=gaussians.scales * jnp.exp(SCALING * jnp.tanh(scales / SCALING)),
        opacities=jnp.where(opaque, jax.nn.sigmoid(inverse_sigmoid(base) + opacities[:, 0]), 0.0),
        colors=jax.nn.sigmoid(inverse_sigmoid(gaussians.colors, COLOR_MARGIN) + colors),
    )
    return Corrected(moved, offsets)


def pose_vector(pose: BodyPose, joints: int) -> Float[Array, " q"]:
    """Returns the rotation vectors of all joints but the root, whose rotation only says how the
    person stands in the world.

    Raises: ValueError if the body has another number of joints than the driver was made for.
    """
    if len(pose.rotations) != joints:
        raise ValueError(f"driver.joints {joints}: the pose has {len(pose.rotations)} joints")
    return pose.rotations[1:].reshape(-1)


@part
class CorrectionMLP(GaussianDriver):
    """The driver of LCA-style systems, for readers that return `VertexFeatures`.

    An MLP predicts 14 raw corrections for each Gaussian from the features of its vertex and the
    pose. They are near 0 at first.
    """

    hidden: Width = 512
    """Width of the hidden layers."""
    layers: Layers = 3
    """Number of hidden layers."""
    joints: Count = 55
    """Number of joints of the body."""
    offset_scale: Spread = 0.05
    """Bound of the offsets in metres."""
    gaussians_per_vertex: Count = 1
    """Gaussians of a vertex, as the decoder makes them."""

    @nn.compact
    def __call__(
        self, outputs: HumanGSOutputs, target: Target, ctx: ForwardContext
    ) -> HumanGSOutputs:
        """See `parts.TargetDecoder`.

        Raises: ValueError for other features, another number of Gaussians of a vertex, or another
            number of joints.
        """
        if not isinstance(outputs.scene, VertexFeatures):
            raise ValueError(
                f"a CorrectionMLP needs VertexFeatures, got {type(outputs.scene).__name__}"
            )
        local, per_vertex = outputs.scene.local, self.gaussians_per_vertex
        if len(outputs.gaussians.opacities) != per_vertex * len(local):
            raise ValueError(
                f"driver.gaussians_per_vertex {per_vertex}: the decoder gives another number"
            )
        # an MLP reads the features of a vertex and the pose
        vector = jnp.broadcast_to(
            pose_vector(target.pose, self.joints), (len(local), 3 * (self.joints - 1))
        )
        x = jnp.concatenate([local, vector], axis=-1)
        for i in range(self.layers):
            x = jax.nn.silu(nn.Dense(self.hidden, name=f"hidden_{i}")(x))
        last = nn.initializers.normal(LAST_STD)
        raw = nn.Dense(CHANNELS * per_vertex, kernel_init=last, name="out")(x)
        gaussians, offsets = apply_corrections(
            outputs.gaussians, raw.reshape(-1, CHANNELS), self.offset_scale
        )
        # for a body of 1.8 m, metres are normalised units
        driven = offsets.reshape(len(local), per_vertex, 3)
        # the loss keeps canonical offsets small, too
        if outputs.tight_offsets is not None:
            driven = jnp.concatenate([outputs.tight_offsets, driven], axis=1)
        return replace(outputs, gaussians=gaussians, tight_offsets=driven)
