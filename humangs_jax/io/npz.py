"""npz archives: written whole or not at all, read without pickle, every kind of damage one exception."""

import os
import threading
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from humangs_jax.io.atomic import replace_file

_ONE_AT_A_TIME = threading.Lock()
"""numpy reads the header of an array through Python's syntax trees, and CPython 3.11 counts the depth of these for all
threads together: two at once are rarely, but then "AST constructor recursion depth mismatch" (python/cpython#106905)."""


def read_npz(path: str | Path) -> tuple[dict[str, np.ndarray], tuple[str, ...]]:
    """The arrays of an npz archive by name, and the names of the entries that are pickled objects (never read).

    Raises: FileNotFoundError; OSError, its text one line, if the file is no npz archive or is damaged.
    """
    arrays, pickled = {}, []
    try:
        with open(path, "rb") as stream:  # np.load leaks the handle of a damaged file that it opened itself
            archive = np.load(stream, allow_pickle=False)
            if not isinstance(archive, np.lib.npyio.NpzFile):
                raise OSError("a single array (npy), expected an npz archive")
            with archive:
                for name in archive.files:
                    try:
                        with _ONE_AT_A_TIME:
                            arrays[name] = archive[name]
                    except ValueError as error:
                        if "pickle" not in str(error):
                            raise
                        pickled.append(name)
    except OSError:
        raise
    except Exception as error:  # zipfile, zlib, struct and numpy raise seven different types for a damaged archive
        raise OSError(f"not a readable npz archive: {' '.join(str(error).split())}") from error
    return arrays, tuple(pickled)


def write_npz(path: str | os.PathLike, arrays: Mapping[str, Any], compressed: bool = True) -> None:
    """Write an npz archive of array-likes by name, under any suffix; it appears whole or not at all. Raises: OSError."""
    save = np.savez_compressed if compressed else np.savez
    converted: dict[str, Any] = {name: np.asarray(value) for name, value in arrays.items()}

    def write(temporary: Path) -> None:
        with open(temporary, "wb") as file:  # numpy would add .npz to a name
            save(file, **converted)

    replace_file(path, write)
