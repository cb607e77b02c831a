"""Checks of the values that users hand in: finite, and in range.

    check_values("render", {"gaussians.opacities": (gaussians.opacities, UNIT), "camera.K": (camera.K, FINITE)})

    ValueError: render: gaussians.opacities: expected numbers in [0, 1], but 2 of 52375 are not, the first at [17]: nan

For functions that people call with concrete arrays. Inside `jit`, `vmap` and `grad` arrays have no values yet: there nothing
is checked and nothing is computed, so the pure function behind a public one needs no switch.
"""

import math
from collections.abc import Mapping
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from humangs_jax.core.array_types import Array, Shaped


class Values(NamedTuple):
    """What the entries of an array may be: finite numbers in [low, high]. words: how an error message says it."""

    words: str
    low: float = -math.inf
    high: float = math.inf


FINITE = Values("finite numbers")
LARGEST = 1e6
"""Of avatars and what is written of them, metres or any unit: nobody is larger, and float32 holds products of several such
numbers."""
BOUNDED = Values(f"finite numbers of at most {LARGEST:g} in magnitude", -LARGEST, LARGEST)
ROUNDING = 1e-6
"""Photos that were resized, and opacities from a sigmoid, may be a few float32 roundings outside of [0, 1]."""
UNIT = Values("numbers in [0, 1]", -ROUNDING, 1 + ROUNDING)
NOT_NEGATIVE = Values("finite numbers >= 0", 0.0)
POSITIVE = Values("finite numbers > 0", math.ulp(0.0))


def check_values(
    owner: str, arrays: Mapping[str, tuple[Shaped[Array, "..."] | Shaped[np.ndarray, "..."] | None, Values]]
) -> None:
    """Checks that arrays hold what they should.

    Arguments: owner: the function that was called, for the message. arrays: by name (for the message too), each with the
    values that it may have; None and empty arrays pass. Arrays of JAX are reduced together on their device, by one program and
    one transfer of two numbers each; numpy's are checked on the host, without a copy to a device.
    Raises: ValueError that names the first array with other values, says how many they are, and where the first one is.
    Nothing is checked if one of the arrays is traced.
    """
    given = {name: (array, values) for name, (array, values) in arrays.items() if array is not None and array.size}
    if any(isinstance(array, Tracer) for array, _ in given.values()):
        return
    on_device = {name: array for name, (array, _) in given.items() if not isinstance(array, np.ndarray)}
    extremes = {name: (array.min(), array.max()) for name, (array, _) in given.items() if name not in on_device}
    if on_device:
        extremes |= zip(on_device, np.asarray(_extremes(tuple(on_device.values()))), strict=True)
    for name, (array, values) in given.items():
        low, high = (float(extreme) for extreme in extremes[name])  # NaN if any entry is
        if not (math.isfinite(low) and math.isfinite(high) and values.low <= low and high <= values.high):
            raise ValueError(f"{owner}: {name}: {_fault(np.asarray(array, np.float64), values)}")


@jax.jit
def _extremes(arrays):
    """(arrays, 2): least and largest entry of each; both NaN if an entry is."""
    return jnp.stack([jnp.stack([jnp.min(array), jnp.max(array)]) for array in arrays])


def _fault(array, values):
    wrong = ~(np.isfinite(array) & (array >= values.low) & (array <= values.high))
    first = np.argwhere(wrong)[0]
    place = f"the first at {first.tolist()}: " if array.ndim else ""
    return f"expected {values.words}, but {wrong.sum()} of {wrong.size} are not, {place}{array[tuple(first)]:.9g}"
