"""Gaussians in the files of other programs, and the one conversion of worlds that all of them share.

Ours are metres with y up, the person faces +z, quaternions wxyz, linear scales, opacities and colors in [0, 1]. glTF's world is
the same. Viewers of `.ply` and `.splat` take y for down: SuperSplat and PlayCanvas turn what they read by half a turn about z.
`.spz` has axes to the right, up and back, half a turn about y from ours. So converters make the same of all of them.

    .ply    3DGS (https://github.com/graphdeco-inria/gaussian-splatting): x y z, nx ny nz (zeros), f_dc_* = (rgb - 1/2) / Y00,
            optionally 45 zero f_rest_*, logit opacity, log scales, quaternion wxyz
    .splat  https://github.com/antimatter15/splat: 32 bytes a Gaussian, position and scales in float32, RGBA and quaternion wxyz
            in uint8, the largest and most opaque first
    .spz    version 3 (https://github.com/nianticlabs/spz#file-format): gzip of a header and six arrays, 20 bytes a Gaussian:
            positions in 24-bit fixed point, scales exp(k / 16 - 10) metres, opacities k / 255, f_dc = (k / 255 - 1/2) / 0.15,
            quaternions by their three smallest components in 10 bits each. Libraries that write it bring a compiler (gsply)
            or do not install (PyPI's spz)
    .glb    glTF 2.0 with KHR_gaussian_splatting
            (https://github.com/KhronosGroup/glTF/tree/main/extensions/2.0/Khronos/KHR_gaussian_splatting)
"""

import gzip
import os
import struct
from typing import get_args

import jax
import jax.numpy as jnp
import numpy as np

from humangs_jax.avatar.export import Up
from humangs_jax.core.array_types import Float, UInt, UInt8
from humangs_jax.core.checks import BOUNDED, check_values, checked_arguments
from humangs_jax.core.pytree import replace
from humangs_jax.geometry import quaternion
from humangs_jax.geometry.transform import EXACT
from humangs_jax.io.atomic import replace_file, write_bytes
from humangs_jax.io.mesh import VERTICES, GlbWriter
from humangs_jax.rendering.gaussians import Gaussians, factored, gaussian_values, widened

SH_C0 = 0.28209479177387814
"""The constant spherical harmonic Y00 = 1 / (2 sqrt(pi))."""
SEEN = 0.5
"""Gaussians of at least this opacity have feet to stand on."""
BACKWARDS = (0.0, 0.0, 1.0, 0.0)
"""The rotation (quaternion, wxyz) of half a turn about y."""
_HALF = float(np.sqrt(0.5))
_TURNS = {"y": (1.0, 0.0, 0.0, 0.0), "-y": (0.0, 0.0, 0.0, 1.0), "z": (_HALF, _HALF, 0.0, 0.0)}
OPACITY_MARGIN = 1e-6
"""Keeps the logit finite for opacities of 0 and 1."""
SMALLEST_SCALE = 1e-9
"""Metres; keeps the logarithm finite for flat Gaussians."""
SPZ_MAGIC, SPZ_VERSION = 0x5053474E, 3
MOST_FRACTIONAL_BITS = 20
"""Steps of a micrometre; less where the Gaussians reach farther than 8 m."""
COLOR_SCALE, SCALE_STEPS, SCALE_ZERO = 0.15, 16.0, 10.0
QUATERNION_STEPS = 511
EXTENSION = "KHR_gaussian_splatting"


# Worlds ---------------------------------------------------------------------------------------------------------------


def up_turn(up: Up) -> tuple[float, float, float, float]:
    """The rotation (quaternion, wxyz) that turns +y to the named axis: -y about z, z about x. Raises: ValueError."""
    if up not in _TURNS:
        raise ValueError(f"up: expected {', '.join(get_args(Up))}, got {up!r}")
    return _TURNS[up]


def up_matrix(up: Up) -> Float[np.ndarray, "3 3"]:
    """`up_turn` as a matrix: of points and normals."""
    return _matrix(up_turn(up))


