"""Cameras of motion capture programs and data sets, written from known cameras and read back; lens
distortion.
"""

import json

import numpy as np
import pytest

from humangs_jax.data.cameras import (
    _squared_reach,
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


OTHERS = {"distance": 2.0, "model": "fisheye"}
OTHER_KEYS = 'distance = 2.0\nmodel = "fisheye"'
FORMATS = {
    "Caliscope": ("camera_array.toml", lambda: written.tables("cameras.{}"), "0123", LENS),
    "Anipose": ("calibration.toml", lambda: written.tables("cam_{}", "{}"), NAMES, LENS),
    "Pose2Sim": (
        "Calib.toml",
        lambda: written.tables("cam_{}", "{}", "fisheye = false"),
        NAMES,
        LENS,
    ),
    "Panoptic": ("calibration_160906.json", written.panoptic, NAMES, LENS),
    "TOML, other keys": (
        "Calib.toml",
        lambda: written.tables("cam_{}", "{}", OTHER_KEYS),
        NAMES,
        LENS,
    ),
    "Panoptic, other keys": (
        "calibration_1.json",
        lambda: {"cameras": [c | OTHERS for c in written.panoptic()["cameras"]]},
        NAMES,
        LENS,
    ),
    "Shelf": ("calibration_shelf.json", written.shelf, "0123", LENS),
    "Qualisys": ("Calib.qca.txt", written.qualisys, NAMES, [*LENS[:4], 0.0]),
}


@pytest.mark.parametrize("kind", FORMATS)
def test_cameras_are_read_as_written(kind, tmp_path):
    name, content, names, lens = FORMATS[kind]
    text = content()
    (tmp_path / name).write_text(text if isinstance(text, str) else json.dumps(text))
    for source in (tmp_path / name, tmp_path):
        found = read_calibration(source, lambda name: (1, 1))
        assert [camera.name for camera in found.cameras] == list(names)
        np.testing.assert_allclose([camera.K for camera in found.cameras], K, atol=EXACT)
        np.testing.assert_allclose(
            [camera.cam_from_world for camera in found.cameras], POSES, atol=EXACT
        )
        np.testing.assert_allclose(
            [camera.distortion for camera in found.cameras], [lens] * 4, atol=EXACT
        )


@pytest.mark.parametrize("place", ["frame", "file"])
def test_a_whole_K_of_a_frame_or_of_the_file(place, tmp_path):
    """As DNA-Rendering's views are written for nerfstudio."""
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


def test_a_binary_model_of_colmap_is_the_text_model(tmp_path):
    world = written.points()
    seen = [written.project(k, pose, world) for k, pose in zip(K, POSES, strict=True)]
    written.write_colmap(
        tmp_path / "text", K, POSES, [f"{n}.png" for n in NAMES], seen=seen, world_points=world
    )
    (tmp_path / "binary").mkdir()
    written.write_binary(tmp_path / "binary", tmp_path / "text")
    one, other = (
        read_calibration(tmp_path / kind, lambda name: (1, 1)) for kind in ("text", "binary")
    )
    for a, b in zip(one.cameras, other.cameras, strict=True):
        assert (a.name, a.width, a.height) == (b.name, b.width, b.height)
        np.testing.assert_array_equal(a.K, b.K)
        np.testing.assert_array_equal(a.cam_from_world, b.cam_from_world)
    assert one.observations is not None and other.observations is not None
    np.testing.assert_array_equal(one.observations.pixels, other.observations.pixels)
    np.testing.assert_array_equal(one.observations.points, other.observations.points)
    for name in ("cameras.bin", "images.bin", "points3D.bin"):
        whole = (tmp_path / "binary" / name).read_bytes()
        (tmp_path / "binary" / name).write_bytes(whole[:-5])
        with pytest.raises(
            CaptureError, match=f"{name}: not a readable COLMAP model: cut short, or damaged"
        ):
            read_calibration(tmp_path / "binary", lambda name: (1, 1))
        (tmp_path / "binary" / name).write_bytes(whole)


WRONG = {
    "ignored": (
        "a.toml",
        written.tables("cameras.{}", extra="ignore = true"),
        "every camera is to be ignored",
    ),
    "fisheye": (
        "a.toml",
        written.tables("cam_{}", extra="fisheye = true"),
        "fisheye lenses are not supported",
    ),
    "no place": (
        "a.toml",
        written.tables("cam_{}").replace("translation", "other"),
        r"cam_0\.translation: missing",
    ),
    "no TOML": ("a.toml", "[cam_0", "not a readable calibration: Expected"),
    "a size": (
        "a.json",
        '{"a": {"K": [1,0,0,0,1,0,0,0,1], "R": [0,0,0], "T": [0,0,0], "width": 0.5, "height": 2}}',
        r"a\.width: expected",
    ),
    "a matrix": (
        "a.yml",
        "!!opencv-matrix {rows: 1, cols: 1, dt: d, data: [1]}",
        "expected keys with values",
    ),
    "a JSON matrix": (
        "a.json",
        '{"type_id": "opencv-matrix", "rows": 1, "cols": 1, "dt": "d", "data": [1]}',
        "expected keys with",
    ),
    "entities": (
        "a.qca.txt",
        "<!DOCTYPE x [<!ENTITY a 'b'>]>" + written.qualisys(),
        "XML with entities",
    ),
    "no focal length": (
        "a.qca.txt",
        written.qualisys().replace("focalLengthV", "other"),
        r"camera 0\.intrinsic\.focalLengthV",
    ),
    "no list": ("a.json", json.dumps({"cameras": [{"name": "a"}]}), r"cameras\[0\]\.K: missing"),
}


@pytest.mark.parametrize("case", WRONG)
def test_wrong_files_are_one_line(case, tmp_path):
    name, text, problem = WRONG[case]
    (tmp_path / name).write_text(text)
    with pytest.raises(CaptureError, match=problem) as caught:
        read_calibration(tmp_path / name, lambda name: (1, 1))
    assert str(tmp_path / name) in str(caught.value) and "\n" not in str(caught.value)


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
    spots = lambda where: np.exp(
        -((columns - where[0]) ** 2 + (rows - where[1]) ** 2) / (2 * 1.5**2)
    )
    photo = sum(spots(where) for where in lens).astype(np.float32)
    straight = undistort(photo, K, coefficients, fill=0.0)
    for where in pinhole:
        near = straight * (np.hypot(columns - where[0], rows - where[1]) < 5)
        centroid = np.asarray([(near * columns).sum(), (near * rows).sum()]) / near.sum()
        np.testing.assert_allclose(
            centroid, where, atol=0.06
        )  # of bilinear lookups; the dots move by up to 4.9 px


@pytest.mark.parametrize(
    "focal, coefficients", [(400, [-0.1, 0.03, 1e-3, -1e-3, 0]), (60, [-0.3, 0, 0, 0, 0])]
)
def test_a_person_is_undistorted_as_the_whole_photo_is(focal, coefficients):
    """Also where the lens folds, and with nobody in the photo."""
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


def test_a_folded_lens_shows_nothing_twice():
    K = np.asarray([[30.0, 0, 40], [0, 30, 40], [0, 0, 1]])
    photo = np.zeros((80, 80), np.float32)
    straight = undistort(photo, K, np.asarray([-0.3, 0, 0, 0, 0.0]), fill=1.0)
    r = np.hypot(*(np.mgrid[:80, :80] + 0.5 - 40)) / 30
    np.testing.assert_array_equal(straight[r**2 >= 1 / 0.9], 1)
    np.testing.assert_array_equal(straight[r**2 < 1 / 0.9 - 0.05], 0)


@pytest.mark.parametrize("folds", [(2,), (3, 2), (5, 2, 3), (-1, 4), (-1, -2, -3), ()])
def test_a_lens_folds_at_the_first_root_of_its_slope(folds):
    """The slope d/dr (r + k1 r^3 + k2 r^5 + k3 r^7) as a product of (1 - r^2 / fold)."""
    slope = np.polynomial.Polynomial([1.0])
    for fold in folds:
        slope *= np.polynomial.Polynomial([1, -1 / fold])
    k1, k2, k3 = np.pad(slope.coef, (0, 4 - len(slope.coef)))[1:] / [3, 5, 7]
    expected = min((fold for fold in folds if fold > 0), default=np.inf)
    assert _squared_reach(np.array([k1, k2, 0, 0, k3])) == pytest.approx(expected, rel=1e-9)


def test_coefficients_of_a_lens_may_be_tiny_or_huge():
    for k3 in (1e-310, -1e-310):
        assert _squared_reach([-0.3, 0, 0, 0, k3]) == pytest.approx(1 / 0.9, rel=1e-9)
    assert 0 < _squared_reach(np.full(5, -1e308)) < 1e-30
