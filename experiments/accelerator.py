"""Measures what an accelerator does: agreement with the CPU, and times."""

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
"""Number of Gaussians and pixels a side, of each scene."""
Stage = Literal["check", "splatting", "people", "reconstruct", "step", "frames", "published"]
REHEARSAL = 1800.0
"""Seconds that a rehearsal of the list takes."""
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
    """Measures what an accelerator does: agreement with the CPU, and times.

    A measurement that fails is noted, the next one begins, and the exit status is 1.

    The stage check compares the numbers of CPU and device: those of the shipped network, and of
    splatting with gradients. splatting measures images, forward and with gradients. people renders
    people on the fly. reconstruct takes the demo's photos. step is a step of training, as
    `train_by_clock` makes it. frames draws an animation. published runs the published network on
    32 people at once.

    --minutes does all of this by a list with a clock (`quarter_hour.py`), and also training and the
    paper's systems. The list works in OUT, and the same command continues with what is not done.
    --rehearse does the list at small sizes, in the time that two cores of a CPU take for it.

    Options:
    stage: which stages
    small: sizes that a CPU rehearses in minutes
    earlier: files of --json of runs on an accelerator, and run.json of `train_by_clock`; their rows
        are published together, and nothing is measured
    trace: folder for a profile of a training step
    minutes: time for the list; default: no list
    rehearse: do the list at small sizes
    out: folder of the list
    """
    if minutes is not None or rehearse:
        limit = REHEARSAL if minutes is None else 60 * minutes
        return _by_the_clock(out, limit, rehearse or small)
    if earlier:
        _publish_earlier(run, earlier)
        return 0

    # all measurements of the stages, as cases
    settings = {"device": jax.devices()[0].device_kind, "small": small}
    cases = {}
    for name in stage:
        options = (small, trace) if name == "step" else (small,)
        for what, measure in STAGES[name](*options):
            cases[f"{name}: {what}"] = functools.partial(_tried, measure)

    found = run.rows(cases, settings)
    run.show(table_of(settings["device"], found), found)
    return int(any("failed" in numbers for numbers in found.values()))


def _by_the_clock(out: Path, limit: float, small: bool) -> int:
    """Does the list with a clock in `limit` seconds, and returns the exit status."""
    became = quarter_hour.spend(out, limit, small)
    print(quarter_hour.table_of(became))
    print("measured:", *quarter_hour.measured_files(out))
    return int(any(each["became"] in ("failed", "no time") for each in became.values()))


def _publish_earlier(run: Run, earlier: tuple[Path, ...]) -> None:
    """Publishes the rows of earlier runs as one table, made by the first of them."""
    records = [json.loads(path.read_text()) for path in earlier]
    rows = {name: row for record in records for name, row in record["rows"].items()}
    names = ("script", "arguments", "date", "machine", "versions")
    made = {name: records[0][name] for name in names}
    text = table_of(records[0]["settings"]["device"], rows)
    publish(page_of(run.table), run.table, text, rows, made)


def table_of(device: str, found: dict[str, dict[str, Any]]) -> str:
    """Formats all numbers of the rows as a table, below the name of the device."""
    rows = []
    for what, numbers in found.items():
        for key, value in numbers.items():
            if isinstance(value, dict | list):
                continue
            shown = significant(value) if isinstance(value, float) else str(value)
            rows.append([what, key, shown])
    table = markdown_table(["measurement", "number", "value"], rows, "llr")
    return f"{device}. Milliseconds, unless a row says otherwise.\n\n{table}"


def _tried(measure):
    """Returns the numbers of a measurement, or {"failed": the error} if it raises one."""
    try:
        return measure()
    except Exception as error:  # the next measurement may work
        return {"failed": f"{type(error).__name__}: {str(error)[:300]}"}


def check(small: bool) -> Iterator[Measurement]:
    """Yields the differences between the device and the CPU of the same process."""

    def pass_once():
        """Compares the Gaussians of the shipped person."""
        variables, config = load_weights()
        body = gaussian_body(load_body(), config)
        views = to_network_views(load_capture(DEMO_CAPTURE), 256)
        inputs = jax.jit(prepare_inputs, static_argnames="config")(body, views, config)

        def gaussians_of(variables, inputs):
            return apply_humangs(variables, inputs, config)[0].gaussians

        return device_errors(gaussians_of, variables, inputs)

    # splatting needs no network, so that its differences are those of the renderer alone
    def splat():
        """Compares an image of random Gaussians and its gradients."""
        size, count = (64, 1_000) if small else (256, SCENES[0][0])
        gaussians, camera = demo_scene(size, count)
        config = plan_buffers(gaussians, camera)
        target = jnp.asarray(
            np.random.default_rng(1).random((camera.height, camera.width, 3), np.float32)
        )

        def loss(gaussians):
            rgb = render(gaussians, camera, config).rgb
            return jnp.mean((rgb - target) ** 2), rgb

        return device_errors(jax.grad(loss, has_aux=True), gaussians)

    yield "shipped network, relative error", pass_once
    yield "splatting with gradients, relative error", splat


