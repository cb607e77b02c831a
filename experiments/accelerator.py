"""What an accelerator does: agreement with the CPU, and times."""

import dataclasses
import functools
import json
import os
from collections.abc import Callable, Iterator
from pathlib import Path
from time import perf_counter
from typing import Any, Literal, get_args

import jax
import jax.numpy as jnp
import numpy as np

from experiments import quarter_hour, train_by_clock
from experiments.harness import Run, entry
from experiments.reconstruction import benchmark_inputs, foreground, random_variables
from experiments.results import markdown_table, page_of, publish, significant
from experiments.splatting import demo_scene
from experiments.timing import medians, timed
from humangs_jax.avatar.frame_settings import FrameSettings
from humangs_jax.avatar.frames import motion_frames
from humangs_jax.avatar.reconstruct import reconstruct
from humangs_jax.body.library import load_body
from humangs_jax.data.capture import load_capture
from humangs_jax.data.photos import DEMO_CAPTURE
from humangs_jax.data.views import gaussian_body, prepare_inputs, to_network_views
from humangs_jax.losses.loss_networks import load_loss_networks
from humangs_jax.motion import load_motion
from humangs_jax.network import presets
from humangs_jax.network.humangs import apply_humangs
from humangs_jax.network.weights import load_weights
from humangs_jax.refinement.refine import refine
from humangs_jax.rendering.buffers import plan_buffers
from humangs_jax.rendering.splatting import render
from humangs_jax.synthetic.bank import build_bank
from humangs_jax.synthetic.on_the_fly import OnTheFlyConfig, on_the_fly_example
from humangs_jax.synthetic.subject import SPLITS
from humangs_jax.training.state import init_state
from humangs_jax.training.step import seed_numbers

SCENES = tuple((count, size) for count in (20_000, 52_000, 200_000) for size in (512, 1024))
"""Gaussians of the scenes, pixels a side."""
Stage = Literal["check", "splatting", "people", "reconstruct", "step", "frames", "published"]
REHEARSAL = 1800.0
"""Seconds of a rehearsal."""
Measurement = tuple[str, Callable[[], dict[str, Any]]]


@entry
def accelerator(
    run: Run,
    stage: tuple[Stage, ...] = get_args(Stage),
    small: bool = False,
    earlier: tuple[Path, ...] = (),
    trace: Path | None = None,
    minutes: float | None = None,
    rehearse: bool = False,
    out: Path = Path("accelerator_out"),
) -> int:
    """What an accelerator does: agreement with the CPU, and times.

    What fails is noted, the next one begins, and the exit status is 1.

    check: the same numbers on CPU and device: the shipped network, splatting by the schedule of
    each with gradients. splatting: forward and with gradients. people: rendered on the fly.
    reconstruct: the demo's photos. step: of training, as `train_by_clock` makes it. frames: of an
    animation. published: the published network on 32 people at once.

    With --minutes all of it is done by a list with a clock (`quarter_hour.py`), training and the
    paper's systems too, in OUT; the same command goes on with what is not done. --rehearse does so
    at small sizes, with as much time as that takes on two cores of a CPU.

    Options:
    stage: which
    small: sizes that a CPU rehearses in minutes
    earlier: files of --json of runs on an accelerator, and run.json of `train_by_clock`: their rows
        are published together, and nothing is measured
    trace: folder for a profile of a training step
    minutes: of the list; default: no list
    rehearse: the list at small sizes
    out: folder of the list
    """
    if minutes is not None or rehearse:
        limit = REHEARSAL if minutes is None else 60 * minutes
        became = quarter_hour.spend(out, limit, rehearse or small)
        print(quarter_hour.table_of(became))
        print("measured:", *quarter_hour.measured_files(out))
        return int(any(each["became"] in ("failed", "no time") for each in became.values()))
    if earlier:
        records = [json.loads(path.read_text()) for path in earlier]
        rows = {name: row for record in records for name, row in record["rows"].items()}
        made = {
            name: records[0][name]
            for name in ("script", "arguments", "date", "machine", "versions")
        }
        publish(
            page_of(run.table),
            run.table,
            table_of(records[0]["settings"]["device"], rows),
            rows,
            made,
        )
        return 0
    settings = {"device": jax.devices()[0].device_kind, "small": small}
    cases = {
        f"{name}: {what}": functools.partial(_tried, measure)
        for name in stage
        for what, measure in (STAGES[name](small, trace) if name == "step" else STAGES[name](small))
    }
    found = run.rows(cases, settings)
    run.show(table_of(settings["device"], found), found)
    return int(any("failed" in numbers for numbers in found.values()))


