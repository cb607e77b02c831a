"""Points in the order of a Morton curve: those that are near in the order are near in space."""

import jax.numpy as jnp

from humangs_jax.core.array_types import Array, Float, Int

BITS = 10
"""Cells along each axis: 2^10."""


def along_curve(positions: Float[Array, "n 3"], reach: float) -> Int[Array, " n"]:
    """Rank of each position along the curve of the cube from -reach to reach; outside of it, that of its border."""
    cells = 2**BITS
    at = jnp.floor((positions / (2 * reach) + 0.5) * cells).astype(jnp.int32)
    at, bits = jnp.clip(at, 0, cells - 1), jnp.arange(BITS)
    digits = (at[:, :, None] >> bits) & 1
    codes = jnp.sum(digits << (3 * bits + jnp.arange(3)[:, None]), axis=(1, 2))
    order = jnp.argsort(codes, stable=True)
    return jnp.zeros_like(order).at[order].set(jnp.arange(len(order), dtype=order.dtype))
