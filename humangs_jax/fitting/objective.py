"""Residuals of a body against keypoints, in standard deviations: half their square sum is the negative log posterior.

Keypoints are compared in pixels by Geman and McClure's robust loss, whose square root is r = e c / sqrt(c^2 + |e|^2): like e near
0, no more than c far off, so that a point on somebody else pulls no harder than one a little off.
"""

import dataclasses

import jax.numpy as jnp
import numpy as np

from humangs_jax.body.landmarks import LandmarkModel, pose_landmarks
from humangs_jax.core.array_types import Array, Bool, Float
from humangs_jax.core.pytree import pytree_dataclass
from humangs_jax.fitting.body_state import BodyState, pose_of
from humangs_jax.fitting.observations import Observations
from humangs_jax.fitting.pose_prior import PosePrior

NEAR = 0.05
"""Metres: points nearer to a camera, or behind it, are taken to be so far."""
LIMIT_STIFFNESS = 20.0
"""Standard deviations per radian beyond a joint's limit: 3 degrees count as much as one."""
LESS_CERTAIN = {"hip": 2.0, "shoulder": 1.5, "neck": 1.5, "mid_hip": 1.5, "ear": 1.5}
"""Annotators do not agree on where these are by more than on others; multiples of the noise."""


@dataclasses.dataclass(frozen=True, eq=False)
class Problem:
    """What stays the same while a body is fitted: landmarks, prior, free joints besides the root, weights of the priors."""

    model: LandmarkModel
    prior: PosePrior
    joints: np.ndarray
    pose_weight: float = 1.0
    shape_weight: float = 1.0

    @property
    def known(self) -> np.ndarray:
        """(k,) 1 for landmarks that the body has."""
        return np.asarray(self.model.known, np.float32)


@pytree_dataclass
class Targets:
    """Triangulated landmarks: points (k, 3) metres; known: (k,) their weights; pixel: () metres that a pixel is there."""

    points: Float[Array, "k 3"]
    known: Float[Array, " k"] | Bool[Array, " k"]
    pixel: Float[Array, ""]


def landmark_certainty(names: tuple[str, ...]) -> Float[np.ndarray, " k"]:
    """(k,) by how much less a landmark counts than a well-defined one, in (0, 1]."""
    kind = lambda name: name.split("_", 1)[1] if name.startswith(("left_", "right_")) else name
    return np.asarray([1 / LESS_CERTAIN.get(kind(name), 1.0) for name in names], np.float32)


def keypoint_errors(observations: Observations, landmarks: Float[Array, "k 3"]) -> Float[Array, "c k 2"]:
    """Landmarks as the views show them less the detections, pixels."""
    rotation, translation = observations.cam_from_world[:, :3, :3], observations.cam_from_world[:, :3, 3]
    seen = jnp.einsum("cab,kb->cka", rotation, landmarks) + translation[:, None]
    depth = jnp.maximum(seen[..., 2:], NEAR)
    focal = jnp.stack([observations.K[:, 0, 0], observations.K[:, 1, 1]], axis=-1)[:, None]
    return seen[..., :2] / depth * focal + observations.K[:, None, :2, 2] - observations.points


def robust(errors: Float[Array, "*n d"], cut: Float[Array, ""] | float) -> Float[Array, "*n d"]:
    """Residuals whose square is Geman and McClure's loss of the errors' length."""
    return errors * (cut / jnp.sqrt(cut * cut + jnp.sum(jnp.square(errors), axis=-1, keepdims=True)))


def keypoint_residuals(problem: Problem, observations: Observations, landmarks, cut) -> Float[Array, "c k 2"]:
    """In standard deviations; cut: where the loss flattens, in standard deviations."""
    certainty = landmark_certainty(problem.model.names)[:, None]
    errors = keypoint_errors(observations, landmarks) / observations.noise * certainty
    weights = observations.confidences * problem.known
    return jnp.where(weights > 0, jnp.sqrt(jnp.where(weights > 0, weights, 1.0)), 0.0)[..., None] * robust(errors, cut)


def prior_residuals(problem: Problem, state: BodyState) -> tuple[Float[Array, "a 3"], Float[Array, "a 3"]]:
    """Of the pose: distances from what is usual, and from the limits."""
    rows = problem.joints
    rotations = pose_of(problem.prior, rows, state).rotations[rows]
    beyond = jnp.maximum(problem.prior.least[rows] - rotations, rotations - problem.prior.greatest[rows])
    return problem.pose_weight * state.bends, LIMIT_STIFFNESS * jnp.maximum(beyond, 0.0)


def residuals(
    problem: Problem,
    observations: Observations,
    state: BodyState,
    cut: Float[Array, ""] | float,
    targets: Targets | None = None,
) -> dict[str, Float[Array, "..."]]:
    """All residuals of one moment, by what they are of."""
    landmarks, _ = pose_landmarks(problem.model, state.betas, pose_of(problem.prior, problem.joints, state))
    usual, limits = prior_residuals(problem, state)
    found = {
        "keypoints": keypoint_residuals(problem, observations, landmarks, cut),
        "pose": usual,
        "limits": limits,
        "shape": problem.shape_weight * state.betas,
    }
    if targets is not None:
        known = (targets.known * problem.known)[:, None]
        found["points"] = known * robust((landmarks - targets.points) / (targets.pixel * observations.noise), cut)
    return found
