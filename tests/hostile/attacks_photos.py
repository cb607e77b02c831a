"""What photos say about themselves, and it is nonsense: color profiles, EXIF, sizes, and what
stands behind the picture.
"""

import io
import struct
import sys
import zlib
from pathlib import Path

import numpy as np
from attacks_binary import as_format, chunk, png, zlib_zeros
from honest_files import pixels, written
from hostile_cases import FIRST_SEED, capture_with, case
from PIL import Image

sys.path.append(str(Path(__file__).parents[1] / "io"))

import profiles


def photo(kind="JPEG", **options):
    stream = io.BytesIO()
    Image.fromarray(pixels(48, 32, 3)).save(stream, kind, **options)
    return stream.getvalue()


# Color profiles
# --------------------------------------------------------------------------------------------------

HONEST = profiles.of_colors(profiles.P3_TO_XYZ, profiles.SRGB_CURVE)
TABLES = profiles.of_tables(
    b"RGB ", 3, lambda r, g, b: (30 * r + 50 * g + 20 * b, 60 * r - 60 * g, 40 * r - 80 * b)
)
RNG = np.random.default_rng(0)


def at(data, place, new):
    return data[:place] + new + data[place + len(new) :]


def noise(data, seed):
    """Some bytes behind the head are others."""
    changed, rng = bytearray(data), np.random.default_rng(FIRST_SEED + seed)
    for place in rng.integers(128, len(data), 12):
        changed[place] = rng.integers(256)
    return bytes(changed)


def with_table(tag):
    return profiles.profile({b"A2B0": tag}, kind=b"prtr", pcs=b"Lab ")


PROFILES = {
    "one byte": b"\0",
    "zeros": bytes(400),
    "a size of 4 GB": at(HONEST, 0, b"\xff" * 4),
    "4 billion parts": at(HONEST, 128, b"\xff" * 4),
    "parts behind the end": at(HONEST, 136, b"\xff" * 8),
    "parts that are each other": HONEST[:132] + HONEST[132:144] * 100,
    "a link": at(HONEST, 12, b"link"),
    "names of colors": at(HONEST, 12, b"nmcl"),
    "an unknown space": at(HONEST, 16, b"ZZZZ"),
    "CMYK": profiles.of_tables(b"CMYK", 4, lambda c, m, y, k: (100 - 90 * k, 50 * c, 50 * m)),
    "greys": profiles.of_grey(profiles.gamma(2.2)),
    "a table of 4 billion": profiles.of_colors(
        profiles.P3_TO_XYZ, b"curv" + bytes(4) + b"\xff" * 40
    ),
    "an exponent of 255": profiles.of_colors(profiles.P3_TO_XYZ, profiles.gamma(255)),
    "a negative exponent": profiles.of_colors(profiles.P3_TO_XYZ, profiles.formula(0, -30000)),
    "a formula over nothing": profiles.of_colors(
        profiles.P3_TO_XYZ, profiles.formula(1, 2.2, 0, 1)
    ),
    "huge numbers": profiles.of_colors(
        profiles.P3_TO_XYZ, profiles.formula(4, 30000, 30000, 30000, 3, -3, 9, 9)
    ),
    "primaries of nothing": profiles.of_colors(0 * profiles.P3_TO_XYZ, profiles.SRGB_CURVE),
    "huge primaries": profiles.of_colors(30000 * profiles.P3_TO_XYZ, profiles.SRGB_CURVE),
    "a cube of 255 sides": with_table(b"mft1" + bytes(4) + bytes([3, 3, 255, 0]) + bytes(600)),
    "16 channels": with_table(b"mft2" + bytes(4) + bytes([16, 16, 255, 0]) + b"\xff" * 600),
    "elements within themselves": with_table(
        b"mAB " + bytes(4) + b"\3\3\0\0" + struct.pack(">5I", 32, 32, 32, 32, 32) + b"mAB " * 50
    ),
    "5 MB": HONEST + bytes(5 << 20),
    "noise of 60,000 bytes": RNG.bytes(60_000),
    **{f"a matrix with noise {i}": noise(HONEST, i) for i in range(40)},
    **{f"tables with noise {i}": noise(TABLES, i) for i in range(40)},
    **{f"tables cut at {i}": TABLES[: 150 * i] for i in range(1, 8)},
}
for kind, data in PROFILES.items():
    case(f"a profile: {kind}", "image", written("a.jpg", photo(icc_profile=data)), "read", 6)
    case(f"a profile: {kind}", "mask", written("a.jpg", photo(icc_profile=data)), "either", 6)
    deep = png(
        1, 1, 16, data=zlib.compress(bytes(7)), extra=chunk(b"iCCP", b"a\0\0" + zlib.compress(data))
    )
    case(f"a profile of 16 bits: {kind}", "image", written("a.png", deep), "either", 6)
