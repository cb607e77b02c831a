"""A body through keypoints: rigid, body, hands, then all moments together with one shape. Pure; vmap it over people.

    rigid   place and heading of a resting body, from the best of several starts
    points  body joints and shape against triangulated points; skipped by moments that have none
    body    the same against the keypoints of every view
    hands   all joints that a keypoint depends on, outliers cut off closer
    person  all moments at once: one shape, the noise that was found, and smooth motion where asked for

The first four are one program that runs with other weights and other unknowns held still: compiling is what takes time here.
"""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np

from humangs_jax.body.joints import BODY_NAMES
from humangs_jax.body.landmarks import LandmarkModel, pose_landmarks
from humangs_jax.body.model import BodyPose
from humangs_jax.core.array_types import Array, Float
from humangs_jax.core.pytree import pytree_dataclass, replace
from humangs_jax.fitting.body_state import BodyState, pose_of, state_of
from humangs_jax.fitting.objective import Problem, Targets, keypoint_errors, residuals
from humangs_jax.fitting.observations import Observations
from humangs_jax.fitting.pose_prior import pose_prior
from humangs_jax.fitting.rigid import rigid_starts, trunk_weights
from humangs_jax.fitting.solvers import Outcome, minimise
from humangs_jax.fitting.triangulation import triangulate_robustly

STAGES = ("rigid", "points", "body", "hands")


@dataclasses.dataclass(frozen=True)
class FitConfig:
    """Static settings of a fit.

    pose_weight, shape_weight: of the priors, 1: one standard deviation of them counts like one of a keypoint. cuts: standard
    deviations at which a keypoint, in the stages rigid, points, body, hands and person, is an outlier. smoothness: expected
    acceleration of joints, metres per moment squared; 0: moments are independent. steps, person_steps: most iterations of a
    stage. starts: headings that are followed up, for one view and for several. tolerance: of the unknowns, which are of unit
    size, at which a stage has converged.
    """

    pose_weight: float = 1.0
    shape_weight: float = 1.0
    cuts: tuple[float, float, float, float, float] = (30.0, 15.0, 15.0, 10.0, 5.0)
    smoothness: float = 0.0
    steps: int = 150
    person_steps: int = 150
    starts: tuple[int, int] = (4, 2)
    tolerance: float = 3e-4


@pytree_dataclass
class LandmarkFit:
    """A person in m moments. betas: (s,). poses: a batch of m. landmarks: (m, k, 3), joints: (m, j, 3) metres.

    noise: (m,) standard deviation of the detections as the fit found it, pixels.
    outcomes: what the solver did, by stage; of each moment, but of "person", which has all moments.
    """

    betas: Float[Array, " s"]
    poses: BodyPose
    landmarks: Float[Array, "m k 3"]
    joints: Float[Array, "m j 3"]
    noise: Float[Array, " m"]
    outcomes: dict[str, Outcome]


@functools.partial(jax.jit, static_argnames="config")
def fit_landmarks(model: LandmarkModel, observations: Observations, config: FitConfig = FitConfig()) -> LandmarkFit:
    """Shape and poses of one person.

    Arguments: observations: a batch of m moments. Returns a fit without numbers that are not finite, whatever the
    observations are; moments without any keypoint rest where the prior has them.
    """
    problem = fit_problem(model, config)
    states, outcomes = jax.vmap(lambda seen: _fit_moment(problem, seen, config))(observations)
    observations = replace(observations, noise=_noise_found(problem, observations, states))
    betas, states, outcomes["person"] = _fit_person(problem, observations, states, config)
    poses = jax.vmap(lambda state: pose_of(problem.prior, problem.joints, state))(states)
    landmarks, joints = jax.vmap(lambda pose: pose_landmarks(model, betas, pose))(poses)
    return LandmarkFit(betas, poses, landmarks, joints, observations.noise, outcomes)


def fit_problem(model: LandmarkModel, config: FitConfig = FitConfig()) -> Problem:
    """The problem in which all joints are free that move a landmark; the others rest as is usual."""
    joints = np.asarray([j for j in model.movers if j > 0], int)
    return Problem(model, pose_prior(model.joint_names), joints, config.pose_weight, config.shape_weight)


def _fit_moment(problem, seen, config):
    """Stages rigid to hands of one moment, from several starts; the best by its keypoints."""
    several = seen.points.shape[0] > 1
    points, counts, weights = triangulate_robustly(seen)
    betas = jnp.zeros(problem.model.joint_directions.shape[-1])
    resting = state_of(problem.prior, problem.joints, betas, BodyPose(jnp.asarray(problem.prior.usual), jnp.zeros(3)))
    starts = rigid_starts(problem, seen, points, counts, resting, config.starts[several])
    stages = _stages(problem, resting, config, Targets(points, counts >= 2, _metres_per_pixel(seen, points, weights)))
    states, outcomes = jax.vmap(lambda start: _run_stages(problem, seen, start, stages, config))(starts)
    best = jnp.argmin(outcomes.after[:, -1])
    state, outcomes = jax.tree.map(lambda leaf: leaf[best], (states, outcomes))
    return state, {name: jax.tree.map(lambda leaf, i=i: leaf[i], outcomes) for i, name in enumerate(STAGES)}


