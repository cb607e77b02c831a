"""EWA projection: 3D Gaussians to 2D Gaussians on the image (Zwicker et al. 2001; Kerbl et al.
2023).

Let p = (X, Y, Z) be the mean in the camera's frame, fx, fy, cx and cy the entries of K, and W the
camera's rotation. Then

    mean2d = (fx X/Z + cx, fy Y/Z + cy)
    J      = [[fx/Z, 0, -fx X/Z^2], [0, fy/Z, -fy Y/Z^2]]
    cov2d  = M M^T + eps2d I,   M = J W A R diag(s)

where J is the projection's derivative at p, and A R diag(s) the factor of the covariance; M is (2,
3).

Everything is kept as planes of g numbers rather than as (g, 2, 2) arrays: XLA then fuses the
projection, and its gradient, into a few loops. The determinant of cov2d is not computed from its
entries, where float32 cancels for needles, but as a sum of squares: |m0 x m1|^2 + eps2d (|m0|^2 +
|m1|^2) + eps2d^2 for the rows m0, m1 of M. What is drawn is the upper triangular r with r^T r =
cov2d^-1 / 2, whose gradient is written by hand for the same reason.

The added variance makes small Gaussians larger. If the scales contain the low-pass of pixels of s
metres (`Gaussians.pixel_footprint`), the opacity is multiplied by sqrt(det(M M^T + e I) / det
cov2d). Here e is the smaller of eps2d (s fx/Z)^2 and eps2d. The first is the variance that was
added in images with such pixels, in pixels^2 of this image. So the total weight of a Gaussian stays
the same in smaller images (Mip-Splatting's 2D filter, https://arxiv.org/abs/2311.16493, equation 9,
which has e = 0). `SplatConfig.antialiased` dims all other Gaussians with e = 0.

If the camera has a lens, mean2d is where the lens puts (X/Z, Y/Z). J is then the derivative of the
whole map (`geometry.lens`): the focal lengths of K, times the Jacobian of the lens, times the
Jacobian of the division by Z. An orthographic camera has J = [[fx, 0, 0], [0, fy, 0]], and all its
directions of sight are its axis.

Gaussians that are not drawn (centre nearer than `near`, behind, or beyond the reach of the lens,
footprint beyond `LARGEST_FOOTPRINT`) have finite values, and get zero gradients in `splatting`. K's
skew is taken as 0.
"""

import functools
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from humangs_jax.core.array_types import Array, Bool, Float, PyTree
from humangs_jax.core.numerics import at_least_float32
from humangs_jax.geometry import quaternion
from humangs_jax.geometry.camera import Camera
from humangs_jax.geometry.lens import distorted_with_slopes, within_reach
from humangs_jax.rendering.gaussians import Gaussians, added_colors, added_variance
from humangs_jax.rendering.splat_config import (
    DEFAULT_CONFIG,
    LARGEST_FOOTPRINT,
    LEAST_DIMMING,
    SplatConfig,
)

Planes = list[Array]
"""List of arrays of (g,) numbers."""


