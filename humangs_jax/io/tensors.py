"""Named tensors of a file: safetensors, or either format of `torch.save`, without torch and without running anything in it.

The first bytes of a file decide; its name does not matter. For torch's formats the unpickler (`restricted_pickle`) knows the
calls which rebuild the tensors of a state dict and refuses every other name. What those calls return is immutable, so that no
later instruction of the pickle can change it. A tensor comes out as a description: a view of a storage, whose numbers lie
elsewhere in the file. Only the storages of wanted tensors are read.

Since torch 1.6 a file is a zip archive of the pickle and one member per storage. Before (and in what the lpips wheel ships) it is
a stream: three pickles of a magic number, a version and the byte order; the pickle itself; a pickled list of the storages' names;
then of each storage the count of its numbers and the numbers.
"""

import functools
import io
import math
import mmap
import os
import struct
import zipfile
import zlib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from humangs_jax.io.arrays import open_archive, read_header
from humangs_jax.io.reading import Refused, check_limit, check_unpacked, limits, open_file, read_bytes, reading, shown
from humangs_jax.io.restricted_pickle import NAMES, Call, RestrictedUnpickler, objects

ZIP_START = b"PK\x03\x04"
PICKLE_START = b"\x80"
MAGIC_NUMBER = 0x1950A86A20F9469CFC6C
"""First value of the older format."""
STREAM_VERSION = 1001
LARGEST_RATIO = 16
"""Members may unpack to this many times the size of the file: torch does not compress at all."""
LARGEST_SHARE = 4
"""Tensors may take this many times the size of the file: bfloat16 is widened, and weights may be tied."""
BROKEN = (zipfile.BadZipFile, zlib.error, EOFError, NotImplementedError, RuntimeError, OSError, struct.error)
"""What zipfile raises for damaged, truncated, encrypted or exotic archives."""

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
STATE_DICTS = ("model", "state_dict")
"""Keys under which training scripts keep the state dict; what lies under others (the optimizer's state) is never read."""


# The pickle -----------------------------------------------------------------------------------------------------------


class _StorageType(NamedTuple):
    """Stands for a `torch.*Storage` class."""

    name: str


class _Storage(NamedTuple):
    """A run of stored numbers: their type, the name of the storage, and the position of the first."""

    kind: str
    name: str
    start: int = 0
    held: Mapping[str, Any] | None = None
    """The bytes of all storages by name, where they are read with the pickle."""

    @property
    def dtype(self) -> np.dtype:
        """Type of the numbers as stored."""
        return STORAGE_DTYPES[self.kind]


class _Tensor(NamedTuple):
    """A tensor that is not read yet: a view of a storage, offset and strides in elements."""

    storage: _Storage
    offset: int
    shape: tuple[int, ...]
    strides: tuple[int, ...]

    def to_array(self) -> np.ndarray:
        """For `as_array`, of a tensor whose storage is held."""
        held = self.storage.held or {}
        if self.storage.name not in held:
            raise Refused(f"storage {self.storage.name} of a tensor is missing")
        return _read_tensor(np.frombuffer(held[self.storage.name], self.storage.dtype), "a tensor", self)


def _counts(x: Any) -> bool:
    return type(x) is tuple and all(type(n) is int and n >= 0 for n in x)


def _rebuild_tensor(storage: Any, offset: Any, shape: Any, strides: Any, *_: Any) -> _Tensor:
    if not (isinstance(storage, _Storage) and _counts((offset,)) and _counts(shape) and _counts(strides)):
        raise Refused("a tensor without a storage, or whose offset, shape or strides are no counts")
    if len(shape) != len(strides):
        raise Refused(f"a tensor with {len(shape)} axes and {len(strides)} strides")
    if len(shape) > MOST_AXES:
        raise Refused(f"a tensor with {len(shape)} axes")
    return _Tensor(storage, offset, shape, strides)


def _rebuild_parameter(tensor: Any, *_: Any) -> _Tensor:
    if not isinstance(tensor, _Tensor):
        raise Refused("a parameter that is no tensor")
    return tensor


def _ordered_dict(*arguments: Any) -> dict:
    """An empty one, whose items follow. Python 2 wrote them before, as a list of [key, value]."""
    pairs = arguments[0] if arguments else []
    if len(arguments) > 1 or type(pairs) is not list:
        raise Refused("an ordered dict that is made of something else than a list of pairs")
    if not all(type(pair) is list and len(pair) == 2 and type(pair[0]) is str for pair in pairs):
        raise Refused("an ordered dict that is made of something else than pairs of a name and a value")
    made = {key: value for key, value in pairs}
    pairs.clear()  # a pickle may name one list many times: each of its instructions makes one item, no more
    return made


