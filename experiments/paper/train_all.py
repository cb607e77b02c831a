"""Trains the variants of the bench one after the other, and scores them."""

import functools
import itertools
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np

from experiments.harness import Run, entry
from experiments.paper.bench import (
    COUNTS,
    MARGIN,
    NEAR,
    NOT_TRAINED,
    PAINTED,
    PHOTOS,
    REFERENCE,
    ROUND,
    SCORES,
    SEEDS,
    TASKS,
    Difference,
    animatable,
    difference,
    finished,
    folder_of,
    headline,
    is_trained,
    last_weights,
    network,
    painted,
    state_of,
    tested,
    tests_of,
    train_run,
    trained_names,
    variants,
)
from experiments.paper.people import SIZE, write_plain
from experiments.results import cells, markdown_table, write_json
from experiments.systems import ADDED
from humangs_jax.core.processes import enable_compile_cache
from humangs_jax.io.reading import read_json
from humangs_jax.network.weights import load_weights

VALIDATED, VIEWS, HELD_OUT_VIEWS, TRAIN_VIEWS = 8, 12, 4, 8
"""Number of validation people, and views of a person: inputs, held-out views of each pose, and
views for training of each pose.
"""


@entry
def paper(
    run: Run, out: Path, only: tuple[str, ...] = (), train: bool = True, quick: bool = False
) -> None:
    """Trains the paper's systems and ablations one after the other at 32 pixels, until each meets
    its criterion.

    `bench.py` describes the rounds of a run, and when it counts as trained. What is done stays in
    OUT. The same command continues there from the last checkpoint, also after a kill. The reference
    comes first, then a seed of each system, more seeds of the reference, the ablations, and more
    seeds of all. CPU seconds are those of calls that were not killed. Operations are those of all
    steps.

    Options:
    out: folder of the people, the runs and results.json
    only: names of the variants to train; default: all
    train: --no-train shows what is done
    quick: 4 people, rounds of 4 steps, two variants
    """
    round_steps, people, test_people, seeds = ROUND, 192, 32, SEEDS
    if quick:
        round_steps, people, test_people, seeds = 4, 4, 2, 1
        only = only or (REFERENCE, "lvsm")
    known = variants()
    unknown = [name for name in only if name not in known]
    if unknown:
        raise ValueError(f"--only {unknown[0]!r}: expected names of {', '.join(known)}")
    settings = {"round_steps": round_steps, "people": people, "test_people": test_people}
    path, place = out / "results.json", out / "people"
    report = kept(path, settings)

    if train:
        enable_compile_cache(out / "cache")
        write_people(place, people, test_people)
        # the baseline, which is the criterion of all runs
        if not report["painted"]:
            seen = tested(painted, place / "validation", PHOTOS)["reconstruction"]["psnr_fg"]
            test = {str(PHOTOS): tested(painted, place / "test", PHOTOS)}
            report["painted"] = {"validation": float(np.mean(seen)), "test": test}
            write_json(path, report)
        for name, seed in queue(seeds):
            if only and name not in only:
                continue
            if not finish(name, seed, out, report):
                print(
                    f"interrupted in {name!r}, seed {seed}: the same command goes on there",
                    file=sys.stderr,
                )
                break

    if report["runs"]:
        numbers = {"differences": differences(report), "ablations": ablations(report)}
        run.show(table(report), report | numbers)


def write_people(place: Path, people: int, test_people: int) -> None:
    """Writes the people of training, validation and test into a folder, where they are missing."""
    write = functools.partial(write_plain, views=VIEWS, held_out=HELD_OUT_VIEWS)
    write(place / "validation", "validation", min(VALIDATED, test_people))
    write(place / "test", "test", test_people)
    write(place / "near", "test", test_people, near=True)
    # twice the size, which the loader averages
    write_plain(place / "train", "train", people, TRAIN_VIEWS, size=2 * SIZE)


