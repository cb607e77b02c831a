"""Joints, their limits, rotations as numpy arrays (float64), forward kinematics, and inverse kinematics of legs.

Joints in SMPL-X order, T-pose at rest, the person faces +z with the left side at +x. Angles in radians, about the axes of the
parent joint at rest.
"""

import dataclasses

import numpy as np
from scipy.spatial.transform import Rotation

from humangs_jax.core.array_types import Float

Rotations = Float[np.ndarray, "j 3"]
"""Rotation vectors of all joints, relative to their parents."""
Vector = Float[np.ndarray, "3"]
Matrix = Float[np.ndarray, "3 3"]

PELVIS, LEFT_HIP, RIGHT_HIP, SPINE1, LEFT_KNEE, RIGHT_KNEE, SPINE2, LEFT_ANKLE, RIGHT_ANKLE, SPINE3 = range(10)
LEFT_FOOT, RIGHT_FOOT, NECK, LEFT_COLLAR, RIGHT_COLLAR, HEAD = range(10, 16)
LEFT_SHOULDER, RIGHT_SHOULDER, LEFT_ELBOW, RIGHT_ELBOW, LEFT_WRIST, RIGHT_WRIST = range(16, 22)
LEFT_EYE, RIGHT_EYE, LEFT_HAND, RIGHT_HAND, JOINTS = 23, 24, 25, 40, 55

FINGER_LIMIT = 1.5
LIMITS = np.asarray([1.0, 1.7, 1.7, 0.35, 2.1, 2.1, 0.35, 0.8, 0.8, 0.35, 0.9, 0.9, 0.5, 0.35, 0.35, 0.5, 2.3, 2.3, 2.4, 2.4,
                     0.8, 0.8, 0, 0, 0, *[FINGER_LIMIT] * 30])  # fmt: skip
"""Largest rotation angle of each joint in the prior; jaw and eyes stay at rest."""

MIRROR = np.asarray([1.0, -1.0, -1.0])
"""The rotation vector of the mirrored rotation (left and right exchanged)."""
BALL_HEIGHT, HEEL_BACK = 0.0112, 0.064
"""Of the shipped body, in lengths of a leg: the joint at the ball of the foot above the sole; the heel behind the ankle."""
REACH = 0.998
"""Largest stretch of a leg as a share of its length: a straight leg leaves the knee's direction undefined."""


@dataclasses.dataclass(frozen=True)
class Build:
    """A body as the prior needs it: rest joints (j, 3), parents, and radii in metres of its clothed parts."""

    joints: Rotations
    parents: tuple[int, ...]
    torso_radius: float
    thigh_radius: float
    shin_radius: float
    arm_radius: float

    @property
    def leg(self) -> float:
        """Length of a leg from hip to ankle, metres."""
        hip, knee, ankle = self.joints[[LEFT_HIP, LEFT_KNEE, LEFT_ANKLE]]
        return float(np.linalg.norm(knee - hip) + np.linalg.norm(ankle - knee))

    @property
    def hip_width(self) -> float:
        """Distance of a hip from the middle, metres."""
        return float(0.5 * (self.joints[LEFT_HIP, 0] - self.joints[RIGHT_HIP, 0]))

    @property
    def sole(self) -> float:
        """Height of the sole in T-pose."""
        return float(self.joints[[LEFT_FOOT, RIGHT_FOOT], 1].mean() - BALL_HEIGHT * self.leg)


