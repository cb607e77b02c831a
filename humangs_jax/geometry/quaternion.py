"""Converts rotations: quaternions (w, x, y, z), axis-angle vectors and matrices. Also finds
singular vectors of 3x3 matrices.

q = w + xi + yj + zk acts on column vectors by v' = q v q*. Axis-angle is the rotation vector theta
* axis, in radians. Quaternions q and -q are the same rotation.
"""

import jax.numpy as jnp

from humangs_jax.core.array_types import Array, Float
from humangs_jax.core.numerics import safe_normalize

IDENTITY = (1.0, 0.0, 0.0, 0.0)


def normalize(q: Float[Array, "*b 4"]) -> Float[Array, "*b 4"]:
    """Returns q / |q|. Where q is 0, the result is the identity (1, 0, 0, 0), with zero
    gradient.
    """
    return safe_normalize(q, jnp.asarray(IDENTITY, q.dtype))


def multiply(p: Float[Array, "*#b 4"], q: Float[Array, "*#b 4"]) -> Float[Array, "*b 4"]:
    """Returns the Hamilton product p q. As a rotation, it rotates first by q, then by p."""
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
    """Returns the shortest rotation from unit vectors a to unit vectors b. Where they are opposite,
    it is a half turn about an axis that is perpendicular to a.
    """
    real = jnp.sum(jnp.square(a + b), axis=-1, keepdims=True) / 2  # 1 + a.b without cancellation
    across = jnp.cross(a, jnp.eye(3, dtype=a.dtype)[jnp.argmin(jnp.abs(a), axis=-1)])
    opposite = real < 1e-12  # their cross product is rounding
    imaginary = jnp.where(opposite, across, jnp.cross(a, b))
    return normalize(jnp.concatenate([jnp.where(opposite, 0.0, real), imaginary], axis=-1))


