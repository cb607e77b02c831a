"""What the import of cameras writes, refuses and warns of."""

import json
import re

import numpy as np
import pytest
from changes import changed, edit_json
from PIL import Image

from humangs_jax.capture.calibration.importing import import_cameras
from humangs_jax.data.cameras import CONVENTIONS, WORLD_FROM_CAM_OPENGL, undistort
from humangs_jax.data.capture_checks import CaptureError
from humangs_jax.data.photos import on_white_background, read_description, read_view
from humangs_jax.io.images import read_grey, read_image
from tests.capture import calibration_files as written

FILES, NAMES = written.FILES, written.NAMES


@pytest.fixture
def rig(tmp_path):
    """Writes a calibration and photos; returns (source, images, out)."""
    written.write_calibration_full(tmp_path / "rig.json", *written.scene(), NAMES)
    written.write_photos(tmp_path / "photos", FILES)
    return tmp_path / "rig.json", tmp_path / "photos", tmp_path / "out"


def import_rig(rig, **options):
    return import_cameras(*rig, **{"up": "+y", **options})


def views_of(out):
    return read_description(out / "capture.json")["views"]


# What is written
# --------------------------------------------------------------------------------------------------


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
        (
            f"read as: OpenCV, AvatarReX or THuman4.0 ({rig[0]}): cam_from_world, OpenCV axes; +y"
            " up; 1 m per unit; pixel centres at whole numbers (0.5 added to cx and cy)"
        ),
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
    assert got == [
        (flat(c, f), i) for i, f in enumerate(frames) for c in NAMES if (c, f) != ("c", "30")
    ]


def test_one_camera_of_a_turning_person_and_cameras_without_a_common_frame(rig, tmp_path):
    written.write_calibration_full(tmp_path / "one.json", *written.scene(1), ["a"])
    written.write_photos(tmp_path / "photos", [f"a/{i:06d}.png" for i in range(3)])
    report = import_cameras(tmp_path / "one.json", tmp_path / "photos", tmp_path / "me", up="+y")
    assert [view["frame"] for view in views_of(tmp_path / "me")] == [0, 1, 2]
    assert report.warnings == () and report.checks.distance is None
    written.write_photos(
        tmp_path / "frames", [f"{name}/IMG_{i}.png" for i, name in enumerate(NAMES)]
    )
    report = import_cameras(rig[0], tmp_path / "frames", rig[2], up="+y")
    assert "no two cameras have a photo of the same frame" in report.warnings[0]


def test_masks_of_avatarrex_and_colmap(rig, tmp_path):
    images, masks = tmp_path / "frames", tmp_path / "masks"
    written.write_photos(images, [f"{c}/00000001.png" for c in NAMES])
    written.write_photos(images, [f"{c}/mask/pha/00000001.png" for c in NAMES], grey=True)
    import_cameras(rig[0], images, rig[2], masks=images, up="+y")
    # not the photo of that name itself
    for view, name in zip(views_of(rig[2]), NAMES, strict=True):
        assert (rig[2] / view["mask"]).read_bytes() == (
            images / name / "mask/pha/00000001.png"
        ).read_bytes()
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
    with pytest.raises(CaptureError, match="lies in it and would be deleted"):
        import_cameras(rig[0], rig[2] / "images", rig[2], overwrite=True)
    assert sorted(p.name for p in rig[2].parent.iterdir()) == ["out", "photos", "rig.json"]


# Distortion
# --------------------------------------------------------------------------------------------------


def distort_rig(file, coefficients):
    edit_json(
        file, lambda values: [camera.update(distCoeff=coefficients) for camera in values.values()]
    )


