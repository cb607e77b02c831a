"""Time and error of the splatting renderer on one scene, beside a compiled yardstick where there is one.

    python experiments/splatting/benchmark.py --scene S.npz --reference R.npz --size 512 [--yardstick DIR] --json OUT
    python experiments/splatting/benchmark.py --scene demo --size 512

Files: see `splatting/scenes.py`. DIR holds a `yardstick.py` with `Scene` and `Yardstick` (its `forward()` and
`forward_backward(target)` take turns with ours in this process). The loss is the mean squared error against a target of
noise; black background. Half a minute at 512. `--float64` draws the scene in float64 instead and compares that.

Prints tables and writes {"forward_ms", "forward_backward_ms", "forward_cpu_ms", "forward_backward_cpu_ms" (medians),
"yardstick": {the same} or null, "ratio": ours / yardstick, "compile_s", "peak_rss_mb", "psnr", "max_abs_error",
"fraction_above_2e-4", "gradient_relative_l2", "gradient_cosine", "gradient_signed_bias", "gradient_gain": {parameter:
number}, "config", "device", ...}; values that need a missing reference are null.

Expected: psnr at least 95 dB (90 where a head's tiles are crowded), gradients within 1e-3, cosine above 0.99999, and in
float64 no error above 1e-6. On 2 cores of an AMD EPYC (Zen 4), 52,375 Gaussians at 512: see docs/performance.md.
"""

import argparse
import dataclasses
import importlib.util
import json
import os
import sys
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[2]))
from experiments.common.interleaved import medians, peak_rss_mb, prepare_process
from experiments.common.results import markdown_table, publish, write_json
from experiments.splatting.scenes import (
    PARAMETERS,
    Reference,
    Scene,
    gradient_errors,
    image_errors,
    load_reference,
    load_scene,
    make_target,
)

TABLE = "splatting_benchmark"
DIRECTIONS = ("forward", "forward_backward")


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scene", required=True, help="npz of a scene, or 'demo'")
    parser.add_argument("--reference", type=Path, help="npz of its image and gradients")
    parser.add_argument("--size", type=int, default=512, help="side of the image, pixels")
    parser.add_argument("--yardstick", type=Path, help="folder of a compiled yardstick")
    parser.add_argument("--json", type=Path, help="write the numbers here")
    parser.add_argument("--page", type=Path, help=f"page whose table {TABLE} gets this run's rows")
    parser.add_argument("--repeats", type=int, default=15, help="timed iterations; 0: errors only")
    parser.add_argument("--preset", default="exact", help="name in SPLAT_PRESETS")
    parser.add_argument("--config", type=json.loads, default={}, help="JSON of SplatConfig fields over the preset")
    parser.add_argument("--margin", type=float, default=1.0, help="room in the buffers; 1 is what eager calls take")
    parser.add_argument("--float64", action="store_true", help="draw in float64")
    arguments = parser.parse_args()
    prepare_process()
    result = benchmark(arguments)
    text = "\n\n".join(table for table in (times_table(result), errors_table(result)) if table)
    print(text)
    if arguments.json:
        write_json(arguments.json, result)
    if arguments.page:
        publish(arguments.page, TABLE, text, result, name_of(result))


def benchmark(arguments: argparse.Namespace) -> dict[str, Any]:
    """Everything that the JSON holds."""
    import jax

    jax.config.update("jax_enable_compilation_cache", False)  # compile times are of a first run
    jax.config.update("jax_enable_x64", arguments.float64)
    dtype = np.float64 if arguments.float64 else np.float32
    scene = load_scene(arguments.scene, arguments.size)
    reference = load_reference(arguments.reference, arguments.size) if arguments.reference else None
    target = make_target(arguments.size, reference.seed if reference else 1)
    config = planned(scene, arguments.preset, arguments.config, arguments.margin, dtype)
    programs, facts = compiled(scene, target, config, dtype)

    runs = dict(programs)
    if arguments.yardstick:
        runs |= {f"yardstick {name}": run for name, run in yardstick_runs(arguments.yardstick, scene, target).items()}
    load = os.getloadavg()[0]
    times = medians(runs, arguments.repeats) if arguments.repeats else {}
    result: dict[str, Any] = milliseconds(times, "")
    result["yardstick"] = milliseconds(times, "yardstick ") if arguments.yardstick else None
    result["ratio"] = result["yardstick"] and {
        key: result[key] / theirs if theirs else None for key, theirs in result["yardstick"].items()
    }
    each = {key: {name: fact[key] for name, fact in facts.items()} for key in ("compile_s", "temporary_mb")}
    result |= {"compile_s": max(each["compile_s"].values()), "compile_s_each": each["compile_s"]}
    result |= {"peak_rss_mb": peak_rss_mb(), "temporary_mb": each["temporary_mb"]}
    result |= errors(programs, reference)
    result |= {"config": dataclasses.asdict(config)}
    result |= {
        "scene": scene.kind,
        "size": scene.size,
        "gaussians": len(scene.means),
        "dtype": np.dtype(dtype).name,
        "preset": arguments.preset,
        "repeats": arguments.repeats,
        "load_average": load,
        "device": jax.devices()[0].device_kind,
        "jax": jax.__version__,
    }
    return result


