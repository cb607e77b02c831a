"""What is written, what is refused, and what is warned of when cameras are imported."""

import json
import re

import numpy as np
import pytest
from PIL import Image

from humangs_jax.data.calibration.calibration import (
    CONVENTIONS,
    WORLD_FROM_CAM_OPENGL,
    _squared_reach,
    distort,
    undistort,
    undistort_person,
)
from humangs_jax.data.calibration.importing import import_cameras
from humangs_jax.data.capture_checks import CaptureError
from humangs_jax.data.photos import on_white_background, read_description, read_view
from humangs_jax.io.images import read_grey, read_image
from tests.data import calibration_files as written

NAMES = ("a", "b", "c", "d")
FILES = tuple(f"{name}.png" for name in NAMES)


@pytest.fixture
def rig(tmp_path):
    """Calibration and photos: (source, images, out)."""
    written.write_calibration_full(tmp_path / "rig.json", *written.scene(), NAMES)
    written.write_photos(tmp_path / "photos", FILES)
    return tmp_path / "rig.json", tmp_path / "photos", tmp_path / "out"


def import_rig(rig, **options):
    return import_cameras(*rig, **{"up": "+y", **options})


def views_of(out):
    return read_description(out / "capture.json")["views"]


def change(file, edit):
    values = json.loads(file.read_text())
    edit(values)
    file.write_text(json.dumps(values))


# What is written ---------------------------------------------------------------------------------------------------


def test_photos_and_masks_are_copied_as_they_are(rig, tmp_path):
    written.write_photos(tmp_path / "masks", FILES, grey=True)
    report = import_rig(rig, masks=tmp_path / "masks")
    views = views_of(rig[2])
    assert [view["image"] for view in views] == [f"images/{file}" for file in FILES]
    for view, file in zip(views, FILES, strict=True):
        assert (rig[2] / view["image"]).read_bytes() == (rig[1] / file).read_bytes()
        assert (rig[2] / view["mask"]).read_bytes() == (tmp_path / "masks" / file).read_bytes()
        assert view["frame"] == 0
        read_view(rig[2], view, on_white=False)
    assert sorted(p.name for p in rig[2].iterdir()) == ["capture.json", "images", "masks"]
    assert report.warnings == ()
    assert str(report).splitlines() == [
        f"{rig[2]}: 4 photos of 64 x 48 pixels: 4 cameras, 1 frame",
        f"read as: OpenCV, AvatarReX or THuman4.0 ({rig[0]}): cam_from_world, OpenCV axes; +y up; 1 m per unit; "
        "pixel centres at whole numbers (0.5 added to cx and cy)",
        "the cameras stand 2.3 m from where they look",
    ]


@pytest.mark.parametrize("layout", ["{camera}/{frame}", "{frame}/{camera}"])
def test_frames_are_counted(rig, tmp_path, layout):
    frames = ("9", "10", "30")
    paths = [layout.format(camera=c, frame=f) + ".png" for c in NAMES for f in frames]
    paths.remove(layout.format(camera="c", frame="30") + ".png")  # as in missing_img_files.txt
    images = tmp_path / "frames"
    written.write_photos(images, paths)
    report = import_cameras(rig[0], images, rig[2], up="+y")
    assert (report.cameras, report.frames, report.views) == (4, 3, 11) and report.warnings == ()
    got = [(view["image"], view["frame"]) for view in views_of(rig[2])]
    flat = lambda c, f: "images/" + layout.format(camera=c, frame=f).replace("/", "_") + ".png"
    assert got == [(flat(c, f), i) for i, f in enumerate(frames) for c in NAMES if (c, f) != ("c", "30")]


def test_one_camera_of_a_turning_person(tmp_path):
    K, poses = written.scene(1)
    written.write_calibration_full(tmp_path / "rig.json", K, poses, ["a"])
    written.write_photos(tmp_path / "photos", [f"a/{i:06d}.png" for i in range(3)])
    report = import_cameras(tmp_path / "rig.json", tmp_path / "photos", tmp_path / "out", up="+y")
    assert [view["frame"] for view in views_of(tmp_path / "out")] == [0, 1, 2]
    assert report.warnings == () and report.checks.distance is None


