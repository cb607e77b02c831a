"""Results of the evaluation as data: what a row holds, means, rows kept from an unfinished run, tables.

A person has a row {cell: {"novel": scores, "animation": scores}}, where a cell is a number of photos or a body. "novel" are
held-out views in the pose of the photos, "animation" held-out views in poses that no photo shows. Scores are means over views
of those of `humangs_jax.evaluation` under the protocol "humangs", and those of the painted body ("baseline_").
"""

import hashlib
import json
import os
from collections.abc import Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

from experiments.common.results import markdown_table
from humangs_jax.evaluation.tables import mean_scores

TASKS = ("novel", "animation")
Scores = dict[str, float | None]
Row = dict[str, dict[str, Any]]

COLUMNS = {  # heading and digits
    "psnr": ("PSNR", 2),
    "ssim": ("SSIM", 3),
    "lpips": ("LPIPS", 4),
    "psnr_fg": ("fg PSNR", 2),
    "baseline_psnr": ("base", 2),
    "baseline_ssim": ("base SSIM", 3),
    "baseline_psnr_fg": ("base fg", 2),
    "baseline_lpips": ("base LPIPS", 4),
    "foreground": ("share", 3),
}
EXTREMES = 5
"""People at either end who are shown."""


def table_row(scores: Mapping[str, float | None]) -> str:
    """The numbers of a row of the printed table; a dash for what is missing."""
    return "".join(f"{cell(scores, key):>11}" for key in COLUMNS)


def cell(scores: Mapping[str, float | None], key: str) -> str:
    """One number with its digits."""
    value = scores.get(key)
    return "-" if value is None else f"{value:.{COLUMNS[key][1]}f}"


def mean_cells(rows: Sequence[Row], names: Sequence[str]) -> Row:
    """Means over rows by cell and task."""
    return {name: {task: mean_scores(row[name][task] for row in rows) for task in rows[0][name]} for name in names}


def kept_rows(path: Path | None, settings: dict[str, Any], cells: str) -> dict[int, Row]:
    """The rows that a file holds, by seed, if it was made with the same settings; none otherwise.

    cells: where a person's row is in the file. Raises: ValueError if the file is there and holds no JSON object.
    """
    if path is None or not path.exists():
        return {}
    try:
        report = json.loads(path.read_text())
    except ValueError as error:
        raise ValueError(f"{path}: expected the JSON of an earlier evaluation, or no file: {error}") from error
    if not isinstance(report, dict):
        raise ValueError(f"{path}: expected the JSON of an earlier evaluation, or no file")
    if report.get("settings") != settings:
        print(f"{path}: made with other settings (weights, people or sizes), so it is replaced")
        return {}
    return {person["seed"]: person[cells] for person in report["subjects"] + report["others"]}


def finished(rows: Mapping[int, Row], seeds: Sequence[int], names: Sequence[str]) -> list[int]:
    """The seeds whose rows have all these cells."""
    return [seed for seed in seeds if all(name in rows.get(seed, {}) for name in names)]


def file_digest(path: Path) -> str:
    """SHA-256 of a file, in hexadecimal digits."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def headline(counts: Sequence[int]) -> str:
    """The number of views of the headline scores: 4 if it was asked for, else the largest."""
    return str(4 if 4 in counts else max(counts))


def views_report(
    rows: Mapping[int, Row], settings: dict[str, Any], seeds: Sequence[int], counts: Sequence[int]
) -> dict[str, Any]:
    """What evaluate_synthetic.py writes; see there. At least one of the seeds has all its cells."""
    names, chosen = [str(count) for count in sorted(counts)], headline(counts)
    done = finished(rows, seeds, names)
    means = mean_cells([rows[seed] for seed in done], names)
    return {
        **means[chosen]["novel"],
        "views": int(chosen),
        **{key: settings[key] for key in ("split", "tokens", "image_size", "lpips_net")},
        "by_views": means,
        "settings": settings,
        "subjects": [{"seed": seed, **rows[seed][chosen]["novel"], "by_views": rows[seed]} for seed in done],
        "others": [{"seed": seed, "by_views": row} for seed, row in rows.items() if seed not in done],
    }


def without_people(report: dict[str, Any]) -> dict[str, Any]:
    """The report with the number of its people in place of their rows."""
    kept = {name: value for name, value in report.items() if name not in ("subjects", "others")}
    return kept | {"people": len(report["subjects"])}


def ranked(report: dict[str, Any]) -> list[dict[str, Any]]:
    """The people of a report, best PSNR of novel views first."""
    return sorted(report["subjects"], key=lambda person: -person["psnr"])


def extremes(report: dict[str, Any]) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """The best people, best first, and the worst, worst first: at most `EXTREMES` each, nobody twice."""
    order = ranked(report)
    count = min(EXTREMES, max(1, len(order) // 2))
    return order[:count], order[count:][::-1][:count]


def falls(report: dict[str, Any], task: str) -> list[tuple[str, str, float]]:
    """Where more views are worse on average: (views, more views, dB lost), in order."""
    means = [(count, cells[task]["psnr"]) for count, cells in report["by_views"].items()]
    return [(few, many, before - after) for (few, before), (many, after) in pairwise(means) if after < before]


def ahead(report: dict[str, Any], task: str, key: str) -> int:
    """How many people score better than their painted body, with the report's number of views."""
    cells = [row["by_views"][str(report["views"])][task] for row in report["subjects"]]
    return sum(scores[key] > scores[f"baseline_{key}"] for scores in cells)


