"""Measures how fast the package is, in a unit that machines have in common, and whether a change
made it slower.

The unit is the CPU time of a plain product of two matrices by the same JAX. A faster or busier
machine changes this time as much as the others.
"""

import ast
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from experiments.harness import Run, entry
from experiments.results import REPOSITORY, markdown_table

MEASURED = {
    "render": "an image of the demo's avatar, 512 px",
    "gradient": "the same with its gradient",
    "reconstruct": "reconstruct the demo's person, 4 photos",
    "compile_render": "compile the image",
    "compile_gradient": "compile image and gradient",
}
"""{measurement: its name in the table}."""
PUBLIC = "public names"
"""Row of the number of names that `import humangs_jax` offers."""
WORKER = REPOSITORY / "experiments" / "speed_worker.py"


@entry
def speed(
    run: Run,
    before: str | None = None,
    turns: int = 3,
    repeats: int = 5,
    slower: float = 1.3,
) -> int:
    """Measures the CPU time of drawing, gradients, reconstruction and compilation in plain matrix
    products, and counts the code of each room.

    With --before each turn also measures the other commit in another process, by the same file
    through public names. The exit status is 1 if something takes more than --slower times as long
    as before. What the other commit cannot do is not compared.

    Options:
    before: commit, branch or tag to compare with, for instance the last release
    turns: number of processes of each
    repeats: timed iterations in a process
    slower: largest ratio of the times now and before
    """
    # both places take turns
    with checkout(before) as other:
        places = {"before": other} if other else {}
        places["now"] = REPOSITORY
        samples = {name: [] for name in places}
        for _ in range(turns):
            for name, place in places.items():
                samples[name].append(_measured(place, repeats))
        rooms = {name: code_by_room(place) for name, place in places.items()}

    # a row for each measurement, then for each room
    ratios = {name: _ratios(each) for name, each in samples.items()}
    rows = [
        [title, *(_shown(own.get(key)) for own in ratios.values())]
        for key, title in MEASURED.items()
    ]
    for room in rooms["now"]:
        title = room if room == PUBLIC else f"code tokens, {room}"
        rows.append([title, *(f"{own.get(room, 0):,}" for own in rooms.values())])
    numbers = {name: {"ratios": ratios[name], "code": rooms[name]} for name in places}
    run.show(markdown_table(["in plain products", *places], rows), numbers)
    too_slow = slower_than(ratios.get("before", {}), ratios["now"], slower)
    for line in too_slow:
        print(line)
    return int(bool(too_slow))


def slower_than(before: dict[str, float], now: dict[str, float], factor: float) -> list[str]:
    """Returns a line for each measurement that takes more than `factor` times as long as before."""
    return [
        f"{MEASURED[key]}: {now[key]:.2f} plain products, {before[key]:.2f} before:"
        f" {now[key] / before[key]:.2f} times, allowed are {factor:g}"
        for key in MEASURED
        if key in before and key in now and now[key] > factor * before[key]
    ]


def code_by_room(root: Path) -> dict[str, int]:
    """Counts the tokens of code of each folder of the package at a place, and its public names."""
    from experiments.count import code_tokens

    package = root / "humangs_jax"
    found: dict[str, int] = {}
    for file in sorted(package.rglob("*.py")):
        inside = file.relative_to(package).parts
        room = f"{inside[0]}/" if len(inside) > 1 else "the package itself"
        found[room] = found.get(room, 0) + code_tokens(file.read_text(encoding="utf-8"))
    return found | {PUBLIC: len(public_names(root))}


def public_names(root: Path) -> list[str]:
    """Returns the names that `import humangs_jax` offers at a place."""
    tree = ast.parse((root / "humangs_jax" / "__init__.pyi").read_text(encoding="utf-8"))
    return [
        each.asname or each.name
        for node in tree.body
        if isinstance(node, ast.ImportFrom)
        for each in node.names
    ]


@contextmanager
def checkout(commit: str | None) -> Generator[Path | None]:
    """Yields a folder with the files of a commit, which is removed afterwards, or None for no
    commit.
    """
    if commit is None:
        yield None
        return
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder) / "before"
        git = ["git", "-C", str(REPOSITORY), "worktree"]
        subprocess.run([*git, "add", "--quiet", "--detach", str(place), commit], check=True)
        try:
            yield place
        finally:
            subprocess.run([*git, "remove", "--force", str(place)], check=False)


def _measured(place: Path, repeats: int) -> dict[str, float]:
    """Returns the CPU milliseconds that a process measures with the package of a place.

    Raises: OSError with the end of the process's errors.
    """
    environment = os.environ | {"PYTHONPATH": str(place), "OMP_WAIT_POLICY": "passive"}
    environment.pop("JAX_COMPILATION_CACHE_DIR", None)  # compilation is what is measured
    command = [sys.executable, "-P", str(WORKER), str(repeats)]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, cwd=place)
    if done.returncode:
        raise OSError(f"{place}: {done.stderr[-2000:]}")
    return json.loads(done.stdout.splitlines()[-1])


def _ratios(samples: list[dict[str, float]]) -> dict[str, float]:
    """Returns each measurement in plain products of its process, as medians over the processes."""
    found = {}
    for key in MEASURED:
        if all(key in each for each in samples):
            found[key] = float(np.median([each[key] / each["product"] for each in samples]))
    return found


def _shown(ratio: float | None) -> str:
    """Formats a ratio, with a dash for one that was not measured."""
    return "-" if ratio is None else f"{ratio:.3g}"
