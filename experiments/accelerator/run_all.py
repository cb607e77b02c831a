"""A day on an accelerator, in stages of at most ten minutes: agreement with the CPU, times, the batch that fits, training.

    python experiments/accelerator/run_all.py --out $OUT --minutes 9                        # all stages, as far as time goes
    python experiments/accelerator/run_all.py --out $OUT --minutes 9 --stage train --init-weights weights.safetensors
    python experiments/accelerator/run_all.py --out $OUT --tiny                             # rehearsal on a CPU
    python experiments/accelerator/run_all.py --out docs/results/accelerator --page docs/accelerator.md   # tables, runs nothing

OUT/STAGE.json is written after every measurement, so a stage that is stopped keeps what it has, and a stage that is there is
continued. No measurement begins when less than a tenth of the time is left. At most eight files of at most 16 MiB: six of
numbers, OUT/weights.safetensors and OUT/train_log.jsonl. `--init-weights` continues a training from such weights.

check: the same numbers on CPU and device: the shipped network, splatting by the schedule of each with gradients, a resumed run.
splatting: forward and with gradients, beside gsplat if it is installed. network: the published one beside plain products of as
many operations. frames: of an animation, and people rendered on the fly. batch: steps of training at batch sizes until memory
ends. train: the preset `small` at the fastest of them.
"""

import argparse
import dataclasses
import json
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[2]))
from experiments.common.results import markdown_table, publish, write_json

STAGES = ("check", "splatting", "network", "frames", "batch", "train")
RESERVE = 0.1
"""Share of the time in which nothing new begins."""
COUNTS = (20_000, 52_000, 140_000, 500_000)
"""Gaussians of the scenes."""
Measurement = tuple[str, Callable[[], Any]]


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, help="folder of the results")
    parser.add_argument("--stage", nargs="+", choices=STAGES, default=list(STAGES))
    parser.add_argument("--minutes", type=float, default=9.0, help="for all stages of this call")
    parser.add_argument(
        "--people", type=int, default=200, help="made on the host before training, if --bank names none"
    )
    parser.add_argument("--bank", type=Path, help="people.npz of another run")
    parser.add_argument(
        "--init-weights", type=Path, help="weights to start the training from; default: the shipped ones"
    )
    parser.add_argument("--tiny", action="store_true", help="sizes that a CPU rehearses in minutes")
    parser.add_argument("--page", type=Path, help="write the tables of --out to this page; nothing is run")
    arguments = parser.parse_args()
    if arguments.page:
        write_tables(arguments.out, arguments.page)
        return
    arguments.out.mkdir(parents=True, exist_ok=True)
    from humangs_jax.core.processes import keep_freed_memory

    keep_freed_memory()
    arguments.deadline = time.monotonic() + 60 * arguments.minutes
    make = {
        "check": check,
        "splatting": splatting,
        "network": network,
        "frames": frames,
        "batch": batch_sizes,
        "train": train,
    }
    for stage in arguments.stage:
        run_stage(stage, make[stage](arguments), arguments)


def run_stage(stage: str, measurements: Iterator[Measurement], arguments: argparse.Namespace) -> None:
    """Makes the measurements that OUT/stage.json lacks, as long as there is time; a failure is a row that says why."""
    import jax

    path = arguments.out / f"{stage}.json"
    found = json.loads(path.read_text()) if path.is_file() else {}
    found["device"], found["jax"] = jax.devices()[0].device_kind, jax.__version__
    for name, measure in measurements:
        if name in found and "failed" not in found[name]:
            continue
        if arguments.deadline - time.monotonic() < RESERVE * 60 * arguments.minutes:
            print(f"{stage}: {name}: no time left", flush=True)
            continue
        began = time.perf_counter()
        try:
            found[name] = measure()
        except Exception as error:  # the next measurement may work; the time on the device does not come back
            found[name] = {"failed": f"{type(error).__name__}: {str(error)[:300]}"}
        print(f"{stage}: {name} ({time.perf_counter() - began:.0f} s): {json.dumps(found[name])[:300]}", flush=True)
        write_json(path, found)


