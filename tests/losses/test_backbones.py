import itertools

import jax
import jax.numpy as jnp
import loss_cases
import numpy as np
import pytest

from experiments.training.cases import random_weights
from humangs_jax.losses import backbones, lpips, perceptual
from humangs_jax.losses.backbones import Conv, Convolution, Pool, feature_maps

TABLES = {"vgg19": perceptual.VGG19, **lpips.BACKBONES}
SMALLEST = {"vgg19": 16, "vgg": 16, "alex": 31, "squeeze": 25}
CHANNELS = {**loss_cases.HEADS, "vgg19": loss_cases.HEADS["vgg"]}


@pytest.mark.parametrize("name", TABLES)
def test_tables_list_torchvisions_layers(name):
    ours = [(layer.name, layer.inputs, layer.outputs, layer.size) for layer in backbones.convolutions(TABLES[name])]
    assert ours == loss_cases.BACKBONES[name]
    assert backbones.channels(TABLES[name]) == CHANNELS[name]


@pytest.mark.parametrize("name", TABLES)
def test_the_smallest_image(name):
    least = SMALLEST[name]
    assert backbones.smallest_side(TABLES[name]) == least
    weights = jax.eval_shape(lambda key: random_weights(key, TABLES[name]), jax.random.key(0))
    maps = lambda *size: jax.eval_shape(lambda x, w: feature_maps(w, TABLES[name], x), jnp.zeros((*size, 3)), weights)
    assert all(min(x.shape) >= 1 for x, _ in maps(least, least))
    for size in ((least - 1, 64), (64, least - 1)):
        with pytest.raises(ValueError, match=f"too small for this network: {least} pixels"):
            maps(*size)


def pooled(layer, x):
    """What a layer makes of x (h, w, 3), all above zero, behind a convolution that does nothing."""
    identity = {"0": Convolution(jnp.eye(3)[None, None], jnp.zeros(3))}
    return feature_maps(identity, ((Conv("0", 3, 3, 1, 1, 0), layer),), x)[0][0]


@pytest.mark.slow
@pytest.mark.parametrize("layer", [Pool(2, 2, True), Pool(2, 2), Pool(), Pool(ceil=True)])
@pytest.mark.parametrize("size", [(7, 8), (9, 6), (5, 3)])
def test_pools_against_their_definition(layer, size):
    x = np.random.default_rng(0).random((*size, 3)).astype(np.float32)
    reduce = np.mean if layer.average else np.max
    starts = lambda side: range(0, side - (1 if layer.ceil else layer.size - 1), 2)  # a window may stick out by one
    expected = [
        [reduce(x[i : i + layer.size, j : j + layer.size], axis=(0, 1)) for j in starts(size[1])]
        for i in starts(size[0])
    ]
    np.testing.assert_allclose(pooled(layer, jnp.asarray(x)), expected, rtol=1e-6)


@pytest.mark.slow
def test_of_equal_maxima_the_first_has_the_gradient():
    image = jnp.asarray([[1.0, 2.0, 3.0, 3.0], [2.0, 2.0, 3.0, 3.0]])[..., None] * jnp.ones(3)
    gradient = jax.grad(lambda x: pooled(Pool(2, 2), x).sum())(image)
    assert np.array_equal(gradient[..., 0], [[0, 1, 1, 0], [0, 0, 0, 0]])


@pytest.mark.slow
@pytest.mark.parametrize("layer", [Pool(2, 2, True), Pool(2, 2), Pool(), Pool(ceil=True)])
@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_what_is_not_finite_stays_so(layer, bad):
    for i, j in itertools.product(range(4), repeat=2):
        assert not np.isfinite(pooled(layer, jnp.ones((5, 5, 3)).at[i, j].set(bad))).all()
