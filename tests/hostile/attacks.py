"""The table of attacks: files that a reader must refuse.

They would run code, write outside of their folder, cost more memory or time than their size allows,
or hold numbers that no person has.

`ATTACKS` has a row for each: name, reader of `readers.FORMATS`, maker of the file, and what may
happen to it.
"""

import gzip
import io
import json
import os
import struct
import sys
import zlib
from collections.abc import Callable
from pathlib import Path
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
from typing import Any, NamedTuple

import numpy as np
from changes import edit_bytes
from network.torch_writer import FakeTensor, write_checkpoint
from PIL import Image
from png_files import chunk
from readers import (
    FORMATS,
    PARAMETERS,
    TEXT_PLY,
    TRANSFORMS,
    picture,
    pixels,
    ply,
    write_capture,
    write_import,
    write_obj,
    written,
)

from humangs_jax.avatar.export.spz import zstd

sys.path.append(str(Path(__file__).parents[1] / "io"))

import profiles


class Attack(NamedTuple):
    """One hostile file."""

    name: str
    reader: str
    make: Callable[[Path], Path]
    expect: str = "refused"
    """The outcome that must follow: "refused", "read", or "either"."""


ATTACKS: list[Attack] = []


def attack(name: str, readers: str, make: Any, expect: str = "refused") -> None:
    """Adds a row for each of some readers; `make` is a maker, or the bytes of a file."""
    for reader in readers.split(", "):
        own = make if callable(make) else written(NAMES.get(reader, "a.bin"), make)
        ATTACKS.append(Attack(f"{reader}: {name}", reader, own, expect))


NAMES = {"image": "a.png", "mask": "a.jpg", "opencv yaml": "a.yml", "toml": "a.toml"}
NAMES |= dict.fromkeys(("3dgs", "3dgs text"), "a.ply")
NAMES |= dict.fromkeys(("pickle", "pickled tensors", "smplx pkl", "AIST++"), "a.pkl")
NAMES |= dict.fromkeys(("spz", "spz 4"), "a.spz") | dict.fromkeys(("torch", "GVHMR"), "a.pt")
NAMES |= dict.fromkeys(("safetensors", "weights"), "a.safetensors")
NAMES |= dict.fromkeys(("npz", "avatar", "smplx npz", "amass", "bank", "body"), "a.npz")
NAMES |= {"fit record": "a.npz", "keypoints npz": "a.npz", "Motion-X": "a.npy"}
NAMES |= {"glb motion": "a.glb", "bvh": "a.bvh", "face table": "a.csv", "obj": "a.obj"}
"""What files of a reader are called, where the suffix decides."""


def setting(changes):
    """Returns a change of JSON that sets a value for each path, such as "accessors.0.count"."""

    def change(content):
        for path, value in changes.items():
            *parents, last = [int(part) if part.isdigit() else part for part in path.split(".")]
            place = content
            for part in parents:
                place = place[part]
            place[last] = value
        return content

    return change


def changed(reader, change, inside=None):
    """Returns a maker of a reader's valid file with changed bytes."""

    def make(folder):
        path = FORMATS[reader].make(folder)
        edit_bytes(path / inside if inside else FORMATS[reader].damaged(path), change)
        return path

    return make


def with_values(reader, changes):
    """Returns a maker of a reader's valid JSON with other values."""
    return changed(reader, lambda data: json.dumps(setting(changes)(json.loads(data))).encode())


def with_arrays(reader, **changes):
    """Returns a maker of a reader's valid arrays, without checksum, some of them replaced.

    A change is a value, or a function of the old array.
    """

    def change(data):
        with np.load(io.BytesIO(data)) as archive:
            arrays = dict(archive)
        if "header" in arrays:
            header = json.loads(str(arrays["header"]))
            header.pop("checksum", None)
            arrays["header"] = np.asarray(json.dumps(header))
        for key, value in changes.items():
            arrays[key] = value(arrays[key]) if callable(value) else value
        stream = io.BytesIO()
        np.savez(stream, **arrays)
        return stream.getvalue()

    return changed(reader, change)


# Code: pickles
# --------------------------------------------------------------------------------------------------


def name_of(module, name):
    return b"c" + f"{module}\n{name}\n".encode()


def word(text):
    return b"X" + struct.pack("<I", len(text)) + text.encode()


def number(value):
    return b"J" + struct.pack("<i", value)


def raw(data):
    return b"B" + struct.pack("<I", len(data)) + data


def sizes(*shape):
    return MARK + b"".join(map(number, shape)) + TUPLE


def a_call(module, name, argument="touch OWNED"):
    return name_of(module, name) + word(argument) + TUPLE1 + REDUCE


def dtype(code, state=b""):
    return name_of("numpy", "dtype") + word(code) + b"\x89\x88" + TUPLE3 + REDUCE + state


def array(kind, shape, data):
    """Returns pickle instructions that make an array, as numpy writes them."""
    made = name_of("numpy.core.multiarray", "_reconstruct") + name_of("numpy", "ndarray")
    made += number(0) + TUPLE1 + b"C\x01b" + TUPLE3 + REDUCE
    return made + MARK + number(1) + shape + kind + b"\x89" + data + TUPLE + BUILD


def pickle_of(instructions):
    """Returns a pickled dict whose entry v_template is made by the instructions."""
    return PROTO + b"\x02" + EMPTY_DICT + word("v_template") + instructions + SETITEM + STOP


def doubled(times):
    """Returns instructions that make x = (x, x) again and again.

    Comparing or printing the result takes 2^times steps.
    """
    out = EMPTY_TUPLE + b"q\x00"
    for i in range(times):
        at = bytes([i])
        out += b"0h" + at + b"h" + at + TUPLE2 + b"q" + bytes([i + 1])
    return out


def doubled_list(times):
    out = EMPTY_LIST + b"K\x01a"
    for i in range(times):
        at = bytes([i])
        out += b"q" + at + b"0" + EMPTY_LIST + MARK + b"h" + at + b"h" + at + b"e"
    return out


