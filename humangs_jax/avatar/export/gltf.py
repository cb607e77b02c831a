"""`.glb`: glTF 2.0 with KHR_gaussian_splatting: points with scales, quaternions xyzw, opacities and f_dc.

https://github.com/KhronosGroup/glTF/tree/main/extensions/2.0/Khronos/KHR_gaussian_splatting
"""

import os

import numpy as np

from humangs_jax.avatar.export.world import linear_of, plain_arrays, sh_of
from humangs_jax.io.glb import VERTICES, GlbWriter
from humangs_jax.rendering.gaussians import Gaussians

EXTENSION = "KHR_gaussian_splatting"


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
