"""States of fits: what they move, and how; the prior of poses."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from fit_people import NAMES_WITHIN_LIMITS, rotations_of

from humangs_jax.body.joints import JOINT_NAMES
from humangs_jax.body.model import BodyPose, pose_body, shape_body
from humangs_jax.core.pytree import replace
from humangs_jax.data.capture import Capture
from humangs_jax.fitting.refine import CaptureRefineConfig, capture_origin, moved_capture
from humangs_jax.fitting.state import (
    MIRROR,
    RANGES,
    StateStd,
    betas_of,
    camera_origin,
    cameras_of,
    pose_of,
    pose_prior,
    segments,
    state_of,
    usual_origin,
    violations,
    zero_state,
)
from humangs_jax.geometry import quaternion
from humangs_jax.geometry.camera import intrinsics_from_fov, orbit
from tests.fitting.fit_people import default_body

STD = StateStd()


@pytest.fixture(scope="module")
def capture():
    """Two frames; view 2 is by the camera of view 0. The root is turned by nearly half a turn."""
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
def origin(capture):
    return capture_origin(capture, capture.cameras, CaptureRefineConfig(coefficients=5))


def random_state(origin, seed=0):
    rng = np.random.default_rng(seed)
    return jax.tree.map(lambda leaf: jnp.asarray(rng.normal(size=leaf.shape), jnp.float32), zero_state(origin))


def moved(state, **changes):
    """With some fields of the cameras changed."""
    return replace(state, cameras=replace(state.cameras, **changes))


def test_views_by_one_camera_share_it_and_equal_focal_lengths_are_one_unless_told_otherwise(capture):
    of = lambda cameras, shared: camera_origin(cameras, capture.frames, shared)
    assert of(capture.cameras, True).camera.tolist() == [0, 1, 0]
    assert of(capture.cameras, True).focal.tolist() == [0, 0, 0]
    assert of(capture.cameras, False).focal.tolist() == [0, 1, 0]
    zoomed = replace(capture.cameras, K=capture.cameras.K.at[1, 0, 0].multiply(1.01))
    assert of(zoomed, True).focal.tolist() == [0, 1, 0]


def test_zeros_are_the_origin_with_the_shape_filled_up(capture, origin):
    same = moved_capture(capture, origin, zero_state(origin))
    np.testing.assert_allclose(same.cameras.cam_from_world, capture.cameras.cam_from_world, atol=1e-6)
    np.testing.assert_array_equal(same.cameras.K, capture.cameras.K)
    np.testing.assert_allclose(same.poses.rotations, capture.poses.rotations, atol=2e-6)
    assert same.betas.tolist() == [0.0] * 5


def test_a_turned_camera_stays_in_its_place_by_its_std_and_focal_lengths_scale(capture, origin):
    state = zero_state(origin)
    start = state.cameras
    state = moved(state, rotations=start.rotations.at[1, 2].set(1.0), log_focals=start.log_focals + 1.0)
    K, matrices = cameras_of(origin, state)
    cameras = replace(capture.cameras, cam_from_world=matrices)
    np.testing.assert_allclose(cameras.center, capture.cameras.center, atol=1e-5)
    np.testing.assert_allclose(matrices[0], capture.cameras.cam_from_world[0], atol=1e-6)
    relative = matrices[1, :3, :3] @ capture.cameras.cam_from_world[1, :3, :3].T
    assert np.degrees(np.arccos((np.trace(relative) - 1) / 2)) == pytest.approx(STD.camera_rotation, rel=1e-2)
    factors = np.asarray(K / jnp.where(capture.cameras.K == 0, 1, capture.cameras.K))
    np.testing.assert_allclose(factors[:, [0, 1], [0, 1]], np.exp(STD.focal), rtol=1e-6)
    np.testing.assert_array_equal(K[:, :2, 2], capture.cameras.K[:, :2, 2])


def test_a_state_without_cameras_leaves_them_where_they_are(capture, origin):
    K, matrices = cameras_of(origin, replace(zero_state(origin), cameras=None))
    np.testing.assert_array_equal(K, capture.cameras.K)
    np.testing.assert_array_equal(matrices, capture.cameras.cam_from_world)


def test_a_shifted_camera_shifts_in_both_views_that_are_its_own(capture, origin):
    state = zero_state(origin)
    state = moved(state, centers=state.cameras.centers.at[0].set(jnp.asarray([0.0, 2.0, 0.0])))
    cameras = replace(capture.cameras, cam_from_world=cameras_of(origin, state)[1])
    shift = np.asarray(cameras.center - capture.cameras.center)
    np.testing.assert_allclose(
        shift, [[0, 2 * STD.camera_center, 0], [0, 0, 0], [0, 2 * STD.camera_center, 0]], atol=1e-5
    )


def test_the_root_turns_about_the_pelvis_by_small_turns_even_near_half_a_turn(capture, origin):
    """Posed by blend skinning, beside the same body turned as a whole."""
    state = random_state(origin)
    still = replace(state, global_orient=jnp.zeros_like(state.global_orient))
    rest = shape_body(capture.body, betas_of(origin, state))
    joints_of = jax.jit(jax.vmap(lambda pose: pose_body(capture.body, rest, pose).joints))
    turned, before = joints_of(pose_of(origin, state)), joints_of(pose_of(origin, still))
    turns = quaternion.matrix_from_axis_angle(jnp.radians(STD.global_orient) * state.global_orient)
    expected = jnp.einsum("mab,mjb->mja", turns, before - before[:, :1]) + before[:, :1]
    np.testing.assert_allclose(turned, expected, atol=2e-5)
    assert np.abs(turned - before).max() > 0.02


def test_states_are_found_again_from_their_poses(capture, origin):
    for own in (origin, usual_origin(pose_prior(JOINT_NAMES), origin.joints, 5)):
        state = random_state(own)
        again = state_of(own, betas_of(own, state), pose_of(own, state))
        for name in ("betas", "global_orient", "transl", "body_pose"):
            np.testing.assert_allclose(getattr(again, name), getattr(state, name), atol=2e-4)


@pytest.mark.slow
def test_poses_have_derivatives_at_zero_and_near_half_a_turn(origin):
    jacobian = jax.jacfwd(lambda state: pose_of(origin, state).rotations)(zero_state(origin))
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(jacobian))
    assert np.abs(jacobian.global_orient).max() > 0.5 * np.radians(STD.global_orient)


def test_fingers_and_eyes_wear_what_the_joint_above_them_wears(capture, origin):
    assert 0 not in origin.joints and "left_index1" not in [JOINT_NAMES[j] for j in origin.joints]
    own = segments(capture.body.parents, origin.joints)
    of = lambda name: own[JOINT_NAMES.index(name)]
    assert of("pelvis") == 0 and of("left_index2") == of("left_wrist") != of("right_wrist")
    assert of("left_eye") == of("head")


def test_refined_captures_keep_what_is_not_refined(capture, origin):
    refined = moved_capture(capture, origin, random_state(origin))
    assert refined.images is capture.images and refined.names == capture.names
    fingers = [j for j, name in enumerate(JOINT_NAMES) if "index" in name]
    np.testing.assert_array_equal(refined.poses.rotations[:, fingers], capture.poses.rotations[:, fingers])
    assert dataclasses.replace(refined, betas=capture.betas).body is capture.body


PRIOR = pose_prior(JOINT_NAMES)


def test_every_joint_has_a_range_that_holds_its_usual_value():
    assert set(RANGES) == {name for name in JOINT_NAMES if not name.startswith("right_")}
    assert (PRIOR.lower <= PRIOR.mean).all() and (PRIOR.mean <= PRIOR.upper).all()
    assert (PRIOR.std > 0).all()


def test_right_is_the_mirror_image_of_left():
    for j, name in enumerate(JOINT_NAMES):
        if name.startswith("left_"):
            other = JOINT_NAMES.index(name.replace("left_", "right_"))
            np.testing.assert_array_equal(PRIOR.mean[other], MIRROR * PRIOR.mean[j])
            both = np.stack([MIRROR * PRIOR.lower[j], MIRROR * PRIOR.upper[j]])
            np.testing.assert_array_equal(PRIOR.lower[other], both.min(0))
            np.testing.assert_array_equal(PRIOR.upper[other], both.max(0))


@pytest.mark.parametrize("pose", NAMES_WITHIN_LIMITS)
def test_people_bend_within_their_limits(pose):
    assert violations(PRIOR, rotations_of(pose)) == []


@pytest.mark.parametrize(
    ("joint", "vector", "axis"),
    [
        ("left_knee", (-0.6, 0, 0), 0),
        ("right_elbow", (0, -0.8, 0), 1),
        ("left_index2", (0, 0, 1.2), 2),
        ("head", (1.6, 0, 0), 0),
    ],
)
def test_what_no_joint_does_is_found(joint, vector, axis):
    rotations = rotations_of("standing")
    j = JOINT_NAMES.index(joint)
    rotations[j] = vector
    found = violations(PRIOR, rotations)
    assert [(k, a) for k, a, _ in found] == [(j, axis)]
    assert found[0][2] > 0.3


def test_unknown_joints_rest_freely():
    prior = pose_prior(("pelvis", "tail"))
    assert (prior.mean[1] == 0).all() and (prior.upper[1] > 3).all()