def encoded(text, how):
    return name_of("_codecs", "encode") + text + word(how) + TUPLE2 + REDUCE


def hex_of_hex(times):
    out = word("00" * 64)
    for _ in range(times):
        out = encoded(out, "hex")
    return out


def sparse(kind="csc", shape=(3, 3), indptr=(0, 1, 1, 1), indices=(0,)):
    """Returns instructions that make a sparse matrix, as scipy writes them."""

    def array_of(values, code):
        return array(dtype(code), sizes(len(values)), raw(np.asarray(values, code).tobytes()))

    state = EMPTY_DICT + MARK + word("_shape") + number(shape[0]) + number(shape[1]) + TUPLE2
    state += word("data") + array_of((1.0,), "f8") + word("indices") + array_of(indices, "i4")
    state += word("indptr") + array_of(indptr, "i8") + b"u"
    return name_of("scipy.sparse", f"{kind}_matrix") + EMPTY_TUPLE + NEWOBJ + state + BUILD


def of_equal_hashes(count):
    """Returns keys and values, all None, for a dict: the keys are integers with one hash, so that
    a dict of them takes seconds to minutes.
    """
    keys = (i * sys.hash_info.modulus for i in range(8, 8 + count))
    return b"".join(b"\x8a\x0a" + key.to_bytes(10, "little") + b"N" for key in keys)


EIGHT = raw(bytes(8))
STATE = EMPTY_DICT + word("x") + number(1) + SETITEM + BUILD
FIELD = EMPTY_DICT + word("f") + dtype("O8") + number(0) + TUPLE2 + SETITEM
HIDDEN = MARK + number(3) + word("|") + b"N" + word("f") + TUPLE1 + FIELD
HIDDEN += number(8) + number(1) + number(0) + TUPLE + BUILD
"""The state of a record of 8 bytes whose only field is an object, with flags that deny it."""
OF_NOTHING = EMPTY_TUPLE + NEWOBJ
PICKLES = {
    "os.system": a_call("os", "system"),
    "subprocess.Popen": a_call("subprocess", "Popen"),
    "eval": a_call("builtins", "eval", "__import__('os').system('touch OWNED')"),
    "exec of Python 2": a_call("__builtin__", "exec", "import os"),
    "a dotted name": a_call("os", "path.os.system"),
    "numpy.load": a_call("numpy", "load"),
    "getattr": name_of("builtins", "getattr") + name_of("os", "system") + TUPLE1 + REDUCE,
    "chumpy's own functions": a_call("chumpy.ch", "depends_on"),
    "an extension": b"\x82\x01",
    "an instance of the old kind": MARK + word("x") + b"ios\nsystem\n",
    "an object of the old kind": MARK + name_of("os", "system") + word("x") + b"o",
    "a persistent id": b"Pos.system\n",
    "a state for a function": name_of("numpy._core.numeric", "_frombuffer") + STATE,
    "a state for a class": name_of("numpy", "ndarray") + STATE,
    "a hidden field": array(dtype("V8", HIDDEN), sizes(4), raw(struct.pack("<4Q", 65, 8, 16, 9))),
    "an array of objects": array(dtype("O8"), sizes(1), EMPTY_LIST),
    "a record": array(dtype("f8,O"), sizes(1), raw(bytes(16))),
    "a dtype of a million": array(dtype("V1000000"), sizes(0), raw(b"")),
    "a dtype that is an array": array(array(dtype("f8"), sizes(1), EIGHT), sizes(1), EIGHT),
    "a shape too large": array(dtype("f8"), sizes(1 << 30, 1 << 30), EIGHT),
    "a negative shape": array(dtype("f8"), sizes(-1), EIGHT),
    "too few bytes": array(dtype("f8"), sizes(2), EIGHT),
    "no state": name_of("numpy.core.multiarray", "_reconstruct") + EMPTY_TUPLE + REDUCE,
    "memo index of 2^31": number(1) + LONG_BINPUT + struct.pack("<I", (1 << 31) - 1),
    "hex of hex": hex_of_hex(40),
    "rot13": encoded(word("x"), "rot13"),
    "a megabyte 4,000 times": MARK
    + word("x" * (1 << 20))
    + b"q\x00"
    + encoded(b"h\x00", "latin1") * 4000
    + b"l",
    "bytes of 2^62": b"\x8e" + struct.pack("<Q", 1 << 62),
    "a bytearray of 2^40": b"\x96" + struct.pack("<Q", 1 << 40),
    "a frame that ends in a word": b"\x95" + struct.pack("<Q", 4) + word("0" * 8 + "q\xff"),
    "a frame in a frame": b"\x95\x28" + bytes(7) + b"\x95" + struct.pack("<Q", 4) + word("x" * 40),
    "an integer of 2^31 bytes": b"\x8b" + struct.pack("<i", (1 << 31) - 1),
    "an integer of 100,000 digits": b"I" + b"9" * 100_000 + b"\n",
    "tuples in tuples": EMPTY_TUPLE + (b"2" + TUPLE2) * 64,
    "tuples as a key": EMPTY_DICT + doubled(64) + b"N" + SETITEM,
    "a key behind a state": EMPTY_DICT + doubled(64) + b"N" + BUILD + b"N" + SETITEM,
    "tuples as a storage": name_of("torch.storage", "_load_from_bytes")
    + doubled(64)
    + TUPLE1
    + REDUCE,
    "a set": b"\x8f" + MARK + doubled(64) + b"\x90",
    "a key of 72 bits": EMPTY_DICT + b"\x8a\x09" + b"\xff" * 8 + b"\x00N" + SETITEM,
    "keys of equal hashes": EMPTY_DICT + MARK + of_equal_hashes(60_000) + b"u",
    "lists in lists": doubled_list(40),
    "marks": MARK * 100_000,
    "nothing on the stack": REDUCE,
    "an element of a number": number(1) + number(2) + b"a",
    "an instruction that does not exist": b"\xff",
    "sparse: 10^12 numbers": sparse(shape=(1_000_000, 1_000_000)),
    "sparse: pointers of 10^12": sparse(indptr=(0, 10**12, 10**12, 10**12)),
    "sparse: pointers backwards": sparse(indptr=(0, 5, 1, 1)),
    "sparse: an index outside": sparse(indices=(7,)),
    "sparse: entries of two lengths": sparse("coo"),
    "chumpy within itself": name_of("chumpy.ch", "Ch")
    + OF_NOTHING
    + b"q\x01"
    + EMPTY_DICT
    + word("x")
    + b"h\x01"
    + SETITEM
    + BUILD,
    "chumpy of nothing": name_of("chumpy.ch", "Ch") + OF_NOTHING,
}
for kind, instructions in PICKLES.items():
    data = pickle_of(instructions)
    attack(kind, "pickle, smplx pkl", data)
    attack(kind, "AIST++", data.replace(word("v_template"), word("smpl_poses")))
    attack(kind, "pickled tensors", data, "either")
