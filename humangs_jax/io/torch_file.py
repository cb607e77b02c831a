"""Tensors of a file that `torch.save` wrote, without torch and without running anything in it (see `torch_pickle`).

Both formats are read. Since torch 1.6 it is a zip archive of the pickle and one member per storage. Before (and in what
the lpips wheel ships) it is a stream: three pickles of a magic number, a version and the byte order; the pickle itself;
a pickled list of the storages' names; then of each storage the count of its numbers and the numbers. Only the storages
of wanted tensors are read.
"""

import os
import struct
import zipfile
import zlib
from collections.abc import Callable
from typing import Any, BinaryIO

import numpy as np

from humangs_jax.io.torch_pickle import StateDictUnpickler, Storage, Tensor, read_tensor, state_dict_tensors

ZIP_START = b"PK\x03\x04"
PICKLE_START = b"\x80"
MAGIC_NUMBER = 0x1950A86A20F9469CFC6C
"""What the older format begins with."""
STREAM_VERSION = 1001
LARGEST_RATIO = 16
"""Members may unpack to this many times the size of the file: torch does not compress at all."""
BROKEN = (zipfile.BadZipFile, zlib.error, EOFError, NotImplementedError, RuntimeError, OSError, struct.error)
"""What zipfile raises for damaged, truncated, encrypted or exotic archives."""

Wanted = Callable[[str], bool]
Tensors = dict[str, np.ndarray]


def everything(key: str) -> bool:
    """Wants every tensor."""
    return True


def read_torch_file(path: str | os.PathLike, wanted: Wanted = everything) -> tuple[Tensors, int]:
    """The tensors of the state dict in a file whose name is wanted, and how many others there are.

    bfloat16 comes as float32, everything else as it is stored. Raises: OSError; ValueError if the file is no checkpoint
    or a damaged one, if its pickle asks for anything but tensors, or if a storage is missing or too short, naming it.
    """
    size = os.path.getsize(path)
    with open(path, "rb") as file:
        start = file.read(4)
        file.seek(0)
        try:
            if start.startswith(PICKLE_START):
                return _read_stream(file, size, wanted)
            if start != ZIP_START:
                raise ValueError("neither of the formats that torch.save writes")
            with zipfile.ZipFile(file) as archive:
                return _read_archive(archive, size, wanted)
        except BROKEN as error:
            raise ValueError(f"{path}: a damaged torch file: {error}") from error
        except ValueError as error:
            raise ValueError(f"{path}: {error}") from error


def _unpickle(unpickler: StateDictUnpickler) -> Any:
    try:
        return unpickler.load()
    except BROKEN:
        raise
    except Exception as error:  # a broken pickle raises nearly anything
        raise ValueError(str(error) or f"its pickle is damaged ({type(error).__name__})") from error


def _read_archive(archive: zipfile.ZipFile, size: int, wanted: Wanted) -> tuple[Tensors, int]:
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
        tensors, skipped = state_dict_tensors(_unpickle(StateDictUnpickler(file)), wanted)

    def read(key: str, storage: Storage) -> np.ndarray:
        try:
            return np.frombuffer(archive.read(f"{root}data/{storage.name}"), storage.dtype)
        except (KeyError, ValueError, *BROKEN) as error:
            raise ValueError(f"{key}: storage {storage.name} is missing or damaged: {error}") from error

    return _read_tensors(tensors, read), skipped


def _read_stream(file: BinaryIO, size: int, wanted: Wanted) -> tuple[Tensors, int]:
    if _unpickle(StateDictUnpickler(file)) != MAGIC_NUMBER:
        raise ValueError("a pickle, but neither of the formats that torch.save writes")
    if (version := _unpickle(StateDictUnpickler(file))) != STREAM_VERSION:
        raise ValueError(f"version {version!r} of the older format, expected {STREAM_VERSION}")
    machine = _unpickle(StateDictUnpickler(file))
    if not (isinstance(machine, dict) and machine.get("little_endian") is True):
        raise ValueError("only little-endian checkpoints are supported")
    unpickler = StateDictUnpickler(file)
    tensors, skipped = state_dict_tensors(_unpickle(unpickler), wanted)
    places = _storage_places(file, size, unpickler.kinds)

    def read(key: str, storage: Storage) -> np.ndarray:
        if storage.name not in places:
            raise ValueError(f"{key}: storage {storage.name} is missing")
        start, count = places[storage.name]
        file.seek(start)
        return np.frombuffer(file.read(count * storage.dtype.itemsize), storage.dtype)

    return _read_tensors(tensors, read), skipped


def _storage_places(file: BinaryIO, size: int, kinds: dict[str, str]) -> dict[str, tuple[int, int]]:
    """Where in the stream the numbers of each storage begin, and how many they are."""
    names, places = _unpickle(StateDictUnpickler(file)), {}
    if not (isinstance(names, list) and all(isinstance(name, str) and name in kinds for name in names)):
        raise ValueError("its list of storages names one that no tensor has")
    for name in names:
        (count,) = struct.unpack("<q", file.read(8))
        start = file.tell()
        end = start + count * Storage(kinds[name], name).dtype.itemsize
        if count < 0 or end > size:
            raise ValueError(f"storage {name} of {count} numbers does not fit the file: truncated?")
        places[name] = start, count
        file.seek(end)
    return places


def _read_tensors(tensors: dict[str, Tensor], read: Callable[[str, Storage], np.ndarray]) -> Tensors:
    return {key: read_tensor(read(key, tensor.storage), key, tensor) for key, tensor in tensors.items()}
