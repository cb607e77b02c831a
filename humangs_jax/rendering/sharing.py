"""One image drawn by several devices: each draws every n-th row of tiles, so that all have about the same work.

Every device projects all Gaussians and keeps the pairs of its own rows; rows are joined, the largest weights and the counts of
missing pairs are reduced over the devices.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jax.sharding import Mesh
from jax.sharding import PartitionSpec as P

from humangs_jax.rendering.binning import WHOLE, Share
from humangs_jax.rendering.splat_config import SplatConfig
from humangs_jax.rendering.tiling import TileGrid


def device_count(mesh: Mesh | None) -> int:
    """Devices that share an image. Raises: ValueError if the mesh has several axes."""
    if mesh is None:
        return 1
    if len(mesh.axis_names) != 1:
        raise ValueError(f"mesh: expected one axis, got {mesh.axis_names}")
    return mesh.size


def draw_shared(
    draw: Callable[..., tuple], mesh: Mesh | None, footprints: Any, splats: Any, grid: TileGrid, config: SplatConfig
) -> tuple:
    """`draw(footprints, splats, grid, config, share)`, shared among the devices of a mesh.

    draw: returns features (t, c, p), final transmittance (t, 1, p), largest weights (g,) and overflow (), of the rows of
    tiles that `share` names. mesh: of one axis; None: one device draws them all.
    """
    if mesh is None:
        return draw(footprints, splats, grid, config, WHOLE)
    (axis,), n = mesh.axis_names, mesh.size
    each = -(-grid.rows // n)
    mesh = Mesh(mesh.devices, mesh.axis_names)  # automatic axes: the compiler shards what lies outside of `one`

    def one(footprints, splats):
        share = Share(lax.axis_index(axis), n)
        *tiles, peaks, overflow = draw(footprints, splats, grid, config, share)
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
