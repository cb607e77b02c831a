"""What the bytes of a photo say before it is decoded: the scans of a JPEG, the size of a WebP, the kind of an ISO file.

Phones put more behind a JPEG (a video, a map of gains, depth) and inside of its segments (thumbnails, EXIF, C2PA). Only the
marks of the picture itself count.
"""

import re

from humangs_jax.io.reading import Refused

HEIC_BRANDS = frozenset((b"heic", b"heix", b"heim", b"heis", b"mif1", b"msf1"))
"""Of the box `ftyp` that such a file begins with (ISO/IEC 23008-12)."""
AVIF_BRANDS = frozenset((b"avif", b"avis"))
MARKED_BRANDS = 16
"""Brands of a box `ftyp` that are looked at; files have up to ten."""

JPEG_START = b"\xff\xd8"
JPEG_MARKER = re.compile(rb"\xff([^\x00\xff])")
"""FF 00 is a byte FF of the compressed data, and before the last FF there may be any number of others."""
END, SCAN = 0xD9, 0xDA
WITH_LENGTH = frozenset((*range(0xC0, 0xC8), *range(0xC9, 0xD0), SCAN, 0xDB, 0xDC, 0xDD, *range(0xE0, 0xF0), 0xFE))
"""Markers that two bytes of length follow, as libjpeg reads them; all others stand alone, or libjpeg ends there."""


def jpeg_scans(data: bytes) -> int:
    """The number of scans of the picture that a JPEG file begins with.

    Segments are stepped over, and what is behind the picture is not looked at.
    """
    at, count = len(JPEG_START), 0
    while (found := JPEG_MARKER.search(data, at)) is not None:
        code, at = found[1][0], found.end()
        if code == END:
            break
        count += code == SCAN
        if code in WITH_LENGTH:
            at += max(2, int.from_bytes(data[at : at + 2], "big"))
    return count


def is_webp(data: bytes) -> bool:
    """Whether a file begins as a WebP."""
    return data[:4] == b"RIFF" and data[8:12] == b"WEBP"


def webp_size(data: bytes) -> tuple[int, int]:
    """Width and height of the canvas of a WebP, for which Pillow takes memory as soon as it opens one. Raises: Refused."""
    kind, body = data[12:16], data[20:30]
    if len(body) == 10 and kind == b"VP8X":
        return 1 + int.from_bytes(body[4:7], "little"), 1 + int.from_bytes(body[7:10], "little")
    if len(body) == 10 and kind == b"VP8L":
        bits = int.from_bytes(body[1:5], "little")
        return 1 + (bits & 0x3FFF), 1 + (bits >> 14 & 0x3FFF)
    if len(body) == 10 and kind == b"VP8 ":
        return int.from_bytes(body[6:8], "little") & 0x3FFF, int.from_bytes(body[8:10], "little") & 0x3FFF
    raise Refused("not a readable image: a WebP without a picture")


def iso_kind(data: bytes) -> str | None:
    """Pillow's name, HEIF or AVIF, for a file that begins as such a photo, else None.

    A first brand mif1 may be either: the further brands tell.
    """
    if data[4:8] != b"ftyp":
        return None
    end = min(int.from_bytes(data[:4], "big"), 16 + 4 * MARKED_BRANDS)
    further = {data[at : at + 4] for at in range(16, end, 4)}
    if data[8:12] in AVIF_BRANDS or (data[8:12] in (b"mif1", b"msf1") and further & AVIF_BRANDS):
        return "AVIF"
    return "HEIF" if data[8:12] in HEIC_BRANDS else None


def png_chunks(data: bytes) -> dict[bytes, bytes]:
    """The chunks of a PNG file before its pixels, by name."""
    at, found = 8, {}
    while at + 8 <= len(data) and (name := data[at + 4 : at + 8]) != b"IDAT":
        length = int.from_bytes(data[at : at + 4], "big")
        found[name] = data[at + 8 : at + 8 + length]
        at += 12 + length
    return found


NCLX = b"colrnclx"
"""A box of HEIC and AVIF files before their code points of colors."""


def nclx_colors(data: bytes) -> tuple[int, int] | None:
    """Code points (H.273) of the primaries and the curve of an AVIF, of the first box that has some."""
    at = data.find(NCLX)
    numbers = data[at + len(NCLX) : at + len(NCLX) + 4]
    if at < 0 or len(numbers) < 4:
        return None
    return int.from_bytes(numbers[:2], "big"), int.from_bytes(numbers[2:], "big")
