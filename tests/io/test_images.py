"""Photos at other sizes, masks of segmentation tools, EXIF and HEIC.

tests/data tests how photos are read and written.
"""

import struct
import sys
import zlib
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image
from png_files import chunk

from humangs_jax.io.images import (
    FORMATS,
    cropped_from,
    focal_length,
    image_size,
    is_heic,
    open_image,
    orientation,
    oriented,
    read_grey,
    read_image,
    resized,
)
from humangs_jax.io.reading import FileError, Limits, set_limits

HEIC = Path(__file__).parent / "phone.heic"
"""A photo that pillow-heif 1.8.1 wrote: 32 x 24, red with a blue upper left quarter.

Its EXIF has orientation 6 and a focal length of 26 mm.
"""

ROUNDING = 2e-6
"""Rounding of sums of some hundred float32 products of numbers in [0, 1]."""
SIDE = st.integers(1, 60)


def area_average(image, size):
    """Returns the image at another height by area.

    A new pixel is the integral over its area, from cumulated sums at its edges.
    """
    sums = np.concatenate([0 * image[:1], np.cumsum(image, axis=0, dtype=np.float64)])
    edges = np.arange(size + 1) * (len(image) / size)
    at = np.stack(
        [
            np.interp(edges, np.arange(len(sums)), column)
            for column in sums.reshape(len(sums), -1).T
        ],
        -1,
    )
    return (np.diff(at, axis=0) * (size / len(image))).reshape(size, *image.shape[1:])


@settings(max_examples=40, deadline=None)
@given(SIDE, SIDE, SIDE, SIDE, st.sampled_from([(), (1,), (3,)]), st.integers(0, 1000))
def test_each_axis_has_its_own_filter_and_no_value_leaves_the_range(
    height, width, new_height, new_width, channels, seed
):
    image = (
        np.random.default_rng(seed).integers(0, 2, (height, width, *channels)).astype(np.float32)
    )
    found = resized(image, new_width, new_height)
    assert found.shape == (new_height, new_width, *channels) and found.dtype == np.float32
    assert found.min() >= image.min() and found.max() <= image.max()
    if new_height <= height and new_width <= width:
        averaged = area_average(area_average(image, new_height).swapaxes(0, 1), new_width).swapaxes(
            0, 1
        )
        np.testing.assert_allclose(found, averaged, atol=ROUNDING)
    if new_height <= height:  # whatever happens to the columns
        alike = np.repeat(image[:, :1], width, axis=1)
        averaged = np.repeat(area_average(alike[:, :1], new_height), new_width, axis=1)
        np.testing.assert_allclose(resized(alike, new_width, new_height), averaged, atol=ROUNDING)
    np.testing.assert_array_equal(resized(image, width, height), image)
    upside_down = resized(image[::-1, ::-1], new_width, new_height)[::-1, ::-1]
    np.testing.assert_allclose(upside_down, found, atol=ROUNDING)