def test_frames_that_no_cameras_share_are_warned_of(rig, tmp_path):
    written.write_photos(tmp_path / "frames", [f"{name}/IMG_{i}.png" for i, name in enumerate(NAMES)])
    report = import_cameras(rig[0], tmp_path / "frames", rig[2], up="+y")
    assert "no two cameras have a photo of the same frame" in report.warnings[0]


def test_masks_of_avatarrex_and_colmap(rig, tmp_path):
    images, masks = tmp_path / "frames", tmp_path / "masks"
    written.write_photos(images, [f"{c}/00000001.png" for c in NAMES])
    written.write_photos(images, [f"{c}/mask/pha/00000001.png" for c in NAMES], grey=True)
    import_cameras(rig[0], images, rig[2], masks=images, up="+y")
    for view, name in zip(views_of(rig[2]), NAMES, strict=True):  # not the photo of that name itself
        assert (rig[2] / view["mask"]).read_bytes() == (images / name / "mask/pha/00000001.png").read_bytes()
    written.write_photos(masks, [f"{c}.png.png" for c in NAMES], grey=True)
    import_rig(rig, masks=masks, overwrite=True)
    assert (rig[2] / views_of(rig[2])[1]["mask"]).read_bytes() == (masks / "b.png.png").read_bytes()


def test_whole_or_not_at_all(rig):
    import_rig(rig)
    before = (rig[2] / "capture.json").read_text()
    (rig[2] / "body.npz").write_bytes(b"of the old cameras")
    with pytest.raises(CaptureError, match="the folder is not empty"):
        import_rig(rig)
    distort_rig(rig[0], [0.1, 0, 0, 0, 0])
    broken = (rig[1] / "c.png").read_bytes()[:400]  # its head says the right size
    (rig[1] / "c.png").write_bytes(broken)
    with pytest.raises(CaptureError, match=r"c\.png: not a readable image"):
        import_rig(rig, overwrite=True)
    assert (rig[2] / "capture.json").read_text() == before
    written.write_photos(rig[1], ["c.png"])
    import_rig(rig, overwrite=True)
    assert not (rig[2] / "body.npz").exists()  # it belonged to other cameras
    assert sorted(p.name for p in rig[2].parent.iterdir()) == ["out", "photos", "rig.json"]


def test_overwriting_spares_what_is_no_capture_and_the_sources(rig, tmp_path):
    with pytest.raises(CaptureError, match="no capture"):
        import_cameras(rig[0], rig[1], rig[1], overwrite=True)
    import_rig(rig)
    with pytest.raises(CaptureError, match="would be overwritten"):
        import_cameras(rig[0], rig[2] / "images", rig[2], overwrite=True)
    with pytest.raises(CaptureError, match="is a file"):
        import_cameras(rig[0], rig[1], rig[0])


# Distortion --------------------------------------------------------------------------------------------------------


def distort_rig(file, coefficients):
    def edit(values):
        for camera in values.values():
            camera["distCoeff"] = list(coefficients)

    change(file, edit)


def test_dots_land_where_the_pinhole_says():
    K = np.asarray([[110.0, 0, 63.5], [0, 108, 50], [0, 0, 1]])
    coefficients = np.asarray([-0.25, 0.08, 0.004, -0.003, 0.01])
    dots = np.stack(np.meshgrid(np.arange(-4, 5) * 0.12, np.arange(-3, 4) * 0.12), axis=-1).reshape(-1, 2)
    pinhole, lens = (plane * np.diag(K)[:2] + K[:2, 2] for plane in (dots, distort(dots, coefficients)))
    assert np.linalg.norm(pinhole - lens, axis=-1).max() > 4  # the lens matters
    columns, rows = np.meshgrid(np.arange(128) + 0.5, np.arange(100) + 0.5)
    spots = lambda where: np.exp(-((columns - where[0]) ** 2 + (rows - where[1]) ** 2) / (2 * 1.5**2))
    photo = sum(spots(where) for where in lens).astype(np.float32)
    straight = undistort(photo, K, coefficients, fill=0.0)
    for where in pinhole:
        near = straight * (np.hypot(columns - where[0], rows - where[1]) < 5)
        centroid = np.asarray([(near * columns).sum(), (near * rows).sum()]) / near.sum()
        np.testing.assert_allclose(centroid, where, atol=0.06)  # of bilinear lookups; the dots move by up to 4.9 px


