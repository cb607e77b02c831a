"""Losses and metrics against numbers worked out by hand."""

import jax.numpy as jnp
import numpy as np
from rounding import bound

from humangs_jax.objectives.losses import squared_error, tightness
from humangs_jax.objectives.metrics import LARGEST_PSNR, masked_psnr, psnr, ssim

FLOAT32 = 1e-6
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


def test_ssim_of_the_clipped_prediction():
    target = np.random.default_rng(0).random((16, 16, 3))
    target[0] = 1.0
    assert ssim(np.where(target == 1.0, 3.0, target), target) == 1.0


def test_without_tight_gaussians_there_is_no_tightness():
    np.testing.assert_array_equal(tightness(jnp.zeros((4, 0, 3))), np.zeros(4))
