"""Cameras that are written in each format, as its tool does, are read back unchanged."""

import json
import re
from pathlib import Path

import numpy as np
import pytest
from changes import edit_json, edit_text
from scipy.spatial.transform import Rotation

from humangs_jax.capture.calibration.importing import import_cameras
from humangs_jax.capture.calibration.rigs import parse_file_storage
from humangs_jax.data.cameras import read_calibration
from humangs_jax.data.capture_checks import CaptureError
from tests.capture import calibration_files as written

PIXELS = 1e-3
"""Largest reprojection error of numbers that are written with all digits."""
FILES, NAMES = written.FILES, written.NAMES


def views_of(out):
    return json.loads((out / "capture.json").read_text())["views"]


def error_of(out, K, poses):
    """Returns the largest distance in pixels between points of the imported and of the true
    cameras.
    """
    views = views_of(out)
    p = written.points()
    got = [
        written.project(np.asarray(view["K"]), np.asarray(view["cam_from_world"]), p)
        for view in views
    ]
    true = [written.project(K[i % len(K)], poses[i % len(poses)], p) for i in range(len(views))]
    return np.abs(np.asarray(got) - np.asarray(true)).max()


def rig(folder, writer, name, K, poses, names=NAMES, **how):
    """Writes a calibration and photos beside it; returns (source, images)."""
    writer(folder / name, K, poses, names, **how)
    written.write_photos(folder / "photos", FILES)
    return folder / name, folder / "photos"


Y_DOWN, Z_UP = np.diag([1.0, -1, -1]), written.Y_UP_FROM_Z_UP.T
COLMAP_FILES = ["front view.png", "left/1.png", "right/1.png", "back.png"]
FORMATS = {
    "colmap": (written.write_colmap, "model/sparse/0", Y_DOWN, COLMAP_FILES),
    "easymocap": (written.write_easymocap, "easymocap", Z_UP, NAMES),
    "yaml": (written.write_opencv_yaml, "rig.yml", Y_DOWN, NAMES),
    "json": (written.write_opencv_json, "rig.json", Y_DOWN, NAMES),
    "full": (written.write_calibration_full, "calibration_full.json", Y_DOWN, NAMES),
    "transforms": (
        written.write_transforms,
        "transforms.json",
        Z_UP,
        [f"./images/{name}" for name in NAMES],  # a suffix is found
    ),
}
"""Writer, source, turn from our world to one with the format's up, and names, by format."""


@pytest.mark.parametrize("kind", FORMATS)
def test_known_cameras_come_back(tmp_path, kind):
    K, poses = written.scene()
    writer, name, turn, names = FORMATS[kind]
    source, images = rig(tmp_path, writer, name, K, written.in_source(poses, 0.01, turn), names)
    written.write_photos(images, COLMAP_FILES if kind == "colmap" else FILES)
    source = tmp_path / "model" if kind == "colmap" else source
    report = import_cameras(source, images, tmp_path / "out", scale=0.01)
    assert error_of(tmp_path / "out", K, poses) < PIXELS
    assert report.warnings == ()
    assert (report.views, report.frames, report.cameras) == (4, 1, 4)
    np.testing.assert_allclose(report.checks.distance, 2.3, atol=0.01)


@pytest.mark.parametrize("up", ["+x", "-x", "+y", "-y", "+z", "-z"])
def test_any_axis_can_be_up(tmp_path, up):
    K, poses = written.scene()
    axis = (1 if up[0] == "+" else -1) * np.eye(3)["xyz".index(up[1])]
    turn = Rotation.align_vectors([axis], [[0, 1, 0]])[0].as_matrix()
    source, images = rig(
        tmp_path, written.write_calibration_full, "rig.json", K, written.in_source(poses, turn=turn)
    )
    report = import_cameras(source, images, tmp_path / "out", up=up)
    assert report.warnings == ()
    got = np.asarray([v["cam_from_world"] for v in views_of(tmp_path / "out")])[:, :3, :3]
    true = poses[:, :3, :3]
    np.testing.assert_allclose(got[:, :, 1], true[:, :, 1], atol=1e-9)  # the heading is free
    relative = lambda r: r @ np.swapaxes(r[:1], 1, 2)
    np.testing.assert_allclose(relative(got), relative(true), atol=1e-9)
    other = "+z" if up != "+z" else "+y"
    report = import_cameras(source, images, tmp_path / "out", up=other, overwrite=True)
    assert f"--up={up} fits best" in str(report)


