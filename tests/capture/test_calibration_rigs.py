"""Cameras of motion capture programs and data sets come back as written; lens distortion."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from changes import edit_text

from humangs_jax.data.cameras import (
    distort,
    read_calibration,
    undistort,
    undistort_person,
)
from humangs_jax.data.capture_checks import CaptureError
from tests.capture import calibration_files as written

EXACT = 1e-9
NAMES, LENS, SIZE = written.NAMES, written.LENS, [written.WIDTH, written.HEIGHT]
K, POSES = written.scene()


FILES = Path(__file__).parents[1] / "data" / "files"


def test_cameras_of_panoptic_are_read_as_written(tmp_path):
    """Keys that mean something else in other programs do no harm."""
    content = written.panoptic()
    content["cameras"] = [
        each | {"distance": 2.0, "model": "fisheye"} for each in content["cameras"]
    ]
    (tmp_path / "calibration_1.json").write_text(json.dumps(content))
    found = read_calibration(tmp_path, lambda name: (1, 1))
    assert [camera.name for camera in found.cameras] == list(NAMES)
    for key, values in {"K": K, "cam_from_world": POSES, "distortion": [LENS] * 4}.items():
        got = [getattr(camera, key) for camera in found.cameras]
        np.testing.assert_allclose(got, values, atol=EXACT)


def test_a_file_without_cameras_is_refused(tmp_path):
    for content in (written.panoptic(), {"cameras": {}, "camera_poses": {}}):
        content["cameras"] = type(content["cameras"])()
        (tmp_path / "calibration_1.json").write_text(json.dumps(content))
        with pytest.raises(CaptureError, match=r"calibration_1\.json: has no camera"):
            read_calibration(tmp_path / "calibration_1.json", lambda name: (1, 1))


def edited(folder, name, old, new):
    """Copies another tool's file with one text replaced."""
    copy = Path(shutil.copy(FILES / name, folder))
    edit_text(copy, old, new)
    return copy


def test_a_field_of_view_of_qualisys_moves_the_centre_and_the_lens_of_shelf_is_in_opencvs_order(
    tmp_path,
):
    moved = edited(
        tmp_path,
        "pose2sim/Calib.qca.txt",
        '<fov_video bottom="1919" left="0" right="1087" top="0"/>',
        '<fov_video bottom="1001" left="3" right="1002" top="2"/>',
    )
    camera = read_calibration(moved, lambda name: (1, 1)).cameras[0]
    assert (camera.width, camera.height) == (1000, 1000)
    centre = [34110.316406 / 64 - 3, 60680.792969 / 64 - 2]
    np.testing.assert_allclose(camera.K[:2, 2], centre, atol=EXACT)
    values = json.loads((FILES / "mmpose/calibration_shelf.json").read_text())
    values["0"] |= {"k": [[1], [2], [5]], "p": [[3], [4]]}
    (tmp_path / "calibration_shelf.json").write_text(json.dumps(values))
    found = read_calibration(tmp_path / "calibration_shelf.json", lambda name: (1, 1))
    np.testing.assert_array_equal(found.cameras[0].distortion, [1, 2, 3, 4, 5])


@pytest.mark.parametrize("place", ["frame", "file"])
def test_a_whole_K_of_a_frame_or_of_the_file(place, tmp_path):
    """DNA-Rendering's views are written so for nerfstudio."""
    file = tmp_path / "transforms.json"
    written.write_transforms(file, K, POSES, written.FILES)
    values = json.loads(file.read_text())
    for frame, k in zip(values["frames"], K.tolist(), strict=True):
        for key in ("fl_x", "fl_y", "cx", "cy"):
            frame.pop(key)
        (frame if place == "frame" else values).setdefault("K", k)
    file.write_text(json.dumps(values))
    found = read_calibration(file, lambda name: SIZE)
    np.testing.assert_allclose(
        [camera.K for camera in found.cameras], K if place == "frame" else [K[0]] * 4, atol=EXACT
    )


@pytest.mark.parametrize("name", ["cameras.bin", "images.bin", "points3D.bin"])
def test_a_binary_model_that_is_cut_short_is_refused(name, tmp_path):
    for file in (FILES / "colmap").glob("*.bin"):
        shutil.copy(file, tmp_path)
    (tmp_path / name).write_bytes((FILES / "colmap" / name).read_bytes()[:-5])
    with pytest.raises(CaptureError, match=f"{name}: not a readable COLMAP model: cut short"):
        read_calibration(tmp_path, lambda name: (1, 1))


TOML, QUALISYS = "pose2sim/Calib_qca.toml", "pose2sim/Calib.qca.txt"
WRONG = {
    "fisheye": (TOML, "fisheye = false", "fisheye = true", "fisheye lenses are not supported"),
    "no place": (TOML, "translation", "other", r"cam_1\.translation: missing"),
    "no TOML": (TOML, "[cam_1]", "[cam_1", "not a readable calibration: Expected"),
    "entities": (QUALISYS, "<calibration", "<!ENTITY a 'b'><calibration", "XML with entities"),
    "no focal length": (QUALISYS, "focalLengthV", "f", r"camera 0\.intrinsic\.focalLengthV"),
}


@pytest.mark.parametrize("case", WRONG)
def test_wrong_files_are_one_line(case, tmp_path):
    name, old, new, problem = WRONG[case]
    file = edited(tmp_path, name, old, new)
    with pytest.raises(CaptureError, match=problem) as caught:
        read_calibration(file, lambda name: (1, 1))
    assert str(file) in str(caught.value) and "\n" not in str(caught.value)


