"""Silhouettes as evidence: silhouettes of a body against silhouettes of masks.

As in edge trackers (Harris and Stennett 1990, "RAPiD"): each point of the body's silhouette looks along its normal for the
nearest end of the mask, and each point of the mask's silhouette for the nearest point of the body's that faces the same way. Both
give an equation n . x = n . q: x, a point of the body in the image, may slide along the mask's silhouette.

People wear clothes and hair: the body may end inside of the mask, but not outside. So distances outwards count in full, and
distances inwards count less and less the larger they are.
"""

import dataclasses
import functools
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np

from humangs_jax.body.model import BodyModel
from humangs_jax.body.skinning import SurfacePoints
from humangs_jax.core.array_types import Array, Float, Int
from humangs_jax.core.pytree import pytree_dataclass
from humangs_jax.fitting.residuals.boundaries import Boundary, inside_image
from humangs_jax.fitting.solve import robust
from humangs_jax.network.maps import sample_bilinear

LOOKS = 129
"""Samples along a normal: half a pixel apart in the first round, less later."""
FACING = 0.5
"""Least cosine between the normals of two points that belong together (60 degrees)."""


@pytree_dataclass
class Matches:
    """Equations of one view: points[i] of the body's silhouette shall lie on the line normals[i] . x = offsets[i].

    points: (e,) indices. normals: (e, 2) unit, outwards. offsets: (e,) pixels. weights: (e,) 0: no equation.
    """

    points: Int[Array, " e"]
    normals: Float[Array, "e 2"]
    offsets: Float[Array, " e"]
    weights: Float[Array, " e"]


@dataclasses.dataclass(frozen=True, eq=False)
class MaskView:
    """A mask (h, w) with its silhouette."""

    mask: Float[np.ndarray, "h w"]
    boundary: Boundary


def match(body: Boundary, view: MaskView, reach: float, count: int) -> Matches:
    """At most 2 `count` equations, padded with weight 0. reach: pixels, how far points look."""
    own = _ends_of_mask(body, view.mask, reach)
    other = _nearest(body, view.boundary, reach)
    rows = [np.concatenate(pair) for pair in zip(own, other, strict=True)]
    missing = 2 * count - len(rows[0])
    points, normals, offsets = (np.pad(x, ((0, missing),) + ((0, 0),) * (x.ndim - 1)) for x in rows)
    weights = np.arange(2 * count) < len(rows[0])
    to = lambda x: jnp.asarray(x, jnp.float32)
    return Matches(jnp.asarray(points, jnp.int32), to(normals), to(offsets), to(weights))


def _ends_of_mask(body, mask, reach):
    """For points of the body, along their normals: where the mask goes from inside to outside."""
    steps = np.linspace(-reach, reach, LOOKS)
    places = body.positions[:, None] + steps[:, None] * body.normals[:, None]
    covered = np.asarray(_coverage(mask, places))
    seen = inside_image(places, mask.shape)
    ends = (covered[:, :-1] >= 0.5) & (covered[:, 1:] < 0.5) & seen[:, :-1] & seen[:, 1:]
    nearest = np.argmin(np.where(ends, np.abs(steps[:-1]), np.inf), axis=1)
    rows = np.arange(len(nearest))
    inner, outer = covered[rows, nearest], covered[rows, nearest + 1]
    found = ends[rows, nearest]
    along = steps[nearest] + (steps[1] - steps[0]) * (inner - 0.5) / np.where(found, inner - outer, 1.0)
    offsets = np.sum(body.normals * body.positions, axis=-1) + along
    return np.flatnonzero(found), body.normals[found], offsets[found]


@jax.jit
def _coverage(mask, places):
    return sample_bilinear(mask[..., None], places - 0.5)[..., 0]


def _nearest(body, mask, reach):
    """For points of the mask: the nearest of the body that faces the same way."""
    if not len(body.positions) or not len(mask.positions):
        return np.zeros(0, int), np.zeros((0, 2)), np.zeros(0)
    distances = np.linalg.norm(mask.positions[:, None] - body.positions, axis=-1)
    distances = np.where(mask.normals @ body.normals.T > FACING, distances, np.inf)
    nearest = np.argmin(distances, axis=1)
    found = distances[np.arange(len(nearest)), nearest] < reach
    return nearest[found], mask.normals[found], np.sum(mask.normals * mask.positions, axis=-1)[found]


def distances(matches: Matches, pixels: Float[Array, "p 2"]) -> Float[Array, " e"]:
    """How far points of the body are outside of their lines, pixels; negative inside."""
    along = matches.normals * pixels[matches.points]
    return along[:, 0] + along[:, 1] - matches.offsets  # not `jnp.sum`: see `scan.scan_residuals`


def silhouette_residuals(
    matches: Matches,
    pixels: Float[Array, "p 2"],
    clothes: Float[Array, " p"],
    noise: Float[Array, ""],
    scales: tuple[Float[Array, ""], Float[Array, ""]],
    independent: float,
) -> Float[Array, " e"]:
    """Distances of silhouettes in standard deviations.

    Arguments: clothes: pixels by which the mask reaches beyond the body. noise: std of a silhouette, pixels. scales: robust
    scales outwards and inwards, pixels. independent: number of independent equations that all of a view count for, because
    neighbours on a silhouette err together.
    """
    off = distances(matches, pixels) + clothes[matches.points]
    scale = jnp.where(off > 0, *scales)
    share = independent / jnp.maximum(jnp.sum(matches.weights), 1.0)
    bounded = jax.vmap(robust)((off / noise)[:, None], scale / noise)[:, 0]
    return jnp.sqrt(matches.weights * jnp.minimum(share, 1.0)) * bounded


# Points of silhouettes on the body --------------------------------------------------------------------------------------


def boundary_points(body: BodyModel, boundaries: Sequence[Boundary], count: int, coefficients: int) -> SurfacePoints:
    """The points of v silhouettes as functions of shape and pose, (v, count, ...), padded with points that no equation uses."""
    fill = lambda x: np.pad(x, ((0, count - len(x)),) + ((0, 0),) * (x.ndim - 1))
    ends = jnp.asarray(np.stack([fill(boundary.ends) for boundary in boundaries]))
    shares = jnp.asarray(np.stack([fill(boundary.shares) for boundary in boundaries]))
    return _between(body, ends, shares, coefficients)


@functools.partial(jax.jit, static_argnames="coefficients")
def _between(body, ends, shares, coefficients):
    def one(ends, shares):
        def of(values):
            share = shares.reshape(-1, *(1,) * (values.ndim - 1))
            return (1 - share) * values[ends[:, 0]] + share * values[ends[:, 1]]

        corrections = None if body.pose_directions is None else of(body.pose_directions)
        directions = body.shape_directions[..., :coefficients]
        return SurfacePoints(of(body.template), of(directions), corrections, of(body.skinning_weights))

    return jax.vmap(one)(ends, shares)