@pytest.mark.parametrize("focal, coefficients", [(400, [-0.1, 0.03, 1e-3, -1e-3, 0]), (60, [-0.3, 0, 0, 0, 0])])
def test_a_person_is_undistorted_as_the_whole_photo_is(focal, coefficients):
    """Also where the lens folds, and with nobody in the photo."""
    K, coefficients = np.asarray([[focal, 0, 66.0], [0, focal, 50], [0, 0, 1]]), np.asarray(coefficients)
    random = np.random.default_rng(0)
    for rows, columns in ((slice(30, 70), slice(50, 75)), (slice(0, 20), slice(100, 130)), (slice(0), slice(0))):
        mask = np.zeros((100, 130), np.float32)
        mask[rows, columns] = 1
        image = np.where(mask[..., None] > 0, random.random((100, 130, 3), np.float32), np.float32(1))
        straight, person = undistort_person(image, mask, K, coefficients)
        np.testing.assert_array_equal(person, undistort(mask, K, coefficients, fill=0.0))
        np.testing.assert_allclose(straight, undistort(image, K, coefficients, fill=1.0), atol=1e-6)


def test_distortion_is_opencvs():
    # by hand: r^2 = 0.05, radial = 1 + 0.1 * 0.05 - 0.2 * 0.0025 + 0.5 * 0.000125
    radial = 1 + 0.005 - 0.0005 + 0.0000625
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


def test_photos_and_masks_are_undistorted(rig, tmp_path):
    distort_rig(rig[0], [0.3, 0, 0, 0, 0])  # pincushion: the corners lie outside of the photo
    written.write_photos(tmp_path / "masks", FILES, grey=True)
    report = import_rig(rig, masks=tmp_path / "masks")
    assert report.undistorted == 4
    view = views_of(rig[2])[2]
    image, mask = read_image(rig[2] / view["image"])[0], read_grey(rig[2] / view["mask"])
    assert (image[0, 0] == 1).all() and mask[0, 0] == 0
    K = np.asarray(view["K"])
    expected = undistort(read_image(rig[1] / "c.png")[0], K, np.asarray([0.3, 0, 0, 0, 0]), fill=1.0)
    np.testing.assert_allclose(image, expected, atol=0.5 / 255 + 1e-6)
    assert np.abs(expected - read_image(rig[1] / "c.png")[0]).max() > 0.1


def test_alpha_becomes_a_mask_when_undistorted(rig):
    distort_rig(rig[0], [0.1, 0, 0, 0, 0])
    change(rig[0], lambda values: values["a"].update(distCoeff=[0.0] * 5))  # one lens without
    for file in FILES:
        pixels = np.zeros((written.HEIGHT, written.WIDTH, 4), np.uint8)
        pixels[10:30, 20:40] = (255, 0, 0, 255)
        Image.fromarray(pixels).save(rig[1] / file)
    assert import_rig(rig).undistorted == 3
    for view in views_of(rig[2]):
        photo, mask, _ = read_view(rig[2], view, on_white=False)
        assert mask is not None and mask[20, 30] == 1 and mask[2, 2] == 0
        image = on_white_background(photo, mask)
        np.testing.assert_allclose(image[20, 30], [1, 0, 0])
        np.testing.assert_allclose(image[2, 2], 1)


def test_alpha_stays_beside_masks_when_undistorted(rig, tmp_path):
    """The mask says what the person is; what alpha leaves out is white all the same."""
    distort_rig(rig[0], [0.1, 0, 0, 0, 0])
    for file in FILES:
        pixels = np.zeros((written.HEIGHT, written.WIDTH, 4), np.uint8)
        pixels[10:30, 20:40] = (255, 0, 0, 255)
        Image.fromarray(pixels).save(rig[1] / file)
    written.write_photos(tmp_path / "masks", FILES, grey=True)
    for file in FILES:
        Image.fromarray(np.full((written.HEIGHT, written.WIDTH), 255, np.uint8)).save(tmp_path / "masks" / file)
    import_rig(rig, masks=tmp_path / "masks")
    for view in views_of(rig[2]):
        image, mask, _ = read_view(rig[2], view, on_white=False)
        assert mask is not None and mask[20, 30] == mask[5, 30] == 1
        np.testing.assert_allclose(image[20, 30], [1, 0, 0])
        np.testing.assert_allclose(image[5, 30], 1)


