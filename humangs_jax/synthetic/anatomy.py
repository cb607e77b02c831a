"""Joints, their limits, rotations as numpy arrays (float64), kinematics forward, and of legs
inverse; the body under clothes.

Joints in SMPL-X order, T-pose at rest, the person faces +z with the left side at +x. Angles in
radians, about the axes of the parent joint at rest. Cuts (hems, necklines, hairlines) and paint are
given in TEMPLATE coordinates: the T-pose of the mean body, metres. A vertex keeps them for every
shape of the person, so one number fits all people. Draping uses the person's rest vertices.
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
"""Rotation vectors of all joints, relative to their parents."""
Vector = Float[np.ndarray, "3"]
Matrix = Float[np.ndarray, "3 3"]


class Joint:
    """Numbers of SMPL-X's joints."""

    PELVIS, LEFT_HIP, RIGHT_HIP, SPINE1, LEFT_KNEE, RIGHT_KNEE = range(6)
    SPINE2, LEFT_ANKLE, RIGHT_ANKLE, SPINE3, LEFT_FOOT, RIGHT_FOOT = range(6, 12)
    NECK, LEFT_COLLAR, RIGHT_COLLAR, HEAD, LEFT_SHOULDER, RIGHT_SHOULDER = range(12, 18)
    LEFT_ELBOW, RIGHT_ELBOW, LEFT_WRIST, RIGHT_WRIST = range(18, 22)
    LEFT_EYE, RIGHT_EYE = 23, 24
    LEFT_HAND, RIGHT_HAND = 25, 40
    """First joints of the hands, 15 each."""


JOINTS = 55
"""How many joints there are."""
FINGER_LIMIT = 1.5
"""Largest rotation angle of a joint of a finger in the prior, radians."""
LIMITS = np.asarray([1.0, 1.7, 1.7, 0.35, 2.1, 2.1, 0.35, 0.8, 0.8, 0.35, 0.9,
                     0.9, 0.5, 0.35, 0.35, 0.5, 2.3, 2.3, 2.4, 2.4, 0.8, 0.8,
                     0, 0, 0, *[FINGER_LIMIT] * 30])  # fmt: skip
"""Largest rotation angle of each joint in the prior; jaw and eyes stay at rest."""

MIRROR = np.asarray([1.0, -1.0, -1.0])
"""The rotation vector of the mirrored rotation (left and right exchanged)."""


@dataclasses.dataclass(frozen=True)
class Build:
    """A body as the pose prior needs it."""

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
        """Height of the sole in T-pose."""
        balls = self.joints[[Joint.LEFT_FOOT, Joint.RIGHT_FOOT], 1].mean()
        return float(balls - 0.0112 * self.leg)  # that high above the sole, in the shipped body


