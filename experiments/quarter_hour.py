"""Spends a quarter of an hour of an accelerator by a list with a clock.

Each stage is a command in a separate process with a limit of seconds. A stage writes its results to
disk. The list goes on when a stage has ended, failed or was cut. The same command continues with
the stages that are not done. Compiled programs, and the settings that XLA found by trying, are kept
in the folder.
"""

import dataclasses
import json
import os
import signal
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from time import monotonic
from typing import Any

from experiments.results import REPOSITORY, markdown_table, write_json

GRACE = 15.0
"""Seconds that a stage has to write its results after it was interrupted."""
LEAST = 20.0
"""Seconds that must be left for a stage to begin."""
UNTRIED = "--xla_gpu_autotune_level=0"
"""Flag with which XLA takes its default tiles for products, without trying others."""
NO_FUSION_TRIALS = "--xla_gpu_experimental_enable_fusion_autotuner=false"
"""Flag with which XLA does not try other ways to fuse."""


@dataclasses.dataclass(frozen=True)
class Stage:
    """One line of the list."""

    name: str
    """Its name, of a few words."""
    words: tuple[str, ...]
    """The experiment and its options."""
    seconds: float
    """Seconds after which it is cut."""
    flags: str = ""
    """Flags of XLA, empty for none."""


def stages(out: Path, small: bool) -> list[Stage]:
    """Returns the list, the most wanted stage first. `small` is for a rehearsal on a CPU."""

    def stage_of(name):
        return ("accelerator", "--stage", name, *(["--small"] * small))

    def measure(name: str, seconds: float) -> Stage:
        return Stage(name, (*stage_of(name), "--json", str(out / f"{name}.json")), seconds)

    def step(name: str, flags: str) -> Stage:
        files = ("--json", str(out / f"step_{name}.json"), "--trace", str(out / f"trace_{name}"))
        return Stage(f"training step, {name}", (*stage_of("step"), *files), 150, flags)

    # training and people are tiny in a rehearsal: it is about the list
    train = ("train_by_clock", str(out / "train"))
    learned = ("train_refiner", str(out / "refiner"))
    systems = ("paper", str(out / "paper"))
    if small:
        train += ("--minutes", "1", "--people", "1", "--batch", "1")
        learned += ("--people", "2", "--samples", "2", "--steps", "1")
        systems += ("--quick",)
    else:
        train += ("--minutes", "5", "--people", "450", "--batch", "8")
    return [
        measure("check", 60),
        measure("splatting", 90),
        step("tried", ""),
        step("untried", UNTRIED),
        step("fusions_untried", NO_FUSION_TRIALS),
        measure("reconstruct", 60),
        measure("frames", 30),
        measure("published", 60),
        Stage("training by the clock", train, 360),
        Stage("learned update", learned, 120),
        Stage("the paper's systems", systems, 120),
    ]


def spend(out: Path, seconds: float, small: bool) -> dict[str, dict[str, Any]]:
    """Runs the list in `out` for this many seconds.

    Returns {stage: {"became": "done", "cut", "failed" or "no time", "seconds"}}, which is also
    written to OUT/clock.json after each stage.
    """
    out.mkdir(parents=True, exist_ok=True)
    path, end = out / "clock.json", monotonic() + seconds
    found = json.loads(path.read_text()) if path.exists() else {}
    for stage in stages(out, small):
        if found.get(stage.name, {}).get("became") == "done":
            continue
        left = end - monotonic() - GRACE
        if left < min(LEAST, stage.seconds):
            found[stage.name] = {"became": "no time", "seconds": 0.0}
        else:
            print(f"{seconds - left - GRACE:5.0f} s  {stage.name}", flush=True)
            log = out / f"{stage.name.replace(' ', '_').replace(',', '')}.log"
            found[stage.name] = ran(stage, min(left, stage.seconds), environment(out, stage), log)
        write_json(path, found)
    return found


def ran(stage: Stage, limit: float, environment: dict[str, str], log: Path) -> dict[str, Any]:
    """Runs one stage. After `limit` seconds it gets an interrupt, and `GRACE` seconds later it is
    killed.
    """
    began = monotonic()
    with open(log, "w") as lines:
        process = subprocess.Popen(
            [sys.executable, "-m", "experiments", *stage.words],
            cwd=REPOSITORY,
            env=environment,
            stdout=lines,
            stderr=subprocess.STDOUT,
        )
        became = "cut"
        try:
            became = "failed" if process.wait(limit) else "done"
        except subprocess.TimeoutExpired:
            process.send_signal(signal.SIGINT)
            try:
                process.wait(GRACE)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
        except BaseException:  # this process is interrupted
            process.kill()
            process.wait()
            raise
    return {"became": became, "seconds": round(monotonic() - began, 1)}


def environment(out: Path, stage: Stage) -> dict[str, str]:
    """Returns the environment of a stage, with its flags and with caches that later stages and
    calls use again.
    """
    trials = f"--xla_gpu_per_fusion_autotune_cache_dir={(out / 'trials').resolve()}"
    (out / "trials").mkdir(exist_ok=True)
    flags = (os.environ.get("XLA_FLAGS", ""), trials, stage.flags)
    return os.environ | {
        "PYTHONPATH": os.pathsep.join([str(REPOSITORY), os.environ.get("PYTHONPATH", "")]),
        "JAX_COMPILATION_CACHE_DIR": str((out / "cache").resolve()),
        "XLA_FLAGS": " ".join(filter(None, flags)),
    }


def table_of(found: dict[str, dict[str, Any]]) -> str:
    """Formats what became of each stage."""
    rows = [[name, each["became"], f"{each['seconds']:.0f}"] for name, each in found.items()]
    return markdown_table(["stage", "became", "s"], rows, "llr")


def measured_files(out: Path) -> Sequence[Path]:
    """Returns the files that `accelerator --earlier` puts together."""
    files = [*sorted(out.glob("*.json")), out / "train" / "run.json"]
    return [path for path in files if path.name != "clock.json" and path.exists()]
