"""A pose prior: draws plausible poses of people who stand, stride, crouch or reach.

Poses keep to the limits of the joints, and the person stands on the ground. A stance places the
feet and the pelvis. For each arm many candidates are drawn, and the one with the least cost is
kept. The cost is the distance of the wrist from a goal, plus penalties where forearm and hand come
too near to trunk, head, legs or the other arm, or where the shoulder exceeds its limit. Each hand
is between the relaxed gesture and a random one. `anatomy` has the joints, their limits and the
conventions.
"""

import dataclasses
from collections.abc import Callable

import numpy as np

from humangs_jax.core.array_types import Float
from humangs_jax.synthetic import anatomy as kin
from humangs_jax.synthetic.anatomy import Joint
from humangs_jax.synthetic.surfaces import choice

_HAND_LENGTH = 0.6
"""Distance from the wrist to a little beyond the knuckles, in lengths of the forearm."""
_Capsule = tuple[kin.Vector, kin.Vector, float]
"""The two ends of a capsule (3,) and its radius, metres."""


@dataclasses.dataclass(frozen=True)
class Stance:
    """Where feet and pelvis are before the person is turned by a heading.

    Distances are in lengths of a leg, with x to the left of the pelvis and z in front of it. Angles
    are in radians.
    """

    feet: kin.Feet
    """The left and the right foot."""
    sink: float = 0.0
    """How far the pelvis is below the highest place that the legs allow."""
    tilt: float = 0.0
    """Tilt of the pelvis forward."""
    roll: float = 0.0
    """Roll of the pelvis, positive with the left side up."""
    lean: float = 0.0
    """Angle by which the trunk bends forward to keep the balance."""


def _sample_stance(rng: np.random.Generator, build: kin.Build, rotations: kin.Rotations) -> Stance:
    """Draws a stance and sets legs and pelvis in `rotations`; returns the stance.

    The heading of the pelvis stays. A stance that exceeds the limits of the joints, or that the
    legs cannot reach, is drawn again. After 20 such stances the person stands upright.
    """
    heading, width = rotations[Joint.PELVIS, 1], build.hip_width / build.leg
    for _ in range(20):
        stance = STANCES[choice(rng, {name: odds for name, (odds, _) in STANCES.items()})][1](
            rng, width
        )
        _, missed = take_stance(build, rotations, heading, stance)
        if missed < 1e-6 and kin.excess(rotations, (*kin.LEGS[0], *kin.LEGS[1])) < 0:
            return stance
    stance = _stand(rng, width)
    take_stance(build, rotations, heading, stance)
    return stance


def take_stance(
    build: kin.Build, rotations: kin.Rotations, heading: float, stance: Stance
) -> tuple[kin.Vector, float]:
    """Sets pelvis and legs of a stance in `rotations`.

    heading: turn of the person about y, radians.

    Returns: the position of the pelvis (3,) over the ground at y = 0, and the distance of the
    ankles from their places (the larger one of left and right). Both are in metres.
    """
    turn = kin.turned(y=heading) @ kin.turned(x=stance.tilt, z=stance.roll)
    rotations[Joint.PELVIS] = kin.rotation_vector(turn)
    feet = in_world(stance.feet, build.leg, heading)
    pelvis = np.asarray(
        [0.0, kin.highest_pelvis(build, turn, 0.0, 0.0, feet) - stance.sink * build.leg, 0.0]
    )
    return pelvis, kin.place_feet(build, rotations, pelvis, feet)


def in_world(feet: kin.Feet, leg: float, heading: float) -> kin.Feet:
    """Converts the feet of a stance to metres, and turns them by the heading (radians).

    leg: length of a leg, metres.
    """
    placed = []
    for foot in feet:
        x, _, z = kin.turned(y=heading) @ np.asarray([foot.x * leg, 0.0, foot.z * leg])
        placed.append(kin.Foot(float(x), float(z), heading + foot.yaw, foot.pitch, foot.lift * leg))
    return placed[0], placed[1]


