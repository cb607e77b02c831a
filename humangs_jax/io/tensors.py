"""Reads named tensors from safetensors files, and from files that `torch.save` writes, without
torch and without running anything in them.

The first bytes of a file decide its format; its name does not matter. For torch's format the
unpickler (`restricted_pickle`) knows the calls which rebuild the tensors of a state dict, and
refuses every other name. These calls return immutable objects, so that no later instruction of the
pickle can change them. A tensor is read as a description: a view of a storage, whose numbers lie
elsewhere in the file. Only the storages of wanted tensors are read.

A file of torch is a zip archive of the pickle and one member per storage. Before torch 1.6 it was a
stream of pickles and numbers, which is refused. Tensors in a plain pickle still have one such
stream for each storage.
"""

import functools
import io
import math
import os
import struct
import zipfile
import zlib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from humangs_jax.io.arrays import open_archive, read_header
from humangs_jax.io.reading import (
    InvalidFileError,
    check_limit,
    check_unpacked,
    limits,
    open_file,
    read_bytes,
    reading,
    shown,
)
from humangs_jax.io.restricted_pickle import NAMES, Call, PlainDict, RestrictedUnpickler, objects

ZIP_START = b"PK\x03\x04"
STREAM_START = b"\x8a\x0a" + 0x1950A86A20F9469CFC6C.to_bytes(10, "little") + b"."
"""First bytes of a stream of torch, after two bytes that name the protocol. They are the pickle of
a magic number.
"""
OLD_STREAM = (
    "written before torch 1.6: torch.save(torch.load(FILE), FILE) of a newer torch writes it again"
)
"""Error about a file that torch wrote as a stream, with advice."""
LARGEST_RATIO = 16
"""Largest sum of the unpacked sizes of the members, relative to the size of the file. torch does
not compress at all.
"""
LARGEST_SHARE = 4
"""Largest size of the wanted tensors together, as they are stored, relative to the size of the
file. It is above 1 because several tensors may share a storage (tied weights).
"""
MOST_AXES = 32

Wanted = Callable[[str], bool]
Tensors = dict[str, np.ndarray]
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

# The pickle
# --------------------------------------------------------------------------------------------------


class _StorageType(NamedTuple):
    """Stands for a `torch.*Storage` class."""

    name: str
    """Name of the class, a key of `STORAGE_DTYPES`."""


class _Storage(NamedTuple):
    """A run of stored numbers."""

    kind: str
    """Type of the numbers, a key of `STORAGE_DTYPES`."""
    name: str
    """The name of the storage in its file."""
    count: Any
    """Number of numbers, as the pickle gives it."""
    read: Callable[[str], Any]
    """Function that returns the bytes of a storage by its name."""


class _Tensor(NamedTuple):
    """A tensor that is not read yet: a view of a storage."""

    storage: _Storage
    """The storage that holds the numbers."""
    offset: int
    """Index of the first number in the storage."""
    shape: tuple[int, ...]
    """Sizes of the axes."""
    strides: tuple[int, ...]
    """Step along each axis, in elements."""

    def to_array(self) -> np.ndarray:
        """Returns the numbers, after a check of bounds. bfloat16 becomes float32.

        Raises: InvalidFileError.
        """
        (kind, name, _, read), offset, shape, strides = self
        try:
            data = np.frombuffer(read(name), STORAGE_DTYPES[kind])
        except Exception as error:  # zipfile raises some eight types
            raise InvalidFileError(f"storage {name} is missing or damaged: {error}") from error
        last = offset + sum((n - 1) * stride for n, stride in zip(shape, strides, strict=True))
        count = math.prod(shape)  # views of parameters never repeat numbers: a larger one is a bomb
        if count > len(data) or (count and last >= len(data)):
            raise InvalidFileError(
                f"shape {shape} does not fit storage {name} of {len(data)} numbers"
            )
        if not count:
            return np.zeros(shape, data.dtype)
        steps = tuple(stride * data.itemsize for stride in strides)
        view = np.lib.stride_tricks.as_strided(data[offset:], shape, steps, writeable=False)
        array = np.ascontiguousarray(view).reshape(shape)
        if kind == "BFloat16Storage":
            return (array.astype(np.uint32) << 16).view(np.float32)
        return array