def check(arguments: argparse.Namespace) -> Iterator[Measurement]:
    """Differences between the device and the CPU of the same process."""
    import jax
    import jax.numpy as jnp
    import numpy as np

    from humangs_jax.body.library import load_body
    from humangs_jax.data.capture import load_capture
    from humangs_jax.data.views import gaussian_body, prepare_inputs, standardize
    from humangs_jax.network.humangs import apply_humangs
    from humangs_jax.network.weights import load_weights
    from humangs_jax.rendering.splatting import plan_buffers, render

    places = {"CPU": jax.devices("cpu")[0], "device": jax.devices()[0]}

    def everywhere(function, *inputs):
        """{place: numpy leaves} of a function that is compiled for each."""
        found = {}
        for name, place in places.items():
            with jax.default_device(place):
                found[name] = jax.tree.map(np.asarray, jax.jit(function)(*jax.device_put(inputs, place)))
        return found

    def errors(found):
        pairs = zip(*(jax.tree_util.tree_leaves_with_path(found[name]) for name in ("device", "CPU")), strict=True)
        relative = lambda a, b: float(np.linalg.norm(np.float64(a) - b) / (np.linalg.norm(np.float64(b)) + 1e-300))
        return {jax.tree_util.keystr(path, simple=True, separator="."): relative(a, b) for (path, a), (_, b) in pairs}

    def pass_once():
        variables, config = load_weights()
        body, views = gaussian_body(load_body(), config), standardize(load_capture("demo_capture"), 256)
        inputs = jax.jit(prepare_inputs, static_argnames="config")(body, views, config)
        return errors(everywhere(lambda v, x: apply_humangs(v, x, config)[0].gaussians, variables, inputs))

    def splat():
        scene = demo_scene(1_000 if arguments.tiny else COUNTS[0], 64 if arguments.tiny else 256)
        gaussians, camera = scene
        config = plan_buffers(gaussians, camera)
        target = jnp.asarray(np.random.default_rng(1).random((camera.height, camera.width, 3), np.float32))

        def loss(gaussians):
            rgb = render(gaussians, camera, config).rgb
            return jnp.mean((rgb - target) ** 2), rgb

        return errors(everywhere(jax.grad(loss, has_aux=True), gaussians))

    yield "shipped network, relative error", pass_once
    yield "splatting with gradients, relative error", splat
    yield "resumed run", lambda: resumed()


def resumed() -> dict[str, Any]:
    """Four steps of the preset `tiny` at once, and two and two: largest difference of a parameter."""
    import jax
    import numpy as np

    from humangs_jax.body.library import load_body
    from humangs_jax.data.loader import find_captures
    from humangs_jax.people.writer import Layout, write_set
    from humangs_jax.training.config import tiny
    from humangs_jax.training.loop import train as train_run

    config = dataclasses.replace(tiny(), steps=4)
    with tempfile.TemporaryDirectory() as folder:
        write_set(Path(folder) / "people", 1, Layout(32, poses=1, views=4))
        people, body = find_captures(Path(folder) / "people"), load_body()
        run = lambda name, **how: train_run(config, body, people, Path(folder) / name, progress=False, **how)
        whole = run("whole")
        run("parts", stop_at=2)
        parts = run("parts")
    pairs = zip(jax.tree.leaves(whole.params), jax.tree.leaves(parts.params), strict=True)
    difference = max(float(np.abs(np.asarray(a) - np.asarray(b)).max()) for a, b in pairs)
    return {"largest difference": difference, "bitwise": difference == 0}


def demo_scene(count: int, size: int) -> tuple[Any, Any]:
    """(Gaussians, camera): the demo person with `count` Gaussians, drawn from her own and moved within their extent, smaller
    in proportion to their spacing.
    """
    import jax.numpy as jnp
    import numpy as np

    from experiments.scenes import load_scene
    from humangs_jax.rendering.gaussians import Gaussians

    scene = load_scene("demo", size)
    rng = np.random.default_rng(count)
    own = len(scene.means)
    rows = np.arange(count) % own
    share = np.sqrt(min(1.0, own / count))
    moved = scene.means[rows] + (1 - share) * scene.scales[rows] * rng.standard_normal((count, 3))
    arrays = moved, scene.quats[rows], share * scene.scales[rows], scene.opacities[rows], scene.colors[rows]
    return Gaussians(*(jnp.asarray(x, jnp.float32) for x in arrays)), scene.camera()


