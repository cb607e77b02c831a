"""Parts of GST-style systems: tokens of groups of vertices look at one photo, and each token makes
one attribute of the Gaussians of its group.

GST (Prospero et al. 2024, https://arxiv.org/abs/2409.04196) takes one photo and a frozen ViT of
HMR2. 130 learned tokens (5 attributes of 26 groups of 265 vertices of SMPL) cross-attend to the
ViT's tokens. Each vertex has a Gaussian, whose mean is the posed vertex plus an offset. The body's
pose and shape and the camera come from the same network.

In our reading the tokens attend to each other before they look at the photo, as in any decoder of a
transformer. The body, its pose and the camera are given, as they are to all systems here. GST's
come from pretrained weights of HMR2, and a network that knows a few hundred people would be judged
only by its wrong poses. Our patch transformer replaces HMR2's. Vertices are grouped in their order.
Offsets are in the canonical frame, so that the person can be posed, unlike GST's. After the reader
a token changes nothing outside of its group.
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
"""{attribute of a Gaussian: its numbers}, in the order of a group's tokens."""


@part
class GroupReader(Reader):
    """A reader with a learned token for each attribute and group, which look at the tokens of one
    photo.
    """

    groups: Vertices = 26
    """Number of groups of vertices."""
    width: Width = 1024
    """Number of features of a token."""
    layers: Layers = 6
    """Number of layers."""
    mlp_ratio: Ratio = 2
    """Width of the MLPs as a multiple of `width`."""
    head_width: Width = 64
    """Width of a head of the attention."""

    def __post_init__(self):
        """Raises ValueError for sizes that do not fit together."""
        super().__post_init__()
        check_heads("reader", self.width, self.head_width)

    @nn.compact
    def __call__(
        self, encoding: Encoding, inputs: HumanGSInputs, ctx: ForwardContext
    ) -> Float[Array, "a r d"]:
        """Returns the tokens of the 5 attributes of r groups.

        Raises: ValueError for a second photo, or an encoder with an upsampler.
        """
        check_views(inputs, 1)
        tokens, count = image_tokens(encoding, inputs)
        shape = len(ATTRIBUTES) * self.groups, self.width
        x = self.param("queries", nn.initializers.normal(1.0), shape)
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
    """A decoder with a linear head for each attribute, from a group's token to the Gaussians of its
    vertices.
    """

    group_size: Vertices = 265
    """Vertices of a group. The body has at most `groups` times `group_size`."""
    offset_scale: Spread = 0.5
    """Bound of the offsets in normalised units."""
    initial_log_scale: Bias = -4.8
    """Bias of the scales before the softplus."""

    @nn.compact
    def __call__(
        self, features: Float[Array, "a r d"], inputs: HumanGSInputs, ctx: ForwardContext
    ) -> HumanGSOutputs:
        """Returns a Gaussian for each vertex.

        Raises: ValueError for a body with more vertices than the groups have.
        """
        vertices, groups = len(inputs.canonical_vertices), features.shape[1]
        room = groups * self.group_size
        if vertices > room:
            raise ValueError(
                f"a body of {vertices} vertices: {groups} groups of decoder.group_size"
                f" {self.group_size} have {room}"
            )
        # each token makes one attribute of all vertices of its group
        first = {
            "offsets": (0.0, 0.0, 0.0),
            "quats": quaternion.IDENTITY,
            "scales": (self.initial_log_scale,) * 3,
            "opacities": (INITIAL_OPACITY,),
            "colors": (0.0, 0.0, 0.0),
        }
        raw = {}
        for token, (name, numbers) in zip(features, ATTRIBUTES.items(), strict=True):

            def initial(_, __, dtype=jnp.float32, bias=first[name]):
                return jnp.tile(jnp.asarray(bias, dtype), self.group_size)

            head = nn.Dense(
                self.group_size * numbers,
                kernel_init=nn.initializers.normal(LAST_STD),
                bias_init=initial,
                name=name,
            )
            raw[name] = head(token).reshape(room, numbers)[:vertices]
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