class ProjectedGaussians(NamedTuple):
    """2D Gaussians on the image, planes of (g,). `means2d`, `depths` and `conics` are in the form
    of gsplat's arrays.
    """

    x: Float[Array, " g"]
    """x of the centres, (g,), pixels."""
    y: Float[Array, " g"]
    """y of the centres, (g,), pixels."""
    depths: Float[Array, " g"]
    """z in the camera's frame, (g,), metres."""
    xx: Float[Array, " g"]
    """Variance along x, (g,), pixels^2, eps2d included."""
    xy: Float[Array, " g"]
    """Covariance of x and y, (g,), pixels^2."""
    yy: Float[Array, " g"]
    """Variance along y, (g,), pixels^2, eps2d included."""
    determinant: Float[Array, " g"]
    """Determinant of the covariance, (g,), pixels^4."""
    r00: Float[Array, " g"]
    """Entry 00 of the upper triangular r with r^T r = conic / 2, (g,), 1 / pixels. It is finite
    also where nothing is drawn.
    """
    r01: Float[Array, " g"]
    """Entry 01 of r, (g,), 1 / pixels."""
    r11: Float[Array, " g"]
    """Entry 11 of r, (g,), 1 / pixels."""
    visible: Bool[Array, " g"]
    """Whether each Gaussian is drawn, (g,)."""
    dimming: Float[Array, " g"] | None = None
    """Factor of the opacity, (g,), in (0, 1]. None if no Gaussian is dimmed."""
    added_colors: Float[Array, "g 3"] | None = None
    """RGB that harmonics add to the colors, as seen from this camera, (g, 3); None without
    harmonics.
    """

    def dimmed(self, opacities: Float[Array, " g"]) -> Float[Array, " g"]:
        """Returns the opacities times `dimming`, as they are drawn."""
        if self.dimming is None:
            return opacities
        return opacities * self.dimming

    def seen_from_here(self, colors: Float[Array, "g 3"]) -> Float[Array, "g 3"]:
        """Returns the colors as they are drawn: with `added_colors`, and at least 0. Without
        `added_colors` the colors are unchanged.
        """
        if self.added_colors is None:
            return colors
        return jnp.maximum(colors + self.added_colors, 0.0)

    @property
    def means2d(self) -> Float[Array, "g 2"]:
        """Centres on the image, (g, 2), pixels."""
        return jnp.stack([self.x, self.y], axis=-1)

    @property
    def conics(self) -> Float[Array, "g 3"]:
        """Entries 00, 01, 11 of the inverse covariances, (g, 3), 1 / pixels^2."""
        r00, r01, r11 = self.r00, self.r01, self.r11
        return 2 * jnp.stack([r00 * r00, r00 * r01, r01 * r01 + r11 * r11], axis=-1)


def project_gaussians(
    gaussians: Gaussians, camera: Camera, config: SplatConfig = DEFAULT_CONFIG
) -> ProjectedGaussians:
    """Returns every Gaussian projected onto the image, as `config` says. This is the first step of
    `splatting.render`.

    `config.jacobian_margin` is the width of a margin around the image, as a fraction of half the
    image's width (or height). For a centre beyond the margin, the Jacobian is evaluated at the
    nearest point of the margin's outer edge. This applies to pinhole cameras without distortion.
    """
    gaussians, camera = at_least_float32((gaussians, camera))
    eps2d = added_variance(gaussians.pixel_footprint, config.eps2d)
    jacobian_margin = config.jacobian_margin
    K, rotation, translation = camera.K, camera.cam_from_world[:3, :3], camera.cam_from_world[:3, 3]
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    # means in the frame of the camera; those behind it are moved to its axis, where all is finite
    means = _planes(gaussians.means)
    X, Y, Z = (_dot(rotation[i], means) + translation[i] for i in range(3))
    in_front = config.near < Z
    X, Y = jnp.where(in_front, X, 0.0), jnp.where(in_front, Y, 0.0)
    inverse_depth = 1 / jnp.where(in_front, Z, 1.0)
    u, v = X * inverse_depth, Y * inverse_depth
    if not camera.is_plain:
        reached = within_reach(camera.lens, camera.distortion, u, v)
        in_front &= reached
        u, v = jnp.where(reached, u, 0.0), jnp.where(reached, v, 0.0)

    # the rows of J W: where the Jacobian is taken, then its product with the rotation
    ju, jv = u, v
    if jacobian_margin is not None:
        ju = _clamp_to_view(u, fx, cx, camera.width, jacobian_margin)
        jv = _clamp_to_view(v, fy, cy, camera.height, jacobian_margin)
    zx, zy = fx * inverse_depth, fy * inverse_depth
    jw = [
        [zx * (rotation[0, j] - ju * rotation[2, j]) for j in range(3)],
        [zy * (rotation[1, j] - jv * rotation[2, j]) for j in range(3)],
    ]
    # lenses put the centre elsewhere and have another J
    x, y = u, v
    if camera.lens == "orthographic":
        x, y, zx = X, Y, fx
        jw = [[focal * rotation[i, j] for j in range(3)] for i, focal in enumerate((fx, fy))]
    elif not camera.is_plain:
        x, y, slopes = distorted_with_slopes(camera.lens, camera.distortion, u, v)
        toward_u = [inverse_depth * (rotation[0, j] - u * rotation[2, j]) for j in range(3)]
        toward_v = [inverse_depth * (rotation[1, j] - v * rotation[2, j]) for j in range(3)]
        jw = [
            [focal * (du * toward_u[j] + dv * toward_v[j]) for j in range(3)]
            for focal, (du, dv) in zip((fx, fy), slopes, strict=True)
        ]
    m = _times_factors(jw, gaussians, config.normalize_quats)

    # footprints, without those whose squares overflow
    small = _all([jnp.abs(entry) < LARGEST_FOOTPRINT for row in m for entry in row])
    m0, m1 = ([jnp.where(small, entry, 0.0) for entry in row] for row in m)
    xx, xy, yy, determinant = _covariance(m0, m1, eps2d)
    # opacity is dimmed by what the added variance enlarges
    dimming = None
    if gaussians.pixel_footprint is not None and eps2d > 0:
        dimming = _dimming(m0, m1, determinant, eps2d, gaussians.pixel_footprint * zx)
    elif config.antialiased and eps2d > 0:
        dimming = _dimming(m0, m1, determinant, eps2d, jnp.zeros_like(determinant))
    r00, r01, r11 = _conic_factor(m0, m1, eps2d)
    # harmonics along the line of sight
    colors = None
    if gaussians.harmonics is not None:
        if camera.lens == "orthographic":
            sight = [rotation[2, j] for j in range(3)]
        else:
            sight = [rotation[0, j] * u + rotation[1, j] * v + rotation[2, j] for j in range(3)]
        colors = added_colors(
            gaussians.harmonics, *(lax.rsqrt(_dot(sight, sight)) * s for s in sight)
        )
    return ProjectedGaussians(
        x=fx * x + cx,
        y=fy * y + cy,
        depths=Z,
        xx=xx,
        xy=xy,
        yy=yy,
        determinant=determinant,
        r00=r00,
        r01=r01,
        r11=r11,
        visible=in_front & small & (determinant > 0),
        dimming=dimming,
        added_colors=colors,
    )


