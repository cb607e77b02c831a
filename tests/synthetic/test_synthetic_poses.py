"""The prior of poses: limits, kinematics, soles on the ground, hands and limbs off the body."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from humangs_jax.body.library import load_body
from humangs_jax.body.model import BodyPose, pose_body, rest_pose, shape_body
from humangs_jax.body.resolution import decimate
from humangs_jax.rendering.mesh.rasterizer import vertex_normals
from humangs_jax.synthetic import anatomy as kin
from humangs_jax.synthetic.poses import (
    STANCES,
    arm_clearance,
    pose_hand,
    sample_rotations,
    take_stance,
)

CLOSE = 1e-4
"""Error of 10 chained float32 rotations against float64, metres or radians."""
SEEDS = range(40)
INSIDE = 0.012
"""Largest share of vertices inside another part, mean over poses; creases alone are 0.7 %."""


@functools.cache
def mean_build():
    body = load_body()
    joints = np.asarray(body.joint_regressor @ body.template, float)
    return kin.Build(joints, body.parents, 0.13, 0.1, 0.08, 0.035)


@pytest.fixture(scope="module")
def build():
    return mean_build()


@pytest.fixture(scope="module")
def drawn(build):
    return np.stack([sample_rotations(np.random.default_rng(seed), build) for seed in SEEDS])


@pytest.fixture(scope="module")
def posed(body):
    """Returns a function of rotations (j, 3) that gives the mean body's vertices (n, 3)."""
    rest = shape_body(body, jnp.zeros(0))
    pose = jax.jit(
        lambda rotations: pose_body(body, rest, BodyPose(rotations, jnp.zeros(3))).vertices
    )
    return lambda rotations: np.asarray(pose(jnp.asarray(rotations, jnp.float32)))


@given(st.lists(st.floats(-1.7, 1.7), min_size=6, max_size=6), st.floats(0, 1))
@settings(deadline=None, max_examples=30)
def test_halfway_rotations_are_on_the_way(numbers, t):
    a, b = np.asarray(numbers[:3]), np.asarray(numbers[3:])
    middle = kin.between(a, b, t)

    def angle(x, y):
        return np.linalg.norm(
            kin.rotation_vector(kin.rotation_matrix(x).T @ kin.rotation_matrix(y))
        )

    np.testing.assert_allclose(
        [angle(a, middle), angle(middle, b)], [t * angle(a, b), (1 - t) * angle(a, b)], atol=1e-6
    )


def test_all_joints_stay_within_their_limits(drawn):
    angles = np.linalg.norm(drawn, axis=-1)
    for joint, limit in enumerate(kin.LIMITS):
        assert angles[:, joint].max() <= limit + 1e-9, joint
    assert angles[:, kin.Joint.LEFT_HAND :].max() <= kin.FINGER_LIMIT + 1e-9
    assert (angles[:, 22:25] == 0).all()
    assert (angles.std(0)[:22] > 0.01).all()  # every joint of the body takes part
    assert (angles.std(0)[kin.Joint.LEFT_HAND :] > 0.01).all()  # and every joint of the hands


def test_knees_elbows_and_fingers_bend_one_way(drawn):
    # rest knees are not quite straight
    assert (drawn[:, [kin.Joint.LEFT_KNEE, kin.Joint.RIGHT_KNEE], 0] >= -0.03).all()
    assert (drawn[:, kin.Joint.LEFT_ELBOW, 1] < 0).all() and (
        drawn[:, kin.Joint.RIGHT_ELBOW, 1] > 0
    ).all()
    for first, sign in ((kin.Joint.LEFT_HAND, -1), (kin.Joint.RIGHT_HAND, 1)):
        bends = sign * drawn[:, first : first + 12, 2]  # towards the palm
        assert bends.min() > -0.12 and bends.max() > 1.0 and np.median(bends) > 0.1


def test_kinematics_are_those_of_the_body_model(body, build, drawn):
    rotations = drawn[3].astype(np.float32)
    _, positions = kin.joint_positions(build, rotations)
    rest = shape_body(body, np.zeros(1, np.float32) + rest_pose(body).translation[:1])
    pose = jax.jit(pose_body)(
        body, rest, BodyPose(rotations + rest_pose(body).rotations, rest_pose(body).translation)
    )
    np.testing.assert_allclose(positions, pose.joints, atol=CLOSE)


@given(
    st.floats(-0.3, 0.3),
    st.floats(-0.4, 0.4),
    st.floats(-0.5, 0.5),
    st.floats(-0.4, 0.7),
    st.floats(0, 0.3),
    st.floats(0, 0.3),
)
@settings(deadline=None, max_examples=40)
def test_legs_put_the_feet_where_they_are_to_be(x, z, yaw, pitch, lift, sink):
    build = mean_build()
    joints = build.joints
    feet = (kin.Foot(0.12 + x, z, yaw, pitch, lift), kin.Foot(-0.12, 0.05, 0.0))
    rotations = np.zeros((kin.JOINTS, 3))
    rotations[kin.Joint.PELVIS] = [0.1, 0.3, 0.05]
    height = kin.highest_pelvis(build, kin.rotation_matrix(rotations[0]), 0.0, 0.0, feet) - sink
    pelvis = np.asarray([0.0, height, 0.0])
    assert kin.place_feet(build, rotations, pelvis, feet) < 1e-9
    world, positions = kin.joint_positions(build, rotations)
    positions = positions + pelvis - positions[kin.Joint.PELVIS]
    for side, foot in enumerate(feet):
        ankle, orientation = kin.ankle_of(build, side, foot)
        np.testing.assert_allclose(positions[kin.Joint.LEFT_ANKLE + side], ankle, atol=1e-9)
        np.testing.assert_allclose(world[kin.Joint.LEFT_ANKLE + side], orientation, atol=1e-9)
        if foot.pitch >= 0:  # the ball is above its place, the toes are flat
            ball = positions[kin.Joint.LEFT_FOOT + side]
            np.testing.assert_allclose(ball[[0, 2]], [foot.x, foot.z], atol=1e-9)
            np.testing.assert_allclose(
                ball[1], foot.lift + joints[kin.Joint.LEFT_FOOT + side, 1] - build.sole, atol=1e-9
            )
            np.testing.assert_allclose(world[kin.Joint.LEFT_FOOT + side][1], [0, 1, 0], atol=1e-9)


