"""Differentiable 3D Gaussian splatting in plain JAX, for CPU, GPU and TPU, under `jit`, `vmap` and
`grad` (reverse mode, first derivatives).

Projected Gaussians -> depth order -> lists by tile -> composited tiles -> image over a background.
`reference` draws the same image by the definition. Gradients reach means, quats, scales, opacities,
colors, harmonics, deformations, features, shifts, the background, and K and cam_from_world of the
camera.

Shapes are static, so how many (splat, tile) pairs fit is decided before drawing. A call outside of
transformations measures what its scene needs. A traced call takes the sizes of its configuration,
which `plan_buffers` measures on a similar scene, or else `default_pairs`. Pairs that do not fit are
counted (`Rendering.overflow`), and eager calls raise `BufferOverflowError`.
"""

import dataclasses
import functools
from collections.abc import Callable, Sequence
from numbers import Real
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.core import Tracer

from humangs_jax.core.array_types import Array, Bool, Float, Int
from humangs_jax.core.arrays import from_host
from humangs_jax.core.checks import FINITE, check_values, checked_arguments
from humangs_jax.core.compiled import compiled
from humangs_jax.core.numerics import at_least_float32, safe_divide
from humangs_jax.core.processes import compiler_options
from humangs_jax.core.pytree import Batchable, pytree_dataclass, replace
from humangs_jax.core.records import record_values
from humangs_jax.geometry.camera import Camera
from humangs_jax.io.images import image_row, named_color, png_bytes
from humangs_jax.rendering.buffers import (
    BufferOverflowError,
    plan_buffers,
    raise_on_overflow,
    warn_of_overflow,
    with_default_buffers,
)
from humangs_jax.rendering.compositing import composite
from humangs_jax.rendering.gaussians import Gaussians
from humangs_jax.rendering.projection import ProjectedGaussians, project_gaussians
from humangs_jax.rendering.splat_config import ALPHA_MIN, DEFAULT_CONFIG, SplatConfig, splat_config
from humangs_jax.rendering.splat_rows import pack_splats
from humangs_jax.rendering.tiling import (
    TileGrid,
    depth_order,
    emit_pairs,
    footprints_by,
    radii_on_image,
    sort_into_tiles,
    take,
    tiles_to_image,
)

__all__ = [
    "BufferOverflowError",
    "Rendering",
    "SplatConfig",
    "plan_buffers",
    "render",
    "render_views",
    "visible_gaussians",
]


@pytree_dataclass
class Rendering(Batchable):
    """One image of a set of Gaussians. With leading axes, a batch of images.

    Most fields that may be None are filled only if a field of `SplatConfig` asks for them.
    """

    rgb: Float[Array, "h w 3"]
    """Image over the background, (h, w, 3)."""
    alpha: Float[Array, "h w"]
    """Share of the light that the Gaussians stop, (h, w), in [0, 1)."""
    depth: Float[Array, "h w"]
    """Mean z of the Gaussians that a pixel shows, with the weights of the colors, (h, w), metres; 0
    where alpha is 0.
    """
    overflow: Int[Array, ""]
    """Number of (splat, tile) pairs that did not fit in the buffers and were not drawn."""
    visibility: Float[Array, " g"] | None = None
    """Largest weight alpha T of each Gaussian on any pixel, (g,), 0 if it is hidden. It is not
    differentiable. None unless `SplatConfig.visibility`.
    """
    features: Float[Array, "h w n"] | None = None
    """Features blended with the weights of the colors, over a background of 0, (h, w, n). None
    without features.
    """
    means2d: Float[Array, "g 2"] | None = None
    """Centres on the image, (g, 2), pixels; None unless `SplatConfig.means2d`."""
    radii: Float[Array, "g 2"] | None = None
    """Half the width and height of the footprints, (g, 2), pixels; 0 for Gaussians that are not
    drawn. They are not differentiable. None unless `SplatConfig.radii`.
    """
    depth_sum: Float[Array, "h w"] | None = None
    """Sum of z times weight, (h, w), metres, which is depth times alpha. None unless
    `SplatConfig.depth_sum`.
    """
    depth_median: Float[Array, "h w"] | None = None
    """z of the first Gaussian behind which at most half of the light is left, (h, w), metres; 0
    where more than half passes. It is not differentiable. None unless `SplatConfig.depth_median`.
    """
    distortion: Float[Array, "h w"] | None = None
    """Sum over all i and j of w_i w_j (z_i - z_j)^2, (h, w), squared metres (2DGS,
    https://arxiv.org/abs/2403.17888, eq. 13, with squares). None unless `SplatConfig.distortion`.
    """

    def _repr_png_(self) -> bytes:
        """Returns the bytes of a PNG for notebooks. Images of a batch are side by side."""
        images = np.asarray(self.rgb)
        return png_bytes(image_row(images.reshape(-1, *images.shape[-3:]), images.shape[-3]))


