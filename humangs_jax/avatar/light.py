"""The light of the photos. Colors contain it, so they are corrected (`relit`) for parts that turn in another pose.

The log of the brightness is a polynomial of second order in the surface's unit normal, the same for all colors. A Lambertian
surface in distant light has a brightness of that order (Ramamoorthi and Hanrahan 2001, https://doi.org/10.1145/383259.383317).

Its coefficients come from the colors of the avatar. Vertices that are near each other mostly have the same albedo. If their
normals and their brightness differ, the light is the cause (Retinex: Land and McCann 1971,
https://doi.org/10.1364/JOSA.61.000001). Prints and the edges of clothes are outliers.
"""

import jax
import jax.numpy as jnp
import numpy as np

from humangs_jax.core.array_types import Array, Float, Int
from humangs_jax.core.checks import FINITE, Values
from humangs_jax.core.pytree import pytree_dataclass
from humangs_jax.geometry.transform import EXACT, along_curve
from humangs_jax.rendering.mesh.position_map import vertex_normals

TERMS = 8
LIMIT = 0.7
"""Of the change of the log: no pose makes a Gaussian more than twice as bright, or less than half, as it is in the photos."""
STEPS = (1, 2, 3, 5, 8, 13, 21, 34, 55, 89, 144, 233)
"""Along a curve through all vertices: how far apart those are that are compared."""
CURVE_REACH = 1.5
"""Metres, of the curve's cube around the middle of the body."""
REACH = 0.25
"""Metres: vertices farther apart are not compared."""
DARKEST = 0.02
"""Brightness below which differences of the log are noise."""
ROBUST = 0.03
"""Difference of the logs from which on a deviation counts by its size and not by its square."""
RIDGE = 0.003
"""Weight of the squares of the coefficients: a body without contrast has no light."""
ITERATIONS = 10
TINY = 1e-24
"""Of squares: keeps the gradient of a vanishing normal finite."""


@pytree_dataclass
class Light:
    """coefficients: (8,), of `light_terms`. normals: (g, 3), unit, of the body's surface in the T-pose.

    shading: (g,) log of the brightness in the photos: the colors of the Gaussians are those under this light.
    """

    coefficients: Float[Array, "8"]
    normals: Float[Array, "g 3"]
    shading: Float[Array, " g"]


def light_values(light: Light | None) -> dict[str, tuple[Array | None, Values]]:
    """What `core.checks.check_values` needs to check the light of an avatar."""
    return {f"light.{name}": (getattr(light, name, None), FINITE) for name in ("coefficients", "normals", "shading")}


def light_terms(normals: Float[Array, "g 3"]) -> Float[Array, "g 8"]:
    """Spherical harmonics of the first and second order, up to constant factors."""
    x, y, z = normals[:, 0], normals[:, 1], normals[:, 2]
    return jnp.stack([x, y, z, x * y, y * z, z * x, z**2 - x**2, 3 * y**2 - 1], axis=-1)


def log_brightness(terms: Float[Array, "*n 8"], coefficients: Float[Array, "8"]) -> Float[Array, "*n"]:
    """Log of the brightness that a light gives."""
    return jnp.sum(terms * coefficients, axis=-1)


def turned_normals(normals: Float[Array, "g 3"], linear: Float[Array, "g 3 3"]) -> Float[Array, "g 3"]:
    """Unit normals of surfaces that linear maps deform; 0 where a map has rank 1."""
    # the inverse transpose, up to a positive factor: rows of cofactors
    rows = [jnp.cross(linear[:, (i + 1) % 3], linear[:, (i + 2) % 3]) for i in range(3)]
    turned = jnp.einsum("gij,gj->gi", jnp.stack(rows, axis=1), normals, precision=EXACT)
    return turned * jax.lax.rsqrt(jnp.maximum(jnp.sum(turned**2, axis=-1, keepdims=True), TINY))


def relit(colors: Float[Array, "g 3"], light: Light, linear: Float[Array, "g 3 3"]) -> Float[Array, "g 3"]:
    """Colors where `linear` has turned the surface. They do not exceed 1, except where they do in the photos."""
    terms = light_terms(turned_normals(light.normals, linear))
    change = jnp.clip(log_brightness(terms, light.coefficients) - light.shading, -LIMIT, LIMIT)
    return jnp.minimum(colors * jnp.exp(change)[:, None], jnp.maximum(colors, 1.0))


def light_coefficients(
    vertices: Float[Array, "n 3"], colors: Float[Array, "n 3"], weights: Float[Array, " n"], terms: Float[Array, "n 8"]
) -> Float[Array, "8"]:
    """The light that explains the colors of vertices.

    Arguments: vertices: metres, in the T-pose. colors, weights: of the vertices; those without weight do not count. terms: of
    the light in the photos. Returns: coefficients with the least absolute deviations of the differences between vertices that
    are near each other, found by reweighted least squares.
    """
    middle = (jnp.min(vertices, axis=0) + jnp.max(vertices, axis=0)) / 2
    order = jnp.argsort(along_curve(vertices - middle, CURVE_REACH))
    brightness = jnp.mean(jnp.log(jnp.maximum(colors, DARKEST)), axis=-1)
    numbers = jnp.concatenate([vertices, brightness[:, None], weights[:, None], terms], axis=-1)[order]
    others = jnp.stack([jnp.roll(numbers, step, axis=0) for step in STEPS])
    apart = jnp.broadcast_to(numbers, others.shape) - others
    near = jnp.sum(apart[..., :3] ** 2, axis=-1) < REACH**2
    counted = (near * jnp.minimum(numbers[:, 4], others[..., 4])).reshape(-1)
    change, turn = apart[..., 3].reshape(-1), apart[..., 5:].reshape(-1, TERMS)

    def step(_, coefficients):
        weight = counted / jnp.maximum(jnp.abs(change - log_brightness(turn, coefficients)), ROBUST)
        weighted = (turn * (weight / jnp.maximum(jnp.sum(counted), 1e-6))[:, None]).T
        squares, target = (jnp.matmul(weighted, values, precision=EXACT) for values in (turn, change))
        return jnp.linalg.solve(squares + RIDGE * jnp.eye(TERMS), target)

    return jax.lax.fori_loop(0, ITERATIONS, step, jnp.zeros(TERMS))


def surface_normals(vertices: Float[Array, "n 3"], faces: Int[Array, "f 3"], points: Float[Array, "g 3"]) -> Float[Array, "g 3"]:
    """Unit normals of a mesh at the vertex nearest to each point. On the host."""
    from scipy.spatial import KDTree

    return vertex_normals(vertices, faces)[KDTree(np.asarray(vertices)).query(np.asarray(points))[1]]
