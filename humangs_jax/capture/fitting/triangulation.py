"""Triangulates points from several views, and finds out which people in several views are the same
person.

A pixel is a ray. The point with the least weighted sum of squared distances to the rays is the
solution of 3 x 3 equations. Each distance is multiplied by the focal length over the distance from
the camera, which turns metres into pixels (Hartley and Zisserman, Multiple View Geometry, 12.2).
The robust solution of a point begins with the pair of views whose point the views agree with most.

If two views show the same person, the triangulated landmarks project to the person's landmarks in
other cameras, within a few hundredths of the person's size. Landmarks of two different people do
not, nor do landmarks of a person with left and right exchanged in one view. So every pair of people
in two views proposes points, once as they are, and once with left and right of the second person
exchanged. People in other views who agree with the points join the pair.
"""

import dataclasses
import itertools
from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy.optimize import linear_sum_assignment

from humangs_jax.capture.fitting.residuals.keypoints import Observations, focal_lengths, in_cameras
from humangs_jax.core.array_types import Array, Bool, Float, Int
from humangs_jax.core.numerics import safe_normalize
from humangs_jax.geometry.transform import EXACT

PAIRS_AT_ONCE = 16
"""Number of pairs of views that are evaluated at the same time. It is fixed, so that memory does
not grow with the number of pairs.
"""
_MARGIN = 6.0
"""A view agrees with a point if its error is below this, in standard deviations of the noise."""


def triangulate(
    observations: Observations, weights: Float[Array, "c k"] | None = None
) -> tuple[Float[Array, "k 3"], Float[Array, " k"]]:
    """Returns points triangulated by least squares over all views, (k, 3), metres, and how many
    views have a weight for each point, (k,).

    Arguments: weights: weight of each point in each view, (c, k). None: the confidences.
    """
    weights = observations.confidences if weights is None else weights
    origins, directions = _rays(observations)
    focal = observations.K[:, 0, 0]
    points = _nearest(origins, directions, weights)
    # rays are weighted by the distance of the last point
    for _ in range(3):
        distance = jnp.sum(directions * (points - origins[:, None]), axis=-1)
        pixels_per_metre = focal[:, None] / jnp.maximum(jnp.abs(distance), 0.1)
        points = _nearest(origins, directions, weights * jnp.square(pixels_per_metre))
    return points, jnp.sum(weights > 0, axis=0).astype(jnp.float32)


def triangulate_robustly(
    observations: Observations,
) -> tuple[Float[Array, "k 3"], Float[Array, " k"], Float[Array, "c k"]]:
    """Returns robustly triangulated points, (k, 3), metres, how many views agree with each point,
    (k,), and the weights of these views, (c, k).

    Every pair of views proposes a point. The proposal that the views agree with most is chosen, and
    is triangulated again from the views that agree with it. If fewer than two views agree with a
    point, its weights are 0.
    """
    views = observations.points.shape[0]
    if views < 2:
        k = observations.points.shape[1]
        return jnp.zeros((k, 3)), jnp.zeros(k), jnp.zeros_like(observations.confidences)
    pairs = np.stack(np.triu_indices(views, 1), axis=1)
    chosen = np.zeros((len(pairs), views, 1), np.float32)
    chosen[np.arange(len(pairs))[:, None], pairs] = 1

    def propose(pair):
        points = triangulate(observations, observations.confidences * pair)[0]
        return points, jnp.sum(agreement(observations, points), axis=0)

    # of all pairs only their points are kept: with 48 views there are 1128 pairs, each with an
    # agreement of every view
    proposals, agreed = jax.lax.map(propose, jnp.asarray(chosen), batch_size=PAIRS_AT_ONCE)
    best = jnp.argmax(agreed, axis=0)
    points = jnp.take_along_axis(proposals, best[None, :, None], axis=0)[0]
    weights = agreement(observations, points)
    weights = jnp.where(jnp.sum(weights > 0, axis=0) >= 2, weights, 0.0)
    points, count = triangulate(observations, weights)
    return points, count, weights


def agreement(observations: Observations, points: Float[Array, "k 3"]) -> Float[Array, "c k"]:
    """Returns how well views agree with points, (c, k). The agreement is the confidence for an
    error of 0, decreases with the error, and is 0 for errors beyond `_MARGIN`.
    """
    errors = reprojection_errors(observations, points)
    return observations.confidences * jnp.maximum(
        1 - jnp.square(errors / (_MARGIN * observations.noise)), 0.0
    )


