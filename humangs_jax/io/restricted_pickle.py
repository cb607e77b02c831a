"""Reads pickles of arrays without running anything that they contain.

A pickle is a program: it names functions and classes, and calls them. `RestrictedUnpickler` is
Python's own unpickler, but it finds only the names in a table. Each of these names gives it a
harmless stand-in. `_Looked` looks at each instruction before the unpickler gets it. It refuses an
instruction that no pickle of arrays has, a number or an index larger than files need, and a dict
with a key that is made of more than `LARGEST_KEY` values, as tuples within tuples can be. So a
small file cannot take much memory.

For body models and motions the table has numpy's arrays, scipy's sparse matrices and chumpy's
arrays. numpy itself gets a type and bytes only in the end, when `as_array` makes an array of
numbers. Single integers are the exception, because they may be keys.
"""

import io
import math
import pickle
import pickletools
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple, no_type_check

import numpy as np

from humangs_jax.io.reading import InvalidFileError, check_limit, limits, read_bytes, reading

REFUSED = {
    *("EXT1", "EXT2", "EXT4", "INST", "OBJ", "NEWOBJ_EX", "DUP"),
    *("EMPTY_SET", "FROZENSET", "ADDITEMS", "NEXT_BUFFER", "READONLY_BUFFER"),
}
"""Instructions that no pickle of arrays has."""
LARGEST_INTEGER = 1 << 64
"""Integers of a pickle must be smaller than this in magnitude. Greater ones can be chosen so that a
dict becomes very slow.
"""
LARGEST_KEY = 256
"""Largest number of values that the key of a dict may be made of, because all of them are hashed.
"""
COUNTED = 1 << 30
"""Largest count of values that `_Looked` holds. Larger counts are held as this number, because
tuples within tuples can stand for any number of values.
"""
LONGEST_LIST = 1 << 24
"""Largest number of items in a nested list. Items of inner lists count, too, as often as the inner
list occurs.
"""


# Instructions
# --------------------------------------------------------------------------------------------------


