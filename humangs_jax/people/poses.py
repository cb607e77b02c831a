"""A pose prior: plausible standing, striding, crouching and reaching people, within joint limits, their soles on the ground.

Stances place the feet and the pelvis; `arms` has arms and hands; `kinematics` has the joints, their limits and the conventions.
"""

import dataclasses
from collections.abc import Callable

import numpy as np

from humangs_jax.people import kinematics as kin
from humangs_jax.people.arms import bend_arm, draw_goal, pose_hand
from humangs_jax.people.noise import choice

TRIES = 20
"""Stances tried until one is within the limits of the joints; after that the person stands upright."""


@dataclasses.dataclass(frozen=True)
class Stance:
    """Feet and pelvis before the person is turned. Lengths in legs, x to the left of the pelvis, z in front of it.

    feet: left, right. sink: how much lower the pelvis is than it could be, in legs. tilt: of the pelvis forward. roll: of the
    pelvis, left side up. lean: how far forward the trunk bends to keep the balance.
    """

    feet: kin.Feet
    sink: float = 0.0
    tilt: float = 0.0
    roll: float = 0.0
    lean: float = 0.0


def sample_stance(rng: np.random.Generator, build: kin.Build, rotations: kin.Rotations) -> Stance:
    """Set legs and pelvis in `rotations`, keeping the pelvis's heading; returns the stance."""
    heading, width = rotations[kin.PELVIS, 1], build.hip_width / build.leg
    for _ in range(TRIES):
        stance = STANCES[choice(rng, {name: odds for name, (odds, _) in STANCES.items()})][1](rng, width)
        _, missed = take_stance(build, rotations, heading, stance)
        if missed < 1e-6 and kin.excess(rotations, tuple(j for leg in kin.LEGS for j in leg)) < 0:
            return stance
    stance = _stand(rng, width)
    take_stance(build, rotations, heading, stance)
    return stance


def take_stance(build: kin.Build, rotations: kin.Rotations, heading: float, stance: Stance) -> tuple[kin.Vector, float]:
    """Set pelvis and legs. Returns the pelvis's position, the ground at y = 0, and the larger error of the two feet, metres."""
    turn = kin.turned(y=heading) @ kin.turned(x=stance.tilt, z=stance.roll)
    rotations[kin.PELVIS] = kin.rotation_vector(turn)
    feet = in_world(stance.feet, build.leg, heading)
    pelvis = np.asarray([0.0, kin.highest_pelvis(build, turn, 0.0, 0.0, feet) - stance.sink * build.leg, 0.0])
    return pelvis, kin.place_feet(build, rotations, pelvis, feet)


def in_world(feet: kin.Feet, leg: float, heading: float) -> kin.Feet:
    """The feet of a stance (lengths in legs, unturned) in metres, turned by the heading."""
    placed = []
    for foot in feet:
        x, _, z = kin.turned(y=heading) @ np.asarray([foot.x * leg, 0.0, foot.z * leg])
        placed.append(kin.Foot(float(x), float(z), heading + foot.yaw, foot.pitch, foot.lift * leg))
    return placed[0], placed[1]


def _pair(rng, width, *, spread=(0.0, 0.08), apart=(0.0, 0.06), turn_out=(-0.05, 0.35)):
    """Two flat feet about as far apart as the hips."""
    feet = []
    for sign in (1, -1):
        x = sign * (width + rng.uniform(*spread))
        feet.append(kin.Foot(x, 0.08 + rng.choice([-1, 1]) * rng.uniform(*apart), sign * rng.uniform(*turn_out)))
    return feet


def _stand(rng, width):
    return Stance(tuple(_pair(rng, width)), sink=rng.uniform(0.0, 0.015), roll=rng.normal(0, 0.02))


def _contrapposto(rng, width):
    feet, relaxed = _pair(rng, width), int(rng.integers(2))
    sign = 1 if relaxed == 0 else -1
    shift = rng.uniform(0.4, 1.0) * width * sign  # the standing foot comes below the pelvis
    feet = [dataclasses.replace(foot, x=foot.x + shift) for foot in feet]
    z = feet[relaxed].z + rng.uniform(0.0, 0.28)
    pitch, yaw = rng.choice([0.0, rng.uniform(0.1, 0.5)]), feet[relaxed].yaw + sign * rng.uniform(0, 0.3)
    feet[relaxed] = dataclasses.replace(feet[relaxed], z=z, pitch=pitch, yaw=yaw)
    return Stance(tuple(feet), sink=rng.uniform(0.0, 0.01), roll=-sign * rng.uniform(0.03, 0.12))


def _stride(rng, width):
    feet, front = _pair(rng, 0.75 * width, spread=(-0.02, 0.03), turn_out=(-0.05, 0.2)), int(rng.integers(2))
    length, share = rng.uniform(0.25, 0.85), rng.uniform(0.35, 0.6)
    feet[front] = dataclasses.replace(feet[front], z=0.08 + share * length, pitch=-rng.uniform(0, 0.3) * (length > 0.4))
    rear = rng.uniform(0.3, 0.7) * min(1.0, length / 0.5)
    feet[1 - front] = dataclasses.replace(feet[1 - front], z=0.08 - (1 - share) * length, pitch=rear)
    return Stance(tuple(feet), sink=rng.uniform(0.0, 0.04), tilt=rng.uniform(0, 0.08), lean=rng.uniform(0, 0.1))


