"""Computes where a lens shows points of the plane z = 1 in front of a camera, and how far the lens
reaches.

"pinhole" with OpenCV's coefficients k1 k2 p1 p2 [k3 [k4 k5 k6 [s1 s2 s3 s4]]] (Brown and Conrady,
calib3d): of a point (u, v) = (X / Z, Y / Z), with r^2 = u^2 + v^2 and R = (1 + k1 r^2 + k2 r^4 + k3
r^6) / (1 + k4 r^2 + k5 r^4 + k6 r^6),

    x = u R + 2 p1 u v + p2 (r^2 + 2 u^2) + s1 r^2 + s2 r^4
    y = v R + p1 (r^2 + 2 v^2) + 2 p2 u v + s3 r^2 + s4 r^4.

"fisheye" (Kannala and Brandt 2006, OpenCV's fisheye module), with t = atan(r) and coefficients k1
k2 k3 k4, or none:

    (x, y) = (u, v) t / r (1 + k1 t^2 + k2 t^4 + k3 t^6 + k4 t^8).

"orthographic" has no coefficients: pixels are fx X + cx and fy Y + cy, with K in pixels a metre. In
all functions, u and v are arrays of the same shape.
"""

import jax
import jax.numpy as jnp

from humangs_jax.core.array_types import Array, Bool, Float

COUNTS: dict[str, tuple[int, ...]] = {
    "pinhole": (4, 5, 8, 12),
    "fisheye": (4,),
    "orthographic": (),
}
"""Allowed numbers of coefficients, by lens."""
RINGS = 16
"""Number of points on the way from the axis to a given point at which `within_reach` checks that
the image moves outwards.
"""


def check_lens(lens: object, count: int | None) -> None:
    """Checks that a lens is known and may have this number of coefficients. count: None for no
    coefficients. Raises: ValueError for an unknown lens, and for a number that it cannot have.
    """
    if lens not in COUNTS:
        raise ValueError(f"lens: expected {', '.join(COUNTS)}, got {lens!r}")
    allowed = COUNTS[str(lens)]
    if count is not None and count not in allowed:
        expected = "none"
        if allowed:
            expected = f"{' or '.join(map(str, allowed))} coefficients"
        raise ValueError(f"distortion of a {lens} lens: expected {expected}, got {count}")


def distorted(
    lens: str, coefficients: Float[Array, " n"] | None, u: Array, v: Array
) -> tuple[Array, Array]:
    """Returns the positions (x, y) at which the lens shows points (u, v) of the plane z = 1.
    Raises: as `check_lens`.
    """
    count = None if coefficients is None else coefficients.shape[-1]
    check_lens(lens, count)
    if lens == "fisheye":
        scale = _fisheye_scale(coefficients, u * u + v * v)
        return u * scale, v * scale
    if coefficients is None:
        return u, v
    c = [coefficients[i] for i in range(coefficients.shape[-1])] + [0.0] * 12
    k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4 = c[:12]
    rr = u * u + v * v
    radial = (1 + rr * (k1 + rr * (k2 + rr * k3))) / (1 + rr * (k4 + rr * (k5 + rr * k6)))
    x = u * radial + 2 * p1 * u * v + p2 * (rr + 2 * u * u) + rr * (s1 + rr * s2)
    y = v * radial + p1 * (rr + 2 * v * v) + 2 * p2 * u * v + rr * (s3 + rr * s4)
    return x, y


def _fisheye_scale(coefficients: Float[Array, " n"] | None, rr: Array) -> Array:
    """Returns x / u = y / v of a fisheye, which is atan(r) / r times the polynomial of the module's
    docstring. It has derivatives on the axis, too. rr: r^2.
    """
    # near the axis atan(r) / r is its Taylor series, cut after r^10: exact to float64's rounding
    small = rr < 1e-3
    near = jnp.where(small, rr, 0.0)
    series = 1 - near * (1 / 3 - near * (1 / 5 - near * (1 / 7 - near * (1 / 9 - near / 11))))
    r = jnp.sqrt(jnp.where(small, 1.0, rr))
    ratio = jnp.where(small, series, jnp.arctan(r) / r)
    if coefficients is None:
        return ratio
    k1, k2, k3, k4 = (coefficients[i] for i in range(4))
    tt = ratio * ratio * rr
    return ratio * (1 + tt * (k1 + tt * (k2 + tt * (k3 + tt * k4))))


def distorted_with_slopes(
    lens: str, coefficients: Float[Array, " n"] | None, u: Array, v: Array
) -> tuple[Array, Array, list[list[Array]]]:
    """Returns x, y, and the Jacobian [[dx/du, dx/dv], [dy/du, dy/dv]]. The Jacobian is computed in
    forward mode, so that its gradient can be computed in reverse mode.
    """

    def lensed(u, v):
        return distorted(lens, coefficients, u, v)

    one, zero = jnp.ones_like(u), jnp.zeros_like(u)
    (x, y), (xu, yu) = jax.jvp(lensed, (u, v), (one, zero))
    _, (xv, yv) = jax.jvp(lensed, (u, v), (zero, one))
    return x, y, [[xu, xv], [yu, yv]]


def within_reach(
    lens: str, coefficients: Float[Array, " n"] | None, u: Array, v: Array
) -> Bool[Array, "*b"]:
    """Says whether the image of a point (u, v) moves outwards all the way while the point moves
    from the axis to (u, v). Where it does not, the lens's polynomial folds the image back over
    itself.

    Tangential and thin-prism terms of a pinhole are left out. Without coefficients, all finite
    points are within reach. The result has no gradient.
    """
    u, v = jax.lax.stop_gradient((u, v))
    if coefficients is None:
        return jnp.isfinite(u) & jnp.isfinite(v)
    coefficients = jax.lax.stop_gradient(coefficients)
    if lens == "pinhole":
        straight = [i for i in (2, 3, 8, 9, 10, 11) if i < coefficients.shape[-1]]
        coefficients = coefficients.at[jnp.asarray(straight)].set(0.0)
    r = jnp.sqrt(u * u + v * v)

    def image(r):
        return distorted(lens, coefficients, r, jnp.zeros_like(r))[0]

    grows = jnp.isfinite(r)
    for i in range(1, RINGS + 1):
        _, slope = jax.jvp(image, (r * (i / RINGS),), (jnp.ones_like(r),))
        grows &= slope > 0
    return grows
