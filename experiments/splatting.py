"""Time, error, stages and growth of the splatting renderer on a scene, see `scenes.py`."""

import dataclasses
import gc
import importlib.util
import os
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from experiments.harness import Run, entry, figure
from experiments.results import markdown_table
from experiments.scenes import (
    PARAMETERS,
    Reference,
    Scene,
    gradient_errors,
    image_errors,
    load_reference,
    load_scene,
    make_target,
    orbiting,
)
from experiments.timing import medians, peak_rss_mb
from humangs_jax.core.compiling import compiler_options
from humangs_jax.core.pytree import replace
from humangs_jax.geometry import transform
from humangs_jax.rendering import compositing, tiling
from humangs_jax.rendering.compositing import pack_splats
from humangs_jax.rendering.projection import project
from humangs_jax.rendering.splat_config import SPLAT_PRESETS
from humangs_jax.rendering.splatting import SplatConfig, plan_buffers, render, render_views
from humangs_jax.rendering.tiling import TileGrid, image_to_tiles, sort_into_tiles, tiles_to_image

DIRECTIONS = ("forward", "forward_backward")


def compiled(
    scene: Scene, target: np.ndarray, config: Any, dtype: type = np.float32
) -> tuple[dict[str, Callable[[], Any]], dict[str, dict[str, float]]]:
    """Our two programs, bound to the scene, and for each how long it took to compile and how much it holds while it runs.

    forward() -> Rendering. forward_backward() -> (loss, gradients as Gaussians). Both wait for their results.
    """
    gaussians, camera = scene.gaussians(dtype), scene.camera(dtype)
    goal, black = jnp.asarray(target, dtype), jnp.zeros(3, dtype)

    def forward(gaussians):
        return render(gaussians, camera, config, black)

    def loss(gaussians):
        return jnp.mean((forward(gaussians).rgb - goal) ** 2)

    options = compiler_options()
    programs, facts = {}, {}
    for name, function in zip(DIRECTIONS, (forward, jax.value_and_grad(loss)), strict=True):
        started = time.perf_counter()
        program = jax.jit(function, compiler_options=options).lower(gaussians).compile()
        memory = program.memory_analysis()
        facts[name] = {
            "compile_s": time.perf_counter() - started,
            "temporary_mb": memory.temp_size_in_bytes / 2**20 if memory else float("nan"),
        }
        programs[name] = lambda program=program: jax.block_until_ready(program(gaussians))
    return programs, facts


def yardstick_runs(folder: Path, scene: Scene, target: np.ndarray) -> dict[str, Callable[[], Any]]:
    """The yardstick's two programs, bound to the scene."""
    spec = importlib.util.spec_from_file_location("yardstick", folder / "yardstick.py")
    if spec is None or spec.loader is None:
        raise ValueError(f"{folder}: holds no yardstick.py that can be loaded")
    module = importlib.util.module_from_spec(spec)
    sys.modules["yardstick"] = module
    spec.loader.exec_module(module)
    yardstick = module.Yardstick(module.Scene(*scene))
    return {"forward": yardstick.forward, "forward_backward": lambda: yardstick.forward_backward(target)}


def errors(programs: Mapping[str, Callable[[], Any]], reference: Reference | None) -> dict[str, Any]:
    """Errors of image and gradients; None where the reference lacks them."""
    image = np.asarray(programs["forward"]().rgb)
    found: dict[str, Any] = dict.fromkeys(("psnr", "max_abs_error", "fraction_above_2e-4"))
    measures = ("relative_l2", "cosine", "signed_bias", "gain")
    found |= {f"gradient_{measure}": dict.fromkeys(PARAMETERS) for measure in measures}
    if reference is None:
        return found
    found |= image_errors(image, reference.image)
    if reference.gradients:
        gradients = programs["forward_backward"]()[1]
        for name, expected in reference.gradients.items():
            for measure, value in gradient_errors(getattr(gradients, name), expected).items():
                found[f"gradient_{measure}"][name] = value
    return found


