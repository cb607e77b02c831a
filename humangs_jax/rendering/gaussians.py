"""3D Gaussians, the scene that every splatter here draws.

The covariance of a Gaussian is A R diag(s)^2 R^T A^T. R is the rotation of its quaternion, and s
are its scales (standard deviations, metres). A is the linear deformation that blend skinning
leaves. Without `deformations` it is the identity.
"""

import functools
import math
from typing import Annotated, Literal

import jax
import jax.numpy as jnp
import numpy as np

from humangs_jax.core.array_types import Array, Float
from humangs_jax.core.checks import NOT_NEGATIVE, UNIT, checked_arguments
from humangs_jax.core.numerics import inverse_sigmoid
from humangs_jax.core.pytree import Batchable, pytree_dataclass, replace
from humangs_jax.geometry import quaternion, transform
from humangs_jax.geometry.quaternion import left_singular_vectors
from humangs_jax.geometry.transform import EXACT
from humangs_jax.rendering.splat_config import EPS2D, MIP_EPS2D


@pytree_dataclass
class Gaussians(Batchable):
    """A set of 3D Gaussians, or a batch of sets (leading axes on every field)."""

    means: Float[Array, "g 3"]
    """Centres, (g, 3), metres."""
    quats: Float[Array, "g 4"]
    """Rotations, (g, 4), quaternions wxyz. They are normalised where they are used, except with
    `SplatConfig.normalize_quats` False.
    """
    scales: Annotated[Float[Array, "g 3"], NOT_NEGATIVE]
    """Standard deviations along the Gaussians' axes, (g, 3), metres."""
    opacities: Annotated[Float[Array, " g"], UNIT]
    """Opacities at the centres, (g,), in [0, 1]."""
    colors: Float[Array, "g 3"]
    """RGB, (g, 3), in [0, 1], as images have them (sRGB-encoded).

    Any finite numbers are drawn: splatting is linear in them, and people draw normals and labels as
    colors.
    """
    deformations: Float[Array, "g 3 3"] | None = None
    """Linear maps, (g, 3, 3), or None. They are applied to the covariances after the rotation, and
    never to the means.
    """
    pixel_footprint: Annotated[Float[Array, " g"] | None, NOT_NEGATIVE] = None
    """Side of a pixel at each Gaussian, (g,), metres. The scales contain the low-pass of images
    with such pixels (`avatar.animate`). Renderers then add a variance of at most `MIP_EPS2D`
    pixels^2. If a pixel of the drawn image is larger than `pixel_footprint`, the Gaussian is also
    dimmed, because the added variance enlarges it. None: the scales contain no low-pass.
    """
    harmonics: Float[Array, "g k 3"] | None = None
    """Coefficients of real spherical harmonics, (g, k, 3), or None. The harmonics add colors that
    depend on the direction of sight, see `added_colors`. Degree 1 has k = 3, degrees 1 and 2 have k
    = 8, and degrees 1 to 3 have k = 15. Directions are in the frame of the means. `skin_gaussians`
    turns the harmonics with the Gaussians, so the harmonics of an avatar are in the frame of its
    T-pose.
    """


def added_variance(pixel_footprint: Float[Array, " g"] | None, eps2d: float) -> float:
    """Returns the variance that is added to projected variances, pixels^2. It is `eps2d`, but at
    most `MIP_EPS2D` if there is a `pixel_footprint`.
    """
    if pixel_footprint is None:
        return eps2d
    return min(eps2d, MIP_EPS2D)


def widened(
    scales: Float[Array, "g 3"], pixel_footprint: Float[Array, " g"] | None, sign: int = 1
) -> Float[Array, "g 3"]:
    """Returns scales with a low-pass added, metres. The variance of the low-pass is `EPS2D -
    MIP_EPS2D` times the square of `pixel_footprint`, the side of a pixel in metres. The results are
    at least 1e-5. sign: -1 subtracts the variance again. Without a `pixel_footprint` the scales are
    unchanged.
    """
    if pixel_footprint is None:
        return scales
    added = sign * (EPS2D - MIP_EPS2D) * jnp.square(pixel_footprint)
    # no scale gets smaller than 10 micrometres, a thousandth of a pixel
    return jnp.sqrt(jnp.maximum(jnp.square(scales) + added[:, None], 1e-5**2))


