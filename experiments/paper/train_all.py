"""Train the paper's systems and ablations one after the other at bench size (128 pixels), and write docs/paper.md's table.

    python experiments/paper/train_all.py --out runs/paper --people 64 --budget 8          # hours; the same command goes on
    python experiments/paper/train_all.py --out runs/paper --bank people.npz --validation VALIDATION --steps 20000 --budget 40
    python experiments/paper/train_all.py --out runs/paper --data TRAINING --validation OTHERS --budget 40     # your people
    python experiments/paper/train_all.py --out runs/paper_quick --quick                                     # minutes

Each variant of `bench.variants` has the same number of steps, people, views and losses; the learning rate ends at 0. What is done
stays in OUT: finished variants are not repeated, an unfinished one goes on from its last checkpoint, also after Ctrl-C or a kill.
--budget ends the call in time. Another --steps is another OUT. The default of 3,000 steps takes some 30 minutes of two cores a
variant, and two seeds of two of them say how large noise is: a difference inside its 95 % interval is called so.

People are rendered on the fly from a bank of training seeds, the same ones for all; scores are of validation people: captures
with at least 4 + 6 views of one pose. Both are made once in OUT unless given. --quick trains the first two variants for 20 steps,
which says that everything runs and nothing else.
"""

import argparse
import json
import os
import signal
import sys
import threading
from collections.abc import Mapping
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[2]))
from experiments.paper.bench import (
    MARGIN,
    NOISE,
    NOT_TRAINED,
    PAGE,
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

TABLE = "paper"
VALIDATED = 8


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, help="folder of the runs and of results.json")
    parser.add_argument("--budget", type=float, help="hours that this call may take; default: no limit")
    parser.add_argument("--steps", type=int, default=3000, help="of each variant")
    parser.add_argument("--people", type=int, default=64, help="people of the bank that is made")
    parser.add_argument("--first", type=int, default=0, help="number of the first of them among the training seeds")
    parser.add_argument("--bank", type=Path, help="the people.npz of another run instead")
    parser.add_argument("--data", type=Path, help="captures or a data set (docs/datasets.md) to train on instead")
    parser.add_argument("--body", type=Path, help="body model of --data and --validation")
    parser.add_argument("--validation", type=Path, help="captures of other people; default: they are made")
    parser.add_argument("--validated", type=int, default=VALIDATED, help="how many of them")
    parser.add_argument("--only", nargs="+", help="names of the variants to train; default: all")
    parser.add_argument("--quick", action="store_true", help="20 steps of the first two variants on 4 people")
    parser.add_argument("--list", action="store_true", help="print the variants and end")
    parser.add_argument("--page", type=Path, nargs="?", const=PAGE, help="write the table paper of this page")
    arguments = parser.parse_args()
    if arguments.data is not None and arguments.validation is None:
        parser.error("--data needs --validation: people of the same kind to compare on")
    if arguments.steps < 1 or arguments.people < 1 or (arguments.budget is not None and arguments.budget <= 0):
        parser.error("--steps and --people must be at least 1, --budget positive")
    if arguments.quick:
        arguments.steps, arguments.people, arguments.validated = 20, 4, 2
    from humangs_jax.core.processes import keep_freed_memory

    keep_freed_memory()
    queue = variants(arguments.steps)
    if arguments.list:
        print("\n".join(queue))
        return
    names = arguments.only or list(queue)[: 2 if arguments.quick else None]
    if unknown := [name for name in names if name not in queue]:
        parser.error(f"--only {unknown[0]!r}: expected names of {', '.join(queue)}")
    run(arguments, queue, names, parser)


