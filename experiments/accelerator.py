"""What an accelerator does: agreement with the CPU, and times."""

import dataclasses
import functools
import json
import os
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from time import perf_counter
from typing import Any, Literal, get_args

import jax
import jax.numpy as jnp
import numpy as np

from experiments.harness import Run, entry
from experiments.reconstruction import benchmark, configured
from experiments.results import markdown_table, page_of, publish, significant
from experiments.splatting import demo_scene
from experiments.timing import medians, timed
from humangs_jax.avatar.frames import motion_frames
from humangs_jax.avatar.reconstruct import reconstruct
from humangs_jax.avatar.shot import Shot
from humangs_jax.body.library import load_body
from humangs_jax.body.model import BodyModel
from humangs_jax.data.capture import load_capture
from humangs_jax.data.loading import Loader
from humangs_jax.data.loading.captures import find_captures
from humangs_jax.data.motion import load_motion
from humangs_jax.data.photos import DEMO_CAPTURE
from humangs_jax.data.views import gaussian_body, prepare_inputs, standardize
from humangs_jax.losses.loss_networks import load_loss_networks
from humangs_jax.network.humangs import apply_humangs
from humangs_jax.network.weights import load_weights
from humangs_jax.people.bank import PeopleBank, build_bank
from humangs_jax.people.on_the_fly import OnTheFlyConfig, on_the_fly_example
from humangs_jax.people.subject import SPLITS
from humangs_jax.people.writer import Layout, write_set
from humangs_jax.refinement.refine import refine
from humangs_jax.rendering import compositing
from humangs_jax.rendering.buffers import plan_buffers
from humangs_jax.rendering.splat_config import SplatConfig
from humangs_jax.rendering.splatting import render
from humangs_jax.training import config as train_presets
from humangs_jax.training.config import TrainConfig, compiled_for, fitting_losses
from humangs_jax.training.loop import train as train_run
from humangs_jax.training.sources import on_the_fly_people
from humangs_jax.training.state import init_state
from humangs_jax.training.step import compiled_update, seed_numbers

SCENES = ((20_000, 256), (20_000, 512), (52_000, 512), (52_000, 1024), (140_000, 1024), (500_000, 1024))
"""Gaussians of the scenes, pixels a side."""
Stage = Literal["check", "splatting", "schedule", "people", "training", "reconstruct", "frames", "network"]
Measurement = tuple[str, Callable[[], dict[str, Any]]]


@entry
def accelerator(
    run: Run, stage: tuple[Stage, ...] = get_args(Stage), small: bool = False, earlier: tuple[Path, ...] = ()
) -> None:
    """What an accelerator does: agreement with the CPU, and times. What fails is noted, and the next one begins.

    check: the same numbers on CPU and device: the shipped network, splatting by the schedule of each with gradients, a resumed
    run. splatting: forward and with gradients, beside gsplat if it is installed. schedule: the same, by settings of the schedule.
    people: rendered on the fly. training: steps of the preset `small` from the shipped weights. reconstruct: the demo's photos.
    frames: of an animation. network: the published one beside plain products of as many operations.

    Options:
    stage: which
    small: sizes that a CPU rehearses in minutes
    earlier: files of --json of runs on an accelerator, and run.json of `train_by_clock`: their rows are published together, and
        nothing is measured
    """
    if earlier:
        records = [json.loads(path.read_text()) for path in earlier]
        rows = {name: row for record in records for name, row in record["rows"].items()}
        made = {name: records[0][name] for name in ("script", "arguments", "date", "machine", "versions")}
        publish(page_of(run.table), run.table, table_of(records[0]["settings"]["device"], rows), rows, made)
        return
    makers = {"check": check, "splatting": splatting, "schedule": schedule, "people": people, "training": training}
    makers |= {"reconstruct": reconstructed, "frames": frames, "network": network}
    settings = {"device": jax.devices()[0].device_kind, "small": small}
    cases = {f"{name}: {what}": functools.partial(_tried, measure) for name in stage for what, measure in makers[name](small)}
    found = run.rows(cases, settings)
    run.show(table_of(settings["device"], found), found)


