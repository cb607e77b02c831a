"""Small scenes for tests of splatting, with difficult Gaussians.

No tile size divides the image.
"""

import jax
import jax.numpy as jnp
import numpy as np

from humangs_jax.core.pytree import replace
from humangs_jax.geometry.camera import Camera
from humangs_jax.rendering.gaussians import Gaussians
from humangs_jax.rendering.tiling import TileGrid

WIDTH, HEIGHT = 21, 13
COUNT = 32


def random_gaussians(seed, dtype=np.float64, count=COUNT) -> Gaussians:
    """Returns Gaussians 2 to 4 m before the camera at the origin.

    Most are blobs; a few of each difficult kind are among them.
    """
    rng = np.random.default_rng(seed)
    z = rng.uniform(2, 4, count)
    means = np.stack(
        [rng.uniform(-1.2, 1.2, count) * z / 2, rng.uniform(-1.2, 1.2, count) * z / 3, z], axis=-1
    )
    scales = np.exp(rng.uniform(np.log(0.01), np.log(0.5), (count, 3)))
    opacities = rng.uniform(0, 1, count)
    means[:6, :2] *= 0.1  # an opaque stack: reaches the stop and the clamp of alpha
    scales[:6], opacities[:6] = 0.3, [1, 0.9995, 0.99, 0.95, 0.9, 0.9]
    scales[6:9] = [2.0, 0.002, 0.002]  # needles across the image
    means[9, 2], means[10, 2] = -2.0, 0.011  # behind the camera; just beyond the near plane
    scales[11] = 0  # a point: one pixel's worth of eps2d
    scales[12] = 5.0  # a semi-transparent foreground
    opacities[13:15] = [0, 1 / 255 - 1e-4]  # never drawn
    deformations = np.eye(3) + 0.3 * rng.normal(size=(count, 3, 3))
    arrays = (
        means,
        rng.normal(size=(count, 4)),
        scales,
        opacities,
        rng.uniform(0, 1, (count, 3)),
        deformations,
    )
    return Gaussians(*(jnp.asarray(a, dtype) for a in arrays))


def with_harmonics(gaussians: Gaussians, count: int) -> Gaussians:
    """Returns the Gaussians with harmonics, some of whose colors are negative and drawn as 0."""
    values = np.random.default_rng(count).normal(size=(len(gaussians.means), count, 3))
    return replace(gaussians, harmonics=jnp.asarray(values, gaussians.means.dtype))


def camera(dtype=np.float64, width=WIDTH, height=HEIGHT) -> Camera:
    """Returns a camera near the origin that looks along z, a little turned and off centre."""
    K = jnp.asarray([[22.0, 0, 0.52 * width], [0, 24.0, 0.45 * height], [0, 0, 1]], dtype)
    angle = 0.05
    pose = np.eye(4)
    pose[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    pose[:3, 3] = [0.05, -0.02, 0.1]
    return Camera(K, jnp.asarray(pose, dtype), width, height)


def tile_centers(grid: TileGrid) -> np.ndarray:
    """Returns x and y (t, 2) of the tiles' centres, pixels."""
    rows, columns = np.divmod(np.arange(grid.tiles), grid.columns)
    return (np.stack([columns, rows], axis=-1) + 0.5) * grid.tile_size


def few(gaussians: Gaussians, indices: np.ndarray) -> Gaussians:
    """Returns some of the Gaussians, or all in another order."""
    return jax.tree.map(lambda leaf: jnp.asarray(np.asarray(leaf)[indices]), gaussians)
