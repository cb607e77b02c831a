"""Sequences are smooth and within reach, and their feet do not slide."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from humangs_jax.body.model import BodyPose, pose_body, shape_body
from humangs_jax.synthetic import anatomy as kin
from humangs_jax.synthetic.poses import arm_clearance
from humangs_jax.synthetic.sequences import KINDS, sample_sequence

FRAMES = 50
CASES = [(kind, seed) for kind in KINDS for seed in (0, 1)]
SLIDE = 1.2e-3
"""Largest move of a planted sole, metres a frame (3.6 cm/s): as a foot rolls, its round sole
touches elsewhere.
"""
SUNK = 5e-3
"""Largest depth of a planted sole below the ground, metres; heel and toes come up by more."""


@pytest.fixture(scope="module")
def build(body):
    return kin.Build(
        np.asarray(body.joint_regressor @ body.template, float),
        body.parents,
        0.13,
        0.1,
        0.08,
        0.035,
    )


@pytest.fixture(scope="module")
def drawn(build):
    return {
        case: sample_sequence(np.random.default_rng(case[1]), build, FRAMES, case[0])
        for case in CASES
    }


@pytest.fixture(scope="module")
def feet(body, drawn):
    """Returns by case the vertices (m, 2, n, 3) of both feet."""
    part = np.asarray(body.skinning_weights).argmax(1)
    chosen = [np.flatnonzero(np.isin(part, (7 + side, 10 + side))) for side in (0, 1)]
    count = min(map(len, chosen))
    chosen = np.stack([c[:count] for c in chosen])
    rest = shape_body(body, jnp.zeros(0))
    pose = jax.jit(lambda r, t: pose_body(body, rest, BodyPose(r, t)).vertices[chosen])
    f32 = lambda x: jnp.asarray(x, jnp.float32)
    return {
        case: np.stack(
            [pose(f32(r), f32(t)) for r, t in zip(s.rotations, s.translations, strict=True)]
        )
        for case, s in drawn.items()
    }


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES)
def test_planted_soles_are_on_the_ground_and_do_not_slide(drawn, feet, case):
    sequence, vertices = drawn[case], feet[case]
    assert sequence.planted.any(axis=1).all()  # never in the air
    lowest = vertices[..., 1].min(-1)
    assert np.abs(lowest[sequence.planted]).max() < 0.015
    assert lowest.min() > -SUNK
    slides = []
    for f in range(FRAMES - 1):
        for side in (0, 1):
            if sequence.planted[f : f + 2, side].all():
                now, then = vertices[f, side], vertices[f + 1, side]
                touching = (now[:, 1] < lowest[f, side] + 4e-3) & (
                    then[:, 1] < lowest[f + 1, side] + 4e-3
                )
                slides += np.linalg.norm((then - now)[touching][:, [0, 2]], axis=1).tolist()
    assert len(slides) > 100 and np.mean(slides) < SLIDE / 3 and np.quantile(slides, 0.99) < SLIDE


@pytest.mark.parametrize("case", CASES)
def test_motions_are_smooth(drawn, case):
    sequence = drawn[case]
    matrices = kin.rotation_matrix(sequence.rotations)
    steps = np.linalg.norm(
        kin.rotation_vector(np.swapaxes(matrices[:-1], -1, -2) @ matrices[1:]), axis=-1
    )
    assert steps.max() < np.deg2rad(22)  # a swinging shin makes 500 degrees a second
    assert steps.max() > np.deg2rad(3)  # it moves
    # m/s^2
    assert np.linalg.norm(np.diff(sequence.translations, 2, axis=0), axis=1).max() * 30**2 < 12


@pytest.mark.parametrize("case", CASES)
def test_legs_and_arms_keep_to_their_limits(build, drawn, case):
    for rotations in drawn[case].rotations:
        assert kin.excess(rotations, tuple(range(1, 22))) < 0.05
        assert (rotations[[kin.Joint.LEFT_KNEE, kin.Joint.RIGHT_KNEE], 0] > -0.03).all()
    inside = [arm_clearance(build, rotations) < -0.03 for rotations in drawn[case].rotations]
    assert np.mean(inside) < 0.1


def test_walks_get_on_and_turns_turn(drawn):
    way = lambda s: np.linalg.norm(s.translations[-1] - s.translations[0])

    def heading(s):
        return np.unwrap(
            np.arctan2(*np.moveaxis(kin.rotation_matrix(s.rotations[:, 0])[:, [0, 2], 2], -1, 0))
        )

    for case, sequence in drawn.items():
        if case[0] == "walk":
            assert way(sequence) > 0.6
            step = np.diff(sequence.translations, axis=0)[:, [0, 2]]
            facing = np.stack([np.sin(heading(sequence)), np.cos(heading(sequence))], -1)[:-1]
            assert (np.sum(step * facing, 1) > 0).all()  # forwards
        if case[0] == "turn":
            assert way(sequence) < 0.6
            assert np.ptp(heading(sequence)) > 0.5
        if case[0] == "reach":
            assert sequence.planted.all()


def test_a_seed_is_a_motion_and_kinds_are_drawn(build, drawn):
    again = sample_sequence(np.random.default_rng(0), build, FRAMES, "walk")
    np.testing.assert_array_equal(again.rotations, drawn["walk", 0].rotations)
    assert {
        sample_sequence(np.random.default_rng(seed), build, 2).kind for seed in range(12)
    } == set(KINDS)