MANY = PROTO + b"\x02" + b"N0" * 3_000_000 + EMPTY_DICT + STOP
attack("six million instructions", "pickle, pickled tensors", written("a.pkl", lambda: MANY))


class Call:
    def __reduce__(self):
        return eval, ("1",)


ONES = np.ones(4, np.float32)
TORCH = {
    "a shape of 2^60": FakeTensor(ONES, shape=(1 << 30, 1 << 30), strides=(0, 0)),
    "a shape of 70 axes": FakeTensor(ONES, shape=(1,) * 70, strides=(1,) * 70),
    "strides of 2^60": FakeTensor(ONES, shape=(2, 2), strides=(1 << 60, 1 << 60)),
    "an offset of 2^62": FakeTensor(ONES, offset=1 << 62),
    "a call of eval": Call(),
}
for kind, value in TORCH.items():
    make = lambda folder, value=value: write_checkpoint(folder / "a.pt", {"model": {"w": value}})
    attack(kind, "torch, GVHMR", make)


# Archives and tensors
# --------------------------------------------------------------------------------------------------


def raw_zip(members):
    """Returns a zip of members (name, method, packed bytes, unpacked size), without checksums."""
    body, directory = bytearray(), bytearray()
    for name, method, data, size in members:
        common = struct.pack("<HHHHHIIIHH", 20, 0, method, 0, 0, 0, len(data), size, len(name), 0)
        directory += b"PK\1\2" + struct.pack("<H", 20) + common
        directory += struct.pack("<HHHII", 0, 0, 0, 0, len(body)) + name
        body += b"PK\3\4" + common + name + data
    count = min(len(members), 0xFFFF)
    end = struct.pack("<HHHHIIH", 0, 0, count, count, len(directory), len(body), 0)
    return bytes(body) + directory + b"PK\5\6" + end


def deflated_zeros(size, start=b""):
    """Returns compressed `start` and zeros; one block of zeros is repeated."""
    pack = zlib.compressobj(9, zlib.DEFLATED, -15)
    head = pack.compress(start) + pack.flush(zlib.Z_FULL_FLUSH)
    pack.compress(bytes(1 << 20)) + pack.flush(zlib.Z_FULL_FLUSH)
    block = pack.compress(bytes(1 << 20)) + pack.flush(zlib.Z_FULL_FLUSH)
    return head + block * (size >> 20) + pack.flush()


def npy(descr="'<f8'", shape="(3,)", version=1):
    text = f"{{'descr': {descr}, 'fortran_order': False, 'shape': {shape}, }}\n".encode()
    return b"\x93NUMPY" + bytes([version, 0]) + struct.pack("<H", len(text)) + text


def bomb():
    header = npy(shape=f"({(1 << 30) // 8},)")
    data = deflated_zeros(1 << 30, header)
    return raw_zip([(b"%d.npy" % i, 8, data, (1 << 30) + len(header)) for i in range(8)])


HEADERS = {
    "a shape of 10^18": npy(shape="(1000000000, 1000000000)"),
    "a negative shape": npy(shape="(-1,)"),
    "strings of no length": npy("'<U0'", "(1000000000000,)"),
    "a record": npy("[('a', '<f8')]", "(1,)"),
    "a type within types": npy("('<f8', (1000000, 1000000))", "(1,)"),
    "a header that is code": npy("__import__('os').system('touch OWNED')"),
    "a header of 9,000 brackets": npy("(" * 9000),
    "no header": b"",
    "version 9": npy(version=9),
}
ARCHIVES = {kind: raw_zip([(b"x.npy", 0, data, len(data))]) for kind, data in HEADERS.items()} | {
    "a method that does not exist": raw_zip([(b"x.npy", 99, bytes(20), 20)]),
    "a false checksum": raw_zip([(b"x.npy", 0, npy() + bytes(24), len(npy()) + 24)]),
    "damaged deflate": raw_zip([(b"x.npy", 8, b"\xff" * 40, 400)]),
    "a size of 2^31": raw_zip([(b"x.npy", 0, bytes(20), 1 << 31)]),
}
OF_ARRAYS = "npz, avatar, smplx npz, amass, bank, fit record, body, keypoints npz"
for kind, data in ARCHIVES.items():
    attack(kind, OF_ARRAYS, data)