@no_type_check  # a call for each instruction: checks of types in tests would take most of the time
class _Looked:
    """A file of pickles that checks each instruction before it hands the instruction out.

    A look ends behind a BUILD, where joblib writes the bytes of an array, or at the end of the
    pickle. `stack` and `memo` mirror the stack and the memo of the unpickler. For each value they
    hold the count of values that it was made of; the stack holds None for a mark.
    """

    def __init__(self, file: Any):
        self.file, self.seen, self.frame_end = file, file.tell(), 0
        self.count, self.most = 0, limits().opcodes
        self.stack: list[int | None] = []
        self.memo: dict[int, int] = {}

    def read(self, count: int) -> bytes:
        """Returns the next `count` bytes, after checking the instructions in them."""
        # a frame is handed out as a whole: it may have several looks in it
        while self.file.tell() + count > self.seen:
            self.look()
        return self.file.read(count)

    def readline(self) -> bytes:
        """Reads the rest of the line, which is an argument of an instruction that was looked at."""
        return self.file.readline()

    def array_bytes(self, count: int) -> bytes:
        """Returns the next `count` bytes of the file, which are bytes of an array between two
        instructions. Raises: InvalidFileError if they lie in a frame, which the unpickler reads as
        a whole.
        """
        if self.file.tell() != self.seen:
            raise InvalidFileError("the bytes of an array within a frame of instructions")
        data = self.file.read(count)
        self.seen = self.file.tell()
        return data

    def look(self) -> None:
        """Checks the instructions that follow the last checked one, up to a BUILD or STOP.

        Raises: InvalidFileError for anything that is refused; ValueError, from `pickletools`, for
        bytes that are no instruction or are cut off.
        """
        here = self.file.tell()
        self.file.seek(self.seen)
        for opcode, argument, start in pickletools.genops(self.file):
            self.count += 1
            if self.count > self.most:
                check_limit("opcodes", self.count, "instructions of a pickle")
            if opcode.name in REFUSED:
                raise InvalidFileError(f"refused the instruction {opcode.name} of a pickle")
            if type(argument) is int and abs(argument) >= LARGEST_INTEGER:
                raise InvalidFileError("refused an integer of more than 64 bits")
            # the unpickler reads a frame at once, and what crosses its end in another way than here
            within, end = (start or 0) < self.frame_end, self.file.tell()
            if within and (end > self.frame_end or opcode.name == "FRAME"):
                raise InvalidFileError(
                    "refused a frame of instructions that ends within one, or holds one"
                )
            if opcode.name == "FRAME":
                self.frame_end = end + argument
            self.follow(opcode, argument)
            if opcode.name in ("BUILD", "STOP"):
                break
        self.seen = self.file.tell()
        self.file.seek(here)

    def follow(self, opcode: Any, argument: Any) -> None:
        """Changes `stack` and `memo` as an instruction changes the stack and the memo of the
        unpickler.

        Raises: InvalidFileError for an index of the memo without a value, for an instruction that
        takes more from the stack than there is, and for a dict with large keys.
        """
        name, stack = opcode.name, self.stack
        if name in ("PUT", "BINPUT", "LONG_BINPUT", "MEMOIZE"):
            self._memoize(name, argument)
            return
        if name in ("GET", "BINGET", "LONG_BINGET"):
            stack.append(self.memo.get(argument, 0))
            return
        # POP also takes a mark, and takes nothing from an empty stack
        if name == "POP":
            del stack[-1:]
            return

        taken, items = self._popped(opcode)

        # all values that a key is made of are hashed, and a mark is no key
        keys: list[int | None] = []
        if name == "SETITEM":  # it takes a dict, a key and a value
            keys = taken[1:2]
        elif name in ("SETITEMS", "DICT"):  # keys and values alternate
            keys = items[::2]
        if any(key is None or key > LARGEST_KEY for key in keys):
            raise InvalidFileError(
                "a dict with keys other than strings, numbers and short tuples of these"
            )

        # all but DUP, which is refused, leave at most one value: it is made of all that they took
        if name == "MARK":
            stack.append(None)
        elif opcode.stack_after:
            made = 1 + sum(part or 0 for part in taken) + sum(part or 0 for part in items)
            stack.append(min(made, COUNTED))

    def _memoize(self, name: str, argument: Any) -> None:
        """Puts the top of `stack` into `memo`, as the instruction `name` does.

        Raises: InvalidFileError for an index that is beyond the values of the pickle.
        """
        index = argument
        if name == "MEMOIZE":
            index = len(self.memo)
        # the unpickler makes a list with a place for each index: there is none without a value
        if not 0 <= index <= self.count or not self.stack:
            raise InvalidFileError("refused an index of the memo that is beyond its values")
        self.memo[index] = self.stack[-1] or 0

    def _popped(self, opcode: Any) -> tuple[list[int | None], list[int | None]]:
        """Removes from `stack` what an instruction takes, and returns it in two parts.

        Every instruction takes a fixed number of values: `taken`. Some instructions also take the
        last mark and all values above it, which are `items`. For SETITEMS with two entries:

            bottom  ...  | dict  | mark | key  value  key  value |  top
                         | taken |      | items                  |

        REDUCE takes no mark: `taken` is its function and arguments, and `items` is empty. If an
        instruction needs a mark and there is none, `items` is the whole stack. The unpickler
        refuses such a pickle.

        Raises: InvalidFileError if the stack has fewer values than `taken` needs.
        """
        stack, before = self.stack, opcode.stack_before
        needed = len(before)
        items: list[int | None] = []
        if pickletools.markobject in before:
            needed = before.index(pickletools.markobject)
            above = len(stack)
            while above > 0 and stack[above - 1] is not None:
                above -= 1
            items = stack[above:]
            mark = max(0, above - 1)
            del stack[mark:]

        if len(stack) < needed:
            raise InvalidFileError(
                "refused an instruction that takes more from the stack than there is"
            )
        first = len(stack) - needed
        taken = stack[first:]
        del stack[first:]
        return taken, items


