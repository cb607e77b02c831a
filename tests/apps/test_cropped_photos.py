"""Photos without a calibration are named if their EXIF describes a frame of another size."""

from PIL import Image

from humangs_jax.apps import photos_alone


def test_photos_that_were_cropped_are_named(tmp_path):
    exif = Image.Exif()
    exif.get_ifd(0x8769).update({0xA405: 26, 0xA002: 4032, 0xA003: 3024})
    files = [tmp_path / "a.jpg", tmp_path / "b.jpg"]
    for file, size in zip(files, [(120, 60), (80, 60)], strict=True):
        Image.new("RGB", size).save(file, exif=exif)
    named = "a.jpg (120 x 60, EXIF 4032 x 3024): their focal length is taken for unknown"
    assert photos_alone._cropped(files) == (
        f"cropped, as their shape is not that of their EXIF: {named}",
    )
    assert photos_alone._cropped(files[1:]) == ()
