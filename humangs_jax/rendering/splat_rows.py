"""Stores splats as rows of numbers: packs them, takes them in chunks from their lists, and computes
their moments. Both schedules of compositing use these functions.

For formulas and symbols see `rendering.compositing`.
"""

import functools
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from humangs_jax.core.array_types import Array, Float, Int, PyTree
from humangs_jax.geometry.transform import EXACT
from humangs_jax.rendering.projection import ProjectedGaussians
from humangs_jax.rendering.splat_config import SplatConfig
from humangs_jax.rendering.tiling import TileGrid

X = 0
"""Column of a splat's row with the x of its centre, pixels."""
Y = 1
"""Column with the y of the centre, pixels."""
R00 = 2
"""Column with the entry 00 of r, 1 / pixels."""
R01 = 3
"""Column with the entry 01 of r, 1 / pixels."""
R11 = 4
"""Column with the entry 11 of r, 1 / pixels."""
LOG_OPACITY = 5
"""Column with the logarithm of the opacity."""
FEATURES = slice(6, None)
"""Columns of red, green, blue, z, and any further features."""
Z = 9
"""Column with z, metres. `splatting` measures z from the nearest Gaussian."""
HALF = 0.5
"""Transmittance at the median depth."""


def pack_splats(
    projected: ProjectedGaussians,
    opacities: Float[Array, " g"],
    features: Float[Array, "g n"],
    alpha_min: float,
) -> Float[Array, "g width"]:
    """Returns the rows of splats, (g, 6 + n): x, y (pixels), r00, r01, r11 (1 / pixels), log
    opacity, features. Splats that are not drawn get the log opacity 0, so that it is finite.
    """
    p = projected
    drawn = p.visible & (opacities >= alpha_min)
    log_opacity = jnp.log(jnp.where(drawn, opacities, 1.0))
    return jnp.stack([p.x, p.y, p.r00, p.r01, p.r11, log_opacity, *features.T], axis=-1)


class Composited(NamedTuple):
    """The result of compositing: values at p pixels of each of t tiles, and values of each of g
    splats.
    """

    features: Float[Array, "t n p"]
    """Sum of w f, (t, n, p); 0 where lists are empty."""
    transmittance: Float[Array, "t p"]
    """The final T, (t, p); 1 where lists are empty."""
    lengths: Int[Array, " t"]
    """Number of splats of each list that were read, (t,). Reading stops at the end of the list, or
    after the chunk in which the last pixels of the tile end.
    """
    peaks: Float[Array, " g"]
    """The largest w of each splat, (g,). 0 unless `config.visibility`."""
    medians: Float[Array, "t p"] | None
    """The z of the splat behind which T is at most one half for the first time, (t, p), metres.
    Infinite where T stays above one half. Lists run front to back, so this is the smallest such z.
    None unless `config.depth_median`.
    """


def joined_over_batch(function: Callable[..., PyTree]) -> Callable[..., PyTree]:
    """Returns a function in a form that `vmap` calls once, with the tiles of all images together.
    The function's arguments are (splats, items, starts, further arrays per tile...).

    The function must return arrays per tile or per splat. `vmap` divides them among the images
    afterwards.
    """
    function = jax.custom_batching.custom_vmap(function)

    @function.def_vmap
    def rule(size, batched, *args):
        args = [
            a if b else jnp.broadcast_to(a, (size, *a.shape))
            for a, b in zip(args, batched, strict=True)
        ]
        splats, items, starts, *rest = args
        image = jnp.arange(size, dtype=jnp.int32)[:, None]
        args = [splats, items + image * splats.shape[1], starts + image * items.shape[1], *rest]
        out = function(*(a.reshape(-1, *a.shape[2:]) for a in args))
        out = jax.tree.map(lambda a: a.reshape(size, -1, *a.shape[1:]), out)
        return out, jax.tree.map(lambda _: True, out)

    return function


