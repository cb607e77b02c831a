"""LPIPS on made-up weights against torch (torch_losses.py): values, gradients, and what must hold for any weights."""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from loss_cases import convolutions_of, image_pair, made_up_heads
from rounding import bound

from humangs_jax.losses.backbones import Convolution
from humangs_jax.losses.lpips import BACKBONES, Lpips, lpips, lpips_distances

DATA = Path(__file__).parent / "data"
SIZES = {"vgg": (37, 32), "alex": (37, 43), "squeeze": (40, 33)}
FLOAT32 = 1e-5  # relative; sums of some thousand products, a dozen times over, and differences of unit vectors
GRADIENT = 3e-5
"""Relative L2 in float32. A sum of n terms of either sign, one after the other, rounds by u sqrt(n) / 2.4 of itself: 1.7e-6 for
the 9 x 512 of VGG's widest layers. Thirteen layers forward and backward: 9e-6 in quadrature; differences of unit vectors
triple it. Measured with AVX-512, whose vectors shorten the sums: 4e-6."""
FLOAT64 = 1e-12
STORED = 1e-7  # the gradients are stored as float32
BFLOAT16 = 0.05  # relative; features keep 8 bits
EQUAL = 1e-8  # a compiler may round the two ways through the network differently: squares of some 1e-7, times channels
NETS = pytest.mark.parametrize("net", BACKBONES)


def made_up(net, dtype="float32"):
    backbone = {name: Convolution(*map(jnp.asarray, x)) for name, x in convolutions_of(net, dtype).items()}
    return Lpips(backbone, tuple(jnp.asarray(head[0, :, 0, 0], dtype) for head in made_up_heads(net)), net)


def pair(net, dtype="float32"):
    return tuple(jnp.asarray(x, dtype) for x in image_pair(*SIZES[net]))


@jax.jit
def with_gradient(weights, predicted, target):
    """(distance, its parts) and the gradient."""

    def distance(image):
        parts = lpips_distances(weights, image, target)
        return parts.sum(), parts

    return jax.value_and_grad(distance, has_aux=True)(predicted)


def relative(found, expected):
    return np.linalg.norm(np.asarray(found) - expected) / np.linalg.norm(expected)


@pytest.mark.slow
@NETS
def test_the_numbers_and_gradients_of_torch(net):
    expected = np.load(DATA / "torch_losses.npz")
    (_, parts), gradient = with_gradient(made_up(net), *pair(net))
    assert gradient.dtype == jnp.float32
    np.testing.assert_allclose(parts, expected[f"{net}_parts"], rtol=FLOAT32)
    assert relative(gradient, expected[f"{net}_gradient"]) < bound(GRADIENT)


slow = lambda net: pytest.param(net, marks=pytest.mark.slow)


@pytest.mark.parametrize("net", ["alex", slow("vgg"), slow("squeeze")])
def test_the_numbers_of_torch_in_float64(net):
    expected = np.load(DATA / "torch_losses.npz")
    with jax.enable_x64(True):
        (_, parts), gradient = with_gradient(made_up(net, "float64"), *pair(net, "float64"))
    np.testing.assert_allclose(parts, expected[f"{net}_parts"], rtol=FLOAT64)
    assert gradient.dtype == np.float64 and relative(gradient, expected[f"{net}_gradient"]) < STORED


@pytest.mark.slow
@NETS
def test_equal_images_have_no_distance_and_no_gradient(net):
    weights, (image, _) = made_up(net), pair(net)
    for x in (image, jnp.ones_like(image), jnp.zeros_like(image)):
        (value, _), gradient = with_gradient(weights, x, x)
        assert value < bound(EQUAL) and np.abs(gradient).max() < bound(EQUAL)


@pytest.mark.slow
def test_a_batch_is_a_loop_and_order_does_not_matter():
    weights, (x, y) = made_up("squeeze"), pair("squeeze")
    batch = jax.jit(jax.vmap(lpips, (None, 0, 0)))(weights, jnp.stack([x, y]), jnp.stack([y, x]))
    (alone, _), _ = with_gradient(weights, x, y)
    np.testing.assert_allclose(batch, [alone, alone], rtol=FLOAT32)


@pytest.mark.slow
def test_where_all_features_are_zero_gradients_are_finite():
    """The length of a zero vector has no gradient: the original gives NaN there."""
    weights = made_up("alex")
    dead = {name: Convolution(x.kernel, x.bias - 1e4) for name, x in weights.backbone.items()}
    images = pair("alex")
    (value, _), gradient = with_gradient(Lpips(dead, weights.heads, "alex"), *images)
    assert value == 0 and not gradient.any()
    mixed = dead | {"0": weights.backbone["0"]}
    (value, _), gradient = with_gradient(Lpips(mixed, weights.heads, "alex"), *images)
    assert value > 0 and np.isfinite(gradient).all()


@pytest.mark.slow
def test_weights_in_bfloat16():
    weights, images = made_up("alex"), pair("alex")
    (value, _), gradient = with_gradient(jax.tree.map(lambda x: x.astype(jnp.bfloat16), weights), *images)
    assert value.dtype == jnp.float32 and np.isfinite(gradient).all()
    np.testing.assert_allclose(value, with_gradient(weights, *images)[0][0], rtol=BFLOAT16)


@NETS
def test_a_small_image_is_refused(net):
    with pytest.raises(ValueError, match="is too small for this network"):
        lpips(made_up(net), jnp.zeros((15, 64, 3)), jnp.zeros((15, 64, 3)))
