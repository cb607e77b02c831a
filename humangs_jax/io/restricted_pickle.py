"""Pickles of arrays, without running anything in them.

A pickle is a program: it names functions and classes, and calls them. `RestrictedUnpickler` runs
Python's own unpickler, the one written in Python, without most of its instructions. A name becomes
what a table says, which knows nothing but inert stand-ins; calls go to these alone, and only they
take a state. Instructions are counted, keys of dicts are plain, and no instruction makes something
larger than what the file holds.

For body models and motions the table has numpy's arrays, scipy's sparse matrices and chumpy's
arrays. numpy itself sees a type and bytes in the end, when `as_array` makes an array of numbers.
"""

import io
import math
import pickle
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from humangs_jax.io.reading import Refused, check_limit, limits, read_bytes, reading

REFUSED = (
    *(pickle.EXT1, pickle.EXT2, pickle.EXT4, pickle.INST, pickle.OBJ, pickle.NEWOBJ_EX),
    *(
        pickle.EMPTY_SET,
        pickle.FROZENSET,
        pickle.ADDITEMS,
        pickle.NEXT_BUFFER,
        pickle.READONLY_BUFFER,
    ),
)
"""Instructions that no pickle of arrays has."""
LARGEST_KEY = 1 << 31
"""Integers below it as keys: greater ones can be chosen so that a dict becomes very slow."""
LONGEST_LIST = 1 << 24
"""Numbers in a nested list; the same list may stand in others many times."""


class Call(NamedTuple):
    """What a name of a pickle may stand for: a function of this module, with no way to change
    it.
    """

    function: Callable[..., Any]
    """What is called with the arguments of the pickle."""


class StandIn:
    """An object of a pickle whose class is not loaded; its state as a dict."""

    def __init__(self, *_: Any) -> None:
        self.state: dict[str, Any] = {}

    def set_state(self, state: Any) -> None:
        """What BUILD hands over: a dict, or a pair of dicts."""
        for part in state if isinstance(state, tuple) else (state,):
            if isinstance(part, dict):
                self.state.update(part)


class RestrictedUnpickler(
    pickle._Unpickler
):  # the one without C: nothing in it is hidden from this class
    """Reads one pickle. names: what the (module, name) of a pickle stands for; what is in no table
    is refused.

    purpose: ends the message of a refusal. Strings of Python 2 are taken for latin1.
    """

    def __init__(self, file: Any, names: Mapping[tuple[str, str], Any], purpose: str):
        super().__init__(file, encoding="latin1")
        self.names, self.purpose = names, purpose
        vars(self)["dispatch"] = _Counted(self)  # in place of the class's table

    def find_class(self, module: str, name: str) -> Any:
        """The stand-in for a name."""
        key = module, name
        if module.startswith("scipy.sparse"):  # its classes have moved between modules
            key = "scipy.sparse", name
        if key not in self.names:
            module = "builtins" if module == "__builtin__" else module  # its name in protocol 2
            raise Refused(f"refused to load {module}.{name}: {self.purpose}")
        return self.names[key]

    def persistent_load(self, pid: Any) -> Any:
        """Torch's storages; nothing else has any."""
        raise Refused("refused to load a persistent object")


class _Counted:
    """The instructions by their byte: those of Python's unpickler, or ours in their place."""

    def __init__(self, reader: RestrictedUnpickler):
        self._count, self._left = 0, limits().opcodes
        usual = dict(type(reader).dispatch)
        for opcode in REFUSED:
            usual.pop(opcode[0], None)
        self._table = usual | {opcode[0]: run for opcode, run in _OURS.items()}

    def __getitem__(self, byte: int) -> Callable[[Any], None]:
        self._count += 1
        if self._count > self._left:
            check_limit("opcodes", self._count, "instructions of a pickle")
        if byte not in self._table:
            raise Refused(f"refused the instruction {bytes([byte])!r} of a pickle")
        return self._table[byte]


def _checked_key(key: Any) -> Any:
    if (
        isinstance(key, _Array)
        and key.state.get("shape") == ()
        and (number := key.to_array().item()) == int(number)
    ):
        key = int(number)  # numpy's numbers of people
    parts = key if type(key) is tuple and len(key) <= 4 else (key,)
    if not all(
        type(x) in (str, bytes, bool) or (type(x) is int and abs(x) < LARGEST_KEY) for x in parts
    ):
        raise Refused("a dict with keys other than strings and small integers")
    return key


def _fill(mapping: Any, items: list[Any]) -> None:
    if type(mapping) is not dict:
        raise Refused("items of what is no dict")
    mapping.update(
        (_checked_key(key), value) for key, value in zip(items[::2], items[1::2], strict=True)
    )


