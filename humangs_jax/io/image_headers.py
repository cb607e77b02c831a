"""Reads what a photo's file says before it is decoded: a JPEG's scans, a WebP's size, an ISO file's
kind, a PNG's chunks, and EXIF's frame.

Phones put more behind a JPEG (a video, a map of gains, depth) and inside of its segments
(thumbnails, EXIF, C2PA). Only the markers of the picture itself count.
"""

import re
import zlib
from typing import Any

import numpy as np

from humangs_jax.io.reading import InvalidFileError

HEIC_BRANDS = frozenset((b"heic", b"heix", b"heim", b"heis", b"mif1", b"msf1"))
"""Brands of HEIC in the box `ftyp` that a file begins with (ISO/IEC 23008-12)."""
AVIF_BRANDS = frozenset((b"avif", b"avis"))
"""Brands of AVIF in the box `ftyp`."""

JPEG_START = b"\xff\xd8"
JPEG_MARKER = re.compile(rb"\xff([^\x00\xff])")
"""Pattern of a marker. FF 00 is a byte FF of the compressed data and no marker. Any number of FF
bytes may stand before a marker.
"""
END = 0xD9
"""Marker of JPEG files that ends the image."""
SCAN = 0xDA
"""Marker of JPEG files that begins a scan."""
WITH_LENGTH = frozenset(
    (*range(0xC0, 0xC8), *range(0xC9, 0xD0), SCAN, 0xDB, 0xDC, 0xDD, *range(0xE0, 0xF0), 0xFE)
)
"""Markers that are followed by two bytes of length, as libjpeg reads them. After other markers no
length follows, or libjpeg stops reading.
"""


def jpeg_scans(data: bytes) -> int:
    """Returns the number of scans of the picture that a JPEG file begins with.

    Segments are skipped. Bytes after the picture are not counted.
    """
    at, count = len(JPEG_START), 0
    while True:
        found = JPEG_MARKER.search(data, at)
        if found is None:
            break
        code, at = found[1][0], found.end()
        if code == END:
            break
        count += code == SCAN
        if code in WITH_LENGTH:
            at += max(2, int.from_bytes(data[at : at + 2], "big"))
    return count


def is_webp(data: bytes) -> bool:
    """Says whether a file begins as a WebP."""
    return data[:4] == b"RIFF" and data[8:12] == b"WEBP"


def webp_size(data: bytes) -> tuple[int, int]:
    """Returns width and height of a WebP's canvas, pixels. Pillow takes memory for the canvas as
    soon as it opens the file. Raises: InvalidFileError.
    """
    kind, body = data[12:16], data[20:30]
    if len(body) == 10 and kind == b"VP8X":
        return 1 + int.from_bytes(body[4:7], "little"), 1 + int.from_bytes(body[7:10], "little")
    if len(body) == 10 and kind == b"VP8L":
        bits = int.from_bytes(body[1:5], "little")
        return 1 + (bits & 0x3FFF), 1 + (bits >> 14 & 0x3FFF)
    if len(body) == 10 and kind == b"VP8 ":
        return int.from_bytes(body[6:8], "little") & 0x3FFF, int.from_bytes(
            body[8:10], "little"
        ) & 0x3FFF
    raise InvalidFileError("not a readable image: a WebP without a picture")


def iso_kind(data: bytes) -> str | None:
    """Returns Pillow's name, HEIF or AVIF, of a file that begins as such a photo, else None.

    If the first brand is mif1 or msf1, the file is AVIF if a further brand is AVIF's, else HEIF.
    """
    if data[4:8] != b"ftyp":
        return None
    # files have up to ten further brands
    end = min(int.from_bytes(data[:4], "big"), 16 + 4 * 16)
    further = {data[at : at + 4] for at in range(16, end, 4)}
    if data[8:12] in AVIF_BRANDS or (data[8:12] in (b"mif1", b"msf1") and further & AVIF_BRANDS):
        return "AVIF"
    return "HEIF" if data[8:12] in HEIC_BRANDS else None


def png_chunks(data: bytes) -> dict[bytes, bytes]:
    """Returns the chunks of a PNG file before its pixels, by name."""
    at, found = 8, {}
    while at + 8 <= len(data):
        name = data[at + 4 : at + 8]
        if name == b"IDAT":
            break
        length = int.from_bytes(data[at : at + 4], "big")
        found[name] = data[at + 8 : at + 8 + length]
        at += 12 + length
    return found


def nclx_colors(data: bytes) -> tuple[int, int] | None:
    """Returns the code points (H.273) of an AVIF's primaries and curve, from the first box that has
    them. None if there is no such box.
    """
    box = b"colrnclx"
    at = data.find(box)
    numbers = data[at + len(box) : at + len(box) + 4]
    if at < 0 or len(numbers) < 4:
        return None
    return int.from_bytes(numbers[:2], "big"), int.from_bytes(numbers[2:], "big")


def check_png_chunks(data: bytes) -> None:
    """Checks that a PNG file is whole, by the checksums of its chunks. It must have pixels, an end,
    and a palette if its pixels need one. Pillow decodes some files without these.

    Raises: InvalidFileError.
    """
    at, names = 8, set()
    while at < len(data) and b"IEND" not in names:
        length, name = int.from_bytes(data[at : at + 4], "big"), data[at + 4 : at + 8]
        body, check = data[at + 8 : at + 8 + length], data[at + 8 + length : at + 12 + length]
        if len(check) < 4 or zlib.crc32(name + body) != int.from_bytes(check, "big"):
            raise InvalidFileError(f"not a readable image: chunk {name!r} is damaged or cut off")
        names.add(name)
        at += 12 + length
    missing = {b"IDAT", b"IEND"} - names
    if missing:
        raise InvalidFileError(
            f"not a readable image: cut off, without the chunk {min(missing).decode()}"
        )
    color_type = data[25]
    if color_type == 3 and b"PLTE" not in names:
        raise InvalidFileError(
            "not a readable image: its pixels are numbers of a palette, and it has none"
        )


def other_frame(tags: dict[int, Any], size: tuple[int, int]) -> tuple[int, int] | None:
    """Returns the width and height that EXIF's tags state, if they show that the photo was cut out
    of a frame of that size. Otherwise returns None. tags: EXIF's tags. size: (width, height) of the
    photo.
    """
    # EXIF's width and height of the photo as it was taken
    width, height = tags.get(0xA002), tags.get(0xA003)
    if not isinstance(width, int) or not isinstance(height, int):
        return None
    frame, turned = (width, height), (height, width)
    if not 0 < min(frame) <= max(frame) < 1 << 24 or _same_shape(size, frame):
        return None
    # 3 : 4 of a frame of 4 : 3 may be turned, or cut out of it at its full height
    cut_upright = size != turned and (size[0] == frame[0] or size[1] == frame[1])
    if _same_shape(size, turned) and not cut_upright:
        return None
    return frame


def _same_shape(size: tuple[int, int], frame: tuple[int, int]) -> bool:
    """Says whether two sizes have the same ratio of sides. Because of rounding, each side may be
    off by one pixel plus a hundredth of the side.
    """
    scale = np.hypot(*size) / np.hypot(*frame)
    off = np.abs(scale * np.asarray(frame) - size)
    return bool((off <= 1 + 0.01 * np.asarray(size)).all())