# Conventions -------------------------------------------------------------------------------------------------------

FLIP = np.diag([1.0, -1, -1, 1])
MEANINGS = {
    "cam_from_world, OpenCV axes": lambda pose: pose,
    "world_from_cam, OpenCV axes": np.linalg.inv,
    "cam_from_world, OpenGL axes": lambda pose: FLIP @ pose,
    "world_from_cam, OpenGL axes": lambda pose: np.linalg.inv(FLIP @ pose),
}


@pytest.mark.parametrize("meaning", MEANINGS)
def test_another_convention_is_named(rig, meaning):
    K, poses = written.scene()
    matrices = np.stack([MEANINGS[meaning](pose) for pose in poses])
    np.testing.assert_allclose(CONVENTIONS[meaning](matrices), poses, atol=1e-12)
    written.write_calibration_full(rig[0], K, matrices, NAMES)
    warnings = [w for w in import_rig(rig).warnings if "look at one place" in w]
    assert warnings == [] if meaning.startswith("cam_from_world, OpenCV") else meaning in warnings[0]
    # the same numbers in a transforms.json, whose reader expects world_from_cam with OpenGL axes
    as_transforms = np.stack([CONVENTIONS[WORLD_FROM_CAM_OPENGL](m) for m in matrices])
    file = rig[0].with_name("transforms.json")
    written.write_transforms(file, K, as_transforms, FILES)
    np.testing.assert_allclose(json.loads(file.read_text())["frames"][1]["transform_matrix"], matrices[1], atol=1e-9)
    warnings = import_cameras(file, rig[1], rig[2], up="+y", overwrite=True).warnings
    warnings = [w for w in warnings if "look at one place" in w]
    assert warnings == [] if meaning == WORLD_FROM_CAM_OPENGL else meaning in warnings[0]


def test_cameras_that_look_elsewhere_are_warned_of(rig):
    K, poses = written.scene()
    outwards = np.stack([np.diag([-1.0, 1, -1, 1]) @ pose for pose in poses])
    outwards[::2] = poses[::2]  # every other one looks outwards
    written.write_calibration_full(rig[0], K, outwards, NAMES)
    assert any("is this calibration of photos around a person?" in w for w in import_rig(rig).warnings)


def test_cameras_that_look_at_head_and_feet_are_fine(rig):
    K, poses = written.scene()
    poses[::2, :3, 3] += 0.4 * poses[::2, :3, 1]  # every other one stands lower by 0.4 m
    poses[1::2, :3, 3] -= 0.4 * poses[1::2, :3, 1]
    written.write_calibration_full(rig[0], K, poses, NAMES)
    assert import_rig(rig).warnings == ()


def test_wrong_scale_and_wrong_image_size_are_warned_of(rig):
    K, poses = written.scene()
    assert "is scale, the metres" in import_rig(rig, scale=0.001).warnings[0]
    written.write_calibration_full(rig[0], K * [[2], [2], [1]], poses, NAMES)
    warning = import_rig(rig, overwrite=True).warnings[0]
    assert warning.startswith("a: the principal point") and "another size" in warning


# What is refused ---------------------------------------------------------------------------------------------------


def without(key):
    return lambda values: values["b"].pop(key)


def with_value(key, value):
    return lambda values: values["b"].update({key: value})


