"""What an accelerator does: agreement with the CPU, and times."""

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

from experiments.harness import Run, entry
from experiments.results import markdown_table, page_of, publish, significant
from experiments.splatting import demo_scene
from experiments.timing import medians, timed
from humangs_jax.avatar.reconstruct import reconstruct
from humangs_jax.body.library import load_body
from humangs_jax.data.capture import load_capture
from humangs_jax.data.photos import DEMO_CAPTURE
from humangs_jax.data.views import gaussian_body, prepare_inputs, to_network_views
from humangs_jax.network.humangs import apply_humangs
from humangs_jax.network.weights import load_weights
from humangs_jax.refinement.refine import refine
from humangs_jax.rendering.buffers import plan_buffers
from humangs_jax.rendering.splatting import render
from humangs_jax.synthetic.bank import build_bank
from humangs_jax.synthetic.on_the_fly import OnTheFlyConfig, on_the_fly_example
from humangs_jax.synthetic.subject import SPLITS

SCENES = (
    (20_000, 256),
    (20_000, 512),
    (52_000, 512),
    (52_000, 1024),
    (140_000, 1024),
    (500_000, 1024),
)
"""Gaussians of the scenes, pixels a side."""
Stage = Literal["check", "splatting", "people", "reconstruct"]
Measurement = tuple[str, Callable[[], dict[str, Any]]]


@entry
def accelerator(
    run: Run,
    stage: tuple[Stage, ...] = get_args(Stage),
    small: bool = False,
    earlier: tuple[Path, ...] = (),
) -> int:
    """What an accelerator does: agreement with the CPU, and times.

    What fails is noted, the next one begins, and the exit status is 1.

    check: the same numbers on CPU and device: the shipped network, splatting by the schedule of
    each with gradients. splatting: forward and with gradients. people: rendered on the fly.
    reconstruct: the demo's photos. Training: `train_by_clock`.

    Options:
    stage: which
    small: sizes that a CPU rehearses in minutes
    earlier: files of --json of runs on an accelerator, and run.json of `train_by_clock`: their rows
        are published together, and nothing is measured
    """
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
        for what, measure in STAGES[name](small)
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
        pairs = zip(
            *(jax.tree_util.tree_leaves_with_path(found[name]) for name in ("device", "CPU")),
            strict=True,
        )
        relative = lambda a, b: float(
            np.linalg.norm(np.float64(a) - b) / (np.linalg.norm(np.float64(b)) + 1e-300)
        )
        return {
            jax.tree_util.keystr(path, simple=True, separator="."): relative(a, b)
            for (path, a), (_, b) in pairs
        }

    def pass_once():
        variables, config = load_weights()
        body, views = (
            gaussian_body(load_body(), config),
            to_network_views(load_capture(DEMO_CAPTURE), 256),
        )
        inputs = jax.jit(prepare_inputs, static_argnames="config")(body, views, config)
        return errors(
            everywhere(lambda v, x: apply_humangs(v, x, config)[0].gaussians, variables, inputs)
        )

    def splat():
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
        first = lambda: reconstruct(variables, config, capture)
        run = functools.partial(refine, first(), capture, steps=0) if refined else first
        for which in ("first", "second"):
            began = perf_counter()
            jax.block_until_ready(run())
            times[f"{which} s"] = perf_counter() - began
        return times

    yield "feed-forward", functools.partial(measure, False)
    yield "learned iterations", functools.partial(measure, True)


STAGES = dict(zip(get_args(Stage), (check, splatting, people, reconstructed), strict=True))
