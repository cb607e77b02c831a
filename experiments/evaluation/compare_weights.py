"""Weights, or two ways to use them, side by side: feed-forward and refined, of the same people.

    python experiments/evaluation/refinement.py --split validation --seconds 5 --sizes 256 --iterations 0 --weights A --json
    a.json python experiments/evaluation/compare_weights.py first=a.json trained=b.json --page docs/evaluation.md [--table NAME]

The scores are those of `refinement.py`, means over its people. Results may differ in --weights, --tokens, --crop and
--skinning-reach.
"""

import argparse
import json
import sys
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[2]))
from experiments.common.results import add_outputs, check_section, markdown_table, write_outputs

COMPARED = ("weights", "tokens", "crop", "skinning_reach")
"""Settings that may differ."""
SCORES = {
    "psnr": ("PSNR", 2),
    "psnr_fg": ("on the person", 2),
    "ssim": ("SSIM", 4),
    "semi_transparent": ("semi_transparent", 3),
}
TASKS = {"novel": "same pose", "animation": "unseen poses"}


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("results", nargs="+", metavar="NAME=JSON", help="results of refinement.py")
    parser.add_argument("--table", default="weights_choice", help="name of the table on the page")
    add_outputs(parser, "TABLE")
    arguments = parser.parse_args()
    if arguments.page:
        check_section(arguments.page, arguments.table)
    named = dict(pair.split("=", 1) for pair in arguments.results)
    results = {name: json.loads(Path(path).read_text()) for name, path in named.items()}
    means = compare(results)
    write_outputs(arguments, arguments.table, section(means), {"means": means, "people": by_person(results)})


def compare(results: dict[str, Any]) -> dict[str, Any]:
    """{name: {seconds: {task: {score: mean}}}}.

    Raises: ValueError if two results are not of the same people and settings, or a result is of several starts.
    """
    common = [
        ({name: value for name, value in result["settings"].items() if name not in COMPARED}, seeds(result))
        for result in results.values()
    ]
    for name, found in zip(results, common, strict=True):
        if found != common[0]:
            raise ValueError(
                f"{name}: expected the people and settings of {next(iter(results))}: {common[0]}, got {found}"
            )
    for name, result in results.items():
        if len(result["means"]) != 1:
            raise ValueError(f"{name}: expected one size, number of photos and start, got {list(result['means'])}")
    return {
        name: {run: {task: {key: tasks[task][key] for key in SCORES} for task in TASKS} for run, tasks in runs.items()}
        for name, result in results.items()
        for runs in result["means"].values()
    }


def by_person(results: dict[str, Any]) -> dict[str, Any]:
    """{name: {seconds: foreground PSNR in the pose of the photos, of each person}}."""
    score = lambda subject, cell, run: subject["cells"][cell][run]["novel"]["psnr_fg"]
    return {
        name: {run: [score(subject, cell, run) for subject in result["subjects"]] for run in runs}
        for name, result in results.items()
        for cell, runs in result["means"].items()
    }


def seeds(result: dict[str, Any]) -> list[int]:
    """Seeds of its people."""
    return [subject["seed"] for subject in result["subjects"]]


def section(means: dict[str, Any]) -> str:
    """The table."""
    header = ["weights", "refined, s", *(f"{task}: {name}" for task in TASKS.values() for name, _ in SCORES.values())]
    rows = [
        [name, run, *(f"{scores[task][score]:.{digits}f}" for task in TASKS for score, (_, digits) in SCORES.items())]
        for name, runs in means.items()
        for run, scores in runs.items()
    ]
    return markdown_table(header, rows)


if __name__ == "__main__":
    main()