@pytest.mark.parametrize(
    ("edit", "problem"),
    [
        (without("K"), r"b\.K: missing"),
        (without("R"), r"b\.R: missing"),
        (without("T"), r"b\.T: missing"),
        (with_value("K", [1, 2, 3]), r"b\.K: expected 3 x 3 numbers"),
        (with_value("K", "nine"), r"b\.K: expected numbers"),
        (with_value("T", [0, 0, float("nan")]), r"b\.T: expected finite numbers"),
        (
            with_value("R", [2, 0, 0, 0, 2, 0, 0, 0, 2]),
            "b: cam_from_world: the rotation is singular, mirrored or scaled",
        ),
        (with_value("K", [70, 5, 32, 0, 70, 24, 0, 0, 1]), r"b: K: expected \[\[fx, 0, cx\]"),
        (with_value("distCoeff", [0.1, 0, 0]), r"b\.distCoeff: expected k1 k2 p1 p2 \[k3\], got 3"),
        (with_value("distCoeff", [[0.1, 0], [0]]), r"b\.distCoeff: expected numbers"),
        (with_value("distCoeff", [0, 0, 0, 0, 0, 0.1, 0, 0]), "undistort the photos before"),
        (with_value("fisheye", True), r"b\.fisheye: fisheye lenses are not supported: undistort the photos before"),
        (with_value("distortion_model", "equidistant"), r"b\.distortion_model: fisheye"),
        (with_value("imgSize", [128, 96]), r"b\.png: size: 64 x 48, was calibrated with 128 x 96"),
        (with_value("imgSize", [0, 96]), r"b\.imgSize: expected width and height"),
        (lambda values: values.clear(), "not a known format"),
        (lambda values: values.update(e=values["a"]), r"rig\.json: e: no photo of this camera"),
    ],
)
def test_a_wrong_camera_is_named(rig, edit, problem):
    change(rig[0], edit)
    with pytest.raises(CaptureError, match=problem) as error:
        import_rig(rig)
    assert "\n" not in str(error.value)
    assert not rig[2].exists()


def test_photos_that_do_not_fit_are_named(rig, tmp_path):
    with pytest.raises(CaptureError, match=r"masks: no such folder"):
        import_rig(rig, masks=tmp_path / "masks")
    written.write_photos(tmp_path / "masks", FILES[:3], grey=True)
    with pytest.raises(CaptureError, match=r"masks/d\.png: no mask"):
        import_rig(rig, masks=tmp_path / "masks")
    written.write_photos(tmp_path / "masks", ["d.png"], (10, 10), grey=True)
    with pytest.raises(CaptureError, match=r"masks/d\.png: size: 10 x 10, but its photo has 64 x 48"):
        import_rig(rig, masks=tmp_path / "masks")
    (tmp_path / "empty").mkdir()
    with pytest.raises(CaptureError, match=r"empty: no photo of the cameras a, b, c, \.\.\.: expected CAMERA/FRAME"):
        import_cameras(rig[0], tmp_path / "empty", rig[2])
    (rig[1] / "a.png").write_bytes(b"no image")
    with pytest.raises(CaptureError, match=r"a\.png: not a readable image"):
        import_rig(rig)
    for camera in NAMES:
        change(rig[0], lambda values, name=camera: values[name].pop("imgSize"))
    for frame, size in enumerate(((32, 48), (64, 48))):
        for camera in NAMES:
            written.write_photos(rig[1] / camera, [f"{frame}.png"], size)
    with pytest.raises(CaptureError, match=r"1\.png: size: 64 x 48, but 0\.png of the same camera has 32 x 48"):
        import_rig(rig)


@pytest.mark.parametrize(
    ("options", "problem"),
    [
        ({"scale": 0.0}, "scale 0"),
        ({"scale": float("nan")}, "scale nan"),
        ({"up": "z"}, r"^up z: expected one of \+x, -x"),
        ({"pixel_centers": "corner"}, "^pixel_centers corner: expected one of integer, half"),
    ],
)
def test_wrong_options_are_named(rig, options, problem):
    with pytest.raises(ValueError, match=problem):
        import_rig(rig, **options)


def colmap(tmp_path, cameras=None, images=None):
    folder = tmp_path / "model"
    written.write_colmap(folder, *written.scene(), FILES)
    for name, edit in (("cameras.txt", cameras), ("images.txt", images)):
        if edit is not None:
            (folder / name).write_text(edit((folder / name).read_text()))
    written.write_photos(tmp_path / "photos", FILES)
    return folder


