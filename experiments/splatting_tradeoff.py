"""What each knob of the splatting renderer gains in time and costs in accuracy, and the Pareto front of their settings."""

import dataclasses
import gc
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from experiments.harness import Run, entry, figure
from experiments.results import markdown_table
from experiments.scenes import PARAMETERS, Scene, gradient_errors, image_errors, load_scene, make_target, orbiting
from experiments.splatting import DIRECTIONS, compiled
from experiments.timing import timed
from humangs_jax.rendering.splat_config import DEFAULT_CONFIG, SPLAT_PRESETS, SplatConfig
from humangs_jax.rendering.splatting import plan_buffers, render, render_views

KNOBS: dict[str, tuple[Any, ...]] = {
    "tile_size": (4, 16),
    "block": (16, 64),
    "chunk": (4, 16),
    "chunk_backward": (4, 16),
    "matmul_precision": ("bfloat16",),
    "alpha_min": (1 / 192, 1 / 128, 1 / 64, 1 / 32, 1 / 16),
    "transmittance_stop": (1e-3, 1e-2, 3e-2, 1e-1),
    "radius_sigma": (3.33, 3.0, 2.5, 2.0, 1.5),
    "opacity_min": (0.05, 0.1, 0.2, 0.4),
    "scale": (0.75, 0.5, 0.25),
}
SCHEDULE = ("tile_size", "block", "chunk", "chunk_backward", "matmul_precision")
"""Knobs that do not change the image: left out of the plot."""

HIDDEN = (1 / 255, 0.01, 0.03, 0.1)
"""Weights on any pixel of any camera below which a Gaussian is dropped (`splatting.seen_from`)."""

VIEWS = 24
"""Cameras that ask what is hidden, besides the one that is drawn."""

COMBINED: tuple[dict[str, Any], ...] = (
    {"alpha_min": 1 / 128, "transmittance_stop": 1e-3},
    {"alpha_min": 1 / 32, "transmittance_stop": 1e-2},
    {"radius_sigma": 2.75, "transmittance_stop": 1e-3},
    {"radius_sigma": 2.25, "transmittance_stop": 1e-3},
    {"radius_sigma": 2.0, "transmittance_stop": 3e-3},
    {"radius_sigma": 1.5, "transmittance_stop": 3e-3},
    {"radius_sigma": 1.25, "transmittance_stop": 1e-2},
    {"radius_sigma": 2.0, "alpha_min": 1 / 64, "transmittance_stop": 3e-3},
    {"radius_sigma": 1.75, "transmittance_stop": 3e-3, "scale": 0.5},
    {"hidden": 0.01, "radius_sigma": 2.75, "transmittance_stop": 1e-3},
    {"hidden": 0.03, "radius_sigma": 2.5, "transmittance_stop": 1e-3},
    {"hidden": 0.03, "radius_sigma": 2.0, "transmittance_stop": 3e-3},
    {"hidden": 0.1, "radius_sigma": 1.75, "transmittance_stop": 3e-3},
)
"""Several knobs at once; "hidden" as in `HIDDEN`."""

SHORT_NAMES = {"alpha_min": "alpha", "transmittance_stop": "stop"}


class Setting(NamedTuple):
    """A point of the trade-off. knob: of which it is a value, "preset" or "combined". dropped: (g,) left out, or None."""

    knob: str
    label: str
    config: Any
    dropped: np.ndarray | None = None


@entry
def splatting_tradeoff(
    run: Run,
    scene: str = "demo",
    size: int = 512,
    repeats: int = 9,
    only: tuple[str, ...] = (),
    image: Path | None = None,
    measured: Path | None = None,
) -> None:
    """What each knob of the splatting renderer gains in time and costs in accuracy.

    Every setting takes turns with the exact one, call by call, in one process; its time is the median of the quotients. Its error
    is that of the image to the exact one, drawn in float64, on black; of gradients (mean squared error against noise) the
    relative L2 error, the worst of the five parameters'. Dropping the hidden: the Gaussians that weigh less than a threshold on
    every pixel of 24 cameras around are left out. 8 minutes for 52,375 Gaussians.

    Options:
    scene: npz of a scene, or "demo"
    size: side of the image, pixels
    repeats: timed iterations
    only: knobs to measure (also: hidden, combined, preset)
    image: draw the Pareto front here
    measured: docs/results/splatting_tradeoff.json of an earlier run, for the image alone
    """
    if measured:
        result = json.loads(measured.read_text())["numbers"]
    else:
        result = measure(load_scene(scene, size), repeats, only or None)
        run.show(table(result), result)
    if image:
        plot(image, result)