FORWARD = ("project", "depth order", "pairs", "lists", "rows", "composite", "image")
BACKWARD = ("cotangents", "composite backward", "project backward")


def stages(scene: Scene, config: Any) -> dict[str, Any]:
    """Functions without arguments, by stage, in the order of the work. One device, exact footprints."""
    on_cpu = jax.default_backend() == "cpu"
    order_of_work, runs = "blocks" if on_cpu else "chunks", {}

    def stage(name, function, *arguments):
        program = jax.jit(function, compiler_options=compiler_options())
        program = program.lower(*arguments).compile()
        runs[name] = lambda: jax.block_until_ready(program(*arguments))
        return program(*arguments)

    def footprints(projected, opacities, order):
        ellipses = tiling.footprints(projected, tiling.squared_reach(opacities, config.alpha_min))
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
    order = stage("depth order", tiling.depth_order, projected.depths)
    pairs = stage(
        "pairs",
        lambda *a: tiling.emit_pairs(footprints(*a), grid, config.max_rows, config.max_pairs),
        *(projected, gaussians.opacities, order),
    )
    count = len(scene.means)
    lists = stage("lists", lambda *a: sort_into_tiles(*a, grid.tiles, count), pairs.tiles, pairs.splats)
    splats = stage("rows", rows, projected, gaussians, order)
    forward, backward = (
        getattr(compositing, f"{way}_by_{order_of_work}")(grid, config) for way in ("forward", "backward")
    )
    features, transmittance, used, _ = stage("composite", forward, splats, *lists)
    stage("image", lambda f, t: (tiles_to_image(f, grid), tiles_to_image(t[:, None], grid)), features, transmittance)

    image = jnp.asarray(make_target(scene.size) / scene.size**2)
    image = jnp.concatenate([image, jnp.zeros_like(image[..., :2])], axis=-1)

    def cotangents(image, features):
        g = image_to_tiles(image, grid)[:, :4]
        return g, jnp.sum(g * features, axis=1)

    g, total = stage("cotangents", cotangents, image, features)
    sums = stage("composite backward", backward, splats, lists.items, lists.starts, used, g, total)
    stage(
        "project backward",
        lambda gaussians, order, sums: jax.vjp(lambda g: drawn(g, order), gaussians)[1](sums),
        *(gaussians, order, sums),
    )
    return runs


VIEW_ANGLE = 0.01
"""Radians from one camera to the next."""
PANELS = {"pixels": "pixels", "gaussians": "Gaussians", "views, render_views": "views", "views, vmap": "views"}


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


def slope(rows: Sequence[dict[str, Any]], name: str) -> float:
    """Of log CPU time over log size, by least squares."""
    size, time = np.log([(row["size"], row[f"{name}_cpu_ms"]) for row in rows]).T
    return float(np.polyfit(size, time, 1)[0])


STEPS = (1e-3, 1e-4)
AWAY = (0.02, -0.03, 0.01, 0.02, 0.01, -0.03)
"""Radians and metres."""
CUTS = {
    "as drawn: alpha_min 1/255, transmittance_stop 1e-4": {},
    "alpha_min 1e-6": {"alpha_min": 1e-6},
    "alpha_min 1e-6, transmittance_stop 0": {"alpha_min": 1e-6, "transmittance_stop": 0.0},
}


def times_table(numbers: Mapping[str, Any]) -> str:
    """Wall and CPU ms, and their ratios to the yardstick's; empty if nothing was timed."""
    times, facts = numbers["times"], numbers["facts"]
    if not times:
        return ""
    cells = [f"{numbers['scene']} {numbers['size']}"]
    for name in DIRECTIONS:
        ours, theirs = times[name], times.get(f"yardstick {name}")
        cells.append(f"{ours['ms']:.0f}, {ours['cpu_ms']:.0f}")
        ratios = [ours[key] / theirs[key] for key in ("ms", "cpu_ms")] if theirs else []
        cells.append(", ".join(f"{ratio:.2f}" for ratio in ratios) or "-")
    cells += [", ".join(f"{fact['compile_s']:.1f}" for fact in facts.values()), f"{numbers['peak_rss_mb']:.0f}"]
    header = ["wall, CPU", "forward, ms", "/ yardstick", "forward+backward, ms", "/ yardstick"]
    return markdown_table([*header, "compile each, s", "peak memory, MiB"], [cells])


