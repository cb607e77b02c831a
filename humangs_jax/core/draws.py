"""Draws random numbers by name, all at once.

For each shape of random numbers, JAX adds a function of more than a hundred lines of StableHLO to
the program, and compiling it takes time. So code that needs many numbers draws all of them at once,
uniform in [0, 1).
"""

import math
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from humangs_jax.core.array_types import Array, Float, Key


def uniform_by_name(
    key: Key, shapes: Mapping[str, tuple[int, ...]], dtype: Any = jnp.float32
) -> dict[str, Float[Array, "..."]]:
    """Returns arrays of uniform random numbers in [0, 1) by name. shapes: their shapes by name."""
    ends = np.cumsum([math.prod(shape) for shape in shapes.values()])
    parts = jnp.split(jax.random.uniform(key, (ends[-1],), dtype), ends[:-1])
    return {
        name: part.reshape(shape) for (name, shape), part in zip(shapes.items(), parts, strict=True)
    }


def normal_of(uniform: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """Returns standard normal numbers made from numbers that are uniform in [0, 1)."""
    # the inverse of the error function is infinite at -1, which the smallest number would become
    least = np.nextafter(np.asarray(-1, uniform.dtype), np.asarray(0, uniform.dtype))
    return math.sqrt(2) * jax.lax.erf_inv(jnp.maximum(2 * uniform - 1, least))
