"""Checks arrays of files, computes their checksums, and reads npz archives without pickle.

The functions `check_...` raise InvalidFileError, see `io.reading`. `ArrayFile` knows its file, so
each of its errors is one line that names the file, and the key if an array is wrong.
"""

import hashlib
import io
import math
import os
import threading
import zipfile
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from humangs_jax.core.array_types import Float, Int
from humangs_jax.core.progress import printable
from humangs_jax.io.atomic import replace_file
from humangs_jax.io.reading import (
    FileError,
    InvalidFileError,
    check_limit,
    check_unpacked,
    open_file,
    reading,
)
from humangs_jax.io.restricted_pickle import as_array, plain_array, read_pickle

SHORT = 16
"""Number of hexadecimal digits (64 bits) of a checksum that names a file or stands in a
manifest.
"""


def numbers(
    value: Any,
    file: object,
    field: str,
    shape: tuple[int | None, ...] | None = None,
    *,
    some: bool = False,
    nulls: bool = False,
    largest: float = math.inf,
    dtype: type[np.floating] = np.float64,
    error: type[FileError] = FileError,
) -> np.ndarray:
    """Returns a value of a file as an array of real numbers. They are finite in float32, unless
    `nulls` is True.

    Arguments:
        file, field: for the error.
        shape: expected sizes of the axes, with None for any size. If shape is None, any shape is
            accepted.
        some: whether there must be at least one number.
        nulls: whether null becomes NaN. Numbers that are not finite are then accepted, too.
        largest: largest magnitude that is allowed. It is not checked if a number is NaN.
        dtype: type of the numbers in the array that is returned.
        error: class of the error.

    Raises: `error` with file, field and what was expected.
    """
    # an array of numbers, in words for an error
    words = "numbers"
    if shape is not None and None not in shape:
        words = f"{' x '.join(map(str, shape))} numbers".lstrip()
    try:
        array = np.asarray(value)
        if nulls and array.dtype.kind == "O":
            known = all(x is None or type(x) in (int, float) for x in array.flat)
            array = array.astype(dtype) if known else array
        if array.dtype.kind not in "fiub":  # numpy would read numbers in words, too
            raise TypeError
        array = array.astype(dtype)
    except (ValueError, TypeError, OverflowError):
        if isinstance(value, np.ndarray):
            words = f"real numbers, got {value.dtype}"
        raise error(file, field, f"expected {words}") from None
    # how many there are
    if some and not array.size:
        raise error(file, field, f"expected at least one number, got shape {array.shape}")
    if shape is not None and not _fits(array, shape):
        raise error(file, field, f"expected shape {_in_words(shape)}, got {array.shape}")
    # what they are
    with np.errstate(over="ignore"):
        finite = np.isfinite(array.astype(np.float32, copy=False))
    if not nulls and not finite.all():
        where = np.argwhere(~finite)[0].tolist()
        raise error(
            file, field, f"expected finite numbers, got {array[tuple(where)]} at index {where}"
        )
    if largest < math.inf and array.size and np.abs(array).max() > largest:
        where = [int(i) for i in np.unravel_index(np.abs(array).argmax(), array.shape)]
        found = f"got {array[tuple(where)]:.4g} at index {where}: another unit?"
        raise error(file, field, f"expected numbers of at most {largest:.4g}, {found}")
    return array


Shape = tuple[int | str | None, ...]
"""Expected sizes of axes. A name or None stands for any size."""


def _fits(array: np.ndarray, shape: Shape) -> bool:
    """Says whether an array has this shape."""
    return array.ndim == len(shape) and all(
        not isinstance(b, int) or a == b for a, b in zip(array.shape, shape, strict=True)
    )


def _in_words(shape: Shape) -> str:
    """Returns a shape as text for an error line."""
    return str(tuple("any" if size is None else size for size in shape)).replace("'", "")


