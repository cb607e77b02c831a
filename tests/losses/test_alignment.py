"""Comparison after small moves: detail a few pixels off beats a blur, wrong detail does not."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from humangs_jax.losses import alignment
from humangs_jax.losses.alignment import (
    aligned_psnr,
    misplaced,
    moved_photo,
    photos_agree,
    smooth_moves,
)

HEIGHT, WIDTH = 120, 80
PERSON = slice(10, 110), slice(20, 60)


def person(seed=0, detail=2.0):
    """Returns a photo (h, w, 4): detail inside of a rectangle 100 pixels high, and its mask."""
    rng, photo = np.random.default_rng(seed), np.ones((HEIGHT, WIDTH, 4), np.float32)
    noise = gaussian_filter(rng.normal(size=(HEIGHT, WIDTH, 3)), (detail, detail, 0))
    photo[..., 3] = 0
    photo[PERSON] = 1
    photo[PERSON][..., :3] = np.clip(0.5 + 0.25 * noise / noise.std(), 0, 1)[PERSON]
    return photo


def plain_psnr(image, photo):
    return -10 * np.log10(np.mean(np.square(image - photo)))


def blurred(photo):
    """Returns the photo without detail and with its sharp outline."""
    smooth = gaussian_filter(photo, (4, 4, 0))
    smooth[..., 3] = photo[..., 3]
    return np.where(photo[..., 3:] > 0, smooth, photo)


def test_detail_that_is_two_pixels_off_is_better_than_a_blur():
    photo = person()
    off = np.roll(photo, (2, 0), (0, 1))
    assert plain_psnr(off, photo) < plain_psnr(blurred(photo), photo)
    assert aligned_psnr(off, photo) > aligned_psnr(blurred(photo), photo) + 3


def test_detail_of_somebody_else_and_detail_that_is_far_off_are_worse_than_a_blur():
    photo = person()
    for wrong in (person(seed=1), np.roll(photo, (9, 0), (0, 1))):
        assert aligned_psnr(wrong, photo) < aligned_psnr(blurred(photo), photo)


def test_people_of_any_size_are_compared_alike(monkeypatch):
    photo = person()
    off = np.roll(photo, (2, 1), (0, 1))
    large = [each.repeat(3, axis=0).repeat(3, axis=1) for each in (off, photo)]
    monkeypatch.setattr(alignment, "LARGEST", 100)
    assert aligned_psnr(*large) == pytest.approx(aligned_psnr(off, photo), abs=1e-3)


def test_only_pixels_that_count_are_scored():
    photo, image = person(), person()
    image[:40, :, :3] = 0
    counted = np.zeros((HEIGHT, WIDTH), bool)
    assert aligned_psnr(image, photo, counted) == 100
    counted[60:] = True
    assert aligned_psnr(image, photo, counted) > 60 > aligned_psnr(image, photo)


def test_smooth_moves_bring_a_photo_to_an_image():
    photo = person()
    rows = np.indices((HEIGHT, WIDTH))[0]
    bend = np.stack([1.5 * np.sin(rows / 25.0), np.cos(rows / 25.0)], axis=-1)
    image = moved_photo(photo, bend)
    moves = smooth_moves(image, photo)
    inside = (photo[..., 3] > 0) & (image[..., 3] > 0)
    assert np.abs(moves - bend)[inside].mean() < 0.4
    closer = np.square(moved_photo(photo, moves) - image).mean()
    assert closer < 0.3 * np.square(photo - image).mean()
    expected = np.linalg.norm(bend, axis=-1)[inside].mean() / 100
    assert misplaced(image, photo) == pytest.approx(expected, rel=0.3)


def test_what_is_where_it_should_be_does_not_move():
    photo = person()
    darker = np.where(photo[..., 3:] > 0, photo - [0.1, 0.05, 0.1, 0], photo).astype(np.float32)
    assert misplaced(photo, photo) == 0 and misplaced(darker, photo) < 1e-3
    assert misplaced(photo, np.zeros_like(photo)) == 0  # nobody


@pytest.mark.parametrize(
    ("gains", "least", "kept"),
    [
        ([], -1.0, False),
        ([0.5], 0.1, True),
        ([0.0], 0.1, False),
        ([-3.0, 0.2, 0.3], 0.1, True),  # one of three is off
        ([0.2, -3.0, -3.0], 0.1, False),
        ([-3.0, 0.2], 0.1, False),
        ([1.2, -9.0, -9.0], 0.1, True),  # no wrong thing gains as much
        ([float("nan"), float("nan")], -1.0, False),
    ],
)
def test_most_of_the_photos_decide(gains, least, kept):
    assert photos_agree(gains, least) is kept


def test_two_photos_that_agree_are_enough():
    for gain in (0.5, -0.5):
        rest = iter([gain, gain, pytest.fail])
        photos_agree(rest, 0.1)
        assert next(rest) is pytest.fail