def _covariance(m0: Planes, m1: Planes, eps2d: Array | float) -> tuple[Array, Array, Array, Array]:
    """Returns xx, xy, yy and the determinant of cov2d, (g,) each. m0, m1: the rows of M."""
    xx, xy, yy = _dot(m0, m0), _dot(m0, m1), _dot(m1, m1)
    normal = [_cross(m0, m1, 1, 2), _cross(m0, m1, 2, 0), _cross(m0, m1, 0, 1)]
    determinant = _dot(normal, normal) + eps2d * (xx + yy) + eps2d * eps2d
    return xx + eps2d, xy, yy + eps2d, determinant


def _dimming(m0: Planes, m1: Planes, determinant: Array, eps2d: float, footprint: Array) -> Array:
    """Returns the factor of the opacity, (g,). It is at least `LEAST_DIMMING`, and 1 where the
    determinant overflows.

    footprint: `Gaussians.pixel_footprint` in pixels of this image, (g,). 0 for Gaussians without
    one.
    """
    finite = determinant < jnp.inf
    m0, m1 = ([jnp.where(finite, entry, 0.0) for entry in row] for row in (m0, m1))
    contained = _covariance(m0, m1, eps2d * jnp.minimum(jnp.square(footprint), 1.0))[3]
    share = jnp.where(finite, contained / jnp.where(finite, determinant, 1.0), 1.0)
    return jnp.sqrt(jnp.maximum(share, LEAST_DIMMING**2))


def _cross(m0: Planes, m1: Planes, j: int, i: int) -> Array:
    """Returns the cross product of the columns j and i of M, (g,)."""
    return m0[j] * m1[i] - m1[j] * m0[i]


@functools.partial(jax.custom_vjp, nondiff_argnums=(2,))
def _conic_factor(m0: Planes, m1: Planes, eps2d: float) -> tuple[Array, Array, Array]:
    """Returns the upper triangular r with r^T r = cov2d^-1 / 2: r00, r01, r11. Where cov2d is
    singular, they are some finite numbers.

    Gradient. With k the symmetric matrix of k00 = r00 g00 + r01 g01, k01 = r11 g01, k11 = r11 g11
    (g: the cotangents),

        dL/dM = -2 r^T k r M.

    For a needle of length l and width w, in pixels, the entries of r are of the order of 1 / w, but
    r times the long axis is of the order of 1. In

        (r M)_0j = r00 / yy (sum_i m1_i (m_j x m_i) + eps2d m0_j),     (r M)_1j = r11 m1_j

    m_j is column j of M, m0 and m1 are its rows, and a x b = a_0 b_1 - a_1 b_0. The term that would
    cancel, m_j x m_j, is left out. Autodiff would sum two terms that cancel, one through yy and one
    through the determinant.
    """
    _, xy, yy, determinant = _covariance(m0, m1, eps2d)
    regular = determinant > 0
    yy, determinant = jnp.where(regular, yy, 1.0), jnp.where(regular, determinant, 1.0)
    # divided by yy: the gradient of a quotient squares its denominator, and the square of the
    # determinant overflows from 2e19 pixels^4 on
    r00 = lax.rsqrt(2 * (determinant / yy))
    return r00, -r00 * (xy / yy), lax.rsqrt(2 * yy)


