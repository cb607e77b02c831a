"""Differentiable 3D Gaussian splatting in plain JAX, for CPU, GPU and TPU, under `jit`, `vmap` and `grad`.

    rendering = render(gaussians, camera)                # eager: the buffers are sized to the scene
    config = fit_config(gaussians, camera)               # for calls inside jit, vmap, grad: sized once
    loss = lambda gaussians: jnp.mean((render(gaussians, camera, config).rgb - photo) ** 2)

Projection, depth order, (tile, splat) pairs, lists by tile, compositing: each has its module. `dense` draws the same
image by the definition. Gradients (reverse mode only) reach means, quats, scales, opacities, colors, deformations, the
background, and K and cam_from_world of the camera.
"""

import dataclasses
import functools

import jax
import jax.numpy as jnp
from jax import lax
from jax.core import Tracer

from humangs_jax.array_types import Array, Float, Int
from humangs_jax.capacity import round_up
from humangs_jax.geometry.camera import Camera
from humangs_jax.numerics import at_least_float32, safe_divide
from humangs_jax.pytree import pytree_dataclass
from humangs_jax.rendering import binning
from humangs_jax.rendering.compositing import composite, pack_splats
from humangs_jax.rendering.gaussians import Gaussians
from humangs_jax.rendering.projection import ProjectedGaussians, project, squared_reach
from humangs_jax.rendering.splat_config import DEFAULT_CONFIG, SplatConfig
from humangs_jax.rendering.tiling import TileGrid, sort_into_tiles, tiles_to_image

__all__ = ["Rendering", "SplatConfig", "default_pairs", "fit_config", "render", "render_views"]

CPU_COMPILER_OPTIONS = {
    "xla_cpu_prefer_vector_width": 512,
    "xla_disable_hlo_passes": "cpu-parallel-task-assigner,cse_barrier_expander",
}
"""`jax.jit(..., compiler_options=CPU_COMPILER_OPTIONS)` of a program that draws on a CPU: wide vectors make the loops over
pixels up to a third faster where there is AVX-512, and XLA no longer shares out their small kernels, tens of
microseconds each, over several threads, which took twice the CPU time and gained nothing. Eager calls use it; options do
not reach a jit inside a jit, so your own needs them itself."""

PAIRS_PER_GAUSSIAN, PAIRS_PER_TILE = 12, 16
"""Default capacity of traced calls. A person of 50,000 Gaussians needs 6 tiles per Gaussian at 512 x 512 and 15 at 1024
x 1024, where its 16,384 tiles add another 5 each."""


@pytree_dataclass
class Rendering:
    """One image of a set of Gaussians.

    rgb: (h, w, 3) over the background. alpha: (h, w) in [0, 1). depth: (h, w) mean z of what is seen, weighted as the
    colours are, metres; 0 where alpha is 0. overflow: (splat, tile) pairs that did not fit in the buffers and were not
    drawn.
    """

    rgb: Float[Array, "h w 3"]
    alpha: Float[Array, "h w"]
    depth: Float[Array, "h w"]
    overflow: Int[Array, ""]


def render(
    gaussians: Gaussians,
    camera: Camera,
    config: SplatConfig = DEFAULT_CONFIG,
    background: Float[Array, "3"] | None = None,
) -> Rendering:
    """Draws Gaussians as one camera sees them.

    background: (3,) RGB; None: white.

    Raises: ValueError if an eager call overflows `config.max_pairs` or `max_rows`. Inside a transformation the missing
    pairs are counted in `Rendering.overflow` instead.
    """
    background = _white(gaussians) if background is None else background
    gaussians, camera, background = at_least_float32((gaussians, camera, background))
    if _is_traced(gaussians, camera, background):
        return _render(gaussians, camera, background, _with_default_buffers(gaussians, camera, config))
    fitted = fit_config(gaussians, camera, config, margin=1.0) if config.max_pairs is None else config
    rendering = _jitted(_render, 3)(gaussians, camera, background, fitted)
    _check_overflow(rendering, gaussians, camera, fitted)
    return rendering


def render_views(
    gaussians: Gaussians,
    cameras: Camera,
    config: SplatConfig = DEFAULT_CONFIG,
    background: Float[Array, "3"] | None = None,
    batch_size: int = 1,
) -> Rendering:
    """Draws every camera of a batch (leading axis v), `batch_size` views at a time: memory does not grow with v.

    `jax.vmap` of `render` draws all views at once (their tiles become one list of tiles): as fast, a fifth faster with
    gradients, but it holds the buffers of all views.

    Returns a Rendering with a leading axis v. Raises: as `render`.
    """
    background = _white(gaussians) if background is None else background
    gaussians, cameras, background = at_least_float32((gaussians, cameras, background))
    if _is_traced(gaussians, cameras, background):
        return _render_views(
            gaussians, cameras, background, _with_default_buffers(gaussians, cameras, config), batch_size
        )
    fitted = fit_config(gaussians, cameras, config, margin=1.0) if config.max_pairs is None else config
    renderings = _jitted(_render_views, 3, 4)(gaussians, cameras, background, fitted, batch_size)
    _check_overflow(renderings, gaussians, cameras, fitted)
    return renderings