def device_errors(function: Callable[..., Any], *inputs: Any) -> dict[str, float]:
    """Compiles a function for the device and for the CPU and compares what it returns on them.

    Returns {leaf: norm of the difference, as a share of the norm on the CPU}.
    """
    leaves = []
    for place in (jax.devices()[0], jax.devices("cpu")[0]):
        with jax.default_device(place):
            result = jax.jit(function)(*jax.device_put(inputs, place))
            leaves.append(jax.tree_util.tree_leaves_with_path(jax.tree.map(np.asarray, result)))

    found = {}
    for (path, on_device), (_, on_cpu) in zip(*leaves, strict=True):
        difference = np.linalg.norm(np.float64(on_device) - on_cpu)
        relative = difference / (np.linalg.norm(np.float64(on_cpu)) + 1e-300)
        found[jax.tree_util.keystr(path, simple=True, separator=".")] = float(relative)
    return found


def splatting(small: bool) -> Iterator[Measurement]:
    """Yields the milliseconds of an image, alone and with gradients."""

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
        # the first run compiles
        first = {f"{name}, first s": timed(run)[0] / 1e3 for name, run in runs.items()}
        times = {name: float(wall) for name, (wall, _) in medians(runs, 5).items()}
        return times | first | {"pairs": config.max_pairs}

    scenes = ((1_000, 64),) if small else SCENES
    for count, size in scenes:
        yield f"{count} Gaussians, {size} pixels", functools.partial(measure, count, size)


def people(small: bool) -> Iterator[Measurement]:
    """Yields how many people are made on the fly a second, one by one and under `vmap`."""
    size = 32 if small else 256

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

    def measure(batch):
        config = OnTheFlyConfig(
            input_size=size, target_size=size, views_at_once=7, pixels_per_step=1 << 30, depths=True
        )
        keys = jax.random.split(jax.random.key(0), batch)
        make = jax.jit(jax.vmap(functools.partial(on_the_fly_example, bank(), config=config)))
        time = float(medians({"all": lambda: jax.block_until_ready(make(keys))}, 3)["all"][0])
        return {"ms": time, "people a second": 1e3 * batch / time}

    batches = (1,) if small else (1, 8)
    for batch in batches:
        yield f"{batch} at once", functools.partial(measure, batch)


def reconstructed(small: bool) -> Iterator[Measurement]:
    """Yields the seconds of `hg.reconstruct` and of the learned iterations, the first and the
    second time.
    """

    def measure(refined):
        (variables, config), capture, times = load_weights(), load_capture(DEMO_CAPTURE), {}

        def first():
            return reconstruct(variables, config, capture)

        run = first
        if refined:
            run = functools.partial(refine, first(), capture, steps=0)
        for which in ("first", "second"):
            began = perf_counter()
            jax.block_until_ready(run())
            times[f"{which} s"] = perf_counter() - began
        return times

    yield "feed-forward", functools.partial(measure, False)
    yield "learned iterations", functools.partial(measure, True)


def training_step(small: bool, trace: Path | None) -> Iterator[Measurement]:
    """Yields the seconds to compile a step of training with LPIPS, and the milliseconds of a step
    and of making its batch.
    """
    batch_size = 1 if small else 8

    def measure() -> dict[str, Any]:
        # the network, the people and the state that a step takes
        how = train_by_clock.Clock(batch=batch_size)
        body, (variables, model) = load_body(), load_weights()
        config, carrier = train_by_clock.configured(how), gaussian_body(body, model)
        config = dataclasses.replace(
            config, model=dataclasses.replace(model, runtime=config.model.runtime)
        )
        networks = load_loss_networks(lpips_net="alex", installed=True)
        if networks.lpips is None:  # the extra `lpips` is not installed
            config = dataclasses.replace(config, loss=dataclasses.replace(config.loss, lpips=0.0))
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

    yield f"{batch_size} people", measure


def frames(small: bool) -> Iterator[Measurement]:
    """Yields the frames of an animation a second, drawn one after the other."""

    def measure(size: int) -> dict[str, Any]:
        avatar = reconstruct(*load_weights(), load_capture(DEMO_CAPTURE))
        motion = load_motion()

        def draw():
            return list(motion_frames(avatar, motion, FrameSettings(size=size), progress=False))

        wall = float(medians({"all": draw}, 1)["all"][0])
        return {"frames a second": 1e3 * len(motion.translations) / wall}

    sizes = (64,) if small else (512, 1024)
    for size in sizes:
        yield f"{size} pixels", functools.partial(measure, size)


def published_network(small: bool) -> Iterator[Measurement]:
    """Yields the milliseconds that the published network with random weights takes from photos to
    Gaussians, for a batch of people.
    """

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

    batches = (2,) if small else (1, 32)
    for batch in batches:
        yield f"{batch} at once", functools.partial(measure, batch)


MEASURES = (
    *(check, splatting, people, reconstructed),
    *(training_step, frames, published_network),
)
STAGES: dict[str, Any] = dict(zip(get_args(Stage), MEASURES, strict=True))
