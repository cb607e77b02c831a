"""Cameras of motion capture programs and data sets, written from known cameras and read back; a table of formats."""

import json

import numpy as np
import pytest

from humangs_jax.data.calibration.calibration import read_calibration
from humangs_jax.data.capture_checks import CaptureError
from tests.data import calibration_files as written

EXACT = 1e-9
NAMES, LENS, SIZE = written.NAMES, written.LENS, [written.WIDTH, written.HEIGHT]
K, POSES = written.scene()


FORMATS = {
    "Caliscope": ("camera_array.toml", lambda: written.tables("cameras.{}"), "0123", LENS),
    "Anipose": ("calibration.toml", lambda: written.tables("cam_{}", "{}"), NAMES, LENS),
    "Pose2Sim": ("Calib.toml", lambda: written.tables("cam_{}", "{}", "fisheye = false"), NAMES, LENS),
    "Panoptic": ("calibration_160906.json", written.panoptic, NAMES, LENS),
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
        np.testing.assert_allclose([camera.cam_from_world for camera in found.cameras], POSES, atol=EXACT)
        np.testing.assert_allclose([camera.distortion for camera in found.cameras], [lens] * 4, atol=EXACT)


@pytest.mark.parametrize("place", ["frame", "file"])
def test_a_whole_K_of_a_frame_or_of_the_file(place, tmp_path):
    files = [f"{name}.png" for name in NAMES]
    written.write_transforms(tmp_path / "transforms.json", K, POSES, files)
    values = json.loads((tmp_path / "transforms.json").read_text())
    for holder in [values, *values["frames"]]:
        for key in ("fl_x", "fl_y", "cx", "cy"):
            holder.pop(key, None)
    for frame, k in zip(values["frames"], K, strict=True):
        (frame if place == "frame" else values)["K"] = (k if place == "frame" else K[0]).tolist()
    (tmp_path / "transforms.json").write_text(json.dumps(values))
    found = read_calibration(tmp_path / "transforms.json", lambda name: SIZE)
    np.testing.assert_allclose([camera.K for camera in found.cameras], K if place == "frame" else [K[0]] * 4, atol=EXACT)


def test_a_binary_model_of_colmap_is_the_text_model(tmp_path):
    world = written.points()
    seen = [written.project(k, pose, world) for k, pose in zip(K, POSES, strict=True)]
    written.write_colmap(tmp_path / "text", K, POSES, [f"{n}.png" for n in NAMES], seen=seen, world_points=world)
    (tmp_path / "binary").mkdir()
    written.write_binary(tmp_path / "binary", tmp_path / "text")
    one, other = (read_calibration(tmp_path / kind, lambda name: (1, 1)) for kind in ("text", "binary"))
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
        with pytest.raises(CaptureError, match=f"{name}: not a readable COLMAP model"):
            read_calibration(tmp_path / "binary", lambda name: (1, 1))
        (tmp_path / "binary" / name).write_bytes(whole)


WRONG = {
    "ignored": ("a.toml", written.tables("cameras.{}", extra="ignore = true"), "every camera is to be ignored"),
    "fisheye": ("a.toml", written.tables("cam_{}", extra="fisheye = true"), "fisheye lenses are not supported"),
    "no place": ("a.toml", written.tables("cam_{}").replace("translation", "other"), r"cam_0\.translation: missing"),
    "no TOML": ("a.toml", "[cam_0", "not valid TOML"),
    "entities": ("a.qca.txt", "<!DOCTYPE x [<!ENTITY a 'b'>]>" + written.qualisys(), "XML with entities"),
    "no focal length": ("a.qca.txt", written.qualisys().replace("focalLengthV", "other"), r"camera 0\.intrinsic\.focalLengthV"),
    "no list": ("a.json", json.dumps({"cameras": [{"name": "a"}]}), r"cameras\[0\]\.K: missing"),
}


@pytest.mark.parametrize("case", WRONG)
def test_wrong_files_are_one_line(case, tmp_path):
    name, text, problem = WRONG[case]
    (tmp_path / name).write_text(text)
    with pytest.raises(CaptureError, match=problem) as caught:
        read_calibration(tmp_path / name, lambda name: (1, 1))
    assert str(tmp_path / name) in str(caught.value) and "\n" not in str(caught.value)
