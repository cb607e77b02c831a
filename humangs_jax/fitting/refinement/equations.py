"""The equations of refinement, and their solution while what belongs together is held fixed.

Residuals, in standard deviations: outlines of every view (`silhouettes`), keypoints where there are any (`objective`), and
the prior (`unknowns`). Half their square sum is the negative log posterior.
"""

import functools
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from humangs_jax.body import skinning
from humangs_jax.body.landmarks import LandmarkModel
from humangs_jax.body.model import BodyModel, pose_features
from humangs_jax.body.surface_points import SurfacePoints, pose_points
from humangs_jax.core.array_types import Array, Float
from humangs_jax.core.pytree import pytree_dataclass, replace
from humangs_jax.fitting.objective import Problem, keypoint_residuals
from humangs_jax.fitting.observations import Observations
from humangs_jax.fitting.pose_prior import pose_prior
from humangs_jax.fitting.refinement.outlines import Outline
from humangs_jax.fitting.refinement.silhouettes import Matches, silhouette_residuals
from humangs_jax.fitting.refinement.unknowns import (
    Spreads,
    Start,
    Unknowns,
    moved_cameras,
    moved_poses,
    moved_shape,
    root_turns,
    thickness,
)
from humangs_jax.fitting.solvers import Outcome, least_squares, minimise

DENSE = 400
"""Unknowns above which L-BFGS takes the place of least squares, whose matrix of derivatives grows with rows times columns."""
PATIENCE = 6
"""Steps of L-BFGS for one of least squares."""
KEYPOINT_CUT = 5.0
"""Standard deviations at which a keypoint is an outlier."""
BARE = 5.0
"""Clothes are not thinner than nothing: so much less likely than thick ones."""
NEAR = 0.05
"""Metres: points nearer to a camera, or behind it, are taken to be so far."""


@pytree_dataclass
class Evidence:
    """What v views show. points: of the body's outline, and matches: where they belong, batches of v. noise: () pixels; cuts:
    (2,) pixels, outwards and inwards. keypoints: a batch of v, each with one view (c = 1), or None.
    """

    points: SurfacePoints
    matches: Matches
    noise: Float[Array, ""]
    cuts: Float[Array, "2"]
    keypoints: Observations | None


def surface_points(body: BodyModel, outlines: Sequence[Outline], count: int, coefficients: int) -> SurfacePoints:
    """The points of outlines as functions of shape and pose, filled up to `count` with others that no equation names."""
    fill = lambda x: np.pad(x, ((0, count - len(x)),) + ((0, 0),) * (x.ndim - 1))
    ends = jnp.asarray(np.stack([fill(outline.ends) for outline in outlines]))
    shares = jnp.asarray(np.stack([fill(outline.shares) for outline in outlines]))
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


def evidence_residuals(
    model: LandmarkModel | None,
    start: Start,
    spreads: Spreads,
    unknowns: Unknowns,
    evidence: Evidence,
    independent: float,
) -> dict[str, Float[Array, "..."]]:
    """Residuals of the views, by what they are of: silhouettes (v, e) and keypoints (v, 1, k, 2)."""
    K, cam_from_world = moved_cameras(start, spreads, unknowns)
    betas, poses = moved_shape(start, spreads, unknowns), moved_poses(start, spreads, unknowns)
    turns, rest = root_turns(start, spreads, unknowns, betas, poses)
    chain = lambda r, t: skinning.joint_transforms(rest, start.parents, r, t)
    transforms = jnp.einsum("mab,mjbc->mjac", turns, jax.vmap(chain)(poses.rotations, poses.translation))

    features = jax.vmap(pose_features)(poses.rotations)

    def seen_points(points, frame, matrix):
        posed = pose_points(points, betas, features[frame], transforms[frame])
        return jnp.matmul(posed, matrix[:3, :3].T, precision=skinning.EXACT) + matrix[:3, 3]

    def silhouette(points, matches, frame, own_K, matrix):
        seen = seen_points(points, frame, matrix)
        focal, depth = jnp.stack([own_K[0, 0], own_K[1, 1]]), jnp.maximum(seen[:, 2:], NEAR)
        clothes = thickness(start, spreads, unknowns, points.weights) * focal.mean() / depth[:, 0]
        pixels, cuts = seen[:, :2] / depth * focal + own_K[:2, 2], (evidence.cuts[0], evidence.cuts[1])
        return silhouette_residuals(matches, pixels, clothes, evidence.noise, cuts, independent)

    parts = {"silhouettes": jax.vmap(silhouette)(evidence.points, evidence.matches, start.frame, K, cam_from_world)}
    if model is not None and evidence.keypoints is not None:
        problem, sources = Problem(model, pose_prior(model.joint_names), np.zeros(0, int)), _sources(model, start)
        landmarks = jax.vmap(lambda f, t: jnp.matmul(model.regressor, pose_points(sources, betas, f, t)))(
            features, transforms
        )
        seen = replace(evidence.keypoints, K=K[:, None], cam_from_world=cam_from_world[:, None])
        compare = lambda own, points: keypoint_residuals(problem, own, points, KEYPOINT_CUT)
        parts["keypoints"] = jax.vmap(compare)(seen, landmarks[start.frame])
    return parts


def _sources(model, start):
    """What landmarks are means of, as points of a surface: the joints, each moved by itself alone, and vertices."""
    joints, coefficients = len(start.parents), len(start.betas)
    points, pad = model.points, ((joints, 0), (0, 0), (0, 0))
    return SurfacePoints(
        jnp.concatenate([model.joints, points.rest]),
        jnp.concatenate([model.joint_directions, points.directions])[..., :coefficients],
        None if points.corrections is None else jnp.pad(points.corrections, pad),
        jnp.concatenate([jnp.eye(joints), points.weights]),
    )


@functools.partial(jax.jit, static_argnames=("spreads", "independent", "steps"))
def solve(
    model: LandmarkModel | None,
    start: Start,
    evidence: Evidence,
    unknowns: Unknowns,
    spreads: Spreads,
    independent: float,
    steps: int,
) -> tuple[Unknowns, Outcome]:
    """The unknowns after at most so many steps from the given ones; these, if nothing is better."""
    vector, unravel = ravel_pytree(unknowns)  # one vector in, one out: compiles in half the time of trees

    def residuals(y):
        moved = unravel(y)
        parts = evidence_residuals(model, start, spreads, moved, evidence, independent)
        clothes = jnp.where(moved.clothes < 0, BARE * moved.clothes, moved.clothes)
        return ravel_pytree((parts, replace(moved, clothes=clothes)))[0]

    if vector.size > DENSE:
        solution, outcome = minimise(residuals, vector, PATIENCE * steps)
    else:
        solution, outcome = least_squares(residuals, vector, steps)
    return unravel(solution), outcome
