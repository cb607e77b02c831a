"""Photos are checked before use: views without the person go, few of many are chosen.

Chosen photos get equal exposure.
"""

import dataclasses
import itertools
import logging

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from humangs_jax.apps.settings import Settings
from humangs_jax.body.resolution import decimate, vertex_areas
from humangs_jax.core.pytree import replace
from humangs_jax.data import prepared
from humangs_jax.data import view_choice as module
from humangs_jax.data.body_and_masks import views_without_person
from humangs_jax.data.capture_checks import CaptureError
from humangs_jax.data.exposure import (
    EXPECTED,
    apply_gain,
    equalize_exposure,
    exposure_gains,
    gains_of,
)
from humangs_jax.data.prepared import prepare_capture
from humangs_jax.data.view_choice import best_views, greedy_cover
from humangs_jax.data.views import to_network_views
from humangs_jax.refinement.photos import crop_to_person


def with_mask(capture, view, mask):
    masks = capture.masks.copy()
    masks[view] = mask
    return dataclasses.replace(capture, masks=masks)


def elsewhere(mask):
    """Returns a mask of a spot in the corner, far from the body."""
    spot = np.zeros_like(mask)
    spot[:40, :40] = 1
    return spot


SPOILED = {
    "empty": (lambda mask: 0 * mask, "the mask is empty"),
    "faint": (lambda mask: 0.4 * mask, "the mask is empty"),
    "inverted": (lambda mask: 1 - mask, "hardly meet: is the mask inverted?"),
    "a spot elsewhere": (elsewhere, "hardly meet ("),
}


