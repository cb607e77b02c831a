"""Writes checkpoints as `torch.save` does, without torch."""

import collections
import dataclasses
import io
import pickle
import struct
import sys
import types
import zipfile
from unittest import mock

import numpy as np

from humangs_jax.io.tensors import STORAGE_DTYPES

MAGIC_NUMBER = 0x1950A86A20F9469CFC6C
"""First value of a stream of torch."""
KINDS = {dtype: kind for kind, dtype in STORAGE_DTYPES.items() if kind != "BFloat16Storage"}


@dataclasses.dataclass
class FakeTensor:
    """What `torch.save` writes of a tensor: a storage, and a view of it, by default contiguous."""

    storage: np.ndarray
    kind: str = "FloatStorage"
    shape: tuple | None = None
    strides: tuple | None = None
    offset: int = 0


def tensors(state):
    """Returns a state dict whose arrays are tensors."""
    own = {key: np.ascontiguousarray(x).reshape(np.shape(x)) for key, x in state.items()}
    return collections.OrderedDict((key, FakeTensor(x, KINDS[x.dtype])) for key, x in own.items())


def contiguous(shape):
    return tuple(int(np.prod(shape[i + 1 :])) for i in range(len(shape)))


def pickled(content, extra=lambda tensor: ()):
    """Returns (pickle of `content`, storages of its tensors); a storage's number is its name."""
    torch, utils = types.ModuleType("torch"), types.ModuleType("torch._utils")
    # modules in the place of PyTorch, so that the pickle names its functions and classes
    rebuild = lambda *_: None
    rebuild.__module__, rebuild.__qualname__, rebuild.__name__ = (
        "torch._utils",
        *["_rebuild_tensor_v2"] * 2,
    )
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
            kind = getattr(torch, value.tensor.kind)
            return ("storage", kind, str(len(storages) - 1), "cpu", size, *extra(value.tensor))

        # the arguments of PyTorch's function that makes a tensor of a storage
        def reducer_override(self, value):
            if not isinstance(value, FakeTensor):
                return NotImplemented
            shape = value.storage.shape if value.shape is None else value.shape
            strides = contiguous(shape) if value.strides is None else value.strides
            return rebuild, (
                Reference(value),
                value.offset,
                shape,
                strides,
                False,
                collections.OrderedDict(),
            )

    file = io.BytesIO()
    with mock.patch.dict(sys.modules, {"torch": torch, "torch._utils": utils}):
        Pickler(file, protocol=2).dump(content)
    return file.getvalue(), storages


def write_checkpoint(path, content, byteorder="little", compression=zipfile.ZIP_STORED):
    """Writes a checkpoint in zip format, whose tensors are `FakeTensor`."""
    data, storages = pickled(content)
    with zipfile.ZipFile(path, "w", compression) as archive:
        archive.writestr("archive/data.pkl", data)
        archive.writestr("archive/byteorder", byteorder)
        for i, storage in enumerate(storages):
            archive.writestr(f"archive/data/{i}", storage.tobytes())
    return path


def stream(storage, kind="FloatStorage", little=True, count=None, first=MAGIC_NUMBER):
    """Returns a storage as torch wrote it into a plain pickle before torch 1.6."""
    module = types.ModuleType("torch")
    setattr(module, kind, type(kind, (), {"__module__": "torch"}))
    size = storage.size if count is None else count

    class Reference:
        pass

    class Pickler(pickle.Pickler):
        def persistent_id(self, value):
            if not isinstance(value, Reference):
                return None
            return ("storage", getattr(module, kind), "94", "cpu", size, None)

    file = io.BytesIO()
    for value in (first, 1001, {"protocol_version": 1001, "little_endian": little}):
        pickle.dump(value, file, 2)
    with mock.patch.dict(sys.modules, {"torch": module}):
        Pickler(file, 2).dump(Reference())
    pickle.dump(["94"], file, 2)
    return file.getvalue() + struct.pack("<q", size) + storage.tobytes()


def plain_pickle(content, stream=stream):
    """Returns a pickle of arrays, written like tensors that `pickle.dump` writes."""
    names = {"torch.storage": "_load_from_bytes", "torch._utils": "_rebuild_tensor_v2"}
    modules = {"torch": types.ModuleType("torch")}
    for module, name in names.items():
        modules[module] = types.ModuleType(module)
        function = types.FunctionType((lambda *_: None).__code__, {}, name)
        function.__module__, function.__qualname__ = module, name
        setattr(modules[module], name, function)
    load = modules["torch.storage"]._load_from_bytes
    rebuild = modules["torch._utils"]._rebuild_tensor_v2

    class Stored:
        def __init__(self, array):
            self.data = stream(array, KINDS[array.dtype])

        def __reduce__(self):
            return load, (self.data,)

    class Pickler(pickle.Pickler):
        def reducer_override(self, value):
            if not isinstance(value, np.ndarray):
                return NotImplemented
            view = (Stored(value), 0, value.shape, contiguous(value.shape), False)
            return rebuild, (*view, collections.OrderedDict())

    file = io.BytesIO()
    with mock.patch.dict(sys.modules, modules):
        Pickler(file, 4).dump(content)
    return file.getvalue()
