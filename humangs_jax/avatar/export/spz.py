"""`.spz` of Niantic (https://github.com/nianticlabs/spz#file-format): a header and six arrays. From
version 3 on a Gaussian has 20 bytes, and 3 more for each harmonic.

Positions are 24-bit fixed-point numbers. A byte k stands for the opacity k / 255, for f_dc = (k /
255 - 1/2) / 0.15, for a scale of exp(k / 16 - 10) metres, or for the harmonic k / 128 - 1. The
three channels of a harmonic are next to each other. Quaternions have their three smallest
components in 10 bits each; before version 3 they have x, y and z in a byte each. Version 1 has
positions as 16-bit floats.

Files up to version 3 are one gzip stream. Files of version 4 have, in this order, a header of 32
bytes that is not compressed, perhaps records of other programs, a table at the offset that the
header names, and a zstd frame for each array that is not empty. The table has the compressed and
the unpacked size of each array, bytes.

The format is written here because the libraries for it need a compiler (gsply) or cannot be
installed (spz of PyPI).
"""

import gzip
import io
import itertools
import os
import struct
import sys
from collections.abc import Sequence
from typing import Literal, NamedTuple

import numpy as np

from humangs_jax.avatar.export.gaussians import colors_of, loaded, plain_arrays, sh_of, with_largest
from humangs_jax.core.array_types import Float, UInt, UInt8
from humangs_jax.io.atomic import write_bytes
from humangs_jax.io.reading import InvalidFileError, check_limit, check_unpacked
from humangs_jax.rendering.gaussians import COUNTS, Gaussians

if sys.version_info >= (3, 14):
    from compression import zstd
else:
    from backports import zstd

Version = Literal[3, 4]
"""The versions that are written. More programs read 3."""
SPZ_MAGIC = 0x5053474E
"""The letters NGSP at the beginning of a file."""
WITH_TABLE = 4
"""The version from which on the arrays are compressed one by one."""
HEADER = struct.Struct("<IIIBBBB")
"""The header: magic, version, number of Gaussians, degree, fractional bits, flags, and number of
streams (0 before version 4).
"""
TABLE_PLACE = struct.Struct("<I12x")
"""What follows the header in version 4: the offset of the table, in bytes from the beginning of the
file.
"""
TABLE_ROW = struct.Struct("<QQ")
"""A row of the table: the compressed and the unpacked size of a stream, bytes."""
RECORD = struct.Struct("<II")
"""The beginning of a record of another program: its kind, and the number of bytes that follow."""
COORDINATE_SYSTEM = 0xADBE0003
"""The kind of a record that names the axes. Files have it unless their axes point to the right, up
and back.
"""
ANTIALIASED = 1
"""The flag of files whose Gaussians were trained with the filters of Mip-Splatting."""
MORE_BEHIND = 2
"""The flag of files that contain records of other programs."""
MOST_FRACTIONAL_BITS = 20
"""The largest number of fractional bits of positions; a step is then about a micrometre. Files with
Gaussians farther than 8 m from the origin have fewer.
"""
COLOR_SCALE = 0.15
"""Factor on the harmonic of degree 0 before it becomes a byte."""
SCALE_STEPS = 16.0
"""The byte of a scale grows by this number of steps when the scale grows by the factor e."""
SCALE_ZERO = 10.0
"""The number that is added to the logarithm of a scale in metres, so that the byte is not
negative.
"""
HARMONIC_STEPS = 128.0
"""The byte of a harmonic grows by this number of steps when the harmonic grows by 1. It is also the
byte that stands for 0.
"""
QUATERNION_STEPS = 511


class _Header(NamedTuple):
    """The fields of a file's header."""

    magic: int
    version: int
    count: int
    degree: int
    bits: int
    flags: int
    streams: int

    @property
    def widths(self) -> tuple[int, ...]:
        """The number of bytes of a Gaussian in each array: positions, opacities, colors, scales,
        quaternions, harmonics.
        """
        positions = 6 if self.version == 1 else 9
        quats = 3 if self.version < 3 else 4
        return positions, 1, 3, 3, quats, 3 * COUNTS[self.degree]


