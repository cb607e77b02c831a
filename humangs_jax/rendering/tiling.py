"""Tiles: which items (splats, triangles) touch which square of pixels, one list per tile in one buffer of fixed size.

A rasterizer uses it in five steps, all with static shapes:

1. count, for every item, how many tiles it touches, and `expand` the counts: slot -> item (in one step, or item -> rows
   of tiles -> tiles). From the slot's place among the item's slots follows its tile; slots that are not needed get tile
   `grid.tiles`.
2. `sort_into_tiles`: the (tile, item) pairs by tile, and by item number inside a tile. Number the items by depth first
   and every list runs front to back.
3. `blocks_by_length`: tiles by falling list length, so that a block of consecutive ones has lists of about the same
   length, and empty tiles come last and are never visited.
4. the rasterizer's own loop over blocks, and over chunks of the lists of a block; pixels of a tile are one axis of
   `tile_size`^2 values, row by row, at `grid.offsets` from the tile's centre in `grid.centers`.
5. `tiles_to_image`, and `image_to_tiles` for gradients.

What does not fit in a buffer is counted: `Expansion.needed` is exact whatever the capacity. Image sizes need not be
multiples of the tile size: the last row and column of tiles reach beyond the image, and those pixels are cut off.
"""

import dataclasses
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import lax

from humangs_jax.core.array_types import Array, Float, Int, Shaped, UInt

SUM_LIMIT = 1 << 30
"""Running sums stop here instead of wrapping past 2^31: far above any buffer, so a sum there only says "too many"."""

_ROW = 64
"""Width of the triangular products in `cumsum`: 64 numbers below 2^18 add up exactly in float32."""


