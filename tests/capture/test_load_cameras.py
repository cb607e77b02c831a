"""`load_cameras` reads cameras of other tools in their own world, with lenses and points."""

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from changes import edit_json

import humangs_jax as hg
from humangs_jax.data.capture_checks import CaptureError
from humangs_jax.geometry.camera import project
from tests.capture import calibration_files as written

PIXELS = 1e-3
FILES, NAMES = written.FILES, written.NAMES
POINTS = written.points()
MODELS = {
    "OPENCV_FISHEYE": ((0.05, -0.02, 0.008, -0.001), "fisheye", (0.05, -0.02, 0.008, -0.001)),
    "RADIAL_FISHEYE": ((0.05, -0.02), "fisheye", (0.05, -0.02, 0, 0)),
    "SIMPLE_RADIAL_FISHEYE": ((0.05,), "fisheye", (0.05, 0, 0, 0)),
    "SIMPLE_FISHEYE": ((), "fisheye", (0, 0, 0, 0)),
    "FISHEYE": ((), "fisheye", (0, 0, 0, 0)),
    "FULL_OPENCV": (
        (0.1, -0.2, 0.01, 0.02, 0.03, 0.04, -0.05, 0.06),
        "pinhole",
        (0.1, -0.2, 0.01, 0.02, 0.03, 0.04, -0.05, 0.06),
    ),
    "OPENCV": ((0.1, -0.2, 0.01, 0.02), "pinhole", (0.1, -0.2, 0.01, 0.02, 0)),
    "PINHOLE": ((), "pinhole", None),
}


