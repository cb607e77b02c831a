"""Does operations on small arrays with numpy. Outside of `jit`, JAX compiles each operation of
`jnp` for each shape. This takes some ten milliseconds, even if there is hardly anything to compute.
"""

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from humangs_jax.core.array_types import Int

SMALL = 1 << 16
"""Arrays of at most this many entries are indexed on the host. Copying them from an accelerator and
back takes less time than compiling a program.
"""


def from_host(array: Any, dtype: Any = None) -> Any:
    """Returns an array of JAX with the numbers of a list or of an array of numpy. An array of JAX
    is only converted to `dtype`. dtype: None keeps the type.

    `jnp.asarray` gives the same numbers, but compiles a program for each shape.
    """
    if isinstance(array, jax.Array):
        if dtype is None or array.dtype == dtype:
            return array
        return array.astype(dtype)
    return jax.device_put(np.asarray(array, dtype))


def on_host(array: Any) -> bool:
    """Says whether numpy can read an array without a copy from an accelerator or from another
    process. True for arrays of numpy, and for arrays of JAX with numbers on CPUs of this process.
    """
    if isinstance(array, np.ndarray):
        return True
    return _plain(array) and all(device.platform == "cpu" for device in array.devices())


def taken(array: Any, index: Any) -> Any:
    """Returns `array[index]`, for arrays of numpy and of JAX.

    An array of JAX is indexed by numpy if it is small, or if it is on the host (`on_host`). The
    result is then an array of JAX again.

    Raises: IndexError for an integer out of range. A traced index of an array of JAX is clamped
    instead. A traced index of an array of numpy is an error of JAX.
    """
    if isinstance(index, Tracer) or isinstance(array, np.ndarray):
        return array[index]
    small = _plain(array) and array.size <= SMALL
    if small or on_host(array):
        if isinstance(index, jax.Array):
            index = np.asarray(index)
        return from_host(np.asarray(array)[index])
    wrong = out_of_range(index, len(array))
    if len(wrong):
        raise IndexError(f"index {wrong[0]} is out of bounds for axis 0 with size {len(array)}")
    return array[index]


def out_of_range(index: Any, size: int) -> Int[np.ndarray, " n"]:
    """Returns the integers of an index that do not fit an axis of this size, (n,). The result is
    empty for slices, lists and masks, and for arrays whose numbers this process cannot read.
    """
    readable = isinstance(index, int | np.integer | np.ndarray) or _plain(index)
    if not readable or np.asarray(index).dtype == bool:
        return np.zeros(0, int)
    numbers = np.asarray(index)
    return numbers[(numbers < -size) | (numbers >= size)]


def joined(arrays: Sequence[Any]) -> Any:
    """Returns `jnp.stack(arrays)`. numpy computes it if all arrays are on the host (`on_host`)."""
    if all(on_host(array) for array in arrays):
        return from_host(np.stack(arrays))
    return jnp.stack(arrays)


def _plain(array: Any) -> bool:
    """Says whether a value is an array of JAX with numbers that this process can read."""
    if isinstance(array, Tracer) or not isinstance(array, jax.Array):
        return False
    numbers = jnp.issubdtype(array.dtype, jnp.number) or array.dtype == bool
    return numbers and array.is_fully_addressable
