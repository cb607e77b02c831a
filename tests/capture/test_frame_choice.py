"""Chosen frames of a video show all directions evenly, are sharp, and have usual poses."""

import numpy as np
import pytest

from humangs_jax.capture.calibration.frame_choice import (
    choose_by_direction,
    directions_of,
    unusual,
)
from humangs_jax.capture.keypoints.keypoints import MEDIAPIPE_33

NAMES = MEDIAPIPE_33.names
FRAMES = 64


def turning(directions, bent=()):
    """Returns landmarks in camera axes of a person who faces these directions.

    The right arm is raised in the frames `bent`.
    """
    rest = np.random.default_rng(0).normal(0, 0.3, (len(NAMES), 3))
    for part, height in (("shoulder", -0.5), ("hip", 0.0)):
        rest[NAMES.index(f"left_{part}")] = 0.2, height, 0.0
        rest[NAMES.index(f"right_{part}")] = -0.2, height, 0.0
    frames = []
    for frame, direction in enumerate(directions):
        body = rest.copy()
        if frame in bent:
            for part in ("elbow", "wrist"):
                body[NAMES.index(f"right_{part}")] += (0.0, -0.9, 0.2)
        c, s = np.cos(direction), np.sin(direction)
        turn = np.asarray([[c, 0, -s], [0, 1, 0], [s, 0, c]])
        frames.append(body @ turn.T)
    return np.stack(frames)


def gaps(directions):
    """Returns degrees between neighbours on the circle."""
    around = np.sort(np.mod(directions, 2 * np.pi))
    return np.degrees(np.diff(np.append(around, around[0] + 2 * np.pi)))


def test_the_direction_of_a_body_is_found_from_its_landmarks():
    directions = np.linspace(-3, 3, 13)
    np.testing.assert_allclose(directions_of(turning(directions), NAMES), directions, atol=1e-9)


@pytest.mark.parametrize("turns", [1.0, 2.3])
def test_frames_are_even_over_the_directions_although_the_person_turns_unevenly(turns):
    """The person waits in front and hurries past the back: most frames show the front."""
    steps = np.linspace(0, 1, FRAMES)
    directions = 2 * np.pi * turns * (steps + 0.12 * np.sin(2 * np.pi * steps))
    chosen = choose_by_direction(directions, np.ones(FRAMES), 8)
    assert len(chosen) == 8 and chosen == sorted(chosen)
    assert gaps(directions[chosen]).max() < 60
    assert gaps(np.linspace(0, 1, FRAMES)[:: FRAMES // 8] ** 3 * 2 * np.pi).max() > 60


def test_blurred_frames_and_those_of_another_pose_are_not_taken():
    directions = np.linspace(0, 2 * np.pi, FRAMES, endpoint=False)
    bent = range(10, 14)
    odd = unusual(turning(directions, bent), directions, np.ones((FRAMES, len(NAMES))))
    assert odd[list(bent)].min() > 3 * np.delete(odd, list(bent)).max() + 0.01
    worth = 1 / (1 + (odd / 0.15) ** 2)
    blurred = np.arange(FRAMES) % 3 > 0
    chosen = choose_by_direction(directions, np.where(blurred, 0.2, 1.0) * worth, 8)
    assert len(chosen) == 8 and not blurred[chosen].any()
    assert not set(chosen) & set(bent)


def test_someone_who_does_not_turn_is_not_chosen_by_directions():
    swaying = 0.4 * np.sin(np.linspace(0, 20, FRAMES))
    assert choose_by_direction(swaying, np.ones(FRAMES), 8) == []
    assert choose_by_direction(np.linspace(0, 6, FRAMES), np.zeros(FRAMES), 8) == []


def test_half_a_turn_gives_the_frames_that_there_are():
    directions = np.linspace(0, np.pi, FRAMES)
    chosen = choose_by_direction(directions, np.ones(FRAMES), 16)
    assert 8 <= len(chosen) <= 9 and gaps(directions[chosen])[:-1].max() < 40
