"""Attention, and the transformer's blocks."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads
from network_cases import random_like
from rounding import bound

from humangs_jax.network.runtime import Runtime
from humangs_jax.network.transformer import (
    Attention,
    Transformer,
    TransformerConfig,
    attention,
    chunked_attention,
    resolve_implementation,
)

FLOAT32_TOLERANCE = 2e-6
"""A dozen float32 roundings of averages of numbers of order one."""
LENGTH, HEADS, WIDTH = 13, 3, 4


def random_qkv(seed=0, length=LENGTH):
    return np.random.default_rng(seed).normal(size=(3, length, HEADS, WIDTH))


def oracle(q, k, v, count):
    """Returns attention in float64, for one head and query at a time."""
    out = np.zeros_like(q)
    for i in range(len(q)):
        for h in range(q.shape[1]):
            logits = k[:count, h] @ q[i, h] / np.sqrt(q.shape[2])
            weights = np.exp(logits - logits.max())
            out[i, h] = weights / weights.sum() @ v[:count, h]
    return out


@pytest.mark.slow
@pytest.mark.parametrize("count", [None, 5, LENGTH])
@pytest.mark.parametrize(
    ("implementation", "chunk"), [("xla", 1), ("chunked", 4), ("chunked", 13), ("chunked", 100)]
)
def test_agrees_with_the_definition(implementation, chunk, count):
    q, k, v = random_qkv()
    length = None if count is None else jnp.asarray(count)
    arrays = (jnp.asarray(x, jnp.float32) for x in (q, k, v))
    if implementation == "xla":
        ours = jax.jit(attention, static_argnums=4)(*arrays, length, "xla")
    else:
        ours = jax.jit(chunked_attention, static_argnums=4)(*arrays, length, chunk)
    assert np.abs(ours - oracle(q, k, v, count)).max() < bound(FLOAT32_TOLERANCE)


def test_extreme_logits_stay_finite():
    q, k, v = (jnp.asarray(x, jnp.float32) for x in random_qkv())
    value, gradient = jax.value_and_grad(
        lambda q: jnp.sum(chunked_attention(1e4 * q, k, v, jnp.asarray(5), 4))
    )(q)
    assert np.isfinite(value) and np.isfinite(gradient).all()


def test_gradients_agree_with_differences():
    with jax.enable_x64(True):
        q, k, v = (jnp.asarray(x) for x in random_qkv(1))
        f = jax.jit(lambda q, k, v: chunked_attention(q, k, v, jnp.asarray(9), 4))
        check_grads(f, (q, k, v), order=1, modes=("rev",), atol=1e-6, rtol=1e-6)


def test_padding_changes_nothing():
    q, k, v = (jnp.asarray(x, jnp.float32) for x in random_qkv())
    short = chunked_attention(q[:6], k[:6], v[:6], None, 4)
    padded = chunked_attention(
        q.at[6:].set(1e3), k.at[6:].set(1e3), v.at[6:].set(1e3), jnp.asarray(6), 4
    )
    assert np.allclose(padded[:6], short, atol=FLOAT32_TOLERANCE)


def test_memory_does_not_grow_with_the_square_of_the_length():
    length, chunk = 2048, 64
    q = jax.ShapeDtypeStruct((length, HEADS, WIDTH), jnp.float32)
    loss = lambda q, k, v: jnp.sum(chunked_attention(q, k, v, None, chunk))
    compiled = jax.jit(jax.grad(loss, (0, 1, 2))).lower(q, q, q).compile()
    square = 4 * HEADS * length**2
    assert compiled.memory_analysis().temp_size_in_bytes < square / 4


@pytest.mark.parametrize(
    ("backend", "tokens", "dtype", "expected"),
    [
        ("cpu", 100, "float32", "chunked"),
        ("gpu", 16385, "bfloat16", "cudnn"),
        ("gpu", 100, "float32", "xla"),
        ("gpu", 16385, "float32", "chunked"),
        ("tpu", 16385, "bfloat16", "chunked"),
        ("tpu", 1537, "bfloat16", "xla"),
    ],
)
def test_auto_follows_backend_length_and_precision(monkeypatch, backend, tokens, dtype, expected):
    monkeypatch.setattr(jax, "default_backend", lambda: backend)
    assert resolve_implementation("auto", tokens, jnp.dtype(dtype)) == expected
    assert resolve_implementation("xla", tokens, jnp.dtype(dtype)) == "xla"


@pytest.mark.slow
def test_query_key_norm_makes_attention_blind_to_their_lengths():
    tokens = jnp.asarray(np.random.default_rng(3).normal(size=(7, 8)), jnp.float32)
    for normed in (True, False):
        module = Attention(4, normed, Runtime(), jax.nn.initializers.normal(0.5))
        variables = module.init(jax.random.key(0), tokens)
        kernel = variables["params"]["qkv"]["kernel"]
        longer = kernel.at[:, :16].multiply(3.0)  # queries and keys
        params = {**variables["params"], "qkv": {"kernel": longer}}
        same = np.allclose(
            module.apply(variables, tokens), module.apply({"params": params}, tokens), atol=1e-4
        )
        assert same == normed


CONFIG = TransformerConfig(width=16, layers=6, head_width=8)
network = functools.partial(Transformer, runtime=Runtime())
BLOCKS_TOLERANCE = 1e-5
"""Sums in another order, over six layers."""
TOKENS = jnp.asarray(np.random.default_rng(0).normal(size=(11, 16)), jnp.float32)
VARIABLES = random_like(jax.eval_shape(network(CONFIG).init, jax.random.key(0), TOKENS))


def loss(variables, runtime):
    outputs = Transformer(CONFIG, runtime).apply(variables, TOKENS, jnp.asarray(9))
    return sum(jnp.sum(jnp.sin(k * x)) for k, x in enumerate(outputs, 1)), outputs


value_and_grad = jax.jit(jax.value_and_grad(loss, has_aux=True), static_argnames="runtime")


@pytest.mark.slow
@pytest.mark.parametrize(
    "how", [{"scan": True}, {"remat": "dots"}, {"scan": True, "remat": "full"}], ids=str
)
def test_blocks_may_be_looped_over_and_recomputed(how):
    runtime = Runtime(**how)
    shapes = jax.eval_shape(Transformer(CONFIG, runtime).init, jax.random.key(0), TOKENS)
    assert jax.tree.structure(shapes) == jax.tree.structure(VARIABLES)
    ours, reference = (jax.tree.leaves(value_and_grad(VARIABLES, x)) for x in (runtime, Runtime()))
    for a, b in zip(ours, reference, strict=True):
        assert np.allclose(
            a, b, rtol=BLOCKS_TOLERANCE, atol=BLOCKS_TOLERANCE * max(1, np.abs(b).max())
        )


@pytest.mark.slow
def test_outputs_are_those_of_the_quarters():
    """A network that is cut off after a quarter gives that quarter's raw output."""
    outputs = network(CONFIG).apply(VARIABLES, TOKENS)
    assert len(outputs) == 4

    def blocks(n):
        return {
            k: v for k, v in VARIABLES["params"].items() if k in {f"block_{i}" for i in range(n)}
        }

    rest = {k: VARIABLES["params"][k] for k in ("input_norm", "norm")}
    short = network(dataclasses.replace(CONFIG, layers=4))
    # 1, 2, 3, 4 of 6: here 1, 3, 4, 6
    quarters = short.apply({"params": {**blocks(4), **rest}}, TOKENS)
    assert np.allclose(outputs[0], quarters[0], atol=BLOCKS_TOLERANCE) and np.allclose(
        outputs[1], quarters[2], atol=BLOCKS_TOLERANCE
    )
    normed = (outputs[2] - outputs[2].mean(-1, keepdims=True)) / jnp.sqrt(
        outputs[2].var(-1, keepdims=True) + 1e-5
    )
    expected = normed * rest["norm"]["scale"] + rest["norm"]["bias"]
    assert np.allclose(quarters[3], expected, atol=10 * BLOCKS_TOLERANCE)
