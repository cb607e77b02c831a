"""Rigid and affine 4x4 transforms of column vectors, named by their frames: p_a = a_from_b p_b.
Order of points in space.

Products ask for full precision: accelerators otherwise round float32 factors to 8 or 10 bits, which
is millimetres.
"""

import jax
import jax.numpy as jnp

from humangs_jax.core.array_types import Array, Float, Int

EXACT = jax.lax.Precision.HIGHEST


def make(
    rotation: Float[Array, "*#b 3 3"], translation: Float[Array, "*#b 3"]
) -> Float[Array, "*b 4 4"]:
    """[[rotation, translation], [0, 0, 0, 1]]."""
    batch = jnp.broadcast_shapes(rotation.shape[:-2], translation.shape[:-1])
    rotation = jnp.broadcast_to(rotation, (*batch, 3, 3))
    translation = jnp.broadcast_to(translation, (*batch, 3))
    top = jnp.concatenate([rotation, translation[..., None]], axis=-1)
    bottom = jnp.broadcast_to(jnp.asarray([0.0, 0.0, 0.0, 1.0], top.dtype), (*batch, 1, 4))
    return jnp.concatenate([top, bottom], axis=-2)


def apply(
    transform: Float[Array, "*#b 4 4"], points: Float[Array, "*#b 3"]
) -> Float[Array, "*b 3"]:
    """Move points by the transform; batch axes broadcast. The last row is taken as (0, 0, 0, 1)."""
    return (
        jnp.einsum("...ij,...j->...i", transform[..., :3, :3], points, precision=EXACT)
        + transform[..., :3, 3]
    )


def invert_rigid(transform: Float[Array, "*b 4 4"]) -> Float[Array, "*b 4 4"]:
    """Inverse of a rotation with translation (the linear part is not checked to be orthogonal)."""
    rotation = jnp.swapaxes(transform[..., :3, :3], -1, -2)
    return make(
        rotation, -jnp.einsum("...ij,...j->...i", rotation, transform[..., :3, 3], precision=EXACT)
    )


BITS = 10
"""Cells along each axis: 2^10."""


def along_curve(positions: Float[Array, "n 3"], reach: float) -> Int[Array, " n"]:
    """Rank of each position along the curve of the cube from -reach to reach; outside of it, that
    of its border.
    """
    cells = 2**BITS
    at = jnp.floor((positions / (2 * reach) + 0.5) * cells).astype(jnp.int32)
    at, bits = jnp.clip(at, 0, cells - 1), jnp.arange(BITS)
    digits = (at[:, :, None] >> bits) & 1
    codes = jnp.sum(digits << (3 * bits + jnp.arange(3)[:, None]), axis=(1, 2))
    order = jnp.argsort(codes, stable=True)
    return jnp.zeros_like(order).at[order].set(jnp.arange(len(order), dtype=order.dtype))
