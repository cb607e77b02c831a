"""Finds the cameras of photos of one moment from the person in them, without calibration or board.

`person_moments` decides which photos show one moment, and finds the cameras up to a similarity.
This module finds the scale and the axes of the world. Metres come from the detector's 3D landmarks,
or from the person's height if it is given. The direction y up comes from the cameras, which people
hold level, and from the body.
"""

import dataclasses
from collections.abc import Iterator, Sequence

import jax.numpy as jnp
import numpy as np

from humangs_jax.body.model import shape_body
from humangs_jax.capture.fitting.person_bundle import Rig
from humangs_jax.capture.fitting.person_moments import (
    FEWEST,
    SEEN,
    SMALLEST,
    USUAL_FOCAL,
    USUAL_STD,
    PersonViews,
    Trial,
    across,
    best_trial,
    cleaned,
    explain,
    known_landmarks,
    middle_of,
    only_known,
    under_bar,
)
from humangs_jax.core.array_types import Bool, Float
from humangs_jax.core.pytree import replace
from humangs_jax.data.capture import Capture
from humangs_jax.geometry.camera import Camera


@dataclasses.dataclass(frozen=True)
class _Std:
    """Standard deviations that are used to find the world's upward direction, and to scale a
    person.
    """

    level: float = 4.0
    """Standard deviation of a camera's roll, degrees."""
    upright: float = 15.0
    """Standard deviation of a body's lean, degrees."""
    bones: float = 0.01
    """Standard deviation of the difference between the joints of the new shape and exactly scaled
    joints, metres.
    """
    stature: float = 0.001
    """Standard deviation of the difference between the new stature and the wanted one, metres."""


_STD = _Std()


_SHARES = {("shoulder", "hip"): 0.36, ("hip", "knee"): 0.315, ("knee", "ankle"): 0.325}
"""Usual shares of trunk, thigh and shin in the sum of the three lengths. They are used for parts
that no photo shows.
"""
_LEAST_TRUNK = 2
"""A photo has to show at least this many of the landmarks in `_TRUNK`. If it shows fewer, it does
not determine the pose.
"""
_TRUNK = ("left_shoulder", "right_shoulder", "left_hip", "right_hip")


@dataclasses.dataclass(frozen=True, eq=False)
class PersonCameras:
    """Cameras around a person who stands on y = 0 at x = z = 0, facing +z.

    `cameras`, `landmarks`, `mirrored` and `errors` have one entry for each of the c photos in
    `views`.
    """

    views: tuple[int, ...]
    """Indices of the photos that are used."""
    cameras: tuple[Camera, ...]
    """Camera of each photo."""
    landmarks: Float[np.ndarray, "c k 3"]
    """Landmarks of the person in each photo, (c, k, 3), metres."""
    mirrored: Bool[np.ndarray, " c"]
    """Whether the detector exchanged left and right in each photo, (c,)."""
    moments: int
    """Number of moments: either 1, or the number of photos. In the second case each camera has a
    separate world.
    """
    errors: Float[np.ndarray, " c"]
    """Median distance between projected and detected landmarks in each photo, (c,), pixels."""
    warnings: tuple[str, ...]
    """Warnings for the user, one line each."""