@dataclasses.dataclass(frozen=True)
class TileGrid:
    """An image cut into squares of `tile_size` pixels, numbered row by row. Static (hashable)."""

    width: int
    height: int
    tile_size: int

    @property
    def columns(self) -> int:
        """Tiles per row of tiles."""
        return -(-self.width // self.tile_size)

    @property
    def rows(self) -> int:
        """Rows of tiles."""
        return -(-self.height // self.tile_size)

    @property
    def tiles(self) -> int:
        """Number of tiles; also the tile number of "no tile"."""
        return self.columns * self.rows

    @property
    def pixels(self) -> int:
        """Pixels per tile."""
        return self.tile_size**2

    def offsets(self, dtype: np.dtype | type = np.float32) -> np.ndarray:
        """(2, pixels): x and y of a tile's pixel centres, from the tile's centre. Small: moments stay accurate."""
        pixel = np.arange(self.pixels)
        offsets = np.stack([pixel % self.tile_size, pixel // self.tile_size]) + 0.5 - self.tile_size / 2
        return offsets.astype(dtype)

    def centers(self, dtype: np.dtype | type = np.float32) -> np.ndarray:
        """(t, 2): x and y of the tiles' centres, pixels."""
        tile = np.arange(self.tiles)
        corners = np.stack([tile % self.columns, tile // self.columns], axis=-1) * self.tile_size
        return (corners + self.tile_size / 2).astype(dtype)


class Expansion(NamedTuple):
    """Slots divided among items, item by item.

    source: (capacity,) item of each slot; of slots >= needed, the last item.
    first: (n,) first slot of each item, so that slot - first[source] counts the slots of one item.
    needed: slots asked for, whatever the capacity (saturates at `SUM_LIMIT`). Slot s is used if s < needed.
    """

    source: Int[Array, " capacity"]
    first: Int[Array, " n"]
    needed: Int[Array, ""]


class TileLists(NamedTuple):
    """For each tile a list of items: items[starts[t] : starts[t] + counts[t]], ascending.

    items: (capacity,). starts, counts: (t,).
    """

    items: Int[Array, " capacity"]
    starts: Int[Array, " t"]
    counts: Int[Array, " t"]


class TileBlocks(NamedTuple):
    """Tiles by falling list length, padded to whole blocks.

    tiles: (blocks * block,) tile numbers; the padding has the number "no tile" (t), which is out of bounds on purpose:
    gather with a fill value, scatter with mode="drop". used: how many blocks hold a tile whose list is not empty.
    """

    tiles: Int[Array, " t_padded"]
    used: Int[Array, ""]


def cumsum(x: Int[Array, " n"]) -> Int[Array, " n"]:
    """Inclusive running sum of int32 numbers >= 0, saturating at `SUM_LIMIT`.

    Any 64 consecutive ones must sum to less than 2^24. Three levels: rows of 64 by a triangular matrix product, rows of
    64 of their totals likewise, and the few numbers left by comparing all with all. Faster than `jnp.cumsum` on a CPU
    and, which matters more, it neither wraps nor has logarithmically many steps to compile.
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
    before = jnp.where(fits, jnp.sum(jnp.where(earlier, last, 0), axis=1, dtype=jnp.int32), SUM_LIMIT)
    starts = jnp.minimum((middle + before[:, None]).reshape(-1)[: totals.shape[0]] - totals, SUM_LIMIT)
    return jnp.minimum(within + starts[:, None], SUM_LIMIT).reshape(-1)[:n]


def _in_rows(x):
    return jnp.pad(x, (0, -x.shape[0] % _ROW)).reshape(-1, _ROW)


def _sums_in_rows(rows):
    """Running sums along each row, exact while they stay below 2^24."""
    triangle = jnp.triu(jnp.ones((_ROW, _ROW), jnp.float32))
    return jnp.matmul(rows.astype(jnp.float32), triangle, precision=lax.Precision.HIGHEST).astype(jnp.int32)


def expand(counts: Int[Array, " n"], capacity: int) -> Expansion:
    """Divides `capacity` slots: item i takes the next counts[i] >= 0 of them. For the counts, the limits of `cumsum` hold."""
    if counts.shape[0] == 0:
        return Expansion(jnp.zeros(capacity, jnp.int32), counts, jnp.zeros((), jnp.int32))
    end = materialized(cumsum(counts))
    first = end - counts
    return Expansion(owners(first, capacity), first, end[-1])


def owners(first: Int[Array, " n"], size: int, start: Int[Array, ""] | int = 0) -> Int[Array, " size"]:
    """Which item owns each of the slots start .. start + size, if item i owns those from first[i] to first[i + 1].

    As many items begin at or before a slot as the running sum of marks says, and the last of them owns the slot: items
    without slots begin together with the next one that has any. (Exact below 2^24 items, see `cumsum`.)
    """
    marks = jnp.zeros(size, jnp.int32).at[jnp.maximum(first - start, 0)].add(1, mode="drop")
    return materialized(cumsum(marks) - 1)


def take(table: Shaped[Array, "n *rest"], indices: Int[Array, " slots"]) -> Shaped[Array, "slots *rest"]:
    """Rows of a table at indices that are known to be in range: no clamping, no wrapping of negative ones."""
    return materialized(table).at[indices].get(mode="promise_in_bounds", wrap_negative_indices=False)


def materialized(array: Shaped[Array, "*shape"]) -> Shaped[Array, "*shape"]:
    """The same numbers, stored before they are used.

    XLA's CPU backend would evaluate the expression behind a table anew for each number that a gather takes from it.
    It respects the barrier where a program is compiled with `core.compiling`.
    """
    return lax.optimization_barrier(array)


def bits_for(count: int) -> int:
    """Bits that hold the numbers 0 .. count - 1 (at least one)."""
    return max(1, (count - 1).bit_length())


def sort_keys(keys: UInt[Array, " n"]) -> UInt[Array, " n"]:
    """Ascending. Equal keys are identical, so a sort need not be stable; XLA's stable sort is a third faster on CPUs, and
    elsewhere has to carry the positions along.
    """
    return lax.platform_dependent(keys, cpu=jnp.sort, default=lambda keys: lax.sort(keys, is_stable=False))


def sort_into_tiles(
    tiles: Int[Array, " capacity"], items: Int[Array, " capacity"], tile_count: int, item_count: int
) -> TileLists:
    """Pairs (tile, item) -> lists by tile, ascending by item. Pairs of tile `tile_count` ("no tile") are left out.

    One sort of one uint32 where the tile number and the item number fit it together (sorting a key with a payload costs
    several times as much); otherwise a sort by two keys.
    """
    bits = bits_for(item_count)
    if (tile_count + 1) << bits <= 1 << 32:
        key = tiles.astype(jnp.uint32) << bits | items.astype(jnp.uint32)
        sorted_items = (sort_keys(key) & ((1 << bits) - 1)).astype(jnp.int32)
    else:
        sorted_items = lax.sort((tiles, items), num_keys=2, is_stable=False)[1]
    counts = jnp.zeros(tile_count, jnp.int32).at[tiles].add(1, mode="drop")
    starts = jnp.cumsum(counts, dtype=jnp.int32) - counts
    return TileLists(sorted_items, starts, counts)


def blocks_by_length(counts: Int[Array, " t"], block: int) -> TileBlocks:
    """Tiles in blocks of `block`, by falling list length; equal ones, and ones too long for the key, by number."""
    t = counts.shape[0]
    bits = bits_for(t)
    longest = (1 << (32 - bits)) - 1
    key = (longest - jnp.minimum(counts.astype(jnp.uint32), longest)) << bits | jnp.arange(t, dtype=jnp.uint32)
    tiles = (sort_keys(key) & ((1 << bits) - 1)).astype(jnp.int32)
    tiles = jnp.pad(tiles, (0, -t % block), constant_values=t)
    used = jnp.sum(counts > 0, dtype=jnp.int32)
    return TileBlocks(tiles, (used + block - 1) // block)


def image_to_tiles(image: Float[Array, "h w c"], grid: TileGrid) -> Float[Array, "t c p"]:
    """The pixels of each tile, channel by channel; 0 beyond the image."""
    size, c = grid.tile_size, image.shape[-1]
    image = jnp.pad(image, ((0, grid.rows * size - grid.height), (0, grid.columns * size - grid.width), (0, 0)))
    tiles = image.reshape(grid.rows, size, grid.columns, size, c).transpose(0, 2, 4, 1, 3)
    return tiles.reshape(grid.tiles, c, grid.pixels)


def tiles_to_image(tiles: Float[Array, "t c p"], grid: TileGrid) -> Float[Array, "h w c"]:
    """Inverse of `image_to_tiles`; pixels beyond the image are cut off."""
    size, c = grid.tile_size, tiles.shape[1]
    image = tiles.reshape(grid.rows, grid.columns, c, size, size).transpose(0, 3, 1, 4, 2)
    return image.reshape(grid.rows * size, grid.columns * size, c)[: grid.height, : grid.width]
