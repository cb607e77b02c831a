"""Photos of several sizes, EXIF flags and formats become a capture of one size.

Pixels show the same points as before.
"""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from changes import edit_json
from PIL import Image

from humangs_jax.capture.calibration.importing import import_cameras
from humangs_jax.capture.keypoints.reading import read_keypoints
from humangs_jax.data.cameras import distort
from humangs_jax.data.capture_checks import CaptureError
from humangs_jax.data.photos import load_photos, unknown_in_capture
from humangs_jax.io.images import orientation, oriented, read_image
from humangs_jax.io.reading import Limits, set_limits
from tests.capture import calibration_files as written

SHOWN = {"a.png": (64, 48), "b.PNG": (48, 64), "c.png": (40, 30)}
"""Width and height of the upright photos; b is stored on its side."""
FLAG = 6
HEIC = Path(__file__).parents[1] / "io" / "phone.heic"


def write_phones(folder, masks=False, reach=(0, 0)):
    """Writes the calibration of the upright photos, and photos of noise.

    `reach` is the number of rows and columns at the rim that the masks cover.
    """
    K, poses = written.scene(len(SHOWN))
    K[:, :2, 2] = np.asarray(list(SHOWN.values())) / 2 + (1.3, -0.8)
    written.write_calibration_full(folder / "rig.json", K, poses, [name[0] for name in SHOWN])
    cameras = json.loads((folder / "rig.json").read_text())
    rng, upright = np.random.default_rng(0), {}
    for kind in ("photos", "masks") if masks else ("photos",):
        (folder / kind).mkdir()
        for name, (width, height) in SHOWN.items():
            cameras[name[0]]["imgSize"] = [width, height]
            pixels = rng.integers(0, 256, (height, width, 3), np.uint8)
            if kind == "masks":
                pixels = np.zeros((height, width), np.uint8)
                pixels[5 : height - 5 + reach[0], 5 : width - 5 + reach[1]] = 255
            upright[kind, name] = pixels
            stored, exif = pixels, Image.Exif()
            if name == "b.PNG":
                stored, exif[0x0112] = np.rot90(pixels), FLAG
            Image.fromarray(stored).save(folder / kind / name, "PNG", exif=exif)
    (folder / "rig.json").write_text(json.dumps(cameras))
    return upright, K


def imported(folder, **options):
    return import_cameras(
        folder / "rig.json", folder / "photos", folder / "out", up="+y", **options
    )


def test_photos_of_several_sizes_are_padded_and_cameras_stay(tmp_path):
    upright, K = write_phones(tmp_path, masks=True)
    report = imported(tmp_path, masks=tmp_path / "masks")
    assert (report.width, report.height, report.turned, report.warnings) == (64, 64, 1, ())
    assert "3 sizes (1 of 64 x 48, 1 of 48 x 64, 1 of 40 x 30): white was added" in str(report)
    photos = load_photos(tmp_path / "out")
    np.testing.assert_allclose(photos.cameras.K, K, rtol=1e-6)  # float32
    assert photos.masks is not None
    for i, (name, (width, height)) in enumerate(SHOWN.items()):
        mask = upright["masks", name] / 255
        np.testing.assert_array_equal(photos.masks[i, :height, :width], mask)
        seen = upright["photos", name] / 255 * mask[..., None] + 1 - mask[..., None]
        np.testing.assert_allclose(photos.images[i, :height, :width], seen, atol=1e-6)
        assert photos.masks[i].sum() == mask.sum() and photos.images[i, height:].min(initial=1) == 1
        pixels = np.asarray(Image.open(tmp_path / "out" / "images" / f"{name[0]}.png"))
        assert pixels.shape == (64, 64, 3) and pixels[:, width:].min(initial=255) == 255