for kind in ("a size of 4 GB", "CMYK", "16 channels"):
    in_capture = capture_with(photo=photo("PNG", icc_profile=PROFILES[kind]))
    case(f"a profile of a capture: {kind}", "capture", in_capture, "either", 6)

ROW = zlib.compress(bytes(4 * 13))
CHUNKS = {
    "a profile that is a bomb": chunk(b"iCCP", b"a\0\0" + zlib_zeros(1 << 30)),
    "a profile that is no deflate": chunk(b"iCCP", b"a\0\0" + b"\xff" * 30),
    "a profile without a name": chunk(b"iCCP", b"a" * 200),
    "no code points": chunk(b"cICP", b""),
    "all code points": chunk(b"cICP", b"\xff" * 400),
    "a gamma of 0": chunk(b"gAMA", bytes(4)),
    "a gamma of 42,949": chunk(b"gAMA", b"\xff" * 4),
    "a gamma that is cut": chunk(b"gAMA", b"\1"),
    "primaries of 0": chunk(b"cHRM", bytes(32)),
    "primaries of 42,949": chunk(b"cHRM", b"\xff" * 32),
    "primaries that are cut": chunk(b"cHRM", b"\1" * 5),
}
for kind, extra in CHUNKS.items():
    case(
        f"a PNG with {kind}",
        "image",
        written("a.png", png(4, 4, data=ROW, extra=extra)),
        "either",
        6,
    )


# Behind the picture, and in its segments
# --------------------------------------------------------------------------------

JPEG = photo(quality=80)
SCANS = b"\xff\xda\0\x08" * 1000


def segment(code, content):
    return bytes([0xFF, code]) + struct.pack(">H", len(content) + 2) + content


BEHIND = {
    "a video": JPEG + b"\0\0\0\x18ftypmp42" + SCANS + RNG.bytes(100_000),
    "a thousand pictures": JPEG * 1000,
    "marks of scans": (
        JPEG[:2] + segment(0xE1, b"Exif\0\0" + SCANS) + segment(0xFE, SCANS) + JPEG[2:]
    ),
    "a million bytes FF": JPEG[:2] + b"\xff" * 1_000_000 + JPEG[2:],
}
for kind, data in BEHIND.items():
    case(f"a JPEG with {kind}", "image", written("a.jpg", data), "read", 6)
case(
    "a JPEG whose million bytes FF end in 0",
    "image",
    written("a.jpg", JPEG[:-2] + b"\xff" * 1_000_000 + bytes(9)),
    "either",
    5,
)
MANY = as_format("JPEG", progressive=True)()
LAST = MANY[MANY.rindex(b"\xff\xda") : -2]
HIDDEN = {
    "a mark of no length": b"\xff\x02\xff\xff",
    "an empty segment": b"\xff\xe0\0\2",
    "marks of restarts": b"\xff\xd0\xff\xd7",
    "a start": b"\xff\xd8",
    "bytes FF": b"\xff" * 50,
}
for kind, between in HIDDEN.items():
    data = MANY[:-2] + (between + LAST) * 1000 + MANY[-2:]
    case(f"1,000 scans behind {kind}", "image", written("a.jpg", data), item=5)


