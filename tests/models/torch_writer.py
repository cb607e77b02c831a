"""Checkpoints as `torch.save` writes them, without torch."""

import collections
import dataclasses
import pickle
import sys
import types
import zipfile
from unittest import mock

import numpy as np

from humangs_jax.models.torch_file import STORAGE_DTYPES

KINDS = {dtype: kind for kind, dtype in STORAGE_DTYPES.items() if kind != "BFloat16Storage"}


@dataclasses.dataclass
class FakeTensor:
    """What `torch.save` writes for a tensor: a storage by reference, and a view of it (contiguous if not said)."""

    storage: np.ndarray
    kind: str = "FloatStorage"
    shape: tuple | None = None
    strides: tuple | None = None
    offset: int = 0


def tensors(state):
    """A state dict of arrays as tensors."""
    own = {key: np.ascontiguousarray(x).reshape(np.shape(x)) for key, x in state.items()}
    return collections.OrderedDict((key, FakeTensor(x, KINDS[x.dtype])) for key, x in own.items())


def contiguous(shape):
    return tuple(int(np.prod(shape[i + 1 :])) for i in range(len(shape)))


def write_checkpoint(path, content, byteorder="little", compression=zipfile.ZIP_STORED):
    """A zip-format checkpoint of whatever `content` is; tensors in it as `FakeTensor`."""
    torch, utils = types.ModuleType("torch"), types.ModuleType("torch._utils")
    rebuild = lambda *_: None
    rebuild.__module__, rebuild.__qualname__, rebuild.__name__ = "torch._utils", *["_rebuild_tensor_v2"] * 2
    utils._rebuild_tensor_v2, torch._utils = rebuild, utils
    for name in STORAGE_DTYPES:
        setattr(torch, name, type(name, (), {"__module__": "torch"}))
    storages = []

    class Reference:
        def __init__(self, tensor):
            self.tensor = tensor

    class Pickler(pickle.Pickler):
        def persistent_id(self, value):
            if not isinstance(value, Reference):
                return None
            storages.append(value.tensor.storage)
            size = value.tensor.storage.size
            return ("storage", getattr(torch, value.tensor.kind), str(len(storages) - 1), "cpu", size)

        def reducer_override(self, value):
            if not isinstance(value, FakeTensor):
                return NotImplemented
            shape = value.storage.shape if value.shape is None else value.shape
            strides = contiguous(shape) if value.strides is None else value.strides
            return rebuild, (Reference(value), value.offset, shape, strides, False, collections.OrderedDict())

    modules = {"torch": torch, "torch._utils": utils}
    with mock.patch.dict(sys.modules, modules), zipfile.ZipFile(path, "w", compression) as archive:
        with archive.open("archive/data.pkl", "w") as file:
            Pickler(file, protocol=2).dump(content)
        archive.writestr("archive/byteorder", byteorder)
        for i, storage in enumerate(storages):
            archive.writestr(f"archive/data/{i}", storage.tobytes())
    return path
