"""A photo that several steps of a command read is decoded once."""

import shutil
from collections import Counter

import numpy as np
import pytest
from PIL import Image

from humangs_jax.io import images
from humangs_jax.io.decoded import decoded_once, forget_decoded
from humangs_jax.io.images import read_grey, read_image, write_png

SIZE = (40, 30)
"""Width and height of the photos, pixels."""


def noise(channels, dtype=np.uint8):
    """Returns random pixels of all levels."""
    top = np.iinfo(dtype).max + 1
    shape = (SIZE[1], SIZE[0], channels)
    return np.random.default_rng(0).integers(0, top, shape).astype(dtype)


@pytest.fixture()
def decodings(monkeypatch):
    """Returns how often files of each content were decoded."""
    counted, levels = Counter(), images._levels

    def counting(image, data):
        counted[data] += 1
        return levels(image, data)

    monkeypatch.setattr(images, "_levels", counting)
    return counted


@pytest.fixture(params=["photo.jpg", "photo.png", "transparent.png", "grey of 16 bits.png"])
def photo(request, tmp_path):
    path = tmp_path / request.param
    if request.param == "transparent.png":
        Image.fromarray(noise(4)).save(path)
    elif request.param == "grey of 16 bits.png":
        Image.fromarray(noise(1, np.uint16)[..., 0]).save(path)
    else:
        Image.fromarray(noise(3)).save(path)
    return path


def test_a_photo_and_its_copy_are_decoded_once_and_are_the_same_bits(photo, tmp_path, decodings):
    before = read_image(photo)
    copy = shutil.copyfile(photo, tmp_path / f"copy{photo.suffix}")
    decodings.clear()
    with decoded_once():
        found = [read_image(path) for path in (photo, copy, photo)]
        for colors, alpha in found:
            np.testing.assert_array_equal(colors, before[0])
            assert (alpha is None) == (before[1] is None)
            np.testing.assert_array_equal(alpha, before[1])
    assert list(decodings.values()) == [1]
    read_image(photo)
    assert list(decodings.values()) == [2]  # nothing is kept afterwards


def test_masks_are_decoded_once_and_are_no_photos(tmp_path, decodings):
    path = tmp_path / "mask.png"
    write_png(path, np.eye(30, dtype=np.float32))
    with decoded_once():
        for _ in range(2):
            np.testing.assert_array_equal(read_grey(path), np.eye(30))
    assert list(decodings.values()) == [1]


def test_a_file_that_changes_is_decoded_again(tmp_path):
    path = tmp_path / "photo.png"
    with decoded_once():
        for level in (0.2, 0.4):
            write_png(path, np.full((30, 40, 3), level))
            np.testing.assert_allclose(read_image(path)[0], level, atol=1 / 510)


def test_no_more_is_kept_than_there_is_room_for(tmp_path, decodings):
    paths = [tmp_path / f"{i}.png" for i in range(3)]
    for i, path in enumerate(paths):
        Image.fromarray(noise(3) ^ i).save(path)
    with decoded_once(2 * noise(3).nbytes):
        for path in 2 * paths:
            read_image(path)
        assert sorted(decodings.values()) == [1, 1, 2]
        forget_decoded()
        read_image(paths[0])
        assert sorted(decodings.values()) == [1, 2, 2]
