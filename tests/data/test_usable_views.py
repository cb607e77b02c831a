"""Views whose mask does not show the person are left out by name, wherever photos are read."""

import dataclasses
import logging

import jax.numpy as jnp
import numpy as np
import pytest

from humangs_jax.apps.settings import Settings
from humangs_jax.core.pytree import replace
from humangs_jax.data.capture_checks import CaptureError
from humangs_jax.data.usable_views import _sampling, shares_on_masks, usable_views
from humangs_jax.data.views import select_views, standardize
from humangs_jax.refinement.photos import crop_to_person


def with_mask(capture, view, mask):
    masks = capture.masks.copy()
    masks[view] = mask
    return dataclasses.replace(capture, masks=masks)


def elsewhere(mask):
    """A spot in the corner, where the body is not."""
    spot = np.zeros_like(mask)
    spot[:40, :40] = 1
    return spot


SPOILED = {
    "empty": (lambda mask: 0 * mask, "the mask is empty"),
    "faint": (lambda mask: 0.4 * mask, "the mask is empty"),
    "inverted": (lambda mask: 1 - mask, "hardly meet"),
    "a spot elsewhere": (elsewhere, "hardly meet"),
}


def head(mask):
    """The top eighth of the person."""
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
        left = usable_views(capture)
    assert left.names == tuple(np.delete(demo.names, 1))
    (record,) = caplog.records
    assert f"1 of 4 views is left out: {demo.names[1]}: " in record.getMessage() and reason in record.getMessage()


@pytest.mark.parametrize("mask", [*KEPT, None])
def test_other_masks_are_kept(demo, mask):
    capture = dataclasses.replace(demo, masks=None) if mask is None else with_mask(demo, 1, KEPT[mask](demo.masks[1]))
    assert usable_views(capture) is capture


def test_exact_masks_hold_the_body(demo):
    assert min(shares_on_masks(demo)) > 0.95


def test_points_are_spread_by_the_area_of_the_skin():
    vertices, corners = np.zeros((6, 3)), np.asarray([[0, 1, 2], [3, 4, 5]])
    vertices[[1, 2, 4, 5], [0, 1, 0, 1]], vertices[3:, 2] = [3, 3, 1, 1], 1.0  # areas 9 : 1
    found, weights = _sampling(vertices, corners, 1000)
    assert np.mean(found[:, 0] == 0) == pytest.approx(0.9, abs=0.01)
    points = np.einsum("pc,pcx->px", weights, vertices[found])[found[:, 0] == 0]
    np.testing.assert_allclose(points.mean(axis=0), [1, 1, 0], atol=0.1)  # the centroid


def test_a_body_that_is_out_of_the_frame_meets_no_mask(demo):
    poses = replace(demo.poses, translation=demo.poses.translation + jnp.asarray([50.0, 0, 0]))
    with pytest.raises(CaptureError, match=r"no view is left that shows the person: .*hardly meet"):
        usable_views(dataclasses.replace(demo, poses=poses))


def test_all_that_reads_photos_leaves_it_out(demo):
    capture, usable = with_mask(demo, 1, 0), [0, 2, 3]
    expected = demo.select(usable)
    assert select_views(capture, 3) == select_views(capture, 9) == usable
    assert Settings().photos(capture).names == Settings(views=9).photos(capture).names == expected.names
    for views in (standardize(capture, 64), standardize(capture, 64, crop=True), crop_to_person(capture)):
        assert len(views.images) == 3
    np.testing.assert_array_equal(standardize(capture, 64).images, standardize(expected, 64).images)
    np.testing.assert_array_equal(crop_to_person(capture).images, crop_to_person(expected).images)


def test_no_view_left_is_an_error_that_names_them(demo):
    nobody = dataclasses.replace(demo, masks=0 * demo.masks)
    for read in (usable_views, lambda c: select_views(c, 2), lambda c: standardize(c, 64), crop_to_person):
        with pytest.raises(CaptureError, match=f"capture: masks: no view is left .*{demo.names[0]}.*: the mask is empty"):
            read(nobody)