attack("zeros of 8 GiB", OF_ARRAYS, written("a.npz", bomb))
MEMBERS = raw_zip([(b"%d.npy" % i, 0, b"", 0) for i in range(70_000)])
attack("70,000 members", "npz, torch", MEMBERS)
TENSOR = {"dtype": "F32", "shape": [4], "data_offsets": [0, 16]}
SAFETENSORS = {
    "8 bits": {"w": {"dtype": "F8_E4M3", "shape": [16], "data_offsets": [0, 16]}},
    "offsets beyond the end": {"w": {**TENSOR, "data_offsets": [0, 1 << 40]}},
    "offsets backwards": {"w": {**TENSOR, "data_offsets": [16, 0]}},
    "offsets of two tensors": {"w": TENSOR, "v": TENSOR},
    "a shape of 2^64": {"w": {**TENSOR, "shape": [1 << 32, 1 << 32]}},
    "a header of 2 MB": {"__metadata__": {"a": "x" * (2 << 20)}},
    "numbers as metadata": {"__metadata__": {"a": 1}, "w": TENSOR},
}
for kind, header in SAFETENSORS.items():
    text = json.dumps(header).encode()
    attack(kind, "safetensors, weights", struct.pack("<Q", len(text)) + text + bytes(64))
NESTED = b'{"a":' + b"[" * 90_000 + b"]" * 90_000 + b"}"
attack("lists in lists", "safetensors, weights", struct.pack("<Q", len(NESTED)) + NESTED)
attack("a header of 2^60", "safetensors", struct.pack("<Q", 1 << 60) + b"{" + bytes(64))
FLIPPED = changed("weights", lambda data: data[:-7] + bytes([data[-7] ^ 1]) + data[-6:])
attack("one flipped bit in a tensor", "weights", FLIPPED)


# Photos
# --------------------------------------------------------------------------------------------------


def png(width, height, depth=8, color=2, data=b"", extra=b""):
    header = struct.pack(">IIBB", width, height, depth, color) + bytes(3)
    head = b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header)
    return head + extra + chunk(b"IDAT", data) + chunk(b"IEND", b"")


def zeros(size):
    return b"\x78\xda" + deflated_zeros(size) + struct.pack(">I", 1)


def photo(kind, shape=(48, 32, 3), **options):
    stream = io.BytesIO()
    Image.fromarray(pixels(*shape)).save(stream, kind, **options)
    return stream.getvalue()


def at(data, place, new):
    return data[:place] + new + data[place + len(new) :]


HEIC = (Path(__file__).parents[1] / "io" / "phone.heic").read_bytes()
AVIF, WEBP = photo("AVIF"), photo("WEBP", lossless=True)
JPEG = photo("JPEG", (8, 8, 3), progressive=True)
SCAN = JPEG[JPEG.rindex(b"\xff\xda") : -2]
EPS = (
    b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 9 9\n(OWNED) (w) file closefile\nshowpage\n%%EOF"
)
ROWS = zlib.compress(bytes(4 * 13))
PHOTOS = {
    "13,000 x 13,000": png(13_000, 13_000, data=zeros(1 << 20)),
    "13,000 x 13,000 of 16 bits": png(13_000, 13_000, 16, data=zeros(1 << 20)),
    "2^31 x 2^31": png((1 << 31) - 1, (1 << 31) - 1),
    "no width": png(0, 10),
    "60,000,000 wide": png(60_000_000, 1, data=zeros(1 << 20)),
    "16 bits, cut": png(100, 100, 16, data=zlib.compress(bytes(25))),
    "16 bits, no such filter": png(4, 1, 16, data=zlib.compress(b"\x09" + bytes(24))),
    "16 bits, damaged deflate": png(4, 1, 16, data=b"\xff" * 30),
    "a false checksum": png(4, 4, data=ROWS).replace(b"IDAT", b"IDBT"),
    "a palette that is not there": png(4, 4, color=3, data=zlib.compress(bytes(20))),
    "no end": png(4, 4, data=ROWS)[:-12],
    "EPS": EPS,
    **{kind: photo(kind) for kind in ("GIF", "TIFF", "BMP", "ICO", "PDF", "PPM")},
    "SVG": b"<svg xmlns='http://www.w3.org/2000/svg'/>",
    "a JPEG of 1,000 scans": JPEG[:-2] + SCAN * 1000 + JPEG[-2:],
    "1,000 scans behind bytes FF": JPEG[:-2] + (b"\xff" * 50 + SCAN) * 1000 + JPEG[-2:],
    "a HEIC of 60,000 x 60,000": at(
        HEIC, HEIC.index(b"ispe") + 8, struct.pack(">II", 60000, 60000)
    ),
    "a HEIC without pixels": HEIC[: HEIC.index(b"mdat") + 4],
    "an AVIF of 60,000 x 60,000": at(
        AVIF, AVIF.index(b"ispe") + 8, struct.pack(">II", 60000, 60000)
    ),
    "an AVIF that is a video": b"\0\0\0\x14ftypavis" + bytes(8) + b"\0\0\0\x08moov",
    "a WebP of 16,384 x 16,384": at(WEBP, 21, b"\xff\xff\xff\x0f"),
    "a WebP without a picture": b"RIFF\x04\0\0\0WEBP",
}
for kind, data in PHOTOS.items():
    attack(kind, "image, mask", data)
for kind in ("EPS", "13,000 x 13,000", "TIFF", "16 bits, cut"):
    attack(
        kind,
        "capture, photos, summary",
        changed("capture", lambda _, k=kind: PHOTOS[k], "images/000.png"),
    )
TEXTS = {
    "16 bits and a bomb": png(4, 1, 16, data=zeros(1 << 32)),
    "8 bits and a bomb": png(4, 1, data=zeros(1 << 32)),
    "text of a gigabyte": png(4, 4, extra=chunk(b"zTXt", b"x\0\0" + zeros(1 << 30))),
    "a profile that is a bomb": png(
        4, 4, data=ROWS, extra=chunk(b"iCCP", b"a\0\0" + zeros(1 << 30))
    ),
    "a gamma of 0": png(4, 4, data=ROWS, extra=chunk(b"gAMA", bytes(4))),
    "primaries of 0": png(4, 4, data=ROWS, extra=chunk(b"cHRM", bytes(32))),
    "all code points": png(4, 4, data=ROWS, extra=chunk(b"cICP", b"\xff" * 400)),
}
for kind, data in TEXTS.items():
    attack(kind, "image", data, "either")
