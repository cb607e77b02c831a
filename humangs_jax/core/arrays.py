"""Small operations on arrays by numpy. Outside of `jit`, each operation of `jnp` is compiled for
each shape, which takes some ten milliseconds even if there is hardly anything to compute.
"""

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

SMALL = 1 << 16
"""Largest count of numbers that are brought from an accelerator and back in less time than a
program takes to compile.
"""


def from_host(array: Any, dtype: Any = None) -> Any:
    """Returns an array of JAX with the numbers of a list or of an array of numpy. An array of JAX
    only gets the dtype.

    `jnp.asarray` gives the same result, but compiles a program for each shape.
    """
    if isinstance(array, jax.Array):
        if dtype is None or array.dtype == dtype:
            return array
        return array.astype(dtype)
    return jax.device_put(np.asarray(array, dtype))


def on_host(array: Any) -> bool:
    """Says whether numpy can read an array at once, because it is numpy's, or JAX's on a CPU of
    this process.
    """
    if isinstance(array, np.ndarray):
        return True
    return _plain(array) and all(device.platform == "cpu" for device in array.devices())


def taken(array: Any, index: Any) -> Any:
    """Returns `array[index]`, by numpy where it can read the array, or the array is small."""
    small = _plain(array) and array.size <= SMALL
    if isinstance(index, Tracer) or isinstance(array, np.ndarray) or not (small or on_host(array)):
        return array[index]
    if isinstance(index, jax.Array):
        index = np.asarray(index)
    return from_host(np.asarray(array)[index])


def joined(arrays: Sequence[Any]) -> Any:
    """Returns `jnp.stack(arrays)`, by numpy where it can read the arrays."""
    if all(on_host(array) for array in arrays):
        return from_host(np.stack(arrays))
    return jnp.stack(arrays)


def _plain(array: Any) -> bool:
    """Says whether a value is an array of JAX with numbers that this process can read."""
    if isinstance(array, Tracer) or not isinstance(array, jax.Array):
        return False
    numbers = jnp.issubdtype(array.dtype, jnp.number) or array.dtype == bool
    return numbers and array.is_fully_addressable