Background = Float[Array, "3"] | Float[np.ndarray, "3"] | Sequence[float | int] | str | None
"""The color of the background: (3,) RGB, three numbers in [0, 1], a CSS name or "#rrggbb". None
means white.
"""


@checked_arguments
def render(
    gaussians: Gaussians,
    camera: Camera,
    config: SplatConfig | str = DEFAULT_CONFIG,
    background: Background = None,
    features: Float[Array, "g n"] | None = None,
    shifts: Float[Array, "g 2"] | None = None,
) -> Rendering:
    """Draws Gaussians as one camera sees them. Only first derivatives in reverse mode are
    supported: no `jvp`, no Hessian.

    After Kerbl et al. 2023 (https://arxiv.org/abs/2308.04079).

    A call outside of transformations checks its arguments, and sizes buffers to the scene if
    `config.max_pairs` is None. Inside `jit`, `vmap` and `grad` values are not checked, and buffers
    come from `config`; `plan_buffers` sizes them once. Pairs of splats and tiles that do not fit
    are not drawn there. `Rendering.overflow` counts them, and `SplatConfig.warn_overflow` logs
    them. Conventions are gsplat's (`rendering.splat_config`).

    Args:
        gaussians: one set of g, metres.
        camera: one camera; its size is the image's.
        config: what is drawn, and the buffers; or the name of one of `SPLAT_PRESETS`.
        background: (3,) RGB, three numbers, or a color's name. None: white.
        features: (g, n) other numbers of the Gaussians, drawn as the colors are, such as normals,
            labels or learned features.
        shifts: (g, 2) pixels that are added to the centres on the image. The gradient with respect
            to shifts of 0 is what gsplat's `means2d.grad` holds.

    Returns:
        A `Rendering`: rgb (h, w, 3), alpha, depth, overflow, features if there are any, and what
        `config` asks for.

    Raises:
        TypeError: for arguments of other classes.
        ValueError: for a batch of cameras or of sets, shapes that do not fit each other, a
            background that is no color, values that are not finite, opacities outside of [0, 1],
            negative scales, focal lengths that are not positive, numbers of harmonics other than 3,
            8 and 15, and an unknown name of a preset. Values are not checked inside of
            transformations.
        BufferOverflowError: outside of transformations, if `config.max_pairs` or `max_rows` is too
            small.

    Examples:
        >>> rendering = hg.render(gaussians, camera)
        >>> config = hg.plan_buffers(gaussians, cameras)
        >>> image = lambda gaussians: hg.render(gaussians, camera, config).rgb
        >>> loss = lambda gaussians: jnp.mean((image(gaussians) - photo) ** 2)
        >>> gradient = jax.jit(jax.grad(loss), compiler_options=hg.compiler_options())(gaussians)
    """
    if camera.batch_shape:
        raise ValueError(
            f"render draws one camera, got a batch {camera.batch_shape}: use"
            " render_views(gaussians, cameras), or jax.vmap(render, in_axes=(None, 0))(gaussians,"
            " cameras) to draw all views at once"
        )
    return _render(draw, gaussians, camera, config, background, features, shifts)


@checked_arguments
def render_views(
    gaussians: Gaussians,
    cameras: Camera,
    config: SplatConfig | str = DEFAULT_CONFIG,
    background: Background = None,
) -> Rendering:
    """Draws every camera of a batch (leading axis v), one after the other. Working memory does not
    grow with v. The memory for values that a gradient needs later grows with v. `jax.vmap` of
    `render` draws all views at once, and holds the buffers of all views. On CPUs, `jax.vmap` is as
    fast as `render_views`, but slower if gradients of many views are taken.

    Args:
        gaussians: as `render`.
        cameras: a batch of v.
        config: as `render`.
        background: as `render`.

    Returns:
        A `Rendering` with a leading axis v.

    Raises:
        TypeError: as `render`.
        ValueError: for a single camera or several batch axes, and otherwise as `render`.
        BufferOverflowError: as `render`.

    Examples:
        >>> images = hg.render_views(gaussians, cameras).rgb  # (v, h, w, 3)
    """
    if len(cameras.batch_shape) != 1:
        got = "a single camera: use render"
        if cameras.batch_shape:
            got = f"a batch {cameras.batch_shape}"
        raise ValueError(f"render_views draws cameras with one leading axis, got {got}")
    return _render(draw_views, gaussians, cameras, config, background)


