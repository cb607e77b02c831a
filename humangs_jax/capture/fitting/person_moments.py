"""Decides from a person's landmarks whether photos show one moment, and finds the cameras of this
moment.

A detector that takes a person's back for the front exchanges left and right in a whole view. So
each view is mirrored on trial, and is left mirrored if it then agrees clearly better with the other
views. The body shows whether all views are mirrored: toes and nose point to the front.

A trial is an adjustment of the cameras with some views mirrored. Trials are only as exact as a
comparison needs. The chosen trial is then made as exact as possible.
"""

import dataclasses
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from humangs_jax.capture.fitting.person_bundle import (
    COARSE,
    EXACT,
    ROBUST_SCALES,
    Evidence,
    Rig,
    adjust,
    align_views,
    pixel_errors,
    place_person,
)
from humangs_jax.capture.fitting.residuals.keypoints import NOISE, OUTER, in_camera_axes
from humangs_jax.capture.keypoints.keypoints import mirrored_name
from humangs_jax.core.array_types import Bool, Float, Int
from humangs_jax.core.progress import bar, watched
from humangs_jax.io.images import DIAGONAL_35MM

USUAL_FOCAL = 29.0
"""Focal length of a telephone's main camera, as the equivalent for 35-mm film, mm. It is assumed if
no photo states a focal length.
"""
USUAL_STD = 0.2
"""Standard deviation of the logarithm of a focal length that is assumed and not known."""
_EXIF_STD = 0.03
"""Standard deviation of the logarithm of a focal length from EXIF."""
SEEN = 0.1
"""A landmark is used if its visibility exceeds this number."""
FEWEST = 6
"""Smallest number of usable landmarks that a photo has to show."""
SMALLEST = 16.0
"""Smallest size of a person in a photo, pixels. A smaller person is little more than a point."""


@dataclasses.dataclass(frozen=True)
class _OneMoment:
    """Limits that decide whether photos show one moment. Errors are distances between projected and
    detected landmarks, as shares of the person's size in the photo.
    """

    most_error: float = 0.02
    """Largest rms error of photos that show one moment.

    Rms errors were measured on photos of a man in a laboratory. For each of 7 moments, seen by four
    cameras, they were 0.007 to 0.014. For photos of several moments they were 0.045 to 0.073. For
    four photos, of which one showed another moment, the rms error was 0.033.
    """
    doubtful: float = 0.012
    """If the rms error exceeds this, the search for mirrored views is repeated from another start,
    in which all views are mirrored. If detections of one moment are off by 3 pixels for a person of
    900 pixels, the rms error is 0.004 to 0.007. With one mirrored view it is at least 0.02.
    """
    without_one: float = 0.015
    """If one photo is left out, the other photos show one moment only if their rms error is below
    this. If four photos show several moments, three of them have an rms error of at least 0.021.
    """
    fewest: int = 4
    """With at least this many photos, one photo may be left out because it contradicts the
    others.
    """
    other: float = 0.03
    """A further photo shows the same moment if its rms error is below this."""
    deciding: int = 8
    """Largest number of photos that decide whether there is one moment. Further photos are only
    compared with the result.
    """
    mirrored: float = 0.7
    """A view counts as mirrored only if mirroring it multiplies the cost by less than this
    number.
    """
    least_angle: float = 4.0
    """Each photo counts as a moment if all of them see the person from directions that differ by
    less than this angle, degrees.
    """
    far: float = 0.2
    """Errors of a landmark that are larger than this count as this error."""


ONE_MOMENT = _OneMoment()


_BONES = (("shoulder", "elbow"), ("elbow", "wrist"), ("hip", "knee"), ("knee", "ankle"))
"""Ends of the bones that have equal lengths on the left and on the right."""


