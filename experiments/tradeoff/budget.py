"""Whether what `humangs tune` chooses stays within its budget on a busy machine.

    python experiments/tradeoff/budget.py --json OUT --page docs/tradeoff.md [--load 2] [--runs 10] [--size 256]

While --load other processes multiply matrices, one core each, settings are chosen for the demo capture: for budgets of some
multiples of what the fastest setting takes then. What was chosen is measured again --runs times, as `tune` measures: the slowest
of some reconstructions, the 90th percentile of some frames. A run is within the budget if both are.
"""

import argparse
import contextlib
import dataclasses
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[2]))
from experiments.common.results import add_outputs, check_section, cores, markdown_table, write_outputs

TABLE = "tune_budgets"
MULTIPLES = ((0.5, 0.5), (2.0, 2.0), (6.0, 3.0))
"""Budgets for a reconstruction and for a frame, in times of the fastest setting."""
BUSY = """
import numpy as np
x = np.random.default_rng(0).random((500, 500))
while True:
    x @ x
"""


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--load", type=int, default=cores(), help="busy processes beside it (default: one for each core)"
    )
    parser.add_argument("--runs", type=int, default=10, help="measurements of each choice")
    parser.add_argument("--size", type=int, default=256, help="side of the frames, pixels")
    add_outputs(parser, TABLE)
    arguments = parser.parse_args()
    if arguments.page:
        check_section(arguments.page, TABLE)
    with busy(arguments.load):
        rows = measure(arguments.runs, arguments.size)
    results = {"load": arguments.load, "size": arguments.size, "budgets": rows}
    write_outputs(arguments, TABLE, section(results), results)


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


def measure(runs: int, size: int) -> list[dict[str, Any]]:
    """One row a budget: {"reconstruct_ms", "frame_ms"} and {"refused"}, or {"chosen", "tuned", "runs", "within"}."""
    from tqdm import tqdm

    from humangs_jax.apps import settings as tuning
    from humangs_jax.data.capture import load_capture
    from humangs_jax.network.weights import load_weights

    network, capture = load_weights(), load_capture("demo_capture")
    fastest = tuning.measure(tuning.load_front()[0].settings, *network, capture, size)
    rows = []
    for make, frame in tqdm(MULTIPLES, desc="budgets"):
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
    return rows


def section(results: dict[str, Any]) -> str:
    """The table."""
    lines = []
    for row in results["budgets"]:
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
    return markdown_table(header, lines, "rrlrrr")


if __name__ == "__main__":
    main()
