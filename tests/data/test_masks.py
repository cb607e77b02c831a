"""Masks that are too large or too small move to the edges in the photos; colors along an edge."""

import json
import logging

import numpy as np
import pytest
from command_line import run
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import ndimage

from humangs_jax.data.capture import capture_from_arrays, load_capture
from humangs_jax.data.masks import (
    CERTAIN,
    DEPTH,
    RIM_HEIGHT,
    STEP,
    box_of,
    clean_rims,
    masks_at_edges,
    person_box,
    signed_distance,
)
from humangs_jax.io.images import read_grey, read_image, write_png

HEIGHT, WIDTH = 240, 160
FOUND = 0.5
"""Largest error of a found size beyond the search's step, in pixels of a person 200 high."""
LEFT = 0.7
"""Largest mean distance between silhouettes, in the same pixels; measured up to 0.4.

The search has steps of 0.5. A silhouette with corners does not grow by a distance exactly.
"""


def fit_mask(photo, mask):
    return masks_at_edges([photo], [mask])[0]


def figure(scale=1):
    """Returns the coverage of two ellipses and a box, 200 pixels high at scale 1."""
    fine = 4
    y, x = (np.mgrid[: HEIGHT * scale * fine, : WIDTH * scale * fine] + 0.5) / fine / scale
    parts = [
        ((x - 80) / 18) ** 2 + ((y - 42) / 22) ** 2 < 1,
        ((x - 80) / 42) ** 2 + ((y - 120) / 62) ** 2 < 1,
    ]
    whole = parts[0] | parts[1] | ((abs(x - 80) < 24) & (y > 120) & (y < 220))
    return (
        whole.reshape(HEIGHT * scale, fine, WIDTH * scale, fine)
        .mean(axis=(1, 3))
        .astype(np.float32)
    )


def photo_of(mask, seed=0, background=None):
    """Returns a photo of a striped person in front of blurred noise."""
    rng = np.random.default_rng(seed)
    size = (*mask.shape, 3)
    if background is None:
        noise = ndimage.gaussian_filter(rng.normal(size=size), (3, 3, 0))
        background = np.clip(0.35 + 0.1 * noise / noise.std(), 0, 1)
    stripes = 0.75 + 0.15 * np.sign(np.sin(np.arange(mask.shape[0]) / 5))[
        :, None, None
    ] * np.asarray([1, 0.3, -0.5])
    return (mask[..., None] * stripes + (1 - mask[..., None]) * background).astype(np.float32)


def grown(mask, pixels):
    """Returns the mask with its silhouette moved outwards by `pixels`."""
    return np.clip(signed_distance(mask) + pixels + 0.5, 0, 1).astype(np.float32)


@settings(max_examples=12, deadline=None)
# below, what is found may be under the least that is moved
@given(st.floats(1.3, 3.5), st.booleans(), st.integers(0, 1000))
def test_a_boundary_that_is_off_is_moved_back(pixels, larger, seed):
    mask = figure()
    wrong = grown(mask, pixels if larger else -pixels)
    fitted, excess = fit_mask(photo_of(mask, seed), wrong)
    assert abs(excess - (pixels if larger else -pixels)) < FOUND
    assert np.abs(fitted - mask).sum() < LEFT * np.abs(wrong - mask).sum() / pixels
    assert fitted.min() >= 0 and fitted.max() <= 1 and fitted.dtype == mask.dtype


def test_larger_photos_have_larger_errors():
    scale = 2
    mask = figure(scale)
    wrong = grown(mask, 3.0 * scale)
    fitted, excess = fit_mask(photo_of(mask), wrong)
    assert abs(excess - 3.0 * scale) < FOUND * scale
    assert np.abs(fitted - mask).sum() < LEFT * np.abs(wrong - mask).sum() / 3