def _counts(x: Any) -> bool:
    """Says whether a value is a tuple of integers that are not negative."""
    return type(x) is tuple and all(type(n) is int and n >= 0 for n in x)


def _rebuild_tensor(storage: Any, offset: Any, shape: Any, strides: Any, *_: Any) -> _Tensor:
    if not (
        isinstance(storage, _Storage) and _counts((offset,)) and _counts(shape) and _counts(strides)
    ):
        raise InvalidFileError(
            "a tensor without a storage, or whose offset, shape or strides are no counts"
        )
    if len(shape) != len(strides) or len(shape) > MOST_AXES:
        raise InvalidFileError(f"a tensor with {len(shape)} axes and {len(strides)} strides")
    return _Tensor(storage, offset, shape, strides)


def _rebuild_parameter(tensor: Any, *_: Any) -> _Tensor:
    if not isinstance(tensor, _Tensor):
        raise InvalidFileError("a parameter that is no tensor")
    return tensor


def _ordered_dict(*arguments: Any) -> PlainDict:
    """Returns an empty dict. The pickle adds its items later. Raises: InvalidFileError for
    arguments.
    """
    if arguments:
        raise InvalidFileError("an ordered dict that is made of something")
    return PlainDict()


def _storage_of_bytes(data: bytes) -> _Storage:
    """Returns the storage of a tensor in a plain pickle, which is a separate stream of bytes.

    The stream consists of five pickles, the count of the numbers, and the numbers. The pickles hold
    a magic number, a version, a description of the machine, the storage, and a list with its name.

    Raises: InvalidFileError; anything that pickle raises for damaged streams.
    """
    if data[2:15] != STREAM_START:
        raise InvalidFileError("a storage that is not a stream of torch")
    file = io.BytesIO(data)
    file.seek(2 + len(STREAM_START))
    _, machine, storage = (_TorchUnpickler(file).load() for _ in range(3))
    if not (isinstance(machine, dict) and machine.get("little_endian") is True):
        raise InvalidFileError("only little-endian checkpoints are supported")
    if not isinstance(storage, _Storage) or not _counts((storage.count,)):
        raise InvalidFileError("a storage of a tensor that is none")
    size = storage.count * STORAGE_DTYPES[storage.kind].itemsize
    if size > len(data) - file.tell():
        raise InvalidFileError(
            f"a storage of {storage.count} numbers does not fit its bytes: truncated?"
        )
    numbers = memoryview(data)[len(data) - size :]
    return storage._replace(read=lambda name: numbers)


_NAMES: dict[tuple[str, str], Any] = {
    ("torch._utils", "_rebuild_tensor"): Call(_rebuild_tensor),
    ("torch._utils", "_rebuild_tensor_v2"): Call(_rebuild_tensor),
    ("torch._utils", "_rebuild_parameter"): Call(_rebuild_parameter),
    ("collections", "OrderedDict"): Call(_ordered_dict),
    **{("torch", name): _StorageType(name) for name in STORAGE_DTYPES},
}


class _TorchUnpickler(RestrictedUnpickler):
    """An unpickler that knows tensors, ordered dicts and storages. `read` returns the bytes of a
    storage by its name.
    """

    def __init__(
        self, file: Any, names: Mapping = _NAMES, read: Callable[[str], bytes] | None = None
    ) -> None:
        purpose = "it is not needed to hold arrays"
        if names is _NAMES:
            purpose = "no part of a state dict"
        super().__init__(file, names, purpose)
        self.kinds: dict[str, str] = {}
        self.read_storage = functools.cache(read or {}.__getitem__)

    def persistent_load(self, pid: Any) -> _Storage:
        """Returns the storage that a pickle refers to. Raises: InvalidFileError for any other
        object.
        """
        known = type(pid) is tuple and len(pid) in (5, 6) and pid[0] == "storage"
        if not (known and isinstance(pid[1], _StorageType) and isinstance(pid[2], str)):
            raise InvalidFileError("refused to load a persistent object that is no storage")
        # streams add what part of another storage this one is, which torch has not had since 0.4
        if pid[5:] not in ((), (None,)):
            raise InvalidFileError("a storage that is a part of another one")
        if self.kinds.setdefault(pid[2], pid[1].name) != pid[1].name:
            raise InvalidFileError(f"storage {pid[2]} is of two types")
        return _Storage(pid[1].name, pid[2], pid[4], self.read_storage)


