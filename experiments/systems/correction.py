"""Corrections of canonical Gaussians for one driving frame, and the LCA-style driver: an MLP that gives them.

LCA (Large-scale Codec Avatars, 2026, https://arxiv.org/abs/2604.02320) has no public code; what is known of it: a transformer
over image and anchor tokens, an MLP that gives canonical Gaussians, an MLP that corrects them for the driving signal,
skinning. Our reading of the second MLP: it takes the features of a vertex, which the canonical MLP takes too, and the
rotations of all joints but the root.
"""

from typing import Any, NamedTuple, cast

import flax.linen as nn
import jax
import jax.numpy as jnp

from humangs_jax.body.model import BodyPose
from humangs_jax.core.array_types import Array, Float, Key
from humangs_jax.core.configuration import Few, Layers, Spread, Width, part
from humangs_jax.core.numerics import inverse_sigmoid
from humangs_jax.core.pytree import replace
from humangs_jax.geometry import quaternion
from humangs_jax.network.inputs import HumanGSInputs
from humangs_jax.network.parts import HumanGSOutputs, Pass, Variables, VertexFeatures
from humangs_jax.network.vertex_decoder import COLOR_MARGIN, LAST_STD
from humangs_jax.rendering.gaussians import Gaussians

CHANNELS = 14
"""Of a correction: offset 3, quaternion 4, logarithm of the scale 3, logits of opacity 1 and color 3."""
SCALING = 2.0
"""Corrections of the logarithm of a scale are bounded to this."""


class Corrected(NamedTuple):
    """gaussians: canonical, of one frame. offsets: (g, 3) of the means, in the unit of `offset_scale`."""

    gaussians: Gaussians
    offsets: Float[Array, "g 3"]


def apply_corrections(gaussians: Gaussians, raw: Float[Array, "g 14"], offset_scale: float) -> Corrected:
    """Gaussians with corrections, `CHANNELS` numbers each: zeros change nothing (but colors closer to 0 or 1 than
    `COLOR_MARGIN`), and Gaussians of opacity 0 keep it.

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
class CorrectionMLP:
    """The LCA-style driver, for readers that give `VertexFeatures`, and a decoder with K Gaussians per vertex.

    hidden: width. layers: hidden ones. joints: of the body. offset_scale: metres, bound of the offsets. gaussians_per_vertex: K.
    """

    hidden: Width = 512
    layers: Layers = 3
    joints: Few = 55
    offset_scale: Spread = 0.05
    gaussians_per_vertex: Few = 1

    def init(self, key: Key, features: Any, inputs: HumanGSInputs, run: Pass) -> Variables:
        """{"params"} of the MLP. Raises: ValueError for other features."""
        if not isinstance(features, VertexFeatures):
            raise ValueError(f"a CorrectionMLP needs VertexFeatures, got {type(features).__name__}")
        entering = features.local.shape[-1] + 3 * (self.joints - 1)
        return cast(Variables, self._module().init(key, jnp.zeros((1, entering))))

    def apply(
        self, variables: Variables, outputs: HumanGSOutputs, pose: BodyPose, posed: Float[Array, "n 3"], run: Pass
    ) -> HumanGSOutputs:
        """See `parts.Driver`. Raises: ValueError for another K; see `pose_vector`."""
        local = outputs.scene.local
        per_vertex = self.gaussians_per_vertex
        if len(outputs.gaussians.opacities) != per_vertex * len(local):
            raise ValueError(f"driver.gaussians_per_vertex {per_vertex}: the decoder gives another number")
        vector = jnp.broadcast_to(pose_vector(pose, self.joints), (len(local), 3 * (self.joints - 1)))
        raw = self._module().apply(variables, jnp.concatenate([local, vector], axis=-1))
        gaussians, offsets = apply_corrections(outputs.gaussians, raw.reshape(-1, CHANNELS), self.offset_scale)
        driven = offsets.reshape(len(local), per_vertex, 3)  # of a body of 1.8 m, metres are normalised units
        if outputs.tight_offsets is not None:  # the canonical ones stay small, too
            driven = jnp.concatenate([outputs.tight_offsets, driven], axis=1)
        return replace(outputs, gaussians=gaussians, tight_offsets=driven)

    def _module(self):
        return CorrectionModule(self.hidden, self.layers, self.gaussians_per_vertex)


class CorrectionModule(nn.Module):
    """Inputs of vertices (n, c) -> raw corrections (n, m = 14 k); they start near 0."""

    hidden: int
    layers: int
    per_vertex: int

    @nn.compact
    def __call__(self, x: Float[Array, "n c"]) -> Float[Array, "n m"]:
        for i in range(self.layers):
            x = jax.nn.silu(nn.Dense(self.hidden, name=f"hidden_{i}")(x))
        last = nn.initializers.normal(LAST_STD)
        return nn.Dense(CHANNELS * self.per_vertex, kernel_init=last, name="out")(x)
