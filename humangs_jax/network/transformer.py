"""Pre-norm transformer over all tokens of all views. The tokens themselves contain their position
(rays and pose features).

    x += attention(norm1(x));  x += mlp(norm2(x))

LayerNorms of the blocks have a weight and no bias, the final one has both (eps 1e-5). Norms and
softmax run in float32 at least, and so does the residual stream; products run in `dtype`. Attention
over the tokens of all views is softmax(q k^T / sqrt(e)) v per head. With `qk_norm`, q and k are
normalised first. Tokens that are padding stand at the end, and only the first `count` tokens are
attended to. There are three exact implementations:

- "chunked": matrix products over blocks of one head's queries, recomputed in the backward pass, so
  that memory grows with L and not with L^2;
- "xla": `jax.nn.dot_product_attention`, which materialises L x L logits;
- "cudnn": the fused flash attention of `jax.nn.dot_product_attention` (NVIDIA, half precision
  only).

"auto" takes "cudnn" for half precision on a GPU, "xla" on GPU and TPU up to `XLA_TOKENS` tokens
(not in float64: its softmax is always float32), and "chunked" otherwise. For 4,097 tokens and 12
heads of 64 on a CPU of two cores, "xla" needs 2.6 s of processor time, and 7.9 s with its gradient.
"chunked" needs 0.8 s and 2.9 s (measured when it was written).
"""

from typing import Any, cast

import flax.linen as nn
import jax
import jax.numpy as jnp
from jax.ad_checkpoint import checkpoint_name

from humangs_jax.core.array_types import Array, Float, Int
from humangs_jax.core.configuration import Layers, Ratio, Width, configuration
from humangs_jax.network.runtime import AttentionKernel, Runtime

NORM_EPSILON = 1e-5
PRODUCT = "product"
"""Name of the arrays of a block that `Runtime.remat` "dots" may keep for the backward pass."""
QUERIES = 1024
"""Number of queries that "chunked" takes at once."""
XLA_TOKENS = 8192
"""Largest number of tokens for which "auto" takes "xla". The L x L logits of all heads then fit
beside a model on any accelerator (12 heads, float32: 3 GB a layer).
"""


def resolve_implementation(implementation: str, tokens: int, dtype: Any) -> AttentionKernel:
    """Returns the implementation that "auto" stands for on the default backend, for this number of
    tokens and dtype. Another name is returned unchanged.
    """
    if implementation != "auto":
        return cast(AttentionKernel, implementation)
    backend = jax.default_backend()
    if backend == "gpu" and jnp.dtype(dtype).itemsize == 2:
        return "cudnn"
    fits = tokens <= XLA_TOKENS and jnp.dtype(dtype).itemsize <= 4
    if backend in ("gpu", "tpu") and fits:
        return "xla"
    return "chunked"


