"""A reader whose vertices look at all tokens of all photos by attention, without pixel alignment.

The paper replaces it by back-projection. The arithmetic of attention grows with vertices times
tokens, that of back-projection with vertices times views. One layer is

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
    """A reader with vertices as queries, and image tokens as keys and values."""

    width: Width = 768
    """Number of features of a vertex."""
    layers: Layers = 1
    """Number of layers."""
    mlp_ratio: Ratio = 4
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
    ) -> VertexFeatures:
        """Returns the features of the n vertices.

        Raises: ValueError for an encoder with an upsampler.
        """
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
    """Returns the tokens of all views, those of padding last, and the number of real tokens, None
    if all are real.

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
    if inputs.view_count is None:
        return tokens, None
    return tokens, inputs.view_count * (height * width)


def check_heads(part: str, width: int, head_width: int) -> None:
    """Raises a ValueError unless `width` features are a whole number of heads."""
    if width % head_width:
        raise ValueError(f"{part}: width {width} is not a multiple of head_width {head_width}")


class CrossBlock(nn.Module):
    """One layer, in which queries (n, d) look at tokens (l, e). The module's docstring has the
    formula.
    """

    head_width: int
    """Width of a head of the attention."""
    mlp_ratio: int
    """Width of the MLP as a multiple of d."""
    runtime: Runtime
    """Number types and the kind of attention."""

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