# Writing
# --------------------------------------------------------------------------------------------------


def write_spz(path: str | os.PathLike[str], gaussians: Gaussians, version: Version = 3) -> None:
    """Write a `.spz`. If writing fails, the path stays as it was.

    Scales change by up to 3 %, and are clipped to the range from 0.045 mm to 379 m. Colors,
    harmonics and opacities are rounded to 8 bits, components of quaternions to 10 bits. Harmonics
    are clipped to [-1, 1].

    Raises: ValueError if a coordinate of a Gaussian exceeds 8,388,607 m, and as `plain_arrays`;
    OSError.
    """
    means, quats, scales, opacities, colors, harmonics = plain_arrays(gaussians)
    # places have 24 bits: as many behind the point as the farthest Gaussian leaves
    farthest = np.abs(means).max(initial=1e-6)
    bits = min(MOST_FRACTIONAL_BITS, int(np.floor(np.log2((2**23 - 1) / farthest))))
    if bits < 0:
        raise ValueError(
            f"{path}: .spz holds Gaussians up to 8,388,607 m from the origin, got {farthest:g}"
        )
    fixed = np.rint(means * 2.0**bits).astype("<i4")
    with np.errstate(divide="ignore"):
        steps = SCALE_STEPS * (np.log(scales) + SCALE_ZERO)
    # one array for each property, as few bytes as the format has for it
    arrays = (
        fixed[..., None].view("u1")[..., :3],  # the lower three of four bytes
        _byte(255 * opacities),
        _byte(255 * (COLOR_SCALE * sh_of(colors) + 0.5)),
        _byte(steps),
        _packed_quaternions(quats),
        _byte(HARMONIC_STEPS * harmonics + HARMONIC_STEPS),
    )
    parts = [np.ascontiguousarray(array).tobytes() for array in arrays]
    numbers = (SPZ_MAGIC, version, len(means), COUNTS.index(harmonics.shape[1]), bits, 0)
    # older files are one stream of gzip
    if version < WITH_TABLE:
        content = HEADER.pack(*numbers, 0) + b"".join(parts)
        write_bytes(path, gzip.compress(content, 9, mtime=0))
        return
    parts = [part for part in parts if part]
    streams = [zstd.compress(part, 12) for part in parts]
    table = [
        TABLE_ROW.pack(len(stream), len(part)) for stream, part in zip(streams, parts, strict=True)
    ]
    begin = HEADER.pack(*numbers, len(streams)) + TABLE_PLACE.pack(HEADER.size + TABLE_PLACE.size)
    write_bytes(path, begin + b"".join(table) + b"".join(streams))


def _byte(values: Float[np.ndarray, "*b"]) -> UInt8[np.ndarray, "*b"]:
    return np.clip(np.rint(values), 0, 255).astype("u1")


def _packed_quaternions(quats: Float[np.ndarray, "g 4"]) -> UInt[np.ndarray, " g"]:
    """Returns each quaternion packed into a uint32. It has the index of the largest of x, y, z, w,
    then the sign and the size of each of the others, in this order. Sizes are shares of 1 /
    sqrt(2), in steps of 1 / 511.
    """
    xyzw = quats[:, [1, 2, 3, 0]]
    largest = np.argmax(np.abs(xyzw), axis=1)
    xyzw = xyzw * np.where(np.take_along_axis(xyzw, largest[:, None], axis=1) < 0, -1, 1)
    sizes = np.clip(
        np.floor(QUATERNION_STEPS * np.sqrt(2) * np.abs(xyzw) + 0.5), 0, QUATERNION_STEPS
    ).astype("<u4")
    packed = largest.astype("<u4")
    for i in range(4):
        component = (
            packed << np.uint32(10) | np.where(xyzw[:, i] < 0, 512, 0).astype("<u4") | sizes[:, i]
        )
        packed = np.where(largest == i, packed, component).astype("<u4")
    return packed


# Reading
# --------------------------------------------------------------------------------------------------