def splatting(arguments: argparse.Namespace) -> Iterator[Measurement]:
    """Milliseconds of an image, alone and with gradients."""
    counts, sizes = ((1_000,), (64,)) if arguments.tiny else (COUNTS, (256, 512, 1024))

    def measure(count, size):
        import jax
        import jax.numpy as jnp

        from experiments.timing import medians
        from humangs_jax.rendering.splatting import plan_buffers, render

        gaussians, camera = demo_scene(count, size)
        config = plan_buffers(gaussians, camera)
        draw = jax.jit(lambda g: render(g, camera, config).rgb)
        gradient = jax.jit(jax.grad(lambda g: jnp.mean(render(g, camera, config).rgb ** 2)))
        runs = {"forward": draw, "with gradients": gradient}
        runs = {name: lambda run=run: jax.block_until_ready(run(gaussians)) for name, run in runs.items()}
        runs |= gsplat_runs(gaussians, camera)
        return {name: float(wall) for name, (wall, _) in medians(runs, 5, warm_up=2).items()}

    for count in counts:
        for size in sizes:
            yield f"{count} Gaussians, {size} pixels", lambda count=count, size=size: measure(count, size)


def gsplat_runs(gaussians, camera):
    """The same image by gsplat (https://github.com/nerfstudio-project/gsplat), {} where it or torch with CUDA is missing."""
    try:
        import torch  # ty: ignore[import-not-found]
        from gsplat import rasterization  # ty: ignore[import-not-found]
    except ImportError:
        return {}
    import numpy as np

    if not torch.cuda.is_available():
        return {}
    tensor = lambda x: torch.tensor(np.asarray(x), device="cuda")
    names = ("means", "quats", "scales", "opacities", "colors")
    values = {name: tensor(getattr(gaussians, name)).requires_grad_() for name in names}
    view = tensor(camera.cam_from_world)[None], tensor(camera.K)[None], camera.width, camera.height

    def draw():
        image = rasterization(*values.values(), *view)[0]
        torch.cuda.synchronize()
        return image

    def gradient():
        (draw() ** 2).mean().backward()
        torch.cuda.synchronize()

    return {"gsplat, forward": draw, "gsplat, with gradients": gradient}


def network(arguments: argparse.Namespace) -> Iterator[Measurement]:
    """`experiments/reconstruction/benchmark.py` of the published network."""
    from experiments.reconstruction.benchmark import benchmark

    preset, sizes = ("tiny", (32,)) if arguments.tiny else ("published", (256, 512))
    for size in sizes:
        options: dict[str, Any] = {
            "preset": preset,
            "views": 4,
            "size": size,
            "dtype": "auto",
            "repeats": 5,
            "stages": True,
        }
        options |= {"memory": [], "memory_size": size}
        yield f"{preset} {size}", lambda options=options: benchmark(argparse.Namespace(**options))