def to_matrix(q: Float[Array, "*b 4"]) -> Float[Array, "*b 3 3"]:
    """Returns the rotation matrix of a unit quaternion.

    A quaternion of another length is not normalized first, so its matrix is in general no rotation
    (see `normalize`).
    """
    w, x, y, z = jnp.moveaxis(q, -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return jnp.stack([jnp.stack(row, axis=-1) for row in rows], axis=-2)


def candidates_from_matrix(
    m: Float[Array, "*b 3 3"],
) -> tuple[Float[Array, "*b 4 4"], Float[Array, "*b 4"]]:
    """Returns four quaternions for each rotation matrix, (..., 4, 4), and how well conditioned each
    of them is, q_abs, (..., 4).

    For the matrix of a rotation q, q_abs[c] is 2 |q[c]|. Where this is at least 0.1, candidate c is
    q or -q, with component c positive. Elsewhere candidate c is shorter than 1.

    In detail, M is the symmetric matrix (4, 4) that equals 4 q q^T for a rotation. Its diagonal is
    1 ± m00 ± m11 ± m22, with no or two minus signs, and q_abs is sqrt(max(0, diagonal)). Candidate
    c is row c of M divided by 2 max(q_abs[c], 0.1). For a matrix that is no rotation, the four
    candidates may be different rotations.
    """
    # the diagonal of M: 4 q_c^2. The square root has no gradient at 0
    m00, m11, m22 = m[..., 0, 0], m[..., 1, 1], m[..., 2, 2]
    squared = jnp.stack(
        [1 + m00 + m11 + m22, 1 + m00 - m11 - m22, 1 - m00 + m11 - m22, 1 - m00 - m11 + m22],
        axis=-1,
    )
    positive = squared > 0
    q_abs = jnp.where(positive, jnp.sqrt(jnp.where(positive, squared, 1.0)), 0.0)

    # the other elements of M, and its rows
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
    return candidates / (2 * jnp.maximum(q_abs, 0.1))[..., None], q_abs


def from_matrix(m: Float[Array, "*b 3 3"]) -> Float[Array, "*b 4"]:
    """Returns the quaternion of a rotation matrix, by the best conditioned of the four candidates
    (see `candidates_from_matrix`).

    A matrix that is no rotation is not repaired. The result may then have |q| != 1, as in the
    published network ("rotation" skinning).
    """
    candidates, q_abs = candidates_from_matrix(m)
    best = jnp.argmax(q_abs, axis=-1)[..., None, None]
    return jnp.take_along_axis(candidates, best, axis=-2)[..., 0, :]


def sine_and_cosine_ratios(
    angle_squared: Float[Array, "*b"],
) -> tuple[Float[Array, "*b"], Float[Array, "*b"]]:
    """Returns sin(t)/t and (1 - cos t)/t^2 from t^2, smooth through 0."""
    # the Taylor series, cut after t^4, are exact to float32's rounding here (t^6/5040 < 2e-16)
    small = angle_squared < 1e-4
    squared = jnp.where(small, 1.0, angle_squared)
    angle = jnp.sqrt(squared)
    sine = jnp.where(small, 1 - angle_squared / 6 + angle_squared**2 / 120, jnp.sin(angle) / angle)
    half = jnp.sin(angle / 2)  # 1 - cos t = 2 sin^2(t/2): no cancellation
    cosine = jnp.where(
        small, 0.5 - angle_squared / 24 + angle_squared**2 / 720, 2 * half * half / squared
    )
    return sine, cosine


def matrix_from_axis_angle(axis_angle: Float[Array, "*b 3"]) -> Float[Array, "*b 3 3"]:
    """Returns the matrix of a rotation vector by Rodrigues' formula, with exact derivatives at the
    zero rotation.
    """
    x, y, z = jnp.moveaxis(axis_angle, -1, 0)
    sine, cosine = sine_and_cosine_ratios(x * x + y * y + z * z)
    rows = [
        [1 - cosine * (y * y + z * z), cosine * x * y - sine * z, cosine * x * z + sine * y],
        [cosine * x * y + sine * z, 1 - cosine * (x * x + z * z), cosine * y * z - sine * x],
        [cosine * x * z - sine * y, cosine * y * z + sine * x, 1 - cosine * (x * x + y * y)],
    ]
    return jnp.stack([jnp.stack(row, axis=-1) for row in rows], axis=-2)


def from_axis_angle(axis_angle: Float[Array, "*b 3"]) -> Float[Array, "*b 4"]:
    """Returns the unit quaternion of a rotation vector, with exact derivatives at the zero
    rotation.
    """
    half = 0.5 * axis_angle
    squared = jnp.sum(jnp.square(half), axis=-1)
    sine, cosine = sine_and_cosine_ratios(squared)
    return jnp.concatenate([(1 - squared * cosine)[..., None], half * sine[..., None]], axis=-1)


def to_axis_angle(q: Float[Array, "*b 4"]) -> Float[Array, "*b 3"]:
    """Returns the rotation vector, no longer than pi, of a unit quaternion, with exact derivatives
    at the zero rotation.
    """
    q = jnp.where(q[..., :1] < 0, -q, q)
    squared = jnp.sum(jnp.square(q[..., 1:]), axis=-1, keepdims=True)
    # below, the sine is the angle, and derivatives of its root would overflow in float32
    turned = squared > 1e-30
    sine = jnp.sqrt(jnp.where(turned, squared, 1.0))
    return q[..., 1:] * jnp.where(turned, 2 * jnp.arctan2(sine, q[..., :1]) / sine, 2.0)


def interpolate(
    a: Float[Array, "*#b 3"], b: Float[Array, "*#b 3"], share: Float[Array, "*#b"]
) -> Float[Array, "*b 3"]:
    """Returns the rotation vector at a share, 0 to 1, of the shortest way from a to b. This is
    spherical linear interpolation (Shoemake 1985, https://doi.org/10.1145/325165.325242).
    """
    start = from_axis_angle(a)
    turn = to_axis_angle(multiply(from_axis_angle(-a), from_axis_angle(b)))
    return to_axis_angle(multiply(start, from_axis_angle(share[..., None] * turn)))


# Singular vectors: LAPACK decomposes small matrices one by one; this runs on planes of the whole
# batch, on any backend. Working on the matrix itself, never on its Gram matrix, keeps small
# singular values accurate (Demmel & Veselić 1992, https://doi.org/10.1137/0613074).


def left_singular_vectors(
    m: Float[Array, "*b 3 3"],
) -> tuple[Float[Array, "*b 3 3"], Float[Array, "*b 3"]]:
    """Returns the left singular vectors of matrices as rotations U (det +1), and the singular
    values s >= 0, in no particular order: m m^T = U diag(s)^2 U^T.

    The results are not meant to be differentiated, because U is not unique where singular values
    coincide. Columns of U that belong to singular values of 0 complete the others to a rotation.
    """
    columns = [m[..., :, i] for i in range(3)]
    # cyclic Jacobi converges quadratically: 3x3 matrices reach float64's rounding after five sweeps
    for _ in range(6):
        for p, q in ((0, 1), (0, 2), (1, 2)):
            columns[p], columns[q] = _orthogonalize(columns[p], columns[q])
    norms = jnp.stack([jnp.linalg.norm(c, axis=-1) for c in columns], axis=-1)
    return _complete_to_rotation(jnp.stack(columns, axis=-1), norms), norms


def _orthogonalize(
    a: Float[Array, "*b 3"], b: Float[Array, "*b 3"]
) -> tuple[Float[Array, "*b 3"], Float[Array, "*b 3"]]:
    """Returns two orthogonal vectors that are a rotation of the pair: (c a - s b, s a + c b) with c
    and s the cosine and the sine of one angle. This is a step of one-sided Jacobi.
    """
    aa, bb, ab = (jnp.sum(x * y, axis=-1, keepdims=True) for x, y in ((a, a), (b, b), (a, b)))
    needed = ab != 0
    ratio = (bb - aa) / (2 * jnp.where(needed, ab, 1))
    # the smaller root of t^2 + 2 ratio t - 1, in the form that neither cancels nor overflows for
    # large ratios
    tangent = jnp.where(ratio >= 0, 1, -1) / (
        jnp.abs(ratio) + jnp.hypot(jnp.ones_like(ratio), ratio)
    )
    cosine = 1 / jnp.hypot(jnp.ones_like(tangent), tangent)
    sine = cosine * tangent
    cosine, sine = jnp.where(needed, cosine, 1), jnp.where(needed, sine, 0)
    return cosine * a - sine * b, sine * a + cosine * b


def _complete_to_rotation(
    columns: Float[Array, "*b 3 3"], norms: Float[Array, "*b 3"]
) -> Float[Array, "*b 3 3"]:
    """Returns rotations made from the two longest columns of each matrix. These two become unit
    vectors in their places, the second made orthogonal to the first. The third place gets their
    cross product. The sign of the matrix's last column is then chosen so that the determinant is 1.
    This holds even if columns are zero.

    norms: the lengths of the columns.
    """
    order = jnp.argsort(-norms, axis=-1)
    first = jnp.take_along_axis(columns, order[..., None, 0:1], axis=-1)[..., 0]
    second = jnp.take_along_axis(columns, order[..., None, 1:2], axis=-1)[..., 0]
    longest = jnp.max(norms, axis=-1, keepdims=True)
    x_axis = jnp.asarray([1.0, 0.0, 0.0], columns.dtype)
    u0 = jnp.where(longest > 0, first / jnp.where(longest > 0, longest, 1), x_axis)
    # a direction that is surely not along u0: the axis of its smallest component
    axis = jnp.eye(3, dtype=columns.dtype)[jnp.argmin(jnp.abs(u0), axis=-1)]
    other = jnp.cross(u0, axis)
    second_norm = jnp.sort(norms, axis=-1)[..., 1:2]
    usable = second_norm > longest * jnp.finfo(columns.dtype).eps
    candidate = jnp.where(usable, second / jnp.where(usable, second_norm, 1), other)
    u1 = candidate - jnp.sum(candidate * u0, axis=-1, keepdims=True) * u0
    u1 = u1 / jnp.linalg.norm(u1, axis=-1, keepdims=True)
    u2 = jnp.cross(u0, u1)
    sorted_basis = jnp.stack([u0, u1, u2], axis=-1)
    back = jnp.argsort(order, axis=-1)
    basis = jnp.take_along_axis(sorted_basis, back[..., None, :], axis=-1)
    # a permutation of the columns may be odd: flip one column's sign, which leaves U diag(s)^2 U^T
    # as it is
    sign = jnp.sign(jnp.linalg.det(basis))[..., None]
    return basis.at[..., :, 2].multiply(sign)
