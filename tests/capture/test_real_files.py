"""Files of other programs (tests/data/files) have the values that are known for them.

The values come from the files' own text, from another program, or from the photos.
"""

import shutil
from pathlib import Path

import numpy as np
import pytest

from humangs_jax.capture.calibration.checks import check_calibration
from humangs_jax.capture.calibration.loaded import load_cameras
from humangs_jax.capture.keypoints.reading import read_keypoints
from humangs_jax.data.cameras import read_calibration
from humangs_jax.data.capture_checks import CaptureError

FILES = Path(__file__).parents[1] / "data" / "files"
DIGITS = 1e-3
"""Largest error of places, in the unit of each file: they are written below with three decimals."""
OPENPOSE = 32
"""Largest error in pixels of OpenPose's points of a person who is 700 pixels high."""


def read(name):
    return read_calibration(FILES / name, lambda photo: (800, 800))


EXPECTED = {
    # file: cameras, size and camera matrix of the first, its lens, where it stands
    "colmap": (
        ("100_7109.JPG", "100_7100.JPG", "100_7101.JPG"),
        (2832, 2128),
        (2971.71, 2971.71, 1416, 1064),
        (-0.164224, 0, 0, 0, 0),
        (3.8942, 0.6734, 3.3652),
    ),
    "caliscope/camera_array.toml": (
        "0123",
        (1280, 720),
        (903.550124, 907.878867, 618.308630, 394.213231),
        (-0.332099300, 0.0464196862, -0.00429577157, 0.00411324010, 0.0665682301),
        (0.9443, 0.7562, -0.1640),
    ),
    "pose2sim/Calib.qca.txt": (
        ("cam01", "cam02", "cam03", "cam04"),
        (1088, 1920),
        (107599.671875 / 64, 107588.828125 / 64, 34110.316406 / 64, 60680.792969 / 64),
        (-0.046183, 0.139983, 0.000608, 0.00069, 0),
        (1.4602, -1.9092, 1.8965),
    ),
    "mmpose/calibration_shelf.json": (
        "01234",
        (None, None),
        (1063.512085, 1071.863647, 511.738251, 350.088287),
        None,
        (-1586.4505, -2109.4707, 1104.2086),
    ),
    "nerfstudio/transforms_train.json": (
        ("./train/r_0",),
        (800, 800),
        (1111.1110, 1111.1110, 400, 400),
        None,
        (-0.0538, 3.8455, 1.2081),
    ),
}


@pytest.mark.parametrize("name", EXPECTED)
def test_cameras_of_other_programs_are_where_they_stood(name):
    names, size, K, lens, place = EXPECTED[name]
    cameras = read(name).cameras
    first = cameras[0]
    assert [camera.name for camera in cameras] == list(names)
    assert (first.width, first.height) == size
    np.testing.assert_allclose(first.K[[0, 1, 0, 1], [0, 1, 2, 2]], K, rtol=1e-6)
    assert (first.distortion is None) == (lens is None)
    if lens is not None:
        np.testing.assert_allclose(first.distortion, lens, rtol=1e-6)
    pose = first.cam_from_world
    np.testing.assert_allclose(-pose[:3, :3].T @ pose[:3, 3], place, atol=DIGITS)


@pytest.mark.parametrize("suffix", ["txt", "bin"])
def test_a_model_of_colmap_sees_its_points_where_colmap_found_them(suffix, tmp_path):
    """Models are text and binary; a misread number would move points by hundreds of pixels."""
    for file in (FILES / "colmap").glob(f"*.{suffix}"):
        shutil.copy(file, tmp_path)
    model = read_calibration(tmp_path, lambda photo: (1, 1))
    checks = check_calibration(model, model, "-y")
    assert checks.reprojection is not None and checks.reprojection < 0.6  # COLMAP itself: 0.58
    assert checks.observations == 53
    np.testing.assert_allclose(model.cameras[0].K, read("colmap").cameras[0].K, rtol=1e-5)
    one, other = (load_cameras(folder) for folder in (tmp_path, FILES / "colmap"))
    np.testing.assert_allclose(one.points, other.points, rtol=1e-5)
    np.testing.assert_array_equal(one.colors, other.colors)
    assert len(np.unique(one.colors)) > 10


def test_cameras_of_qualisys_are_those_that_pose2sim_made_of_them():
    """Lenses differ, because Pose2Sim had divided them by 64."""
    ours, theirs = (
        read(f"pose2sim/{name}").cameras for name in ("Calib.qca.txt", "Calib_qca.toml")
    )
    for one, other in zip(ours, theirs, strict=True):
        assert one.name == other.name
        np.testing.assert_allclose(one.cam_from_world, other.cam_from_world, atol=1e-12)
        np.testing.assert_allclose(one.K, other.K)


def test_keypoints_of_openpose_meet_in_space_between_the_cameras_of_qualisys():
    """A person balances upright, has human size, and has left and right at the right sides."""
    rig = read("pose2sim/Calib.qca.txt").cameras
    names = [f"{camera.name}.0050" for camera in rig]
    found = read_keypoints(FILES / "pose2sim/pose", names, 1088, 1920, person=0)
    assert found.set.name == "openpose_b67"
    place, errors = {}, []
    for k, name in enumerate(found.set.names):
        views = [v for v in range(len(rig)) if found.confidences[v, k] > 0.5]
        if len(views) < 3:
            continue
        matrices = [rig[v].K @ rig[v].cam_from_world[:3] for v in views]
        pixels = found.points[views, k] - 0.5  # Qualisys' first pixel has its centre at 0
        rows = [p[i] - xy[i] * p[2] for p, xy in zip(matrices, pixels, strict=True) for i in (0, 1)]
        point = np.linalg.svd(np.asarray(rows))[2][-1]
        place[name] = point[:3] / point[3]
        shown = np.asarray([p @ point for p in matrices])
        errors += list(np.linalg.norm(shown[:, :2] / shown[:, 2:] - pixels, axis=1))
    assert len(place) >= 10 and np.median(errors) < OPENPOSE / 2 and max(errors) < OPENPOSE
    assert 1.3 < place["head_top"][2] < 1.6 and 0 < place["left_ankle"][2] < 0.3
    assert 0.25 < np.linalg.norm(place["left_shoulder"] - place["right_shoulder"]) < 0.45


def test_a_fisheye_of_anipose_is_a_lens_for_scenes_and_refused_for_captures():
    file = FILES / "anipose/calibration.toml"
    with pytest.raises(CaptureError, match=r"cam_0\.fisheye: fisheye lenses are not supported"):
        read("anipose/calibration.toml")
    cameras = load_cameras(file)
    assert list(cameras) == ["A", "B", "C"]
    assert cameras["A"].lens == "fisheye"
    np.testing.assert_allclose(cameras["A"].distortion, [-0.0605929458, 0, 0, 0], rtol=1e-6)


def test_annotations_of_coco_are_where_they_were_set():
    found = read_keypoints(FILES / "coco/test_coco.json", ["000000000785"], 640, 425)
    assert found.set.name == "coco17" and not found.missing and not found.warnings
    expected = [[367, 81], [374, 73], [360, 75], [386, 78], [356, 81]]
    np.testing.assert_array_equal(found.points[0, :5], np.add(expected, 0.5))
    with pytest.raises(CaptureError, match=r"view 000000196141: 3 people: expected one"):
        read_keypoints(FILES / "coco/test_coco.json", ["000000196141"], 640, 429)
