"""Calibrations that contradict the person in the photos, and what photos agree on without them."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

from humangs_jax.body.landmarks import landmark_model, pose_landmarks
from humangs_jax.capture.fitting.contradiction import find_contradiction
from humangs_jax.capture.keypoints.keypoints import MEDIAPIPE_33, Keypoints
from humangs_jax.core.pytree import replace
from humangs_jax.data.photos import load_photos

PITCH = np.radians(20)
"""Angle by which the cameras look down: level cameras agree upside down, too."""


@pytest.fixture(scope="module")
def photos():
    """Returns the demo's photos as if their cameras looked down."""
    photos, down = load_photos("demo_capture"), np.eye(4)
    down[1:3, 1:3] = [[np.cos(PITCH), -np.sin(PITCH)], [np.sin(PITCH), np.cos(PITCH)]]
    return changed(photos, down @ np.asarray(photos.cameras.cam_from_world))


@pytest.fixture(scope="module")
def keypoints(demo, photos):
    """Returns keypoints of the demo's body with errors of 1.2 % of the person's size."""
    model = landmark_model(demo.body, MEDIAPIPE_33.names)
    places, _ = pose_landmarks(model, jnp.asarray(demo.betas), demo.pose(0))
    matrices, K = (np.asarray(x) for x in (photos.cameras.cam_from_world, photos.cameras.K))
    local = np.asarray(places) @ matrices[:, :3, :3].swapaxes(1, 2) + matrices[:, None, :3, 3]
    seen = local @ K.swapaxes(1, 2)
    rng, size = np.random.default_rng(0), 400
    points = seen[..., :2] / seen[..., 2:] + rng.normal(0, 0.012 * size, (*local.shape[:2], 2))
    known = np.isfinite(points).all(-1)
    middle = np.nanmean(local, axis=1, keepdims=True)
    world = np.nan_to_num((local - middle) @ towards_ray(middle[:, 0]).swapaxes(1, 2))
    world = world + rng.normal(0, 0.02, world.shape)
    return Keypoints(
        np.nan_to_num(points).astype(np.float32),
        known.astype(np.float32),
        MEDIAPIPE_33,
        world=world.astype(np.float32),
    )


def towards_ray(places):
    """Returns rotations whose z axis is the ray to each place, as a detector sees them."""
    z = places / np.linalg.norm(places, axis=-1, keepdims=True)
    x = np.cross([0.0, 1.0, 0.0], z)
    x /= np.linalg.norm(x, axis=-1, keepdims=True)
    return np.stack([x, np.cross(z, x), z], axis=1)


def changed(photos, matrices=None, K=None):
    cameras = photos.cameras
    matrices = cameras.cam_from_world if matrices is None else jnp.asarray(matrices, jnp.float32)
    K = cameras.K if K is None else jnp.asarray(K, jnp.float32)
    return dataclasses.replace(photos, cameras=replace(cameras, cam_from_world=matrices, K=K))


def upside_down(photos):
    """Returns the calibration for images and cameras whose y axis points up."""
    other = np.diag([1.0, -1.0, 1.0, 1.0])
    K = np.asarray(photos.cameras.K).copy()
    K[:, 1, 2] = photos.images.shape[1] - K[:, 1, 2]
    return changed(photos, other @ np.asarray(photos.cameras.cam_from_world) @ other, K)


def of_others(photos):
    """Returns cameras at other places around the person, as if they were those of other photos."""
    turns = np.tile(np.eye(4), (4, 1, 1))
    for turn, angle in zip(turns, np.radians([0, 50, -70, 110]), strict=True):
        turn[:3, :3] = [
            [np.cos(angle), 0, np.sin(angle)],
            [0, 1, 0],
            [-np.sin(angle), 0, np.cos(angle)],
        ]
    return changed(photos, np.asarray(photos.cameras.cam_from_world) @ turns)


def test_a_calibration_that_is_right_is_not_contradicted(photos, keypoints):
    assert find_contradiction(photos, keypoints) is None


def test_a_camera_that_is_a_little_off_is_no_contradiction(photos, keypoints):
    turn, angle = np.eye(4), np.radians(4)
    turn[:3, :3] = [
        [np.cos(angle), 0, np.sin(angle)],
        [0, 1, 0],
        [-np.sin(angle), 0, np.cos(angle)],
    ]
    matrices = np.asarray(photos.cameras.cam_from_world).copy()
    matrices[1] = turn @ matrices[1]
    assert find_contradiction(changed(photos, matrices), keypoints) is None


def test_images_whose_y_axis_points_up_are_named(photos, keypoints):
    found = find_contradiction(upside_down(photos), keypoints)
    assert "contradicts the people" in str(found)
    assert "with the images' y axis pointing the other way they agree" in str(found)


def test_matrices_the_wrong_way_round_are_named(photos, keypoints):
    inverse = np.linalg.inv(np.asarray(photos.cameras.cam_from_world))
    found = find_contradiction(changed(photos, inverse), keypoints)
    assert "with matrices that go from the camera to the world they agree" in str(found)


def test_photos_agree_without_the_cameras_of_other_photos(photos, keypoints):
    found = find_contradiction(of_others(photos), keypoints)
    assert "of the person's size; without it they agree" in str(found)
    assert found.after.missed < 0.5 * found.found.missed and "\n" not in str(found)


def test_nothing_is_named_where_photos_do_not_agree_without_the_calibration(photos, keypoints):
    """Nor is anything named where the detector gives no depths to find cameras by."""
    other = of_others(photos)
    flat = dataclasses.replace(keypoints, world=None)
    assert find_contradiction(other, flat) is None  # the person may have moved as well
    noise = np.random.default_rng(1).normal(0, 40, keypoints.points.shape)
    blurred = dataclasses.replace(keypoints, points=(keypoints.points + noise).astype(np.float32))
    found = find_contradiction(other, blurred)
    assert found is not None and found.remedy is None and str(found).endswith("person's size")


def test_one_photo_of_four_that_does_not_agree_is_no_matter_of_the_calibration(photos, keypoints):
    other = dataclasses.replace(keypoints, points=keypoints.points.copy())
    other.points[2] = 512 - other.points[2]
    assert find_contradiction(photos, other) is None


def test_one_view_and_few_keypoints_say_nothing(photos, keypoints):
    few = dataclasses.replace(keypoints, confidences=keypoints.confidences.copy())
    few.confidences[1:] = 0
    assert find_contradiction(upside_down(photos), few) is None
