"""Decides from a person's landmarks if photos are of one moment, and finds the cameras of that
moment.

A detector that takes a back for a front exchanges left and right in a whole view. So each view is
mirrored on trial, and the other views decide. Whether all views are mirrored is decided by the
body, whose toes and nose are in front.

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
"""Focal length of a telephone's main camera, mm, as 35-mm equivalent."""
USUAL_STD = 0.2
"""Standard deviation of the logarithm of a focal length that is only assumed."""
_EXIF_STD = 0.03
"""Standard deviation of the logarithm of a focal length from EXIF."""
SEEN = 0.1
"""Least visibility of a landmark that is used."""
FEWEST = 6
"""Least number of landmarks that are used in a photo."""
SMALLEST = 16.0
"""Least size of a person in a photo, pixels. A smaller person is only a point."""


@dataclasses.dataclass(frozen=True)
class _OneMoment:
    """Limits that decide if photos are of one moment. Distances are shares of the person's size in
    the photo.
    """

    most_error: float = 0.02
    """Largest rms distance of the landmarks from the person's points in photos of one moment.
    Measured on a man in a laboratory: 7 moments with four cameras each had 0.007 to 0.014, photos
    of several moments 0.045 to 0.073, and four photos with one of another moment 0.033.
    """
    doubtful: float = 0.012
    """Rms distance above which mirrorings are also tried from the other end, with all views
    mirrored. Detections of one moment with an error of 3 pixels of 900 have 0.004 to 0.007, a
    mirrored view 0.02 and more.
    """
    without_one: float = 0.015
    """Largest rms distance when one photo is left out, for the others to be of one moment. Three of
    four photos of several moments have 0.021 or more.
    """
    fewest: int = 4
    """Least number of photos of which one may be left out because it contradicts the others."""
    other: float = 0.03
    """Largest rms distance of the landmarks in one further photo. A photo with more shows another
    moment.
    """
    deciding: int = 8
    """Largest number of photos that decide between one moment and several. Further photos are
    compared with their result.
    """
    mirrored: float = 0.7
    """Largest ratio of the costs with and without a view mirrored, for the view to count as
    mirrored.
    """
    least_angle: float = 4.0
    """Least angle between the two directions that differ most, from which photos see the person,
    degrees. If the angle is smaller, each photo is taken alone.
    """
    far: float = 0.2
    """Largest error that counts. Larger errors count as this one."""


ONE_MOMENT = _OneMoment()


_BONES = (("shoulder", "elbow"), ("elbow", "wrist"), ("hip", "knee"), ("knee", "ankle"))
"""Ends of the bones that have one length on the left and on the right."""


@dataclasses.dataclass(frozen=True, eq=False)
class PersonViews:
    """Landmarks that a detector sees of one person in c photos."""

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
        """Returns some of the photos, in this order."""
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
    """Half the square sum of the adjustment's residuals."""
    evidence: Evidence
    """The landmarks of the photos, with left and right exchanged."""

    @property
    def error(self) -> float:
        """Rms distance of the landmarks from their pixels, a share of the person's size, see
        `_relative_error`.
        """
        return _relative_error(self._shares, self.evidence.weights)

    def of_view(self, view: int) -> float:
        """Returns the rms distance of the landmarks in one photo, a share of the person's size in
        it.
        """
        seen = self.evidence.weights[view] > SEEN
        return float(np.sqrt(np.mean(np.minimum(self._shares[view][seen], ONE_MOMENT.far) ** 2)))

    @property
    def _shares(self) -> Float[np.ndarray, "c k"]:
        return self.pixels * (NOISE / self.evidence.noise)[:, None]

    @property
    def pixels(self) -> Float[np.ndarray, "c k"]:
        """Distances of landmarks from their pixels, (c, k), pixels."""
        return np.linalg.norm(pixel_errors(self.evidence, self.rig), axis=-1)


@dataclasses.dataclass(frozen=True, eq=False)
class Explanation:
    """The answer of `explain`: cameras of one moment, or none."""

    trial: Trial | None
    """Cameras of `views`. None: no cameras explain several photos of one moment."""
    views: tuple[int, ...]
    """Indices of the photos that the trial explains. These are all, or all but one."""
    warnings: tuple[str, ...] = ()
    """Warnings about this explanation, one line each."""


def explain(seen: PersonViews) -> Explanation:
    """Returns the cameras that explain all photos, or all but one, by one person in one pose. If
    there are no such cameras, the explanation has no trial, and each photo counts as a moment.
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
    """Returns the trial of the chosen photos without the one that contradicts the others most, and
    the photos that are left. None if these are not of one moment either.
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
    """Adds each of the other photos that agrees with the trial, mirrored or not.

    Returns a trial of the cameras of these photos and `views`, fitted together, and the photos.
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
    """Chooses the photos that decide, so that they show the person from different sides.

    Each next photo is the one whose direction is farthest from those of all chosen before.
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
    """Yields the items under a progress bar, if there are several and a program shows one."""
    yield from bar(items, desc=what, leave=False, shown=watched() and len(items) > 1)


# Trials
# --------------------------------------------------------------------------------------------------


