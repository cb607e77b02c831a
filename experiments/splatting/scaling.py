"""How the time of splatting grows with pixels, Gaussians and views.

    python experiments/splatting/scaling.py --scene S.npz --size 512 [--json OUT] [--image OUT.png]
        [--page docs/performance.md]
    python experiments/splatting/scaling.py --scene demo --image docs/images/splatting_scaling.png

Pixels: the same view at 128 to 1024. Gaussians: random subsets of 1/8 to all of them, and all of them twice, the copies
moved by a quarter of their size. Views: 1 to 8 cameras side by side (so that all have the same to draw) at half the
size, one after the other (`render_views`) and at once (`jax.vmap`). Fits the slope of log CPU time over log size: 1 is
linear growth. 4 minutes. Expected: 0.3 over pixels, 0.9 over Gaussians, 1 over views.
"""

import argparse
import gc
import json
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[2]))
from experiments.common.interleaved import medians, prepare_process
from experiments.common.results import add_outputs, markdown_table, write_outputs
from experiments.splatting.benchmark import DIRECTIONS, compiled
from experiments.splatting.scenes import PARAMETERS, Scene, load_scene, make_target, orbiting

SIZES = (128, 256, 512, 1024)
FRACTIONS = (0.125, 0.25, 0.5, 1.0, 2.0)
VIEWS = (1, 2, 4, 8)
VIEW_ANGLE = 0.01
"""Radians from one camera to the next."""
TICKS = (10, 20, 50, 100, 200, 500, 1000)
PANELS = {"pixels": "pixels", "gaussians": "Gaussians", "views, render_views": "views", "views, vmap": "views"}


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scene", help="npz of a scene, or 'demo'")
    parser.add_argument("--measured", type=Path, help="JSON of an earlier run, instead of a scene")
    parser.add_argument("--size", type=int, default=512, help="side of the image where pixels are not what grows")
    parser.add_argument("--repeats", type=int, default=7, help="timed iterations")
    add_outputs(parser, "splatting_scaling")
    parser.add_argument("--image", "--picture", type=Path, help="draw the growth here")
    arguments = parser.parse_args()
    if bool(arguments.scene) == bool(arguments.measured):
        parser.error("give either --scene or --measured")
    if arguments.measured:
        result = json.loads(arguments.measured.read_text())
    else:
        prepare_process()
        result = measure(load_scene(arguments.scene, arguments.size), arguments.repeats)
    write_outputs(arguments, "splatting_scaling", table(result), result)
    if arguments.image:
        draw(result, arguments.image)