def _pair(
    rng: np.random.Generator,
    width: float,
    *,
    spread: tuple[float, float] = (0.0, 0.08),
    apart: tuple[float, float] = (0.0, 0.06),
    turn_out: tuple[float, float] = (-0.05, 0.35),
) -> list[kin.Foot]:
    """Draws two flat feet, left and right, each about as far from the middle as its hip.

    Lengths are in lengths of a leg, angles in radians. width: distance of a hip from the middle.
    spread: range of the distance by which a foot is further from the middle than its hip. apart:
    range of the shift of a foot forward or back. turn_out: range of the angle by which a foot is
    turned outwards.
    """
    feet = []
    for sign in (1, -1):
        x = sign * (width + rng.uniform(*spread))
        feet.append(
            kin.Foot(
                x, 0.08 + rng.choice([-1, 1]) * rng.uniform(*apart), sign * rng.uniform(*turn_out)
            )
        )
    return feet


def _stand(rng: np.random.Generator, width: float) -> Stance:
    """Draws a stance with both feet flat on the ground."""
    return Stance(tuple(_pair(rng, width)), sink=rng.uniform(0.0, 0.015), roll=rng.normal(0, 0.02))


def _contrapposto(rng: np.random.Generator, width: float) -> Stance:
    """Draws a stance with the weight on one foot and the relaxed foot in front."""
    feet, relaxed = _pair(rng, width), int(rng.integers(2))
    sign = 1 if relaxed == 0 else -1
    shift = rng.uniform(0.4, 1.0) * width * sign  # the standing foot comes below the pelvis
    feet = [dataclasses.replace(foot, x=foot.x + shift) for foot in feet]
    z = feet[relaxed].z + rng.uniform(0.0, 0.28)
    pitch = rng.choice([0.0, rng.uniform(0.1, 0.5)])
    yaw = feet[relaxed].yaw + sign * rng.uniform(0, 0.3)
    feet[relaxed] = dataclasses.replace(feet[relaxed], z=z, pitch=pitch, yaw=yaw)
    return Stance(tuple(feet), sink=rng.uniform(0.0, 0.01), roll=-sign * rng.uniform(0.03, 0.12))


def _stride(rng: np.random.Generator, width: float) -> Stance:
    """Draws a stance with one foot in front of the other, as in walking."""
    feet = _pair(rng, 0.75 * width, spread=(-0.02, 0.03), turn_out=(-0.05, 0.2))
    front = int(rng.integers(2))
    length, share = rng.uniform(0.25, 0.85), rng.uniform(0.35, 0.6)
    feet[front] = dataclasses.replace(
        feet[front], z=0.08 + share * length, pitch=-rng.uniform(0, 0.3) * (length > 0.4)
    )
    rear = rng.uniform(0.3, 0.7) * min(1.0, length / 0.5)
    feet[1 - front] = dataclasses.replace(
        feet[1 - front], z=0.08 - (1 - share) * length, pitch=rear
    )
    return Stance(
        tuple(feet),
        sink=rng.uniform(0.0, 0.04),
        tilt=rng.uniform(0, 0.08),
        lean=rng.uniform(0, 0.1),
    )


def _wide(rng: np.random.Generator, width: float) -> Stance:
    """Draws a stance with the feet wide apart."""
    feet = _pair(rng, width, spread=(0.12, 0.35), turn_out=(0.05, 0.5))
    return Stance(
        tuple(feet), sink=rng.choice([0.0, rng.uniform(0, 0.15)]), roll=rng.normal(0, 0.03)
    )