def reprojection_errors(
    observations: Observations, points: Float[Array, "k 3"]
) -> Float[Array, "c k"]:
    """Returns the distances between projected points and the detections, (c, k), pixels. They are
    1e6 for points behind a camera or less than 1 cm in front of it.
    """
    seen = in_cameras(observations, points)
    depth = seen[..., 2]
    before = depth > 0.01
    pixels = seen[..., :2] / jnp.where(before, depth, 1.0)[..., None] * focal_lengths(observations)
    pixels += observations.K[:, None, :2, 2]
    return jnp.where(before, jnp.linalg.norm(pixels - observations.points, axis=-1), 1e6)


def _rays(observations: Observations) -> tuple[Float[Array, "c 3"], Float[Array, "c k 3"]]:
    rotation = observations.cam_from_world[:, :3, :3]
    translation = observations.cam_from_world[:, :3, 3]
    xy = (observations.points - observations.K[:, None, :2, 2]) / focal_lengths(observations)
    local = jnp.concatenate([xy, jnp.ones_like(xy[..., :1])], axis=-1)
    directions = safe_normalize(
        jnp.einsum("cba,ckb->cka", rotation, local, precision=EXACT), jnp.asarray([0.0, 0.0, 1.0])
    )
    return -jnp.einsum("cba,cb->ca", rotation, translation, precision=EXACT), directions


def _nearest(
    origins: Float[Array, "c 3"], directions: Float[Array, "c k 3"], weights: Float[Array, "c k"]
) -> Float[Array, "k 3"]:
    center = jnp.mean(origins, axis=0)  # against rounding far from the world's origin
    across = jnp.eye(3) - directions[..., :, None] * directions[..., None, :]
    scale = weights / jnp.maximum(jnp.sum(weights, axis=0), 1e-12)
    # the ridge pulls towards the cameras: parallel rays leave the distance open
    matrix = jnp.einsum("ck,ckab->kab", scale, across, precision=EXACT) + 1e-6 * jnp.eye(3)
    vector = jnp.einsum("ck,ckab,cb->ka", scale, across, origins - center, precision=EXACT)
    return jnp.linalg.solve(matrix, vector[..., None])[..., 0] + center


# Who is who
# --------------------------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class _SamePerson:
    """Limits that decide whether people in several views of one moment are one person."""

    agree: float = 0.06
    """Largest median distance between a person's landmarks in a view and the projected points of
    the same person, as a share of the person's size in the photo. A camera that is off by a degree
    contributes 0.02.
    """
    clearly: float = 0.5
    """If a view agrees without an exchange, its sides count as exchanged only if an exchange
    multiplies the distance (see `agree`) by less than this number.
    """
    rather: float = 0.8
    """If a view does not agree without an exchange, this number is used in place of `clearly`, and
    the view has to agree after the exchange.
    """
    seen: float = 0.3
    """A landmark is used if it has at least this visibility."""
    fewest: int = 6
    """Two views are compared if they share at least this many landmarks."""


_SAME_PERSON = _SamePerson()


@dataclasses.dataclass(frozen=True)
class _SameWay:
    """Limits that decide whether people in two successive frames are one person."""

    farthest: float = 1.0
    """Largest distance between a person's position in a frame and the last known position, metres.
    It is used if several views show the person.
    """
    near: float = 0.5
    """Largest movement of a person in one camera's photos, as a share of the person's size in the
    photo.
    """
    resized: float = 1.5
    """Largest ratio between a person's sizes in one camera's photos."""
    shorter: float = 0.3
    """People are linked only if every other choice makes the sum of movements longer by at least
    this, as a share of the largest allowed movement.
    """
    far: float = 3.0
    """Largest movement that is compared, as a multiple of the largest allowed movement. Longer and
    unknown movements are set to it.
    """
    still_degrees: float = 10.0
    """Two views count as one camera only if the rotation between them is at most this, degrees."""
    still_metres: float = 0.3
    """Two views count as one camera only if the distance between their centres is at most this,
    metres.
    """


_SAME_WAY = _SameWay()


class Seen(NamedTuple):
    """A view and the people that are seen in it."""

    K: Float[np.ndarray, "3 3"]
    """Intrinsics, (3, 3), pixels."""
    cam_from_world: Float[np.ndarray, "4 4"]
    """Camera pose, (4, 4), metres."""
    people: tuple[Float[np.ndarray, "k 3"], ...]
    """Landmarks of each person, (k, 3): pixels (x, y) and visibility."""


