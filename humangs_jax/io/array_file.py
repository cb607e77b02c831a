"""Files of named arrays (npz archives, pickles), read key by key: every fault is one line with file and key."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from humangs_jax.core.array_types import Float
from humangs_jax.io.npz import read_npz
from humangs_jax.io.reading import FileError, open_file, reading
from humangs_jax.io.restricted_pickle import as_array, read_pickle


class ArrayFile:
    """Named arrays of a file. error: the class of what is raised for a value that is not what it should be."""

    def __init__(
        self,
        path: str | Path,
        values: Mapping[str, Any],
        pickled: tuple[str, ...] = (),
        error: type[FileError] = FileError,
    ) -> None:
        self.path, self.values, self.pickled, self.error = Path(path), values, pickled, error

    @classmethod
    def open(
        cls, path: str | Path, error: type[FileError] = FileError, wanted: Callable[[str], bool] | None = None
    ) -> "ArrayFile":
        """An npz archive, by suffix or content, or else a pickle (read without running anything in it).

        Arguments: wanted: which arrays of an archive to read; None: all.
        Raises: `error` if the file is damaged or larger than the limits allow; for a missing file see `reading`.
        """
        with reading(path, "file of arrays", error):
            with open_file(path) as file:
                archive = file.read(2) == b"PK"
            if archive or Path(path).suffix.lower() == ".npz":
                return cls(path, *read_npz(path, wanted), error)
            return cls(path, read_pickle(path), (), error)

    def __contains__(self, key: str) -> bool:
        return key in self.values

    def array(self, key: str) -> np.ndarray:
        """What is under a key, as an array of any kind. Raises: `error`."""
        if key not in self.values:
            found = ", ".join(sorted(map(str, self.values))) or "none"
            reason = "a pickled object, which is never read" if key in self.pickled else f"missing (keys: {found})"
            raise self.error(self.path, key, reason)
        try:
            return as_array(self.values[key])
        except (ValueError, TypeError, OverflowError) as error:
            raise self.error(self.path, key, error) from error

    def numbers(
        self, key: str, shape: tuple[int | None, ...] | None, largest: float = np.inf
    ) -> Float[np.ndarray, "..."]:
        """Finite float64 numbers under a key, as `checked_numbers`."""
        return checked_numbers(self.array(key), self.path, key, shape, largest, self.error)

    def number(self, key: str) -> float:
        """A single number, however nested. Raises: as `numbers`."""
        return float(self.numbers(key, (1,) * self.array(key).ndim).reshape(-1)[0])

    def indices(self, key: str, bound: int) -> np.ndarray:
        """Triangles (f, 3) of integers in [0, bound)."""
        array = self.numbers(key, (None, 3)).astype(np.int64)
        if array.min() < 0 or array.max() >= bound:
            raise self.error(self.path, key, f"expected indices in [0, {bound})")
        return array


def checked_numbers(
    value: Any,
    file: object,
    key: str,
    shape: tuple[int | None, ...] | None,
    largest: float = np.inf,
    error: type[FileError] = FileError,
) -> Float[np.ndarray, "..."]:
    """Finite float64 numbers, at least one. shape: None in it is any size, None for it any shape. largest: in magnitude."""
    array = np.asarray(value)
    if array.dtype.kind not in "fiu":
        raise error(file, key, f"expected real numbers, got {array.dtype}")
    shape = (None,) * array.ndim if shape is None else shape
    fits = array.ndim == len(shape) and all(b in (None, a) for a, b in zip(array.shape, shape, strict=True))
    if 0 in array.shape:
        raise error(file, key, f"expected at least one number, got shape {array.shape}")
    if not fits:
        wanted = ", ".join("any" if size is None else str(size) for size in shape)
        raise error(file, key, f"expected shape ({wanted}), got {array.shape}")
    array = array.astype(np.float64)
    if not np.isfinite(array).all():
        where = [int(i) for i in np.argwhere(~np.isfinite(array))[0]]
        raise error(file, key, f"expected finite numbers, got {array[tuple(where)]} at index {where}")
    if largest < np.inf and np.abs(array).max() > largest:
        where = [int(i) for i in np.unravel_index(np.abs(array).argmax(), array.shape)]
        found = f"got {array[tuple(where)]:.4g} at index {where}: another unit?"
        raise error(file, key, f"expected numbers of at most {largest:.4g}, {found}")
    return array
