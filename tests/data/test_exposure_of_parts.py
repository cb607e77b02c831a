"""Photos that share no point of the body get equal exposure and white balance."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from humangs_jax.body.library import load_body
from humangs_jax.data.exposure import (
    LEAST_OF_PART,
    LEAST_POINTS,
    PARTS,
    apply_gain,
    body_parts,
    equalize_exposure,
    gains_between,
    gains_of,
    linked_views,
    points_of,
)

POINTS = 200
"""Points of each part on each side of the person."""
ONE_MOMENT, OTHER_MOMENTS = np.zeros(4, int), np.arange(4)


def person(rng, sides=(0, 0, 1, 1), different=()):
    """Returns (colors, seen, parts) of the points of a person in four photos of two sides.

    The parts `different` have another color behind.
    """
    parts = np.tile(np.repeat(np.arange(len(PARTS)), POINTS), 2)
    side = np.repeat([0, 1], len(PARTS) * POINTS)
    paint = rng.uniform(0.25, 0.6, (2, len(PARTS), 3))
    others = [part for part in range(len(PARTS)) if part not in different]
    paint[1, others] = paint[0, others]
    own = paint[side, parts] * np.exp(0.05 * rng.normal(size=(len(side), 3)))
    seen = side == np.asarray(sides)[:, None]
    # how the light falls changes the brightness of a part, and hardly its tint
    shade = rng.normal(0, 0.15, (2, len(PARTS), 1)) + rng.normal(0, 0.015, (2, len(PARTS), 3))
    return own[None] * np.exp(shade)[side, parts] * np.ones((4, 1, 1)), seen, parts


def tints(logs):
    return logs - logs.mean(axis=-1, keepdims=True)


def difference(logs):
    """Returns the difference between the two sides."""
    return logs[:2].mean(axis=0) - logs[2:].mean(axis=0)


def between(colors, seen, parts, frames):
    return np.log(gains_between(colors, seen, parts, linked_views(colors, seen), frames))


@given(
    balance=st.lists(st.floats(-0.25, 0.25), min_size=3, max_size=3), seed=st.integers(0, 1 << 20)
)
def test_the_white_balance_of_front_against_back_is_found_from_the_parts(balance, seed):
    colors, seen, parts = person(np.random.default_rng(seed))
    logs = np.outer([1, 1, -1, -1], balance)
    found = between(colors * np.exp(-logs)[:, None], seen, parts, OTHER_MOMENTS)
    np.testing.assert_allclose(difference(tints(found)), difference(tints(logs)), atol=0.03)
    np.testing.assert_allclose(found.mean(axis=0), 0, atol=1e-9)
    np.testing.assert_array_equal(found[0], found[1])


def test_an_exposure_is_found_nearly_whole_from_the_parts():
    logs = np.outer([0.2, 0.2, -0.2, -0.2], np.ones(3))
    errors = []
    for seed in range(20):
        colors, seen, parts = person(np.random.default_rng(seed))
        found = between(colors * np.exp(-logs)[:, None], seen, parts, OTHER_MOMENTS)
        errors.append(difference(found - logs).mean())
    assert np.sqrt(np.mean(np.square(errors))) < 0.4 / 3
    assert abs(np.mean(errors)) < 0.05


def test_an_open_coat_does_not_count():
    """Chest, belly and neck have other colors behind; the other parts agree."""
    logs = np.outer([1, 1, -1, -1], [0.15, 0.0, -0.15])
    for seed in range(5):
        colors, seen, parts = person(np.random.default_rng(seed), different=(0, 1, 9))
        found = between(colors * np.exp(-logs)[:, None], seen, parts, OTHER_MOMENTS)
        np.testing.assert_allclose(difference(tints(found)), difference(tints(logs)), atol=0.04)


def test_photos_of_one_moment_and_one_light_stay_as_they_are():
    """Parts are brighter on one side because of the light."""
    for seed in range(20):
        np.testing.assert_array_equal(
            between(*person(np.random.default_rng(seed), different=(0,)), ONE_MOMENT), 0
        )


def test_photos_of_one_moment_by_cameras_of_other_white_balances_are_made_equal():
    colors, seen, parts = person(np.random.default_rng(0))
    logs = np.outer([1, 1, -1, -1], [0.1, 0.0, -0.1])
    found = between(colors * np.exp(-logs)[:, None], seen, parts, ONE_MOMENT)
    np.testing.assert_allclose(difference(tints(found)), difference(tints(logs)), atol=0.03)


def test_three_groups_are_made_equal_together():
    """The groups are a front, a back, and a detail that shows only two parts."""
    colors, seen, parts = person(np.random.default_rng(1), sides=(0, 1, 0, 1))
    logs = np.asarray([[0.2, 0, -0.2], [-0.2, 0, 0.2], [0.0, 0.1, -0.1], [0.1, -0.1, 0.0]])
    logs = logs - logs.mean(axis=0)
    groups = np.asarray([0, 1, 2, 3])
    seen &= np.isin(parts, (3, 4)) | (np.arange(4) < 2)[:, None]
    found = np.log(
        gains_between(colors * np.exp(-logs)[:, None], seen, parts, groups, OTHER_MOMENTS)
    )
    np.testing.assert_allclose(tints(found), tints(logs), atol=0.04)


def test_sides_that_show_no_common_part_and_bodies_of_unknown_parts_stay_as_they_are():
    colors, seen, parts = person(np.random.default_rng(2))
    colors[2:] *= [1.3, 1.0, 0.7]
    apart = seen & ((parts < 5) == (np.arange(4) < 2)[:, None])
    assert not between(colors, apart, parts, OTHER_MOMENTS).any()
    assert not between(colors, seen, np.full_like(parts, -1), OTHER_MOMENTS).any()
    few = np.arange(len(parts)) % POINTS < LEAST_OF_PART - 1
    groups = np.asarray([0, 0, 1, 1])
    found = gains_between(colors[[0, 2]], (seen & few)[[0, 2]], parts, groups[[0, 2]], np.arange(2))
    np.testing.assert_array_equal(found, 1)


def test_views_are_linked_by_common_points_or_by_way_of_others():
    starts = np.asarray([0, 100, 200, 1000])
    points = np.arange(2000)
    seen = (points >= starts[:, None]) & (points < starts[:, None] + 100 + LEAST_POINTS)
    colors = np.full((4, 2000, 3), 0.5)
    np.testing.assert_array_equal(linked_views(colors, seen), [0, 0, 0, 1])
    colors[1] = 0.01  # too dark to say anything
    assert len(set(linked_views(colors, seen))) == 4


def test_every_vertex_of_the_shipped_body_has_a_part_and_both_sides_the_same():
    body = load_body()
    parts = body_parts(body)
    assert set(parts) == set(range(len(PARTS)))
    x, z = np.asarray(body.template)[:, 0], np.asarray(body.template)[:, 2]
    for part in range(len(PARTS)):
        own = parts == part
        assert 0.4 < (x[own] > 0).mean() < 0.6
        assert np.ptp(np.sign(z[own] - np.median(z[own]))) == 2  # front and back


@pytest.fixture(scope="module")
def front_and_back(demo):
    """Returns two photos of the demo that share no point, each as a moment."""
    seen = points_of(demo)[1]
    shared = [(seen[0] & seen[other]).sum() for other in range(1, 4)]
    pair = demo.select([0, 1 + int(np.argmin(shared))])
    assert min(shared) < LEAST_POINTS
    twice = jax.tree.map(lambda leaf: jnp.repeat(leaf[:1], 2, axis=0), pair.poses)
    return dataclasses.replace(pair, frames=np.arange(2, dtype=np.int32), poses=twice)


@pytest.mark.parametrize("balance", [(0.15, 0.0, -0.15), (-0.1, 0.05, 0.12)])
def test_front_and_back_of_the_demo_on_two_days_get_one_color(front_and_back, balance):
    logs = np.stack([np.asarray(balance), -np.asarray(balance)])
    changed = dataclasses.replace(
        front_and_back,
        images=apply_gain(front_and_back.images, front_and_back.masks, np.exp(-logs)),
    )
    np.testing.assert_array_equal(gains_of(*points_of(changed)), 1)  # no common point
    gains = np.log(equalize_exposure(changed).gains)
    left, before = (tints(x[0] - x[1]) for x in (logs - gains, logs))
    assert np.linalg.norm(left) < np.linalg.norm(before) / 3


def test_photos_that_share_points_are_not_compared_by_parts(demo):
    np.testing.assert_array_equal(equalize_exposure(demo).gains, gains_of(*points_of(demo)))
