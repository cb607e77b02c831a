"""`.glb`: glTF 2.0 with KHR_gaussian_splatting
(https://github.com/KhronosGroup/glTF/tree/main/extensions/2.0/Khronos/KHR_gaussian_splatting): quaternions xyzw, linear scales.
"""

import logging
import os
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from humangs_jax.avatar.export.gaussians import colors_of, linear_of, loaded, plain_arrays, sh_of
from humangs_jax.core.array_types import Float
from humangs_jax.data.motion.gltf import node_matrices
from humangs_jax.io.mesh import VERTICES, GlbWriter, count_of, parse_glb, read_accessor
from humangs_jax.io.reading import Refused, check_limit, shown
from humangs_jax.rendering.gaussians import Gaussians, factored, skin_gaussians
from humangs_jax.rendering.harmonics import COUNTS

logger = logging.getLogger(__name__)

EXTENSION, SRGB = "KHR_gaussian_splatting", "srgb_rec709_display"
COEFFICIENTS = [f"{EXTENSION}:SH_DEGREE_{degree}_COEF_{i}" for degree in (1, 2, 3) for i in range(2 * degree + 1)]


def write_glb(path: str | os.PathLike[str], gaussians: Gaussians) -> None:
    """Write a `.glb` with KHR_gaussian_splatting; the file appears whole or not at all.

    Viewers that do not know the extension draw colored points: glTF's COLOR_0 is linear, unlike the extension's coefficients.
    """
    means, quats, scales, opacities, colors, harmonics = plain_arrays(gaussians)
    if not len(means):
        raise ValueError(f"{path}: expected at least one Gaussian")
    arrays = {
        "POSITION": ("VEC3", means),
        "COLOR_0": ("VEC4", np.column_stack([linear_of(colors), np.clip(opacities, 0, 1)])),
        f"{EXTENSION}:ROTATION": ("VEC4", quats[:, [1, 2, 3, 0]]),
        f"{EXTENSION}:SCALE": ("VEC3", scales),
        f"{EXTENSION}:OPACITY": ("SCALAR", np.clip(opacities, 0, 1)),
        f"{EXTENSION}:SH_DEGREE_0_COEF_0": ("VEC3", sh_of(colors)),
    }
    arrays |= {name: ("VEC3", harmonics[:, i]) for i, name in enumerate(COEFFICIENTS[: harmonics.shape[1]])}
    writer = GlbWriter()
    attributes = {
        name: writer.array(kind, values, VERTICES, bounds=name == "POSITION") for name, (kind, values) in arrays.items()
    }
    about = {
        "kernel": "ellipse",
        "colorSpace": SRGB,
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


def read_glb(data: bytes) -> Gaussians:
    """Gaussians of the bytes of a file, those of all nodes in their places. Raises: Refused; what damaged numbers raise."""
    content, binary = parse_glb(data)
    if needed := sorted(set(content.get("extensionsRequired", [])) - {EXTENSION, "KHR_mesh_quantization"}):
        raise Refused(f"needs the extension {shown(needed[0])}: expected {EXTENSION} without compression")
    places = node_matrices(content.get("nodes", []))
    placed = [
        (part, places[i])
        for i, node in enumerate(content.get("nodes", []))
        for part in (content["meshes"][node["mesh"]]["primitives"] if "mesh" in node else ())
        if EXTENSION in part.get("extensions", {})
    ]
    if not placed:
        raise Refused(f"no Gaussians: expected parts of meshes with {EXTENSION}")
    check_limit("parts", len(placed), "parts of meshes")
    counts = [count_of(content["accessors"][part["attributes"]["POSITION"]]) for part, _ in placed]
    check_limit("gaussians", sum(counts), "Gaussians")
    spaces = {shown(part["extensions"][EXTENSION].get("colorSpace", SRGB)) for part, _ in placed}
    if spaces != {shown(SRGB)}:
        logger.warning("colors of %s are taken as they are: images of them have these colors, too", ", ".join(spaces))
    parts = [_part(content, binary, part["attributes"], place) for part, place in placed]
    if len({None if part.harmonics is None else part.harmonics.shape[1] for part in parts}) > 1:
        raise Refused("parts with harmonics of different degrees: expected one degree")
    return jax.tree.map(lambda *arrays: jnp.concatenate(arrays), *parts)


def _part(content: dict[str, Any], binary: bytes, attributes: dict[str, int], place: Float[np.ndarray, "4 4"]) -> Gaussians:
    def array(name: str) -> np.ndarray:
        if name not in attributes:
            raise Refused(f"{name}: missing")
        return read_accessor(content, binary, attributes[name])

    names = [f"{EXTENSION}:{name}" for name in ("ROTATION", "SCALE", "OPACITY", "SH_DEGREE_0_COEF_0")]
    arrays = {name: array(name) for name in ("POSITION", *names)}
    arrays[names[0]] = np.roll(arrays[names[0]], 1, axis=1)
    arrays[names[2]] = arrays[names[2]].reshape(-1)
    arrays[names[3]] = colors_of(arrays[names[3]])
    if count := next(count for count in COUNTS[::-1] if not count or COEFFICIENTS[count - 1] in attributes):
        arrays["SH"] = np.stack([array(name) for name in COEFFICIENTS[:count]], axis=1)
    gaussians = loaded(arrays)
    if np.array_equal(place, np.eye(4)):
        return gaussians
    return factored(skin_gaussians(gaussians, jnp.broadcast_to(jnp.asarray(place, jnp.float32), (len(gaussians.means), 4, 4))))
