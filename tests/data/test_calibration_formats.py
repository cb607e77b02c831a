"""Each format, written the way its tool does from known cameras, is read back as these cameras."""

import json
from pathlib import Path

import numpy as np
import pytest

from humangs_jax.data.calibration.calibration import read_calibration
from humangs_jax.data.calibration.importing import import_cameras
from humangs_jax.data.calibration.opencv import parse_file_storage
from humangs_jax.data.capture_checks import CaptureError
from tests.data import calibration_files as written

PIXELS = 1e-3
"""Largest reprojection error of what is written with all digits."""
NAMES = ("a", "b", "c", "d")


def error_of(out, K, poses):
    """Largest distance in pixels between points seen by the imported cameras and by the true ones."""
    views = json.loads((out / "capture.json").read_text())["views"]
    p = written.points()
    got = [written.project(np.asarray(view["K"]), np.asarray(view["cam_from_world"]), p) for view in views]
    true = [written.project(K[i % len(K)], poses[i % len(poses)], p) for i in range(len(views))]
    return np.abs(np.asarray(got) - np.asarray(true)).max()


def write(kind, folder, K, poses):
    """A calibration in that format of those source-world poses, and photos: (source, images)."""
    images = folder / "photos"
    files = [f"{name}.png" for name in NAMES]
    source = folder / kind
    if kind == "colmap":
        files = ["front view.png", "left/1.png", "right/1.png", "back.png"]
        written.write_colmap(source / "sparse" / "0", K, poses, files)
    elif kind == "easymocap":
        written.write_easymocap(source, K, poses, NAMES, decimals=9)
    elif kind == "yaml":
        source = folder / "rig.yml"
        written.write_opencv_yaml(source, K, poses, NAMES)
    elif kind == "json":
        source = folder / "rig.json"
        written.write_opencv_json(source, K, poses, NAMES)
    elif kind == "full":
        source = folder / "calibration_full.json"
        written.write_calibration_full(source, K, poses, NAMES)
    else:
        source = folder / "transforms.json"
        written.write_transforms(source, K, poses, [f"./images/{name}" for name in NAMES])
    written.write_photos(images, files)
    return source, images


# format, its default up axis, and the turn from our world into one with that axis up
FORMATS = [
    ("colmap", np.diag([1.0, -1, -1])),
    ("easymocap", written.Y_UP_FROM_Z_UP.T),
    ("yaml", np.diag([1.0, -1, -1])),
    ("json", np.diag([1.0, -1, -1])),
    ("full", np.diag([1.0, -1, -1])),
    ("transforms", written.Y_UP_FROM_Z_UP.T),
]


@pytest.mark.parametrize(("kind", "turn"), FORMATS)
def test_known_cameras_come_back(tmp_path, kind, turn):
    K, poses = written.scene()
    source, images = write(kind, tmp_path, K, written.in_source(poses, 0.01, turn))
    report = import_cameras(source, images, tmp_path / "out", scale=0.01)
    assert error_of(tmp_path / "out", K, poses) < PIXELS
    assert report.warnings == ()
    assert (report.views, report.frames, report.cameras) == (4, 1, 4)
    np.testing.assert_allclose(report.checks.distance, 2.3, atol=0.01)


@pytest.mark.parametrize("up", ["+x", "-x", "+y", "-y", "+z", "-z"])
def test_any_axis_can_be_up(tmp_path, up):
    K, poses = written.scene()
    # a world in which the axis `up` is our y: rows of the turn are our axes' places there
    sign, axis = (1.0 if up[0] == "+" else -1.0), "xyz".index(up[1])
    turn = np.zeros((3, 3))
    turn[axis, 1] = sign
    turn[(axis + 1) % 3, 2] = 1.0
    turn[(axis + 2) % 3, 0] = sign
    assert np.linalg.det(turn) == pytest.approx(1)
    source, images = write("full", tmp_path, K, written.in_source(poses, turn=turn))
    report = import_cameras(source, images, tmp_path / "out", up=up)
    assert report.warnings == ()
    views = json.loads((tmp_path / "out" / "capture.json").read_text())["views"]
    got, true = (
        np.stack([p[:3, :3] for p in which]) for which in (np.asarray([v["cam_from_world"] for v in views]), poses)
    )
    np.testing.assert_allclose(got[:, :, 1], true[:, :, 1], atol=1e-9)  # y is y; the heading is free
    relative = lambda r: r @ np.swapaxes(r[:1], 1, 2)
    np.testing.assert_allclose(relative(got), relative(true), atol=1e-9)
    other = "+z" if up != "+z" else "+y"
    report = import_cameras(source, images, tmp_path / "out", up=other, overwrite=True)
    assert f"{up} fits best" in str(report)


