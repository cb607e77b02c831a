"""Photos at other sizes. (Reading and writing them: tests/data.)"""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from humangs_jax.io.images import resized

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