def run(arguments: argparse.Namespace, queue: Mapping[str, Any], names: list[str], parser: Any) -> None:
    """Train what is missing, one after the other; write the results after each."""
    import jax

    from experiments.common.results import check_section, publish, write_json
    from experiments.subjects import file_digest
    from humangs_jax.data.datasets.bodies import FileBody
    from humangs_jax.data.loader import CaptureCache, find_captures
    from humangs_jax.people.bank import load_bank
    from humangs_jax.training.sources import on_the_fly_people, people_on_disk

    if arguments.page:
        try:
            check_section(arguments.page, TABLE)
        except (ValueError, OSError) as error:
            parser.error(str(error))
    if arguments.budget is not None:
        timer = threading.Timer(3600 * arguments.budget, os.kill, (os.getpid(), signal.SIGTERM))
        timer.daemon = True
        timer.start()
    bank, folder = made_people(arguments)
    folders = find_captures(folder)[: arguments.validated]
    trained_on = str(arguments.data) if bank is None else file_digest(bank)
    settings = {"steps": arguments.steps, "people": trained_on, "validation": [x.name for x in folders]}
    path = arguments.out / "results.json"
    rows = kept(path, settings, parser)
    body = FileBody.load(arguments.body)
    people = people_on_disk(arguments.data, body) if bank is None else on_the_fly_people(load_bank(bank))
    unseen = CaptureCache(folders, body.model)
    for name in names:
        if name in rows:
            continue
        place = arguments.out / folder_of(name)
        views = view_counts(name, queue[name].config)
        row = train_variant(queue[name].config, place, people, body.model, unseen, views)
        if row is None:
            print(f"interrupted in {name!r}: the same command goes on there", file=sys.stderr)
            break
        rows = kept(path, settings, parser) | {name: row}  # another process may have added to it
        write_json(path, {"settings": settings, "runs": rows})
        print(f"{name}: " + ", ".join(f"{key} {value:.4g}" for key, value in headline(row).items()), flush=True)
        jax.clear_caches()
    if rows:
        print(text := table(rows, queue, settings, results(PAINTED_TABLE)["validation"] if arguments.page else None))
        if arguments.page:
            publish(arguments.page, TABLE, text, {"settings": settings, "runs": rows})


def made_people(arguments: argparse.Namespace) -> tuple[Path | None, Path]:
    """The bank of people to train on (None with --data), and the folder of those to compare on; made in OUT unless given."""
    from humangs_jax.body.library import load_body

    arguments.out.mkdir(parents=True, exist_ok=True)
    bank, folder = arguments.bank, arguments.validation
    if bank is None and arguments.data is None:
        from humangs_jax.people.bank import build_bank, save_bank
        from humangs_jax.people.seeds import seeds_of

        bank = arguments.out / "people.npz"
        if not bank.is_file():
            seeds = seeds_of("train", arguments.first, arguments.people)
            save_bank(bank, build_bank(seeds, load_body(), "train", processes=os.cpu_count() or 1, progress=True))
    if folder is None:
        from humangs_jax.people.writer import Layout, write_set

        folder = arguments.out / "validation"
        write_set(folder, arguments.validated, Layout(128, poses=2, views=12), "validation")
    return bank, folder


def kept(path: Path, settings: Mapping[str, Any], parser: Any) -> dict[str, Any]:
    """The runs in a file, {} without a file; exits with a message if they had other settings."""
    if not path.is_file():
        return {}
    report = json.loads(path.read_text())
    if report["settings"] != settings:
        parser.error(f"{path} has runs of other settings, {report['settings']}: give another --out")
    return report["runs"]


def table(
    rows: Mapping[str, Any],
    queue: Mapping[str, Any],
    settings: Mapping[str, Any],
    painted: Mapping[str, Any] | None = None,
) -> str:
    """A row a variant, with its difference to what it is compared with; below, what another seed changes.

    painted: scores of the painted body mesh by number of photos; runs that hardly beat it are marked as not trained.
    """
    from experiments.common.results import markdown_table

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
            [name, *(f"{own[str(c)]['psnr_fg']:.2f}" if str(c) in own else "" for c in counts)]
            for name, own in counted.items()
        ]
        texts.append(markdown_table(["foreground PSNR, dB, by photos", *map(str, counts)], shown))
    return "\n\n".join(texts)


if __name__ == "__main__":
    main()
