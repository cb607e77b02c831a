"""Gaussians in the files that other people's viewers open.

3DGS `.ply` (Kerbl et al. 2023): per vertex x y z, nx ny nz (zeros), f_dc_* = (rgb - 1/2) / Y00, optionally 45 zero f_rest_*,
logit opacity, log scales, quaternion wxyz. `.splat` (https://github.com/antimatter15/splat): 32 bytes each, position and
scales in float32, RGBA and quaternion wxyz in uint8, the largest and most opaque first. `.glb`: glTF 2.0 with
KHR_gaussian_splatting (https://github.com/KhronosGroup/glTF/tree/main/extensions/2.0/Khronos/KHR_gaussian_splatting): points with
scales, quaternions xyzw, opacities and f_dc.

Ours are metres with y up, the person faces +z. glTF's world is the same. Viewers of the other two take y for down: SuperSplat and
PlayCanvas turn what they read by half a turn about z. `grounded_gaussians` and `turned` bring a person into their world.
"""

import json
import os
import struct
from typing import Literal, get_args

import jax.numpy as jnp
import numpy as np

from humangs_jax.core.pytree import replace
from humangs_jax.geometry import quaternion
from humangs_jax.geometry.transform import EXACT
from humangs_jax.io.atomic import replace_file, write_bytes
from humangs_jax.rendering.gaussians import Gaussians, factored

Up = Literal["y", "-y", "z"]
"""The axis that points up in a file."""
SH_C0 = 0.28209479177387814
"""The constant spherical harmonic Y00 = 1 / (2 sqrt(pi))."""
OPACITY_MARGIN = 1e-6
"""Keeps the logit finite for opacities of 0 and 1."""
SMALLEST_SCALE = 1e-9
"""Metres; keeps the logarithm finite for flat Gaussians."""
SEEN = 0.5
"""Gaussians of at least this opacity have feet to stand on."""
_HALF = float(np.sqrt(0.5))
_TURNS = {"y": (1.0, 0.0, 0.0, 0.0), "-y": (0.0, 0.0, 0.0, 1.0), "z": (_HALF, _HALF, 0.0, 0.0)}
"""The rotation (quaternion, wxyz) that turns +y to the named axis: -y about z, z about x."""


def turned(gaussians: Gaussians, up: Up) -> Gaussians:
    """Gaussians of a world with y up in one where `up` is. Raises: ValueError for another axis.

    -y: half a turn about z, (-x, -y, z). z: a quarter about x, (x, -z, y).
    """
    if up not in _TURNS:
        raise ValueError(f"up: expected {', '.join(get_args(Up))}, got {up!r}")
    if gaussians.deformations is not None:
        gaussians = factored(gaussians)
    turn = jnp.asarray(_TURNS[up], gaussians.quats.dtype)
    means = jnp.matmul(gaussians.means, quaternion.to_matrix(turn).T, precision=EXACT)
    return replace(gaussians, means=means, quats=quaternion.multiply(turn, gaussians.quats))


def grounded_gaussians(gaussians: Gaussians) -> Gaussians:
    """Moved along y so that the lowest centre of a Gaussian that is seen (opacity 0.5 and more) lies on y = 0."""
    means, opacities = np.asarray(gaussians.means), np.asarray(gaussians.opacities)
    seen = opacities >= min(SEEN, opacities.max(initial=0.0))
    lowest = means[seen, 1].min(initial=np.inf)
    shift = np.asarray([0.0, lowest if np.isfinite(lowest) else 0.0, 0.0], means.dtype)
    return replace(gaussians, means=gaussians.means - shift)


