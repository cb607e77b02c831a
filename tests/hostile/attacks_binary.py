"""Archives (npz, safetensors): false sizes, bombs, nesting. Photos: too many pixels, damage.

Scans: accessors, textures.
"""

import gzip
import io
import json
import re
import struct
import zipfile
import zlib
from pathlib import Path

import honest_files as honest
from honest_files import pixels
from hostile_cases import PLACES, capture_with, case, changed, setting, written
from PIL import Image

from humangs_jax.avatar.export.spz import zstd

# Archives
# --------------------------------------------------------------------------------------------------


def raw_zip(members):
    """A zip of (name, method, compressed bytes, size when unpacked), checksums left out."""
    body, directory = bytearray(), bytearray()
    for name, method, data, size in members:
        common = struct.pack("<HHHHHIIIHH", 20, 0, method, 0, 0, 0, len(data), size, len(name), 0)
        directory += (
            b"PK\1\2"
            + struct.pack("<H", 20)
            + common
            + struct.pack("<HHHII", 0, 0, 0, 0, len(body))
            + name
        )
        body += b"PK\3\4" + common + name + data
    count = min(len(members), 0xFFFF)
    return (
        bytes(body)
        + directory
        + b"PK\5\6"
        + struct.pack("<HHHHIIH", 0, 0, count, count, len(directory), len(body), 0)
    )


def deflated_zeros(size, start=b""):
    """`start`, then zeros, compressed: one block again and again, so that gigabytes take no
    time.
    """
    pack = zlib.compressobj(9, zlib.DEFLATED, -15)
    head = pack.compress(start) + pack.flush(zlib.Z_FULL_FLUSH)
    pack.compress(bytes(1 << 20)) + pack.flush(zlib.Z_FULL_FLUSH)
    block = pack.compress(bytes(1 << 20)) + pack.flush(zlib.Z_FULL_FLUSH)
    return head + block * (size >> 20) + pack.flush()


def npy_header(descr="'<f8'", order=False, shape="(3,)", version=(1, 0), extra=""):
    text = f"{{'descr': {descr}, 'fortran_order': {order}, 'shape': {shape}, {extra}}}\n".encode()
    return (
        b"\x93NUMPY"
        + bytes(version)
        + struct.pack("<H" if version[0] == 1 else "<I", len(text))
        + text
    )


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
    return raw_zip(
        [(f"x{i}.npy".encode(), 8, data, (1 << 30) + len(header)) for i in range(gigabytes)]
    )


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
    "a header that is code": npy_header("__import__('os').system('x')"),
    "a header of 9,000 brackets": npy_header("(" * 9000),
    "a header of 2^31": b"\x93NUMPY\2\0" + struct.pack("<I", (1 << 31) - 1),
    "no header": b"",
    "version 9": npy_header(version=(9, 0)),
    "characters that do not exist": npy_header("'<U1'", shape="(1,)") + b"\xff\xff\xff\x7f",
}
ARCHIVES = {
    f"with {kind}": npz_of(("x.npy", data + bytes(16 * (kind == "objects"))))
    for kind, data in HEADERS.items()
} | {
    "encrypted": (
        raw_zip([(b"x.npy", 0, bytes(20), 20)]).replace(b"PK\3\4\x14\0\0\0", b"PK\3\4\x14\0\1\0")
    ),
    "compressed in another way": raw_zip([(b"x.npy", 14, bytes(20), 20)]),
    "with a method that does not exist": raw_zip([(b"x.npy", 99, bytes(20), 20)]),
    "with a false checksum": raw_zip(
        [(b"x.npy", 0, npy_header() + bytes(24), len(npy_header()) + 24)]
    ),
    "with damaged deflate": raw_zip([(b"x.npy", 8, b"\xff" * 40, 400)]),
    "that says it is larger": raw_zip([(b"x.npy", 0, bytes(20), 1 << 31)]),
}
for kind, data in ARCHIVES.items():
    case(kind, "npz", written("a.npz", data), "read" if "object" in kind else "refused", item=6)
    for reader in (
        "smplx npz",
        "avatar",
        "amass",
        "bank",
        "fit record",
        "body",
        "keypoints npz",
    ):
        case(kind, reader, written("a.npz", data), item=6)
for gigabytes in (1, 8):
    for reader in ("npz", "avatar", "smplx npz", "amass", "keypoints npz"):
        case(
            f"zeros of {gigabytes} GiB",
            reader,
            written("a.npz", lambda g=gigabytes: bomb(g)),
            item=5,
        )