# Files
# --------------------------------------------------------------------------------------------------


def _of_archive(archive: zipfile.ZipFile, size: int, names: Mapping) -> Any:
    """Returns the content of the pickle in an archive. Its tensors can be read while the archive is
    open.

    Raises: as `tensors_in`.
    """
    if sum(member.file_size for member in archive.infolist()) > LARGEST_RATIO * size:
        raise InvalidFileError(
            f"its members unpack to more than {LARGEST_RATIO} times the size of the file"
        )
    members = set(archive.namelist())
    pickles = [name for name in members if name.count("/") == 1 and name.endswith("/data.pkl")]
    if len(pickles) != 1:
        raise InvalidFileError(f"expected one <name>/data.pkl inside, found {len(pickles)}")
    root = pickles[0].removesuffix("data.pkl")
    if f"{root}byteorder" in members and archive.read(f"{root}byteorder").strip() != b"little":
        raise InvalidFileError("only little-endian checkpoints are supported")
    check_limit("text_bytes", archive.getinfo(pickles[0]).file_size, "bytes of a pickle")

    def read(name):
        return archive.read(f"{root}data/{name}")

    return _TorchUnpickler(io.BytesIO(archive.read(pickles[0])), names, read).load()


def everything(key: str) -> bool:
    """Returns True for any name, so that all tensors are wanted."""
    return True


def read_torch_file(
    path: str | os.PathLike[str], wanted: Wanted = everything
) -> tuple[Tensors, int]:
    """Returns the wanted tensors of a state dict by name, and the number of its other entries.

    bfloat16 becomes float32; other types stay as stored.
    Raises: FileNotFoundError; FileError if the file is no checkpoint or a damaged one, if its
    pickle asks for more than tensors, or if a storage is missing or too short.
    """
    with reading(path, "torch file"), open_file(path) as file:
        # keys of training scripts; what lies under others (the optimizer's state) is never read
        keys = ("model", "state_dict")
        return _tensors_of(file, os.path.getsize(path), wanted, keys)


def tensors_in(data: bytes, keys: tuple[str, ...]) -> Tensors:
    """Returns all tensors of the state dict in the bytes of a `torch.save` file. The state dict
    lies under one of `keys`, or is the whole content.

    Raises: InvalidFileError; anything that zipfile and pickle raise for damaged files.
    """
    return _tensors_of(io.BytesIO(data), len(data), everything, keys)[0]


def _tensors_of(file: Any, size: int, wanted: Wanted, keys: tuple[str, ...]) -> tuple[Tensors, int]:
    """Returns the wanted tensors of the state dict in an open file, and the number of its other
    entries. Raises: as `tensors_in`.
    """
    start = file.read(15)
    file.seek(0)
    if start[2:] == STREAM_START:
        raise InvalidFileError(OLD_STREAM)
    if not start.startswith(ZIP_START):
        raise InvalidFileError("no file that torch.save writes")
    with open_archive(file, size) as archive:
        return _state_dict(_of_archive(archive, size, _NAMES), size, wanted, keys)


def _state_dict(
    content: Any, size: int, wanted: Wanted, keys: tuple[str, ...]
) -> tuple[Tensors, int]:
    """Returns the wanted tensors of the state dict in unpickled content, and the number of its
    other entries.

    The state dict lies under one of the keys, or is the content itself. The size of the file bounds
    the size of the tensors together. Raises: InvalidFileError.
    """
    # the dict with the tensors
    model, label = content, None
    for key in keys:
        if isinstance(content, dict) and isinstance(content.get(key), dict):
            model, label = content[key], key
            break
    has_tensors = isinstance(model, dict) and any(isinstance(x, _Tensor) for x in model.values())
    if not isinstance(model, dict) or (label is None and not has_tensors):
        names = " or ".join(map(repr, keys))
        raise InvalidFileError(f"expected a state dict, or a dict with one under {names}")
    if not all(isinstance(key, str) for key in model):
        raise InvalidFileError("the state dict has a key that is no string")
    # those that are wanted
    chosen = {key: tensor for key, tensor in model.items() if wanted(key)}
    for key, tensor in chosen.items():
        if not isinstance(tensor, _Tensor):
            raise InvalidFileError(
                f"{label or 'state_dict'}[{shown(key)}] is no tensor but {type(tensor).__name__}"
            )
    arrays: Tensors = {}
    left, held = LARGEST_SHARE * size, None
    # each storage is read once, and one at a time is held
    for key in sorted(chosen, key=lambda key: chosen[key].storage.name):
        tensor = chosen[key]
        if tensor.storage.name != held:
            held = tensor.storage.name
            tensor.storage.read.cache_clear()
        left -= math.prod(tensor.shape) * STORAGE_DTYPES[tensor.storage.kind].itemsize
        try:
            arrays[key] = tensor.to_array()
        except InvalidFileError as error:
            raise InvalidFileError(f"{key}: {error}") from error
        if left < 0:
            raise InvalidFileError(
                f"{key}: the tensors take more than {LARGEST_SHARE} times the size of the file"
            )
    return {key: arrays[key] for key in chosen}, len(model) - len(chosen)


