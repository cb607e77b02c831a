"""Formats of Gaussians: `.ply`, `.splat`, `.glb` and checkpoints of gsplat; `spz` and `sog` have
the others.

A `.ply` has the properties of 3DGS, or the compressed ones of PlayCanvas, which are read only.

3DGS (https://github.com/graphdeco-inria/gaussian-splatting): x y z, nx ny nz (zeros), f_dc_* = (rgb
- 1/2) / Y00, f_rest_* of degrees 1 to 3 (all of red, then of green, then of blue), logit opacity,
log scales, quaternion wxyz.

Compressed (https://github.com/playcanvas/splat-transform): for each 256 Gaussians a chunk has the
bounds of positions, log scales and perhaps colors. Each Gaussian has four words of 32 bits.
Position and scale are shares between the bounds, in 11, 10 and 11 bits. The quaternion has the
place of its largest component in 2 bits, and the other three components in 10 bits each. Color and
opacity have 8 bits each. f_rest_* are bytes, from -4 to 4.
"""

import io
import itertools
import os
import re
from collections.abc import Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy.special import expit

from humangs_jax.avatar.export import CHECKPOINTS
from humangs_jax.avatar.export.gaussians import (
    colors_of,
    linear_of,
    loaded,
    plain_arrays,
    sh_of,
    with_largest,
)
from humangs_jax.core.array_types import Float
from humangs_jax.core.checks import checked_arguments
from humangs_jax.io.atomic import replace_file, write_bytes
from humangs_jax.io.mesh import VERTICES, GlbWriter, count_of, parse_glb, read_accessor
from humangs_jax.io.nodes import node_matrices
from humangs_jax.io.reading import InvalidFileError, check_limit, shown
from humangs_jax.io.tensors import tensors_in
from humangs_jax.rendering.gaussians import COUNTS, Gaussians, factored, skin_gaussians

OPACITY_MARGIN = 1e-6
"""Opacities are clipped to be at least this far from 0 and 1, so that their logit is finite."""
SMALLEST_SCALE = 1e-9
"""The least scale that is written, metres. It keeps the logarithm finite for flat Gaussians."""
LONGEST_HEADER = 1 << 16
ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
TYPES = {
    "char": "i1",
    "uchar": "u1",
    "short": "i2",
    "ushort": "u2",
    "int": "i4",
    "uint": "u4",
    "float": "f4",
    "double": "f8",
}
TYPES |= {f"{np.dtype(kind).name}": kind for kind in TYPES.values()}
CHUNK = 256
REST = 8 * np.concatenate([[0], np.arange(1.5, 255), [256]]) / 256 - 4
"""The number that each byte of compressed harmonics stands for, (256,). It is the middle of the
byte's step; for the first and the last byte it is the end of the range.
"""
DEGREE_4 = 72
"""The number of `f_rest_*` properties of harmonics of degree 1 to 4, which are not read."""
FILTER = "filter_3D"
"""The property with the standard deviation of the 3D smoothing filter of Mip-Splatting and GOF. It
widens the scales and lowers the opacities.
"""
KNOWN = re.compile(
    r"[xyz]|n[xyz]|red|green|blue|alpha|opacity|filter_3D"
    r"|(f_dc|f_rest|scale|rot|packed|min|max)_\w+"
)
"""Matches the names of the properties that are read. Also matches properties that need no mention
if they are not read, such as normals and 8-bit colors.
"""
SHOWN = 6
"""The largest number of names in a line about unused properties."""
Columns = Mapping[str, np.ndarray]


