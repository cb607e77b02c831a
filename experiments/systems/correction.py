"""Corrections of canonical Gaussians for one driving frame, and the LCA-style driver: an MLP that
gives them.

LCA (Large-scale Codec Avatars, 2026, https://arxiv.org/abs/2604.02320) has no public code; what is
known of it: a transformer over image and anchor tokens, an MLP that gives canonical Gaussians, an
MLP that corrects them for the driving signal, skinning. Our reading of the second MLP: it takes the
features of a vertex, which the canonical MLP takes too, and the rotations of all joints but the
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
"""Of a correction: offset 3, quaternion 4, logarithm of the scale 3, logits of opacity 1 and color
3.
"""
SCALING = 2.0
"""Corrections of the logarithm of a scale are bounded to this."""


class Corrected(NamedTuple):
    """gaussians: canonical, of one frame.

    offsets: (g, 3) of the means, in the unit of `offset_scale`.
    """

    gaussians: Gaussians
    offsets: Float[Array, "g 3"]


def apply_corrections(
    gaussians: Gaussians, raw: Float[Array, "g 14"], offset_scale: float
) -> Corrected:
    """Gaussians with corrections, `CHANNELS` numbers each: zeros change nothing (but colors closer
    to 0 or 1 than `COLOR_MARGIN`), and Gaussians of opacity 0 keep it.

    offset_scale: metres to which offsets, in canonical axes, are bounded by tanh.
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
    """Axis-angles of all joints but the root: how the person stands in the world is no part of it.

    Raises: ValueError if the body has another number of joints than the driver was made for.
    """
    if len(pose.rotations) != joints:
        raise ValueError(f"driver.joints {joints}: the pose has {len(pose.rotations)} joints")
    return pose.rotations[1:].reshape(-1)


@part
class CorrectionMLP(GaussianDriver):
    """The LCA-style driver, for readers that give `VertexFeatures`, and a decoder with K Gaussians
    per vertex.

    Inputs of vertices -> raw corrections, 14 for each Gaussian; they start near 0.
    """

    hidden: Width = 512
    layers: Layers = 3
    """Hidden ones."""
    joints: Count = 55
    """Of the body."""
    offset_scale: Spread = 0.05
    """Metres, bound of the offsets."""
    gaussians_per_vertex: Count = 1
    """K."""

    @nn.compact
    def __call__(
        self, outputs: HumanGSOutputs, target: Target, ctx: ForwardContext
    ) -> HumanGSOutputs:
        """See `parts.TargetDecoder`.

        Raises: ValueError for other features or another K; see `pose_vector`.
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
        # of a body of 1.8 m, metres are normalised units
        driven = offsets.reshape(len(local), per_vertex, 3)
        # the canonical ones stay small, too
        if outputs.tight_offsets is not None:
            driven = jnp.concatenate([outputs.tight_offsets, driven], axis=1)
        return replace(outputs, gaussians=gaussians, tight_offsets=driven)