many = lambda suffix: (
    lambda: raw_zip([(f"{i}{suffix}".encode(), 0, b"", 0) for i in range(100_000)])
)
case("100,000 members", "npz", written("a.npz", many(".npy")), item=5)
case("100,000 members", "torch zip", written("a.pt", many("")), item=5)


# safetensors
# -----------------------------------------------------------------------------------------------


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
case(
    "a header of 2^60",
    "safetensors",
    written("a.safetensors", struct.pack("<Q", 1 << 60) + b"{" + bytes(64)),
    item=5,
)


# Photos
# --------------------------------------------------------------------------------------------------


def chunk(name, data):
    return struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))


def png(width, height, depth=8, color=2, data=b"", method=b"\0\0\0", extra=b""):
    header = struct.pack(">IIBB", width, height, depth, color) + method
    return (
        b"\x89PNG\r\n\x1a\n"
        + chunk(b"IHDR", header)
        + extra
        + chunk(b"IDAT", data)
        + chunk(b"IEND", b"")
    )


def zlib_zeros(size):
    body = deflated_zeros(size)
    return b"\x78\xda" + body + struct.pack(">I", 1)


EPS = b"""%!PS-Adobe-3.0 EPSF-3.0
%%BoundingBox: 0 0 10 10
%%EndComments
(OWNED) (w) file closefile
showpage
%%EOF
"""


def as_format(kind, **options):
    def data():
        stream = io.BytesIO()
        Image.fromarray(pixels(8, 8, 3)).save(stream, kind, **options)
        return stream.getvalue()

    return data


def progressive(scans):
    """A JPEG whose scans are repeated."""
    data = as_format("JPEG", progressive=True)()
    start = data.rindex(b"\xff\xda")
    scan = data[start:-2]
    return data[:start] + scan * scans + data[-2:]


HEIC = (Path(__file__).parents[1] / "io" / "phone.heic").read_bytes()
HEIC_SIZE = HEIC.index(b"ispe") + 8


def heic(width, height):
    """A HEIC photo that states this size of its 32 x 24 pixels."""
    return HEIC[:HEIC_SIZE] + struct.pack(">II", width, height) + HEIC[HEIC_SIZE + 8 :]


ROW16 = b"\0" + bytes(6 * 4)
PHOTOS = {
    "13,000 x 13,000": (png(13_000, 13_000, data=zlib_zeros(1 << 20)), 5),
    "13,000 x 13,000 of 16 bits": (png(13_000, 13_000, 16, data=zlib_zeros(1 << 20)), 6),
    "2^31 x 2^31": (png((1 << 31) - 1, (1 << 31) - 1), 5),
    "of no width": (png(0, 10), 6),
    "one pixel high, 60,000,000 wide": (png(60_000_000, 1, data=zlib_zeros(1 << 20)), 5),
    "8,000 x 8,000 without pixels": (png(8000, 8000), 5),
    "16 bits, cut": (png(100, 100, 16, data=zlib.compress(ROW16)), 6),
    "16 bits, no such filter": (png(4, 1, 16, data=zlib.compress(b"\x09" + ROW16[1:])), 6),
    "16 bits, no such method": (png(4, 1, 16, data=zlib.compress(ROW16), method=b"\7\0\0"), 6),
    "16 bits, damaged deflate": (png(4, 1, 16, data=b"\xff" * 30), 6),
    "16 bits and a bomb": (png(4, 1, 16, data=zlib_zeros(1 << 32)), 5),
    "8 bits and a bomb": (png(4, 1, data=zlib_zeros(1 << 32)), 5),
    "a false checksum": (png(4, 4, data=zlib.compress(bytes(52))).replace(b"IDAT", b"IDBT"), 6),
    "text of a gigabyte": (png(4, 4, extra=chunk(b"zTXt", b"x\0\0" + zlib_zeros(1 << 30))), 5),
    "EPS": (EPS, 4),
    "EPS behind a comment": (
        b"\xc5\xd0\xd3\xc6"
        + struct.pack("<IIIIIIH", 32, len(EPS), 0, 0, 0, 0, 0xFFFF)
        + b"\0\0"
        + EPS,
        4,
    ),
    **{kind: (as_format(kind)(), 4) for kind in ("GIF", "TIFF", "BMP", "ICO", "PDF", "PPM")},
    "SVG": (b"<svg xmlns='http://www.w3.org/2000/svg'/>", 4),
    "a JPEG of 1,000 scans": (progressive(1000), 5),
    "a JPEG of 65,000 x 65,000": (
        as_format("JPEG")().replace(struct.pack(">HH", 8, 8), struct.pack(">HH", 65000, 65000)),
        5,
    ),
    "a HEIC of 60,000 x 60,000": (heic(60_000, 60_000), 5),
    "a HEIC of no width": (heic(0, 24), 6),
    "a HEIC without pixels": (HEIC[: HEIC.index(b"mdat") + 4], 6),
    "a HEIC of zeros": (HEIC[: HEIC.index(b"mdat") + 4] + bytes(400), 6),
    "a HEIC that is a video": (b"\0\0\0\x14ftypheic" + bytes(8) + b"\0\0\0\x08moov", 6),
}
for kind, (data, item) in PHOTOS.items():
    expect = (
        "either"
        if kind in ("8 bits and a bomb", "16 bits and a bomb", "text of a gigabyte")
        else "refused"
    )
    for reader, name in (("image", "a.png"), ("mask", "a.jpg")):
        case(kind, reader, written(name, data), expect, item)