def default_pairs(g: int, width: int, height: int, tile_size: int = 8) -> int:
    """`max_pairs` of a traced call that gives None: enough for a person, never more than can be needed."""
    tiles = TileGrid(width, height, tile_size).tiles
    return max(1, min(g * tiles, PAIRS_PER_GAUSSIAN * g + PAIRS_PER_TILE * tiles))


def fit_config(
    gaussians: Gaussians, camera: Camera, config: SplatConfig = DEFAULT_CONFIG, margin: float = 1.25
) -> SplatConfig:
    """`config` with buffers for this view, or for the largest of a batch of views, times `margin`.

    Sizes are rounded up to 2^i or 1.5 * 2^i, so that similar scenes share one compilation. Measures concrete arrays:
    call it outside of transformations.
    """
    gaussians, camera = at_least_float32((gaussians, camera))
    rows, pairs = (round_up(int(int(most) * margin)) for most in _needed(gaussians, camera, _without_buffers(config)))
    return dataclasses.replace(config, max_rows=rows, max_pairs=pairs)


def _render(gaussians: Gaussians, camera: Camera, background, config: SplatConfig) -> Rendering:
    grid = TileGrid(camera.width, camera.height, config.tile_size)
    projected = _project(gaussians, camera, config)
    if gaussians.means.shape[0] == 0:
        blank = jnp.zeros((grid.height, grid.width, 5), projected.x.dtype).at[..., 4].set(1)
        return _blend(blank, background, 0.0, jnp.int32(0))

    assert config.max_pairs is not None  # callers have fitted the buffers
    depths = jnp.where(projected.visible, lax.stop_gradient(projected.depth), jnp.inf)
    order = binning.depth_order(depths)
    ellipses = binning.Footprints(*(plane[order] for plane in _footprints(projected, gaussians, config)))
    pairs = binning.emit_pairs(ellipses, grid, config.max_rows or config.max_pairs, config.max_pairs)
    lists = sort_into_tiles(pairs.tiles, pairs.splats, grid.tiles, order.shape[0])

    # Depths are blended relative to the nearest: their gradient is a difference of depths, which must not drown in the
    # rounding of depths.
    nearest = jnp.min(depths)
    nearest = jnp.where(nearest < jnp.inf, nearest, 0.0)
    behind = jnp.where(projected.visible, projected.depth - nearest, 0.0)
    seen = jnp.concatenate([gaussians.colors, behind[:, None]], axis=-1)
    splats = pack_splats(projected, gaussians.opacities, seen, config.alpha_min)
    splats = splats.at[order].get(unique_indices=True, mode="promise_in_bounds")
    features, transmittance = composite(splats, lists, grid, config)
    image = tiles_to_image(jnp.concatenate([features, transmittance[:, None]], axis=1), grid)
    return _blend(image, background, nearest, pairs.overflow)


def _blend(image, background, nearest, overflow) -> Rendering:
    """image: (h, w, 5) premultiplied rgb, premultiplied z - nearest, and the final transmittance."""
    transmittance = image[..., 4]
    alpha = 1 - transmittance
    rgb = image[..., :3] + transmittance[..., None] * background
    depth = jnp.where(alpha > 0, nearest + safe_divide(image[..., 3], alpha), 0.0)
    return Rendering(rgb, alpha, depth, overflow)


def _render_views(gaussians, cameras, background, config, batch_size):
    one = lambda camera: _render(gaussians, camera, background, config)
    return lax.map(one, cameras, batch_size=batch_size if batch_size > 1 else None)


@functools.cache
def _jitted(function, *static):
    options = CPU_COMPILER_OPTIONS if jax.default_backend() == "cpu" else None
    return jax.jit(function, static_argnums=static, compiler_options=options)


def _project(gaussians, camera, config) -> ProjectedGaussians:
    return project(gaussians, camera, config.near, config.dilation, config.jacobian_margin)


def _footprints(projected, gaussians, config) -> binning.Footprints:
    return binning.footprints(projected, squared_reach(gaussians.opacities, config.alpha_min))


@functools.partial(jax.jit, static_argnums=2)
def _needed(gaussians, camera, config):
    """Most rows and most pairs that any of the views needs."""

    def one(camera):
        ellipses = _footprints(_project(gaussians, camera, config), gaussians, config)
        return binning.count_pairs(ellipses, TileGrid(camera.width, camera.height, config.tile_size))

    if camera.K.ndim == 2:
        return one(camera)
    rows, pairs = lax.map(one, camera)
    return jnp.max(rows, initial=0), jnp.max(pairs, initial=0)


def _check_overflow(rendering, gaussians, camera, config):
    if overflow := int(jnp.max(rendering.overflow, initial=0)):
        rows, pairs = (int(most) for most in _needed(gaussians, camera, _without_buffers(config)))
        raise ValueError(
            f"{overflow} (splat, tile) pairs of a view did not fit: it needs max_pairs >= {pairs} "
            f"and max_rows >= {rows}, got max_pairs = {config.max_pairs}, max_rows = {config.max_rows}"
        )


def _with_default_buffers(gaussians, camera, config):
    if config.max_pairs is not None:
        return config
    pairs = default_pairs(gaussians.means.shape[0], camera.width, camera.height, config.tile_size)
    return dataclasses.replace(config, max_pairs=pairs)


def _without_buffers(config):
    return dataclasses.replace(config, max_pairs=None, max_rows=None)


def _is_traced(*trees):
    return any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(trees))


def _white(gaussians):
    return jnp.ones(3, gaussians.means.dtype)