Key = tuple[int, int]
"""Indices of a view, and of a person in it."""


class Match(NamedTuple):
    """One person in several views."""

    members: tuple[int | None, ...]
    """Index of the person in each view. None where the view does not show the person."""
    mirrored: tuple[bool, ...]
    """Whether left and right are exchanged in each view, compared with most of the person's
    views.
    """
    error: float
    """Mean error of the views. The error of a view is the median distance between the person's
    landmarks and the projected points, as a share of the person's size. The two views that proposed
    the points count as one view, with the larger of their errors. The error is infinite for a
    person who is seen in one view.
    """
    center: Float[np.ndarray, "3"]
    """Median of the triangulated points, (3,), metres. NaN if there are no such points, as for a
    person who is seen in one view.
    """


def match_people(views: Sequence[Seen], mirror: Sequence[int]) -> list[Match]:
    """Returns a match for each person in the views of one moment.

    People who are seen in more views come first. People who are seen in a single view come last.

    Arguments: mirror: for each landmark the index of its mirror image, (k,).
    """
    # each pair of people in two views proposes points, as they are and with sides exchanged;
    # whoever agrees with these in other views joins
    flipped_order = np.asarray(mirror)
    left = {(v, p) for v, view in enumerate(views) for p in range(len(view.people))}
    groups = []
    for (v, p), (w, q) in itertools.combinations(sorted(left), 2):
        if v == w:
            continue
        first, second = views[v].people[p], views[w].people[q]
        trials = []
        for row in (second, second[flipped_order]):
            points, known = _triangulated(views, {v: first, w: row})
            error = max(_error(views[i], each, points, known) for i, each in ((v, first), (w, row)))
            trials.append((error, points, known))
        flipped = _is_exchanged(trials[0][0], trials[1][0])
        if trials[flipped][0] < _SAME_PERSON.agree:
            groups.append(
                _gathered(views, flipped_order, {(v, p): False, (w, q): flipped}, *trials[flipped])
            )
    matches = []
    # the group that most views agree with, and of these the one that agrees best
    for group, error in sorted(groups, key=lambda each: (-len(each[0]), each[1])):
        if all(key in left for key in group):
            left -= set(group)
            matches.append(_match(views, flipped_order, group, error))
    return matches + [
        _match(views, flipped_order, {key: False}, float("inf")) for key in sorted(left)
    ]


def _gathered(
    views: Sequence[Seen],
    mirror: Int[np.ndarray, " k"],
    pair: dict[Key, bool],
    error: float,
    points: Float[np.ndarray, "k 3"],
    known: Bool[np.ndarray, " k"],
) -> tuple[dict[Key, bool], float]:
    """Adds people of other views to a pair of people, if they agree with the pair's points. Returns
    the group, {(view, person): whether sides are exchanged}, and its mean error.

    error, points and known: error and triangulated points of the pair, and which points count.
    """
    group, errors = dict(pair), [error]
    for v in set(range(len(views))) - {v for v, _ in pair}:
        trials = []
        for p, row in enumerate(views[v].people):
            plain = _error(views[v], row, points, known)
            exchanged = _error(views[v], row[mirror], points, known)
            flipped = _is_exchanged(plain, exchanged)
            trials.append((exchanged if flipped else plain, (v, p), flipped))
        best = min(trials, default=None)
        if best is not None and best[0] < _SAME_PERSON.agree:
            error, key, flipped = best
            group[key] = flipped
            errors.append(error)
    return group, float(np.mean(errors))


def _is_exchanged(plain: float, exchanged: float) -> bool:
    """Returns whether sides are exchanged. plain and exchanged: errors without and with an
    exchange.

    If a person is small or thin, left and right hardly differ. Then nothing counts as exchanged.
    """
    most = (
        _SAME_PERSON.clearly * plain
        if plain < _SAME_PERSON.agree
        else min(_SAME_PERSON.agree, _SAME_PERSON.rather * plain)
    )
    return exchanged < most


