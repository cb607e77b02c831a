"""Photos at other sizes. (Reading and writing them: tests/data.)"""

import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from humangs_jax.io.images import (
    FORMATS,
    focal_length,
    image_size,
    is_heic,
    open_image,
    orientation,
    read_image,
    resized,
)
from humangs_jax.io.reading import FileError, Limits, set_limits

HEIC = Path(__file__).parent / "phone.heic"
"""Written by pillow-heif 1.8.1: 32 x 24, red, the upper left quarter blue; EXIF has orientation 6 and a focal length of 26 mm."""

ROUNDING = 2e-6
"""Of sums of some hundred float32 products of numbers in [0, 1]."""
SIDE = st.integers(1, 60)


def area_average(image, size):
    """Along the first axis: the integral over each new pixel, by the cumulated sums at its edges."""
    sums = np.concatenate([0 * image[:1], np.cumsum(image, axis=0, dtype=np.float64)])
    edges = np.arange(size + 1) * (len(image) / size)
    at = np.stack([np.interp(edges, np.arange(len(sums)), column) for column in sums.reshape(len(sums), -1).T], -1)
    return (np.diff(at, axis=0) * (size / len(image))).reshape(size, *image.shape[1:])


@settings(max_examples=40, deadline=None)
@given(SIDE, SIDE, SIDE, SIDE, st.sampled_from([(), (1,), (3,)]), st.integers(0, 1000))
def test_each_axis_has_its_own_filter_and_no_value_leaves_the_range(
    height, width, new_height, new_width, channels, seed
):
    image = np.random.default_rng(seed).integers(0, 2, (height, width, *channels)).astype(np.float32)
    found = resized(image, new_width, new_height)
    assert found.shape == (new_height, new_width, *channels) and found.dtype == np.float32
    assert found.min() >= image.min() and found.max() <= image.max()
    if new_height <= height and new_width <= width:
        averaged = area_average(area_average(image, new_height).swapaxes(0, 1), new_width).swapaxes(0, 1)
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
    """As Pillow does it, but for the rim, and for what it leaves outside of the range of the image."""
    image = np.random.default_rng(0).random((31, 40), np.float32)
    theirs = np.asarray(Image.fromarray(image).resize(size, Image.Resampling.BICUBIC))
    y, x = (
        2 * new // old + 1 for new, old in zip(size[::-1], image.shape, strict=True)
    )  # where a pixel beyond the rim counts
    assert theirs.max() > 1
    inside = np.s_[y : size[1] - y, x : size[0] - x]
    np.testing.assert_allclose(
        resized(image, *size)[inside], np.clip(theirs, image.min(), image.max())[inside], atol=ROUNDING
    )


def test_a_ramp_stays_a_ramp():
    """So that intrinsics that follow the pixels see the same point; pixels that are cut in two are off by an eighth at most."""
    ramp = np.linspace(0, 1, 24, dtype=np.float32)[:, None] + np.zeros((1, 7), np.float32)
    for size in (5, 9, 17, 40, 101):
        centres = (np.arange(size) + 0.5) * 24 / size - 0.5
        inside, atol = (centres > 1) & (centres < 22), ROUNDING if size > 24 else 1 / 8 / 23
        np.testing.assert_allclose(resized(ramp, 7, size)[inside, 3], centres[inside] / 23, atol=atol)


def test_bytes_are_averaged_as_numbers():
    image = np.full((4, 6, 3), 255, np.uint8)
    np.testing.assert_array_equal(resized(image, 4, 3), np.full((3, 4, 3), 255, np.float32))


# EXIF and HEIC -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["PNG", "JPEG"])
@pytest.mark.parametrize(
    ("value", "expected"), [(26, 26 * 50 / 43.27), (0, None), (None, None), ("26", None), ((26, 27), None)]
)
def test_focal_length_is_that_of_the_diagonal(kind, value, expected, tmp_path):
    exif = Image.Exif()
    exif[0x0112] = 6
    if value is not None:
        exif.get_ifd(0x8769)[0xA405] = value
    Image.new("RGB", (30, 40)).save(tmp_path / "a", kind, exif=exif)
    assert focal_length(tmp_path / "a") == pytest.approx(expected)


@pytest.mark.filterwarnings("ignore:Corrupt EXIF")
def test_photos_without_exif_and_with_a_damaged_one_have_no_focal_length(tmp_path):
    Image.new("RGB", (30, 40)).save(tmp_path / "a.png")
    Image.new("RGB", (30, 40)).save(tmp_path / "b.jpg", exif=b"Exif\0\0MM\0*\xff\xff\xff\xff")
    assert focal_length(tmp_path / "a.png") is None and focal_length(tmp_path / "b.jpg") is None


def test_heic_is_read_upright(tmp_path):
    pytest.importorskip("pi_heif")
    colors, alpha = read_image(HEIC)
    assert is_heic(HEIC) and colors.shape == (24, 32, 3) and alpha is None
    np.testing.assert_allclose(colors[0, 0], np.asarray([20, 40, 220]) / 255, atol=0.03)  # compressed
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
    with pytest.raises(FileError, match=r'phone\.heic: a HEIC photo: .* pip install "humangs_jax\[heic\]"$'):
        image_size(HEIC)


def test_heic_needs_no_name_and_leaves_other_formats_alone(tmp_path):
    pytest.importorskip("pi_heif")
    (tmp_path / "a.jpg").write_bytes(HEIC.read_bytes())
    assert image_size(tmp_path / "a.jpg") == (32, 24)
    Image.new("RGB", (3, 4)).save(tmp_path / "b.heic", "PNG")
    with open_image(tmp_path / "b.heic") as (image, _):
        assert image.format in FORMATS and not is_heic(tmp_path / "b.heic")