def rotation_matrix(vectors: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3 3"]:
    """The rotations of rotation vectors (..., 3)."""
    return Rotation.from_rotvec(vectors.reshape(-1, 3)).as_matrix().reshape(*vectors.shape, 3)


def rotation_vector(matrix: Float[np.ndarray, "*n 3 3"]) -> Float[np.ndarray, "*n 3"]:
    """The rotation vector, no longer than pi, of (..., 3, 3) rotations."""
    return Rotation.from_matrix(matrix.reshape(-1, 3, 3)).as_rotvec().reshape(matrix.shape[:-1])


def between(
    a: Float[np.ndarray, "*n 3"], b: Float[np.ndarray, "*n 3"], t: float
) -> Float[np.ndarray, "*n 3"]:
    """Rotation vectors on the way from a to b, the shortest one, t in [0, 1]."""
    first = rotation_matrix(a)
    step = rotation_vector(np.swapaxes(first, -1, -2) @ rotation_matrix(b))
    return rotation_vector(first @ rotation_matrix(t * step))


def turned(x: float = 0.0, y: float = 0.0, z: float = 0.0) -> Matrix:
    """The rotation about (x, y, z) by its length.

    About x: legs and feet swing backwards, heels up; about y: to the left.
    """
    return rotation_matrix(np.asarray([x, y, z], float))


def joint_positions(
    build: Build, rotations: Rotations
) -> tuple[Float[np.ndarray, "j 3 3"], Rotations]:
    """World rotations (j, 3, 3) and positions (j, 3) of all joints for rotation vectors (j, 3)."""
    bones = bones_of(np.asarray(build.joints, np.float64), build.parents)
    return posed_tree(rotation_matrix(rotations), bones, build.parents)


def limited(rotations: Rotations) -> Rotations:
    """Rotation vectors (j, 3) shortened to the limits of their joints."""
    angle = np.linalg.norm(rotations, axis=1)
    return rotations * np.minimum(1, LIMITS / np.maximum(angle, 1e-9))[:, None]


def excess(rotations: Rotations, joints: tuple[int, ...]) -> float:
    """By how much (radians) the worst of some joints exceeds its limit; negative if none does."""
    return float(np.max(np.linalg.norm(rotations[list(joints)], axis=1) - LIMITS[list(joints)]))


@dataclasses.dataclass(frozen=True)
class Foot:
    """Position of a foot, given by the point that a flat sole would touch."""

    x: float
    """The point below the ball of the foot, along x, metres."""
    z: float
    """The same point along z, metres."""
    yaw: float = 0.0
    """Heading of the foot, radians about y."""
    pitch: float = 0.0
    """Roll of the foot, radians: positive onto the toes, which stay flat where they are, negative
    onto the heel.
    """
    lift: float = 0.0
    """Height of the whole foot above the ground, metres."""


Feet = tuple[Foot, ...]
"""The left and the right one."""
LEGS = (
    (Joint.LEFT_HIP, Joint.LEFT_KNEE, Joint.LEFT_ANKLE, Joint.LEFT_FOOT),
    (Joint.RIGHT_HIP, Joint.RIGHT_KNEE, Joint.RIGHT_ANKLE, Joint.RIGHT_FOOT),
)


def ankle_of(build: Build, side: int, foot: Foot) -> tuple[Vector, Matrix]:
    """Position of the ankle, the ground at y = 0, and orientation of the foot.

    side: 0 left, 1 right.
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
    """The greatest height of the pelvis, turned by `turn`, above x, z, at which both legs reach
    their feet.

    reach: largest stretch of a leg as a share of its length: a straight leg leaves the knee's
    direction undefined.
    """
    heights = []
    for side, foot in enumerate(feet):
        hip = turn @ (build.joints[LEGS[side][0]] - build.joints[Joint.PELVIS])
        ankle, _ = ankle_of(build, side, foot)
        away = np.hypot(x + hip[0] - ankle[0], z + hip[2] - ankle[2])
        heights.append(ankle[1] + np.sqrt(max((reach * build.leg) ** 2 - away**2, 0.0)) - hip[1])
    return min(heights)


def place_feet(build: Build, rotations: Rotations, pelvis: Vector, feet: Feet) -> float:
    """Set hips, knees, ankles and toes (in place) so that the feet are at their targets; the
    pelvis's rotation stays.

    pelvis: where the pelvis joint is, the ground at y = 0. Returns how far (metres) the worse ankle
    is from its place, which is 0 unless a leg is too short.
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
        across = (
            turn[:, 0] + orientation[:, 0]
        )  # knees point between where the pelvis and where the foot looks
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
    """The knee's angle at which hip and ankle are at the given distance."""
    wanted = 0.5 * (distance**2 - thigh @ thigh - shin @ shin) - thigh[0] * shin[0]
    cosine, sine = thigh[1] * shin[1] + thigh[2] * shin[2], thigh[2] * shin[1] - thigh[1] * shin[2]
    return float(
        np.arctan2(sine, cosine) + np.arccos(np.clip(wanted / np.hypot(cosine, sine), -1, 1))
    )


def _frame(direction: Vector, across: Vector) -> Matrix:
    """Orthonormal columns: the direction, what of `across` is orthogonal to it, and their
    product.
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
"""Height of the crotch."""
ANKLE = -1.159
"""Height of the ankles."""
FLOOR = -1.2285
"""Height of the soles."""
ARM_HEIGHT = 0.096
"""Height of the arms."""
SHOULDER = 0.171
"""Distance of the shoulders from the middle (|x|), template coordinates."""
WRIST = 0.651
"""Distance of the wrists from the middle."""
ARMHOLE = 0.185
"""Distance from the middle at which sleeves are sewn on."""
TRUNK_GIRTH = 0.16
"""Radius that turns angles around the trunk into metres of cloth."""
_LEG_GIRTH = 0.08
"""The same for legs."""
ARM_GIRTH = 0.06
"""The same for arms."""
SAME_GIRTH = 1e-4
"""Tolerance for comparing girths."""


@dataclasses.dataclass(frozen=True)
class Anatomy:
    """A shaped body, measured for clothes."""

    skin: Surface
    """The whole body at rest, with attributes `template` (n, 3), `normals` (n, 3), `cloth` (n, 4).
    """
    joints: np.ndarray
    """Joints at rest, (j, 3), metres."""
    parents: tuple[int, ...]
    """Parent of each joint."""
    arm: np.ndarray
    """Membership of each vertex in the arms, (n,), 0 to 1."""
    leg: np.ndarray
    """Membership of each vertex in the legs, (n,), 0 to 1."""
    trunk: Boundaries
    """Silhouettes of trunk and upper thighs, in slices across y."""
    hips_and_legs: Boundaries
    """Silhouettes of everything below the waist, in slices across y."""
    legs: tuple[Boundaries, Boundaries]
    """Silhouettes of the left and the right leg, in slices across y."""
    arms: tuple[Boundaries, Boundaries]
    """Silhouettes of the left and the right arm, in slices across |x|."""


def smoothstep(low: float, high: float, x: np.ndarray) -> np.ndarray:
    """0 at `low`, 1 at `high`, smooth between, constant beyond (either may be the larger one)."""
    t = np.clip((x - low) / (high - low), 0, 1)
    return t * t * (3 - 2 * t)


def _leg_membership(template: np.ndarray) -> np.ndarray:
    """(n,) 1 on the legs, 0 on the trunk, smooth across the hip."""
    return smoothstep(-CROTCH - 0.1, -CROTCH + 0.05, -template[:, 1])


def cloth_coordinates(template: np.ndarray) -> np.ndarray:
    """(n, 4) x, y, z around the axis of trunk or leg, and the girth radius that turns angles into
    metres.

    The angle atan2(x, z) is 0 in front. Arms go on as the trunk does; `sewn_coordinates` gives them
    their own.
    """
    x, y, z = template.T
    trunk = np.stack([x, y, z - 0.02, np.full_like(x, TRUNK_GIRTH)], -1)
    on_leg = _leg_membership(template)[:, None]
    return (trunk * (1 - on_leg) + leg_coordinates(template) * on_leg).astype(np.float32)


def leg_coordinates(template: np.ndarray) -> np.ndarray:
    """(n, 4) cloth coordinates around the axis of the nearer leg, from the waist down: trousers,
    sewn along the middle.
    """
    x, y, z = template.T
    knee = np.interp(-y, [0.358, 0.764, 1.159], [0.101, 0.130, 0.137])
    leg = np.stack(
        [x - np.where(x < 0, -1.0, 1.0) * knee, y, z + 0.01, np.full_like(x, _LEG_GIRTH)], -1
    )
    return leg.astype(np.float32)


def sewn_coordinates(cloth: np.ndarray, template: np.ndarray) -> np.ndarray:
    """Cloth coordinates (n, 4) with those of arms and legs replaced by coordinates around the limb
    that the point is on.

    They are sharp at seams (armholes; the middle of trousers). Arms are turned down, so that y runs
    along every limb. Only cloth with the trunk's girth has sleeves, only cloth with the legs' girth
    has legs.
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
    """Template, coordinates of cloth, membership of arms and legs of the mean body."""
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
    """The `Anatomy` of a shaped body from its rest vertices (n, 3) and joints (j, 3)."""
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
