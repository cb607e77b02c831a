"""Results of the evaluation as data: what a row holds, means, rows kept from an unfinished run, tables.

A person has a row {cell: {"novel": scores, "animation": scores}}, where a cell is a number of photos or a body. "novel" are
held-out views in the pose of the photos, "animation" held-out views in poses that no photo shows. Scores are means over views:
PSNR in dB, SSIM, LPIPS, PSNR on the person alone ("psnr_foreground", weighted by the true mask), the share of the picture that
the person takes ("foreground"), and those of the painted body ("baseline_").
"""

import hashlib
import json
from collections.abc import Iterable, Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

TASKS = ("novel", "animation")
Scores = dict[str, float | None]
Row = dict[str, dict[str, Any]]

COLUMNS = {  # heading and digits
    "psnr": ("PSNR", 2),
    "ssim": ("SSIM", 3),
    "lpips": ("LPIPS", 4),
    "psnr_foreground": ("fg PSNR", 2),
    "baseline_psnr": ("base", 2),
    "baseline_ssim": ("base SSIM", 3),
    "baseline_psnr_foreground": ("base fg", 2),
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


def mean_scores(scores: Iterable[Scores]) -> Scores:
    """Means over people; None for what some of them lack."""
    listed = list(scores)
    columns = {key: [one.get(key) for one in listed] for key in listed[0]}
    known = {key: [value for value in values if value is not None] for key, values in columns.items()}
    return {key: sum(values) / len(values) if len(values) == len(listed) else None for key, values in known.items()}


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
    """The number of views whose scores stand for all: 4 if that was asked for, else the largest."""
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
