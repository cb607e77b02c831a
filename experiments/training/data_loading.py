"""How fast training data comes, each way, against what training consumes.

    python experiments/training/data_loading.py --json data.json [--sizes 128 256 512] [--subjects 4] [--train-step-s 0.9]

For every image size, on this machine: `synth` (people written to disk: subjects and views per second of one process),
`read` (written people through the loader: every example decoded from disk, and kept in memory), and `on_the_fly` (people from a
bank: building it, compiling, views per second). Then the time of one step of the small preset (measured at its own sizes unless
--train-step-s gives it), which consumes the views of one example, and how long a step would wait. The loader works beside the
step, so a step waits only if a batch takes longer than the step. On-the-fly people are rendered on the device of the step, so
all of their time is added, unless the device has time to spare (CPUs of several cores). Where the step is measured, its
waiting time with each source is measured too. CPU seconds count the work of all threads and depend little on other programs.

About 4 minutes on 2 CPU cores to themselves, 2 of them with --train-step-s. Expected there, CPU ms a view at 256: written
170, on the fly 32, read 9 from disk and 1 from memory; rendering an example on the fly takes a sixth of the CPU time of a step.
"""

import argparse
import os
import platform
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[2]))
from experiments.common.interleaved import prepare_process
from experiments.common.results import markdown_table, publish, significant, write_json

INPUTS, TARGETS = 4, 3
"""Views of an example."""
POSES, VIEWS = 2, 6
"""Of written people: poses, and cameras around each."""
PLACES = {"disk": "from disk", "memory": "kept in memory"}
STEPS = 5
"""Training steps that are timed."""


def seconds(work: Callable[[], object]) -> dict[str, float]:
    """Wall and CPU seconds of one call."""
    wall, cpu = time.perf_counter(), time.process_time()
    work()
    return {"wall_s": time.perf_counter() - wall, "cpu_s": time.process_time() - cpu}


def rates(spent: dict[str, float], subjects: int, views: int) -> dict[str, float]:
    """With what was made: per second, and CPU seconds of one view."""
    made = {"subjects": subjects, "views": views, "cpu_s_per_view": spent["cpu_s"] / views}
    return spent | made | {f"{name}_per_s": made[name] / spent["wall_s"] for name in ("subjects", "views")}


def measure_synth(out: Path, size: int, subjects: int, body: Any) -> dict[str, float]:
    """Write people; one more before, which compiles."""
    from humangs_jax.people.writer import Layout, write_set

    layout = Layout(size, poses=POSES, views=VIEWS)
    write_set(out, 1, layout, "train", 0, body=body, progress=False)
    spent = seconds(lambda: write_set(out, subjects + 1, layout, "train", 0, body=body, progress=False))
    return rates(spent, subjects, subjects * POSES * VIEWS)


def measure_read(out: Path, size: int, examples: int, body: Any) -> dict[str, dict[str, float]]:
    """Examples of written people through the loader: from disk every time, and from memory."""
    from humangs_jax.data.loader import CaptureCache, CaptureSource, Loader, ViewSampling
    from humangs_jax.people.writer import find_people

    sampling = ViewSampling(input_counts=(INPUTS,), target_count=TARGETS)
    results = {}
    for name, limit in (("disk", 0), ("memory", 4 << 30)):
        cache = CaptureCache(find_people(out), body, limit)
        loader = Loader(CaptureSource(cache, sampling, size, size), seed=1)
        list(loader.batches(0, 2 * len(cache) if limit else 2))  # with a limit: read all of them once
        spent = seconds(lambda loader=loader: list(loader.batches(0, examples)))
        results[name] = rates(spent, examples, examples * (INPUTS + TARGETS))
    return results