for kind in ("EPS", "13,000 x 13,000", "TIFF", "16 bits, cut"):
    for reader in ("capture", "photos", "boundary"):
        case(
            f"a photo that is {kind}",
            reader,
            capture_with(photo=PHOTOS[kind][0]),
            item=PHOTOS[kind][1],
        )


# Pillow decodes these
# -------------------------------------------------------------------------------------------------


def damaged(data, name):
    """The checksum of one chunk is another one."""
    at = data.index(name)
    end = at + 4 + struct.unpack(">I", data[at - 4 : at])[0]
    return data[:end] + bytes([data[end] ^ 1]) + data[end + 1 :]


ROWS = zlib.compress(bytes(4 * 5))
BY_PALETTE = png(4, 4, color=3, data=ROWS, extra=chunk(b"PLTE", bytes(range(48))))
DECODED = {
    "a palette that is not there": png(4, 4, color=3, data=ROWS),
    "a false checksum of the pixels": damaged(png(4, 4, data=zlib.compress(bytes(52))), b"IDAT"),
    "a false checksum of the palette": damaged(BY_PALETTE, b"PLTE"),
    "a false checksum of the end": damaged(png(4, 4, data=zlib.compress(bytes(52))), b"IEND"),
    "a false checksum of a text": damaged(
        png(4, 4, data=zlib.compress(bytes(52)), extra=chunk(b"tEXt", b"a\0b")), b"tEXt"
    ),
    "no end": png(4, 4, data=zlib.compress(bytes(52)))[:-12],
}
for kind, data in DECODED.items():
    for reader in ("image", "mask"):
        case(kind, reader, written("a.png", data), item=6)
    case(f"a photo with {kind}", "capture", capture_with(photo=data), item=6)
case("a palette", "mask", written("a.png", BY_PALETTE), "either", item=6)


# Scans
# --------------------------------------------------------------------------------------------------


def glb(change):
    """A GLB with a skeleton's motion and its JSON changed: a function, or values by path."""

    def make(folder):
        honest.write_glb_motion(folder / "m.glb")
        data = (folder / "m.glb").read_bytes()
        length = struct.unpack_from("<I", data, 12)[0]
        content = json.loads(data[20 : 20 + length])
        (change if callable(change) else setting(change))(content)
        header = json.dumps(content).encode()
        header += b" " * (-len(header) % 4)
        (folder / "m.glb").write_bytes(glb_of(header, data[20 + length :]))
        return folder / "m.glb"

    return make


def glb_of(header, rest=b""):
    chunks = struct.pack("<II", len(header), 0x4E4F534A) + header + rest
    return struct.pack("<III", 0x46546C67, 2, 12 + len(chunks)) + chunks


def no_view(count):
    def change(content):
        content["accessors"].append({"componentType": 5126, "count": count, "type": "VEC3"})

    return change


GLBS = {
    "an accessor without a view": (no_view(500_000_000), 5),
    "an accessor of 2^62": (no_view(1 << 62), 5),
    "an accessor below 0": ({"accessors.0.count": -3}, 6),
    "an accessor of half": ({"accessors.0.count": 1.5}, 6),
    "an accessor of words": ({"accessors.0.count": "many"}, 6),
    "a count too large": ({"accessors.0.count": 100_000}, 6),
    "another type": ({"accessors.0.componentType": 7}, 6),
    "a view beyond the end": ({"bufferViews.0.byteOffset": 1 << 40}, 6),
    "a view below 0": ({"bufferViews.0.byteOffset": -8}, 6),
    "a view of the last buffer": ({"bufferViews.0.buffer": -1}, 6),
    "another file": ({"buffers.0.uri": "../../etc/passwd"}, 2),
    "another machine": ({"buffers.0.uri": "http://127.0.0.1:9/x.bin"}, 4),
}
for kind, (change, item) in GLBS.items():
    case(kind, "glb motion", glb(change), item=item)