def _wide(rng, width):
    feet = _pair(rng, width, spread=(0.12, 0.35), turn_out=(0.05, 0.5))
    return Stance(tuple(feet), sink=rng.choice([0.0, rng.uniform(0, 0.15)]), roll=rng.normal(0, 0.03))


def _squat(rng, width):
    depth, feet = rng.uniform(0.08, 0.42), _pair(rng, width, spread=(0.03, 0.2), turn_out=(0.1, 0.6))
    heels = rng.uniform(0.2, 0.6) if depth > 0.3 else 0.0
    feet = [dataclasses.replace(foot, pitch=heels, z=foot.z + 0.06) for foot in feet]
    return Stance(tuple(feet), sink=depth, tilt=0.6 * depth, lean=1.4 * depth)


def _lunge(rng, width):
    feet, front = _pair(rng, width, turn_out=(-0.05, 0.2)), int(rng.integers(2))
    feet[front] = dataclasses.replace(feet[front], z=rng.uniform(0.4, 0.7))
    feet[1 - front] = dataclasses.replace(feet[1 - front], z=-rng.uniform(0.4, 0.75), pitch=rng.uniform(0.55, 0.85))
    return Stance(tuple(feet), sink=rng.uniform(0.05, 0.3), tilt=rng.uniform(0, 0.15), lean=rng.uniform(-0.1, 0.3))


def _side_lunge(rng, width):
    feet, bent = _pair(rng, width, spread=(0.2, 0.4), turn_out=(0.1, 0.5)), int(rng.integers(2))
    sign = 1 if bent == 0 else -1
    feet = [dataclasses.replace(foot, x=foot.x - sign * rng.uniform(0.1, 0.3)) for foot in feet]
    return Stance(tuple(feet), sink=rng.uniform(0.02, 0.2), tilt=rng.uniform(0.05, 0.2), lean=rng.uniform(0, 0.3))


def _one_leg(rng, width):
    """One foot in the air: a raised knee, a kick, a foot behind."""
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


def _tiptoe(rng, width):
    pitch = rng.uniform(0.3, 0.8)
    feet = [dataclasses.replace(foot, pitch=pitch) for foot in _pair(rng, width)]
    return Stance(tuple(feet), sink=rng.uniform(0, 0.03))


STANCES: dict[str, tuple[float, Callable[[np.random.Generator, float], Stance]]] = {
    "stand": (0.26, _stand), "contrapposto": (0.2, _contrapposto), "stride": (0.22, _stride), "wide": (0.08, _wide),
    "squat": (0.06, _squat), "lunge": (0.05, _lunge), "side lunge": (0.04, _side_lunge), "one leg": (0.07, _one_leg),
    "tiptoe": (0.02, _tiptoe),
}  # fmt: skip
"""Name -> probability, and a function of a generator and the distance of a hip from the middle in legs."""


BOTH_ARMS, ATTEMPTS = 0.45, 3
"""Share of people whose arms have the same goal; how many goals are tried for an arm that cannot keep clear of the body."""


def sample_rotations(rng: np.random.Generator, build: kin.Build) -> kin.Rotations:
    """(j, 3) rotation vectors of a random plausible pose; the lowest points of planted feet are at one height."""
    rotations = np.zeros((kin.JOINTS, 3))
    rotations[kin.PELVIS] = [0.0, rng.uniform(-0.7, 0.7), 0.0]
    stance = sample_stance(rng, build, rotations)
    bend_trunk(rng, rotations, stance.lean, stance.roll)
    both, goal = rng.random() < BOTH_ARMS, draw_goal(rng)
    for side in (0, 1):
        wanted = goal if both or side == 0 else draw_goal(rng)
        for _ in range(ATTEMPTS):
            if bend_arm(rng, build, rotations, wanted, side, other_arm=side == 1) >= 0:
                break
            wanted = draw_goal(rng)
        pose_hand(rng, rotations, side)
    return kin.limited(rotations)


def bend_trunk(rng: np.random.Generator, rotations: kin.Rotations, lean: float, roll: float) -> None:
    """Set spine, neck and head in `rotations`.

    lean: how far the trunk bends forward, about. roll: of the pelvis, left side up, which the spine evens out.
    """
    bowed = rng.random() < 0.08
    lean = lean + rng.normal(0.03, 0.07) + (rng.uniform(0.2, 0.7) if bowed else 0.0)
    side, turn = rng.normal(0, 0.06) - 0.8 * roll, rng.normal(0, 0.14)
    for joint, share in ((kin.SPINE1, 0.3), (kin.SPINE2, 0.35), (kin.SPINE3, 0.35)):
        rotations[joint] = np.asarray([lean, turn, side]) * share
    look = rng.normal(0, 1, 3) * [0.12, 0.28, 0.07]
    rotations[kin.NECK], rotations[kin.HEAD] = 0.45 * look - [0.4 * lean, 0, 0], 0.55 * look
