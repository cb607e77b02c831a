"""Photos that show a part of the person: without legs, without head, or hardly anything."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from fit_people import (
    FOCAL,
    NAMES,
    betas_of,
    cameras_around,
    default_body,
    errors_of,
    model_of,
    posed,
    rotations_of,
    seen_by,
)

from humangs_jax.body.landmarks import pose_landmarks
from humangs_jax.body.model import BodyPose
from humangs_jax.capture.fitting.fit_capture import fit_photos
from humangs_jax.capture.fitting.person_cameras import cameras_from_person
from humangs_jax.capture.fitting.person_moments import across, handedness, middle_of, only_known
from humangs_jax.capture.keypoints.keypoints import COCO_WHOLEBODY_133, Keypoints
from humangs_jax.data.photos import Photos
from humangs_jax.geometry.camera import Camera, stack_cameras

LEGS = {
    "knee": ("ankle", "heel", "toe", "foot"),
    "hip": ("knee", "ankle", "heel", "toe", "foot"),
}
"""Words of the landmarks that a photo does not show, by the joint at which it ends."""
FACE = ("nose", "eye", "ear", "mouth")


def without(seen, words, views=slice(None)):
    """Returns what is seen in photos that do not show these landmarks.

    The detector guesses wrong places for them.
    """
    hidden = np.asarray([any(word in name for word in words) for name in seen.names])
    visibility, points, world = (
        np.array(getattr(seen, name)) for name in ("visibility", "points", "world")
    )
    visibility[views] = np.where(hidden, 0.0, visibility[views])
    points[views] = np.where(hidden[:, None], points[views] + 300.0, points[views])
    world[views] = np.where(hidden[:, None], world[views] + 0.5, world[views])
    return dataclasses.replace(seen, visibility=visibility, points=points, world=world)


@pytest.mark.parametrize("cut", LEGS)
def test_cameras_of_a_person_without_legs_stand_as_those_of_the_whole_person(cut):
    matrices = cameras_around(4)
    found = cameras_from_person(without(seen_by(posed(), matrices), LEGS[cut]), height=1.7)
    angles, centers, _ = errors_of(found, matrices)
    assert found.moments == 1 and angles.max() < 1 and centers.max() < 0.05
    whole = cameras_from_person(seen_by(posed(), matrices), height=1.7)
    for one, other in zip(found.cameras, whole.cameras, strict=True):
        np.testing.assert_allclose(one.center, other.center, atol=0.25)
        up, usual = (np.asarray(c.cam_from_world)[:3, 1] for c in (one, other))
        assert up @ usual > np.cos(np.radians(6))


@pytest.mark.parametrize("words", [FACE, (*FACE, *LEGS["hip"]), LEGS["hip"]])
def test_one_photo_of_a_part_of_the_person_has_a_camera_that_looks_at_it(words):
    (matrix,) = cameras_around(1)
    found = cameras_from_person(without(seen_by(posed(), matrix[None]), words))
    camera = found.cameras[0]
    assert np.isfinite(np.asarray(camera.cam_from_world)).all()
    distance = np.linalg.norm(np.asarray(camera.center)[[0, 2]])
    assert distance == pytest.approx(np.linalg.norm(matrix[:3, 3]), rel=0.15)
    assert found.errors[0] < 25


def test_a_photo_that_shows_too_little_is_left_out_where_others_show_more():
    seen = seen_by(posed(), cameras_around(4))
    hardly = without(seen, ("shoulder", "hip", "knee", "ankle", "heel", "toe", "foot"), [2])
    found = cameras_from_person(hardly)
    assert found.views == (0, 1, 3) and len(found.cameras) == 3
    assert "p2.jpg: left out: neither shoulders nor hips are seen in it" in found.warnings
    nearly = dataclasses.replace(seen, visibility=seen.visibility.copy())
    nearly.visibility[1, 4:] = 0
    found = cameras_from_person(nearly)
    assert found.views == (0, 2, 3)
    left_out = "p1.jpg: left out: 4 landmarks of the person are seen, expected 6 or more"
    assert left_out in found.warnings


def test_landmarks_that_are_not_seen_do_not_tell_left_from_right():
    points, names = posed(), NAMES
    known = np.asarray([name not in ("left_hip", "left_knee") for name in names])
    shown, left = only_known(points, names, known)
    wrong = points.copy()
    wrong[~known] = 9.0
    assert len(left) == known.sum()
    np.testing.assert_array_equal(only_known(wrong, names, known)[0], shown)
    assert handedness(shown, left) > 0
    right = points[names.index("right_hip")]
    np.testing.assert_array_equal(middle_of(shown, left, "hip"), right)
    shoulders = [points[names.index(f"{side}_shoulder")] for side in ("left", "right")]
    np.testing.assert_allclose(across(shown, left), shoulders[0] - shoulders[1])
    assert np.isnan(middle_of(points[:1], names[:1], "hip")).all()
    assert handedness(points[:1], names[:1]) == 0


@pytest.mark.slow  # a fit
@pytest.mark.parametrize("cut", LEGS)
def test_what_a_photo_does_not_show_rests_and_what_it_shows_is_posed(cut):
    """Of four photos of different moments two are whole and two end at the hip or the knee."""
    rng = np.random.default_rng(0)
    rotations = np.stack([rotations_of("standing")] * 4)
    rotations += 0.1 * rng.normal(size=rotations.shape).astype(np.float32)
    joints, landmarks = [], []
    for each in rotations:
        pose = BodyPose(jnp.asarray(each), jnp.zeros(3))
        marks, places = pose_landmarks(model_of(NAMES), jnp.asarray(betas_of(0)), pose)
        joints.append(np.asarray(places))
        landmarks.append(np.asarray(marks, float))
    matrices = cameras_around(4)
    seen = seen_by(np.stack(landmarks), matrices, pixels=2.0, world=0.02)
    seen = without(seen, LEGS[cut], [1, 3])
    width, height = seen.sizes[0]
    K = np.asarray([[FOCAL, 0, width / 2], [0, FOCAL, height / 2], [0, 0, 1]])
    cameras = stack_cameras([Camera.from_opencv(K, m, width, height) for m in matrices])
    images = np.ones((4, 4, 4, 3), np.float32)
    photos = Photos(images, None, cameras, np.arange(4, dtype=np.int32), tuple("abcd"), False)
    # the same landmarks among those of a set
    rows = [COCO_WHOLEBODY_133.names.index(name) for name in seen.names]
    points, confidences, world = (
        np.zeros((4, 133, *rest), np.float32) for rest in ((2,), (), (3,))
    )
    points[:, rows], confidences[:, rows], world[:, rows] = seen.points, seen.visibility, seen.world
    keypoints = Keypoints(points, confidences, COCO_WHOLEBODY_133, world=world)
    fitted = fit_photos(photos, keypoints, default_body()).capture
    turns = np.degrees(np.linalg.norm(np.asarray(fitted.poses.rotations), axis=-1))
    names = default_body().joint_names
    hidden = {"hip": ("knee", "ankle"), "knee": ("ankle",)}[cut]
    legs = [names.index(f"{side}_{part}") for side in ("left", "right") for part in hidden]
    assert turns[[1, 3]][:, legs].max() < 45
    found = np.asarray(fit_joints(fitted))
    upper = [names.index(name) for name in ("neck", "left_shoulder", "right_elbow", "left_wrist")]
    pelvis = lambda places: places - places[:, :1]
    errors = np.linalg.norm(pelvis(found) - pelvis(np.stack(joints)), axis=-1)[:, upper]
    assert errors[[1, 3]].mean() < 2.0 * errors[[0, 2]].mean() + 0.02


def fit_joints(capture):
    """Returns the joints of each pose of a capture, metres."""
    model = model_of(NAMES)
    poses = [capture.poses[i] for i in range(capture.frame_count)]
    return [pose_landmarks(model, jnp.asarray(capture.betas), pose)[1] for pose in poses]
