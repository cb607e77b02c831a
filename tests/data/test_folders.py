"""Folders as phones, disks and other programs fill them: photos are used, the rest is named."""

import json

import numpy as np
import pytest
from PIL import Image

from humangs_jax.apps.start import inspect_folder, photo_files
from humangs_jax.apps.video_photos import video_of
from humangs_jax.avatar.video import contact_sheet, write_video
from humangs_jax.capture.calibration.importing import import_cameras
from humangs_jax.data.capture_checks import CaptureError
from humangs_jax.data.folders import photo_of_mask, scan_folder, unused_line
from humangs_jax.io.images import DRAWN, MASK, is_own_picture, mark_of, write_png
from tests.capture import calibration_files as written

FILES, NAMES = written.FILES, written.NAMES
CLIP = np.full((3, written.HEIGHT, written.WIDTH, 3), 0.5)


@pytest.fixture
def rig(tmp_path):
    """Writes a calibration and photos; returns (source, images, place of the capture)."""
    written.write_calibration_full(tmp_path / "rig.json", *written.scene(), NAMES)
    written.write_photos(tmp_path / "photos", FILES)
    return tmp_path / "rig.json", tmp_path / "photos", tmp_path / "out"


def imported(rig, **options):
    return import_cameras(*rig, **{"up": "+y", **options})


def images_of(out):
    return [view["image"] for view in json.loads((out / "capture.json").read_text())["views"]]


@pytest.mark.parametrize("suffix", [".mp4", ".mov"])
def test_photos_win_over_the_clips_beside_them(suffix, rig):
    for name in NAMES:
        write_video(rig[1] / "clip.mp4", CLIP, 10)
        (rig[1] / "clip.mp4").rename(rig[1] / f"{name}{suffix.upper()}")
    report = imported(rig)
    assert (report.views, report.frames) == (4, 1)
    assert (
        f"not used: 4 videos beside photos (a{suffix.upper()}, b{suffix.upper()}, c{suffix.upper()}"
        " and 1 more)" in str(report)
    )
    assert "not used: 4 videos" in str(inspect_folder(rig[1]))
    # frames are asked for: of the videos
    assert imported(rig, frames=2, overwrite=True).frames == 2
    assert "4 photos beside the videos" in str(imported(rig, frames=2, overwrite=True))


def test_errors_about_videos_name_no_folder_that_is_gone(rig):
    for file in FILES:
        (rig[1] / file).unlink()
    write_video(rig[1] / "z.mp4", CLIP, 10)
    with pytest.raises(
        CaptureError, match=r"rig\.json: a: no photo of this camera in .*photos: expected"
    ) as caught:
        imported(rig)
    assert ".video-" not in str(caught.value)


def test_an_m4v_is_a_video(tmp_path):
    write_video(tmp_path / "me.mp4", CLIP, 10)
    (tmp_path / "me.mp4").rename(tmp_path / "me.m4v")
    assert video_of(tmp_path) == tmp_path / "me.m4v" == video_of(tmp_path / "me.m4v")


def test_photos_without_a_camera_are_named(rig):
    written.write_calibration_full(rig[0], *(each[:2] for each in written.scene()), NAMES[:2])
    assert (
        "warning: not used: 2 photos without a camera in rig.json (c.png, d.png)"
        in str(imported(rig)).splitlines()
    )


def test_images_that_colmap_did_not_register_are_named(rig, tmp_path):
    written.write_colmap(tmp_path / "model", *(each[1:] for each in written.scene()), FILES[1:])
    report = import_cameras(tmp_path / "model", *rig[1:])
    assert report.views == 3 and "1 photo without a camera in images.txt (a.png)" in str(report)


def test_cameras_without_photos_are_left_out_and_counted(rig):
    for file in FILES[2:]:
        (rig[1] / file).unlink()
    report = imported(rig)
    assert (report.cameras, report.views) == (2, 2)
    assert "left out, without a photo: 2 of 4 cameras of rig.json (c, d)" in str(report)


@pytest.mark.parametrize("write", [written.write_transforms, written.write_colmap])
def test_images_without_photos_are_left_out_unless_names_do_not_match(write, rig, tmp_path):
    name = "transforms.json" if write is written.write_transforms else "model"
    write(tmp_path / name, *written.scene(), FILES)
    (rig[1] / "a.png").rename(rig[1] / "renamed.png")
    with pytest.raises(CaptureError, match=r"a\.png: no such photo"):
        import_cameras(tmp_path / name, *rig[1:])
    (rig[1] / "renamed.png").unlink()
    report = import_cameras(tmp_path / name, *rig[1:])
    assert images_of(rig[2]) == ["images/b.png", "images/c.png", "images/d.png"]
    assert "1 of 4 images" in str(report) and report.frames == 1