P3 = profiles.of_colors(profiles.P3_TO_XYZ, profiles.SRGB_CURVE)
TABLE = {"kind": b"prtr", "pcs": b"Lab "}
CUBE = b"mft1" + bytes(4) + bytes([3, 3, 255, 0]) + bytes(600)
SIXTEEN = b"mft2" + bytes(4) + bytes([16, 16, 255, 0]) + b"\xff" * 600
SELF = b"mAB " + bytes(4) + b"\3\3\0\0" + struct.pack(">5I", *[32] * 5) + b"mAB " * 50
LONG_CURVE = b"curv" + bytes(4) + b"\xff" * 40
PROFILES = {
    "one byte": b"\0",
    "zeros": bytes(400),
    "a size of 4 GB": at(P3, 0, b"\xff" * 4),
    "4 billion parts": at(P3, 128, b"\xff" * 4),
    "parts behind the end": at(P3, 136, b"\xff" * 8),
    "an unknown space": at(P3, 16, b"ZZZZ"),
    "a table of 4 billion": profiles.of_colors(profiles.P3_TO_XYZ, LONG_CURVE),
    "an exponent of 255": profiles.of_colors(profiles.P3_TO_XYZ, profiles.gamma(255)),
    "primaries of nothing": profiles.of_colors(0 * profiles.P3_TO_XYZ, profiles.SRGB_CURVE),
    "a cube of 255 sides": profiles.profile({b"A2B0": CUBE}, **TABLE),
    "16 channels": profiles.profile({b"A2B0": SIXTEEN}, **TABLE),
    "elements within themselves": profiles.profile({b"A2B0": SELF}, **TABLE),
    "5 MB": P3 + bytes(5 << 20),
}
for kind, data in PROFILES.items():
    attack(f"a profile: {kind}", "image", photo("JPEG", icc_profile=data), "read")
IN_ITSELF = b"Exif\0\0MM\0*\0\0\0\x08\0\1\x87\x69\0\4\0\0\0\1\0\0\0\x08\0\0\0\x08"
EXIF = {
    "folders within themselves": IN_ITSELF,
    "a folder behind the end": b"Exif\0\0MM\0*\xff\xff\xff\xf0",
    "60,000 tags": b"Exif\0\0MM\0*\0\0\0\x08\xff\xff"
    + b"\xa0\2\0\4\xff\xff\xff\xff\0\0\0\x08" * 5000,
}
for kind, data in EXIF.items():
    attack(f"EXIF: {kind}", "image", photo("JPEG", exif=data), "read")
BEHIND = {
    "a video behind it": JPEG + b"\0\0\0\x18ftypmp42" + b"\xff\xda\0\x08" * 1000,
    "a million bytes FF": JPEG[:2] + b"\xff" * 1_000_000 + JPEG[2:],
}
for kind, data in BEHIND.items():
    attack(kind, "image", data, "read")


# Gaussians, meshes, GLB
# --------------------------------------------------------------------------------------------------


def glb(header, rest=b""):
    header += b" " * (-len(header) % 4)
    body = struct.pack("<II", len(header), 0x4E4F534A) + header + rest
    return struct.pack("<III", 0x46546C67, 2, 12 + len(body)) + body


def glb_with(changes):
    def change(data):
        length = struct.unpack_from("<I", data, 12)[0]
        content = setting(changes)(json.loads(data[20 : 20 + length]))
        return glb(json.dumps(content).encode(), data[20 + length :])

    return changed("glb motion", change)


GLBS = {
    "an accessor of 2^62": {"accessors.0.count": 1 << 62},
    "an accessor below 0": {"accessors.0.count": -3},
    "an accessor of words": {"accessors.0.count": "many"},
    "a count too large": {"accessors.0.count": 100_000},
    "another type": {"accessors.0.componentType": 7},
    "a view beyond the end": {"bufferViews.0.byteOffset": 1 << 40},
    "a view below 0": {"bufferViews.0.byteOffset": -8},
    "another file": {"buffers.0.uri": "../../etc/passwd"},
    "another machine": {"buffers.0.uri": "http://127.0.0.1:9/x.bin"},
}
for kind, changes in GLBS.items():
    attack(kind, "glb motion", glb_with(changes))
attack("lists in lists", "glb motion", glb(NESTED))


def spz_four(count, unpacked, streams=5, place=32):
    """Returns a maker of a version 4 file whose frames unpack to 64 MB each.

    `unpacked` are the sizes that its table states.
    """
    frame = zstd.compress(bytes(64 << 20))
    table = b"".join(struct.pack("<QQ", len(frame), size) for size in unpacked)
    header = struct.pack("<IIIBBBBI12x", 0x5053474E, 4, count, 0, 12, 0, streams, place)
    return written("a.spz", lambda: header + table + frame * len(unpacked))


def spz(count, degree, size):
    header = struct.pack("<IIIBBBB", 0x5053474E, 3, count, degree, 12, 0, 0)
    return gzip.compress(header + bytes(size))


