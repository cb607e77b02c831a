import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads
from rounding import bound

from humangs_jax.network.runtime import Runtime
from humangs_jax.network.transformer import (
    Attention,
    attention,
    chunked_attention,
    resolve_implementation,
)

FLOAT32_TOLERANCE = 2e-6
"""Outputs are averages of numbers of order one; a dozen float32 roundings."""
LENGTH, HEADS, WIDTH = 13, 3, 4


def random_qkv(seed=0, length=LENGTH):
    return np.random.default_rng(seed).normal(size=(3, length, HEADS, WIDTH))


def oracle(q, k, v, count):
    """One head and query at a time, float64."""
    out = np.zeros_like(q)
    for i in range(len(q)):
        for h in range(q.shape[1]):
            logits = k[:count, h] @ q[i, h] / np.sqrt(q.shape[2])
            weights = np.exp(logits - logits.max())
            out[i, h] = weights / weights.sum() @ v[:count, h]
    return out


@pytest.mark.slow
@pytest.mark.parametrize("count", [None, 5, LENGTH])
@pytest.mark.parametrize(("implementation", "chunk"), [("xla", 1), ("chunked", 4), ("chunked", 13), ("chunked", 100)])
def test_agrees_with_the_definition(implementation, chunk, count):
    q, k, v = random_qkv()
    length = None if count is None else jnp.asarray(count)
    compute = jax.jit(attention, static_argnums=(4, 5))
    ours = compute(*(jnp.asarray(x, jnp.float32) for x in (q, k, v)), length, implementation, chunk)
    assert np.abs(ours - oracle(q, k, v, count)).max() < bound(FLOAT32_TOLERANCE)


def test_extreme_logits_stay_finite():
    q, k, v = (jnp.asarray(x, jnp.float32) for x in random_qkv())
    value, gradient = jax.value_and_grad(lambda q: jnp.sum(chunked_attention(1e4 * q, k, v, jnp.asarray(5), 4)))(q)
    assert np.isfinite(value) and np.isfinite(gradient).all()


def test_gradients_agree_with_differences():
    with jax.enable_x64(True):
        q, k, v = (jnp.asarray(x) for x in random_qkv(1))
        f = jax.jit(lambda q, k, v: chunked_attention(q, k, v, jnp.asarray(9), 4))
        check_grads(f, (q, k, v), order=1, modes=("rev",), atol=1e-6, rtol=1e-6)


def test_padding_changes_nothing():
    q, k, v = (jnp.asarray(x, jnp.float32) for x in random_qkv())
    short = chunked_attention(q[:6], k[:6], v[:6], None, 4)
    padded = chunked_attention(q.at[6:].set(1e3), k.at[6:].set(1e3), v.at[6:].set(1e3), jnp.asarray(6), 4)
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
        same = np.allclose(module.apply(variables, tokens), module.apply({"params": params}, tokens), atol=1e-4)
        assert same == normed
