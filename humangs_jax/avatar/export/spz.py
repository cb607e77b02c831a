"""`.spz` version 3 (https://github.com/nianticlabs/spz#file-format): gzip of a header and six arrays, 20 bytes a Gaussian.

Positions are 24-bit fixed-point numbers, scales exp(k / 16 - 10) metres, opacities k / 255, colors
f_dc = (k / 255 - 1/2) / 0.15, quaternions their three smallest components in 10 bits each. Axes are right, up and back: a person
that faces +z in a `.glb` faces -z here, as converters (Niantic's own, splat-transform) have it. Written here because the
libraries for Python that write it bring a compiler of 200 MB (gsply: numba) or do not install (PyPI's spz).
"""

import gzip
import os
import struct

import numpy as np

from humangs_jax.avatar.export.world import BACKWARDS, plain_arrays, rotated, sh_of
from humangs_jax.io.atomic import write_bytes
from humangs_jax.rendering.gaussians import Gaussians

MAGIC, VERSION = 0x5053474E, 3
MOST_FRACTIONAL_BITS = 20
"""Steps of a micrometre; less where the Gaussians reach farther than 8 m."""
COLOR_SCALE, SCALE_STEPS, SCALE_ZERO = 0.15, 16.0, 10.0
QUATERNION_STEPS = 511


def write_spz(path: str | os.PathLike, gaussians: Gaussians) -> None:
    """Write a `.spz`; the file appears whole or not at all.

    Scales lose up to 3 %, colors and opacities to 8 bits, components of quaternions to 10.

    Raises: ValueError for Gaussians farther than 8,000 km from the origin.
    """
    means, quats, scales, opacities, colors = plain_arrays(rotated(gaussians, BACKWARDS))
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
    )
    header = struct.pack("<IIIBBBB", MAGIC, VERSION, len(means), 0, bits, 0, 0)
    data = header + b"".join(np.ascontiguousarray(part).tobytes() for part in parts)
    write_bytes(path, gzip.compress(data, 9, mtime=0))


def _byte(values):
    return np.clip(np.rint(values), 0, 255).astype("u1")


def _packed_quaternions(quats):
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