def write_ply(path: str | os.PathLike, gaussians: Gaussians, spherical_harmonics_rest: bool = False) -> None:
    """Write a 3DGS `.ply`; the file appears whole or not at all.

    spherical_harmonics_rest: add the 45 zero `f_rest_*` fields that some importers (Unity) insist on.
    """
    import plyfile

    means, quats, scales, opacities, colors = _plain_arrays(gaussians)
    p = np.clip(opacities, OPACITY_MARGIN, 1 - OPACITY_MARGIN)
    columns = dict(zip("xyz", means.T, strict=True))
    columns |= {f"n{axis}": np.zeros(len(means)) for axis in "xyz"}
    columns |= {f"f_dc_{i}": (colors[:, i] - 0.5) / SH_C0 for i in range(3)}
    if spherical_harmonics_rest:
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
    """Write a `.splat`; the file appears whole or not at all. Colours and opacities lose to 8 bits, quaternions to 7."""
    means, quats, scales, opacities, colors = _plain_arrays(gaussians)
    rows = np.empty(len(means), [("position", "<f4", 3), ("scale", "<f4", 3), ("rgba", "u1", 4), ("rotation", "u1", 4)])
    rows["position"], rows["scale"] = means, scales
    rows["rgba"] = np.rint(255 * np.clip(np.concatenate([colors, opacities[:, None]], axis=1), 0, 1))
    rows["rotation"] = np.clip(np.rint(128 * quats + 128), 0, 255)
    order = np.argsort(-opacities * scales.prod(axis=1), kind="stable")  # viewers draw the first while the rest loads
    write_bytes(path, rows[order].tobytes())


def write_glb(path: str | os.PathLike, gaussians: Gaussians) -> None:
    """Write a `.glb` with KHR_gaussian_splatting; the file appears whole or not at all.

    Viewers that do not know the extension draw coloured points.
    """
    means, quats, scales, opacities, colors = _plain_arrays(gaussians)
    rgba = np.concatenate([colors, opacities[:, None]], axis=1)
    prefix = "KHR_gaussian_splatting:"
    arrays = {
        "POSITION": ("VEC3", means),
        "COLOR_0": ("VEC4", np.clip(rgba, 0, 1)),
        f"{prefix}ROTATION": ("VEC4", quats[:, [1, 2, 3, 0]]),
        f"{prefix}SCALE": ("VEC3", scales),
        f"{prefix}OPACITY": ("SCALAR", np.clip(opacities, 0, 1)),
        f"{prefix}SH_DEGREE_0_COEF_0": ("VEC3", (colors - 0.5) / SH_C0),
    }
    data, views, accessors = b"", [], []
    for kind, array in arrays.values():
        values = np.ascontiguousarray(array, "<f4")
        views.append({"buffer": 0, "byteOffset": len(data), "byteLength": values.nbytes, "target": 34962})
        accessors.append({"bufferView": len(views) - 1, "componentType": 5126, "count": len(values), "type": kind})
        data += values.tobytes()
    single = means.astype(np.float32)
    accessors[0] |= {"min": single.min(0).tolist(), "max": single.max(0).tolist()}
    about = {
        "kernel": "ellipse",
        "colorSpace": "srgb_rec709_display",
        "projection": "perspective",
        "sortingMethod": "cameraDistance",
    }
    primitive = {
        "attributes": {name: i for i, name in enumerate(arrays)},
        "mode": 0,
        "extensions": {"KHR_gaussian_splatting": about},
    }
    document = {
        "asset": {"version": "2.0", "generator": "humangs_jax"},
        "extensionsUsed": ["KHR_gaussian_splatting"],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [primitive]}],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": len(data)}],
    }
    text = json.dumps(document, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(data), b"BIN\0") + data
    write_bytes(path, struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks)


def _plain_arrays(gaussians: Gaussians):
    """Means, unit quaternions, scales, opacities and colours in float64, without deformations."""
    if gaussians.deformations is not None:
        gaussians = factored(gaussians)
    means, quats, scales, opacities, colors = (
        np.asarray(x, np.float64)
        for x in (gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities, gaussians.colors)
    )
    norms = np.linalg.norm(quats, axis=-1, keepdims=True)
    unit = np.where(norms > 0, quats / np.where(norms > 0, norms, 1), [1.0, 0, 0, 0])
    return means, unit, scales, opacities, colors