def _conic_factor_fwd(m0: Planes, m1: Planes, eps2d: float) -> tuple[PyTree, PyTree]:
    r = _conic_factor(m0, m1, eps2d)
    return r, (m0, m1, r)


def _conic_factor_bwd(eps2d: float, saved: PyTree, cotangents: PyTree) -> tuple[Planes, Planes]:
    m0, m1, (r00, r01, r11) = saved
    g00, g01, g11 = cotangents
    k00, k01, k11 = r00 * g00 + r01 * g01, r11 * g01, r11 * g11
    ratio = 2 * r00 * r11 * r11  # r00 / yy
    d0, d1 = [], []
    for j in range(3):
        across = sum(m1[i] * _cross(m0, m1, j, i) for i in range(3) if i != j)
        n0, n1 = ratio * (across + eps2d * m0[j]), r11 * m1[j]
        t0, t1 = k00 * n0 + k01 * n1, k01 * n0 + k11 * n1
        d0.append(-2 * (r00 * t0))
        d1.append(-2 * (r01 * t0 + r11 * t1))
    return d0, d1


_conic_factor.defvjp(_conic_factor_fwd, _conic_factor_bwd)


def _times_factors(
    rows: Sequence[Planes], gaussians: Gaussians, normalize_quats: bool
) -> list[Planes]:
    """Returns rows @ A R diag(s), 2 x 3 planes. rows: 2 x 3 planes."""
    if gaussians.deformations is not None:
        entries = _planes(gaussians.deformations.reshape(-1, 9))
        rows = _times(rows, [entries[:3], entries[3:6], entries[6:]])
    quats = gaussians.quats
    if normalize_quats:
        quats = quaternion.normalize(gaussians.quats)
    rows = _times(rows, _rotation_planes(quats))
    scales = _planes(gaussians.scales)
    return [[row[j] * scales[j] for j in range(3)] for row in rows]


def _rotation_planes(quats: Float[Array, "g 4"]) -> list[Planes]:
    """Returns the rotation matrices of quaternions as 3 x 3 planes, with the same numbers as
    `quaternion.to_matrix`.
    """
    w, x, y, z = _planes(quats)
    return [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]


def _times(rows: Sequence[Planes], matrix: Sequence[Planes]) -> list[Planes]:
    return [[_dot(row, [matrix[i][j] for i in range(3)]) for j in range(3)] for row in rows]


@jax.custom_vjp
def _planes(columns: Array) -> Planes:
    """Returns the c columns of an array (g, c), as planes of (g,).

    The gradient joins the planes by selection. Autodiff's concatenation (or sum of padded planes)
    gets fused with the expressions that it joins. XLA's CPU backend then evaluates their common
    parts anew at each use, which was measured to be 50 to 100 times slower.
    """
    return [columns[:, i] for i in range(columns.shape[1])]


def _planes_bwd(_: None, planes: Planes) -> tuple[Array]:
    column = lax.broadcasted_iota(jnp.int32, (planes[0].shape[0], len(planes)), 1)
    joined = planes[0][:, None]
    for i, plane in enumerate(planes[1:], start=1):
        joined = jnp.where(column == i, plane[:, None], joined)
    return (joined,)


_planes.defvjp(lambda columns: (_planes(columns), None), _planes_bwd)


def _clamp_to_view(slope: Array, focal: Array, center: Array, size: Any, margin: float) -> Array:
    extra = margin * 0.5 * size / focal
    return jnp.clip(slope, -center / focal - extra, (size - center) / focal + extra)


def _dot(a: Planes | Array, b: Planes) -> Array:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _all(conditions: Planes) -> Array:
    result = conditions[0]
    for condition in conditions[1:]:
        result &= condition
    return result
