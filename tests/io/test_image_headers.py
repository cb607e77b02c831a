"""Data behind or inside of a photo is not read as the photo; formats of phones and the web are."""

import io
import sys

import numpy as np
import pytest
from PIL import Image

from humangs_jax.io.image_headers import check_png_chunks, iso_kind, jpeg_scans, webp_size
from humangs_jax.io.images import focal_length, image_size, orientation, read_image
from humangs_jax.io.reading import FileError, InvalidFileError, Limits, set_limits

PHOTO = Image.fromarray(np.random.default_rng(0).integers(0, 255, (24, 32, 3), np.uint8)).resize(
    (320, 240)
)
SCAN = b"\xff\xda\x00\x08"
NOISE = np.random.default_rng(1).bytes(40_000) + SCAN * 200


def encoded(kind, image=PHOTO, **options):
    file = io.BytesIO()
    image.save(file, kind, **options)
    return file.getvalue()


def with_segment(jpeg, marker, content):
    """Returns a JPEG file with one more segment before all others."""
    return (
        jpeg[:2]
        + bytes([0xFF, marker])
        + (len(content) + 2).to_bytes(2, "big")
        + content
        + jpeg[2:]
    )


PLAIN, PROGRESSIVE = encoded("JPEG", quality=90), encoded("JPEG", quality=90, progressive=True)
THUMBNAILS = PROGRESSIVE[:20_000] + SCAN * 100


@pytest.mark.parametrize("jpeg", [PLAIN, PROGRESSIVE])
@pytest.mark.parametrize(
    "around",
    [
        lambda jpeg: jpeg + NOISE,
        lambda jpeg: jpeg + b"\0\0\0\x18ftypmp42" + NOISE,
        lambda jpeg: jpeg + PROGRESSIVE * 20,
        lambda jpeg: with_segment(jpeg, 0xE1, b"Exif\0\0" + THUMBNAILS),
        lambda jpeg: with_segment(with_segment(jpeg, 0xEB, SCAN * 3000), 0xFE, SCAN * 3000),
        lambda jpeg: jpeg[:2] + b"\xff" * 9 + jpeg[2:] + NOISE,
    ],
)
def test_scans_behind_a_picture_and_in_its_segments_are_not_the_pictures(jpeg, around, tmp_path):
    (tmp_path / "plain.jpg").write_bytes(jpeg)
    (tmp_path / "more.jpg").write_bytes(around(jpeg))
    assert jpeg_scans(around(jpeg)) == jpeg_scans(jpeg)
    np.testing.assert_array_equal(
        read_image(tmp_path / "more.jpg")[0], read_image(tmp_path / "plain.jpg")[0]
    )


def repeated(jpeg, count, between=b""):
    """Returns a progressive JPEG file whose last scan occurs `count` times."""
    last = jpeg.rindex(b"\xff\xda")
    return jpeg[:last] + (between + jpeg[last:-2]) * count + jpeg[-2:]


@pytest.mark.parametrize(
    "between",
    [b"", b"\xff\xff\xff", b"\xff\x02\xff\xff", b"\xff\xd3", b"\xff\xfe\0\4ab", b"garbage\xff\0"],
)
def test_a_hundred_real_scans_are_refused_whatever_is_between_them(between, tmp_path):
    many = repeated(PROGRESSIVE, 100, between)
    (tmp_path / "many.jpg").write_bytes(many)
    assert jpeg_scans(many) == 100 + jpeg_scans(PROGRESSIVE) - 1
    with pytest.raises(FileError, match=r"many\.jpg: 1\d\d scans of a JPEG: the limit scans is 64"):
        read_image(tmp_path / "many.jpg")


@pytest.mark.parametrize("cut", [2, 3, 20, 300, len(PLAIN) - 2])
def test_scans_of_a_photo_that_is_cut_are_counted_to_its_end(cut):
    assert jpeg_scans(PLAIN[:cut]) in (0, 1) and jpeg_scans(PLAIN[:cut] + b"\xff") in (0, 1)


