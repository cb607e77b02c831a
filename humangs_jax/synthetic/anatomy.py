"""Kinematics of the body for poses, and measures of the body for clothes.

For poses there are joints and their limits, rotations as numpy arrays (float64), forward kinematics
of the body, and inverse kinematics of the legs. Joints are in the order of SMPL-X. At rest the
person is in T-pose and faces +z, with the left side at +x. Angles are in radians, about the axes of
the parent joint at rest.

Cuts (hems, necklines, hairlines) and paint are given in TEMPLATE coordinates: places on the mean
body in T-pose, metres. A vertex has the same template coordinates for every shape of the body, so
that one number fits all people. Draping uses the vertices of the person at rest.
"""

import dataclasses
import functools

import numpy as np
from scipy.spatial.transform import Rotation

from humangs_jax.body.kinematics import bones_of, posed_tree
from humangs_jax.core.array_types import Float
from humangs_jax.synthetic.surfaces import (
    Boundaries,
    Faces,
    Field,
    Points,
    Surface,
    blurred,
    boundaries,
    vertex_normals,
)

Rotations = Float[np.ndarray, "j 3"]
"""Rotation vectors of all joints relative to their parents, (j, 3), radians."""
Vector = Float[np.ndarray, "3"]
Matrix = Float[np.ndarray, "3 3"]


class Joint:
    """Indices of SMPL-X's joints."""

    PELVIS, LEFT_HIP, RIGHT_HIP, SPINE1, LEFT_KNEE, RIGHT_KNEE = range(6)
    SPINE2, LEFT_ANKLE, RIGHT_ANKLE, SPINE3, LEFT_FOOT, RIGHT_FOOT = range(6, 12)
    NECK, LEFT_COLLAR, RIGHT_COLLAR, HEAD, LEFT_SHOULDER, RIGHT_SHOULDER = range(12, 18)
    LEFT_ELBOW, RIGHT_ELBOW, LEFT_WRIST, RIGHT_WRIST = range(18, 22)
    LEFT_EYE, RIGHT_EYE = 23, 24
    LEFT_HAND, RIGHT_HAND = 25, 40
    """First joint of each hand; a hand has 15 joints."""


JOINTS = 55
"""Number of joints."""
FINGER_LIMIT = 1.5
"""Largest rotation angle of a joint of a finger in the prior, radians."""
LIMITS = np.asarray([1.0, 1.7, 1.7, 0.35, 2.1, 2.1, 0.35, 0.8, 0.8, 0.35, 0.9,
                     0.9, 0.5, 0.35, 0.35, 0.5, 2.3, 2.3, 2.4, 2.4, 0.8, 0.8,
                     0, 0, 0, *[FINGER_LIMIT] * 30])  # fmt: skip
"""Largest rotation angle of each joint in the prior, radians; jaw and eyes stay at rest."""

MIRROR = np.asarray([1.0, -1.0, -1.0])
"""Factors (3,) on a rotation vector, which mirror the rotation from left to right."""


@dataclasses.dataclass(frozen=True)
class Build:
    """The joints and the thickness of a clothed body, as the pose prior needs them."""

    joints: Rotations
    """Joints at rest, (j, 3), metres."""
    parents: tuple[int, ...]
    """Parent of each joint; -1 for the root."""
    torso_radius: float
    """Radius of the clothed torso, metres."""
    thigh_radius: float
    """Radius of a clothed thigh, metres."""
    shin_radius: float
    """Radius of a clothed shin, metres."""
    arm_radius: float
    """Radius of a clothed arm, metres."""

    @property
    def leg(self) -> float:
        """Length of a leg from hip to ankle, metres."""
        hip, knee, ankle = self.joints[[Joint.LEFT_HIP, Joint.LEFT_KNEE, Joint.LEFT_ANKLE]]
        return float(np.linalg.norm(knee - hip) + np.linalg.norm(ankle - knee))

    @property
    def hip_width(self) -> float:
        """Distance of a hip from the middle, metres."""
        return float(0.5 * (self.joints[Joint.LEFT_HIP, 0] - self.joints[Joint.RIGHT_HIP, 0]))

    @property
    def sole(self) -> float:
        """Height (y) of the soles in T-pose, metres."""
        balls = self.joints[[Joint.LEFT_FOOT, Joint.RIGHT_FOOT], 1].mean()
        return float(balls - 0.0112 * self.leg)  # that high above the sole, in the shipped body