def test_easymocap_with_three_decimals(tmp_path):
    K, poses = written.scene()
    written.write_easymocap(tmp_path / "cams", K, poses, NAMES, decimals=3)
    written.write_photos(tmp_path / "photos", [f"{name}.png" for name in NAMES])
    import_cameras(tmp_path / "cams" / "intri.yml", tmp_path / "photos", tmp_path / "out", up="+y")
    assert error_of(tmp_path / "out", K, poses) < 0.1  # 5e-4 of rounding times a focal length of 70 px
    for view in json.loads((tmp_path / "out" / "capture.json").read_text())["views"]:
        r = np.asarray(view["cam_from_world"])[:3, :3]
        np.testing.assert_allclose(r @ r.T, np.eye(3), atol=1e-12)  # rounded no longer


def test_a_camera_whose_name_ends_another_one_keeps_its_own_lens(tmp_path):
    K, poses = written.scene()
    written.write_easymocap(tmp_path / "cams", K, poses, NAMES, decimals=9)
    for file in (tmp_path / "cams").iterdir():
        text = file.read_text().replace(f"_{NAMES[0]}:", "_1:").replace(f"_{NAMES[1]}:", "_a_1:")
        file.write_text(text.replace(f'"{NAMES[0]}"', '"1"').replace(f'"{NAMES[1]}"', '"a_1"'))
    intri = tmp_path / "cams" / "intri.yml"
    kept = [line for line in intri.read_text().splitlines()]
    intri.write_text("\n".join([*kept, "dist_a_1: [0.2, 0.0, 0.0, 0.0, 0.0]", ""]))
    cameras = {camera.name: camera for camera in read_calibration(tmp_path / "cams", lambda name: (0, 0)).cameras}
    assert cameras["1"].distortion is None
    assert cameras["a_1"].distortion is not None and cameras["a_1"].distortion[0] == 0.2
    np.testing.assert_allclose(cameras["1"].cam_from_world[:3, :3], poses[0, :3, :3], atol=1e-6)


@pytest.mark.parametrize("key", ["R", "Rot"])
def test_rotation_vector_and_matrix_agree(tmp_path, key):
    K, poses = written.scene()
    written.write_easymocap(tmp_path / "cams", K, poses, NAMES, decimals=9)
    extri = tmp_path / "cams" / "extri.yml"
    if key == "R":
        extri.write_text(extri.read_text().replace("Rot_", "Unused_"))
    written.write_photos(tmp_path / "photos", [f"{name}.png" for name in NAMES])
    import_cameras(tmp_path / "cams", tmp_path / "photos", tmp_path / "out", up="+y")
    assert error_of(tmp_path / "out", K, poses) < PIXELS


def test_colmap_points_are_reprojected(tmp_path):
    K, poses = written.scene()
    K[:, 1, 1] = K[:, 0, 0]  # SIMPLE_RADIAL has one focal length
    k1, p = 0.05, written.points()
    seen = []
    for k, pose in zip(K, poses, strict=True):
        plane = (written.project(k, pose, p) - k[:2, 2]) / k[0, 0]
        seen.append(plane * (1 + k1 * (plane**2).sum(-1, keepdims=True)) * k[0, 0] + k[:2, 2])
    names = [f"{name}.png" for name in NAMES]
    written.write_colmap(tmp_path / "model", K, poses, names, "SIMPLE_RADIAL", [k1], seen, p)
    written.write_photos(tmp_path / "photos", names)
    report = import_cameras(tmp_path / "model", tmp_path / "photos", tmp_path / "out", up="+y")
    assert report.checks.reprojection is not None and report.checks.reprojection < 1e-9
    assert report.checks.observations == 4 * len(p)
    assert report.undistorted == 4 and "lens distortion removed from 4 photos" in str(report)
    written.write_colmap(
        tmp_path / "model", K, poses, names, "SIMPLE_RADIAL", [k1], [s + np.asarray([3, 0]) for s in seen], p
    )
    report = import_cameras(tmp_path / "model", tmp_path / "photos", tmp_path / "out", up="+y", overwrite=True)
    assert report.checks.reprojection == pytest.approx(3)
    assert "mean reprojection error is 3 px" in report.warnings[0]