@checked_arguments
def visible_gaussians(
    gaussians: Gaussians,
    cameras: Camera,
    config: SplatConfig | str = DEFAULT_CONFIG,
    threshold: float = ALPHA_MIN,
) -> Bool[Array, " g"]:
    """Returns which Gaussians have a weight alpha T of at least `threshold` on some pixel of some
    camera, (g,). `cameras` has one leading axis.

    The other Gaussians, such as those inside of an avatar, can be left out for similar cameras.
    Raises: as `render_views`.
    """
    visibility = render_views(
        gaussians, cameras, dataclasses.replace(splat_config(config), visibility=True)
    ).visibility
    assert visibility is not None
    return jnp.max(visibility, axis=0) >= threshold


def _render(
    draw: Callable[..., Rendering],
    gaussians: Gaussians,
    cameras: Camera,
    config: SplatConfig | str,
    background: Background,
    features: Float[Array, "g n"] | None = None,
    shifts: Float[Array, "g 2"] | None = None,
) -> Rendering:
    if gaussians.batch_shape:
        raise ValueError(
            f"expected one set of Gaussians, got a batch {gaussians.batch_shape}: draw it with"
            " jax.vmap"
        )
    # everything in the form that drawing expects
    config = splat_config(config)
    gaussians, cameras, background = with_background(gaussians, cameras, background)
    features = features_of(features, len(gaussians.opacities))
    more = (features,)
    if shifts is not None:
        more = (features, shifts)
        expected = (len(gaussians.opacities), 2)
        if shifts.shape != expected:
            raise ValueError(f"shifts: expected shape {expected}, got {shifts.shape}")
    # under a transformation values are unknown: buffers come from the configuration
    leaves = jax.tree.leaves((gaussians, cameras, background, more))
    if any(isinstance(leaf, Tracer) for leaf in leaves):
        config = with_default_buffers(gaussians, cameras, config)
        rendering = draw(gaussians, cameras, background, config, *more)
        warn_of_overflow(rendering.overflow, config)
        return rendering
    # values are known here: they are checked, and the buffers made to fit
    check_values(
        "render",
        record_values(gaussians, "gaussians")
        | record_values(cameras, "camera", on_host=True)
        | {"background": (background, FINITE), "features": (features, FINITE)}
        | {"shifts": (shifts, FINITE)},
    )
    if config.max_pairs is None:
        config = plan_buffers(gaussians, cameras, config, margin=1.0)
    rendering = _compiled(draw)(gaussians, cameras, background, config, *more)
    raise_on_overflow(rendering.overflow, gaussians, cameras, config)
    return rendering


@functools.cache
def _compiled(draw: Callable[..., Rendering]) -> Callable[..., Rendering]:
    """Returns the compiled `draw` or `draw_views` for eager calls."""
    return compiled(static=["config"], options=compiler_options)(draw)


@jax.custom_vjp
def _once_per_image(array: Array, camera: Camera) -> Array:
    """Returns the array unchanged. Where `vmap` shares the array among cameras, each camera gets a
    copy.

    The gradients of the copies are then summed over the cameras once. Without copies they would be
    summed at each of the dozen operations of the projection that mix shared and unshared arrays,
    which cost a fifth of an image's time on a CPU.
    """
    return _own(array, camera.K)


_once_per_image.defvjp(
    lambda array, camera: (_own(array, camera.K), camera),
    lambda camera, cotangent: (cotangent, jax.tree.map(jnp.zeros_like, camera)),
)


@jax.custom_batching.custom_vmap
def _own(array: Array, of: Array) -> Array:
    return array


@_own.def_vmap
def _own_in_batch(
    size: int, batched: Sequence[bool], array: Array, of: Array
) -> tuple[Array, bool]:
    return array if batched[0] else jnp.broadcast_to(array, (size, *array.shape)), True


# One image
# --------------------------------------------------------------------------------------------------


def with_background(
    gaussians: Gaussians, cameras: Camera, background: Background
) -> tuple[Gaussians, Camera, Float[Array, "3"]]:
    """Returns Gaussians, cameras and the background's color (3,), all in float32 or a wider type.

    Raises: ValueError if the background is no color.
    """
    return at_least_float32((gaussians, cameras, _color(background, gaussians.means.dtype)))


