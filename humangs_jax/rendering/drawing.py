"""One image: projected Gaussians -> depth order -> lists by tile -> composited tiles -> image over a background.

The pure function behind `splatting.render`, in two halves (`projection.project_gaussians`, `draw_projected`) for those who
look at what lies between them.
"""

import dataclasses
from collections.abc import Sequence
from numbers import Real

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from humangs_jax.core.array_types import Array, Float, Int
from humangs_jax.core.numerics import at_least_float32, safe_divide
from humangs_jax.core.pytree import Batchable, pytree_dataclass
from humangs_jax.geometry.camera import Camera
from humangs_jax.io.images import contact_sheet, named_color, png_bytes
from humangs_jax.rendering import binning
from humangs_jax.rendering.buffers import warn_of_overflow, with_default_buffers
from humangs_jax.rendering.compositing import composite, pack_splats
from humangs_jax.rendering.gaussians import Gaussians
from humangs_jax.rendering.projection import ProjectedGaussians, drawn_camera, project_gaussians
from humangs_jax.rendering.schedules.splat_rows import FEATURE_COUNT
from humangs_jax.rendering.splat_config import DEFAULT_CONFIG, SplatConfig
from humangs_jax.rendering.tiling import TileGrid, sort_into_tiles, take, tiles_to_image


@pytree_dataclass
class Rendering(Batchable):
    """One image of a set of Gaussians; with leading axes, a batch of images.

    rgb: (h, w, 3) over the background. alpha: (h, w) in [0, 1). depth: (h, w) mean z of what is seen, weighted as the
    colors are, metres; 0 where alpha is 0. overflow: (splat, tile) pairs that did not fit in the buffers and were not
    drawn. visibility: (g,) the largest weight alpha T of each Gaussian on any pixel, 0 if it is hidden; not
    differentiable; None unless `SplatConfig.visibility`.
    """

    rgb: Float[Array, "h w 3"]
    alpha: Float[Array, "h w"]
    depth: Float[Array, "h w"]
    overflow: Int[Array, ""]
    visibility: Float[Array, " g"] | None = None

    def _repr_png_(self) -> bytes:
        """The image, or those of a batch side by side, for notebooks."""
        images = np.asarray(self.rgb)
        return png_bytes(contact_sheet(images.reshape(-1, *images.shape[-3:]), images.shape[-3]))


Background = Float[Array, "3"] | Float[np.ndarray, "3"] | Sequence[float | int] | str | None
"""(3,) RGB, three numbers in [0, 1], a CSS name or "#rrggbb"; None: white."""


def with_background(
    gaussians: Gaussians, cameras: Camera, background: Background
) -> tuple[Gaussians, Camera, Float[Array, "3"]]:
    """What is drawn, in float32 at least. Raises: ValueError for a background that is no color."""
    return at_least_float32((gaussians, cameras, _color(background, gaussians.means.dtype)))


def _color(background, dtype):
    if background is None:
        return jnp.ones(3, dtype)
    if isinstance(background, str):
        return jnp.asarray(named_color(background), dtype)
    if hasattr(background, "shape"):
        color, fits = background, background.shape == (3,)
    else:
        color = background
        fits = isinstance(background, Sequence) and len(background) == 3
        fits = fits and all(isinstance(x, jax.Array) or (isinstance(x, Real) and 0 <= x <= 1) for x in background)
    if not fits:
        shown = f"shape {color.shape}" if hasattr(color, "shape") else repr(color)
        raise ValueError(f"background: expected 3 numbers in [0, 1] or the name of a color, got {shown}")
    return color if isinstance(color, jax.Array) else jnp.asarray(color, dtype)


def draw_projected(
    projected: ProjectedGaussians,
    gaussians: Gaussians,
    camera: Camera,
    config: SplatConfig = DEFAULT_CONFIG,
    background: Background = None,
) -> Rendering:
    """The second half of `render`, for use inside transformations.

    projected: by `project_gaussians`, of these Gaussians, camera and config. Of the Gaussians only opacities and colors
    are read here. background: as `Background`.
    """
    gaussians, camera, background = with_background(gaussians, camera, background)
    config = with_default_buffers(gaussians, camera, config)
    rendering = _draw(projected, gaussians, camera, background, config)
    warn_of_overflow(rendering.overflow, config)
    return rendering


def draw(gaussians: Gaussians, camera: Camera, background: Float[Array, "3"], config: SplatConfig) -> Rendering:
    """`splatting.render` with buffers that are decided, `config.max_pairs`: pure, and without checks."""
    return _draw(project_gaussians(gaussians, camera, config), gaussians, camera, background, config)


def draw_views(gaussians: Gaussians, cameras: Camera, background: Float[Array, "3"], config: SplatConfig) -> Rendering:
    """`draw` for every camera of a batch, one after the other."""
    return lax.map(lambda camera: draw(gaussians, camera, background, config), cameras)


