"""Draws the image by its definition: every Gaussian on every pixel, one after the other. It is the
oracle of `splatting`.

It shares only small functions with the tiled renderer, such as the checks of arguments. Its
projection multiplies plain matrices, its compositing is the loop of the formula, and its gradients
are autodiff's. With a_j the columns of M and C = cov2d = M M^T + eps2d I, the exponent is -1/2 of

    d^T C^-1 d = (sum_j (a_j x d)^2 + eps2d |d|^2) / det C,
    det C      = sum_i<j (a_i x a_j)^2 + eps2d |M|^2 + eps2d^2.

These are sums of squares, which are accurate for needles of any length. (The inverse of C has no
correct digit left for a needle of 1e8 pixels.) Memory and time grow with Gaussians times pixels;
use it in float64 on small images.
"""

import functools
import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from humangs_jax.core.array_types import Array, Bool, Float
from humangs_jax.core.checks import checked_arguments
from humangs_jax.core.numerics import safe_sqrt
from humangs_jax.geometry import transform
from humangs_jax.geometry.camera import Camera
from humangs_jax.geometry.lens import within_reach
from humangs_jax.rendering.gaussians import Gaussians, added_variance, covariance_factors
from humangs_jax.rendering.splat_config import (
    DEFAULT_CONFIG,
    LARGEST_FOOTPRINT,
    SplatConfig,
    splat_config,
)
from humangs_jax.rendering.splatting import Background, Rendering, features_of, with_background


@checked_arguments
def render_reference(
    gaussians: Gaussians,
    camera: Camera,
    config: SplatConfig | str = DEFAULT_CONFIG,
    background: Background = None,
    features: Float[Array, "g n"] | None = None,
    shifts: Float[Array, "g 2"] | None = None,
) -> Rendering:
    """Draws the image of `render` by its definition, without tiles or buffers, in the precision of
    its arguments, but at least float32.

    Footprints never end: `radius_sigma` and `square` of `config` are ignored, and so are buffers
    and schedule. Values are not checked.

    Args:
        gaussians: as `render`; float64 arrays give float64 images.
        camera: as `render`.
        config: as `render`.
        background: as `render`.
        features: as `render`.
        shifts: as `render`.

    Returns:
        A `Rendering`, without visibility, means2d and radii.

    Raises:
        TypeError: for arguments of other classes.
        ValueError: for a background that is no color, features that do not have one row for each
            Gaussian, Gaussians whose arrays do not fit each other, and an unknown name of a preset.

    Examples:
        >>> with jax.enable_x64():
        ...     exact = hg.render_reference(gaussians, camera).rgb
    """
    drawn = with_background(gaussians, camera, background)
    features = features_of(features, len(gaussians.opacities))
    return _reference(*drawn, splat_config(config), features, shifts)


class _State(NamedTuple):
    """What the pixels have seen of the Gaussians so far."""

    color: Float[Array, "h w n"]
    """Sum of w times the color and the further features, (h, w, n). w is the weight, alpha T."""
    depth_sum: Float[Array, "h w"]
    """Sum of w times the depth."""
    squared_depth_sum: Float[Array, "h w"]
    """Sum of w times the square of the depth."""
    median: Float[Array, "h w"]
    """Depth of the Gaussian behind which T is one half or less; 0 before it."""
    transmittance: Float[Array, "h w"]
    """T, the product of 1 - alpha."""
    ended: Bool[Array, "h w"]
    """Whether the pixel has ended."""


