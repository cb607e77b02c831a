"""`.splat` (https://github.com/antimatter15/splat): 32 bytes a Gaussian, position and scales in float32, RGBA and quaternion wxyz
in uint8, the largest and most opaque first. It has no header.
"""

import os

import numpy as np

from humangs_jax.avatar.export.gaussians import loaded, plain_arrays
from humangs_jax.io.atomic import write_bytes
from humangs_jax.io.reading import Refused, check_limit
from humangs_jax.rendering.gaussians import Gaussians

ROW = [("position", "<f4", 3), ("scale", "<f4", 3), ("rgba", "u1", 4), ("rotation", "u1", 4)]
ROW_BYTES = 32


def write_splat(path: str | os.PathLike[str], gaussians: Gaussians) -> None:
    """Write a `.splat`; the file appears whole or not at all. Colors and opacities lose to 8 bits, quaternions to 7.

    Raises: ValueError for Gaussians with harmonics.
    """
    means, quats, scales, opacities, colors, harmonics = plain_arrays(gaussians)
    if harmonics.size:
        raise ValueError(
            f"{path}: .splat holds one color for each Gaussian: expected no harmonics (replace(gaussians, harmonics=None))"
        )
    rows = np.empty(len(means), ROW)
    rows["position"], rows["scale"] = means, scales
    rows["rgba"] = np.rint(255 * np.clip(np.concatenate([colors, opacities[:, None]], axis=1), 0, 1))
    rows["rotation"] = np.clip(np.rint(128 * quats + 128), 0, 255)
    order = np.argsort(-opacities * scales.prod(axis=1), kind="stable")  # viewers draw the first while the rest loads
    write_bytes(path, rows[order].tobytes())


def read_splat(data: bytes) -> Gaussians:
    """Gaussians of the bytes of a file. Raises: Refused."""
    check_limit("gaussians", len(data) // ROW_BYTES, "Gaussians")
    if not data or len(data) % ROW_BYTES:
        raise Refused(f"no .splat file: expected {ROW_BYTES} bytes for each Gaussian, got {len(data):,}")
    rows = np.ndarray((len(data) // ROW_BYTES,), ROW, data)
    rgba = rows["rgba"] / 255
    arrays = {
        "position": rows["position"],
        "rotation": (rows["rotation"] - 128.0) / 128,
        "scale": rows["scale"],
        "opacity": rgba[:, 3],
        "color": rgba[:, :3],
    }
    return loaded(arrays)
