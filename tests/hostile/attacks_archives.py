"""npz and safetensors files: false sizes, bombs, nesting."""

import io
import json
import struct
import zipfile
import zlib

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
    return bytes(body) + directory + b"PK\5\6" + struct.pack("<HHHHIIH", 0, 0, count, count, len(directory), len(body), 0)


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
ARCHIVES = {f"with {kind}": npz_of(("x.npy", data + bytes(16 * (kind == "objects")))) for kind, data in HEADERS.items()} | {
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
many = lambda suffix: lambda: raw_zip([(f"{i}{suffix}".encode(), 0, b"", 0) for i in range(100_000)])
case("100,000 members", "npz", written("a.npz", many(".npy")), item=5)
case("100,000 members", "torch zip", written("a.pt", many("")), item=5)


# safetensors -----------------------------------------------------------------------------------------------


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