def chunked_attention(
    q: Float[Array, "m h e"],
    k: Float[Array, "l h e"],
    v: Float[Array, "l h e"],
    count: Int[Array, ""] | None,
    query_chunk: int = QUERIES,
) -> Float[Array, "m h e"]:
    """Returns exact attention, computed head by head and one block of queries after the other.
    Softmax statistics are float32 at least.

    count: number of keys that are attended to, the first ones; None: all. query_chunk: largest
    number of queries in a block.
    """
    # queries of each head in blocks of equal length
    length, heads, width = q.shape
    blocks = -(-length // query_chunk)
    block = -(-length // blocks)
    q, k, v = (jnp.swapaxes(x, 0, 1) for x in (q * width**-0.5, k, v))
    q = jnp.pad(q, ((0, 0), (0, blocks * block - length), (0, 0))).reshape(
        heads, blocks, block, width
    )
    # keys beyond `count` are padding
    statistics = jnp.promote_types(q.dtype, jnp.float32)
    absent = None
    if count is not None:
        absent = jnp.arange(k.shape[1]) >= count

    @jax.checkpoint
    def attend(queries, keys, values):
        logits = jnp.einsum("qe,ke->qk", queries, keys, preferred_element_type=statistics)
        if absent is not None:
            logits = jnp.where(absent, jnp.finfo(statistics).min, logits)
        weights = jnp.exp(logits - jax.lax.stop_gradient(jnp.max(logits, axis=-1, keepdims=True)))
        total = jnp.sum(weights, axis=-1, keepdims=True)
        out = jnp.einsum(
            "qk,ke->qe", weights.astype(values.dtype), values, preferred_element_type=statistics
        )
        # dividing the sum spares a pass over the L x L weights
        return (out / total).astype(values.dtype)

    def attend_head(head):
        queries, keys, values = head
        return jax.lax.map(lambda block: attend(block, keys, values), queries)

    out = jax.lax.map(attend_head, (q, k, v)).reshape(heads, blocks * block, width)
    return jnp.swapaxes(out[:, :length], 0, 1)


def attention(
    q: Float[Array, "m h e"],
    k: Float[Array, "l h e"],
    v: Float[Array, "l h e"],
    count: Int[Array, ""] | None = None,
    implementation: str = "auto",
) -> Float[Array, "m h e"]:
    """Returns the attention of every query to the first `count` tokens (None: to all tokens)."""
    resolved = resolve_implementation(implementation, max(len(q), len(k)), q.dtype)
    if resolved == "chunked":
        return chunked_attention(q, k, v, count)
    lengths = None
    if count is not None:
        lengths = count.astype(jnp.int32)[None]
    out = jax.nn.dot_product_attention(
        q[None], k[None], v[None], key_value_seq_lengths=lengths, implementation=resolved
    )
    return out[0]


class Attention(nn.Module):
    """Multi-head self-attention without biases, from tokens (l, d) to (l, d)."""

    head_width: int
    """Features of a head."""
    qk_norm: bool
    """Whether queries and keys are normalised."""
    runtime: Runtime
    """How the network runs here."""
    kernel_init: Any
    """Initializer of the matrices."""

    @nn.compact
    def __call__(
        self, tokens: Float[Array, "l d"], count: Int[Array, ""] | None = None
    ) -> Float[Array, "l d"]:
        length, width = tokens.shape
        heads, dtype = width // self.head_width, self.runtime.compute_dtype

        def dense(features, name):
            return nn.Dense(
                features, use_bias=False, dtype=dtype, kernel_init=self.kernel_init, name=name
            )

        qkv = checkpoint_name(dense(3 * width, "qkv")(tokens), PRODUCT)
        qkv = qkv.reshape(length, 3, heads, self.head_width)
        q, k, v = qkv[:, 0], qkv[:, 1], qkv[:, 2]
        if self.qk_norm:
            q = nn.RMSNorm(epsilon=NORM_EPSILON, dtype=dtype, name="q_norm")(q)
            k = nn.RMSNorm(epsilon=NORM_EPSILON, dtype=dtype, name="k_norm")(k)
        out = attention(q, k, v, count, self.runtime.attention)
        out = checkpoint_name(out, PRODUCT)
        return dense(width, "out")(out.reshape(length, width))


INIT_STD = 0.02
_POLICIES = {"full": None, "dots": jax.checkpoint_policies.save_only_these_names(PRODUCT)}


@configuration
class TransformerConfig:
    """Sizes of the transformer."""

    width: Width = 768
    """Features per token."""
    layers: Layers = 12
    """Number of blocks."""
    mlp_ratio: Ratio = 4
    """Hidden width of the MLP, divided by the width."""
    class_token: bool = True
    """Whether there is a learned global token in front of all others."""
    head_width: Width = 64
    """Features per attention head."""
    qk_norm: bool = True
    """Whether queries and keys are normalised by an RMSNorm over the head."""

    def __post_init__(self):
        """Raises ValueError for sizes that do not fit together."""
        if self.width % self.head_width:
            raise ValueError(
                f"width {self.width} is not a multiple of head_width {self.head_width}"
            )


def layer_norm(dtype: Any, name: str, use_bias: bool = False) -> nn.LayerNorm:
    """Returns the LayerNorm of the published network. Its two-pass variance does not lose digits to
    cancellation.
    """
    return nn.LayerNorm(
        epsilon=NORM_EPSILON, use_bias=use_bias, use_fast_variance=False, dtype=dtype, name=name
    )


class Block(nn.Module):
    """One pre-norm block, from tokens (l, d) to (l, d)."""

    config: TransformerConfig
    """Sizes of the transformer."""
    runtime: Runtime
    """How the network runs here."""
    index: int
    """Number of the block, from 0. Deeper blocks start with smaller weights."""

    @nn.compact
    def __call__(
        self, x: Float[Array, "l d"], count: Int[Array, ""] | None = None
    ) -> Float[Array, "l d"]:
        config, dtype = self.config, self.runtime.compute_dtype
        init = nn.initializers.normal(INIT_STD / (2 * (self.index + 1)) ** 0.5)

        def dense(features, name):
            return nn.Dense(features, use_bias=False, dtype=dtype, kernel_init=init, name=name)

        normed = layer_norm(dtype, "norm1")(x)
        x = x + Attention(config.head_width, config.qk_norm, self.runtime, init, name="attention")(
            normed, count
        )
        hidden = dense(config.mlp_ratio * config.width, "mlp_in")(layer_norm(dtype, "norm2")(x))
        hidden = checkpoint_name(hidden, PRODUCT)
        return x + dense(config.width, "mlp_out")(jax.nn.gelu(hidden, approximate=False))


class Transformer(nn.Module):
    """Maps tokens (l, d) to outputs after layers L/4, L/2, 3L/4 (raw) and L (after the final norm),
    (l, d) each.
    """

    config: TransformerConfig
    """Sizes of the transformer."""
    runtime: Runtime
    """How the network runs here."""

    @nn.compact
    def __call__(
        self, tokens: Float[Array, "l d"], count: Int[Array, ""] | None = None
    ) -> list[Float[Array, "l d"]]:
        config, runtime = self.config, self.runtime
        x = layer_norm(runtime.compute_dtype, "input_norm")(tokens)
        x = x.astype(jnp.promote_types(x.dtype, jnp.float32))
        quarters = (config.layers // 4, config.layers // 2, 3 * config.layers // 4)
        if runtime.scan and not self.is_initializing():
            x, collected = self._scan_blocks(x, count, quarters)
        else:
            collected = []
            block_class = Block
            if runtime.remat != "none":
                block_class = nn.remat(Block, policy=_POLICIES[runtime.remat])
            for index in range(config.layers):
                x = block_class(config, runtime, index, name=f"block_{index}")(x, count)
                if index + 1 in quarters:
                    collected.append(x)
        return [*collected, layer_norm(runtime.compute_dtype, "norm", use_bias=True)(x)]

    def _scan_blocks(
        self, x: Float[Array, "l d"], count: Int[Array, ""] | None, quarters: tuple[int, ...]
    ) -> tuple[Float[Array, "l d"], list[Float[Array, "l d"]]]:
        """Returns the output of the blocks and the outputs at the quarters. The blocks run as one
        loop over their stacked parameters.
        """
        config, remat = self.config, self.runtime.remat
        block = Block(config, self.runtime, 0, parent=None)
        blocks = [self.variables["params"][f"block_{index}"] for index in range(config.layers)]
        stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *blocks)
        slots = [
            quarters.index(i + 1) if i + 1 in quarters else len(quarters)
            for i in range(config.layers)
        ]

        def step(carry, layer):
            x, kept = carry
            params, slot = layer
            x = block.apply({"params": params}, x, count)
            return (x, kept.at[slot].set(x, mode="drop")), None

        kept = jnp.zeros((len(quarters), *x.shape), x.dtype)
        body = step
        if remat != "none":
            body = jax.checkpoint(step, policy=_POLICIES[remat])
        (x, kept), _ = jax.lax.scan(body, (x, kept), (stacked, jnp.asarray(slots)))
        return x, list(kept)
