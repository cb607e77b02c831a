"""Made-up motions of people on the floor and on their feet, y up.

What touches the floor stays where it is.
"""

import functools

import numpy as np
from scipy.spatial.transform import Rotation

from humangs_jax.body.joints import JOINT_NAMES
from humangs_jax.motion.rules import joint_places
from humangs_jax.motion.skeleton import shipped_joints

INDEX = {name: i for i, name in enumerate(JOINT_NAMES)}
FPS, FRAMES = 30.0, 48
TIMES = np.arange(FRAMES) / FPS
UP = {
    "y": Rotation.identity(),
    "z": Rotation.from_euler("x", 90, degrees=True),
    "-y": Rotation.from_euler("x", 180, degrees=True),
}
"""Rotations from our world to one in which another axis is up."""


def _poses(root, **joints):
    rotations = np.zeros((FRAMES, 55, 3))
    for name, turn in {"pelvis": root, **joints}.items():
        rotations[:, INDEX[name]] = turn
    return rotations


def _on_the_floor(rotations):
    """Returns translations with which the lowest joint is at height 0 and does not slide."""
    joints, moves = shipped_joints(), np.zeros((FRAMES, 3))
    places = joint_places(joints, rotations, moves)
    lowest = places[..., 1].argmin(axis=1)
    for frame in range(1, FRAMES):
        slip = places[frame, lowest[frame]] - places[frame - 1, lowest[frame]]
        moves[frame] = moves[frame - 1] - slip
    moves[:, 1] = -places[..., 1].min(axis=1)
    return moves


def _about(axis, degrees):
    return Rotation.from_euler(axis, degrees, degrees=True).as_rotvec()


def _lying(side):
    wave = 0.3 * np.sin(4 * TIMES)[:, None] * [1.0, 0.5, 0.2]
    return _poses(
        _about("x", side),
        left_shoulder=_about("z", -70) + wave,
        right_shoulder=_about("z", 70),
        head=0.5 * wave,
    )


def _crawling():
    swing = 20 * np.sin(2 * np.pi * TIMES)
    arms = [
        Rotation.from_euler("yx", np.stack([0 * swing + y, s * swing], 1), degrees=True).as_rotvec()
        for s, y in ((-1, -88), (1, 88))
    ]
    legs = [_about("x", (s * swing - 90)[:, None]) for s in (1, -1)]
    knees = dict.fromkeys(("left_knee", "right_knee"), _about("x", 90))
    return _poses(
        _about("x", 90),
        left_shoulder=arms[0],
        right_shoulder=arms[1],
        left_hip=legs[0],
        right_hip=legs[1],
        **knees,
    )


def _walking():
    swing = 25 * np.sin(2 * np.pi * TIMES)
    legs = [_about("x", (s * swing)[:, None]) for s in (1, -1)]
    knees = [
        _about("x", np.maximum(s * 50 * np.cos(2 * np.pi * TIMES), 0)[:, None]) for s in (-1, 1)
    ]
    arms = {"left_shoulder": _about("z", -70), "right_shoulder": _about("z", 70)}
    return _poses(
        [0.0, 0, 0],
        left_hip=legs[0],
        right_hip=legs[1],
        left_knee=knees[0],
        right_knee=knees[1],
        **arms,
    )


def _upside_down(turns):
    arms = {"left_shoulder": _about("z", 75), "right_shoulder": _about("z", -75)}
    wave = 0.15 * np.sin(5 * TIMES)[:, None] * [1.0, 0.2, 0.5]
    return _poses(turns, left_hip=wave, right_hip=-wave, **arms)


@functools.cache
def motions():
    """Returns (rotations (m, 55, 3), translations (m, 3)) by what the person does."""
    turning = np.linspace(0, 2 * np.pi, FRAMES)[:, None] * [0, 0, 1.0]
    made = {
        "walking": _walking(),
        "lying on the back": _lying(-90),
        "lying on the front": _lying(90),
        "crawling": _crawling(),
        "handstand": _upside_down(_about("x", 180)),
        "cartwheel": _upside_down(turning),
        "upside down in a cartwheel": _upside_down(0.4 * turning + [0, 0, 0.6 * np.pi]),
    }
    return {name: (rotations, _on_the_floor(rotations)) for name, rotations in made.items()}


def in_world(rotations, translations, turn):
    """Returns the motion in coordinates turned by a rotation."""
    rotations, pelvis = rotations.copy(), shipped_joints()[0]
    rotations[:, 0] = (turn * Rotation.from_rotvec(rotations[:, 0])).as_rotvec()
    return rotations, turn.apply(translations + pelvis) - pelvis