def _squat(rng: np.random.Generator, width: float) -> Stance:
    """Draws a stance with bent knees. In a deep squat only the toes touch the ground."""
    depth = rng.uniform(0.08, 0.42)
    feet = _pair(rng, width, spread=(0.03, 0.2), turn_out=(0.1, 0.6))
    heels = rng.uniform(0.2, 0.6) if depth > 0.3 else 0.0
    feet = [dataclasses.replace(foot, pitch=heels, z=foot.z + 0.06) for foot in feet]
    return Stance(tuple(feet), sink=depth, tilt=0.6 * depth, lean=1.4 * depth)


def _lunge(rng: np.random.Generator, width: float) -> Stance:
    """Draws a stance with one foot far in front and the other far behind, on its toes."""
    feet, front = _pair(rng, width, turn_out=(-0.05, 0.2)), int(rng.integers(2))
    feet[front] = dataclasses.replace(feet[front], z=rng.uniform(0.4, 0.7))
    feet[1 - front] = dataclasses.replace(
        feet[1 - front], z=-rng.uniform(0.4, 0.75), pitch=rng.uniform(0.55, 0.85)
    )
    return Stance(
        tuple(feet),
        sink=rng.uniform(0.05, 0.3),
        tilt=rng.uniform(0, 0.15),
        lean=rng.uniform(-0.1, 0.3),
    )


def _side_lunge(rng: np.random.Generator, width: float) -> Stance:
    """Draws a stance with feet far apart and the weight on one bent leg."""
    feet, bent = _pair(rng, width, spread=(0.2, 0.4), turn_out=(0.1, 0.5)), int(rng.integers(2))
    sign = 1 if bent == 0 else -1
    feet = [dataclasses.replace(foot, x=foot.x - sign * rng.uniform(0.1, 0.3)) for foot in feet]
    return Stance(
        tuple(feet),
        sink=rng.uniform(0.02, 0.2),
        tilt=rng.uniform(0.05, 0.2),
        lean=rng.uniform(0, 0.3),
    )


def _one_leg(rng: np.random.Generator, width: float) -> Stance:
    """Draws a stance with one foot in the air: raised knee, kick, foot behind, or foot aside."""
    feet, raised = _pair(rng, width), int(rng.integers(2))
    sign = 1 if raised == 0 else -1
    feet = [dataclasses.replace(foot, x=foot.x + 0.6 * width * sign) for foot in feet]
    x, z, lift, pitch = feet[raised].x, feet[raised].z, 0.0, 0.0
    way = rng.choice(["knee", "kick", "behind", "aside"])
    if way == "knee":
        z, lift, pitch = z + rng.uniform(0.0, 0.3), rng.uniform(0.1, 0.5), rng.uniform(0.1, 0.6)
    elif way == "kick":
        z, lift, pitch = z + rng.uniform(0.4, 0.8), rng.uniform(0.1, 0.5), rng.uniform(-0.5, 0.2)
    elif way == "behind":
        z, lift, pitch = z - rng.uniform(0.3, 0.55), rng.uniform(0.1, 0.45), rng.uniform(0.5, 1.2)
    else:
        x, lift = x + sign * rng.uniform(0.2, 0.5), rng.uniform(0.05, 0.3)
    feet[raised] = kin.Foot(x, z, feet[raised].yaw, pitch, lift)
    sink, roll = rng.uniform(0.0, 0.05), sign * rng.uniform(0, 0.08)
    return Stance(tuple(feet), sink=sink, roll=roll, lean=rng.uniform(-0.05, 0.1))


def _tiptoe(rng: np.random.Generator, width: float) -> Stance:
    """Draws a stance on the toes of both feet."""
    pitch = rng.uniform(0.3, 0.8)
    feet = [dataclasses.replace(foot, pitch=pitch) for foot in _pair(rng, width)]
    return Stance(tuple(feet), sink=rng.uniform(0, 0.03))


