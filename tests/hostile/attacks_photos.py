"""Photos: too many pixels, damaged ones, and other formats under their names."""

import io
import struct
import zlib
from pathlib import Path

import honest_files as honest
from attacks_archives import deflated_zeros
from honest_files import pixels
from hostile_cases import case, written
from PIL import Image

# Photos ---------------------------------------------------------------------------------------------------------------


def chunk(name, data):
    return struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))


def png(width, height, depth=8, color=2, data=b"", method=b"\0\0\0", extra=b""):
    header = struct.pack(">IIBB", width, height, depth, color) + method
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + extra + chunk(b"IDAT", data) + chunk(b"IEND", b"")


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
    "30,000 x 30,000 of 16 bits": (png(30_000, 30_000, 16, data=zlib_zeros(1 << 20)), 6),
    "2^31 x 2^31": (png((1 << 31) - 1, (1 << 31) - 1), 5),
    "of no width": (png(0, 10), 6),
    "one pixel high, 60,000,000 wide": (png(60_000_000, 1, data=zlib_zeros(1 << 20)), 5),
    "8,000 x 8,000 without pixels": (png(8000, 8000), 5),
    "16 bits without pixels": (png(100, 100, 16), 6),
    "16 bits, cut": (png(100, 100, 16, data=zlib.compress(ROW16)), 6),
    "16 bits, no such filter": (png(4, 1, 16, data=zlib.compress(b"\x09" + ROW16[1:])), 6),
    "16 bits, no such method": (png(4, 1, 16, data=zlib.compress(ROW16), method=b"\7\0\0"), 6),
    "16 bits, no such interlace": (png(4, 1, 16, data=zlib.compress(ROW16), method=b"\0\0\7"), 6),
    "16 bits, damaged deflate": (png(4, 1, 16, data=b"\xff" * 30), 6),
    "16 bits and a bomb": (png(4, 1, 16, data=zlib_zeros(1 << 32)), 5),
    "8 bits and a bomb": (png(4, 1, data=zlib_zeros(1 << 32)), 5),
    "a false checksum": (png(4, 4, data=zlib.compress(bytes(52))).replace(b"IDAT", b"IDBT"), 6),
    "text of a gigabyte": (png(4, 4, extra=chunk(b"zTXt", b"x\0\0" + zlib_zeros(1 << 30))), 5),
    "EPS": (EPS, 4),
    "EPS behind a comment": (b"\xc5\xd0\xd3\xc6" + struct.pack("<IIIIIIH", 32, len(EPS), 0, 0, 0, 0, 0xFFFF) + b"\0\0" + EPS, 4),
    "GIF": (as_format("GIF")(), 4),
    "TIFF": (as_format("TIFF")(), 4),
    "BMP": (as_format("BMP")(), 4),
    "ICO": (as_format("ICO")(), 4),
    "PDF": (as_format("PDF")(), 4),
    "WEBP": (as_format("WEBP")(), 4),
    "PPM": (as_format("PPM")(), 4),
    "SVG": (b"<svg xmlns='http://www.w3.org/2000/svg'/>", 4),
    "a JPEG of 1,000 scans": (progressive(1000), 5),
    "a JPEG of 65,000 x 65,000": (as_format("JPEG")().replace(struct.pack(">HH", 8, 8), struct.pack(">HH", 65000, 65000)), 5),
    "a JPEG without pixels": (as_format("JPEG")()[:300], 6),
    "a HEIC of 60,000 x 60,000": (heic(60_000, 60_000), 5),
    "a HEIC of 7,000 x 7,000": (heic(7000, 7000), 5),
    "a HEIC of no width": (heic(0, 24), 6),
    "a HEIC without pixels": (HEIC[: HEIC.index(b"mdat") + 4], 6),
    "a HEIC, cut": (HEIC[:-40], 6),
    "a HEIC of zeros": (HEIC[: HEIC.index(b"mdat") + 4] + bytes(400), 6),
    "a HEIC of which only the first box is there": (HEIC[:28], 6),
    "a HEIC that is a video": (b"\0\0\0\x14ftypheic" + bytes(8) + b"\0\0\0\x08moov", 6),
}  # fmt: skip
for kind, (data, item) in PHOTOS.items():
    expect = "either" if kind in ("8 bits and a bomb", "16 bits and a bomb", "text of a gigabyte") else "refused"
    for reader, name in (("image", "a.png"), ("mask", "a.jpg")):
        case(kind, reader, written(name, data), expect, item)


def capture_with_photo(data):
    def make(folder):
        honest.write_capture(folder)
        (folder / "images" / "000.png").write_bytes(data)
        return folder

    return make


for kind in ("EPS", "13,000 x 13,000", "WEBP", "16 bits, cut"):
    for reader in ("capture", "photos", "boundary"):
        case(f"a photo that is {kind}", reader, capture_with_photo(PHOTOS[kind][0]), item=PHOTOS[kind][1])


# Pillow decodes these -------------------------------------------------------------------------------------------------


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
    "a false checksum of a text": damaged(png(4, 4, data=zlib.compress(bytes(52)), extra=chunk(b"tEXt", b"a\0b")), b"tEXt"),
    "no end": png(4, 4, data=zlib.compress(bytes(52)))[:-12],
}
for kind, data in DECODED.items():
    for reader in ("image", "mask"):
        case(kind, reader, written("a.png", data), item=6)
    case(f"a photo with {kind}", "capture", capture_with_photo(data), item=6)
case("a palette", "mask", written("a.png", BY_PALETTE), "either", item=6)
