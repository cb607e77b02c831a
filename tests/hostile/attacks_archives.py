"""npz, MATLAB, safetensors and OpenEXR files: false sizes, bombs, nesting."""

import io
import json
import struct
import zipfile
import zlib

import numpy as np
from hostile_cases import case, written

# Archives -------------------------------------------------------------------------------------------------------------


def raw_zip(members):
    """A zip of (name, method, compressed bytes, size when unpacked), checksums left out."""
    body, directory = bytearray(), bytearray()
    for name, method, data, size in members:
        common = struct.pack("<HHHHHIIIHH", 20, 0, method, 0, 0, 0, len(data), size, len(name), 0)
        directory += b"PK\1\2" + struct.pack("<H", 20) + common + struct.pack("<HHHII", 0, 0, 0, 0, len(body)) + name
        body += b"PK\3\4" + common + name + data
    count = min(len(members), 0xFFFF)
    return (
        bytes(body) + directory + b"PK\5\6" + struct.pack("<HHHHIIH", 0, 0, count, count, len(directory), len(body), 0)
    )


def deflated_zeros(size, start=b""):
    """`start`, then zeros, compressed: one block again and again, so that gigabytes take no time."""
    pack = zlib.compressobj(9, zlib.DEFLATED, -15)
    head = pack.compress(start) + pack.flush(zlib.Z_FULL_FLUSH)
    block = pack.compress(bytes(1 << 20)) + pack.flush(zlib.Z_FULL_FLUSH)
    block = pack.compress(bytes(1 << 20)) + pack.flush(zlib.Z_FULL_FLUSH)
    return head + block * (size >> 20) + pack.flush()


def npy_header(descr="'<f8'", order=False, shape="(3,)", version=(1, 0), extra=""):
    text = f"{{'descr': {descr}, 'fortran_order': {order}, 'shape': {shape}, {extra}}}\n".encode()
    return b"\x93NUMPY" + bytes(version) + struct.pack("<H" if version[0] == 1 else "<I", len(text)) + text


def npz_of(*members):
    """Stored members (name, bytes)."""
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w") as archive:
        for name, data in members:
            archive.writestr(name, data)
    return stream.getvalue()


def bomb(gigabytes):
    header = npy_header(shape=f"({(1 << 30) // 8},)")
    data = deflated_zeros(1 << 30, header)
    return raw_zip([(f"x{i}.npy".encode(), 8, data, (1 << 30) + len(header)) for i in range(gigabytes)])


HEADERS = {
    "a shape of 10^18": npy_header(shape="(1000000000, 1000000000)"),
    "a shape of 10^100": npy_header(shape="(10**100,)"),
    "a negative shape": npy_header(shape="(-1,)"),
    "strings of no length": npy_header("'<U0'", shape="(1000000000000,)"),
    "objects": npy_header("'|O'", shape="(1,)"),
    "a record with an object": npy_header("[('a', '|O')]", shape="(1,)"),
    "a record": npy_header("[('a', '<f8')]", shape="(1,)"),
    "a type of 2^40": npy_header("'|V1099511627776'", shape="(1,)"),
    "a type within types": npy_header("('<f8', (1000000, 1000000))", shape="(1,)"),
    "dates": npy_header("'<M8[s]'", shape="(1,)"),
    "a header that is code": npy_header("__import__('os').system('x')"),
    "a header of 9,000 brackets": npy_header("(" * 9000),
    "a header of 9,000 signs": npy_header("-" * 9000 + "1"),
    "a header of 2^31": b"\x93NUMPY\2\0" + struct.pack("<I", (1 << 31) - 1),
    "no header": b"",
    "version 9": npy_header(version=(9, 0)),
    "characters that do not exist": npy_header("'<U1'", shape="(1,)") + b"\xff\xff\xff\x7f",
}
ARCHIVES = {
    f"with {kind}": npz_of(("x.npy", data + bytes(16 * (kind == "objects")))) for kind, data in HEADERS.items()
} | {
    "with two members of one name": None,
    "encrypted": raw_zip([(b"x.npy", 0, bytes(20), 20)]).replace(b"PK\3\4\x14\0\0\0", b"PK\3\4\x14\0\1\0"),
    "compressed in another way": raw_zip([(b"x.npy", 14, bytes(20), 20)]),
    "with a method that does not exist": raw_zip([(b"x.npy", 99, bytes(20), 20)]),
    "with a false checksum": raw_zip([(b"x.npy", 0, npy_header() + bytes(24), len(npy_header()) + 24)]),
    "with damaged deflate": raw_zip([(b"x.npy", 8, b"\xff" * 40, 400)]),
    "that says it is larger": raw_zip([(b"x.npy", 0, bytes(20), 1 << 31)]),
}
for kind, data in ARCHIVES.items():
    if data is not None:
        unread = "objects" in kind or "an object" in kind
        case(kind, "npz", written("a.npz", data), "read" if unread else "refused", item=6)
        for reader in ("smplx npz", "avatar", "amass", "bank", "joints npz", "fit record", "body", "keypoints npz"):
            case(kind, reader, written("a.npz", data), item=6)
for gigabytes in (1, 8):
    for reader in ("npz", "avatar", "smplx npz", "amass", "keypoints npz"):
        case(f"zeros of {gigabytes} GiB", reader, written("a.npz", lambda g=gigabytes: bomb(g)), item=5)