@pytest.mark.parametrize("size", [(90, 70), (41, 33), (160, 31)])
def test_enlarging_is_bicubic(size):
    """Pillow gives the same, but at the rim and outside of the image's range."""
    image = np.random.default_rng(0).random((31, 40), np.float32)
    theirs = np.asarray(Image.fromarray(image).resize(size, Image.Resampling.BICUBIC))
    # where a pixel beyond the rim counts
    y, x = (2 * new // old + 1 for new, old in zip(size[::-1], image.shape, strict=True))
    assert theirs.max() > 1
    inside = np.s_[y : size[1] - y, x : size[0] - x]
    np.testing.assert_allclose(
        resized(image, *size)[inside],
        np.clip(theirs, image.min(), image.max())[inside],
        atol=ROUNDING,
    )


def test_bytes_are_averaged_as_numbers():
    image = np.full((4, 6, 3), 255, np.uint8)
    np.testing.assert_array_equal(resized(image, 4, 3), np.full((3, 4, 3), 255, np.float32))


# EXIF and HEIC
# --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["PNG", "JPEG"])
@pytest.mark.parametrize(
    ("value", "expected"),
    [(26, 26 * 50 / 43.27), (0, None), (None, None), ("26", None), ((26, 27), None)],
)
def test_focal_length_is_that_of_the_diagonal(kind, value, expected, tmp_path):
    exif = Image.Exif()
    exif[0x0112] = 6
    if value is not None:
        exif.get_ifd(0x8769)[0xA405] = value
    Image.new("RGB", (30, 40)).save(tmp_path / "a", kind, exif=exif)
    assert focal_length(tmp_path / "a") == pytest.approx(expected)


def with_frame(path, size, frame, flag=1):
    """Writes a photo whose EXIF has 26 mm and says that it was taken with this size."""
    exif = Image.Exif()
    exif[0x0112] = flag
    exif.get_ifd(0x8769).update({0xA405: 26, 0xA002: frame[0], 0xA003: frame[1]})
    Image.new("RGB", size).save(path, "JPEG", exif=exif)
    return path


FRAME = (403, 302)


@pytest.mark.parametrize("flag", [1, 6])
@pytest.mark.parametrize(
    "size", [FRAME, (202, 151), (101, 76), (67, 50), (806, 604), FRAME[::-1], (151, 202), (50, 67)]
)
def test_photos_that_were_made_smaller_or_turned_have_a_focal_length(size, flag, tmp_path):
    path = with_frame(tmp_path / "a.jpg", size, FRAME, flag)
    assert (
        focal_length(path) == pytest.approx(26 * np.hypot(*size) / 43.27)
        and cropped_from(path) is None
    )


@pytest.mark.parametrize(
    "size",
    [(40, 60), (300, 300), (403, 227), (226, 302), (403, 100), (200, 302), (160, 90), (90, 160)],
)
def test_photos_that_were_cropped_have_none(size, tmp_path):
    path = with_frame(tmp_path / "a.jpg", size, FRAME)
    assert focal_length(path) is None and cropped_from(path) == FRAME


@pytest.mark.parametrize("frame", [(0, 0), (0, 40), (1 << 31, 1 << 31), ((1, 2), 3), ("40", "30")])
def test_frames_of_nonsense_are_as_none(frame, tmp_path):
    path = with_frame(tmp_path / "a.jpg", (30, 40), frame)
    assert focal_length(path) == pytest.approx(26 * 50 / 43.27) and cropped_from(path) is None


@pytest.mark.filterwarnings("ignore:Corrupt EXIF")
def test_photos_without_exif_and_with_a_damaged_one_have_no_focal_length(tmp_path):
    Image.new("RGB", (30, 40)).save(tmp_path / "a.png")
    Image.new("RGB", (30, 40)).save(tmp_path / "b.jpg", exif=b"Exif\0\0MM\0*\xff\xff\xff\xff")
    assert focal_length(tmp_path / "a.png") is None and focal_length(tmp_path / "b.jpg") is None


def test_heic_is_read_upright(tmp_path):
    pytest.importorskip("pi_heif")
    colors, alpha = read_image(HEIC)
    assert is_heic(HEIC) and colors.shape == (24, 32, 3) and alpha is None
    # compressed
    np.testing.assert_allclose(colors[0, 0], np.asarray([20, 40, 220]) / 255, atol=0.03)
    np.testing.assert_allclose(colors[-1, -1], np.asarray([200, 120, 40]) / 255, atol=0.03)
    assert orientation(HEIC) == 1 and focal_length(HEIC) == pytest.approx(26 * 40 / 43.27)
    try:
        set_limits(Limits(pixels=700))
        with pytest.raises(FileError, match=r"768 pixels \(32 x 24\): the limit pixels is 700"):
            read_image(HEIC)
    finally:
        set_limits(None)
    for end in (20, 300, 600):
        (tmp_path / "cut.heic").write_bytes(HEIC.read_bytes()[:end])
        with pytest.raises(FileError, match=r"cut\.heic: not a readable image: ") as caught:
            read_image(tmp_path / "cut.heic")
        assert "\n" not in str(caught.value)


def test_heic_without_its_extra_is_one_line_that_names_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "pi_heif", None)
    with pytest.raises(
        FileError, match=r'phone\.heic: a HEIC photo: .* pip install "humangs_jax\[heic\]"$'
    ):
        image_size(HEIC)


