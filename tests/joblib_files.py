"""Writes pickles with arrays behind them as joblib does, without joblib."""

import io
import pickle
import sys
import types
from unittest import mock

import numpy as np


class Wrapped:
    """joblib's placeholder of an array."""

    def __init__(self, array, padding):
        self.subclass, self.shape, self.order, self.dtype = (
            np.ndarray,
            array.shape,
            "C",
            array.dtype,
        )
        self.allow_mmap, self.numpy_array_alignment_bytes = True, padding


class JoblibPickler(pickle._Pickler):
    """Writes arrays behind their placeholders, as joblib does."""

    padding = None

    def save(self, value, save_persistent_id=True):
        if not isinstance(value, np.ndarray):
            return super().save(value, save_persistent_id)
        value = np.ascontiguousarray(value)
        super().save(Wrapped(value, self.padding))
        self.framer.commit_frame(force=True)
        self.file_write = self.framer.file_write
        if self.padding is not None:
            self.file_write(bytes([3]) + b"\0" * 3)
        self.file_write(value.tobytes())
        return None


def joblib(content, padding=None, protocol=4):
    module, file = types.ModuleType("joblib.numpy_pickle"), io.BytesIO()
    Wrapped.__module__, Wrapped.__qualname__, Wrapped.__name__ = (
        "joblib.numpy_pickle",
        *["NumpyArrayWrapper"] * 2,
    )
    module.NumpyArrayWrapper = Wrapped
    with mock.patch.dict(
        sys.modules, {"joblib": types.ModuleType("joblib"), "joblib.numpy_pickle": module}
    ):
        pickler = JoblibPickler(file, protocol)
        pickler.padding = padding
        pickler.dump(content)
    return file.getvalue()
