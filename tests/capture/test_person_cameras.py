"""Cameras from the person, against true ones."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from fit_people import (
    FOCAL,
    MIRRORED,
    NAMES,
    cameras_around,
    default_body,
    errors_of,
    person,
    posed,
    seen_by,
)

from humangs_jax.apps.check import check_capture
from humangs_jax.body.model import BodyPose, shape_body
from humangs_jax.capture.fitting.camera_errors import find_camera_errors, mended
from humangs_jax.capture.fitting.fit_capture import examine, fit_photos
from humangs_jax.capture.fitting.person_cameras import cameras_from_person, scaled_to_height
from humangs_jax.capture.fitting.person_moments import ONE_MOMENT, explain
from humangs_jax.capture.keypoints.keypoints import Keypoints
from humangs_jax.core.pytree import replace
from humangs_jax.data.capture import Capture
from humangs_jax.data.photos import Photos
from humangs_jax.geometry import quaternion, transform
from humangs_jax.geometry.camera import Camera, stack_cameras

EXACT_DEGREES, EXACT_METRES = 0.1, 0.01
"""Largest errors with exact landmarks.

They come from float32 and from priors on size and level cameras, which do not quite hold here.
"""
NOISE = {"pixels": 4.0, "world": 0.04, "turn": 10.0, "size": 0.93}
"""Errors of the detector on photos of 1,920 pixels."""
NOISY_DEGREES, NOISY_METRES = 3.5, 0.25
"""Largest mean errors with that noise; photos of a man gave 1.6 to 2.5 degrees and 6 to 14 cm."""


@pytest.mark.parametrize(("views", "pose"), [(4, "crouching"), (3, "standing"), (8, "standing")])
def test_exact_landmarks_give_exact_cameras_of_a_person_who_stands_upright_and_looks_at_plus_z(
    views, pose
):
    matrices = cameras_around(views)
    found = cameras_from_person(seen_by(posed(pose), matrices))
    angles, centers, _ = errors_of(found, matrices)
    assert found.moments == 1 and found.views == tuple(range(views)) and not found.mirrored.any()
    assert angles.max() < EXACT_DEGREES and centers.max() < EXACT_METRES
    assert found.errors.max() < 0.5
    points = found.landmarks[0]
    point_of = lambda name: points[NAMES.index(name)]
    assert points[:, 1].min() == pytest.approx(0, abs=1e-6)
    assert point_of("nose")[1] > point_of("left_hip")[1] > point_of("left_ankle")[1]
    assert (
        point_of("left_shoulder")[0] > point_of("right_shoulder")[0]
        and point_of("nose")[2] > point_of("left_ear")[2]
    )


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_noise_of_a_detector(seed):
    matrices = cameras_around(4, seed)
    found = cameras_from_person(seen_by(posed("standing", seed, 0.2), matrices, seed=seed, **NOISE))
    angles, centers, _ = errors_of(found, matrices)
    assert found.moments == 1 and angles.mean() < NOISY_DEGREES and centers.mean() < NOISY_METRES


def test_the_height_sets_the_scale():
    matrices, seen = cameras_around(3), seen_by(posed(), cameras_around(3), size=0.9)
    found = {height: cameras_from_person(seen, height=height) for height in (None, 1.5, 1.8)}
    scales = {height: 1 / errors_of(each, matrices)[2] for height, each in found.items()}
    assert scales[None] == pytest.approx(0.9, rel=0.03) and scales[1.8] / scales[
        1.5
    ] == pytest.approx(1.2, rel=1e-4)
    assert any("height is not given" in line for line in found[None].warnings)


def test_a_mirrored_view_is_found():
    matrices = cameras_around(3)
    seen = seen_by(posed("crouching"), matrices, **NOISE | {"turn": 0.0})
    points, world = seen.points.copy(), seen.world.copy()
    points[1], world[1] = points[1][MIRRORED], world[1][MIRRORED]
    found = cameras_from_person(dataclasses.replace(seen, points=points, world=world))
    assert found.mirrored.tolist() == [False, True, False]
    assert errors_of(found, matrices)[0].mean() < NOISY_DEGREES
    assert any("p1.jpg: the detector exchanged left and right" in line for line in found.warnings)


def test_the_order_of_photos_does_not_matter():
    matrices, order = cameras_around(4), [2, 0, 3, 1]
    seen = seen_by(posed(), matrices, **NOISE)
    first, second = cameras_from_person(seen), cameras_from_person(seen.select(order))
    focal = lambda found: np.asarray([float(camera.K[0, 0]) for camera in found.cameras])
    np.testing.assert_allclose(focal(first)[order], focal(second), rtol=5e-3)
    ours, theirs = (
        np.asarray([c.cam_from_world for c in found.cameras])[:, 2, 3] for found in (first, second)
    )
    np.testing.assert_allclose(ours[order], theirs, rtol=0.02)


def test_a_wrong_focal_length_changes_distances_and_hardly_directions():
    matrices = cameras_around(4)
    found = cameras_from_person(seen_by(posed(), matrices, focal=1.15 * 1680))
    angles, centers, _ = errors_of(found, matrices)
    assert angles.max() < NOISY_DEGREES and centers.max() < NOISY_METRES
    assert all(float(camera.K[0, 0]) < 1.15 * 1680 for camera in found.cameras)


def test_one_photo_is_enough_for_its_own_camera():
    matrices = cameras_around(1)
    found = cameras_from_person(seen_by(posed(), matrices))
    true = np.linalg.norm(matrices[0][:3, 3])
    assert found.moments == 1
    assert np.linalg.norm(np.asarray(found.cameras[0].cam_from_world)[:3, 3]) == pytest.approx(
        true, rel=0.15
    )


def test_photos_of_several_moments_are_named_and_stand_alone():
    changes = (
        ("standing", 0, 0.0),
        ("crouching", 0, 0.4),
        ("standing", 5, 0.5),
        ("crouching", 7, 0.5),
    )
    seen = seen_by(np.stack([posed(*change) for change in changes]), cameras_around(4))
    assert explain(seen).trial is None
    found = cameras_from_person(seen)
    assert (
        found.moments == 4
        and len(found.cameras) == 4
        and found.landmarks.shape == (4, len(NAMES), 3)
    )


def test_a_photo_of_another_moment_is_left_out_by_name():
    matrices = cameras_around(5)
    landmarks = np.stack([posed("standing")] * 4 + [posed("crouching", 0, 0.4)])
    found = cameras_from_person(seen_by(landmarks, matrices))
    assert found.views == (0, 1, 2, 3) and found.moments == 1
    assert any(line.startswith("p4.jpg: left out") for line in found.warnings)


def cameras_at(*azimuths):
    """Returns cam_from_world of level cameras around the origin, degrees from the front."""
    matrices = np.tile(np.eye(4), (len(azimuths), 1, 1))
    for matrix, azimuth in zip(matrices, np.radians(azimuths), strict=True):
        vectors = jnp.asarray([[np.pi, 0, 0], [0, azimuth, 0]], jnp.float32)
        flip, around = np.asarray(quaternion.matrix_from_axis_angle(vectors), float)
        matrix[:3, :3], matrix[2, 3] = flip @ around, 3.6
    return matrices


@pytest.mark.parametrize("azimuths", [(0, 0.5, 1, 1.5), (40, 40.6, 41.2, 42, 42.4)])
def test_photos_from_one_side_stand_alone_with_a_warning(azimuths):
    found = cameras_from_person(seen_by(posed(), cameras_at(*azimuths)))
    assert found.moments == len(azimuths) == len(found.views)
    assert any(
        line.startswith("all photos are from one side (directions differ by")
        for line in found.warnings
    )


def test_photos_from_one_side_and_one_of_another_moment_stand_alone():
    landmarks = np.stack([posed()] * 3 + [posed("crouching", 0, 0.4)])
    found = cameras_from_person(seen_by(landmarks, cameras_at(0, 0.5, 1, 90)))
    assert found.moments == 4 and found.views == (0, 1, 2, 3)
    assert any(
        line.startswith("p0.jpg, p1.jpg, p2.jpg are from one side") for line in found.warnings
    )


@pytest.mark.parametrize("other", [None, 2, 11])
def test_of_many_photos_a_few_decide_and_the_others_are_compared_with_them(other):
    count = ONE_MOMENT.deciding + 4
    matrices = cameras_around(count)
    landmarks = np.stack(
        [
            posed("crouching", 0, 0.4) if view == other else posed("standing")
            for view in range(count)
        ]
    )
    seen = seen_by(landmarks, matrices, **NOISE)
    points, world = seen.points.copy(), seen.world.copy()
    points[5], world[5] = points[5][MIRRORED], world[5][MIRRORED]
    found = cameras_from_person(dataclasses.replace(seen, points=points, world=world))
    views = [view for view in range(count) if view != other]
    assert found.moments == 1 and list(found.views) == views
    assert [view for view, flip in zip(views, found.mirrored, strict=True) if flip] == [5]
    named = [line.partition(":")[0] for line in found.warnings if "left out" in line]
    assert named == ([] if other is None else [f"p{other}.jpg"])
    angles, centers, _ = errors_of(found, matrices[views])
    assert angles.mean() < NOISY_DEGREES and centers.mean() < NOISY_METRES


@pytest.mark.parametrize("factor", [1.4, 2.0, 0.7])
def test_a_photo_of_another_lens_without_exif_leaves_the_focal_lengths_of_the_others(factor):
    matrices = cameras_around(4)
    seen = seen_by(posed(), matrices)
    points, middle = seen.points.copy(), np.asarray(seen.sizes[1]) / 2
    points[1] = middle + factor * (points[1] - middle)
    focal = np.where(np.arange(4) == 1, np.nan, seen.focal)
    found = cameras_from_person(dataclasses.replace(seen, points=points, focal=focal))
    lengths = np.asarray([float(camera.K[0, 0]) for camera in found.cameras])
    np.testing.assert_allclose(lengths[[0, 2, 3]], FOCAL, rtol=0.015)
    assert abs(np.log(lengths[1] / (factor * FOCAL))) < abs(np.log(factor)) / 2
    assert errors_of(found, matrices)[0].max() < NOISY_DEGREES


def test_what_cannot_be_used_is_refused_by_name():
    seen = seen_by(posed(), cameras_around(4))
    hidden = seen.visibility.copy()
    hidden[1, 4:] = 0
    with pytest.raises(
        ValueError, match=r"p1\.jpg: 4 landmarks of the person are seen, expected 6 or more"
    ):
        cameras_from_person(dataclasses.replace(seen, visibility=hidden).select([1]))
    with pytest.raises(ValueError, match="height 178: expected metres"):
        cameras_from_person(seen, height=178.0)
    with pytest.raises(
        ValueError, match=r"p0\.jpg: all landmarks of the person lie within 16 pixels"
    ):
        cameras_from_person(dataclasses.replace(seen, points=np.zeros_like(seen.points)))
    with pytest.raises(ValueError, match="no photo of the person"):
        cameras_from_person(seen.select([]))
    for change in (
        {"sizes": seen.sizes[:3]},
        {"photos": seen.photos[1:]},
        {"names": seen.names[1:]},
    ):
        with pytest.raises(
            ValueError,
            match="expected points, visibility, world, sizes, focal and photos of 4 views",
        ):
            cameras_from_person(dataclasses.replace(seen, **change))


def test_a_person_of_another_height_looks_the_same():
    body = default_body()
    matrix = cameras_around(1)[0].astype(np.float32)
    camera = Camera.from_opencv([[FOCAL, 0, 544], [0, FOCAL, 960], [0, 0, 1]], matrix, 1088, 1920)
    rest = shape_body(body, jnp.zeros(4))
    capture = Capture(
        images=np.ones((1, 1920, 1088, 3), np.float32),
        masks=None,
        cameras=stack_cameras([camera]),
        frames=np.zeros(1, np.int32),
        body=body,
        betas=np.zeros(body.shape_directions.shape[-1], np.float32),
        poses=jax.vmap(BodyPose)(
            jnp.zeros((1, len(body.parents), 3)), -rest.joints[:1] + jnp.asarray([0.1, 0.2, 0.0])
        ),
        names=("a",),
        displacement=np.full(body.template.shape, 0.01, np.float32),
    )
    tall = scaled_to_height(capture, 1.9)
    np.testing.assert_allclose(
        tall.displacement, 0.01 * 1.9 / np.ptp(rest.vertices[:, 1]), rtol=1e-5
    )

    def height_and_view(capture):
        vertices = np.asarray(
            shape_body(body, jnp.asarray(capture.betas)).vertices + capture.poses.translation[0]
        )
        matrix = np.asarray(capture.cameras.cam_from_world[0])
        seen = vertices @ matrix[:3, :3].T + matrix[:3, 3]
        return np.ptp(vertices[:, 1]), seen[:, :2] / seen[:, 2:]

    # the body grows and the camera moves back: the view stays
    (_, before), (height, after) = height_and_view(capture), height_and_view(tall)
    assert height == pytest.approx(1.9, abs=0.003)
    assert np.ptp(after[:, 1]) == pytest.approx(np.ptp(before[:, 1]), rel=0.01)


# A camera that is turned is found, named and turned back; cameras that are right are left alone
# -----------------------


TURN, ROLL = 0.35, 0.9
"""Largest remainders of a turn by 1 degree, degrees.

