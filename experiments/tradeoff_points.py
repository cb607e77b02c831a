"""The points of the trade of speed against accuracy; presets and budgets, measured again."""

import contextlib
import dataclasses
import os
import subprocess
import sys
from typing import Any

from experiments.harness import Run, entry
from experiments.results import cores, markdown_table
from humangs_jax.apps import settings as tuning
from humangs_jax.apps.settings import PRESETS, Settings
from humangs_jax.data.capture import load_capture
from humangs_jax.network.runtime import Runtime
from humangs_jax.network.weights import load_weights

SIZE = 512
"""Side of the frames in pixels, unless a point says otherwise."""
STARTS = ("network", "random colors", "painted body", "published network")


@dataclasses.dataclass(frozen=True)
class Point:
    """A way to make an avatar and draw it. size: side of the frames, pixels. start: of `STARTS`: the last ones are to compare
    with; of the published network, whose weights are not ours to ship, only time and memory are measured.
    """

    name: str
    knob: str
    settings: Settings
    size: int = SIZE
    start: str = "network"


def point(name: str, knob: str, size: int = SIZE, start: str = "network", **changes: Any) -> Point:
    """A point by what differs from the default one."""
    fields = {field.name for field in dataclasses.fields(Runtime)}
    runtime = Runtime(**{key: value for key, value in changes.items() if key in fields})
    rest: dict[str, Any] = {"views": 4} | {key: value for key, value in changes.items() if key not in fields}
    return Point(name, knob, Settings(runtime=runtime, **rest), size, start)


DEFAULT = point("default", "default")
"""4 photos of 256 pixels, as the weights were trained, float32, no refinement; frames of 512 pixels, exact."""


def points() -> list[Point]:
    """All of them, the default first."""
    found = [DEFAULT]
    found += [Point(f"preset {name}", "preset", settings) for name, settings in PRESETS.items()]
    found += [point(name, "splat preset", splat=name) for name in ("near_exact", "fast", "inria")]
    found += [point(f"frames of {n}", "frame size", size=n) for n in (128, 256, 384, 1024)]
    found += [point("pruned", "Gaussians", prune=True), point("painted body", "naive", start="painted body")]
    found += [point(f"{n} steps", "refinement", refine_steps=n, refine_size=256) for n in (25, 50, 100, 200)]
    for n in (0, 50, 200):
        random: dict[str, Any] = {"refine_steps": n, "refine_size": 256}
        found += [point(f"random colors, {n} steps", "naive", start="random colors", **random)]
    found += [point(f"{n} photos" if n > 1 else "1 photo", "photos", views=n) for n in (1, 2, 3, 6)]
    found += [point(f"photos of {n}", "photo size", image_size=n) for n in (128, 192, 384, 512)]
    found += [point("all tokens", "tokens", tokens="all"), point("cropped", "tokens", crop=True)]
    found += [point(f"cropped, photos of {n}", "tokens", crop=True, image_size=n) for n in (128, 192, 384)]
    found += [point(dtype, "precision", dtype=dtype) for dtype in ("bfloat16", "float16")]
    found += [point(f"body of {n}", "Gaussians", body_vertices=n) for n in (1000, 2000, 3000)]
    found += [point(f"edges of {edge * 1e3:g} mm", "Gaussians", longest_edge=edge) for edge in (0.024, 0.02, 0.017)]
    found += [point("100 steps at 512", "refinement", refine_steps=100, refine_size=512)]
    found += [refined(*limits) for limits in ITERATIONS]
    found += [combined(**fields) for fields in COMBINED]
    found += [
        point(f"published, {t} tokens", "published", start="published network", tokens=t) for t in ("foreground", "all")
    ]
    return found


ITERATIONS = (
    *((n, 0, 256) for n in (1, 2, 3, 4, 6)),
    *((4, steps, 256) for steps in (25, 50, 100)),
    *((4, steps, 512) for steps in (0, 100)),
)
"""Of the learned update, steps of Adam after them, and the size of the photos."""


def refined(iterations: int, steps: int, size: int) -> Point:
    """A point with iterations, named by what it does."""
    parts = [f"{iterations} round{'s' * (iterations > 1)}", *([f"{steps} steps"] if steps else [])]
    name = ", ".join(parts) + (f" at {size}" if size != 256 else "")
    return point(name, "refinement", refine_iterations=iterations, refine_steps=steps, refine_size=size)


