"""Finds which splats touch which tile, a square of pixels, and keeps one list per tile in one
buffer of fixed size.

Splatting takes five steps. All have static shapes, and no gradient passes through the first three:

1. `expand` gives each item one slot for each tile that the item touches. A slot is a (tile, item)
   pair. Splats take two such steps (`emit_pairs`): from splats to rows of tiles, and from rows to
   tiles.
2. `sort_into_tiles` sorts the (tile, item) pairs by tile, and by item inside a tile. If items are
   numbered by depth (`depth_order`), every list runs front to back.
3. `blocks_by_length` orders tiles by falling list length. A block of consecutive tiles then has
   lists of about the same length. Empty tiles come last, and blocks of empty tiles are not visited.
   Only the schedule for CPUs uses blocks.
4. Compositing loops over blocks and over chunks of their lists. The pixels of a tile are one axis
   of `tile_size`^2 values, row by row, at `grid.offsets` from the tile's centre.
5. `tiles_to_image` puts the image together.

What does not fit in a buffer is counted: `Expansion.needed` is exact up to `SUM_LIMIT`, whatever
the capacity. Where the last row and column of tiles reach beyond the image, the pixels outside are
cut off.

A splat's footprint is the ellipse d^T cov2d^-1 d <= reach around its centre, outside of which alpha
< alpha_min. The footprint meets a tile if it meets the rectangle spanned by the tile's pixel
centres. Let D be the determinant of cov2d. At dy below the centre, the left and the right border of
the ellipse are at

    dx = (xy / yy) dy -+ sqrt(D / yy (reach - dy^2 / yy)),     |dy| <= sqrt(reach yy).

So inside one row of tiles the ellipse reaches farthest right at dy = xy sqrt(reach / xx), and
farthest left at minus this dy, both clamped to the row.
"""

import dataclasses
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import lax

from humangs_jax.core.array_types import Array, Float, Int, Shaped, UInt
from humangs_jax.rendering.projection import ProjectedGaussians
from humangs_jax.rendering.splat_config import ALPHA_MIN, SplatConfig

SUM_LIMIT = 1 << 30
"""Running sums stop here instead of wrapping past 2^31. A sum of this size only says "too many"."""

_ROW = 64
"""Width of the triangular products in `cumsum`: 64 numbers below 2^18 add up exactly in float32."""


Size = Any
"""An integer. For a grid that only counts (`count_pairs`), it may also be a JAX array without axes.
"""