@dataclasses.dataclass(frozen=True, eq=False)
class PersonViews:
    """Landmarks of one person that a detector found in c photos."""

    points: Float[np.ndarray, "c k 2"]
    """Detected landmarks, (c, k, 2), pixels, with the centre of the first pixel at (0.5, 0.5)."""
    visibility: Float[np.ndarray, "c k"]
    """Visibility of the landmarks, (c, k), in [0, 1]. 0 where a landmark is not seen."""
    world: Float[np.ndarray, "c k 3"]
    """3D landmarks relative to the middle of the hips, (c, k, 3), metres. Axes are the camera's (x
    right, y down, z away), as if the camera looked straight at the person.
    """
    names: tuple[str, ...]
    """Names of the landmarks, see `KeypointSet`."""
    sizes: tuple[tuple[int, int], ...]
    """Width and height of each photo, pixels."""
    focal: Float[np.ndarray, " c"]
    """Focal lengths, (c,), pixels. NaN where unknown."""
    photos: tuple[str, ...]
    """Names of the photos."""

    def select(self, views: Sequence[int]) -> "PersonViews":
        """Returns the landmarks of some photos, in the order of `views`."""
        rows = list(views)
        return dataclasses.replace(
            self,
            points=self.points[rows],
            visibility=self.visibility[rows],
            world=self.world[rows],
            sizes=tuple(self.sizes[view] for view in rows),
            focal=self.focal[rows],
            photos=tuple(self.photos[view] for view in rows),
        )


def known_landmarks(seen: PersonViews) -> Bool[np.ndarray, "c k"]:
    """Returns which landmarks are visible and have finite coordinates, (c, k)."""
    finite = np.isfinite(seen.points).all(-1) & np.isfinite(seen.world).all(-1)
    return finite & (np.nan_to_num(seen.visibility) > SEEN)


def cleaned(seen: PersonViews) -> PersonViews:
    """Returns the views with zeros in place of all landmarks that are not known."""
    known = known_landmarks(seen)
    return dataclasses.replace(
        seen,
        points=np.where(known[..., None], seen.points, 0.0),
        visibility=np.where(known, seen.visibility, 0.0),
        world=np.where(known[..., None], seen.world, 0.0),
    )


# What explains the photos
# --------------------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True, eq=False)
class Trial:
    """Cameras that were fitted with left and right exchanged in some photos."""

    mirrored: Bool[np.ndarray, " c"]
    """Whether left and right are exchanged in each view, (c,)."""
    rig: Rig
    """The cameras, and the person's landmarks."""
    cost: float
    """Half the sum of the squared residuals of the adjustment."""
    evidence: Evidence
    """The landmarks of the photos, with left and right exchanged in the mirrored views."""

    @property
    def error(self) -> float:
        """Rms distance between projected and detected landmarks in all photos, as a share of the
        person's size, corrected for the number of unknowns. See `_relative_error`.
        """
        return _relative_error(self._shares, self.evidence.weights)

    def of_view(self, view: int) -> float:
        """Returns the rms distance between projected and detected landmarks in one photo, as a
        share of the person's size in the photo.
        """
        seen = self.evidence.weights[view] > SEEN
        return float(np.sqrt(np.mean(np.minimum(self._shares[view][seen], ONE_MOMENT.far) ** 2)))

    @property
    def _shares(self) -> Float[np.ndarray, "c k"]:
        return self.pixels * (NOISE / self.evidence.noise)[:, None]

    @property
    def pixels(self) -> Float[np.ndarray, "c k"]:
        """Distances between projected and detected landmarks, (c, k), pixels."""
        return np.linalg.norm(pixel_errors(self.evidence, self.rig), axis=-1)


@dataclasses.dataclass(frozen=True, eq=False)
class Explanation:
    """Result of `explain`: cameras of one moment, if there are such cameras."""

    trial: Trial | None
    """Cameras of `views`. None: each photo counts as a moment, see `explain`."""
    views: tuple[int, ...]
    """Indices of the photos that the trial explains: all photos, or all except one. Without a trial
    they are all photos.
    """
    warnings: tuple[str, ...] = ()
    """Warnings about this explanation, one line each."""


