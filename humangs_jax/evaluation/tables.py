"""Scores as data: means in a stated order, bootstrap intervals, and tables. Nothing here needs JAX.

A mean is first over the images of a frame, then over the frames of a person, then over people: a person counts once, however
often photographed. An interval is of the mean over people; with one person, over the frames; with one frame, over the images.
"""

import csv
import io
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from humangs_jax.core.progress import printable

Row = dict[str, float | None]
"""Scores by name; None for what is missing."""
ORDER = "mean over the images of a frame, then over the frames of a person, then over people"
CONFIDENCE = 0.95
RESAMPLES, BLOCKS = 2000, 20
"""Of the bootstrap, and in how many parts it is computed, for memory."""


class Column(NamedTuple):
    """How a score is shown. better: "up", "down" or ""."""

    heading: str
    digits: int
    better: str


COLUMNS = {
    "psnr": Column("PSNR", 2, "up"),
    "ssim": Column("SSIM", 4, "up"),
    "lpips_vgg": Column("LPIPS vgg", 4, "down"),
    "lpips_alex": Column("LPIPS alex", 4, "down"),
    "lpips_squeeze": Column("LPIPS squeeze", 4, "down"),
    "psnr_fg": Column("foreground PSNR", 2, "up"),
    "psnr_boundary": Column("PSNR at the silhouette", 2, "up"),
    "iou": Column("IoU", 4, "up"),
    "semi_transparent": Column("semi_transparent", 4, "down"),
    "foreground": Column("share of the person", 3, ""),
    "patch_psnr": Column("PSNR of patches", 2, "up"),
    "patch_ssim": Column("SSIM of patches", 4, "up"),
    "patch_lpips_vgg": Column("LPIPS vgg of patches", 4, "down"),
    "patch_lpips_alex": Column("LPIPS alex of patches", 4, "down"),
    "patch_lpips_squeeze": Column("LPIPS squeeze of patches", 4, "down"),
    "patches": Column("patches", 1, ""),
}


class Scored(NamedTuple):
    """An image's place and scores."""

    person: str
    frame: int
    view: str
    scores: Row


class Mean(NamedTuple):
    """A mean and its interval of `CONFIDENCE`; count: how many of `over` it is of. low and high are None for one."""

    mean: float
    low: float | None
    high: float | None
    count: int
    over: str


def mean_scores(rows: Iterable[Mapping[str, float | None]]) -> Row:
    """Means of the scores of some images or people; None for what one of them lacks."""
    listed = list(rows)
    columns = {name: [row.get(name) for row in listed] for name in listed[0]}
    known = {name: [value for value in values if value is not None] for name, values in columns.items()}
    return {name: sum(values) / len(values) if len(values) == len(listed) else None for name, values in known.items()}


def known_means(rows: Sequence[Row]) -> Row:
    """Means of the scores over those that have them, such as images with patches; None for what none has."""
    known = {name: [value for row in rows if (value := row[name]) is not None] for name in rows[0]}
    return {name: sum(values) / len(values) if values else None for name, values in known.items()}


def grouped(rows: Iterable[tuple[Any, Row]]) -> dict[Any, list[Row]]:
    """Scores by a key, in the order of first appearance."""
    groups: dict[Any, list[Row]] = {}
    for key, row in rows:
        groups.setdefault(key, []).append(row)
    return groups


def _frame_means(rows: Sequence[Scored]) -> dict[tuple[str, int], Row]:
    """Scores by person and frame."""
    return {key: known_means(images) for key, images in grouped(((r.person, r.frame), r.scores) for r in rows).items()}


def person_means(rows: Sequence[Scored]) -> dict[str, Row]:
    """Scores by person: means over the images of a frame, then over frames."""
    frames = _frame_means(rows)
    return {key: known_means(found) for key, found in grouped((who, row) for (who, _), row in frames.items()).items()}


