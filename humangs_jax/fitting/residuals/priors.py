"""Priors of poses: the usual rotation of every joint, its standard deviation, and its limits.

Rotation vectors of SMPL-X's joints, by name, in radians about the axes of the T-pose: x to the person's left, y up, z forward.
Limits are boxes of rotation vectors, generous where axes mix (hips, shoulders). Written for the left side; the right is its
mirror image (x, -y, -z). Signs: a knee bends about +x, the left elbow about -y, left fingers about -z; the left arm hangs at
z = -1.4 and is above the head at z = +1.4.
"""

import dataclasses

import jax.numpy as jnp
import numpy as np

from humangs_jax.body.joints import FINGERS
from humangs_jax.core.array_types import Array, Float

MIRROR = np.asarray([1.0, -1.0, -1.0])
"""The rotation vector of the mirrored rotation."""
FREE = np.pi
"""Radians: a component without a limit of its own."""
LIMIT_STIFFNESS = 20.0
"""Standard deviations per radian beyond a joint's limit: 3 degrees count as much as one."""


@dataclasses.dataclass(frozen=True)
class Range:
    """Statistics of a joint's rotation vector, (3,) each: mean, standard deviation, lower and upper limit."""

    mean: tuple[float, float, float]
    std: tuple[float, float, float]
    lower: tuple[float, float, float]
    upper: tuple[float, float, float]


_SPINE = Range((0.03, 0.0, 0.0), (0.2, 0.15, 0.15), (-0.5, -0.5, -0.5), (0.8, 0.5, 0.5))
_NECK = Range((0.0, 0.0, 0.0), (0.25, 0.3, 0.2), (-0.8, -0.9, -0.6), (0.8, 0.9, 0.6))
_THUMB = Range((0.1, 0.15, -0.05), (0.3, 0.3, 0.3), (-0.8, -0.9, -1.0), (0.8, 1.2, 0.8))
_FINGER = Range((0.0, 0.0, -0.35), (0.1, 0.1, 0.5), (-0.4, -0.4, -1.9), (0.4, 0.4, 0.4))
_KNUCKLE = Range((0.0, 0.0, -0.3), (0.15, 0.2, 0.5), (-0.5, -0.6, -1.8), (0.5, 0.6, 0.6))

RANGES = {
    "pelvis": Range((0.0, 0.0, 0.0), (1.0, 1.0, 1.0), (-FREE, -FREE, -FREE), (FREE, FREE, FREE)),
    "spine1": _SPINE,
    "spine2": _SPINE,
    "spine3": _SPINE,
    "neck": _NECK,
    "head": _NECK,
    "left_hip": Range((-0.2, 0.05, 0.05), (0.6, 0.3, 0.3), (-2.6, -1.2, -0.8), (0.8, 1.2, 1.6)),
    "left_knee": Range((0.4, 0.0, 0.0), (0.6, 0.08, 0.08), (-0.15, -0.25, -0.25), (2.7, 0.25, 0.25)),
    "left_ankle": Range((-0.1, 0.0, 0.0), (0.3, 0.15, 0.2), (-1.0, -0.6, -0.7), (1.0, 0.6, 0.7)),
    "left_foot": Range((0.0, 0.0, 0.0), (0.3, 0.05, 0.05), (-1.2, -0.2, -0.2), (0.5, 0.2, 0.2)),
    "left_collar": Range((0.0, 0.0, 0.0), (0.1, 0.12, 0.15), (-0.3, -0.5, -0.4), (0.3, 0.5, 0.7)),
    "left_shoulder": Range((0.0, -0.1, -0.8), (0.5, 0.6, 0.7), (-1.8, -2.4, -2.0), (1.8, 1.5, 2.0)),
    "left_elbow": Range((0.0, -0.5, 0.0), (0.35, 0.7, 0.2), (-1.3, -2.7, -0.7), (1.3, 0.15, 0.7)),
    "left_wrist": Range((0.0, 0.0, 0.0), (0.3, 0.3, 0.4), (-0.9, -0.8, -1.4), (0.9, 0.8, 1.4)),
    "jaw": Range((0.0, 0.0, 0.0), (0.1, 0.03, 0.03), (-0.1, -0.2, -0.2), (0.6, 0.2, 0.2)),
    "left_eye": Range((0.0, 0.0, 0.0), (0.1, 0.1, 0.03), (-0.5, -0.6, -0.2), (0.5, 0.6, 0.2)),
    **{f"left_thumb{k}": _THUMB for k in (1, 2, 3)},
    **{f"left_{finger}1": _KNUCKLE for finger in FINGERS if finger != "thumb"},
    **{f"left_{finger}{k}": _FINGER for finger in FINGERS if finger != "thumb" for k in (2, 3)},
}
"""Ranges of everyday movement; wider than measured joint angles, because components of a rotation vector are not joint angles."""


@dataclasses.dataclass(frozen=True, eq=False)
class PosePrior:
    """Arrays (j, 3) in the order of a body's joints, radians. The root's are not used: every orientation is as likely."""

    mean: Float[np.ndarray, "j 3"]
    std: Float[np.ndarray, "j 3"]
    lower: Float[np.ndarray, "j 3"]
    upper: Float[np.ndarray, "j 3"]


def pose_prior(joint_names: tuple[str, ...]) -> PosePrior:
    """The prior of a body. Joints with other names than SMPL-X's have mean 0, std 0.3 rad and no limits."""
    unknown = Range((0.0, 0.0, 0.0), (0.3, 0.3, 0.3), (-FREE, -FREE, -FREE), (FREE, FREE, FREE))
    rows = [_range_of(name, unknown) for name in joint_names]
    return PosePrior(*(np.stack([row[i] for row in rows]).astype(np.float32) for i in range(4)))


def limit_residuals(prior: PosePrior, joints: tuple[int, ...], rotations: Float[Array, "j 3"]) -> Float[Array, "a 3"]:
    """How far joints turn beyond their limits, in standard deviations."""
    rows = np.asarray(joints, int)
    turned = rotations[rows]
    beyond = jnp.maximum(prior.lower[rows] - turned, turned - prior.upper[rows])
    return LIMIT_STIFFNESS * jnp.maximum(beyond, 0.0)


def violations(
    prior: PosePrior, rotations: Float[np.ndarray, "j 3"], slack: float = 0.05
) -> list[tuple[int, int, float]]:
    """(joint, axis, radians beyond the limit) of all components that exceed their limit by more than `slack` radians."""
    beyond = np.maximum(prior.lower - rotations, rotations - prior.upper)
    return [(int(j), int(a), float(beyond[j, a])) for j, a in np.argwhere(beyond > slack)]


def _range_of(name, unknown):
    if not name.startswith("right_"):
        own = RANGES.get(name, unknown)
        return [np.asarray(x, float) for x in (own.mean, own.std, own.lower, own.upper)]
    mean, std, lower, upper = _range_of(name.replace("right_", "left_", 1), unknown)
    ends = np.sort(np.stack([MIRROR * lower, MIRROR * upper]), axis=0)
    return [MIRROR * mean, std, ends[0], ends[1]]
