"""Differentiable 3D Gaussian splatting in plain JAX, for CPU, GPU and TPU, under `jit`, `vmap` and `grad`.

    rendering = render(gaussians, camera)                # eager: the buffers are sized to the scene
    config = plan_buffers(gaussians, cameras)                    # for calls inside jit, vmap, grad: sized once
    loss = lambda gaussians: jnp.mean((render(gaussians, camera, config).rgb - photo) ** 2)

Projection, depth order, (tile, splat) pairs, lists by tile, compositing: each has its module. `dense` draws the same
image by the definition. Gradients (reverse mode only) reach means, quats, scales, opacities, colors, deformations, the
background, and K and cam_from_world of the camera.

One XLA program runs on one CPU core here. `mesh` shares an image out among devices, which a CPU has as many of as
`jax.config.update("jax_num_cpu_devices", 2)` says before JAX is first used.
"""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.core import Tracer
from jax.sharding import Mesh
from jax.sharding import PartitionSpec as P

from humangs_jax.core.array_types import Array, Bool, Float, Int
from humangs_jax.core.buffers import round_up
from humangs_jax.core.numerics import at_least_float32, safe_divide
from humangs_jax.core.pytree import Batchable, pytree_dataclass
from humangs_jax.geometry.camera import Camera
from humangs_jax.rendering import binning, constants
from humangs_jax.rendering.compositing import composite, pack_splats
from humangs_jax.rendering.gaussians import Gaussians
from humangs_jax.rendering.projection import ProjectedGaussians, project, squared_reach
from humangs_jax.rendering.schedules.splat_rows import FEATURE_COUNT
from humangs_jax.rendering.splat_config import DEFAULT_CONFIG, SplatConfig
from humangs_jax.rendering.tiling import TileGrid, sort_into_tiles, take, tiles_to_image

__all__ = [
    "BufferOverflowError",
    "Rendering",
    "SplatConfig",
    "default_pairs",
    "draw_projected",
    "plan_buffers",
    "project_gaussians",
    "render",
    "render_views",
    "seen_from",
]

CPU_COMPILER_OPTIONS = {
    "xla_cpu_prefer_vector_width": 512,
    "xla_disable_hlo_passes": "cpu-parallel-task-assigner,cse_barrier_expander,small-while-loop-hoisting",
}
"""`jax.jit(..., compiler_options=CPU_COMPILER_OPTIONS)` of a program that draws on a CPU: wide vectors make the loops over
pixels up to a third faster where there is AVX-512; XLA no longer shares out their small kernels, tens of microseconds each,
over several threads, which took twice the CPU time and gained nothing; and it keeps barriers, so that tables are stored
before they are gathered from (the loops of tiny images must then not become single kernels, which know no barriers).
Eager calls use it; options do not reach a jit inside a jit, so your own needs them itself. Works from jax 0.10 to 0.12."""

PAIRS_PER_GAUSSIAN, PAIRS_PER_TILE = 12, 16
"""Default capacity of traced calls. A person of 50,000 Gaussians needs 6 tiles per Gaussian at 512 x 512 and 15 at 1024
x 1024, where its 16,384 tiles add another 5 each."""


class BufferOverflowError(ValueError):
    """A view needs larger buffers than its configuration has."""


@pytree_dataclass
class Rendering(Batchable):
    """One image of a set of Gaussians.

    rgb: (h, w, 3) over the background. alpha: (h, w) in [0, 1). depth: (h, w) mean z of what is seen, weighted as the
    colours are, metres; 0 where alpha is 0. overflow: (splat, tile) pairs that did not fit in the buffers and were not
    drawn. visibility: (g,) the largest weight alpha T of each Gaussian on any pixel, 0 if it is hidden; not
    differentiable; None unless `SplatConfig.visibility`.
    """

    rgb: Float[Array, "h w 3"]
    alpha: Float[Array, "h w"]
    depth: Float[Array, "h w"]
    overflow: Int[Array, ""]
    visibility: Float[Array, " g"] | None = None


def render(
    gaussians: Gaussians,
    camera: Camera,
    config: SplatConfig = DEFAULT_CONFIG,
    background: Float[Array, "3"] | None = None,
    mesh: Mesh | None = None,
) -> Rendering:
    """Draws Gaussians as one camera sees them.

    background: (3,) RGB; None: white. mesh: of one axis, whose devices share the image's rows of tiles; None: one
    device draws it all.

    Raises: BufferOverflowError if an eager call overflows `config.max_pairs` or `max_rows`. Inside a transformation the
    missing pairs are counted in `Rendering.overflow` instead.
    """
    background = _white(gaussians) if background is None else background
    gaussians, camera, background = at_least_float32((gaussians, camera, background))
    if _is_traced(gaussians, camera, background):
        gaussians = jax.tree.map(lambda leaf: _once_per_image(leaf, camera), gaussians)
        return _render(gaussians, camera, background, _with_default_buffers(gaussians, camera, config), mesh)
    fitted = plan_buffers(gaussians, camera, config, margin=1.0, mesh=mesh) if config.max_pairs is None else config
    rendering = _jitted(_render, 3, 4)(gaussians, camera, background, fitted, mesh)
    _check_overflow(rendering, gaussians, camera, fitted, mesh)
    return rendering


