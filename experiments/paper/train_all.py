"""Trains the paper's systems and ablations one after the other at bench size (128 pixels)."""

import dataclasses
import json
import os
import signal
import sys
import threading
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax

from experiments.harness import Run, entry
from experiments.paper.bench import (
    MARGIN,
    NOISE,
    NOT_TRAINED,
    PAINTED,
    PAINTED_TABLE,
    PHOTOS,
    SCORES,
    folder_of,
    headline,
    results,
    seed_interval,
    train_variant,
    untrained,
    variants,
    verdict,
    view_counts,
)
from experiments.results import markdown_table, write_json
from experiments.subjects import file_digest
from humangs_jax.body.library import load_body
from humangs_jax.data.datasets.bodies import FileBody
from humangs_jax.data.loading import CaptureCache, find_captures
from humangs_jax.people.bank import build_bank, load_bank, save_bank
from humangs_jax.people.subject import seeds_of
from humangs_jax.people.writer import Layout, write_set
from humangs_jax.training.sources import on_the_fly_people, people_on_disk


@dataclasses.dataclass(frozen=True)
class Bench:
    """Options:
    budget: hours that this call may take; default: no limit
    steps: of each variant; another number is another OUT
    people: people of the bank that is made
    first: number of the first of them among the training seeds
    bank: the people.npz of another run instead
    data: captures or a data set (docs/datasets.md) to train on instead
    body: body model of --data and --validation
    validation: captures of other people; default: they are made
    validated: how many of them
    only: names of the variants to train; default: all
    quick: 20 steps of the first two variants on 4 people
    """

    budget: float | None = None
    steps: int = 3000
    people: int = 64
    first: int = 0
    bank: Path | None = None
    data: Path | None = None
    body: Path | None = None
    validation: Path | None = None
    validated: int = 8
    only: tuple[str, ...] = ()
    quick: bool = False


@entry
def paper(run: Run, out: Path, bench: Bench = Bench(), names_only: bool = False) -> None:
    """Trains the paper's systems and ablations at bench size (128 pixels), one after the other, and compares them.

    Each variant has the same number of steps, people, views and losses; the learning rate ends at 0. What is done stays in OUT:
    finished variants are not repeated, an unfinished one goes on from its last checkpoint, also after Ctrl-C or a kill. 3,000
    steps take some 30 minutes of two cores a variant, and two seeds of two of them say how large noise is: a difference inside
    its 95 % interval is called so. People are rendered on the fly from a bank of training seeds, the same ones for all; scores
    are of validation people: captures with at least 4 + 6 views of one pose. Both are made once in OUT unless given.

    Options:
    out: folder of the runs and of results.json
    names_only: print the variants and end
    """
    if bench.data is not None and bench.validation is None:
        raise ValueError("--data needs --validation: people of the same kind to compare on")
    if bench.steps < 1 or bench.people < 1 or (bench.budget is not None and bench.budget <= 0):
        raise ValueError("--steps and --people must be at least 1, --budget positive")
    if bench.quick:
        bench = dataclasses.replace(bench, steps=20, people=4, validated=2)
    queue = variants(bench.steps)
    if names_only:
        print("\n".join(queue))
        return
    names = bench.only or list(queue)[: 2 if bench.quick else None]
    if unknown := [name for name in names if name not in queue]:
        raise ValueError(f"--only {unknown[0]!r}: expected names of {', '.join(queue)}")
    if bench.budget is not None:
        timer = threading.Timer(3600 * bench.budget, os.kill, (os.getpid(), signal.SIGTERM))
        timer.daemon = True
        timer.start()
    bank, folder = made_people(out, bench)
    folders = find_captures(folder)[: bench.validated]
    trained_on = str(bench.data) if bank is None else file_digest(bank)
    settings = {"steps": bench.steps, "people": trained_on, "validation": [x.name for x in folders]}
    path, body = out / "results.json", FileBody.load(bench.body)
    rows = kept(path, settings)
    people = people_on_disk(bench.data or out, body) if bank is None else on_the_fly_people(load_bank(bank))
    unseen = CaptureCache(folders, body.model)
    for name in (name for name in names if name not in rows):
        config = queue[name].config
        row = train_variant(config, out / folder_of(name), people, body.model, unseen, view_counts(name, config))
        if row is None:
            print(f"interrupted in {name!r}: the same command goes on there", file=sys.stderr)
            break
        rows = kept(path, settings) | {name: row}  # another process may have added to it
        write_json(path, {"settings": settings, "runs": rows})
        print(f"{name}: " + ", ".join(f"{key} {value:.4g}" for key, value in headline(row).items()), flush=True)
        jax.clear_caches()
    if rows:
        painted = results(PAINTED_TABLE)["validation"] if run.publish else None
        run.show(table(rows, queue, settings, painted), {"settings": settings, "runs": rows})