MOST_AXES = 32
_NAMES: dict[tuple[str, str], Any] = {
    ("torch._utils", "_rebuild_tensor"): Call(_rebuild_tensor),
    ("torch._utils", "_rebuild_tensor_v2"): Call(_rebuild_tensor),
    ("torch._utils", "_rebuild_parameter"): Call(_rebuild_parameter),
    ("collections", "OrderedDict"): Call(_ordered_dict),
    **{("torch", name): _StorageType(name) for name in STORAGE_DTYPES},
}


class _StateDictUnpickler(RestrictedUnpickler):
    """Knows tensors, ordered dicts and storages; `kinds` is the type of each storage that it read."""

    def __init__(self, file: Any, held: Mapping[str, Any] | None = None, names: Mapping = _NAMES) -> None:
        super().__init__(file, names, "no part of a state dict" if names is _NAMES else "it is not needed to hold arrays")
        self.kinds: dict[str, str] = {}
        self.held = held

    def persistent_load(self, pid: Any) -> _Storage:
        """A storage. The older format adds None, or says which part of another storage this one is."""
        known = type(pid) is tuple and len(pid) in (5, 6) and pid[0] == "storage"
        if not (known and isinstance(pid[1], _StorageType) and isinstance(pid[2], str)):
            raise Refused("refused to load a persistent object that is no storage")
        if self.kinds.setdefault(pid[2], pid[1].name) != pid[1].name:
            raise Refused(f"storage {pid[2]} is of two types")
        part = pid[5] if len(pid) == 6 else None
        if part is None:
            return _Storage(pid[1].name, pid[2], 0, self.held)
        if not (type(part) is tuple and len(part) == 3 and _counts(part[1:])):
            raise Refused("a part of a storage whose place is no count")
        return _Storage(pid[1].name, pid[2], part[1], self.held)


def _state_dict_tensors(content: Any, wanted: Callable[[str], bool]) -> tuple[dict[str, _Tensor], int]:
    """The wanted tensors of the state dict in what was unpickled, and how many others it has.

    The state dict is what lies under one of `STATE_DICTS`, or else the content itself. Raises: Refused.
    """
    label = next((key for key in STATE_DICTS if isinstance(content, dict) and isinstance(content.get(key), dict)), None)
    model = content if label is None else content[label]
    if not isinstance(model, dict) or (label is None and not any(isinstance(x, _Tensor) for x in model.values())):
        names = " or ".join(map(repr, STATE_DICTS))
        raise Refused(f"expected a state dict, or a dict with one under {names}")
    if not all(isinstance(key, str) for key in model):
        raise Refused("the state dict has a key that is no string")
    chosen = {key: x for key, x in model.items() if wanted(key)}
    for key, value in chosen.items():
        if not isinstance(value, _Tensor):
            raise Refused(f"{label or 'state_dict'}[{shown(key)}] is no tensor but {type(value).__name__}")
    return chosen, len(model) - len(chosen)


def _read_tensor(data: np.ndarray, key: str, tensor: _Tensor) -> np.ndarray:
    """The numbers of a tensor from those of its storage, bounds checked. bfloat16 becomes float32. Raises: Refused."""
    storage, offset, shape, strides = tensor
    offset += storage.start
    last = offset + sum((n - 1) * stride for n, stride in zip(shape, strides, strict=True))
    count = math.prod(shape)  # views of parameters never repeat numbers: a larger one is a bomb
    if count > len(data) or (count and last >= len(data)):
        raise Refused(f"{key}: shape {shape} does not fit storage {storage.name} of {len(data)} numbers")
    if not count:
        return np.zeros(shape, data.dtype)
    steps = tuple(stride * data.itemsize for stride in strides)
    view = np.lib.stride_tricks.as_strided(data[offset:], shape, steps, writeable=False)
    array = np.ascontiguousarray(view).reshape(shape)
    return (array.astype(np.uint32) << 16).view(np.float32) if storage.kind == "BFloat16Storage" else array


# The file -------------------------------------------------------------------------------------------------------------


def everything(key: str) -> bool:
    """Wants every tensor."""
    return True


def read_torch_file(path: str | os.PathLike[str], wanted: Wanted = everything) -> tuple[Tensors, int]:
    """The tensors of the state dict in a file whose name is wanted, and how many others there are.

    bfloat16 comes as float32, everything else as it is stored.
    Raises: FileNotFoundError; FileError if the file is no checkpoint or a damaged one, if its pickle asks for more than
    tensors, or if a storage is missing or too short, naming it.
    """
    with reading(path, "torch file"), open_file(path) as file:
        size = os.path.getsize(path)
        start = file.read(4)
        file.seek(0)
        if start.startswith(PICKLE_START):
            with mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as content:
                return _read_stream(content, size, wanted)
        if start != ZIP_START:
            raise Refused("neither of the formats that torch.save writes")
        with open_archive(file, size) as archive:
            return _read_archive(archive, size, wanted)


