"""npz archives: written whole or not at all, read without pickle, every kind of damage one error line."""

import contextlib
import io
import math
import os
import threading
import zipfile
from collections.abc import Callable, Generator, Mapping
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from humangs_jax.io.atomic import replace_file
from humangs_jax.io.reading import Refused, check_limit, check_unpacked, open_file, reading

_ONE_AT_A_TIME = threading.Lock()
"""numpy reads the header of an array through Python's syntax trees, and CPython 3.11 counts the depth of these for all
threads together: two at once are rarely, but then "AST constructor recursion depth mismatch" (python/cpython#106905)."""
_HEADERS = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
LONGEST_HEADER = 512
"""Characters; that of a plain array takes some hundred, and longer ones can exhaust Python's parser."""
PLAIN_KINDS = "biufcSU"
"""Kinds of dtypes that are read: numbers and strings, no objects, no records."""


def read_npz(path: str | Path, wanted: Callable[[str], bool] | None = None) -> tuple[dict[str, np.ndarray], tuple[str, ...]]:
    """The arrays of an npz archive by name, and the names of the entries that are pickled objects (never read).

    Arguments: wanted: which names to read; None: all.
    Raises: FileNotFoundError; FileError if the file is no npz archive, is damaged, or is larger than the limits allow.
    """
    arrays, pickled = {}, []
    with reading(path, "npz archive"), open_file(path) as file:
        if file.read(6) == np.lib.format.MAGIC_PREFIX:
            raise ValueError("a single array (npy), expected an npz archive")
        with open_archive(file, os.path.getsize(path)) as archive:
            for info in archive.infolist():
                name = info.filename.removesuffix(".npy")
                if wanted is not None and not wanted(name):
                    continue
                with archive.open(info) as member:
                    try:
                        array = _read_array(member, info.file_size)
                    except Refused as error:
                        raise Refused(f"{name}: {error}") from error
                if array is None:
                    pickled.append(name)
                else:
                    arrays[name] = array
    return arrays, tuple(pickled)


@contextlib.contextmanager
def open_archive(file: BinaryIO | io.BytesIO, size: int) -> Generator[zipfile.ZipFile]:
    """A zip archive whose members together stay within the limits.

    Raises: Refused; what zipfile raises for damaged archives.
    """
    ending = zipfile._EndRecData(file)  # ty: ignore[missing-attribute]  the list of members is not read yet
    if not ending:
        raise zipfile.BadZipFile("not a zip archive, or cut off")
    check_limit("members", ending[5] // 46, "members")  # each takes 46 bytes and its name
    with zipfile.ZipFile(file) as archive:
        members = archive.infolist()
        if len({member.filename for member in members}) < len(members):
            raise Refused("two members of one name")
        if strange := [m.filename for m in members if m.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)]:
            raise Refused(f"{strange[0]}: compressed by a method that is not read")
        check_unpacked(size, sum(member.file_size for member in members))
        yield archive


def read_header(file: Any) -> tuple[tuple[int, ...], bool, np.dtype]:
    """Shape, order (columns first?) and type of an npy array, whose bytes follow in the file. Raises: Refused."""
    version = np.lib.format.read_magic(file)
    if version not in _HEADERS:
        raise Refused(f"version {version} of the npy format is not read")
    with _ONE_AT_A_TIME:
        return _HEADERS[version](file, max_header_size=LONGEST_HEADER)


def _read_array(member: Any, size: int) -> np.ndarray | None:
    """The array of a member of `size` bytes; None for pickled objects. Nothing is made before its size is checked."""
    shape, columns_first, dtype = read_header(member)
    if dtype.hasobject:
        return None
    if dtype.kind not in PLAIN_KINDS or (dtype.itemsize == 0 and math.prod(shape) > 1):
        raise Refused(f"expected numbers or strings, got {dtype}")
    if min(shape, default=0) < 0 or math.prod(shape) * dtype.itemsize != (left := size - member.tell()):
        raise Refused(f"shape {shape} of {dtype} does not fit its {size - member.tell():,} bytes")
    data = np.empty(left, np.uint8)
    at = 0
    while at < left:
        piece = member.read(min(left - at, 1 << 22))
        if not piece:
            raise EOFError("cut off")
        data[at : at + len(piece)] = np.frombuffer(piece, np.uint8)
        at += len(piece)
    return plain_array(data, dtype, shape[::-1]).T if columns_first else plain_array(data, dtype, shape)


def plain_array(data: Any, dtype: np.dtype, shape: tuple[int, ...]) -> np.ndarray:
    """An array of the machine's byte order from bytes of a file, which may hold what numpy itself never writes."""
    array = np.frombuffer(data, dtype).reshape(shape) if dtype.itemsize else np.zeros(shape, dtype)
    if dtype.kind == "b":
        return array.view(np.uint8) != 0
    array = array.astype(dtype.newbyteorder("="), copy=False)
    if dtype.kind == "U" and array.size and np.ascontiguousarray(array).reshape(-1).view(np.uint32).max() > 0x10FFFF:
        raise Refused("strings with characters that do not exist")
    return array


def write_npz(path: str | os.PathLike[str], arrays: Mapping[str, Any], compressed: bool = True) -> None:
    """Write an npz archive of array-likes by name, under any suffix; it appears whole or not at all. Raises: OSError."""
    save = np.savez_compressed if compressed else np.savez
    converted: dict[str, Any] = {name: np.asarray(value) for name, value in arrays.items()}

    def write(temporary: Path) -> None:
        with open(temporary, "wb") as file:  # numpy would add .npz to a name
            save(file, **converted)

    replace_file(path, write)
