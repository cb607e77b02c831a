"""Units of calibrations, cameras relative to other cameras, and files that are no calibration."""

import json

import numpy as np
import pytest

from humangs_jax.capture.calibration.importing import import_cameras
from humangs_jax.data.cameras import read_calibration
from humangs_jax.data.capture_checks import CaptureError
from tests.capture import calibration_files as written

FILES, NAMES = written.FILES, written.NAMES
K, POSES = written.scene()


def imported(tmp_path, unit, writer=written.write_calibration_full, name="rig.json", **options):
    """Imports cameras of a file whose unit is `unit` metres."""
    writer(tmp_path / name, K, written.in_source(POSES, unit), NAMES)
    written.write_photos(tmp_path / "photos", FILES)
    return import_cameras(
        tmp_path / name, tmp_path / "photos", tmp_path / "out", **{"up": "+y", **options}
    )


def write_panoptic(file, K, poses, names):
    rows = zip(names, written.integer_centers(K).tolist(), poses, strict=True)

    def keys(k, pose):
        return {
            "K": k,
            "R": pose[:3, :3].tolist(),
            "t": pose[:3, 3:].tolist(),
            "distCoef": [0.0] * 5,
        }

    file.write_text(
        json.dumps({"cameras": [{"name": name, **keys(k, pose)} for name, k, pose in rows]})
    )


@pytest.mark.parametrize(("unit", "word"), [(0.01, "centimetres"), (0.001, "millimetres")])
def test_the_unit_is_the_one_that_puts_the_cameras_near_a_person(unit, word, tmp_path):
    report = imported(tmp_path, unit)
    assert report.checks.distance == pytest.approx(2.3, rel=1e-3) and report.checks.warnings == ()
    assert f"the unit is taken for {word}: in metres the cameras stand" in str(report)


@pytest.mark.parametrize(
    ("unit", "message"),
    [(0.01, "CMU Panoptic is in centimetres: taken"), (1.0, "taken for metres")],
)
def test_panoptic_is_in_centimetres_unless_that_cannot_be(unit, message, tmp_path):
    report = imported(tmp_path, unit, write_panoptic, "calibration_1.json")
    assert report.checks.distance == pytest.approx(2.3, rel=1e-3) and message in str(report)


def test_a_scale_that_is_given_is_taken_and_metres_need_no_words(tmp_path):
    assert "unit" not in str(imported(tmp_path, 1.0)).replace("per unit", "")
    report = imported(tmp_path, 0.01, scale=1.0, overwrite=True)
    assert report.checks.distance == pytest.approx(230, rel=1e-3) and "taken for" not in str(report)


def multical(relations):
    """Returns the scene as multical writes it.

    `relations` names for each camera the one in whose axes it stands, or None for the world.
    """
    index = NAMES.index

    def lens(i):
        return {
            "model": "standard",
            "image_size": [written.WIDTH, written.HEIGHT],
            "dist": [[0.0] * 5],
            "K": K[i].tolist(),
        }

    poses = {}
    for name, base in relations.items():
        pose = POSES[index(name)] @ (
            np.eye(4) if base is None else np.linalg.inv(POSES[index(base)])
        )
        key = name if base is None else f"{name}_to_{base}"
        poses[key] = {"R": pose[:3, :3].tolist(), "T": pose[:3, 3].tolist()}
    return {"cameras": {name: lens(i) for i, name in enumerate(NAMES)}, "camera_poses": poses}


@pytest.mark.parametrize(
    "relations",
    [
        {"a": None, "b": "a", "c": "a", "d": "a"},
        {"d": "c", "c": "b", "b": "a", "a": None},
        {"b": "a", "c": "a", "d": "c"},
        dict.fromkeys(NAMES),
    ],
    ids=["to the first", "a chain", "no world", "all in the world"],
)
def test_cameras_of_multical_stand_relative_to_each_other(relations, tmp_path):
    file = tmp_path / "calibration.json"
    file.write_text(json.dumps(multical(relations)))
    found = read_calibration(file, lambda name: (1, 1))
    assert (found.format, [camera.name for camera in found.cameras]) == ("multical", list(NAMES))
    first = found.cameras[0].cam_from_world
    for camera, pose, k in zip(found.cameras, POSES, K, strict=True):
        between = camera.cam_from_world @ np.linalg.inv(first)
        np.testing.assert_allclose(between, pose @ np.linalg.inv(POSES[0]), atol=1e-9)
        np.testing.assert_allclose(camera.K, k)
        assert (camera.width, camera.height) == (written.WIDTH, written.HEIGHT)


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        (
            lambda v: v["camera_poses"].pop("d_to_a"),
            r"camera_poses\.d: missing: where does this camera stand",
        ),
        (lambda v: v["cameras"]["c"].update(model="fisheye"), r"cameras\.c\.model: fisheye"),
    ],
)
def test_faults_of_multical_name_the_key(change, problem, tmp_path):
    values = multical({"a": None, "b": "a", "c": "a", "d": "a"})
    change(values)
    (tmp_path / "calibration.json").write_text(json.dumps(values))
    with pytest.raises(CaptureError, match=problem):
        read_calibration(tmp_path / "calibration.json", lambda name: (1, 1))


KALIBR = (
    "cam0:\n  distortion_model: radtan\n  intrinsics: [1, 1, 1, 1]\n  T_cn_cnm1:\n  - [1, 0, 0,"
    " 0]\n"
)
METASHAPE = (
    '<?xml version="1.0" encoding="UTF-8"?>\n<document version="1.5.0">\n  <chunk label="Chunk 1"/>'
)
LENS = (
    "%YAML:1.0\n---\ncamera_matrix: !!opencv-matrix\n   rows: 3\n   cols: 3\n   dt: d\n   data:"
    " [1,0,0, 0,1,0, 0,0,1]\n"
)
STEREO = LENS.replace("camera_matrix", "K1") + "R: [1, 0, 0]\n"


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("annots.npy", b"\x93NUMPY\x01\0v\0{}", "an array of NumPy, such as annots.npy"),
        ("camchain.yaml", KALIBR.encode(), "a camchain of Kalibr"),
        ("camera.yml", LENS.encode(), "the lens of one camera, without where it stands"),
        ("cameras.xml", METASHAPE.encode(), "Metashape (File > Export > "),
        ("poses.csv", b"#name,x,y,alt,heading,pitch,roll,f\n", "export the registration as COLMAP"),
        ("reconstruction.json", b'[{"cameras": {}, "shots": {}}]', "`opensfm export_colmap`"),
        ("small.sfm", b'[{"poseId": "1", "intrinsicId": "2"}]', "`aliceVision_exportColmap`"),
        ("out.xml", b"<?xml version='1.0'?>\n<opencv_storage>\n<K_a>", "cv2.FileStorage"),
        ("path.json", b'{"extrinsic": [1], "intrinsic_matrix": [1]}', "it has the keys extrinsic"),
        ("stereo.yml", STEREO.encode(), "it has the keys K1, R: not a known format"),
        ("mine.json", b'{"focal": 3, "poses": []}', "it has the keys focal, poses"),
        ("none.json", b"", "none.json: not a known format"),
    ],
)
def test_what_is_no_calibration_is_described(name, content, message, tmp_path):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(CaptureError, match=rf"{name}: .*expected COLMAP") as caught:
        read_calibration(tmp_path / name, lambda name: (1, 1))
    assert message in str(caught.value) and "not a known format" in str(caught.value)
