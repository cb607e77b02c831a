"""Checks whether a calibration and the keypoints of a person can both be right.

The rays of one landmark through several cameras have to meet in front of the cameras. If they do
not meet well, the triangulated body is compared with the detector's depths, to see whether it is a
mirror image.

Calibrations of other tools fail in typical ways. If matrices go from cameras to the world, and not
from the world to cameras, rays do not meet. If the y axis of the images points up, rays may meet,
but show a person upside down or mirrored.

If a calibration fails, usual mistakes are corrected on trial. The error then names the correction
with which keypoints and cameras agree. If no correction helps, the cameras are found from the
person, as for photos without a calibration, and the agreement is tested with these cameras.
"""

import dataclasses
from typing import NamedTuple

import numpy as np

from humangs_jax.capture.fitting.camera_errors import find_camera_errors, mended
from humangs_jax.capture.fitting.person_cameras import cameras_from_person
from humangs_jax.capture.fitting.person_moments import PersonViews
from humangs_jax.capture.keypoints.keypoints import Keypoints
from humangs_jax.core.array_types import Bool, Float, Int
from humangs_jax.data.photos import Photos


@dataclasses.dataclass(frozen=True)
class _Limits:
    """Limits that decide whether a calibration and keypoints contradict each other."""

    most_missed: float = 0.06
    """Up to this median distance a disagreement is tolerated if no remedy is known. It is the
    distance between keypoints and projected triangulated landmarks, divided by the person's size in
    the photo.

    It was 0.015 for four photos of a woman, and 0.12 with their y axis upside down. A camera turned
    by one degree adds 0.02 in its photo.
    """
    agrees: float = 0.035
    """Up to this median distance cameras and keypoints agree. It is measured as in
    `most_missed`.
    """
    better: float = 0.5
    """A remedy is accepted only if it multiplies the median distance by this number or less."""
    mirrored: float = 0.8
    """The person counts as a mirror image if mirroring the depth multiplies the distance from the
    detector's 3D landmarks by less than this number.
    """
    seen: float = 0.5
    """A keypoint counts if its confidence exceeds this number."""
    least_landmarks: int = 8
    """Smallest number of triangulated landmarks. If there are fewer, nothing is concluded."""
    least_views: int = 4
    """With at least this many views, one view may be left out if the others agree without it."""


_LIMITS = _Limits()


class Agreement(NamedTuple):
    """How well cameras agree with keypoints."""

    missed: float
    """Median distance between keypoints and projected triangulated landmarks, as a share of the
    person's size in the view.
    """
    pixels: float
    """Median distance between keypoints and projected triangulated landmarks, pixels."""
    mirrored: bool
    """Whether the triangulated person is a mirror image."""
    behind: bool
    """Whether more than half of the landmarks in all views are behind the cameras."""


@dataclasses.dataclass(frozen=True)
class Contradiction:
    """A calibration that does not agree with the keypoints of the person."""

    found: Agreement
    """Agreement of the keypoints with the cameras of the calibration as given."""
    remedy: str | None
    """A change of the calibration, in words, after which cameras and keypoints agree. None if no
    such change is known.
    """
    after: Agreement | None
    """Agreement of the keypoints with the cameras after the remedy. None if there is no remedy."""

    def __str__(self) -> str:
        """Returns one line about the disagreement. It states the median distance, or that the
        person would be behind the cameras. If a remedy is known, the line states it, too.
        """
        off = f"landmarks miss each other by {self.found.pixels:.0f} px"
        share = f"{off}, {self.found.missed:.0%} of the person's size"
        what = "the person would be behind the cameras" if self.found.behind else share
        line = f"the calibration contradicts the people in the photos: {what}"
        if self.remedy is None or self.after is None:
            return line
        return f"{line}; {self.remedy} they agree ({self.after.pixels:.0f} px)"