@jax.jit
def _reference(
    gaussians: Gaussians,
    camera: Camera,
    background: Array,
    config: SplatConfig,
    features: Array | None,
    shifts: Array | None,
) -> Rendering:
    """Returns the rendering of all Gaussians on all pixels, see the module."""
    # the Gaussians on the image, the nearest first
    centers, axes, depths, visible = _project(gaussians, camera, config)
    if shifts is not None:
        centers = centers + shifts
    eps2d = added_variance(gaussians.pixel_footprint, config.eps2d)
    determinants = _determinant(axes, eps2d)
    opacities = _drawn_opacities(gaussians, camera, config, axes, depths, determinants)
    order = jnp.argsort(jnp.where(visible, depths, jnp.inf), stable=True)

    # all pixels
    y, x = jnp.mgrid[: camera.height, : camera.width] + 0.5
    pixels = jnp.stack([x, y], axis=-1).astype(centers.dtype)
    blank = jnp.zeros((camera.height, camera.width), centers.dtype)

    # what is blended: colors and further features
    colors = _seen_colors(gaussians, camera, visible)
    if features is not None:
        colors = jnp.concatenate([colors, features], axis=-1)
    no_color = jnp.zeros((*blank.shape, colors.shape[1]), blank.dtype)

    def draw(state, splat):
        center, axis, determinant, depth, is_visible, opacity, color = splat
        # alpha of this Gaussian at each pixel
        d = pixels - center
        squared = jnp.sum(_cross(axis, d[..., None]) ** 2, axis=-1) + eps2d * jnp.sum(d**2, axis=-1)
        raw = opacity * jnp.exp(-0.5 * squared / determinant)
        alpha = jnp.where(raw < config.alpha_max, raw, config.alpha_max)
        alpha = jnp.where(is_visible & (raw >= config.alpha_min), alpha, 0.0)
        # a pixel ends before the Gaussian that would leave too little
        before = state.transmittance
        ended = state.ended | (before * (1 - alpha) <= config.transmittance_stop)
        alpha = jnp.where(ended, 0.0, alpha)
        # this Gaussian is added with its weight
        weight = alpha * before
        after = before * (1 - alpha)
        state = _State(
            color=state.color + weight[..., None] * color,
            depth_sum=state.depth_sum + weight * depth,
            squared_depth_sum=state.squared_depth_sum + weight * depth**2,
            median=jnp.where((before > 0.5) & (after <= 0.5), depth, state.median),
            transmittance=after,
            ended=ended,
        )
        return state, None

    start = _State(no_color, blank, blank, blank, transmittance=blank + 1, ended=blank > 0)
    splats = centers, axes, determinants, depths, visible, opacities, colors
    splats = jax.tree.map(lambda leaf: leaf[order], splats)
    seen, _ = lax.scan(draw, start, splats)

    # the image over the background
    alpha = 1 - seen.transmittance
    some = alpha > 0
    depth = jnp.where(some, seen.depth_sum / jnp.where(some, alpha, 1.0), 0.0)
    rgb = seen.color[..., :3] + seen.transmittance[..., None] * background
    distortion = None
    if config.distortion:
        distortion = 2 * (alpha * seen.squared_depth_sum - seen.depth_sum**2)
    return Rendering(
        rgb,
        alpha,
        depth,
        jnp.int32(0),
        features=None if features is None else seen.color[..., 3:],
        depth_sum=seen.depth_sum if config.depth_sum else None,
        depth_median=lax.stop_gradient(seen.median) if config.depth_median else None,
        distortion=distortion,
    )


def _drawn_opacities(
    gaussians: Gaussians,
    camera: Camera,
    config: SplatConfig,
    axes: Float[Array, "g 2 3"],
    depths: Float[Array, " g"],
    determinants: Float[Array, " g"],
) -> Float[Array, " g"]:
    """Returns the opacities as they are drawn, (g,). They are dimmed as `projection` says, because
    the added variance enlarges the Gaussians. determinants: with the added variance, (g,).
    """
    eps2d = added_variance(gaussians.pixel_footprint, config.eps2d)
    if gaussians.pixel_footprint is not None and eps2d > 0:
        away = 1.0 if camera.lens == "orthographic" else depths
        contained = eps2d * jnp.minimum((gaussians.pixel_footprint * camera.K[0, 0] / away) ** 2, 1)
        return gaussians.opacities * jnp.sqrt(_determinant(axes, contained) / determinants)
    if config.antialiased and eps2d > 0:
        return gaussians.opacities * safe_sqrt(_determinant(axes, 0.0) / determinants)
    return gaussians.opacities


