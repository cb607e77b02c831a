"""Rotations: quaternions (w, x, y, z), axis-angle vectors and matrices.

q = w + xi + yj + zk acts on column vectors by v' = q v q*. Axis-angle is the rotation vector theta * axis, in radians.
Quaternions q and -q are the same rotation.
"""

import jax.numpy as jnp

from humangs_jax.core.array_types import Array, Float
from humangs_jax.core.numerics import safe_normalize

IDENTITY = (1.0, 0.0, 0.0, 0.0)
SMALL_ANGLE_SQUARED = 1e-4
"""Below this the Taylor series of sin(t)/t and (1-cos t)/t^2, cut after t^4, are exact to float32 rounding (t^6/5040 < 2e-16)."""

SMALLEST_SQUARE = 1e-30
"""Of a sine: below it the sine is the angle, and derivatives of its root would overflow in float32."""

OPPOSITE = 1e-12
"""Unit vectors whose product is less than this above -1 count as opposite: their cross product is rounding."""


def normalize(q: Float[Array, "*b 4"]) -> Float[Array, "*b 4"]:
    """q / |q|; the identity, with zero gradient, where q is 0."""
    return safe_normalize(q, jnp.asarray(IDENTITY, q.dtype))


def multiply(p: Float[Array, "*#b 4"], q: Float[Array, "*#b 4"]) -> Float[Array, "*b 4"]:
    """Hamilton product p q: first rotates by q, then by p."""
    pw, px, py, pz = jnp.moveaxis(p, -1, 0)
    qw, qx, qy, qz = jnp.moveaxis(q, -1, 0)
    return jnp.stack(
        [
            pw * qw - px * qx - py * qy - pz * qz,
            pw * qx + px * qw + py * qz - pz * qy,
            pw * qy - px * qz + py * qw + pz * qx,
            pw * qz + px * qy - py * qx + pz * qw,
        ],
        axis=-1,
    )


def between(a: Float[Array, "*#b 3"], b: Float[Array, "*#b 3"]) -> Float[Array, "*b 4"]:
    """The shortest rotation from one unit vector to another; half a turn across `a` where they are opposite."""
    real = jnp.sum(jnp.square(a + b), axis=-1, keepdims=True) / 2  # 1 + a.b without cancellation
    across = jnp.cross(a, jnp.eye(3, dtype=a.dtype)[jnp.argmin(jnp.abs(a), axis=-1)])
    opposite = real < OPPOSITE
    imaginary = jnp.where(opposite, across, jnp.cross(a, b))
    return normalize(jnp.concatenate([jnp.where(opposite, 0.0, real), imaginary], axis=-1))