@pytest.mark.parametrize(
    ("reach", "named"), [((5, 0), "a.png and 1 more"), ((0, 5), "b.PNG and 1 more")]
)
def test_what_is_beyond_the_rim_that_cuts_a_person_off_is_unknown(reach, named, tmp_path):
    write_phones(tmp_path, masks=True, reach=reach)
    (warning,) = imported(tmp_path, masks=tmp_path / "masks").warnings
    assert f"cut off at the border of {named}: what is beyond is unknown" in warning
    photos = load_photos(tmp_path / "out")
    assert photos.unknown is not None
    for i, (width, height) in enumerate(SHOWN.values()):
        added = np.ones((64, 64), bool)
        added[:height, :width] = False
        cut = (reach[0] and height < 64) or (reach[1] and width < 64)
        np.testing.assert_array_equal(photos.unknown[i], added if cut else np.zeros_like(added))


def test_what_was_added_to_photos_without_masks_is_unknown_once_masks_are_found(tmp_path):
    write_phones(tmp_path)
    imported(tmp_path)
    out = tmp_path / "out"
    assert load_photos(out).unknown is None  # nothing is background yet
    unknown = unknown_in_capture(out)
    assert unknown is not None
    assert [64 * 64 - each.sum() for each in unknown] == [w * h for w, h in SHOWN.values()]
    for name in "abc":
        written.write_photos(out / "masks", [f"{name}.png"], (64, 64), grey=True)
    masked = lambda d: [v.update(mask=v["image"].replace("images", "masks")) for v in d["views"]]
    edit_json(out / "capture.json", masked)
    photos = load_photos(out)
    np.testing.assert_array_equal(photos.unknown, unknown)
    assert photos.masks is not None and not photos.masks[unknown].any()


def test_what_a_distorted_lens_has_not_seen_is_unknown_where_it_cuts_the_person_off(tmp_path):
    K, poses = written.scene(2)
    bent = [0.3, 0, 0, 0, 0]
    written.write_calibration_full(tmp_path / "rig.json", K, poses, "ab", distCoeff=bent)
    written.write_photos(tmp_path / "photos", ["a.png", "b.png"])
    (tmp_path / "masks").mkdir()
    mask = np.zeros((48, 64), np.uint8)
    mask[20:28, 28:36] = 255
    Image.fromarray(mask).save(tmp_path / "masks" / "a.png")
    mask[20:, 28:36] = 255
    Image.fromarray(mask).save(tmp_path / "masks" / "b.png")
    imported(tmp_path, masks=tmp_path / "masks")
    photos = load_photos(tmp_path / "out")
    assert photos.unknown is not None and photos.unknown[1, -1].any()
    assert not photos.unknown[0].any() and not photos.unknown[1, 10:30, 10:50].any()


def test_masks_of_others_are_turned_and_padded_with_their_photos(tmp_path):
    upright, _ = write_phones(tmp_path, masks=True)
    (tmp_path / "others").mkdir()
    width, height = SHOWN["b.PNG"]
    bar = np.zeros((height, width), np.uint8)
    bar[30:40, :20] = 255
    exif = Image.Exif()
    exif[0x0112] = FLAG
    Image.fromarray(np.rot90(bar)).save(tmp_path / "others" / "b.png", exif=exif)
    imported(tmp_path, masks=tmp_path / "masks", others=tmp_path / "others")
    photos = load_photos(tmp_path / "out")
    assert photos.unknown is not None
    np.testing.assert_array_equal(photos.unknown[1, :height, :width], bar > 0)
    assert photos.unknown.sum() == (bar > 0).sum()
    assert upright["masks", "b.PNG"][30:40, 5:20].all() and not photos.masks[1, 30:40, :20].any()


def test_masks_of_others_that_are_named_like_no_photo_are_refused(tmp_path):
    write_phones(tmp_path)
    written.write_photos(tmp_path / "others", ["x.png"], (48, 64), grey=True)
    with pytest.raises(CaptureError, match=r"others: no mask .* is named like a photo of .*photos"):
        imported(tmp_path, others=tmp_path / "others")
    written.write_photos(tmp_path / "others", ["a.png"], (8, 8), grey=True)
    with pytest.raises(CaptureError, match=r"a\.png: size: 8 x 8, but its photo has 64 x 48"):
        imported(tmp_path, others=tmp_path / "others")
    assert not (tmp_path / "out").exists()