def table_of(device: str, found: dict[str, dict[str, Any]]) -> str:
    """All numbers of the rows."""
    rows = [
        [what, key, significant(value) if isinstance(value, float) else str(value)]
        for what, numbers in found.items()
        for key, value in numbers.items()
        if not isinstance(value, dict | list)
    ]
    return f"{device}. Milliseconds, unless said otherwise.\n\n{markdown_table(['measurement', 'number', 'value'], rows, 'llr')}"


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
        body, views = gaussian_body(load_body(), config), standardize(load_capture(DEMO_CAPTURE), 256)
        inputs = jax.jit(prepare_inputs, static_argnames="config")(body, views, config)
        return errors(everywhere(lambda v, x: apply_humangs(v, x, config)[0].gaussians, variables, inputs))

    def splat():
        scene = demo_scene(64 if small else 256, 1_000 if small else SCENES[0][0])
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
    config = dataclasses.replace(train_presets.tiny(), steps=4)
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


_scene = functools.cache(demo_scene)


def splatting(small: bool) -> Iterator[Measurement]:
    """Milliseconds of an image, alone and with gradients."""
    for count, size in ((1_000, 64),) if small else SCENES:
        yield f"{count} Gaussians, {size} pixels", lambda count=count, size=size: drawing_times(count, size, gsplat_runs)


def drawing_times(count: int, size: int, others: Callable[..., Any] = lambda *_: {}, **settings: Any) -> dict[str, Any]:
    """Milliseconds of an image, alone and with gradients. settings: of the `SplatConfig`."""
    gaussians, camera = _scene(size, count)
    config = plan_buffers(gaussians, camera, SplatConfig(**settings))
    draw = jax.jit(lambda g: render(g, camera, config).rgb)
    gradient = jax.jit(jax.grad(lambda g: jnp.mean(render(g, camera, config).rgb ** 2)))
    runs = {"forward": draw, "with gradients": gradient}
    runs = {name: lambda run=run: jax.block_until_ready(run(gaussians)) for name, run in runs.items()}
    runs |= others(gaussians, camera)
    first = {f"{name}, first s": timed(run)[0] / 1e3 for name, run in runs.items()}  # compilation
    return {name: float(wall) for name, (wall, _) in medians(runs, 5).items()} | first | {"pairs": config.max_pairs}


def schedule(small: bool) -> Iterator[Measurement]:
    """`drawing_times` by the sizes of tiles, chunks and steps of `compositing`."""
    sizes = {"CHUNK": compositing.CHUNK, "STEP_BYTES": compositing.STEP_BYTES, "STEP_CHUNKS": compositing.STEP_CHUNKS}

    def measure(tile, block, **changed):
        for name, value in (sizes | changed).items():
            setattr(compositing, name, value)
        for cached in (compositing.forward_by_chunks, compositing.backward_by_chunks):
            cached.cache_clear()
        try:  # the block has no effect on an accelerator, but makes a program of its own
            return drawing_times(*((1_000, 64) if small else (52_000, 512)), tile_size=tile, block=block)
        finally:
            for name, value in sizes.items():
                setattr(compositing, name, value)

    wide = {"STEP_BYTES": 512 << 20, "STEP_CHUNKS": 8192}
    cases = (
        (8, {}),
        (16, {}),
        (8, {"CHUNK": 32}),
        (8, {"CHUNK": 128}),
        (8, {"STEP_CHUNKS": 512}),
        (8, wide),
        (16, {"CHUNK": 32, **wide}),
        (8, {"CHUNK": 16, "STEP_CHUNKS": 4096}),
    )
    for i, (tile, changed) in enumerate(cases):
        yield f"tile {tile} {changed}", functools.partial(measure, tile, 16 + i, **changed)


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
    preset, sizes = ("tiny", (32,)) if small else ("published", (512,))
    for size in sizes:
        yield f"{preset} {size}", lambda size=size: benchmark(configured(preset, size), 4, size, 5)


@functools.cache
def bank_of(count: int) -> tuple[PeopleBank, BodyModel, TrainConfig]:
    """People of the training seeds with their displacements; the body and the run that they are for."""
    config, body = train_presets.small(), load_body()
    config = dataclasses.replace(config, model=dataclasses.replace(load_weights()[1], runtime=config.model.runtime))
    config = dataclasses.replace(config, views=dataclasses.replace(config.views, input_counts=(4,)))
    carrier = gaussian_body(body, config.model)
    processes = min(count, os.cpu_count() or 1)
    return build_bank(SPLITS["train"][:count], body, "train", displaced=carrier, processes=processes), carrier, config