def _match(
    views: Sequence[Seen], mirror: Int[np.ndarray, " k"], group: dict[Key, bool], error: float
) -> Match:
    members: list[int | None] = [None] * len(views)
    mirrored = [False] * len(views)
    for (v, p), flipped in group.items():
        members[v], mirrored[v] = p, flipped
    rows = {}
    for (v, p), flipped in group.items():
        row = views[v].people[p]
        rows[v] = row[mirror] if flipped else row
    center = np.full(3, np.nan)
    if len(rows) > 1:
        points, known = _triangulated(views, rows)
        center = np.median(points[known], axis=0) if known.any() else center
    if 2 * sum(mirrored) > len(group):  # the exchanged ones are the fewer
        mirrored = [
            member is not None and not flipped
            for member, flipped in zip(members, mirrored, strict=True)
        ]
    return Match(tuple(members), tuple(mirrored), error, center)


def _triangulated(
    views: Sequence[Seen], rows: dict[int, Float[np.ndarray, "k 3"]]
) -> tuple[Float[np.ndarray, "k 3"], Bool[np.ndarray, " k"]]:
    """Returns points triangulated by linear least squares, (k, 3), metres, and which of these
    landmarks all views see, (k,).
    """
    known = np.logical_and.reduce([row[:, 2] >= _SAME_PERSON.seen for row in rows.values()])
    equations = []
    for v, row in rows.items():
        xy = (row[:, :2] - views[v].K[:2, 2]) / np.diag(views[v].K)[:2]
        camera = views[v].cam_from_world[:3]
        equations += [xy[:, i, None] * camera[2] - camera[i] for i in range(2)]
    vectors = np.linalg.svd(np.stack(equations, axis=1))[2][:, -1]
    scale = np.where(np.abs(vectors[:, 3]) > 1e-12, vectors[:, 3], np.nan)
    points = vectors[:, :3] / scale[:, None]
    return points, known & np.isfinite(points).all(-1)


def _error(
    view: Seen,
    row: Float[np.ndarray, "k 3"],
    points: Float[np.ndarray, "k 3"],
    known: Bool[np.ndarray, " k"],
) -> float:
    """Returns the median distance between landmarks and projected points, divided by the person's
    size in the photo. It is infinite if the person is behind the camera, or if too few landmarks
    are shared.
    """
    seen = known & (row[:, 2] >= _SAME_PERSON.seen)
    if seen.sum() < _SAME_PERSON.fewest:
        return float("inf")
    local = points[seen] @ view.cam_from_world[:3, :3].T + view.cam_from_world[:3, 3]
    if np.median(local[:, 2]) <= 0:
        return float("inf")
    pixels = local @ view.K.T
    depths = np.where(local[:, 2:] > 0, local[:, 2:], np.nan)
    distances = np.linalg.norm(pixels[:, :2] / depths - row[seen, :2], axis=-1)
    size = np.ptp(row[row[:, 2] >= _SAME_PERSON.seen, :2], axis=0).max()
    return float(np.median(np.nan_to_num(distances, nan=np.inf))) / max(float(size), 1e-9)


def comparable(first: Float[np.ndarray, "k 3"], second: Float[np.ndarray, "k 3"]) -> bool:
    """Returns whether two views of a person share enough landmarks to be compared."""
    return (
        int(((first[:, 2] >= _SAME_PERSON.seen) & (second[:, 2] >= _SAME_PERSON.seen)).sum())
        >= _SAME_PERSON.fewest
    )


def in_order_of_time(
    frames: Sequence[list[Match]], shown: Sequence[Sequence[Seen]] | None = None
) -> list[list[Match | None]]:
    """Follows people over successive frames. Returns for each frame a list with one entry per
    person, in the same order in all frames. The entry is the person's match, or None if the frame
    does not show the person.

    People are linked so that the sum of all movements is smallest. Movements are first measured in
    space. People who are not linked by this are then compared in the photos of one camera. A person
    is not linked if another choice is nearly as short. A match that is linked to nobody becomes a
    new person, who may in truth be one of the others.

    Arguments: shown: the views of each frame. None: people are followed in space alone.
    """
    people: list[list[Match | None]] = []
    for f, matches in enumerate(frames):
        # people are linked by their positions in space first
        last = [max(g for g in range(f) if person[g] is not None) for person in people]
        centers = [_last_center(person) for person in people]
        ways = np.asarray(
            [[np.linalg.norm(match.center - center) for match in matches] for center in centers]
        )
        chosen = dict(
            _plainly_shortest(ways.reshape(len(people), len(matches)), _SAME_WAY.farthest)
        )
        if shown is not None:
            # those that are left are compared in the photos of one camera
            free = [j for j in range(len(people)) if j not in chosen]
            left = [i for i in range(len(matches)) if i not in chosen.values()]
            costs = np.full((len(free), len(left)), np.inf)
            for (row, j), (column, i) in itertools.product(enumerate(free), enumerate(left)):
                before = people[j][last[j]]
                assert before is not None
                costs[row, column] = _moved_in_photos(shown[last[j]], before, shown[f], matches[i])
            chosen |= {
                free[row]: left[column] for row, column in _plainly_shortest(costs, _SAME_WAY.near)
            }
        for j, person in enumerate(people):
            person.append(matches[chosen[j]] if j in chosen else None)
        # matches that continue nobody are new people
        new = [match for i, match in enumerate(matches) if i not in chosen.values()]
        people += [[*[None] * f, match] for match in new]
    return [[person[f] for person in people] for f in range(len(frames))]