def _set_item(reader: Any) -> None:
    value, key = reader.stack.pop(), reader.stack.pop()
    _fill(reader.stack[-1], [key, value])


def _set_items(reader: Any) -> None:
    items = reader.pop_mark()
    _fill(reader.stack[-1], items)


def _dict(reader: Any) -> None:
    items, made = reader.pop_mark(), {}
    _fill(made, items)
    reader.append(made)


def _extend(reader: Any, items: list[Any]) -> None:
    if type(reader.stack[-1]) is not list:
        raise Refused("elements of what is no list")
    reader.stack[-1].extend(items)


def _reduce(reader: Any) -> None:
    arguments, function = reader.stack.pop(), reader.stack.pop()
    if type(function) is not Call or type(arguments) is not tuple:
        raise Refused("refused a call of what is no function of arrays")
    reader.append(function.function(*arguments))


def _build(reader: Any) -> None:
    state = reader.stack.pop()
    target = reader.stack[-1]
    if isinstance(target, StandIn):
        target.set_state(state)
        if isinstance(target, _Joblib):
            reader.stack[-1] = target.read(reader._file_read)
    elif type(target) is not dict:  # an ordered dict with attributes, which are of no use
        raise Refused("refused a state for what has none")


def _bytearray(reader: Any) -> None:
    count = int.from_bytes(reader.read(8), "little")
    data = reader.read(min(count, 1 << 62))
    if len(data) != count:
        raise EOFError("cut off")
    reader.append(data)


_OURS = {
    pickle.SETITEM: _set_item,
    pickle.SETITEMS: _set_items,
    pickle.DICT: _dict,
    pickle.APPEND: lambda reader: _extend(reader, [reader.stack.pop()]),
    pickle.APPENDS: lambda reader: _extend(reader, reader.pop_mark()),
    pickle.REDUCE: _reduce,
    pickle.NEWOBJ: _reduce,
    pickle.BUILD: _build,
    pickle.BYTEARRAY8: _bytearray,
}


# Arrays
# --------------------------------------------------------------------------------------------------


class _Dtype(StandIn):
    """A type of numbers or strings; `dtype` is None for every other one (objects, records)."""

    def set_state(self, state: Any) -> None:
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
    made.state["code"] = code.decode("latin1") if isinstance(code, bytes) else code
    return made


class _Array(StandIn):
    """An array that numpy has not seen: a type, a shape and bytes."""

    def set_state(self, state: Any) -> None:
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
        data = data.encode("latin1") if isinstance(data, str) else data
        dtype = self.state["dtype"].dtype if isinstance(self.state["dtype"], _Dtype) else None
        if dtype is None or not isinstance(data, bytes):
            raise ValueError("expected numbers, got other objects")
        sizes = shape if isinstance(shape, tuple) else ()
        if not all(type(n) is int and n >= 0 for n in sizes) or math.prod(
            sizes
        ) * dtype.itemsize != len(data):
            raise ValueError(f"shape {shape} of {dtype} does not fit {len(data):,} bytes")
        if not dtype.itemsize:
            raise ValueError(f"expected numbers, got {dtype}")
        columns_first = self.state["columns_first"]
        return (
            plain_array(data, dtype, sizes[::-1]).T
            if columns_first
            else plain_array(data, dtype, sizes)
        )


def _made_array(shape: Any, dtype: Any, columns_first: Any, data: Any) -> "_Array":
    array = _Array()
    array.set_state((1, shape, dtype, columns_first, data))
    return array


class _Joblib(StandIn):
    """What joblib writes for an array, whose bytes follow it in the file: behind a count of others
    that align them, or none.
    """

    def read(self, read: Callable[[int], bytes]) -> "_Array":
        shape, dtype = self.state.get("shape"), self.state.get("dtype")
        plain = dtype.dtype if isinstance(dtype, _Dtype) else None
        if (
            plain is None
            or type(shape) is not tuple
            or not all(type(n) is int and n >= 0 for n in shape)
        ):
            raise Refused("an array of joblib that is not of numbers")
        if self.state.get("numpy_array_alignment_bytes") is not None:
            read(read(1)[0])
        size = math.prod(shape) * plain.itemsize
        return _made_array(shape, dtype, self.state.get("order") == "F", read(min(size, 1 << 62)))


def _encode(text: Any = "", encoding: Any = "latin1", *_: Any) -> str:
    if type(text) is not str or encoding not in ("latin1", "latin-1"):
        raise Refused("refused to encode anything but latin1")
    return text  # stands for its bytes, and takes no further memory: `_Array` encodes it


