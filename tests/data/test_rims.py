"""Colors along the edge of a mask."""

import numpy as np
import pytest

from humangs_jax.data.masks import CERTAIN, DEPTH, RIM_HEIGHT, clean_rims

SKIN, ROOM = np.asarray([0.8, 0.5, 0.4], np.float32), np.asarray([0.1, 0.2, 0.9], np.float32)
ROUNDING = 1e-5
"""Of float32 sums over the kernel."""


def disc(size: int, radius: float, soft: float) -> np.ndarray:
    """Coverage of a disc whose edge is `soft` pixels wide."""
    y, x = np.mgrid[:size, :size] - (size - 1) / 2
    return np.clip((radius - np.hypot(x, y)) / soft + 0.5, 0, 1).astype(np.float32)


def mixed(coverage: np.ndarray) -> np.ndarray:
    """Skin before the room."""
    return SKIN * coverage[..., None] + ROOM * (1 - coverage[..., None])


def test_the_rim_shows_the_person_alone():
    mask = disc(500, 0.5 * RIM_HEIGHT, 3)
    photo = mixed(mask)
    cleaned, mixture = clean_rims(photo, mask), 1 - mask
    seen = (mask > 0.05) & (mixture > CERTAIN)
    np.testing.assert_allclose(cleaned[seen], np.broadcast_to(SKIN, photo.shape)[seen], atol=ROUNDING)
    np.testing.assert_array_equal(cleaned[mixture < CERTAIN], photo[mixture < CERTAIN])
    assert np.abs(photo - SKIN)[seen].max() > 0.5


def test_a_mask_too_large_by_a_pixel_shows_no_room():
    photo, mask = mixed(disc(500, 0.5 * RIM_HEIGHT - 1, 1)), disc(500, 0.5 * RIM_HEIGHT, 1)
    rim = mask > 0.5
    before, after = (np.abs(image - SKIN)[rim].max() for image in (photo, clean_rims(photo, mask)))
    assert before > 0.4
    assert after < 0.1


def test_detail_of_the_rim_stays_and_so_does_the_inside():
    rng = np.random.default_rng(0)
    mask, across = disc(500, 0.5 * RIM_HEIGHT, 1), np.cross(SKIN - ROOM, [1.0, 0, 0])
    pattern = 0.1 * rng.choice([-1, 1], mask.shape)[..., None] * across / np.linalg.norm(across)
    photo = (mixed(mask) + pattern).clip(0, 1).astype(np.float32)
    cleaned, whole = clean_rims(photo, mask), (mask == 1)
    # the means have some of the pattern, and so has the direction in which the room lies
    assert np.abs(cleaned - photo)[whole].max() < 0.05
    deep = disc(500, 0.5 * RIM_HEIGHT - DEPTH - 2, 1) == 1
    np.testing.assert_array_equal(cleaned[deep], photo[deep])


@pytest.mark.parametrize("scale", [0.5, 2.0])
def test_lengths_follow_the_person(scale):
    radius = 0.5 * scale * RIM_HEIGHT
    size, off = int(2 * radius) + 40, 1.5 * scale
    photo, mask = mixed(disc(size, radius - off, 1)), disc(size, radius, 1)
    changed = np.abs(clean_rims(photo, mask) - photo).max(-1) > 0
    assert changed[(mask == 1) & (disc(size, radius - off, 1) < 0.5)].mean() > 0.9


def test_what_is_thinner_than_the_rim_stays():
    photo = np.random.default_rng(0).random((500, 500, 3)).astype(np.float32)
    mask = np.zeros((500, 500), np.float32)
    mask[30:470, 250:252] = 1
    np.testing.assert_array_equal(clean_rims(photo, mask), photo)


@pytest.mark.parametrize("value", [0.0, 1.0])
def test_no_edge(value):
    photo = np.random.default_rng(0).random((20, 30, 3)).astype(np.float32)
    np.testing.assert_array_equal(clean_rims(photo, np.full((20, 30), value, np.float32)), photo)


def test_the_border_of_the_photo_is_no_edge_of_the_person():
    photo = np.random.default_rng(0).random((RIM_HEIGHT, 300, 3)).astype(np.float32)
    mask = np.zeros((RIM_HEIGHT, 300), np.float32)
    mask[:, 100:200] = 1
    changed = np.abs(clean_rims(photo, mask) - photo).max(-1) > 0
    assert not changed[:, 110:190].any()
    assert changed[:, 100].any()
