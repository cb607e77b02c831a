"""3D landmarks of a detector as evidence where a frame has one view."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from fitting.fit_people import betas_of, model_of, observe, rotations_of
from scipy.spatial.transform import Rotation

from humangs_jax.body.landmarks import pose_landmarks
from humangs_jax.body.model import BodyPose
from humangs_jax.core.pytree import replace
from humangs_jax.data.capture import capture_from_arrays
from humangs_jax.data.keypoints.own import ImagePeople, SeenPerson, write_people
from humangs_jax.data.keypoints.reading import read_keypoints
from humangs_jax.data.keypoints.sets import MEDIAPIPE_33
from humangs_jax.fitting.landmark_fit import fit_landmarks
from humangs_jax.fitting.residuals.keypoints import group_by_frame, world_residuals

POSES = ("standing", "crouching", "facing away")
NOISE = 0.04
"""Metres: of a detector's landmarks in space."""


def seen_in_space(model, observations, seed):
    """The landmarks of `POSES` in camera axes, too small by a tenth, about another middle, with noise: (m, 1, k, 3)."""
    rotations, none = jnp.stack([rotations_of(pose) for pose in POSES]), jnp.zeros(3)
    betas = jnp.asarray(betas_of(seed))
    landmarks = jax.vmap(lambda r: pose_landmarks(model, betas, BodyPose(r, none))[0])(rotations)
    turned = np.einsum("mcab,mkb->mcka", observations.cam_from_world[..., :3, :3], landmarks)
    return 0.9 * turned + 3.0 + np.random.default_rng(seed).normal(0, NOISE, turned.shape)


@pytest.mark.slow
def test_of_one_view_depths_are_better_where_the_detector_sees_them():
    model, seed = model_of(), 3
    joints, _, seen = observe(POSES, seed=seed, views=1, noise=1.0)
    spatial = replace(seen, world=jnp.asarray(seen_in_space(model, seen, seed), jnp.float32))

    def error(observations):
        found = np.asarray(fit_landmarks(model, observations).joints)[:, :22]
        centered = lambda x: x - x.mean(1, keepdims=True)
        return np.linalg.norm(centered(found) - centered(joints[:, :22]), axis=-1).mean()

    without, with_them = error(seen), error(spatial)
    assert with_them < 0.8 * without


def test_size_and_place_in_space_do_not_count_and_unseen_landmarks_neither():
    model, seed = model_of(), 1
    _, _, seen = observe(POSES, seed=seed, views=1)
    landmarks = jnp.asarray(np.random.default_rng(0).normal(0, 0.5, (len(model.names), 3)), jnp.float32)
    rotation = seen.cam_from_world[0, :, :3, :3]
    world = 1.7 * jnp.einsum("cab,kb->cka", rotation, landmarks) - 2.0
    first = jax.tree.map(lambda leaf: leaf[0], seen)
    hidden = first.confidences.at[:, :5].set(0.0)
    residuals = lambda world: world_residuals(model, replace(first, confidences=hidden, world=world), landmarks, 5.0)
    np.testing.assert_allclose(residuals(world), 0, atol=2e-2)  # the size has a floor of 5 cm
    np.testing.assert_array_equal(residuals(world.at[:, :5].add(9.0))[:, :5], 0)
    assert float(jnp.abs(residuals(world.at[:, 8].add(0.5))).max()) > 0.5


def test_landmarks_of_a_file_come_into_the_axes_of_the_camera(tmp_path):
    """The detector looks at the middle of the hips, which here is far from the middle of the photo."""
    rng, hips = np.random.default_rng(0), [MEDIAPIPE_33.names.index(f"{side}_hip") for side in ("left", "right")]
    points = rng.normal(0, 0.3, (2, 33, 3))
    points[:, hips[1]] = -points[:, hips[0]]
    middle = np.asarray([1.2, -0.8, 3.0])
    K = np.asarray([[100.0, 0, 32], [0, 100, 32], [0, 0, 1]])
    ray = middle / np.linalg.norm(middle)
    side = np.cross([0, 0, 1], ray)
    turn = Rotation.from_rotvec(side / np.linalg.norm(side) * np.arccos(ray[2])).as_matrix()
    pixels = (
        points * [1, 1, 0] + middle
    ) @ K.T  # in a plane before the camera, so that the middle of the hips stays there
    pixels = pixels[..., :2] / pixels[..., 2:]
    seen = lambda i: SeenPerson(np.column_stack([pixels[i], np.ones(33)]), points[i] @ turn, 1.0)
    images = [ImagePeople(f"{i:03d}.png", (64, 64), (seen(i),)) for i in range(2)]
    write_people(tmp_path / "keypoints.json", images)
    capture = capture_from_arrays(
        np.ones((2, 64, 64, 3)), K, np.tile(np.eye(4), (2, 1, 1)), np.zeros((2, 55, 3)), np.zeros((2, 3)), frames=[0, 1]
    )
    keypoints = read_keypoints(tmp_path / "keypoints.json", capture.names, 64, 64)
    observations, _ = group_by_frame(capture, keypoints)
    np.testing.assert_allclose(observations.world[:, 0], points, atol=1e-3)  # the file has tenths of a millimetre
    one_moment = capture_from_arrays(
        np.ones((2, 64, 64, 3)), K, np.tile(np.eye(4), (2, 1, 1)), np.zeros((1, 55, 3)), np.zeros((1, 3)), frames=[0, 0]
    )
    assert group_by_frame(one_moment, keypoints)[0].world is None