class Call(NamedTuple):
    """A function of this package that a name of a pickle may stand for. A pickle cannot change the
    function.
    """

    function: Callable[..., Any]
    """The function, which is called with arguments from the file."""

    def __call__(self, *arguments: Any) -> Any:
        """Returns what the function returns."""
        return self.function(*arguments)


class Named(NamedTuple):
    """A class of Python that a pickle names as the base of another class. It cannot be called."""

    name: str
    """Name of the class, for error lines."""


class StandIn:
    """An object of a pickle whose class is not loaded. `state` holds its state as a dict.

    A pickle cannot change this class: BUILD sets state only through `__setstate__`, which needs an
    object.
    """

    def __init__(self, *_: Any) -> None:
        self.state: dict[str, Any] = {}

    def __new__(cls, *_: Any) -> Any:  # not Self: beartype in tests checks functions, not classes
        """Makes an object with an empty state, because a pickle may make objects without
        `__init__`.
        """
        made = super().__new__(cls)
        made.state = {}
        return made

    def __setstate__(self, state: Any) -> None:
        """Updates `state` with what BUILD passes: a dict, or a tuple, of which only the dicts are
        used.
        """
        parts = state if isinstance(state, tuple) else (state,)
        for part in parts:
            if isinstance(part, dict):
                self.state.update(part)


class PlainDict(dict):
    """A dict that stands for an object of a subclass of dict, such as OrderedDict, because that
    class is not loaded. Attributes that the pickle sets are ignored.
    """

    __slots__ = ()

    def __setstate__(self, state: Any) -> None:
        """Ignores attributes that the pickle sets on the dict."""


class RestrictedUnpickler(pickle.Unpickler):
    """Reads one pickle of a file, from the file's current position.

    names: the stand-in for each (module, name) that a pickle may use. Any other name is refused.
    All modules whose names begin with "scipy.sparse" are looked up as "scipy.sparse". purpose: ends
    the message of a refusal. Strings of Python 2 are read as latin1.
    """

    def __init__(self, file: Any, names: Mapping[tuple[str, str], Any], purpose: str):
        self.names, self.purpose, self.looked = names, purpose, _Looked(file)
        super().__init__(self.looked, encoding="latin1")

    def find_class(self, module: str, name: str) -> Any:
        """Returns the stand-in for a name of a module. All modules whose names begin with
        "scipy.sparse" are looked up as "scipy.sparse".

        Raises: InvalidFileError if the table has no such name.
        """
        key = module, name
        if module.startswith("scipy.sparse"):  # its classes have moved between modules
            key = "scipy.sparse", name
        if key not in self.names:
            module = "builtins" if module == "__builtin__" else module  # its name in protocol 2
            raise InvalidFileError(f"refused to load {module}.{name}: {self.purpose}")
        found = self.names[key]
        # its state is followed by bytes of this file
        if found is _Joblib:
            return type("_Joblib", (_Joblib,), {"looked": self.looked})
        return found

    def persistent_load(self, pid: Any) -> Any:
        """Refuses persistent objects, which no pickle of arrays has.

        Raises: InvalidFileError.
        """
        raise InvalidFileError("refused to load a persistent object")


# Arrays
# --------------------------------------------------------------------------------------------------


class _Dtype(StandIn):
    """A numpy type. `dtype` is that type for numbers or strings, and None for others (objects,
    records).
    """

    def __setstate__(self, state: Any) -> None:
        self.state["parts"] = state if isinstance(state, tuple) else ()

    @property
    def dtype(self) -> np.dtype | None:
        code, parts = self.state["code"], self.state.get("parts", (3, "|", None, None, None))
        plain = (
            len(parts) >= 5
            and parts[2] is parts[3] is parts[4] is None
            and parts[1] in ("<", ">", "=", "|")
        )
        if not plain or not isinstance(code, str) or not re.fullmatch(r"[biufcSU?]\d{0,3}", code):
            return None
        try:
            return np.dtype(code).newbyteorder(parts[1])
        except TypeError:
            return None


