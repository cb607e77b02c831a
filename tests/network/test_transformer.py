import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from network_cases import random_like

from humangs_jax.network.runtime import Runtime
from humangs_jax.network.transformer import Transformer, TransformerConfig

CONFIG = TransformerConfig(width=16, layers=6, head_width=8)
network = functools.partial(Transformer, runtime=Runtime())
TOLERANCE = 1e-5
"""The same sums in another order, over six layers."""
TOKENS = jnp.asarray(np.random.default_rng(0).normal(size=(11, 16)), jnp.float32)
VARIABLES = random_like(jax.eval_shape(network(CONFIG).init, jax.random.key(0), TOKENS))


def loss(variables, runtime):
    outputs = Transformer(CONFIG, runtime).apply(variables, TOKENS, jnp.asarray(9))
    return sum(jnp.sum(jnp.sin(k * x)) for k, x in enumerate(outputs, 1)), outputs


value_and_grad = jax.jit(jax.value_and_grad(loss, has_aux=True), static_argnames="runtime")


@pytest.mark.slow
@pytest.mark.parametrize("how", [{"scan": True}, {"remat": "dots"}, {"scan": True, "remat": "full"}], ids=str)
def test_blocks_may_be_looped_over_and_recomputed(how):
    runtime = Runtime(**how)
    shapes = jax.eval_shape(Transformer(CONFIG, runtime).init, jax.random.key(0), TOKENS)
    assert jax.tree.structure(shapes) == jax.tree.structure(VARIABLES)
    ours, reference = (jax.tree.leaves(value_and_grad(VARIABLES, x)) for x in (runtime, Runtime()))
    for a, b in zip(ours, reference, strict=True):
        assert np.allclose(a, b, rtol=TOLERANCE, atol=TOLERANCE * max(1, np.abs(b).max()))


@pytest.mark.slow
def test_outputs_are_those_of_the_quarters():
    """A network that is cut off after a quarter gives the raw output of that quarter."""
    outputs = network(CONFIG).apply(VARIABLES, TOKENS)
    assert len(outputs) == 4
    blocks = lambda n: {k: v for k, v in VARIABLES["params"].items() if k in {f"block_{i}" for i in range(n)}}
    rest = {k: VARIABLES["params"][k] for k in ("input_norm", "norm")}
    short = network(dataclasses.replace(CONFIG, layers=4))
    quarters = short.apply({"params": {**blocks(4), **rest}}, TOKENS)  # 1, 2, 3, 4 of 6: here 1, 3, 4, 6
    assert np.allclose(outputs[0], quarters[0], atol=TOLERANCE) and np.allclose(outputs[1], quarters[2], atol=TOLERANCE)
    normed = (outputs[2] - outputs[2].mean(-1, keepdims=True)) / jnp.sqrt(outputs[2].var(-1, keepdims=True) + 1e-5)
    expected = normed * rest["norm"]["scale"] + rest["norm"]["bias"]
    assert np.allclose(quarters[3], expected, atol=10 * TOLERANCE)
