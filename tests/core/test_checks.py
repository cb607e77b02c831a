"""Checks of values: what passes, what is named, and that transformations are left alone."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from humangs_jax.core.checks import FINITE, NOT_NEGATIVE, POSITIVE, UNIT, check_values


def test_what_is_right_passes():
    arrays = {
        "means": (jnp.asarray([[-1e30, 0.0], [1e-30, 3.0]]), FINITE),
        "opacities": (jnp.asarray([0.0, 1.0]), UNIT),
        "photos": (np.asarray([0.0, 1.0], np.float32), UNIT),
        "labels": (jnp.arange(3), NOT_NEGATIVE),
        "focal": (np.float32(1e-30), POSITIVE),
        "absent": (None, UNIT),
        "empty": (jnp.zeros((0, 3)), POSITIVE),
    }
    check_values("draw", arrays)


@pytest.mark.parametrize("array_of", [np.asarray, jnp.asarray], ids=["numpy", "jax"])
@pytest.mark.parametrize(
    ("entries", "values", "words"),
    [
        (
            [[0, 1], [np.nan, np.inf]],
            FINITE,
            r"expected finite numbers, but 2 of 4 are not, the first at \[1, 0\]: nan",
        ),
        ([0, 1, -np.inf], NOT_NEGATIVE, r"expected finite numbers >= 0, but 1 of 3 are not, the first at \[2\]: -inf"),
        ([0.5, 1.25, -1], UNIT, r"expected numbers in \[0, 1\], but 2 of 3 are not, the first at \[1\]: 1.25"),
        ([1, 0], POSITIVE, r"expected finite numbers > 0, but 1 of 2 are not, the first at \[1\]: 0"),
        (-3.0, NOT_NEGATIVE, r"expected finite numbers >= 0, but 1 of 1 are not, -3"),
    ],
)
def test_what_is_wrong_is_named(array_of, entries, values, words):
    right = (jnp.ones(3), FINITE)
    with pytest.raises(ValueError, match=f"^draw: colors: {words}$"):
        check_values(
            "draw", {"means": right, "colors": (array_of(np.asarray(entries, np.float32)), values), "w": right}
        )


def test_traced_arrays_are_not_looked_at():
    def checked(x):
        check_values("draw", {"x": (x, UNIT), "constant": (np.asarray([np.nan]), FINITE)})
        return jnp.sum(x)

    wrong = jnp.asarray([np.nan, 2.0])
    assert np.isnan(jax.jit(checked)(wrong)) and np.isnan(jax.vmap(checked)(wrong[None])[0])
    assert jax.grad(checked)(wrong).tolist() == [1, 1]
    assert str(jax.make_jaxpr(checked)(wrong)) == str(jax.make_jaxpr(jnp.sum)(wrong))
    with pytest.raises(ValueError, match="x: expected numbers"):
        checked(wrong)
