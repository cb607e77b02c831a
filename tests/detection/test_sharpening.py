"""Masks of a network at the size of the photo."""

import numpy as np
import pytest
from scipy import ndimage

from humangs_jax.detection.sharpening import sharpened
from humangs_jax.io.images import resized

PERSON, ROOM = np.asarray([0.7, 0.5, 0.4], np.float32), np.asarray([0.2, 0.3, 0.6], np.float32)


def scene(scale):
    """Photo, true coverage, and the mask of a network that has one pixel for `scale` of the photo; a body with a thin arm."""
    y, x = np.mgrid[: 60 * scale, : 60 * scale] / scale
    true = ((np.hypot((x - 30) / 12, (y - 32) / 22) < 1) | ((np.abs(y - 20) < 1.2) & (x > 30) & (x < 54))).astype(
        np.float32
    )
    photo = PERSON * true[..., None] + ROOM * (1 - true[..., None])
    photo += 0.02 * np.random.default_rng(0).normal(size=photo.shape).astype(np.float32)
    coarse = ndimage.gaussian_filter(resized(true, 60, 60), 0.8)
    return photo.clip(0, 1), true, resized(coarse, 60 * scale, 60 * scale).clip(0, 1)


def overlap(one, other):
    return (one & other).sum() / (one | other).sum()


@pytest.mark.parametrize("scale", [2, 4, 8])
def test_edges_move_to_those_of_the_photo_and_thin_parts_stay(scale):
    photo, true, mask = scene(scale)
    found, inside = sharpened(mask, photo, float(scale)), true > 0.5
    before, after = (overlap(each > 0.5, inside) for each in (mask, found))
    assert 1 - after < 0.5 * (1 - before)
    arm = inside.copy()
    arm[:, : 44 * scale] = False
    assert (found > 0.5)[arm].mean() > max(0.9, (mask > 0.5)[arm].mean())
    assert np.abs(found - true).mean() < np.abs(mask - true).mean()


def test_what_is_far_from_the_person_stays_clear():
    photo, _, mask = scene(4)
    mask[:, :40] = 0
    found = sharpened(mask, photo, 4.0)
    assert not found[:, :20].any()
    np.testing.assert_array_equal(sharpened(np.zeros_like(mask), photo, 4.0), 0)


def test_a_photo_without_edges_leaves_the_place_of_the_edge():
    _, _, mask = scene(4)
    flat = np.full((*mask.shape, 3), 0.5, np.float32)
    found = sharpened(mask, flat, 4.0)
    assert overlap(found > 0.5, mask > 0.4) > 0.9
