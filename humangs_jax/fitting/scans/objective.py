"""Residuals of a body against a scan, in standard deviations, for pairs of a body vertex and a scan point that are kept fixed.

Of a pair, d = n . (scan point - body vertex) is the distance by which the scan is outside of the skin, n the normal of the
surface that was searched for the partner. On a bare person d is noise on both sides. Clothes are outside: d > 0 is usual and
counts lightly; d < 0 says that the body pokes out of its clothes, and counts fully. Hands are usually bare, so that
they count fully on both sides. Pairs that are far apart fade out by their weights, which `rounds` sets anew in every round.
"""

import jax.numpy as jnp
import numpy as np

from humangs_jax.body.model import BodyPose
from humangs_jax.core.array_types import Array, Float, Int
from humangs_jax.core.pytree import pytree_dataclass, static_field
from humangs_jax.fitting.body_state import BodyState, pose_of
from humangs_jax.fitting.objective import LIMIT_STIFFNESS, robust
from humangs_jax.fitting.pose_prior import PosePrior, pose_prior
from humangs_jax.fitting.scans.body_surface import BodySurface, pose_vertices

SIZE = 0.05
"""A step of 1 in the logarithm of the scan's scale."""
JOINT_CUT = 4.0
"""Standard deviations at which a given joint is taken to be wrong."""


@pytree_dataclass
class ScanState:
    """What is sought: the body in the scan's frame, and the logarithm of the metres per unit of that frame, about unit size."""

    body: BodyState
    size: Float[Array, ""]


@pytree_dataclass
class Matches:
    """r pairs. rows: (r,) vertices of the body. points, normals: (r, 3) in the scan's frame. outside: (r,) standard deviation
    of positive distances. weights: (r,), 0: no pair.
    """

    rows: Int[Array, " r"]
    points: Float[Array, "r 3"]
    normals: Float[Array, "r 3"]
    outside: Float[Array, " r"]
    weights: Float[Array, " r"]

    @classmethod
    def none(cls) -> "Matches":
        """One pair without weight."""
        return cls(jnp.zeros(1, jnp.int32), jnp.zeros((1, 3)), jnp.zeros((1, 3)), jnp.ones(1), jnp.zeros(1))


@pytree_dataclass
class Given:
    """Known landmarks. points: (k, 3) in the scan's frame. weights: (k,) 0: not known. spread: () metres. height: () metres
    of stature, and height_weight: () 1 if it is known, else 0.
    """

    points: Float[Array, "k 3"]
    weights: Float[Array, " k"]
    spread: Float[Array, ""]
    height: Float[Array, ""]
    height_weight: Float[Array, ""]


@pytree_dataclass
class Tolerances:
    """Each (). inside, outside: standard deviations of d on either side, in units of the frame, about metres; outside where the
    skin is usually covered. prior: weight of the pose's, 1: as it is.
    """

    inside: Float[Array, ""]
    outside: Float[Array, ""]
    prior: Float[Array, ""]


@pytree_dataclass
class ScanProblem:
    """What stays the same. surface: of the body. Static: joints, which are free besides the root; ends, the highest and the
    lowest vertex at rest.
    """

    surface: BodySurface
    joints: tuple[int, ...] = static_field(default=())
    ends: tuple[int, int] = static_field(default=(0, 0))

    @property
    def prior(self) -> PosePrior:
        """Of the body's joints."""
        return pose_prior(self.surface.landmarks.joint_names)

    def pose(self, state: ScanState) -> BodyPose:
        """The pose in the scan's frame."""
        return pose_of(self.prior, np.asarray(self.joints), state.body)


def scan_problem(surface: BodySurface, names: tuple[str, ...]) -> ScanProblem:
    """With those joints free that have these names."""
    model = surface.landmarks
    joints = tuple(j for j, name in enumerate(model.joint_names) if j > 0 and name in names)
    height = np.asarray(surface.points.rest)[:, 1]
    return ScanProblem(surface, joints, (int(height.argmax()), int(height.argmin())))


def scale_of(state: ScanState) -> Float[Array, ""]:
    """Metres per unit of the scan's frame."""
    return jnp.exp(SIZE * state.size)


def scan_residuals(
    problem: ScanProblem, matches: Matches, given: Given, tolerances: Tolerances, state: ScanState
) -> dict[str, Float[Array, "..."]]:
    """All residuals by what they are of."""
    rows, joints, body = matches.rows, np.asarray(problem.joints), state.body
    prior, pose = problem.prior, problem.pose(state)
    vertices, landmarks, _ = pose_vertices(problem.surface, rows, body.betas, pose)
    # in the scan's frame: in metres, a smaller scan would be nearer
    apart = matches.points - vertices / scale_of(state)
    # Term by term: of `jnp.sum(normals * apart, axis=-1)` XLA's CPU compiler (jaxlib 0.10.2) makes wrong Jacobians under jacfwd
    along = matches.normals * apart
    away = along[:, 0] + along[:, 1] + along[:, 2]
    turned = pose.rotations[joints]
    beyond = jnp.maximum(prior.least[joints] - turned, turned - prior.greatest[joints])
    off = (landmarks / scale_of(state) - given.points) / given.spread
    return {
        "surface": jnp.sqrt(matches.weights) * one_sided(away, matches.outside, tolerances.inside),
        "joints": jnp.sqrt(given.weights)[:, None] * robust(off, JOINT_CUT),
        "pose": tolerances.prior * body.bends,
        "limits": LIMIT_STIFFNESS * jnp.maximum(beyond, 0.0),
        "shape": body.betas,
        "height": given.height_weight * (_stature(problem, body.betas) - given.height) / HEIGHT_SPREAD,
    }


HEIGHT_SPREAD = 0.01
"""Metres: how well people know their height."""


def one_sided(away: Float[Array, " r"], outside: Float[Array, " r"], inside: Float[Array, ""]) -> Float[Array, " r"]:
    """Distances (r,), positive outside, in standard deviations of either side."""
    return away / jnp.where(away > 0, outside, inside)


def _stature(problem, betas):
    top, bottom = problem.ends
    points = problem.surface.points
    height = lambda i: points.rest[i, 1] + points.directions[i, 1, : betas.shape[0]] @ betas
    return height(top) - height(bottom)
