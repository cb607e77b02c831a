"""Tensors of a zip-format `.pt` file (what `torch.save` writes), without torch and without running anything in it.

Such a file is a pickle that describes tensors, and one zip member per storage. The pickle is read by an unpickler that
knows the calls which rebuild the tensors of a state dict and refuses everything else by name. What those calls return
is immutable, so that no later instruction of the pickle can change it. Only the storages of the state dict are read.
"""

import collections
import math
import os
import pickle
import struct
import zipfile
import zlib
from typing import Any, NamedTuple

import numpy as np

STORAGE_DTYPES = {
    "DoubleStorage": np.dtype("<f8"),
    "FloatStorage": np.dtype("<f4"),
    "HalfStorage": np.dtype("<f2"),
    "BFloat16Storage": np.dtype("<u2"),  # widened after reading
    "LongStorage": np.dtype("<i8"),
    "IntStorage": np.dtype("<i4"),
    "ShortStorage": np.dtype("<i2"),
    "CharStorage": np.dtype("i1"),
    "ByteStorage": np.dtype("u1"),
    "BoolStorage": np.dtype("?"),
}
STATE_DICT = "model"
"""Key of the state dict in the file; what lies under other keys (the optimizer's state) is never read."""
LARGEST_RATIO = 16
"""Members may unpack to this many times the size of the file: torch does not compress at all."""
BROKEN = (zipfile.BadZipFile, zlib.error, EOFError, NotImplementedError, RuntimeError, OSError, struct.error)
"""What zipfile raises for damaged, truncated, encrypted or exotic archives."""


class _StorageType(NamedTuple):
    """Stands for a `torch.*Storage` class."""

    name: str


class _Storage(NamedTuple):
    kind: str
    member: str


class _Tensor(NamedTuple):
    """A tensor that is not read yet: a view of a storage, offset and strides in elements."""

    storage: _Storage
    offset: int
    shape: tuple[int, ...]
    strides: tuple[int, ...]


class _RebuildTensor:
    __slots__ = ()

    def __call__(self, storage: Any, offset: Any, shape: Any, strides: Any, *_: Any) -> _Tensor:
        whole = lambda x: type(x) is tuple and all(type(n) is int and n >= 0 for n in x)
        if not (isinstance(storage, _Storage) and whole((offset,)) and whole(shape) and whole(strides)):
            raise pickle.UnpicklingError("a tensor without a storage, or whose offset, shape or strides are no counts")
        if len(shape) != len(strides):
            raise pickle.UnpicklingError(f"a tensor with {len(shape)} axes and {len(strides)} strides")
        return _Tensor(storage, offset, shape, strides)


class _RebuildParameter:
    __slots__ = ()

    def __call__(self, tensor: Any, *_: Any) -> Any:
        return tensor


_ALLOWED = {
    ("torch._utils", "_rebuild_tensor_v2"): _RebuildTensor(),
    ("torch._utils", "_rebuild_parameter"): _RebuildParameter(),
    ("collections", "OrderedDict"): collections.OrderedDict,
    **{("torch", name): _StorageType(name) for name in STORAGE_DTYPES},
}


class _StateDictUnpickler(pickle.Unpickler):
    """Knows tensors, ordered dicts and storages."""

    def find_class(self, module: str, name: str) -> Any:
        if (module, name) not in _ALLOWED:
            module = "builtins" if module == "__builtin__" else module  # its name in protocol 2, which torch writes
            raise pickle.UnpicklingError(f"refused to load {module}.{name}: no part of a state dict")
        return _ALLOWED[module, name]

    def persistent_load(self, pid: Any) -> _Storage:
        known = isinstance(pid, tuple) and len(pid) == 5 and pid[0] == "storage"
        if not (known and isinstance(pid[1], _StorageType) and isinstance(pid[2], str)):
            raise pickle.UnpicklingError("refused to load a persistent object that is no storage")
        return _Storage(pid[1].name, pid[2])


