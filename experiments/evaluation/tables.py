"""The evaluation's report as a section of a Markdown page."""

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from experiments.common.results import markdown_table
from experiments.evaluation.results import COLUMNS, Scores, ahead, cell, extremes, falls, table_row

TASK_NAMES = {"novel": "new views, same pose", "animation": "new views, unseen poses"}
SHOWN = {
    "psnr": "PSNR",
    "ssim": "SSIM",
    "lpips": "LPIPS",
    "psnr_foreground": "PSNR on the person",
    "baseline_psnr": "painted body: PSNR",
    "baseline_ssim": "SSIM",
    "baseline_lpips": "LPIPS",
    "baseline_psnr_foreground": "on the person",
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
    """Tables of the scores by number of views, what they say, who is best and worst, and the pictures if there are any."""
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
    whole, person = (ahead(report, task, key) for key in ("psnr", "psnr_foreground"))
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
            numbers = [cell(s, key) for s in scores for key in ("psnr", "psnr_foreground", "baseline_psnr")]
            rows.append([f"{name} {place}", row["seed"], *numbers])
    return markdown_table(header, rows)


def printed_table(means: dict[str, dict[str, Scores]]) -> str:
    """Means by cell and task for the terminal."""
    rows = {f"{name}, {task}": scores for name, tasks in means.items() for task, scores in tasks.items()}
    width = max(map(len, rows))
    heading = " " * width + "".join(f"{heading:>11}" for heading, _ in COLUMNS.values())
    return "\n".join([heading, *(f"{name:{width}}{table_row(scores)}" for name, scores in rows.items())])