NESTED = b'{"a":' + b"[" * 90_000 + b"]" * 90_000 + b"}"
case("lists in lists", "glb motion", written("a.glb", lambda: glb_of(NESTED)), item=6)


def filtered_ply(number):
    """One Gaussian in text, with Mip-Splatting's filter of that size."""
    names = ["x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", "filter_3D"]
    names += [f"scale_{i}" for i in range(3)] + [f"rot_{i}" for i in range(4)]
    header = [
        "ply",
        "format ascii 1.0",
        "element vertex 1",
        *(f"property double {name}" for name in names),
        "end_header",
    ]
    row = ["1"] * len(names)
    row[7] = number
    return "\n".join([*header, " ".join(row), ""]).encode()


def gaussians_ply(*lines, size=0):
    header = "\n".join(["ply", "format binary_little_endian 1.0", *lines, "end_header\n"]).encode()
    return written("a.ply", header + bytes(size))


def spz(count, degree, size=0):
    header = struct.pack("<IIIBBBB", 0x5053474E, 3, count, degree, 12, 0, 0)
    return written("a.spz", lambda: gzip.compress(header + bytes(size)))


def spz_four(count, sizes, streams=5, place=32, behind=b""):
    """Version 4 with a table that promises these sizes, of frames of zeros that unpack to 64 MB."""
    frame = zstd.compress(bytes(64 << 20))
    table = b"".join(struct.pack("<QQ", len(frame), size) for size in sizes)
    header = struct.pack("<IIIBBBBI12x", 0x5053474E, 4, count, 0, 12, 0, streams, place)
    return written("a.spz", lambda: header + table + frame * len(sizes) + behind)


FEW = [10 * width for width in (9, 1, 3, 3, 4)]
MANY = [13_000_000 * width for width in (9, 1, 3, 3, 4)]
GAUSSIANS = {
    "zstd that unpacks to more than it says": ("spz 4", spz_four(10, FEW), 5),
    "zstd that unpacks to less than 260 MB": ("spz 4", spz_four(13_000_000, MANY), 5),
    "a table of 10^18 bytes": ("spz 4", spz_four(10, [10**18] * 5), 5),
    "4 billion in version 4": ("spz 4", spz_four(2**32 - 1, FEW), 5),
    "255 streams": ("spz 4", spz_four(10, FEW, streams=255), 6),
    "a table behind the end": ("spz 4", spz_four(10, FEW, place=2**32 - 1), 6),
    "a table in the header": ("spz 4", spz_four(10, FEW, place=0), 6),
    "a header cut off": ("spz 4", written("a.spz", b"NGSP\4\0\0\0\1"), 6),
    "1,500 properties that nobody knows": (
        "3dgs",
        gaussians_ply(
            "element vertex 1", *(f"property float \x1b[31m{i}" for i in range(1_500)), size=6_000
        ),
        6,
    ),
    "a filter of 10^30 m": ("3dgs", written("a.ply", lambda: filtered_ply("1e30")), 6),
    "all of it NaN": ("3dgs", written("a.ply", lambda: filtered_ply("nan")), 6),
    "10^12 in the header": (
        "3dgs",
        gaussians_ply("element vertex 1000000000000", "property float x"),
        5,
    ),
    "20 million without a file": (
        "3dgs",
        gaussians_ply("element vertex 20000000", "property float x", size=99),
        5,
    ),
    "10 million without properties": ("3dgs", gaussians_ply("element vertex 10000000"), 5),
    "one property twice": (
        "3dgs",
        gaussians_ply("element vertex 1", *["property float x"] * 2, size=8),
        6,
    ),
    "4 billion": ("spz", spz(2**32 - 1, 0), 5),
    "19 million of zeros, a bomb": ("spz", spz(19_000_000, 3, 64 << 20), 5),
    "ten times as long, a bomb": ("spz", spz(10, 0, 64 << 20), 5),
}
for kind, (reader, make, item) in GAUSSIANS.items():
    case(kind, reader, make, item=item)


def obj_with(place=None, texture="texture.png", material="scan.mtl"):
    """place: makes the texture."""

    def make(folder):
        if place is not None:
            place(folder / "texture.png")
        return honest.textured_obj(folder, texture, material)

    return make


def of_bytes(data):
    return lambda path: path.write_bytes(data)