def test_heic_needs_no_name_and_leaves_other_formats_alone(tmp_path):
    pytest.importorskip("pi_heif")
    (tmp_path / "a.jpg").write_bytes(HEIC.read_bytes())
    assert image_size(tmp_path / "a.jpg") == (32, 24)
    Image.new("RGB", (3, 4)).save(tmp_path / "b.heic", "PNG")
    with open_image(tmp_path / "b.heic") as (image, _):
        assert image.format in FORMATS and not is_heic(tmp_path / "b.heic")


PERSON = np.zeros((12, 8), bool)
PERSON[2:10, 2:5] = True
VOC = [
    0,
    0,
    0,
    128,
    0,
    0,
    0,
    128,
    0,
    128,
    128,
    0,
    0,
    0,
    128,
    128,
    0,
    128,
    0,
    128,
    128,
    128,
    128,
    128,
]


def palette(labels, colors, **options):
    image = Image.new("P", labels.shape[::-1])
    image.putdata(labels.astype(np.uint8).ravel().tolist())
    image.putpalette(colors)
    return image, options


def pixels(array, **options):
    return Image.fromarray(array), options


def grey(mask):
    return np.where(mask, 255, 0).astype(np.uint8)


def colored(mask, person, background=(0, 0, 0)):
    return np.where(mask[..., None], np.uint8(person), np.uint8(background))


PHOTO = np.random.default_rng(0).integers(0, 255, (*PERSON.shape, 3), np.uint8)
RAMP = [value for value in range(256) for _ in range(3)]
READ = {
    "grey": pixels(grey(PERSON)),
    "16 bits": pixels(np.where(PERSON, 65535, 0).astype(np.uint16)),
    "one label": palette(PERSON * 1, VOC),
    "a label that is grey": palette(PERSON * 7, VOC),
    "no label 0": palette(np.where(PERSON, 3, 2), [0, 0, 255, 0, 255, 0, 0, 0, 0, 128, 0, 0]),
    "fewer colors than labels": palette(PERSON * 1, [0, 0, 0]),
    "an opaque palette": palette(PERSON * 1, VOC, transparency=bytes([255, 255])),
    "a transparent background": palette(PERSON * 1, VOC, transparency=0),
    "red": pixels(colored(PERSON, (255, 0, 0))),
    "a cut-out": pixels(np.dstack([PHOTO, grey(PERSON)])),
    "white with alpha": pixels(np.dstack([np.full_like(PHOTO, 255), grey(PERSON)])),
    "greys equal to alpha": pixels(np.dstack([grey(PERSON), grey(PERSON)])),
    "opaque alpha": pixels(np.dstack([grey(PERSON), np.full_like(grey(PERSON), 255)])),
}


@pytest.mark.parametrize("kind", READ)
def test_the_person_is_read(kind, tmp_path):
    image, options = READ[kind]
    image.save(tmp_path / "mask.png", **options)
    np.testing.assert_array_equal(read_grey(tmp_path / "mask.png"), PERSON)


@pytest.mark.parametrize(
    ("image", "expected"),
    [
        (palette(0 * PERSON, VOC), 0),
        (palette(1 + 0 * PERSON, VOC), 1),
        (pixels(colored(0 * PERSON, (9, 0, 0))), 0),
        (pixels(np.zeros((*PERSON.shape, 4), np.uint8)), 0),
    ],
)
def test_nobody_and_everything(image, expected, tmp_path):
    image[0].save(tmp_path / "mask.png")
    assert (read_grey(tmp_path / "mask.png") == expected).all()


