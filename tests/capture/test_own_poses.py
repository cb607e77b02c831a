"""Each photo gets a pose if the person moved between the photos, and only then."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from humangs_jax.body.landmarks import landmark_model, pose_landmarks
from humangs_jax.body.model import pose_body, shape_body
from humangs_jax.capture.fitting.files import FitRecord, write_fitted
from humangs_jax.capture.fitting.own_poses import (
    find_movement,
    fit_own_poses,
    movement_line,
    record_of_photos,
    with_own_poses,
)
from humangs_jax.capture.fitting.report import FitReport
from humangs_jax.capture.keypoints.keypoints import COCO_17, Keypoints
from humangs_jax.core.pytree import replace
from humangs_jax.data.capture import load_capture, save_capture
from humangs_jax.geometry.camera import project
from humangs_jax.rendering.mesh.rasterizer import rasterize_mesh
from tests.capture.test_silhouette_fit import SIZE, VIEWS, default_body, truth

NOISE = 1.0
"""Noise of the keypoints, pixels: half a percent of the person's height."""


def bent(degrees, seed=0):
    """Returns poses of the photos: the shared one with joints of limbs and head bent a little."""
    capture = with_own_poses(truth())
    names = capture.body.joint_names
    moving = [
        j
        for j, name in enumerate(names)
        if any(part in name for part in ("shoulder", "elbow", "knee", "neck", "head"))
    ]
    rng = np.random.default_rng(seed)
    turns = np.radians(degrees) * rng.normal(size=(VIEWS, len(moving), 3))
    rotations = capture.poses.rotations.at[:, np.asarray(moving)].add(jnp.asarray(turns))
    return replace(capture.poses, rotations=rotations.astype(jnp.float32))


def photographed(poses, seed=1):
    """Returns (capture with the body in the shared pose, noisy keypoints).

    Masks and keypoints are those of each photo's pose.
    """
    capture, body = truth(), default_body()
    model = landmark_model(body, COCO_17.names)
    rest = shape_body(body, jnp.zeros(3))
    masks, points = [], []
    for view in range(VIEWS):
        pose = jax.tree.map(lambda leaf, view=view: leaf[view], poses)
        camera, large = capture.cameras[view], capture.cameras[view].resized(2 * SIZE, 2 * SIZE)
        vertices = _vertices(body, rest, pose)
        ids = np.asarray(rasterize_mesh(vertices, body.faces, large).face_ids)
        masks.append((ids >= 0).reshape(SIZE, 2, SIZE, 2).mean((1, 3)))
        points.append(project(camera, pose_landmarks(model, jnp.zeros(3), pose)[0])[0])
    noise = np.random.default_rng(seed).normal(0, NOISE, (VIEWS, len(COCO_17.names), 2))
    points = (np.stack(points) + noise).astype(np.float32)
    keypoints = Keypoints(points, np.ones(points.shape[:2], np.float32), COCO_17)
    return dataclasses.replace(capture, masks=np.stack(masks).astype(np.float32)), keypoints


_vertices = jax.jit(lambda body, rest, pose: pose_body(body, rest, pose).vertices)


@pytest.mark.slow
def test_someone_who_moved_is_given_a_pose_for_each_photo_and_someone_who_stood_still_is_not():
    still, keypoints = photographed(with_own_poses(truth()).poses)
    assert not find_movement(still, keypoints).shown
    poses = bent(5.0)
    capture, keypoints = photographed(poses)
    assert find_movement(capture, keypoints).shown
    fitted = fit_own_poses(capture, keypoints)
    assert fitted.report.kept and fitted.capture.frames.tolist() == list(range(VIEWS))
    iou = fitted.report.errors["silhouette_iou"]
    assert iou.after > iou.before + 0.01
    limbs = np.linalg.norm(np.asarray(poses.rotations - truth().poses.rotations), axis=-1) > 0
    before = np.asarray(truth().poses.rotations - poses.rotations)[limbs]
    after = np.asarray(fitted.capture.poses.rotations - poses.rotations)[limbs]
    assert np.linalg.norm(after) < np.linalg.norm(before)


def test_the_reported_movement_is_that_across_the_line_of_sight():
    one = with_own_poses(truth()).select([0])
    towards = np.asarray(one.cameras.center[0]) - np.asarray(one.poses.translation[0])
    towards = 0.2 * towards / np.linalg.norm(towards)
    aside = 0.2 * np.cross(towards, [0.0, 1.0, 0.0]) / np.linalg.norm(towards)
    for shift, distance in ((towards, "up to 1 cm"), (aside, "up to 13 cm")):
        moved = one.poses.translation.at[0].add(jnp.asarray(shift, jnp.float32))
        poses = replace(one.poses, translation=moved)
        assert distance in movement_line(dataclasses.replace(one, poses=poses))


def test_the_record_of_a_fit_has_a_row_for_each_photo():
    keypoints = Keypoints(np.zeros((VIEWS, 17, 2)), np.ones((VIEWS, 17)), COCO_17)
    record = FitRecord(
        keypoints, ("a", "b", "c"), np.asarray([2.0]), np.ones((1, 5)), np.ones((1, 5)), np.eye(3)
    )
    own = record_of_photos(record, np.zeros(VIEWS, np.int32))
    assert own.noise.tolist() == [2.0] * VIEWS and own.joint_std.shape == (VIEWS, 5)


def test_a_capture_folder_gets_the_frames_of_its_photos(tmp_path):
    save_capture(tmp_path / "me", truth())
    write_fitted(tmp_path / "me", tmp_path / "me", with_own_poses(truth()), FitReport("refinement"))
    assert load_capture(tmp_path / "me").frames.tolist() == list(range(VIEWS))