@dataclasses.dataclass(frozen=True)
class TileGrid:
    """An image cut into squares of `tile_size` pixels, numbered row by row.

    A grid is static (hashable). Only `count_pairs` also takes a grid of traced sizes, so that one
    program counts for all sizes.
    """

    width: Size
    """Width of the image, pixels."""
    height: Size
    """Height of the image, pixels."""
    tile_size: int
    """Side of a tile, pixels."""

    @property
    def columns(self) -> Size:
        """Number of tiles in a row of tiles."""
        return -(-self.width // self.tile_size)

    @property
    def rows(self) -> Size:
        """Number of rows of tiles."""
        return -(-self.height // self.tile_size)

    @property
    def tiles(self) -> Size:
        """Number of tiles. This number also stands for "no tile" in lists of tile numbers."""
        return self.columns * self.rows

    @property
    def pixels(self) -> int:
        """Number of pixels in a tile."""
        return self.tile_size**2

    def offsets(self, dtype: np.dtype | type = np.float32) -> np.ndarray:
        """Returns x and y of a tile's pixel centres, (2, pixels), relative to the tile's centre,
        pixels.

        Such small numbers keep the moments of the backward pass accurate.
        """
        pixel = np.arange(self.pixels)
        offsets = (
            np.stack([pixel % self.tile_size, pixel // self.tile_size]) + 0.5 - self.tile_size / 2
        )
        return offsets.astype(dtype)


class Expansion(NamedTuple):
    """Slots divided among items, item by item."""

    source: Int[Array, " capacity"]
    """Item of each slot, (capacity,). Slots from `needed` on have the last item."""
    first: Int[Array, " n"]
    """First slot of each item, (n,). The difference slot - first[source] numbers the slots of one
    item from 0.
    """
    needed: Int[Array, ""]
    """Number of slots that were asked for, even beyond the capacity (saturates at `SUM_LIMIT`).
    Slot s is used if s < needed.
    """


class TileLists(NamedTuple):
    """A list of items for each tile. Tile t has items[starts[t] : starts[t] + counts[t]],
    ascending.
    """

    items: Int[Array, " capacity"]
    """The items of all lists, (capacity,)."""
    starts: Int[Array, " t"]
    """Index in `items` of each tile's first item, (t,)."""
    counts: Int[Array, " t"]
    """Length of each tile's list, (t,)."""


class TileBlocks(NamedTuple):
    """Tile numbers ordered by falling list length, padded to whole blocks."""

    tiles: Int[Array, " t_padded"]
    """Tile numbers, (blocks * block,). The padding has the number "no tile" (t), which is out of
    bounds on purpose. Gather with a fill value, and scatter with mode="drop".
    """
    used: Int[Array, ""]
    """Number of blocks that hold a tile whose list is not empty."""


def cumsum(x: Int[Array, " n"]) -> Int[Array, " n"]:
    """Returns the inclusive running sum of int32 numbers >= 0, saturating at `SUM_LIMIT`.

    Any 64 consecutive numbers must sum to less than 2^24. There are three levels. Rows of 64
    numbers are summed by a product with a triangular matrix. The totals of 64 rows each are summed
    by another such product. The few totals that are left are summed with a mask of all pairs. This
    is faster than `jnp.cumsum` on a CPU, does not wrap, and does not have logarithmically many
    steps to compile.
    """
    n = x.shape[0]
    within = _sums_in_rows(_in_rows(x))
    totals = within[:, -1]
    # totals may have 24 bits: twelve at a time, 64 of them sum exactly in float32
    middle = _in_rows(totals)
    middle = _sums_in_rows(middle & 0xFFF) + (_sums_in_rows(middle >> 12) << 12)
    last = middle[:, -1]
    earlier = jnp.tri(last.shape[0], k=-1, dtype=bool)
    fits = jnp.sum(jnp.where(earlier, last.astype(jnp.float32), 0), axis=1) < SUM_LIMIT
    before = jnp.where(
        fits, jnp.sum(jnp.where(earlier, last, 0), axis=1, dtype=jnp.int32), SUM_LIMIT
    )
    starts = jnp.minimum(
        (middle + before[:, None]).reshape(-1)[: totals.shape[0]] - totals, SUM_LIMIT
    )
    return jnp.minimum(within + starts[:, None], SUM_LIMIT).reshape(-1)[:n]


def _in_rows(x: Int[Array, " n"]) -> Int[Array, "rows 64"]:
    return jnp.pad(x, (0, -x.shape[0] % _ROW)).reshape(-1, _ROW)


def _sums_in_rows(rows: Int[Array, "rows 64"]) -> Int[Array, "rows 64"]:
    """Returns running sums along each row, exact while they stay below 2^24."""
    triangle = jnp.triu(jnp.ones((_ROW, _ROW), jnp.float32))
    return jnp.matmul(rows.astype(jnp.float32), triangle, precision=lax.Precision.HIGHEST).astype(
        jnp.int32
    )


def expand(counts: Int[Array, " n"], capacity: int) -> Expansion:
    """Returns which item owns each of `capacity` slots: item i takes the next counts[i] >= 0 slots.

    The counts must keep the limits of `cumsum`.
    """
    if counts.shape[0] == 0:
        return Expansion(jnp.zeros(capacity, jnp.int32), counts, jnp.zeros((), jnp.int32))
    end = _materialized(cumsum(counts))
    first = end - counts
    return Expansion(owners(first, capacity), first, end[-1])


def owners(
    first: Int[Array, " n"], size: int, start: Int[Array, ""] | int = 0
) -> Int[Array, " size"]:
    """Returns the item that owns each of the slots start .. start + size - 1, (size,). Item i owns
    the slots first[i] .. first[i + 1] - 1.

    A running sum counts the items that begin at or before a slot, and the last of these items owns
    the slot. Items without slots begin together with the next item that has any. The result is
    exact below 2^24 items, see `cumsum`.
    """
    marks = jnp.zeros(size, jnp.int32).at[jnp.maximum(first - start, 0)].add(1, mode="drop")
    return _materialized(cumsum(marks) - 1)


def take(
    table: Shaped[Array, "n *rest"], indices: Int[Array, " slots"]
) -> Shaped[Array, "slots *rest"]:
    """Returns rows of a table at indices that must be in range. They are not clamped, and negative
    ones do not wrap.
    """
    return (
        _materialized(table).at[indices].get(mode="promise_in_bounds", wrap_negative_indices=False)
    )


def _materialized(array: Shaped[Array, "*shape"]) -> Shaped[Array, "*shape"]:
    """Returns the array, stored in memory before it is used.

    Without this, XLA's CPU backend would evaluate the expression behind a table anew for each
    number that a gather takes from it. XLA respects the barrier where a program is compiled with
    `core.processes.compiler_options`.
    """
    return lax.optimization_barrier(array)


def _bits_for(count: int) -> int:
    """Returns the number of bits that hold the numbers 0 .. count - 1 (at least one)."""
    return max(1, (count - 1).bit_length())


def sort_keys(keys: UInt[Array, " n"]) -> UInt[Array, " n"]:
    """Returns the keys in ascending order.

    Equal keys are identical, so the sort need not be stable. XLA's stable sort is used on CPUs,
    where it is a third faster; elsewhere it would have to carry the positions along.
    """
    return lax.platform_dependent(
        keys, cpu=jnp.sort, default=lambda keys: lax.sort(keys, is_stable=False)
    )


def sort_into_tiles(
    tiles: Int[Array, " capacity"], items: Int[Array, " capacity"], tile_count: int, item_count: int
) -> TileLists:
    """Sorts pairs (tile, item) into one list per tile, ascending by item. Pairs of tile
    `tile_count` ("no tile") are left out.

    If a tile number and an item number fit together in a uint32, the pairs are packed into such
    keys, and only the keys are sorted. (Keys with a payload take several times as long to sort.)
    Otherwise the pairs are sorted by two keys.
    """
    bits = _bits_for(item_count)
    if (tile_count + 1) << bits <= 1 << 32:
        key = tiles.astype(jnp.uint32) << bits | items.astype(jnp.uint32)
        sorted_items = (sort_keys(key) & ((1 << bits) - 1)).astype(jnp.int32)
    else:
        sorted_items = lax.sort((tiles, items), num_keys=2, is_stable=False)[1]
    counts = jnp.zeros(tile_count, jnp.int32).at[tiles].add(1, mode="drop")
    starts = jnp.cumsum(counts, dtype=jnp.int32) - counts
    return TileLists(sorted_items, starts, counts)


def blocks_by_length(counts: Int[Array, " t"], block: int) -> TileBlocks:
    """Puts tiles into blocks of `block` tiles, by falling list length.

    Tiles with lists of the same length, and tiles with lists too long for the sort key, are ordered
    by their number.
    """
    t = counts.shape[0]
    bits = _bits_for(t)
    longest = (1 << (32 - bits)) - 1
    key = (longest - jnp.minimum(counts.astype(jnp.uint32), longest)) << bits | jnp.arange(
        t, dtype=jnp.uint32
    )
    tiles = (sort_keys(key) & ((1 << bits) - 1)).astype(jnp.int32)
    tiles = jnp.pad(tiles, (0, -t % block), constant_values=t)
    used = jnp.sum(counts > 0, dtype=jnp.int32)
    return TileBlocks(tiles, (used + block - 1) // block)


def tiles_to_image(tiles: Float[Array, "t c p"], grid: TileGrid) -> Float[Array, "h w c"]:
    """Returns the image (h, w, c) of all tiles' pixels (t, c, p). Pixels beyond the image are cut
    off.
    """
    size, c = grid.tile_size, tiles.shape[1]
    image = tiles.reshape(grid.rows, grid.columns, c, size, size).transpose(0, 3, 1, 4, 2)
    return image.reshape(grid.rows * size, grid.columns * size, c)[: grid.height, : grid.width]


# Splats
# --------------------------------------------------------------------------------------------------


SLACK = 2e-3
"""Pixels by which footprints are widened, so that rounding of positions loses no tile (at 1000
pixels, a float32 has steps of 6e-5).
"""


class Footprints(NamedTuple):
    """Ellipses on the image, planes of (g,), named as in `ProjectedGaussians`."""

    x: Float[Array, " g"]
    """x of the centres, (g,), pixels."""
    y: Float[Array, " g"]
    """y of the centres, (g,), pixels."""
    xx: Float[Array, " g"]
    """Variance along x, (g,), pixels^2."""
    xy: Float[Array, " g"]
    """Covariance of x and y, (g,), pixels^2."""
    yy: Float[Array, " g"]
    """Variance along y, (g,), pixels^2."""
    determinant: Float[Array, " g"]
    """Determinant of the covariance, (g,), pixels^4."""
    reach: Float[Array, " g"]
    """d^T cov2d^-1 d on the border of the ellipse, (g,); 0 where nothing is drawn."""

    def rows(self, grid: TileGrid) -> tuple[Int[Array, " g"], Int[Array, " g"]]:
        """Returns the first row of tiles that each splat touches, (g,), and how many rows it
        touches, (g,).
        """
        half = jnp.sqrt(self.reach * self.yy)
        row0 = _first(self.y - half, grid.tile_size, grid.rows)
        row1 = _last(self.y + half, grid.tile_size, grid.rows)
        return row0, jnp.where(self.reach > 0, jnp.maximum(row1 - row0 + 1, 0), 0)

    def half_sides(self) -> Float[Array, "g 2"]:
        """Returns half the width and half the height of each footprint, (g, 2), pixels."""
        return jnp.sqrt(self.reach[:, None] * jnp.stack([self.xx, self.yy], axis=-1))

    def bands(self) -> "_Bands":
        height, tip = jnp.sqrt(self.reach * self.yy), self.xy * jnp.sqrt(self.reach / self.xx)
        inverse = 1 / self.yy
        return _Bands(
            self.x,
            self.y,
            height,
            tip,
            self.xy * inverse,
            self.determinant * inverse,
            inverse,
            self.reach,
        )


class _Bands(NamedTuple):
    """The numbers from which the span of each ellipse in a row of tiles is computed, planes of
    (g,).
    """

    x: Float[Array, " g"]
    """x of the centre, pixels."""
    y: Float[Array, " g"]
    """y of the centre, pixels."""
    height: Float[Array, " g"]
    """Half the height of the ellipse, pixels."""
    tip: Float[Array, " g"]
    """y of the rightmost point, relative to the centre, pixels. Positive is down."""
    slope: Float[Array, " g"]
    """xy / yy, no unit."""
    ratio: Float[Array, " g"]
    """D / yy, the determinant of the covariance over its yy, pixels^2."""
    inverse: Float[Array, " g"]
    """1 / yy, pixels^-2."""
    reach: Float[Array, " g"]
    """d^T cov2d^-1 d on the border of the ellipse."""

    def columns(
        self, row: Int[Array, " g"], grid: TileGrid
    ) -> tuple[Int[Array, " g"], Int[Array, " g"]]:
        """Returns the first and the last column of tiles that each ellipse touches in one row of
        tiles, (g,) each. row: number of that row for each ellipse.
        """
        size = grid.tile_size
        top = jnp.maximum(row * size + 0.5 - SLACK - self.y, -self.height)
        bottom = jnp.minimum((row + 1) * size - 0.5 + SLACK - self.y, self.height)
        right, left = jnp.clip(self.tip, top, bottom), jnp.clip(-self.tip, top, bottom)

        def half(dy):
            return jnp.sqrt(jnp.maximum(self.ratio * (self.reach - dy * dy * self.inverse), 0))

        column0 = _first(self.x + self.slope * left - half(left), size, grid.columns)
        column1 = _last(self.x + self.slope * right + half(right), size, grid.columns)
        return column0, column1


class Squares(NamedTuple):
    """Footprints as squares, planes of (g,). A splat touches the tiles that INRIA's rasterizer
    counts for it.
    """

    x: Float[Array, " g"]
    """x of the centres, (g,), pixels."""
    y: Float[Array, " g"]
    """y of the centres, (g,), pixels."""
    radius: Float[Array, " g"]
    """Half a side of the square, (g,), whole pixels; 0 where nothing is drawn."""

    def rows(self, grid: TileGrid) -> tuple[Int[Array, " g"], Int[Array, " g"]]:
        """Returns the first row of tiles that each splat touches, (g,), and how many rows it
        touches, (g,).
        """
        first, last = self._range(self.y, grid.tile_size, grid.rows)
        return first, jnp.where(self.radius > 0, jnp.maximum(last - first + 1, 0), 0)

    def half_sides(self) -> Float[Array, "g 2"]:
        """Returns half the width and half the height of each square, (g, 2), pixels."""
        return jnp.stack([self.radius, self.radius], axis=-1)

    def bands(self) -> "Squares":
        return self

    def columns(
        self, row: Int[Array, " g"], grid: TileGrid
    ) -> tuple[Int[Array, " g"], Int[Array, " g"]]:
        """Returns the first and the last column of tiles that each square touches, (g,) each. They
        are the same in all rows.
        """
        return self._range(self.x, grid.tile_size, grid.columns)

    def _range(self, center: Array, size: int, tiles: Size) -> tuple[Array, Array]:
        low, high = center - 0.5 - self.radius, center - 0.5 + self.radius + size - 1
        first = jnp.clip(jnp.floor(low / size), 0, tiles)
        return first.astype(jnp.int32), (jnp.clip(jnp.floor(high / size), 0, tiles) - 1).astype(
            jnp.int32
        )


class Pairs(NamedTuple):
    """(tile, splat) pairs, ordered by splat."""

    tiles: Int[Array, " capacity"]
    """Tile of each pair, (capacity,); unused pairs have the tile number "no tile"."""
    splats: Int[Array, " capacity"]
    """Splat of each pair, (capacity,)."""
    needed: Int[Array, ""]
    """Number of pairs that the image needs (saturates at `SUM_LIMIT`)."""
    overflow: Int[Array, ""]
    """Number of pairs that did not fit and are missing here."""


def depth_order(depths: Float[Array, " g"]) -> Int[Array, " g"]:
    """Returns the stable order of positive depths, (g,), nearest first.

    float32 depths are sorted in radix passes. Each pass sorts single uint32 keys (a digit of the
    depth, then the position), which XLA's CPU backend does four times as fast as an argsort. This
    works because the bits of positive floats are ordered like the floats. Other types take an
    argsort.
    """
    g = depths.shape[0]
    if depths.dtype != jnp.float32:
        return jnp.argsort(depths, stable=True).astype(jnp.int32)
    bits = _bits_for(g)
    digit = 32 - bits
    value, position = lax.bitcast_convert_type(depths, jnp.uint32), jnp.arange(g, dtype=jnp.uint32)
    order = position.astype(jnp.int32)
    for shift in range(0, 31, digit):  # the sign bit is 0
        key = ((value[order] >> shift) & ((1 << digit) - 1)) << bits | position
        order = order[(sort_keys(key) & ((1 << bits) - 1)).astype(jnp.int32)]
    return order


def squared_reach(
    opacities: Float[Array, " g"], alpha_min: float = ALPHA_MIN
) -> Float[Array, " g"]:
    """Returns the value of d^T cov2d^-1 d at which each splat's alpha falls to `alpha_min`, (g,).
    It is 0 for a splat whose opacity is not above `alpha_min`.

    No gradient passes.
    """
    opacities = lax.stop_gradient(opacities)
    seen = opacities > alpha_min
    return jnp.where(seen, 2 * jnp.log(jnp.where(seen, opacities, 1.0) / alpha_min), 0.0)


def footprints(projected: ProjectedGaussians, reach: Float[Array, " g"]) -> Footprints:
    """Returns the ellipses of all splats, a little widened against rounding. Invisible splats get
    reach 0.
    """
    # a little more, against rounding of alpha at its threshold
    reach = jnp.where(projected.visible & (reach > 0), reach * 1.0001 + 1e-5, 0.0)
    p = lax.stop_gradient(projected)
    return Footprints(p.x, p.y, p.xx, p.xy, p.yy, p.determinant, reach)


def _square_footprints(
    projected: ProjectedGaussians, reach: Float[Array, " g"], radius_sigma: float
) -> Squares:
    """Returns squares around the splats. Half a side is `radius_sigma` times the larger standard
    deviation, rounded up to pixels, or 0 where the splat is invisible or its reach is 0.
    """
    p = lax.stop_gradient(projected)
    middle = 0.5 * (p.xx + p.yy)
    # INRIA's rasterizer raises the squared half difference of the two variances to at least 0.1
    largest = middle + jnp.sqrt(jnp.maximum(middle * middle - p.determinant, 0.1))
    radius = jnp.where(p.visible & (reach > 0), jnp.ceil(radius_sigma * jnp.sqrt(largest)), 0.0)
    return Squares(p.x, p.y, radius)


def footprints_by(
    projected: ProjectedGaussians, opacities: Float[Array, " g"], config: SplatConfig
) -> Footprints | Squares:
    """Returns the footprints that a configuration asks for.

    They are squares if `config.square`. Otherwise they are ellipses that end where alpha falls to
    `alpha_min`, or at `radius_sigma` standard deviations if that is nearer. opacities: as they are
    drawn, (g,).
    """
    reach = squared_reach(opacities, config.alpha_min)
    if config.radius_sigma is None:
        return footprints(projected, reach)
    if config.square:
        return _square_footprints(projected, reach, config.radius_sigma)
    return footprints(projected, jnp.minimum(reach, config.radius_sigma**2))


def radii_on_image(
    footprints: Footprints | Squares, width: int, height: int
) -> Float[Array, "g 2"]:
    """Returns half the sides of the footprints, (g, 2), pixels; 0 for footprints that lie beside
    the image.

    Footprints carry no gradient.
    """
    half = footprints.half_sides()
    center = jnp.stack([footprints.x, footprints.y], axis=-1)
    size = jnp.asarray([width, height], half.dtype)
    met = jnp.all((center + half > 0) & (center - half < size), axis=-1, keepdims=True)
    return jnp.where(met, half, 0.0)


def count_pairs(
    footprints: Footprints | Squares, grid: TileGrid
) -> tuple[Int[Array, ""], Int[Array, ""]]:
    """Returns the numbers of rows and pairs that `emit_pairs` needs, without making any buffer.
    Both saturate at `SUM_LIMIT`.
    """
    _, counts = footprints.rows(grid)
    return _saturating_sum(counts), _count_row_by_row(footprints, grid, jnp.max(counts, initial=0))


def emit_pairs(
    footprints: Footprints | Squares, grid: TileGrid, max_rows: int, max_pairs: int
) -> Pairs:
    """Lists all (tile, splat) pairs, splat by splat, in buffers of fixed size. If a buffer
    overflows, the pairs of the last splats are missing.
    """
    bands = footprints.bands()
    first, counts = footprints.rows(grid)
    # from splats to the rows of tiles that they meet
    rows = expand(counts, max_rows)
    slot = jnp.arange(max_rows, dtype=jnp.int32)
    row = take(first - rows.first, rows.source) + slot
    table = take(jnp.stack(bands, axis=-1), rows.source)
    column0, column1 = type(bands)(*(table[:, i] for i in range(len(bands)))).columns(row, grid)
    # from rows to the tiles of their spans
    pairs = expand(
        jnp.where(slot < rows.needed, jnp.maximum(column1 - column0 + 1, 0), 0), max_pairs
    )

    slot = jnp.arange(max_pairs, dtype=jnp.int32)
    table = take(
        jnp.stack([row * grid.columns + column0 - pairs.first, rows.source], axis=-1), pairs.source
    )
    tiles = jnp.where(slot < pairs.needed, table[:, 0] + slot, grid.tiles)
    # If rows are missing, so are their pairs, and they are counted row by row; otherwise this loop
    # runs zero times.
    missing = rows.needed > max_rows
    recount = _count_row_by_row(footprints, grid, jnp.where(missing, jnp.max(counts, initial=0), 0))
    needed = jnp.where(missing, recount, pairs.needed)
    return Pairs(tiles, table[:, 1], needed, needed - jnp.minimum(pairs.needed, max_pairs))


def _first(v: Array, tile_size: int, tiles: Size) -> Array:
    """Returns the first column (or row) of tiles whose last pixel centre lies at v - `SLACK` or
    beyond, clipped to [0, tiles]. v: x (or y), pixels.
    """
    return jnp.clip(jnp.ceil((v - (tile_size - 0.5) - SLACK) / tile_size), 0, tiles).astype(
        jnp.int32
    )


def _last(v: Array, tile_size: int, tiles: Size) -> Array:
    """Returns the last column (or row) of tiles whose first pixel centre lies at v + `SLACK` or
    before, clipped to [-1, tiles - 1]. v: x (or y), pixels.
    """
    return jnp.clip(jnp.floor((v - 0.5 + SLACK) / tile_size), -1, tiles - 1).astype(jnp.int32)


def _count_row_by_row(footprints: Footprints | Squares, grid: TileGrid, most_rows: Array) -> Array:
    """Returns the number of pairs of all splats. A loop counts first the pairs in each splat's
    first row of tiles, then those in its second row, and so on.
    """
    bands = footprints.bands()
    first, counts = footprints.rows(grid)

    def count(i, total):
        column0, column1 = bands.columns(first + i, grid)
        here = jnp.where(i < counts, jnp.maximum(column1 - column0 + 1, 0), 0)
        return jnp.minimum(total + _saturating_sum(here), SUM_LIMIT)

    return lax.fori_loop(0, most_rows, count, jnp.zeros((), jnp.int32))


def _saturating_sum(x: Array) -> Array:
    fits = jnp.sum(x.astype(jnp.float32)) < SUM_LIMIT
    return jnp.where(fits, jnp.sum(x, dtype=jnp.int32), SUM_LIMIT)
