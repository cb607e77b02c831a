"""Measures what a user waits for, the first time and every time after.

Every command runs in a new process, with an empty cache of compiled programs and with a full one.
The result is a time line of the command's stages.
"""

import json
import os
import subprocess
import sys
import tempfile
import textwrap
from pathlib import Path
from typing import Any, Literal, get_args

from experiments.harness import Run, entry, figure
from experiments.results import REPOSITORY, markdown_table
from experiments.speed import checkout

Command = Literal["demo", "start", "animate"]
PROGRAMS = REPOSITORY / "experiments" / "programs.py"
TIMES = {"empty": "the first time", "full": "every time after"}
"""{state of the cache: its name in the table}."""
LABELLED = 0.04
"""Share of the longest run that a stage needs to have its name in the figure."""
LETTERS = 9
"""Letters that fit into a stage of that share."""


@entry
def first_run(
    run: Run,
    command: tuple[Command, ...] = get_args(Command),
    before: str | None = None,
    small: bool = False,
) -> None:
    """Measures what `humangs demo`, `start` on four photos and `animate` wait for: seconds by
    stage, programs, and seconds of compiling, the first time and every time after.

    CPU seconds are those of all threads. Other work on the machine changes them least. Compiling is
    part of the stages' seconds, and includes reading from the cache on disk.

    Options:
    command: which commands
    before: commit, branch or tag to compare with, measured in turns
    small: no refinement and small frames, for a rehearsal
    """
    # every command with both states of the cache, first of the other revision
    with checkout(before) as other:
        places = {"before": other} if other else {}
        places["now"] = REPOSITORY
        cases = {
            f"{where}: {name}, {state}": (place, name, state)
            for name in command
            for where, place in places.items()
            for state in TIMES
        }
        with tempfile.TemporaryDirectory() as folder:
            root = Path(folder)

            def measure(case):
                return lambda: measured(root / case[0].name, *case, small)

            rows = run.rows({name: measure(case) for name, case in cases.items()}, {"small": small})
    run.show(table_of(rows), rows)
    if run.publish:
        draw_time_lines(REPOSITORY / "docs" / "images" / "first_run.png", rows)


def measured(folder: Path, place: Path, command: Command, state: str, small: bool) -> dict:
    """Runs a command of the package that lies at `place` in a new process, and returns its numbers.

    `folder` holds the cache, and the results of earlier commands, which `animate` shows.

    Raises: OSError with the end of the command's errors.
    """
    folder.mkdir(exist_ok=True)
    cache = folder / f"cache_{command}"
    words = words_of(command, folder, small)
    environment = os.environ | {"PYTHONPATH": str(place), "HUMANGS_COMPILE_CACHE": str(cache)}
    environment.pop("JAX_COMPILATION_CACHE_DIR", None)
    ran = subprocess.run(
        [sys.executable, "-P", str(PROGRAMS), *words],
        capture_output=True,
        text=True,
        env=environment,
        check=False,
    )
    if ran.returncode:
        raise OSError(f"humangs {' '.join(words)}: {ran.stderr[-1000:]}")
    return summary(json.loads(ran.stdout.splitlines()[-1]))


def words_of(command: Command, folder: Path, small: bool) -> list[str]:
    """Returns the command line of a command.

    `animate` shows the avatar of an earlier command. `start` gets the demo's photos without
    anything beside them.
    """
    frames = ["--size", "64"] if small else []
    if command == "demo":
        return ["demo", "--out", str(folder / "demo"), *frames, *(["--refine", "0"] * small)]
    if command == "animate":
        avatar = next(iter(folder.glob("*/avatar.npz")))
        return ["animate", str(avatar), "--out", str(folder / "walk.mp4"), *frames]
    photos = folder / "photos"
    if not photos.exists():
        write_photos(photos, 256 if small else 1024)
    out = folder / f"started_{len(list(folder.iterdir()))}"
    return ["start", str(photos), "--out", str(out), "--no-browser", *(["--refine", "0"] * small)]