def measure_on_the_fly(size: int, people: int, examples: int, body: Any) -> dict[str, Any]:
    """Build a bank, compile, draw examples one by one."""
    import jax

    from humangs_jax.people.bank import build_bank
    from humangs_jax.people.on_the_fly import OnTheFlyConfig, jitted_example

    texture = 1024 if size > 256 else 512
    build_bank([0, 1], body, "train", texture_size=texture)
    banks = []
    built = seconds(lambda: banks.append(build_bank(range(people), body, "train", texture_size=texture)))
    accelerator = jax.default_backend() != "cpu"
    views = INPUTS + TARGETS
    wide: dict[str, Any] = {"views_at_once": views, "pixels_per_step": 1 << 30} if accelerator else {}
    config = OnTheFlyConfig(input_views=INPUTS, target_views=TARGETS, input_size=size, target_size=size, **wide)
    draw = lambda i: jax.block_until_ready(jitted_example(banks[0], jax.random.key(i), config))
    first = seconds(lambda: draw(0))
    draw(1)
    spent = seconds(lambda: [draw(2 + i) for i in range(examples)])
    bank = {"people": people, "texture": texture, "bytes_per_person": banks[0].size_bytes / people, **built}
    bank["people_per_s"] = people / built["wall_s"]
    return {"bank": bank, "compile": first, **rates(spent, examples, examples * views)}


def measure_training(folder: Path, body: Any) -> dict[str, Any]:
    """Steps of the small preset at its own sizes: alone, and fed by the loader with written and with on-the-fly people."""
    import dataclasses

    import jax

    from humangs_jax.data.loader import CaptureCache, CaptureSource, Loader, ViewSampling, Waiting
    from humangs_jax.data.views import gaussian_body
    from humangs_jax.people.bank import build_bank
    from humangs_jax.people.on_the_fly import OnTheFlyConfig, on_the_fly_source
    from humangs_jax.people.writer import Layout, find_people, write_set
    from humangs_jax.training.config import small
    from humangs_jax.training.state import init_state
    from humangs_jax.training.step import train_step

    sampling = ViewSampling(input_counts=(INPUTS,), target_count=TARGETS)
    config = dataclasses.replace(small(), views=sampling)
    sizes = config.model.conventions.image_size, config.target_size
    write_set(folder, 2, Layout(max(sizes), poses=POSES, views=VIEWS), "train", 0, body=body, progress=False)
    bank = build_bank([0, 1], body, "train", pose_count=4)
    sources = {
        "on_the_fly": on_the_fly_source(bank, OnTheFlyConfig(INPUTS, TARGETS, *sizes), (INPUTS,)),
        "read": CaptureSource(CaptureCache(find_people(folder), body), sampling, *sizes),
    }
    state, model_body = init_state(config, None), gaussian_body(body, config.model)

    def step(batch):
        nonlocal state
        state, metrics = train_step(state, batch, model_body, config)
        jax.block_until_ready(metrics)

    batch = Loader(sources["on_the_fly"]).batch_at(0)
    compiled = seconds(lambda: step(batch))
    step(batch)
    spent = seconds(lambda: [step(batch) for _ in range(STEPS)])
    result: dict[str, Any] = {name: value / STEPS for name, value in spent.items()}
    result |= {"compile_s": compiled["wall_s"], "input_size": sizes[0], "target_size": sizes[1]}
    for name, source in sources.items():
        waiting = Waiting()
        feed = Loader(source, seed=1).batches(0, STEPS + 1, waiting=waiting)
        fed = seconds(lambda feed=feed: [step(batch) for _, batch in feed])
        waited = (waiting.seconds - waiting.first_seconds) / STEPS
        result[f"fed_{name}"] = {"waited_s": waited, "step_s": (fed["wall_s"] - waiting.first_seconds) / (STEPS + 1)}
    return result


def waits(sizes: dict[str, Any], step_s: float) -> dict[str, dict[str, float]]:
    """Seconds that a step of one example would wait for its data, each way; and the share of a step that this is."""
    results = {}
    for size, result in sizes.items():
        per_example = lambda r: r["wall_s"] / r["subjects"]
        ahead = {name: max(0.0, per_example(result["read"][name]) - step_s) for name in ("disk", "memory")}
        added = {f"read_{name}": value for name, value in ahead.items()} | {
            "on_the_fly": per_example(result["on_the_fly"])
        }
        results[size] = added | {f"{name}_share": value / step_s for name, value in added.items()}
    return results


def by_way(of_size: dict[str, Any]) -> dict[str, dict[str, float]]:
    """The numbers of each way, as the tables name it."""
    written = f"written by `synth` (people, posing, PNG included; {POSES * VIEWS} views each)"
    kept = {f"read by the loader, {place}": of_size["read"][name] for name, place in PLACES.items()}
    return {written: of_size["synth"], **kept, "on the fly": of_size["on_the_fly"]}