def test_the_example_of_the_docs_is_a_calibration(tmp_path):
    text = (Path(__file__).parents[2] / "docs/cameras.md").read_text()
    (tmp_path / "calibration.json").write_text(re.search(r"```json\n(.*?)```", text, re.DOTALL)[1])
    (camera,) = read_calibration(tmp_path / "calibration.json", lambda _: (1920, 1080)).cameras
    assert (
        camera.name == "front"
        and (camera.width, camera.height) == (1920, 1080)
        and camera.distortion is not None
    )
    np.testing.assert_array_equal(
        camera.cam_from_world[:3], [[1, 0, 0, 0], [0, 1, 0, 0.9], [0, 0, 1, 2.6]]
    )


@pytest.mark.parametrize("key", ["Rot_", "R_"])
def test_easymocap_with_three_decimals_and_a_matrix_or_a_vector(tmp_path, key):
    K, poses = written.scene()
    source, images = rig(tmp_path, written.write_easymocap, "cams", K, poses, decimals=3)
    other = {"Rot_": "R_", "R_": "Rot_"}[key]
    text = (source / "extri.yml").read_text().replace(f"\n{other}", "\nUnused_")
    (source / "extri.yml").write_text(text)
    import_cameras(source / "intri.yml", images, tmp_path / "out", up="+y")
    # 5e-4 of rounding times a focal length of 70 px
    assert error_of(tmp_path / "out", K, poses) < 0.1
    for view in views_of(tmp_path / "out"):
        r = np.asarray(view["cam_from_world"])[:3, :3]
        np.testing.assert_allclose(r @ r.T, np.eye(3), atol=1e-12)  # rounded no longer


def test_a_camera_whose_name_ends_another_one_keeps_its_own_lens(tmp_path):
    K, poses = written.scene()
    written.write_easymocap(tmp_path / "cams", K, poses, NAMES)
    for file in (tmp_path / "cams").iterdir():
        text = file.read_text().replace(f"_{NAMES[0]}:", "_1:").replace(f"_{NAMES[1]}:", "_a_1:")
        file.write_text(text.replace(f'"{NAMES[0]}"', '"1"').replace(f'"{NAMES[1]}"', '"a_1"'))
    with open(tmp_path / "cams" / "intri.yml", "a") as intri:
        intri.write("dist_a_1: [0.2, 0.0, 0.0, 0.0, 0.0]\n")
    cameras = {
        camera.name: camera
        for camera in read_calibration(tmp_path / "cams", lambda name: (0, 0)).cameras
    }
    assert cameras["1"].distortion is None
    assert cameras["a_1"].distortion is not None and cameras["a_1"].distortion[0] == 0.2
    np.testing.assert_allclose(cameras["1"].cam_from_world[:3, :3], poses[0, :3, :3], atol=1e-6)
    edit_text(tmp_path / "cams" / "extri.yml", "T_c:", "U_c:")
    with pytest.raises(CaptureError, match=r"extri\.yml: T_c: missing"):
        read_calibration(tmp_path / "cams", lambda name: (0, 0))


@pytest.mark.parametrize(
    ("file", "more", "problem"),
    [
        ("extri.yml", "K_a: [1.0]\ndist_a: [0.2, 0.0, 0.0, 0.0, 0.0]\n", None),
        ("intri.yml", "R_a: [1.0]\nT_a: [1.0]\n", None),
        ("intri.yml", "dist_a: [0.2]\n", r"intri\.yml: dist_a: expected k1"),
        ("extri.yml", "T_a: [1.0]\n", r"extri\.yml: T_a: expected 3 numbers"),
    ],
)
def test_easymocap_values_are_of_their_own_file(tmp_path, file, more, problem):
    K, poses = written.scene()
    written.write_easymocap(tmp_path, K, poses, NAMES)
    text = (tmp_path / file).read_text()
    (tmp_path / file).write_text(text + more)
    if problem is not None:
        with pytest.raises(CaptureError, match=problem):
            read_calibration(tmp_path, lambda name: (0, 0))
        return
    cameras = read_calibration(tmp_path, lambda name: (0, 0)).cameras
    assert cameras[0].distortion is None
    np.testing.assert_allclose(
        [camera.K for camera in cameras], written.integer_centers(K), atol=1e-6
    )
    np.testing.assert_allclose([camera.cam_from_world for camera in cameras], poses, atol=1e-6)


