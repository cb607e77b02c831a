"""Which splats touch which tiles: depth order, then exactly the pairs (tile, splat) whose footprint meets the tile.

A splat's footprint is the ellipse d^T cov2d^-1 d <= reach around its centre, outside of which alpha < alpha_min. It
meets a tile if it meets the rectangle spanned by the tile's pixel centres. With D the determinant of cov2d, the ellipse
at height dy above its centre spans

    dx = (xy / yy) dy -+ sqrt(D / yy (reach - dy^2 / yy)),     |dy| <= sqrt(reach yy),

so inside one row of tiles it reaches farthest right at dy = xy sqrt(reach / xx), clamped to the row, and farthest left
at the opposite point. Pairs are emitted by two expansions: splat -> rows of tiles -> tiles.

Nothing here is differentiated.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jax import lax

from humangs_jax.core.array_types import Array, Float, Int
from humangs_jax.rendering.projection import ProjectedGaussians, squared_reach
from humangs_jax.rendering.splat_config import SplatConfig
from humangs_jax.rendering.tiling import SUM_LIMIT, TileGrid, bits_for, expand, sort_keys, take

SLACK = 2e-3
"""Pixels by which footprints are widened, against rounding of positions (a float32 at 1000 pixels has 6e-5)."""

REACH_SLACK = (1.0001, 1e-5)
"""The squared reach is multiplied by the first and raised by the second, against rounding of alpha at its threshold."""

INRIA_MIN_DISCRIMINANT = 0.1
"""Pixels^4; INRIA's rasterizer raises the squared half difference of a splat's two variances to at least this."""


class Footprints(NamedTuple):
    """Ellipses on the image, planes of (g,), named as in `ProjectedGaussians`; reach is 0 where nothing is drawn."""

    x: Float[Array, " g"]
    y: Float[Array, " g"]
    xx: Float[Array, " g"]
    xy: Float[Array, " g"]
    yy: Float[Array, " g"]
    determinant: Float[Array, " g"]
    reach: Float[Array, " g"]

    def rows(self, grid: TileGrid):
        """First row of tiles of each splat, and how many."""
        half = jnp.sqrt(self.reach * self.yy)
        row0 = _first(self.y - half, grid.tile_size, grid.rows)
        row1 = _last(self.y + half, grid.tile_size, grid.rows)
        return row0, jnp.where(self.reach > 0, jnp.maximum(row1 - row0 + 1, 0), 0)

    def bands(self) -> "_Bands":
        height, tip = jnp.sqrt(self.reach * self.yy), self.xy * jnp.sqrt(self.reach / self.xx)
        inverse = 1 / self.yy
        return _Bands(self.x, self.y, height, tip, self.xy * inverse, self.determinant * inverse, inverse, self.reach)


class _Bands(NamedTuple):
    """What a row of tiles needs of an ellipse, planes of (g,): centre, half its height, how high above the centre its
    rightmost point is, xy / yy, D / yy, 1 / yy and the squared reach.
    """

    x: Float[Array, " g"]
    y: Float[Array, " g"]
    height: Float[Array, " g"]
    tip: Float[Array, " g"]
    slope: Float[Array, " g"]
    ratio: Float[Array, " g"]
    inverse: Float[Array, " g"]
    reach: Float[Array, " g"]

    def columns(self, row, grid: TileGrid):
        """First and last tile of each ellipse within one row of tiles."""
        size = grid.tile_size
        top = jnp.maximum(row * size + 0.5 - SLACK - self.y, -self.height)
        bottom = jnp.minimum((row + 1) * size - 0.5 + SLACK - self.y, self.height)
        right, left = jnp.clip(self.tip, top, bottom), jnp.clip(-self.tip, top, bottom)
        half = lambda dy: jnp.sqrt(jnp.maximum(self.ratio * (self.reach - dy * dy * self.inverse), 0))
        column0 = _first(self.x + self.slope * left - half(left), size, grid.columns)
        column1 = _last(self.x + self.slope * right + half(right), size, grid.columns)
        return column0, column1


class Squares(NamedTuple):
    """INRIA's footprints, planes of (g,): the tiles that meet a square, as its rasterizer counts them.

    radius: half a side, whole pixels; 0 where nothing is drawn.
    """

    x: Float[Array, " g"]
    y: Float[Array, " g"]
    radius: Float[Array, " g"]

    def rows(self, grid: TileGrid):
        """First row of tiles of each splat, and how many."""
        first, last = self._range(self.y, grid.tile_size, grid.rows)
        return first, jnp.where(self.radius > 0, jnp.maximum(last - first + 1, 0), 0)

    def bands(self) -> "Squares":
        return self

    def columns(self, row, grid: TileGrid):
        """First and last tile of each square, the same in all its rows."""
        return self._range(self.x, grid.tile_size, grid.columns)

    def _range(self, center, size, tiles):
        low, high = center - 0.5 - self.radius, center - 0.5 + self.radius + size - 1
        first = jnp.clip(jnp.floor(low / size), 0, tiles)
        return first.astype(jnp.int32), (jnp.clip(jnp.floor(high / size), 0, tiles) - 1).astype(jnp.int32)


class Pairs(NamedTuple):
    """(tile, splat) pairs; unused ones have the tile number "no tile".

    tiles, splats: (capacity,). needed: how many there are in all. overflow: how many of them are missing here.
    """

    tiles: Int[Array, " capacity"]
    splats: Int[Array, " capacity"]
    needed: Int[Array, ""]
    overflow: Int[Array, ""]


def depth_order(depths: Float[Array, " g"]) -> Int[Array, " g"]:
    """Stable order of positive depths, nearest first.

    float32: radix passes, each a sort of ONE uint32 (digit of the depth, then position), which XLA's CPU backend does
    four times as fast as an argsort. The bits of positive floats are ordered like the floats.
    """
    g = depths.shape[0]
    if depths.dtype != jnp.float32:
        return jnp.argsort(depths, stable=True).astype(jnp.int32)
    bits = bits_for(g)
    digit = 32 - bits
    value, position = lax.bitcast_convert_type(depths, jnp.uint32), jnp.arange(g, dtype=jnp.uint32)
    order = position.astype(jnp.int32)
    for shift in range(0, 31, digit):  # the sign bit is 0
        key = ((value[order] >> shift) & ((1 << digit) - 1)) << bits | position
        order = order[(sort_keys(key) & ((1 << bits) - 1)).astype(jnp.int32)]
    return order


def footprints(projected: ProjectedGaussians, reach: Float[Array, " g"]) -> Footprints:
    """Ellipses of the visible splats, a little widened against rounding; the others get reach 0."""
    factor, more = REACH_SLACK
    reach = jnp.where(projected.visible & (reach > 0), reach * factor + more, 0.0)
    p = lax.stop_gradient(projected)
    return Footprints(p.x, p.y, p.xx, p.xy, p.yy, p.determinant, reach)


def square_footprints(projected: ProjectedGaussians, reach: Float[Array, " g"], radius_sigma: float) -> Squares:
    """Squares of `radius_sigma` times the larger standard deviation, rounded up to pixels, where reach is positive."""
    p = lax.stop_gradient(projected)
    middle = 0.5 * (p.xx + p.yy)
    largest = middle + jnp.sqrt(jnp.maximum(middle * middle - p.determinant, INRIA_MIN_DISCRIMINANT))
    radius = jnp.where(p.visible & (reach > 0), jnp.ceil(radius_sigma * jnp.sqrt(largest)), 0.0)
    return Squares(p.x, p.y, radius)


def footprints_by(
    projected: ProjectedGaussians, opacities: Float[Array, " g"], config: SplatConfig
) -> Footprints | Squares:
    """The footprints that a configuration asks for: ellipses that end at `alpha_min` or `radius_sigma`, or squares."""
    reach = squared_reach(opacities, config.alpha_min)
    reach = jnp.where(opacities >= config.opacity_min, reach, 0.0)
    if config.radius_sigma is None:
        return footprints(projected, reach)
    if config.square:
        return square_footprints(projected, reach, config.radius_sigma)
    return footprints(projected, jnp.minimum(reach, config.radius_sigma**2))


def count_pairs(footprints: Footprints | Squares, grid: TileGrid) -> tuple[Int[Array, ""], Int[Array, ""]]:
    """(rows, pairs) that `emit_pairs` needs, without any buffer; both saturate at `SUM_LIMIT`."""
    _, counts = footprints.rows(grid)
    return _saturating_sum(counts), _count_row_by_row(footprints, grid, jnp.max(counts, initial=0))


def emit_pairs(footprints: Footprints | Squares, grid: TileGrid, max_rows: int, max_pairs: int) -> Pairs:
    """All pairs, splat by splat, in buffers of fixed size; if they overflow, the last splats lose theirs."""
    bands = footprints.bands()
    first, counts = footprints.rows(grid)
    rows = expand(counts, max_rows)
    slot = jnp.arange(max_rows, dtype=jnp.int32)
    row = take(first - rows.first, rows.source) + slot
    table = take(jnp.stack(bands, axis=-1), rows.source)
    column0, column1 = type(bands)(*(table[:, i] for i in range(len(bands)))).columns(row, grid)
    pairs = expand(jnp.where(slot < rows.needed, jnp.maximum(column1 - column0 + 1, 0), 0), max_pairs)

    slot = jnp.arange(max_pairs, dtype=jnp.int32)
    table = take(jnp.stack([row * grid.columns + column0 - pairs.first, rows.source], axis=-1), pairs.source)
    tiles = jnp.where(slot < pairs.needed, table[:, 0] + slot, grid.tiles)
    # If rows are missing, so are their pairs, and they are counted row by row; otherwise this loop runs zero times.
    missing = rows.needed > max_rows
    recount = _count_row_by_row(footprints, grid, jnp.where(missing, jnp.max(counts, initial=0), 0))
    needed = jnp.where(missing, recount, pairs.needed)
    return Pairs(tiles, table[:, 1], needed, needed - jnp.minimum(pairs.needed, max_pairs))


def _first(v, tile_size, tiles):
    """First of `tiles` whose last pixel centre is not left of v."""
    return jnp.clip(jnp.ceil((v - (tile_size - 0.5) - SLACK) / tile_size), 0, tiles).astype(jnp.int32)


def _last(v, tile_size, tiles):
    """Last of `tiles` whose first pixel centre is not right of v."""
    return jnp.clip(jnp.floor((v - 0.5 + SLACK) / tile_size), -1, tiles - 1).astype(jnp.int32)


def _count_row_by_row(footprints, grid: TileGrid, most_rows):
    """Pairs of all splats: their first rows of tiles, then their second ones, and so on."""
    bands = footprints.bands()
    first, counts = footprints.rows(grid)

    def count(i, total):
        column0, column1 = bands.columns(first + i, grid)
        here = jnp.where(i < counts, jnp.maximum(column1 - column0 + 1, 0), 0)
        return jnp.minimum(total + _saturating_sum(here), SUM_LIMIT)

    return lax.fori_loop(0, most_rows, count, jnp.zeros((), jnp.int32))


def _saturating_sum(x):
    fits = jnp.sum(x.astype(jnp.float32)) < SUM_LIMIT
    return jnp.where(fits, jnp.sum(x, dtype=jnp.int32), SUM_LIMIT)
