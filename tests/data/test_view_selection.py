"""Which photos of many to use."""

import dataclasses
import itertools

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from humangs_jax.body.resolution import decimate, vertex_areas
from humangs_jax.core.pytree import replace
from humangs_jax.data import views as module
from humangs_jax.data.views import greedy_cover, select_views, standardize

GUARANTEE = 1 - 1 / np.e
"""Of the greedy choice for a monotone submodular function."""


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
    """Of four photos, three of which are one, two different ones show more."""
    doubled = demo.select([0, 0, 2, 0])
    chosen = select_views(doubled, 2)
    assert 2 in chosen and len(set(chosen)) == 2


def test_a_photo_without_the_person_is_not_chosen(demo):
    views = demo.select(range(4))
    empty = views.masks.copy()
    empty[1] = 0
    empty[1, :8, :8] = 1  # an empty mask would be no mask
    chosen = select_views(dataclasses.replace(views, masks=empty), 3)
    assert chosen == [0, 2, 3]


def test_few_photos_are_all_taken_and_none_is_refused(demo):
    assert select_views(demo.select(range(3)), 5) == [0, 1, 2]
    with pytest.raises(ValueError, match="at least 1 photo, got 0"):
        select_views(demo, 0)


def test_without_a_number_what_adds_nothing_is_left_out(demo):
    """Photos from four sides add something each; their copies do not."""
    assert select_views(demo, None) == [0, 1, 2, 3]
    assert len(select_views(demo.select([0, 2, 0, 2]), None)) == 2


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
    capture = dataclasses.replace(doubled, cameras=replace(doubled.cameras, cam_from_world=jnp.asarray(matrices)))
    body = decimate(capture.body, module.SELECTION_VERTICES)
    quality = np.asarray(module.view_quality(body, standardize(capture, module.SELECTION_SIZE)))
    for far, near in ((0, 1), (2, 3)):
        both = (quality[far] > 0) & (quality[near] > 0)
        distance = matrices[near, 2, 3]
        # the rays of the nearer camera spread more, by some degrees
        assert np.median(quality[far, both] / quality[near, both]) == pytest.approx(distance / (distance + away), rel=0.1)


def test_surface_counts_and_not_the_number_of_vertices(demo, monkeypatch):
    """One photo shows the 60 % of the vertices with the smallest areas, the other one the others: more skin."""

    def quality(body, views):
        area = vertex_areas(np.asarray(body.template), np.asarray(body.faces))
        small = area <= np.quantile(area, 0.6)
        assert area[small].sum() < area[~small].sum()
        return np.stack([small, ~small]).astype(float)

    monkeypatch.setattr(module, "view_quality", quality)
    assert select_views(demo.select([0, 1]), 1) == [1]
