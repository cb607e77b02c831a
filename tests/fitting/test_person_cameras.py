"""Cameras from the person, against true ones."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from fit_people import default_body
from person_views import FOCAL, MIRROR, NAMES, cameras_around, errors_of, posed, seen_by

from humangs_jax.body.model import BodyPose, shape_body
from humangs_jax.data.capture import Capture
from humangs_jax.fitting.person_cameras import (
    SeveralMomentsError,
    cameras_from_person,
    cameras_of_moment,
    scaled_to_height,
)
from humangs_jax.geometry.camera import Camera, stack_cameras

EXACT_DEGREES, EXACT_METRES = 0.1, 0.01
"""Of exact landmarks: float32, and priors (size, level cameras) that are not quite those of the test's person."""
NOISE = {"pixels": 4.0, "world": 0.04, "turn": 10.0, "size": 0.93}
"""What the detector is off on photos of 1,920 pixels."""
NOISY_DEGREES, NOISY_METRES = 3.5, 0.25
"""Means over the cameras with that noise; a man's photos gave 1.6 to 2.5 degrees and 6 to 14 cm."""


@pytest.mark.parametrize(
    ("views", "pose"),
    [(4, "crouching"), *(pytest.param(views, "standing", marks=pytest.mark.slow) for views in (3, 8))],
)
def test_exact_landmarks_give_exact_cameras(views, pose):
    matrices = cameras_around(views)
    found = cameras_from_person(seen_by(posed(pose), matrices))
    angles, centers, _ = errors_of(found, matrices)
    assert found.moments == 1 and found.views == tuple(range(views)) and not found.mirrored.any()
    assert angles.max() < EXACT_DEGREES and centers.max() < EXACT_METRES
    assert found.errors.max() < 0.5


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (1, 2))])
def test_noise_of_a_detector(seed):
    matrices = cameras_around(4, seed)
    found = cameras_from_person(seen_by(posed("standing", seed, 0.2), matrices, seed=seed, **NOISE))
    angles, centers, _ = errors_of(found, matrices)
    assert found.moments == 1 and angles.mean() < NOISY_DEGREES and centers.mean() < NOISY_METRES


def test_the_height_sets_the_scale():
    matrices, landmarks = cameras_around(4), posed()
    scales = []
    for height in (None, 1.5, 1.8):
        found = cameras_from_person(seen_by(landmarks, matrices, size=0.9), height=height)
        scales.append(1 / errors_of(found, matrices)[2])
    assert scales[0] == pytest.approx(0.9, rel=0.03)
    assert scales[2] / scales[1] == pytest.approx(1.8 / 1.5, rel=1e-4)
    assert any("height is not given" in line for line in cameras_from_person(seen_by(landmarks, matrices)).warnings)


def test_the_person_stands_upright_and_looks_at_plus_z():
    found = cameras_from_person(seen_by(posed(), cameras_around(4)))
    points = found.landmarks[0]
    at = lambda name: points[NAMES.index(name)]
    assert points[:, 1].min() == pytest.approx(0, abs=1e-6)
    assert at("nose")[1] > at("left_hip")[1] > at("left_knee")[1] > at("left_ankle")[1]
    assert at("left_shoulder")[0] > at("right_shoulder")[0] and at("nose")[2] > at("left_ear")[2]


@pytest.mark.parametrize("view", [0, pytest.param(1, marks=pytest.mark.slow)])
def test_a_mirrored_view_is_found(view):
    matrices = cameras_around(4)
    seen = seen_by(posed("crouching"), matrices, **NOISE | {"turn": 0.0})
    points, world = seen.points.copy(), seen.world.copy()
    points[view], world[view] = points[view][MIRROR], world[view][MIRROR]
    found = cameras_from_person(dataclasses.replace(seen, points=points, world=world))
    assert found.mirrored.tolist() == [v == view for v in range(4)]
    assert errors_of(found, matrices)[0].mean() < NOISY_DEGREES
    assert any(f"p{view}.jpg: the detector exchanged left and right" in line for line in found.warnings)