def errors_table(numbers: Mapping[str, Any]) -> str:
    """Errors of image and gradients (the worst parameter); empty without a reference."""
    if numbers["psnr"] is None:
        return ""
    cells = [f"{numbers['scene']} {numbers['size']}, {numbers['dtype']}", f"{numbers['psnr']:.1f}"]
    cells += [f"{numbers['max_abs_error']:.1e}", f"{numbers['fraction_above_2e-4']:.4%}"]
    for measure, worst, form in (("relative_l2", max, ".1e"), ("cosine", min, ".8f"), ("signed_bias", max, ".0e")):
        values = [abs(value) for value in numbers[f"gradient_{measure}"].values() if value is not None]
        cells.append(format(worst(values), form) if values else "-")
    header = ["error to float64", "PSNR, dB", "largest", "pixels off by > 2e-4"]
    return markdown_table([*header, "gradients: relative L2", "cosine", "signed bias"], [cells])


# Entries -------------------------------------------------------------------------------------------------------------


@entry
def splatting_benchmark(
    run: Run,
    scene: str = "demo",
    reference: Path | None = None,
    size: int = 512,
    yardstick: Path | None = None,
    repeats: int = 15,
    preset: str = "exact",
    float64: bool = False,
) -> None:
    """Time and error of the splatting renderer on one scene, beside a compiled yardstick where there is one.

    The loss is the mean squared error against a target of noise; black background. Half a minute at 512. Expected: PSNR at least
    95 dB (90 where a head's tiles are crowded), gradients within 1e-3, cosine above 0.99999, and in float64 no error above 1e-6.
    A page's rows of other scenes and sizes stay.

    Options:
    scene: npz of a scene, or "demo"
    reference: npz of its image and gradients; errors need it
    size: side of the image, pixels
    yardstick: folder with a `yardstick.py` that has `Scene` and `Yardstick` (`forward()` and `forward_backward(target)`)
    repeats: timed iterations; 0: errors only
    preset: name in SPLAT_PRESETS
    float64: draw in float64
    """
    jax.config.update("jax_enable_compilation_cache", False)  # compile times are of a first run
    jax.config.update("jax_enable_x64", float64)
    dtype, loaded = np.float64 if float64 else np.float32, load_scene(scene, size)
    expected = load_reference(reference, size) if reference else None
    target = make_target(size, expected.seed if expected else 1)
    config = plan_buffers(loaded.gaussians(dtype), loaded.camera(dtype), SPLAT_PRESETS[preset], 1.0)
    programs, facts = compiled(loaded, target, config, dtype)
    runs = dict(programs)
    if yardstick:
        runs |= {f"yardstick {name}": program for name, program in yardstick_runs(yardstick, loaded, target).items()}
    load = os.getloadavg()[0]
    times = medians(runs, repeats) if repeats else {}
    named = {name: dict(zip(("ms", "cpu_ms"), map(float, pair), strict=True)) for name, pair in times.items()}
    numbers = {"times": named, "facts": facts, "peak_rss_mb": peak_rss_mb()} | errors(programs, expected)
    numbers |= {"config": dataclasses.asdict(config), "scene": loaded.kind, "size": size, "dtype": np.dtype(dtype).name}
    numbers |= {"gaussians": len(loaded.means), "preset": preset, "repeats": repeats, "load_average": load}
    numbers |= {"device": jax.devices()[0].device_kind}
    tables = [table for table in (times_table(numbers), errors_table(numbers)) if table]
    run.show("\n\n".join(tables), numbers, row=f"{loaded.kind} {size}")


