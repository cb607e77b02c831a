"""Read arrays out of a body model's pickle without running what it contains.

A pickle names functions and classes, and loading it calls them. Here only a fixed list of names is understood: numpy's
array constructors as they are, and scipy's sparse matrices and chumpy's arrays as inert stand-ins. Any other name is
refused.
"""

import pickle
from pathlib import Path
from typing import Any

import numpy as np


class _StandIn:
    """Holds the state of an object whose class is not loaded."""

    def __init__(self, *arguments: Any) -> None:
        self.arguments = arguments

    def __setstate__(self, state: Any) -> None:
        for part in state if isinstance(state, tuple) else (state,):
            if isinstance(part, dict):
                self.__dict__.update(part)


class _Sparse(_StandIn):
    def coordinates(self) -> tuple[np.ndarray, np.ndarray]:
        raise NotImplementedError

    def to_array(self) -> np.ndarray:
        shape, data = self.__dict__["_shape"], np.asarray(self.__dict__["data"])
        full = np.zeros(shape, data.dtype)
        np.add.at(full, self.coordinates(), data)
        return full


class _SparseColumns(_Sparse):
    def coordinates(self) -> tuple[np.ndarray, np.ndarray]:
        counts = np.diff(self.__dict__["indptr"])
        return self.__dict__["indices"], np.repeat(np.arange(len(counts)), counts)


class _SparseRows(_Sparse):
    def coordinates(self) -> tuple[np.ndarray, np.ndarray]:
        counts = np.diff(self.__dict__["indptr"])
        return np.repeat(np.arange(len(counts)), counts), self.__dict__["indices"]


class _SparseEntries(_Sparse):
    def coordinates(self) -> tuple[np.ndarray, np.ndarray]:
        if "coords" in self.__dict__:
            return self.__dict__["coords"]
        return self.__dict__["row"], self.__dict__["col"]


class _Chumpy(_StandIn):
    def to_array(self) -> np.ndarray:
        return np.asarray(self.__dict__["x"])


class _ChumpySelection(_StandIn):
    def to_array(self) -> np.ndarray:
        source = as_array(self.__dict__["a"])
        return source.ravel()[np.asarray(self.__dict__["idxs"])].reshape(self.__dict__["preferred_shape"])


_SPARSE = {"csc_matrix": _SparseColumns, "csr_matrix": _SparseRows, "coo_matrix": _SparseEntries}
_CHUMPY = {("chumpy.ch", "Ch"): _Chumpy, ("chumpy.reordering", "Select"): _ChumpySelection}
_EXACT = {
    ("numpy", "ndarray"),
    ("numpy", "dtype"),
    *(
        (f"numpy.{core}.{module}", name)
        for core in ("core", "_core")
        for module, name in (("multiarray", "_reconstruct"), ("multiarray", "scalar"), ("numeric", "_frombuffer"))
    ),
    ("_codecs", "encode"),  # how protocol 2 writes bytes
    *((module, "_reconstructor") for module in ("copyreg", "copy_reg")),
    *((module, "object") for module in ("builtins", "__builtin__")),
}


class _Unpickler(pickle.Unpickler):
    def find_class(self, module: str, name: str) -> Any:
        if (module, name) in _CHUMPY:
            return _CHUMPY[module, name]
        if module.startswith("scipy.sparse") and name in _SPARSE:
            return _SPARSE[name]
        if (module, name) in _EXACT:
            return super().find_class(module, name)
        raise pickle.UnpicklingError(f"it asks for '{module}.{name}', which is not needed to hold arrays")


def as_array(value: Any) -> np.ndarray:
    """A full array from what `read_pickle` returned: array, number or stand-in. Raises: ValueError for anything else."""
    if isinstance(value, _Sparse | _Chumpy | _ChumpySelection):
        try:
            return value.to_array()
        except (KeyError, TypeError, IndexError) as error:
            raise ValueError(
                f"a {type(value).__name__.strip('_')} object without readable contents ({error!r})"
            ) from error
    if isinstance(value, np.ndarray | np.generic | int | float | list | tuple):
        return np.asarray(value)
    raise ValueError(f"expected an array, got {type(value).__name__}")


def read_pickle(path: str | Path) -> dict[str, Any]:
    """The dict in a pickle (of Python 2 or 3), its arrays still to be passed through `as_array`.

    Raises: ValueError, naming the file, if it is no pickle of a dict or names anything that arrays do not need.
    """
    with open(path, "rb") as file:
        try:
            content = _Unpickler(file, encoding="latin1").load()
        except Exception as error:  # a broken pickle may raise anything
            raise ValueError(f"{path}: refused to load this pickle: {error}") from error
    if not isinstance(content, dict):
        raise ValueError(f"{path}: expected a dict of arrays, got {type(content).__name__}")
    return content