def turned(gaussians: Gaussians, up: Up) -> Gaussians:
    """Gaussians of a world with y up in one where `up` is. Raises: ValueError for another axis.

    -y: half a turn about z, (-x, -y, z). z: a quarter about x, (x, -z, y).
    """
    return rotated(gaussians, up_turn(up))


def rotated(gaussians: Gaussians, turn: tuple[float, float, float, float]) -> Gaussians:
    """Gaussians turned about the origin by a quaternion (wxyz) of quarters of a turn."""
    if gaussians.deformations is not None:
        gaussians = factored(gaussians)
    matrix = jnp.asarray(_matrix(turn), gaussians.means.dtype)
    means = jnp.matmul(gaussians.means, matrix.T, precision=EXACT)
    quats = quaternion.multiply(jnp.asarray(turn, gaussians.quats.dtype), gaussians.quats)
    return replace(gaussians, means=means, quats=quats)


def _matrix(turn: tuple[float, float, float, float]) -> Float[np.ndarray, "3 3"]:
    """Of 0 and +-1."""
    with jax.ensure_compile_time_eval():  # the turn is known inside of transformations, too
        return np.asarray(quaternion.to_matrix(jnp.asarray(turn)), np.float32).round()


def grounded_gaussians(gaussians: Gaussians) -> Gaussians:
    """Moved along y so that the lowest centre of a Gaussian that is seen (opacity 0.5 and more) lies on y = 0."""
    means, opacities = np.asarray(gaussians.means), np.asarray(gaussians.opacities)
    seen = opacities >= min(SEEN, opacities.max(initial=0.0))
    lowest = means[seen, 1].min(initial=np.inf)
    shift = np.asarray([0.0, lowest if np.isfinite(lowest) else 0.0, 0.0], means.dtype)
    return replace(gaussians, means=gaussians.means - shift)


def plain_arrays(
    gaussians: Gaussians,
) -> tuple[
    Float[np.ndarray, "g 3"],
    Float[np.ndarray, "g 4"],
    Float[np.ndarray, "g 3"],
    Float[np.ndarray, " g"],
    Float[np.ndarray, "g 3"],
]:
    """Means, unit quaternions (wxyz), scales, opacities and colors in float64, without deformations and without low-pass.

    Viewers add `EPS2D` pixels^2, as 3DGS does, where our renderer adds less to scales that contain a low-pass
    (`Gaussians.low_pass`). It is taken out, so that both draw the same in images of the size that the Gaussians were fitted to.

    Raises: ValueError for numbers that files cannot hold: not finite, or of more than `checks.LARGEST`.
    """
    bounded = {
        f"gaussians.{name}": (getattr(gaussians, name), BOUNDED) for name in ("means", "quats", "scales", "colors")
    }
    if gaussians.harmonics is not None:
        raise ValueError("export: gaussians.harmonics: expected none: these files hold one color for each Gaussian")
    check_values("export", gaussian_values(gaussians))
    check_values("export", bounded)
    gaussians = replace(gaussians, scales=widened(gaussians.scales, gaussians.low_pass, -1), low_pass=None)
    if gaussians.deformations is not None:
        gaussians = factored(gaussians)
    means, quats, scales, opacities, colors = (
        np.asarray(x, np.float64)
        for x in (gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities, gaussians.colors)
    )
    norms = np.linalg.norm(quats, axis=-1, keepdims=True)
    unit = np.where(norms > 0, quats / np.where(norms > 0, norms, 1), [1.0, 0, 0, 0])
    return means, unit, scales, opacities, colors


def sh_of(colors: Float[np.ndarray, "*g 3"]) -> Float[np.ndarray, "*g 3"]:
    """Coefficients of the constant spherical harmonic: files of Gaussians hold rgb = 1/2 + Y00 f."""
    return (colors - 0.5) / SH_C0


def linear_of(colors: Float[np.ndarray, "*g 3"]) -> Float[np.ndarray, "*g 3"]:
    """Linear colors in [0, 1] of sRGB-encoded ones (IEC 61966-2-1)."""
    encoded = np.clip(colors, 0, 1)
    return np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)