def find_contradiction(photos: Photos, keypoints: Keypoints) -> Contradiction | None:
    """Returns the contradiction between the keypoints of one person and the calibration of the
    photos, or None.

    The result is None if one of these holds:

    - Keypoints and calibration agree, or too few landmarks are seen in several views.
    - They agree after the cameras that `find_camera_errors` finds were corrected.
    - No usual mistake explains the contradiction, and the other views agree if one of at least four
      views is left out.
    - No remedy is known, the contradiction is small, and the person is neither mirrored nor behind
      the cameras. The person may have moved between the photos.
    """
    K = np.asarray(photos.cameras.K, np.float64)
    matrices = np.asarray(photos.cameras.cam_from_world, np.float64)
    frames = np.asarray(photos.frames)
    found = agreement(K, matrices, frames, keypoints)
    if found is None or _agrees(found):
        return None
    # cameras that are turned a little are reported by `find_camera_errors`, not here
    turned = find_camera_errors(photos, keypoints)
    cameras = mended(photos, turned).cameras
    again = agreement(K, np.asarray(cameras.cam_from_world, np.float64), frames, keypoints)
    if turned and again is not None and _agrees(again):
        return None

    best: tuple[str, Agreement] | None = None
    for remedy, (own_K, own) in _remedies(K, matrices, photos.images.shape[1]).items():
        after = agreement(own_K, own, frames, keypoints)
        if after is None or not _agrees(after) or after.missed > _LIMITS.better * found.missed:
            continue
        if best is None or after.missed < best[1].missed:
            best = remedy, after
    if best is not None:
        return Contradiction(found, *best)
    # one photo that does not agree with the others is of somebody else, or one camera is off
    candidates = range(len(K)) if len(K) >= _LIMITS.least_views else range(0)
    for view in candidates:
        others = dataclasses.replace(keypoints, confidences=keypoints.confidences.copy())
        others.confidences[view] = 0
        rest = agreement(K, matrices, frames, others)
        if rest is not None and _agrees(rest) and rest.missed <= _LIMITS.better * found.missed:
            return None
    without = _without_calibration(photos, keypoints)
    if without is not None and _agrees(without) and without.missed <= _LIMITS.better * found.missed:
        return Contradiction(found, "without it", without)
    # the person may have moved between the photos, which looks like a small contradiction
    if found.missed <= _LIMITS.most_missed and not (found.mirrored or found.behind):
        return None
    return Contradiction(found, None, None)


def _without_calibration(photos: Photos, keypoints: Keypoints) -> Agreement | None:
    """Returns how well the keypoints agree with cameras that are found from the person alone.

    The result is None if there are several moments or no 3D landmarks, or if no cameras are found
    that explain all photos.
    """
    if keypoints.world is None or len(np.unique(photos.frames)) > 1:
        return None
    height, width = photos.images.shape[1:3]
    views = len(photos.names)
    seen = PersonViews(
        points=np.asarray(keypoints.points, np.float64),
        visibility=np.asarray(keypoints.confidences, np.float64),
        world=np.asarray(keypoints.world, np.float64),
        names=keypoints.set.names,
        sizes=((width, height),) * views,
        focal=np.full(views, np.nan),
        photos=tuple(photos.names),
    )
    try:
        cameras = cameras_from_person(seen)
    except ValueError:  # the person is not seen well enough
        return None
    if cameras.moments > 1 or len(cameras.views) < views:
        return None
    # the median distance over the person's size, as in `agreement`
    pairs = zip(seen.points, seen.visibility > _LIMITS.seen, strict=True)
    sizes = [np.ptp(points[known], axis=0).max() for points, known in pairs]
    pixels = float(np.median(cameras.errors))
    missed = float(np.median(cameras.errors / np.maximum(sizes, 1.0)))
    return Agreement(missed, pixels, mirrored=False, behind=False)


def _agrees(found: Agreement) -> bool:
    return found.missed <= _LIMITS.agrees and not found.behind


def _remedies(
    K: Float[np.ndarray, "v 3 3"], matrices: Float[np.ndarray, "v 4 4"], height: int
) -> dict[str, tuple[Float[np.ndarray, "v 3 3"], Float[np.ndarray, "v 4 4"]]]:
    """Returns a mapping from each correction of a usual mistake, in words, to the corrected K and
    cam_from_world. height: height of the images, pixels.
    """
    other = np.diag([1.0, -1.0, 1.0, 1.0])
    upwards = K.copy()
    upwards[:, 1, 2] = height - K[:, 1, 2]
    return {
        "with the images' y axis pointing the other way": (upwards, other @ matrices @ other),
        "with matrices that go from the camera to the world": (K, np.linalg.inv(matrices)),
        "with the cameras' y and z axes pointing the other way": (
            K,
            np.diag([1.0, -1.0, -1.0, 1.0]) @ matrices,
        ),
    }


