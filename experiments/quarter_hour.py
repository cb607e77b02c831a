"""A quarter of an hour of an accelerator, spent by a list with a clock.

Each stage is a command in a process of its own with a limit of seconds. What a stage has found lies
on disk when it ends, and the list goes on after it, whether it ended, failed or was cut. The same
command goes on with the stages that are not done. Compiled programs, and what XLA found out by
trying, are kept in the folder.
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
"""Seconds that a stage has to write what it has, after it was told to end."""
LEAST = 20.0
"""Seconds: with less left, no stage begins."""
UNTRIED = "--xla_gpu_autotune_level=0"
"""XLA takes its default tiles for products, without trying others."""
NO_FUSION_TRIALS = "--xla_gpu_experimental_enable_fusion_autotuner=false"
"""XLA tries no other ways to fuse."""


@dataclasses.dataclass(frozen=True)
class Stage:
    """One line of the list."""

    name: str
    """What it is, in a word or two."""
    words: tuple[str, ...]
    """The experiment and its options."""
    seconds: float
    """When it is cut, at the latest."""
    flags: str = ""
    """Of XLA."""


def stages(out: Path, small: bool) -> list[Stage]:
    """The list, the most wanted first. small: for a rehearsal on a CPU."""

    def stage_of(name):
        return ("accelerator", "--stage", name, *(["--small"] * small))

    def measure(name: str, seconds: float) -> Stage:
        return Stage(name, (*stage_of(name), "--json", str(out / f"{name}.json")), seconds)

    def step(name: str, flags: str) -> Stage:
        files = ("--json", str(out / f"step_{name}.json"), "--trace", str(out / f"trace_{name}"))
        return Stage(f"training step, {name}", (*stage_of("step"), *files), 150, flags)

    # training and people are tiny in a rehearsal: it is about the list
    minutes, people, batch = ("1", "1", "1") if small else ("5", "450", "8")
    train = ("--minutes", minutes, "--people", people, "--batch", batch)
    refining = ("--people", "2", "--samples", "2", "--steps", "1") if small else ()
    learned = ("train_refiner", str(out / "refiner"), *refining)
    systems = ("paper", str(out / "paper"), *(("--quick",) if small else ()))
    return [
        measure("check", 60),
        measure("splatting", 90),
        step("tried", ""),
        step("untried", UNTRIED),
        step("fusions_untried", NO_FUSION_TRIALS),
        measure("reconstruct", 60),
        measure("frames", 30),
        measure("published", 60),
        Stage("training by the clock", ("train_by_clock", str(out / "train"), *train), 360),
        Stage("learned update", learned, 120),
        Stage("the paper's systems", systems, 120),
    ]


def spend(out: Path, seconds: float, small: bool) -> dict[str, dict[str, Any]]:
    """Runs the list in `out`, and returns what became of each stage: done, cut, failed, or no time.

    It is written to OUT/clock.json after each one.
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
    """Runs one stage; at the limit it hears Ctrl-C, and then is killed."""
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
        except BaseException:  # Ctrl-C of this one
            process.kill()
            process.wait()
            raise
    return {"became": became, "seconds": round(monotonic() - began, 1)}


def environment(out: Path, stage: Stage) -> dict[str, str]:
    """Of a stage: caches that later stages and calls find again, and its flags."""
    trials = f"--xla_gpu_per_fusion_autotune_cache_dir={(out / 'trials').resolve()}"
    (out / "trials").mkdir(exist_ok=True)
    flags = (os.environ.get("XLA_FLAGS", ""), trials, stage.flags)
    return os.environ | {
        "PYTHONPATH": os.pathsep.join([str(REPOSITORY), os.environ.get("PYTHONPATH", "")]),
        "JAX_COMPILATION_CACHE_DIR": str((out / "cache").resolve()),
        "XLA_FLAGS": " ".join(filter(None, flags)),
    }


def table_of(found: dict[str, dict[str, Any]]) -> str:
    """What became of each stage."""
    rows = [[name, each["became"], f"{each['seconds']:.0f}"] for name, each in found.items()]
    return markdown_table(["stage", "became", "s"], rows, "llr")


def measured_files(out: Path) -> Sequence[Path]:
    """What `accelerator --earlier` puts together."""
    files = [*sorted(out.glob("*.json")), out / "train" / "run.json"]
    return [path for path in files if path.name != "clock.json" and path.exists()]