def queue(seeds: int) -> list[tuple[str, int]]:
    """Returns all runs (name, seed), the most wanted ones first.

    Each system has a first seed before any variant has a second one. Systems that were added later
    come last.
    """
    systems = [name for name, variant in variants().items() if not variant.about]
    others = [name for name, variant in variants().items() if variant.about]
    more = [(REFERENCE, seed) for seed in range(1, seeds)]
    order = [(name, 0) for name in systems] + more + [(name, 0) for name in others]
    every = [(name, seed) for seed in range(1, seeds) for name in (*systems, *others)]
    order += [run for run in every if run not in more]
    return sorted(order, key=lambda run: run[0] in ADDED)


def finish(name: str, seed: int, out: Path, report: dict[str, Any]) -> bool:
    """Trains a run to its end and scores it. The report is written after each round.

    Returns False if the run was interrupted.
    """
    variant, place = variants()[name], out / folder_of(name) / str(seed)
    rows = report["runs"].setdefault(name, {})
    row = rows.get(str(seed), {})
    while "scores" not in row:
        # a round at a time, then the test scores
        if not row.get("done"):
            least, steps = report["painted"]["validation"], report["settings"]["round_steps"]
            row = train_run(variant, seed, place, out / "people", row, least, steps)
            if row is None:
                return False
            print(
                f"{name}, seed {seed}: {row['steps']} steps, foreground {row['validation']:.2f} dB",
                flush=True,
            )
        else:
            method = network(load_weights(last_weights(place))[0], variant.model)
            scores = {}
            for test in tests_of(name, variant):
                folder = out / "people" / ("near" if test in NEAR else "test")
                scores[test] = tested(
                    method, folder, int(test.split()[-1]), animatable(variant.model)
                )
            row = row | {"scores": scores}
        rows[str(seed)] = row
        write_json(out / "results.json", report)
        jax.clear_caches()
    return True


def kept(path: Path, settings: Mapping[str, Any]) -> dict[str, Any]:
    """Reads the report in a file, or returns an empty one without a file.

    Raises: ValueError if the report has other settings.
    """
    if not path.is_file():
        return {"settings": dict(settings), "painted": {}, "runs": {}}
    report = read_json(path)
    if report["settings"] != settings:
        raise ValueError(
            f"{path} has runs of other settings, {report['settings']}: give another OUT"
        )
    return report


def table(report: Mapping[str, Any]) -> str:
    """Formats a row for each variant with its difference to the reference, tables by number of
    photos, and the ablations.

    A variant that has not met the criterion shows how far it came instead of scores.
    """
    runs, least, changes = report["runs"], report["painted"]["validation"], differences(report)
    lines, counted = [], []
    for name, own in runs.items():
        if not own:
            continue
        rows, last = finished(runs, name), next(iter(own.values()))
        if rows and is_trained(rows[0], least):
            scores = [len(rows), *mean_cells(rows), str(changes.get(name, ""))]
            counted += photo_rows(name, rows)
        else:
            state = f"{state_of(report, name)}, {last['validation']:.2f} dB in validation"
            scores = [0, *["-"] * (len(SCORES) + 1), state]
        lines.append([name, last["photos"], *scores, *spent(own)])

    # the baseline has the last row
    base = report["painted"]["test"][str(PHOTOS)]
    means, moved = ({key: np.mean(x) for key, x in base[task].items()} for task in TASKS)
    lines.append(
        [PAINTED, PHOTOS, "", *cells(means, SCORES), f"{moved['psnr_fg']:.2f}", "", "", "", ""]
    )
    header = ["variant", "photos", "seeds", *(heading for heading, _ in SCORES.values())]
    header += ["another pose, foreground", f"foreground against `{REFERENCE}`, dB"]
    header += ["steps", "TFLOP", "CPU minutes"]

    # what the table shows, then the other tables
    settings = report["settings"]
    about = (
        f"{settings['test_people']} test people. A run has rounds of {settings['round_steps']}"
        " steps, then a quarter as many "
        f"with the perceptual loss. Rounds end {MARGIN:g} dB of foreground PSNR above the"
        f" {PAINTED}, which has {least:.2f} dB on "
        f'the validation people, or where a run is flat; "{NOT_TRAINED}": it has not got there, or'
        " the perceptual loss has "
        "taken it below the baseline. Intervals: 95 %, over people and seeds."
    )
    texts = [markdown_table(header, lines), about]
    if counted:
        heads = ["foreground PSNR, dB, by photos", "cameras", *COUNTS]
        texts.append(markdown_table(heads, counted, "llrrrr"))
    for part, (heads, rows) in ablations(report).items():
        texts += [f"{part}; a gain is positive:", markdown_table(heads, rows, "lllrrrr")]
    return "\n\n".join(texts)


