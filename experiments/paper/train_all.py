"""Trains the variants of the bench one after the other, and scores them."""

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


@entry
def paper(
    run: Run, out: Path, only: tuple[str, ...] = (), train: bool = True, quick: bool = False
) -> None:
    """Trains the paper's systems and ablations one after the other at 32 pixels, until each meets
    its criterion.

    What the rounds of a run are, and when it counts as trained: `bench.py`. What is done stays in
    OUT: the same command goes on there, also after a kill, from the last checkpoint. The reference
    comes first, then a seed of each system, more seeds of the reference, the ablations, more seeds
    of all. CPU seconds are of calls that were not killed; operations are of all steps.

    Options:
    out: folder of the people, the runs and results.json
    only: names of the variants to train; default: all
    train: --no-train shows what is done
    quick: 4 people, rounds of 4 steps, two variants
    """
    round_steps, people, test_people, seeds = (4, 4, 2, 1) if quick else (ROUND, 192, 32, SEEDS)
    known, only = variants(), only or ((REFERENCE, "lvsm") if quick else ())
    if unknown := [name for name in only if name not in known]:
        raise ValueError(f"--only {unknown[0]!r}: expected names of {', '.join(known)}")
    settings = {"round_steps": round_steps, "people": people, "test_people": test_people}
    path, place = out / "results.json", out / "people"
    report = kept(path, settings)
    if train:
        enable_compile_cache(out / "cache")
        write_plain(
            place / "validation", "validation", min(VALIDATED, test_people), VIEWS, HELD_OUT_VIEWS
        )
        write_plain(place / "test", "test", test_people, VIEWS, HELD_OUT_VIEWS)
        write_plain(place / "near", "test", test_people, VIEWS, HELD_OUT_VIEWS, near=True)
        write_plain(
            place / "train", "train", people, TRAIN_VIEWS, size=2 * SIZE
        )  # the loader averages
        if not report["painted"]:
            seen = tested(painted, place / "validation", PHOTOS)["reconstruction"]["psnr_fg"]
            test = {str(PHOTOS): tested(painted, place / "test", PHOTOS)}
            report["painted"] = {"validation": float(np.mean(seen)), "test": test}
            write_json(path, report)
        for name, seed in (x for x in queue(seeds) if x[0] in (only or known)):
            if not finish(name, seed, out, report):
                print(
                    f"interrupted in {name!r}, seed {seed}: the same command goes on there",
                    file=sys.stderr,
                )
                break
    if report["runs"]:
        run.show(
            table(report),
            report | {"differences": differences(report), "ablations": ablations(report)},
        )


def queue(seeds: int) -> list[tuple[str, int]]:
    """Runs, the most wanted ones first: of systems a seed before a second one of any; what was
    added later is last.
    """
    systems = [name for name, variant in variants().items() if not variant.about]
    others = [name for name, variant in variants().items() if variant.about]
    more = [(REFERENCE, seed) for seed in range(1, seeds)]
    order = [(name, 0) for name in systems] + more + [(name, 0) for name in others]
    every = [(name, seed) for seed in range(1, seeds) for name in (*systems, *others)]
    order += [run for run in every if run not in more]
    return sorted(order, key=lambda run: run[0] in ADDED)