# EXIF
# --------------------------------------------------------------------------------------------------


def exif(**tags):
    """The bytes of an EXIF that has these tags, by their name."""
    codes = {"equivalent": 0xA405, "width": 0xA002, "height": 0xA003, "orientation": 0x0112}
    found = Image.Exif()
    for name, value in tags.items():
        (found if name == "orientation" else found.get_ifd(0x8769))[codes[name]] = value
    return found.tobytes()


EXIF = {
    "a frame of 0": exif(equivalent=26, width=0, height=0),
    "a frame of 4 billion": exif(equivalent=26, width=0xFFFFFFFF, height=1),
    "a frame of words": exif(equivalent=26, width="wide", height="high"),
    "a frame of several numbers": exif(equivalent=26, width=(1, 2, 3), height=(4, 5)),
    "half a frame": exif(equivalent=26, width=40),
    "an equivalent of words": exif(equivalent="26", width=48, height=32),
    "an orientation of 60,000": exif(orientation=60_000),
    "folders within themselves": (
        b"Exif\0\0MM\0*\0\0\0\x08\0\1\x87\x69\0\4\0\0\0\1\0\0\0\x08\0\0\0\x08"
    ),
    "a folder behind the end": b"Exif\0\0MM\0*\xff\xff\xff\xf0",
    "60,000 tags": (
        b"Exif\0\0MM\0*\0\0\0\x08\xff\xff" + b"\xa0\2\0\4\xff\xff\xff\xff\0\0\0\x08" * 5000
    ),
}
for kind, data in EXIF.items():
    for form in ("JPEG", "WEBP"):
        case(f"EXIF of {kind}, {form}", "image", written("a", photo(form, exif=data)), "read", 6)


# WebP and AVIF
# --------------------------------------------------------------------------------------------------

WEBP, LOSSLESS, AVIF = photo("WEBP"), photo("WEBP", lossless=True), photo("AVIF")
EXTENDED = photo("WEBP", exif=exif(orientation=6))
AVIF_SIZE = AVIF.index(b"ispe") + 8
WEB = {
    "a WebP of 16,384 x 16,384": (at(LOSSLESS, 21, b"\xff\xff\xff\x0f"), 5),
    "a WebP of 16 million x 16 million": (at(EXTENDED, 24, b"\xff" * 6), 5),
    "a WebP of 16,000 x 16,000 in its other way": (
        at(WEBP, 26, struct.pack("<HH", 16_000, 16_000)),
        5,
    ),
    "a WebP without a picture": (b"RIFF\x04\0\0\0WEBP", 6),
    "a WebP of an unknown part": (at(WEBP, 12, b"ABCD"), 6),
    "a WebP that is cut": (WEBP[: len(WEBP) // 2], 6),
    "an AVIF of 60,000 x 60,000": (at(AVIF, AVIF_SIZE, struct.pack(">II", 60_000, 60_000)), 5),
    "an AVIF of no width": (at(AVIF, AVIF_SIZE, bytes(4)), 6),
    "an AVIF that is cut": (AVIF[: len(AVIF) // 2], 6),
    "an AVIF that is a video": (b"\0\0\0\x14ftypavis" + bytes(8) + b"\0\0\0\x08moov", 6),
}
for kind, (data, item) in WEB.items():
    for reader in ("image", "mask"):
        case(kind, reader, written("a.jpg", data), item=item)
for seed in range(40):
    for form, data in (("WebP", EXTENDED), ("AVIF", AVIF)):
        changed, rng = bytearray(data), np.random.default_rng(FIRST_SEED + seed)
        for place in rng.integers(12, len(data), 6):
            changed[place] = rng.integers(256)
        case(f"noise {seed} of {form}", "image", written("a", bytes(changed)), "either", 6)
