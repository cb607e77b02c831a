"""Work done over work needed: how much of what a splatting renderer evaluates contributes to the image.

    python experiments/splatting/work.py --scene S.npz --size 512 [--json OUT]
    python experiments/splatting/work.py --scene demo --size 512

Needed are the (pixel, Gaussian) pairs that contribute: alpha at least alpha_min, the pixel not ended before. Done is what
each idea evaluates, one after the other: Gaussians culled against tiles of 8, 16 and 32 pixels by a square of 3 standard
deviations (INRIA), by one that ends where the Gaussian's own alpha does, and by that ellipse; then the lists cut into
chunks and drawn in blocks of tiles that work as long as their longest list, with and without stopping once all pixels of
a block have ended; then how full the buffers are. Counted in numpy from the lists that the renderer makes: 10 s.

Expected for 52,375 Gaussians of a person at 512: the square of 3 sigma evaluates 10 times what is needed on tiles of 8
pixels and 18 times on tiles of 16; exact lists on tiles of 8, in blocks of 32 that stop, 6 times.
"""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[2]))
from experiments.common.results import markdown_table, write_json
from experiments.splatting.scenes import Scene, load_scene

if TYPE_CHECKING:
    from humangs_jax.rendering.projection import ProjectedGaussians

TILE_SIZES = (8, 16, 32)
BLOCKS = (16, 32, 64)
INRIA_SIGMAS = 3.0


class Lists(NamedTuple):
    """The lists of the tiles of one size, nearest first.

    planes: (6, g) x, y, xy, yy, determinant (pixels) and opacity of the sorted Gaussians. items: (pairs,).
    starts, counts: (t,). rows: (splat, row of tiles) pairs.
    """

    planes: np.ndarray
    items: np.ndarray
    starts: np.ndarray
    counts: np.ndarray
    rows: int


class TileWork(NamedTuple):
    """What lists hold, tile by tile (t,): (pixel, Gaussian) pairs that contribute; those whose alpha is not skipped;
    how much of the list is used before all pixels of the tile have ended.
    """

    contributing: np.ndarray
    visible: np.ndarray
    used: np.ndarray


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scene", nargs="+", required=True, help="npz files of scenes, or 'demo'")
    parser.add_argument("--size", type=int, nargs="+", default=[512], help="sides of the image, pixels")
    parser.add_argument("--json", type=Path, help="write the numbers here")
    arguments = parser.parse_args()
    results = [count(load_scene(scene, size)) for scene in arguments.scene for size in arguments.size]
    print(table(results))
    if arguments.json:
        write_json(arguments.json, results)


def count(scene: Scene) -> dict[str, Any]:
    """All numbers of one scene: {"needed", "done": {idea: {tile size: pixel-Gaussian pairs}}, ...}."""
    from humangs_jax.rendering.splat_config import SplatConfig
    from humangs_jax.rendering.splatting import plan_buffers

    config = SplatConfig()
    projected, reach = projected_splats(scene, config)
    squares = culling_squares(projected, reach)
    done = {f"{name}, tiles": {} for name in squares} | {"exact ellipses, tiles": {}}
    pairs, blocks = {name: {} for name in done}, {}
    for size in TILE_SIZES:
        for name, half in squares.items():
            pairs[f"{name}, tiles"][size] = tiles_met(projected, *half, scene.size, size)
        lists = make_lists(scene, config, size)
        pairs["exact ellipses, tiles"][size] = len(lists.items)
        drawn = draw_lists(lists, scene.size, size, config)
        for block in BLOCKS:
            for stop in (False, True):
                name = f"exact ellipses, blocks of {block}" + (", early stop" if stop else "")
                lengths = drawn.used if stop else lists.counts
                steps = block_steps(lists.counts, lengths, block, config.chunk)
                blocks.setdefault(name, {})[size] = steps * size**2
        if size == config.tile_size:
            needed, visible, counts, rows = drawn.contributing.sum(), drawn.visible.sum(), lists.counts, lists.rows
    for name, of_size in pairs.items():
        done[name] = {size: number * size**2 for size, number in of_size.items()}
    planned = plan_buffers(scene.gaussians(), scene.camera())
    return {
        "scene": scene.kind,
        "size": scene.size,
        "gaussians": len(scene.means),
        "needed": int(needed),
        "visible": int(visible),
        "tile_pairs": pairs,
        "done": done | blocks,
        "longest_list": int(counts.max()),
        "tiles": len(counts),
        "tiles_not_empty": int((counts > 0).sum()),
        "capacity": {
            "pairs": [int(counts.sum()), planned.max_pairs],
            "rows": [rows, planned.max_rows],
        },
    }


