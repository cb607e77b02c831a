"""Photos of one person in equal exposure."""

import dataclasses
import itertools

import numpy as np
import pytest

from humangs_jax.data.exposure import EXPECTED, camera_gains, equal_exposure, exposures, gains_of, multiplied, with_gains

SHRINKING = 0.1
"""Share of a gain that the prior keeps back where many points are shared."""
POINTS = 4000


def skin(rng, count=4, noise=0.05):
    """Colors of common points in photos of equal exposure."""
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
    np.testing.assert_array_equal(gains_of(skin(rng) * np.asarray([0.7, 1, 1, 1.3])[:, None, None], apart), 1)


def test_photos_with_nothing_in_common_are_not_moved_against_each_other():
    """Two pairs of cameras on two sides: each pair agrees, and the pairs keep their means."""
    rng = np.random.default_rng(3)
    logs = np.repeat([[0.3], [0.1], [-0.1], [-0.3]], 3, axis=1)
    seen = (np.arange(POINTS) < POINTS // 2) == np.asarray([True, True, False, False])[:, None]
    found = np.log(gains_of(skin(rng) * np.exp(-logs)[:, None], seen))
    np.testing.assert_allclose(found[:2] - found[:2].mean(0), [[0.1] * 3, [-0.1] * 3], atol=SHRINKING * 0.2)
    np.testing.assert_allclose(found[:2].mean(0), 0, atol=1e-3 * EXPECTED + 1e-9)


def test_outliers_do_not_count():
    rng = np.random.default_rng(4)
    colors, logs = skin(rng), centred(np.repeat([[0.2], [0.0], [0.0], [-0.2]], 3, axis=1))
    colors[1, : POINTS // 5] *= 0.4  # a shadow
    found = np.log(gains_of(colors * np.exp(-logs)[:, None], np.ones((4, POINTS), bool)))
    np.testing.assert_allclose(found, logs, atol=2 * SHRINKING * 0.2)


def test_a_synthetic_capture_stays_as_it_is(demo):
    assert equal_exposure(demo) is demo


def test_a_capture_in_different_exposures_is_made_equal_once(demo):
    logs = centred(np.asarray([[0.15, 0.1, 0.1], [-0.15, -0.1, -0.2], [0.1, 0.2, 0.15], [-0.1, -0.2, -0.15]]))
    changed = with_gains(demo, np.exp(-logs))
    gains = camera_gains(changed)
    left, before = (np.sqrt(np.mean(np.square(x))) for x in (np.log(gains) - logs, logs))
    assert left < 0.6 * before
    np.testing.assert_allclose(exposures(changed) * gains, 1, rtol=1e-12)
    equal = equal_exposure(changed)
    assert equal_exposure(equal) is equal
    outside = demo.masks == 0
    np.testing.assert_array_equal(equal.images[outside], 1)
    # what a camera would have shown: the gains undone
    back = multiplied(equal.images, equal.masks, 1 / gains)
    unclipped = (equal.images < 1).all(-1) & (demo.masks > 0)
    np.testing.assert_allclose(back[unclipped], changed.images[unclipped], atol=1e-5)


def test_without_masks_nothing_is_changed(demo):
    bare = dataclasses.replace(demo, masks=None)
    assert equal_exposure(bare) is bare
    np.testing.assert_array_equal(exposures(bare), 1)
    nobody = dataclasses.replace(demo, masks=np.zeros_like(demo.masks))
    np.testing.assert_array_equal(exposures(nobody), 1)
    with pytest.raises(ValueError, match="masks"):
        with_gains(bare, np.ones((demo.view_count, 3)))