def test_hidden_files_are_no_photos_in_any_layout(rig, tmp_path):
    for number in range(2):
        for camera in NAMES:
            written.write_photos(tmp_path / "frames" / camera, [f"{number}.png"])
            (tmp_path / "frames" / camera / f"._{number}.png").write_bytes(b"\0\5\x16\7")
    (tmp_path / "._rig.json").write_bytes(b"\0\5\x16\7")
    report = import_cameras(rig[0], tmp_path / "frames", rig[2], up="+y")
    assert (report.views, report.frames, report.unused) == (8, 2, ())
    assert len(photo_files(tmp_path / "frames")[1]) == 8


@pytest.mark.parametrize(
    "pattern",
    [
        "{name}.mask.png",
        "{stem}_mask.png",
        "{stem}-Matte.png",
        "mask_{stem}.png",
        "{stem}.segmentation.PNG",
    ],
)
def test_masks_may_say_that_they_are_masks(pattern, rig, tmp_path):
    names = [pattern.format(name=file, stem=file[:-4]) for file in FILES]
    written.write_photos(tmp_path / "masks", names, grey=True)
    assert imported(rig, masks=tmp_path / "masks").masks
    for name in names:  # beside the photos
        (tmp_path / "masks" / name).rename(rig[1] / name)
    found = inspect_folder(rig[1])
    assert (found.photos, found.masks) == (4, rig[1])
    assert imported(rig, masks=rig[1], overwrite=True).masks
    (rig[1] / names[0]).unlink()
    assert (
        "3 masks beside photos" in str(inspect_folder(rig[1]))
        and inspect_folder(rig[1]).masks is None
    )


def test_names_that_only_look_like_those_of_masks_are_photos():
    assert photo_of_mask("unmasked.png") is None and photo_of_mask("mask.png") is None
    assert photo_of_mask("0001.jpg.mask.png") == "0001.jpg"


def test_pictures_of_other_formats_are_named(rig):
    for name in ("x.TIF", "y.dng", "notes.txt"):
        (rig[1] / name).write_bytes(b"II*\0")
    assert "not used: 2 files in a format that is not read (x.TIF, y.dng)" in str(
        inspect_folder(rig[1])
    )
    for file in FILES:
        (rig[1] / file).unlink()
    with pytest.raises(CaptureError, match=r"no photo: expected .*\(not used: 2 files .*x\.TIF"):
        inspect_folder(rig[1])


def test_of_two_photos_of_one_name_one_is_taken_and_the_other_named(rig):
    Image.new("RGB", (written.WIDTH, written.HEIGHT)).save(rig[1] / "a.webp")
    report = imported(rig)
    assert images_of(rig[2])[0] == "images/a.png"
    assert "not used: 1 photo with the name of another one (a.webp)" in str(report)


def test_photos_beside_a_folder_of_photos_are_named(tmp_path):
    written.write_photos(tmp_path / "images", FILES)
    written.write_photos(tmp_path, ["late.png"])
    assert "1 photo outside of the folder of photos (late.png)" in str(inspect_folder(tmp_path))


def test_pictures_that_show_results_are_no_photos(rig):
    contact_sheet(np.zeros((2, 8, 8, 3)), rig[1] / "people.png")
    write_png(rig[1] / "cut.png", np.zeros((8, 8, 3)), mark=DRAWN)
    assert is_own_picture(rig[1] / "cut.png") and not is_own_picture(rig[1] / "a.png")
    assert [photo.name for photo in photo_files(rig[1])[1]] == list(FILES)
    assert "2 pictures that humangs drew (cut.png, people.png)" in str(inspect_folder(rig[1]))
    assert "2 pictures that humangs drew" in str(imported(rig))


def test_masks_and_files_that_cannot_be_read_are_no_results(tmp_path):
    write_png(tmp_path / "mask.png", np.zeros((8, 8)), mark=MASK)
    assert mark_of(tmp_path / "mask.png") == MASK and not is_own_picture(tmp_path / "mask.png")
    (tmp_path / "short.png").write_bytes(b"\x89PNG")
    assert mark_of(tmp_path / "short.png") is None and mark_of(tmp_path / "none.png") is None


def test_folders_that_are_captures_are_named_and_previews_are_not(rig):
    imported((rig[0], rig[1], rig[1] / "me"))
    written.write_photos(rig[1] / "@eaDir", ["thumb.png"])
    scan = scan_folder(rig[1])
    assert (
        len(scan.photos) == 4
        and unused_line(scan.unused) == "not used: 1 folder that is a capture already (me)"
    )