def _seen_colors(gaussians: Gaussians, camera: Camera, visible: Array) -> Float[Array, "g 3"]:
    """Returns the colors along the line of sight, (g, 3). visible: whether each is drawn, (g,)."""
    if gaussians.harmonics is None:
        return gaussians.colors
    # directions from the camera to the Gaussians, in its frame, then in that of the means
    sight = transform.apply(camera.cam_from_world, gaussians.means)
    sight = jnp.where(visible[:, None], sight, 1.0)
    if camera.lens == "orthographic":
        sight = jnp.zeros_like(sight).at[:, 2].set(1.0)
    sight = jnp.matmul(sight, camera.cam_from_world[:3, :3], precision=transform.EXACT)
    sight = sight / jnp.linalg.norm(sight, axis=-1, keepdims=True)
    # harmonics of these directions
    functions = _harmonics(sight, math.isqrt(gaussians.harmonics.shape[1]))
    added = jnp.einsum("gk,gkc->gc", functions, gaussians.harmonics, precision=transform.EXACT)
    return jnp.maximum(gaussians.colors + added, 0)


def _project(
    gaussians: Gaussians, camera: Camera, config: SplatConfig
) -> tuple[Array, Array, Array, Array]:
    """Returns the centres (g, 2), axes (g, 2, 3) and depths (g,) of projected Gaussians, and
    whether each is drawn. Gaussians that are too near, behind the camera or beyond the reach of its
    lens get depth 1.

    Column j of the axes is the image of the Gaussian's axis j, pixels: cov2d = axes axes^T + eps2d
    I.
    """
    p = transform.apply(camera.cam_from_world, gaussians.means)
    visible = p[:, 2] > config.near
    if not camera.is_plain:
        return _project_by_lens(gaussians, camera, config, p, visible)
    depths = jnp.where(visible, p[:, 2], 1.0)
    slopes = jnp.where(visible[:, None], p[:, :2], 0.0) / depths[:, None]
    focal, center = jnp.stack([camera.K[0, 0], camera.K[1, 1]]), camera.K[:2, 2]

    # J, where the configuration evaluates it
    at = slopes
    if config.jacobian_margin is not None:
        size = jnp.asarray([camera.width, camera.height], slopes.dtype)
        extra = config.jacobian_margin * 0.5 * size / focal
        at = jnp.clip(slopes, -center / focal - extra, (size - center) / focal + extra)
    jacobian = jnp.concatenate(
        [jnp.broadcast_to(jnp.eye(2, dtype=at.dtype), (*depths.shape, 2, 2)), -at[..., None]],
        axis=-1,
    )
    jacobian = focal[:, None] * jacobian / depths[:, None, None]
    # the axes of each Gaussian on the image, M = J W A R diag(s)
    product = functools.partial(jnp.matmul, precision=transform.EXACT)
    image_from_world = product(jacobian, camera.cam_from_world[:3, :3])
    axes = product(image_from_world, covariance_factors(gaussians, config.normalize_quats))
    small = jnp.all(jnp.abs(axes) < LARGEST_FOOTPRINT, axis=(1, 2))
    return (
        slopes * focal + center,
        jnp.where(small[:, None, None], axes, 0.0),
        depths,
        visible & small,
    )


def _project_by_lens(
    gaussians: Gaussians, camera: Camera, config: SplatConfig, p: Array, visible: Array
) -> tuple[Array, Array, Array, Array]:
    """Returns the results of `_project` for a camera with a lens. The Jacobian of the whole camera
    comes from autodiff.
    """
    slopes = p[:, :2] / jnp.where(visible, p[:, 2], 1.0)[:, None]
    visible &= within_reach(camera.lens, camera.distortion, *slopes.T)
    p = jnp.where(visible[:, None], p, jnp.asarray([0.0, 0.0, 1.0], p.dtype))
    centers, jacobian = jax.vmap(lambda q: (_pixel(q, camera), jax.jacfwd(_pixel)(q, camera)))(p)
    product = functools.partial(jnp.matmul, precision=transform.EXACT)
    factors = covariance_factors(gaussians, config.normalize_quats)
    axes = product(product(jacobian, camera.cam_from_world[:3, :3]), factors)
    small = jnp.all(jnp.abs(axes) < LARGEST_FOOTPRINT, axis=(1, 2))
    return centers, jnp.where(small[:, None, None], axes, 0.0), p[:, 2], visible & small


