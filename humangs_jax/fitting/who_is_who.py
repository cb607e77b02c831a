"""Which of the people in several calibrated photos of one moment are the same person, and whose sides a view has exchanged.

Landmarks of one person triangulate: seen from other cameras they fall on that person's landmarks, within a few hundredths of the
person's size. Those of two people do not, nor do those of a person whose left and right one view takes for each other. Every pair
of people in two views proposes points, as they are and with the sides of the second exchanged; the others join where they agree.
"""

import itertools
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from humangs_jax.core.array_types import Bool, Float, Int

AGREE = 0.06
"""Median distance of landmarks from the triangulated points, a share of the person's size in the photo, up to which a view shows
the same person. Cameras that are off by a degree make 0.02 of it."""
CLEARLY, RATHER = 0.5, 0.8
"""Sides are exchanged if the distance is then less than this share of what it is without; the second where it does not agree
without."""
FARTHEST = 1.0
"""Metres between a person's places in two frames that follow each other."""
SEEN, FEWEST = 0.3, 6
"""Least visibility of a landmark that counts, and least number of those that two views share."""


PLAIN = 0.1
"""Of colors in [0, 1]: how much farther apart the next best order of people has to be."""


class Seen(NamedTuple):
    """People of a view. K: (3, 3). cam_from_world: (4, 4). people: each (k, 3) pixels and visibility."""

    K: Float[np.ndarray, "3 3"]
    cam_from_world: Float[np.ndarray, "4 4"]
    people: tuple[Float[np.ndarray, "k 3"], ...]


Key = tuple[int, int]
"""A view, and a person in it."""
Proposal = tuple[float, Key, Key, bool, Float[np.ndarray, "k 3"], Bool[np.ndarray, " k"]]
"""Error, two people, whether the sides of the second are exchanged, points, and which of them are known."""


class Match(NamedTuple):
    """One person. members: for each view the index of its person, None where it has none. mirrored: for each view whether left
    and right are exchanged. error: median distance of the landmarks from the triangulated points over the person's size; infinite
    for a person of one view. center: the median of the points, metres; NaN for a person of one view.
    """

    members: tuple[int | None, ...]
    mirrored: tuple[bool, ...]
    error: float
    center: Float[np.ndarray, "3"]


def match_people(views: Sequence[Seen], mirror: Sequence[int]) -> list[Match]:
    """The people of some views of one moment, those seen by most views first; those whom no other view shows come last.

    Arguments: mirror: for each landmark the index of its mirror image.
    """
    flipped_order = np.asarray(mirror)
    left = {(v, p) for v, view in enumerate(views) for p in range(len(view.people))}
    proposals = []
    for (v, p), (w, q) in itertools.combinations(sorted(left), 2):
        if v != w:
            first, second = views[v].people[p], views[w].people[q]
            trials = []
            for row in (second, second[flipped_order]):
                points, known = _triangulated(views, {v: first, w: row})
                errors = [_error(views[i], each, points, known) for i, each in ((v, first), (w, row))]
                trials.append((max(errors), points, known))
            flipped = _is_exchanged(trials[0][0], trials[1][0])
            error, points, known = trials[flipped]
            if error < AGREE:
                proposals.append((error, (v, p), (w, q), flipped, points, known))
    groups = [_gathered(views, flipped_order, left, proposal) for proposal in proposals]
    matches = []
    # the group that most views agree with, and of these the one that agrees best
    for group, error in sorted(groups, key=lambda each: (-len(each[0]), each[1])):
        if all(key in left for key in group):
            left -= set(group)
            matches.append(_match(views, flipped_order, group, error))
    for key in sorted(left):
        matches.append(_match(views, flipped_order, {key: False}, float("inf")))
    return matches


def _gathered(
    views: Sequence[Seen], mirror: Int[np.ndarray, " k"], available: set[Key], proposal: Proposal
) -> tuple[dict[Key, bool], float]:
    """The members of a proposal and of the other views where they agree: {(view, person): exchanged}, and the error."""
    _, first, second, flip, points, known = proposal
    group, errors = {first: False, second: flip}, [proposal[0]]
    for v in range(len(views)):
        if v in (first[0], second[0]):
            continue
        trials = []
        for p, row in enumerate(views[v].people):
            if (v, p) in available:
                plain, exchanged = (_error(views[v], each, points, known) for each in (row, row[mirror]))
                flipped = _is_exchanged(plain, exchanged)
                trials.append((exchanged if flipped else plain, (v, p), flipped))
        if not trials:
            continue
        error, key, flipped = min(trials)
        if error < AGREE:
            group[key] = flipped
            errors.append(error)
    return group, float(np.mean(errors))


def _is_exchanged(plain: float, exchanged: float) -> bool:
    """From two errors. Of a small or thin person left and right hardly differ: then nothing is exchanged."""
    return exchanged < (CLEARLY * plain if plain < AGREE else min(AGREE, RATHER * plain))


