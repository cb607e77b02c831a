"""Losses and metrics against numbers that were computed by hand."""

import jax.numpy as jnp
import numpy as np
import pytest
from rounding import bound

from humangs_jax.losses.losses import (
    BOUNDARY,
    FAR_SURFACE,
    LARGEST_PSNR,
    boundary_band,
    masked_psnr,
    psnr,
    semi_transparent,
    silhouette_iou,
    squared_error,
    surface_distance,
    tightness,
    translucency,
)

SIDE = 256
FLOAT32 = 1e-6
SQUARES = 1e-8  # rounding of squares of 0.1, of which small differences are taken
DECIBELS = 1e-3  # logarithm of a float32 mean


def test_squared_error_is_a_map():
    errors = squared_error(jnp.asarray([[0.5, 1.0]]), jnp.asarray([[0.0, 0.25]]))
    np.testing.assert_allclose(errors, [[0.25, 0.5625]], rtol=FLOAT32)


def test_tightness_is_the_squared_norm_per_vertex():
    offsets = jnp.asarray([[[3.0, 4.0, 0.0]], [[0.0, 0.0, 0.0]], [[0.1, 0.2, 0.2]]])
    np.testing.assert_allclose(tightness(offsets), [25.0, 0.0, 0.09], rtol=FLOAT32)


def test_tightness_averages_the_tight_gaussians_of_a_vertex():
    offsets = jnp.asarray([[[1.0, 0.0, 0.0], [0.0, 0.0, 2.0]]])
    np.testing.assert_allclose(tightness(offsets), [2.5], rtol=FLOAT32)


def test_psnr_of_a_known_error_and_of_equal_images():
    target = jnp.full((8, 8, 3), 0.5)
    assert abs(float(psnr(target + 0.1, target)) - 20) < bound(DECIBELS)
    assert abs(float(psnr(target, target)) - LARGEST_PSNR) < bound(DECIBELS)


def test_psnr_clips_the_prediction_and_nothing_else():
    white = jnp.ones((4, 4, 3))
    assert float(psnr(white + 5.0, white)) == float(psnr(white, white))


def test_masked_psnr_looks_at_the_mask_alone():
    target = jnp.full((8, 8, 3), 0.5)
    mask = jnp.zeros((8, 8)).at[:4].set(1.0)
    predicted = target.at[4:].set(0.0).at[:4].add(0.01)
    assert abs(float(masked_psnr(predicted, target, mask)) - 40) < bound(DECIBELS)
    assert float(masked_psnr(predicted, target, jnp.zeros((8, 8)))) == LARGEST_PSNR


def test_silhouettes_are_compared_at_a_half():
    mask = np.zeros((4, 6), np.float32)
    mask[:, :3] = 0.6
    alpha = np.roll(mask, 1, axis=1) + 0.4 * (mask == 0)
    assert float(silhouette_iou(jnp.asarray(alpha), jnp.asarray(mask))) == pytest.approx(2 / 4)
    assert float(silhouette_iou(jnp.zeros((4, 6)), jnp.zeros((4, 6)))) == 1


def test_without_tight_gaussians_there_is_no_tightness():
    np.testing.assert_array_equal(tightness(jnp.zeros((4, 0, 3))), np.zeros(4))


def test_surfaces_are_compared_where_both_are_the_persons():
    rows = [[2.05, 2.05, 2.05, 5.0, 2.05], [1, 0, 0.5, 1, 1], [2, 2, 2, 2, 0], [1, 1, 0, 1, 1]]
    distance = surface_distance(*jnp.asarray(rows))
    # a depth of 0 is unknown
    np.testing.assert_allclose(distance, [0.05, 0, 0, FAR_SURFACE, 0], atol=FLOAT32)


def test_translucency_vanishes_for_opacities_of_0_and_1():
    np.testing.assert_allclose(translucency(jnp.asarray([0.0, 0.5, 1.0])), [0, 1, 0])


def test_fog_is_the_share_of_the_mask_that_is_neither_clear_nor_opaque():
    alpha, mask = jnp.asarray([[0.0, 0.5, 1.0, 0.5]]), jnp.asarray([[1.0, 1.0, 1.0, 0.0]])
    assert float(semi_transparent(alpha, mask)) == pytest.approx(1 / 3)
    assert float(semi_transparent(alpha, 0 * mask)) == 0


def test_only_the_band_along_the_boundary_counts():
    inside = np.zeros((SIDE, SIDE), bool)
    inside[64:192, 64:192] = True
    truth = np.zeros((SIDE, SIDE, 3))
    middle, corner, edge = truth.copy(), truth.copy(), truth.copy()
    middle[100:150, 100:150] = 1
    corner[:20, :20] = 1
    edge[66, 100:110] = 0.5  # the third pixel inside
    found = lambda image: masked_psnr(*map(jnp.asarray, (image, truth, boundary_band(inside))))
    assert found(middle) == found(corner) == LARGEST_PSNR
    width = round(BOUNDARY * SIDE)
    band = 4 * 128 * 2 * width  # but for the corners, outside rounded and inside shared
    expected = -10 * np.log10(10 * 0.25 / band)
    assert found(edge) == pytest.approx(expected, abs=0.1)