def to_matrix(q: Float[Array, "*b 4"]) -> Float[Array, "*b 3 3"]:
    """Rotation matrix of a unit quaternion. For |q| != 1 the polynomial is used as it is (see `normalize`)."""
    w, x, y, z = jnp.moveaxis(q, -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return jnp.stack([jnp.stack(row, axis=-1) for row in rows], axis=-2)


def candidates_from_matrix(
    m: Float[Array, "*b 3 3"], smallest: float = 0.1
) -> tuple[Float[Array, "*b 4 4"], Float[Array, "*b 4"]]:
    """The four quaternions that a rotation matrix can be read as, and how well conditioned each is.

    q_abs = sqrt(max(0, 1 ± m00 ± m11 ± m22)); candidate c is row c divided by 2 max(q_abs, `smallest`). Of a rotation
    they are all the same; of another matrix they are not.
    """
    m00, m11, m22 = m[..., 0, 0], m[..., 1, 1], m[..., 2, 2]
    squared = jnp.stack([1 + m00 + m11 + m22, 1 + m00 - m11 - m22, 1 - m00 + m11 - m22, 1 - m00 - m11 + m22], axis=-1)
    positive = squared > 0
    q_abs = jnp.where(positive, jnp.sqrt(jnp.where(positive, squared, 1.0)), 0.0)
    a, b, c = m[..., 2, 1] - m[..., 1, 2], m[..., 0, 2] - m[..., 2, 0], m[..., 1, 0] - m[..., 0, 1]
    d, e, f = m[..., 1, 0] + m[..., 0, 1], m[..., 0, 2] + m[..., 2, 0], m[..., 1, 2] + m[..., 2, 1]
    w2, x2, y2, z2 = jnp.moveaxis(jnp.square(q_abs), -1, 0)
    candidates = jnp.stack(
        [
            jnp.stack([w2, a, b, c], axis=-1),
            jnp.stack([a, x2, d, e], axis=-1),
            jnp.stack([b, d, y2, f], axis=-1),
            jnp.stack([c, e, f, z2], axis=-1),
        ],
        axis=-2,
    )
    return candidates / (2 * jnp.maximum(q_abs, smallest))[..., None], q_abs


def from_matrix(m: Float[Array, "*b 3 3"], smallest: float = 0.1) -> Float[Array, "*b 4"]:
    """Quaternion of a rotation matrix, by the best conditioned of the four candidates (see `candidates_from_matrix`).

    A matrix that is no rotation is not repaired: the result then has |q| != 1, as in the published network ("rotation"
    skinning).
    """
    candidates, q_abs = candidates_from_matrix(m, smallest)
    best = jnp.argmax(q_abs, axis=-1)[..., None, None]
    return jnp.take_along_axis(candidates, best, axis=-2)[..., 0, :]


def _sine_and_cosine_ratios(angle_squared):
    """sin(t)/t and (1 - cos t)/t^2 from t^2, smooth through 0."""
    small = angle_squared < SMALL_ANGLE_SQUARED
    squared = jnp.where(small, 1.0, angle_squared)
    angle = jnp.sqrt(squared)
    sine = jnp.where(small, 1 - angle_squared / 6 + angle_squared**2 / 120, jnp.sin(angle) / angle)
    half = jnp.sin(angle / 2)  # 1 - cos t = 2 sin^2(t/2): no cancellation
    cosine = jnp.where(small, 0.5 - angle_squared / 24 + angle_squared**2 / 720, 2 * half * half / squared)
    return sine, cosine


def matrix_from_axis_angle(axis_angle: Float[Array, "*b 3"]) -> Float[Array, "*b 3 3"]:
    """Rodrigues' formula, with exact derivatives at the zero rotation."""
    x, y, z = jnp.moveaxis(axis_angle, -1, 0)
    sine, cosine = _sine_and_cosine_ratios(x * x + y * y + z * z)
    rows = [
        [1 - cosine * (y * y + z * z), cosine * x * y - sine * z, cosine * x * z + sine * y],
        [cosine * x * y + sine * z, 1 - cosine * (x * x + z * z), cosine * y * z - sine * x],
        [cosine * x * z - sine * y, cosine * y * z + sine * x, 1 - cosine * (x * x + y * y)],
    ]
    return jnp.stack([jnp.stack(row, axis=-1) for row in rows], axis=-2)


def from_axis_angle(axis_angle: Float[Array, "*b 3"]) -> Float[Array, "*b 4"]:
    """Unit quaternion of a rotation vector, with exact derivatives at the zero rotation."""
    half = 0.5 * axis_angle
    squared = jnp.sum(jnp.square(half), axis=-1)
    sine, cosine = _sine_and_cosine_ratios(squared)
    return jnp.concatenate([(1 - squared * cosine)[..., None], half * sine[..., None]], axis=-1)


def to_axis_angle(q: Float[Array, "*b 4"]) -> Float[Array, "*b 3"]:
    """The rotation vector, no longer than pi, of a unit quaternion, with exact derivatives at the zero rotation."""
    q = jnp.where(q[..., :1] < 0, -q, q)
    squared = jnp.sum(jnp.square(q[..., 1:]), axis=-1, keepdims=True)
    turned = squared > SMALLEST_SQUARE
    sine = jnp.sqrt(jnp.where(turned, squared, 1.0))
    return q[..., 1:] * jnp.where(turned, 2 * jnp.arctan2(sine, q[..., :1]) / sine, 2.0)


def interpolate(a: Float[Array, "*#b 3"], b: Float[Array, "*#b 3"], share: Float[Array, "*#b"]) -> Float[Array, "*b 3"]:
    """The rotation vector that many shares of the shortest way from a to b: spherical linear interpolation (Shoemake 1985,
    https://doi.org/10.1145/325165.325242).
    """
    start = from_axis_angle(a)
    turn = to_axis_angle(multiply(from_axis_angle(-a), from_axis_angle(b)))
    return to_axis_angle(multiply(start, from_axis_angle(share[..., None] * turn)))