def _dtype(code: Any = "", *_: Any) -> "_Dtype":
    made = _Dtype()
    if isinstance(code, bytes):
        made.state["code"] = code.decode("latin1")
    else:
        made.state["code"] = code
    return made


class _Array(StandIn):
    """An array as a type, a shape and bytes, before numpy has seen it."""

    def __setstate__(self, state: Any) -> None:
        if isinstance(state, tuple) and len(state) == 5:
            _, shape, dtype, columns_first, data = state
            self.state.update(
                shape=shape,
                dtype=dtype,
                columns_first=columns_first is True or columns_first == 1,
                data=data,
            )

    def to_array(self) -> np.ndarray:
        shape, data = self.state["shape"], self.state["data"]
        if isinstance(data, str):
            data = data.encode("latin1")
        dtype = None
        if isinstance(self.state["dtype"], _Dtype):
            dtype = self.state["dtype"].dtype
        if dtype is None or not isinstance(data, bytes | bytearray):
            raise ValueError("expected numbers, got other objects")
        sizes = shape if isinstance(shape, tuple) else ()
        if not all(type(n) is int and n >= 0 for n in sizes) or math.prod(
            sizes
        ) * dtype.itemsize != len(data):
            raise ValueError(f"shape {shape} of {dtype} does not fit {len(data):,} bytes")
        if not dtype.itemsize:
            raise ValueError(f"expected numbers, got {dtype}")
        columns_first = self.state["columns_first"]
        if columns_first:
            return plain_array(data, dtype, sizes[::-1]).T
        return plain_array(data, dtype, sizes)


def _made_array(shape: Any, dtype: Any, columns_first: Any, data: Any) -> "_Array":
    array = _Array()
    array.__setstate__((1, shape, dtype, columns_first, data))
    return array


def _scalar(dtype: Any, data: Any = b"") -> Any:
    """Returns one number. An integer becomes an int, because it may be the key of a dict. Any other
    number becomes an `_Array`.
    """
    array = _made_array((), dtype, False, data)
    plain = dtype.dtype if isinstance(dtype, _Dtype) else None
    if plain is not None and plain.kind in "iu":
        return int(array.to_array())
    return array


class _Joblib(_Array):
    """An array as joblib writes it. The bytes of the array follow the object in the file.

    Some versions of joblib write padding before these bytes: one byte with the length of the
    padding, then the padding.
    """

    looked: _Looked
    """The file that the bytes are read from. `find_class` makes a subclass that holds it."""

    def __setstate__(self, state: Any) -> None:
        if not isinstance(state, dict):
            raise InvalidFileError("an array of joblib without a description")
        shape, dtype = state.get("shape"), state.get("dtype")
        plain = dtype.dtype if isinstance(dtype, _Dtype) else None
        if (
            plain is None
            or type(shape) is not tuple
            or not all(type(n) is int and n >= 0 for n in shape)
        ):
            raise InvalidFileError("an array of joblib that is not of numbers")
        if state.get("numpy_array_alignment_bytes") is not None:
            self.looked.array_bytes(self.looked.array_bytes(1)[0])
        size = math.prod(shape) * plain.itemsize
        data = self.looked.array_bytes(min(size, 1 << 62))
        super().__setstate__((1, shape, dtype, state.get("order") == "F", data))


def _encode(text: Any = "", encoding: Any = "latin1", *_: Any) -> str:
    if type(text) is not str or encoding not in ("latin1", "latin-1"):
        raise InvalidFileError("refused to encode anything but latin1")
    return text  # stands for its bytes, and takes no further memory: `_Array` encodes it


def _numbers(value: Any) -> np.ndarray:
    """Returns the numbers of an `_Array`, which is a part of a sparse or chumpy array.

    Sparse and chumpy arrays are refused as parts, because shared ones could be nested to any size.

    Raises: ValueError for anything but an `_Array`.
    """
    if not isinstance(value, _Array):
        raise ValueError(f"expected an array, got {type(value).__name__}")
    return value.to_array()


