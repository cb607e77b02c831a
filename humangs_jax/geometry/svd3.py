"""Singular value decomposition of 3x3 matrices by one-sided Jacobi rotations, vectorised over batches.

LAPACK decomposes small matrices one by one; this runs on planes of the whole batch, on any backend. Working on the matrix
itself, never on its Gram matrix, keeps small singular values accurate (Demmel & Veselić 1992, https://doi.org/10.1137/0613074).
"""

import jax.numpy as jnp

from humangs_jax.core.array_types import Array, Float

SWEEPS = 6
"""Cyclic Jacobi converges quadratically; 3x3 matrices reach float64 rounding after five sweeps (tests), float32 after four."""


def left_singular_vectors(m: Float[Array, "*b 3 3"]) -> tuple[Float[Array, "*b 3 3"], Float[Array, "*b 3"]]:
    """Rotations U (det +1) and singular values s >= 0, in no particular order, with m m^T = U diag(s)^2 U^T.

    Not meant to be differentiated: U is not unique where singular values coincide. A zero column is completed to a rotation.
    """
    columns = [m[..., :, i] for i in range(3)]
    for _ in range(SWEEPS):
        for p, q in ((0, 1), (0, 2), (1, 2)):
            columns[p], columns[q] = _orthogonalize(columns[p], columns[q])
    norms = jnp.stack([jnp.linalg.norm(c, axis=-1) for c in columns], axis=-1)
    return _complete_to_rotation(jnp.stack(columns, axis=-1), norms), norms


def _orthogonalize(a, b):
    """Rotate two columns in their plane until they are orthogonal."""
    aa, bb, ab = (jnp.sum(x * y, axis=-1, keepdims=True) for x, y in ((a, a), (b, b), (a, b)))
    needed = ab != 0
    ratio = (bb - aa) / (2 * jnp.where(needed, ab, 1))
    # the smaller root of t^2 + 2 ratio t - 1, in the form that neither cancels nor overflows for large ratios
    tangent = jnp.where(ratio >= 0, 1, -1) / (jnp.abs(ratio) + jnp.hypot(jnp.ones_like(ratio), ratio))
    cosine = 1 / jnp.hypot(jnp.ones_like(tangent), tangent)
    sine = cosine * tangent
    cosine, sine = jnp.where(needed, cosine, 1), jnp.where(needed, sine, 0)
    return cosine * a - sine * b, sine * a + cosine * b


def _complete_to_rotation(columns, norms):
    """Normalise the two longest columns and take their cross product as the third: proper even where columns vanish."""
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
    # a permutation of the columns may be odd: flip one column's sign, which leaves U diag(s)^2 U^T as it is
    sign = jnp.sign(jnp.linalg.det(basis))[..., None]
    return basis.at[..., :, 2].multiply(sign)