Keypoints of one moment err by a pixel and the person is 120 pixels high. 17 of them know a turn
about the camera's own axis only to 0.45 degrees.
"""
VIEWS = 4
"""Number of cameras of people who move."""


def turned(capture, views, vector):
    """Returns the capture with cameras turned by a vector in their axes, degrees."""
    rotations = np.zeros((capture.view_count, 3), np.float32)
    rotations[views] = np.radians(vector)
    turns = transform.make(
        quaternion.matrix_from_axis_angle(jnp.asarray(rotations)), jnp.zeros((len(rotations), 3))
    )
    return dataclasses.replace(
        capture,
        cameras=replace(capture.cameras, cam_from_world=turns @ capture.cameras.cam_from_world),
    )


def off(capture, truth):
    """Returns degrees (v,) between the cameras of two captures."""
    between = capture.cameras.cam_from_world[:, :3, :3] @ jnp.swapaxes(
        truth.cameras.cam_from_world[:, :3, :3], -1, -2
    )
    return np.degrees(
        np.linalg.norm(quaternion.to_axis_angle(quaternion.from_matrix(between)), axis=-1)
    )


@pytest.mark.parametrize(("views", "seed"), [(3, 1), (6, 0)])
def test_a_camera_turned_by_a_degree_is_named_and_turned_back_and_right_ones_are_left(views, seed):
    truth, keypoints = person(seed, 1, views)
    assert find_camera_errors(truth, keypoints) == ()
    for vector in ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.6, -0.6, 0.5)):
        (error,) = find_camera_errors(turned(truth, [1], vector), keypoints)
        assert (
            error.views == (1,)
            and error.names[0] == "m0v1"
            and str(error).startswith("camera m0v1")
        )
        assert error.degrees == pytest.approx(
            1.0, abs=TURN
        ) and f"{error.degrees:.1f} degrees" in str(error)
        assert off(mended(turned(truth, [1], vector), (error,)), truth).max() < ROLL


def test_all_moments_of_a_camera_that_stands_still_count_and_two_cameras_may_be_off():
    truth, keypoints = person(3, 4, 4, still=True, even=True)
    assert find_camera_errors(truth, keypoints) == ()
    wrong = turned(
        turned(truth, range(1, 16, 4), (1.0, 0.0, 0.3)), range(2, 16, 4), (-0.8, 0.3, 0.0)
    )
    errors = find_camera_errors(wrong, keypoints)
    assert sorted(error.views[0] for error in errors) == [1, 2] and all(
        len(error.views) == 4 for error in errors
    )
    assert off(mended(wrong, errors), truth).max() < TURN


@pytest.mark.parametrize("views", [1, 2])
def test_nothing_is_reported_for_one_or_two_cameras(views):
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
        assert (
            find_camera_errors(truth, Keypoints(wrong, keypoints.confidences, keypoints.set)) == ()
        )
    nothing = Keypoints(points, np.zeros_like(keypoints.confidences), keypoints.set)
    assert find_camera_errors(truth, nothing) == ()


def test_landmarks_that_the_detector_hardly_sees_turn_no_camera():
    """An error that all landmarks of a view share is a rotation, however little they scatter: their
    certainty decides.
    """
    truth, keypoints = person(2, 1, 4)
    points = np.array(keypoints.points)
    points[1] += [3.0, 0.0]
    for certainty, named in ((1.0, True), (0.1, False)):
        found = find_camera_errors(
            truth, Keypoints(points, certainty * keypoints.confidences, keypoints.set)
        )
        assert bool(found) is named, certainty


@pytest.mark.slow  # two fits
def test_a_fit_turns_the_camera_back_and_says_so_and_check_names_it(tmp_path):
    truth, keypoints = person(1, 1, 4)
    wrong = turned(truth, [2], (1.0, 0.0, 0.5))
    photos = Photos(wrong.images, None, wrong.cameras, wrong.frames, wrong.names)
    fitted, left = (
        fit_photos(photos, keypoints, truth.body, fixed_cameras=fixed) for fixed in (False, True)
    )
    assert off(fitted.capture, truth).max() < ROLL < off(left.capture, truth).max()
    assert "camera m0v2 is off by 1" in str(fitted.report) and not any(
        "camera" in w for w in fitted.report.warnings
    )
    assert any("camera m0v2 is off by" in warning for warning in left.report.warnings)
    assert any(
        "camera m0v2" in warning for warning in examine(left.capture, keypoints).report.warnings
    )
    assert (
        fitted.report.errors["keypoint_error_px"].after
        < left.report.errors["keypoint_error_px"].after
    )
    # a body that is wider than the masks: cameras stay only where the keypoints say that they are
    # right
    masks = np.zeros(truth.images.shape[:3], np.float32)

    def report_of(capture, known):
        return str(
            check_capture(dataclasses.replace(capture, masks=masks), tmp_path / "x.png", known)
        )

    assert "--fixed-cameras" not in report_of(wrong, keypoints) + report_of(truth, None)