@pytest.mark.parametrize("kind", ["WEBP", "AVIF"])
@pytest.mark.parametrize("name", ["a.webp", "a.avif", "a.jpg"])
def test_photos_of_the_web_are_read_whatever_they_are_called(kind, name, tmp_path):
    exif = Image.Exif()
    exif[0x010F] = "a phone"
    exif[0x0112] = 6
    exif.get_ifd(0x8769)[0xA405] = 26
    (tmp_path / name).write_bytes(encoded(kind, quality=95, exif=exif))
    colors, alpha = read_image(tmp_path / name)
    assert alpha is None and np.abs(colors - np.asarray(PHOTO) / 255).mean() < 0.02
    assert image_size(tmp_path / name) == PHOTO.size and orientation(tmp_path / name) == 6
    assert focal_length(tmp_path / name) == pytest.approx(26 * 400 / 43.27)


@pytest.mark.parametrize(
    "options",
    [{"lossless": True}, {"quality": 80}, {"quality": 80, "exif": b"Exif\0\0MM\0*\0\0\0\x08\0\0"}],
)
def test_the_size_of_a_webp_is_known_before_it_takes_memory(options, tmp_path):
    assert webp_size(encoded("WEBP", **options)) == PHOTO.size
    (tmp_path / "a.webp").write_bytes(encoded("WEBP", **options))
    try:
        set_limits(Limits(pixels=70_000))
        with pytest.raises(
            FileError, match=r"a\.webp: 76,800 pixels \(320 x 240\): the limit pixels"
        ):
            read_image(tmp_path / "a.webp")
    finally:
        set_limits(None)


def test_alpha_of_a_webp_is_kept(tmp_path):
    pixels = np.dstack([np.asarray(PHOTO), np.arange(240, dtype=np.uint8)[:, None].repeat(320, 1)])
    Image.fromarray(pixels).save(tmp_path / "a.webp", lossless=True, exact=True)
    colors, alpha = read_image(tmp_path / "a.webp")
    np.testing.assert_allclose(np.dstack([colors, alpha]) * 255, pixels, atol=1e-3)


@pytest.mark.parametrize("kind", ["WEBP", "AVIF"])
def test_a_damaged_photo_of_the_web_is_one_line(kind, tmp_path):
    data = encoded(kind)
    for cut in (13, 24, 60, len(data) // 2):
        (tmp_path / "a.webp").write_bytes(data[:cut])
        with pytest.raises(FileError, match=r"a\.webp: ") as caught:
            read_image(tmp_path / "a.webp")
        assert "\n" not in str(caught.value)


def test_a_png_that_is_cut_anywhere_is_refused_with_the_same_error():
    whole = encoded("PNG", PHOTO.resize((4, 3)))
    check_png_chunks(whole)
    for cut in range(len(whole)):
        with pytest.raises(InvalidFileError, match=r"not a readable image: .*cut off"):
            check_png_chunks(whole[:cut])


def test_further_brands_tell_what_a_photo_is_whose_first_does_not():
    def box(*brands):
        return (
            (16 + 4 * len(brands[1:])).to_bytes(4, "big")
            + b"ftyp"
            + brands[0]
            + bytes(4)
            + b"".join(brands[1:])
        )

    assert iso_kind(box(b"mif1", b"mif1", b"avif")) == iso_kind(box(b"avis")) == "AVIF"
    assert iso_kind(box(b"mif1", b"heic")) == iso_kind(box(b"heic", b"avif")) == "HEIF"
    assert iso_kind(box(b"mp42", b"heic")) is iso_kind(PLAIN) is None


def test_a_pillow_without_avif_is_one_line(monkeypatch, tmp_path):
    (tmp_path / "a.avif").write_bytes(encoded("AVIF"))
    monkeypatch.setattr(sys.modules["PIL.features"], "check", lambda name: False)
    with pytest.raises(FileError, match=r"a\.avif: an AVIF photo, which this Pillow cannot read"):
        image_size(tmp_path / "a.avif")