def covariance_factors(gaussians: Gaussians, normalize_quats: bool = True) -> Float[Array, "g 3 3"]:
    """Returns F = A R diag(s), (g, 3, 3), metres. The covariance is F F^T."""
    quats = gaussians.quats
    if normalize_quats:
        quats = quaternion.normalize(gaussians.quats)
    factors = quaternion.to_matrix(quats) * gaussians.scales[:, None, :]
    if gaussians.deformations is not None:
        factors = jnp.matmul(gaussians.deformations, factors, precision=transform.EXACT)
    return factors


def covariances(gaussians: Gaussians) -> Float[Array, "g 3 3"]:
    """Returns the covariance matrices in the world, (g, 3, 3), metres^2."""
    factors = covariance_factors(gaussians)
    return jnp.einsum("gik,gjk->gij", factors, factors, precision=transform.EXACT)


def factored(gaussians: Gaussians) -> Gaussians:
    """Returns Gaussians with the same covariances but without `deformations`. Quats and scales come
    from the singular value decomposition of A R diag(s).

    This is not meant to be differentiated: the factors are not unique where two scales coincide.
    """
    if gaussians.deformations is None:
        return gaussians
    rotations, scales = left_singular_vectors(covariance_factors(gaussians))
    return replace(
        gaussians, quats=quaternion.from_matrix(rotations), scales=scales, deformations=None
    )


def skin_gaussians(
    gaussians: Gaussians,
    transforms: Float[Array, "g 4 4"],
    mode: Literal["affine", "rotation"] = "affine",
) -> Gaussians:
    """Returns the Gaussians moved by their (blended) transforms. Scales, opacities and colors stay.
    Harmonics are turned by the rotation that is read from the transform.

    With "affine", the linear part of the transform is multiplied into `deformations`, and so
    transforms the whole covariance. With "rotation", as published, the linear part is multiplied by
    the Gaussian's rotation matrix, and the product is converted to a quaternion. If the blended
    transform is no rotation, the norm of this quaternion may differ from 1. To reproduce this, draw
    with `normalize_quats=False`.

    Raises: ValueError for another mode, and for "rotation" if the Gaussians have deformations
    already.
    """
    linear, means = transforms[:, :3, :3], transform.apply(transforms, gaussians.means)
    if gaussians.harmonics is not None:
        turns = quaternion.to_matrix(quaternion.normalize(quaternion.from_matrix(linear)))
        gaussians = replace(gaussians, harmonics=turned_harmonics(gaussians.harmonics, turns))
    if mode == "affine":
        deformations = linear
        if gaussians.deformations is not None:
            deformations = jnp.matmul(linear, gaussians.deformations, precision=transform.EXACT)
        return replace(gaussians, means=means, deformations=deformations)
    if mode != "rotation":
        raise ValueError(f"skinning mode must be 'affine' or 'rotation', got {mode!r}")
    if gaussians.deformations is not None:
        raise ValueError(
            "'rotation' skinning keeps quaternions only: these Gaussians are deformed already"
        )
    rotations = quaternion.to_matrix(quaternion.normalize(gaussians.quats))
    turned = jnp.matmul(linear, rotations, precision=transform.EXACT)
    return replace(gaussians, means=means, quats=quaternion.from_matrix(turned))


SMALLEST_SCALE = 1e-6
"""Smallest scale, metres. It keeps the logarithm finite for flat Gaussians."""
COLOR_MARGIN = 0.005
"""Distance from 0 and 1 to which colors are clamped, because the gradient of the sigmoid vanishes
there.
"""
OPACITY_MARGIN = 0.001
"""Distance from 0 and 1 to which opacities are clamped. It is less than the smallest opacity that
is drawn, 1/255, so that hidden Gaussians stay hidden.
"""


