"""GST-style: tokens of groups of vertices look at one photo, and each makes one attribute of the
Gaussians of its group.

Theirs (Prospero et al. 2024, https://arxiv.org/abs/2409.04196): one photo, a frozen HMR2 ViT, 130
learned tokens (5 attributes of 26 groups of 265 vertices of SMPL) that cross-attend to its tokens;
a Gaussian a vertex, its mean the posed vertex plus an offset; the body's pose and shape and the
camera come from the same network.

Our reading: the tokens attend to each other before they look at the photo, as in any decoder of a
transformer; the body, its pose and the camera are given, as they are to every system here: theirs
come from HMR2's pretrained weights, and a network that knows a few hundred people would be judged
by its wrong poses alone; our patch transformer stands for HMR2's; vertices are grouped in their
order; offsets are in the canonical frame, so that the person can be posed, which theirs cannot.
Behind the reader a token changes nothing outside of its group.
"""

import flax.linen as nn
import jax
import jax.numpy as jnp

from experiments.systems.cross_attention import CrossBlock, check_heads, image_tokens
from experiments.systems.two_stream import check_views
from humangs_jax.core.array_types import Array, Float
from humangs_jax.core.configuration import Bias, Layers, Ratio, Spread, Vertices, Width, part
from humangs_jax.geometry import quaternion
from humangs_jax.network.parts import (
    Decoder,
    Encoding,
    ForwardContext,
    HumanGSInputs,
    HumanGSOutputs,
    Reader,
    subject_unit,
)
from humangs_jax.network.transformer import INIT_STD, Attention, layer_norm
from humangs_jax.network.vertex_decoder import INITIAL_OPACITY, LAST_STD
from humangs_jax.rendering.gaussians import Gaussians

ATTRIBUTES = {"offsets": 3, "quats": 4, "scales": 3, "opacities": 1, "colors": 3}
"""Numbers of each attribute of a Gaussian; the order of a group's tokens."""


@part
class GroupReader(Reader):
    """Learned tokens, one an attribute and group, that look at the tokens of one photo.

    `width`: of a token; `layers`, `mlp_ratio` and `head_width` as in `CrossAttentionReader`.
    """

    groups: Vertices = 26
    """Of vertices."""
    width: Width = 1024
    layers: Layers = 6
    mlp_ratio: Ratio = 2
    head_width: Width = 64

    def __post_init__(self):
        """Raises ValueError for sizes that do not fit together."""
        super().__post_init__()
        check_heads("reader", self.width, self.head_width)

    @nn.compact
    def __call__(
        self, encoding: Encoding, inputs: HumanGSInputs, ctx: ForwardContext
    ) -> Float[Array, "a r d"]:
        """Tokens of the 5 attributes of r groups.

        Raises ValueError for a second photo, or an encoder with an upsampler.
        """
        check_views(inputs, 1)
        tokens, count = image_tokens(encoding, inputs)
        x = self.param(
            "queries", nn.initializers.normal(1.0), (len(ATTRIBUTES) * self.groups, self.width)
        )
        init = nn.initializers.normal(INIT_STD)
        for index in range(self.layers):
            own = Attention(self.head_width, True, ctx.runtime, init, name=f"self_{index}")
            x = x + own(layer_norm(ctx.runtime.compute_dtype, f"self_norm_{index}")(x), None)
            x = CrossBlock(self.head_width, self.mlp_ratio, ctx.runtime, name=f"block_{index}")(
                x, tokens, count
            )
        return layer_norm(None, "norm", use_bias=True)(x).reshape(
            len(ATTRIBUTES), self.groups, self.width
        )


@part
class GroupDecoder(Decoder):
    """A linear head an attribute, from a group's token to the Gaussians of its vertices."""

    group_size: Vertices = 265
    """Vertices of a group; the body has at most groups * group_size."""
    offset_scale: Spread = 0.5
    """Bound of the offsets, normalised units."""
    initial_log_scale: Bias = -4.8
    """Bias of the scales before the softplus."""

    @nn.compact
    def __call__(
        self, features: Float[Array, "a r d"], inputs: HumanGSInputs, ctx: ForwardContext
    ) -> HumanGSOutputs:
        """A Gaussian a vertex. Raises ValueError for a body of more vertices than the groups
        have.
        """
        vertices, groups = len(inputs.canonical_vertices), features.shape[1]
        room = groups * self.group_size
        if vertices > room:
            raise ValueError(
                f"a body of {vertices} vertices: {groups} groups of decoder.group_size"
                f" {self.group_size} have {room}"
            )
        # a token an attribute: each gives that attribute of all vertices of its group
        first = {"scales": self.initial_log_scale, "opacities": INITIAL_OPACITY}
        raw = {}
        for token, (name, numbers) in zip(features, ATTRIBUTES.items(), strict=True):
            bias = quaternion.IDENTITY if name == "quats" else (first.get(name, 0.0),) * numbers
            raw[name] = nn.Dense(
                self.group_size * numbers,
                kernel_init=nn.initializers.normal(LAST_STD),
                bias_init=lambda _, __, dtype=jnp.float32, b=bias: jnp.tile(
                    jnp.asarray(b, dtype), self.group_size
                ),
                name=name,
            )(token).reshape(room, numbers)[:vertices]
        # offsets are limited, in units of the body
        unit = subject_unit(inputs.canonical_vertices)
        offsets = self.offset_scale * jnp.tanh(raw["offsets"] / self.offset_scale)
        gaussians = Gaussians(
            means=inputs.canonical_vertices + offsets * unit,
            quats=quaternion.normalize(raw["quats"]),
            scales=jax.nn.softplus(raw["scales"]) * unit,
            opacities=jax.nn.sigmoid(raw["opacities"][:, 0]),
            colors=jax.nn.sigmoid(raw["colors"]),
        )
        return HumanGSOutputs(gaussians, offsets[:, None])