def test_cameras_to_be_ignored_are_left_out(tmp_path):
    file = edited(tmp_path, "caliscope/camera_array.toml", "ignore = false", "ignore = true")
    found = read_calibration(file, lambda name: (1, 1))
    assert [camera.name for camera in found.cameras] == ["1", "2", "3"]
    file.write_text(file.read_text().replace("ignore = false", "ignore = true"))
    with pytest.raises(CaptureError, match="every camera is to be ignored"):
        read_calibration(file, lambda name: (1, 1))


# Lenses
# --------------------------------------------------------------------------------------------------


def test_dots_land_where_the_pinhole_says():
    K = np.asarray([[110.0, 0, 63.5], [0, 108, 50], [0, 0, 1]])
    coefficients = np.asarray([-0.25, 0.08, 0.004, -0.003, 0.01])
    dots = np.stack(np.meshgrid(np.arange(-4, 5) * 0.12, np.arange(-3, 4) * 0.12), axis=-1).reshape(
        -1, 2
    )
    pinhole, lens = (
        plane * np.diag(K)[:2] + K[:2, 2] for plane in (dots, distort(dots, coefficients))
    )
    assert np.linalg.norm(pinhole - lens, axis=-1).max() > 4  # the lens matters
    columns, rows = np.meshgrid(np.arange(128) + 0.5, np.arange(100) + 0.5)

    def spots(where):
        return np.exp(-((columns - where[0]) ** 2 + (rows - where[1]) ** 2) / (2 * 1.5**2))

    photo = sum(spots(where) for where in lens).astype(np.float32)
    straight = undistort(photo, K, coefficients, fill=0.0)
    for where in pinhole:
        near = straight * (np.hypot(columns - where[0], rows - where[1]) < 5)
        centroid = np.asarray([(near * columns).sum(), (near * rows).sum()]) / near.sum()
        # of bilinear lookups; the dots move by up to 4.9 px
        np.testing.assert_allclose(centroid, where, atol=0.06)


@pytest.mark.parametrize(
    "focal, coefficients", [(400, [-0.1, 0.03, 1e-3, -1e-3, 0]), (60, [-0.3, 0, 0, 0, 0])]
)
def test_a_person_is_undistorted_as_the_whole_photo_is(focal, coefficients):
    """This also holds where the lens folds, and in a photo without a person."""
    K, coefficients = (
        np.asarray([[focal, 0, 66.0], [0, focal, 50], [0, 0, 1]]),
        np.asarray(coefficients),
    )
    random = np.random.default_rng(0)
    for rows, columns in (
        (slice(30, 70), slice(50, 75)),
        (slice(0, 20), slice(100, 130)),
        (slice(0), slice(0)),
    ):
        mask = np.zeros((100, 130), np.float32)
        mask[rows, columns] = 1
        image = np.where(
            mask[..., None] > 0, random.random((100, 130, 3), np.float32), np.float32(1)
        )
        straight, person = undistort_person(image, mask, K, coefficients)
        np.testing.assert_array_equal(person, undistort(mask, K, coefficients, fill=0.0))
        np.testing.assert_allclose(straight, undistort(image, K, coefficients, fill=1.0), atol=1e-6)


def test_distortion_is_opencvs():
    radial = 1 + 0.1 * 0.05 - 0.2 * 0.0025 + 0.5 * 0.000125  # by hand: r^2 = 0.05
    x = 0.1 * radial + 2 * 0.01 * 0.02 + 0.03 * (0.05 + 0.02)
    y = 0.2 * radial + 0.01 * (0.05 + 0.08) + 2 * 0.03 * 0.02
    got = distort(np.asarray([0.1, 0.2]), np.asarray([0.1, -0.2, 0.01, 0.03, 0.5]))
    np.testing.assert_allclose(got, [x, y], rtol=1e-12)


def of_folds(*folds):
    """Returns a lens whose slope is 0 at these radii squared.

    The slope d/dr (r + k1 r^3 + k2 r^5 + k3 r^7) is the product of (1 - r^2 / fold).
    """
    slope = np.polynomial.Polynomial([1.0])
    for fold in folds:
        slope *= np.polynomial.Polynomial([1, -1 / fold])
    k1, k2, k3 = np.pad(slope.coef, (0, 4 - len(slope.coef)))[1:] / [3, 5, 7]
    return [k1, k2, 0, 0, k3]


@pytest.mark.parametrize(
    ("coefficients", "fold"),
    [
        *((of_folds(*folds), min(folds)) for folds in ((2,), (3, 2), (5, 2, 3))),
        (of_folds(-1, 4), 4),
        (of_folds(-1, -2, -3), np.inf),
        ([0.0] * 5, np.inf),
        *(([-0.3, 0, 0, 0, k3], 1 / 0.9) for k3 in (1e-310, -1e-310)),
        ([-1e308] * 5, 0),
    ],
)
def test_a_lens_shows_nothing_beyond_its_first_fold(coefficients, fold):
    K = np.asarray([[15.0, 0, 40], [0, 15, 40], [0, 0, 1]])
    rows, columns = (np.mgrid[:80, :80] + 0.5 - 40) / 15
    squared = rows**2 + columns**2
    with np.errstate(all="ignore"):
        straight = undistort(np.zeros((80, 80), np.float32), K, np.asarray(coefficients), fill=1.0)
        seen = np.abs(distort(np.stack([columns, rows], axis=-1), np.asarray(coefficients)))
    inside = (seen < 38 / 15).all(axis=-1)
    np.testing.assert_array_equal(straight[squared >= fold], 1)
    np.testing.assert_array_equal(straight[inside & (squared < fold - 0.1)], 0)