def _numbers(value: Any) -> np.ndarray:
    """A part of a sparse or chumpy array.

    Never one of these again: shared ones could be nested to any size.
    """
    if not isinstance(value, _Array):
        raise ValueError(f"expected an array, got {type(value).__name__}")
    return value.to_array()


class _Sparse(StandIn):
    """A matrix by the coordinates of its entries, or compressed along one axis, whose entries are
    counted.
    """

    axis: int | None = None

    def _places(self, count: int) -> list[np.ndarray]:
        """The row and the column of each entry."""
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
        places = [np.repeat(np.arange(len(steps)), steps), _numbers(self.state["indices"])]
        return places[:: 1 if self.axis == 0 else -1]

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
    axis = 0


class _SparseColumns(_Sparse):
    axis = 1


class _Chumpy(StandIn):
    def to_array(self) -> np.ndarray:
        return _numbers(self.state["x"])


class _ChumpySelection(StandIn):
    def to_array(self) -> np.ndarray:
        source = (
            self.state["a"].to_array()
            if isinstance(self.state["a"], _Chumpy)
            else _numbers(self.state["a"])
        )
        return source.ravel()[_numbers(self.state["idxs"])].reshape(self.state["preferred_shape"])


NAMES: dict[tuple[str, str], Any] = {
    ("numpy", "ndarray"): _Array,  # a class that is only named
    ("joblib.numpy_pickle", "NumpyArrayWrapper"): Call(_Joblib),
    ("collections", "defaultdict"): Call(lambda *_: {}),
    ("numpy", "dtype"): Call(_dtype),
    **{
        (f"numpy.{core}.{module}", name): Call(function)
        for core in ("core", "_core")
        for module, name, function in (
            ("multiarray", "_reconstruct", lambda *_: _Array()),
            ("multiarray", "scalar", lambda dtype, data=b"": _made_array((), dtype, False, data)),
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
        (m, name): object
        for m in ("builtins", "__builtin__")
        for name in ("object", "dict", "list", "int", "float")
    },
    ("scipy.sparse", "csc_matrix"): Call(_SparseColumns),
    ("scipy.sparse", "csr_matrix"): Call(_SparseRows),
    ("scipy.sparse", "coo_matrix"): Call(_Sparse),
    ("chumpy.ch", "Ch"): Call(_Chumpy),
    ("chumpy.reordering", "Select"): Call(_ChumpySelection),
}


def _instance(cls: Any) -> StandIn:
    if (
        type(cls) is not Call
        or not isinstance(cls.function, type)
        or not issubclass(cls.function, StandIn)
    ):
        raise Refused("refused to make an object of another class")
    return cls.function()


def objects(value: Any) -> Any:
    """The list in an array of Python objects, or the one that it holds; everything else as it
    is.
    """
    held = value.state.get("data") if isinstance(value, _Array) else None
    if not isinstance(held, list):
        return value
    return held[0] if value.state.get("shape") == () and len(held) == 1 else held


def plain_array(data: Any, dtype: np.dtype, shape: tuple[int, ...]) -> np.ndarray:
    """An array of the machine's byte order from bytes of a file, which may hold what numpy itself
    never writes.
    """
    array = np.frombuffer(data, dtype).reshape(shape) if dtype.itemsize else np.zeros(shape, dtype)
    if dtype.kind == "b":
        return array.view(np.uint8) != 0
    array = array.astype(dtype.newbyteorder("="), copy=False)
    if (
        dtype.kind == "U"
        and array.size
        and np.ascontiguousarray(array).reshape(-1).view(np.uint32).max() > 0x10FFFF
    ):
        raise Refused("strings with characters that do not exist")
    return array


def as_array(value: Any) -> np.ndarray:
    """A full array from what `read_pickle` returned: array, number, list of numbers or stand-in
    (with a method `to_array`).

    Raises: ValueError for anything else.
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
    """Refuses lists that are large, deep or hold other things than numbers; in pickles one list may
    stand in many places.
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
    """The dict in a pickle (of Python 2 or 3), its arrays still to be passed through `as_array`.

    Raises: FileNotFoundError; FileError, naming the file, if it is no pickle of a dict or names
    anything that arrays do not need.
    """
    with reading(path, "pickle"):
        data = io.BytesIO(read_bytes(path, "array_bytes"))
        content = RestrictedUnpickler(data, NAMES, "it is not needed to hold arrays").load()
        if not isinstance(content, dict) or not all(isinstance(key, str) for key in content):
            raise Refused(f"expected a dict of arrays by name, got {type(content).__name__}")
        return content