def _archived_pickle(archive: zipfile.ZipFile, size: int) -> tuple[io.BytesIO, str]:
    """The pickle in an archive, and what the names of its members begin with."""
    if sum(member.file_size for member in archive.infolist()) > LARGEST_RATIO * size:
        raise Refused(f"its members unpack to more than {LARGEST_RATIO} times the size of the file")
    names = set(archive.namelist())
    pickles = [name for name in names if name.count("/") == 1 and name.endswith("/data.pkl")]
    if len(pickles) != 1:
        raise Refused(f"expected one <name>/data.pkl inside, found {len(pickles)}")
    root = pickles[0].removesuffix("data.pkl")
    if f"{root}byteorder" in names and archive.read(f"{root}byteorder").strip() != b"little":
        raise Refused("only little-endian checkpoints are supported")
    check_limit("text_bytes", archive.getinfo(pickles[0]).file_size, "bytes of a pickle")
    return io.BytesIO(archive.read(pickles[0])), root


def _read_archive(archive: zipfile.ZipFile, size: int, wanted: Wanted) -> tuple[Tensors, int]:
    file, root = _archived_pickle(archive, size)
    tensors, skipped = _state_dict_tensors(_StateDictUnpickler(file).load(), wanted)

    def read(key: str, storage: _Storage) -> np.ndarray:
        try:
            return np.frombuffer(archive.read(f"{root}data/{storage.name}"), storage.dtype)
        except (KeyError, ValueError, *BROKEN) as error:
            raise Refused(f"{key}: storage {storage.name} is missing or damaged: {error}") from error

    return _read_tensors(tensors, size, read), skipped


def _check_stream(file: Any) -> None:
    """The three pickles before that of the content."""
    if _StateDictUnpickler(file).load() != MAGIC_NUMBER:
        raise Refused("a pickle, but neither of the formats that torch.save writes")
    if (version := _StateDictUnpickler(file).load()) != STREAM_VERSION:
        raise Refused(f"version {shown(version)} of the older format, expected {STREAM_VERSION}")
    machine = _StateDictUnpickler(file).load()
    if not (isinstance(machine, dict) and machine.get("little_endian") is True):
        raise Refused("only little-endian checkpoints are supported")


def _read_stream(file: Any, size: int, wanted: Wanted) -> tuple[Tensors, int]:
    _check_stream(file)
    unpickler = _StateDictUnpickler(file)
    tensors, skipped = _state_dict_tensors(unpickler.load(), wanted)
    places = _storage_places(file, size, unpickler.kinds)

    def read(key: str, storage: _Storage) -> np.ndarray:
        if storage.name not in places:
            raise Refused(f"{key}: storage {storage.name} is missing")
        start, count = places[storage.name]
        file.seek(start)
        return np.frombuffer(file.read(count * storage.dtype.itemsize), storage.dtype)

    return _read_tensors(tensors, size, read), skipped


def _storage_places(file: Any, size: int, kinds: dict[str, str]) -> dict[str, tuple[int, int]]:
    """Where in the stream the numbers of each storage begin, and how many they are."""
    names, places = _StateDictUnpickler(file).load(), {}
    if not (isinstance(names, list) and all(isinstance(name, str) and name in kinds for name in names)):
        raise Refused("its list of storages names one that no tensor has")
    for name in names:
        (count,) = struct.unpack("<q", file.read(8))
        start = file.tell()
        end = start + count * _Storage(kinds[name], name).dtype.itemsize
        if count < 0 or end > size:
            raise Refused(f"storage {name} of {count} numbers does not fit the file: truncated?")
        places[name] = start, count
        file.seek(end)
    return places


def _read_tensors(tensors: dict[str, _Tensor], size: int, read: Callable[[str, _Storage], np.ndarray]) -> Tensors:
    """Each storage is read once, however many tensors share it; what they take together is bounded by the file's size."""
    arrays, of_storage, left = {}, {}, LARGEST_SHARE * size
    for key, tensor in tensors.items():
        of_storage.setdefault(tensor.storage.name, []).append(key)
    for keys in of_storage.values():
        data = read(keys[0], tensors[keys[0]].storage)
        for key in keys:
            left -= math.prod(tensors[key].shape) * data.itemsize
            arrays[key] = _read_tensor(data, key, tensors[key])
            if left < 0:
                raise Refused(f"{key}: the tensors take more than {LARGEST_SHARE} times the size of the file")
    return {key: arrays[key] for key in tensors}