STANCES: dict[str, tuple[float, Callable[[np.random.Generator, float], Stance]]] = {
    "stand": (0.26, _stand),
    "contrapposto": (0.2, _contrapposto),
    "stride": (0.22, _stride),
    "wide": (0.08, _wide),
    "squat": (0.06, _squat),
    "lunge": (0.05, _lunge),
    "side lunge": (0.04, _side_lunge),
    "one leg": (0.07, _one_leg),
    "tiptoe": (0.02, _tiptoe),
}
"""Stances by name: the probability, and the function that draws such a stance.

The function takes a generator and the distance of a hip from the middle, in lengths of a leg.
"""


@dataclasses.dataclass(frozen=True)
class _Goal:
    """Where a wrist should be, and how the arm may bend. Pairs are ranges of angles, radians."""

    odds: float
    """Odds of this goal."""
    place: tuple[float, float, float]
    """Place of the left wrist relative to the left shoulder, along the axes of the chest, in
    lengths of the arm.
    """
    raised: tuple[float, float] = (-1.45, -0.1)
    """Elevation of the upper arm, radians. 0 is horizontal."""
    forward: tuple[float, float] = (-0.5, 1.4)
    """Turn of the upper arm towards the front, radians."""
    flexed: tuple[float, float] = (0.05, 2.2)
    """Bend of the elbow, radians."""
    collar: float = -0.08
    """Angle by which the collar is raised, radians."""


_GOALS = {
    "hang": _Goal(0.36, (0.28, -1.0, 0.1), (-1.5, -1.05), (-0.25, 0.35), (0.05, 0.6)),
    "away": _Goal(0.14, (0.6, -0.85, 0.08), (-1.3, -0.7), flexed=(0.05, 0.6)),
    "hip": _Goal(0.09, (0.35, -0.82, 0.12)),
    "front": _Goal(0.09, (0.2, -0.3, 0.8)),
    "low": _Goal(0.06, (0.15, -0.75, 0.5)),
    "chest": _Goal(0.05, (-0.2, -0.4, 0.45)),
    "wave": _Goal(0.05, (0.55, 0.45, 0.25), (-1.45, 1.25), collar=0.15),
    "side": _Goal(0.04, (1.0, -0.1, 0.1), (-0.4, 0.4), collar=0.05),
    "up": _Goal(0.03, (0.25, 1.0, 0.1), (-0.5, 1.25), collar=0.3),
    "reach": _Goal(0.03, (0.15, 0.1, 0.95), (-0.6, 0.5), (0.6, 1.5), (0.05, 0.9), 0.02),
    "back": _Goal(0.02, (0.3, -0.85, -0.45), (-1.45, -0.7), (-0.9, 0.0), (0.05, 0.9)),
    "face": _Goal(0.02, (-0.2, 0.2, 0.5), (-1.3, 0.4), (0.0, 1.5), (1.2, 2.35), 0.05),
    "diagonal": _Goal(0.02, (0.75, 0.65, 0.1), (0.0, 1.1), (-0.2, 0.9), (0.05, 0.7), 0.2),
}
ARMS = (
    (Joint.LEFT_COLLAR, Joint.LEFT_SHOULDER, Joint.LEFT_ELBOW, Joint.LEFT_WRIST),
    (Joint.RIGHT_COLLAR, Joint.RIGHT_SHOULDER, Joint.RIGHT_ELBOW, Joint.RIGHT_WRIST),
)


def draw_goal(rng: np.random.Generator) -> str:
    """Draws the name of a goal."""
    return choice(rng, {name: goal.odds for name, goal in _GOALS.items()})


