"""Pickles and files of torch: programs that would run, types that lie, and sizes that explode."""

import struct
import zipfile
from pickle import (
    BUILD,
    EMPTY_DICT,
    EMPTY_LIST,
    EMPTY_TUPLE,
    LONG_BINPUT,
    MARK,
    NEWOBJ,
    PROTO,
    REDUCE,
    SETITEM,
    STOP,
    TUPLE,
    TUPLE1,
    TUPLE2,
    TUPLE3,
)

import numpy as np
from hostile_cases import case, written
from torch_writer import FakeTensor, pickled, write_checkpoint

# Pickles
# --------------------------------------------------------------------------------------------------


def name_of(module, name):
    return b"c" + f"{module}\n{name}\n".encode()


def word(text):
    return b"X" + struct.pack("<I", len(text)) + text.encode()


def number(value):
    return b"J" + struct.pack("<i", value)


def body_pickle(value):
    """A dict whose entry v_template is what the instructions leave."""
    return PROTO + b"\x02" + EMPTY_DICT + word("v_template") + value + SETITEM + STOP


class Call:
    def __init__(self, function, *arguments):
        self.parts = function, arguments

    def __reduce__(self):
        return self.parts


def a_call(module, name, argument=b"touch OWNED"):
    return name_of(module, name) + word(argument.decode()) + TUPLE1 + REDUCE


def numpy_array(dtype, shape, data):
    """Instructions of an array as numpy writes it, from those of a dtype, a shape and the data."""
    start = (
        name_of("numpy.core.multiarray", "_reconstruct")
        + name_of("numpy", "ndarray")
        + number(0)
        + TUPLE1
    )
    start += b"C\x01b" + TUPLE3 + REDUCE
    return start + MARK + number(1) + shape + dtype + b"\x89" + data + TUPLE + BUILD


def numpy_dtype(code, state=b""):
    made = name_of("numpy", "dtype") + word(code) + b"\x89\x88" + TUPLE3 + REDUCE
    return made + state


def dtype_state(*parts):
    return MARK + b"".join(parts) + TUPLE + BUILD


def shape_of(*sizes):
    return MARK + b"".join(number(size) for size in sizes) + TUPLE


def raw(data):
    return b"B" + struct.pack("<I", len(data)) + data


HIDDEN_OBJECT = numpy_array(
    # a record of 8 bytes whose only field is an object, with flags that deny it
    numpy_dtype(
        "V8",
        dtype_state(
            number(3),
            word("|"),
            b"N",
            word("f") + TUPLE1,
            EMPTY_DICT + word("f") + numpy_dtype("O8", b"") + number(0) + TUPLE2 + SETITEM,
            number(8),
            number(1),
            number(0),
        ),
    ),
    shape_of(4),
    raw(struct.pack("<4Q", 0x41414141, 8, 16, 1 << 40)),
)


def doubled(times):
    """x = (x, x), again and again: hashing, comparing or printing it takes 2^times steps."""
    return EMPTY_TUPLE + (b"2" + TUPLE2) * times


def doubled_by_memo(times):
    """x = (x, x), again and again, each one from the memo."""
    first = EMPTY_TUPLE + b"q\x00"
    return first + b"".join(
        b"0h" + bytes([i]) + b"h" + bytes([i]) + TUPLE2 + b"q" + bytes([i + 1])
        for i in range(times)
    )


def doubled_list(times):
    """x = [x, x], again and again."""
    out = EMPTY_LIST + b"K\x01a"
    for i in range(times):
        out += (
            b"q"
            + bytes([i])
            + b"0"
            + EMPTY_LIST
            + MARK
            + b"h"
            + bytes([i])
            + b"h"
            + bytes([i])
            + b"e"
        )
    return out


def hex_chain(times):
    out = word("00" * 64)
    for _ in range(times):
        out = name_of("_codecs", "encode") + out + word("hex") + TUPLE2 + REDUCE
    return out


def repeated_encode():
    text = word("x" * (1 << 20)) + b"q\x00"
    each = name_of("_codecs", "encode") + b"h\x00" + word("latin1") + TUPLE2 + REDUCE
    return MARK + text + each * 4000 + b"l"


def sparse(kind="csc", shape=(3, 3), indptr=(0, 1, 1, 1), indices=(0,), data=(1.0,)):
    """A sparse matrix with the state that scipy writes."""
    array = lambda values, code: numpy_array(
        numpy_dtype(code), shape_of(len(values)), raw(np.asarray(values, code).tobytes())
    )
    state = EMPTY_DICT + MARK + word("_shape") + (number(shape[0]) + number(shape[1]) + TUPLE2)
    state += word("data") + array(data, "f8") + word("indices") + array(indices, "i4")
    state += word("indptr") + array(indptr, "i8") + b"u"
    return name_of("scipy.sparse", f"{kind}_matrix") + EMPTY_TUPLE + NEWOBJ + state + BUILD


def chumpy_cycle():
    state = EMPTY_DICT + word("x") + b"h\x01" + SETITEM
    return name_of("chumpy.ch", "Ch") + EMPTY_TUPLE + NEWOBJ + b"q\x01" + state + BUILD