TASK_NAMES = {"novel": "new views, same pose", "animation": "new views, unseen poses"}
SHOWN = {
    "psnr": "PSNR",
    "ssim": "SSIM",
    "lpips": "LPIPS",
    "psnr_fg": "foreground PSNR",
    "baseline_psnr": "painted body: PSNR",
    "baseline_ssim": "SSIM",
    "baseline_lpips": "LPIPS",
    "baseline_psnr_fg": "on the person",
}
"""Scores of the page's tables, and their headings."""


def shown_scores(means: Sequence[Scores]) -> list[str]:
    """Scores that a table has columns for: those that are known."""
    return [key for key in SHOWN if any(scores.get(key) is not None for scores in means)]


def about(settings: dict[str, Any], people: int) -> str:
    """What was measured, in one line."""
    size = settings["image_size"]
    return (
        f"{people} people of the {settings['split']} seeds, {size} x {size} pixels, white; {settings['held_out']} held-out "
        f"views in the pose of the photos, {settings['poses']} x {settings['pose_views']} in unseen poses; "
        f"weights {settings['weights'][:12]}, tokens: {settings['tokens']}."
    )


def views_section(report: dict[str, Any], page: Path, pictures: Path | None = None, plot: Path | None = None) -> str:
    """Tables of the scores by number of views, a verdict, the best and worst people, and the images if given."""
    by_views = report["by_views"]
    keys = shown_scores([scores for tasks in by_views.values() for scores in tasks.values()])
    tasks = [task for task in TASK_NAMES if task in next(iter(by_views.values()))]
    rows = [
        [TASK_NAMES[task], count, *(cell(by_views[count][task], key) for key in keys)]
        for task in tasks
        for count in by_views
    ]
    parts = [
        about(report["settings"], len(report["subjects"])),
        markdown_table(["task", "photos", *(SHOWN[key] for key in keys)], rows),
        " ".join(verdict(report, task) for task in tasks),
        extremes_table(report, tasks),
    ]
    link = lambda path: Path(os.path.relpath(path, page.parent)).as_posix()
    if plot is not None:
        parts.append(f"![PSNR against the number of photos]({link(plot)})")
    if pictures is not None:
        parts.append(f"![The best people beside the worst: truth, ours, painted body]({link(pictures)})")
    return "\n\n".join(parts)


def verdict(report: dict[str, Any], task: str) -> str:
    """Whether more photos are ever worse, and how many people beat their painted body."""
    worse = falls(report, task)
    said = "more photos are never worse on average"
    if worse:
        said = "on average, PSNR falls " + ", ".join(f"by {lost:.2f} dB from {a} to {b} photos" for a, b, lost in worse)
    people = len(report["subjects"])
    whole, person = (ahead(report, task, key) for key in ("psnr", "psnr_fg"))
    return (
        f"{TASK_NAMES[task].capitalize()}: {said}; with {report['views']}, {whole} of {people} people have a higher PSNR than "
        f"their painted body, {person} on the person alone."
    )


def extremes_table(report: dict[str, Any], tasks: Sequence[str]) -> str:
    """The best and the worst people, by PSNR of new views."""
    best, worst = extremes(report)
    count = str(report["views"])
    header = ["", "seed"]
    for task in tasks:
        header += [f"{TASK_NAMES[task]}: PSNR", "on the person", "painted body"]
    rows = []
    for name, people in (("best", best), ("worst", worst)):
        for place, row in enumerate(people, 1):
            scores = [row["by_views"][count][task] for task in tasks]
            numbers = [cell(s, key) for s in scores for key in ("psnr", "psnr_fg", "baseline_psnr")]
            rows.append([f"{name} {place}", row["seed"], *numbers])
    return markdown_table(header, rows)


def printed_table(means: dict[str, dict[str, Scores]]) -> str:
    """Means by cell and task for the terminal."""
    rows = {f"{name}, {task}": scores for name, tasks in means.items() for task, scores in tasks.items()}
    width = max(map(len, rows))
    heading = " " * width + "".join(f"{heading:>11}" for heading, _ in COLUMNS.values())
    return "\n".join([heading, *(f"{name:{width}}{table_row(scores)}" for name, scores in rows.items())])