@pytest.mark.parametrize(
    ("cameras", "images", "problem"),
    [
        (
            lambda t: t.replace("PINHOLE", "OPENCV_FISHEYE"),
            None,
            "line 2: camera model OPENCV_FISHEYE: expected one of",
        ),
        (
            lambda t: t.replace("PINHOLE", "SIMPLE_PINHOLE"),
            None,
            "line 2: SIMPLE_PINHOLE: expected WIDTH HEIGHT f cx cy",
        ),
        (lambda t: t.replace("64 48", "64 x"), None, "line 2: could not convert"),
        (lambda t: t[: t.index("\n2 ")], None, "line 5: camera 2 is not in cameras.txt"),
        (None, lambda t: "# nothing\n", "images.txt: no image is registered"),
        (
            None,
            lambda t: "\n".join(line for line in t.split("\n") if line),
            "line 4: expected X Y POINT3D_ID of each point",
        ),
        (None, lambda t: t.replace("a.png", ""), "line 3: expected IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME"),
        (None, lambda t: t.replace("b.png", "z.png"), r"images\.txt: z\.png: no such photo \(PNG or JPEG\)"),
        (None, lambda t: t.replace("b.png", "sub/a.png"), r"a\.png is the photo of a\.png already"),
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
        (lambda v: v.update(frames={}), "frames: expected a list"),
        (lambda v: v["frames"][1].pop("transform_matrix"), r"frames\[1\]\.transform_matrix: missing"),
        (lambda v: v["frames"][1].pop("file_path"), r"frames\[1\]\.file_path: missing"),
        (lambda v: v["frames"][1].update(file_path="z"), r"transforms\.json: z: no such photo"),
        (
            lambda v: [f.pop("fl_x") and f.pop("fl_y") for f in v["frames"]],
            r"frames\[0\]\.fl_x: missing: expected fl_x or",
        ),
        (
            lambda v: v["frames"][1].update(transform_matrix=[[0.0] * 4] * 4),
            r"frames\[1\]\.transform_matrix: .*singular",
        ),
        (lambda v: v.update(camera_model="OPENCV_FISHEYE"), "camera_model: 'OPENCV_FISHEYE': expected"),
        (lambda v: v.update(is_fisheye=True), "is_fisheye: fisheye lenses"),
        (lambda v: v.update(k4=0.1), "k4: expected 0"),
        (lambda v: v.pop("w"), r"frames\[0\]\.w: missing"),
        (lambda v: v.pop("w") and v.pop("h") and v["frames"][0].update(file_path="z"), "z: no such photo"),
    ],
)
def test_faults_of_transforms_name_the_key(tmp_path, edit, problem):
    written.write_transforms(tmp_path / "transforms.json", *written.scene(), FILES)
    change(tmp_path / "transforms.json", edit)
    written.write_photos(tmp_path / "photos", FILES)
    with pytest.raises(CaptureError, match=problem):
        import_cameras(tmp_path / "transforms.json", tmp_path / "photos", tmp_path / "out")


def test_sources_that_are_none_are_named(rig, tmp_path):
    empty, binary, half = (tmp_path / name for name in ("empty", "binary", "half"))
    for folder in (empty, binary, half):
        folder.mkdir()
    (binary / "images.bin").write_bytes(b"")
    (half / "intri.yml").write_text("%YAML:1.0\n---\nnames:\n   - a\n")
    for file, text in (("nothing.json", ""), ("list.json", "[1]"), ("words.txt", "cameras"), ("open.json", "{")):
        (empty.parent / file).write_text(text)
    for source, problem in (
        (tmp_path / "no", "no: no such file or folder"),
        (empty, "empty: no cameras found: expected COLMAP text model"),
        (binary, "binary COLMAP model: .*model_converter"),
        (half, r"extri\.yml: no such file"),
        (tmp_path / "nothing.json", r"nothing\.json: empty"),
        (tmp_path / "list.json", "not a known format"),
        (tmp_path / "words.txt", "not a known format"),
        (tmp_path / "open.json", "line 1: not valid JSON"),
    ):
        with pytest.raises(CaptureError, match=problem):
            import_cameras(source, rig[1], rig[2])
    assert not rig[2].exists()


def test_a_bare_photo_of_16_bits_stays_what_it_is(rig):
    deep = np.arange(written.WIDTH * written.HEIGHT, dtype=np.uint16).reshape(written.HEIGHT, written.WIDTH) * 20
    Image.fromarray(deep).save(rig[1] / "a.png")
    import_rig(rig)
    np.testing.assert_allclose(read_image(rig[2] / "images" / "a.png")[0][..., 0], deep / 65535, rtol=1e-6)


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


# Masks -------------------------------------------------------------------------------------------------------------

PERSON = np.zeros((written.HEIGHT, written.WIDTH), np.uint8)
PERSON[8:40, 20:40] = 255


def write_masks(folder, masks):
    folder.mkdir(exist_ok=True)
    for file, mask in zip(FILES, masks, strict=True):
        Image.fromarray(mask).save(folder / file)
    return folder