class _Sparse(StandIn):
    """A sparse matrix. If `axis` is None, each entry has a row and a column. If `axis` is 0 or 1,
    the matrix is compressed along its rows or its columns: index pointers count the entries in each
    of them.
    """

    axis: int | None = None

    def _places(self, count: int) -> list[np.ndarray]:
        """Returns the row and the column of each entry, (count,) each. count: number of entries."""
        if self.axis is None:
            return [
                _numbers(x)
                for x in self.state.get("coords") or (self.state["row"], self.state["col"])
            ]
        ends = _numbers(self.state["indptr"]).astype(np.int64, casting="safe")
        steps = np.diff(ends)
        if (
            ends.ndim != 1
            or not len(ends)
            or ends[0] != 0
            or (steps < 0).any()
            or ends[-1] != count
        ):
            raise ValueError("index pointers that do not count the entries")
        along, across = np.repeat(np.arange(len(steps)), steps), _numbers(self.state["indices"])
        if self.axis == 0:
            return [along, across]
        return [across, along]

    def to_array(self) -> np.ndarray:
        shape, data = self.state["_shape"], _numbers(self.state["data"])
        if not (
            isinstance(shape, tuple)
            and len(shape) == 2
            and all(type(n) is int and n >= 0 for n in shape)
        ):
            raise ValueError("expected a shape of two sizes")
        check_limit("plain_bytes", math.prod(shape) * data.itemsize, "bytes of a sparse matrix")
        where = [x.astype(np.int64, casting="safe") for x in self._places(data.size)]
        for index, size in zip(where, shape, strict=True):
            if index.shape != data.shape or (
                index.size and not 0 <= index.min() <= index.max() < size
            ):
                raise ValueError(f"indices that do not fit the shape {shape}")
        full = np.zeros(shape, data.dtype)
        np.add.at(full, tuple(where), data)
        return full


class _SparseRows(_Sparse):
    """A matrix compressed along its rows."""

    axis = 0


class _SparseColumns(_Sparse):
    """A matrix compressed along its columns."""

    axis = 1


class _Chumpy(StandIn):
    """A chumpy array, which holds its numbers as `x`."""

    def to_array(self) -> np.ndarray:
        return _numbers(self.state["x"])


class _ChumpySelection(StandIn):
    """A chumpy array of some of the numbers of another array."""

    def to_array(self) -> np.ndarray:
        if isinstance(self.state["a"], _Chumpy):
            source = self.state["a"].to_array()
        else:
            source = _numbers(self.state["a"])
        return source.ravel()[_numbers(self.state["idxs"])].reshape(self.state["preferred_shape"])


NAMES: dict[tuple[str, str], Any] = {
    ("numpy", "ndarray"): _Array,  # a class that is only named
    ("joblib.numpy_pickle", "NumpyArrayWrapper"): _Joblib,
    ("collections", "defaultdict"): Call(lambda *_: PlainDict()),
    ("numpy", "dtype"): Call(_dtype),
    **{
        (f"numpy.{core}.{module}", name): Call(function)
        for core in ("core", "_core")
        for module, name, function in (
            ("multiarray", "_reconstruct", lambda *_: _Array()),
            ("multiarray", "scalar", _scalar),
            (
                "numeric",
                "_frombuffer",
                lambda data, dtype, shape, order: _made_array(shape, dtype, order == "F", data),
            ),
        )
    },
    ("_codecs", "encode"): Call(_encode),
    **{
        (module, "_reconstructor"): Call(lambda cls, *_: _instance(cls))
        for module in ("copyreg", "copy_reg")
    },
    **{
        (m, name): Named(name)
        for m in ("builtins", "__builtin__")
        for name in ("object", "dict", "list", "int", "float")
    },
    ("scipy.sparse", "csc_matrix"): _SparseColumns,
    ("scipy.sparse", "csr_matrix"): _SparseRows,
    ("scipy.sparse", "coo_matrix"): _Sparse,
    ("chumpy.ch", "Ch"): _Chumpy,
    ("chumpy.reordering", "Select"): _ChumpySelection,
}