def finish(name: str, seed: int, out: Path, report: dict[str, Any]) -> bool:
    """Bring a run to its end and score it; the report is written after each round.

    False if it was interrupted.
    """
    variant, place = variants()[name], out / folder_of(name) / str(seed)
    rows = report["runs"].setdefault(name, {})
    while "scores" not in (row := rows.get(str(seed), {})):
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
    """The report in a file, an empty one without a file.

    Raises: ValueError if it has other settings.
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
    """A row a variant, with its difference to the reference; those that have not met the criterion
    say how far they came.
    """
    runs, least, lines, counted, changes = (
        report["runs"],
        report["painted"]["validation"],
        [],
        [],
        differences(report),
    )
    for name, own in ((name, own) for name, own in runs.items() if own):
        rows, steps = finished(runs, name), max(x["steps"] for x in own.values())
        spent = {"operations": 1e12, "cpu_seconds": 60}
        compute = [f"{sum(x[key] for x in own.values()) / unit:.2g}" for key, unit in spent.items()]
        last = next(iter(own.values()))
        if not rows or not is_trained(rows[0], least):
            said = f"{state_of(report, name)}, {last['validation']:.2f} dB in validation"
            lines.append(
                [name, last["photos"], 0, *["-"] * (len(SCORES) + 1), said, steps, *compute]
            )
            continue
        means = {key: np.mean([headline(x)["reconstruction"][key] for x in rows]) for key in SCORES}
        moved = "-"
        if "animation" in headline(rows[0]):
            moved = f"{np.mean([headline(x)['animation']['psnr_fg'] for x in rows]):.2f}"
        lines.append(
            [
                name,
                last["photos"],
                len(rows),
                *cells(means, SCORES),
                moved,
                str(changes.get(name, "")),
                steps,
                *compute,
            ]
        )
        for kind in (COUNTS, NEAR):
            if set(kind) <= set(rows[0]["scores"]):
                means = [
                    np.mean([x["scores"][test]["reconstruction"]["psnr_fg"] for x in rows])
                    for test in kind
                ]
                counted.append(
                    [name, "near" if kind == NEAR else "standard", *(f"{x:.2f}" for x in means)]
                )
    base = report["painted"]["test"][str(PHOTOS)]
    means, moved = ({key: np.mean(x) for key, x in base[task].items()} for task in TASKS)
    lines.append(
        [PAINTED, PHOTOS, "", *cells(means, SCORES), f"{moved['psnr_fg']:.2f}", "", "", "", ""]
    )
    header = [
        "variant",
        "photos",
        "seeds",
        *(heading for heading, _ in SCORES.values()),
        "another pose, foreground",
    ]
    header += [f"foreground against `{REFERENCE}`, dB", "steps", "TFLOP", "CPU minutes"]
    settings = report["settings"]
    said = (
        f"{settings['test_people']} test people. A run has rounds of {settings['round_steps']}"
        " steps, then a quarter as many "
        f"with the perceptual loss. Rounds end {MARGIN:g} dB of foreground PSNR above the"
        f" {PAINTED}, which has {least:.2f} dB on "
        f'the validation people, or where a run is flat; "{NOT_TRAINED}": it has not got there, or'
        " the perceptual loss has "
        "taken it below the baseline. Intervals: 95 %, over people and seeds."
    )
    texts = [markdown_table(header, lines), said]
    if counted:
        texts.append(
            markdown_table(
                ["foreground PSNR, dB, by photos", "cameras", *COUNTS], counted, "llrrrr"
            )
        )
    for part, (heads, rows) in ablations(report).items():
        texts += [f"{part}; a gain is positive:", markdown_table(heads, rows, "lllrrrr")]
    return "\n\n".join(texts)


def differences(report: Mapping[str, Any]) -> dict[str, Difference]:
    """To the reference, of the foreground in the pose of the photos, each trained variant with its
    own number of photos.
    """
    runs, ready = report["runs"], trained_names(report)
    with_photos = {
        name: (name, finished(runs, name)[0]["photos"]) for name in ready if name != REFERENCE
    }
    return {
        name: difference(runs, own, (REFERENCE, PHOTOS))
        for name, own in with_photos.items()
        if REFERENCE in ready
    }


ABLATIONS = {
    "The global token": "no global token",
    "Features of four depths": "one depth",
    "1 tight + 4 free Gaussians a vertex instead of 1": "1 Gaussian a vertex",
    "Photos, over the number before": REFERENCE,
}
"""The paper's, and the variant without the part; that of photos compares the reference with itself.
"""


def ablations(report: Mapping[str, Any]) -> dict[str, tuple[list[str], list[list[str]]]]:
    """Heading and rows of each ablation: what a part gains, by cameras, poses and numbers of
    photos.
    """
    runs, ready, found = report["runs"], trained_names(report), {}

    def scored(name, test, task):
        return name in ready and task in finished(runs, name)[0]["scores"].get(test, {})

    for part, other in ABLATIONS.items():
        lines = []
        for kind, task, score in itertools.product((COUNTS, NEAR), TASKS, ("psnr", "lpips_alex")):
            sign, digits = (1, 2) if score == "psnr" else (-1, 4)
            before = kind if other != REFERENCE else ("", *kind)
            gains = []
            for a, b in zip(kind, before, strict=False):
                known = scored(REFERENCE, a, task) and scored(other, b, task)
                gain = difference(runs, (REFERENCE, a), (other, b), task, score) if known else None
                gains.append(
                    "-" if gain is None else gain._replace(mean=sign * gain.mean).text(digits)
                )
            if set(gains) != {"-"}:
                lines.append(
                    ["near" if kind == NEAR else "standard", TASKS[task], SCORES[score][0], *gains]
                )
        if lines:
            found[part] = (["cameras", "shown", "gain", *COUNTS], lines)
    return found