def table_of(device: str, found: dict[str, dict[str, Any]]) -> str:
    """All numbers of the rows."""
    rows = [
        [what, key, significant(value) if isinstance(value, float) else str(value)]
        for what, numbers in found.items()
        for key, value in numbers.items()
        if not isinstance(value, dict | list)
    ]
    return (
        f"{device}. Milliseconds, unless said"
        f" otherwise.\n\n{markdown_table(['measurement', 'number', 'value'], rows, 'llr')}"
    )


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
                found[name] = jax.tree.map(
                    np.asarray, jax.jit(function)(*jax.device_put(inputs, place))
                )
        return found

    def errors(found):
        """{leaf: relative difference between the device and the CPU}."""
        pairs = zip(
            *(jax.tree_util.tree_leaves_with_path(found[name]) for name in ("device", "CPU")),
            strict=True,
        )

        def relative(a, b):
            return float(
                np.linalg.norm(np.float64(a) - b) / (np.linalg.norm(np.float64(b)) + 1e-300)
            )

        return {
            jax.tree_util.keystr(path, simple=True, separator="."): relative(a, b)
            for (path, a), (_, b) in pairs
        }

    def pass_once():
        """The Gaussians of the shipped person."""
        variables, config = load_weights()
        body = gaussian_body(load_body(), config)
        views = to_network_views(load_capture(DEMO_CAPTURE), 256)
        inputs = jax.jit(prepare_inputs, static_argnames="config")(body, views, config)
        return errors(
            everywhere(lambda v, x: apply_humangs(v, x, config)[0].gaussians, variables, inputs)
        )

    def splat():
        """An image of random Gaussians and its gradients."""
        scene = demo_scene(64 if small else 256, 1_000 if small else SCENES[0][0])
        gaussians, camera = scene
        config = plan_buffers(gaussians, camera)
        target = jnp.asarray(
            np.random.default_rng(1).random((camera.height, camera.width, 3), np.float32)
        )

        def loss(gaussians):
            rgb = render(gaussians, camera, config).rgb
            return jnp.mean((rgb - target) ** 2), rgb

        return errors(everywhere(jax.grad(loss, has_aux=True), gaussians))

    yield "shipped network, relative error", pass_once
    yield "splatting with gradients, relative error", splat


def splatting(small: bool) -> Iterator[Measurement]:
    """Milliseconds of an image, alone and with gradients."""

    def measure(count, size):
        gaussians, camera = demo_scene(size, count)
        config = plan_buffers(gaussians, camera)
        draw = jax.jit(lambda g: render(g, camera, config).rgb)
        gradient = jax.jit(jax.grad(lambda g: jnp.mean(render(g, camera, config).rgb ** 2)))
        runs = {"forward": draw, "with gradients": gradient}
        runs = {
            name: lambda run=run: jax.block_until_ready(run(gaussians))
            for name, run in runs.items()
        }
        first = {
            f"{name}, first s": timed(run)[0] / 1e3 for name, run in runs.items()
        }  # compilation
        return (
            {name: float(wall) for name, (wall, _) in medians(runs, 5).items()}
            | first
            | {"pairs": config.max_pairs}
        )

    for count, size in ((1_000, 64),) if small else SCENES:
        yield f"{count} Gaussians, {size} pixels", functools.partial(measure, count, size)


def people(small: bool) -> Iterator[Measurement]:
    """People made on the fly a second, one by one and under `vmap`."""

    @functools.cache
    def bank():
        seeds, body = SPLITS["train"][: 1 if small else 8], load_body()
        displaced = gaussian_body(body, load_weights()[1])
        return build_bank(
            seeds,
            body,
            "train",
            displaced=displaced,
            processes=min(len(seeds), os.cpu_count() or 1),
        )

    def measure(batch, size):
        config = OnTheFlyConfig(
            input_size=size, target_size=size, views_at_once=7, pixels_per_step=1 << 30, depths=True
        )
        keys = jax.random.split(jax.random.key(0), batch)
        make = jax.jit(jax.vmap(functools.partial(on_the_fly_example, bank(), config=config)))
        time = float(medians({"all": lambda: jax.block_until_ready(make(keys))}, 3)["all"][0])
        return {"ms": time, "people a second": 1e3 * batch / time}

    for batch in (1,) if small else (1, 8):
        yield f"{batch} at once", functools.partial(measure, batch, 32 if small else 256)