def read_spz(data: bytes, notes: list[str]) -> Gaussians:
    """Returns the Gaussians in the bytes of a `.spz`. Lines about what is left out are appended to
    `notes`.

    Raises: InvalidFileError; for damaged files also the errors of gzip and zstd.
    """
    version = int.from_bytes(data[4:8], "little")
    if data.startswith(b"NGSP") and version >= WITH_TABLE:
        header, parts = _with_table(data, notes)
    else:
        header, parts = _of_stream(data)
    # what is in the file and not used
    if header.flags & ANTIALIASED:
        notes.append(
            "trained antialiased, as Mip-Splatting does; drawn without that it looks thicker from"
            " afar"
        )
    if header.flags & MORE_BEHIND and header.version < WITH_TABLE:
        notes.append("records of other programs at its end are not used")
    count = header.count
    # each part holds one property of all Gaussians
    positions, opacities, colors, scales, quats, harmonics = (
        np.frombuffer(part, "u1").reshape(count, width)
        for part, width in zip(parts, header.widths, strict=True)
    )
    # bytes to numbers; places and rotations differ by the version
    if header.version == 1:
        means = positions.view("<f2")
    else:
        means = _fixed_point(positions, header.bits)
    if header.version < 3:
        rotations = with_largest(quats / 127.5 - 1, np.zeros(count))
    else:
        rotations = _smallest_three(quats)
    arrays = {
        "positions": means,
        "rotations": rotations,
        "scales": np.exp(scales / SCALE_STEPS - SCALE_ZERO),
        "alphas": opacities[:, 0] / 255,
        "colors": colors_of((colors / 255 - 0.5) / COLOR_SCALE),
    }
    if header.degree:
        arrays["sh"] = (
            harmonics.reshape(count, COUNTS[header.degree], 3) / np.float32(HARMONIC_STEPS) - 1
        )
    return loaded(arrays, notes)


def _checked_header(start: bytes, versions: Sequence[int], size: int) -> _Header:
    """Returns the header of a file of `size` bytes. First it checks the version, the degree, the
    number of Gaussians, and whether a file of `size` bytes may unpack to this number of Gaussians.

    start: the first bytes of the file, unpacked. versions: the versions that are read.

    Raises: InvalidFileError.
    """
    header = _Header(*HEADER.unpack(start[: HEADER.size].ljust(HEADER.size, b"\0")))
    if header.magic != SPZ_MAGIC or header.version not in versions:
        raise InvalidFileError(
            f"no .spz of version 1 to 4: version {header.version} in what begins as version"
            f" {versions[-1]} does"
        )
    if header.degree >= len(COUNTS):
        raise InvalidFileError(
            f"harmonics of degree {header.degree}: expected .spz of degree 0 to 3"
        )
    check_limit("gaussians", header.count, "Gaussians")
    check_unpacked(size, header.count * sum(header.widths))
    return header


def _of_stream(data: bytes) -> tuple[_Header, list[bytes]]:
    """Returns the header and the six arrays of a file of version 1 to 3. The file is a gzip, or the
    unpacked content of a gzip. A download unpacks the gzip if the server declares it as an
    encoding.
    """
    packed = io.BytesIO(data)
    with packed if data.startswith(b"NGSP") else gzip.GzipFile(fileobj=packed) as file:
        header = _checked_header(file.read(HEADER.size), (1, 2, 3), len(data))
        sizes = [header.count * width for width in header.widths]
        content = file.read(sum(sizes) + 1)
    _check_size(len(content), header, more=bool(header.flags & MORE_BEHIND))
    ends = list(itertools.accumulate(sizes))
    return header, [content[end - size : end] for size, end in zip(sizes, ends, strict=True)]


def _check_size(size: int, header: _Header, more: bool = False) -> None:
    expected = header.count * sum(header.widths)
    if size < expected or (size > expected and not more):
        raise InvalidFileError(
            f"expected {header.count:,} Gaussians in {expected:,} bytes, got"
            f" {'more' if size > expected else 'less'}"
        )