def bend_arm(
    rng: np.random.Generator,
    build: kin.Build,
    rotations: kin.Rotations,
    goal: str,
    side: int,
    other_arm: bool = False,
) -> float:
    """Sets collar, shoulder, elbow and wrist of one side in `rotations`.

    Trunk, head and legs must be set before the arm.

    goal: a name that `draw_goal` returns. side: 0 for left, 1 for right. other_arm: whether to keep
    clear of the other arm, too. The other arm must then be set before.

    Returns: the least distance of forearm and hand from what they keep clear of, metres. It is
    negative if they are inside.
    """
    matrix, vector = kin.rotation_matrix, kin.rotation_vector
    collar, shoulder, elbow, wrist = ARMS[side]
    mirror = np.ones(3) if side == 0 else kin.MIRROR
    n = 400  # poses of the arm
    wanted = _GOALS[goal]
    rotations[collar] = (
        np.asarray([0, rng.normal(-0.03, 0.03), wanted.collar + rng.normal(0, 0.03)]) * mirror
    )
    down, forward, twist, flex, pronation = np.zeros((5, n, 3))
    down[:, 2] = rng.uniform(*wanted.raised, n)
    forward[:, 1] = -rng.uniform(*wanted.forward, n)
    twist[:, 0] = rng.uniform(-1.0, 0.8, n)
    flex[:, 1] = -rng.uniform(*wanted.flexed, n)
    pronation[:, 0] = rng.uniform(-0.4, 0.5)
    # a hanging arm swings about the axis of both shoulders
    about_both = np.stack([forward[:, 1], down[:, 1], down[:, 2]], 1)
    if goal == "hang":
        swing = matrix(about_both)
    else:
        swing = matrix(forward) @ matrix(down)
    upper = vector(swing @ matrix(twist)) * mirror
    lower = vector(matrix(flex) @ matrix(pronation)) * mirror

    world, positions = kin.joint_positions(build, rotations)
    rest = build.joints
    upper_world = world[collar] @ matrix(upper)
    elbows = positions[shoulder] + upper_world @ (rest[elbow] - rest[shoulder])
    wrists = elbows + upper_world @ matrix(lower) @ (rest[wrist] - rest[elbow])
    reach = np.linalg.norm(rest[elbow] - rest[shoulder]) + np.linalg.norm(rest[wrist] - rest[elbow])
    offset = np.asarray(wanted.place) * [1 - 2 * side, 1, 1] + rng.normal(0, 0.08, 3)
    target = positions[shoulder] + reach * world[Joint.SPINE3] @ offset
    capsules = _body_capsules(build, world, positions)
    if other_arm:
        capsules += _arm_capsules(build, positions, 1 - side)
    clear = np.min(
        [_clearance(build, capsules, points) for points in _along(elbows, wrists)], axis=0
    )
    beyond = np.maximum(np.linalg.norm(upper, axis=1) - kin.LIMITS[shoulder], 0)
    # forearm and hand keep 15 mm away from the body
    near = np.maximum(0.015 - clear, 0)
    cost = np.linalg.norm(wrists - target, axis=1) + 20 * near + 5 * beyond
    best = int(np.argmin(cost))
    rotations[shoulder], rotations[elbow] = upper[best], lower[best]
    rotations[wrist] = rng.normal(0, 1, 3) * [0.08, 0.12, 0.2]
    return float(clear[best])


def arm_clearance(build: kin.Build, rotations: kin.Rotations) -> float:
    """Returns the least distance of a forearm or hand from the body and from the other arm, metres.
    It is negative if one of them is inside of these.
    """
    world, positions = kin.joint_positions(build, rotations)
    body, worst = _body_capsules(build, world, positions), np.inf
    for side, (_, _, elbow, wrist) in enumerate(ARMS):
        points = np.stack(_along(positions[elbow], positions[wrist]))
        worst = min(
            worst, _clearance(build, body + _arm_capsules(build, positions, 1 - side), points).min()
        )
    return float(worst)