@pytree_dataclass
class _Stage:
    """One run of the solver. views: (k,) weights of keypoints. targets: triangulated points and theirs. free: what moves."""

    views: Float[Array, " k"]
    targets: Targets
    cut: Float[Array, ""]
    free: BodyState


def _stages(problem, resting, config, targets):
    """A batch of the four stages."""
    joints, model = problem.joints, problem.model
    trunk = jnp.asarray(trunk_weights(model.names))
    body = np.asarray([model.joint_names[j] in BODY for j in joints])[:, None]
    ones, none = jnp.ones_like(trunk), jnp.zeros_like(trunk)
    moved = lambda shape, bends: replace(
        resting,
        betas=jnp.full(resting.betas.shape, shape),
        heading=jnp.ones(3, bool),
        place=jnp.ones(3, bool),
        bends=jnp.broadcast_to(jnp.asarray(bends), resting.bends.shape),
    )
    triangulated = jnp.any(targets.known)
    in_space = lambda share: replace(targets, known=targets.known * share)
    cut = lambda stage: jnp.asarray(config.cuts[stage])
    stages = [
        _Stage(trunk, in_space(0.0), cut(0), moved(False, False)),
        _Stage(jnp.where(triangulated, none, ones), in_space(1.0), cut(1), moved(True, body)),
        _Stage(ones, in_space(0.0), cut(2), moved(True, body)),
        _Stage(ones, in_space(0.0), cut(3), moved(True, True)),
    ]
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *stages)


BODY = (*BODY_NAMES, "jaw")
"""Joints that move before the hands do."""


def _run_stages(problem, seen, start, stages, config):
    """All stages one after the other, each from where the last ended. Returns the state and outcomes of each."""

    def run(state, stage):
        still = state
        hold = lambda y: jax.tree.map(jnp.where, stage.free, y, still)
        weighted = replace(seen, confidences=seen.confidences * stage.views)
        objective = lambda y: residuals(problem, weighted, hold(y), stage.cut, stage.targets)
        state, outcome = minimise(objective, state, config.steps, tolerance=config.tolerance)
        return hold(state), outcome

    return jax.lax.scan(run, start, stages)


def _noise_found(problem, observations, states):
    """(m,) pixels, from the median error, which outliers hardly touch; within bounds about what was expected."""

    def moment(seen, state):
        landmarks, _ = pose_landmarks(problem.model, state.betas, pose_of(problem.prior, problem.joints, state))
        lengths = jnp.linalg.norm(keypoint_errors(seen, landmarks), axis=-1)
        found = jnp.nanmedian(jnp.where(seen.confidences * problem.known > 0, lengths, jnp.nan)) / RAYLEIGH_MEDIAN
        return jnp.clip(jnp.nan_to_num(found, nan=seen.noise), NOISE_RANGE[0] * seen.noise, NOISE_RANGE[1] * seen.noise)

    return jax.vmap(moment)(observations, states)


RAYLEIGH_MEDIAN = 1.1774
"""Median length of a vector whose two components have a standard deviation of 1."""
NOISE_RANGE = (0.5, 8.0)
"""Multiples of the expected noise."""


def _fit_person(problem, observations, states, config):
    """All moments at once with one shape, and smooth motion."""
    parts = lambda state: {name: getattr(state, name) for name in ("heading", "place", "bends")}
    m = len(observations.noise)

    def all_residuals(y):
        shape, poses = y
        each = jax.vmap(lambda seen, own: residuals(problem, seen, BodyState(betas=shape, **own), config.cuts[-1]))
        found = each(observations, poses)
        found["shape"] = problem.shape_weight * shape  # one person has one shape, whatever the number of moments
        if config.smoothness and m > 2:
            found["motion"] = _acceleration(problem, shape, poses) / config.smoothness
        return found

    start = (jnp.median(states.betas, axis=0), parts(states))
    (betas, free), outcome = minimise(all_residuals, start, config.person_steps, tolerance=config.tolerance)
    return betas, replace(states, betas=jnp.broadcast_to(betas, (m, *betas.shape)), **free), outcome


def _acceleration(problem, betas, poses):
    """(m - 2, j, 3) second differences of the joints over moments, metres."""
    pose = lambda own: pose_of(problem.prior, problem.joints, BodyState(betas=betas, **own))
    joints = jax.vmap(lambda own: pose_landmarks(problem.model, betas, pose(own))[1])(poses)
    return joints[2:] - 2 * joints[1:-1] + joints[:-2]


def _metres_per_pixel(seen, points, weights):
    """How large a pixel is where the person is."""
    centers = -jnp.einsum("cba,cb->ca", seen.cam_from_world[:, :3, :3], seen.cam_from_world[:, :3, 3])
    distance = jnp.linalg.norm(points - centers[:, None], axis=-1)
    each = distance / seen.K[:, :1, 0]
    return jnp.sum(weights * each) / jnp.maximum(jnp.sum(weights), 1e-6) + 1e-4