def test_keypoints_of_the_photos_before_padding_fit(tmp_path):
    write_phones(tmp_path)
    imported(tmp_path)
    images = [
        {"id": i, "file_name": n, "width": w, "height": h}
        for i, (n, (w, h)) in enumerate(SHOWN.items())
    ]
    people = [{"image_id": i, "keypoints": [10.0 + i, 20.0, 2] * 17} for i in range(len(SHOWN))]
    file = tmp_path / "k.json"
    file.write_text(json.dumps({"images": images, "annotations": people}))
    photos = load_photos(tmp_path / "out")
    keypoints = read_keypoints(file, photos.names, *photos.images.shape[2:0:-1])
    assert keypoints.points[:, 0].tolist() == [[10.5 + i, 20.5] for i in range(len(SHOWN))]
    images[0]["width"] = 80  # of another photo
    file.write_text(json.dumps({"images": images, "annotations": people}))
    with pytest.raises(
        CaptureError, match=r"size of a\.png: 80 x 48, but the capture's photos have 64 x 64"
    ):
        read_keypoints(file, photos.names, 64, 64)


@pytest.mark.parametrize("limit", [{"pixels": 4000}, {"capture_pixels": 3 * 64 * 64 - 1}])
def test_padding_has_the_limits_of_reading(limit, tmp_path):
    write_phones(tmp_path)
    try:
        set_limits(Limits(**limit))
        with pytest.raises(
            CaptureError, match=rf"photos: .* padded.*: the limit {next(iter(limit))} is"
        ) as caught:
            imported(tmp_path)
    finally:
        set_limits(None)
    assert "\n" not in str(caught.value) and not (tmp_path / "out").exists()


def test_heic_photos_become_png(tmp_path):
    pytest.importorskip("pi_heif")
    K, poses = written.scene(2)
    K[:, :2, 2] = (16.5, 12.5)
    written.write_calibration_full(tmp_path / "rig.json", K, poses, "ab", imgSize=[32, 24])
    written.write_photos(tmp_path / "photos", ["a.png"], (32, 24))
    shutil.copy(HEIC, tmp_path / "photos" / "b.HEIC")
    report = imported(tmp_path)
    assert "written as PNG: 1 HEIC photo" in report.notes and (report.turned, report.heic) == (0, 1)
    assert sorted(path.name for path in (tmp_path / "out" / "images").iterdir()) == [
        "a.png",
        "b.png",
    ]
    np.testing.assert_allclose(
        load_photos(tmp_path / "out").images[1], read_image(HEIC)[0], atol=1e-6
    )


# EXIF flags: pixels, masks and cameras of the import agree, and no flag is left for others to obey
# ---------------------

NAMES = written.NAMES
POINT = written.TARGET + np.asarray([0.12, 0.1, 0.05])
LENS = np.asarray([0.05, 0.01, 0.02, -0.03, 0.0])
OFF = 0.1
"""Largest error of a spot's centroid, pixels: levels have 8 bits, and removing a lens is bilinear.
"""


def spot(K, pose, lens, size):
    """Returns a white spot at the pixel where a camera sees POINT."""
    seen = pose[:3, :3] @ POINT + pose[:3, 3]
    x, y = distort(seen[:2] / seen[2], lens) * np.diag(K)[:2] + K[:2, 2]
    columns, rows = np.meshgrid(np.arange(size[0]) + 0.5, np.arange(size[1]) + 0.5)
    return np.exp(-((columns - x) ** 2 + (rows - y) ** 2) / (2 * 2.0**2))


def centroid(image, near):
    columns, rows = np.meshgrid(np.arange(image.shape[1]) + 0.5, np.arange(image.shape[0]) + 0.5)
    # a lens leaves white corners
    weights = image * (np.hypot(columns - near[0], rows - near[1]) < 7)
    return np.asarray([(weights * columns).sum(), (weights * rows).sum()]) / weights.sum()


def save(file, image, flag=1):
    file.parent.mkdir(exist_ok=True)
    exif = Image.Exif()
    exif[0x0112] = flag
    Image.fromarray(np.rint(255 * image).astype(np.uint8)).save(file, exif=exif)


