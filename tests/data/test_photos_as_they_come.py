"""Photos of several sizes, flags and formats in one folder become a capture of one size in which pixels keep their places."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from humangs_jax.data.calibration.importing import import_cameras
from humangs_jax.data.capture_checks import CaptureError
from humangs_jax.data.keypoints.reading import read_keypoints
from humangs_jax.data.photos import load_photos
from humangs_jax.io.images import read_image
from humangs_jax.io.reading import Limits, set_limits
from tests.data import calibration_files as written

SHOWN = {"a.png": (64, 48), "b.PNG": (48, 64), "c.png": (40, 30)}
"""Width and height of the upright photos; b is stored on its side."""
FLAG = 6
HEIC = Path(__file__).parents[1] / "io" / "phone.heic"


def write_phones(folder, masks=False, reach=(0, 0)):
    """Calibration of the upright photos, and photos of noise. reach: rows and columns of the masks up to the rim."""
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
    return import_cameras(folder / "rig.json", folder / "photos", folder / "out", up="+y", **options)


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


@pytest.mark.parametrize(("reach", "named"), [((5, 0), "a.png and 1 more"), ((0, 5), "b.PNG and 1 more")])
def test_a_person_who_is_cut_off_by_a_padded_rim_is_warned_of(reach, named, tmp_path):
    write_phones(tmp_path, masks=True, reach=reach)
    (warning,) = imported(tmp_path, masks=tmp_path / "masks").warnings
    assert f"cut off where white was added to {named}" in warning


def test_keypoints_of_the_photos_before_padding_fit(tmp_path):
    write_phones(tmp_path)
    imported(tmp_path)
    images = [{"id": i, "file_name": n, "width": w, "height": h} for i, (n, (w, h)) in enumerate(SHOWN.items())]
    people = [{"image_id": i, "keypoints": [10.0 + i, 20.0, 2] * 17} for i in range(len(SHOWN))]
    file = tmp_path / "k.json"
    file.write_text(json.dumps({"images": images, "annotations": people}))
    photos = load_photos(tmp_path / "out")
    keypoints = read_keypoints(file, photos.names, *photos.images.shape[2:0:-1])
    assert keypoints.points[:, 0].tolist() == [[10.5 + i, 20.5] for i in range(len(SHOWN))]
    images[0]["width"] = 80  # of another photo
    file.write_text(json.dumps({"images": images, "annotations": people}))
    with pytest.raises(CaptureError, match=r"size of a\.png: 80 x 48, but the capture's photos have 64 x 64"):
        read_keypoints(file, photos.names, 64, 64)


@pytest.mark.parametrize("limit", [{"pixels": 4000}, {"capture_pixels": 3 * 64 * 64 - 1}])
def test_padding_has_the_limits_of_reading(limit, tmp_path):
    write_phones(tmp_path)
    try:
        set_limits(Limits(**limit))
        with pytest.raises(CaptureError, match=rf"photos: .* padded.*: the limit {next(iter(limit))} is") as caught:
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
    assert sorted(path.name for path in (tmp_path / "out" / "images").iterdir()) == ["a.png", "b.png"]
    np.testing.assert_allclose(load_photos(tmp_path / "out").images[1], read_image(HEIC)[0], atol=1e-6)
