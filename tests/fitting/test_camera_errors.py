"""A camera that is turned is found, named and turned back; cameras that are right are left alone."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

from humangs_jax.apps.check import check_capture
from humangs_jax.core.pytree import replace
from humangs_jax.data.keypoints.keypoints import Keypoints
from humangs_jax.data.photos import Photos
from humangs_jax.fitting.camera_errors import find_camera_errors, mended
from humangs_jax.fitting.fit_capture import examine, fit_photos
from humangs_jax.geometry import quaternion, transform
from tests.fitting.seen_people import person

TURN, ROLL = 0.35, 0.9
"""Degrees: what may be left of a turn of 1 degree with keypoints of one moment that err by a pixel, of a person who is 120 high;
17 of them know a turn about the camera's own axis to 0.45 degrees only."""
VIEWS = 4
"""Cameras of people who move."""


def turned(capture, views, vector):
    """Cameras turned by a rotation vector in their axes, degrees."""
    rotations = np.zeros((capture.view_count, 3), np.float32)
    rotations[views] = np.radians(vector)
    turns = transform.make(quaternion.matrix_from_axis_angle(jnp.asarray(rotations)), jnp.zeros((len(rotations), 3)))
    return dataclasses.replace(
        capture, cameras=replace(capture.cameras, cam_from_world=turns @ capture.cameras.cam_from_world)
    )


def off(capture, truth):
    """(v,) degrees between the cameras of two captures."""
    between = capture.cameras.cam_from_world[:, :3, :3] @ jnp.swapaxes(truth.cameras.cam_from_world[:, :3, :3], -1, -2)
    return np.degrees(np.linalg.norm(quaternion.to_axis_angle(quaternion.from_matrix(between)), axis=-1))


@pytest.mark.parametrize("views", [3, 4, 6])
@pytest.mark.parametrize("seed", [0, 1])
def test_a_camera_turned_by_a_degree_is_named_and_turned_back_and_right_ones_are_left(views, seed):
    truth, keypoints = person(seed, 1, views)
    assert find_camera_errors(truth, keypoints) == ()
    for vector in ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.6, -0.6, 0.5)):
        (error,) = find_camera_errors(turned(truth, [1], vector), keypoints)
        assert error.views == (1,) and error.names[0] == "m0v1" and str(error).startswith("camera m0v1")
        assert error.degrees == pytest.approx(1.0, abs=TURN) and f"{error.degrees:.1f} degrees" in str(error)
        assert off(mended(turned(truth, [1], vector), (error,)), truth).max() < ROLL


def test_all_moments_of_a_camera_that_stands_still_count_and_two_cameras_may_be_off():
    truth, keypoints = person(3, 8, 4, still=True, even=True)
    assert find_camera_errors(truth, keypoints) == ()
    wrong = turned(turned(truth, [1, 5, 9, 13, 17, 21, 25, 29], (1.0, 0.0, 0.3)), range(2, 32, 4), (-0.8, 0.3, 0.0))
    errors = find_camera_errors(wrong, keypoints)
    assert sorted(error.views[0] for error in errors) == [1, 2] and all(len(error.views) == 8 for error in errors)
    assert off(mended(wrong, errors), truth).max() < TURN


def late(keypoints, cameras, frames):
    """The keypoints of a moving person, of whom some cameras show what the others have shown so many frames before."""
    views = np.arange(len(keypoints.points)).reshape(-1, VIEWS)
    for camera, by in zip(cameras, frames, strict=True):
        views[:, camera] = views[np.clip(np.arange(len(views)) - by, 0, len(views) - 1), camera]
    points, confidences = keypoints.points[views.ravel()], keypoints.confidences[views.ravel()]
    return dataclasses.replace(keypoints, points=points, confidences=confidences)


@pytest.mark.parametrize(("seed", "by"), [(0, 0), (0, 1), (0, 3), (1, 0), (1, 2), (1, -2)])
def test_a_camera_that_is_late_is_named_and_no_camera_that_is_right(seed, by):
    truth, keypoints = person(seed, 24, VIEWS, still=True, moving=True, outliers=0.05)
    found = find_camera_errors(truth, late(keypoints, [1], [by]))
    assert [(error.names, error.late, error.degrees) for error in found] == ([(("m0v1",), by, 0.0)] if by else [])
    when = {1: "1 frame late", 2: "2 frames late", 3: "3 frames late", -2: "2 frames early"}
    assert by == 0 or str(found[0]) == f"camera m0v1 is {when[by]}"


