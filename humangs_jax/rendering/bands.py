"""Large scenes in bounded memory: the image in bands of rows, one after the other, each with buffers of the same size."""

import jax
import jax.numpy as jnp
import numpy as np

from humangs_jax.core.pytree import replace
from humangs_jax.geometry.camera import Camera
from humangs_jax.rendering.buffers import plan_buffers
from humangs_jax.rendering.gaussians import Gaussians
from humangs_jax.rendering.splat_config import DEFAULT_CONFIG, SplatConfig
from humangs_jax.rendering.splatting import Background, Rendering, render

PAIRS = 4_000_000
"""(splat, tile) pairs that are drawn at once: some hundred megabytes."""


def render_in_bands(
    gaussians: Gaussians,
    camera: Camera,
    config: SplatConfig = DEFAULT_CONFIG,
    background: Background = None,
    most_pairs: int = PAIRS,
) -> Rendering:
    """The image of `render`, as arrays of numpy, drawn in as many bands as keep each below `most_pairs`; for calls outside of
    transformations.

    Bands of one row of tiles may still need more: they get it. Configurations whose image depends on its height (a
    `jacobian_margin`, a `scale`, `visibility`) are drawn whole. Raises: as `render`.
    """
    whole = config.jacobian_margin is not None or config.scale != 1 or config.visibility
    planned = plan_buffers(gaussians, camera, config, margin=1.0)
    rows, bands = -(-camera.height // config.tile_size), 1
    cameras = camera
    while not whole and (planned.max_pairs or 0) > most_pairs and bands < rows:
        bands = min(rows, max(bands + 1, -(-bands * (planned.max_pairs or 0) // most_pairs)))
        cameras = banded(camera, -(-rows // bands) * config.tile_size)
        planned = plan_buffers(gaussians, cameras, config, margin=1.0)
    if bands == 1:
        return jax.tree.map(np.asarray, render(gaussians, camera, planned, background))
    drawn = [jax.tree.map(np.asarray, render(gaussians, each, planned, background)) for each in cameras]
    joined = {
        name: np.concatenate([getattr(each, name) for each in drawn])[: camera.height] for name in ("rgb", "alpha", "depth")
    }
    return replace(drawn[0], **joined)


def banded(camera: Camera, height: int) -> Camera:
    """Cameras of the bands of so many rows, from the top; the last may reach beyond the image."""
    tops = np.arange(0, camera.height, height)
    shift = jnp.zeros((len(tops), 3, 3), camera.K.dtype).at[:, 1, 2].set(tops.astype(camera.K.dtype))
    poses = jnp.broadcast_to(camera.cam_from_world, (len(tops), 4, 4))
    return replace(camera, K=camera.K - shift, cam_from_world=poses, height=height)
