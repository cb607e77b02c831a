"""The pickle inside a `torch.save` file, read without torch and without running anything in it.

The unpickler knows the calls which rebuild the tensors of a state dict and refuses everything else by name. What those
calls return is immutable, so that no later instruction of the pickle can change it. A tensor comes out as a description:
a view of a storage, whose numbers lie elsewhere in the file.
"""

import collections
import math
import pickle
from collections.abc import Callable
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
STATE_DICTS = ("model", "state_dict")
"""Keys under which training scripts keep the state dict; what lies under others (the optimizer's state) is never read."""


class _StorageType(NamedTuple):
    """Stands for a `torch.*Storage` class."""

    name: str


class Storage(NamedTuple):
    """Which numbers: their type, the name of the storage that holds them, how many of its numbers come before."""

    kind: str
    name: str
    start: int = 0

    @property
    def dtype(self) -> np.dtype:
        """Of the numbers as they are stored."""
        return STORAGE_DTYPES[self.kind]


class Tensor(NamedTuple):
    """A tensor that is not read yet: a view of a storage, offset and strides in elements."""

    storage: Storage
    offset: int
    shape: tuple[int, ...]
    strides: tuple[int, ...]


def _counts(x: Any) -> bool:
    return type(x) is tuple and all(type(n) is int and n >= 0 for n in x)


class _RebuildTensor:
    __slots__ = ()

    def __call__(self, storage: Any, offset: Any, shape: Any, strides: Any, *_: Any) -> Tensor:
        if not (isinstance(storage, Storage) and _counts((offset,)) and _counts(shape) and _counts(strides)):
            raise pickle.UnpicklingError("a tensor without a storage, or whose offset, shape or strides are no counts")
        if len(shape) != len(strides):
            raise pickle.UnpicklingError(f"a tensor with {len(shape)} axes and {len(strides)} strides")
        return Tensor(storage, offset, shape, strides)


class _RebuildParameter:
    __slots__ = ()

    def __call__(self, tensor: Any, *_: Any) -> Any:
        return tensor


_ALLOWED = {
    ("torch._utils", "_rebuild_tensor"): _RebuildTensor(),
    ("torch._utils", "_rebuild_tensor_v2"): _RebuildTensor(),
    ("torch._utils", "_rebuild_parameter"): _RebuildParameter(),
    ("collections", "OrderedDict"): collections.OrderedDict,
    **{("torch", name): _StorageType(name) for name in STORAGE_DTYPES},
}


class StateDictUnpickler(pickle.Unpickler):
    """Knows tensors, ordered dicts and storages; `kinds` tells the type of each storage that it met."""

    def __init__(self, file: Any) -> None:
        super().__init__(file)
        self.kinds: dict[str, str] = {}

    def find_class(self, module: str, name: str) -> Any:
        """What stands for a name of the pickle."""
        if (module, name) not in _ALLOWED:
            module = "builtins" if module == "__builtin__" else module  # its name in protocol 2, which torch writes
            raise pickle.UnpicklingError(f"refused to load {module}.{name}: no part of a state dict")
        return _ALLOWED[module, name]

    def persistent_load(self, pid: Any) -> Storage:
        """A storage. The older format adds None, or says which part of another storage this one is."""
        known = isinstance(pid, tuple) and len(pid) in (5, 6) and pid[0] == "storage"
        if not (known and isinstance(pid[1], _StorageType) and isinstance(pid[2], str)):
            raise pickle.UnpicklingError("refused to load a persistent object that is no storage")
        if self.kinds.setdefault(pid[2], pid[1].name) != pid[1].name:
            raise pickle.UnpicklingError(f"storage {pid[2]} is of two types")
        part = pid[5] if len(pid) == 6 else None
        if part is None:
            return Storage(pid[1].name, pid[2])
        if not (type(part) is tuple and len(part) == 3 and _counts(part[1:])):
            raise pickle.UnpicklingError("a part of a storage whose place is no count")
        return Storage(pid[1].name, pid[2], part[1])


def state_dict_tensors(content: Any, wanted: Callable[[str], bool]) -> tuple[dict[str, Tensor], int]:
    """The wanted tensors of the state dict in what was unpickled, and how many others it has.

    The state dict is what lies under one of `STATE_DICTS`, or else the content itself. Raises: ValueError.
    """
    label = next((key for key in STATE_DICTS if isinstance(content, dict) and isinstance(content.get(key), dict)), None)
    model = content if label is None else content[label]
    if not isinstance(model, dict) or (label is None and not any(isinstance(x, Tensor) for x in model.values())):
        names = " or ".join(map(repr, STATE_DICTS))
        raise ValueError(f"expected a state dict, or a dict with one under {names}")
    if not all(isinstance(key, str) for key in model):
        raise ValueError("the state dict has a key that is no string")
    chosen = {key: x for key, x in model.items() if wanted(key)}
    for key, value in chosen.items():
        if not isinstance(value, Tensor):
            raise ValueError(f"{label or 'state_dict'}[{key!r}] is no tensor but {type(value).__name__}")
    return chosen, len(model) - len(chosen)


def read_tensor(data: np.ndarray, key: str, tensor: Tensor) -> np.ndarray:
    """The numbers of a tensor from those of its storage, bounds checked. bfloat16 becomes float32. Raises: ValueError."""
    storage, offset, shape, strides = tensor
    offset += storage.start
    last = offset + sum((n - 1) * stride for n, stride in zip(shape, strides, strict=True))
    count = math.prod(shape)  # views of parameters never repeat numbers: a larger one is a bomb
    if count > len(data) or (count and last >= len(data)):
        raise ValueError(f"{key}: shape {shape} does not fit storage {storage.name} of {len(data)} numbers")
    if not count:
        return np.zeros(shape, data.dtype)
    steps = tuple(stride * data.itemsize for stride in strides)
    view = np.lib.stride_tricks.as_strided(data[offset:], shape, steps, writeable=False)
    array = np.ascontiguousarray(view).reshape(shape)
    return (array.astype(np.uint32) << 16).view(np.float32) if storage.kind == "BFloat16Storage" else array
