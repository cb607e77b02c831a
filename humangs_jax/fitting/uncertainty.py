"""How well a fit is known: the Gauss-Newton covariance at the solution.

With residuals r in standard deviations and J their derivatives by the unknowns, J^T J is the information. All frames share one
shape, so J^T J is an arrow: blocks of the frames plus the row and column of the shape. It is inverted by the Schur complement of
the shape. The covariance holds at a minimum and for independent errors of the keypoints.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np

from humangs_jax.body.landmarks import LandmarkModel
from humangs_jax.core.array_types import Float
from humangs_jax.core.pytree import pytree_dataclass, replace
from humangs_jax.fitting.landmark_fit import FitConfig, LandmarkFit, keypoint_problem
from humangs_jax.fitting.residuals.keypoints import Observations, frame_residuals

UNSEEN = 1e-8
"""Least information about position and orientation; keeps the inverse finite for frames without keypoints."""


@pytree_dataclass
class Uncertainty:
    """The uncertainty of a fit of m frames (numpy on the host).

    joint_covariances: (m, j, 3, 3) of the joints' positions, square metres. determined: (m, j) share of the prior's variance of
    a joint's rotation, mean over axes, that the views remove: 1 all, 0 nothing, as for joints that no keypoint depends on.
    shape_covariance: (s, s).
    """

    joint_covariances: Float[np.ndarray, "m j 3 3"]
    determined: Float[np.ndarray, "m j"]
    shape_covariance: Float[np.ndarray, "s s"]

    @property
    def joint_std(self) -> Float[np.ndarray, "m j"]:
        """(m, j) metres: root mean square of the expected distance from the true joint."""
        return np.sqrt(np.trace(self.joint_covariances, axis1=-2, axis2=-1))


def fit_uncertainty(
    model: LandmarkModel, observations: Observations, fit: LandmarkFit, config: FitConfig
) -> Uncertainty:
    """The covariance of a fit to these observations, in float64.

    Raises: ValueError if the fit has a different number of frames than the observations.
    """
    m = len(observations.noise)
    if len(fit.noise) != m:
        raise ValueError(f"a fit of {len(fit.noise)} frames, but observations of {m}")
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
    return Uncertainty(covariances, _determined(keypoint_problem(model, config), config, poses), shape_covariance)


def _determined(problem, config, poses):
    """`Uncertainty.determined` from the covariance (m, p, p) of the unknowns, in the order global_orient, transl, body_pose."""
    joints, variances = np.asarray(problem.origin.joints), np.diagonal(poses, axis1=-2, axis2=-1)
    left = variances[:, 6:].reshape(len(poses), len(joints), 3)
    std = np.radians(problem.origin.std.global_orient) * np.sqrt(variances[:, :3])
    determined = np.zeros((len(poses), len(problem.prior.std)))
    determined[:, joints] = 1 - np.clip(left.mean(-1) * config.pose_weight**2, 0, 1)
    determined[:, 0] = 1 - np.clip((std / np.pi).max(-1), 0, 1)
    return determined


@functools.partial(jax.jit, static_argnames="config")
def _derivatives(model, observations, fit, config):
    """Derivatives of the residuals (m, r, .) and of the joints (m, j, 3, .), by pose and by shape."""
    problem = keypoint_problem(model, config)

    def both(seen, vector, betas):
        pose = {"global_orient": vector[:3], "transl": vector[3:6], "body_pose": vector[6:].reshape(-1, 3)}
        state = replace(fit.state, betas=betas, **pose)
        found = frame_residuals(problem, seen, state, config.robust_scales[-1])
        found.pop("shape")
        positions = problem.landmarks_and_joints(state)[1]
        return jnp.concatenate([leaf.ravel() for leaf in found.values()]), positions

    def frame(seen, own):
        vector = jnp.concatenate([own.global_orient, own.transl, own.body_pose.ravel()])
        (by_pose, by_shape), (joints_by_pose, joints_by_shape) = jax.jacfwd(both, argnums=(1, 2))(
            seen, vector, own.betas
        )
        return by_pose, by_shape, joints_by_pose, joints_by_shape

    m = len(observations.noise)
    own = replace(fit.state, betas=jnp.broadcast_to(fit.state.betas, (m, *fit.state.betas.shape)))
    return jax.lax.map(lambda x: frame(*x), (observations, own))