def cameras_from_person(seen: PersonViews, *, height: float | None = None) -> PersonCameras:
    """Returns the cameras of photos, found from the person in them. If one set of landmarks
    explains all photos, they show one moment. Otherwise each camera is found separately.

    Photos that show too little of the person are left out if other photos show more. If one photo
    contradicts all others, it is left out, too.

    Arguments: height: height of the person without shoes, metres. None: the person has the size of
    the detector's 3D landmarks.
    Raises: ValueError if there are no photos, if arrays have different lengths, or if the height is
    not between 0.3 and 3 metres. ValueError with the name of a photo if the person is too small in
    it, or if its focal length or 3D landmarks are unusable. Also if it shows fewer than `FEWEST`
    landmarks, and no other photo shows enough of the person. ValueError with the names of the
    photos if no cameras are found.
    """
    _check(seen, height)
    # photos that show too little are left out where others show more
    little = _little_shown(seen)
    if little and len(little) < len(seen.photos):
        kept = [view for view in range(len(seen.photos)) if view not in little]
        found = cameras_from_person(seen.select(kept), height=height)
        left_out = tuple(f"{seen.photos[view]}: left out: {why}" for view, why in little.items())
        views = tuple(kept[view] for view in found.views)
        return dataclasses.replace(found, views=views, warnings=(*found.warnings, *left_out))
    _check_views(seen)
    seen = cleaned(seen)
    explained = explain(seen)
    if explained.trial is not None:
        views = explained.views
        found = _cameras(seen.select(views), explained.trial, height)
        return dataclasses.replace(
            found, views=views, warnings=(*found.warnings, *explained.warnings)
        )

    # each photo shows another person in another world
    every = range(len(seen.photos))
    alone = [seen.select([view]) for view in every]
    found = [
        _cameras(own, best_trial(own), height) for own in under_bar(alone, "cameras of each photo")
    ]
    warnings = (*explained.warnings, *(warning for each in found for warning in each.warnings))
    names = ("landmarks", "mirrored", "errors")
    joined = {name: np.concatenate([getattr(each, name) for each in found]) for name in names}
    cameras = tuple(each.cameras[0] for each in found)
    return PersonCameras(
        tuple(every), cameras, moments=len(found), warnings=tuple(dict.fromkeys(warnings)), **joined
    )


def _cameras(seen: PersonViews, trial: Trial, height: float | None) -> PersonCameras:
    """Returns the cameras and landmarks of a trial, in a world in which the person stands at the
    origin. height: see `cameras_from_person`.

    Raises: ValueError if the trial has numbers that are not finite.
    """
    rig = trial.rig
    if not all(np.isfinite(getattr(rig, field.name)).all() for field in dataclasses.fields(rig)):
        raise ValueError(
            f"{', '.join(seen.photos)}: no cameras were found that explain the landmarks of the"
            " person"
        )
    medians = np.asarray(
        [np.median(e[w > SEEN]) for e, w in zip(trial.pixels, trial.evidence.weights, strict=True)]
    )
    cameras, landmarks = _in_world(seen, rig, height)
    return PersonCameras(
        views=tuple(range(len(cameras))),
        cameras=cameras,
        landmarks=np.broadcast_to(landmarks, (len(cameras), *landmarks.shape)),
        mirrored=trial.mirrored,
        moments=1,
        errors=medians,
        warnings=tuple(_warnings(seen, trial.mirrored, height)),
    )


# What is given
# --------------------------------------------------------------------------------------------------


def _check(seen: PersonViews, height: float | None) -> None:
    views = len(seen.points)
    if not views:
        raise ValueError("no photo of the person: expected one or more")
    # arrays of one length
    counts = {len(x) for x in (seen.visibility, seen.world, seen.sizes, seen.focal, seen.photos)}
    if counts != {views} or {len(seen.names)} != {
        x.shape[1] for x in (seen.points, seen.visibility, seen.world)
    }:
        raise ValueError(
            f"expected points, visibility, world, sizes, focal and photos of {views} views"
        )
    if height is not None and not 0.3 < height < 3:
        raise ValueError(f"height {height:g}: expected metres between 0.3 and 3")


def _little_shown(seen: PersonViews) -> dict[int, str]:
    """Returns the photos that show too little of the person to find a pose, as a mapping from their
    indices to the reasons.
    """
    trunk = [seen.names.index(name) for name in _TRUNK if name in seen.names]
    found = {}
    for view, known in enumerate(known_landmarks(seen)):
        if known.sum() < FEWEST:
            found[view] = _few_landmarks(int(known.sum()))
        elif len(trunk) == len(_TRUNK) and known[trunk].sum() < _LEAST_TRUNK:
            found[view] = "neither shoulders nor hips are seen in it"
    return found