def _draw(projected, gaussians, camera, background, config: SplatConfig) -> Rendering:
    if config.scale != 1:
        small = dataclasses.replace(config, scale=1.0)
        drawn = _draw(projected, gaussians, drawn_camera(camera, config), background, small)
        return _resized(drawn, camera)
    grid = TileGrid(camera.width, camera.height, config.tile_size)
    if gaussians.means.shape[0] == 0:
        blank = jnp.zeros((grid.tiles, FEATURE_COUNT, grid.pixels), projected.x.dtype)
        visibility = jnp.zeros(0, blank.dtype) if config.visibility else None
        return _blended(blank, 1 + blank[:, :1], grid, background, 0.0, jnp.int32(0), visibility)

    depths = jnp.where(projected.visible, lax.stop_gradient(projected.depths), jnp.inf)
    order = binning.depth_order(depths)
    opacities = projected.dimmed(gaussians.opacities)
    footprints = binning.footprints_by(projected, opacities, config)
    footprints = jax.tree.map(lambda plane: take(plane, order), footprints)

    # Depths are blended relative to the nearest: their gradient is a difference of depths, which must not drown in the
    # rounding of depths.
    nearest = jnp.min(depths)
    nearest = jnp.where(nearest < jnp.inf, nearest, 0.0)
    behind = jnp.where(projected.visible, projected.depths - nearest, 0.0)
    seen = jnp.concatenate([gaussians.colors, behind[:, None]], axis=-1)
    splats = pack_splats(projected, opacities, seen, config.alpha_min)
    splats = splats.at[order].get(unique_indices=True, mode="promise_in_bounds")
    features, transmittance, peaks, overflow = _draw_tiles(footprints, splats, grid, config)
    visibility = jnp.zeros_like(peaks).at[order].set(peaks, unique_indices=True) if config.visibility else None
    return _blended(features, transmittance, grid, background, nearest, overflow, visibility)


def _draw_tiles(footprints, splats, grid: TileGrid, config: SplatConfig):
    """Tiles of premultiplied features (t, 4, p) and the final T (t, 1, p), largest weights (g,), overflow.

    Footprints and splats in depth order.
    """
    assert config.max_pairs is not None  # callers have fitted the buffers
    pairs = binning.emit_pairs(footprints, grid, config.max_rows or config.max_pairs, config.max_pairs)
    lists = sort_into_tiles(pairs.tiles, pairs.splats, grid.tiles, splats.shape[0])
    features, transmittance, peaks = composite(splats, lists, grid, config)
    return features, transmittance[:, None], lax.stop_gradient(peaks), pairs.overflow


def _blended(features, transmittance, grid, background, nearest, overflow, visibility) -> Rendering:
    """features: (t, 4, p) premultiplied rgb and z - nearest. transmittance: (t, 1, p) the final one.

    Tile by tile, and each output on its own: an output that nobody reads then costs nothing, nor does its gradient.
    """
    alpha = 1 - transmittance
    rgb = features[:, :3] + transmittance * background[:, None]
    depth = jnp.where(alpha > 0, nearest + safe_divide(features[:, 3:], alpha), 0.0)
    rgb, alpha, depth = (tiles_to_image(tiles, grid) for tiles in (rgb, alpha, depth))
    return Rendering(rgb, alpha[..., 0], depth[..., 0], overflow, visibility)


def _resized(rendering: Rendering, camera: Camera) -> Rendering:
    """The image at the camera's size; depth is weighted by alpha."""
    r = rendering
    premultiplied = jnp.concatenate([r.rgb, r.alpha[..., None], (r.alpha * r.depth)[..., None]], axis=-1)
    image = _resampled(_resampled(premultiplied, camera.height, 0), camera.width, 1)
    alpha = image[..., 3]
    return Rendering(image[..., :3], alpha, safe_divide(image[..., 4], alpha), r.overflow, r.visibility)


def _resampled(image, size: int, axis: int):
    """Linear interpolation between pixels along one axis, constant beyond the outer ones.

    As `jax.image.resize`, whose matrix products take 14 times as long on a CPU.
    """
    count = image.shape[axis]
    at = ((np.arange(size) + 0.5) * (count / size) - 0.5).clip(0, count - 1)
    first = np.floor(at).astype(np.int32)
    fraction = np.expand_dims(at - first, [i for i in range(image.ndim) if i != axis]).astype(image.dtype)
    neighbours = (jnp.asarray(i) for i in (first, np.minimum(first + 1, count - 1)))
    a, b = (jnp.moveaxis(take(jnp.moveaxis(image, axis, 0), i), 0, axis) for i in neighbours)
    return a + fraction * (b - a)
