"""Points in space from several views, and similarities between points.

A pixel is a ray. The point with the least weighted sum of squared distances to the rays solves 3 x 3 equations. Weights of
focal length over distance turn metres into pixels (Hartley and Zisserman, Multiple View Geometry, 12.2). Robustly: from the pair
of views that most views agree with. Similarities are in float64 on the host.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from humangs_jax.core.array_types import Array, Float
from humangs_jax.core.numerics import safe_normalize
from humangs_jax.fitting.residuals.keypoints import Observations, focal_lengths, in_cameras
from humangs_jax.geometry.transform import EXACT

RIDGE = 1e-6
"""Share of the weights that pulls towards the cameras: parallel rays leave the distance open."""
REWEIGHTED = 3
"""Rounds of weighting the rays by the distance of the last point."""
PAIRS_AT_ONCE = 16
"""Pairs of views whose proposals are compared with all views at once: memory does not grow with the number of pairs."""
MARGIN = 6.0
"""A view agrees with a point within this many standard deviations of the noise."""


def triangulate(
    observations: Observations, weights: Float[Array, "c k"] | None = None
) -> tuple[Float[Array, "k 3"], Float[Array, " k"]]:
    """Least squares over all views: points (k, 3) in metres and how many views see each (k,).

    Arguments: weights: of the views of each point; default: the confidences.
    """
    weights = observations.confidences if weights is None else weights
    origins, directions = _rays(observations)
    focal = observations.K[:, 0, 0]
    points = _nearest(origins, directions, weights)
    for _ in range(REWEIGHTED):
        distance = jnp.sum(directions * (points - origins[:, None]), axis=-1)
        points = _nearest(origins, directions, weights * jnp.square(focal[:, None] / jnp.maximum(jnp.abs(distance), 0.1)))
    return points, jnp.sum(weights > 0, axis=0).astype(jnp.float32)


def triangulate_robustly(observations: Observations) -> tuple[Float[Array, "k 3"], Float[Array, " k"], Float[Array, "c k"]]:
    """Points (k, 3), how many views agree with each (k,), and those views' weights (c, k).

    Every pair of views proposes a point; the proposal that the views agree with most is improved from those views alone. A
    point that fewer than two views agree with has weights of 0.
    """
    views = observations.points.shape[0]
    if views < 2:
        k = observations.points.shape[1]
        return jnp.zeros((k, 3)), jnp.zeros(k), jnp.zeros_like(observations.confidences)
    pairs = np.stack(np.triu_indices(views, 1), axis=1)
    chosen = np.zeros((len(pairs), views, 1), np.float32)
    chosen[np.arange(len(pairs))[:, None], pairs] = 1

    def agreement(points):
        errors = reprojection_errors(observations, points)
        return observations.confidences * jnp.maximum(1 - jnp.square(errors / (MARGIN * observations.noise)), 0.0)

    def propose(pair):
        points = triangulate(observations, observations.confidences * pair)[0]
        return points, jnp.sum(agreement(points), axis=0)

    # of all pairs only their points are kept: with 48 views there are 1128 pairs, each with an agreement of every view
    proposals, agreed = jax.lax.map(propose, jnp.asarray(chosen), batch_size=PAIRS_AT_ONCE)
    best = jnp.argmax(agreed, axis=0)
    weights = agreement(jnp.take_along_axis(proposals, best[None, :, None], axis=0)[0])
    agreeing = jnp.sum(weights > 0, axis=0)
    weights = jnp.where(agreeing >= 2, weights, 0.0)
    points, count = triangulate(observations, weights)
    return points, count, weights


def reprojection_errors(observations: Observations, points: Float[Array, "k 3"]) -> Float[Array, "c k"]:
    """Distance in pixels between points as the views would show them and the detections; huge behind a camera."""
    seen = in_cameras(observations, points)
    depth = seen[..., 2]
    before = depth > 0.01
    pixels = seen[..., :2] / jnp.where(before, depth, 1.0)[..., None] * focal_lengths(observations)
    pixels += observations.K[:, None, :2, 2]
    return jnp.where(before, jnp.linalg.norm(pixels - observations.points, axis=-1), 1e6)


def _rays(observations: Observations) -> tuple[Float[Array, "c 3"], Float[Array, "c k 3"]]:
    rotation, translation = observations.cam_from_world[:, :3, :3], observations.cam_from_world[:, :3, 3]
    xy = (observations.points - observations.K[:, None, :2, 2]) / focal_lengths(observations)
    local = jnp.concatenate([xy, jnp.ones_like(xy[..., :1])], axis=-1)
    directions = safe_normalize(jnp.einsum("cba,ckb->cka", rotation, local, precision=EXACT), jnp.asarray([0.0, 0.0, 1.0]))
    return -jnp.einsum("cba,cb->ca", rotation, translation, precision=EXACT), directions


def _nearest(
    origins: Float[Array, "c 3"], directions: Float[Array, "c k 3"], weights: Float[Array, "c k"]
) -> Float[Array, "k 3"]:
    center = jnp.mean(origins, axis=0)  # against rounding far from the world's origin
    across = jnp.eye(3) - directions[..., :, None] * directions[..., None, :]
    scale = weights / jnp.maximum(jnp.sum(weights, axis=0), 1e-12)
    matrix = jnp.einsum("ck,ckab->kab", scale, across, precision=EXACT) + RIDGE * jnp.eye(3)
    vector = jnp.einsum("ck,ckab,cb->ka", scale, across, origins - center, precision=EXACT)
    return jnp.linalg.solve(matrix, vector[..., None])[..., 0] + center


# Similarities ----------------------------------------------------------------------------------------------------------

ITERATIONS = 10
"""Rounds of reweighting by the distances."""


@dataclasses.dataclass(frozen=True, eq=False)
class Similarity:
    """x -> scale rotation x + translation. rotation: (3, 3), proper. translation: (3,)."""

    scale: float
    rotation: Float[np.ndarray, "3 3"]
    translation: Float[np.ndarray, "3"]

    def __call__(self, points: Float[np.ndarray, "*b 3"]) -> Float[np.ndarray, "*b 3"]:
        return self.scale * np.asarray(points, np.float64) @ self.rotation.T + self.translation

    def after(self, first: "Similarity") -> "Similarity":
        """The composition: first `first`, then this one."""
        return Similarity(
            self.scale * first.scale, self.rotation @ first.rotation, self(np.asarray(first.translation, np.float64))
        )

    def inverse(self) -> "Similarity":
        back = self.rotation.T
        return Similarity(1 / self.scale, back, -(back @ self.translation) / self.scale)

    def matrix(self) -> Float[np.ndarray, "4 4"]:
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = self.scale * self.rotation, self.translation
        return matrix


def align_points(
    source: Float[np.ndarray, "k 3"], target: Float[np.ndarray, "k 3"], weights: Float[np.ndarray, " k"]
) -> Similarity:
    """The similarity from source to target whose weighted square distances are least (Umeyama 1991, eq. 40 to 43).

    Raises: ValueError if fewer than three points have a weight, or they lie on a line.
    """
    share = weights / max(weights.sum(), 1e-30)
    mean_source, mean_target = share @ source, share @ target
    x, y = source - mean_source, target - mean_target
    extent = np.linalg.svd(np.sqrt(share)[:, None] * x, compute_uv=False)
    if (weights > 0).sum() < 3 or extent[1] < 1e-6 * extent[0]:
        raise ValueError("expected at least three points that are not on one line")
    u, values, vt = np.linalg.svd(y.T @ (share[:, None] * x))
    signs = np.asarray([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    rotation = (u * signs) @ vt
    scale = float((values * signs).sum() / (share @ (x * x).sum(axis=1)))
    return Similarity(scale, rotation, mean_target - scale * rotation @ mean_source)


def align_robustly(
    source: Float[np.ndarray, "k 3"], target: Float[np.ndarray, "k 3"], weights: Float[np.ndarray, " k"], std: float
) -> Similarity:
    """The same with Cauchy weights: points farther off than `std`, in units of the target, count less.

    Raises: see `align_points`.
    """
    found = align_points(source, target, weights)
    for _ in range(ITERATIONS):
        away = np.linalg.norm(found(source) - target, axis=1) / std
        found = align_points(source, target, weights / (1 + away * away))
    return found