def tile_work(scene: Scene, config: Any, dtype: type = np.float32) -> dict[str, float]:
    """What one config makes of a scene, for a benchmark's report."""
    scene = scene.resized(max(1, round(scene.size * config.scale)))
    lists = make_lists(scene, config, config.tile_size, dtype)
    drawn = draw_lists(lists, scene.size, config.tile_size, config)
    pixels = config.tile_size**2
    needed = int(drawn.contributing.sum())
    evaluated = block_steps(lists.counts, drawn.used, config.block, config.chunk) * pixels
    return {
        "contributing_pairs": needed,
        "tile_pairs": len(lists.items),
        "tile_pairs_capacity": config.max_pairs,
        "tile_rows": lists.rows,
        "tile_rows_capacity": config.max_rows,
        "tiles_not_empty": int((lists.counts > 0).sum()),
        "longest_list": int(lists.counts.max(initial=0)),
        "pixel_pairs_in_lists": len(lists.items) * pixels,
        "pixel_pairs_evaluated": evaluated,
        "evaluated_over_contributing": round(evaluated / max(needed, 1), 2),
    }


def projected_splats(scene: Scene, config: Any, dtype: type = np.float32) -> tuple["ProjectedGaussians", np.ndarray]:
    """The 2D Gaussians, and the squared distance in standard deviations at which each ends; 0: not drawn."""
    import jax

    from humangs_jax.rendering.projection import project, squared_reach

    @jax.jit
    def run(gaussians, camera):
        projected = project(
            gaussians, camera, config.near, config.eps2d, config.jacobian_margin, config.normalize_quats
        )
        return projected, squared_reach(gaussians.opacities, config.alpha_min)

    projected, reach = run(scene.gaussians(dtype), scene.camera(dtype))
    reach = np.where(projected.visible, reach, 0)
    if config.radius_sigma is not None:
        reach = np.minimum(reach, config.radius_sigma**2)
    return projected, np.where(scene.opacities >= config.opacity_min, reach, 0)