case("a texture that has moved", "obj", obj_with(), "read", 6)
case("a material that has moved", "obj", obj_with(material="moved.mtl"), "read", 6)
case("a texture that is EPS", "obj", obj_with(of_bytes(EPS)), "read", 4)
case(
    "a texture of 13,000 x 13,000",
    "obj",
    obj_with(of_bytes(PHOTOS["13,000 x 13,000"][0])),
    "read",
    5,
)
case("a material outside", "obj", obj_with(material="../../../../etc/passwd"), "read", 2)
short, short_uvs = (
    lambda data, kind=kind: re.sub(rb"^(%s \S+) .*$" % kind, rb"\1", data, flags=re.MULTILINE)
    for kind in (b"v", b"vt")
)
case("vertices of one number", "obj", changed("obj", short), item=6)
case("vertices of one number", "thuman scan", changed("thuman scan", short), item=6)
case(
    "texture coordinates of one number",
    "thuman scan",
    changed("thuman scan", short_uvs),
    "either",
    6,
)
case("a texture outside", "obj", obj_with(texture="../../../../etc/passwd"), "read", 2)
MESHES = {
    "a corner of 2^30": ("scan.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\n" + "f 1 2 1073741824\n" * 60),
    "a corner of 10^30": ("scan.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\n" + f"f 1 2 {10**30}\n" * 60),
    "a corner of 0": ("scan.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\n" + "f 0 1 2\n" * 60),
    "places of words": ("scan.obj", "v a b c\n" * 9 + "f 1 2 3\n" * 60),
    "another encoding": ("scan.obj", b"\xff\xfe" * 5000 + b"\nf 1 2 3\n"),
    "one line of 4 MB": ("scan.obj", "v " + "1 " * (2 << 20)),
}
for kind, (name, data) in MESHES.items():
    expect = "either" if kind == "a corner of 0" else "refused"  # trimesh counts it from the end
    case(
        kind,
        name.split(".")[1],
        written(name, data),
        expect,
        5 if "10^" in kind or "2^" in kind else 6,
    )
for suffix in ("dae", "3mf", "gltf", "zip", "xyz", "dxf", "svg", "step", "urdf", "json", "pkl", ""):
    case(
        f"a file named .{suffix}",
        "obj",
        written(f"scan.{suffix}", "<?xml version='1.0'?><a/>"),
        item=4,
    )


# Parts and textures
# --------------------------------------------------------------------------------------------------


def many_changes(word, count):
    vertices = "".join(f"v {i} {i % 7} {i % 3}\n" for i in range(3 * count))
    return vertices + "".join(
        f"{word} a{i}\nf {3 * i + 1} {3 * i + 2} {3 * i + 3}\n" for i in range(count)
    )


for word in ("o", "g", "s"):
    many = written("scan.obj", lambda w=word: many_changes(w, 30_000))
    case(f"{word} for each of 30,000 faces", "obj", many, "read", 5)
for kind, line in {
    "in comments": "# usemtl a{0}\nf {1}\n",
    "in faces": "f {1} usemtl a{0}\n",
    "in a name": "usemtl " + "usemtl " * 1000 + "\nf {1}\n",
}.items():

    def disguised(line=line):
        vertices = "".join(f"v {i} {i % 7} {i % 3}\n" for i in range(90_000))
        return vertices + "".join(
            line.format(i, f"{3 * i + 1} {3 * i + 2} {3 * i + 3}")
            for i in range(30_000 // line.count("u"))
        )

    case(f"usemtl {kind}, 30,000", "obj", written("scan.obj", disguised), "either", 5)
case(
    "usemtl for each of 30,000 faces",
    "obj",
    written("scan.obj", lambda: many_changes("usemtl", 30_000)),
    item=5,
)
two = written(
    "scan.obj", lambda: re.sub(r"usemtl a\d*(\d)", r"usemtl \1", many_changes("usemtl", 30_000))
)
case("two materials, 30,000 changes", "obj", two, "read", 5)
for kind, place in (
    PLACES | {"empty": of_bytes(b""), "cut off": of_bytes(honest.photo_bytes()[:200])}
).items():
    case(f"a texture: {kind}", "obj", obj_with(place), "read", 6)
case("a texture without a name", "obj", obj_with(texture=""), "read", 6)


def nine_thousand_textures(folder):
    path = honest.write_obj(folder)
    (folder / "scan.mtl").write_text(
        "".join(f"newmtl m{i}\nmap_Kd texture.png\n" for i in range(9000))
    )
    return path


case("9,000 materials of one texture", "obj", nine_thousand_textures, "read", 5)
