"""Losses of frozen networks with made-up weights, against torch (torch_losses.py).

Some properties hold for any weights.
"""

import itertools
from pathlib import Path

import jax
import jax.numpy as jnp
import loss_cases
import numpy as np
import pytest
from loss_cases import convolutions_of, image_pair, made_up_heads
from rounding import bound

from experiments.training import random_weights
from humangs_jax.losses import perceptual
from humangs_jax.losses.losses import _each_lpips
from humangs_jax.losses.perceptual import (
    BACKBONES,
    DIVISORS,
    VGG19,
    Conv,
    Convolution,
    Lpips,
    Pool,
    Vgg19,
    convolutions,
    feature_maps,
    lpips,
    lpips_distances,
    perceptual_errors,
    perceptual_loss,
    vgg16_loss,
)

DATA = Path(__file__).parent / "data"
TABLES = {"vgg19": VGG19, **BACKBONES}
SMALLEST = {"vgg19": 16, "vgg": 16, "alex": 31, "squeeze": 25}
CHANNELS = {**loss_cases.HEADS, "vgg19": loss_cases.HEADS["vgg"]}
SIZES = {"vgg19": (37, 32), "vgg": (37, 32), "alex": (37, 43), "squeeze": (40, 33)}
# relative; sums of some thousand products, a dozen times over, and differences of unit vectors
FLOAT32 = 1e-5
GRADIENT = 3e-5
"""Relative L2 error of gradients in float32.

A sum of n terms of either sign, added in order, rounds by u sqrt(n) / 2.4 of itself: 1.7e-6 for the
9 x 512 of VGG's widest layers. Thirteen layers forward and backward give 9e-6 in quadrature, and
differences of unit vectors triple it. With AVX-512, whose vectors shorten the sums, 4e-6 was
measured.
"""
FLOAT64 = 1e-12
STORED = 1e-7  # the gradients are stored as float32
BFLOAT16 = 0.05  # relative; features keep 8 bits
EQUAL = 1e-6  # a compiler may round the two ways through the network differently
NAMES = pytest.mark.parametrize("name", TABLES)


@NAMES
def test_tables_list_torchvisions_layers(name):
    ours = [
        (layer.name, layer.inputs, layer.outputs, layer.size)
        for layer in perceptual.convolutions(TABLES[name])
    ]
    assert ours == loss_cases.BACKBONES[name]
    assert perceptual.channels(TABLES[name]) == CHANNELS[name]


@NAMES
def test_the_smallest_image(name):
    least = SMALLEST[name]
    assert perceptual.smallest_side(TABLES[name]) == least
    weights = jax.eval_shape(lambda key: random_weights(key, TABLES[name]), jax.random.key(0))

    def maps(*size):
        return jax.eval_shape(
            lambda x, w: feature_maps(w, TABLES[name], x), jnp.zeros((*size, 3)), weights
        )

    assert all(min(x.shape) >= 1 for x, _ in maps(least, least))
    for size in ((least - 1, 64), (64, least - 1)):
        with pytest.raises(
            ValueError,
            match=rf"{size[1]} x {size[0]} is too small for this network: {least} pixels",
        ):
            maps(*size)


def pooled(layer, x):
    """Returns a layer's result for x (h, w, 3) > 0, behind a convolution that changes nothing."""
    identity = {"0": Convolution(jnp.eye(3)[None, None], jnp.zeros(3))}
    return feature_maps(identity, ((Conv("0", 3, 3, 1, 1, 0), layer),), x)[0][0]


POOLS = [Pool(2, 2, True), Pool(2, 2), Pool(), Pool(ceil=True)]


@pytest.mark.slow
@pytest.mark.parametrize("layer", POOLS)
@pytest.mark.parametrize("size", [(7, 8), (9, 6), (5, 3)])
def test_pools_against_their_definition(layer, size):
    x = np.random.default_rng(0).random((*size, 3)).astype(np.float32)
    reduce = np.mean if layer.average else np.max

    def starts(side):
        return range(0, side - (1 if layer.ceil else layer.size - 1), 2)

    window = lambda i, j: reduce(x[i : i + layer.size, j : j + layer.size], axis=(0, 1))
    expected = [[window(i, j) for j in starts(size[1])] for i in starts(size[0])]
    np.testing.assert_allclose(pooled(layer, jnp.asarray(x)), expected, rtol=1e-6)