def test_parts_are_moved_by_their_own_error():
    mask = figure()
    wrong = np.where(np.arange(HEIGHT)[:, None] < 150, grown(mask, 3.5), grown(mask, 2.0))
    fitted, excess = fit_mask(photo_of(mask), wrong)
    assert excess > 0
    assert np.abs(fitted - mask).sum() < LEFT * np.abs(wrong - mask).sum() / 3


def test_one_side_alone_stays():
    """A side that is too large looks like one whose rim has the wall's color."""
    mask = figure()
    wrong = np.where(np.arange(HEIGHT)[:, None] < 120, grown(mask, 3.0), mask)
    fitted, excess = fit_mask(photo_of(mask), wrong)
    assert fitted is wrong and excess == 0


@pytest.fixture(scope="module")
def person():
    """Returns (colors without background, masks) of the demo's person in four views."""
    capture = load_capture("demo_capture").resized(256)
    masks = capture.masks
    return np.clip(1 + (capture.images - 1) / np.maximum(masks[..., None], 1e-3), 0, 1), masks


WALL = np.asarray([0.85, 0.83, 0.8])


def before_a_wall(colors, masks, rim=0.0, color=WALL, where=True):
    """Returns photos before a noisy wall, with a stripe along the silhouette, `rim` pixels wide."""
    photos = []
    for i, (image, mask) in enumerate(zip(colors, masks, strict=True)):
        wall = WALL + 0.01 * np.random.default_rng(i).normal(size=image.shape)
        stripe = (np.clip(rim - signed_distance(mask) + 0.5, 0, 1) * where * (rim > 0))[..., None]
        lit = stripe * color + (1 - stripe) * image
        photos.append(
            (np.rint(255 * (mask[..., None] * lit + (1 - mask[..., None]) * wall)) / 255).astype(
                np.float32
            )
        )
    return photos


@pytest.mark.parametrize("rim", [2.0, 4.0])
@pytest.mark.parametrize("kind", ["rim light", "piping", "on one side"])
def test_exact_masks_stay_where_the_rim_looks_like_the_wall(person, kind, rim):
    """A stripe of the wall's color is no sign that the mask is too large: the fingers show that."""
    colors, masks = person
    side = np.arange(masks.shape[2]) < np.median(np.nonzero(masks > 0.5)[2])
    how = {"rim light": {"color": 0.97}, "piping": {}, "on one side": {"where": side}}[kind]
    fitted = masks_at_edges(before_a_wall(colors, masks, rim, **how), list(masks))
    assert [excess for _, excess in fitted] == [0] * len(masks)
    np.testing.assert_array_equal([found for found, _ in fitted], masks)


@pytest.mark.parametrize("pixels", [-3.0, 2.0])
def test_masks_of_the_same_person_that_are_off_are_moved(person, pixels):
    colors, masks = person
    wrong = [grown(mask, pixels) for mask in masks]
    fitted = masks_at_edges(before_a_wall(colors, masks), wrong)
    for (found, excess), own, mask in zip(fitted, wrong, masks, strict=True):
        assert abs(excess - pixels) < FOUND + STEP
        assert np.abs(found - mask).sum() < 0.4 * np.abs(own - mask).sum()  # measured 0.1 to 0.25


def test_a_mask_that_most_views_contradict_stays():
    """In one view a rim may look like the wall; masks that are off are off in most views."""
    mask = figure()
    photos = [photo_of(mask, seed) for seed in range(4)]
    for wrong, moved in (({3}, 0), ({1, 3}, 2), ({0, 1, 2, 3}, 4)):
        masks = [grown(mask, 3.0) if view in wrong else mask for view in range(4)]
        assert sum(excess > 0 for _, excess in masks_at_edges(photos, masks)) == moved


def test_an_exact_mask_stays():
    mask = figure()
    for pixels in (0.0, 0.3, -0.3):
        given_mask = grown(mask, pixels) if pixels else mask
        fitted, excess = fit_mask(photo_of(mask), given_mask)
        assert fitted is given_mask and excess == 0


