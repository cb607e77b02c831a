"""`.spz` of Niantic (https://github.com/nianticlabs/spz#file-format): gzip of a header and six arrays, 20 bytes a Gaussian and 3
for each harmonic.

Positions in 24-bit fixed point, opacities k / 255, f_dc = (k / 255 - 1/2) / 0.15, scales exp(k / 16 - 10) metres, quaternions by
their three smallest components in 10 bits each (version 3, which is written) or by x, y, z in a byte each (version 2), harmonics
k / 128 - 1, the channels of each together. Libraries that write it bring a compiler (gsply) or do not install (PyPI's spz).
"""

import gzip
import io
import itertools
import os
import struct

import numpy as np

from humangs_jax.avatar.export.gaussians import colors_of, loaded, plain_arrays, sh_of, with_largest
from humangs_jax.core.array_types import Float, UInt, UInt8
from humangs_jax.io.atomic import write_bytes
from humangs_jax.io.reading import Refused, check_limit, check_unpacked
from humangs_jax.rendering.gaussians import Gaussians
from humangs_jax.rendering.harmonics import COUNTS

SPZ_MAGIC, SPZ_VERSION = 0x5053474E, 3
HEADER = struct.Struct("<IIIBBBB")
"""Magic, version, number of Gaussians, degree, fractional bits, flags, nothing."""
MORE_BEHIND = 2
"""The flag of files with parts that are not read here."""
MOST_FRACTIONAL_BITS = 20
"""Steps of a micrometre; less where the Gaussians reach farther than 8 m."""
COLOR_SCALE, SCALE_STEPS, SCALE_ZERO, HARMONIC_STEPS = 0.15, 16.0, 10.0, 128.0
QUATERNION_STEPS = 511


def write_spz(path: str | os.PathLike[str], gaussians: Gaussians) -> None:
    """Write a `.spz`; the file appears whole or not at all.

    Scales lose up to 3 %, colors, harmonics and opacities to 8 bits, components of quaternions to 10. Harmonics are from -1 to 1.

    Raises: ValueError for Gaussians farther than 8,000 km from the origin.
    """
    means, quats, scales, opacities, colors, harmonics = plain_arrays(gaussians)
    farthest = np.abs(means).max(initial=1e-6)
    bits = min(MOST_FRACTIONAL_BITS, int(np.floor(np.log2((2**23 - 1) / farthest))))
    if bits < 0:
        raise ValueError(f"{path}: .spz holds Gaussians up to 8,388,607 m from the origin, got {farthest:g}")
    fixed = np.rint(means * 2.0**bits).astype("<i4")
    with np.errstate(divide="ignore"):
        steps = SCALE_STEPS * (np.log(scales) + SCALE_ZERO)
    parts = (
        fixed[..., None].view("u1")[..., :3],  # the lower three of four bytes
        _byte(255 * opacities),
        _byte(255 * (COLOR_SCALE * sh_of(colors) + 0.5)),
        _byte(steps),
        _packed_quaternions(quats),
        _byte(HARMONIC_STEPS * harmonics + HARMONIC_STEPS),
    )
    header = HEADER.pack(SPZ_MAGIC, SPZ_VERSION, len(means), COUNTS.index(harmonics.shape[1]), bits, 0, 0)
    data = header + b"".join(np.ascontiguousarray(part).tobytes() for part in parts)
    write_bytes(path, gzip.compress(data, 9, mtime=0))


def _byte(values: Float[np.ndarray, "*b"]) -> UInt8[np.ndarray, "*b"]:
    return np.clip(np.rint(values), 0, 255).astype("u1")


def _packed_quaternions(quats: Float[np.ndarray, "g 4"]) -> UInt[np.ndarray, " g"]:
    """(g,) uint32: the index of the largest of x, y, z, w, then for each of the others a sign and a size out of 1 / sqrt(2)."""
    xyzw = quats[:, [1, 2, 3, 0]]
    largest = np.argmax(np.abs(xyzw), axis=1)
    xyzw = xyzw * np.where(np.take_along_axis(xyzw, largest[:, None], axis=1) < 0, -1, 1)
    sizes = np.clip(np.floor(QUATERNION_STEPS * np.sqrt(2) * np.abs(xyzw) + 0.5), 0, QUATERNION_STEPS).astype("<u4")
    packed = largest.astype("<u4")
    for i in range(4):
        component = packed << np.uint32(10) | np.where(xyzw[:, i] < 0, 512, 0).astype("<u4") | sizes[:, i]
        packed = np.where(largest == i, packed, component).astype("<u4")
    return packed


def read_spz(data: bytes) -> Gaussians:
    """Gaussians of the bytes of a file. Raises: Refused; what gzip raises for damaged files."""
    with gzip.GzipFile(fileobj=io.BytesIO(data)) as file:
        header = file.read(HEADER.size).ljust(HEADER.size, b"\0")
        magic, version, count, degree, bits, flags, _ = HEADER.unpack(header)
        if magic != SPZ_MAGIC or version not in (2, SPZ_VERSION) or degree >= len(COUNTS):
            raise Refused(f"expected .spz of version 2 or 3 and degree 0 to 3, got version {version} and degree {degree}")
        check_limit("gaussians", count, "Gaussians")
        widths = (9, 1, 3, 3, 3 if version == 2 else 4, 3 * COUNTS[degree])
        check_unpacked(len(data), size := count * sum(widths))
        content = file.read(size + 1)
    if len(content) < size or (len(content) > size and not flags & MORE_BEHIND):
        raise Refused(f"expected {count:,} Gaussians in {size:,} bytes, got {'more' if len(content) > size else 'less'}")
    starts = itertools.accumulate(widths, initial=0)
    parts = [
        np.frombuffer(content, "u1", count * width, count * start).reshape(count, width)
        for start, width in zip(starts, widths, strict=False)
    ]
    positions, opacities, colors, scales, quats, harmonics = parts
    padded = np.pad(positions.reshape(count, 3, 3), ((0, 0), (0, 0), (1, 0)))  # the lowest of four bytes
    arrays = {
        "positions": np.ascontiguousarray(padded).view("<i4")[..., 0] / 2.0 ** (8 + bits),
        "rotations": with_largest(quats / 127.5 - 1, np.zeros(count)) if version == 2 else _smallest_three(quats),
        "scales": np.exp(scales / SCALE_STEPS - SCALE_ZERO),
        "alphas": opacities[:, 0] / 255,
        "colors": colors_of((colors / 255 - 0.5) / COLOR_SCALE),
        "sh": harmonics.reshape(count, COUNTS[degree], 3) / np.float32(HARMONIC_STEPS) - 1,
    }
    return loaded(arrays if degree else {name: arrays[name] for name in list(arrays)[:5]})


def _smallest_three(packed: UInt8[np.ndarray, "g 4"]) -> Float[np.ndarray, "g 4"]:
    """Inverse of `_packed_quaternions`."""
    word = np.ascontiguousarray(packed).view("<u4")[:, 0]
    signed = [word >> np.uint32(shift) & np.uint32(1023) for shift in (20, 10, 0)]
    three = np.stack([np.where(part & 512, -1.0, 1.0) * (part & 511) for part in signed], axis=1)
    return with_largest(three / (QUATERNION_STEPS * np.sqrt(2)), word >> 30)[:, [3, 0, 1, 2]]