def _body_capsules(
    build: kin.Build, world: Float[np.ndarray, "j 3 3"], positions: kin.Rotations
) -> list[_Capsule]:
    """Returns capsules that stand for trunk, legs and head of a posed body.

    world: rotations of the joints in the world. positions: of the joints, metres.
    """
    sideways = 0.25 * (positions[Joint.LEFT_HIP] - positions[Joint.RIGHT_HIP])
    top = positions[Joint.NECK] + world[Joint.SPINE3] @ np.asarray([0, -0.06, 0])
    head = positions[Joint.HEAD] + world[Joint.HEAD] @ np.asarray([0, 0.09, 0.03])
    capsules = [(head, head, 0.14)]
    for s in (-1.0, 0.0, 1.0):
        capsules.append(
            (positions[Joint.PELVIS] + s * sideways, top + s * 0.8 * sideways, build.torso_radius)
        )
    for hip, knee, ankle, _ in kin.LEGS:
        capsules.append((positions[hip], positions[knee], build.thigh_radius))
        capsules.append((positions[knee], positions[ankle], build.shin_radius))
    return capsules


def _arm_capsules(build: kin.Build, positions: kin.Rotations, side: int) -> list[_Capsule]:
    """Returns two capsules of one side: the upper arm, and the forearm with the hand.

    side: 0 for left, 1 for right.
    """
    _, shoulder, elbow, wrist = (positions[joint] for joint in ARMS[side])
    radius = build.arm_radius + 0.01
    return [(shoulder, elbow, radius), (elbow, wrist + _HAND_LENGTH * (wrist - elbow), radius)]


def _clearance(
    build: kin.Build, capsules: list[_Capsule], points: Float[np.ndarray, "n 3"]
) -> Float[np.ndarray, " n"]:
    """Returns for each point the gap between the nearest capsule and an arm whose axis goes through
    the point, (n,), metres.

    The gap is the distance of the point from the capsule's axis, minus both radii. It is negative
    where arm and capsule overlap.
    """
    distances = []
    for a, b, radius in capsules:
        axis = b - a
        t = np.clip((points - a) @ axis / max(axis @ axis, 1e-9), 0, 1)
        distances.append(np.linalg.norm(points - a - t[:, None] * axis, axis=1) - radius)
    return np.min(distances, axis=0) - build.arm_radius


def _along(
    elbows: Float[np.ndarray, "*n 3"], wrists: Float[np.ndarray, "*n 3"]
) -> list[Float[np.ndarray, "*n 3"]]:
    """Returns five points of each arm, from the elbow to beyond the knuckles. They must not touch
    the body.
    """
    tips = wrists + _HAND_LENGTH * (wrists - elbows)
    return [elbows, 0.5 * (elbows + wrists), wrists, 0.5 * (wrists + tips), tips]


_FINGERS = ((0, 1.0), (1, 0.15), (3, -1.2), (2, -0.6))
"""Index, middle, pinky and ring finger, in the order of SMPL-X's joints. Each finger has the index
of its curl in a gesture, and a factor on the gesture's angle between fingers.
"""
_GESTURES = {
    "relaxed": (0.4, (0.25, 0.32, 0.38, 0.42), 0.03, 0.25),
    "flat": (0.15, (0.03, 0.03, 0.04, 0.05), 0.0, 0.05),
    "spread": (0.1, (0.0, 0.0, 0.0, 0.0), 0.16, -0.3),
    "fist": (0.12, (1.3, 1.35, 1.35, 1.35), 0.0, 1.0),
    "point": (0.06, (0.02, 1.2, 1.3, 1.3), 0.0, 0.8),
    "two": (0.03, (0.02, 0.02, 1.3, 1.3), 0.12, 0.9),
    "thumb up": (0.03, (1.2, 1.3, 1.3, 1.3), 0.0, -0.4),
    "hold": (0.11, (0.65, 0.7, 0.75, 0.8), 0.05, 0.6),
}
"""Gestures by name. Each has four things: its odds; the curl of index, middle, ring and pinky,
radians per knuckle; the angle between fingers, radians; and the place of the thumb: 0 beside the
palm, 1 across the palm, negative if it points away.
"""


