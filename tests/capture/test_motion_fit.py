"""The fit of a motion to the keypoints of one camera."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from humangs_jax.body.landmarks import landmark_model, pose_landmarks
from humangs_jax.body.library import load_body
from humangs_jax.body.model import BodyPose, shape_body
from humangs_jax.capture.fitting.motion_fit import FLIP, betas_of_joints, fit_motion
from humangs_jax.capture.keypoints.keypoints import COCO_17, MEDIAPIPE_33, Keypoints
from humangs_jax.geometry.mesh import smallest_turns
from humangs_jax.geometry.quaternion import matrix_from_axis_angle
from humangs_jax.motion import load_motion

BODY = load_body()
K = np.asarray([[900.0, 0, 480], [0, 900, 480], [0, 0, 1]])
BETAS = np.where(np.isin(np.arange(22), (4, 6)), 1.0, 0.0).astype(np.float32)


def walker(frames):
    """A person who walks before a camera that looks down by 10 degrees.

    Returns the joints in the camera's axes and in the world, metres, and noisy keypoints.
    """
    walk, model = load_motion(), landmark_model(BODY, MEDIAPIPE_33.names, MEDIAPIPE_33.places)
    again = np.arange(frames) % len(walk.translations)
    poses = jax.vmap(BodyPose)(walk.rotations[again], walk.translations[again])
    of = jax.jit(jax.vmap(lambda pose: pose_landmarks(model, jnp.asarray(BETAS), pose)))
    landmarks, joints = (np.asarray(x, np.float64) for x in of(poses))
    turn = FLIP[:3, :3] @ np.asarray(matrix_from_axis_angle(jnp.asarray([0.17, 0, 0])))
    in_camera = lambda x: (x - [0.3, 0.6, 4.0]) @ turn.T
    seen, rng = in_camera(landmarks), np.random.default_rng(0)
    points = seen[..., :2] / seen[..., 2:] * 900 + 480 + rng.normal(0, 2, (*seen.shape[:2], 2))
    # the detector's own axes have the ray to the person as z; its person is of another size
    rays = np.append((points.mean(1) - 480) / 900, np.ones((frames, 1)), axis=1)
    turns = smallest_turns(np.asarray([0, 0, 1.0]), rays / np.linalg.norm(rays, axis=1)[:, None])
    hips = [MEDIAPIPE_33.names.index(f"{side}_hip") for side in ("left", "right")]
    world = np.einsum("mba,mkb->mka", turns, seen - seen[:, hips].mean(1, keepdims=True)) / 1.07
    world = world + rng.normal(0, 0.03, world.shape)
    confidences = np.full(points.shape[:2], 0.9, np.float32)
    keypoints = Keypoints(
        points.astype(np.float32), confidences, MEDIAPIPE_33, world=world.astype(np.float32)
    )
    return in_camera(joints)[:, :22], joints[:, :22], keypoints, walk.fps


def jerk(joints, fps):
    return np.linalg.norm(np.diff(joints, n=3, axis=0), axis=-1).mean() * fps**3


@pytest.mark.slow
def test_a_walk_is_found_in_the_keypoints_of_one_camera_whose_noise_it_does_not_have():
    """There are several windows, and frames in which nobody is seen."""
    truth, world, keypoints, fps = walker(150)
    keypoints.confidences[70:76] = 0
    ends = [int(f(np.asarray(BODY.template)[:, 1])) for f in (np.argmin, np.argmax)]
    height_of = lambda betas: np.ptp(shape_body(BODY, jnp.asarray(betas)).vertices[ends, 1])
    height = float(height_of(BETAS))
    fits, done = [], []

    def watch(stages, windows):
        fits.append(len(stages))
        return (done.append(stage) for stage in stages)

    found = fit_motion(BODY, keypoints, K, fps, height=height, watch=watch)
    assert fits == [len(done)]
    assert height_of(found.betas) == pytest.approx(height, abs=0.01)
    matrix = found.cam_from_world
    ours = found.joints[:, :22] @ matrix[:3, :3].T + matrix[:3, 3]
    aligned = lambda x: x - x[:, :1]
    assert np.linalg.norm(aligned(ours) - aligned(truth), axis=-1).mean() < 0.045
    # no step where one window ends and the next begins, and no more jerk than people have
    assert jerk(found.joints[:, :22], fps) < 1.2 * jerk(world, fps)
    # the world is upright, and the person on its floor
    tilt = np.degrees(np.arccos(np.clip(-matrix[1, 1], -1, 1)))
    assert abs(tilt - np.degrees(0.17)) < 6
    assert abs(np.quantile(found.joints[..., 1].min(1), 0.05)) < 0.1


def test_the_shape_of_an_avatar_is_that_of_its_joints():
    joints = np.asarray(shape_body(BODY, jnp.asarray(BETAS)).joints)
    found = betas_of_joints(BODY, joints + np.asarray([0.0, 1.0, 0.0]))
    again = np.asarray(shape_body(BODY, jnp.asarray(found, jnp.float32)).joints)
    assert np.linalg.norm((again - again[0]) - (joints - joints[0]), axis=-1).max() < 2e-3
    with pytest.raises(ValueError, match="expected 55 joints, got 54"):
        betas_of_joints(BODY, joints[1:])


def test_a_video_that_shows_nobody_is_refused():
    points = np.zeros((4, 33, 2), np.float32)
    blind = Keypoints(points, points[..., 0], MEDIAPIPE_33, world=np.zeros((4, 33, 3)))
    with pytest.raises(ValueError, match="seen in no frame"):
        fit_motion(BODY, blind, K, 30.0)
    few = Keypoints(points[:, :17], points[:, :17, 0], COCO_17, world=np.zeros((4, 17, 3)))
    with pytest.raises(ValueError, match="coco17 lack left_heel, left_foot_index"):
        fit_motion(BODY, few, K, 30.0)
    with pytest.raises(ValueError, match="in space"):
        fit_motion(BODY, Keypoints(points, points[..., 0], MEDIAPIPE_33), K, 30.0)
