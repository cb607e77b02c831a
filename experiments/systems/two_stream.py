"""The reader of LHM-style systems, in which points of the body and image tokens attend to each
other and to themselves, in two streams.

LHM (Qiu et al. 2025, https://arxiv.org/abs/2503.10625) has encoded canonical points of the body and
the tokens of one photo in blocks like those of Stable Diffusion 3 (Esser et al. 2024,
https://arxiv.org/abs/2403.03206): joint attention over both, with separate weights for each stream,
modulated by the pooled image features. A small MLP makes a Gaussian of every point. The camera and
the pose of the photo are not used. LHM++ (https://arxiv.org/abs/2506.13766) does this with pooled
points and several photos.

In our reading the points are the vertices of the body. Our patch transformer, trained with the
rest, replaces the frozen Sapiens and DINOv2. There is no second branch for the head, because our
inputs have no crop of it. Points are pooled along a Morton curve, as Point Transformer V3 does
(https://arxiv.org/abs/2312.10035), once and not in a U-Net. Gaussians are drawn directly, and are
no features for a second network. The cost grows with (points + tokens)^2.
"""

import flax.linen as nn
import jax
import jax.numpy as jnp

from experiments.systems.cross_attention import INIT, check_heads, image_tokens
from humangs_jax.core.array_types import Array, Float, Int
from humangs_jax.core.configuration import Count, Layers, Ratio, Vertices, Width, part
from humangs_jax.geometry.transform import along_curve
from humangs_jax.network.parts import (
    Encoding,
    ForwardContext,
    HumanGSInputs,
    Reader,
    VertexFeatures,
    subject_unit,
)
from humangs_jax.network.runtime import Runtime
from humangs_jax.network.transformer import NORM_EPSILON, attention, layer_norm
from humangs_jax.network.vertex_decoder import positional_encoding

CURVE_REACH = 1.2
"""Half the side of the curve's cube in normalised units. Canonical bodies are 1.8 high and less
than 2 wide.
"""