COMBINED: tuple[dict[str, Any], ...] = (
    {"views": 1, "crop": True},
    {"views": 2, "crop": True},
    {"views": 6, "crop": True},
    {"views": 1, "crop": True, "image_size": 128, "splat": "fast"},
    {"views": 2, "crop": True, "image_size": 128, "splat": "near_exact"},
    {"views": 6, "crop": True, "image_size": 128},
    {"views": 2, "crop": True, "image_size": 192},
    {"views": 6, "crop": True, "image_size": 384},
    {"body_vertices": 1000, "splat": "fast"},
    {"body_vertices": 2000, "splat": "fast"},
    {"body_vertices": 2000, "splat": "near_exact"},
    {"views": 1, "crop": True, "image_size": 128, "body_vertices": 2000, "splat": "fast"},
    {"crop": True, "refine_iterations": 4, "refine_size": 128},
    {"crop": True, "refine_iterations": 4, "refine_size": 256},
    {"crop": True, "refine_iterations": 4, "refine_size": 256, "splat": "near_exact"},
    {"views": 2, "crop": True, "refine_iterations": 4, "refine_size": 256},
    {"views": 6, "crop": True, "refine_iterations": 4, "refine_size": 256},
    {"views": 6, "crop": True, "refine_iterations": 4, "refine_steps": 100, "refine_size": 256},
    {"views": 6, "crop": True, "refine_iterations": 4, "refine_size": 512},
    {"views": 6, "crop": True, "refine_iterations": 4, "refine_steps": 100, "refine_size": 512},
    {"body_vertices": 2000, "crop": True, "refine_iterations": 4, "refine_size": 256, "splat": "near_exact"},
    {"body_vertices": 1000, "crop": True, "refine_iterations": 4, "refine_size": 256, "splat": "fast"},
    {"crop": True, "image_size": 128, "refine_iterations": 4, "refine_size": 128},
    {"crop": True, "image_size": 384, "refine_iterations": 4, "refine_size": 512},
    {"crop": True, "longest_edge": 0.02, "refine_iterations": 4, "refine_size": 256},
    {"crop": True, "longest_edge": 0.02, "refine_iterations": 4, "refine_steps": 100, "refine_size": 512},
    {"crop": True, "refine_steps": 200, "refine_size": 256},
)
"""Several knobs at once."""

SHORT = {
    "views": "{} photos",
    "image_size": "of {}",
    "crop": "cropped",
    "body_vertices": "body of {}",
    "longest_edge": "edges of {} m",
    "refine_iterations": "{} iterations",
    "refine_steps": "{} steps",
    "refine_size": "at {}",
    "splat": "{}",
}


def combined(**fields: Any) -> Point:
    """A point named by its settings."""
    return point(", ".join(SHORT[key].format(value) for key, value in fields.items()), "combined", **fields)


MULTIPLES = ((0.5, 0.5), (2.0, 2.0), (6.0, 3.0))
"""Budgets for a reconstruction and for a frame, in times of the fastest setting."""
BUSY = """
import numpy as np
x = np.random.default_rng(0).random((500, 500))
while True:
    x @ x
"""


@contextlib.contextmanager
def busy(count: int) -> Any:
    """`count` processes, each of which keeps one core busy until the block ends."""
    one_thread = {f"{name}_NUM_THREADS": "1" for name in ("OMP", "OPENBLAS", "MKL")}
    processes = [subprocess.Popen([sys.executable, "-c", BUSY], env=os.environ | one_thread) for _ in range(count)]
    try:
        yield
    finally:
        for process in processes:
            process.kill()
            process.wait()


@entry
def tune_budgets(run: Run, load: int | None = None, runs: int = 10, size: int = 256) -> None:
    """Whether what `humangs tune` chooses stays within its budget on a busy machine.

    While other processes multiply matrices, one core each, settings are chosen for the demo capture: for budgets of some
    multiples of what the fastest setting takes then. What was chosen is measured again as `tune` measures: the slowest of some
    reconstructions, the 90th percentile of some frames. A run is within the budget if both are.

    Options:
    load: busy processes beside it (default: one for each core)
    runs: measurements of each choice
    size: side of the frames, pixels
    """
    load = cores() or 1 if load is None else load
    network, capture, rows = load_weights(), load_capture("demo_capture"), []
    with busy(load):
        fastest = tuning.measure(tuning.load_front()[0].settings, *network, capture, size)
        for make, frame in MULTIPLES:
            budget = tuning.Budget(make * fastest.reconstruct_ms, frame * fastest.frame_ms)
            row: dict[str, Any] = {"reconstruct_ms": budget.reconstruct_ms, "frame_ms": budget.frame_ms}
            rows.append(row)
            try:
                tuned = tuning.tune(*network, capture, budget, size)
            except tuning.NoSettingError as error:
                row["refused"] = str(error)
                continue
            costs = [tuning.measure(tuned.point.settings, *network, capture, size) for _ in range(runs)]
            row |= {"chosen": tuned.point.name, "tuned": dataclasses.asdict(tuned.cost)}
            row |= {"runs": [dataclasses.asdict(cost) for cost in costs]}
            row["within"] = sum(budget.allows(cost, margin=1.0) for cost in costs)
    lines = []
    for row in rows:
        budget = [f"{row['reconstruct_ms']:.0f}", f"{row['frame_ms']:.0f}"]
        if "refused" in row:
            lines.append([*budget, "no setting is within the budget", "", "", ""])
            continue
        whole = [cost["make_ms"] + cost["refine_ms"] for cost in (row["tuned"], *row["runs"])]
        frame = [cost["frame_ms"] for cost in (row["tuned"], *row["runs"])]
        spread = lambda times: f"{times[0]:.0f}; {min(times[1:]):.0f} to {max(times[1:]):.0f}"
        lines.append([*budget, row["chosen"], spread(whole), spread(frame), f"{row['within']} of {len(row['runs'])}"])
    header = [
        "ms a reconstruction",
        "ms a frame",
        "chosen",
        "reconstruction: tuned; later",
        "frame: tuned; later",
        "within",
    ]
    run.show(markdown_table(header, lines, "rrlrrr"), {"load": load, "size": size, "budgets": rows})