def test_photos_and_masks_are_undistorted(rig, tmp_path):
    distort_rig(rig[0], [0.3, 0, 0, 0, 0])  # pincushion: the corners lie outside of the photo
    written.write_photos(tmp_path / "masks", FILES, grey=True)
    report = import_rig(rig, masks=tmp_path / "masks")
    assert report.undistorted == 4
    view = views_of(rig[2])[2]
    image, mask = read_image(rig[2] / view["image"])[0], read_grey(rig[2] / view["mask"])
    assert (image[0, 0] == 1).all() and mask[0, 0] == 0
    K = np.asarray(view["K"])
    expected = undistort(
        read_image(rig[1] / "c.png")[0], K, np.asarray([0.3, 0, 0, 0, 0]), fill=1.0
    )
    np.testing.assert_allclose(image, expected, atol=0.5 / 255 + 1e-6)
    assert np.abs(expected - read_image(rig[1] / "c.png")[0]).max() > 0.1


@pytest.mark.parametrize("masked", [False, True])
def test_alpha_is_a_mask_when_undistorted_or_stays_beside_masks(rig, tmp_path, masked):
    """Beside masks, the mask shows the person, and pixels without alpha are white."""
    distort_rig(rig[0], [0.1, 0, 0, 0, 0])
    edit_json(rig[0], lambda values: values["a"].update(distCoeff=[0.0] * 5))  # one lens without
    pixels = np.zeros((written.HEIGHT, written.WIDTH, 4), np.uint8)
    pixels[10:30, 20:40] = (255, 0, 0, 255)
    for file in FILES:
        Image.fromarray(pixels).save(rig[1] / file)
    masks = None
    if masked:
        masks = write_masks(tmp_path / "masks", [np.full(PERSON.shape, 255, np.uint8)] * 4)
    assert import_rig(rig, masks=masks).undistorted == 3
    for view in views_of(rig[2]):
        photo, mask, _ = read_view(rig[2], view, on_white=False)
        assert mask is not None and mask[20, 30] == 1 and mask[5, 30] == masked
        image = on_white_background(photo, mask)
        np.testing.assert_allclose(image[20, 30], [1, 0, 0])
        np.testing.assert_allclose(image[5, 30], 1)


# Conventions
# --------------------------------------------------------------------------------------------------

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
    assert (
        warnings == [] if meaning.startswith("cam_from_world, OpenCV") else meaning in warnings[0]
    )
    # the same numbers in a transforms.json, whose reader expects world_from_cam with OpenGL axes
    as_transforms = np.stack([CONVENTIONS[WORLD_FROM_CAM_OPENGL](m) for m in matrices])
    file = rig[0].with_name("transforms.json")
    written.write_transforms(file, K, as_transforms, FILES)
    np.testing.assert_allclose(
        json.loads(file.read_text())["frames"][1]["transform_matrix"], matrices[1], atol=1e-9
    )
    warnings = import_cameras(file, rig[1], rig[2], up="+y", overwrite=True).warnings
    warnings = [w for w in warnings if "look at one place" in w]
    assert warnings == [] if meaning == WORLD_FROM_CAM_OPENGL else meaning in warnings[0]


def test_cameras_that_look_elsewhere_are_warned_of_but_not_at_head_and_feet(rig):
    K, poses = written.scene()
    outwards = np.stack([np.diag([-1.0, 1, -1, 1]) @ pose for pose in poses])
    outwards[::2] = poses[::2]  # every other one looks outwards
    written.write_calibration_full(rig[0], K, outwards, NAMES)
    assert any(
        "is this calibration of photos around a person?" in w for w in import_rig(rig).warnings
    )
    lower = 0.4 * np.asarray([1, -1, 1, -1])[:, None]  # metres by which cameras stand lower
    poses[:, :3, 3] += lower * poses[:, :3, 1]
    written.write_calibration_full(rig[0], K, poses, NAMES)
    assert import_rig(rig, overwrite=True).warnings == ()


def test_wrong_scale_and_wrong_image_size_are_warned_of(rig):
    K, poses = written.scene()
    assert "is scale, the metres" in import_rig(rig, scale=0.001).warnings[0]
    written.write_calibration_full(rig[0], K * [[2], [2], [1]], poses, NAMES)
    warning = import_rig(rig, overwrite=True).warnings[0]
    assert warning.startswith("a: the principal point") and "another size" in warning