def render_views(
    gaussians: Gaussians,
    cameras: Camera,
    config: SplatConfig = DEFAULT_CONFIG,
    background: Float[Array, "3"] | None = None,
    batch_size: int = 1,
    mesh: Mesh | None = None,
) -> Rendering:
    """Draws every camera of a batch (leading axis v), `batch_size` views at a time: working memory does not
    grow with v (what a gradient keeps of each view does).

    `jax.vmap` of `render` draws all views at once (their tiles become one list of tiles) and holds the buffers of all: on
    CPUs as fast, with gradients of many views slower. mesh: of one axis, whose devices share each image.

    Returns a Rendering with a leading axis v. Raises: as `render`.
    """
    background = _white(gaussians) if background is None else background
    gaussians, cameras, background = at_least_float32((gaussians, cameras, background))
    if _is_traced(gaussians, cameras, background):
        fitted = _with_default_buffers(gaussians, cameras, config)
        return _render_views(gaussians, cameras, background, fitted, batch_size, mesh)
    fitted = plan_buffers(gaussians, cameras, config, margin=1.0, mesh=mesh) if config.max_pairs is None else config
    renderings = _jitted(_render_views, 3, 4, 5)(gaussians, cameras, background, fitted, batch_size, mesh)
    _check_overflow(renderings, gaussians, cameras, fitted, mesh)
    return renderings


def seen_from(
    gaussians: Gaussians, cameras: Camera, config: SplatConfig = DEFAULT_CONFIG, threshold: float = constants.ALPHA_MIN
) -> Bool[Array, " g"]:
    """Which Gaussians weigh at least `threshold` on some pixel of some camera (leading axis v).

    The others can be left out for cameras like these: an avatar's inside is never seen.
    """
    visibility = render_views(gaussians, cameras, dataclasses.replace(config, visibility=True)).visibility
    assert visibility is not None
    return jnp.max(visibility, axis=0) >= threshold


def default_pairs(g: int, width: int, height: int, tile_size: int = 8) -> int:
    """`max_pairs` of a traced call that gives None: enough for a person, never more than can be needed."""
    tiles = TileGrid(width, height, tile_size).tiles
    return max(1, min(g * tiles, PAIRS_PER_GAUSSIAN * g + PAIRS_PER_TILE * tiles))


def plan_buffers(
    gaussians: Gaussians,
    cameras: Camera,
    config: SplatConfig = DEFAULT_CONFIG,
    margin: float = 1.25,
    mesh: Mesh | None = None,
) -> SplatConfig:
    """`config` with buffers for one camera, or for the most demanding one of a batch, times `margin`.

    Sizes are rounded up to (4, 5, 6 or 7) 2^i, so that similar scenes share one compilation. Measures concrete arrays:
    call it outside of transformations. mesh: the one that `render` will be given, if any.
    """
    gaussians, cameras = at_least_float32((gaussians, cameras))
    needed = _needed(gaussians, cameras, _without_buffers(config), _shares(mesh))
    rows, pairs = (round_up(int(int(most) * margin)) for most in needed)
    return dataclasses.replace(config, max_rows=rows, max_pairs=pairs)


def project_gaussians(gaussians: Gaussians, camera: Camera, config: SplatConfig = DEFAULT_CONFIG) -> ProjectedGaussians:
    """The first half of `render`: Gaussians on the image that `config` draws."""
    return _project(*at_least_float32((gaussians, _drawn_camera(camera, config))), config)


def draw_projected(
    projected: ProjectedGaussians,
    gaussians: Gaussians,
    camera: Camera,
    config: SplatConfig = DEFAULT_CONFIG,
    background: Float[Array, "3"] | None = None,
) -> Rendering:
    """The second half of `render`, to look at what lies between them; for use inside transformations.

    projected: of these Gaussians, camera and config; of the Gaussians only opacities and colours are read here.
    """
    background = _white(gaussians) if background is None else background
    gaussians, camera, background = at_least_float32((gaussians, camera, background))
    config = _with_default_buffers(gaussians, camera, config)
    return _draw_projected(projected, gaussians, camera, background, config, None)