def explain(seen: PersonViews) -> Explanation:
    """Returns cameras with which one person in one pose explains all photos, or all except one.

    If there are no such cameras, or if several photos are all from nearly the same direction, the
    explanation has no trial. Each photo then counts as a moment.
    """
    every = tuple(range(len(seen.photos)))

    # a few photos decide
    chosen = _different(seen)
    trial, views = best_trial(seen.select(chosen)), chosen
    if trial.error > ONE_MOMENT.most_error and len(chosen) >= ONE_MOMENT.fewest:
        trial, views = _without_one(seen, chosen) or (trial, chosen)
    if trial.error > ONE_MOMENT.most_error:
        return Explanation(None, every)

    # the others have to agree, but for one
    if len(chosen) < len(every):
        trial, views = _with_others(
            seen, trial, views, [view for view in every if view not in chosen]
        )
    if len(views) < len(every) - 1 or trial.error > ONE_MOMENT.most_error:
        return Explanation(None, every)

    # from one side the landmarks of one photo decide nothing about the others
    angle = _angle(trial.rig)
    if len(every) > 1 and angle < ONE_MOMENT.least_angle:
        which = ", ".join(seen.photos[view] for view in views)
        if len(views) == len(every):
            which = "all photos"
        side = (
            f"{which} are from one side (directions differ by {angle:.1f} degrees, expected"
            f" {ONE_MOMENT.least_angle:.0f} or more)"
        )
        return Explanation(None, every, (f"{side}: each photo counts as a moment",))

    out = [seen.photos[view] for view in every if view not in views]
    left = "left out: it shows another moment than the others, or was not understood"
    return Explanation(trial, views, tuple(f"{photo}: {left}" for photo in out))


def _without_one(
    seen: PersonViews, chosen: tuple[int, ...]
) -> tuple[Trial, tuple[int, ...]] | None:
    """Leaves out the one of the chosen photos that contradicts the others most. Returns the trial
    of the other photos, and the indices of these photos. The result is None if the other photos do
    not show one moment either.
    """
    rests = [tuple(v for v in chosen if v != out) for out in chosen]
    trials = [
        _try(seen.select(rest), np.zeros(len(rest), bool))
        for rest in under_bar(rests, "cameras without one photo")
    ]
    best = int(np.argmin([trial.error for trial in trials]))
    if trials[best].error >= ONE_MOMENT.without_one:
        return None
    found = best_trial(seen.select(rests[best]))
    return (found, rests[best]) if found.error <= ONE_MOMENT.most_error else None


def _with_others(
    seen: PersonViews, trial: Trial, views: tuple[int, ...], others: Sequence[int]
) -> tuple[Trial, tuple[int, ...]]:
    """Adds those of the photos `others` that agree with the trial, as they are or mirrored.

    Returns a trial in which the cameras of `views` and of the added photos are fitted together, and
    the indices of all these photos.
    """
    mirrored = dict(zip(views, trial.mirrored, strict=True))
    for view in under_bar(others, "cameras of further photos"):
        pair = seen.select([*views, view])
        tries = [_try(pair, np.append(trial.mirrored, flip)) for flip in (False, True)]
        best = min(tries, key=lambda each: each.cost)
        if best.of_view(-1) < ONE_MOMENT.other:
            mirrored[view] = bool(best.mirrored[-1])
    used = tuple(sorted(mirrored))
    return _polished(_try(seen.select(used), np.asarray([mirrored[view] for view in used]))), used


def _different(seen: PersonViews) -> tuple[int, ...]:
    """Returns the indices of the photos that decide whether there is one moment. They show the
    person from different sides.

    The photo that shows most of the person is chosen first. Each next photo is the one with the
    direction that differs most from the directions of all chosen photos.
    """
    count = len(seen.photos)
    if count <= ONE_MOMENT.deciding:
        return tuple(range(count))
    _, start = evidence_of(seen, np.zeros(count, bool))
    towards = _directions(start)
    chosen = [int(np.argmax(seen.visibility.sum(1)))]
    while len(chosen) < ONE_MOMENT.deciding:
        nearest = np.max(towards @ towards[chosen].T, axis=1)
        nearest[chosen] = np.inf
        chosen.append(int(np.argmin(nearest)))
    return tuple(sorted(chosen))


