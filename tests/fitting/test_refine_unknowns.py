"""What refinement moves, and how."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from humangs_jax.body import skinning
from humangs_jax.body.joints import JOINT_NAMES
from humangs_jax.body.model import BodyPose, pose_body, shape_body
from humangs_jax.core.pytree import replace
from humangs_jax.data.capture import Capture
from humangs_jax.fitting.refinement.rounds import RoundConfig, moved_capture, start_of
from humangs_jax.fitting.refinement.unknowns import (
    Spreads,
    moved_cameras,
    moved_poses,
    moved_shape,
    nothing_moved,
    root_turns,
    same_cameras,
    same_focals,
    segments,
)
from humangs_jax.geometry.camera import intrinsics_from_fov, orbit
from tests.fitting.fit_people import default_body

SPREADS = Spreads()


@pytest.fixture(scope="module")
def capture():
    """Two moments; view 2 is by the camera of view 0. The root is turned by nearly half a turn."""
    K = intrinsics_from_fov(1.0, 64, 48)
    cameras = orbit(jnp.zeros(3), 3.0, jnp.asarray([0.3, 2.0, 0.3]), 0.1, K, 64, 48)
    rotations = np.random.default_rng(0).normal(0, 0.2, (2, len(JOINT_NAMES), 3)).astype(np.float32)
    rotations[:, 0] = [[0, 3.1, 0.2], [0, 0, 0]]
    poses = BodyPose(jnp.zeros((1, 3)), jnp.zeros(3))
    poses = replace(poses, rotations=jnp.asarray(rotations), translation=jnp.asarray([[0, 0.1, 0], [0.2, 0, 0.0]]))
    images = np.ones((3, 48, 64, 3), np.float32)
    frames = np.asarray([0, 0, 1], np.int32)
    return Capture(images, None, cameras, frames, default_body(), np.zeros(3, np.float32), poses, ("a", "b", "c"))


@pytest.fixture(scope="module")
def start(capture):
    return start_of(capture, capture.cameras, RoundConfig(coefficients=5))


def random_move(start, seed=0):
    rng = np.random.default_rng(seed)
    return jax.tree.map(lambda leaf: jnp.asarray(rng.normal(size=leaf.shape), jnp.float32), nothing_moved(start))


def test_views_by_one_camera_share_it_and_equal_focal_lengths_are_one_unless_told_otherwise(capture):
    camera = same_cameras(capture.cameras)
    assert camera.tolist() == [0, 1, 0]
    assert same_focals(capture.cameras, camera, True).tolist() == [0, 0, 0]
    assert same_focals(capture.cameras, camera, False).tolist() == [0, 1, 0]
    zoomed = replace(capture.cameras, K=capture.cameras.K * jnp.asarray([1.0, 1.01, 1.0])[:, None, None])
    assert same_focals(zoomed, camera, True).tolist() == [0, 1, 0]


def test_nothing_moved_is_the_start_with_the_shape_filled_up(capture, start):
    same = moved_capture(capture, start, SPREADS, nothing_moved(start))
    np.testing.assert_allclose(same.cameras.cam_from_world, capture.cameras.cam_from_world, atol=1e-6)
    np.testing.assert_array_equal(same.cameras.K, capture.cameras.K)
    np.testing.assert_allclose(same.poses.rotations, capture.poses.rotations, atol=2e-6)
    assert same.betas.tolist() == [0.0] * 5


def test_a_turned_camera_stays_in_its_place_by_the_spread_and_focal_lengths_scale(capture, start):
    move = nothing_moved(start)
    move = replace(move, turns=move.turns.at[1, 2].set(1.0), zooms=move.zooms + 1.0)
    K, matrices = moved_cameras(start, SPREADS, move)
    moved = replace(capture.cameras, cam_from_world=matrices)
    np.testing.assert_allclose(moved.center, capture.cameras.center, atol=1e-5)
    np.testing.assert_allclose(matrices[0], capture.cameras.cam_from_world[0], atol=1e-6)
    relative = matrices[1, :3, :3] @ capture.cameras.cam_from_world[1, :3, :3].T
    assert np.degrees(np.arccos((np.trace(relative) - 1) / 2)) == pytest.approx(SPREADS.turn, rel=1e-2)
    factors = np.asarray(K / jnp.where(capture.cameras.K == 0, 1, capture.cameras.K))
    np.testing.assert_allclose(factors[:, [0, 1], [0, 1]], np.exp(SPREADS.focal), rtol=1e-6)
    np.testing.assert_array_equal(K[:, :2, 2], capture.cameras.K[:, :2, 2])


def test_a_shifted_camera_shifts_in_both_views_that_are_its_own(capture, start):
    move = nothing_moved(start)
    move = replace(move, shifts=move.shifts.at[0].set(jnp.asarray([0.0, 2.0, 0.0])))
    moved = replace(capture.cameras, cam_from_world=moved_cameras(start, SPREADS, move)[1])
    shift = np.asarray(moved.center - capture.cameras.center)
    np.testing.assert_allclose(shift, [[0, 2 * SPREADS.shift, 0], [0, 0, 0], [0, 2 * SPREADS.shift, 0]], atol=1e-5)


def test_poses_with_the_turn_of_the_root_in_them_put_the_body_where_the_turn_beside_them_does(capture, start):
    move = random_move(start)
    betas, poses = moved_shape(start, SPREADS, move), moved_poses(start, SPREADS, move)
    turns, rest_joints = root_turns(start, SPREADS, move, betas, poses)
    moved = moved_capture(capture, start, SPREADS, move)
    rest = shape_body(capture.body, betas)
    chain = jax.jit(jax.vmap(lambda r, t: skinning.joint_transforms(rest_joints, start.parents, r, t)))
    joints_of = jax.jit(jax.vmap(lambda pose: pose_body(capture.body, rest, pose).joints))
    transforms = turns[:, None] @ chain(poses.rotations, poses.translation)
    joints = np.stack([skinning.apply_transforms(own, rest_joints) for own in transforms])
    np.testing.assert_allclose(joints_of(moved.poses), joints, atol=2e-5)
    assert np.abs(joints_of(capture.poses) - joints).max() > 0.02


def test_fingers_and_eyes_wear_what_the_joint_above_them_wears(start):
    joints = np.asarray(start.joints)
    assert 0 not in joints and "left_index1" not in [JOINT_NAMES[j] for j in joints]
    own = segments(start.parents, joints)
    of = lambda name: own[JOINT_NAMES.index(name)]
    assert of("pelvis") == 0 and of("left_index2") == of("left_wrist") != of("right_wrist")
    assert of("left_eye") == of("head")


def test_refined_captures_keep_what_is_not_refined(capture, start):
    moved = moved_capture(capture, start, SPREADS, random_move(start))
    assert moved.images is capture.images and moved.names == capture.names
    fingers = [j for j, name in enumerate(JOINT_NAMES) if "index" in name]
    np.testing.assert_array_equal(moved.poses.rotations[:, fingers], capture.poses.rotations[:, fingers])
    assert dataclasses.replace(moved, betas=capture.betas).body is capture.body