def phone(
    tmp_path,
    flag,
    lens=0 * LENS,
    mask=None,
    calibrated="stored",
    size=(written.WIDTH, written.HEIGHT),
    **changes,
):
    """Writes and imports a rig whose photos have an EXIF flag.

    `mask` is "stored", "shown", or "flagged" for stored with the flag.
    """
    K, poses = written.scene()
    K[:, 0, 2], K[:, 1, 2] = size[0] / 2 + 1.3, size[1] / 2 - 0.8
    shown = size if flag < 5 else size[::-1]
    changes = {
        "imgSize": list(size if calibrated == "stored" else shown),
        "distCoeff": lens.tolist(),
        **changes,
    }
    if calibrated == "shown":  # cameras of the turned photo
        K[:, 0, 2], K[:, 1, 2] = shown[0] / 2 + 1.3, shown[1] / 2 - 0.8
    written.write_calibration_full(tmp_path / "rig.json", K, poses, NAMES, **changes)
    if changes["imgSize"] is None:
        edit_json(
            tmp_path / "rig.json", lambda rig: [camera.pop("imgSize") for camera in rig.values()]
        )
    back = {6: 8, 8: 6}.get(flag, flag)
    for name, k, pose in zip(NAMES, K, poses, strict=True):
        image = spot(k, pose, lens, size if calibrated == "stored" else shown)
        image = image if calibrated == "stored" else oriented(image, back)
        save(tmp_path / "photos" / f"{name}.png", np.dstack([image] * 3), flag)
        if mask is not None:
            pixels = oriented(image, flag) if mask == "shown" else image
            save(tmp_path / "masks" / f"{name}.png", pixels, flag if mask == "flagged" else 1)
    masks = None if mask is None else tmp_path / "masks"
    return import_cameras(
        tmp_path / "rig.json", tmp_path / "photos", tmp_path / "me", masks=masks, up="+y"
    )


def check_agreement(folder):
    """Checks that the spot is where the camera sees the point, in photo and mask.

    Photos are read as they are written.
    """
    photos = load_photos(folder)
    for i, name in enumerate(json.loads((folder / "capture.json").read_text())["views"]):
        expected = written.project(
            np.asarray(photos.cameras.K[i]),
            np.asarray(photos.cameras.cam_from_world[i]),
            POINT[None],
        )
        image = photos.images[i, ..., 0] if photos.masks is None else photos.masks[i]
        np.testing.assert_allclose(centroid(image, expected[0]), expected[0], atol=OFF)
        assert orientation(folder / name["image"]) == 1
        if photos.masks is not None:
            assert orientation(folder / name["mask"]) == 1


@pytest.mark.parametrize("lens", [0 * LENS, LENS], ids=["pinhole", "lens"])
@pytest.mark.parametrize("flag", range(1, 9))
def test_cameras_of_stored_pixels_are_turned_with_them(flag, lens, tmp_path):
    report = phone(tmp_path, flag, lens)
    check_agreement(tmp_path / "me")
    shown = (written.WIDTH, written.HEIGHT) if flag < 5 else (written.HEIGHT, written.WIDTH)
    assert (report.width, report.height) == shown
    assert report.turned == (0 if flag == 1 else 4)
    assert any("EXIF orientation" in line for line in (*report.notes, *report.warnings)) == (
        flag != 1
    )
    assert any("sizes do not tell" in warning for warning in report.warnings) == (flag in (2, 3, 4))
    assert any("mirror" in warning for warning in report.warnings) == (flag in (2, 4, 5, 7))


@pytest.mark.parametrize(
    ("mask", "flag"),
    [
        *(("shown", flag) for flag in range(1, 9)),
        *(("flagged", flag) for flag in range(1, 9)),
        # others look like masks of the turned photo
        *(("stored", flag) for flag in (1, 5, 6, 7, 8)),
    ],
)
def test_masks_are_turned_to_their_photo(mask, flag, tmp_path):
    phone(tmp_path, flag, mask=mask)
    check_agreement(tmp_path / "me")