def read_tensors(path: str | os.PathLike[str], wanted: Wanted = everything) -> tuple[Tensors, int]:
    """The tensors whose name is wanted, and how many others the file has. Nothing in the file is run.

    Raises: FileNotFoundError; FileError if it is none of these formats, is damaged, or asks for more than tensors.
    """
    return read_safetensors(path, wanted)[:2] if is_safetensors(path) else read_torch_file(path, wanted)


def is_safetensors(path: str | os.PathLike[str]) -> bool:
    """Whether a file begins as safetensors files do: with the length of a JSON object, and its brace."""
    with reading(path, "file of tensors"), open_file(path) as file:
        start = file.read(9)
    return start[8:] == b"{" and struct.unpack("<Q", start[:8])[0] < 1 << 32


def read_safetensors(path: str | os.PathLike[str], wanted: Wanted = everything) -> tuple[Tensors, int, dict[str, str]]:
    """The tensors whose name is wanted, how many others the file has, and the strings in its header.

    Raises: FileNotFoundError; FileError.
    """
    from safetensors import safe_open

    with reading(path, "safetensors file"):
        with open_file(path) as start:
            check_limit("slow_text_bytes", int.from_bytes(start.read(8), "little"), "bytes of a header")
        with safe_open(Path(path), framework="numpy") as file:
            keys = list(file.keys())
            tensors = {key: np.asarray(file.get_tensor(key)) for key in keys if wanted(key)}
            return tensors, len(keys) - len(tensors), file.metadata() or {}


# Values of any kind ---------------------------------------------------------------------------------------------------

STREAM_START = b"\x8a\x0a" + MAGIC_NUMBER.to_bytes(10, "little")
"""The magic number in the first pickle of the older format, behind the protocol."""
COMPRESSED = (b"\x78\x01", b"\x78\x5e", b"\x78\x9c", b"\x78\xda", b"\x1f\x8b")
"""How zlib's streams and gzip's begin, in which joblib writes."""


def read_values(path: str | os.PathLike[str]) -> Any:
    """What a pickle, a file of joblib or `torch.save`, or an npy of an object holds: dicts, lists and what `as_array` takes.

    Nothing in the file is run. Raises: FileNotFoundError; FileError as `read_pickle`.
    """
    with reading(path, "pickle"):
        data = read_bytes(path, "array_bytes")
        if data[:2] in COMPRESSED:
            most = max(limits().plain_bytes, limits().ratio * len(data))
            unpacked = zlib.decompressobj(47).decompress(data, most + 1)
            check_unpacked(len(data), len(unpacked))
            data = unpacked
        file, held = io.BytesIO(data), {}
        if data.startswith(ZIP_START):
            with open_archive(file, len(data)) as archive:
                content, root = _archived_pickle(archive, len(data))
                start = f"{root}data/"
                held = {name.removeprefix(start): archive.read(name) for name in archive.namelist() if name.startswith(start)}
                return _values(content, held)
        if data.startswith(np.lib.format.MAGIC_PREFIX):
            if not read_header(file)[2].hasobject:
                raise Refused("a single array: expected a dict of arrays by name")
            return objects(_values(file, held))
        if data[2:14] == STREAM_START:
            _check_stream(file)
            return _stream_values(file, len(data), held, _names())
        return _values(file, held)


def _values(file: Any, held: Mapping[str, Any]) -> Any:
    return _StateDictUnpickler(file, held, _names()).load()


def _names() -> dict[tuple[str, str], Any]:
    """Arrays and tensors. A plain pickle has a file of the older format for each storage; the same bytes are read once."""
    of_bytes = Call(functools.cache(_storage_of_bytes))
    more = {("torch.storage", "_load_from_bytes"): of_bytes, ("torch", "device"): Call(lambda *_: None)}
    return NAMES | _NAMES | more


def _stream_values(file: Any, size: int, held: dict[str, Any], names: Mapping) -> Any:
    """The content of a stream, behind the check; fills `held`."""
    unpickler = _StateDictUnpickler(file, held, names)
    content = unpickler.load()
    for name, (start, count) in _storage_places(file, size, unpickler.kinds).items():
        file.seek(start)
        held[name] = file.read(count * _Storage(unpickler.kinds[name], name).dtype.itemsize)
    return content


def _storage_of_bytes(data: Any) -> _Storage:
    if type(data) is not bytes:
        raise Refused("a storage that is not of bytes")
    file = io.BytesIO(data)
    _check_stream(file)
    storage = _stream_values(file, len(data), {}, _NAMES)
    if not isinstance(storage, _Storage):
        raise Refused("a storage of a tensor that is none")
    return storage