def test_soft_masks_keep_their_greys(tmp_path):
    soft = np.linspace(0, 255, 96).reshape(12, 8).astype(np.uint8)
    for image, _ in (
        pixels(soft),
        palette(soft, RAMP),
        pixels(np.dstack([PHOTO, soft])),
        pixels(np.dstack([soft] * 3)),
    ):
        image.save(tmp_path / "mask.png")
        np.testing.assert_allclose(read_grey(tmp_path / "mask.png"), soft / 255, atol=1e-6)


TWO = PERSON * 1 + (np.arange(8) > 3) * PERSON
REFUSED = {
    "a palette of the labels 1, 2: which is the person": palette(TWO, VOC),
    "a palette of the labels 0, 1: 0 is not black: which is the background": palette(
        PERSON * 1, [9, 9, 200, 200, 9, 9]
    ),
    "2 colors: which is the person": pixels(
        colored(TWO == 1, (255, 0, 0)) + colored(TWO == 2, (0, 255, 0))
    ),
    "2 colors without black: which": pixels(colored(PERSON, (255, 0, 0), (0, 0, 200))),
    "an alpha channel besides its greys": pixels(np.dstack([grey(TWO == 1), grey(PERSON)])),
}


@pytest.mark.parametrize("problem", REFUSED)
def test_what_is_not_clear_is_one_line(problem, tmp_path):
    image, options = REFUSED[problem]
    image.save(tmp_path / "mask.png", **options)
    with pytest.raises(FileError) as caught:
        read_grey(tmp_path / "mask.png")
    assert str(caught.value).startswith(f"{tmp_path / 'mask.png'}: ") and problem in str(
        caught.value
    )


@pytest.mark.parametrize("flag", range(1, 9))
def test_pixels_are_turned_as_pillow_turns_them(flag, tmp_path):
    from PIL import ImageOps

    exif = Image.Exif()
    exif[0x0112] = flag
    Image.fromarray(PHOTO).save(tmp_path / "photo.png", exif=exif)
    with Image.open(tmp_path / "photo.png") as image:
        np.testing.assert_array_equal(
            oriented(PHOTO, flag), np.asarray(ImageOps.exif_transpose(image))
        )


def deep_png(pixels, color_type):
    rows = b"".join(b"\0" + row.astype(">u2").tobytes() for row in pixels)
    header = struct.pack(">IIBBBBB", pixels.shape[1], pixels.shape[0], 16, color_type, 0, 0, 0)
    return (
        b"\x89PNG\r\n\x1a\n"
        + chunk(b"IHDR", header)
        + chunk(b"IDAT", zlib.compress(rows))
        + chunk(b"IEND", b"")
    )


@pytest.mark.parametrize(("channels", "color_type"), [(1, 0), (3, 2), (4, 6), (2, 4)])
def test_sixteen_bit_png_keeps_every_bit(tmp_path, channels, color_type):
    pixels = np.random.default_rng(1).integers(0, 65536, (7, 9, channels), np.uint16)
    (tmp_path / "deep.png").write_bytes(deep_png(pixels, color_type))
    colors, alpha = read_image(tmp_path / "deep.png")
    expected = pixels.astype(np.float32) / np.float32(65535)
    np.testing.assert_array_equal(
        colors, np.broadcast_to(expected[..., : 3 if channels > 2 else 1], (7, 9, 3))
    )
    if channels in (2, 4):
        np.testing.assert_array_equal(alpha, expected[..., -1])
    else:
        assert alpha is None


@pytest.mark.parametrize("mode", ["L", "1", "P", "RGB", "CMYK", "LA", "RGBA"])
def test_every_common_image_mode_is_read(tmp_path, mode):
    image = Image.fromarray(np.random.default_rng(2).integers(0, 256, (8, 9, 3), np.uint8)).convert(
        mode
    )
    suffix = "jpg" if mode == "CMYK" else "png"
    image.save(tmp_path / f"x.{suffix}")
    colors, alpha = read_image(tmp_path / f"x.{suffix}")
    assert colors.shape == (8, 9, 3) and (alpha is not None) == mode.endswith("A")
    if mode != "CMYK":  # JPEG is lossy
        np.testing.assert_allclose(colors, np.asarray(image.convert("RGB")) / 255, atol=1e-6)