@pytest.mark.slow
def test_of_equal_maxima_the_first_has_the_gradient():
    image = jnp.asarray([[1.0, 2.0, 3.0, 3.0], [2.0, 2.0, 3.0, 3.0]])[..., None] * jnp.ones(3)
    gradient = jax.grad(lambda x: pooled(Pool(2, 2), x).sum())(image)
    assert np.array_equal(gradient[..., 0], [[0, 1, 1, 0], [0, 0, 0, 0]])


@pytest.mark.slow
@pytest.mark.parametrize("layer", POOLS)
@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_what_is_not_finite_stays_so(layer, bad):
    for i, j in itertools.product(range(4), repeat=2):
        assert not np.isfinite(pooled(layer, jnp.ones((5, 5, 3)).at[i, j].set(bad))).all()


def made_up(name, dtype="float32"):
    layers = {
        layer: Convolution(*map(jnp.asarray, x))
        for layer, x in convolutions_of(name, dtype).items()
    }
    if name == "vgg19":
        return Vgg19(layers)
    return Lpips(
        layers, tuple(jnp.asarray(head[0, :, 0, 0], dtype) for head in made_up_heads(name)), name
    )


def pair(name, dtype="float32"):
    return tuple(jnp.asarray(x, dtype) for x in image_pair(*SIZES[name]))


@jax.jit
def with_gradient(weights, predicted, target):
    """Returns ((loss, its parts), gradient)."""

    def loss(image):
        if isinstance(weights, Lpips):
            return lpips(weights, image, target), lpips_distances(weights, image, target)
        errors = perceptual_errors(weights, image, target)
        return perceptual_loss(weights, image, target), errors / jnp.asarray(
            DIVISORS, errors.dtype
        ) / 255

    return jax.value_and_grad(loss, has_aux=True)(predicted)


slow = lambda *case: pytest.param(*case, marks=pytest.mark.slow)


@pytest.mark.parametrize(
    ("name", "dtype"),
    [
        ("alex", "float64"),
        *(
            slow(name, dtype)
            for dtype in ("float32", "float64")
            for name in TABLES
            if name != "alex"
        ),
    ],
)
def test_the_numbers_and_gradients_of_torch(name, dtype):
    stored, kind = np.load(DATA / "torch_losses.npz"), "perceptual" if name == "vgg19" else name
    numbers, slopes = (FLOAT32, bound(GRADIENT)) if dtype == "float32" else (FLOAT64, STORED)
    with jax.enable_x64(dtype == "float64"):
        (value, parts), gradient = with_gradient(made_up(name, dtype), *pair(name, dtype))
    assert value.dtype == dtype and gradient.dtype == dtype
    np.testing.assert_allclose(parts, stored[f"{kind}_parts"], rtol=numbers)
    np.testing.assert_allclose(value, stored[f"{kind}_parts"].sum(), rtol=numbers)
    expected = stored[f"{kind}_gradient"]
    assert np.linalg.norm(np.asarray(gradient) - expected) < slopes * np.linalg.norm(expected)


@pytest.mark.slow
def test_the_golden_numbers():
    """The numbers are the project's golden perceptual_a."""
    golden, vgg = np.load(DATA / "perceptual_a.npz"), made_up("vgg19")
    images = [jnp.asarray(golden[name].transpose(0, 2, 3, 1)) for name in ("predicted", "target")]

    def batched(*images):
        return jax.vmap(lambda *x: (perceptual_errors(vgg, *x), perceptual_loss(vgg, *x)))(*images)

    errors, losses = jax.jit(batched)(*images)
    np.testing.assert_allclose(errors.mean(axis=0), golden["errors"], rtol=FLOAT32)
    np.testing.assert_allclose(losses.mean(), golden["total"], rtol=FLOAT32)