def read_torch_file(path: str | os.PathLike, skip_prefix: str | None = None) -> tuple[dict[str, np.ndarray], int]:
    """Tensors of the state dict in a file, without those whose name begins with `skip_prefix`; how many those are.

    bfloat16 comes as float32, everything else as it is stored. Raises: OSError; ValueError if the file is no zip-format
    checkpoint or a damaged one, if its pickle asks for anything but tensors, or if a storage is missing or too short,
    naming it.
    """
    with open(path, "rb") as file:
        try:
            with zipfile.ZipFile(file) as archive:
                return _read_archive(archive, os.path.getsize(path), skip_prefix)
        except BROKEN as error:
            raise ValueError(
                f"{path} is no zip-format checkpoint (torch.save since 1.6), or damaged: {error}"
            ) from error
        except ValueError as error:
            raise ValueError(f"{path}: {error}") from error


def _read_archive(archive: zipfile.ZipFile, size: int, skip_prefix: str | None) -> tuple[dict[str, np.ndarray], int]:
    if sum(member.file_size for member in archive.infolist()) > LARGEST_RATIO * size:
        raise ValueError(f"its members unpack to more than {LARGEST_RATIO} times the size of the file")
    names = archive.namelist()
    pickles = [name for name in names if name.count("/") == 1 and name.endswith("/data.pkl")]
    if len(pickles) != 1:
        raise ValueError(f"expected one <name>/data.pkl inside, found {pickles}")
    root = pickles[0].removesuffix("data.pkl")
    if f"{root}byteorder" in names and archive.read(f"{root}byteorder").strip() != b"little":
        raise ValueError("only little-endian checkpoints are supported")
    with archive.open(pickles[0]) as file:
        try:
            content = _StateDictUnpickler(file).load()
        except BROKEN:
            raise
        except Exception as error:  # a broken pickle raises nearly anything
            raise ValueError(str(error) or f"its pickle is damaged ({type(error).__name__})") from error
    if not isinstance(content, dict) or not isinstance(content.get(STATE_DICT), dict):
        raise ValueError(f"expected a dict with a state dict under {STATE_DICT!r}")
    model = content[STATE_DICT]
    if not all(isinstance(key, str) for key in model):
        raise ValueError("the state dict has a key that is no string")
    wanted = {key: x for key, x in model.items() if skip_prefix is None or not key.startswith(skip_prefix)}
    for key, value in wanted.items():
        if not isinstance(value, _Tensor):
            raise ValueError(f"{STATE_DICT}[{key!r}] is no tensor but {type(value).__name__}")
    return {key: _read_tensor(archive, root, key, value) for key, value in wanted.items()}, len(model) - len(wanted)


def _read_tensor(archive: zipfile.ZipFile, root: str, key: str, tensor: _Tensor) -> np.ndarray:
    """The numbers of one tensor, bounds checked."""
    (kind, member), offset, shape, strides = tensor
    dtype = STORAGE_DTYPES[kind]
    try:
        data = np.frombuffer(archive.read(f"{root}data/{member}"), dtype)
    except (KeyError, ValueError, *BROKEN) as error:
        raise ValueError(f"{key}: storage {member} is missing or damaged: {error}") from error
    last = offset + sum((n - 1) * stride for n, stride in zip(shape, strides, strict=True))
    count = math.prod(shape)  # views of parameters never repeat numbers: a larger one is a bomb
    if count > len(data) or (count and last >= len(data)):
        raise ValueError(f"{key}: shape {shape} does not fit storage {member} of {len(data)} numbers")
    if not count:
        return np.zeros(shape, dtype)
    steps = tuple(stride * dtype.itemsize for stride in strides)
    view = np.lib.stride_tricks.as_strided(data[offset:], shape, steps, writeable=False)
    array = np.ascontiguousarray(view).reshape(shape)
    return (array.astype(np.uint32) << 16).view(np.float32) if kind == "BFloat16Storage" else array