# Formats --------------------------------------------------------------------------------------------------------------


@checked_arguments
def write_ply(path: str | os.PathLike, gaussians: Gaussians, rest_fields: bool = False) -> None:
    """Write a 3DGS `.ply`; the file appears whole or not at all.

    rest_fields: add the 45 zero `f_rest_*` fields that some importers (Unity) insist on.
    """
    import plyfile

    means, quats, scales, opacities, colors = plain_arrays(gaussians)
    p = np.clip(opacities, OPACITY_MARGIN, 1 - OPACITY_MARGIN)
    columns = dict(zip("xyz", means.T, strict=True))
    columns |= {f"n{axis}": np.zeros(len(means)) for axis in "xyz"}
    columns |= {f"f_dc_{i}": sh_of(colors)[:, i] for i in range(3)}
    if rest_fields:
        columns |= {f"f_rest_{i}": np.zeros(len(means)) for i in range(45)}
    columns["opacity"] = np.log(p) - np.log1p(-p)
    columns |= {f"scale_{i}": np.log(np.maximum(scales[:, i], SMALLEST_SCALE)) for i in range(3)}
    columns |= {f"rot_{i}": quats[:, i] for i in range(4)}
    vertices = np.empty(len(means), dtype=[(name, "<f4") for name in columns])
    for name, values in columns.items():
        vertices[name] = values
    content = plyfile.PlyData([plyfile.PlyElement.describe(vertices, "vertex")], byte_order="<")
    replace_file(path, lambda temporary: content.write(str(temporary)))


def write_splat(path: str | os.PathLike, gaussians: Gaussians) -> None:
    """Write a `.splat`; the file appears whole or not at all. Colors and opacities lose to 8 bits, quaternions to 7."""
    means, quats, scales, opacities, colors = plain_arrays(gaussians)
    rows = np.empty(len(means), [("position", "<f4", 3), ("scale", "<f4", 3), ("rgba", "u1", 4), ("rotation", "u1", 4)])
    rows["position"], rows["scale"] = means, scales
    rows["rgba"] = np.rint(255 * np.clip(np.concatenate([colors, opacities[:, None]], axis=1), 0, 1))
    rows["rotation"] = np.clip(np.rint(128 * quats + 128), 0, 255)
    order = np.argsort(-opacities * scales.prod(axis=1), kind="stable")  # viewers draw the first while the rest loads
    write_bytes(path, rows[order].tobytes())


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
    header = struct.pack("<IIIBBBB", SPZ_MAGIC, SPZ_VERSION, len(means), 0, bits, 0, 0)
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


def write_glb(path: str | os.PathLike, gaussians: Gaussians) -> None:
    """Write a `.glb` with KHR_gaussian_splatting; the file appears whole or not at all.

    Viewers that do not know the extension draw colored points: glTF's COLOR_0 is linear, unlike the extension's coefficients.
    """
    means, quats, scales, opacities, colors = plain_arrays(gaussians)
    arrays = {
        "POSITION": ("VEC3", means),
        "COLOR_0": ("VEC4", np.column_stack([linear_of(colors), np.clip(opacities, 0, 1)])),
        f"{EXTENSION}:ROTATION": ("VEC4", quats[:, [1, 2, 3, 0]]),
        f"{EXTENSION}:SCALE": ("VEC3", scales),
        f"{EXTENSION}:OPACITY": ("SCALAR", np.clip(opacities, 0, 1)),
        f"{EXTENSION}:SH_DEGREE_0_COEF_0": ("VEC3", sh_of(colors)),
    }
    writer = GlbWriter()
    attributes = {
        name: writer.array(kind, values, VERTICES, bounds=name == "POSITION") for name, (kind, values) in arrays.items()
    }
    about = {
        "kernel": "ellipse",
        "colorSpace": "srgb_rec709_display",
        "projection": "perspective",
        "sortingMethod": "cameraDistance",
    }
    document = {
        "extensionsUsed": [EXTENSION],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": attributes, "mode": 0, "extensions": {EXTENSION: about}}]}],
    }
    writer.write(path, document)