def check_array(
    name: str,
    array: np.ndarray,
    shape: Shape,
    low: float = -math.inf,
    high: float = math.inf,
) -> None:
    """Checks that an array has the shape, and real numbers in [low, high] that are finite in
    float32. Booleans are refused. None and names in the shape stand for any size.

    Raises: InvalidFileError.
    """
    if not _fits(array, shape):
        raise InvalidFileError(f"{name}: expected shape {_in_words(shape)}, got {array.shape}")
    if array.dtype.kind not in "fiu":
        raise InvalidFileError(f"{name}: expected real numbers, got {array.dtype}")
    if not array.size:
        return
    least, most = float(array.min()), float(array.max())  # NaN if any entry is
    # what becomes infinite when it is cast to float32 is no number either
    largest = float(np.finfo(np.float32).max)
    if not (max(low, -largest) <= least and most <= min(high, largest)):
        words = "finite numbers"
        if math.inf not in (-low, high) or low == 0:
            words = f"numbers in [{low:g}, {high:g}]"
        raise InvalidFileError(f"{name}: expected {words}, got {least:.9g} to {most:.9g}")


def check_row_sums(name: str, weights: np.ndarray) -> None:
    """Checks that rows of weights sum to 1, to within 0.01. Raises: InvalidFileError."""
    sums = weights.sum(axis=1, dtype=np.float64)
    if not sums.size:
        return
    worst = float(sums[np.abs(sums - 1).argmax()])
    if abs(worst - 1) > 1e-2:  # eight weights in half floats are off by less
        raise InvalidFileError(f"{name}: expected rows with the sum 1, got {worst:.6g}")


def check_indices(name: str, array: np.ndarray, shape: tuple[int | None, ...], bound: int) -> None:
    """Checks that an array has the shape, and integers in [0, bound). None in the shape stands for
    any size.

    Raises: InvalidFileError.
    """
    check_array(name, array, shape)
    if array.dtype.kind not in "iu" or (
        array.size and not 0 <= int(array.min()) <= int(array.max()) < bound
    ):
        raise InvalidFileError(f"{name}: expected integers in [0, {bound})")


def check_joints(parents: Sequence[Any], names: Sequence[Any]) -> None:
    """Checks that joints form a tree with one root, whose parent is -1, that their names are
    printable, and that their number is within the limit `joints`.

    Raises: InvalidFileError.
    """
    check_limit("joints", len(parents), "joints")
    count = len(parents)
    if (
        not all(type(parent) is int and -1 <= parent < count for parent in parents)
        or list(parents).count(-1) != 1
    ):
        raise InvalidFileError(
            "parents: expected the number of the parent of each joint, -1 for one of them"
        )
    up = np.asarray([*(count if parent == -1 else parent for parent in parents), count])
    for _ in range(count.bit_length()):
        up = up[up]  # twice as far up each time
    if (up != count).any():
        raise InvalidFileError("parents: expected joints that all descend from the root")
    if len(names) != len(parents) or not all(
        isinstance(name, str) and name == printable(name) for name in names
    ):
        raise InvalidFileError(f"joint_names: expected {len(parents)} printable names")


def checksum(arrays: Mapping[str, Any], *texts: str) -> str:
    """Returns the SHA-256, in hexadecimal, of named arrays (with their types and shapes) and of
    texts.
    """
    digest = hashlib.sha256()
    for name in sorted(arrays):
        array = np.ascontiguousarray(arrays[name])
        digest.update(f"{name} {array.dtype.str} {array.shape}\n".encode())
        if array.size:
            digest.update(array.reshape(-1).view(np.uint8).data)
    for text in texts:
        digest.update(f"{len(text)} {text}\n".encode())
    return digest.hexdigest()


def file_checksum(file: Path) -> str:
    """Returns the SHA-256, in hexadecimal, of the bytes of a file. Raises: OSError."""
    with open(file, "rb") as opened:
        return hashlib.file_digest(opened, "sha256").hexdigest()


def check_checksum(recorded: Any, found: str) -> None:
    """Checks that the recorded checksum of a file equals `found`, the computed checksum. A recorded
    None is accepted, because earlier versions recorded none.

    Raises: InvalidFileError.
    """
    if recorded not in (None, found):
        raise InvalidFileError(
            f"damaged: its contents have the checksum {found[:12]}, recorded is"
            f" {str(recorded)[:12]}"
        )


