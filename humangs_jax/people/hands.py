"""Hands between a few gestures: relaxed, flat, spread, a fist, pointing, holding."""

import dataclasses

import numpy as np

from humangs_jax.core.array_types import Float
from humangs_jax.people.kinematics import FINGER_LIMIT, LEFT_HAND, MIRROR, RIGHT_HAND

FINGERS = ("index", "middle", "pinky", "ring")
"""In the order of SMPL-X's joints; the thumb comes last."""
BONE_SHARE = (0.85, 1.0, 0.7)
"""Of a finger's curl that its knuckles take, from the palm outwards."""
SPLAY = {"index": 1.0, "middle": 0.15, "ring": -0.6, "pinky": -1.2}


@dataclasses.dataclass(frozen=True)
class Gesture:
    """odds: of being drawn. curl: of index, middle, ring, pinky, radians a knuckle. spread: angle between fingers.

    thumb: how far it lies across the palm, 0 beside it, 1 across.
    """

    odds: float
    curl: tuple[float, float, float, float]
    spread: float = 0.0
    thumb: float = 0.2


GESTURES = {
    "relaxed": Gesture(0.4, (0.25, 0.32, 0.38, 0.42), 0.03, 0.25),
    "flat": Gesture(0.15, (0.03, 0.03, 0.04, 0.05), 0.0, 0.05),
    "spread": Gesture(0.1, (0.0, 0.0, 0.0, 0.0), 0.16, -0.3),
    "fist": Gesture(0.12, (1.3, 1.35, 1.35, 1.35), 0.0, 1.0),
    "point": Gesture(0.06, (0.02, 1.2, 1.3, 1.3), 0.0, 0.8),
    "two": Gesture(0.03, (0.02, 0.02, 1.3, 1.3), 0.12, 0.9),
    "thumb up": Gesture(0.03, (1.2, 1.3, 1.3, 1.3), 0.0, -0.4),
    "hold": Gesture(0.11, (0.65, 0.7, 0.75, 0.8), 0.05, 0.6),
}


def pose_hand(rng: np.random.Generator, rotations: Float[np.ndarray, "j 3"], side: int) -> None:
    """Set the 15 joints of one hand (0 left, 1 right) in `rotations`: on the way from relaxed to some gesture."""
    first, mirror = (LEFT_HAND, np.ones(3)) if side == 0 else (RIGHT_HAND, MIRROR)
    odds = np.asarray([gesture.odds for gesture in GESTURES.values()])
    goal = list(GESTURES.values())[rng.choice(len(odds), p=odds / odds.sum())]
    start, t = GESTURES["relaxed"], rng.beta(2.5, 1.0)
    mix = lambda a, b: (1 - t) * np.asarray(a) + t * np.asarray(b)
    index, middle, ring, pinky = mix(start.curl, goal.curl)
    curls = {"index": index, "middle": middle, "ring": ring, "pinky": pinky}
    spread, thumb = mix(start.spread, goal.spread), mix(start.thumb, goal.thumb) + rng.normal(0, 0.08)
    for finger, name in enumerate(FINGERS):
        curl = curls[name] * rng.uniform(0.85, 1.15) + rng.normal(0, 0.03)
        for bone, share in enumerate(BONE_SHARE):
            # fingers do not bend backwards, and spread at the palm only
            bend = np.clip(curl * share * rng.uniform(0.9, 1.1), -0.1, FINGER_LIMIT - 0.1)
            aside = SPLAY[name] * spread if bone == 0 else 0.0
            rotations[first + 3 * finger + bone] = np.asarray([0, -aside, -bend]) * mirror
    rotations[first + 12] = np.asarray([0.25 * thumb, 0.45 * thumb, -0.35 * thumb]) * mirror
    rotations[first + 13] = np.asarray([0.0, 0.35 * thumb, -0.1 * thumb]) * mirror
    rotations[first + 14] = np.asarray([0.0, 0.5 * max(thumb, 0.0), 0.0]) * mirror
