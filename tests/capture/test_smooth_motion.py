"""Smooth motion of a body of four joints, in which some frames are badly seen.

Such frames spoil neither the others nor themselves.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from fit_people import TOY_MODEL as MODEL

from humangs_jax.body.landmarks import pose_landmarks
from humangs_jax.body.model import BodyPose
from humangs_jax.capture.fitting import landmark_fit
from humangs_jax.capture.fitting.fit_capture import _motion_warnings
from humangs_jax.capture.fitting.landmark_fit import LandmarkFit, keypoint_problem, smooth_motion
from humangs_jax.capture.fitting.residuals.keypoints import make_observations
from humangs_jax.capture.fitting.state import state_of
from humangs_jax.core.pytree import replace
from humangs_jax.geometry.camera import intrinsics_from_fov, orbit

FRAMES, SIZE, NOISE, STD = 7, 512, 1.0, 0.003
"""Frames, pixels of a side, pixels of noise, and expected acceleration, metres per frame squared.

The true acceleration is 0.002.
"""


def true_poses():
    """Returns rotations (m, j, 3) and translations (m, 3) of walking with a swinging arm."""
    time = np.arange(FRAMES)[:, None, None]
    rotations = 0.2 * np.sin(0.15 * time + np.arange(4)[:, None]) * np.asarray([0.3, 1.0, 0.5])
    translations = np.stack([0.05 * np.arange(FRAMES), np.zeros(FRAMES), np.zeros(FRAMES)], axis=1)
    return rotations.astype(np.float32), translations.astype(np.float32)


@jax.jit
def landmarks_of(rotations, translations):
    return jax.vmap(lambda r, t: pose_landmarks(MODEL, jnp.zeros(1), BodyPose(r, t)))(
        rotations, translations
    )


@jax.jit
def states_of(rotations, translations):
    origin = keypoint_problem(MODEL).origin
    states = jax.vmap(lambda r, t: state_of(origin, jnp.zeros(1), BodyPose(r, t)))(
        rotations, translations
    )
    return replace(states, betas=states.betas[0])


def seen_by(landmarks, seed=0):
    """Returns noisy observations of landmarks (m, k, 3)."""
    K = intrinsics_from_fov(1.0, SIZE, SIZE)
    camera = orbit(jnp.asarray([0.2, 0.5, 0.0]), 3.0, jnp.asarray([0.0, 1.5]), 0.1, K, SIZE, SIZE)
    pose = np.asarray(camera.cam_from_world)
    local = np.einsum("cab,mkb->mcka", pose[:, :3, :3], landmarks) + pose[:, None, :3, 3]
    pixels = local[..., :2] / local[..., 2:] * float(K[0, 0]) + SIZE / 2
    pixels = pixels + np.random.default_rng(seed).normal(0, NOISE, pixels.shape)
    still = lambda x: np.broadcast_to(x, (FRAMES, *x.shape))
    seen = make_observations(
        pixels, np.ones(pixels.shape[:-1]), still(np.asarray(camera.K)), still(pose)
    )
    return replace(seen, noise=jnp.full(FRAMES, NOISE))


@pytest.fixture(scope="module")
def walk():
    """Returns (observations, start, true joints).

    The start is the truth with errors, as fits of single frames would give.
    """
    rotations, translations = true_poses()
    landmarks, joints = (np.asarray(x) for x in landmarks_of(rotations, translations))
    rng = np.random.default_rng(1)
    near = (
        rotations + rng.normal(0, 0.01, rotations.shape),
        translations + rng.normal(0, 0.003, translations.shape),
    )
    return seen_by(landmarks), tuple(np.asarray(x, np.float32) for x in near), joints


def smoothed(seen, start, spoilt=(), model=MODEL):
    """Returns the smoothed fit.

    The frames `spoilt` start as a fit without keypoints would: at rest at the world's origin.
    """
    rotations, translations = (x.copy() for x in start)
    rotations[list(spoilt)], translations[list(spoilt)] = 0, 0
    nothing = jnp.zeros((FRAMES, 1, 3))
    poses = jax.vmap(BodyPose)(jnp.asarray(rotations), jnp.asarray(translations))
    state = states_of(rotations, translations)
    fit = LandmarkFit(
        state.betas,
        poses,
        jnp.zeros((FRAMES, 8, 3)),
        nothing,
        seen.noise,
        state,
        jnp.zeros(()),
        jnp.ones(8),
    )
    return smooth_motion(model, seen, fit, STD)


def centimetres(fit, joints):
    """Returns the mean joint error of each frame, centimetres."""
    return 100 * np.linalg.norm(np.asarray(fit.joints) - joints, axis=-1).mean(-1)


def without(seen, frames, views=slice(None)):
    confidences = np.array(seen.confidences)
    for frame in frames:
        confidences[frame, views] = 0
    return replace(seen, confidences=jnp.asarray(confidences))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("spoilt", "views", "bound"),
    [
        ((), slice(None), 1.0),
        ((3,), slice(None), 1.5),  # without keypoints
        ((6,), slice(None), 2.5),  # the last: nothing on its other side
        ((2, 3, 4), slice(None), 2.5),
        ((3,), slice(1, None), 1.5),  # seen by one view, and placed anywhere by its own fit
    ],
)
def test_frames_that_show_little_are_taken_from_their_neighbours(walk, spoilt, views, bound):
    seen, start, joints = walk
    fit = smoothed(without(seen, spoilt, views), start, spoilt)
    errors = centimetres(fit, joints)
    others = np.setdiff1d(np.arange(FRAMES), spoilt)
    assert errors[others].max() < 1.0 and errors.max() < bound
    assert float(fit.smoothness) == pytest.approx(STD)
    jitter = lambda x: np.linalg.norm(np.diff(np.asarray(x), 2, axis=0), axis=-1).mean()
    assert jitter(fit.joints) < 1.5 * jitter(joints)


@pytest.mark.slow
def test_somebody_else_in_one_frame_does_not_move_the_others(walk):
    seen, start, joints = walk
    away = np.asarray([0.8, 0.0, 0.5], np.float32)
    rotations, translations = (x.copy() for x in start)
    translations[3] += away
    points = np.array(seen.points)
    points[3] = seen_by(np.asarray(landmarks_of(*true_poses())[0]) + away).points[3]
    fit = smoothed(replace(seen, points=jnp.asarray(points)), (rotations, translations))
    errors = centimetres(fit, joints)
    assert errors[[0, 1, 2, 4, 5, 6]].max() < 1.0
    (warning,) = _motion_warnings(np.asarray(fit.joints, float), float(fit.smoothness), STD)
    assert warning.startswith("frame 3: 0.9") and "somebody else" in warning


@pytest.mark.slow
def test_smoothness_that_the_keypoints_contradict_by_the_certainty_that_the_fit_found_is_not_forced(
    walk,
):
    """The motion has six times the expected acceleration; keypoints are followed as in single
    frames.
    """
    rotations, translations = (x.copy() for x in walk[1])
    translations[:, 1] += 0.015 * (np.arange(FRAMES) % 2)
    landmarks, joints = (np.asarray(x) for x in landmarks_of(rotations, translations))
    fit = smoothed(seen_by(landmarks), (rotations, translations))
    assert float(fit.smoothness) == pytest.approx(4 * STD) and centimetres(fit, joints).max() < 1.0
    assert next(
        iter(_motion_warnings(np.asarray(fit.joints, float), float(fit.smoothness), STD))
    ).startswith("smoothness 0.003: the keypoints contradict it")
    # what the model supposed of its landmarks before the fit is asked neither in the search nor
    # where its result is accepted
    supposed = replace(MODEL, certainty=jnp.full(8, 1e-3))
    again = smoothed(seen_by(landmarks), (rotations, translations), model=supposed)
    assert float(again.smoothness) == float(fit.smoothness)
    np.testing.assert_array_equal(again.joints, fit.joints)


def test_the_result_of_smoothing_is_reported():
    joints = np.zeros((5, 4, 3)) + 0.05 * np.arange(5)[:, None, None]
    found = lambda held, joints=joints: list(_motion_warnings(joints, held, 0.01))
    assert found(0.01) == []
    assert "accelerations are held to 0.16 instead" in found(0.16)[0]
    assert "frames are fitted one by one" in found(0.0)[0]
    assert "2 frames have no acceleration" in found(0.0, joints[:2])[0]
    jumped = joints.copy()
    jumped[2, :, 0] += 0.9
    assert [text[:14] for text in found(0.01, jumped)] == ["frame 2: 0.90 "]


def test_frames_that_all_show_little_keep_their_poses(walk):
    """No frame is extrapolated from another."""
    seen, start, _ = walk
    state = states_of(*start)
    blind = without(seen, range(FRAMES))
    kept = landmark_fit._bridged(keypoint_problem(MODEL), blind, state)
    for name in ("global_orient", "transl", "body_pose"):
        np.testing.assert_allclose(getattr(kept, name), getattr(state, name), atol=1e-5)