def settings(scene: Scene, only: Sequence[str] | None) -> list[Setting]:
    """All points to measure but the exact one."""
    weights = largest_weights(scene) if only is None or {"hidden", "combined"} & set(only) else None
    found = [Setting("preset", name, config) for name, config in SPLAT_PRESETS.items() if name != "exact"]
    for knob, values in KNOBS.items():
        found += [Setting(knob, f"{knob} {short(v)}", SplatConfig(**{knob: v})) for v in values]
    if weights is not None:
        found += [Setting("hidden", f"hidden {short(t)}", SplatConfig(), weights < t) for t in HIDDEN]
        for fields in COMBINED:
            label = ", ".join(f"{SHORT_NAMES.get(name, name)} {short(value)}" for name, value in fields.items())
            dropped = weights < fields["hidden"] if "hidden" in fields else None
            config = SplatConfig(**{name: value for name, value in fields.items() if name != "hidden"})
            found.append(Setting("combined", label, config, dropped))
    return [s for s in found if only is None or s.knob in only]


def short(value: Any) -> str:
    """1/64 rather than 0.015625."""
    if isinstance(value, float) and 2e-3 < value < 0.1 and float(1 / value).is_integer() and (1 / value) % 10:
        return f"1/{1 / value:.0f}"
    return f"{value:g}" if isinstance(value, float) else str(value)


def largest_weights(scene: Scene) -> np.ndarray:
    """(g,) the largest weight of each Gaussian on any pixel of any of the cameras around the scene, and of its own."""
    gaussians, config = scene.gaussians(), SplatConfig(visibility=True)
    own = render(gaussians, scene.camera(), config).visibility
    turns = np.linspace(0, 2 * np.pi, VIEWS, endpoint=False)
    cameras = orbiting(scene, turns, np.resize([0.0, 0.4, -0.4], VIEWS))
    others = render_views(gaussians, cameras, config).visibility
    return np.maximum(np.asarray(own), np.asarray(others).max(axis=0))


def measure(scene: Scene, repeats: int, only: Sequence[str] | None = None) -> dict[str, Any]:
    """{"scene", "size", "exact": milliseconds and errors, "settings": [one dict each]}."""
    target = make_target(scene.size)
    fitted = lambda scene, config, dtype: plan_buffers(scene.gaussians(dtype), scene.camera(dtype), config, 1.0)
    with jax.enable_x64(True):
        config = fitted(scene, DEFAULT_CONFIG, np.float64)
        truth = outputs(compiled(scene, target, config, np.float64)[0], None)
    exact = compiled(scene, target, fitted(scene, DEFAULT_CONFIG, np.float32))[0]
    times = {name: np.median([timed(exact[name]) for _ in range(repeats + 1)], axis=0) for name in DIRECTIONS}
    rows = []
    for setting in settings(scene, only):
        kept = ~setting.dropped if setting.dropped is not None else np.ones(len(scene.means), bool)
        part = scene._replace(**{name: getattr(scene, name)[kept] for name in PARAMETERS})
        config = fitted(part, setting.config, np.float32)
        programs = compiled(part, target, config)[0]
        row: dict[str, Any] = {"knob": setting.knob, "label": setting.label, "gaussians": len(part.means)}
        row |= ratios(exact, programs, repeats) | differences(outputs(programs, kept), truth)
        rows.append(row | {"config": dataclasses.asdict(config)})
        print(
            f"{setting.label:48} {row['forward_cpu']:.2f} {row['forward_backward_cpu']:.2f} {row['psnr']:.1f} dB",
            flush=True,
        )
        del programs
        gc.collect()
    return {
        "scene": scene.kind,
        "size": scene.size,
        "gaussians": len(scene.means),
        "exact": {name: {"wall_ms": t[0], "cpu_ms": t[1]} for name, t in times.items()}
        | differences(outputs(exact, None), truth),
        "settings": rows,
    }