def frames(arguments: argparse.Namespace) -> Iterator[Measurement]:
    """Frames of an animation a second, and people made on the fly a second."""
    import jax

    from experiments.timing import medians

    size, people, batches = (64, 1, (1,)) if arguments.tiny else (512, 8, (1, 8, 32))

    def animation():
        from humangs_jax.avatar.frames import motion_frames
        from humangs_jax.avatar.reconstruct import reconstruct
        from humangs_jax.avatar.shot import Shot
        from humangs_jax.data.capture import load_capture
        from humangs_jax.data.motion import load_motion
        from humangs_jax.network.weights import load_weights

        avatar, motion = reconstruct(*load_weights(), load_capture("demo_capture")), load_motion(None)
        count = len(motion.translations)
        draw = {"all": lambda: sum(1 for _ in motion_frames(avatar, motion, Shot(size=size), progress=False))}
        return {"frames a second": 1e3 * count / float(medians(draw, 1 if arguments.tiny else 3)["all"][0])}

    def on_the_fly(batch):
        from humangs_jax.body.library import load_body
        from humangs_jax.people.bank import build_bank
        from humangs_jax.people.on_the_fly import OnTheFlyConfig, on_the_fly_example
        from humangs_jax.people.seeds import SPLITS

        bank = build_bank(SPLITS["train"][:people], load_body(), "train", processes=1, progress=False)
        config = OnTheFlyConfig(input_size=size // 2, target_size=size // 2, views_at_once=7, pixels_per_step=1 << 30)
        keys = jax.random.split(jax.random.key(0), batch)
        make = jax.jit(jax.vmap(lambda key: on_the_fly_example(bank, key, config)))
        times = medians({"all": lambda: jax.block_until_ready(make(keys))}, 3)
        return {"people a second": 1e3 * batch / float(times["all"][0])}

    yield f"walk, {size} pixels", animation
    for batch in batches:
        yield f"{batch} people on the fly", lambda batch=batch: on_the_fly(batch)


def batch_sizes(arguments: argparse.Namespace) -> Iterator[Measurement]:
    """Steps of the preset `small` at growing batches; too large a batch fails, and ends the stage by failing all larger ones."""
    preset, size, sizes = ("tiny", 32, (1, 2)) if arguments.tiny else ("small", 256, (1, 2, 4, 8, 16, 32, 64))

    def measure(batch):
        import jax

        from experiments.timing import medians
        from experiments.training.cases import Case
        from humangs_jax.core.compiling import compiler_options

        with tempfile.TemporaryDirectory() as folder:
            case = Case(preset, size, 4 if preset == "small" else 2, 3 if preset == "small" else 2, "float32", batch)
            case.config = dataclasses.replace(case.config, microbatch_size=batch)
            case.prepare(Path(folder))
            program, compile_seconds, _ = case.compiled(compiler_options())
            times = medians({"step": lambda: case.run(program)}, 3)
        statistics = jax.devices()[0].memory_stats() or {}
        ms = float(times["step"][0])
        return {
            "ms": ms,
            "subjects a second": 1e3 * batch / ms,
            "compile s": compile_seconds,
            "peak MB": statistics.get("peak_bytes_in_use", 0) / 2**20,
        }

    for batch in sizes:
        yield f"batch {batch}", lambda batch=batch: measure(batch)


def train(arguments: argparse.Namespace) -> Iterator[Measurement]:
    """The rest of the time: training at the fastest batch, from weights to weights."""

    def measure():
        import shutil

        from experiments.training.train_shipped import main as train_shipped
        from humangs_jax.training.config import small, tiny

        batch = fastest_batch(arguments.out / "batch.json")
        config = dataclasses.replace(tiny() if arguments.tiny else small(), batch_size=batch, microbatch_size=batch)
        if arguments.tiny:
            config = dataclasses.replace(config, steps=4, validate_every=4, checkpoint_every=4)
        hours = (arguments.deadline - time.monotonic()) / 3600 * (1 - RESERVE)
        run, start = Path(tempfile.mkdtemp()), time.perf_counter()
        weights = arguments.init_weights or (None if arguments.tiny else "shipped")
        people = 1 if arguments.tiny else arguments.people
        train_shipped(run, people, arguments.bank, hours=hours, init_weights=weights, config=config)
        shutil.copy(run / "weights.safetensors", arguments.out / "weights.safetensors")
        shutil.copy(run / "log.jsonl", arguments.out / "train_log.jsonl")
        rows = [json.loads(line) for line in (run / "log.jsonl").read_text().splitlines()]
        last = max((row.get("step", 0) for row in rows), default=0)
        shutil.rmtree(run)
        return {"batch": batch, "steps": last, "seconds": time.perf_counter() - start}

    yield f"from {arguments.init_weights or 'shipped weights'}", measure


def fastest_batch(path: Path) -> int:
    """The batch with most subjects a second of a stage's file; 1 without one."""
    rows = json.loads(path.read_text()) if path.is_file() else {}
    speeds = {
        int(name.split()[1]): row["subjects a second"] for name, row in rows.items() if "subjects a second" in row
    }
    return max(speeds, key=lambda batch: speeds[batch], default=1)


def write_tables(out: Path, page: Path) -> None:
    """One table a stage: measurements by their numbers."""
    for stage in STAGES:
        path = out / f"{stage}.json"
        if not path.is_file():
            continue
        found = json.loads(path.read_text())
        rows = [
            [name, key, f"{value:.4g}" if isinstance(value, float) else str(value)]
            for name, numbers in found.items()
            if isinstance(numbers, dict)
            for key, value in numbers.items()
            if not isinstance(value, dict | list)
        ]
        about = f"{found['device']}, JAX {found['jax']}."
        publish(
            page,
            f"accelerator_{stage}",
            f"{about}\n\n{markdown_table(['measurement', 'number', 'value'], rows, 'llr')}",
            found,
        )


if __name__ == "__main__":
    main()
