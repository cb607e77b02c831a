"""GST-style: tokens of groups of vertices look at one photo, and each makes one attribute of the Gaussians of its group.

Theirs (Prospero et al. 2024, https://arxiv.org/abs/2409.04196): one photo, a frozen HMR2 ViT, 130 learned tokens (5 attributes
of 26 groups of 265 vertices of SMPL) that cross-attend to its tokens; a Gaussian a vertex, its mean the posed vertex plus an
offset; the body's pose and shape and the camera come from the same network.

Our reading: the body is given, as it is to every system here; our patch transformer stands for HMR2's; vertices are grouped in
their order; offsets are in the canonical frame, so that the person can be posed, which theirs cannot. A token changes nothing
outside of its group.
"""

from typing import cast

import flax.linen as nn
import jax
import jax.numpy as jnp

from experiments.systems.cross_attention import CrossBlock, check_heads, image_tokens
from experiments.systems.two_stream import check_views
from humangs_jax.core.array_types import Array, Float, Int, Key
from humangs_jax.core.configuration import Bias, Layers, Patch, Ratio, Spread, Vertices, Width, part
from humangs_jax.geometry import quaternion
from humangs_jax.network.inputs import HumanGSInputs, subject_unit
from humangs_jax.network.parts import Encoding, HumanGSOutputs, Pass, Variables
from humangs_jax.network.runtime import Runtime
from humangs_jax.network.transformer import layer_norm
from humangs_jax.network.vertex_decoder import INITIAL_OPACITY, LAST_STD
from humangs_jax.rendering.gaussians import Gaussians

ATTRIBUTES = {"offsets": 3, "quats": 4, "scales": 3, "opacities": 1, "colors": 3}
"""Numbers of each attribute of a Gaussian; the order of a group's tokens."""


@part
class GroupReader:
    """Learned tokens, one an attribute and group, that look at the tokens of one photo.

    groups: of vertices. width: of a token. layers, mlp_ratio, head_width, patch_size: as in `CrossAttentionReader`.
    """

    groups: Vertices = 26
    width: Width = 1024
    layers: Layers = 6
    mlp_ratio: Ratio = 2
    head_width: Width = 64
    patch_size: Patch = 8

    def __post_init__(self):
        """Raises ValueError for sizes that do not fit together."""
        check_heads("reader", self.width, self.head_width)

    def init(self, key: Key, encoding: Encoding, inputs: HumanGSInputs, run: Pass) -> Variables:
        """{"params"} of `GroupTokens`."""
        return cast(Variables, self._module(run).init(key, jnp.zeros((1, encoding.maps.shape[-1])), None))

    def apply(
        self, variables: Variables, encoding: Encoding, inputs: HumanGSInputs, run: Pass
    ) -> Float[Array, "a r d"]:
        """Tokens of the 5 attributes of r groups. Raises ValueError for a second photo, or an encoder with an upsampler."""
        check_views(inputs, 1)
        return cast(Array, self._module(run).apply(variables, *image_tokens(encoding, inputs, run, self.patch_size)))

    def _module(self, run: Pass):
        return GroupTokens(self, run.runtime)


class GroupTokens(nn.Module):
    """Image tokens (l, e) -> (5, groups, d)."""

    config: GroupReader
    runtime: Runtime

    @nn.compact
    def __call__(self, tokens: Float[Array, "l e"], count: Int[Array, ""] | None) -> Float[Array, "a r d"]:
        config, shape = self.config, (len(ATTRIBUTES) * self.config.groups, self.config.width)
        x = self.param("queries", nn.initializers.normal(1.0), shape)
        for index in range(config.layers):
            block = CrossBlock(config.head_width, config.mlp_ratio, self.runtime, name=f"block_{index}")
            x = block(x, tokens, count)
        return layer_norm(None, "norm", use_bias=True)(x).reshape(len(ATTRIBUTES), config.groups, config.width)


@part
class GroupDecoder:
    """A linear head an attribute, from a group's token to the Gaussians of its vertices.

    group_size: vertices of a group; the body has at most groups * group_size. offset_scale: bound of the offsets, normalised
    units. initial_log_scale: bias of the scales before the softplus.
    """

    group_size: Vertices = 265
    offset_scale: Spread = 0.5
    initial_log_scale: Bias = -4.8

    def init(self, key: Key, features: Float[Array, "a r d"], inputs: HumanGSInputs, run: Pass) -> Variables:
        """{"params"} of `GroupHeads`."""
        return cast(Variables, GroupHeads(self).init(key, features))

    def apply(
        self, variables: Variables, features: Float[Array, "a r d"], inputs: HumanGSInputs, run: Pass
    ) -> HumanGSOutputs:
        """A Gaussian a vertex. Raises ValueError for a body of more vertices than the groups have."""
        vertices, room = len(inputs.canonical_vertices), features.shape[1] * self.group_size
        if vertices > room:
            raise ValueError(
                f"a body of {vertices} vertices: {features.shape[1]} groups of decoder.group_size {self.group_size} have {room}"
            )
        unit = subject_unit(inputs.canonical_vertices)
        raw = run.stage("raw heads", lambda f: GroupHeads(self).apply(variables, f), features)

        def assemble(raw):
            own = {name: x.reshape(room, -1)[:vertices] for name, x in raw.items()}
            offsets = self.offset_scale * jnp.tanh(own["offsets"] / self.offset_scale)
            gaussians = Gaussians(
                means=inputs.canonical_vertices + offsets * unit,
                quats=quaternion.normalize(own["quats"]),
                scales=jax.nn.softplus(own["scales"]) * unit,
                opacities=jax.nn.sigmoid(own["opacities"][:, 0]),
                colors=jax.nn.sigmoid(own["colors"]),
            )
            none = jnp.zeros((), jnp.int32)
            return HumanGSOutputs(gaussians, offsets[:, None], None, dropped_tokens=none, dropped_reads=none)

        return run.stage("canonical Gaussians", assemble, raw)


class GroupHeads(nn.Module):
    """Tokens (5, r, d) -> by attribute (r, group_size * numbers)."""

    config: GroupDecoder

    @nn.compact
    def __call__(self, tokens: Float[Array, "a r d"]) -> dict[str, Float[Array, "r s"]]:
        first = {"scales": self.config.initial_log_scale, "opacities": INITIAL_OPACITY}
        made = {}
        for token, (name, numbers) in zip(tokens, ATTRIBUTES.items(), strict=True):
            bias = quaternion.IDENTITY if name == "quats" else (first.get(name, 0.0),) * numbers
            head = nn.Dense(
                self.config.group_size * numbers,
                kernel_init=nn.initializers.normal(LAST_STD),
                bias_init=lambda key, shape, dtype=jnp.float32, b=bias: jnp.tile(
                    jnp.asarray(b, dtype), self.config.group_size
                ),
                name=name,
            )
            made[name] = head(token)
        return made