def under_bar(items: Sequence[Any], what: str) -> Iterator[Any]:
    """Yields the items. A progress bar is shown if there are several items and progress is being
    displayed.
    """
    yield from bar(items, desc=what, leave=False, shown=watched() and len(items) > 1)


# Trials
# --------------------------------------------------------------------------------------------------


def best_trial(seen: PersonViews) -> Trial:
    """Returns the trial that explains the landmarks best. If there are several views, any of them
    may be mirrored in it.
    """
    views = len(seen.points)
    found = _try(seen, np.zeros(views, bool))
    if views > 1:
        found = _least(seen, found)
        if found.error > ONE_MOMENT.doubtful:
            other = _least(seen, _try(seen, np.ones(views, bool)))
            found = min(found, other, key=lambda each: each.cost)
        shown = np.any(known_landmarks(seen), axis=0)
        if handedness(*only_known(found.rig.landmarks, seen.names, shown)) < 0:
            found = _try(seen, ~found.mirrored)
    return _polished(found)


def _least(seen: PersonViews, start: Trial) -> Trial:
    """Mirrors one view after the other, as long as the cost decreases clearly. Each time it mirrors
    the view that decreases the cost most. Returns the trial after the last clear decrease, or the
    start if there was none.
    """
    views = np.arange(len(seen.points))
    while True:
        flips = [start.mirrored ^ (views == v) for v in views]
        trials = [_try(seen, flip) for flip in under_bar(flips, "cameras with a view mirrored")]
        best = min(trials, key=lambda each: each.cost)
        if not best.cost < ONE_MOMENT.mirrored * start.cost:
            return start
        start = best


def _try(seen: PersonViews, mirrored: Bool[np.ndarray, " c"]) -> Trial:
    """Returns the trial with these views mirrored. Its cameras are fitted only as exactly as a
    comparison of trials needs.
    """
    evidence, start = evidence_of(seen, mirrored)
    return Trial(mirrored, *adjust(evidence, start, COARSE), evidence)


def _polished(trial: Trial) -> Trial:
    """Returns the trial with cameras that are fitted again, as exactly as possible."""
    rig, cost = adjust(trial.evidence, trial.rig, EXACT, ROBUST_SCALES[-1:])
    return dataclasses.replace(trial, rig=rig, cost=cost)


def _relative_error(errors: Float[np.ndarray, "c k"], weights: Float[np.ndarray, "c k"]) -> float:
    """Returns the rms error of the landmarks that are seen. errors: shares of the person's size,
    (c, k). Errors that exceed `_OneMoment.far` count as that error.

    The sum of squares is divided by n - u, or by n / 4 if that is larger. Here n is the number of
    observed coordinates, and u the number of unknowns of points and cameras up to a similarity.
    """
    views, shown = len(errors), weights.max(0) > SEEN
    numbers = 2 * (weights > SEEN).sum()
    left = max(numbers - 3 * shown.sum() - 6 * views + 7, numbers / 4)
    # as many far outliers as a detector has count no more than near ones
    near = np.minimum(errors, ONE_MOMENT.far)
    return float(np.sqrt(np.sum((weights > SEEN) * near**2) / left))


def _angle(rig: Rig) -> float:
    """Returns the largest angle between the directions from which two photos see the person,
    degrees.
    """
    towards = _directions(rig)
    return float(np.rad2deg(np.arccos(np.clip(towards @ towards.T, -1, 1))).max())


def _directions(rig: Rig) -> Float[np.ndarray, "c 3"]:
    """Returns unit vectors from the person towards the cameras, (c, 3)."""
    places = rig.places / np.linalg.norm(rig.places, axis=1, keepdims=True)
    return -np.einsum("cba,cb->ca", rig.rotations, places)


# Evidence
# --------------------------------------------------------------------------------------------------