@pytest.mark.slow
def test_the_order_of_photos_does_not_matter():
    matrices, order = cameras_around(4), [2, 0, 3, 1]
    seen = seen_by(posed(), matrices, **NOISE)
    first, second = cameras_from_person(seen), cameras_from_person(seen.select(order))
    focal = lambda found: np.asarray([float(camera.K[0, 0]) for camera in found.cameras])
    np.testing.assert_allclose(focal(first)[order], focal(second), rtol=5e-3)
    ours, theirs = (np.asarray([c.cam_from_world for c in found.cameras])[:, 2, 3] for found in (first, second))
    np.testing.assert_allclose(ours[order], theirs, rtol=0.02)


def test_a_wrong_focal_length_changes_distances_and_hardly_directions():
    matrices = cameras_around(4)
    found = cameras_from_person(seen_by(posed(), matrices, focal=1.15 * 1680))
    angles, centers, _ = errors_of(found, matrices)
    assert angles.max() < NOISY_DEGREES and centers.max() < NOISY_METRES
    assert all(float(camera.K[0, 0]) < 1.15 * 1680 for camera in found.cameras)


@pytest.mark.slow
def test_one_photo_is_enough_for_its_own_camera():
    matrices = cameras_around(1)
    found = cameras_from_person(seen_by(posed(), matrices))
    true = np.linalg.norm(matrices[0][:3, 3])
    assert found.moments == 1
    assert np.linalg.norm(np.asarray(found.cameras[0].cam_from_world)[:3, 3]) == pytest.approx(true, rel=0.15)


def several_moments():
    changes = (("standing", 0, 0.0), ("crouching", 0, 0.4), ("standing", 5, 0.5), ("crouching", 7, 0.5))
    return seen_by(np.stack([posed(*change) for change in changes]), cameras_around(4))


def test_photos_of_several_moments_are_told():
    with pytest.raises(SeveralMomentsError, match="% of the person's size"):
        cameras_of_moment(several_moments())


@pytest.mark.slow
def test_photos_of_several_moments_stand_alone():
    found = cameras_from_person(several_moments())
    assert found.moments == 4 and len(found.cameras) == 4 and found.landmarks.shape == (4, len(NAMES), 3)


@pytest.mark.slow
def test_a_photo_of_another_moment_is_left_out_by_name():
    matrices = cameras_around(5)
    landmarks = np.stack([posed("standing")] * 4 + [posed("crouching", 0, 0.4)])
    found = cameras_from_person(seen_by(landmarks, matrices))
    assert found.views == (0, 1, 2, 3) and found.moments == 1
    assert any(line.startswith("p4.jpg: left out") for line in found.warnings)


def test_what_cannot_be_used_is_refused_by_name():
    seen = seen_by(posed(), cameras_around(4))
    hidden = seen.visibility.copy()
    hidden[1, 4:] = 0
    with pytest.raises(ValueError, match=r"p1\.jpg: 4 landmarks of the person are seen, expected 6 or more"):
        cameras_from_person(dataclasses.replace(seen, visibility=hidden))
    with pytest.raises(ValueError, match="height 178: expected metres"):
        cameras_from_person(seen, height=178.0)
    with pytest.raises(ValueError, match=r"p0\.jpg: all landmarks of the person lie within 16 pixels"):
        cameras_from_person(dataclasses.replace(seen, points=np.zeros_like(seen.points)))
    with pytest.raises(ValueError, match="no photo of the person"):
        cameras_from_person(seen.select([]))


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
        poses=jax.vmap(BodyPose)(jnp.zeros((1, len(body.parents), 3)), -rest.joints[:1] + jnp.asarray([0.1, 0.2, 0.0])),
        names=("a",),
    )
    tall = scaled_to_height(capture, 1.9)

    def of(capture):
        vertices = np.asarray(shape_body(body, jnp.asarray(capture.betas)).vertices + capture.poses.translation[0])
        seen = vertices @ np.asarray(capture.cameras.cam_from_world[0, :3, :3]).T + np.asarray(
            capture.cameras.cam_from_world[0, :3, 3]
        )
        return np.ptp(vertices[:, 1]), seen[:, :2] / seen[:, 2:]

    (_, before), (height, after) = of(capture), of(tall)
    assert height == pytest.approx(1.9, abs=0.003)
    assert np.ptp(after[:, 1]) == pytest.approx(np.ptp(before[:, 1]), rel=0.01)