def people(small: bool) -> Iterator[Measurement]:
    """People made on the fly a second, one by one and under `vmap`."""

    def measure(batch, size):
        bank, _, _ = bank_of(1 if small else 8)
        config = OnTheFlyConfig(input_size=size, target_size=size, views_at_once=7, pixels_per_step=1 << 30, depths=True)
        keys = jax.random.split(jax.random.key(0), batch)
        make = jax.jit(jax.vmap(lambda key: on_the_fly_example(bank, key, config)))
        time = float(medians({"all": lambda: jax.block_until_ready(make(keys))}, 3)["all"][0])
        return {"ms": time, "people a second": 1e3 * batch / time}

    for batch in (1,) if small else (1, 8):
        yield f"{batch} at once", lambda batch=batch: measure(batch, 32 if small else 256)


def training(small: bool) -> Iterator[Measurement]:
    """Steps from the shipped weights, by the size of the batch; and making their examples."""

    def measure(batch, lpips):
        bank, body, config = bank_of(1 if small else 8)
        config = dataclasses.replace(config, batch_size=batch, microbatch_size=batch)
        if small:
            config = dataclasses.replace(config, model=config.model.with_conventions(image_size=64), target_size=64)
        networks = load_loss_networks(lpips_net="alex", installed=True)
        config = fitting_losses(dataclasses.replace(config, loss=dataclasses.replace(config.loss, lpips=lpips)), networks)
        source = on_the_fly_people(bank, OnTheFlyConfig(displaced_share=0.5))(config)
        loader, state = Loader(source, batch), init_state(config, jax.tree.map(jnp.array, load_weights()[0]))
        began = perf_counter()
        inputs = jax.block_until_ready(loader.batch_at(0))
        compiled_examples = perf_counter() - began
        seed, step, found = seed_numbers(0), compiled_update(), {}

        def run():
            nonlocal state
            state, metrics = step(state, inputs, body, networks, seed, compiled_for(config), None)
            found.update({name: float(value) for name, value in jax.device_get(metrics).items()})

        began = perf_counter()
        run()
        compiled = perf_counter() - began
        first = {name: found[name] for name in ("loss", "psnr", "grad_norm", "overflow", "dropped_tokens")}
        times = medians({"examples": lambda: jax.block_until_ready(loader.batch_at(1)), "step": run}, 3, warm_up=1)
        times = {f"{name} ms": float(wall) for name, (wall, _) in times.items()}
        peak = (jax.devices()[0].memory_stats() or {}).get("peak_bytes_in_use", 0) / 2**20
        return times | first | {"first examples s": compiled_examples, "first step s": compiled, "peak MB": peak}

    for batch, lpips in ((1, 0.0), (2, 0.0)) if small else ((1, 0.1), (8, 0.1), (32, 0.1)):
        yield f"batch {batch}", lambda batch=batch, lpips=lpips: measure(batch, lpips)


def reconstructed(small: bool) -> Iterator[Measurement]:
    """Seconds of `hg.reconstruct` and of the learned iterations, the first and the second time."""

    def feed_forward():
        (variables, config), capture, times = load_weights(), load_capture(DEMO_CAPTURE), {}
        for which in ("first", "second"):
            began = perf_counter()
            jax.block_until_ready(reconstruct(variables, config, capture))
            times[f"{which} s"] = perf_counter() - began
        return times

    def refined():
        (variables, config), capture, times = load_weights(), load_capture(DEMO_CAPTURE), {}
        avatar = reconstruct(variables, config, capture)
        for which in ("first", "second"):
            began = perf_counter()
            jax.block_until_ready(refine(avatar, capture, steps=0))
            times[f"{which} s"] = perf_counter() - began
        return times

    yield "feed-forward", feed_forward
    yield "learned iterations", refined


def frames(small: bool) -> Iterator[Measurement]:
    """Frames of an animation a second."""

    def animation():
        avatar, motion = reconstruct(*load_weights(), load_capture(DEMO_CAPTURE)), load_motion(None)
        count = len(motion.translations)
        shot = Shot(size=64 if small else 512)
        draw = {"all": lambda: sum(1 for _ in motion_frames(avatar, motion, shot, progress=False))}
        return {"frames a second": 1e3 * count / float(medians(draw, 1 if small else 3)["all"][0])}

    yield "walk, 512 pixels", animation