def _with_table(data: bytes, notes: list[str]) -> tuple[_Header, list[bytes]]:
    """Returns the header and the six arrays of a file of version 4.

    Before anything is unpacked, the table is checked against the file and the number of Gaussians,
    so that nothing unpacks to more bytes than expected. Lines about records that are not used are
    appended to `notes`.
    """
    header = _checked_header(data, (WITH_TABLE,), len(data))
    begin = HEADER.size + TABLE_PLACE.size
    if len(data) < begin:
        raise InvalidFileError(f"cut short: expected a header of {begin} bytes, got {len(data)}")
    (place,) = TABLE_PLACE.unpack_from(data, HEADER.size)
    end = place + header.streams * TABLE_ROW.size
    if not begin <= place <= end <= len(data):
        raise InvalidFileError(
            f"table of {header.streams} streams at {place:,}: expected it within {len(data):,}"
            " bytes"
        )
    notes += _records(data[begin:place])
    rows = list(TABLE_ROW.iter_unpack(data[place:end]))
    sizes = [header.count * width for width in header.widths]
    filled = [size for size in sizes if size]
    # empty streams may be left out
    rows = rows if len(rows) == len(filled) else [row for row in rows if row[1]]
    if [unpacked for _, unpacked in rows] != filled:
        found = ", ".join(f"{unpacked:,}" for _, unpacked in rows[: len(sizes)]) or "none"
        wanted = ", ".join(f"{size:,}" for size in filled)
        raise InvalidFileError(
            f"table: {header.count:,} Gaussians: expected streams of {wanted} bytes, got {found}"
        )
    streams = []
    at = end
    for packed, unpacked in TABLE_ROW.iter_unpack(data[place:end]):
        if packed > len(data) - at:
            raise InvalidFileError(
                f"cut short: a stream of {packed:,} bytes from {at:,}, but there are {len(data):,}"
            )
        if unpacked:
            streams.append(_unpacked(data[at : at + packed], unpacked))
        at += packed
    waiting = iter(streams)
    return header, [next(waiting) if size else b"" for size in sizes]


def _records(data: bytes) -> list[str]:
    """Returns a list with one line about the records of other programs. The list is empty if there
    are none.
    """
    names, at = [], 0
    while at + RECORD.size <= len(data):
        kind, size = RECORD.unpack_from(data, at)
        if kind == COORDINATE_SYSTEM:
            names.append("the coordinate system: turn the Gaussians yourself")
        else:
            names.append(f"{kind:#010x}")
        at += RECORD.size + size
    if names:
        return [f"records of other programs that are not used: {', '.join(names[:4])}"]
    return []


def _unpacked(stream: bytes, size: int) -> bytes:
    """Returns the `size` bytes that a zstd frame unpacks to.

    Raises: InvalidFileError for another number of bytes; ZstdError.
    """
    content = zstd.ZstdDecompressor().decompress(stream, size + 1)
    if len(content) != size:
        raise InvalidFileError(
            f"a stream unpacks to {'more' if len(content) > size else 'less'} than the {size:,}"
            " bytes of the table"
        )
    return content


def _fixed_point(positions: UInt8[np.ndarray, "g 9"], bits: int) -> Float[np.ndarray, "g 3"]:
    """Returns positions, metres, from 3 bytes for each coordinate. bits: the number of fractional
    bits.
    """
    padded = np.pad(positions.reshape(len(positions), 3, 3), ((0, 0), (0, 0), (1, 0)))
    return np.ascontiguousarray(padded).view("<i4")[..., 0] / 2.0 ** (8 + bits)


def _smallest_three(packed: UInt8[np.ndarray, "g 4"]) -> Float[np.ndarray, "g 4"]:
    """Returns the unit quaternions (wxyz) that `_packed_quaternions` packed into 4 bytes each."""
    word = np.ascontiguousarray(packed).view("<u4")[:, 0]
    signed = [word >> np.uint32(shift) & np.uint32(1023) for shift in (20, 10, 0)]
    three = np.stack([np.where(part & 512, -1.0, 1.0) * (part & 511) for part in signed], axis=1)
    return with_largest(three / (QUATERNION_STEPS * np.sqrt(2)), word >> 30)[:, [3, 0, 1, 2]]