@entry
def splatting_stages(
    run: Run, scene: tuple[str, ...] = ("demo",), size: tuple[int, ...] = (512,), repeats: int = 11
) -> None:
    """Where the time of splatting goes: its stages, each compiled by itself, in turns with the whole.

    Stages: projection of the Gaussians; their order by depth; (tile, splat) pairs; the lists of the tiles (one sort); rows of
    numbers in depth order; compositing; joining the tiles to an image; and with gradients the cotangents cut into tiles,
    compositing again, and the gradient of projection and rows. Half a minute. The stages add up to the whole within a tenth.

    Options:
    scene: npz files of scenes, or "demo"
    size: sides of the image, pixels
    repeats: timed iterations
    """
    results: list[dict[str, Any]] = []
    for loaded in (load_scene(each, side) for each in scene for side in size):
        config = plan_buffers(loaded.gaussians(), loaded.camera(), margin=1.0)
        runs = stages(loaded, config) | compiled(loaded, make_target(loaded.size), config)[0]
        times = {name: float(cpu) for name, (_, cpu) in medians(runs, repeats).items()}
        results.append({"scene": loaded.kind, "size": loaded.size, "cpu_ms": times})
    rows = [[name, *(f"{r['cpu_ms'][name]:.1f}" for r in results)] for name in FORWARD + BACKWARD]
    for whole, parts in zip(DIRECTIONS, (FORWARD, FORWARD + BACKWARD), strict=True):
        sums = (f"{sum(r['cpu_ms'][part] for part in parts):.0f}; {r['cpu_ms'][whole]:.0f}" for r in results)
        rows.append([f"{whole.replace('_', '+')}: sum of its stages; in one program", *sums])
    run.show(markdown_table(["CPU ms", *(f"{r['scene']} {r['size']}" for r in results)], rows), results)