def head(mask):
    """Returns the mask's top eighth."""
    rows = np.flatnonzero((mask > 0.5).any(axis=1))
    return mask * (np.arange(len(mask)) < rows[0] + len(rows) // 8)[:, None]


KEPT = {
    "the head alone": head,
    "half of the person": lambda mask: mask * (np.arange(len(mask)) < 256)[:, None],
    "all of the photo": np.ones_like,
    "soft": lambda mask: 0.6 * mask,
}


@pytest.mark.parametrize("spoiled", SPOILED)
def test_a_spoiled_mask_leaves_its_view_out_by_name(demo, spoiled, caplog):
    change, reason = SPOILED[spoiled]
    capture = with_mask(demo, 1, change(demo.masks[1]))
    with caplog.at_level(logging.WARNING):
        left = prepare_capture(capture).capture
    assert left.names == tuple(np.delete(demo.names, 1))
    (record,) = caplog.records
    assert (
        f"1 of 4 views is left out: {demo.names[1]}: " in record.getMessage()
        and reason in record.getMessage()
    )


@pytest.mark.parametrize("mask", [*KEPT, None])
def test_other_masks_are_kept(demo, mask):
    if mask is None:
        capture = dataclasses.replace(demo, masks=None)
    else:
        capture = with_mask(demo, 1, KEPT[mask](demo.masks[1]))
    assert not views_without_person(capture)


def test_a_body_that_is_out_of_the_frame_meets_no_mask(demo):
    poses = replace(demo.poses, translation=demo.poses.translation + jnp.asarray([50.0, 0, 0]))
    with pytest.raises(CaptureError, match=r"no view is left that shows the person: .*hardly meet"):
        prepare_capture(dataclasses.replace(demo, poses=poses))


def test_all_that_reads_photos_leaves_it_out(demo):
    capture, usable = with_mask(demo, 1, 0), [0, 2, 3]
    expected = demo.select(usable)
    assert (
        Settings().photos(capture).capture.names
        == Settings(views=9).photos(capture).capture.names
        == expected.names
    )
    left, all_shown = prepare_capture(capture), prepare_capture(expected)
    assert left.capture.names == expected.names
    assert left.left_out == {demo.names[1]: "the mask is empty"} and not all_shown.left_out
    cropped, wanted = crop_to_person(left), crop_to_person(all_shown)
    np.testing.assert_array_equal(cropped.images, wanted.images)


def test_no_view_left_is_an_error_that_names_them(demo):
    nobody = dataclasses.replace(demo, masks=0 * demo.masks)
    for read in (prepare_capture, lambda c: prepare_capture(c, views=2)):
        with pytest.raises(
            CaptureError,
            match=f"capture: masks: no view is left .*{demo.names[0]}.*: the mask is empty",
        ):
            read(nobody)


# Which photos of many to use
# -------------------------------------------------------------------------------------------

GUARANTEE = 1 - 1 / np.e
"""Least share of the best gain that a greedy choice reaches (monotone submodular functions)."""


def covered(quality, rows):
    return quality[list(rows)].max(axis=0).sum()


@given(arrays(float, (6, 5), elements=st.floats(0, 1)), st.integers(1, 4))
def test_the_greedy_choice_keeps_its_guarantee(quality, count):
    chosen = greedy_cover(quality, count)
    assert len(set(chosen)) == count
    best = max(covered(quality, rows) for rows in itertools.combinations(range(6), count))
    assert covered(quality, chosen) >= GUARANTEE * best - 1e-9


@pytest.mark.slow
def test_repeated_photos_are_left_out(demo):
    """Three of four photos are the same: two different ones show more."""
    doubled = demo.select([0, 0, 2, 0])
    chosen = best_views(doubled, 2)
    assert 2 in chosen and len(set(chosen)) == 2


def test_a_photo_without_the_person_is_not_chosen(demo):
    views = demo.select(range(4))
    empty = views.masks.copy()
    empty[1] = 0
    empty[1, :8, :8] = 1  # an empty mask would be no mask
    chosen = prepare_capture(dataclasses.replace(views, masks=empty), views=3)
    assert chosen.capture.names == tuple(np.delete(demo.names, 1))


def test_few_photos_are_all_taken_and_none_is_refused(demo):
    assert best_views(demo.select(range(3)), 5) == [0, 1, 2]
    with pytest.raises(ValueError, match="at least 1 photo, got 0"):
        best_views(demo, 0)


def test_without_a_number_what_adds_nothing_is_left_out(demo):
    """Photos from four sides each add something, and their copies do not."""
    assert best_views(demo, None) == [0, 1, 2, 3]
    assert len(best_views(demo.select([0, 2, 0, 2]), None)) == 2


@given(arrays(float, (6, 5), elements=st.floats(0, 1)), st.floats(0, 1))
def test_the_choice_ends_where_the_gain_does(quality, least):
    chosen = greedy_cover(quality, 6, least)
    sums = [covered(quality, chosen[: i + 1]) for i in range(len(chosen))]
    assert all(later >= (1 + least) * earlier for earlier, later in itertools.pairwise(sums))
    rest = [covered(quality, [*chosen, row]) for row in range(6) if row not in chosen]
    assert all(more < (1 + least) * sums[-1] for more in rest)


def test_a_photo_from_farther_away_is_worth_less_by_its_pixels_per_metre(demo):
    doubled, away = demo.select([0, 0, 2, 2]), 1.5
    matrices = np.array(doubled.cameras.cam_from_world)
    matrices[::2, 2, 3] += away
    capture = dataclasses.replace(
        doubled, cameras=replace(doubled.cameras, cam_from_world=jnp.asarray(matrices))
    )
    body = decimate(capture.body, module.SELECTION_VERTICES)
    quality = np.asarray(
        module.view_quality(body, to_network_views(capture, module.SELECTION_SIZE))
    )
    for far, near in ((0, 1), (2, 3)):
        both = (quality[far] > 0) & (quality[near] > 0)
        distance = matrices[near, 2, 3]
        # the rays of the nearer camera spread more, by some degrees
        assert np.median(quality[far, both] / quality[near, both]) == pytest.approx(
            distance / (distance + away), rel=0.1
        )


def test_surface_counts_and_not_the_number_of_vertices(demo, monkeypatch):
    """One photo shows the 60 % of the vertices with the smallest areas; the other one shows more
    skin.
    """

    def quality(body, views):
        area = vertex_areas(np.asarray(body.template), np.asarray(body.faces))
        small = area <= np.quantile(area, 0.6)
        assert area[small].sum() < area[~small].sum()
        return np.stack([small, ~small]).astype(float)

    monkeypatch.setattr(module, "view_quality", quality)
    assert best_views(demo.select([0, 1]), 1) == [1]


# Equal exposure
# --------------------------------------------------------------------------------------------------

SHRINKING = 0.1
"""Largest share of a gain that the prior removes where many points are shared."""
POINTS = 4000


def skin(rng, count=4, noise=0.05):
    """Returns colors of common points in photos of equal exposure."""
    own = rng.uniform(0.2, 0.7, (1, POINTS, 3))
    return own * np.exp(noise * rng.normal(size=(count, POINTS, 3)))


def centred(logs):
    return logs - logs.mean(0)


def test_known_gains_are_recovered():
    rng = np.random.default_rng(0)
    logs = centred(0.15 * rng.normal(size=(4, 3)))
    found = np.log(gains_of(skin(rng) * np.exp(-logs)[:, None], np.ones((4, POINTS), bool)))
    np.testing.assert_allclose(found, logs, atol=SHRINKING * np.abs(logs).max())
    np.testing.assert_allclose(found.mean(0), 0, atol=1e-12)


def test_fewer_points_give_gains_nearer_to_one():
    noise = 0.1 * (np.arange(POINTS) % 3 - 1)[:, None]
    colors = 0.4 * np.exp(np.stack([noise - 0.2, 0 * noise + 0.2]).repeat(3, axis=-1))
    enough = [np.arange(POINTS) < points * np.ones((2, 1)) for points in (4000, 1000, 300, 100, 20)]
    sizes = [np.abs(np.log(gains_of(colors, seen))).max() for seen in enough]
    assert sizes[-1] == 0
    assert all(fewer < more for more, fewer in itertools.pairwise(sizes))


def test_gains_are_exactly_one_without_disagreement_or_without_common_points():
    rng = np.random.default_rng(2)
    np.testing.assert_array_equal(gains_of(skin(rng, noise=0.3), np.ones((4, POINTS), bool)), 1)
    apart = np.arange(POINTS) * 4 // POINTS == np.arange(4)[:, None]
    np.testing.assert_array_equal(
        gains_of(skin(rng) * np.asarray([0.7, 1, 1, 1.3])[:, None, None], apart), 1
    )


def test_photos_with_nothing_in_common_are_not_moved_against_each_other():
    """Two pairs of cameras stand on two sides: each pair is made equal, and their means stay."""
    rng = np.random.default_rng(3)
    logs = np.repeat([[0.3], [0.1], [-0.1], [-0.3]], 3, axis=1)
    seen = (np.arange(POINTS) < POINTS // 2) == np.asarray([True, True, False, False])[:, None]
    found = np.log(gains_of(skin(rng) * np.exp(-logs)[:, None], seen))
    np.testing.assert_allclose(
        found[:2] - found[:2].mean(0), [[0.1] * 3, [-0.1] * 3], atol=SHRINKING * 0.2
    )
    np.testing.assert_allclose(found[:2].mean(0), 0, atol=1e-3 * EXPECTED + 1e-9)


def test_outliers_do_not_count():
    rng = np.random.default_rng(4)
    colors, logs = skin(rng), centred(np.repeat([[0.2], [0.0], [0.0], [-0.2]], 3, axis=1))
    colors[1, : POINTS // 5] *= 0.4  # a shadow
    found = np.log(gains_of(colors * np.exp(-logs)[:, None], np.ones((4, POINTS), bool)))
    np.testing.assert_allclose(found, logs, atol=2 * SHRINKING * 0.2)


def test_a_synthetic_capture_stays_as_it_is(demo):
    equal = equalize_exposure(demo)
    assert equal.images is demo.images
    np.testing.assert_array_equal(equal.gains, 1)


def exposed(capture, logs):
    """Returns the capture as if each camera had chosen its exposure."""
    return dataclasses.replace(
        capture, images=apply_gain(capture.images, capture.masks, np.exp(-logs))
    )


def test_a_capture_in_different_exposures_is_made_equal(demo):
    logs = centred(
        np.asarray([[0.15, 0.1, 0.1], [-0.15, -0.1, -0.2], [0.1, 0.2, 0.15], [-0.1, -0.2, -0.15]])
    )
    changed = exposed(demo, logs)
    gains = equalize_exposure(changed).gains
    left, before = (np.sqrt(np.mean(np.square(x))) for x in (np.log(gains) - logs, logs))
    assert left < 0.6 * before
    np.testing.assert_allclose(exposure_gains(changed) * gains, 1, rtol=1e-12)
    equal = equalize_exposure(changed)
    outside = demo.masks == 0
    np.testing.assert_array_equal(equal.images[outside], 1)
    # what a camera would have shown: the gains undone
    back = apply_gain(equal.images, equal.masks, 1 / gains)
    unclipped = (equal.images < 1).all(-1) & (demo.masks > 0)
    np.testing.assert_allclose(back[unclipped], changed.images[unclipped], atol=1e-5)


@given(
    logs=arrays(float, (4, 3), elements=st.floats(-0.7, 0.7)),
    views=st.lists(st.integers(0, 3), min_size=1, max_size=4, unique=True),
)
@settings(max_examples=4)
def test_gains_are_found_once_for_a_capture_whatever_its_exposure_gains(demo, logs, views):
    """Photos that are already equal, subsets and smaller photos get no further gains."""
    equal = equalize_exposure(exposed(demo, logs))
    assert equalize_exposure(equal) is equal
    some = equal.select(views)
    assert equalize_exposure(some) is some
    assert equalize_exposure(some.resized(64)).gains is some.gains
    np.testing.assert_array_equal(exposure_gains(some), 1 / equal.gains[views])


def test_without_masks_nothing_is_changed(demo):
    bare = dataclasses.replace(demo, masks=None)
    assert equalize_exposure(bare) is bare
    np.testing.assert_array_equal(exposure_gains(bare), 1)
    nobody = dataclasses.replace(demo, masks=np.zeros_like(demo.masks))
    np.testing.assert_array_equal(exposure_gains(nobody), 1)


def test_a_number_of_views_that_is_another_word_is_refused(demo):
    with pytest.raises(ValueError, match="'autos': expected a number from 1"):
        prepare_capture(demo, views="autos")


def test_photos_that_are_all_kept_are_not_called_chosen(demo, monkeypatch):
    monkeypatch.setattr(prepared, "best_views", lambda capture, count: [0, 1, 2, 3])
    assert not prepare_capture(demo, views="auto").chosen
    monkeypatch.setattr(prepared, "best_views", lambda capture, count: [0, 2])
    assert prepare_capture(demo, views="auto").chosen
