"""Where the time of splatting goes: its stages, each compiled by itself, in turns with the whole.

    python experiments/splatting/stages.py --scene S.npz --size 512 [--json OUT] [--page docs/performance.md]
    python experiments/splatting/stages.py --scene demo

Stages: projection of the Gaussians; their order by depth; (tile, splat) pairs; the lists of the tiles (one sort); rows of
numbers in depth order; compositing; joining the tiles to an image; and with gradients the cotangents cut into tiles,
compositing again, and the gradient of projection and rows. Half a minute. Expected: compositing takes two fifths of a
forward pass, and with its gradient three fifths of forward+backward; the stages add up to the whole within a tenth.
"""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[2]))
from experiments.common.interleaved import medians, prepare_process
from experiments.common.results import add_outputs, markdown_table, write_outputs
from experiments.splatting.benchmark import DIRECTIONS, compiled
from experiments.splatting.scenes import Scene, load_scene, make_target

FORWARD = ("project", "depth order", "pairs", "lists", "rows", "composite", "image")
BACKWARD = ("cotangents", "composite backward", "project backward")


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scene", nargs="+", required=True, help="npz files of scenes, or 'demo'")
    parser.add_argument("--size", type=int, nargs="+", default=[512], help="sides of the image, pixels")
    parser.add_argument("--repeats", type=int, default=11, help="timed iterations")
    add_outputs(parser, "splatting_stages")
    arguments = parser.parse_args()
    prepare_process()
    results = [measure(load_scene(s, size), arguments.repeats) for s in arguments.scene for size in arguments.size]
    write_outputs(arguments, "splatting_stages", table(results), results)


def measure(scene: Scene, repeats: int) -> dict[str, Any]:
    """{"scene", "size", "cpu_ms": {stage: number}}."""
    from humangs_jax.rendering.splatting import plan_buffers

    config = plan_buffers(scene.gaussians(), scene.camera(), margin=1.0)
    runs = stages(scene, config) | compiled(scene, make_target(scene.size), config)[0]
    times = {name: float(cpu) for name, (_, cpu) in medians(runs, repeats).items()}
    return {"scene": scene.kind, "size": scene.size, "cpu_ms": times}


def stages(scene: Scene, config: Any) -> dict[str, Any]:
    """Functions without arguments, by stage, in the order of the work. One device, exact footprints."""
    import jax
    import jax.numpy as jnp

    from humangs_jax.core.compiling import compiler_options
    from humangs_jax.rendering import binning
    from humangs_jax.rendering.compositing import pack_splats
    from humangs_jax.rendering.projection import project, squared_reach
    from humangs_jax.rendering.schedules import fat_chunks, small_blocks
    from humangs_jax.rendering.tiling import TileGrid, image_to_tiles, sort_into_tiles, tiles_to_image

    on_cpu = jax.default_backend() == "cpu"
    schedule, runs = small_blocks if on_cpu else fat_chunks, {}

    def stage(name, function, *arguments):
        program = jax.jit(function, compiler_options=compiler_options())
        program = program.lower(*arguments).compile()
        runs[name] = lambda: jax.block_until_ready(program(*arguments))
        return program(*arguments)

    def footprints(projected, opacities, order):
        ellipses = binning.footprints(projected, squared_reach(opacities, config.alpha_min))
        return jax.tree.map(lambda plane: plane[order], ellipses)

    def rows(projected, gaussians, order):
        seen = jnp.concatenate([gaussians.colors, projected.depths[:, None]], axis=-1)
        splats = pack_splats(projected, gaussians.opacities, seen, config.alpha_min)
        return splats.at[order].get(unique_indices=True, mode="promise_in_bounds")

    def drawn(gaussians, order):
        return rows(project(gaussians, camera), gaussians, order)

    gaussians, camera = scene.gaussians(), scene.camera()
    grid = TileGrid(scene.size, scene.size, config.tile_size)
    projected = stage("project", lambda g: project(g, camera), gaussians)
    order = stage("depth order", binning.depth_order, projected.depths)
    pairs = stage(
        "pairs",
        lambda *a: binning.emit_pairs(footprints(*a), grid, config.max_rows, config.max_pairs),
        *(projected, gaussians.opacities, order),
    )
    count = len(scene.means)
    lists = stage("lists", lambda *a: sort_into_tiles(*a, grid.tiles, count), pairs.tiles, pairs.splats)
    splats = stage("rows", rows, projected, gaussians, order)
    features, transmittance, used, _ = stage("composite", schedule.forward(grid, config), splats, *lists)
    stage("image", lambda f, t: (tiles_to_image(f, grid), tiles_to_image(t[:, None], grid)), features, transmittance)

    image = jnp.asarray(make_target(scene.size) / scene.size**2)
    image = jnp.concatenate([image, jnp.zeros_like(image[..., :2])], axis=-1)

    def cotangents(image, features):
        g = image_to_tiles(image, grid)[:, :4]
        return g, jnp.sum(g * features, axis=1)

    g, total = stage("cotangents", cotangents, image, features)
    backward = schedule.backward(grid, config)
    sums = stage("composite backward", backward, splats, lists.items, lists.starts, used, g, total)
    stage(
        "project backward",
        lambda gaussians, order, sums: jax.vjp(lambda g: drawn(g, order), gaussians)[1](sums),
        *(gaussians, order, sums),
    )
    return runs


def table(results: Sequence[dict[str, Any]]) -> str:
    """Markdown: CPU ms by stage; the sums beside what the whole takes."""
    rows = [[name, *(f"{r['cpu_ms'][name]:.1f}" for r in results)] for name in FORWARD + BACKWARD]
    for whole, parts in zip(DIRECTIONS, (FORWARD, FORWARD + BACKWARD), strict=True):
        sums = (f"{sum(r['cpu_ms'][part] for part in parts):.0f}; {r['cpu_ms'][whole]:.0f}" for r in results)
        rows.append([f"{whole.replace('_', '+')}: sum of its stages; in one program", *sums])
    return markdown_table(["CPU ms", *(f"{r['scene']} {r['size']}" for r in results)], rows)


if __name__ == "__main__":
    sys.exit(main())