def test_both_soles_are_on_the_ground(body, build, posed):
    """The lowest points of both feet are at one height, unless one leg is raised."""
    part = np.asarray(body.skinning_weights).argmax(1)
    soles = [
        np.isin(part, (kin.Joint.LEFT_ANKLE + side, kin.Joint.LEFT_FOOT + side)) for side in (0, 1)
    ]
    gaps = {}
    for name, (_, draw) in STANCES.items():
        for seed in range(4):
            rotations = np.zeros((kin.JOINTS, 3))
            stance = draw(np.random.default_rng(seed), build.hip_width / build.leg)
            _, missed = take_stance(build, rotations, 0.3, stance)
            if missed < 1e-6 and all(foot.lift == 0 for foot in stance.feet):
                low = [posed(rotations)[sole, 1].min() for sole in soles]
                gaps.setdefault(name, []).append(abs(low[0] - low[1]))
    assert set(gaps) == set(STANCES) - {"one leg"}
    # a sole is round where the model of a foot has corners
    assert max(max(values) for values in gaps.values()) < 0.012
    assert np.mean(gaps["stand"]) < 1e-3


def test_hands_stay_clear_of_the_body(build, drawn):
    """In nearly all poses forearms and hands lie outside of trunk, legs, head and the other arm."""
    clear = np.asarray([arm_clearance(build, rotations) for rotations in drawn])
    assert (clear < -0.01).mean() < 0.06


def winding_numbers(points, vertices, faces):
    """Returns how often a mesh winds around each point.

    This is the sum of the signed solid angles of its faces over 4 pi.
    """
    dot = lambda x, y: jnp.sum(x * y, axis=-1)

    def winding_number(point):
        a, b, c = (vertices[faces[:, i]] - point for i in range(3))
        la, lb, lc = (jnp.linalg.norm(x, axis=-1) for x in (a, b, c))
        below = la * lb * lc + dot(a, b) * lc + dot(b, c) * la + dot(c, a) * lb
        return jnp.sum(2 * jnp.arctan2(dot(a, jnp.cross(b, c)), below)) / (4 * jnp.pi)

    return jax.lax.map(winding_number, points, batch_size=64)


@jax.jit
def inside_itself(body, rotations):
    """Returns which vertices lie inside of another part, 2 mm off along their normal.

    Meshes are not quite closed at mouth and eyes.
    """
    vertices = pose_body(
        body, shape_body(body, jnp.zeros(0)), BodyPose(jnp.asarray(rotations), jnp.zeros(3))
    ).vertices
    return (
        winding_numbers(
            vertices + 2e-3 * vertex_normals(vertices, body.faces), vertices, body.faces
        )
        > 0.6
    )


@pytest.mark.slow
def test_hardly_any_of_the_body_is_inside_itself(body, drawn):
    body = decimate(body, 1000)
    at_rest = inside_itself(body, np.zeros((kin.JOINTS, 3), np.float32))
    assert at_rest.mean() < 0.02  # mouth and eyes

    def inside_of(rotations):
        return np.asarray(inside_itself(body, np.float32(rotations)) & ~at_rest).mean()

    inside = [inside_of(rotations) for rotations in drawn[:10]]
    assert np.mean(inside) < INSIDE and np.max(inside) < 0.04
    folded = np.zeros((kin.JOINTS, 3))
    folded[[kin.Joint.LEFT_HIP, kin.Joint.RIGHT_HIP], 2] = -0.3, 0.3  # legs through each other
    assert inside_of(folded) > 0.04


def test_mirrored_goals_give_both_arms_the_same_freedom(drawn):
    left, right = drawn[:, kin.Joint.LEFT_SHOULDER] * kin.MIRROR, drawn[:, kin.Joint.RIGHT_SHOULDER]
    assert np.abs(left.mean(0) - right.mean(0)).max() < 0.4  # means of 40 draws of spread 0.6


def test_gestures_are_drawn_and_mirrored():
    for side, sign in ((0, 1), (1, -1)):
        drawn = []
        for seed in range(200):
            rotations = np.zeros((kin.JOINTS, 3))
            pose_hand(np.random.default_rng(seed), rotations, side)
            drawn.append(rotations)
            assert not rotations[: kin.Joint.LEFT_HAND].any()
        curls = (
            -sign
            * np.asarray(drawn)[
                :, (kin.Joint.LEFT_HAND, kin.Joint.RIGHT_HAND)[side] + np.arange(12), 2
            ]
        )
        index, others = curls[:, :3].mean(1), curls[:, 3:].mean(1)
        assert ((index < 0.3) & (others > 0.8)).any()  # pointing
        assert ((index > 0.9) & (others > 0.9)).any()  # fists
        assert ((index < 0.1) & (others < 0.1)).any()  # flat
    same = [np.zeros((kin.JOINTS, 3)) for _ in range(2)]
    for side in (0, 1):
        pose_hand(np.random.default_rng(7), same[side], side)
    np.testing.assert_allclose(same[0][25:40] * kin.MIRROR, same[1][40:55])
