"""The pose prior: limits, kinematics, arms clear of the body."""

import numpy as np
import pytest

from humangs_jax.body.library import load_body
from humangs_jax.body.model import BodyPose, pose_body, rest_pose, shape_body
from humangs_jax.data.synthetic import poses

CLOSE = 1e-4
"""Metres or radians after 10 chained float32 rotations against float64."""


@pytest.fixture(scope="module")
def body():
    return load_body()


@pytest.fixture(scope="module")
def build(body):
    joints = np.asarray(body.joint_regressor @ body.template, float)
    return poses.Build(joints, body.parents, 0.13, 0.1, 0.08, 0.035)


@pytest.mark.parametrize("angle", [0.0, 1e-5, 0.3, 2.0, 3.0])
def test_rotation_vectors_round_trip(angle):
    vectors = angle * np.asarray([[1.0, 0, 0], [0, -0.6, 0.8], [0.48, 0.6, 0.64]])
    np.testing.assert_allclose(poses.rotation_vector(poses.rotation_matrix(vectors)), vectors, atol=1e-7)


def test_all_joints_stay_within_their_limits(build):
    drawn = np.stack([poses.sample_rotations(np.random.default_rng(seed), build) for seed in range(40)])
    angles = np.linalg.norm(drawn, axis=-1)
    for joint, limit in poses.LIMITS.items():
        assert angles[:, joint].max() <= limit + 1e-9, joint
    assert angles[:, poses.LEFT_HAND :].max() <= poses.FINGER_LIMIT + 1e-9
    assert (angles[:, 22:25] == 0).all()
    assert (angles.std(0)[:22] > 0.01).all()  # every joint of the body takes part


def test_knees_and_elbows_bend_one_way(build):
    drawn = np.stack([poses.sample_rotations(np.random.default_rng(seed), build) for seed in range(40)])
    assert (drawn[:, [poses.LEFT_KNEE, poses.RIGHT_KNEE], 0] >= 0).all()
    assert (drawn[:, poses.LEFT_ELBOW, 1] < 0).all() and (drawn[:, poses.RIGHT_ELBOW, 1] > 0).all()


def test_kinematics_are_those_of_the_body_model(body, build):
    rotations = poses.sample_rotations(np.random.default_rng(3), build).astype(np.float32)
    _, positions = poses.joint_positions(build, rotations)
    rest = shape_body(body, np.zeros(1, np.float32) + rest_pose(body).translation[:1])
    posed = pose_body(body, rest, BodyPose(rotations + rest_pose(body).rotations, rest_pose(body).translation))
    np.testing.assert_allclose(positions, posed.joints, atol=CLOSE)


def test_hands_stay_clear_of_the_trunk(build):
    """Wrists lie outside of the trunk's capsule in nearly all poses."""
    inside = 0
    for seed in range(40):
        world, positions = poses.joint_positions(build, poses.sample_rotations(np.random.default_rng(seed), build))
        wrists = positions[[poses.LEFT_WRIST, poses.RIGHT_WRIST]]
        inside += (poses._clearance(build, positions, world, wrists) < -0.01).sum()
    assert inside <= 2  # of 80


def test_mirrored_goals_give_both_arms_the_same_freedom(build):
    drawn = np.stack([poses.sample_rotations(np.random.default_rng(seed), build) for seed in range(60)])
    left = drawn[:, poses.LEFT_SHOULDER] * poses.MIRROR
    right = drawn[:, poses.RIGHT_SHOULDER]
    assert np.abs(left.mean(0) - right.mean(0)).max() < 0.35  # means of 60 draws of spread 0.6