def best_trial(seen: PersonViews) -> Trial:
    """Returns the trial that explains the landmarks best, whichever views are mirrored."""
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
    """Mirrors the view that decreases the cost most, again and again, as long as the cost decreases
    clearly. Returns the last trial.
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
    """Fits the cameras for a trial, as exactly as a comparison of trials needs."""
    evidence, start = evidence_of(seen, mirrored)
    return Trial(mirrored, *adjust(evidence, start, COARSE), evidence)


def _polished(trial: Trial) -> Trial:
    """Fits the cameras of a trial again, as exactly as possible."""
    rig, cost = adjust(trial.evidence, trial.rig, EXACT, ROBUST_SCALES[-1:])
    return dataclasses.replace(trial, rig=rig, cost=cost)


def _relative_error(errors: Float[np.ndarray, "c k"], weights: Float[np.ndarray, "c k"]) -> float:
    """Returns the rms of the errors, (c, k), of landmarks that are seen. The divisor is the number
    of degrees of freedom that are left after points and cameras were fitted.
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
    of cameras, (c,). Photos without a focal length get the median of the others, relative to the
    diagonal, or else the usual one.

    All focal lengths from EXIF are of one kind. Photos of one size without EXIF are taken to be
    from one camera, which is another kind.
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
    """Returns the landmarks with left and right exchanged in some views, and cameras to start
    from.
    """
    # the landmarks of mirrored views, in the order of their mirror images
    focal, std, kinds = _focal_lengths(seen)
    mirror = [seen.names.index(mirrored_name(name)) for name in seen.names]
    order = np.where(mirrored[:, None], mirror, np.arange(len(mirror)))

    def pick(values: np.ndarray) -> np.ndarray:
        """Returns values (c, k, ...) with the landmarks of mirrored views exchanged."""
        at = order.reshape(*order.shape, *[1] * (values.ndim - 2))
        return np.take_along_axis(values, at, axis=1)

    points, weights = pick(seen.points - np.asarray(seen.sizes)[:, None] / 2), pick(seen.visibility)
    world = pick(seen.world)
    for own, shown, flipped in zip(world, weights > SEEN, mirrored, strict=True):
        # the detector saw the body turned round as well
        if flipped and handedness(*only_known(own, seen.names, shown)) < 0:
            own[:, 2] *= -1
    # 3D landmarks in the axes of their camera, centred, and of one size in all views
    K = focal[:, None, None] * np.diag([1, 1, 0]) + np.diag([0, 0, 1])
    hips = np.asarray([name in ("left_hip", "right_hip") for name in seen.names])
    both_hips = (weights * hips).all(1, where=hips, keepdims=True)
    middle = np.where(both_hips, weights * hips, weights)
    world = in_camera_axes(world, points, middle, K)
    means = (weights[..., None] * world).sum(1) / weights.sum(1)[:, None]
    world = world - means[:, None]
    radii = np.sqrt((weights[..., None] * world**2).sum((1, 2)) / weights.sum(1))
    world *= (np.median(radii) / radii)[:, None, None]
    # cameras to start from: the views turned together, each placed where its pixels are
    shape, rotations = align_views(world, weights)
    sizes = [
        float(np.ptp(np.quantile(p[w > 0], OUTER, axis=0), axis=0).max())
        for p, w in zip(points, weights, strict=True)
    ]
    noise = NOISE * np.asarray(sizes)
    offsets = np.einsum("cab,kb->cka", rotations, shape)
    places = np.stack(
        [place_person(*own) for own in zip(points, weights, offsets, focal, strict=True)]
    )
    evidence = Evidence(points, weights, noise, world, focal, std, kinds, _bones(seen.names))
    return evidence, Rig(shape, rotations, places, focal)


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
    """Returns the middle of the left and the right landmark of a part, (3,). If only one is among
    the names, returns that one. NaN if neither is.
    """
    sides = [f"{side}_{part}" for side in ("left", "right") if f"{side}_{part}" in names]
    found = [points[names.index(name)] for name in sides]
    return np.mean(found, axis=0) if found else np.full(3, np.nan)


def only_known(
    points: Float[np.ndarray, "k 3"], names: Sequence[str], known: Bool[np.ndarray, " k"]
) -> tuple[Float[np.ndarray, "n 3"], tuple[str, ...]]:
    """Returns the known landmarks, (n, 3), and their names. Positions of the others mean
    nothing.
    """
    kept = np.flatnonzero(known)
    return points[kept], tuple(names[i] for i in kept)


def _front(points: Float[np.ndarray, "k 3"], names: Sequence[str]) -> Float[np.ndarray, "3"]:
    """Returns the direction to the person's front, (3,), by toes and nose. It is not a unit vector,
    and 0 if the names do not have these.
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
    """Returns the vector from the right side of the trunk to the left, (3,). It uses shoulders and
    hips if both sides are among the names.
    """
    total = np.zeros(3)
    for part in ("shoulder", "hip"):
        left, right = f"left_{part}", f"right_{part}"
        if left in names and right in names:
            total += points[names.index(left)] - points[names.index(right)]
    return total


def handedness(points: Float[np.ndarray, "k 3"], names: Sequence[str]) -> float:
    """Returns a number that is positive if the left side is to the left of a person who looks to
    the front, and negative if it is to the right. 0 if the names do not tell.
    """
    up = middle_of(points, names, "shoulder") - middle_of(points, names, "hip")
    if np.isnan(up).any():
        return 0.0
    return float(np.linalg.det(np.stack([across(points, names), up, _front(points, names)])))