def _focal_lengths(
    seen: PersonViews,
) -> tuple[Float[np.ndarray, " c"], Float[np.ndarray, " c"], Int[np.ndarray, " c"]]:
    """Returns focal lengths, (c,), pixels, standard deviations of their logarithms, (c,), and kinds
    of cameras, (c,).

    If a photo states no focal length, it gets the median of the others, relative to the diagonal of
    the photo. If no photo states any, the usual one is assumed.

    All cameras with a focal length from EXIF are of one kind. Photos without a focal length that
    have the same size are assumed to be from one camera, and form another kind.
    """
    diagonals = np.hypot(*np.asarray(seen.sizes, float).T)
    known = np.isfinite(seen.focal)
    usual = USUAL_FOCAL / DIAGONAL_35MM
    if known.any():
        usual = np.median((seen.focal / diagonals)[known])
    std = np.where(known, _EXIF_STD, USUAL_STD)
    cameras = [
        () if own else tuple(sorted(size)) for own, size in zip(known, seen.sizes, strict=True)
    ]
    kinds = np.asarray([sorted(set(cameras)).index(own) for own in cameras])
    return np.where(known, seen.focal, usual * diagonals), std, kinds


def evidence_of(seen: PersonViews, mirrored: Bool[np.ndarray, " c"]) -> tuple[Evidence, Rig]:
    """Returns the landmarks, with left and right exchanged in the mirrored views, and cameras to
    start from.
    """
    seen = _unmirrored(seen, mirrored)
    points, weights = seen.points - np.asarray(seen.sizes)[:, None] / 2, seen.visibility
    focal, focal_std, kinds = _focal_lengths(seen)
    evidence = Evidence(
        points=points,
        weights=weights,
        noise=_noise(points, weights),
        world=_centred_world(seen, points, focal),
        focal=focal,
        focal_std=focal_std,
        kinds=kinds,
        bones=_bones(seen.names),
    )
    return evidence, _first_rig(evidence)


def _unmirrored(seen: PersonViews, mirrored: Bool[np.ndarray, " c"]) -> PersonViews:
    """Returns the views with left and right exchanged in the mirrored ones.

    A detector that takes the back for the front may also see the body turned round. If the
    exchanged 3D landmarks show a mirrored body, their depths are negated.
    """
    mirror = [seen.names.index(mirrored_name(name)) for name in seen.names]
    order = np.where(mirrored[:, None], mirror, np.arange(len(mirror)))
    views = np.arange(len(order))[:, None]
    visibility, world = seen.visibility[views, order], seen.world[views, order]
    for view in np.flatnonzero(mirrored):
        known = visibility[view] > SEEN
        if handedness(*only_known(world[view], seen.names, known)) < 0:
            world[view, :, 2] *= -1
    points = seen.points[views, order]
    return dataclasses.replace(seen, points=points, visibility=visibility, world=world)


def _noise(
    points: Float[np.ndarray, "c k 2"], weights: Float[np.ndarray, "c k"]
) -> Float[np.ndarray, " c"]:
    """Returns the standard deviation of the detections in each view, (c,), pixels. It is
    proportional to the person's size in the photo.
    """
    sizes = []
    for own, weight in zip(points, weights, strict=True):
        low, high = np.quantile(own[weight > 0], OUTER, axis=0)
        sizes.append((high - low).max())
    return NOISE * np.asarray(sizes)


def _centred_world(
    seen: PersonViews, points: Float[np.ndarray, "c k 2"], focal: Float[np.ndarray, " c"]
) -> Float[np.ndarray, "c k 3"]:
    """Returns the detector's 3D landmarks in the axes of each camera, (c, k, 3), metres. They are
    relative to their weighted mean, and have one size in all views.

    points: (c, k, 2), pixels from the principal point. focal: (c,), pixels.
    """
    weights = seen.visibility
    # the ray to the person goes through the hips, or through all landmarks if a hip is not seen
    hips = np.asarray([name in ("left_hip", "right_hip") for name in seen.names])
    both_hips = weights.all(1, where=hips, keepdims=True)
    middle_weights = np.where(both_hips, weights * hips, weights)
    K = focal[:, None, None] * np.diag([1, 1, 0]) + np.diag([0, 0, 1])
    world = in_camera_axes(seen.world, points, middle_weights, K)
    # the mean moves to the origin
    total = weights.sum(1)
    world = world - ((weights[..., None] * world).sum(1) / total[:, None])[:, None]
    # all views get the median size
    radii = np.sqrt((weights[..., None] * world**2).sum((1, 2)) / total)
    return world * (np.median(radii) / radii)[:, None, None]