def pose_hand(rng: np.random.Generator, rotations: kin.Rotations, side: int) -> None:
    """Sets the 15 joints of one hand in `rotations`, between relaxed and a random gesture.

    side: 0 for left, 1 for right.
    """
    if side == 0:
        first, mirror = Joint.LEFT_HAND, np.ones(3)
    else:
        first, mirror = Joint.RIGHT_HAND, kin.MIRROR
    goal, t = (
        choice(rng, {name: odds for name, (odds, *_) in _GESTURES.items()}),
        rng.beta(2.5, 1.0),
    )
    blends = (
        (1 - t) * np.asarray(a) + t * np.asarray(b)
        for a, b in zip(_GESTURES["relaxed"], _GESTURES[goal], strict=True)
    )
    _, curls, spread, thumb = blends
    thumb = thumb + rng.normal(0, 0.08)
    for finger, (place, splay) in enumerate(_FINGERS):
        curl = curls[place] * rng.uniform(0.85, 1.15) + rng.normal(0, 0.03)
        # from the palm outwards each knuckle has a share of the curl
        for bone, share in enumerate((0.85, 1.0, 0.7)):
            # fingers do not bend backwards, and spread at the palm only
            bend = np.clip(curl * share * rng.uniform(0.9, 1.1), -0.1, kin.FINGER_LIMIT - 0.1)
            aside = splay * spread if bone == 0 else 0.0
            rotations[first + 3 * finger + bone] = np.asarray([0, -aside, -bend]) * mirror
    rotations[first + 12] = np.asarray([0.25 * thumb, 0.45 * thumb, -0.35 * thumb]) * mirror
    rotations[first + 13] = np.asarray([0.0, 0.35 * thumb, -0.1 * thumb]) * mirror
    rotations[first + 14] = np.asarray([0.0, 0.5 * max(thumb, 0.0), 0.0]) * mirror


def sample_rotations(rng: np.random.Generator, build: kin.Build) -> kin.Rotations:
    """Draws the rotation vectors (j, 3) of a plausible pose, radians.

    The lowest points of all feet that stand on the ground are at one height.
    """
    rotations = np.zeros((kin.JOINTS, 3))
    rotations[Joint.PELVIS] = [0.0, rng.uniform(-0.7, 0.7), 0.0]
    stance = _sample_stance(rng, build, rotations)
    bend_trunk(rng, rotations, stance.lean, stance.roll)
    # both arms may have the same goal; one that cannot keep clear of the body tries three
    both, goal = rng.random() < 0.45, draw_goal(rng)
    for side in (0, 1):
        wanted = goal if both or side == 0 else draw_goal(rng)
        for _ in range(3):
            if bend_arm(rng, build, rotations, wanted, side, other_arm=side == 1) >= 0:
                break
            wanted = draw_goal(rng)
        pose_hand(rng, rotations, side)
    return kin.limited(rotations)


def bend_trunk(
    rng: np.random.Generator, rotations: kin.Rotations, lean: float, roll: float
) -> None:
    """Sets spine, neck and head in `rotations`, at random around given angles.

    lean: mean angle by which the trunk bends forward, radians. roll: angle of the pelvis, radians,
    positive with the left side up; the spine bends against it.
    """
    bowed = rng.random() < 0.08
    lean = lean + rng.normal(0.03, 0.07) + (rng.uniform(0.2, 0.7) if bowed else 0.0)
    side, turn = rng.normal(0, 0.06) - 0.8 * roll, rng.normal(0, 0.14)
    for joint, share in ((Joint.SPINE1, 0.3), (Joint.SPINE2, 0.35), (Joint.SPINE3, 0.35)):
        rotations[joint] = np.asarray([lean, turn, side]) * share
    look = rng.normal(0, 1, 3) * [0.12, 0.28, 0.07]
    rotations[Joint.NECK], rotations[Joint.HEAD] = 0.45 * look - [0.4 * lean, 0, 0], 0.55 * look