class ArrayFile:
    """The named arrays of a file.

    values: the arrays by key. pickled: keys of pickled objects, which are not read. error: class of
    the error for a value that is not as expected.
    """

    def __init__(
        self,
        path: str | Path,
        values: Mapping[str, Any],
        pickled: tuple[str, ...] = (),
        error: type[FileError] = FileError,
    ) -> None:
        self.path, self.values, self.pickled, self.error = Path(path), values, pickled, error

    @classmethod
    def open(
        cls,
        path: str | Path,
        error: type[FileError] = FileError,
        wanted: Callable[[str], bool] | None = None,
    ) -> "ArrayFile":
        """Reads an npz archive or a pickle without running anything in it. A file is an archive if
        its first bytes or its suffix say so.

        Arguments: wanted: says by name which arrays of an archive to read; None: all.
        Raises: `error` if the file is damaged or larger than the limits allow; FileNotFoundError or
        `error` if it is missing, see `reading`.
        """
        with reading(path, "file of arrays", error):
            with open_file(path) as file:
                archive = file.read(2) == b"PK"
            if archive or Path(path).suffix.lower() == ".npz":
                return cls(path, *read_npz(path, wanted), error)
            return cls(path, read_pickle(path), (), error)

    def __contains__(self, key: str) -> bool:
        return key in self.values

    def array(self, key: str) -> np.ndarray:
        """Returns the value of a key as an array of any type. Raises: `error` if the key is
        missing, or if its value is no array.
        """
        if key not in self.values:
            found = ", ".join(sorted(map(str, self.values))) or "none"
            reason = "a pickled object, which is never read"
            if key not in self.pickled:
                reason = f"missing (keys: {found})"
            raise self.error(self.path, key, reason)
        try:
            return as_array(self.values[key])
        except (ValueError, TypeError, OverflowError) as error:
            raise self.error(self.path, key, error) from error

    def numbers(
        self, key: str, shape: tuple[int | None, ...] | None, largest: float = np.inf
    ) -> Float[np.ndarray, "..."]:
        """Returns the value of a key as finite float64 numbers, at least one. shape, largest: as in
        the function `numbers`. Raises: `error`.
        """
        return numbers(
            self.array(key), self.path, key, shape, some=True, largest=largest, error=self.error
        )

    def number(self, key: str) -> float:
        """Returns the only number in the array of a key. The array may have any number of axes.
        Raises: `error`.
        """
        return float(self.numbers(key, (1,) * self.array(key).ndim).reshape(-1)[0])

    def integers(self, key: str, shape: tuple[int | None, ...]) -> Int[np.ndarray, "..."]:
        """Returns the value of a key as int64, at least one number. The file may have them as any
        real type. shape: as in the function `numbers`. Raises: `error`.
        """
        array = self.numbers(key, shape)
        whole = array == np.rint(array)
        if not whole.all():
            where = np.argwhere(~whole)[0].tolist()
            found = f"got {array[tuple(where)]} at index {where}"
            raise self.error(self.path, key, f"expected whole numbers, {found}")
        return array.astype(np.int64)

    def indices(self, key: str, bound: int) -> np.ndarray:
        """Returns the value of a key as triangles, (f, 3), int64, with vertices in [0, bound).
        Raises: `error`.
        """
        array = self.integers(key, (None, 3))
        if array.min() < 0 or array.max() >= bound:
            raise self.error(self.path, key, f"expected indices in [0, {bound})")
        return array


# npz archives
# --------------------------------------------------------------------------------------------------


_ONE_AT_A_TIME = threading.Lock()
"""Lock around reading the header of an array. numpy reads headers through Python's syntax trees,
and CPython 3.11 counts the depth of these trees for all threads together. Two threads that read at
once sometimes fail with "AST constructor recursion depth mismatch" (python/cpython#106905).
"""
_HEADERS = {
    (1, 0): np.lib.format.read_array_header_1_0,
    (2, 0): np.lib.format.read_array_header_2_0,
}
LONGEST_HEADER = 512
"""Largest number of characters of an array's header. A plain array takes some hundred, and longer
headers can exhaust Python's parser.
"""