# What is refused
# --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        ({"K": None}, r"b\.K: missing"),
        (
            {"R": [2, 0, 0, 0, 2, 0, 0, 0, 2]},
            "b: cam_from_world: the rotation is singular, mirrored or scaled",
        ),
        ({"K": [70, 5, 32, 0, 70, 24, 0, 0, 1]}, r"b: K: expected \[\[fx, 0, cx\]"),
        ({"distCoeff": [0.1, 0, 0]}, r"b\.distCoeff: expected k1 k2 p1 p2 \[k3\], got 3"),
        ({"distCoeff": [0, 0, 0, 0, 0, 0.1, 0, 0]}, "undistort the photos before"),
        (
            {"fisheye": True},
            r"b\.fisheye: fisheye lenses are not supported: undistort the photos before",
        ),
        ({"imgSize": [128, 96]}, r"b\.png: size: 64 x 48, was calibrated with 128 x 96"),
    ],
)
def test_a_wrong_camera_is_named(rig, change, problem):
    edit_json(rig[0], lambda values: values.update(b=changed(values["b"], change)))
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
    with pytest.raises(
        CaptureError, match=r"masks/d\.png: size: 10 x 10, but its photo has 64 x 48"
    ):
        import_rig(rig, masks=tmp_path / "masks")
    (tmp_path / "empty").mkdir()
    with pytest.raises(
        CaptureError,
        match=r"rig\.json: a: no photo of this camera in .*empty: expected CAMERA/FRAME",
    ):
        import_cameras(rig[0], tmp_path / "empty", rig[2])
    (rig[1] / "a.png").write_bytes(b"no image")
    with pytest.raises(CaptureError, match=r"a\.png: not a readable image"):
        import_rig(rig)
    for camera in NAMES:
        edit_json(rig[0], lambda values, name=camera: values[name].pop("imgSize"))
    for frame, size in enumerate(((32, 48), (64, 48))):
        for camera in NAMES:
            written.write_photos(rig[1] / camera, [f"{frame}.png"], size)
    with pytest.raises(
        CaptureError, match=r"1\.png: size: 64 x 48, but 0\.png of the same camera has 32 x 48"
    ):
        import_rig(rig)


def test_a_bare_photo_of_16_bits_stays_what_it_is(rig):
    deep = (
        np.arange(written.WIDTH * written.HEIGHT, dtype=np.uint16).reshape(
            written.HEIGHT, written.WIDTH
        )
        * 20
    )
    Image.fromarray(deep).save(rig[1] / "a.png")
    import_rig(rig)
    np.testing.assert_allclose(
        read_image(rig[2] / "images" / "a.png")[0][..., 0], deep / 65535, rtol=1e-6
    )


# Masks
# --------------------------------------------------------------------------------------------------

PERSON = np.zeros((written.HEIGHT, written.WIDTH), np.uint8)
PERSON[8:40, 20:40] = 255
SOFT = (np.arange(written.WIDTH) % 3).astype(np.uint8)
"""Levels of a mask that are no labels."""


def write_masks(folder, masks):
    folder.mkdir(exist_ok=True)
    for file, mask in zip(FILES, masks, strict=True):
        Image.fromarray(mask).save(folder / file)
    return folder