def _pixel(p: Float[Array, "3"], camera: Camera) -> Float[Array, "2"]:
    """Returns the pixel of a point in the camera's frame, (2,)."""
    focal, center = jnp.stack([camera.K[0, 0], camera.K[1, 1]]), camera.K[:2, 2]
    if camera.lens == "orthographic":
        return focal * p[:2] + center
    k = jnp.zeros(12, p.dtype)
    if camera.distortion is not None:
        k = k.at[: camera.distortion.shape[0]].set(camera.distortion)
    if camera.lens == "fisheye":
        radius = jnp.sqrt(p[0] ** 2 + p[1] ** 2 + 1e-30)  # smooth on the axis
        angle = jnp.arctan2(radius, p[2])
        bent = angle + sum(k[i] * angle ** (2 * i + 3) for i in range(4))
        return focal * p[:2] * (bent / radius) + center
    x, y = p[0] / p[2], p[1] / p[2]
    square = x**2 + y**2
    ratio = (1 + k[0] * square + k[1] * square**2 + k[4] * square**3) / (
        1 + k[5] * square + k[6] * square**2 + k[7] * square**3
    )
    moved = jnp.stack(
        [
            x * ratio + 2 * k[2] * x * y + k[3] * (square + 2 * x**2),
            y * ratio + k[2] * (square + 2 * y**2) + 2 * k[3] * x * y,
        ]
    )
    prism = jnp.stack([k[8] * square + k[9] * square**2, k[10] * square + k[11] * square**2])
    return focal * (moved + prism) + center


def _harmonics(sight: Float[Array, "g 3"], degree: int) -> Float[Array, "g k"]:
    """Returns the real spherical harmonics of degrees 1 to `degree` at unit vectors, (g, k). They
    are N P_l^m (cos m phi, sin m phi), computed by recurrence.
    """
    x, y, z = sight.T
    # of m phi, times sin(theta)^m, which P leaves out
    cosine, sine = jnp.ones_like(x), jnp.zeros_like(x)
    found = {}
    for m in range(degree + 1):
        # of degrees m - 1 and m
        legendre = [0 * z, (-1) ** m * math.prod(range(1, 2 * m, 2)) + 0 * z]
        for n in range(m, degree + 1):
            orders = math.factorial(n - m) / math.factorial(n + m)
            norm = math.sqrt((2 * n + 1) / (4 * math.pi) * orders)
            if m == 0:
                found[n, 0] = norm * legendre[1] * cosine
            else:
                found[n, m] = math.sqrt(2) * norm * legendre[1] * cosine
                found[n, -m] = math.sqrt(2) * norm * legendre[1] * sine
            legendre = [
                legendre[1],
                ((2 * n + 1) * z * legendre[1] - (n + m) * legendre[0]) / (n + 1 - m),
            ]
        cosine, sine = x * cosine - y * sine, x * sine + y * cosine
    return jnp.stack([found[n, m] for n in range(1, degree + 1) for m in range(-n, n + 1)], axis=-1)


def _determinant(axes: Float[Array, "g 2 3"], eps2d: Array | float) -> Float[Array, " g"]:
    """Returns the determinant of axes axes^T + eps2d I, (g,), by the formula of Cauchy and Binet.
    For needles the entries of the matrix would cancel, even in float64.
    """
    pairs = _cross(axes[..., jnp.asarray([0, 1, 2])], axes[..., jnp.asarray([1, 2, 0])])
    return jnp.sum(pairs**2, axis=-1) + eps2d * jnp.sum(axes**2, axis=(-1, -2)) + eps2d**2


def _cross(a: Array, b: Array) -> Array:
    """Returns the cross products of the columns of a and b, (..., n). a, b: (..., 2, n)."""
    return a[..., 0, :] * b[..., 1, :] - a[..., 1, :] * b[..., 0, :]