def read_npz(
    path: str | Path, wanted: Callable[[str], bool] | None = None
) -> tuple[dict[str, np.ndarray], tuple[str, ...]]:
    """Returns the arrays of an npz archive by name, and the names of entries that are pickled
    objects. Pickled objects are never read.

    Arguments: wanted: says by name which entries to read; None: all.
    Raises: FileNotFoundError; FileError if the file is no npz archive, is damaged, or is larger
    than the limits allow.
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
                    except InvalidFileError as error:
                        raise InvalidFileError(f"{name}: {error}") from error
                if array is None:
                    pickled.append(name)
                else:
                    arrays[name] = array
    return arrays, tuple(pickled)


def read_npy(path: str | Path) -> np.ndarray | None:
    """Returns the array of an npy file, or None if it holds a pickled object.

    Raises: FileNotFoundError; FileError.
    """
    with reading(path, "npy file"), open_file(path, "array_bytes") as file:
        return _read_array(file, os.path.getsize(path))


def open_archive(file: BinaryIO | io.BytesIO, size: int) -> zipfile.ZipFile:
    """Opens a zip archive of `size` bytes, after checking that its members together stay within the
    limits.

    Raises: InvalidFileError, also for two members of one name and for a compression other than
    deflate; anything that zipfile raises for damaged archives.
    """
    # the list of members is not read yet
    ending = zipfile._EndRecData(file)  # ty: ignore[missing-attribute]
    if not ending:
        raise zipfile.BadZipFile("not a zip archive, or cut off")
    check_limit("members", ending[5] // 46, "members")  # each takes 46 bytes and its name
    archive = zipfile.ZipFile(file)
    members = archive.infolist()
    if len({member.filename for member in members}) < len(members):
        raise InvalidFileError("two members of one name")
    strange = [
        m.filename
        for m in members
        if m.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
    ]
    if strange:
        raise InvalidFileError(f"{strange[0]}: compressed by a method that is not read")
    check_unpacked(size, sum(member.file_size for member in members))
    return archive


def read_header(file: Any) -> tuple[tuple[int, ...], bool, np.dtype]:
    """Returns the shape of an npy array, whether it is in Fortran order, and its type. The file is
    then at the first byte of the numbers.

    Raises: InvalidFileError, and what numpy raises for damaged headers.
    """
    version = np.lib.format.read_magic(file)
    if version not in _HEADERS:
        raise InvalidFileError(f"version {version} of the npy format is not read")
    with _ONE_AT_A_TIME:
        return _HEADERS[version](file, max_header_size=LONGEST_HEADER)


def _read_array(member: Any, size: int) -> np.ndarray | None:
    """Returns the array of an archive's member of `size` bytes, or None for pickled objects.

    Memory is allocated only after the size is checked.
    Raises: as `read_header`; InvalidFileError for other types than numbers and strings, or for
    another size; EOFError.
    """
    shape, columns_first, dtype = read_header(member)
    if dtype.hasobject:
        return None
    plain = dtype.kind in "biufcSU"  # numbers and strings, no objects, no records
    if not plain or (dtype.itemsize == 0 and math.prod(shape) > 1):
        raise InvalidFileError(f"expected numbers or strings, got {dtype}")
    left = size - member.tell()
    if min(shape, default=0) < 0 or math.prod(shape) * dtype.itemsize != left:
        raise InvalidFileError(f"shape {shape} of {dtype} does not fit its {left:,} bytes")
    data = np.empty(left, np.uint8)
    at = 0
    while at < left:
        piece = member.read(min(left - at, 1 << 22))
        if not piece:
            raise EOFError("cut off")
        data[at : at + len(piece)] = np.frombuffer(piece, np.uint8)
        at += len(piece)
    if columns_first:
        return plain_array(data, dtype, shape[::-1]).T
    return plain_array(data, dtype, shape)


def write_npz(
    path: str | os.PathLike[str], arrays: Mapping[str, Any], compressed: bool = True
) -> None:
    """Writes arrays to an npz archive, each under its name. The path may have any suffix. If
    writing fails, the path stays as it was. compressed: whether the archive is compressed. Raises:
    OSError.
    """
    save = np.savez_compressed if compressed else np.savez
    converted: dict[str, Any] = {name: np.asarray(value) for name, value in arrays.items()}

    def write(temporary: Path) -> None:
        with open(temporary, "wb") as file:  # numpy would add .npz to a name
            save(file, **converted)

    replace_file(path, write)
