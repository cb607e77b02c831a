"""3DGS `.ply` (Kerbl et al. 2023, https://github.com/graphdeco-inria/gaussian-splatting).

Per vertex x y z, nx ny nz (zeros), f_dc_* = (rgb - 1/2) / Y00, optionally 45 zero f_rest_*, logit opacity, log scales,
quaternion wxyz.
"""

import os

import numpy as np

from humangs_jax.avatar.export.world import plain_arrays, sh_of
from humangs_jax.core.arguments import checked_arguments
from humangs_jax.io.atomic import replace_file
from humangs_jax.rendering.gaussians import Gaussians

OPACITY_MARGIN = 1e-6
"""Keeps the logit finite for opacities of 0 and 1."""
SMALLEST_SCALE = 1e-9
"""Metres; keeps the logarithm finite for flat Gaussians."""


@checked_arguments
def write_ply(path: str | os.PathLike, gaussians: Gaussians, spherical_harmonics_rest: bool = False) -> None:
    """Write a 3DGS `.ply`; the file appears whole or not at all.

    spherical_harmonics_rest: add the 45 zero `f_rest_*` fields that some importers (Unity) insist on.
    """
    import plyfile

    means, quats, scales, opacities, colors = plain_arrays(gaussians)
    p = np.clip(opacities, OPACITY_MARGIN, 1 - OPACITY_MARGIN)
    columns = dict(zip("xyz", means.T, strict=True))
    columns |= {f"n{axis}": np.zeros(len(means)) for axis in "xyz"}
    columns |= {f"f_dc_{i}": sh_of(colors)[:, i] for i in range(3)}
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