@pytest.mark.parametrize(
    ("mask", "warning"),
    [
        (0 * PERSON, r"the mask is empty, the photo will be left out: b\.png"),
        (PERSON // 3 + (PERSON > 0) * SOFT, r"the mask is empty, .*: b\.png"),
        (255 + 0 * PERSON, r"the mask covers the whole photo.*: b\.png"),
        (255 - PERSON, r"the mask covers the border.* is it inverted\?.*: b\.png"),
    ],
)
def test_masks_that_are_likely_wrong_are_named(rig, tmp_path, mask, warning):
    masks = write_masks(tmp_path / "masks", [PERSON, mask, PERSON, PERSON])
    report = import_rig(rig, masks=masks)
    (found,) = report.warnings
    assert re.match(warning, found) and report.masks


@pytest.mark.parametrize(
    ("mask", "problem"),
    [
        (
            PERSON // 255,
            r"masks/a\.png: values: the largest is 1 of 255: expected 0 \(background\) to 255",
        ),
        (
            np.dstack([PERSON, np.roll(PERSON, 4, axis=0), 0 * PERSON]),
            r"a\.png: 3 colors: which is the person\?",
        ),
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
        Image.fromarray(np.dstack([PERSON] * 3 + [PERSON if file != "b.png" else 0 * PERSON])).save(
            rig[1] / file
        )
    assert import_rig(rig).warnings == ("the mask is empty, the photo will be left out: b.png",)
    written.write_photos(rig[1], ["c.png"])
    with pytest.raises(
        CaptureError, match=r"c\.png: alpha: expected an alpha channel in all images or in none"
    ):
        import_rig(rig, overwrite=True)


def named_masks(tmp_path, key, names):
    """Writes a transforms.json that names masks, and its photos; returns (source, images, out)."""
    written.write_transforms(
        tmp_path / "transforms.json", *written.scene(), [f"images/{file}" for file in FILES]
    )
    written.write_photos(tmp_path / "images", FILES)

    def edit(values):
        for frame, name in zip(values["frames"], names, strict=True):
            if name is not None:
                frame[key] = name

    edit_json(tmp_path / "transforms.json", edit)
    return tmp_path / "transforms.json", tmp_path / "images", tmp_path / "out"


@pytest.mark.parametrize("key", ["fg_mask_path", "mask_path"])
def test_masks_that_a_transforms_json_names_are_used(tmp_path, key):
    source = named_masks(tmp_path, key, [f"./fg/{file}" for file in FILES])
    (warning,) = import_cameras(*source, up="+y").warnings
    assert warning == f"{key} of transforms.json: no such mask, ./fg/a.png: imported without masks"
    masks = write_masks(tmp_path / "fg", [PERSON] * 4)
    report = import_cameras(*source, up="+y", overwrite=True)
    assert (
        report.masks
        and report.warnings == ()
        and f"masks: those of {key} of transforms.json" in str(report)
    )
    assert [view["mask"] for view in views_of(tmp_path / "out")] == [
        f"masks/{file}" for file in FILES
    ]
    report = import_cameras(*source, masks=masks, up="+y", overwrite=True)
    assert report.warnings == (
        f"{key} of transforms.json: not used, the masks are those in {masks}",
    )
    (masks / "c.png").unlink()
    with pytest.raises(
        CaptureError,
        match=rf"images/c\.png: {key}: \./fg/c\.png: no such mask, but other images have one",
    ):
        import_cameras(*source, up="+y", overwrite=True)


def test_masks_named_for_some_or_outside_are_refused(tmp_path):
    write_masks(tmp_path / "fg", [PERSON] * 4)
    source = named_masks(tmp_path, "mask_path", ["fg/a.png", None, "fg/c.png", "fg/d.png"])
    with pytest.raises(
        CaptureError, match=r"images/b\.png: mask_path: missing, but other images have one"
    ):
        import_cameras(*source)
    source = named_masks(tmp_path, "mask_path", [7, None, None, None])
    with pytest.raises(
        CaptureError, match=r"frames\[0\]\.mask_path: expected a name or path, got 7"
    ):
        import_cameras(*source)
    (tmp_path / "inner").mkdir()
    for name in ("images", "transforms.json"):
        (tmp_path / name).rename(tmp_path / "inner" / name)
    source = named_masks(tmp_path / "inner", "mask_path", [f"../fg/{file}" for file in FILES])
    with pytest.raises(CaptureError, match="lies outside of"):
        import_cameras(*source)