def _instance(cls: Any) -> StandIn:
    """Makes an object of a subclass of `StandIn`.

    Raises: InvalidFileError for any other class.
    """
    if not isinstance(cls, type) or not issubclass(cls, StandIn):
        raise InvalidFileError("refused to make an object of another class")
    return cls()


def objects(value: Any) -> Any:
    """Returns the list in an array of Python objects, or the only object of an array without axes.
    Any other value is returned unchanged.
    """
    held = None
    if isinstance(value, _Array):
        held = value.state.get("data")
    if not isinstance(held, list):
        return value
    if value.state.get("shape") == () and len(held) == 1:
        return held[0]
    return held


def plain_array(data: Any, dtype: np.dtype, shape: tuple[int, ...]) -> np.ndarray:
    """Returns an array in the machine's byte order, made from bytes of a file.

    A byte of a boolean may have a value that numpy never writes. Any value other than 0 becomes
    True.

    Raises: InvalidFileError for strings with characters that do not exist.
    """
    if dtype.itemsize:
        array = np.frombuffer(data, dtype).reshape(shape)
    else:
        array = np.zeros(shape, dtype)
    if dtype.kind == "b":
        return array.view(np.uint8) != 0
    array = array.astype(dtype.newbyteorder("="), copy=False)
    if (
        dtype.kind == "U"
        and array.size
        and np.ascontiguousarray(array).reshape(-1).view(np.uint32).max() > 0x10FFFF
    ):
        raise InvalidFileError("strings with characters that do not exist")
    return array


def as_array(value: Any) -> np.ndarray:
    """Returns a value from `read_pickle` as a full array. The value is an array, a number, a list
    of numbers, or a stand-in with a method `to_array`.

    Raises: ValueError for anything else, and for a stand-in with damaged contents.
    """
    if hasattr(value, "to_array"):
        try:
            return value.to_array()
        except (KeyError, TypeError, IndexError, AttributeError) as error:
            name = type(value).__name__.strip("_")
            raise ValueError(
                f"a {name} object without readable contents ({type(error).__name__})"
            ) from error
    if isinstance(value, list | tuple):
        _check_leaves(value)
    if isinstance(value, np.ndarray | np.generic | int | float | list | tuple):
        try:
            return np.asarray(value)
        except (ValueError, OverflowError) as error:
            raise ValueError("expected numbers in lists of equal lengths") from error
    raise ValueError(f"expected an array, got {type(value).__name__}")


def _check_leaves(value: Any) -> None:
    """Checks that nested lists are not too large or too deep, and hold only numbers and arrays.

    In a pickle one list may stand in many places, so a small file can hold a huge nested list.

    Raises: ValueError.
    """
    waiting, left = [(value, 0)], LONGEST_LIST
    while waiting:
        items, depth = waiting.pop()
        left -= len(items)
        if depth > 8 or left < 0:
            raise ValueError(
                "expected an array, got lists that are nested too deeply or of more than"
                f" {LONGEST_LIST:,}"
            )
        for item in items:
            if isinstance(item, list | tuple):
                waiting.append((item, depth + 1))
            elif not isinstance(item, int | float | np.ndarray | np.generic):
                raise ValueError(f"expected numbers, got {type(item).__name__}")


def read_pickle(path: str | Path) -> dict[str, Any]:
    """Returns the dict in a pickle of Python 2 or 3. `as_array` makes arrays of its values.

    Raises: FileNotFoundError; FileError, which names the file, if the file cannot be read, is no
    pickle of a dict whose keys are texts, or names anything that arrays do not need.
    """
    with reading(path, "pickle"):
        data = io.BytesIO(read_bytes(path, "array_bytes"))
        content = RestrictedUnpickler(data, NAMES, "it is not needed to hold arrays").load()
        if not isinstance(content, dict) or not all(isinstance(key, str) for key in content):
            raise InvalidFileError(
                f"expected a dict of arrays by name, got {type(content).__name__}"
            )
        return content