def made_people(out: Path, bench: Bench) -> tuple[Path | None, Path]:
    """The bank of people to train on (None with --data), and the folder of those to compare on; made in OUT unless given."""
    out.mkdir(parents=True, exist_ok=True)
    bank, folder = bench.bank, bench.validation
    if bank is None and bench.data is None:
        bank = out / "people.npz"
        if not bank.is_file():
            seeds = seeds_of("train", bench.first, bench.people)
            save_bank(bank, build_bank(seeds, load_body(), "train", processes=os.cpu_count() or 1, progress=True))
    if folder is None:
        folder = out / "validation"
        write_set(folder, bench.validated, Layout(128, poses=2, views=12), "validation")
    return bank, folder


def kept(path: Path, settings: Mapping[str, Any]) -> dict[str, Any]:
    """The runs in a file, {} without a file. Raises: ValueError if they had other settings."""
    if not path.is_file():
        return {}
    report = json.loads(path.read_text())
    if report["settings"] != settings:
        raise ValueError(f"{path} has runs of other settings, {report['settings']}: give another OUT")
    return report["runs"]


def table(
    rows: Mapping[str, Any],
    queue: Mapping[str, Any],
    settings: Mapping[str, Any],
    painted: Mapping[str, Any] | None = None,
) -> str:
    """A row a variant, with its difference to what it is compared with; below, what another seed changes.

    painted: scores of the vertex-color baseline by number of photos; runs that hardly beat it are marked as not trained.
    """
    lines, interval = [], seed_interval(rows)
    gray = untrained(rows, painted) if painted else ()
    for name in (name for name in queue if name in rows):
        row, against = rows[name], queue[name].against
        scores = headline(row)
        cells: list[object] = [name, row["photos"]]
        cells += [f"{scores[key]:.{digits}f}" for key, (_, digits) in SCORES.items()]
        if against in rows:
            change = scores["psnr_fg"] - headline(rows[against])["psnr_fg"]
            said = NOISE if queue[name].claim == NOISE else verdict(change, interval)
            cells += [against, f"{change:+.2f}", NOT_TRAINED if name in gray or against in gray else said]
        else:
            cells += ["", "", NOT_TRAINED if name in gray else ""]
        lines.append([*cells, f"{row['parameters'] / 1e6:.2f}", row["steps"], f"{row['cpu_seconds']:.0f}"])
    header = ["variant", "photos", *(heading for heading, _ in SCORES.values())]
    header += ["against", "difference of foreground PSNR, dB", "", "M parameters", "steps", "CPU s"]
    text = markdown_table(header, lines, "lr" + "r" * len(SCORES) + "lrlrrr")
    said = f"Means over {len(settings['validation'])} unseen people."
    if interval is not None:
        said += f" 95 % interval of a difference by the seeds of training alone: +-{interval:.2f} dB; within it: noise."
    if painted:
        said += f' "{NOT_TRAINED}": less than {MARGIN:g} dB of foreground PSNR over the {PAINTED} of {PHOTOS} photos.'
    texts = [text, said]
    counted = {name: row["by_views"] for name, row in rows.items() if len(row["by_views"]) > 1}
    if counted:
        counts = sorted({int(count) for own in counted.values() for count in own})
        shown = [
            [name, *(f"{own[str(c)]['psnr_fg']:.2f}" if str(c) in own else "" for c in counts)] for name, own in counted.items()
        ]
        texts.append(markdown_table(["foreground PSNR, dB, by photos", *map(str, counts)], shown))
    return "\n\n".join(texts)