def _few_landmarks(count: int) -> str:
    return f"{count} landmarks of the person are seen, expected {FEWEST} or more"


def _check_views(seen: PersonViews) -> None:
    # enough of the person in every photo: landmarks, pixels and depth
    for photo, points, visible in zip(seen.photos, seen.points, known_landmarks(seen), strict=True):
        if visible.sum() < FEWEST:
            raise ValueError(f"{photo}: {_few_landmarks(int(visible.sum()))}")
        if np.ptp(points[visible], axis=0).max() < SMALLEST:
            raise ValueError(
                f"{photo}: all landmarks of the person lie within {SMALLEST:.0f} pixels"
            )
    for photo, world, visible in zip(seen.photos, seen.world, known_landmarks(seen), strict=True):
        if not np.ptp(world[visible], axis=0).any():
            raise ValueError(f"{photo}: all 3D landmarks of the person are one point")
    for photo, focal in zip(seen.photos, seen.focal, strict=True):
        if focal <= 0 or np.isinf(focal):
            raise ValueError(
                f"{photo}: focal length {focal:g}: expected pixels, or NaN where it is unknown"
            )


# The world
# --------------------------------------------------------------------------------------------------


def _in_world(
    seen: PersonViews, rig: Rig, height: float | None
) -> tuple[tuple[Camera, ...], Float[np.ndarray, "k 3"]]:
    """Returns the cameras, and the landmarks, (k, 3), metres, in a world in which the person stands
    upright at the origin. If no photo shows the whole trunk, the thighs or the shins, this part is
    assumed to have its usual length. height: see `cameras_from_person`.
    """
    points, rotations, places, focal = rig.landmarks, rig.rotations, rig.places, rig.focal
    known, names = only_known(points, seen.names, np.any(known_landmarks(seen), axis=0))
    middles = {part: middle_of(known, names, part) for part in ("shoulder", "hip", "knee", "ankle")}
    shown = {part: place for part, place in middles.items() if np.isfinite(place).all()}
    # the body, from the lowest to the highest part that is seen; else it is as cameras are held
    body = -rotations[:, 1].mean(axis=0)
    if len(shown) > 1:
        highest, *_, lowest = shown.values()
        body = highest - lowest
    body = body / np.linalg.norm(body)
    # y up: across the images' x axes, and along the body; least squares of both
    level = rotations[:, 0]  # images' x axes: horizontal if the cameras are level
    precision = level.T @ level / _STD.level**2 + np.eye(3) / _STD.upright**2
    up = np.linalg.solve(precision, body)
    up /= np.linalg.norm(up)
    # x to the person's left, horizontal; z is then to the front
    left = across(known, names)
    if not left.any():  # as of a person who looks at the cameras
        left = level.mean(axis=0)
    left = left - (left @ up) * up
    left /= np.linalg.norm(left)
    world_from_rig = np.stack([left, up, np.cross(left, up)])
    # metres: the stature is estimated from the lengths of trunk and legs
    lengths = _lengths(known, names)
    shares = sum(_SHARES[part] for part in lengths)
    total = sum(lengths.values()) / shares if lengths else 0.0
    # the stature over the sum, of the shipped body's mean person
    stature = 1.52
    scale = 1.0 if height is None or not lengths else height / (stature * total)
    # the origin under the hips, on the lowest landmark, or below the lowest joint that is seen by
    # the length of the parts that are not
    turned = scale * points @ world_from_rig.T
    middle = scale * world_from_rig @ shown.get("hip", known.mean(axis=0))
    unseen = sum(share for (_, end), share in _SHARES.items() if end not in shown)
    heights = scale * known @ up
    joints = [scale * place @ up for place in shown.values()]
    ground = min(heights.min(), min(joints, default=np.inf) - scale * total * unseen)
    origin = np.asarray([middle[0], ground, middle[2]])
    cameras = []
    for (width, tall), rotation, place, f in zip(seen.sizes, rotations, places, focal, strict=True):
        matrix = np.eye(4)
        matrix[:3, :3] = rotation @ world_from_rig.T
        matrix[:3, 3] = scale * place + matrix[:3, :3] @ origin
        cameras.append(
            Camera.from_opencv(
                [[f, 0, width / 2], [0, f, tall / 2], [0, 0, 1]], matrix, width, tall
            )
        )
    return tuple(cameras), turned - origin


