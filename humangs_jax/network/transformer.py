"""Pre-norm transformer over all tokens of all views; position is in the tokens themselves (rays and pose features).

    x += attention(norm1(x));  x += mlp(norm2(x))

LayerNorms of the blocks have a weight and no bias, the final one has both (eps 1e-5). Norms and softmax run in float32
at least, and so does the residual stream; products run in `dtype`.
"""

from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
from jax.ad_checkpoint import checkpoint_name

from humangs_jax.core.array_types import Array, Float, Int
from humangs_jax.core.configuration import Layers, Ratio, Width, configuration
from humangs_jax.network.attention import NORM_EPSILON, PRODUCT, Attention
from humangs_jax.network.execution import Execution

INIT_STD = 0.02
_POLICIES = {"full": None, "dots": jax.checkpoint_policies.save_only_these_names(PRODUCT)}


@configuration
class TransformerConfig:
    """Sizes of the transformer.

    width: features per token. layers: blocks. mlp_ratio: hidden width of the MLP over the width. class_token: a learned global
    token in front of all others. head_width: features per attention head. qk_norm: RMSNorm over the head on q and k.
    """

    width: Width = 768
    layers: Layers = 12
    mlp_ratio: Ratio = 4
    class_token: bool = True
    head_width: Width = 64
    qk_norm: bool = True

    def __post_init__(self):
        """Raises ValueError for sizes that do not fit together."""
        if self.width % self.head_width:
            raise ValueError(f"width {self.width} is not a multiple of head_width {self.head_width}")


def layer_norm(dtype: Any, name: str, use_bias: bool = False) -> nn.LayerNorm:
    """The LayerNorm of the published network; the two-pass variance does not cancel."""
    return nn.LayerNorm(epsilon=NORM_EPSILON, use_bias=use_bias, use_fast_variance=False, dtype=dtype, name=name)


class Block(nn.Module):
    """One pre-norm block; tokens (l, d) -> (l, d)."""

    config: TransformerConfig
    execution: Execution
    index: int

    @property
    def stage_name(self) -> str:
        """Name of this block in a diagnosis."""
        return f"block {self.index}"

    @nn.compact
    def __call__(self, x: Float[Array, "l d"], count: Int[Array, ""] | None = None) -> Float[Array, "l d"]:
        config, dtype = self.config, self.execution.compute_dtype
        init = nn.initializers.normal(INIT_STD / (2 * (self.index + 1)) ** 0.5)
        dense = lambda features, name: nn.Dense(features, use_bias=False, dtype=dtype, kernel_init=init, name=name)
        normed = layer_norm(dtype, "norm1")(x)
        x = x + Attention(config.head_width, config.qk_norm, self.execution, init, name="attention")(normed, count)
        hidden = dense(config.mlp_ratio * config.width, "mlp_in")(layer_norm(dtype, "norm2")(x))
        hidden = checkpoint_name(hidden, PRODUCT)
        return x + dense(config.width, "mlp_out")(jax.nn.gelu(hidden, approximate=False))


class Transformer(nn.Module):
    """Tokens (l, d) -> outputs after layers L/4, L/2, 3L/4 (raw) and L (after the final norm), each (l, d)."""

    config: TransformerConfig
    execution: Execution

    stage_names = {"input_norm": "input norm", "norm": "final norm"}  # noqa: RUF012 (Linen would take a ClassVar for a field)

    @nn.compact
    def __call__(self, tokens: Float[Array, "l d"], count: Int[Array, ""] | None = None) -> list[Float[Array, "l d"]]:
        config, execution = self.config, self.execution
        x = layer_norm(execution.compute_dtype, "input_norm")(tokens)
        x = x.astype(jnp.promote_types(x.dtype, jnp.float32))
        quarters = (config.layers // 4, config.layers // 2, 3 * config.layers // 4)
        if execution.scan and not self.is_initializing():
            x, collected = self._scan_blocks(x, count, quarters)
        else:
            collected = []
            block_class = Block if execution.remat == "none" else nn.remat(Block, policy=_POLICIES[execution.remat])
            for index in range(config.layers):
                x = block_class(config, execution, index, name=f"block_{index}")(x, count)
                if index + 1 in quarters:
                    collected.append(x)
        return [*collected, layer_norm(execution.compute_dtype, "norm", use_bias=True)(x)]

    def _scan_blocks(self, x, count, quarters):
        """The blocks as one loop over their stacked parameters: (output, outputs at the quarters)."""
        config, remat = self.config, self.execution.remat
        block = Block(config, self.execution, 0, parent=None)
        blocks = [self.variables["params"][f"block_{index}"] for index in range(config.layers)]
        stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *blocks)
        slots = [quarters.index(i + 1) if i + 1 in quarters else len(quarters) for i in range(config.layers)]

        def step(carry, layer):
            x, kept = carry
            params, slot = layer
            x = block.apply({"params": params}, x, count)
            return (x, kept.at[slot].set(x, mode="drop")), None

        kept = jnp.zeros((len(quarters), *x.shape), x.dtype)
        body = step if remat == "none" else jax.checkpoint(step, policy=_POLICIES[remat])
        (x, kept), _ = jax.lax.scan(body, (x, kept), (stacked, jnp.asarray(slots)))
        return x, list(kept)