@pytree_dataclass
class UnconstrainedGaussians(Batchable):
    """Parameters of a set of Gaussians, or of a batch of sets, that an optimizer of optax may move
    freely.
    """

    means: Float[Array, "g 3"]
    """Centres, (g, 3), metres."""
    quats: Float[Array, "g 4"]
    """Rotations, (g, 4), quaternions wxyz of any length."""
    log_scales: Float[Array, "g 3"]
    """Natural logarithms of the scales in metres, (g, 3)."""
    opacity_logits: Float[Array, " g"]
    """Logits of the opacities, (g,)."""
    color_logits: Float[Array, "g 3"]
    """Logits of the colors, (g, 3)."""
    harmonics: Float[Array, "g k 3"] | None = None
    """The harmonics, unchanged, (g, k, 3), or None."""


@checked_arguments
def unconstrain(gaussians: Gaussians) -> UnconstrainedGaussians:
    """Returns parameters from which `constrain` makes these Gaussians, with opacities clamped to
    [`OPACITY_MARGIN`, 1 - `OPACITY_MARGIN`], colors to [`COLOR_MARGIN`, 1 - `COLOR_MARGIN`], and
    scales to at least `SMALLEST_SCALE`. `pixel_footprint` is lost.

    Args:
        gaussians: without deformations. If they have a `pixel_footprint`, their scales contain a
            low-pass, which is not subtracted.

    Returns:
        Parameters without bounds: log scales, logits.

    Raises:
        ValueError: for Gaussians with deformations.

    Examples:
        >>> parameters = hg.unconstrain(gaussians)
        >>> image = lambda p: hg.render(hg.constrain(p), camera, config).rgb
        >>> loss = lambda p: jnp.mean(jnp.square(image(p) - photo))
        >>> updates, state = optimizer.update(jax.grad(loss)(parameters), state)
        >>> parameters = optax.apply_updates(parameters, updates)
    """
    if gaussians.deformations is not None:
        raise ValueError(
            "unconstrain: the Gaussians carry deformations: take"
            " rendering.gaussians.factored(gaussians)"
        )
    parameters = UnconstrainedGaussians(
        gaussians.means,
        gaussians.quats,
        jnp.log(jnp.maximum(gaussians.scales, SMALLEST_SCALE)),
        inverse_sigmoid(gaussians.opacities, OPACITY_MARGIN),
        inverse_sigmoid(gaussians.colors, COLOR_MARGIN),
        gaussians.harmonics,
    )
    # of `jnp.full(n, 0.5)` types are weak, those of a step's result are not: the step would compile
    # twice
    return jax.tree.map(lambda x: jax.lax.convert_element_type(x, x.dtype), parameters)


@checked_arguments
def constrain(parameters: UnconstrainedGaussians) -> Gaussians:
    """Returns the Gaussians of parameters without bounds. Scales are positive, opacities and colors
    in (0, 1).

    Args:
        parameters: without bounds, as an optimizer of optax moves them.

    Returns:
        Gaussians.

    Examples:
        >>> gaussians = hg.constrain(parameters)
    """
    return Gaussians(
        parameters.means,
        parameters.quats,
        jnp.exp(parameters.log_scales),
        jax.nn.sigmoid(parameters.opacity_logits),
        jax.nn.sigmoid(parameters.color_logits),
        harmonics=parameters.harmonics,
    )


# Colors that depend on the direction of sight: real spherical harmonics, by the convention of 3DGS.
# With d the unit vector from the camera's centre to the mean, in the world, Gaussians are drawn in
# the color
#
#     max(colors + sum_k Y_k(d) harmonics_k, 0),     colors = 1/2 + Y_00 f_dc in files of 3DGS.
#
# Y_k: by degree l, then by order m from -l to l, normalised over the sphere, with the sign (-1)^m
# of Condon and Shortley, as in https://github.com/graphdeco-inria/diff-gaussian-rasterization (Y_1
# = -c y, Y_2 = c z, Y_3 = -c x).

