"""A pose prior: plausible standing, striding, crouching and reaching people, within joint limits, their soles on the ground.

Legs from `stances`, arms from `arms`, fingers from `hands`; `kinematics` has the joints, their limits and the conventions.
"""

import numpy as np

from humangs_jax.core.array_types import Float
from humangs_jax.people.arms import bend_arm, draw_goal
from humangs_jax.people.hands import pose_hand
from humangs_jax.people.kinematics import (
    FINGER_LIMIT,
    HEAD,
    JOINTS,
    LEFT_ANKLE,
    LEFT_ELBOW,
    LEFT_FOOT,
    LEFT_HAND,
    LEFT_HIP,
    LEFT_KNEE,
    LEFT_SHOULDER,
    LEFT_WRIST,
    LIMITS,
    MIRROR,
    NECK,
    PELVIS,
    RIGHT_ANKLE,
    RIGHT_ELBOW,
    RIGHT_FOOT,
    RIGHT_HAND,
    RIGHT_HIP,
    RIGHT_KNEE,
    RIGHT_SHOULDER,
    RIGHT_WRIST,
    SPINE1,
    SPINE2,
    SPINE3,
    Build,
    joint_positions,
    limited,
    rotation_matrix,
    rotation_vector,
)
from humangs_jax.people.stances import sample_stance

__all__ = [
    "FINGER_LIMIT",
    "HEAD",
    "JOINTS",
    "LEFT_ANKLE",
    "LEFT_ELBOW",
    "LEFT_FOOT",
    "LEFT_HAND",
    "LEFT_HIP",
    "LEFT_KNEE",
    "LEFT_SHOULDER",
    "LEFT_WRIST",
    "LIMITS",
    "MIRROR",
    "NECK",
    "PELVIS",
    "RIGHT_ANKLE",
    "RIGHT_ELBOW",
    "RIGHT_FOOT",
    "RIGHT_HAND",
    "RIGHT_HIP",
    "RIGHT_KNEE",
    "RIGHT_SHOULDER",
    "RIGHT_WRIST",
    "SPINE1",
    "SPINE2",
    "SPINE3",
    "Build",
    "bend_trunk",
    "joint_positions",
    "limited",
    "rotation_matrix",
    "rotation_vector",
    "sample_rotations",
]

BOTH_ARMS = 0.45
"""Share of people whose arms have the same goal."""
ATTEMPTS = 3
"""How often an arm may look for another goal when it cannot keep clear of the body."""
CLEAR = 0.0
"""Metres: an arm that is at least so clear is taken."""


def sample_rotations(rng: np.random.Generator, build: Build) -> Float[np.ndarray, "j 3"]:
    """(j, 3) rotation vectors of a random plausible pose; the lowest points of planted feet are at one height."""
    rotations = np.zeros((JOINTS, 3))
    rotations[PELVIS] = [0.0, rng.uniform(-0.7, 0.7), 0.0]
    stance, _ = sample_stance(rng, build, rotations)
    bend_trunk(rng, rotations, stance.lean, stance.roll)
    both, goal = rng.random() < BOTH_ARMS, draw_goal(rng)
    for side in (0, 1):
        wanted = goal if both or side == 0 else draw_goal(rng)
        for _ in range(ATTEMPTS):
            if bend_arm(rng, build, rotations, wanted, side, other_arm=side == 1) >= CLEAR:
                break
            wanted = draw_goal(rng)
        pose_hand(rng, rotations, side)
    return limited(rotations)


def bend_trunk(rng: np.random.Generator, rotations: Float[np.ndarray, "j 3"], lean: float, roll: float) -> None:
    """Set spine, neck and head in `rotations`.

    lean: how far the trunk bends forward, about. roll: of the pelvis, left side up, which the spine evens out.
    """
    bowed = rng.random() < 0.08
    lean = lean + rng.normal(0.03, 0.07) + (rng.uniform(0.2, 0.7) if bowed else 0.0)
    side, turn = rng.normal(0, 0.06) - 0.8 * roll, rng.normal(0, 0.14)
    for joint, share in ((SPINE1, 0.3), (SPINE2, 0.35), (SPINE3, 0.35)):
        rotations[joint] = np.asarray([lean, turn, side]) * share
    look = rng.normal(0, 1, 3) * [0.12, 0.28, 0.07]
    rotations[NECK], rotations[HEAD] = 0.45 * look - [0.4 * lean, 0, 0], 0.55 * look