def write_photos(folder: Path, size: int) -> None:
    """Writes the demo's four photos, enlarged to `size` pixels, without anything beside them."""
    from PIL import Image

    folder.mkdir()
    for path in sorted((REPOSITORY / "humangs_jax/assets/demo_capture/images").glob("*.png")):
        image = Image.open(path).convert("RGB").resize((size, size), Image.Resampling.LANCZOS)
        image.save(folder / f"{path.stem}.jpg", quality=95)


def summary(ran: dict[str, Any]) -> dict[str, Any]:
    """Returns the numbers that are published of a run of `experiments.programs`."""
    programs = ran["programs"]
    largest = sorted(programs, key=lambda each: -each["seconds"])[:8]
    stages = {
        name: {
            "seconds": round(seconds, 2),
            "programs": sum(each["stage"] == name for each in programs),
            "compile": round(sum(x["seconds"] for x in programs if x["stage"] == name), 2),
        }
        for name, seconds in ran["stages"].items()
    }
    return {
        "wall": round(ran["wall"], 2),
        "cpu": round(ran["cpu"], 2),
        "programs": len(programs),
        "from disk": ran["hits"],
        **{part: round(seconds, 2) for part, seconds in ran["seconds"].items()},
        "stages": stages,
        "largest": {each["name"]: round(each["seconds"], 2) for each in largest},
    }


def table_of(rows: dict[str, dict[str, Any]]) -> str:
    """Formats a table with a line for each run, and one with a line for each stage of each run."""
    header = ["", "CPU s", "wall s", "programs", "from disk", "compile s"]
    lines = [
        [
            name,
            *(f"{row[key]:.1f}" for key in ("cpu", "wall")),
            *(str(row[key]) for key in ("programs", "from disk")),
            f"{row['compile']:.1f}",
        ]
        for name, row in shown(rows).items()
    ]
    stages = [
        [name, stage, f"{own['seconds']:.1f}", str(own["programs"]), f"{own['compile']:.1f}"]
        for name, row in shown(rows).items()
        for stage, own in row["stages"].items()
    ]
    return (
        markdown_table(header, lines)
        + "\n\n"
        + markdown_table(["", "stage", "wall s", "programs", "compile s"], stages, "llrrr")
    )


def shown(rows: dict[str, dict[str, Any]]) -> dict[str, dict[str, Any]]:
    """Returns the rows by their names in the table."""
    names = {}
    for name in rows:
        head, _, state = name.rpartition(", ")
        names[name] = f"{head}, {TIMES[state]}"
    return {names[name]: row for name, row in rows.items()}


def draw_time_lines(path: Path, rows: dict[str, dict[str, Any]]) -> None:
    """Draws a bar for each run, with its stages one after the other and their compiling darker.

    Time outside of the stages, for starting Python and importing, comes first, in grey. Programs
    that a second thread compiled at the same time do not make a stage longer: the dark part ends
    where the stage ends.
    """
    shortest = LABELLED * max(row["wall"] for row in rows.values())
    with figure(path, 1, (12, 0.5 * len(rows) + 1.2)) as axis:
        for line, row in enumerate(reversed(shown(rows).values())):
            stages = row["stages"].items()
            begin = max(row["wall"] - sum(own["seconds"] for _, own in stages), 0.0)
            axis.barh(line, begin, color="0.8")
            for number, (stage, own) in enumerate(stages):
                color = f"C{number % 10}"
                compiling = min(own["compile"], own["seconds"])
                axis.barh(line, own["seconds"], left=begin, color=color, alpha=0.35)
                axis.barh(line, compiling, left=begin, color=color, alpha=0.7)
                if own["seconds"] > shortest:
                    letters = int(LETTERS * own["seconds"] / shortest)
                    words = textwrap.fill(stage, letters, max_lines=3, placeholder=" …")
                    axis.text(begin + 0.2, line, words, va="center", fontsize=6)
                begin += own["seconds"]
        axis.set_yticks(range(len(rows)), list(reversed(shown(rows))), fontsize=7)
        axis.set_xlabel("seconds; darker: compiling")
