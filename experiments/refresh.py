"""Makes tables of the docs again, one after the other, with the package as it is."""

import re
import shlex
import subprocess
import sys
from pathlib import Path

from experiments.harness import Run, entry
from experiments.results import REPOSITORY

LIST = REPOSITORY / "experiments" / "README.md"
ROW = re.compile(r"^\| \[(\w+)\]\([^)]*\) \| `([^`]+)` \|$", re.MULTILINE)
"""Matches a row of the list: the table, and the command that makes it."""
FILES = re.compile(r"\b(?!OUT\b)[A-Z]{2,}\b|\.py |\.pt ")
"""Matches a command that needs files which only the user has, or that is no entry."""


@entry
def refresh(run: Run, out: Path, tables: tuple[str, ...]) -> int:
    """Makes tables again by the commands that experiments/README.md has for them, and publishes
    them.

    What an experiment has measured lies in OUT/TABLE.json and is not measured again, so that the
    same command continues after an interruption. A new OUT measures everything again. The exit
    status is 1 if an experiment failed. The others are made nevertheless.

    Options:
    out: folder of measurements
    tables: names of the tables, in this order
    """
    # the commands of the list, but for those that need files of the user
    commands = dict(ROW.findall(LIST.read_text(encoding="utf-8")))
    commands = {name: line for name, line in commands.items() if not FILES.search(line)}
    missing = [name for name in tables if name not in commands]
    if missing:
        known = ", ".join(sorted(commands))
        raise ValueError(f"{', '.join(missing)}: expected one of {known}")

    out.mkdir(parents=True, exist_ok=True)
    failed = []
    for name in tables:
        done, rows = out / f"{name}.done", out / f"{name}.json"
        if done.exists():
            continue
        points = str((out / f"{name}.points.json").resolve())
        words = [points if word == "OUT" else word for word in shlex.split(commands[name])]
        words += ["--json", str(rows.resolve()), "--publish"]
        print(f"{name}: {shlex.join(words)}", flush=True)
        command = [sys.executable, "-m", "experiments", *words]
        if subprocess.run(command, cwd=REPOSITORY, check=False).returncode:
            failed.append(name)
        else:
            done.touch()
    print(f"failed: {', '.join(failed)}" if failed else "all are made")
    return int(bool(failed))