def read_tensors(path: str | os.PathLike[str], wanted: Wanted = everything) -> tuple[Tensors, int]:
    """Returns the wanted tensors of a file by name, and the number of its other entries. Nothing in
    the file is run.

    Raises: FileNotFoundError; FileError if the file has neither format, is damaged, or asks for
    more than tensors.
    """
    if is_safetensors(path):
        return read_safetensors(path, wanted)[:2]
    return read_torch_file(path, wanted)


def is_safetensors(path: str | os.PathLike[str]) -> bool:
    """Says whether a file begins as safetensors files do: with the length of a JSON object, and its
    opening brace.

    Raises: FileNotFoundError; FileError if the file cannot be read.
    """
    with reading(path, "file of tensors"), open_file(path) as file:
        start = file.read(9)
    return start[8:] == b"{" and struct.unpack("<Q", start[:8])[0] < 1 << 32


def read_safetensors(
    path: str | os.PathLike[str], wanted: Wanted = everything
) -> tuple[Tensors, int, dict[str, str]]:
    """Returns the wanted tensors by name, the number of other tensors, and the texts of the file's
    metadata.

    Raises: FileNotFoundError; FileError.
    """
    from safetensors import safe_open

    with reading(path, "safetensors file"):
        with open_file(path) as start:
            check_limit(
                "slow_text_bytes", int.from_bytes(start.read(8), "little"), "bytes of a header"
            )
        with safe_open(Path(path), framework="numpy") as file:
            keys = list(file.keys())
            tensors = {key: np.asarray(file.get_tensor(key)) for key in keys if wanted(key)}
            return tensors, len(keys) - len(tensors), file.metadata() or {}


def read_values(path: str | os.PathLike[str]) -> Any:
    """Returns the content of a pickle, of a file of joblib or `torch.save`, or of an npy file that
    holds a Python object. The content consists of dicts, lists and values that `as_array` takes.

    Nothing in the file is run. Raises: FileNotFoundError; FileError, which names the file, if the
    file cannot be read or names anything that such values do not need.
    """
    with reading(path, "pickle"):
        data = read_bytes(path, "array_bytes")
        # joblib writes zlib's streams, and gzip's
        if data[:2] in (b"\x78\x01", b"\x78\x5e", b"\x78\x9c", b"\x78\xda", b"\x1f\x8b"):
            most = max(limits().plain_bytes, limits().ratio * len(data))
            unpacked = zlib.decompressobj(47).decompress(data, most + 1)
            check_unpacked(len(data), len(unpacked))
            data = unpacked
        file = io.BytesIO(data)
        read_once = functools.cache(_storage_of_bytes)

        def storage(data: Any) -> _Storage:
            if type(data) is not bytes:  # tuples within tuples would take very long to hash
                raise InvalidFileError("a storage that is not of bytes")
            return read_once(data)

        more = {("torch.storage", "_load_from_bytes"): Call(storage)}
        names = NAMES | _NAMES | more | {("torch", "device"): Call(lambda *_: None)}
        if data.startswith(ZIP_START):
            return _of_archive(open_archive(file, len(data)), len(data), names)
        if data[2:15] == STREAM_START:
            raise InvalidFileError(OLD_STREAM)
        if data.startswith(np.lib.format.MAGIC_PREFIX) and not read_header(file)[2].hasobject:
            raise InvalidFileError("a single array: expected a dict of arrays by name")
        return objects(_TorchUnpickler(file, names).load())
