"""Rigid and affine 4x4 transforms of column vectors, named by their frames: p_a = a_from_b p_b.
Also ranks points along a curve through space.

Products ask for full precision: accelerators otherwise round float32 factors to 8 or 10 bits, which
is millimetres.
"""

import jax
import jax.numpy as jnp

from humangs_jax.core.array_types import Array, Float, Int
from humangs_jax.geometry import quaternion

EXACT = jax.lax.Precision.HIGHEST


def make(
    rotation: Float[Array, "*#b 3 3"], translation: Float[Array, "*#b 3"]
) -> Float[Array, "*b 4 4"]:
    """Returns [[rotation, translation], [0, 0, 0, 1]]."""
    batch = jnp.broadcast_shapes(rotation.shape[:-2], translation.shape[:-1])
    rotation = jnp.broadcast_to(rotation, (*batch, 3, 3))
    translation = jnp.broadcast_to(translation, (*batch, 3))
    top = jnp.concatenate([rotation, translation[..., None]], axis=-1)
    bottom = jnp.broadcast_to(jnp.asarray([0.0, 0.0, 0.0, 1.0], top.dtype), (*batch, 1, 4))
    return jnp.concatenate([top, bottom], axis=-2)


def apply(
    transform: Float[Array, "*#b 4 4"], points: Float[Array, "*#b 3"]
) -> Float[Array, "*b 3"]:
    """Returns points moved by the transform. Batch axes broadcast. The last row is taken as (0, 0,
    0, 1).
    """
    return (
        jnp.einsum("...ij,...j->...i", transform[..., :3, :3], points, precision=EXACT)
        + transform[..., :3, 3]
    )


def invert_rigid(transform: Float[Array, "*b 4 4"]) -> Float[Array, "*b 4 4"]:
    """Returns the inverse of a rotation with translation. Whether the linear part is orthogonal is
    not checked.
    """
    rotation = jnp.swapaxes(transform[..., :3, :3], -1, -2)
    return make(
        rotation, -jnp.einsum("...ij,...j->...i", rotation, transform[..., :3, 3], precision=EXACT)
    )


def from_twist(twist: Float[Array, "*b 6"]) -> Float[Array, "*b 4 4"]:
    """Returns the rigid motion exp(twist) of SE(3), with exact derivatives at the zero twist.

    twist: a rotation vector w in radians, then a velocity v in metres. Let t = |w|, and [w] the
    matrix of the cross product with w. The rotation is exp([w]). The translation is V v, where V =
    1 + (1 - cos t) / t^2 [w] + (t - sin t) / t^3 [w]^2.
    """
    w, v = twist[..., :3], twist[..., 3:]
    squared = jnp.sum(w * w, axis=-1, keepdims=True)
    sine, cosine = quaternion.sine_and_cosine_ratios(squared)
    # for small angles (t - sin t) / t^3 is its Taylor series: the difference would cancel
    small = squared < 0.25
    a = jnp.where(small, squared, 0.0)
    series = 1 / 6 - a * (1 / 120 - a * (1 / 5040 - a * (1 / 362880 - a / 39916800)))
    third = jnp.where(small, series, (1 - sine) / jnp.where(small, 1.0, squared))
    across = jnp.cross(w, v)
    translation = v + cosine * across + third * jnp.cross(w, across)
    return make(quaternion.matrix_from_axis_angle(w), translation)


BITS = 10
"""Binary digits of a cell's number along an axis. There are 2^10 cells along each axis."""


def along_curve(positions: Float[Array, "n 3"], reach: float) -> Int[Array, " n"]:
    """Returns the rank of each position, (n,), along a space-filling curve (Morton's) of the cube
    from -reach to reach. Positions outside count as if on its border.
    """
    cells = 2**BITS
    at = jnp.floor((positions / (2 * reach) + 0.5) * cells).astype(jnp.int32)
    at, bits = jnp.clip(at, 0, cells - 1), jnp.arange(BITS)
    digits = (at[:, :, None] >> bits) & 1
    codes = jnp.sum(digits << (3 * bits + jnp.arange(3)[:, None]), axis=(1, 2))
    order = jnp.argsort(codes, stable=True)
    return jnp.zeros_like(order).at[order].set(jnp.arange(len(order), dtype=order.dtype))
