"""Values of data-set files, checked one by one: every fault is a `CaptureError` that names file and key."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from humangs_jax.core.array_types import Float
from humangs_jax.data.capture_checks import CaptureError
from humangs_jax.io.npz import read_npz
from humangs_jax.io.reading import reading
from humangs_jax.io.restricted_pickle import as_array, read_pickle

LARGEST_ANGLE = 4 * np.pi
"""Radians of a rotation vector; fits wander beyond 2 pi now and then, degrees are far above."""
FARTHEST = 100.0
"""Metres of a translation or of a camera from the origin; millimetres are far above."""
LARGEST_COEFFICIENT = 30.0
"""Of shape and expression: standard deviations, usually below 5."""


class ArrayFile:
    """Named arrays of an npz archive or of a pickle (.pkl, read without running anything in it).

    Raises: CaptureError if the file is missing, damaged or larger than the limits allow.
    """

    def __init__(self, path: str | Path):
        self.path, self.pickled = Path(path), ()
        kind = "pickle" if self.path.suffix.lower() in (".pkl", ".pickle") else "npz archive"
        with reading(self.path, kind, CaptureError):
            if kind == "pickle":
                self.values: Mapping[str, Any] = read_pickle(self.path)
            else:
                self.values, self.pickled = read_npz(self.path)

    def __contains__(self, key: str) -> bool:
        return key in self.values

    def array(self, key: str) -> np.ndarray:
        """What is under a key, as an array of any kind. Raises: CaptureError."""
        if key not in self.values:
            found = ", ".join(sorted(self.values)) or "none"
            reason = "a pickled object, which is never read" if key in self.pickled else f"missing (keys: {found})"
            raise CaptureError(self.path, key, reason)
        try:
            return as_array(self.values[key])
        except ValueError as error:
            raise CaptureError(self.path, key, error) from error

    def numbers(self, key: str, shape: tuple[int | None, ...], largest: float = np.inf) -> Float[np.ndarray, "..."]:
        """Finite float64 numbers under a key; None in `shape` is any size but 0. largest: no number is greater in size."""
        return checked_numbers(self.array(key), self.path, key, shape, largest)

    def number(self, key: str) -> float:
        """A single number, however nested. Raises: as `numbers`."""
        return float(self.numbers(key, (1,) * self.array(key).ndim).reshape(-1)[0])


def checked_numbers(
    value: Any, file: object, key: str, shape: tuple[int | None, ...], largest: float = np.inf
) -> Float[np.ndarray, "..."]:
    """Finite float64 numbers of a shape in which None is any size but 0."""
    array = np.asarray(value)
    if array.dtype.kind not in "fiu":
        raise CaptureError(file, key, f"expected real numbers, got {array.dtype}")
    fits = array.ndim == len(shape) and all(b in (None, a) for a, b in zip(array.shape, shape, strict=True))
    if not fits or 0 in array.shape:
        wanted = ", ".join("any" if size is None else str(size) for size in shape)
        raise CaptureError(file, key, f"expected shape ({wanted}), got {array.shape}")
    array = array.astype(np.float64)
    size = np.abs(array)
    if not np.isfinite(array).all():
        where = [int(i) for i in np.argwhere(~np.isfinite(array))[0]]
        raise CaptureError(file, key, f"expected finite numbers, got {array[tuple(where)]} at index {where}")
    if size.max() > largest:
        where = [int(i) for i in np.unravel_index(size.argmax(), size.shape)]
        problem = (
            f"expected numbers of at most {largest:.4g}, got {array[tuple(where)]:.4g} at index {where}: another unit?"
        )
        raise CaptureError(file, key, problem)
    return array
