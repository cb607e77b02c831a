"""SSIM against scikit-image, and properties of the loss that is made of it."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rounding import bound
from skimage.metrics import structural_similarity

from humangs_jax.losses.losses import (
    GAUSSIAN,
    blur,
    halve,
    multiscale_structural_dissimilarity,
    similarity_map,
    structural_dissimilarity,
)

FLOAT32_SSIM = 3e-5
"""Rounding of SSIM in float32.

A variance is the difference of two numbers of up to 1, each rounded a few times (2e-7), beside C2 =
9e-4. That is 8e-4 at a pixel of a bright flat region, of either sign, and less in the mean of
thousands.
"""
WINDOW = GAUSSIAN.size


def ssim(predicted, target):
    """Returns scikit-image's SSIM."""
    return structural_similarity(
        predicted, target, win_size=WINDOW, gaussian_weights=True, data_range=1, channel_axis=-1
    )


def pair(seed, height=40, width=33, noise=0.1):
    generator = np.random.default_rng(seed)
    target = np.clip(
        np.kron(generator.random((height // 8 + 1, width // 8 + 1, 3)), np.ones((8, 8, 1))), 0, 1
    )
    target = target[:height, :width]
    target[: height // 3] = 1.0  # white background, where float32 variances are hardest
    predicted = np.clip(target + noise * generator.standard_normal(target.shape), 0, 1)
    return predicted, target


@given(st.integers(0, 10_000), st.sampled_from([0.0, 1e-3, 0.1, 0.5]))
@settings(deadline=None, max_examples=10)
def test_agrees_with_skimage(seed, noise):
    predicted, target = (x.astype(np.float32) for x in pair(seed, noise=noise))
    ours = jnp.mean(similarity_map(jnp.asarray(predicted), jnp.asarray(target)))
    assert abs(float(ours) - ssim(predicted.astype(np.float64), target.astype(np.float64))) < bound(
        FLOAT32_SSIM
    )


def test_blur_has_the_gradient_of_its_definition():
    generator = np.random.default_rng(0)
    x, y = generator.random((2, 14, 17, 2)), generator.random((2, 4, 7, 2))
    with jax.enable_x64(True):
        blurred, transpose = jax.vjp(blur, jnp.asarray(x))
        (back,) = transpose(jnp.asarray(y))
    # <Ax, y> = <x, A^T y> of some hundred numbers
    assert abs(np.vdot(blurred, y) - np.vdot(x, back)) < 1e-10


def test_equal_images_have_no_dissimilarity_and_no_gradient():
    _, target = pair(1)
    target = jnp.asarray(target, jnp.float32)
    loss = lambda image: jnp.mean(structural_dissimilarity(image, target))
    value, gradient = jax.value_and_grad(loss)(target)
    assert abs(float(value)) < bound(FLOAT32_SSIM)
    assert float(jnp.max(jnp.abs(gradient))) < bound(FLOAT32_SSIM)


def test_scales_are_averaged_and_halved_by_boxes():
    predicted, target = (jnp.asarray(x, jnp.float32) for x in pair(4))
    np.testing.assert_allclose(
        halve(predicted)[2, 3], predicted[4:6, 6:8].mean(axis=(0, 1)), rtol=1e-6
    )
    scales = [
        structural_dissimilarity(predicted, target),
        structural_dissimilarity(halve(predicted), halve(target)),
    ]
    expected = np.mean([float(jnp.mean(x)) for x in scales])
    assert abs(float(multiscale_structural_dissimilarity(predicted, target, 2)) - expected) < bound(
        FLOAT32_SSIM
    )


def test_an_image_below_the_window_is_refused():
    with pytest.raises(ValueError, match="no 11 x 11 window"):
        similarity_map(jnp.zeros((10, 40, 3)), jnp.zeros((10, 40, 3)))