def _first_rig(evidence: Evidence) -> Rig:
    """Returns cameras to start from, and the mean landmarks. The views are turned onto each other,
    and each camera is placed so that the landmarks project to their pixels.
    """
    landmarks, rotations = align_views(evidence.world, evidence.weights)
    offsets = np.einsum("cab,kb->cka", rotations, landmarks)
    views = zip(evidence.points, evidence.weights, offsets, evidence.focal, strict=True)
    places = np.stack([place_person(*view) for view in views])
    return Rig(landmarks, rotations, places, evidence.focal)


def _bones(names: Sequence[str]) -> Int[np.ndarray, "b 2 2"]:
    rows = []
    for a, b in _BONES:
        ends = [[f"{side}_{a}", f"{side}_{b}"] for side in ("left", "right")]
        if all(name in names for side in ends for name in side):
            rows.append([[names.index(name) for name in side] for side in ends])
    return np.asarray(rows, int).reshape(-1, 2, 2)


# The body
# --------------------------------------------------------------------------------------------------


def middle_of(
    points: Float[np.ndarray, "k 3"], names: Sequence[str], part: str
) -> Float[np.ndarray, "3"]:
    """Returns the middle between the left and the right landmark of a part, such as "hip", (3,). If
    only one of them is among the names, it returns this landmark. NaN if neither is among the
    names.
    """
    sides = [f"{side}_{part}" for side in ("left", "right") if f"{side}_{part}" in names]
    found = [points[names.index(name)] for name in sides]
    return np.mean(found, axis=0) if found else np.full(3, np.nan)


def only_known(
    points: Float[np.ndarray, "k 3"], names: Sequence[str], known: Bool[np.ndarray, " k"]
) -> tuple[Float[np.ndarray, "n 3"], tuple[str, ...]]:
    """Returns the known landmarks, (n, 3), and their names. The positions of other landmarks are
    meaningless.
    """
    kept = np.flatnonzero(known)
    return points[kept], tuple(names[i] for i in kept)


def _front(points: Float[np.ndarray, "k 3"], names: Sequence[str]) -> Float[np.ndarray, "3"]:
    """Returns a vector to the person's front, (3,). It is the sum of vectors from heels to toes and
    from the ears to the nose, and not a unit vector. It is 0 if the landmarks for it are missing.
    """
    ends = [
        (f"{side}_{toe}", f"{side}_heel")
        for toe in ("foot_index", "big_toe")
        for side in ("left", "right")
    ]
    found = [
        points[names.index(a)] - points[names.index(b)]
        for a, b in ends
        if a in names and b in names
    ]
    if {"nose", "left_ear", "right_ear"} <= set(names):
        found.append(points[names.index("nose")] - middle_of(points, names, "ear"))
    return np.sum(found, axis=0) if found else np.zeros(3)


def across(points: Float[np.ndarray, "k 3"], names: Sequence[str]) -> Float[np.ndarray, "3"]:
    """Returns a vector from the right to the left side of the trunk, (3,). It is the sum for
    shoulders and hips, as far as both of their sides are among the names.
    """
    total = np.zeros(3)
    for part in ("shoulder", "hip"):
        left, right = f"left_{part}", f"right_{part}"
        if left in names and right in names:
            total += points[names.index(left)] - points[names.index(right)]
    return total


def handedness(points: Float[np.ndarray, "k 3"], names: Sequence[str]) -> float:
    """Returns a number that is positive if the landmarks named left are on the left side of a
    person who looks to the front, and negative if they are on the right side. 0 if landmarks are
    missing that show this.
    """
    up = middle_of(points, names, "shoulder") - middle_of(points, names, "hip")
    if np.isnan(up).any():
        return 0.0
    return float(np.linalg.det(np.stack([across(points, names), up, _front(points, names)])))