def spent(runs: Mapping[str, Any]) -> list[Any]:
    """Returns the cells of what the runs of a variant have spent: most steps, TFLOP and CPU
    minutes.
    """
    units = {"operations": 1e12, "cpu_seconds": 60}
    sums = [sum(run[key] for run in runs.values()) / unit for key, unit in units.items()]
    return [max(run["steps"] for run in runs.values()), *(f"{value:.2g}" for value in sums)]


def mean_cells(rows: list[dict[str, Any]]) -> list[str]:
    """Returns the cells of mean scores over the seeds of a variant, and of its foreground in
    another pose.
    """
    found = [headline(row) for row in rows]
    means = {key: np.mean([each["reconstruction"][key] for each in found]) for key in SCORES}
    moved = "-"
    if "animation" in found[0]:
        moved = f"{np.mean([each['animation']['psnr_fg'] for each in found]):.2f}"
    return [*cells(means, SCORES), moved]


def photo_rows(name: str, rows: list[dict[str, Any]]) -> list[list[str]]:
    """Returns rows of foreground PSNRs by number of photos, for the cameras that a variant was
    tested with.
    """
    found = []
    for cameras, tests in {"standard": COUNTS, "near": NEAR}.items():
        if not set(tests) <= set(rows[0]["scores"]):
            continue
        line = [name, cameras]
        for test in tests:
            scores = [row["scores"][test]["reconstruction"]["psnr_fg"] for row in rows]
            line.append(f"{np.mean(scores):.2f}")
        found.append(line)
    return found


def differences(report: Mapping[str, Any]) -> dict[str, Difference]:
    """Returns {trained variant: its difference to the reference}, of the foreground in the pose of
    the photos, with the number of photos that each was trained with.
    """
    runs, ready = report["runs"], trained_names(report)
    if REFERENCE not in ready:
        return {}
    found = {}
    for name in ready:
        if name != REFERENCE:
            photos = finished(runs, name)[0]["photos"]
            found[name] = difference(runs, (name, photos), (REFERENCE, PHOTOS))
    return found


ABLATIONS = {
    "The global token": "no global token",
    "Features of four depths": "one depth",
    "1 tight + 4 free Gaussians a vertex instead of 1": "1 Gaussian a vertex",
    "Photos, over the number before": REFERENCE,
}
"""{ablation of the paper: the variant without the part}. That of photos compares the reference with
itself.
"""


def ablations(report: Mapping[str, Any]) -> dict[str, tuple[list[str], list[list[str]]]]:
    """Returns {ablation: (header, rows)} of what a part gains, by cameras, poses and numbers of
    photos.
    """
    runs, ready, found = report["runs"], trained_names(report), {}

    def scored(name, test, task):
        return name in ready and task in finished(runs, name)[0]["scores"].get(test, {})

    for part, other in ABLATIONS.items():
        lines = []
        for kind, task, score in itertools.product((COUNTS, NEAR), TASKS, ("psnr", "lpips_alex")):
            # a smaller LPIPS is a gain
            sign, digits = (1, 2) if score == "psnr" else (-1, 4)
            before = ("", *kind) if other == REFERENCE else kind
            gains = []
            for a, b in zip(kind, before, strict=False):
                if not scored(REFERENCE, a, task) or not scored(other, b, task):
                    gains.append("-")
                    continue
                gain = difference(runs, (REFERENCE, a), (other, b), task, score)
                gains.append(gain._replace(mean=sign * gain.mean).text(digits))
            if set(gains) != {"-"}:
                cameras = "near" if kind == NEAR else "standard"
                lines.append([cameras, TASKS[task], SCORES[score][0], *gains])
        if lines:
            found[part] = (["cameras", "shown", "gain", *COUNTS], lines)
    return found