BINARY, TEN = "binary_little_endian", [90, 10, 30, 30, 40]
attack("more than it says", "spz 4", spz_four(10, TEN))
attack("a table of 10^18 bytes", "spz 4", spz_four(10, [10**18] * 5))
attack("4 billion", "spz 4", spz_four(2**32 - 1, TEN))
attack("255 streams", "spz 4", spz_four(10, TEN, streams=255))
attack("a table behind the end", "spz 4", spz_four(10, TEN, place=2**32 - 1))
attack("4 billion", "spz", spz(2**32 - 1, 0, 0))
attack("19 million of zeros", "spz", spz(19_000_000, 3, 64 << 20))
attack("ten times as long", "spz", spz(10, 0, 64 << 20))
attack("10^12 in the header", "3dgs", ply(BINARY, {"vertex 1000000000000": {"float": "x"}}, b""))
attack("10 million without properties", "3dgs", ply(BINARY, {"vertex 10000000": {}}, b""))
attack("one property twice", "3dgs", ply(BINARY, {"vertex 1": {"float": "xx"}}, bytes(8)))
NAN = ply("ascii", {"vertex 1": {"double": TEXT_PLY}}, b"nan " * 13 + b"nan\n")
attack("NaN", "3dgs text", NAN)
attack("a texture outside", "obj", lambda folder: write_obj(folder, "../../etc/passwd"), "read")
TRIANGLE = "v 0 0 0\nv 1 0 0\nv 0 1 0\n"
MESHES = {
    "a corner of 2^30": TRIANGLE + "f 1 2 1073741824\n" * 60,
    "a corner of 10^30": TRIANGLE + f"f 1 2 {10**30}\n" * 60,
    "places of words": "v a b c\n" * 9 + "f 1 2 3\n" * 60,
    "one line of 4 MB": "v " + "1 " * (2 << 20),
    "30,000 materials": TRIANGLE + "".join(f"usemtl a{i}\nf 1 2 3\n" for i in range(30_000)),
}
for kind, text in MESHES.items():
    attack(kind, "obj", text.encode())
for suffix in ("dae", "3mf", "gltf", "zip", "svg", "urdf", "json", "pkl", ""):
    attack(f"named .{suffix}", "obj", written(f"scan.{suffix}", "<?xml version='1.0'?><a/>"))


# Text
# --------------------------------------------------------------------------------------------------

OF_JSON = "transforms, opencv json, openpose, coco, mmpose, LHM, face scores, manifest, settings"
DEEP = {
    "lists in lists": b"[" * 100_000 + b"]" * 100_000,
    "900 lists in lists": b"[" * 900 + b"]" * 900,
    "a number of 5,000 digits": b'{"frames": ' + b"9" * 5000 + b"}",
    "characters that do not exist": b'{"a": "\xff\xfe"}',
}
PLAIN = {"null": b"null", "a number": b"3", "a word": b'"a"', "a list of nothing": b"[]"}
for kind, data in (DEEP | PLAIN).items():
    for reader in OF_JSON.split(", "):
        may = "either" if reader == "LHM" and kind in PLAIN else "refused"  # one of several files
        attack(kind, reader, changed(reader, lambda _, data=data: data), may)
attack("100 MB", "json, openpose", written("a.json", lambda: b"[" + b"1," * (50 << 20) + b"1]"))
MATRIX = "K_a: !!opencv-matrix\n   rows: {0}\n   cols: {0}\n   dt: d\n   data: [1, b]"
LAUGHS = "\n".join(f"{b}: &{b} [*{a},*{a}]" for a, b in zip("abcdefgh", "bcdefghi", strict=True))
YAML = {
    "lists in lists": "a: " + "[" * 3000 + "]" * 3000,
    "maps in maps": "\n".join(" " * i + "a:" for i in range(2000)),
    "a billion laughs": "a: &a [x,x]\n" + LAUGHS,
    "2 MB": "K_a: 1\n" * 300_000,
    "a number of 400,000 digits": "K_a: " + "1" * 400_000,
    "commas": "K_a: {" + "," * 200_000,
    "python's objects": "K_a: !!python/object/apply:os.system ['touch OWNED']",
    "a matrix of 10^18": MATRIX.format(10**9),
    "a matrix that is negative": MATRIX.format(-1),
}
for kind, text in YAML.items():
    attack(kind, "opencv yaml", ("%YAML:1.0\n---\n" + text).encode())
attack("tables in tables", "toml", b"a=" + b"[" * 3000 + b"]" * 3000)
attack(
    "entities",
    "qualisys",
    written("a.qca.txt", "<!DOCTYPE x [<!ENTITY a 'b'>]><a><transform/>focalLengthU"),
)
attack("a million columns", "face table", ",".join(["JawOpen"] * 1_000_000).encode())
attack(
    "an open quote", "face table", changed("face table", lambda data: data + b'"' + b"x" * 300_000)
)
for seconds in (b"1e-9", b"1e9", b"1e-300"):
    of_time = lambda data, s=seconds: data.replace(b"Frame Time: 0.0083333", b"Frame Time: " + s)
    attack(f"frames of {seconds.decode()} s", "bvh", changed("bvh", of_time))
NOBODY = '{"pose_keypoints_2d":[]}'
FEW_BYTES = {
    "110,000 people": ("openpose", '{"people":[' + ",".join([NOBODY] * 110_000) + "]}"),
    "a million images": (
        "coco annotations",
        '{"annotations":[],"images":[' + "0," * 999_999 + "0]}",
    ),
    "200,000 instances": ("mmpose", '[{"frame_id":0,"instances":[' + "0," * 199_999 + "0]}]"),
    "200,000 results": ("coco", "[" + ",".join(['{"image_id":0}'] * 200_000) + "]"),
}
for kind, (reader, text) in FEW_BYTES.items():
    attack(kind, reader, written("a.json", text))
BAD_NUMBERS = {"10^400": 10**400, "words": "x", "objects": {}, "ragged": [[1], 2]}
NUMBERS = {
    "import": ("frames.0.transform_matrix.0.0", "fl_x", "w"),
    "cameras of splats": ("0.position", "0.rotation", "0.fx", "0.width", "0"),
    "capture": ("views.0.K", "views.0.cam_from_world", "views.0.frame", "views.0.image"),
    "openpose": ("people.0.pose_keypoints_2d",),
    "coco": ("0.keypoints",),
    "mmpose": ("instance_info.0.instances.0.keypoint_scores",),
    "LHM": ("root_pose",),
    "manifest": ("settings", "split", "generator_version", "version", "format"),
}
for reader, paths in NUMBERS.items():
    for path in paths:
        for kind, bad in BAD_NUMBERS.items():
            if (path, kind) != ("settings", "objects"):
                attack(f"{path} of {kind}", reader, with_values(reader, {path: bad}))