def take_chunk(
    splats: Float[Array, "g width"],
    items: Int[Array, " capacity"],
    starts: Int[Array, " b"],
    counts: Int[Array, " b"],
    tiles: Int[Array, " b"],
    grid: TileGrid,
    k: int,
) -> tuple[
    Int[Array, "b k"], Float[Array, "b k width"], Float[Array, "2 b k"], Float[Array, "b k p"]
]:
    """Returns the first k splats of each of b lists. List i is `items[starts[i] : starts[i] +
    counts[i]]`, and belongs to the tile `tiles[i]`.

    There are four results: the numbers of the splats, (b, k), with g past the end of a list;
    their rows, (b, k, width); x and y of their centres relative to the tile's centre, (2, b, k),
    pixels; and their raw alphas at the tile's pixels, (b, k, p), which are 0 past the end.
    """
    # numbers and rows of the splats
    slot = jnp.arange(k, dtype=jnp.int32)
    item = items.at[starts[:, None] + slot].get(mode="clip")
    item = jnp.where(slot < counts[:, None], item, splats.shape[0])
    row = lax.optimization_barrier(splats.at[item].get(mode="clip"))
    # their centres, measured from that of the tile (of its image, if several were joined)
    place = tiles % grid.tiles
    cx, cy = (
        (axis * grid.tile_size).astype(row.dtype)[:, None] + 0.5 * grid.tile_size
        for axis in (place % grid.columns, place // grid.columns)
    )
    centre = jnp.stack([row[..., X] - cx, row[..., Y] - cy])
    inside = jnp.arange(k, dtype=jnp.int32) < counts[:, None]
    # raw alpha at the pixels, with the exponent as a sum of squares
    x, y = centre
    r00, r01, r11 = row[..., R00], row[..., R01], row[..., R11]
    offsets = jnp.asarray(grid.offsets(row.dtype))
    u = (r00 * x + r01 * y)[..., None] - r00[..., None] * offsets[0] - r01[..., None] * offsets[1]
    v = (r11 * y)[..., None] - r11[..., None] * offsets[1]
    raw = jnp.where(inside[..., None], jnp.exp(row[..., LOG_OPACITY, None] - u * u - v * v), 0.0)
    return item, row, centre, raw


def largest_weights(
    weights: Float[Array, "b k p"], tiles: Int[Array, " b"], grid: TileGrid
) -> Float[Array, "b k"]:
    """Returns the largest weight of each splat on the pixels of its tile that lie inside the image,
    (b, k).
    """
    place = tiles % grid.tiles
    x, y = (0.5 * grid.tile_size + offset for offset in grid.offsets())
    left = jnp.minimum(grid.width - place % grid.columns * grid.tile_size, grid.tile_size)
    above = jnp.minimum(grid.height - place // grid.columns * grid.tile_size, grid.tile_size)
    inside = (x < left[:, None]) & (y < above[:, None])
    return jnp.max(jnp.where(inside[:, None], weights, 0.0), axis=2)


def visible_alpha(raw: Float[Array, "*b"], config: SplatConfig) -> Float[Array, "*b"]:
    """Returns alpha for its raw value: at most `alpha_max`, and 0 below `alpha_min`."""
    return jnp.where(raw < config.alpha_min, 0.0, jnp.minimum(raw, config.alpha_max))


def monomials(grid: TileGrid, dtype: np.dtype | type) -> np.ndarray:
    """Returns 1, x, y, x^2, xy, y^2 of a tile's pixels, (p, 6), measured from its centre."""
    x, y = grid.offsets(dtype)
    return np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=-1)


def moments_about_splat(
    moments: Float[Array, "*b 6"], x: Float[Array, "*b"], y: Float[Array, "*b"]
) -> Float[Array, "*b 6"]:
    """Returns moments about the centre of a splat, from moments about the centre of a tile. Moments
    are the sums with 1, x, y, x^2, xy and y^2 in this order.

    x, y: offset of the splat's centre from the tile's centre, pixels.
    """
    m, mx, my, mxx, mxy, myy = (moments[..., i] for i in range(6))
    about = [
        m,
        mx - x * m,
        my - y * m,
        mxx - 2 * x * mx + x * x * m,
        mxy - x * my - y * mx + x * y * m,
    ]
    return jnp.stack([*about, myy - 2 * y * my + y * y * m], axis=-1)


product = functools.partial(jnp.matmul, precision=EXACT)
"""Matrix product in full precision, for sums over pixels."""