def _last_center(person: Sequence[Match | None]) -> Float[np.ndarray, "3"]:
    """Returns the last known position of a person, (3,), metres. NaN if there is none. Only matches
    of several views have a position.
    """
    centers = [
        match.center for match in person if match is not None and np.isfinite(match.center).all()
    ]
    return centers[-1] if centers else np.full(3, np.nan)


def _plainly_shortest(ways: Float[np.ndarray, "n m"], longest: float) -> list[tuple[int, int]]:
    """Returns pairs (person, match) with the smallest sum of movements. A pair is left out if
    another choice is nearly as short. ways: movement of each person to each match, (n, m). longest:
    largest allowed movement.
    """
    # longer ways, and those that are not known, are all as unlikely
    ways = np.fmin(ways, _SAME_WAY.far * longest)
    rows, columns = linear_sum_assignment(ways)
    pairs = list(zip(rows.tolist(), columns.tolist(), strict=True))
    without_match = sorted(set(range(len(ways))) - set(rows.tolist()))
    of_nobody = sorted(set(range(ways.shape[1])) - set(columns.tolist()))
    chosen = []
    for j, i in pairs:
        # how much longer the ways are if another pair exchanges its matches with this one
        longer = [ways[j, k] + ways[m, i] - ways[j, i] - ways[m, k] for m, k in pairs if m != j]
        # whoever has no match now, or is nobody's match, could have this one
        longer += [ways[m, i] - ways[j, i] for m in without_match]
        longer += [ways[j, k] - ways[j, i] for k in of_nobody]
        if ways[j, i] < longest and min(longer, default=np.inf) >= _SAME_WAY.shorter * longest:
            chosen.append((j, i))
    return chosen


def _moved_in_photos(
    before: Sequence[Seen], first: Match, now: Sequence[Seen], second: Match
) -> float:
    """Returns how far a person would have moved if two matches were the same person, as a share of
    the person's size. It is the largest movement in the photos of any camera that shows both
    matches. It is infinite if no camera shows both, or if the size changed too much in the photos
    of a camera.
    """
    moved = []
    for v, w in itertools.product(range(len(before)), range(len(now))):
        p, q = first.members[v], second.members[w]
        if p is None or q is None or not _stands_still(before[v], now[w]):
            continue
        place, size = _box(before[v].people[p])
        other, other_size = _box(now[w].people[q])
        larger, smaller = max(size, other_size), min(size, other_size)
        if larger > _SAME_WAY.resized * smaller:
            moved.append(float("inf"))
        else:
            moved.append(float(np.linalg.norm(other - place)) / max(larger, 1e-9))
    return max(moved, default=float("inf"))


def _stands_still(before: Seen, now: Seen) -> bool:
    """Returns whether two views can be of one camera that hardly moved."""
    first, second = before.cam_from_world[:3], now.cam_from_world[:3]
    turn = first[:, :3] @ second[:, :3].T
    degrees = np.rad2deg(np.arccos(np.clip((np.trace(turn) - 1) / 2, -1, 1)))
    way = first[:, :3].T @ first[:, 3] - second[:, :3].T @ second[:, 3]
    return bool(
        degrees <= _SAME_WAY.still_degrees and np.linalg.norm(way) <= _SAME_WAY.still_metres
    )


def _box(row: Float[np.ndarray, "k 3"]) -> tuple[Float[np.ndarray, "2"], float]:
    """Returns the median of the visible landmarks, (2,), pixels, and the longer side of their
    bounding box, pixels. If none is visible, all landmarks are used.
    """
    seen = row[row[:, 2] >= _SAME_PERSON.seen, :2]
    seen = seen if len(seen) else row[:, :2]
    return np.median(seen, axis=0), float(np.ptp(seen, axis=0).max())
