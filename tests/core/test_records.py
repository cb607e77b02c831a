"""Records are checked against their annotations."""

import dataclasses
from typing import Annotated

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from humangs_jax.core.array_types import Array, Float, Int
from humangs_jax.core.checks import POSITIVE, UNIT, check_values
from humangs_jax.core.pytree import pytree_dataclass
from humangs_jax.core.records import Batch, Part, array_fields, check_record, record_values


@pytree_dataclass
class Lens:
    focal: Annotated[Float[Array, "2 2"], Part("diagonal", lambda x: x[..., 0, 0], POSITIVE)]


@dataclasses.dataclass(frozen=True)
class Photos:
    images: Annotated[Float[np.ndarray, "v h"], UNIT]
    frames: Int[np.ndarray, " v"]
    lenses: Annotated[Lens, Batch("v")]
    weights: Annotated[Float[np.ndarray, " v"] | None, UNIT] = None
    alone: Lens | None = None


def photos(**changes):
    usual = dict(images=np.ones((3, 2)), frames=np.zeros(3, int), lenses=Lens(jnp.ones((3, 2, 2))))
    return Photos(**(usual | changes))


# jaxtyping would check these classes when they are made; records of users come from `replace`
@pytest.mark.parametrize(
    ("changes", "fault"),
    [
        ({"frames": np.zeros(2, int)}, r"frames: expected shape \(3,\), got \(2,\)"),
        ({"images": np.ones(3)}, r"images: expected shape \(v, h\), got \(3,\)"),
        ({"lenses": Lens(jnp.ones((2, 2, 2)))}, r"lenses.focal: expected shape \(3, 2, 2\)"),
        ({"images": np.full((3, 2), 2.0)}, r"images: expected numbers in \[0, 1\], but 6 of 6"),
        ({"weights": np.full(3, np.nan)}, r"weights: expected numbers in \[0, 1\]"),
        (
            {"lenses": Lens(jnp.zeros((3, 2, 2)))},
            "lenses.focal diagonal: expected finite numbers >",
        ),
        ({"lenses": Lens(jnp.full((3, 2, 2), jnp.inf))}, "lenses.focal: expected finite numbers"),
    ],
)
def test_a_fault_names_the_array_and_what_was_expected(changes, fault):
    with pytest.raises(ValueError, match=f"me: {fault}"):
        check_record(photos(**changes), "me")


def test_right_records_pass_and_what_has_no_mark_is_not_looked_into():
    check_record(photos(), "me")
    check_record(photos(weights=np.ones(3), alone=Lens(jnp.full((2, 2), jnp.nan))), "me")
    with pytest.raises(ValueError, match=r"frames: expected shape \(4,\)"):
        check_record(photos(images=np.ones((4, 2))), "me", {"h": 2})
    assert array_fields(Photos)["frames"].values is None


def test_traced_records_are_not_looked_at():
    def values(lens):
        check_values("me", record_values(lens, "lens"))
        return lens.focal

    assert np.isnan(jax.jit(values)(Lens(jnp.full((2, 2), jnp.nan)))).all()
    assert not record_values(None, "lens")