def _match(views: Sequence[Seen], mirror: Int[np.ndarray, " k"], group: dict[Key, bool], error: float) -> Match:
    members: list[int | None] = [None] * len(views)
    mirrored = [False] * len(views)
    for (v, p), flipped in group.items():
        members[v], mirrored[v] = p, flipped
    rows = {v: views[v].people[p][mirror] if flipped else views[v].people[p] for (v, p), flipped in group.items()}
    center = np.full(3, np.nan)
    if len(rows) > 1:
        points, known = _triangulated(views, rows)
        center = np.median(points[known], axis=0) if known.any() else center
    if 2 * sum(mirrored) > len(group):  # the exchanged ones are the fewer
        mirrored = [member is not None and not flipped for member, flipped in zip(members, mirrored, strict=True)]
    return Match(tuple(members), tuple(mirrored), error, center)


def _triangulated(
    views: Sequence[Seen], rows: dict[int, Float[np.ndarray, "k 3"]]
) -> tuple[Float[np.ndarray, "k 3"], Bool[np.ndarray, " k"]]:
    """Points by linear least squares, and which of them all views see."""
    known = np.logical_and.reduce([row[:, 2] >= SEEN for row in rows.values()])
    equations = []
    for v, row in rows.items():
        xy = (row[:, :2] - views[v].K[:2, 2]) / np.diag(views[v].K)[:2]
        camera = views[v].cam_from_world[:3]
        equations += [xy[:, i, None] * camera[2] - camera[i] for i in range(2)]
    vectors = np.linalg.svd(np.stack(equations, axis=1))[2][:, -1]
    scale = np.where(np.abs(vectors[:, 3]) > 1e-12, vectors[:, 3], np.nan)
    points = vectors[:, :3] / scale[:, None]
    return points, known & np.isfinite(points).all(-1)


def _error(view: Seen, row: Float[np.ndarray, "k 3"], points: Float[np.ndarray, "k 3"], known: Bool[np.ndarray, " k"]) -> float:
    """Median distance of landmarks from points over the size of the person; infinite behind the camera or with few in common."""
    seen = known & (row[:, 2] >= SEEN)
    if seen.sum() < FEWEST:
        return float("inf")
    local = points[seen] @ view.cam_from_world[:3, :3].T + view.cam_from_world[:3, 3]
    if np.median(local[:, 2]) <= 0:
        return float("inf")
    pixels = local @ view.K.T
    distances = np.linalg.norm(pixels[:, :2] / np.where(local[:, 2:] > 0, local[:, 2:], np.nan) - row[seen, :2], axis=-1)
    size = np.ptp(row[row[:, 2] >= SEEN, :2], axis=0).max()
    return float(np.median(np.nan_to_num(distances, nan=np.inf))) / max(float(size), 1e-9)


def in_order_of_time(frames: Sequence[list[Match]]) -> list[list[Match | None]]:
    """The matches of frames that follow each other, so that the i-th of each is one person: who is nearest to where he was.

    People of later frames who are nobody's are added at the end; None where a frame does not have a person.
    """
    people: list[list[Match | None]] = []
    for f, matches in enumerate(frames):
        left = list(range(len(matches)))
        last = [next(m.center for m in reversed(person) if m is not None) for person in people]
        pairs = sorted(
            (float(np.nan_to_num(np.linalg.norm(matches[i].center - center), nan=np.inf)), j, i)
            for j, center in enumerate(last)
            for i in left
        )
        chosen: dict[int, int] = {}
        for distance, j, i in pairs:
            if j not in chosen and i in left and distance < FARTHEST:
                chosen[j] = i
                left.remove(i)
        for j, person in enumerate(people):
            person.append(matches[chosen[j]] if j in chosen else None)
        people += [[*[None] * f, matches[i]] for i in left]
    return [[person[f] for person in people] for f in range(len(frames))]


def match_colors(first: Float[np.ndarray, "n k 3"], second: Float[np.ndarray, "m k 3"]) -> tuple[int, ...] | None:
    """For each of m people of a photo which of n >= m of another one has the same colors; None if that is not plain.

    Arguments: colors in [0, 1] of k parts of the body; NaN for parts that are not seen.
    """
    apart = np.linalg.norm(second[:, None] - first[None], axis=-1)
    seen = np.isfinite(apart)
    apart = np.where(seen, apart, 0).sum(-1) / np.maximum(seen.sum(-1), 1)
    options = sorted(
        (float(sum(apart[i, j] for i, j in enumerate(order))), order)
        for order in itertools.permutations(range(len(first)), len(second))
    )
    return options[0][1] if len(options) == 1 or options[1][0] - options[0][0] >= PLAIN else None