def rotation_matrix(vectors: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3 3"]:
    """The rotations of rotation vectors (..., 3)."""
    return Rotation.from_rotvec(vectors.reshape(-1, 3)).as_matrix().reshape(*vectors.shape, 3)


def rotation_vector(matrix: Float[np.ndarray, "*n 3 3"]) -> Float[np.ndarray, "*n 3"]:
    """The rotation vector, no longer than pi, of (..., 3, 3) rotations."""
    return Rotation.from_matrix(matrix.reshape(-1, 3, 3)).as_rotvec().reshape(matrix.shape[:-1])


def between(a: Float[np.ndarray, "*n 3"], b: Float[np.ndarray, "*n 3"], t: float) -> Float[np.ndarray, "*n 3"]:
    """Rotation vectors on the way from a to b, the shortest one, t in [0, 1]."""
    first = rotation_matrix(a)
    step = rotation_vector(np.swapaxes(first, -1, -2) @ rotation_matrix(b))
    return rotation_vector(first @ rotation_matrix(t * step))


def turned(x: float = 0.0, y: float = 0.0, z: float = 0.0) -> Matrix:
    """The rotation about (x, y, z) by its length. About x: legs and feet swing backwards, heels up; about y: to the left."""
    return rotation_matrix(np.asarray([x, y, z], float))


def joint_positions(build: Build, rotations: Rotations) -> tuple[Float[np.ndarray, "j 3 3"], Rotations]:
    """World rotations (j, 3, 3) and positions (j, 3) of all joints for rotation vectors (j, 3)."""
    local = rotation_matrix(rotations)
    world, positions = np.empty_like(local), np.empty_like(build.joints, dtype=np.float64)
    for j, parent in enumerate(build.parents):
        if parent < 0:
            world[j], positions[j] = local[j], build.joints[j]
        else:
            world[j] = world[parent] @ local[j]
            positions[j] = positions[parent] + world[parent] @ (build.joints[j] - build.joints[parent])
    return world, positions


def limited(rotations: Rotations) -> Rotations:
    """Rotation vectors (j, 3) shortened to the limits of their joints."""
    angle = np.linalg.norm(rotations, axis=1)
    return rotations * np.minimum(1, LIMITS / np.maximum(angle, 1e-9))[:, None]


def excess(rotations: Rotations, joints: tuple[int, ...]) -> float:
    """By how much (radians) the worst of some joints exceeds its limit; negative if none does."""
    return float(np.max(np.linalg.norm(rotations[list(joints)], axis=1) - LIMITS[list(joints)]))


@dataclasses.dataclass(frozen=True)
class Foot:
    """Position of a foot, given by the point that a flat sole would touch.

    x, z: the point below the ball, metres. yaw: its heading. pitch: positive rolls it onto the toes, which stay flat where
    they are, negative onto the heel. lift: of all of it above the ground, metres.
    """

    x: float
    z: float
    yaw: float = 0.0
    pitch: float = 0.0
    lift: float = 0.0


Feet = tuple[Foot, Foot]
"""The left and the right one."""
LEGS = ((LEFT_HIP, LEFT_KNEE, LEFT_ANKLE, LEFT_FOOT), (RIGHT_HIP, RIGHT_KNEE, RIGHT_ANKLE, RIGHT_FOOT))


def ankle_of(build: Build, side: int, foot: Foot) -> tuple[Vector, Matrix]:
    """Position of the ankle, the ground at y = 0, and orientation of the foot. side: 0 left, 1 right."""
    _, _, ankle, ball = LEGS[side]
    a, b = build.joints[ankle], build.joints[ball]
    turn, orientation = turned(y=foot.yaw), turned(y=foot.yaw) @ turned(x=foot.pitch)
    if foot.pitch >= 0:
        pivot, offset = np.asarray([0.0, b[1] - build.sole, 0.0]), a - b
    else:
        heel = np.asarray([a[0], build.sole, a[2] - HEEL_BACK * build.leg])
        pivot, offset = turn @ (heel - [b[0], build.sole, b[2]]), a - heel
    return np.asarray([foot.x, foot.lift, foot.z]) + pivot + orientation @ offset, orientation


def highest_pelvis(build: Build, turn: Matrix, x: float, z: float, feet: Feet, reach: float = REACH) -> float:
    """The greatest height of the pelvis, turned by `turn`, above x, z, at which both legs reach their feet."""
    heights = []
    for side, foot in enumerate(feet):
        hip = turn @ (build.joints[LEGS[side][0]] - build.joints[PELVIS])
        ankle, _ = ankle_of(build, side, foot)
        away = np.hypot(x + hip[0] - ankle[0], z + hip[2] - ankle[2])
        heights.append(ankle[1] + np.sqrt(max((reach * build.leg) ** 2 - away**2, 0.0)) - hip[1])
    return min(heights)


def place_feet(build: Build, rotations: Rotations, pelvis: Vector, feet: Feet) -> float:
    """Set hips, knees, ankles and toes (in place) so that the feet are at their targets; the pelvis's rotation stays.

    pelvis: where the pelvis joint is, the ground at y = 0. Returns how far (metres) the worse ankle is from its place,
    which is 0 unless a leg is too short.
    """
    turn = rotation_matrix(rotations[PELVIS])
    missed = []
    for side, foot in enumerate(feet):
        hip, knee, ankle, ball = LEGS[side]
        target, orientation = ankle_of(build, side, foot)
        start = pelvis + turn @ (build.joints[hip] - build.joints[PELVIS])
        thigh, shin = build.joints[knee] - build.joints[hip], build.joints[ankle] - build.joints[knee]
        bend = _knee_angle(thigh, shin, np.linalg.norm(target - start))
        across = turn[:, 0] + orientation[:, 0]  # knees point between where the pelvis and where the foot looks
        chain = thigh + turned(x=bend) @ shin
        upper = _frame(target - start, across) @ _frame(chain, np.asarray([1.0, 0.0, 0.0])).T
        lower = upper @ turned(x=bend)
        rotations[hip] = rotation_vector(turn.T @ upper)
        rotations[knee] = [bend, 0, 0]
        rotations[ankle] = rotation_vector(lower.T @ orientation)
        rotations[ball] = [-max(foot.pitch, 0.0), 0, 0]
        missed.append(float(np.linalg.norm(start + upper @ chain - target)))
    return max(missed)


def _knee_angle(thigh, shin, distance):
    """The knee's angle at which hip and ankle are at the given distance."""
    wanted = 0.5 * (distance**2 - thigh @ thigh - shin @ shin) - thigh[0] * shin[0]
    cosine, sine = thigh[1] * shin[1] + thigh[2] * shin[2], thigh[2] * shin[1] - thigh[1] * shin[2]
    return float(np.arctan2(sine, cosine) + np.arccos(np.clip(wanted / np.hypot(cosine, sine), -1, 1)))


def _frame(direction, across):
    """Orthonormal columns: the direction, what of `across` is orthogonal to it, and their product."""
    u = direction / np.linalg.norm(direction)
    s = across - (across @ u) * u
    s = s / np.linalg.norm(s)
    return np.stack([u, s, np.cross(u, s)], axis=1)