def agreement(
    K: Float[np.ndarray, "v 3 3"],
    matrices: Float[np.ndarray, "v 4 4"],
    frames: Int[np.ndarray, " v"],
    keypoints: Keypoints,
) -> Agreement | None:
    """Returns how well cameras and keypoints agree. None if fewer than `_Limits.least_landmarks`
    landmarks, counted over all frames, are seen in several views of their frame. frames: frame of
    each view, (v,).
    """
    errors, sizes, behind = [], [], []
    plain = mirrored = 0.0
    count = 0
    for frame in np.unique(frames):
        # landmarks where the rays of the views of one moment meet
        own = np.flatnonzero(frames == frame)
        points = np.asarray(keypoints.points, np.float64)[own]
        seen = np.asarray(keypoints.confidences)[own] > _LIMITS.seen
        project = K[own] @ matrices[own, :3]
        places, known = _triangulated(project, points, seen)
        count += int(known.sum())
        if not known.any():
            continue
        # where each camera shows them; depths near 0 must not divide
        local = np.einsum("vab,kb->vka", matrices[own, :3, :3], places) + matrices[own, None, :3, 3]
        depth = local[..., 2]
        # depths are at least this far from 0, in units of the world
        safe = np.where(np.abs(depth) < 1e-6, 1e-6, depth)
        shown = np.einsum("vab,vkb->vka", K[own], local)[..., :2] / safe[..., None]
        for i, v in enumerate(own):
            used = known & seen[i]
            if not used.any():
                continue
            # distances from the keypoints, with the person's size in this view
            size = float(np.ptp(points[i][seen[i]], axis=0).max())
            off = np.linalg.norm(shown[i][used] - points[i][used], axis=-1)
            errors.append(off)
            sizes.append(np.full(len(off), max(size, 1.0)))
            behind.append(depth[i][used] <= 0)
            # the detector's 3D landmarks tell the person from a mirror image
            if keypoints.world is not None and used.sum() >= _LIMITS.least_landmarks:
                as_seen = np.asarray(keypoints.world[v], np.float64)[used]
                plain += _apart(local[i][used], as_seen)
                mirrored += _apart(local[i][used] * [1, 1, -1], as_seen)
    if count < _LIMITS.least_landmarks:
        return None
    distances = np.concatenate(errors)
    return Agreement(
        missed=float(np.median(distances / np.concatenate(sizes))),
        pixels=float(np.median(distances)),
        mirrored=bool(mirrored < _LIMITS.mirrored * plain),
        behind=bool(np.mean(np.concatenate(behind)) > 0.5),
    )


def _triangulated(
    project: Float[np.ndarray, "v 3 4"],
    points: Float[np.ndarray, "v k 2"],
    seen: Bool[np.ndarray, "v k"],
) -> tuple[Float[np.ndarray, "k 3"], Bool[np.ndarray, " k"]]:
    """Returns for each landmark the point nearest to the rays of the views that see the landmark,
    (k, 3), and whether at least two views see the landmark, (k,).

    The points solve the equations of a direct linear transformation, which has the rows u P_3 - P_1
    and v P_3 - P_2 for each view. Each row is scaled so that its first three numbers have length 1.
    """
    scaled = project / np.linalg.norm(project[:, 2, :3], axis=-1)[:, None, None]
    rows = points[..., None] * scaled[:, None, 2:] - scaled[:, None, :2]
    rows = rows / np.linalg.norm(rows[..., :3], axis=-1, keepdims=True)
    rows = np.where(seen[..., None, None], rows, 0)
    system = rows.transpose(1, 0, 2, 3).reshape(points.shape[1], -1, 4)
    # the fourth column moves to the right side, so that far points are no special case
    places = np.linalg.pinv(system[..., :3], rcond=1e-6) @ -system[..., 3:]
    return places[..., 0], seen.sum(axis=0) >= 2


def _apart(places: Float[np.ndarray, "k 3"], others: Float[np.ndarray, "k 3"]) -> float:
    """Returns the mean distance of `others` from `places`, divided by the size of `places`.
    `others` are first moved, turned and scaled to fit best, but not mirrored (Umeyama 1991).
    """
    a, b = places - places.mean(axis=0), others - others.mean(axis=0)
    u, values, v = np.linalg.svd(a.T @ b)
    signs = np.asarray([1.0, 1.0, np.sign(np.linalg.det(u @ v))])
    scale = (values * signs).sum() / max((b**2).sum(), 1e-12)
    left = a - scale * b @ (u * signs @ v).T
    size = np.sqrt((a**2).sum(axis=-1).mean())
    return float(np.linalg.norm(left, axis=-1).mean() / max(size, 1e-12))