ENCODER = "model.architecture.encoder"
CONFIGURATIONS = {
    "100,000 layers": {f"{ENCODER}.transformer.layers": 100_000},
    "10^400 layers": {f"{ENCODER}.transformer.layers": 10**400},
    "a width of 10^12": {f"{ENCODER}.transformer.width": 10**12},
    "a texture of 10^9": {f"{ENCODER}.texture.resolution": 10**9},
    "patches of half": {f"{ENCODER}.patch_size": 0.5},
}
for kind, changes in CONFIGURATIONS.items():
    attack(kind, "configuration", with_values("configuration", changes))
WORDS = {
    "a title": "\x1b]0;OWNED\x07",
    "C1": "\x9b2J\x85",
    "a new line": "a\nhumangs: error: forged",
    "a carriage return": "a\rforged",
    "marks of direction": "\u202egnp\u2066\u2069",
    "a line separator": "\u2028\u2029",
    "half a surrogate": "\udc9b",
}
"""Text that a terminal would act on."""
for kind, text in WORDS.items():
    for key in ("image", "mask"):
        named = with_values("capture", {f"views.0.{key}": f"images/{text}.png"})
        attack(f"{kind} in {key}", "capture, photos", named)
    unread = {"frames.0.file_path": text, "frames.0.transform_matrix": [1]}
    attack(f"{kind} in a path", "import", with_values("import", unread))
    attack(f"{kind} in a field", "configuration", with_values("configuration", {text: 1}))
    attack(
        f"{kind} in a name", "coco", with_values("coco", {"0.file_name": text, "0.keypoints": [1]})
    )


# Paths out of a folder, and folders that cost more than they weigh
# --------------------------------------------------------------------------------------------------

OUTSIDE = {"views.0.image": "outside.png", "views.0.mask": "mask.png", "body": "outside.npz"}
"""Files beside a capture, by the keys that may name them."""


def capture_with(changes, prepare=lambda folder: None):
    """Returns a maker of a capture with other values, after `prepare` has changed its folder."""

    def make(folder):
        folder = write_capture(folder / "me")
        prepare(folder)
        own = changes(folder) if callable(changes) else changes
        edit_bytes(
            folder / "capture.json",
            lambda data: json.dumps(setting(own)(json.loads(data))).encode(),
        )
        return folder

    return make


def beside(folder, linked=False):
    picture("outside.png", 12, 10, 3)(folder.parent)
    picture("mask.png", 12, 10)(folder.parent)
    np.savez(folder.parent / "outside.npz", **PARAMETERS)
    for name in OUTSIDE.values() if linked else ():
        (folder / name).symlink_to(folder.parent / name)


WAYS_OUT = {
    "an absolute path": lambda folder, name: str(folder.parent / name),
    "a path upwards": lambda folder, name: f"../{name}",
    "a path down and upwards": lambda folder, name: f"images/../../{name}",
    "a null character": lambda folder, name: f"{name}\0",
    "a link outwards": lambda folder, name: name,
}
for way, named in WAYS_OUT.items():
    for key, name in OUTSIDE.items():
        make = capture_with(
            lambda folder, key=key, named=named, name=name: {key: named(folder, name)},
            lambda folder, way=way: beside(folder, "link" in way),
        )
        attack(f"{key}: {way}", "capture, photos, summary", make)
for name in ("../outside.png", "/outside.png", "photos/../../outside.png", "..\\outside.png"):
    attack(f"a photo {name}", "import", with_values("import", {"frames.0.file_path": name}))
for name in ("..", "../..", "/", "x\0y"):

    def named_camera(folder, name=name):
        write_import(folder)
        camera = {"K": np.eye(3).tolist(), "R": np.eye(3).tolist(), "T": [0, 0, 3]}
        return written("cameras.json", {name: camera | {"imgSize": [10, 12]}})(folder)

    attack(f"a camera {name!r}", "import", named_camera)


def views(count, image="images/000.png", **changes):
    """Returns views that each name a photo; "{}" in `image` stands for the view's number."""
    one = {key: value for key, value in CAPTURE_VIEW.items() if key != "mask"} | changes
    return {"views": [one | {"frame": 0, "image": image.format(i)} | changes for i in range(count)]}


CAPTURE_VIEW = json.loads(json.dumps({"image": "", "K": [[60.0, 0, 5], [0, 60, 6], [0, 0, 1]]}))
CAPTURE_VIEW["cam_from_world"] = TRANSFORMS["frames"][0]["transform_matrix"]


def large(count=0, link=os.link, size=1024):
    """Returns a preparation that writes a large photo and `count` links to it."""

    def prepare(folder):
        Image.fromarray(np.zeros((size, size, 3), np.uint8)).save(folder / "images" / "000.png")
        for i in range(count):
            link(folder / "images" / "000.png", folder / f"{i}.png")

    return prepare


attack("one photo 4,000 times", "capture, photos, summary", capture_with(views(4000), large()))
attack(
    "400 links", "capture, photos", capture_with(views(400, "{}.png"), large(400, os.symlink, 1600))
)
attack(
    "400 hard links", "capture, photos", capture_with(views(400, "{}.png"), large(400, size=1600))
)
attack(
    "21 white photos", "capture, photos", capture_with(views(21, "{}.png"), large(21, size=7000))
)
attack("5,000 photos", "photos", capture_with(views(5000, "{}.png"), large(5000, size=12)))
for frame in (2_000_000_000, 10**30, 1000):
    attack(f"frame {frame}", "photos", capture_with(views(4, frame=frame)))


def two_links_to_itself(folder):
    for name in "ab":
        (folder / name).symlink_to(folder)


def forty_pairs(folder):
    """Makes a chain of folders, each with two links to the next."""
    for i in range(40):
        (folder / f"p{i}").mkdir()
        for name in "ab":
            (folder / f"p{i}" / name).symlink_to(folder / f"p{i + 1}")