def test_nerf_with_field_of_view_only(tmp_path):
    K, poses = written.scene()
    K[:] = [[80, 0, written.WIDTH / 2], [0, 80, written.HEIGHT / 2], [0, 0, 1]]
    file = tmp_path / "transforms_train.json"
    written.write_transforms(file, K, poses, [f"./train/r_{i}" for i in range(4)])
    values = json.loads(file.read_text())
    frames = [{key: frame[key] for key in ("file_path", "transform_matrix")} for frame in values["frames"]]
    file.write_text(json.dumps({"camera_angle_x": 2 * np.arctan(written.WIDTH / 160), "frames": frames}))
    written.write_photos(tmp_path, [f"train/r_{i}.png" for i in range(4)])
    import_cameras(file, tmp_path, tmp_path / "out", up="+y")
    assert error_of(tmp_path / "out", K, poses) < PIXELS


def test_pixel_centers_can_be_overridden(tmp_path):
    K, poses = written.scene()
    source, images = write("full", tmp_path, K, poses)
    import_cameras(source, images, tmp_path / "out", up="+y", pixel_centers="half")
    assert error_of(tmp_path / "out", written.integer_centers(K), poses) < PIXELS


def test_file_storage():
    text = """%YAML:1.0
---
count: 3   # a comment
ratio: -1.5e-02
missing: .Nan
title: "a: b"
names:
   - "01"
   - 02
   - 7
flow: [ 1, 2.,
    three, { x:1, y:-2. } ]
inner:
   m: !!opencv-matrix
      rows: 2
      cols: 1
      dt: "2d"
      data: [ 1., 2.,
          3., 4. ]
   last: 1
items:
   - { a: 1 }
   -
      b: 2
same_level:
- 1
- 2
"""
    values = parse_file_storage(text, Path("file"))
    assert np.isnan(values.pop("missing"))
    np.testing.assert_array_equal(values["inner"].pop("m"), [[1, 2], [3, 4]])
    assert values == {
        "count": 3,
        "ratio": -0.015,
        "title": "a: b",
        "names": ["01", "02", 7],
        "flow": [1, 2.0, "three", {"x": 1, "y": -2.0}],
        "inner": {"last": 1},
        "items": [{"a": 1}, {"b": 2}],
        "same_level": [1, 2],
    }


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("%YAML:1.0\na: [ 1, 2\n", "line 2: expected ',' or ']', but got '<stream end>'"),
        ("%YAML:1.0\nhello\n", "expected keys with values"),
        ("%YAML:1.0\na: &a [ 1 ]\nb: *a\n", "line 3: aliases are not supported"),
        ("%YAML:1.0\na: " + "[" * 10_000, "nested too deeply"),
        ("%YAML:1.0\na: 1\n   b: 2\n", "line 3: mapping values are not allowed here"),
        ("%YAML:1.0\na: !!opencv-matrix\n   rows: 3\n   cols: 3\n   dt: d\n   data: [ 1. ]\n", "not a matrix"),
        ("%YAML:1.0\na: !!opencv-matrix\n   rows: 1\n   cols: 1\n   dt: d\n", "not a matrix"),
        ("%YAML:1.0\na: !!opencv-sparse-matrix\n   rows: 1\n", "'opencv-sparse-matrix' is not supported"),
        ('{"a": {"type_id": "opencv-matrix", "rows": 1}}', "a: not a matrix"),
        ('{"a": ', "not valid JSON"),
    ],
)
def test_faults_of_file_storage_name_the_line(text, problem):
    with pytest.raises(CaptureError, match=problem):
        parse_file_storage(text, Path("file"))