def outputs(programs: dict, kept: np.ndarray | None) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Image and gradients; those of Gaussians that were left out are 0."""
    image, gradients = np.asarray(programs["forward"]().rgb), {}
    found = programs["forward_backward"]()[1]
    for name in PARAMETERS:
        gradient = np.asarray(getattr(found, name))
        if kept is not None:
            gradients[name] = np.zeros((len(kept), *gradient.shape[1:]), gradient.dtype)
            gradients[name][kept] = gradient
        else:
            gradients[name] = gradient
    return image, gradients


def ratios(exact: dict, programs: dict, repeats: int) -> dict[str, float]:
    """Times relative to the exact ones, {forward, forward_backward} x {wall, cpu}: medians of quotients of neighbours."""
    found = {}
    for name in DIRECTIONS:
        exact[name](), programs[name]()
        pairs = np.asarray([(timed(exact[name]), timed(programs[name])) for _ in range(repeats)])
        found[f"{name}_wall"], found[f"{name}_cpu"] = np.median(pairs[:, 1] / pairs[:, 0], axis=0).tolist()
    return found


def differences(found: tuple, truth: tuple) -> dict[str, float]:
    """Errors of the image, and the worst relative L2 error of a gradient."""
    worst = max(gradient_errors(found[1][name], truth[1][name])["relative_l2"] for name in PARAMETERS)
    return image_errors(found[0], truth[0]) | {"gradient_relative_l2": worst}


def pareto(rows: Sequence[dict[str, Any]], time: str) -> list[dict[str, Any]]:
    """The settings that no other beats in both time and PSNR, fastest first."""
    front, best = [], -np.inf
    for row in sorted(rows, key=lambda row: (row[time], -row["psnr"])):
        if row["psnr"] > best:
            front.append(row)
            best = row["psnr"]
    return front


def table(result: dict[str, Any]) -> str:
    """Markdown."""
    header = ["setting", "forward, CPU", "forward+backward, CPU", "PSNR, dB", "largest error", "gradients"]
    exact = result["exact"]
    milliseconds = (f"{exact[name]['cpu_ms']:.0f} ms" for name in DIRECTIONS)
    error = lambda row: [f"{row['psnr']:.1f}", f"{row['max_abs_error']:.1g}", f"{row['gradient_relative_l2']:.1g}"]
    rows = [["exact", *milliseconds, *error(exact)]]
    for row in result["settings"]:
        label = f"**{row['label']}**" if row["knob"] == "preset" else row["label"]
        times = (f"{row[f'{name}_cpu']:.2f}" for name in DIRECTIONS)
        rows.append([label, *times, *error(row)])
    title = (
        f"{result['scene']}, {result['gaussians']:,} Gaussians at {result['size']}; times relative to the exact ones."
    )
    return f"{title}\n\n{markdown_table(header, rows)}"


def plot(path: Path, result: dict[str, Any]) -> None:
    """Time relative to exact against PSNR: a line for each knob, the presets, and the front of all settings."""
    exact = {**result["exact"], "label": "exact", "knob": "preset", "forward_cpu": 1.0}
    rows = [exact] + [r for r in result["settings"] if r["knob"] not in SCHEDULE and r["label"] != "inria"]
    with figure(path, 1, (8, 4.4)) as axis:
        steps = zip(*((r["forward_cpu"], r["psnr"]) for r in pareto(rows, "forward_cpu")), strict=True)
        axis.step(*steps, where="post", color="0.8", lw=3, label="best of all settings")
        for i, knob in enumerate(dict.fromkeys(row["knob"] for row in rows if row["knob"] != "preset")):
            points = [(row["forward_cpu"], row["psnr"]) for row in rows if row["knob"] == knob]
            style = "s" if knob == "combined" else "o-"
            axis.plot(*zip(*points, strict=True), style, ms=4, lw=0.9, color=f"C{i}", label=knob)
        for row in (row for row in rows if row["knob"] == "preset"):
            point = row["forward_cpu"], row["psnr"]
            axis.plot(*point, "*", ms=13, color="black", zorder=3)
            axis.annotate(row["label"], point, (-8, 6), textcoords="offset points", weight="bold", ha="right")
        axis.set(xlabel="CPU time of an image relative to exact", ylabel="PSNR to the exact image, dB")
        axis.set_title(f"{result['gaussians']:,} Gaussians, {result['size']} x {result['size']} pixels", fontsize=9)
        axis.legend(fontsize=8, loc="center left", bbox_to_anchor=(1.0, 0.5), frameon=False)