def culling_squares(projected: "ProjectedGaussians", reach: np.ndarray) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Half widths and half heights of the boxes that culling tests against tiles, pixels; negative: not drawn."""
    xx, xy, yy = (np.asarray(plane, np.float64) for plane in (projected.xx, projected.xy, projected.yy))
    larger = 0.5 * (xx + yy) + np.sqrt(0.25 * (xx - yy) ** 2 + xy**2)
    drawn = reach > 0
    three_sigma = np.where(drawn, np.ceil(INRIA_SIGMAS * np.sqrt(larger)), -1e9)
    width, height = (np.where(drawn, np.sqrt(reach * variance), -1e9) for variance in (xx, yy))
    return {"square of 3 sigma": (three_sigma, three_sigma), "opacity-aware box": (width, height)}


def tiles_met(
    projected: "ProjectedGaussians", half_width: np.ndarray, half_height: np.ndarray, size: int, tile_size: int
) -> int:
    """How many (tile, box) pairs intersect, counting tiles by the rectangle of their pixel centres."""
    number = 1
    for center, half in ((projected.x, half_width), (projected.y, half_height)):
        center, last = np.asarray(center, np.float64), -(-size // tile_size) - 1
        first_tile = np.ceil((center - half + 0.5) / tile_size - 1).clip(0, last + 1)
        last_tile = np.floor((center + half - 0.5) / tile_size).clip(-1, last)
        number = number * np.maximum(last_tile - first_tile + 1, 0)
    return int(number.sum())


def make_lists(scene: Scene, config: Any, tile_size: int, dtype: type = np.float32) -> Lists:
    """The lists that the renderer makes, by its own binning."""
    import jax
    import jax.numpy as jnp

    from humangs_jax.rendering import binning
    from humangs_jax.rendering.tiling import TileGrid, sort_into_tiles

    projected, reach = projected_splats(scene, config, dtype)
    grid = TileGrid(scene.size, scene.size, tile_size)

    @jax.jit
    def sort_by_depth(projected, reach):
        order = binning.depth_order(jnp.where(projected.visible, projected.depths, jnp.inf))
        if config.square:
            footprints = binning.square_footprints(projected, reach, config.radius_sigma)
        else:
            footprints = binning.footprints(projected, reach)
        footprints = jax.tree.map(lambda plane: plane[order], footprints)
        return order, footprints, binning.count_pairs(footprints, grid)

    order, footprints, (rows, needed) = sort_by_depth(projected, reach)

    @jax.jit
    def sort_by_tile(footprints):
        pairs = binning.emit_pairs(footprints, grid, max(int(rows), 1), max(int(needed), 1))
        return sort_into_tiles(pairs.tiles, pairs.splats, grid.tiles, len(order))

    items, starts, counts = (np.asarray(array) for array in sort_by_tile(footprints))
    p = projected
    planes = np.stack([p.x, p.y, p.xy, p.yy, p.determinant, scene.opacities]).astype(np.float64)[:, np.asarray(order)]
    return Lists(planes, items[: int(needed)], starts, counts, int(rows))


def draw_lists(lists: Lists, size: int, tile_size: int, config: Any) -> TileWork:
    """Counts what contributes, tile by tile, in float64."""
    columns = -(-size // tile_size)
    pixel = np.arange(tile_size) + 0.5
    work = np.zeros((3, len(lists.counts)), np.int64)
    for tile in np.flatnonzero(lists.counts):
        start, length = lists.starts[tile], lists.counts[tile]
        x, y, xy, yy, determinant, opacity = lists.planes[:, lists.items[start : start + length], None, None]
        dx = pixel + tile % columns * tile_size - x
        dy = (pixel + tile // columns * tile_size)[:, None] - y
        across = yy * dx - xy * dy
        alpha = opacity * np.exp(-0.5 * (across**2 / (yy * determinant) + dy**2 / yy))
        alpha = np.where(alpha < config.alpha_min, 0, np.minimum(alpha, config.alpha_max)).reshape(length, -1)
        open_ = np.cumprod(1 - alpha, axis=0) > config.transmittance_stop  # of those that went on before
        used = min(length, int(open_.sum(axis=0).max()) + 1)
        inside = pixel + tile % columns * tile_size < size, pixel + tile // columns * tile_size < size
        seen = (alpha > 0) & (inside[0] & inside[1][:, None]).ravel()
        work[:, tile] = (seen & open_).sum(), seen.sum(), used
    return TileWork(*work)


def block_steps(counts: np.ndarray, used: np.ndarray, block: int, chunk: int) -> int:
    """Splats that all tiles together take if tiles of like length go in blocks, as long as a block's neediest tile."""
    order = np.argsort(-counts, kind="stable")
    used = used[order][: int((counts > 0).sum())]
    used = np.pad(used, (0, -len(used) % block)).reshape(-1, block)
    return int((-(-used.max(axis=1, initial=0) // chunk) * chunk * block).sum())


def table(results: Sequence[dict[str, Any]]) -> str:
    """Markdown: for every idea and scene the ratio of done to needed by tile size."""
    name = lambda r: f"{r['scene']} {r['size']}"
    header = ["pixel-Gaussian pairs evaluated / contributing", *(f"{name(r)}: T = 8; 16; 32" for r in results)]
    rows = [["contributing, millions", *(f"{r['needed'] / 1e6:.2f}" for r in results)]]
    rows.append(["alpha at least 1/255, of these", *(f"{r['visible'] / r['needed']:.1f}" for r in results)])
    for idea in results[0]["done"]:
        rows.append([idea, *("; ".join(f"{n / r['needed']:.1f}" for n in r["done"][idea].values()) for r in results)])
    lists = lambda r: (
        f"{r['tile_pairs']['exact ellipses, tiles'][8]:,}; {r['longest_list']:,}; {r['tiles_not_empty']:,}"
    )
    rows.append(["(tile, splat) pairs; longest list; tiles that hold something (T = 8)", *map(lists, results)])
    full = lambda r: "; ".join(f"{used / size:.0%}" for used, size in r["capacity"].values())
    rows.append(["how full the planned buffers are: pairs; rows", *map(full, results)])
    return markdown_table(header, rows)


if __name__ == "__main__":
    sys.exit(main())