def _render(gaussians: Gaussians, camera: Camera, background, config: SplatConfig, mesh: Mesh | None) -> Rendering:
    projected = _project(gaussians, _drawn_camera(camera, config), config)
    return _draw_projected(projected, gaussians, camera, background, config, mesh)


def _draw_projected(projected, gaussians, camera, background, config: SplatConfig, mesh: Mesh | None) -> Rendering:
    if config.scale != 1:
        return _draw_resized(projected, gaussians, camera, background, config, mesh)
    grid = _grid(camera, config)
    if gaussians.means.shape[0] == 0:
        blank = jnp.zeros((grid.tiles, FEATURE_COUNT, grid.pixels), projected.x.dtype)
        visibility = jnp.zeros(0, blank.dtype) if config.visibility else None
        return _blend(blank, 1 + blank[:, :1], grid, background, 0.0, jnp.int32(0), visibility)

    depths = jnp.where(projected.visible, lax.stop_gradient(projected.depth), jnp.inf)
    order = binning.depth_order(depths)
    footprints = jax.tree.map(lambda plane: take(plane, order), _footprints(projected, gaussians, config))

    # Depths are blended relative to the nearest: their gradient is a difference of depths, which must not drown in the
    # rounding of depths.
    nearest = jnp.min(depths)
    nearest = jnp.where(nearest < jnp.inf, nearest, 0.0)
    behind = jnp.where(projected.visible, projected.depth - nearest, 0.0)
    seen = jnp.concatenate([gaussians.colors, behind[:, None]], axis=-1)
    splats = pack_splats(projected, gaussians.opacities, seen, config.alpha_min)
    splats = splats.at[order].get(unique_indices=True, mode="promise_in_bounds")
    draw = _draw if mesh is None else _draw_shared(mesh)
    features, transmittance, peaks, overflow = draw(footprints, splats, grid, config)
    visibility = jnp.zeros_like(peaks).at[order].set(peaks, unique_indices=True) if config.visibility else None
    return _blend(features, transmittance, grid, background, nearest, overflow, visibility)


@jax.custom_vjp
def _once_per_image(array, camera: Camera):
    """The same array; where `vmap` shares it among cameras, each camera gets its own.

    Its gradient is then summed over the cameras once, and not at each of the dozen operations of the projection that mix
    what is shared with what is not, which on a CPU cost a fifth of the image.
    """
    return _own(array, camera.K)


_once_per_image.defvjp(
    lambda array, camera: (_own(array, camera.K), camera),
    lambda camera, cotangent: (cotangent, jax.tree.map(jnp.zeros_like, camera)),
)


@jax.custom_batching.custom_vmap
def _own(array, of):
    return array


@_own.def_vmap
def _own_in_batch(size, batched, array, of):
    return array if batched[0] else jnp.broadcast_to(array, (size, *array.shape)), True


def _draw(footprints, splats, grid: TileGrid, config: SplatConfig, share: binning.Share = binning.WHOLE):
    """Tiles of premultiplied features (t, 4, p) and the final T (t, 1, p), largest weights (g,), overflow.

    Footprints and splats in depth order.
    """
    assert config.max_pairs is not None  # callers have fitted the buffers
    pairs = binning.emit_pairs(footprints, grid, config.max_rows or config.max_pairs, config.max_pairs, share)
    lists = sort_into_tiles(pairs.tiles, pairs.splats, grid.tiles, splats.shape[0])
    features, transmittance, peaks = composite(splats, lists, grid, config)
    return features, transmittance[:, None], lax.stop_gradient(peaks), pairs.overflow