def test_nothing_is_found_where_nothing_can_be():
    mask = figure()
    wrong = grown(mask, 2.0)
    for photo, own in (
        (photo_of(mask, background=1.0), grown(mask, -2.0)),  # on white already
        (photo_of(mask), np.zeros_like(mask)),
        (photo_of(mask), np.ones_like(mask)),
        (photo_of(mask)[:1], np.eye(1, WIDTH, dtype=np.float32)),
    ):
        fitted, excess = fit_mask(photo, own)
        assert fitted is own and excess == 0
    flat = np.full((*mask.shape, 3), 0.5, np.float32)
    fitted, _ = fit_mask(flat, wrong)
    assert np.isfinite(fitted).all() and fitted.min() >= 0 and fitted.max() <= 1


def test_a_person_cut_at_the_frame_and_one_of_few_pixels():
    mask = figure()
    cut = slice(60, 200), slice(50, 110)
    fitted, excess = fit_mask(photo_of(mask)[cut], grown(mask, 3.0)[cut])
    assert excess > 0
    assert np.abs(fitted - mask[cut]).sum() < np.abs(grown(mask, 3.0)[cut] - mask[cut]).sum()
    for rows in (1, 2, 5):
        small = np.zeros((20, 20), np.float32)
        small[8 : 8 + rows, 8:11] = 1
        fitted, _ = fit_mask(photo_of(small), small)
        assert np.isfinite(fitted).all()


def test_boxes_of_a_mask_and_of_the_person_in_it():
    inside = np.zeros((40, 30), bool)
    assert not box_of(inside).any() and not person_box(inside).any()
    inside[5:35, 10:20] = True
    inside[36:39, 21] = True  # a foot, seen apart: 3 pixels of 300
    assert box_of(inside).tolist() == person_box(inside).tolist() == [[5, 39], [10, 22]]
    inside[0, 29] = True
    assert box_of(inside).tolist() == [[0, 39], [10, 30]]
    assert person_box(inside).tolist() == [[5, 39], [10, 22]]
    assert person_box(np.eye(7, dtype=bool)).tolist() == [[0, 7], [0, 7]]  # diagonals hang together
    assert person_box(np.ones((1, 1), bool)).tolist() == [[0, 1], [0, 1]]


@pytest.fixture
def folder(tmp_path):
    """Returns (folder of a capture of a photo whose mask is three pixels too large, true mask)."""
    mask = figure()
    place = tmp_path / "me"
    place.mkdir()
    write_png(place / "photo.png", photo_of(mask))
    write_png(place / "mask.png", grown(mask, 3.0))
    K, pose = [[200, 0, 80], [0, 200, 120], [0, 0, 1]], np.eye(4).tolist()
    view = {"image": "photo.png", "mask": "mask.png", "K": K, "cam_from_world": pose}
    description = {"format": "humangs-capture", "version": 1, "body": "body.npz", "views": [view]}
    (place / "capture.json").write_text(json.dumps(description))
    arrays = {
        "betas": np.zeros(10),
        "rotations": np.zeros((1, 55, 3)),
        "translations": np.asarray([[0, 0, 3.0]]),
    }
    np.savez(place / "body.npz", body="makehuman", **arrays)
    return place, mask


