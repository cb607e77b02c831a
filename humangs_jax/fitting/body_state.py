"""What is sought: shape, place and pose of a body, as arrays of about unit size.

Optimisers take steps of one length in all directions: a shape coefficient, a tenth of a metre, and a joint's usual spread are 1.
"""

import jax.numpy as jnp
import numpy as np

from humangs_jax.body.model import BodyPose
from humangs_jax.core.array_types import Array, Float
from humangs_jax.core.pytree import pytree_dataclass
from humangs_jax.fitting.pose_prior import PosePrior

METRE = 0.1
"""A step of 1 in the translation, metres."""
HEADING = 0.3
"""A step of 1 in the orientation of the root, radians."""


@pytree_dataclass
class BodyState:
    """A body in numbers of about unit size. betas: (s,). heading: (3,). place: (3,). bends: (a, 3) of a joints."""

    betas: Float[Array, " s"]
    heading: Float[Array, "3"]
    place: Float[Array, "3"]
    bends: Float[Array, "a 3"]


def state_of(prior: PosePrior, joints: np.ndarray, betas: Float[Array, " s"], pose: BodyPose) -> BodyState:
    """The state of a pose whose free joints (besides the root) are `joints` (a,)."""
    bends = (pose.rotations[joints] - prior.usual[joints]) / prior.spread[joints]
    return BodyState(betas, pose.rotations[0] / HEADING, pose.translation / METRE, bends)


def pose_of(prior: PosePrior, joints: np.ndarray, state: BodyState) -> BodyPose:
    """The pose of a state; joints that are not free are as the prior has them usually."""
    rotations = jnp.asarray(prior.usual).at[joints].set(prior.usual[joints] + prior.spread[joints] * state.bends)
    return BodyPose(rotations.at[0].set(HEADING * state.heading), METRE * state.place)
