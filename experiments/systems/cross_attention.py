"""A reader that is not pixel-aligned: vertices look at all tokens of all photos by attention.

The paper replaces it by back-projection. Its arithmetic grows with vertices times tokens; back-projection's grows with
vertices times views. One layer is

    x += attention(q = norm(x), k, v = tokens);  x += mlp(norm(x))

where x begins as the encoded canonical position of a vertex.
"""

from typing import cast

import flax.linen as nn
import jax
import jax.numpy as jnp

from humangs_jax.core.array_types import Array, Float, Int, Key
from humangs_jax.core.configuration import Layers, Patch, Ratio, Width, part
from humangs_jax.network.encoder import pack_patches, touched_patches
from humangs_jax.network.inputs import HumanGSInputs, subject_unit
from humangs_jax.network.parts import Encoding, Pass, Variables, VertexFeatures
from humangs_jax.network.runtime import Runtime
from humangs_jax.network.transformer import INIT_STD, NORM_EPSILON, attention, layer_norm
from humangs_jax.network.vertex_decoder import positional_encoding

INIT = nn.initializers.normal(INIT_STD)


@part
class CrossAttentionReader:
    """Vertices as queries, image tokens as keys and values. width: features of a vertex. layers, mlp_ratio, head_width: as in
    `TransformerConfig`. patch_size: of the encoder whose tokens are looked at.
    """

    width: Width = 768
    layers: Layers = 1
    mlp_ratio: Ratio = 4
    head_width: Width = 64
    patch_size: Patch = 8

    def __post_init__(self):
        """Raises ValueError for sizes that do not fit together."""
        check_heads("reader", self.width, self.head_width)

    def init(self, key: Key, encoding: Encoding, inputs: HumanGSInputs, run: Pass) -> Variables:
        """{"params"} of the layers."""
        tokens = jnp.zeros((1, encoding.maps.shape[-1]))
        return cast(Variables, self._module(run).init(key, jnp.zeros((1, 3)), tokens, None))

    def apply(self, variables: Variables, encoding: Encoding, inputs: HumanGSInputs, run: Pass) -> VertexFeatures:
        """Features of the n vertices. Raises ValueError for an encoder with an upsampler."""
        canonical = inputs.canonical_vertices / subject_unit(inputs.canonical_vertices)
        local = self._module(run).apply(variables, canonical, *image_tokens(encoding, inputs, run, self.patch_size))
        return VertexFeatures(cast(Array, local), encoding.global_token, normals=inputs.canonical_normals)

    def _module(self, run: Pass):
        return VertexQueries(self, run.runtime)


def image_tokens(
    encoding: Encoding, inputs: HumanGSInputs, run: Pass, patch: int
) -> tuple[Float[Array, "l d"], Int[Array, ""] | None]:
    """The tokens of all views, those of padding last, and the number of real ones (None: all).

    Raises: ValueError unless the maps have one element a patch.
    """
    height, width, features = encoding.maps.shape[1:]
    if inputs.images.shape[1:3] != (height * patch, width * patch):
        raise ValueError(
            f"attention to tokens needs maps of one element per {patch} x {patch} patch, got {width} x {height} for photos of "
            f"{inputs.images.shape[2]} x {inputs.images.shape[1]}: encoder.upsampler must be None"
        )
    tokens = encoding.maps.reshape(-1, features)
    if run.tokens == "foreground":
        packing = pack_patches(
            touched_patches(inputs, patch), min(run.runtime.token_capacity or len(tokens), len(tokens))
        )
        return tokens.at[packing.indices].get(mode="fill", fill_value=0), packing.count
    return tokens, None if inputs.view_count is None else inputs.view_count * (height * width)


def check_heads(part: str, width: int, head_width: int) -> None:
    """Raises ValueError unless heads of that width fill the features."""
    if width % head_width:
        raise ValueError(f"{part}: width {width} is not a multiple of head_width {head_width}")


class VertexQueries(nn.Module):
    """Canonical positions (n, 3) and tokens (l, e) -> features (n, d)."""

    config: CrossAttentionReader
    runtime: Runtime

    @nn.compact
    def __call__(
        self, positions: Float[Array, "n 3"], tokens: Float[Array, "l e"], count: Int[Array, ""] | None
    ) -> Float[Array, "n d"]:
        x = nn.Dense(self.config.width, kernel_init=INIT, name="position")(positional_encoding(positions))
        for index in range(self.config.layers):
            x = CrossBlock(self.config.head_width, self.config.mlp_ratio, self.runtime, name=f"block_{index}")(
                x, tokens, count
            )
        return layer_norm(None, "norm", use_bias=True)(x)


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
        dense = lambda features, name: nn.Dense(features, use_bias=False, dtype=dtype, kernel_init=INIT, name=name)
        heads = lambda y: y.reshape(len(y), -1, self.head_width)
        rms = lambda y, name: nn.RMSNorm(epsilon=NORM_EPSILON, dtype=dtype, name=name)(y)
        q = rms(heads(dense(width, "q")(layer_norm(dtype, "norm1")(x))), "q_norm")
        k, v = jnp.split(dense(2 * width, "kv")(tokens), 2, axis=-1)
        k = rms(heads(k), "k_norm")
        seen = attention(q, k, heads(v), count, self.runtime.attention, self.runtime.attention_chunk)
        x = x + dense(width, "out")(seen.reshape(len(x), width))
        hidden = dense(self.mlp_ratio * width, "mlp_in")(layer_norm(dtype, "norm2")(x))
        return x + dense(width, "mlp_out")(jax.nn.gelu(hidden, approximate=False))
