"""What the schedules of compositing share: splats on the pixels of a tile, sums over those pixels, and batches.

The maths and its notation stand in `compositing`. Pixels and splats are taken relative to a tile's centre: numbers stay
small, so that nothing is lost in float32 however large the image.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from humangs_jax.core.array_types import Array, Bool, Float, Int
from humangs_jax.rendering.splat_config import SplatConfig
from humangs_jax.rendering.tiling import TileGrid

X, Y, R00, R01, R11, LOG_OPACITY = range(6)
FEATURES = slice(6, 10)
FEATURE_COUNT = 4
"""Red, green, blue and z. A constant: XLA unrolls them."""
SPLAT_WIDTH = 10

EXACT = lax.Precision.HIGHEST
"""GPUs and TPUs would otherwise round the factors of a product to 10 or 8 bits."""


def joined_over_batch(function):
    """Under `vmap`, a function of (splats, items, starts, more per tile...) is called once, with the tiles of all
    images.

    Its outputs must be arrays per tile or per splat; those of the images then follow one another.
    """
    function = jax.custom_batching.custom_vmap(function)

    @function.def_vmap
    def rule(size, batched, *args):
        args = [a if b else jnp.broadcast_to(a, (size, *a.shape)) for a, b in zip(args, batched, strict=True)]
        splats, items, starts, *rest = args
        image = jnp.arange(size, dtype=jnp.int32)[:, None]
        args = [splats, items + image * splats.shape[1], starts + image * items.shape[1], *rest]
        out = function(*(a.reshape(-1, *a.shape[2:]) for a in args))
        out = jax.tree.map(lambda a: a.reshape(size, -1, *a.shape[1:]), out)
        return out, jax.tree.map(lambda _: True, out)

    return function


def take_rows(
    splats: Float[Array, "g 10"],
    items: Int[Array, " capacity"],
    starts: Int[Array, " b"],
    counts: Int[Array, " b"],
    tiles: Int[Array, " b"],
    grid: TileGrid,
    k: int,
) -> tuple[Int[Array, "b k"], Float[Array, "b k 10"], Float[Array, "2 b k"]]:
    """The first k splats of each of b lists, `items[starts : starts + counts]`, which lie on `tiles`.

    Returns their numbers (g past the end of a list), rows, and centres from that of the tile.
    """
    slot = jnp.arange(k, dtype=jnp.int32)
    item = items.at[starts[:, None] + slot].get(mode="clip")
    item = jnp.where(slot < counts[:, None], item, splats.shape[0])
    row = lax.optimization_barrier(splats.at[item].get(mode="clip"))
    place = tiles % grid.tiles  # of its image, if several were joined
    cx, cy = (
        (axis * grid.tile_size).astype(row.dtype)[:, None] + 0.5 * grid.tile_size
        for axis in (place % grid.columns, place // grid.columns)
    )
    return item, row, jnp.stack([row[..., X] - cx, row[..., Y] - cy])


def raw_alpha(
    row: Float[Array, "*b 10"], centre: Float[Array, "2 *b"], inside: Bool[Array, "*b"], grid: TileGrid
) -> Float[Array, "*b p"]:
    """Raw alphas on the pixels of a tile of splats with a `centre` from the tile's; 0 of those not `inside` a list."""
    x, y = centre
    r00, r01, r11 = row[..., R00], row[..., R01], row[..., R11]
    offsets = jnp.asarray(grid.offsets(row.dtype))
    u = (r00 * x + r01 * y)[..., None] - r00[..., None] * offsets[0] - r01[..., None] * offsets[1]
    v = (r11 * y)[..., None] - r11[..., None] * offsets[1]
    return jnp.where(inside[..., None], jnp.exp(row[..., LOG_OPACITY, None] - u * u - v * v), 0.0)


def take_chunk(
    splats: Float[Array, "g 10"],
    items: Int[Array, " capacity"],
    starts: Int[Array, " b"],
    counts: Int[Array, " b"],
    tiles: Int[Array, " b"],
    grid: TileGrid,
    k: int,
) -> tuple[Int[Array, "b k"], Float[Array, "b k 10"], Float[Array, "2 b k"], Float[Array, "b k p"]]:
    """`take_rows` and the raw alphas of these splats, 0 past the end of a list."""
    item, row, centre = take_rows(splats, items, starts, counts, tiles, grid, k)
    raw = raw_alpha(row, centre, jnp.arange(k, dtype=jnp.int32) < counts[:, None], grid)
    # One kernel with one exp per pair: without the barrier XLA would fuse exp into each of its consumers.
    return item, row, centre, lax.optimization_barrier(raw)


def largest_weights(weights: Float[Array, "b k p"], tiles: Int[Array, " b"], grid: TileGrid) -> Float[Array, "b k"]:
    """Of each splat on the pixels of its tile that lie inside the image."""
    place = tiles % grid.tiles
    x, y = (0.5 * grid.tile_size + offset for offset in grid.offsets())
    left = jnp.minimum(grid.width - place % grid.columns * grid.tile_size, grid.tile_size)
    above = jnp.minimum(grid.height - place // grid.columns * grid.tile_size, grid.tile_size)
    inside = (x < left[:, None]) & (y < above[:, None])
    return jnp.max(jnp.where(inside[:, None], weights, 0.0), axis=2)


def visible_alpha(raw: Float[Array, "*b"], config: SplatConfig) -> Float[Array, "*b"]:
    """Alpha from its raw value: clamped above, 0 if it is skipped."""
    return jnp.where(raw < config.alpha_min, 0.0, jnp.minimum(raw, config.alpha_max))


def monomials(grid: TileGrid, dtype: np.dtype | type) -> np.ndarray:
    """(p, 6): 1, x, y, x^2, xy, y^2 of a tile's pixels, from its centre."""
    x, y = grid.offsets(dtype)
    return np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=-1)


def moments_about_splat(
    moments: Float[Array, "*b 6"], x: Float[Array, "*b"], y: Float[Array, "*b"]
) -> Float[Array, "*b 6"]:
    """Moments of d = (pixel - splat) from those of (pixel - centre of the tile); x, y: (splat - centre)."""
    m, mx, my, mxx, mxy, myy = (moments[..., i] for i in range(6))
    return jnp.stack(
        [
            m,
            mx - x * m,
            my - y * m,
            mxx - 2 * x * mx + x * x * m,
            mxy - x * my - y * mx + x * y * m,
            myy - 2 * y * my + y * y * m,
        ],
        axis=-1,
    )


def product(a: Float[Array, "*b m p"], b: Float[Array, "*b p n"], config: SplatConfig) -> Float[Array, "*b m n"]:
    """Sums over pixels as a matrix product, with factors of `config.matmul_precision`."""
    if config.matmul_precision == "float32":
        return jnp.matmul(a, b, precision=EXACT)
    narrow = a.astype(config.matmul_precision), b.astype(config.matmul_precision)
    return jnp.matmul(*narrow, preferred_element_type=a.dtype)
