"""Measures how large the program of a training step is, on a CPU and for CUDA, and how long a step
takes on this CPU, before and now.
"""

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

from experiments.harness import Run, entry
from experiments.results import REPOSITORY, markdown_table, significant
from experiments.speed import checkout

WORKER = REPOSITORY / "experiments" / "step_programs_worker.py"
COUNTS = {
    "executed": "operations executed",
    "lines": "lines of StableHLO",
    "while": "loops",
    "convolutions": "convolutions",
}
"""{count of a program: its name in the table}."""
TIMES = {
    "lower": "CPU: trace and lower, CPU s",
    "compile": "CPU: compile, CPU s",
    "step": "CPU: a step, CPU ms",
    "temporary MiB": "CPU: MiB of temporaries",
}
"""{measurement: its name in the table}, which shows the least of all turns."""
PLATFORMS = {"cuda": "CUDA, 8 people", "cpu": "CPU, 8 people"}
"""{platform that programs are lowered for: its name in the table}."""


@entry
def step_programs(run: Run, before: str | None = None, turns: int = 1, repeats: int = 3) -> None:
    """Measures the size of the program of `train_by_clock`'s step with 8 people, and its time on
    this CPU with one person, now and at another commit.

    Programs are counted after tracing and lowering and before fusion, for CUDA without a GPU.
    Operations in loops count as often as the loop runs. Where data decide, loops of compositing are
    assumed to run four times, and others once. Both commits work at the same time, so that other
    programs slow both down by as much. Takes six CPU minutes.

    Options:
    before: commit to compare with
    turns: number of times that each commit is timed
    repeats: number of steps that are timed in each turn
    """
    # all programs read one batch, which is made when it is first needed
    with checkout(before) as other, tempfile.TemporaryDirectory() as folder:
        places = {"before": other} if other else {}
        places["now"] = REPOSITORY
        batch = Path(folder) / "batch"

        def case(*words: str) -> Callable[[], dict[str, Any]]:
            def work() -> dict[str, Any]:
                if not batch.exists():
                    _finished(_started(REPOSITORY, "batch", str(batch)))
                return _together(places, words[0], str(batch), *words[1:])

            return work

        cases = {f"turn {turn + 1}": case("time", str(repeats)) for turn in range(turns)}
        cases |= {title: case("count", platform) for platform, title in PLATFORMS.items()}
        rows = run.rows(cases, {"before": before, "repeats": repeats})
    table = []
    for title in PLATFORMS.values():
        for key, what in COUNTS.items():
            cells = [f"{rows[title][name][key]:,}" for name in places]
            table.append([f"{title}: {what}", *cells])
    for key, what in TIMES.items():
        least = [min(rows[f"turn {i + 1}"][name][key] for i in range(turns)) for name in places]
        table.append([what, *map(significant, least)])
    run.show(markdown_table(["step of train_by_clock", *places], table), rows)


def _together(places: dict[str, Path], *words: str) -> dict[str, Any]:
    """Runs the worker with the package of each place at the same time, and returns {place: its
    numbers}.
    """
    running = {name: _started(place, *words) for name, place in places.items()}
    return {name: json.loads(_finished(process)) for name, process in running.items()}


def _started(place: Path, *words: str) -> subprocess.Popen[str]:
    """Starts the worker with the package of a place."""
    environment = os.environ | {"PYTHONPATH": str(place), "OMP_WAIT_POLICY": "passive"}
    environment.pop("JAX_COMPILATION_CACHE_DIR", None)  # compilation is what is measured
    return subprocess.Popen(
        [sys.executable, "-P", str(WORKER), *words],
        env=environment,
        cwd=place,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,  # Linux shares a busy machine among sessions
    )


def _finished(process: subprocess.Popen[str]) -> str:
    """Waits for a worker, and returns the last line that it prints.

    Raises: OSError with the end of the worker's errors.
    """
    out, errors = process.communicate()
    if process.returncode:
        raise OSError(f"{process.args}: {errors[-2000:]}")
    return (out.splitlines() or [""])[-1]