def cpu_table(sizes: dict[str, Any]) -> str:
    """CPU ms a view, one column for each size."""
    columns = [by_way(of_size) for of_size in sizes.values()]
    rows = [[name, *(significant(1e3 * column[name]["cpu_s_per_view"]) for column in columns)] for name in columns[0]]
    return markdown_table(["CPU ms a view", *(f"{size} px" for size in sizes)], rows)


def rates_table(sizes: dict[str, Any]) -> str:
    """Views and subjects a second, one column for each size."""
    columns = [by_way(of_size) for of_size in sizes.values()]
    cell = lambda numbers: f"{significant(numbers['views_per_s'])} ({significant(numbers['subjects_per_s'])})"
    rows = [[name, *(cell(column[name]) for column in columns)] for name in columns[0]]
    return markdown_table(["views (subjects) a second, one process", *(f"{size} px" for size in sizes)], rows)


def machine() -> dict[str, Any]:
    """Where this was measured."""
    import jax

    device = jax.devices()[0]
    return {
        "cores": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count(),
        "architecture": platform.machine(),
        "backend": jax.default_backend(),
        "device": device.device_kind,
        "load_average": os.getloadavg()[0],
        "jax": jax.__version__,
    }


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", type=Path, help="write the numbers here")
    parser.add_argument(
        "--page", type=Path, help="page whose tables data_loading_cpu and data_loading_rates are written"
    )
    parser.add_argument("--sizes", type=int, nargs="+", default=[128, 256, 512], help="pixels a side")
    parser.add_argument("--subjects", type=int, default=4, help="people written, and in the bank")
    parser.add_argument("--examples", type=int, default=8, help="examples read and drawn")
    parser.add_argument("--train-step-s", type=float, help="seconds of a training step; measured if not given")
    arguments = parser.parse_args()
    if min(arguments.subjects, arguments.examples, *arguments.sizes) < 1:
        parser.error("--sizes, --subjects and --examples must be at least 1")
    prepare_process()
    from humangs_jax.body.library import load_body

    body, sizes = load_body(), {}
    result: dict[str, Any] = {"machine": machine(), "views_per_example": INPUTS + TARGETS, "sizes": sizes}
    with tempfile.TemporaryDirectory() as folder:
        for size in arguments.sizes:
            out = Path(folder) / str(size)
            sizes[str(size)] = {
                "synth": measure_synth(out, size, arguments.subjects, body),
                "read": measure_read(out, size, arguments.examples, body),
                "on_the_fly": measure_on_the_fly(size, arguments.subjects, arguments.examples, body),
            }
    print(f"{cpu_table(sizes)}\n\n{rates_table(sizes)}\n", flush=True)
    given = arguments.train_step_s
    if given is None:
        with tempfile.TemporaryDirectory() as folder:
            result["train_step"] = measure_training(Path(folder), body)
    else:
        result["train_step"] = {"wall_s": given, "given": True}
    step_s = result["train_step"]["wall_s"]
    result["waits"] = waits(sizes, step_s)
    print(f"a training step takes {step_s:.3g} s and consumes {(INPUTS + TARGETS) / step_s:.3g} views a second")
    for size, wait in result["waits"].items():
        shares = ", ".join(
            f"{n} {1e3 * wait[n]:.0f} ms ({100 * wait[f'{n}_share']:.0f} %)"
            for n in ("read_disk", "read_memory", "on_the_fly")
        )
        print(f"at {size} pixels a step waits for its data: {shares}")
    for name in ("read", "on_the_fly"):
        fed: Any = result["train_step"].get(f"fed_{name}")
        if fed:
            print(
                f"fed by the loader ({name}): a step takes {fed['step_s']:.3g} s, {fed['waited_s']:.3g} s of it waiting"
            )
    if arguments.json:
        write_json(arguments.json, result)
    if arguments.page:
        publish(arguments.page, "data_loading_cpu", cpu_table(sizes), result)
        publish(arguments.page, "data_loading_rates", rates_table(sizes), result)


if __name__ == "__main__":
    main()