def test_colmap_points_are_reprojected(tmp_path):
    K, poses = written.scene()
    K[:, 1, 1] = K[:, 0, 0]  # SIMPLE_RADIAL has one focal length
    k1, p = 0.05, written.points()
    seen = []
    for k, pose in zip(K, poses, strict=True):
        plane = (written.project(k, pose, p) - k[:2, 2]) / k[0, 0]
        seen.append(plane * (1 + k1 * (plane**2).sum(-1, keepdims=True)) * k[0, 0] + k[:2, 2])
    lens = {"model": "SIMPLE_RADIAL", "extra": [k1], "world_points": p}
    source, images = rig(
        tmp_path, written.write_colmap, "model", K, poses, FILES, seen=seen, **lens
    )
    report = import_cameras(source, images, tmp_path / "out", up="+y")
    assert report.checks.reprojection is not None and report.checks.reprojection < 1e-9
    assert report.checks.observations == 4 * len(p)
    assert report.undistorted == 4 and "lens distortion removed from 4 photos" in str(report)
    written.write_colmap(
        source, K, poses, FILES, seen=[np.add(pixels, [3, 0]) for pixels in seen], **lens
    )
    report = import_cameras(source, images, tmp_path / "out", up="+y", overwrite=True)
    assert report.checks.reprojection == pytest.approx(3)
    assert "mean reprojection error is 3 px" in report.warnings[0]


def test_pixel_centers_can_be_overridden(tmp_path):
    K, poses = written.scene()
    source, images = rig(tmp_path, written.write_calibration_full, "rig.json", K, poses)
    import_cameras(source, images, tmp_path / "out", up="+y", pixel_centers="half")
    assert error_of(tmp_path / "out", written.integer_centers(K), poses) < PIXELS


def test_file_storage():
    # what OpenCV writes: nested maps, lists in lines and in brackets, and matrices
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
        ("%YAML:1.0\na: &a [ 1 ]\nb: *a\n", "line 3: aliases are not supported"),
        ("%YAML:1.0\na: " + "[" * 10_000, "nested too deeply"),
        (
            "%YAML:1.0\na: !!opencv-matrix\n   rows: 3\n   cols: 3\n   dt: d\n   data: [ 1. ]\n",
            "not a matrix",
        ),
        (
            "%YAML:1.0\na: !!opencv-sparse-matrix\n   rows: 1\n",
            "'opencv-sparse-matrix' is not supported",
        ),
        ('{"a": ', "not valid JSON"),
    ],
)
def test_faults_of_file_storage_name_the_line(text, problem):
    with pytest.raises(CaptureError, match=problem):
        parse_file_storage(text, Path("file"))


# Faults, and moments of videos
# ---------------------------------------------------------------------------------------------


def colmap(tmp_path, cameras=None, images=None):
    folder, _ = rig(tmp_path, written.write_colmap, "model", *written.scene(), FILES)
    for name, edit in (("cameras.txt", cameras), ("images.txt", images)):
        if edit is not None:
            (folder / name).write_text(edit((folder / name).read_text()))
    return folder


@pytest.mark.parametrize(
    ("cameras", "images", "problem"),
    [
        (
            lambda t: re.sub("PINHOLE (.*)", r"OPENCV_FISHEYE \1 0.1 0 0 0", t),
            None,
            "line 2: camera model OPENCV_FISHEYE: expected one of",
        ),
        (
            lambda t: t.replace("PINHOLE", "SIMPLE_PINHOLE"),
            None,
            "line 2: SIMPLE_PINHOLE: expected WIDTH HEIGHT f cx cy",
        ),
        (lambda t: t[: t.index("\n2 ")], None, "line 5: camera 2 is not in cameras.txt"),
        (None, lambda t: "# nothing\n", "images.txt: no image is registered"),
        (
            None,
            lambda t: "\n".join(line for line in t.split("\n") if line),
            "line 4: expected X Y POINT3D_ID of each point",
        ),
        (
            None,
            lambda t: t.replace("b.png", "z.png"),
            r"images\.txt: z\.png: no such photo \(\.png, .*\.webp",
        ),
        (None, lambda t: "1 0 0 0 0 0 0 0 1 a.png\n\n", "line 1: expected a quaternion"),
    ],
)
def test_faults_of_a_colmap_model_name_the_line(tmp_path, cameras, images, problem):
    with pytest.raises(CaptureError, match=problem):
        import_cameras(colmap(tmp_path, cameras, images), tmp_path / "photos", tmp_path / "out")


@pytest.mark.parametrize(
    ("edit", "problem"),
    [
        (lambda v: v.update(frames=[]), "frames: expected at least one"),
        (
            lambda v: v["frames"][1].pop("transform_matrix"),
            r"frames\[1\]\.transform_matrix: missing",
        ),
        (lambda v: v["frames"][1].update(file_path="z"), r"transforms\.json: z: no such photo"),
        (
            lambda v: [f.pop("fl_x") and f.pop("fl_y") for f in v["frames"]],
            r"frames\[0\]\.fl_x: missing: expected fl_x or",
        ),
        (
            lambda v: v["frames"][1].update(transform_matrix=[[0.0] * 4] * 4),
            r"frames\[1\]\.transform_matrix: .*singular",
        ),
        (
            lambda v: v.update(camera_model="OPENCV_FISHEYE"),
            "camera_model: 'OPENCV_FISHEYE': expected",
        ),
        (lambda v: v.pop("w"), r"frames\[0\]\.w: missing"),
        (
            lambda v: v.pop("w") and v.pop("h") and v["frames"][0].update(file_path="z"),
            "z: no such photo",
        ),
    ],
)
def test_faults_of_transforms_name_the_key(tmp_path, edit, problem):
    source, images = rig(
        tmp_path, written.write_transforms, "transforms.json", *written.scene(), FILES
    )
    edit_json(source, edit)
    with pytest.raises(CaptureError, match=problem):
        import_cameras(source, images, tmp_path / "out")