EIGHT = raw(bytes(8))
PICKLES = {
    "os.system": a_call("os", "system"),
    "subprocess.Popen": a_call("subprocess", "Popen"),
    "eval": a_call("builtins", "eval", b"__import__('os').system('touch OWNED')"),
    "exec of Python 2": a_call("__builtin__", "exec", b"import os"),
    "a dotted name": a_call("os", "path.os.system"),
    "numpy.load": a_call("numpy", "load"),
    "getattr": name_of("builtins", "getattr")
    + name_of("os", "system")
    + word("x")
    + TUPLE2
    + REDUCE,
    "an extension": b"\x82\x01",
    "an instance of the old kind": MARK + word("x") + b"ios\nsystem\n",
    "an object of the old kind": MARK + name_of("os", "system") + word("x") + b"o",
    "a persistent id": b"Pos.system\n",
    "a state for the reconstructor": name_of("copyreg", "_reconstructor")
    + EMPTY_DICT
    + word("x")
    + number(1)
    + SETITEM
    + BUILD,
    "a state for _frombuffer": name_of("numpy._core.numeric", "_frombuffer")
    + (EMPTY_DICT + word("__code__") + number(1) + SETITEM)
    + BUILD,
    "a state for ndarray": name_of("numpy", "ndarray")
    + EMPTY_DICT
    + word("x")
    + number(1)
    + SETITEM
    + BUILD,
    "slots of ndarray": name_of("numpy", "ndarray")
    + b"N"
    + EMPTY_DICT
    + word("x")
    + number(1)
    + SETITEM
    + TUPLE2
    + BUILD,
    "a reconstructed type": name_of("copyreg", "_reconstructor")
    + name_of("builtins", "object")
    + name_of("builtins", "object")
    + b"N"
    + TUPLE3
    + REDUCE,
    "a hidden object field": HIDDEN_OBJECT,
    "an array of objects": numpy_array(numpy_dtype("O8"), shape_of(1), EMPTY_LIST),
    "a record": numpy_array(numpy_dtype("f8,O"), shape_of(1), raw(bytes(16))),
    "a dtype of a million": numpy_array(numpy_dtype("V1000000"), shape_of(0), raw(b"")),
    "a dtype that is an array": numpy_array(
        numpy_array(numpy_dtype("f8"), shape_of(1), EIGHT), shape_of(1), EIGHT
    ),
    "a shape too large": numpy_array(numpy_dtype("f8"), shape_of(1 << 30, 1 << 30), EIGHT),
    "a negative shape": numpy_array(numpy_dtype("f8"), shape_of(-1), EIGHT),
    "no bytes": numpy_array(numpy_dtype("f8"), shape_of(1), b"N"),
    "too few bytes": numpy_array(numpy_dtype("f8"), shape_of(2), EIGHT),
    "an array without a state": name_of("numpy.core.multiarray", "_reconstruct")
    + EMPTY_TUPLE
    + REDUCE,
    "scalar of an object": name_of("numpy.core.multiarray", "scalar")
    + numpy_dtype("O8")
    + EIGHT
    + TUPLE2
    + REDUCE,
    "memo index of 2^31": LONG_BINPUT + struct.pack("<I", (1 << 31) - 1) + number(1),
    "memo index of 2^32": number(1) + LONG_BINPUT + struct.pack("<I", (1 << 32) - 1),
    "hex of hex": hex_chain(40),
    "rot13": name_of("_codecs", "encode") + word("x") + word("rot13") + TUPLE2 + REDUCE,
    "a megabyte encoded 4,000 times": repeated_encode(),
    "bytes of 2^62": b"\x8e" + struct.pack("<Q", 1 << 62),
    "a bytearray of 2^40": b"\x96" + struct.pack("<Q", 1 << 40),
    "text of 2^40": b"\x8d" + struct.pack("<Q", 1 << 40),
    "a frame that ends within a word": b"\x95"
    + struct.pack("<Q", 4)
    + word("0" * 8 + "q\xff\xff\xff\x7f"),
    "a frame in a frame": b"\x95"
    + struct.pack("<Q", 40)
    + b"\x95"
    + struct.pack("<Q", 4)
    + word("x" * 40),
    "a frame of 2^62": b"\x95" + struct.pack("<Q", 1 << 62),
    "an integer of 2^31 bytes": b"\x8b" + struct.pack("<i", (1 << 31) - 1),
    "an integer of 100,000 digits": b"I" + b"9" * 100_000 + b"\n",
    "tuples in tuples as a key": EMPTY_DICT + doubled(64) + b"N" + SETITEM,
    "tuples of a memo as a key": EMPTY_DICT + doubled_by_memo(64) + b"N" + SETITEM,
    "a key that a state leaves as it is": EMPTY_DICT
    + doubled_by_memo(64)
    + b"N"
    + BUILD
    + b"N"
    + SETITEM,
    "tuples in tuples as a storage": name_of("torch.storage", "_load_from_bytes")
    + doubled_by_memo(64)
    + TUPLE1
    + REDUCE,
    "a set of such": b"\x8f" + MARK + doubled(64) + b"\x90",
    "a tuple as a key": MARK + doubled(64) + b"Nd",
    "large integers as keys": EMPTY_DICT + b"\x8a\x09" + b"\xff" * 8 + b"\x00" + b"N" + SETITEM,
    "lists in lists": doubled_list(40),
    "tuples in tuples": doubled(64),
    "marks": MARK * 100_000,
    "nothing on the stack": REDUCE,
    "an element of a number": number(1) + number(2) + b"a",
    "items of a list": EMPTY_LIST + number(1) + number(2) + SETITEM,
    "an instruction that does not exist": b"\xff",
    "a sparse matrix of 10^12": sparse(shape=(1_000_000, 1_000_000)),
    "sparse pointers of 10^12": sparse(indptr=(0, 10**12, 10**12, 10**12)),
    "sparse pointers backwards": sparse(indptr=(0, 5, 1, 1)),
    "a sparse index outside": sparse(indices=(7,)),
    "a sparse index below 0": sparse(indices=(-1,)),
    "a sparse matrix of nothing": name_of("scipy.sparse", "csc_matrix") + EMPTY_TUPLE + NEWOBJ,
    "sparse entries of two lengths": sparse("coo"),
    "chumpy within itself": chumpy_cycle(),
    "chumpy of nothing": name_of("chumpy.ch", "Ch") + EMPTY_TUPLE + NEWOBJ,
    "chumpy's own functions": a_call("chumpy.ch", "depends_on"),
}
MEMORY_OF_PICKLES = (
    "memo",
    "hex",
    "encode",
    "2^",
    "sparse",
    "lists in",
    "tuples",
    "key",
    "keys",
    "10^12",
    "such",
)
for kind, instructions in PICKLES.items():
    item = 5 if any(part in kind for part in MEMORY_OF_PICKLES) else 1
    data = body_pickle(instructions)
    case(kind, "smplx pkl", written("model.pkl", data), item=item)
    case(kind, "pickle", written("a.pkl", data), "refused", item)
    case(kind, "pickled tensors", written("a.pkl", data), "either", item)
    case(
        kind,
        "aist",
        written("a.pkl", data.replace(word("v_template"), word("smpl_poses"))),
        item=item,
    )


