"""Convolutions: the definition, its gradients, and that a loop does not make them slow."""

import re

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from humangs_jax.network.convolution import Convolution, convolve

FLOAT64 = 1e-12
SHAPE, FEATURES = (2, 5, 7, 3), 4


def random(*shape):
    return jnp.asarray(np.random.default_rng(len(shape) + shape[0]).normal(size=shape))


def reference(x, kernel):
    padded = jnp.pad(x, ((0, 0), (1, 1), (1, 1), (0, 0)))
    height, width = x.shape[1:3]
    shifted = lambda a, b: padded[:, a : a + height, b : b + width] @ kernel[a, b]
    return sum(shifted(a, b) for a in range(3) for b in range(3))


@pytest.mark.slow
def test_it_is_the_sum_over_a_neighbourhood_with_its_gradients():
    with jax.enable_x64(True):
        x, kernel, weights = random(*SHAPE), random(3, 3, SHAPE[-1], FEATURES), random(*SHAPE[:3], FEATURES)
        for function in (convolve, jax.jit(convolve)):
            np.testing.assert_allclose(function(x, kernel), reference(x, kernel), rtol=FLOAT64, atol=FLOAT64)
            gradients = [
                jax.grad(lambda *a, f=f: jnp.sum(weights * f(*a)), (0, 1))(x, kernel) for f in (function, reference)
            ]
            jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=FLOAT64, atol=FLOAT64), *gradients)


def test_a_batch_of_maps():
    with jax.enable_x64(True):
        x, kernel = random(3, *SHAPE), random(3, 3, SHAPE[-1], FEATURES)
        loss = lambda f: lambda x, kernel: jnp.sum(jnp.sin(f(x, kernel)))
        gradient = lambda f: jax.vmap(jax.grad(loss(f), (0, 1)), (0, None))(x, kernel)
        close = lambda a, b: np.testing.assert_allclose(a, b, rtol=FLOAT64, atol=FLOAT64)
        jax.tree.map(close, gradient(convolve), gradient(reference))


def test_the_module_has_the_parameters_of_flax():
    x = random(*SHAPE).astype(jnp.float32)
    ours, theirs = Convolution(FEATURES, nn.initializers.ones), nn.Conv(FEATURES, (3, 3))
    variables = theirs.init(jax.random.key(0), x)
    assert jax.tree.structure(ours.init(jax.random.key(0), x)) == jax.tree.structure(variables)
    np.testing.assert_allclose(ours.apply(variables, x), theirs.apply(variables, x), rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("batch", [1, 2], ids=["unrolled", "looped"])
def test_in_a_loop_all_of_its_convolutions_are_those_that_the_library_knows(batch):
    """XLA leaves others to nested loops over single numbers."""

    def total_gradient(xs, kernel):
        add = lambda total, x: (total + jax.grad(lambda k: jnp.sum(jnp.sin(convolve(x, k))))(kernel), None)
        return jax.lax.scan(add, jnp.zeros_like(kernel), xs)[0]

    shapes = [jax.ShapeDtypeStruct(shape, jnp.float32) for shape in ((batch, 2, 8, 8, 16), (3, 3, 16, 16))]
    labels = re.findall(r"dim_labels=(\S+)", jax.jit(total_gradient).lower(*shapes).compile().as_text())
    assert labels and {label.rstrip(",") for label in labels} == {"b01f_01io->b01f"}
