import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from humangs_jax.core import numerics

FLOAT32_RELATIVE = 4e-7  # a handful of roundings of 6e-8
decades = st.floats(-18, 18).map(lambda e: 10.0**e)  # squares of float32 overflow past 1e19


@given(decades, st.integers(0, 2**31))
def test_directions_over_many_decades(scale, seed):
    x = (np.random.default_rng(seed).normal(size=3) * scale).astype(np.float32)
    exact = np.linalg.norm(x.astype(np.float64))
    unit = numerics.safe_normalize(jnp.asarray(x), jnp.asarray([1.0, 0, 0]))
    assert np.allclose(unit, x / exact, rtol=0, atol=FLOAT32_RELATIVE)


@pytest.mark.parametrize("largest", [1e-37, 1e-30, 1e25, 1e37])
# denormals (also of 1 / x) are flushed to 0
def test_directions_at_the_extremes_of_float32(
    largest,
):
    x = jnp.asarray([largest, 0.5 * largest, 0.0], jnp.float32)
    unit = numerics.safe_normalize(x, jnp.asarray([0.0, 0, 1]))
    np.testing.assert_allclose(unit, np.asarray([1, 0.5, 0]) / np.sqrt(1.25), rtol=1e-5)


@pytest.mark.parametrize(
    "f",
    [
        lambda x: numerics.safe_sqrt(x).sum(),
        lambda x: numerics.safe_normalize(x, jnp.asarray([0.0, 1, 0])).sum(),
        lambda x: numerics.safe_divide(x, x).sum(),
        lambda x: numerics.inverse_sigmoid(x).sum(),
    ],
)
def test_values_and_gradients_are_finite_at_zero(f):
    value, gradient = jax.value_and_grad(f)(jnp.zeros(3))
    assert np.isfinite(value) and np.isfinite(gradient).all()


def test_absolute_has_no_slope_at_zero():
    x = jnp.asarray([-2.0, 0.0, 3.0])
    assert np.array_equal(numerics.absolute(x), [2, 0, 3])
    assert np.array_equal(jax.grad(lambda x: numerics.absolute(x).sum())(x), [-1, 0, 1])


def test_zero_has_the_stated_value():
    assert (
        numerics.safe_normalize(jnp.zeros(3), jnp.asarray([0.0, 1, 0])) == jnp.asarray([0.0, 1, 0])
    ).all()
    assert numerics.safe_divide(jnp.ones(1), jnp.zeros(1))[0] == 0


@given(st.floats(-12, 12))
def test_the_inverse_of_the_sigmoid_inverts(x):
    assert np.isclose(
        numerics.inverse_sigmoid(jax.nn.sigmoid(jnp.float32(x))), x, atol=0.05, rtol=0
    )


def test_narrow_floats_become_float32_and_their_gradients_narrow_again():
    narrow = jnp.asarray([1.0, 2.0], jnp.bfloat16)
    tree = {"a": narrow, "b": jnp.asarray([3.0]), "c": np.asarray([3.0])}
    wide = numerics.at_least_float32(tree)
    assert {k: leaf.dtype.name for k, leaf in wide.items()} == {
        "a": "float32",
        "b": "float32",
        "c": "float64",
    }
    gradient = jax.grad(lambda x: jnp.sum(numerics.at_least_float32({"x": x})["x"] ** 2))(narrow)
    assert gradient.dtype == jnp.bfloat16
    np.testing.assert_array_equal(gradient, [2.0, 4.0])
