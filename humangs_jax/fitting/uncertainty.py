"""How well a fit is known: the covariance of Gauss and Newton at the solution.

With residuals r in standard deviations and J their derivatives by the unknowns, J^T J is the information. One shape is shared by
all moments, so that it is an arrow: blocks of the moments, and the shape's row and column, inverted by the Schur complement of
the shape. What comes out assumes that the fit is at its minimum and that keypoints err independently.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np

from humangs_jax.body.landmarks import LandmarkModel, pose_landmarks
from humangs_jax.core.array_types import Float
from humangs_jax.core.pytree import pytree_dataclass, replace
from humangs_jax.fitting.body_state import HEADING, BodyState, pose_of, state_of
from humangs_jax.fitting.landmark_fit import FitConfig, LandmarkFit, fit_problem
from humangs_jax.fitting.objective import residuals
from humangs_jax.fitting.observations import Observations

UNSEEN = 1e-8
"""Information about place and heading that nobody has: a kilometre, and any direction."""


@pytree_dataclass
class Uncertainty:
    """Of m moments (numpy on the host).

    joint_covariances: (m, j, 3, 3) of the joints' positions, square metres. rotation_deviations: (m, j, 3) radians, standard
    deviations of the rotation vectors. determined: (m, j) share of the prior's variance of a joint's rotation, mean over axes,
    that the views have removed: 1 all, 0 nothing, as for joints that no keypoint depends on.
    shape_covariance: (s, s).
    """

    joint_covariances: Float[np.ndarray, "m j 3 3"]
    rotation_deviations: Float[np.ndarray, "m j 3"]
    determined: Float[np.ndarray, "m j"]
    shape_covariance: Float[np.ndarray, "s s"]

    @property
    def joint_deviations(self) -> Float[np.ndarray, "m j"]:
        """(m, j) metres: root mean square of the distance that a joint is expected to be off."""
        return np.sqrt(np.trace(self.joint_covariances, axis1=-2, axis2=-1))


def fit_uncertainty(
    model: LandmarkModel, observations: Observations, fit: LandmarkFit, config: FitConfig
) -> Uncertainty:
    """The covariance of a fit to these observations, in float64.

    Raises: ValueError if the fit has another number of moments than the observations.
    """
    m = len(observations.noise)
    if len(fit.noise) != m:
        raise ValueError(f"a fit of {len(fit.noise)} moments, but observations of {m}")
    by_pose, by_shape, joints_by_pose, joints_by_shape = (
        np.asarray(x, np.float64) for x in _derivatives(model, replace(observations, noise=fit.noise), fit, config)
    )
    information = np.einsum("mra,mrb->mab", by_pose, by_pose) + UNSEEN * np.eye(by_pose.shape[-1])
    coupling = np.einsum("mra,mrs->mas", by_pose, by_shape)
    own = np.linalg.inv(information)
    carried = own @ coupling
    shapes = by_shape.shape[-1]
    shape_information = np.einsum("mrs,mrt->st", by_shape, by_shape) - np.einsum("mas,mat->st", coupling, carried)
    shape_covariance = np.linalg.inv(shape_information + config.shape_weight**2 * np.eye(shapes))
    poses = own + carried @ shape_covariance @ carried.swapaxes(-1, -2)
    cross = -carried @ shape_covariance
    mixed = np.einsum("mjap,mps,mjbs->mjab", joints_by_pose, cross, joints_by_shape)
    covariances = (
        np.einsum("mjap,mpq,mjbq->mjab", joints_by_pose, poses, joints_by_pose)
        + mixed
        + mixed.swapaxes(-1, -2)
        + np.einsum("mjas,st,mjbt->mjab", joints_by_shape, shape_covariance, joints_by_shape)
    )
    return _by_joint(fit_problem(model, config), config, covariances, poses, shape_covariance)


def _by_joint(problem, config, covariances, poses, shape_covariance):
    """Variances of the unknowns, in the order heading, place, bends, sorted by joint."""
    prior = problem.prior
    m, j = covariances.shape[:2]
    variances = np.diagonal(poses, axis1=-2, axis2=-1)
    left = variances[:, 6:].reshape(m, len(problem.joints), 3)
    deviations = np.broadcast_to(prior.spread, (m, j, 3)).copy()
    deviations[:, problem.joints] = prior.spread[problem.joints] * np.sqrt(left)
    deviations[:, 0] = HEADING * np.sqrt(variances[:, :3])
    determined = np.zeros((m, j))
    determined[:, problem.joints] = 1 - np.clip(left.mean(-1) * config.pose_weight**2, 0, 1)
    determined[:, 0] = 1 - np.clip((deviations[:, 0] / np.pi).max(-1), 0, 1)
    return Uncertainty(covariances, deviations, determined, shape_covariance)


@functools.partial(jax.jit, static_argnames="config")
def _derivatives(model, observations, fit, config):
    """Of the residuals (m, r, .) and of the joints (m, j, 3, .), by heading, place and bends, and by the shape."""
    problem = fit_problem(model, config)
    joints = problem.joints

    def both(seen, vector, betas):
        state = BodyState(betas=betas, heading=vector[:3], place=vector[3:6], bends=vector[6:].reshape(-1, 3))
        found = residuals(problem, seen, state, config.cuts[-1])
        found.pop("shape")
        positions = pose_landmarks(model, betas, pose_of(problem.prior, joints, state))[1]
        return jnp.concatenate([leaf.ravel() for leaf in found.values()]), positions

    def moment(seen, pose):
        state = state_of(problem.prior, joints, fit.betas, pose)
        vector = jnp.concatenate([state.heading, state.place, state.bends.ravel()])
        (by_pose, by_shape), (joints_by_pose, joints_by_shape) = jax.jacfwd(both, argnums=(1, 2))(
            seen, vector, fit.betas
        )
        return by_pose, by_shape, joints_by_pose, joints_by_shape

    return jax.lax.map(lambda x: moment(*x), (observations, fit.poses))
