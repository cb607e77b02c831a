"""Means of scores, first over the images of a frame, then over the frames of a person, then over
people. So each person counts once, whatever the number of photos.

Intervals are computed for the mean over people. If there is one person, they are computed over
frames, and if there is one frame, over images.
"""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

Row = dict[str, float | None]
"""Scores by name; None for a missing score."""
CONFIDENCE = 0.95
"""The probability with which an interval contains the true mean."""
RESAMPLES = 2000
"""Number of resamples of the bootstrap."""
BLOCKS = 20
"""Number of parts in which the resamples are computed, to save memory."""


class Scored(NamedTuple):
    """The scores of one image, and which image it is."""

    person: str
    """The name of the person."""
    frame: int
    """The frame that the image shows."""
    view: str
    """The name of the view."""
    scores: Row
    """The scores of the image."""


class Mean(NamedTuple):
    """A mean of scores and its confidence interval, of probability `CONFIDENCE`."""

    mean: float
    """The mean."""
    low: float | None
    """The lower end of the interval; None if there is only one value."""
    high: float | None
    """The upper end of the interval; None if there is only one value."""
    count: int
    """The number of values that were averaged."""
    over: str
    """What the values belong to: people, frames or images."""


def mean_scores(rows: Iterable[Mapping[str, float | None]]) -> Row:
    """Returns the mean of each score over some images or people. If one of them lacks a score, the
    mean of this score is None.
    """
    listed = list(rows)
    lacking = {name for name in listed[0] for row in listed if row.get(name) is None}
    means = _known_means(listed)
    return {name: None if name in lacking else mean for name, mean in means.items()}


def _known_means(rows: Sequence[Mapping[str, float | None]]) -> Row:
    """Returns the mean of each score over the rows in which it is known. For example, not all
    images have patches. A score that no row has is None.
    """
    means: Row = {}
    for name in rows[0]:
        values = [row.get(name) for row in rows]
        known = [value for value in values if value is not None]
        means[name] = sum(known) / len(known) if known else None
    return means


def _means_by(rows: Iterable[tuple[Any, Row]]) -> dict[Any, Row]:
    """Returns the `_known_means` of each group of rows that have the same key, by this key. Keys
    are in the order of their first appearance.
    """
    groups: dict[Any, list[Row]] = {}
    for key, row in rows:
        groups.setdefault(key, []).append(row)
    return {key: _known_means(found) for key, found in groups.items()}


def _frame_means(rows: Sequence[Scored]) -> dict[tuple[str, int], Row]:
    return _means_by(((row.person, row.frame), row.scores) for row in rows)


def person_means(rows: Sequence[Scored]) -> dict[str, Row]:
    """Returns the scores of each person: means over the images of a frame, then over frames."""
    return _means_by((person, row) for (person, _), row in _frame_means(rows).items())


def overall_means(rows: Sequence[Scored]) -> dict[str, Mean | None]:
    """Returns the mean of each score, with its interval. The mean is over people, or over frames if
    there is one person, or over images if there is one frame. None for scores that no image has.
    """
    levels = {
        "people": list(person_means(rows).values()),
        "frames": list(_frame_means(rows).values()),
        "images": [row.scores for row in rows],
    }
    over = next((over for over, units in levels.items() if len(units) > 1), "images")
    found: dict[str, Mean | None] = {}
    for name in rows[0].scores:
        of_units = [unit[name] for unit in levels[over]]
        values = [value for value in of_units if value is not None]
        if values:
            found[name] = Mean(float(np.mean(values)), *bootstrap(values), len(values), over)
        else:
            found[name] = None
    return found


def bootstrap(values: Sequence[float], seed: int = 0) -> tuple[float | None, float | None]:
    """Returns the ends of a confidence interval of the mean of some values, by percentiles of the
    bootstrap (Efron, 1979). (None, None) for one value.
    """
    if len(values) < 2:
        return None, None
    generator, numbers = np.random.default_rng(seed), np.asarray(values, np.float64)

    def drawn():
        return generator.integers(len(numbers), size=(RESAMPLES // BLOCKS, len(numbers)))

    means = np.concatenate([numbers[drawn()].mean(axis=1) for _ in range(BLOCKS)])
    low, high = np.quantile(means, [(1 - CONFIDENCE) / 2, (1 + CONFIDENCE) / 2])
    return float(low), float(high)