def _draw_shared(mesh: Mesh):
    """`_draw`, each device its share of the rows of tiles: interleaved, so that all have like work."""
    (axis,), n = mesh.axis_names, mesh.size
    mesh = Mesh(mesh.devices, mesh.axis_names)  # automatic axes: the compiler shards what lies outside of `one`

    def draw(footprints, splats, grid: TileGrid, config: SplatConfig):
        each = -(-grid.rows // n)

        def one(footprints, splats):
            share = binning.Share(lax.axis_index(axis), n)
            *tiles, peaks, overflow = _draw(footprints, splats, grid, config, share)
            return [own_rows(t, share.index) for t in tiles], lax.pmax(peaks, axis), lax.psum(overflow, axis)

        def own_rows(tiles, index):
            tiles = jnp.pad(tiles, ((0, (each * n - grid.rows) * grid.columns), (0, 0), (0, 0)))
            return tiles.reshape(each, n, grid.columns, *tiles.shape[1:])[:, index]

        def joined(rows):
            tiles = rows.reshape(n, each, *rows.shape[1:]).swapaxes(0, 1).reshape(-1, *rows.shape[2:])
            return tiles[: grid.tiles]

        shared = jax.shard_map(
            one, mesh=mesh, in_specs=P(), out_specs=(P(axis), P(), P()), check_vma=False, axis_names={axis}
        )
        tiles, peaks, overflow = shared(footprints, splats)
        return *map(joined, tiles), peaks, overflow

    return draw


def _draw_resized(projected, gaussians, camera, background, config, mesh) -> Rendering:
    small = dataclasses.replace(config, scale=1.0)
    r = _draw_projected(projected, gaussians, _drawn_camera(camera, config), background, small, mesh)
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


def _drawn_camera(camera: Camera, config: SplatConfig) -> Camera:
    if config.scale == 1:
        return camera
    return camera.resized(*(max(1, round(size * config.scale)) for size in (camera.width, camera.height)))


def _grid(camera: Camera, config: SplatConfig) -> TileGrid:
    return TileGrid(camera.width, camera.height, config.tile_size)


def _shares(mesh: Mesh | None) -> int:
    if mesh is None:
        return 1
    if len(mesh.axis_names) != 1:
        raise ValueError(f"the mesh must have one axis, got {mesh.axis_names}")
    return mesh.size


def _blend(features, transmittance, grid, background, nearest, overflow, visibility) -> Rendering:
    """features: (t, 4, p) premultiplied rgb and z - nearest. transmittance: (t, 1, p) the final one.

    Tile by tile, and each output on its own: an output that nobody reads then costs nothing, nor does its gradient.
    """
    alpha = 1 - transmittance
    rgb = features[:, :3] + transmittance * background[:, None]
    depth = jnp.where(alpha > 0, nearest + safe_divide(features[:, 3:], alpha), 0.0)
    rgb, alpha, depth = (tiles_to_image(tiles, grid) for tiles in (rgb, alpha, depth))
    return Rendering(rgb, alpha[..., 0], depth[..., 0], overflow, visibility)


def _render_views(gaussians, cameras, background, config, batch_size, mesh):
    one = lambda camera: _render(gaussians, camera, background, config, mesh)
    return lax.map(one, cameras, batch_size=batch_size if batch_size > 1 else None)


@functools.cache
def _jitted(function, *static):
    options = CPU_COMPILER_OPTIONS if jax.default_backend() == "cpu" else None
    return jax.jit(function, static_argnums=static, compiler_options=options)


def _project(gaussians, camera, config) -> ProjectedGaussians:
    return project(
        gaussians, camera, config.near, config.eps2d, config.jacobian_margin, normalize_quats=config.normalize_quats
    )


def _footprints(projected, gaussians, config) -> binning.Footprints | binning.Squares:
    reach = squared_reach(gaussians.opacities, config.alpha_min)
    reach = jnp.where(gaussians.opacities >= config.opacity_min, reach, 0.0)
    if config.square:
        return binning.square_footprints(projected, reach, config.radius_sigma)
    return binning.footprints(
        projected, reach if config.radius_sigma is None else jnp.minimum(reach, config.radius_sigma**2)
    )


@functools.partial(jax.jit, static_argnums=(2, 3))
def _needed(gaussians, cameras, config, shares):
    """Most rows and most pairs that any of the views needs, on any of the devices that share them."""

    def one(camera):
        camera = _drawn_camera(camera, config)
        footprints = _footprints(_project(gaussians, camera, config), gaussians, config)
        counts = (
            binning.count_pairs(footprints, _grid(camera, config), binning.Share(i, shares)) for i in range(shares)
        )
        return [jnp.max(jnp.stack(most)) for most in zip(*counts, strict=True)]

    if cameras.K.ndim == 2:
        return one(cameras)
    return [jnp.max(most, initial=0) for most in lax.map(one, cameras)]


def _check_overflow(rendering, gaussians, cameras, config, mesh):
    if overflow := int(jnp.max(rendering.overflow, initial=0)):
        rows, pairs = (int(most) for most in _needed(gaussians, cameras, _without_buffers(config), _shares(mesh)))
        raise BufferOverflowError(
            f"{overflow} (splat, tile) pairs of a view did not fit: it needs max_pairs >= {pairs} "
            f"and max_rows >= {rows}, got max_pairs = {config.max_pairs}, max_rows = {config.max_rows}"
        )


def _with_default_buffers(gaussians, camera, config):
    if config.max_pairs is not None:
        return config
    drawn = _drawn_camera(camera, config)
    pairs = default_pairs(gaussians.means.shape[0], drawn.width, drawn.height, config.tile_size)
    return dataclasses.replace(config, max_pairs=pairs)


def _without_buffers(config):
    return dataclasses.replace(config, max_pairs=None, max_rows=None)


def _is_traced(*trees):
    return any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(trees))


def _white(gaussians):
    return jnp.ones(3, gaussians.means.dtype)