def nested(folder):
    for _ in range(900):
        folder = folder / "a"
        folder.mkdir()


FOLDERS = {
    "two links to itself": two_links_to_itself,
    "a link to the root": lambda folder: (folder / "all").symlink_to("/"),
    "40 pairs of links": forty_pairs,
    "a link in a circle": lambda folder: (folder / "x.png").symlink_to(folder / "x.png"),
    "900 folders in folders": nested,
}
for kind, prepare in FOLDERS.items():

    def photos_with(folder, prepare=prepare):
        write_import(folder)
        prepare(folder / "photos")
        return folder

    def keypoints_with(folder, prepare=prepare):
        FORMATS["openpose"].make(folder)
        prepare(folder)
        return folder

    attack(kind, "start", photos_with, "either")
    attack(kind, "openpose", keypoints_with, "either")


# Numbers that no person has
# --------------------------------------------------------------------------------------------------


def first(value, index=0):
    """Returns a change of one number of an array, by default the first."""

    def change(old):
        new = np.array(old)
        new.reshape(-1)[index] = value
        return new

    return change


def header(**changes):
    return {"header": lambda old: np.asarray(json.dumps(json.loads(str(old)) | changes))}


def full(value):
    return lambda old: np.full_like(old, value)


FLOATS = "means, quats, scales, opacities, colors, skinning_weights, rest_vertices, rest_joints"
ARRAYS = {
    "avatar": {f"NaN in {name}": {name: first(np.nan)} for name in FLOATS.split(", ")}
    | {
        "opacity 9": {"opacities": first(9.0)},
        "a negative scale": {"scales": first(-0.1)},
        "a skinning weight of -3": {"skinning_weights": first(-3.0)},
        "weights of 0": {"skinning_weights": full(0)},
        "a corner of 2^30": {"faces": first(1 << 30)},
        "a corner of -1": {"faces": first(-1)},
        "words": {"means": np.asarray(["a"])},
        "complex numbers": {"colors": lambda old: old.astype(complex)},
        "means of 3e38": {"means": first(3e38)},
        "quaternions of 1e30": {"quats": first(1e30)},
        "joints a light year away": {"rest_joints": first(1e16)},
        "a circle of parents": header(parents=[-1, 2, 1]),
        "a parent that is not there": header(parents=[-1, 7, 0]),
        "10^6 parents": header(parents=[-1] + [0] * 10**6),
        "too few names": header(joint_names=["a"]),
        "a title for a joint": header(joint_names=["a", "b", "\x1b]0;OWNED\x07"]),
        "another skinning": header(skinning="exec"),
        "a deep header": {"header": np.asarray("[" * 50_000)},
        "another checksum": header(checksum="0" * 64),
    },
    "body": {
        "corners outside": {"faces": first(99)},
        "joints outside": {"weight_joints": first(99)},
        "NaN": {"template": first(np.nan)},
        "weights of 0": {"weight_values": full(0)},
        "a circle of parents": {"parents": first(1)},
        "a template of 1e38": {"template": first(1e38)},
    },
    "smplx npz": {
        "corners outside": {"f": first(99)},
        "NaN": {"v_template": first(np.nan)},
        "another tree": {"kintree_table": first(9, 3)},
        "no vertices": {"v_template": np.zeros((0, 3))},
        "directions of 1e300": {"shapedirs": full(1e300)},
        "weights of 0": {"weights": full(0)},
    },
    "bank": {
        "a seed of another split": {"seeds": first(10**9)},
        "another version": {"version": np.asarray(99)},
        "NaN": {"vertices": first(np.nan)},
        "corners outside": {"faces": first(60_000)},
        "another number of people": {"betas": np.zeros((9, 3), np.float32)},
    },
    "fit record": {
        "another set": {"set": np.asarray("mine")},
        "a shape that does not fit": {"points": np.zeros((2, 3, 2))},
    },
    "amass": {
        "NaN": {"poses": first(np.nan)},
        "poses of 1e300": {"poses": first(1e300)},
        "places of 1e9": {"trans": first(1e9)},
        "a rate of 0": {"mocap_framerate": np.asarray(0.0)},
        "no frames": {"poses": np.zeros((0, 156)), "trans": np.zeros((0, 3))},
        "another number of frames": {"trans": np.zeros((9, 3))},
    },
    "filmed": {
        "a rate of 10^9": {"fps": np.asarray(1e9)},
        "a rate of 10^-9": {"fps": np.asarray(1e-9)},
        "300,000 frames": {
            "rotations": np.zeros((300_000, 55, 3), np.float32),
            "translations": np.zeros((300_000, 3), np.float32),
        },
        "9,000 frames of 100 s": {
            **{"rotations": np.zeros((9000, 55, 3)), "translations": np.zeros((9000, 3))},
            "fps": np.asarray(0.01),
        },
    },
}
for reader, kinds in ARRAYS.items():
    for kind, changes in kinds.items():
        attack(kind, reader, with_arrays(reader, **changes))
attack("without a checksum", "avatar", with_arrays("avatar"), "read")
for key in ("betas", "rotations", "translations", "displacement"):
    huge = PARAMETERS | {key: np.full(PARAMETERS[key].shape, 1e38)}
    save = lambda folder, arrays=huge: np.savez(folder / "body.npz", **arrays)
    attack(f"{key} of 1e38", "capture", capture_with({}, save))
for kind, rows in {
    "no axes": np.asarray(1.0),
    "matrices of NaN": np.full((3, 22, 3, 3), np.nan),
    "rows of words": np.full((3, 72), "x"),
    "rows of 10^300": np.full((3, 322), 1e300),
    "objects": np.asarray([Call()], object),
}.items():
    stream = io.BytesIO()
    np.save(stream, rows, allow_pickle=True)
    attack(kind, "Motion-X", stream.getvalue())
