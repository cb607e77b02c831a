"""What an accelerator does: agreement with the CPU, times, the batch that fits."""

import dataclasses
import functools
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Literal, get_args

import jax
import jax.numpy as jnp
import numpy as np

from experiments.harness import Run, entry
from experiments.reconstruction import benchmark, configured
from experiments.results import markdown_table
from experiments.splatting import demo_scene
from experiments.timing import medians
from experiments.training import Case
from humangs_jax.avatar.frames import motion_frames
from humangs_jax.avatar.reconstruct import reconstruct
from humangs_jax.avatar.shot import Shot
from humangs_jax.body.library import load_body
from humangs_jax.core.processes import compiler_options
from humangs_jax.data.capture import load_capture
from humangs_jax.data.loading.captures import find_captures
from humangs_jax.data.motion import load_motion
from humangs_jax.data.views import gaussian_body, prepare_inputs, standardize
from humangs_jax.network.humangs import apply_humangs
from humangs_jax.network.weights import load_weights
from humangs_jax.people.bank import build_bank
from humangs_jax.people.on_the_fly import OnTheFlyConfig, on_the_fly_example
from humangs_jax.people.subject import SPLITS
from humangs_jax.people.writer import Layout, write_set
from humangs_jax.rendering.buffers import plan_buffers
from humangs_jax.rendering.splatting import render
from humangs_jax.training.config import tiny
from humangs_jax.training.loop import train as train_run

COUNTS = (20_000, 52_000, 140_000, 500_000)
"""Gaussians of the scenes."""
Stage = Literal["check", "splatting", "network", "frames", "batch"]
Measurement = tuple[str, Callable[[], dict[str, Any]]]


@entry
def accelerator(run: Run, stage: tuple[Stage, ...] = get_args(Stage), small: bool = False) -> None:
    """What an accelerator does: agreement with the CPU, times, the batch that fits. What fails is noted, and the next one begins.

    check: the same numbers on CPU and device: the shipped network, splatting by the schedule of each with gradients, a resumed
    run. splatting: forward and with gradients, beside gsplat if it is installed. network: the published one beside plain products
    of as many operations. frames: of an animation, and people rendered on the fly. batch: steps of training at batch sizes until
    memory ends.

    Options:
    stage: which
    small: sizes that a CPU rehearses in minutes
    """
    makers = {"check": check, "splatting": splatting, "network": network, "frames": frames, "batch": batch_sizes}
    settings = {"device": jax.devices()[0].device_kind, "small": small}
    cases = {f"{name}: {what}": functools.partial(_tried, measure) for name in stage for what, measure in makers[name](small)}
    found = run.rows(cases, settings)
    rows = [
        [what, key, f"{value:.4g}" if isinstance(value, float) else str(value)]
        for what, numbers in found.items()
        for key, value in numbers.items()
        if not isinstance(value, dict | list)
    ]
    run.show(f"{settings['device']}.\n\n{markdown_table(['measurement', 'number', 'value'], rows, 'llr')}", found)


def _tried(measure):
    try:
        return measure()
    except Exception as error:  # the next measurement may work
        return {"failed": f"{type(error).__name__}: {str(error)[:300]}"}


def check(small: bool) -> Iterator[Measurement]:
    """Differences between the device and the CPU of the same process."""
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
        scene = demo_scene(64 if small else 256, 1_000 if small else COUNTS[0])
        gaussians, camera = scene
        config = plan_buffers(gaussians, camera)
        target = jnp.asarray(np.random.default_rng(1).random((camera.height, camera.width, 3), np.float32))

        def loss(gaussians):
            rgb = render(gaussians, camera, config).rgb
            return jnp.mean((rgb - target) ** 2), rgb

        return errors(everywhere(jax.grad(loss, has_aux=True), gaussians))

    yield "shipped network, relative error", pass_once
    yield "splatting with gradients, relative error", splat
    yield "resumed run", resumed


def resumed() -> dict[str, Any]:
    """Four steps of the preset `tiny` at once, and two and two: largest difference of a parameter."""
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


def splatting(small: bool) -> Iterator[Measurement]:
    """Milliseconds of an image, alone and with gradients."""
    counts, sizes = ((1_000,), (64,)) if small else (COUNTS, (256, 512, 1024))

    def measure(count, size):
        gaussians, camera = demo_scene(size, count)
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


def network(small: bool) -> Iterator[Measurement]:
    """`reconstruction.benchmark` of the published network."""
    preset, sizes = ("tiny", (32,)) if small else ("published", (256, 512))
    for size in sizes:
        yield f"{preset} {size}", lambda size=size: benchmark(configured(preset, size), 4, size, 5)


def frames(small: bool) -> Iterator[Measurement]:
    """Frames of an animation a second, and people made on the fly a second."""
    size, people, batches = (64, 1, (1,)) if small else (512, 8, (1, 8, 32))

    def animation():
        avatar, motion = reconstruct(*load_weights(), load_capture("demo_capture")), load_motion(None)
        count = len(motion.translations)
        draw = {"all": lambda: sum(1 for _ in motion_frames(avatar, motion, Shot(size=size), progress=False))}
        return {"frames a second": 1e3 * count / float(medians(draw, 1 if small else 3)["all"][0])}

    def on_the_fly(batch):
        bank = build_bank(SPLITS["train"][:people], load_body(), "train", processes=1, progress=False)
        config = OnTheFlyConfig(input_size=size // 2, target_size=size // 2, views_at_once=7, pixels_per_step=1 << 30)
        keys = jax.random.split(jax.random.key(0), batch)
        make = jax.jit(jax.vmap(lambda key: on_the_fly_example(bank, key, config)))
        times = medians({"all": lambda: jax.block_until_ready(make(keys))}, 3)
        return {"people a second": 1e3 * batch / float(times["all"][0])}

    yield f"walk, {size} pixels", animation
    for batch in batches:
        yield f"{batch} people on the fly", lambda batch=batch: on_the_fly(batch)


def batch_sizes(small: bool) -> Iterator[Measurement]:
    """Steps of the preset `small` at growing batches; too large a batch fails, and ends the stage by failing all larger ones."""
    preset, size, sizes = ("tiny", 32, (1, 2)) if small else ("small", 256, (1, 2, 4, 8, 16, 32, 64))

    def measure(batch):
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
