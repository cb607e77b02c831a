"""A reader that is not pixel-aligned: vertices look at all tokens of all photos by attention.

The paper replaces it by back-projection. Its arithmetic grows with vertices times tokens;
back-projection's grows with vertices times views. One layer is

    x += attention(q = norm(x), k, v = tokens);  x += mlp(norm(x))

where x begins as the encoded canonical position of a vertex.
"""

import flax.linen as nn
import jax
import jax.numpy as jnp

from humangs_jax.core.array_types import Array, Float, Int
from humangs_jax.core.configuration import Layers, Ratio, Width, part
from humangs_jax.network.parts import (
    Encoding,
    ForwardContext,
    HumanGSInputs,
    Reader,
    VertexFeatures,
    subject_unit,
)
from humangs_jax.network.runtime import Runtime
from humangs_jax.network.transformer import INIT_STD, NORM_EPSILON, attention, layer_norm
from humangs_jax.network.vertex_decoder import positional_encoding

INIT = nn.initializers.normal(INIT_STD)


@part
class CrossAttentionReader(Reader):
    """Vertices as queries, image tokens as keys and values."""

    width: Width = 768
    """Features of a vertex."""
    layers: Layers = 1
    mlp_ratio: Ratio = 4
    head_width: Width = 64
    """As `layers` and `mlp_ratio`: see `TransformerConfig`."""

    def __post_init__(self):
        """Raises ValueError for sizes that do not fit together."""
        super().__post_init__()
        check_heads("reader", self.width, self.head_width)

    @nn.compact
    def __call__(
        self, encoding: Encoding, inputs: HumanGSInputs, ctx: ForwardContext
    ) -> VertexFeatures:
        """Features of the n vertices. Raises ValueError for an encoder with an upsampler."""
        tokens, count = image_tokens(encoding, inputs)
        canonical = inputs.canonical_vertices / subject_unit(inputs.canonical_vertices)
        x = nn.Dense(self.width, kernel_init=INIT, name="position")(positional_encoding(canonical))
        for index in range(self.layers):
            x = CrossBlock(self.head_width, self.mlp_ratio, ctx.runtime, name=f"block_{index}")(
                x, tokens, count
            )
        local = layer_norm(None, "norm", use_bias=True)(x)
        return VertexFeatures(local, encoding.global_token, normals=inputs.canonical_normals)


def image_tokens(
    encoding: Encoding, inputs: HumanGSInputs
) -> tuple[Float[Array, "l d"], Int[Array, ""] | None]:
    """The tokens of all views, those of padding last, and the number of real ones (None: all).

    Raises: ValueError unless the maps have one element a patch.
    """
    _, height, width, features = encoding.maps.shape
    tokens, packing = encoding.maps.reshape(-1, features), encoding.packing
    patch = encoding.patch_size
    if inputs.images.shape[1:3] != (height * patch, width * patch):
        raise ValueError(
            f"attention to tokens needs maps of one element per {patch} x {patch} patch, got"
            f" {width} x {height} for photos of {inputs.images.shape[2]} x"
            f" {inputs.images.shape[1]}: encoder.upsampler must be None"
        )
    if packing is not None:
        return tokens.at[packing.indices].get(mode="fill", fill_value=0), packing.count
    return tokens, None if inputs.view_count is None else inputs.view_count * (height * width)


def check_heads(part: str, width: int, head_width: int) -> None:
    """Raises ValueError unless heads of that width fill the features."""
    if width % head_width:
        raise ValueError(f"{part}: width {width} is not a multiple of head_width {head_width}")


class CrossBlock(nn.Module):
    """One layer: queries (n, d) that look at tokens (l, e) -> (n, d); see the module."""

    head_width: int
    mlp_ratio: int
    runtime: Runtime

    @nn.compact
    def __call__(
        self, x: Float[Array, "n d"], tokens: Float[Array, "l e"], count: Int[Array, ""] | None
    ) -> Float[Array, "n d"]:
        width, dtype = x.shape[-1], self.runtime.compute_dtype

        def dense(features, name):
            return nn.Dense(features, use_bias=False, dtype=dtype, kernel_init=INIT, name=name)

        def heads(y):
            return y.reshape(len(y), -1, self.head_width)

        def rms(y, name):
            return nn.RMSNorm(epsilon=NORM_EPSILON, dtype=dtype, name=name)(y)

        q = rms(heads(dense(width, "q")(layer_norm(dtype, "norm1")(x))), "q_norm")
        k, v = jnp.split(dense(2 * width, "kv")(tokens), 2, axis=-1)
        k = rms(heads(k), "k_norm")
        seen = attention(q, k, heads(v), count, self.runtime.attention)
        x = x + dense(width, "out")(seen.reshape(len(x), width))
        hidden = dense(self.mlp_ratio * width, "mlp_in")(layer_norm(dtype, "norm2")(x))
        return x + dense(width, "mlp_out")(jax.nn.gelu(hidden, approximate=False))