def reconstructed(small: bool) -> Iterator[Measurement]:
    """Seconds of `hg.reconstruct` and of the learned iterations, the first and the second time."""

    def measure(refined):
        (variables, config), capture, times = load_weights(), load_capture(DEMO_CAPTURE), {}

        def first():
            return reconstruct(variables, config, capture)

        run = functools.partial(refine, first(), capture, steps=0) if refined else first
        for which in ("first", "second"):
            began = perf_counter()
            jax.block_until_ready(run())
            times[f"{which} s"] = perf_counter() - began
        return times

    yield "feed-forward", functools.partial(measure, False)
    yield "learned iterations", functools.partial(measure, True)


def training_step(small: bool, trace: Path | None) -> Iterator[Measurement]:
    """Seconds to compile a step of training with LPIPS, milliseconds of a step and of its batch."""

    def measure() -> dict[str, Any]:
        how = train_by_clock.Clock(batch=1 if small else 8)
        body, (variables, model) = load_body(), load_weights()
        config, carrier = train_by_clock.configured(how), gaussian_body(body, model)
        config = dataclasses.replace(
            config, model=dataclasses.replace(model, runtime=config.model.runtime)
        )
        networks = load_loss_networks(lpips_net="alex", installed=True)
        bank = build_bank(SPLITS["train"][:1], body, "train", displaced=carrier)
        state, average = (init_state(config, variables) for _ in range(2))
        examples = jax.jit(train_by_clock.examples_of(config, how))
        batch = jax.block_until_ready(examples(bank, 0))
        given = carrier, networks, seed_numbers(0)

        began = perf_counter()
        lowered = train_by_clock.stepper(config).lower(state, average.params, batch, *given, 1.0)
        middle = perf_counter()
        step = lowered.compile()
        numbers = {"lower s": middle - began, "compile s": perf_counter() - middle}

        # the state is given away at each step
        running = [state, average.params]

        def one() -> None:
            running[:] = step(*running, batch, *given, 1.0)[:2]
            jax.block_until_ready(running)

        runs = {"step": one, "batch": lambda: jax.block_until_ready(examples(bank, 1))}
        numbers |= {
            name: float(wall) for name, (wall, _) in medians(runs, 1 if small else 10).items()
        }
        if trace is not None:
            with jax.profiler.trace(str(trace)):
                one()
        return numbers

    yield f"{1 if small else 8} people", measure


def frames(small: bool) -> Iterator[Measurement]:
    """Frames of an animation a second, drawn one after the other."""

    def measure(size: int) -> dict[str, Any]:
        avatar = reconstruct(*load_weights(), load_capture(DEMO_CAPTURE))
        motion = load_motion()

        def draw():
            return list(motion_frames(avatar, motion, FrameSettings(size=size), progress=False))

        wall = float(medians({"all": draw}, 1)["all"][0])
        return {"frames a second": 1e3 * len(motion.translations) / wall}

    for size in (64,) if small else (512, 1024):
        yield f"{size} pixels", functools.partial(measure, size)


def published_network(small: bool) -> Iterator[Measurement]:
    """Milliseconds of the published network, random weights, photos to Gaussians, in a batch."""

    def measure(batch: int) -> dict[str, Any]:
        config = presets.tiny() if small else presets.published()
        variables = random_variables(config)
        inputs = benchmark_inputs(config, 4, config.conventions.image_size)
        config, _, _ = foreground(inputs, config)
        together = jax.tree.map(lambda x: jnp.stack([x] * batch), inputs)

        def each(x):
            return apply_humangs(variables, x, config)[0].gaussians

        make = jax.jit(jax.vmap(each))

        def run():
            return jax.block_until_ready(make(together))

        wall = float(medians({"all": run}, 1 if small else 5)["all"][0])
        return {"ms": wall, "people a second": 1e3 * batch / wall}

    for batch in (2,) if small else (1, 32):
        yield f"{batch} at once", functools.partial(measure, batch)


MEASURES = (
    *(check, splatting, people, reconstructed),
    *(training_step, frames, published_network),
)
STAGES: dict[str, Any] = dict(zip(get_args(Stage), MEASURES, strict=True))