@entry
def splatting_scaling(
    run: Run,
    scene: str = "demo",
    size: int = 512,
    repeats: int = 7,
    sizes: tuple[int, ...] = (128, 256, 512, 1024),
    fractions: tuple[float, ...] = (0.125, 0.25, 0.5, 1.0, 2.0),
    views: tuple[int, ...] = (1, 2, 4, 8),
    image: Path | None = None,
) -> None:
    """How the time of splatting grows with pixels, Gaussians and views; 1 is linear growth.

    Gaussians: random subsets, and all of them twice, the copies moved by a quarter of their size. Views: cameras side by side (so
    that all have the same to draw) at half the size, one after the other and at once. 4 minutes.

    Options:
    scene: npz of a scene, or "demo"
    size: side of the image where pixels are not what grows
    repeats: timed iterations
    sizes: sides of the image, pixels
    fractions: of the Gaussians
    views: numbers of cameras
    image: draw the growth here
    """
    loaded = load_scene(scene, size)
    series: dict[str, list[dict[str, Any]]] = {panel: [] for panel in PANELS}

    def one(panel, at, programs, facts):
        row = {"size": at, "temporary_mb": facts["forward_backward"]["temporary_mb"]}
        for name, (wall, cpu) in medians(programs, repeats).items():
            row |= {f"{name}_ms": float(wall), f"{name}_cpu_ms": float(cpu)}
        series[panel].append(row)
        programs.clear()
        gc.collect()

    def alone(panel, at, part):
        config = plan_buffers(part.gaussians(), part.camera(), margin=1.0)
        one(panel, at, *compiled(part, make_target(part.size), config))

    for side in sizes:
        alone("pixels", side**2, loaded.resized(side))
    for part in (thinned(loaded, fraction) for fraction in fractions):
        alone("gaussians", len(part.means), part)
    for count in views:
        for panel, at_once in (("views, render_views", False), ("views, vmap", True)):
            one(panel, count, *compiled_views(loaded.resized(size // 2), count, at_once))
    slopes = {panel: {name: slope(rows, name) for name in DIRECTIONS} for panel, rows in series.items()}
    table = []
    for panel, points in series.items():
        cells = [panel, ", ".join(f"{point['size']:,}" for point in points)]
        for name in DIRECTIONS:
            cells += [", ".join(f"{point[f'{name}_cpu_ms']:.0f}" for point in points), f"{slopes[panel][name]:.2f}"]
        table.append([*cells, ", ".join(f"{point['temporary_mb']:.0f}" for point in points)])
    header = [
        "growth with",
        "sizes",
        "forward, CPU ms",
        "slope",
        "forward+backward, CPU ms",
        "slope",
        "temporaries, MiB",
    ]
    title = f"{loaded.kind}, {len(loaded.means):,} Gaussians at {size} (views: {size // 2})."
    numbers = {"scene": loaded.kind, "size": size, "gaussians": len(loaded.means), "series": series, "slopes": slopes}
    run.show(f"{title}\n\n{markdown_table(header, table)}", numbers)
    if image:
        plot_scaling(image, series, slopes)


def plot_scaling(path: Path, series: dict[str, Any], slopes: dict[str, Any]) -> None:
    """CPU time over size, with lines of linear growth."""
    labels = list(dict.fromkeys(PANELS.values()))
    with figure(path, len(labels), (12, 4)) as axes:
        for panel, label in PANELS.items():
            axis, rows = axes[labels.index(label)], series[panel]
            sizes = np.asarray([row["size"] for row in rows], float)
            for i, name in enumerate(DIRECTIONS):
                times = np.asarray([row[f"{name}_cpu_ms"] for row in rows])
                how = panel.partition(", ")[2]
                text = f"{name.replace('_', ' + ')}{how and ', ' + how}: slope {slopes[panel][name]:.2f}"
                axis.loglog(sizes, times, "o--" if how == "vmap" else "o-", ms=4, color=f"C{i}", label=text)
                if how != "vmap":
                    axis.loglog(sizes, times[-1] * sizes / sizes[-1], ":", color="0.8", lw=1, zorder=0)
            axis.set_xlabel(label)
            axis.set_xticks(sizes, [f"{size:,.0f}" for size in sizes], fontsize=8)
            axis.legend(fontsize=7.5)
        axes[0].set_ylabel("CPU ms (dotted: linear)")


@entry
def splatting_finite_differences(run: Run, size: int = 128) -> None:
    """Finite differences of an image's error against the gradient of the camera: what the cuts of splatting leave out.

    The shipped person in the pose and before the camera of its first photo, float64; the loss is the mean squared error to the
    image of a camera that is a little off. Central differences for the six numbers of a camera twist, radians and metres.

    Options:
    size: side of the image, pixels
    """
    scene = load_scene("demo", size)
    with jax.enable_x64(True):
        found = camera_differences(scene)
    rows = [[name, *(f"{difference:.2%}" for difference in each)] for name, each in found.items()]
    run.show(markdown_table(["cuts", *(f"step {step:g}" for step in STEPS)], rows), found)


def camera_differences(scene: Scene) -> dict[str, list[float]]:
    """Relative L2 difference of the twist's gradient, by setting, for each of `STEPS`."""
    gaussians, camera = scene.gaussians(np.float64), scene.camera(np.float64)

    def drawn(twist, gaussians, config):
        x, y, z = twist[:3]
        turn = jax.scipy.linalg.expm(jnp.asarray([[0, -z, y], [z, 0, -x], [-y, x, 0]]))
        moved = replace(camera, cam_from_world=transform.make(turn, twist[3:]) @ camera.cam_from_world)
        return render(gaussians, moved, config).rgb

    target = jax.jit(drawn)(jnp.asarray(AWAY), gaussians, plan_buffers(gaussians, camera, margin=1.5))
    both = jax.jit(jax.value_and_grad(lambda *given: jnp.mean(jnp.square(drawn(*given) - target))))
    results = {}
    for name, cuts in CUTS.items():
        config = plan_buffers(gaussians, camera, dataclasses.replace(SplatConfig(), **cuts), margin=1.5)
        gradient = np.asarray(both(jnp.zeros(6), gaussians, config)[1])
        value = lambda twist, config=config: float(both(jnp.asarray(twist), gaussians, config)[0])
        results[name] = []
        for step in STEPS:
            differences = [(value(step * axis) - value(-step * axis)) / (2 * step) for axis in np.eye(6)]
            results[name].append(float(np.linalg.norm(differences - gradient) / np.linalg.norm(gradient)))
    return results
