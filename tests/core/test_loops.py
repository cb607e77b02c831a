"""Loops that accelerators run side by side; this CPU runs both kinds."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from humangs_jax.core import loops
from humangs_jax.core.loops import over


@pytest.fixture
def elsewhere(monkeypatch):
    """Makes JAX report a GPU as its backend."""
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")


def loops_of(function, *arguments):
    return str(jax.make_jaxpr(function)(*arguments)).count("scan[")


def squared(pair):
    return {"x": pair[0] ** 2, "y": jnp.sum(pair[1])}


PAIRS = jnp.arange(6.0), jnp.ones((6, 2))


def test_a_cpu_takes_one_after_the_other_and_others_all_at_once(monkeypatch):
    assert loops_of(lambda xs: over(squared, xs), PAIRS) == 1
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    assert loops_of(lambda xs: over(squared, xs), PAIRS) == 0


@pytest.mark.parametrize("pixels", [1, 2, 3, 100])
def test_all_ways_give_the_same(elsewhere, monkeypatch, pixels):
    monkeypatch.setattr(loops, "PIXELS_AT_ONCE", 6)
    found = over(squared, PAIRS, pixels)
    np.testing.assert_array_equal(found["x"], PAIRS[0] ** 2)
    np.testing.assert_array_equal(found["y"], np.full(6, 2.0))


def test_no_more_pixels_than_fit_are_worked_on_at_once(elsewhere, monkeypatch):
    monkeypatch.setattr(loops, "PIXELS_AT_ONCE", 8)
    # six images of two pixels: three at a time, since four would leave a part of another size
    text = str(jax.make_jaxpr(lambda xs: over(squared, xs, 2))(PAIRS))
    assert "length=2" in text and "f32[3]" in text


def test_nothing_gives_nothing(elsewhere):
    none = over(lambda x: x + 1, jnp.zeros((0, 3)))
    assert none.shape == (0, 3)