@checked_arguments
def write_ply(
    path: str | os.PathLike[str], gaussians: Gaussians, rest_fields: bool = False
) -> None:
    """Write a 3DGS `.ply`. If writing fails, the path stays as it was.

    rest_fields: write all 45 `f_rest_*` fields, which some importers (Unity) require. Fields of
    harmonics that the Gaussians do not have are 0. Raises: ValueError as `plain_arrays`; OSError.
    """
    import plyfile

    means, quats, scales, opacities, colors, harmonics = plain_arrays(gaussians)
    p = np.clip(opacities, OPACITY_MARGIN, 1 - OPACITY_MARGIN)
    columns = dict(zip("xyz", means.T, strict=True))
    columns |= {f"n{axis}": np.zeros(len(means)) for axis in "xyz"}
    columns |= {f"f_dc_{i}": sh_of(colors)[:, i] for i in range(3)}
    if rest_fields:
        harmonics = np.pad(harmonics, ((0, 0), (0, COUNTS[-1] - harmonics.shape[1]), (0, 0)))
    rest = harmonics.swapaxes(1, 2).reshape(len(means), 3 * harmonics.shape[1])
    columns |= {f"f_rest_{i}": column for i, column in enumerate(rest.T)}
    columns["opacity"] = np.log(p) - np.log1p(-p)
    columns |= {f"scale_{i}": np.log(np.maximum(scales[:, i], SMALLEST_SCALE)) for i in range(3)}
    columns |= {f"rot_{i}": quats[:, i] for i in range(4)}
    vertices = np.empty(len(means), dtype=[(name, "<f4") for name in columns])
    for name, values in columns.items():
        vertices[name] = values
    content = plyfile.PlyData([plyfile.PlyElement.describe(vertices, "vertex")], byte_order="<")
    replace_file(path, lambda temporary: content.write(str(temporary)))


def read_ply(data: bytes, notes: list[str]) -> Gaussians:
    """Returns the Gaussians in the bytes of a `.ply`. Lines about unused properties are appended to
    `notes`.

    Raises: InvalidFileError; for damaged numbers also other errors.
    """
    elements = _elements(data)
    notes += _unused(elements)
    vertex = elements.get("vertex", {})
    if "chunk" in elements:
        return _unpacked(elements["chunk"], vertex, elements.get("sh", {}), notes)
    arrays = {
        "x, y, z": _columns(vertex, *"xyz"),
        "rot_*": _columns(vertex, *(f"rot_{i}" for i in range(4))),
        "scale_*": _exponential(_columns(vertex, *(f"scale_{i}" for i in range(3)))),
        "opacity": expit(_columns(vertex, "opacity")[:, 0]),
        "f_dc_*": colors_of(_columns(vertex, *(f"f_dc_{i}" for i in range(3)))),
    }
    if FILTER in vertex:
        fused = _fused(arrays["scale_*"], arrays["opacity"], _columns(vertex, FILTER))
        arrays["scale_*"], arrays["opacity"] = fused
    return loaded(arrays | _harmonics(vertex), notes)


def _fused(
    scales: Float[np.ndarray, "g 3"],
    opacities: Float[np.ndarray, " g"],
    smoothing: Float[np.ndarray, "g 1"],
) -> tuple[Float[np.ndarray, "g 3"], Float[np.ndarray, " g"]]:
    """Returns the scales and opacities after the 3D smoothing filter of Mip-Splatting. smoothing:
    the filter's standard deviations f, metres.

    s' = sqrt(s^2 + f^2) and o' = o prod(s / s'), so that the integral over space stays (arXiv
    2311.16493, equation 9).
    """
    wide = np.hypot(scales, smoothing)
    shares = np.divide(scales, wide, out=np.ones_like(wide), where=wide > 0)
    return wide, opacities * shares.prod(axis=1)


def _unused(elements: Mapping[str, Columns]) -> list[str]:
    """Returns a list with one line about the properties and elements that are not read. The list is
    empty if all are read.
    """
    found = [name for name in elements if name not in ("chunk", "vertex", "sh", "face")]
    found += [
        name
        for each in ("vertex", "chunk", "sh")
        for name in elements.get(each, {})
        if not KNOWN.fullmatch(name)
    ]
    more = ""
    if len(found) > SHOWN:
        more = f" and {len(found) - SHOWN} more"
    if found:
        return [f"properties that are not used: {', '.join(found[:SHOWN])}{more}"]
    return []