@part
class TwoStreamReader(Reader):
    """A reader with joint attention of points and tokens."""

    width: Width = 1024
    """Number of features of both streams."""
    blocks: Layers = 5
    """Number of blocks."""
    mlp_ratio: Ratio = 4
    """Width of the MLPs as a multiple of `width`."""
    head_width: Width = 64
    """Width of a head of the attention."""
    pooling: Vertices = 1
    """Number of vertices that share a point. 1: every vertex is a point."""
    most_views: Count | None = None
    """Largest number of photos, which is 1 in LHM. None: any number."""

    def __post_init__(self):
        """Raises ValueError for sizes that do not fit together."""
        super().__post_init__()
        check_heads("reader", self.width, self.head_width)

    @nn.compact
    def __call__(
        self, encoding: Encoding, inputs: HumanGSInputs, ctx: ForwardContext
    ) -> VertexFeatures:
        """Returns the features of the n vertices.

        Raises: ValueError for too many views, or an encoder with an upsampler.
        """
        check_views(inputs, self.most_views)
        tokens, count = image_tokens(encoding, inputs)
        positions = inputs.canonical_vertices / subject_unit(inputs.canonical_vertices)

        def dense(name):
            return nn.Dense(self.width, kernel_init=INIT, name=name)

        hidden = jax.nn.silu(dense("position_in")(positional_encoding(positions)))
        embedded = dense("position_out")(hidden)
        # neighbours along a curve through space share a point
        points, cluster = embedded, None
        if self.pooling > 1:
            cluster = along_curve(positions, CURVE_REACH) // self.pooling
            clusters = -(-len(positions) // self.pooling)
            members = jax.ops.segment_sum(jnp.ones(len(positions)), cluster, clusters)
            points = jax.ops.segment_sum(embedded, cluster, clusters) / members[:, None]
        tokens = layer_norm(None, "token_norm")(dense("tokens")(tokens))
        # the mean token modulates every block
        present = jnp.ones(len(tokens))
        if count is not None:
            present = (jnp.arange(len(tokens)) < count).astype(jnp.float32)
        pooled = jnp.sum(tokens * present[:, None], axis=0) / jnp.maximum(jnp.sum(present), 1)
        for index in range(self.blocks):
            last, sizes = index + 1 == self.blocks, (self.width, self.mlp_ratio, self.head_width)
            block = TwoStreamBlock(*sizes, ctx.runtime, last, name=f"block_{index}")
            points, tokens = block(points, tokens, count, pooled)
        points = layer_norm(None, "norm", use_bias=True)(points)
        local = points
        if cluster is not None:
            local = points[cluster] + dense("skip")(embedded)
        return VertexFeatures(local, encoding.global_token, normals=inputs.canonical_normals)


def check_views(inputs: HumanGSInputs, most: int | None) -> None:
    """Raises a ValueError for more photos than a system takes."""
    if most is not None and len(inputs.images) > most:
        raise ValueError(f"{len(inputs.images)} photos: this system takes {most}")


class TwoStreamBlock(nn.Module):
    """A block of joint attention over points (n, d) and tokens (l, d).

    The modulation starts as the identity, and gates at 0 (Peebles & Xie 2023,
    https://arxiv.org/abs/2212.09748).
    """

    width: int
    """Number of features d."""
    mlp_ratio: int
    """Width of the MLPs as a multiple of `width`."""
    head_width: int
    """Width of a head of the attention."""
    runtime: Runtime
    """Number types and the kind of attention."""
    last: bool
    """Whether it is the last block, which returns the tokens unchanged, because nothing reads
    them.
    """

    @nn.compact
    def __call__(
        self,
        points: Float[Array, "n d"],
        tokens: Float[Array, "l d"],
        count: Int[Array, ""] | None,
        pooled: Float[Array, " d"],
    ) -> tuple[Float[Array, "n d"], Float[Array, "l d"]]:
        """Returns points and tokens after attention to each other.

        `count` is the number of tokens that are no padding, and `pooled` modulates the block.
        """
        dtype, width, vertices = self.runtime.compute_dtype, self.width, len(points)

        def dense(features, name):
            return nn.Dense(features, use_bias=False, dtype=dtype, kernel_init=INIT, name=name)

        def modulations(name, number):
            """Returns the shifts, scales and gates of one stream, which are 0 at first."""
            zeros = nn.initializers.zeros
            made = nn.Dense(number * width, kernel_init=zeros, name=f"{name}_modulation")
            return jnp.split(made(jax.nn.silu(pooled)), number)

        def heads(x, name, modulation, ask):
            """Returns keys and values of a stream, and also queries if it asks."""
            shift, scale = modulation
            x = layer_norm(dtype, f"{name}_norm1")(x) * (1 + scale) + shift
            made = dense((2 + ask) * width, f"{name}_kvq")(x).reshape(len(x), -1, self.head_width)
            k, v, *q = jnp.split(made, 2 + ask, axis=1)

            def rms(y, which):
                return nn.RMSNorm(epsilon=NORM_EPSILON, dtype=dtype, name=f"{name}_{which}_norm")(y)

            return [rms(k, "k"), v, *(rms(y, "q") for y in q)]

        def update(x, seen, name, modulation):
            """Returns a stream after it has added what it has seen, and an MLP."""
            gate1, shift, scale, gate2 = modulation
            x = x + gate1 * dense(width, f"{name}_out")(seen.reshape(len(x), width))
            hidden = layer_norm(dtype, f"{name}_norm2")(x) * (1 + scale) + shift
            hidden = dense(self.mlp_ratio * width, f"{name}_mlp_in")(hidden)
            hidden = jax.nn.gelu(hidden, approximate=False)
            return x + gate2 * dense(width, f"{name}_mlp_out")(hidden)

        of_points = modulations("points", 6)
        of_tokens = modulations("tokens", 2 if self.last else 6)
        # both streams are one sequence for the attention
        k, v, q = heads(points, "points", of_points[:2], ask=True)
        token_k, token_v, *token_q = heads(tokens, "tokens", of_tokens[:2], ask=not self.last)
        k, v = jnp.concatenate([k, token_k]), jnp.concatenate([v, token_v])
        q = jnp.concatenate([q, *token_q])
        total = None if count is None else vertices + count
        seen = attention(q, k, v, total, self.runtime.attention)
        points = update(points, seen[:vertices], "points", of_points[2:])
        if self.last:
            return points, tokens
        return points, update(tokens, seen[vertices:], "tokens", of_tokens[2:])