COUNTS = (0, 3, 8, 15)
"""Number of functions of the degrees 1 to l, for l = 0 to 3."""
POINTS = 32
"""Number of directions, spread evenly, at which `turned_harmonics` evaluates the functions. It is
larger than the number of functions.
"""


def check_count(count: int) -> None:
    """Checks that a number of harmonics is 3 (degree 1), 8 (degrees 1 and 2) or 15 (degrees 1 to
    3). Raises: ValueError for another number.
    """
    if count not in COUNTS[1:]:
        raise ValueError(
            f"harmonics: expected (g, 3, 3), (g, 8, 3) or (g, 15, 3), got (g, {count}, 3)"
        )


def basis(
    x: Array | np.ndarray | float,
    y: Array | np.ndarray | float,
    z: Array | np.ndarray | float,
    count: int,
) -> list:
    """Returns a list of the spherical harmonics Y_1 to Y_count at unit vectors, each in the shape
    of x. x, y, z: coordinates of the vectors. Raises: ValueError, as `check_count`.
    """
    check_count(count)
    xx, yy, zz = x * x, y * y, z * z
    a = math.sqrt(3 / (4 * math.pi))
    first = [-a * y, a * z, -a * x]
    a, b, c = (math.sqrt(n / (16 * math.pi)) for n in (60, 5, 15))
    second = [a * x * y, -a * y * z, b * (2 * zz - xx - yy), -a * x * z, c * (xx - yy)]
    a, b, c, d, e = (math.sqrt(n / (64 * math.pi)) for n in (70, 1680, 42, 28, 420))
    ring = 4 * zz - xx - yy
    third = [
        -a * y * (3 * xx - yy),
        b * x * y * z,
        -c * y * ring,
        d * z * (2 * zz - 3 * xx - 3 * yy),
    ]
    third += [-c * x * ring, e * z * (xx - yy), -a * x * (xx - 3 * yy)]
    return [*first, *second, *third][:count]


def added_colors(
    harmonics: Float[Array, "g k 3"], x: Array, y: Array, z: Array
) -> Float[Array, "g 3"]:
    """Returns the colors that harmonics add in the directions d, (g, 3): the sum over k of Y_k(d)
    harmonics_k. x, y, z: coordinates of the unit vectors d, (g,) each.
    """
    values = jnp.stack(basis(x, y, z, harmonics.shape[1]), axis=-1)
    return jnp.sum(values[..., None] * harmonics, axis=1)


def turned_harmonics(
    harmonics: Float[Array, "*g k 3"], rotations: Float[Array, "*#g 3 3"]
) -> Float[Array, "*g k 3"]:
    """Returns harmonics turned by rotations R. Colors that were seen along d are then seen along R
    d.
    """
    count = harmonics.shape[-2]
    points, inverse = _points(count)
    before = jnp.matmul(jnp.asarray(points, harmonics.dtype), rotations, precision=EXACT)
    values = jnp.stack(basis(*jnp.moveaxis(before, -1, 0), count), axis=-1)
    matrices = jnp.matmul(jnp.asarray(inverse, harmonics.dtype), values, precision=EXACT)
    return jnp.matmul(matrices, harmonics, precision=EXACT)


@functools.cache
def _points(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Returns unit vectors spread evenly over the sphere, (p, 3), and a matrix (k, p). The matrix
    times the values of a function at these vectors gives the coefficients of k harmonics.
    """
    z = 1 - (2 * np.arange(POINTS) + 1) / POINTS
    angle = np.pi * (1 + math.sqrt(5)) * np.arange(POINTS)
    ring = np.sqrt(1 - z * z)
    points = np.stack([ring * np.cos(angle), ring * np.sin(angle), z], axis=-1)
    return points, np.linalg.pinv(np.stack(basis(*points.T, count), axis=-1))