@pytest.mark.parametrize("flag", range(5, 9))
@pytest.mark.parametrize("given", [True, False], ids=["size given", "size not given"])
def test_cameras_of_the_turned_photo_are_left_alone(flag, given, tmp_path):
    report = phone(tmp_path, flag, calibrated="shown", **({} if given else {"imgSize": None}))
    check_agreement(tmp_path / "me")
    assert "of the turned photos" in report.notes[0]


def test_square_photos_are_taken_as_stored_with_a_warning(tmp_path):
    report = phone(tmp_path, 6, size=(56, 56))
    check_agreement(tmp_path / "me")
    assert any("sizes do not tell" in warning for warning in report.warnings)


def test_other_sizes_and_flags_are_refused(tmp_path):
    with pytest.raises(
        CaptureError,
        match=r"a\.png: size: 64 x 48 \(EXIF orientation 6\), was calibrated with 32 x 24",
    ):
        phone(tmp_path, 6, imgSize=[32, 24])
    with pytest.raises(
        CaptureError,
        match=r"was calibrated with 48 x 64: .* turned \(an EXIF orientation that got lost\)",
    ):
        phone(tmp_path, 1, imgSize=[48, 64])
    assert not (tmp_path / "me").exists()
    phone(tmp_path, 1, mask="shown")
    save(tmp_path / "masks" / "a.png", np.zeros((written.HEIGHT, written.WIDTH)), 6)
    with pytest.raises(CaptureError, match=r"a\.png: size: 48 x 64, but its photo has 64 x 48"):
        import_cameras(
            tmp_path / "rig.json",
            tmp_path / "photos",
            tmp_path / "again",
            masks=tmp_path / "masks",
            up="+y",
        )


def test_photos_of_one_camera_with_different_flags_are_refused(tmp_path):
    K, poses = written.scene(1)
    written.write_calibration_full(tmp_path / "rig.json", K, poses, ["a"])
    for i, flag in enumerate((1, 3)):
        save(tmp_path / "a" / f"{i}.png", np.zeros((written.HEIGHT, written.WIDTH, 3)), flag)
    with pytest.raises(
        CaptureError, match=r"1\.png: EXIF orientation 3, but 0\.png of the same camera has 1"
    ):
        import_cameras(tmp_path / "rig.json", tmp_path, tmp_path / "me")


def turn(K):
    K[0][2], K[1][2] = K[1][2], K[0][2]


def by_hand(tmp_path, turned_K):
    """Returns a capture folder in which photos have an EXIF flag."""
    phone(tmp_path, 1)
    for name in NAMES:
        file = tmp_path / "me/images" / f"{name}.png"
        pixels = np.asarray(Image.open(file)) / 255
        save(file, pixels, 6)
    if turned_K:
        edit_json(
            tmp_path / "me/capture.json", lambda me: [turn(view["K"]) for view in me["views"]]
        )
    return tmp_path / "me"


def test_captures_made_by_hand_are_warned_of_or_refused(tmp_path, caplog):
    load_photos(by_hand(tmp_path, turned_K=False))
    assert [
        record.getMessage()
        for record in caplog.records
        if "EXIF orientation of a.png and 3 more" in record.getMessage()
    ]


def test_a_hand_made_K_of_the_turned_photo_is_refused(tmp_path):
    with pytest.raises(
        CaptureError,
        match=r"a\.png: orientation: EXIF orientation 6 is ignored, but K is of the turned photo",
    ):
        load_photos(by_hand(tmp_path, turned_K=True))


def test_a_damaged_flag_is_no_flag(tmp_path):
    save(tmp_path / "photo.jpg", np.zeros((8, 8, 3)), 6)
    assert orientation(tmp_path / "photo.jpg") == 6
    data = (tmp_path / "photo.jpg").read_bytes()
    (tmp_path / "photo.jpg").write_bytes(data.replace(b"MM\x00*", b"MM\x00?"))
    assert orientation(tmp_path / "photo.jpg") == 1
