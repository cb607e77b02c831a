"""`.splat` (https://github.com/antimatter15/splat): 32 bytes a Gaussian.

Position and scales in float32, RGBA and quaternion wxyz in uint8, the largest and most opaque first.
"""

import os

import numpy as np

from humangs_jax.avatar.export.world import plain_arrays
from humangs_jax.io.atomic import write_bytes
from humangs_jax.rendering.gaussians import Gaussians


def write_splat(path: str | os.PathLike, gaussians: Gaussians) -> None:
    """Write a `.splat`; the file appears whole or not at all. Colors and opacities lose to 8 bits, quaternions to 7."""
    means, quats, scales, opacities, colors = plain_arrays(gaussians)
    rows = np.empty(len(means), [("position", "<f4", 3), ("scale", "<f4", 3), ("rgba", "u1", 4), ("rotation", "u1", 4)])
    rows["position"], rows["scale"] = means, scales
    rows["rgba"] = np.rint(255 * np.clip(np.concatenate([colors, opacities[:, None]], axis=1), 0, 1))
    rows["rotation"] = np.clip(np.rint(128 * quats + 128), 0, 255)
    order = np.argsort(-opacities * scales.prod(axis=1), kind="stable")  # viewers draw the first while the rest loads
    write_bytes(path, rows[order].tobytes())
