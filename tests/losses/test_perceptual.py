"""The perceptual loss against the project's golden numbers (golden perceptual_a) and torch's (torch_losses.py)."""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from loss_cases import convolutions_of, image_pair
from rounding import bound

from humangs_jax.losses.backbones import Convolution
from humangs_jax.losses.perceptual import DIVISORS, Vgg19, perceptual_errors, perceptual_loss

DATA = Path(__file__).parent / "data"
FLOAT32 = 2e-6  # relative; sums of some thousand products, 14 times over
FLOAT64 = 1e-12
STORED = 1e-7  # the gradients are stored as float32
EQUAL = 1e-6  # a compiler may round the two ways through the network differently
BFLOAT16 = 0.03  # relative; features keep 8 bits


@jax.jit
def with_gradient(vgg, predicted, target):
    """(loss, errors), gradient."""
    loss = lambda image: (perceptual_loss(vgg, image, target), perceptual_errors(vgg, image, target))
    return jax.value_and_grad(loss, has_aux=True)(predicted)


def vgg19(dtype="float32"):
    return Vgg19({name: Convolution(*map(jnp.asarray, x)) for name, x in convolutions_of("vgg19", dtype).items()})


@pytest.fixture(scope="module")
def vgg():
    return vgg19()


def pair(height=37, width=32, dtype=jnp.float32):
    return tuple(jnp.asarray(x, dtype) for x in image_pair(height, width))


def test_the_golden_numbers(vgg):
    golden = np.load(DATA / "perceptual_a.npz")
    images = [jnp.asarray(golden[name].transpose(0, 2, 3, 1)) for name in ("predicted", "target")]
    batched = lambda *images: jax.vmap(lambda *x: (perceptual_errors(vgg, *x), perceptual_loss(vgg, *x)))(*images)
    errors, losses = jax.jit(batched)(*images)
    np.testing.assert_allclose(errors.mean(axis=0), golden["errors"], rtol=FLOAT32)
    np.testing.assert_allclose(losses.mean(), golden["total"], rtol=FLOAT32)
    alone = jax.jit(perceptual_loss)(vgg, images[0][1], images[1][1])
    np.testing.assert_allclose(losses[1], alone, rtol=FLOAT32)


@pytest.mark.slow
@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_the_numbers_and_gradients_of_torch(dtype):
    expected = np.load(DATA / "torch_losses.npz")
    numbers, slopes = (FLOAT32, FLOAT32) if dtype == "float32" else (FLOAT64, STORED)
    with jax.enable_x64(dtype == "float64"):
        (value, errors), gradient = with_gradient(vgg19(dtype), *pair(dtype=dtype))
    assert value.dtype == dtype and gradient.dtype == dtype
    np.testing.assert_allclose(np.asarray(errors) / DIVISORS / 255, expected["perceptual_parts"], rtol=numbers)
    np.testing.assert_allclose(value, expected["perceptual_parts"].sum(), rtol=numbers)
    error = np.linalg.norm(np.asarray(gradient) - expected["perceptual_gradient"])
    assert error < slopes * np.linalg.norm(expected["perceptual_gradient"])


@pytest.mark.slow
def test_equal_images_have_no_loss_and_a_finite_gradient(vgg):
    image, _ = pair()
    for x in (image, jnp.ones_like(image), jnp.zeros_like(image)):
        (value, _), gradient = with_gradient(vgg, x, x)
        assert value < bound(EQUAL) and np.isfinite(gradient).all()


def test_no_gradient_reaches_the_target(vgg):
    predicted, target = pair()
    assert not jax.jit(jax.grad(perceptual_loss, 2))(vgg, predicted, target).any()


@pytest.mark.slow
def test_weights_in_bfloat16(vgg):
    narrow = jax.tree.map(lambda x: x.astype(jnp.bfloat16), vgg)
    value = jax.jit(perceptual_loss)(narrow, *pair())
    assert value.dtype == jnp.float32
    np.testing.assert_allclose(value, with_gradient(vgg, *pair())[0][0], rtol=BFLOAT16)


def test_a_small_image_is_refused(vgg):
    with pytest.raises(ValueError, match="an image of 15 x 16 is too small for this network: 16 pixels a side"):
        perceptual_loss(vgg, jnp.zeros((16, 15, 3)), jnp.zeros((16, 15, 3)))