def measure(scene: Scene, repeats: int) -> dict[str, Any]:
    """{"series": {panel: [{"size", "forward_ms", ..., "temporary_mb"}]}, "slopes": {panel: {direction: slope}}}."""
    from humangs_jax.rendering.splatting import plan_buffers

    series: dict[str, list[dict[str, Any]]] = {}

    def one(panel: str, size: float, scene: Scene) -> None:
        config = plan_buffers(scene.gaussians(), scene.camera(), margin=1.0)
        programs, facts = compiled(scene, make_target(scene.size), config)
        _append(series, panel, size, programs, facts, repeats)

    for size in SIZES:
        one("pixels", size**2, scene.resized(size))
    for fraction in FRACTIONS:
        part = thinned(scene, fraction)
        one("gaussians", len(part.means), part)
    small = scene.resized(scene.size // 2)
    for views in VIEWS:
        for panel, at_once in (("views, render_views", False), ("views, vmap", True)):
            _append(series, panel, views, *compiled_views(small, views, at_once), repeats)
    slopes = {panel: {name: slope(rows, name) for name in DIRECTIONS} for panel, rows in series.items()}
    return {"scene": scene.kind, "size": scene.size, "gaussians": len(scene.means), "series": series, "slopes": slopes}


def thinned(scene: Scene, fraction: float) -> Scene:
    """A random subset; above 1: with jittered copies."""
    rng = np.random.default_rng(0)
    g = len(scene.means)
    chosen = rng.permutation(np.resize(np.arange(g), round(g * fraction)) if fraction > 1 else g)[: round(g * fraction)]
    part = scene._replace(**{name: getattr(scene, name)[chosen] for name in PARAMETERS})
    if fraction <= 1:
        return part
    moved = part.means + 0.25 * part.scales * rng.normal(size=part.means.shape)
    return part._replace(means=moved.astype(np.float32))


def compiled_views(scene: Scene, views: int, at_once: bool) -> tuple[dict[str, Callable[[], Any]], dict[str, Any]]:
    """Programs that draw all views, by `jax.vmap` or by `render_views`, as `compiled` makes for one."""
    import jax
    import jax.numpy as jnp

    from humangs_jax.core.compiling import compiler_options
    from humangs_jax.rendering.splatting import plan_buffers, render, render_views

    gaussians, cameras = scene.gaussians(), orbiting(scene, VIEW_ANGLE * np.arange(views))
    config, black = plan_buffers(gaussians, cameras, margin=1.0), jnp.zeros(3)
    goal = jnp.asarray(make_target(scene.size))

    def forward(gaussians):
        if at_once:
            return jax.vmap(lambda camera: render(gaussians, camera, config, black))(cameras)
        return render_views(gaussians, cameras, config, black)

    def loss(gaussians):
        return jnp.mean((forward(gaussians).rgb - goal) ** 2)

    options = compiler_options()
    programs, facts = {}, {}
    for name, function in zip(DIRECTIONS, (forward, jax.value_and_grad(loss)), strict=True):
        program = jax.jit(function, compiler_options=options).lower(gaussians).compile()
        programs[name] = lambda program=program: jax.block_until_ready(program(gaussians))
        memory = program.memory_analysis()
        facts[name] = {"temporary_mb": memory.temp_size_in_bytes / 2**20 if memory else float("nan")}
    return programs, facts


def _append(series, panel, size, programs, facts, repeats):
    row = {"size": size}
    for name, (wall, cpu) in medians(programs, repeats).items():
        row |= {f"{name}_ms": wall, f"{name}_cpu_ms": cpu, f"{name}_temporary_mb": facts[name]["temporary_mb"]}
    series.setdefault(panel, []).append(row)
    print(panel, size, " ".join(f"{row[f'{name}_cpu_ms']:.1f}" for name in DIRECTIONS), flush=True)
    programs.clear()
    gc.collect()


def slope(rows: Sequence[dict[str, Any]], name: str) -> float:
    """Of log CPU time over log size, by least squares."""
    size, time = np.log([(row["size"], row[f"{name}_cpu_ms"]) for row in rows]).T
    return float(np.polyfit(size, time, 1)[0])


def table(result: dict[str, Any]) -> str:
    """Markdown."""
    header = [
        "growth with",
        "sizes",
        "forward, CPU ms",
        "slope",
        "forward+backward, CPU ms",
        "slope",
        "temporaries, MiB",
    ]
    rows = []
    for panel, points in result["series"].items():
        cells = [panel, ", ".join(f"{point['size']:,}" for point in points)]
        for name in DIRECTIONS:
            cells.append(", ".join(f"{point[f'{name}_cpu_ms']:.0f}" for point in points))
            cells.append(f"{result['slopes'][panel][name]:.2f}")
        cells.append(", ".join(f"{point['forward_backward_temporary_mb']:.0f}" for point in points))
        rows.append(cells)
    title = f"{result['scene']}, {result['gaussians']:,} Gaussians at {result['size']} (views: {result['size'] // 2})."
    return f"{title}\n\n{markdown_table(header, rows)}"


def draw(result: dict[str, Any], path: Path) -> None:
    """CPU time over size, with lines of linear growth."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    labels = list(dict.fromkeys(PANELS.values()))
    figure, axes = plt.subplots(1, len(labels), figsize=(12, 4), sharey=True)
    for panel, label in PANELS.items():
        axis, rows = axes[labels.index(label)], result["series"][panel]
        sizes = np.asarray([row["size"] for row in rows], float)
        for i, name in enumerate(DIRECTIONS):
            times = np.asarray([row[f"{name}_cpu_ms"] for row in rows])
            how = panel.partition(", ")[2]
            text = f"{name.replace('_', ' + ')}{how and ', ' + how}: slope {result['slopes'][panel][name]:.2f}"
            axis.loglog(sizes, times, "o--" if how == "vmap" else "o-", ms=4, color=f"C{i}", label=text)
            if how != "vmap":
                axis.loglog(sizes, times[-1] * sizes / sizes[-1], ":", color="0.8", lw=1, zorder=0)
        axis.set(xlabel=label)
        axis.set_xticks(sizes, [f"{size:,.0f}" for size in sizes], fontsize=8)
        axis.set_yticks(TICKS, [f"{tick}" for tick in TICKS])
        axis.minorticks_off()
        axis.grid(alpha=0.25, which="both")
        axis.legend(fontsize=7.5)
    axes[0].set_ylabel("CPU ms (dotted: linear)")
    axes[0].set_ylim(5, 1000)
    figure.tight_layout()
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)
    plt.close(figure)


if __name__ == "__main__":
    sys.exit(main())