@pytest.mark.parametrize(
    ("mask", "warning"),
    [
        (0 * PERSON, r"the mask is empty, the photo will be left out: b\.png"),
        (PERSON // 3, r"the mask is empty, .*: b\.png"),
        (255 + 0 * PERSON, r"the mask covers the whole photo.*: b\.png"),
        (255 - PERSON, r"the mask covers the border.* is it inverted\?.*: b\.png"),
    ],
)
def test_masks_that_are_likely_wrong_are_named(rig, tmp_path, mask, warning):
    if (mask == PERSON // 3).all():
        mask = mask + (PERSON > 0).astype(np.uint8) * (np.arange(written.WIDTH) % 3).astype(np.uint8)  # soft, no label
    masks = write_masks(tmp_path / "masks", [PERSON, mask, PERSON, PERSON])
    report = import_rig(rig, masks=masks)
    (found,) = report.warnings
    assert re.match(warning, found) and report.masks


@pytest.mark.parametrize(
    ("mask", "problem"),
    [
        (PERSON // 255, r"masks/a\.png: values: the largest is 1 of 255: expected 0 \(background\) to 255"),
        (
            PERSON // 255 * (1 + np.arange(written.WIDTH) % 18).astype(np.uint8),
            r"a\.png: values: the largest is 18 of 255",
        ),
        (PERSON // 2, r"a\.png: values: the largest is 127 of 255"),
        ((PERSON > 0).astype(np.uint16) * 255, r"a\.png: values: the largest is 0.992 of 255"),
        (np.dstack([PERSON, np.roll(PERSON, 4, axis=0), 0 * PERSON]), r"a\.png: 3 colors: which is the person\?"),
        (PERSON[:, :10], r"a\.png: size: 10 x 48, but its photo has 64 x 48"),
        (0 * PERSON, r"a\.png: mask: empty, as are all of them"),
    ],
)
def test_masks_that_no_capture_may_have_are_refused_before_writing(rig, tmp_path, mask, problem):
    with pytest.raises(CaptureError, match=problem):
        import_rig(rig, masks=write_masks(tmp_path / "masks", [mask] * 4))
    assert not rig[2].exists()


def test_alpha_in_some_photos_is_refused_and_an_empty_one_is_named(rig):
    for file in FILES:
        Image.fromarray(np.dstack([PERSON] * 3 + [PERSON if file != "b.png" else 0 * PERSON])).save(rig[1] / file)
    assert import_rig(rig).warnings == ("the mask is empty, the photo will be left out: b.png",)
    written.write_photos(rig[1], ["c.png"])
    with pytest.raises(CaptureError, match=r"c\.png: alpha: expected an alpha channel in all images or in none"):
        import_rig(rig, overwrite=True)


def named_masks(tmp_path, key, names):
    """A transforms.json that names masks, and its photos."""
    written.write_transforms(tmp_path / "transforms.json", *written.scene(), [f"images/{file}" for file in FILES])
    written.write_photos(tmp_path / "images", FILES)

    def edit(values):
        for frame, name in zip(values["frames"], names, strict=True):
            if name is not None:
                frame[key] = name

    change(tmp_path / "transforms.json", edit)
    return tmp_path / "transforms.json", tmp_path / "images", tmp_path / "out"


@pytest.mark.parametrize("key", ["fg_mask_path", "mask_path"])
def test_masks_that_a_transforms_json_names_are_used(tmp_path, key):
    source = named_masks(tmp_path, key, [f"./fg/{file}" for file in FILES])
    (warning,) = import_cameras(*source, up="+y").warnings
    assert warning == f"{key} of transforms.json: no such mask, ./fg/a.png: imported without masks"
    masks = write_masks(tmp_path / "fg", [PERSON] * 4)
    report = import_cameras(*source, up="+y", overwrite=True)
    assert report.masks and report.warnings == () and f"masks: those that transforms.json names ({key})" in str(report)
    assert [view["mask"] for view in views_of(tmp_path / "out")] == [f"masks/{file}" for file in FILES]
    report = import_cameras(*source, masks=masks, up="+y", overwrite=True)
    assert report.warnings == (f"{key} of transforms.json: not used, the masks are those in {masks}",)
    (masks / "c.png").unlink()
    with pytest.raises(
        CaptureError, match=rf"images/c\.png: {key}: \./fg/c\.png: no such mask, but other images have one"
    ):
        import_cameras(*source, up="+y", overwrite=True)


def test_masks_named_for_some_or_outside_are_refused(tmp_path):
    write_masks(tmp_path / "fg", [PERSON] * 4)
    source = named_masks(tmp_path, "mask_path", ["fg/a.png", None, "fg/c.png", "fg/d.png"])
    with pytest.raises(CaptureError, match=r"images/b\.png: mask_path: missing, but other images have one"):
        import_cameras(*source)
    source = named_masks(tmp_path, "mask_path", [7, None, None, None])
    with pytest.raises(CaptureError, match=r"frames\[0\]\.mask_path: expected the path of a mask, got 7"):
        import_cameras(*source)
    (tmp_path / "inner").mkdir()
    for name in ("images", "transforms.json"):
        (tmp_path / name).rename(tmp_path / "inner" / name)
    source = named_masks(tmp_path / "inner", "mask_path", [f"../fg/{file}" for file in FILES])
    with pytest.raises(CaptureError, match="lies outside of"):
        import_cameras(*source)


# Moments -----------------------------------------------------------------------------------------------------------


def at_moments(tmp_path, keys, poses=None):
    """Six photos in a transforms.json, each with its own of `keys`. poses: which camera each has; default: three, twice."""
    names = [f"{i}.png" for i in range(6)]
    K, all_poses = written.scene(3 if poses is None else 6)
    which = [0, 1, 2, 0, 1, 2] if poses is None else poses
    written.write_transforms(tmp_path / "transforms.json", K[which], all_poses[which], names)
    written.write_photos(tmp_path / "images", names)
    change(tmp_path / "transforms.json", lambda v: [f.update(own) for f, own in zip(v["frames"], keys, strict=True)])
    return import_cameras(tmp_path / "transforms.json", tmp_path / "images", tmp_path / "out", up="+y")


ALL = range(6)
FLOAT_TIMES = [0.1 + 0.2, 0.3, 0.3, 1 / 3, 0.33333333, 0.3333333333]
MOMENTS = {
    "VHAP": ([{"timestep_index": i // 3, "camera_index": i % 3} for i in ALL], None, 3, [0, 0, 0, 1, 1, 1]),
    "sparse steps, mixed up": ([{"timestep_index": (9, 3)[i // 3]} for i in ALL], None, 3, [1, 1, 1, 0, 0, 0]),
    "seconds": ([{"time": t, "camera_index": i % 3} for i, t in enumerate(FLOAT_TIMES)], None, 3, [0, 0, 0, 1, 1, 1]),
    "names": ([{"timestep_id": f"frame_{i // 3}", "camera_id": f"{i % 3}"} for i in ALL], None, 3, [0, 0, 0, 1, 1, 1]),
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
    assert any("no two photos show the same moment" in w for w in report.warnings) == (kind.startswith("D-NeRF"))


@pytest.mark.parametrize(
    ("keys", "problem"),
    [
        ([{"camera_index": i % 3} for i in ALL], r"frames\[0\] and frames\[3\] have the camera_index 0, so they show"),
        (
            [{"camera_id": f"c{i % 2}"} for i in ALL],
            r"frames\[0\] and frames\[2\] have the camera_id c0, so .*: expected timest",
        ),
        ([{}] * 6, r"frames\[0\] and frames\[3\] have the same camera pose, so they show different moments"),
        ([{"time": 0.0} if i else {} for i in ALL], r"frames\[0\]\.time: missing, but other frames have it"),
        ([{"time": None} for i in ALL], r"frames\[0\]\.time: expected a number or a name, got None"),
        ([{"time": float("nan")} for i in ALL], r"frames\[0\]\.time: expected finite numbers"),
        ([{"time": str(i) if i else 0} for i in ALL], r"time: expected numbers or names, got both"),
        (
            [{"timestep_index": 0, "camera_index": i % 3} for i in ALL],
            r"frames\[3\]: the camera_index and timestep_index of frames\[0\]: expected one photo of a camera",
        ),
    ],
)
def test_moments_that_cannot_be_told_apart_are_refused(tmp_path, keys, problem):
    with pytest.raises(CaptureError, match=problem):
        at_moments(tmp_path, keys)
    assert not (tmp_path / "out").exists()