def features_of(features: Float[Array, "g n"] | None, count: int) -> Float[Array, "g n"] | None:
    """Returns the features in float32 or a wider type. None stays None.

    Raises: ValueError unless there is one row for each of `count` Gaussians.
    """
    if features is not None and features.shape[:1] != (count,):
        raise ValueError(f"features: expected shape ({count}, n), got {features.shape}")
    return at_least_float32(features)


def _color(background: object, dtype: np.dtype) -> Array:
    """Returns a background as three numbers (3,). None becomes white.

    Raises: ValueError if the background is no color.
    """
    if background is None:
        return from_host(np.ones(3), dtype)
    if isinstance(background, str):
        return from_host(named_color(background), dtype)
    if hasattr(background, "shape"):
        color, fits = background, background.shape == (3,) and not _of_bytes(background)
    else:
        color = background
        fits = isinstance(background, Sequence) and len(background) == 3
        fits = fits and all(
            isinstance(x, jax.Array) or (isinstance(x, Real) and 0 <= x <= 1) for x in background
        )
    if not fits:
        shape = getattr(color, "shape", (3,))
        shown = f"shape {shape}" if shape != (3,) else repr(color)
        raise ValueError(
            f"background: expected 3 numbers in [0, 1] or the name of a color, got {shown}"
        )
    if isinstance(color, jax.Array):
        return color
    return jnp.asarray(color, dtype)


def _of_bytes(color: Any) -> bool:
    """Returns whether an array of integers has a value above 1, which suggests colors of 0 to 255.
    False for traced values, which cannot be read, and for floats.
    """
    if isinstance(color, Tracer) or jnp.issubdtype(color.dtype, jnp.inexact):
        return False
    return bool(np.any(np.asarray(color) > 1))


def draw(
    gaussians: Gaussians,
    camera: Camera,
    background: Float[Array, "3"],
    config: SplatConfig,
    features: Float[Array, "g n"] | None = None,
    shifts: Float[Array, "g 2"] | None = None,
) -> Rendering:
    """Draws as `render` does, with buffers of the size `config.max_pairs`. The function is pure and
    checks nothing.
    """
    gaussians, features = jax.tree.map(
        lambda leaf: _once_per_image(leaf, camera), (gaussians, features)
    )
    projected = project_gaussians(gaussians, camera, config)
    if shifts is not None:
        projected = projected._replace(x=projected.x + shifts[:, 0], y=projected.y + shifts[:, 1])
    return _draw(projected, gaussians, camera, background, config, features)


def draw_views(
    gaussians: Gaussians,
    cameras: Camera,
    background: Float[Array, "3"],
    config: SplatConfig,
    features: Array | None = None,
) -> Rendering:
    """Draws every camera of a batch as `draw` does, one after the other."""

    def project(camera):
        return project_gaussians(gaussians, camera, config)

    return lax.map(
        lambda camera: _draw(project(camera), gaussians, camera, background, config, features),
        cameras,
    )


def _draw(
    projected: ProjectedGaussians,
    gaussians: Gaussians,
    camera: Camera,
    background: Array,
    config: SplatConfig,
    others: Array | None = None,
) -> Rendering:
    grid = TileGrid(camera.width, camera.height, config.tile_size)
    if gaussians.means.shape[0] == 0:
        return _blank(projected, grid, background, config, others)

    depths = jnp.where(projected.visible, lax.stop_gradient(projected.depths), jnp.inf)
    order = depth_order(depths)
    opacities = projected.dimmed(gaussians.opacities)
    found = footprints_by(projected, opacities, config)
    footprints = jax.tree.map(lambda plane: take(plane, order), found)

    # Depths are blended relative to the nearest: their gradient is a difference of depths, which
    # must not drown in the rounding of depths.
    nearest = jnp.min(depths)
    nearest = jnp.where(nearest < jnp.inf, nearest, 0.0)
    behind = jnp.where(projected.visible, projected.depths - nearest, 0.0)
    # what is blended: colors, depth, other features, and the powers of the depth
    seen = [projected.seen_from_here(gaussians.colors), behind[:, None]]
    if others is not None:
        seen.append(others)
    if config.distortion:
        seen.append(_powers(behind, projected.visible))
    seen = jnp.concatenate(seen, axis=-1)
    # rows in depth order, their tiles, and the image
    splats = pack_splats(projected, opacities, seen, config.alpha_min)
    splats = splats.at[order].get(unique_indices=True, mode="promise_in_bounds")
    assert config.max_pairs is not None  # callers have fitted the buffers
    pairs = emit_pairs(footprints, grid, config.max_rows or config.max_pairs, config.max_pairs)
    lists = sort_into_tiles(pairs.tiles, pairs.splats, grid.tiles, splats.shape[0])
    drawn = composite(splats, lists, grid, config)
    peaks = lax.stop_gradient(drawn.peaks)
    visibility = None
    if config.visibility:
        visibility = jnp.zeros_like(peaks).at[order].set(peaks, unique_indices=True)
    transmittance = drawn.transmittance[:, None]
    rendering = _blended(
        drawn.features, transmittance, grid, background, nearest, pairs.overflow, config
    )
    depth_median, radii = None, None
    if drawn.medians is not None:
        reached = drawn.medians < jnp.inf
        medians = lax.stop_gradient(jnp.where(reached, nearest + drawn.medians, 0.0))
        depth_median = tiles_to_image(medians[:, None], grid)[..., 0]
    if config.radii:
        radii = radii_on_image(found, camera.width, camera.height)
    return replace(
        rendering,
        visibility=visibility,
        means2d=projected.means2d if config.means2d else None,
        radii=radii,
        depth_median=depth_median,
    )