def model_of(folder, model, extra):
    K, poses = written.scene()
    if "SIMPLE" in model or model.startswith("RADIAL"):
        K[:, 1, 1] = K[:, 0, 0]
    seen = [written.project(k, pose, POINTS) for k, pose in zip(K, poses, strict=True)]
    names = [f"left/{name}" for name in FILES]
    written.write_colmap(folder, K, poses, names, model, extra, seen, POINTS)
    if model in ("SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "SIMPLE_FISHEYE"):  # one focal length
        lines = (folder / "cameras.txt").read_text().splitlines()
        lines = [lines[0], *(" ".join(np.delete(x.split(), 5)) for x in lines[1:])]
        (folder / "cameras.txt").write_text("\n".join(lines) + "\n")
    return K, poses, names


@pytest.mark.parametrize("model", MODELS)
def test_cameras_of_colmap_keep_their_lens_their_world_and_its_points(tmp_path, model):
    extra, lens, coefficients = MODELS[model]
    K, poses, names = model_of(tmp_path, model, extra)
    cameras = hg.load_cameras(tmp_path)
    assert list(cameras) == names and len(cameras) == 4
    for i, camera in enumerate(cameras.values()):
        assert camera.lens == lens and (camera.width, camera.height) == (64, 48)
        np.testing.assert_allclose(camera.K, K[i], rtol=1e-6)
        np.testing.assert_allclose(camera.cam_from_world, poses[i], atol=1e-6)
        if coefficients is None:
            assert camera.distortion is None
        else:
            np.testing.assert_allclose(camera.distortion, coefficients, rtol=1e-6)
    np.testing.assert_allclose(cameras.points, POINTS[np.lexsort(POINTS.T[::-1])], atol=1e-6)
    np.testing.assert_allclose(cameras.colors, 128 / 255, atol=1e-6)
    assert repr(cameras) == "SceneCameras(4 cameras, 30 points)"
    if lens == "fisheye":
        with pytest.raises(CaptureError, match=r"camera model .*FISHEYE: expected one of"):
            hg.load_cameras(tmp_path, lenses=False)
    elif model == "OPENCV":
        assert hg.load_cameras(tmp_path, lenses=False)[names[0]].is_plain


def test_the_folder_of_all_models_of_colmap_leads_to_the_first(tmp_path):
    model_of(tmp_path / "sparse" / "0", "PINHOLE", ())
    assert len(hg.load_cameras(tmp_path / "sparse")) == len(hg.load_cameras(tmp_path)) == 4


def test_poses_of_three_rows_are_read(tmp_path):
    file = tmp_path / "transforms.json"
    written.write_transforms(file, *written.scene(), FILES)
    whole = hg.load_cameras(file)["b.png"]
    edit_json(file, lambda v: [each["transform_matrix"].pop() for each in v["frames"]])
    np.testing.assert_array_equal(
        hg.load_cameras(file)["b.png"].cam_from_world, whole.cam_from_world
    )


def test_y_up_turns_the_world_and_pixel_centres_become_ours(tmp_path):
    K, poses = written.scene()
    turned = written.in_source(poses, turn=written.Y_UP_FROM_Z_UP.T)
    written.write_transforms(tmp_path / "transforms.json", K, turned, FILES)
    there = hg.load_cameras(tmp_path / "transforms.json")
    upright = hg.load_cameras(tmp_path / "transforms.json", y_up=True)
    np.testing.assert_allclose(there["a.png"].cam_from_world, turned[0], atol=1e-5)
    for i, camera in enumerate(upright.values()):
        seen, _ = project(camera, jnp.asarray(POINTS, jnp.float32))
        np.testing.assert_allclose(seen, written.project(K[i], poses[i], POINTS), atol=PIXELS)
    written.write_opencv_json(tmp_path / "rig.json", K, poses, NAMES)
    with pytest.raises(
        CaptureError, match="does not say how large its images are: expected `images`"
    ):
        hg.load_cameras(tmp_path / "rig.json")
    written.write_photos(tmp_path / "photos", FILES)
    rig = hg.load_cameras(tmp_path / "rig.json", tmp_path / "photos")
    np.testing.assert_allclose(rig["b"].K, K[1], rtol=1e-6)
    assert rig.points.shape == (0, 3)
    # the size of another photo says nothing
    (tmp_path / "photos" / FILES[1]).unlink()
    with pytest.raises(CaptureError, match=r"rig\.json.*\bb\b"):
        hg.load_cameras(tmp_path / "rig.json", tmp_path / "photos")


@pytest.mark.parametrize(
    ("changes", "lens", "count"),
    [
        ({"camera_model": "OPENCV_FISHEYE", "k1": 0.1, "k4": 0.01}, "fisheye", 4),
        ({"is_fisheye": True, "k1": 0.1}, "fisheye", 4),
        ({"k1": 0.1, "p2": 0.01}, "pinhole", 5),
        ({"k1": 0.1, "k4": 0.01, "k5": 0.02, "k6": 0.03}, "pinhole", 8),
        ({"k1": 0.1, "camera_model": "SIMPLE_RADIAL"}, "pinhole", 5),
    ],
)
def test_lenses_of_transforms_are_kept(tmp_path, changes, lens, count):
    written.write_transforms(tmp_path / "transforms.json", *written.scene(), FILES, **changes)
    camera = hg.load_cameras(tmp_path)["a.png"]
    assert camera.lens == lens and camera.distortion.shape == (count,)
    assert float(camera.distortion[0]) == pytest.approx(0.1)
    if count == 8:
        np.testing.assert_allclose(camera.distortion[5:], [0.01, 0.02, 0.03], rtol=1e-6)


@pytest.mark.parametrize(
    ("changes", "problem"),
    [
        ({"k1": 0.1, "k4": 0.01}, r"frames\[0\]\.k4: a radial coefficient of r\^8"),
        ({"ftheta_p0": 0.0}, r"frames\[0\]\.ftheta_p0: expected a pinhole"),
        ({"equirectangular": True}, r"frames\[0\]\.equirectangular: expected a pinhole"),
    ],
)
def test_lenses_that_no_camera_here_has_are_refused(tmp_path, changes, problem):
    written.write_transforms(tmp_path / "transforms.json", *written.scene(), FILES, **changes)
    with pytest.raises(CaptureError, match=problem):
        hg.load_cameras(tmp_path)


def test_cameras_beside_splats_of_3dgs(tmp_path):
    # the camera stands at (1, 2, 3) and looks along the world's x
    # its y points along the world's -z
    entry = {
        "img_name": "r_0",
        "width": 80,
        "height": 60,
        "position": [1.0, 2.0, 3.0],
        "rotation": [[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]],
        "fx": 90.0,
        "fy": 91.0,
    }
    file = tmp_path / "cameras.json"
    file.write_text(json.dumps([{"id": 0, **entry}]))
    camera = hg.load_cameras(file)["r_0"]
    np.testing.assert_allclose(camera.K, [[90, 0, 40], [0, 91, 30], [0, 0, 1]])
    pixel, depth = project(camera, jnp.asarray([[3.0, 2.0, 3.0]]))
    np.testing.assert_allclose(pixel, [[40, 30]], atol=PIXELS)
    np.testing.assert_allclose(depth, [2.0], atol=1e-6)
    below, _ = project(camera, jnp.asarray([[3.0, 2.0, 2.0]]))
    np.testing.assert_allclose(below, [[40, 30 + 91 / 2]], atol=PIXELS)
    file.write_text(json.dumps([entry, entry | {"position": [1.0, 2.0]}]))
    with pytest.raises(CaptureError, match=r"\[1\]\.position: expected 3 numbers"):
        hg.load_cameras(file)


@pytest.mark.parametrize(
    ("changes", "lens", "expected"),
    [
        ({"dist": [0.1, 0, 0, 0, 0, 0.2, 0, 0]}, "pinhole", [0.1, 0, 0, 0, 0, 0.2, 0, 0]),
        (
            {"dist": [0.1, 0.2, 0, 0], "distortion_model": "equidistant"},
            "fisheye",
            [0.1, 0.2, 0, 0],
        ),
        ({"fisheye": True}, "fisheye", [0, 0, 0, 0]),
        ({"dist": [0.1, 0.2, 0, 0, 0.1], "fisheye": True}, "fisheye", [0] * 5),
    ],
)
def test_lenses_of_rigs_are_kept(tmp_path, changes, lens, expected):
    file, photos = tmp_path / "calibration_full.json", tmp_path / "photos"
    written.write_calibration_full(file, *written.scene(), NAMES, **changes)
    edit_json(file, lambda values: [each.pop("distCoeff") for each in values.values()])
    written.write_photos(photos, FILES)
    if len(expected) == 5:
        with pytest.raises(CaptureError, match="fisheye lens: expected 4 coefficients, got 5"):
            hg.load_cameras(file, photos)
        return
    camera = hg.load_cameras(file, photos)["c"]
    assert camera.lens == lens
    np.testing.assert_allclose(camera.distortion, expected, rtol=1e-6)
    assert all(isinstance(leaf, jax.Array) for leaf in jax.tree.leaves(camera))