def _exponential(logs: Float[np.ndarray, "g 3"]) -> Float[np.ndarray, "g 3"]:
    return np.exp(np.minimum(logs, 99))  # far too large, so refused


def _harmonics(
    columns: Columns, values: np.ndarray | None = None
) -> dict[str, Float[np.ndarray, "g k 3"]]:
    """Returns the harmonics (g, k, 3) under the name "f_rest_*". The dictionary is empty if there
    are none. values: the number that each byte stands for, as `REST`. None: columns hold the
    numbers themselves.
    """
    count = sum(name.startswith("f_rest_") for name in columns)
    if count % 3 or count // 3 not in COUNTS:
        degree = " of degree 4" if count == DEGREE_4 else ""
        raise InvalidFileError(
            f"f_rest_*: expected 9, 24 or 45 properties, of degree 1 to 3, got {count}{degree}"
        )
    if not count:
        return {}
    rest = _columns(
        columns,
        *(f"f_rest_{i}" for i in range(count)),
        dtype=np.float32 if values is None else np.uint8,
    )
    if values is not None:
        rest = values[rest]
    return {"f_rest_*": rest.reshape(len(rest), 3, count // 3).swapaxes(1, 2)}


def _unpacked(chunk: Columns, vertex: Columns, sh: Columns, notes: list[str]) -> Gaussians:
    """Returns the Gaussians of a compressed `.ply` of PlayCanvas. Lines about what is left out are
    appended to `notes`.
    """
    words = {name: _columns(vertex, f"packed_{name}", dtype=np.uint32)[:, 0] for name in WORDS}
    bits = {
        name: np.stack([_bits(words[name], *place) for place in places], axis=1)
        for name, places in WORDS.items()
    }
    # each chunk of Gaussians has a range that its numbers are shares of
    count, chunks = len(words["color"]), len(next(iter(chunk.values())))
    if chunks != -(-count // CHUNK):
        raise InvalidFileError(
            f"chunk: expected one for each {CHUNK} of {count:,} Gaussians, got {chunks:,}"
        )

    def between(part: Float[np.ndarray, "g 3"], *names: str) -> Float[np.ndarray, "g 3"]:
        low, high = (
            _columns(chunk, *(f"{end}_{name}" for name in names)) for end in ("min", "max")
        )
        return (
            np.repeat(low, CHUNK, axis=0)[:count] * (1 - part)
            + np.repeat(high, CHUNK, axis=0)[:count] * part
        )

    # only newer files have ranges of colors
    colors = bits["color"][:, :3]
    arrays = {
        "packed_position": between(bits["position"], *"xyz"),
        "packed_rotation": with_largest(
            (bits["rotation"] - 0.5) * np.sqrt(2), words["rotation"] >> 30
        ),
        "packed_scale": _exponential(between(bits["scale"], "scale_x", "scale_y", "scale_z")),
        "opacity": bits["color"][:, 3],
        "packed_color": between(colors, *"rgb") if "min_r" in chunk else colors,
    }
    return loaded(arrays | _harmonics(sh, REST), notes)


_ELEVEN = [(21, 11), (11, 10), (0, 11)]
WORDS = {
    "position": _ELEVEN,
    "rotation": [(20, 10), (10, 10), (0, 10)],
    "scale": _ELEVEN,
    "color": [(24, 8), (16, 8), (8, 8), (0, 8)],
}
"""The lowest bit and the number of bits of each part of a packed word. Parts are in the order x, y,
z, for rotations the three components in their order, and for colors red, green, blue, opacity.
"""


def _bits(words: np.ndarray, lowest: int, width: int) -> Float[np.ndarray, " g"]:
    """Returns `width` bits of each word, from the bit `lowest` on, as numbers in [0, 1]."""
    return (words >> np.uint32(lowest) & np.uint32(2**width - 1)) / (2**width - 1)


def _columns(columns: Columns, *names: str, dtype: type[np.generic] = np.float64) -> np.ndarray:
    """Returns the named properties side by side, (g, names), as numbers of type `dtype`.

    Raises: InvalidFileError if a property is missing, or if `dtype` is an integer type and the file
    has another one.
    """
    for name in names:
        if name not in columns:
            raise InvalidFileError(
                f"{name}: missing: expected Gaussians (x, y, z, f_dc_*, opacity, scale_*, rot_* or"
                " packed_*)"
            )
        if issubclass(dtype, np.integer) and columns[name].dtype.newbyteorder("=") != dtype:
            raise InvalidFileError(
                f"{name}: expected {np.dtype(dtype).name}, got {columns[name].dtype}"
            )
    with np.errstate(over="ignore"):
        return np.stack([columns[name].astype(dtype) for name in names], axis=-1)


def _elements(data: bytes) -> dict[str, Columns]:
    """Returns the columns of each element of a `.ply`, up to the first element with lists.

    Memory is taken only after it is known that the file is long enough.
    """
    end = re.compile(rb"end_header[ \t]*\r?\n").search(data, 0, LONGEST_HEADER)
    if end is None:
        raise InvalidFileError("no PLY file: expected a header that ends in end_header")
    # the header: names, numbers and types
    order, counts, types = None, {}, {}
    for line in data[: end.start()].decode("ascii", "replace").splitlines():
        match line.split():
            case [] | ["ply"] | ["comment" | "obj_info", *_]:
                pass
            case ["format", str(form), _] if form in ORDERS:
                order = ORDERS[form]
            case ["element", str(name), str(count)] if (
                name not in counts and count.isdecimal() and len(count) < 20
            ):
                counts[name], types[name] = int(count), []
            case ["property", "list", _, _, str(name)] if types:
                list(types.values())[-1].append((name, None))
            case ["property", str(kind), str(name)] if (
                types and kind in TYPES and order is not None
            ):
                list(types.values())[-1].append((name, order + TYPES[kind]))
            case _:
                raise InvalidFileError(f"header: {shown(line)}: not understood")
    if order is None:
        raise InvalidFileError("header: no format")
    lines = None
    if not order:
        check_limit("text_bytes", len(data), "bytes")
        lines = io.StringIO(data[end.end() :].decode("ascii"))
    # the rows of each element, from bytes or from lines of text
    found, at = {}, end.end()
    for name, count in counts.items():
        if any(kind is None for _, kind in types[name]):
            break
        check_limit("gaussians", count, f"elements {name}")
        dtype = np.dtype(types[name])
        least = dtype.itemsize if lines is None else 2 * len(types[name])  # a digit and a space
        if not dtype.names or count * least > len(data) - at + (lines is not None):
            raise InvalidFileError(
                f"element {name}: {count:,} of them are not in {len(data) - at:,} bytes"
            )
        if lines is None:
            rows = np.ndarray((count,), dtype, data, at)
            found[name] = {each: rows[each] for each in dtype.names}
            at += count * least
        elif count:
            rows = np.loadtxt(itertools.islice(lines, count), comments=None, ndmin=2)
            if rows.shape != (count, len(dtype.names)):
                raise InvalidFileError(
                    f"element {name}: expected {count} lines of {len(dtype.names)} numbers, got"
                    f" {rows.shape}"
                )
            found[name] = dict(zip(dtype.names, rows.T, strict=True))
    return found


# `.splat` (https://github.com/antimatter15/splat): 32 bytes a Gaussian, position and scales in
# float32, RGBA and quaternion wxyz in uint8, the largest and most opaque first. It has no header.


ROW = [("position", "<f4", 3), ("scale", "<f4", 3), ("rgba", "u1", 4), ("rotation", "u1", 4)]
ROW_BYTES = 32


def write_splat(path: str | os.PathLike[str], gaussians: Gaussians) -> None:
    """Write a `.splat`. If writing fails, the path stays as it was. Colors, opacities and
    quaternions are rounded to bytes.

    Raises: ValueError for Gaussians with harmonics, and as `plain_arrays`; OSError.
    """
    means, quats, scales, opacities, colors, harmonics = plain_arrays(gaussians)
    if harmonics.size:
        raise ValueError(
            f"{path}: .splat holds one color for each Gaussian: expected no harmonics"
            " (replace(gaussians, harmonics=None))"
        )
    rows = np.empty(len(means), ROW)
    rows["position"], rows["scale"] = means, scales
    rows["rgba"] = np.rint(
        255 * np.clip(np.concatenate([colors, opacities[:, None]], axis=1), 0, 1)
    )
    rows["rotation"] = np.clip(np.rint(128 * quats + 128), 0, 255)
    # viewers draw the first while the rest loads
    order = np.argsort(-opacities * scales.prod(axis=1), kind="stable")
    write_bytes(path, rows[order].tobytes())


def read_splat(data: bytes, notes: list[str]) -> Gaussians:
    """Returns the Gaussians in the bytes of a `.splat`. Lines about what is left out are appended
    to `notes`.

    Raises: InvalidFileError.
    """
    check_limit("gaussians", len(data) // ROW_BYTES, "Gaussians")
    if not data or len(data) % ROW_BYTES:
        raise InvalidFileError(
            f"no .splat file: expected {ROW_BYTES} bytes for each Gaussian, got {len(data):,}"
        )
    rows = np.ndarray((len(data) // ROW_BYTES,), ROW, data)
    rgba = rows["rgba"] / 255
    arrays = {
        "position": rows["position"],
        "rotation": (rows["rotation"] - 128.0) / 128,
        "scale": rows["scale"],
        "opacity": rgba[:, 3],
        "color": rgba[:, :3],
    }
    return loaded(arrays, notes)


# Checkpoints of gsplat's trainer (https://github.com/nerfstudio-project/gsplat,
# examples/simple_trainer.py): a dict `splats` of means, quats wxyz, log scales, logit opacities,
# sh0 (g, 1, 3) and shN (g, k, 3), as in `.ply`.


SPLATS = "splats"


def read_checkpoint(data: bytes, notes: list[str]) -> Gaussians:
    """Returns the Gaussians in the bytes of a gsplat checkpoint. Lines about what is left out are
    appended to `notes`.

    Raises: InvalidFileError; for damaged files also other errors.
    """
    try:
        tensors = tensors_in(data, (SPLATS,))
    except InvalidFileError as error:
        raise InvalidFileError(
            f"no checkpoint of gsplat with {SPLATS!r} ({error}): {CHECKPOINTS}"
        ) from None

    def tensor(name: str, *shape: int) -> np.ndarray:
        if name not in tensors:
            network = "features" in tensors and name in ("sh0", "shN")
            why = "missing"
            if network:
                why = "trained with --app_opt, whose colors a network makes"
            raise InvalidFileError(f"{SPLATS}.{name}: {why}")
        array = tensors[name]
        expected = (len(tensors.get("means", ())), *shape)
        if array.shape != expected or array.dtype.kind != "f":
            got = f"{array.dtype} {array.shape}"
            raise InvalidFileError(
                f"{SPLATS}.{name}: expected floats of shape {expected}, got {got}"
            )
        return array.astype(np.float64)

    check_limit("gaussians", len(tensors.get("means", ())), "Gaussians")
    # gsplat stores logarithms of scales and logits of opacities
    arrays = {
        f"{SPLATS}.means": tensor("means", 3),
        f"{SPLATS}.quats": tensor("quats", 4),
        f"{SPLATS}.scales": _exponential(tensor("scales", 3)),
        f"{SPLATS}.opacities": expit(tensor("opacities")),
        f"{SPLATS}.sh0": colors_of(tensor("sh0", 1, 3)[:, 0]),
    }
    # harmonics of the higher degrees, if there are any
    rest = tensors.get("shN")
    functions = 0
    if rest is not None and rest.ndim == 3:
        functions = rest.shape[1]
    if functions not in COUNTS:
        degree = " of degree 4" if 3 * functions == DEGREE_4 else ""
        raise InvalidFileError(
            f"{SPLATS}.shN: expected 0, 3, 8 or 15 functions, of degree 0 to 3, got"
            f" {functions}{degree}"
        )
    if functions:
        arrays[f"{SPLATS}.shN"] = tensor("shN", functions, 3)
    return loaded(arrays, notes)


# `.glb`: glTF 2.0 with KHR_gaussian_splatting
# (https://github.com/KhronosGroup/glTF/tree/main/extensions/2.0/Khronos/KHR_gaussian_splatting):
# quaternions xyzw, linear scales.


EXTENSION = "KHR_gaussian_splatting"
"""The glTF extension that holds Gaussians."""
SRGB = "srgb_rec709_display"
"""The extension's name for colors that are encoded as in sRGB images."""
COEFFICIENTS = [
    f"{EXTENSION}:SH_DEGREE_{degree}_COEF_{i}"
    for degree in (1, 2, 3)
    for i in range(2 * degree + 1)
]
KERNEL = "ellipse"
"""The extension's name for the usual shape of a Gaussian, the only shape that is drawn."""
NEEDED = tuple(
    f"{EXTENSION}:{name}" for name in ("ROTATION", "SCALE", "OPACITY", "SH_DEGREE_0_COEF_0")
)
ATTRIBUTES = (*NEEDED, *COEFFICIENTS)
"""The names of the extension's attributes."""


def write_glb(path: str | os.PathLike[str], gaussians: Gaussians) -> None:
    """Write a `.glb` with KHR_gaussian_splatting. If writing fails, the path stays as it was.

    Viewers that do not know the extension draw points in the colors of COLOR_0. These colors are
    linear, as glTF wants them, while the extension's coefficients are of sRGB colors.

    Raises: ValueError if there are no Gaussians, and as `plain_arrays`; OSError.
    """
    means, quats, scales, opacities, colors, harmonics = plain_arrays(gaussians)
    if not len(means):
        raise ValueError(f"{path}: expected at least one Gaussian")
    # the extension's attributes, and colors for viewers without it
    arrays = {
        "POSITION": ("VEC3", means),
        "COLOR_0": ("VEC4", np.column_stack([linear_of(colors), np.clip(opacities, 0, 1)])),
        f"{EXTENSION}:ROTATION": ("VEC4", quats[:, [1, 2, 3, 0]]),
        f"{EXTENSION}:SCALE": ("VEC3", scales),
        f"{EXTENSION}:OPACITY": ("SCALAR", np.clip(opacities, 0, 1)),
        f"{EXTENSION}:SH_DEGREE_0_COEF_0": ("VEC3", sh_of(colors)),
    }
    arrays |= {
        name: ("VEC3", harmonics[:, i]) for i, name in enumerate(COEFFICIENTS[: harmonics.shape[1]])
    }
    writer = GlbWriter()
    # glTF requires the bounds of the positions
    attributes = {
        name: writer.array(kind, values, VERTICES, bounds=name == "POSITION")
        for name, (kind, values) in arrays.items()
    }
    # how the Gaussians are to be drawn
    about = {
        "kernel": KERNEL,
        "colorSpace": SRGB,
        "projection": "perspective",
        "sortingMethod": "cameraDistance",
    }
    document = {
        "extensionsUsed": [EXTENSION],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [
            {
                "primitives": [
                    {"attributes": attributes, "mode": 0, "extensions": {EXTENSION: about}}
                ]
            }
        ],
    }
    writer.write(path, document)


def read_glb(data: bytes, notes: list[str]) -> Gaussians:
    """Returns the Gaussians in the bytes of a `.glb`, each moved by the transform of its node.
    Lines about what is left out are appended to `notes`.

    Raises: InvalidFileError; for damaged numbers also other errors.
    """
    content, binary = parse_glb(data)
    # files that cannot be read right without another extension are refused
    needed = sorted(
        set(content.get("extensionsRequired", [])) - {EXTENSION, "KHR_mesh_quantization"}
    )
    if needed:
        raise InvalidFileError(
            f"needs the extension {shown(needed[0])}: expected {EXTENSION} without compression"
        )
    # each part of a mesh is placed by its node
    places = node_matrices(content.get("nodes", []))
    placed = [
        (part, places[i])
        for i, node in enumerate(content.get("nodes", []))
        if "mesh" in node
        for part in content["meshes"][node["mesh"]]["primitives"]
        if EXTENSION in part.get("extensions", {})
    ]
    if not placed:
        raise InvalidFileError(f"no Gaussians: expected parts of meshes with {EXTENSION}")
    # sizes are checked before anything is read
    check_limit("parts", len(placed), "parts of meshes")
    counts = [count_of(content["accessors"][part["attributes"]["POSITION"]]) for part, _ in placed]
    check_limit("gaussians", sum(counts), "Gaussians")
    spaces = {shown(part["extensions"][EXTENSION].get("colorSpace", SRGB)) for part, _ in placed}
    if spaces != {shown(SRGB)}:
        notes.append(
            f"colors of {', '.join(sorted(spaces))} are taken as they are: images of them have"
            " these colors, too"
        )
    notes += _other_parts(placed)
    # all parts become one set of Gaussians, in one space
    parts = [_part(content, binary, part["attributes"], place, notes) for part, place in placed]
    if len({None if part.harmonics is None else part.harmonics.shape[1] for part in parts}) > 1:
        raise InvalidFileError("parts with harmonics of different degrees: expected one degree")
    return jax.tree.map(lambda *arrays: jnp.concatenate(arrays), *parts)


def _other_parts(placed: Sequence[tuple[dict[str, Any], Any]]) -> list[str]:
    """Returns lines that list the extension's kernels and attributes that are not used here."""
    kernels = {shown(part["extensions"][EXTENSION].get("kernel", KERNEL)) for part, _ in placed} - {
        shown(KERNEL)
    }
    names = {
        name for part, _ in placed for name in part["attributes"] if name.startswith(EXTENSION)
    } - set(ATTRIBUTES)
    found = [f"kernel {kernel}" for kernel in sorted(kernels)] + [
        shown(name) for name in sorted(names)
    ]
    if found:
        return [f"parts that are not used: {', '.join(found[:SHOWN])}"]
    return []


def _part(
    content: dict[str, Any],
    binary: bytes,
    attributes: dict[str, int],
    place: Float[np.ndarray, "4 4"],
    notes: list[str],
) -> Gaussians:
    def array(name: str) -> np.ndarray:
        if name not in attributes:
            raise InvalidFileError(f"{name}: missing")
        return read_accessor(content, binary, attributes[name])

    arrays = {name: array(name) for name in ("POSITION", *NEEDED)}
    turns, _, opacities, colors = NEEDED
    arrays[turns] = np.roll(arrays[turns], 1, axis=1)
    arrays[opacities] = arrays[opacities].reshape(-1)
    arrays[colors] = colors_of(arrays[colors])
    count = next(
        count for count in COUNTS[::-1] if not count or COEFFICIENTS[count - 1] in attributes
    )
    if count:
        arrays["SH"] = np.stack([array(name) for name in COEFFICIENTS[:count]], axis=1)
    gaussians = loaded(arrays, notes)
    if np.array_equal(place, np.eye(4)):
        return gaussians
    return factored(
        skin_gaussians(
            gaussians,
            jnp.broadcast_to(jnp.asarray(place, jnp.float32), (len(gaussians.means), 4, 4)),
        )
    )