def at_moments(tmp_path, keys, poses=None):
    """Imports six photos of a transforms.json whose frames have these keys.

    `poses` says which camera each has; by default three cameras twice.
    """
    names = [f"{i}.png" for i in range(6)]
    K, all_poses = written.scene(3 if poses is None else 6)
    which = [0, 1, 2, 0, 1, 2] if poses is None else poses
    written.write_transforms(tmp_path / "transforms.json", K[which], all_poses[which], names)
    written.write_photos(tmp_path / "images", names)
    edit_json(
        tmp_path / "transforms.json",
        lambda v: [f.update(own) for f, own in zip(v["frames"], keys, strict=True)],
    )
    return import_cameras(
        tmp_path / "transforms.json", tmp_path / "images", tmp_path / "out", up="+y"
    )


ALL = range(6)
FLOAT_TIMES = [0.1 + 0.2, 0.3, 0.3, 1 / 3, 0.33333333, 0.3333333333]
MOMENTS = {
    "VHAP": (
        [{"timestep_index": i // 3, "camera_index": i % 3} for i in ALL],
        None,
        3,
        [0, 0, 0, 1, 1, 1],
    ),
    "sparse steps, mixed up": (
        [{"timestep_index": (9, 3)[i // 3]} for i in ALL],
        None,
        3,
        [1, 1, 1, 0, 0, 0],
    ),
    "seconds": (
        [{"time": t, "camera_index": i % 3} for i, t in enumerate(FLOAT_TIMES)],
        None,
        3,
        [0, 0, 0, 1, 1, 1],
    ),
    "names": (
        [{"timestep_id": f"frame_{i // 3}", "camera_id": f"{i % 3}"} for i in ALL],
        None,
        3,
        [0, 0, 0, 1, 1, 1],
    ),
    "D-NeRF: one camera that moves": ([{"time": i / 5} for i in ALL], list(ALL), 6, list(ALL)),
    "one moment": ([{"time": 0.0, "camera_index": i} for i in ALL], list(ALL), 6, [0] * 6),
    "one camera, by index": ([{"camera_index": 0}] * 6, list(ALL), 1, list(ALL)),
    "one camera, by pose": ([{}] * 6, [2] * 6, 1, list(ALL)),
    "a scene that stands still": ([{}] * 6, list(ALL), 6, [0] * 6),
}


@pytest.mark.parametrize("kind", MOMENTS)
def test_photos_of_one_moment_are_one_frame(tmp_path, kind):
    keys, poses, cameras, frames = MOMENTS[kind]
    report = at_moments(tmp_path, keys, poses)
    assert {view["image"]: view["frame"] for view in views_of(tmp_path / "out")} == {
        f"images/{i}.png": frame for i, frame in enumerate(frames)
    }
    assert [view["frame"] for view in views_of(tmp_path / "out")] == sorted(frames)
    assert (report.cameras, report.frames) == (cameras, max(frames) + 1)
    assert any("no two photos show the same moment" in w for w in report.warnings) == (
        kind.startswith("D-NeRF")
    )


@pytest.mark.parametrize(
    ("keys", "problem"),
    [
        (
            [{"camera_index": i % 3} for i in ALL],
            r"frames\[0\] and frames\[3\] have the camera_index 0, so they show",
        ),
        (
            [{}] * 6,
            (
                r"frames\[0\] and frames\[3\] have the same camera pose, so they show different"
                r" moments"
            ),
        ),
        (
            [{"time": 0.0} if i else {} for i in ALL],
            r"frames\[0\]\.time: missing, but other frames have it",
        ),
        ([{"time": None} for i in ALL], r"frames\[0\]\.time: expected a number, got None"),
        (
            [{"timestep_index": 0, "camera_index": i % 3} for i in ALL],
            (
                r"frames\[3\]: the camera_index and timestep_index of frames\[0\]: expected one"
                r" photo of a camera"
            ),
        ),
    ],
)
def test_moments_that_are_not_distinct_are_refused(tmp_path, keys, problem):
    with pytest.raises(CaptureError, match=problem):
        at_moments(tmp_path, keys)
    assert not (tmp_path / "out").exists()