def test_captures_are_read_as_they_are_unless_asked(folder, caplog):
    place, mask = folder
    with caplog.at_level(logging.WARNING):
        plain = load_capture(place)
    assert not caplog.records
    np.testing.assert_allclose(plain.masks[0], grown(mask, 3.0), atol=0.5 / 255)
    with caplog.at_level(logging.WARNING):
        fitted = load_capture(place, fit_masks=True)
    assert "1 of 1 masks were off, the median 3." in caplog.text and "too large" in caplog.text
    assert np.abs(fitted.masks[0] - mask).sum() < LEFT * np.abs(plain.masks[0] - mask).sum() / 3
    np.testing.assert_array_equal(fitted.images[0][fitted.masks[0] == 0], 1)
    photo, wrong = read_image(place / "photo.png")[0], read_grey(place / "mask.png")
    arrays = (
        photo[None],
        fitted.cameras.K,
        fitted.cameras.cam_from_world,
        np.zeros((1, 55, 3)),
        np.zeros((1, 3)),
    )
    same = capture_from_arrays(*arrays, masks=wrong[None], fit_masks=True)
    np.testing.assert_array_equal(same.masks, fitted.masks)
    np.testing.assert_array_equal(same.images, fitted.images)


def test_masks_of_photos_on_white_are_never_moved(folder, caplog):
    place, mask = folder
    description = json.loads((place / "capture.json").read_text())
    (place / "capture.json").write_text(json.dumps(description | {"background": "white"}))
    with caplog.at_level(logging.WARNING):
        capture = load_capture(place, fit_masks=True)
    assert not caplog.records
    np.testing.assert_allclose(capture.masks[0], grown(mask, 3.0), atol=0.5 / 255)


@pytest.mark.parametrize(("option", "moved"), [((), True), (("--no-fit-masks",), False)])
def test_reconstruct_moves_masks_unless_asked_not_to(
    option, moved, folder, caplog, monkeypatch, capsys
):
    place, _ = folder
    # ends when the capture was read: these are no weights
    ends = "--weights", place / "body.npz", "--out", place / "avatar.npz"
    with caplog.at_level(logging.WARNING):
        code, _, err = run(monkeypatch, capsys, "reconstruct", place, "--no-check", *ends, *option)
    assert code == 1 and "body.npz" in err
    assert ("masks were off" in caplog.text) == moved


# Rims
# --------------------------------------------------------------------------------------------------

SKIN, ROOM = np.asarray([0.8, 0.5, 0.4], np.float32), np.asarray([0.1, 0.2, 0.9], np.float32)
ROUNDING = 1e-5
"""Rounding of float32 sums over the kernel."""


def disc(size: int, radius: float, soft: float) -> np.ndarray:
    """Returns the coverage of a disc whose edge is `soft` pixels wide."""
    y, x = np.mgrid[:size, :size] - (size - 1) / 2
    return np.clip((radius - np.hypot(x, y)) / soft + 0.5, 0, 1).astype(np.float32)


def mixed(coverage: np.ndarray) -> np.ndarray:
    """Returns the colors of skin before the room."""
    return SKIN * coverage[..., None] + ROOM * (1 - coverage[..., None])


def test_the_rim_shows_the_person_alone():
    mask = disc(500, 0.5 * RIM_HEIGHT, 3)
    photo = mixed(mask)
    cleaned, mixture = clean_rims(photo, mask), 1 - mask
    seen = (mask > 0.05) & (mixture > CERTAIN)
    np.testing.assert_allclose(
        cleaned[seen], np.broadcast_to(SKIN, photo.shape)[seen], atol=ROUNDING
    )
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


def test_without_an_edge_or_an_inside_the_photo_stays():
    photo = np.random.default_rng(0).random((500, 500, 3)).astype(np.float32)
    thin = np.zeros((500, 500), np.float32)
    thin[30:470, 250:252] = 1  # thinner than the rim
    for mask in (thin, 0 * thin, np.ones_like(thin)):
        np.testing.assert_array_equal(clean_rims(photo, mask), photo)


def test_the_border_of_the_photo_is_no_edge_of_the_person():
    photo = np.random.default_rng(0).random((RIM_HEIGHT, 300, 3)).astype(np.float32)
    mask = np.zeros((RIM_HEIGHT, 300), np.float32)
    mask[:, 100:200] = 1
    changed = np.abs(clean_rims(photo, mask) - photo).max(-1) > 0
    assert not changed[:, 110:190].any()
    assert changed[:, 100].any()