def test_a_turned_camera_is_not_taken_for_a_late_one_and_both_are_found():
    truth, keypoints = person(2, 24, VIEWS, still=True, moving=True)
    wrong = turned(truth, range(2, 24 * VIEWS, VIEWS), (1.0, 0.0, 0.3))
    (error,) = find_camera_errors(wrong, keypoints)
    assert error.late == 0 and error.names == ("m0v2",)
    delayed = late(keypoints, [0], [2])
    both = find_camera_errors(wrong, delayed)
    assert [(error.names, error.late) for error in both] == [(("m0v0",), 2), (("m0v2",), 0)]
    warnings = " ".join(examine(wrong, delayed).report.warnings)
    assert "camera m0v0 is 2 frames late" in warnings and "camera m0v2 is off by" in warnings


def test_of_a_person_who_stands_nobody_is_late():
    truth, keypoints = person(3, 1, VIEWS)
    keypoints = dataclasses.replace(
        keypoints, points=np.tile(keypoints.points, (24, 1, 1)), confidences=np.tile(keypoints.confidences, (24, 1))
    )
    repeated = truth.select(np.tile(np.arange(VIEWS), 24))
    repeated = dataclasses.replace(repeated, frames=np.repeat(np.arange(24), VIEWS).astype(np.int32))
    assert find_camera_errors(repeated, keypoints) == ()


@pytest.mark.parametrize("views", [1, 2])
def test_nothing_is_said_of_one_or_two_cameras(views):
    truth, keypoints = person(0, 1, views)
    assert find_camera_errors(turned(truth, [0], (2.0, 0.0, 0.0)), keypoints) == ()


def test_outliers_exchanged_sides_and_another_person_are_no_camera_errors():
    truth, keypoints = person(4, 1, 6, outliers=0.15)
    assert find_camera_errors(truth, keypoints) == ()
    points = np.array(person(4, 1, 6)[1].points)
    swapped, other = np.array(points), np.array(points)
    swapped[1] = swapped[1][list(keypoints.set.mirror)]
    other[1] = person(5, 1, 6)[1].points[1] + 40.0
    for wrong in (swapped, other):
        assert find_camera_errors(truth, Keypoints(wrong, keypoints.confidences, keypoints.set)) == ()
    nothing = Keypoints(points, np.zeros_like(keypoints.confidences), keypoints.set)
    assert find_camera_errors(truth, nothing) == ()


def test_landmarks_that_the_detector_hardly_sees_turn_no_camera():
    """An error that all landmarks of a view share is a rotation, too, however small their scatter: the certainty decides."""
    truth, keypoints = person(2, 1, 4)
    points = np.array(keypoints.points)
    points[1] += [3.0, 0.0]
    for certainty, named in ((1.0, True), (0.1, False)):
        found = find_camera_errors(truth, Keypoints(points, certainty * keypoints.confidences, keypoints.set))
        assert bool(found) is named, certainty


@pytest.mark.slow  # two fits
def test_a_fit_turns_the_camera_back_and_says_so_and_check_names_it(tmp_path):
    truth, keypoints = person(1, 1, 4)
    wrong = turned(truth, [2], (1.0, 0.0, 0.5))
    photos = Photos(wrong.images, None, wrong.cameras, wrong.frames, wrong.names)
    fitted, left = (fit_photos(photos, keypoints, truth.body, fixed_cameras=fixed) for fixed in (False, True))
    assert off(fitted.capture, truth).max() < ROLL < off(left.capture, truth).max()
    assert "camera m0v2 is off by 1" in str(fitted.report) and not any("camera" in w for w in fitted.report.warnings)
    assert any("camera m0v2 is off by" in warning for warning in left.report.warnings)
    assert any("camera m0v2" in warning for warning in examine(left.capture, keypoints).report.warnings)
    assert fitted.report.errors["keypoint_error_px"].after < left.report.errors["keypoint_error_px"].after
    # a body that is wider than the masks: cameras stay only where the keypoints say that they are right
    masks = np.zeros(truth.images.shape[:3], np.float32)
    said = lambda capture, known: str(
        check_capture(dataclasses.replace(capture, masks=masks), tmp_path / "x.png", known)
    )
    assert "--fixed-cameras" not in said(wrong, keypoints) + said(truth, None)