def many_instructions():
    return PROTO + b"\x02" + b"N0" * 3_000_000 + EMPTY_DICT + STOP


case("six million instructions", "pickle", written("a.pkl", many_instructions), item=5)
case("six million instructions", "pickled tensors", written("a.pkl", many_instructions), item=5)


# torch
# --------------------------------------------------------------------------------------------------

NUMBERS = np.ones(4, np.float32)


def twenty_thousand_names(folder):
    """One tensor that stands under 20,000 names of a state dict, 1 MiB each."""
    data, storages = pickled({"model": {"w": FakeTensor(np.ones(1 << 18, np.float32))}})
    at = data.index(b"R", data.index(b"_rebuild_tensor_v2")) + 1
    rest = data[at:]
    copies = b"".join(
        b"X" + struct.pack("<I", 6) + f"{i:06d}".encode() + b"h\xfa" + b"s" for i in range(20_000)
    )
    end = rest.index(b"s")  # the tensor goes into its dict
    data = data[:at] + b"q\xfa" + rest[:end] + b"s" + copies + rest[end + 1 :]
    with zipfile.ZipFile(folder / "a.pt", "w") as archive:
        archive.writestr("archive/data.pkl", data)
        archive.writestr("archive/data/0", storages[0].tobytes())
    return folder / "a.pt"


def torch_of(content):
    return lambda folder: write_checkpoint(folder / "a.pt", content)


case("20,000 tensors of one storage", "torch zip", twenty_thousand_names, item=5)
for kind, content in {
    "a shape of 2^60": {
        "model": {"w": FakeTensor(NUMBERS, shape=(1 << 30, 1 << 30), strides=(0, 0))}
    },
    "a shape of 70 axes": {"model": {"w": FakeTensor(NUMBERS, shape=(1,) * 70, strides=(1,) * 70)}},
    "strides of 2^60": {
        "model": {"w": FakeTensor(NUMBERS, shape=(2, 2), strides=(1 << 60, 1 << 60))}
    },
    "an offset of 2^62": {"model": {"w": FakeTensor(NUMBERS, offset=1 << 62)}},
    "no axis of 2^62": {"model": {"w": FakeTensor(NUMBERS, shape=(0, 1 << 62), strides=(1, 1))}},
    "a call of eval": {"model": {"w": Call(eval, "1")}},
}.items():
    case(kind, "torch zip", torch_of(content), item=5 if "2^" in kind else 1)
    case(kind, "released checkpoint", torch_of(content))
    case(kind, "vgg", torch_of(content))
case("of another network", "released checkpoint", torch_of({"model": {"w": FakeTensor(NUMBERS)}}))
case("of another network", "vgg", torch_of({"model": {"w": FakeTensor(NUMBERS)}}))