def _lengths(
    points: Float[np.ndarray, "k 3"], names: Sequence[str]
) -> dict[tuple[str, str], float]:
    """Returns the lengths of trunk, thigh and shin, in the unit of `points`, by the pair of joints
    at the ends. A part is left out if landmarks at its ends are missing.
    """
    found = {}
    for first, last in _SHARES:
        if first == "shoulder":
            length = np.linalg.norm(
                middle_of(points, names, first) - middle_of(points, names, last)
            )
        else:
            pairs = [(f"{side}_{first}", f"{side}_{last}") for side in ("left", "right")]
            sides = [
                np.linalg.norm(points[names.index(a)] - points[names.index(b)])
                for a, b in pairs
                if a in names and b in names
            ]
            length = np.mean(sides) if sides else np.nan
        if np.isfinite(length):
            found[first, last] = float(length)
    return found


def _warnings(
    seen: PersonViews, mirrored: Bool[np.ndarray, " c"], height: float | None
) -> Iterator[str]:
    if height is None:
        yield (
            "the person's height is not given: lengths are a detector's guess, often 6 to 11 % too"
            " small"
        )
    if not np.isfinite(seen.focal).any():
        yield (
            f"no photo says its focal length: {USUAL_FOCAL:.0f} mm of 35-mm film, give or take"
            f" {USUAL_STD:.0%}, is supposed"
        )
    for photo in np.asarray(seen.photos, object)[mirrored]:
        yield f"{photo}: the detector exchanged left and right; they are changed back"


def scaled_to_height(capture: Capture, height: float) -> Capture:
    """Returns the capture scaled so that the person has this height. Cameras, positions and shape
    are scaled together, so that the photos still fit. height: height in the rest pose, metres.
    """
    betas = np.asarray(capture.betas, np.float64)
    before = shape_body(capture.body, jnp.asarray(betas, jnp.float32))
    heights = np.asarray(before.vertices)[:, 1]
    top, bottom = int(np.argmax(heights)), int(np.argmin(heights))
    directions = np.asarray(capture.body.shape_directions, np.float64)[..., : len(betas)]
    scale = height / float(heights[top] - heights[bottom])
    # joints as if all of the body were scaled, the stature exactly so
    joints = np.asarray(before.joints, np.float64)
    bones = np.einsum(
        "jn,nas->jas", np.asarray(capture.body.joint_regressor, np.float64), directions
    )
    rows = [
        (bones - bones[:1]).reshape(-1, len(betas)) / _STD.bones,
        (directions[top, 1] - directions[bottom, 1])[None] / _STD.stature,
        np.eye(len(betas)),
    ]
    wanted = [
        (scale - 1) * (joints - joints[:1]).ravel() / _STD.bones,
        [(height - float(heights[top] - heights[bottom])) / _STD.stature],
        np.zeros(len(betas)),
    ]
    betas = betas + np.linalg.lstsq(np.concatenate(rows), np.concatenate(wanted), rcond=None)[0]
    after = shape_body(capture.body, jnp.asarray(betas, jnp.float32))
    # positions of the root and the cameras scale about the world's origin, so that photos show the
    # same
    roots = scale * (before.joints[0] + capture.poses.translation)
    matrices = capture.cameras.cam_from_world
    return dataclasses.replace(
        capture,
        betas=np.asarray(betas, np.float32),
        poses=replace(capture.poses, translation=roots - after.joints[0]),
        cameras=replace(capture.cameras, cam_from_world=matrices.at[:, :3, 3].multiply(scale)),
        displacement=None if capture.displacement is None else scale * capture.displacement,
    )