@pytest.mark.slow
def test_the_loss_of_vgg16_against_its_definition():
    """The expected convolutions and pools are in numpy, float64."""
    predicted, target = image_pair(16, 19)
    shift, scale = np.asarray([-0.030, -0.088, -0.188]), np.asarray([0.458, 0.448, 0.450])
    ends, features = ("2", "7", "14", "21", "28"), []
    for image in (predicted, target):
        x, found = (2 * image - 1 - shift) / scale, []
        for name, (kernel, bias) in convolutions_of("vgg", np.float64).items():
            windows = np.lib.stride_tricks.sliding_window_view(
                np.pad(x, ((1, 1), (1, 1), (0, 0))), (3, 3), axis=(0, 1)
            )
            x = np.maximum(np.tensordot(windows, kernel, ((3, 4, 2), (0, 1, 2))) + bias, 0)
            if name in ends:
                found.append(x)
                rows, columns = x.shape[0] // 2, x.shape[1] // 2  # 0 after the last one
                x = (
                    x[: 2 * rows, : 2 * columns]
                    .reshape(rows, 2, columns, 2, x.shape[2])
                    .max(axis=(1, 3), initial=0)
                )
        features.append(found)
    expected = np.mean([np.abs(x - y).mean() / y.mean() for x, y in zip(*features, strict=True)])
    images = [jnp.asarray(x, jnp.float32) for x in (predicted, target)]
    loss = jax.jit(vgg16_loss)
    assert float(loss(made_up("vgg"), *images)) == pytest.approx(expected, rel=bound(FLOAT32))
    assert float(loss(made_up("vgg"), images[0], images[0])) == 0
    with pytest.raises(ValueError, match="expected LPIPS vgg, got alex"):
        vgg16_loss(made_up("alex"), *images)


@pytest.mark.slow
@NAMES
def test_equal_images_have_no_loss_and_a_finite_gradient(name):
    weights, (image, _) = made_up(name), pair(name)
    for x in (image, jnp.ones_like(image), jnp.zeros_like(image)):
        (value, _), gradient = with_gradient(weights, x, x)
        assert value < bound(EQUAL) and np.isfinite(gradient).all()
        # squares, which have no kink
        assert name == "vgg19" or np.abs(gradient).max() < bound(EQUAL)


def test_no_gradient_reaches_the_target_of_the_perceptual_loss():
    assert not jax.jit(jax.grad(perceptual_loss, 2))(made_up("vgg19"), *pair("vgg19")).any()


@pytest.mark.slow
def test_where_all_features_are_zero_gradients_are_finite():
    """The length of a zero vector has no gradient; the original gives NaN there."""
    weights = made_up("alex")
    dead = {name: Convolution(x.kernel, x.bias - 1e4) for name, x in weights.backbone.items()}
    images = pair("alex")
    (value, _), gradient = with_gradient(Lpips(dead, weights.heads, "alex"), *images)
    assert value == 0 and not gradient.any()
    mixed = dead | {"0": weights.backbone["0"]}
    (value, _), gradient = with_gradient(Lpips(mixed, weights.heads, "alex"), *images)
    assert value > 0 and np.isfinite(gradient).all()


@pytest.mark.slow
@pytest.mark.parametrize("name", ["vgg19", "alex"])
def test_weights_in_bfloat16(name):
    weights, images = made_up(name), pair(name)
    (value, _), gradient = with_gradient(
        jax.tree.map(lambda x: x.astype(jnp.bfloat16), weights), *images
    )
    assert value.dtype == jnp.float32 and np.isfinite(gradient).all()
    np.testing.assert_allclose(value, with_gradient(weights, *images)[0][0], rtol=BFLOAT16)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["alex", "vgg"])
def test_lpips_of_views_is_that_of_each_and_reads_the_truth_once(name):
    """Value and gradient are those of `lpips`; the truth takes one pass and the image two."""
    weights = made_up(name)
    pairs = [image_pair(*SIZES[name], seed) for seed in (0, 1)]
    shown, truth = (jnp.stack([pair[i] for pair in pairs]) for i in (0, 1))
    of_views = lambda shown: jnp.sum(_each_lpips(weights, shown, truth))
    one_by_one = lambda shown: sum(lpips(weights, *each) for each in zip(shown, truth, strict=True))
    found, expected = (jax.jit(jax.value_and_grad(each))(shown) for each in (of_views, one_by_one))
    np.testing.assert_allclose(found[0], expected[0], rtol=1e-5)
    scale = np.abs(expected[1]).max()
    np.testing.assert_allclose(found[1], expected[1], atol=1e-4 * scale)
    text = jax.jit(jax.grad(of_views)).lower(shown).as_text()
    layers = sum(1 for _ in convolutions(BACKBONES[name]))
    assert text.count("stablehlo.convolution") == 3 * layers