def planned(scene: Scene, preset: str, fields: Mapping[str, Any], margin: float, dtype: type = np.float32) -> Any:
    """A preset with some fields replaced, and buffers that fit the scene."""
    from humangs_jax.rendering.splat_config import SPLAT_PRESETS
    from humangs_jax.rendering.splatting import plan_buffers

    config = dataclasses.replace(SPLAT_PRESETS[preset], **fields)
    return plan_buffers(scene.gaussians(dtype), scene.camera(dtype), config, margin)


def compiled(
    scene: Scene, target: np.ndarray, config: Any, dtype: type = np.float32
) -> tuple[dict[str, Callable[[], Any]], dict[str, dict[str, float]]]:
    """Our two programs, bound to the scene, and for each how long it took to compile and how much it holds while it runs.

    forward() -> Rendering. forward_backward() -> (loss, gradients as Gaussians). Both wait for their results.
    """
    import jax
    import jax.numpy as jnp

    from humangs_jax.core.compiling import compiler_options
    from humangs_jax.rendering.splatting import render

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


def milliseconds(times: Mapping[str, np.ndarray], prefix: str) -> dict[str, float | None]:
    """The four numbers of one competitor; null if nothing was timed."""
    out = {}
    for kind, column in (("ms", 0), ("cpu_ms", 1)):
        for name in DIRECTIONS:
            taken = times.get(prefix + name)
            out[f"{name}_{kind}"] = None if taken is None else float(taken[column])
    return out


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


def name_of(run: Mapping[str, Any]) -> str:
    """Scene and size."""
    return f"{run['scene']} {run['size']}"


def times_table(run: Mapping[str, Any]) -> str:
    """Wall and CPU ms, and their ratios to the yardstick's; empty if nothing was timed."""
    if run["forward_ms"] is None:
        return ""
    cells, ratio = [name_of(run)], run["ratio"]
    for name in DIRECTIONS:
        cells.append(f"{run[f'{name}_ms']:.0f}, {run[f'{name}_cpu_ms']:.0f}")
        cells.append(f"{ratio[f'{name}_ms']:.2f}, {ratio[f'{name}_cpu_ms']:.2f}" if ratio else "-")
    cells += [", ".join(f"{seconds:.1f}" for seconds in run["compile_s_each"].values()), f"{run['peak_rss_mb']:.0f}"]
    header = ["wall, CPU", "forward, ms", "/ yardstick", "forward+backward, ms", "/ yardstick"]
    return markdown_table([*header, "compile each, s", "peak memory, MiB"], [cells])


def errors_table(run: Mapping[str, Any]) -> str:
    """Errors of image and gradients (the worst parameter); empty without a reference."""
    if run["psnr"] is None:
        return ""
    cells = [f"{name_of(run)}, {run['dtype']}", f"{run['psnr']:.1f}", f"{run['max_abs_error']:.1e}"]
    cells.append(f"{run['fraction_above_2e-4']:.4%}")
    for measure, worst, form in (("relative_l2", max, ".1e"), ("cosine", min, ".8f"), ("signed_bias", max, ".0e")):
        values = [abs(value) for value in run[f"gradient_{measure}"].values() if value is not None]
        cells.append(format(worst(values), form) if values else "-")
    header = ["error to float64", "PSNR, dB", "largest", "pixels off by > 2e-4"]
    return markdown_table([*header, "gradients: relative L2", "cosine", "signed bias"], [cells])


if __name__ == "__main__":
    main()
