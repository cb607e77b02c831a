"""Colors that depend on the direction of sight: real spherical harmonics of degrees 1 to 3, by the convention of 3DGS.

With d the unit vector from the camera's centre to the mean, in the world, Gaussians are drawn in the color

    max(colors + sum_k Y_k(d) harmonics_k, 0),     colors = 1/2 + Y_00 f_dc in files of 3DGS.

Y_k: by degree l, then by order m from -l to l, normalised over the sphere, with the sign (-1)^m of Condon and Shortley, as in
https://github.com/graphdeco-inria/diff-gaussian-rasterization (Y_1 = -c y, Y_2 = c z, Y_3 = -c x).
"""

import functools
import math

import jax.numpy as jnp
import numpy as np

from humangs_jax.core.array_types import Array, Float
from humangs_jax.geometry.transform import EXACT

COUNTS = (0, 3, 8, 15)
"""Of the functions of degrees 1 to l, by l."""
_C1 = math.sqrt(3 / (4 * math.pi))
_C2 = [math.sqrt(n / (16 * math.pi)) for n in (60, 5, 15)]
_C3 = [math.sqrt(n / (64 * math.pi)) for n in (70, 1680, 42, 28, 420)]
POINTS = 32
"""Directions from which functions are found again: more than functions, spread evenly."""


def check_count(count: int) -> None:
    """Raises: ValueError for a number of functions that is not that of whole degrees."""
    if count not in COUNTS[1:]:
        raise ValueError(f"harmonics: expected (g, 3, 3), (g, 8, 3) or (g, 15, 3), got (g, {count}, 3)")


def basis(x: Array | np.ndarray | float, y: Array | np.ndarray | float, z: Array | np.ndarray | float, count: int) -> list:
    """Y_1 to Y_count of unit vectors, given as planes. Raises: as `check_count`."""
    check_count(count)
    xx, yy, zz = x * x, y * y, z * z
    first = [-_C1 * y, _C1 * z, -_C1 * x]
    a, b, c = _C2
    second = [a * x * y, -a * y * z, b * (2 * zz - xx - yy), -a * x * z, c * (xx - yy)]
    a, b, c, d, e = _C3
    ring = 4 * zz - xx - yy
    third = [-a * y * (3 * xx - yy), b * x * y * z, -c * y * ring, d * z * (2 * zz - 3 * xx - 3 * yy)]
    third += [-c * x * ring, e * z * (xx - yy), -a * x * (xx - 3 * yy)]
    return [*first, *second, *third][:count]


def added_colors(harmonics: Float[Array, "g k 3"], x: Array, y: Array, z: Array) -> Float[Array, "g 3"]:
    """The sum over k for unit vectors d, given as planes of (g,)."""
    values = jnp.stack(basis(x, y, z, harmonics.shape[1]), axis=-1)
    return jnp.sum(values[..., None] * harmonics, axis=1)


def turned_harmonics(harmonics: Float[Array, "*g k 3"], rotations: Float[Array, "*#g 3 3"]) -> Float[Array, "*g k 3"]:
    """Harmonics of the same colors after everything has been turned: those that were seen along d are seen along R d."""
    count = harmonics.shape[-2]
    points, inverse = _points(count)
    before = jnp.matmul(jnp.asarray(points, harmonics.dtype), rotations, precision=EXACT)
    values = jnp.stack(basis(*jnp.moveaxis(before, -1, 0), count), axis=-1)
    matrices = jnp.matmul(jnp.asarray(inverse, harmonics.dtype), values, precision=EXACT)
    return jnp.matmul(matrices, harmonics, precision=EXACT)


@functools.cache
def _points(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Unit vectors (p, 3) on a spiral, and the matrix (k, p) from the values there to the factors of the functions."""
    z = 1 - (2 * np.arange(POINTS) + 1) / POINTS
    angle = np.pi * (1 + math.sqrt(5)) * np.arange(POINTS)
    ring = np.sqrt(1 - z * z)
    points = np.stack([ring * np.cos(angle), ring * np.sin(angle), z], axis=-1)
    return points, np.linalg.pinv(np.stack(basis(*points.T, count), axis=-1))