def _blank(
    projected: ProjectedGaussians,
    grid: TileGrid,
    background: Array,
    config: SplatConfig,
    others: Array | None,
) -> Rendering:
    """Returns the rendering of no Gaussians."""
    count = 4 + 2 * config.distortion
    if others is not None:
        count += others.shape[1]
    blank = jnp.zeros((grid.tiles, count, grid.pixels), projected.x.dtype)
    rendering = _blended(blank, 1 + blank[:, :1], grid, background, 0.0, jnp.int32(0), config)
    return replace(
        rendering,
        visibility=jnp.zeros(0, blank.dtype) if config.visibility else None,
        means2d=jnp.zeros((0, 2), blank.dtype) if config.means2d else None,
        radii=jnp.zeros((0, 2), blank.dtype) if config.radii else None,
        depth_median=jnp.zeros_like(rendering.depth) if config.depth_median else None,
    )


def _powers(behind: Float[Array, " g"], visible: Array) -> Float[Array, "g 2"]:
    """Returns z and z^2 of each Gaussian, (g, 2), metres and metres^2. z is measured from the mean
    z of the visible Gaussians, because small numbers have small squares. Gaussians that are not
    visible have 0.
    """
    count = jnp.maximum(jnp.sum(visible), 1)
    z = jnp.where(visible, behind - lax.stop_gradient(jnp.sum(behind) / count), 0.0)
    return jnp.stack([z, z * z], axis=-1)


def _blended(
    features: Array,
    transmittance: Array,
    grid: TileGrid,
    background: Array,
    nearest: Array | float,
    overflow: Array,
    config: SplatConfig,
) -> Rendering:
    """Returns the rendering of composited tiles over the background.

    features: (t, 4 + n, p), premultiplied rgb, z - nearest, and n others, of which the last two are
    the `_powers` if `config.distortion`. transmittance: (t, 1, p), the share of light that passes
    all Gaussians.

    Each output is computed separately, tile by tile. An output that nobody reads then costs
    nothing, nor does its gradient.
    """
    alpha = 1 - transmittance
    rgb = features[:, :3] + transmittance * background[:, None]
    depth = jnp.where(alpha > 0, nearest + safe_divide(features[:, 3:4], alpha), 0.0)
    rgb, alpha_image, depth = (tiles_to_image(tiles, grid) for tiles in (rgb, alpha, depth))
    # outputs that are computed only if they are asked for
    depth_sum, distortion = None, None
    if config.depth_sum:
        depth_sum = tiles_to_image(nearest * alpha + features[:, 3:4], grid)[..., 0]
    if config.distortion:
        # the last two channels are the first and the second moment of the depth
        first, second = features[:, -2:-1], features[:, -1:]
        spread = 2 * jnp.maximum(alpha * second - first * first, 0.0)
        distortion = tiles_to_image(spread, grid)[..., 0]
        features = features[:, :-2]
    others = None
    if features.shape[1] > 4:
        others = tiles_to_image(features[:, 4:], grid)
    return Rendering(
        rgb,
        alpha_image[..., 0],
        depth[..., 0],
        overflow,
        features=others,
        depth_sum=depth_sum,
        distortion=distortion,
    )