case(
    "100,000 members",
    "npz",
    written("a.npz", lambda: raw_zip([(f"{i}.npy".encode(), 0, b"", 0) for i in range(100_000)])),
    item=5,
)
case(
    "100,000 members",
    "torch zip",
    written("a.pt", lambda: raw_zip([(f"{i}".encode(), 0, b"", 0) for i in range(100_000)])),
    item=5,
)


# MATLAB, safetensors, OpenEXR -----------------------------------------------------------------------------------------------


def element(kind, data):
    return struct.pack("<II", kind, len(data)) + data + bytes(-len(data) % 8)


def matrix(klass, shape, *parts, name=b""):
    head = element(6, struct.pack("<II", klass, 0)) + element(5, np.asarray(shape, "<i4").tobytes()) + element(1, name)
    return element(14, head + b"".join(parts))


def mat_file(*elements):
    return b"MATLAB 5.0 MAT-file".ljust(124) + b"\0\1IM" + b"".join(elements)


def nested_cells(depth):
    inner, size, heads = matrix(6, (1, 1), element(9, bytes(8))), 0, []
    size = len(inner)
    for i in range(depth):
        name = element(1, b"layers" if i == depth - 1 else b"")
        head = element(6, struct.pack("<II", 1, 0)) + element(5, struct.pack("<ii", 1, 1)) + name
        size += len(head)
        heads.append(struct.pack("<II", 14, size) + head)
        size += 8
    return mat_file(*reversed(heads), inner)


LAYERS = {"name": b"layers"}
MATS = {
    "5,000 cells in cells": (nested_cells(5000), 1),
    "100,000 cells in cells": (nested_cells(100_000), 1),
    "10^9 cells": (mat_file(matrix(1, (1, 1_000_000_000), **LAYERS)), 5),
    "cells below 0": (mat_file(matrix(1, (1, -1), **LAYERS)), 6),
    "10^9 structures": (
        mat_file(matrix(2, (1, 10**9), element(5, struct.pack("<i", 8)), element(1, b"type\0\0\0\0"), **LAYERS)),
        5,
    ),
    "names of no length": (
        mat_file(matrix(2, (1, 1), element(5, struct.pack("<i", 0)), element(1, b"type"), **LAYERS)),
        6,
    ),
    "a function handle": (mat_file(matrix(16, (1, 1), matrix(6, (1, 1), element(9, bytes(8))), **LAYERS)), 6),
    "an object": (mat_file(matrix(3, (1, 1), **LAYERS)), 6),
    "numbers of 2^62": (mat_file(matrix(6, ((1 << 31) - 1, (1 << 31) - 1), element(9, bytes(8)), **LAYERS)), 5),
    "compressed zeros of 4 GiB": (
        mat_file(struct.pack("<II", 15, len(z := b"\x78\xda" + deflated_zeros(4 << 30))), z),
        5,
    ),
    "compressed nonsense": (mat_file(element(15, b"\xff" * 64)), 6),
    "of the other byte order": (b"MATLAB 5.0 MAT-file".ljust(124) + b"\1\0MI", 6),
    "of version 7.3": (b"MATLAB 7.3 MAT-file".ljust(124) + b"\0\2IM", 6),
}
for kind, (data, item) in MATS.items():
    case(kind, "matlab", written("a.mat", data), item=item)
    case(kind, "vgg", written("a.mat", data), item=item)


def safetensors(header, data=bytes(64)):
    header = header if isinstance(header, bytes) else json.dumps(header).encode()
    return struct.pack("<Q", len(header)) + header + data


TENSOR = {"dtype": "F32", "shape": [4], "data_offsets": [0, 16]}
SAFETENSORS = {
    "8 bits": ({"w": {"dtype": "F8_E4M3", "shape": [16], "data_offsets": [0, 16]}}, 6),
    "a type that does not exist": ({"w": {**TENSOR, "dtype": "X9"}}, 6),
    "offsets beyond the end": ({"w": {**TENSOR, "data_offsets": [0, 1 << 40]}}, 6),
    "offsets backwards": ({"w": {**TENSOR, "data_offsets": [16, 0]}}, 6),
    "offsets of two tensors": ({"w": TENSOR, "v": TENSOR}, 6),
    "a shape of 2^64": ({"w": {**TENSOR, "shape": [1 << 32, 1 << 32]}}, 5),
    "a shape below 0": ({"w": {**TENSOR, "shape": [-4]}}, 6),
    "lists in lists": (b'{"a":' + b"[" * 90_000 + b"]" * 90_000 + b"}", 6),
    "a header of 2 MB": (b'{"__metadata__": {"a": "' + b"x" * (2 << 20) + b'"}}', 5),
    "numbers as metadata": ({"__metadata__": {"a": 1}, "w": TENSOR}, 6),
}
for kind, (header, item) in SAFETENSORS.items():
    for reader in ("safetensors", "weights", "vgg", "released checkpoint"):
        case(kind, reader, written("a.safetensors", safetensors(header)), item=item)
case("a header of 2^60", "safetensors", written("a.safetensors", struct.pack("<Q", 1 << 60) + b"{" + bytes(64)), item=5)