def rotation_matrix(vectors: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3 3"]:
    """Converts rotation vectors (..., 3) to rotation matrices (..., 3, 3)."""
    return Rotation.from_rotvec(vectors.reshape(-1, 3)).as_matrix().reshape(*vectors.shape, 3)


def rotation_vector(matrix: Float[np.ndarray, "*n 3 3"]) -> Float[np.ndarray, "*n 3"]:
    """Converts rotation matrices (..., 3, 3) to rotation vectors (..., 3), no longer than pi."""
    return Rotation.from_matrix(matrix.reshape(-1, 3, 3)).as_rotvec().reshape(matrix.shape[:-1])


def between(
    a: Float[np.ndarray, "*n 3"], b: Float[np.ndarray, "*n 3"], t: float
) -> Float[np.ndarray, "*n 3"]:
    """Interpolates rotation vectors along the shortest way from a (t = 0) to b (t = 1)."""
    first = rotation_matrix(a)
    step = rotation_vector(np.swapaxes(first, -1, -2) @ rotation_matrix(b))
    return rotation_vector(first @ rotation_matrix(t * step))


def turned(x: float = 0.0, y: float = 0.0, z: float = 0.0) -> Matrix:
    """Returns the matrix of the rotation vector (x, y, z), radians.

    A positive x swings legs and feet backwards, heels up. A positive y turns to the left.
    """
    return rotation_matrix(np.asarray([x, y, z], float))


def joint_positions(
    build: Build, rotations: Rotations
) -> tuple[Float[np.ndarray, "j 3 3"], Rotations]:
    """Returns the rotations (j, 3, 3) and positions (j, 3) of all joints in a pose, in the world.

    The root joint stays where it is at rest.
    """
    bones = bones_of(np.asarray(build.joints, np.float64), build.parents)
    return posed_tree(rotation_matrix(rotations), bones, build.parents)


def limited(rotations: Rotations) -> Rotations:
    """Returns rotation vectors (j, 3), shortened to the limits of their joints."""
    angle = np.linalg.norm(rotations, axis=1)
    return rotations * np.minimum(1, LIMITS / np.maximum(angle, 1e-9))[:, None]


def excess(rotations: Rotations, joints: tuple[int, ...]) -> float:
    """Returns the largest angle by which one of some joints exceeds its limit, radians.

    It is at most 0 if all joints are within their limits.
    """
    return float(np.max(np.linalg.norm(rotations[list(joints)], axis=1) - LIMITS[list(joints)]))


@dataclasses.dataclass(frozen=True)
class Foot:
    """Place and turn of a foot on the ground."""

    x: float
    """x of the point on the ground below the ball of the foot, metres."""
    z: float
    """z of the same point, metres."""
    yaw: float = 0.0
    """Heading of the foot, radians about y."""
    pitch: float = 0.0
    """Pitch of the foot, radians. Positive: the heel is raised, and the toes stay flat on the
    ground. Negative: the toes are raised, and the heel stays on the ground.
    """
    lift: float = 0.0
    """Height of the whole foot above the ground, metres."""


Feet = tuple[Foot, ...]
"""The left and the right foot."""
LEGS = (
    (Joint.LEFT_HIP, Joint.LEFT_KNEE, Joint.LEFT_ANKLE, Joint.LEFT_FOOT),
    (Joint.RIGHT_HIP, Joint.RIGHT_KNEE, Joint.RIGHT_ANKLE, Joint.RIGHT_FOOT),
)


def ankle_of(build: Build, side: int, foot: Foot) -> tuple[Vector, Matrix]:
    """Returns the position of the ankle (3,), metres, and the rotation of the foot (3, 3).

    The ground is at y = 0. side: 0 for left, 1 for right.
    """
    _, _, ankle, ball = LEGS[side]
    a, b = build.joints[ankle], build.joints[ball]
    turn, orientation = turned(y=foot.yaw), turned(y=foot.yaw) @ turned(x=foot.pitch)
    if foot.pitch >= 0:
        pivot, offset = np.asarray([0.0, b[1] - build.sole, 0.0]), a - b
    else:
        # the heel is that far behind the ankle, in the shipped body
        heel = np.asarray([a[0], build.sole, a[2] - 0.064 * build.leg])
        pivot, offset = turn @ (heel - [b[0], build.sole, b[2]]), a - heel
    return np.asarray([foot.x, foot.lift, foot.z]) + pivot + orientation @ offset, orientation


def highest_pelvis(
    build: Build, turn: Matrix, x: float, z: float, feet: Feet, reach: float = 0.998
) -> float:
    """Returns the greatest height of the pelvis at which both legs reach their feet, metres. A
    foot that is too far away for any height counts as reached when the hip is as high as the ankle.

    turn: rotation of the pelvis. x, z: place of the pelvis. reach: largest distance from hip to
    ankle as a share of the leg's length. It is less than 1, because a straight leg leaves the
    direction of the knee undefined.
    """
    heights = []
    for side, foot in enumerate(feet):
        hip = turn @ (build.joints[LEGS[side][0]] - build.joints[Joint.PELVIS])
        ankle, _ = ankle_of(build, side, foot)
        away = np.hypot(x + hip[0] - ankle[0], z + hip[2] - ankle[2])
        heights.append(ankle[1] + np.sqrt(max((reach * build.leg) ** 2 - away**2, 0.0)) - hip[1])
    return min(heights)


def place_feet(build: Build, rotations: Rotations, pelvis: Vector, feet: Feet) -> float:
    """Sets hips, knees, ankles and toes in `rotations`, so that the feet are at their places.

    The rotation of the pelvis stays. pelvis: position of the pelvis joint (3,), metres; the ground
    is at y = 0.

    Returns: the distance of the ankles from their places (the larger one of left and right),
    metres. It is 0, but for rounding, if both legs can reach.
    """
    turn = rotation_matrix(rotations[Joint.PELVIS])
    missed = []
    for side, foot in enumerate(feet):
        hip, knee, ankle, ball = LEGS[side]
        target, orientation = ankle_of(build, side, foot)
        start = pelvis + turn @ (build.joints[hip] - build.joints[Joint.PELVIS])
        thigh = build.joints[knee] - build.joints[hip]
        shin = build.joints[ankle] - build.joints[knee]
        bend = _knee_angle(thigh, shin, float(np.linalg.norm(target - start)))
        # knees point between where the pelvis and where the foot looks
        across = turn[:, 0] + orientation[:, 0]
        chain = thigh + turned(x=bend) @ shin
        upper = _frame(target - start, across) @ _frame(chain, np.asarray([1.0, 0.0, 0.0])).T
        lower = upper @ turned(x=bend)
        rotations[hip] = rotation_vector(turn.T @ upper)
        rotations[knee] = [bend, 0, 0]
        rotations[ankle] = rotation_vector(lower.T @ orientation)
        rotations[ball] = [-max(foot.pitch, 0.0), 0, 0]
        missed.append(float(np.linalg.norm(start + upper @ chain - target)))
    return max(missed)


def _knee_angle(thigh: Vector, shin: Vector, distance: float) -> float:
    """Returns the angle of the knee, radians, for which hip and ankle are `distance` metres apart.

    thigh, shin: offsets of knee and ankle from the joint above, at rest, metres.
    """
    wanted = 0.5 * (distance**2 - thigh @ thigh - shin @ shin) - thigh[0] * shin[0]
    cosine, sine = thigh[1] * shin[1] + thigh[2] * shin[2], thigh[2] * shin[1] - thigh[1] * shin[2]
    return float(
        np.arctan2(sine, cosine) + np.arccos(np.clip(wanted / np.hypot(cosine, sine), -1, 1))
    )


def _frame(direction: Vector, across: Vector) -> Matrix:
    """Returns a rotation matrix whose first column has the direction `direction`.

    The second column has the direction of the part of `across` that is orthogonal to the first
    column.
    """
    u = direction / np.linalg.norm(direction)
    s = across - (across @ u) * u
    s = s / np.linalg.norm(s)
    return np.stack([u, s, np.cross(u, s)], axis=1)


# The body under clothes
# -----------------------------------------------------------------------------------------------


BODY = ("makehuman", 13380)
"""The body that the cuts below were measured on: its name and number of vertices."""
WAIST = -0.2
"""Height (y) of the waist, template coordinates."""
CROTCH = -0.425
"""Height of the crotch, template coordinates."""
ANKLE = -1.159
"""Height of the ankles, template coordinates."""
FLOOR = -1.2285
"""Height of the soles, template coordinates."""
ARM_HEIGHT = 0.096
"""Height of the arms, template coordinates."""
SHOULDER = 0.171
"""Distance of the shoulders from the middle (|x|), template coordinates."""
WRIST = 0.651
"""Distance of the wrists from the middle (|x|), template coordinates."""
ARMHOLE = 0.185
"""Distance from the middle (|x|) at which sleeves are sewn on, template coordinates."""
TRUNK_GIRTH = 0.16
"""Radius of cloth around the trunk, metres. An angle times this is a length around the trunk."""
_LEG_GIRTH = 0.08
"""Radius of cloth around a leg, metres. An angle times this is a length around the leg."""
ARM_GIRTH = 0.06
"""Radius of cloth around an arm, metres. An angle times this is a length around the arm."""
SAME_GIRTH = 1e-4
"""Girths that differ by less than this count as equal, metres."""


@dataclasses.dataclass(frozen=True)
class Anatomy:
    """A shaped body, measured for clothes."""

    skin: Surface
    """The whole body at rest, with attributes `template` (n, 3), `normals` (n, 3), `cloth` (n, 4).
    """
    joints: np.ndarray
    """Joints at rest, (j, 3), metres."""
    parents: tuple[int, ...]
    """Index of each joint's parent."""
    arm: np.ndarray
    """How much each vertex belongs to an arm, (n,), 0 to 1."""
    leg: np.ndarray
    """How much each vertex belongs to a leg, (n,), 0 to 1."""
    trunk: Boundaries
    """Silhouettes of trunk and upper thighs, in slices across y."""
    hips_and_legs: Boundaries
    """Silhouettes of everything below the waist, in slices across y."""
    legs: tuple[Boundaries, Boundaries]
    """Silhouettes of the left and the right leg, in slices across y."""
    arms: tuple[Boundaries, Boundaries]
    """Silhouettes of the left and the right arm, in slices across |x|."""


def smoothstep(low: float, high: float, x: np.ndarray) -> np.ndarray:
    """Returns 0 at `low` and 1 at `high`, smooth between them and constant beyond.

    Either of `low` and `high` may be the larger one.
    """
    t = np.clip((x - low) / (high - low), 0, 1)
    return t * t * (3 - 2 * t)


def _leg_membership(template: np.ndarray) -> np.ndarray:
    """Returns 1 on the legs and 0 on the trunk (n,), smooth across the hips."""
    return smoothstep(-CROTCH - 0.1, -CROTCH + 0.05, -template[:, 1])


def cloth_coordinates(template: np.ndarray) -> np.ndarray:
    """Returns cloth coordinates (n, 4), metres: x, y, z relative to the axis of trunk or leg, and a
    radius, the girth.

    The angle atan2(x, z) is 0 in front. The angle times the girth is the length around the body.
    Here arms have coordinates relative to the axis of the trunk; `sewn_coordinates` replaces them.
    """
    x, y, z = template.T
    trunk = np.stack([x, y, z - 0.02, np.full_like(x, TRUNK_GIRTH)], -1)
    on_leg = _leg_membership(template)[:, None]
    return (trunk * (1 - on_leg) + leg_coordinates(template) * on_leg).astype(np.float32)


def leg_coordinates(template: np.ndarray) -> np.ndarray:
    """Returns the cloth coordinates (n, 4) of trousers, which are sewn along the middle.

    They are relative to the axis of the leg that is on the same side (x < 0 or x >= 0) as the
    point, also above the crotch.
    """
    x, y, z = template.T
    knee = np.interp(-y, [0.358, 0.764, 1.159], [0.101, 0.130, 0.137])
    leg = np.stack(
        [x - np.where(x < 0, -1.0, 1.0) * knee, y, z + 0.01, np.full_like(x, _LEG_GIRTH)], -1
    )
    return leg.astype(np.float32)


def sewn_coordinates(cloth: np.ndarray, template: np.ndarray) -> np.ndarray:
    """Returns cloth coordinates (n, 4) with new ones for points on arms and legs.

    The new coordinates are relative to the axis of the limb. They change abruptly at seams, which
    are at armholes and in the middle of trousers. Arms are turned down, so that y runs along every
    limb. Points on arms get new coordinates if their girth is `TRUNK_GIRTH`, points on legs if
    their girth is `_LEG_GIRTH`.
    """
    x, y, girth = template[:, 0], template[:, 1], cloth[:, 3]
    on_arm = (np.abs(x) > ARMHOLE) & (y > -0.15) & (np.abs(girth - TRUNK_GIRTH) < SAME_GIRTH)
    on_leg = (np.abs(girth - _LEG_GIRTH) < SAME_GIRTH) & (y < -0.15) & (y > -1.3)
    result = np.array(cloth)
    result[on_leg] = leg_coordinates(template[on_leg])
    x, y, z = template[on_arm].T
    around = np.where(x < 0, -1.0, 1.0) * (y - ARM_HEIGHT)
    result[on_arm] = np.stack(
        [around, ARM_HEIGHT - (np.abs(x) - SHOULDER), z, np.full_like(x, ARM_GIRTH)], -1
    )
    return result


@functools.lru_cache(maxsize=1)
def _fixed(template_bytes: bytes) -> tuple[Points, Float[np.ndarray, "n 4"], Field, Field]:
    """Returns what is equal for all bodies: template (n, 3), cloth coordinates (n, 4), and how much
    each vertex belongs to an arm and to a leg, both (n,), 0 to 1. template_bytes: the template, as
    float32.
    """
    template = np.frombuffer(template_bytes, np.float32).reshape(-1, 3)
    # 1 on the arms, 0 on the trunk, smooth across the shoulder seam
    arm = smoothstep(0.165, 0.23, np.abs(template[:, 0])) * smoothstep(-0.15, -0.05, template[:, 1])
    return template, cloth_coordinates(template), arm, _leg_membership(template)


def measure(
    vertices: Points,
    joints: np.ndarray,
    template: Points,
    faces: Faces,
    weights: np.ndarray,
    parents: tuple,
) -> Anatomy:
    """Measures a shaped body. vertices, joints: of this body at rest, metres. template, faces,
    weights, parents: of the body model.
    """
    template, cloth, arm, leg = _fixed(np.ascontiguousarray(template, np.float32).tobytes())
    vertices = np.asarray(vertices, np.float32)
    attributes = {"template": template, "normals": vertex_normals(vertices, faces), "cloth": cloth}
    skin = Surface(vertices, faces, weights, attributes)
    # slices are 2 cm apart
    levels, along = np.arange(-1.3, 0.5, 0.02), np.arange(0.05, 0.8, 0.02)
    body = (np.abs(template[:, 0]) < 0.19) & (template[:, 1] < 0.2)
    # parts are separated in template coordinates, which all bodies share
    trunk_points = vertices[body & (template[:, 1] > -0.6)]
    spine = np.zeros((len(levels), 2))
    torso = boundaries(trunk_points[:, 1], trunk_points[:, [0, 2]], levels, spine, 0.025)
    lower = vertices[body & (template[:, 1] < WAIST + 0.03)]
    hips = boundaries(lower[:, 1], lower[:, [0, 2]], levels, spine, 0.025)
    # slices of a limb are centred on the line through its joints
    legs, arms = [], []
    for offset, side in enumerate((1, -1)):
        line = joints[
            [Joint.LEFT_ANKLE + offset, Joint.LEFT_KNEE + offset, Joint.LEFT_HIP + offset]
        ]
        centers = np.stack([np.interp(levels, line[:, 1], line[:, i]) for i in (0, 2)], -1)
        own = vertices[
            (template[:, 0] * side > 0.004)
            & (template[:, 1] < CROTCH + 0.1)
            & (template[:, 1] > -1.15)
        ]
        legs.append(blurred(boundaries(own[:, 1], own[:, [0, 2]], levels, centers, 0.025)))
        line = joints[[Joint.LEFT_SHOULDER + offset, Joint.LEFT_WRIST + offset]]
        centers = np.stack([np.interp(along, np.abs(line[:, 0]), line[:, i]) for i in (1, 2)], -1)
        own = vertices[
            (template[:, 0] * side > 0.2)
            & (template[:, 1] > -0.05)
            & (np.abs(template[:, 0]) < 0.68)
        ]
        arms.append(blurred(boundaries(np.abs(own[:, 0]), own[:, [1, 2]], along, centers, 0.025)))
    return Anatomy(
        skin, joints, parents, arm, leg, blurred(torso), blurred(hips), tuple(legs), tuple(arms)
    )