def overall_means(rows: Sequence[Scored]) -> dict[str, Mean | None]:
    """The mean of each score with its interval, see the head of this module; None for scores that no image has."""
    levels = {
        "people": list(person_means(rows).values()),
        "frames": list(_frame_means(rows).values()),
        "images": [row.scores for row in rows],
    }
    over = next((over for over, units in levels.items() if len(units) > 1), "images")
    found: dict[str, Mean | None] = {}
    for name in rows[0].scores:
        values = [value for unit in levels[over] if (value := unit[name]) is not None]
        found[name] = Mean(float(np.mean(values)), *bootstrap(values), len(values), over) if values else None
    return found


def bootstrap(values: Sequence[float], seed: int = 0) -> tuple[float | None, float | None]:
    """The percentile interval of the mean of some values under resampling (Efron, 1979); (None, None) for one value."""
    if len(values) < 2:
        return None, None
    generator, numbers = np.random.default_rng(seed), np.asarray(values, np.float64)
    drawn = lambda: generator.integers(len(numbers), size=(RESAMPLES // BLOCKS, len(numbers)))
    means = np.concatenate([numbers[drawn()].mean(axis=1) for _ in range(BLOCKS)])
    low, high = np.quantile(means, [(1 - CONFIDENCE) / 2, (1 + CONFIDENCE) / 2])
    return float(low), float(high)


def shown(value: float | None, name: str) -> str:
    """A score with its digits; a dash for a missing one."""
    return "-" if value is None else f"{value:.{COLUMNS[name].digits}f}"


def shown_mean(mean: Mean | None, name: str) -> str:
    """A mean with its interval in brackets."""
    if mean is None:
        return "-"
    interval = "" if mean.low is None else f" [{shown(mean.low, name)}, {shown(mean.high, name)}]"
    return shown(mean.mean, name) + interval


_MARKDOWN = {"<": "&lt;", "&": "&amp;"} | {sign: f"\\{sign}" for sign in "\\|`*"}
"""What would begin HTML, code or another cell; links are broken between text and address."""


def markdown_table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """The first column to the left, the others to the right."""
    rule = ["---", *["---:"] * (len(header) - 1)]
    escape = lambda cell: "".join(_MARKDOWN.get(c, c) for c in printable(cell)).replace("](", "]\\(")
    lines = (" | ".join(map(escape, row)) for row in (header, *rows))
    first, *others = (f"| {line} |" for line in lines)
    return "\n".join([first, f"| {' | '.join(rule)} |", *others]) + "\n"


_LATEX = {"\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}"}


def latex_table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A tabular with rules of the package booktabs."""
    special = _LATEX | {sign: f"\\{sign}" for sign in "&%$#_{}"}
    line = lambda row: " & ".join("".join(special.get(c, c) for c in printable(cell)) for cell in row) + r" \\"
    body = "\n".join(line(row) for row in rows)
    begin = f"\\begin{{tabular}}{{l{'r' * (len(header) - 1)}}}\n\\toprule\n{line(header)}\n\\midrule\n"
    return f"{begin}{body}\n\\bottomrule\n\\end{{tabular}}\n"


_FORMULAS = tuple("=+-@\uff1d\uff0b\uff0d\uff20")
"""Signs that a formula begins with, those of full width too."""


def csv_text(rows: Sequence[Scored]) -> str:
    """One line an image, all digits; an empty cell for a missing score. Reads back with any spreadsheet.

    Names that a spreadsheet would take for a formula begin with an apostrophe.
    """
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    names = list(rows[0].scores)
    writer.writerow(["person", "frame", "view", *names])
    for row in rows:
        writer.writerow(
            [_cell(row.person), row.frame, _cell(row.view), *("" if (x := row.scores[n]) is None else x for n in names)]
        )
    return text.getvalue()


def _cell(name: str) -> str:
    name = printable(name)
    return f"'{name}" if name.lstrip()[:1] in _FORMULAS else name
