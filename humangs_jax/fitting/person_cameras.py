"""Cameras of photos of one moment, from the person in them: no calibration, no board.

Where the cameras stand is known up to a similarity. Size and axes come from the person: metres by the detector's 3D landmarks, or
by the person's height where that is given; y up by the cameras, which people hold level, and by the body.

A detector that takes a back for a front exchanges left and right of a whole view. The other views tell: each view is mirrored on
trial. That all are mirrored is told by the body, whose toes and nose are in front.
"""

import contextlib
import dataclasses
from collections.abc import Iterator, Sequence

import jax.numpy as jnp
import numpy as np

from humangs_jax.body.model import shape_body
from humangs_jax.core.array_types import Bool, Float, Int
from humangs_jax.core.pytree import replace
from humangs_jax.data.capture import Capture
from humangs_jax.data.keypoints.keypoints import mirrored_name
from humangs_jax.fitting.person_bundle import Evidence, Rig, adjust, align_views, pixel_errors, place_person
from humangs_jax.fitting.residuals.keypoints import NOISE, OUTER, in_camera_axes
from humangs_jax.geometry.camera import Camera
from humangs_jax.io.images import DIAGONAL_35MM

USUAL_FOCAL, USUAL_STD, EXIF_STD = 29.0, 0.2, 0.03
"""35-mm equivalent of a telephone's main camera, mm, and stds of the logarithm of focal lengths: supposed, and of EXIF."""
SEEN, FEWEST = 0.1, 6
"""Least visibility of a landmark that counts, and least number of those in a photo."""
SMALLEST = 16.0
"""Pixels: a person who is smaller in a photo is a point."""
LEAST_ANGLE = 4.0
"""Degrees between the directions from which photos see the person; below it they are taken one by one."""
CLEARLY = 0.7
"""A view is mirrored if the cost is then less than this share of what it is without."""
ONE_MOMENT = 0.02
"""Rms distance of the landmarks from the person's points, a share of the person's size in the photo, up to which the photos show
one moment. Measured on a man in a laboratory: 7 moments, four cameras each, 0.007 to 0.014; photos of several moments 0.045 to
0.073, with one photo of another moment among four 0.033."""
DOUBTFUL = 0.012
"""The same distance above which mirrorings are also tried from the other end, all views mirrored. Detections of one moment with
an error of 3 pixels of 900 leave 0.004 to 0.007, a mirrored view 0.02 and more."""
FEWEST_WITHOUT, MOMENT_WITHOUT = 4, 0.015
"""Photos of which one may be left out because it contradicts the others, and the distance up to which these are of one moment:
three of four photos of several moments leave 0.021 or more."""
LEVEL, UPRIGHT = 4.0, 15.0
"""Stds of the roll of a camera and of the lean of a body, degrees."""
BONES_STD, STATURE_STD = 0.01, 0.001
"""Metres by which joints and stature may differ from those of a scaled person."""
STATURE = 1.52
"""Stature over trunk, thigh and shin together, of the shipped body's mean person."""
BONES = (("shoulder", "elbow"), ("elbow", "wrist"), ("hip", "knee"), ("knee", "ankle"))


class SeveralMomentsError(ValueError):
    """No cameras explain the landmarks of all photos: the person moved between them."""


@dataclasses.dataclass(frozen=True, eq=False)
class PersonViews:
    """What a detector sees of one person in c photos of one moment.

    points: (c, k, 2) pixels, centres at +0.5. visibility: (c, k) in [0, 1]; 0: not seen. world: (c, k, 3) metres about the
    middle of the hips in the camera's axes (x right, y down, z away), as if the camera looked straight at the person. names: of
    the landmarks, see `KeypointSet`. sizes: (width, height) of the photos, pixels. focal: (c,) pixels, NaN where unknown.
    photos: their names.
    """

    points: Float[np.ndarray, "c k 2"]
    visibility: Float[np.ndarray, "c k"]
    world: Float[np.ndarray, "c k 3"]
    names: tuple[str, ...]
    sizes: tuple[tuple[int, int], ...]
    focal: Float[np.ndarray, " c"]
    photos: tuple[str, ...]

    def select(self, views: Sequence[int]) -> "PersonViews":
        """Some of the photos, in this order."""
        rows, few = list(views), lambda values: tuple(values[view] for view in views)
        arrays = {name: getattr(self, name)[rows] for name in ("points", "visibility", "world", "focal")}
        return dataclasses.replace(self, sizes=few(self.sizes), photos=few(self.photos), **arrays)


@dataclasses.dataclass(frozen=True, eq=False)
class PersonCameras:
    """Cameras around a person who stands on y = 0 at x = z = 0, facing +z.

    views: photos that are used. The rest is of these: cameras: one of each. landmarks: (c, k, 3) metres, of the person in each.
    moments: 1, or as many as photos: then each camera stands in a world of its own. mirrored: (c,) whether the detector exchanged
    left and right. errors: (c,) median distance of landmarks from their pixels, pixels. warnings: what a user should know.
    """

    views: tuple[int, ...]
    cameras: tuple[Camera, ...]
    landmarks: Float[np.ndarray, "c k 3"]
    mirrored: Bool[np.ndarray, " c"]
    moments: int
    errors: Float[np.ndarray, " c"]
    warnings: tuple[str, ...]


def cameras_from_person(seen: PersonViews, *, height: float | None = None) -> PersonCameras:
    """Cameras of photos from the person in them: of one moment, if one set of landmarks explains them all, else each on its own.

    Arguments: height: of the person without shoes, metres. Without it the person has the size of the detector's 3D landmarks.
    Raises: ValueError naming the photo, if one shows too little of the person, or where no camera is found.
    """
    every = range(len(seen.photos))
    with contextlib.suppress(SeveralMomentsError):
        return cameras_of_moment(seen, height=height)
    if len(seen.photos) >= FEWEST_WITHOUT:
        rests = [[v for v in every if v != out] for out in every]
        some = map(seen.select, rests)  # without a look for mirrored views
        errors = [_try(_cleaned(each), np.zeros(len(each.points), bool)).error for each in some]
        out = int(np.argmin(errors))
        if errors[out] < MOMENT_WITHOUT:
            found = cameras_of_moment(seen.select(rests[out]), height=height)
            warning = f"{seen.photos[out]}: left out: it shows another moment than the others, or was not understood"
            return dataclasses.replace(found, views=tuple(rests[out]), warnings=(*found.warnings, warning))
    found = [cameras_of_moment(seen.select([view]), height=height) for view in every]
    warnings = tuple(dict.fromkeys(warning for each in found for warning in each.warnings))
    names = ("landmarks", "mirrored", "errors")
    joined = {name: np.concatenate([getattr(each, name) for each in found]) for name in names}
    cameras = tuple(each.cameras[0] for each in found)
    return PersonCameras(tuple(every), cameras, moments=len(found), warnings=warnings, **joined)


def cameras_of_moment(seen: PersonViews, *, height: float | None = None) -> PersonCameras:
    """The same for photos of one moment; one photo is enough, for its own camera.

    Raises: SeveralMomentsError if they are not of one moment; ValueError as `cameras_from_person`.
    """
    _check(seen, height)
    seen = _cleaned(seen)
    found = _with_mirrored(seen)
    rig = found.rig
    if not all(np.isfinite(getattr(rig, field.name)).all() for field in dataclasses.fields(rig)):
        raise ValueError(f"{', '.join(seen.photos)}: no cameras were found that explain the landmarks of the person")
    if found.error > ONE_MOMENT or not _around(rig):
        raise SeveralMomentsError(
            f"landmarks are off by {found.error:.1%} of the person's size, at most {ONE_MOMENT:.1%} is expected"
        )
    medians = np.asarray([np.median(e[w > SEEN]) for e, w in zip(found.pixels, found.evidence.weights, strict=True)])
    cameras, landmarks = _in_world(seen, rig, height)
    views, every = tuple(range(len(cameras))), np.broadcast_to(landmarks, (len(cameras), *landmarks.shape))
    warnings = tuple(_warnings(seen, found.mirrored, height))
    return PersonCameras(views, cameras, every, found.mirrored, 1, medians, warnings)


# What is given -------------------------------------------------------------------------------------------------------


def _check(seen: PersonViews, height: float | None) -> None:
    views = len(seen.points)
    if not views:
        raise ValueError("no photo of the person: expected one or more")
    counts = {len(x) for x in (seen.visibility, seen.world, seen.sizes, seen.focal, seen.photos)}
    if counts != {views} or {len(seen.names)} != {x.shape[1] for x in (seen.points, seen.visibility, seen.world)}:
        raise ValueError(f"expected points, visibility, world, sizes, focal and photos of {views} views")
    if height is not None and not 0.3 < height < 3:
        raise ValueError(f"height {height:g}: expected metres between 0.3 and 3")
    for photo, points, visible in zip(seen.photos, seen.points, _known(seen), strict=True):
        if visible.sum() < FEWEST:
            raise ValueError(f"{photo}: {visible.sum()} landmarks of the person are seen, expected {FEWEST} or more")
        if np.ptp(points[visible], axis=0).max() < SMALLEST:
            raise ValueError(f"{photo}: all landmarks of the person lie within {SMALLEST:.0f} pixels")
    for photo, focal in zip(seen.photos, seen.focal, strict=True):
        if focal <= 0 or np.isinf(focal):
            raise ValueError(f"{photo}: focal length {focal:g}: expected pixels, or NaN where it is unknown")


def _known(seen: PersonViews) -> Bool[np.ndarray, "c k"]:
    finite = np.isfinite(seen.points).all(-1) & np.isfinite(seen.world).all(-1)
    return finite & (np.nan_to_num(seen.visibility) > SEEN)


def _cleaned(seen: PersonViews) -> PersonViews:
    known = _known(seen)
    return dataclasses.replace(
        seen,
        points=np.where(known[..., None], seen.points, 0.0),
        visibility=np.where(known, seen.visibility, 0.0),
        world=np.where(known[..., None], seen.world, 0.0),
    )


def _focal_lengths(seen: PersonViews) -> tuple[Float[np.ndarray, " c"], Float[np.ndarray, " c"]]:
    """Focal lengths (c,) and stds of their logarithms; those of photos without are like the others', or the usual."""
    diagonals = np.hypot(*np.asarray(seen.sizes, float).T)
    known = np.isfinite(seen.focal)
    usual = np.median((seen.focal / diagonals)[known]) if known.any() else USUAL_FOCAL / DIAGONAL_35MM
    std = np.where(known, EXIF_STD, USUAL_STD)
    return np.where(known, seen.focal, usual * diagonals), std


def _evidence(seen: PersonViews, mirrored: Bool[np.ndarray, " c"]) -> tuple[Evidence, Rig]:
    """Evidence with left and right of some views exchanged, and cameras to start from."""
    focal, std = _focal_lengths(seen)
    mirror = [seen.names.index(mirrored_name(name)) for name in seen.names]
    order = np.where(mirrored[:, None], mirror, np.arange(len(mirror)))
    pick = lambda values: np.take_along_axis(values, order.reshape(*order.shape, *[1] * (values.ndim - 2)), axis=1)
    points, weights = pick(seen.points - np.asarray(seen.sizes)[:, None] / 2), pick(seen.visibility)
    world = pick(seen.world)
    for own, flipped in zip(world, mirrored, strict=True):
        if flipped and _handedness(own, seen.names) < 0:  # the detector saw the body turned round as well
            own[:, 2] *= -1
    K = focal[:, None, None] * np.diag([1, 1, 0]) + np.diag([0, 0, 1])
    hips = np.asarray([name in ("left_hip", "right_hip") for name in seen.names])
    middle = np.where((weights * hips).all(1, where=hips, keepdims=True), weights * hips, weights)
    world = in_camera_axes(world, points, middle, K)
    world = np.asarray([x - (w[:, None] * x).sum(0) / w.sum() for x, w in zip(world, weights, strict=True)])
    radii = np.sqrt((weights[..., None] * world**2).sum((1, 2)) / weights.sum(1))
    world *= (np.median(radii) / radii)[:, None, None]
    shape, rotations = align_views(world, weights)
    size = lambda p, w: float(np.ptp(np.quantile(p[w > 0], OUTER, axis=0), axis=0).max())
    noise = np.asarray([size(p, w) * NOISE for p, w in zip(points, weights, strict=True)])
    offsets = np.einsum("cab,kb->cka", rotations, shape)
    places = np.stack([place_person(*own) for own in zip(points, weights, offsets, focal, strict=True)])
    evidence = Evidence(points, weights, noise, world, focal, std, _bones(seen.names))
    return evidence, Rig(shape, rotations, places, focal)


def _bones(names: Sequence[str]) -> Int[np.ndarray, "b 2 2"]:
    rows = []
    for a, b in BONES:
        ends = [[f"{side}_{a}", f"{side}_{b}"] for side in ("left", "right")]
        if all(name in names for side in ends for name in side):
            rows.append([[names.index(name) for name in side] for side in ends])
    return np.asarray(rows, int).reshape(-1, 2, 2)


# Cameras -------------------------------------------------------------------------------------------------------------


def _with_mirrored(seen: PersonViews) -> "_Trial":
    views = len(seen.points)
    found = _try(seen, np.zeros(views, bool))
    if views == 1:
        return found
    found = _least(seen, found)
    if found.error > DOUBTFUL:
        found = min(found, _least(seen, _try(seen, np.ones(views, bool))), key=lambda each: each.cost)
    return _try(seen, ~found.mirrored) if _handedness(found.rig.landmarks, seen.names) < 0 else found


@dataclasses.dataclass(frozen=True, eq=False)
class _Trial:
    """Cameras if these views are mirrored. cost: of the adjustment. error: see `_relative_error`."""

    mirrored: Bool[np.ndarray, " c"]
    rig: Rig
    cost: float
    evidence: Evidence

    @property
    def error(self) -> float:
        return _relative_error(self.pixels * (NOISE / self.evidence.noise)[:, None], self.evidence.weights)

    @property
    def pixels(self) -> Float[np.ndarray, "c k"]:
        """Distances of landmarks from their pixels."""
        return np.linalg.norm(pixel_errors(self.evidence, self.rig), axis=-1)


def _least(seen: PersonViews, start: _Trial) -> _Trial:
    """View after view is mirrored while that explains the landmarks clearly better."""
    while True:
        trials = [_try(seen, start.mirrored ^ (np.arange(len(seen.points)) == v)) for v in range(len(seen.points))]
        best = min(trials, key=lambda each: each.cost)
        if not best.cost < CLEARLY * start.cost:
            return start
        start = best


def _try(seen: PersonViews, mirrored: Bool[np.ndarray, " c"]) -> _Trial:
    evidence, start = _evidence(seen, mirrored)
    return _Trial(mirrored, *adjust(evidence, start), evidence)


def _relative_error(errors: Float[np.ndarray, "c k"], weights: Float[np.ndarray, "c k"]) -> float:
    """Rms of errors (c, k), by degrees of freedom where there are any: points and cameras were fitted to them."""
    views, shown = len(errors), weights.max(0) > SEEN
    numbers = 2 * (weights > SEEN).sum()
    left = max(numbers - 3 * shown.sum() - 6 * views + 7, numbers / 4)
    # as many far outliers as a detector has count no more than near ones
    return float(np.sqrt(np.sum((weights > SEEN) * np.minimum(errors, 0.2) ** 2) / left))


def _around(rig: Rig) -> bool:
    """Whether photos see the person from several directions: else the landmarks of one decide nothing about the others."""
    places = rig.places
    towards = -np.einsum("cba,cb->ca", rig.rotations, places / np.linalg.norm(places, axis=1, keepdims=True))
    return len(places) == 1 or bool(np.rad2deg(np.arccos(np.clip(towards @ towards.T, -1, 1))).max() > LEAST_ANGLE)


# The world -----------------------------------------------------------------------------------------------------------


def _middle(points: Float[np.ndarray, "k 3"], names: Sequence[str], part: str) -> Float[np.ndarray, "3"]:
    return np.mean([points[names.index(f"{side}_{part}")] for side in ("left", "right")], axis=0)


def _front(points: Float[np.ndarray, "k 3"], names: Sequence[str]) -> Float[np.ndarray, "3"]:
    ends = [(f"{side}_{toe}", f"{side}_heel") for toe in ("foot_index", "big_toe") for side in ("left", "right")]
    found = [points[names.index(a)] - points[names.index(b)] for a, b in ends if a in names and b in names]
    if {"nose", "left_ear", "right_ear"} <= set(names):
        found.append(points[names.index("nose")] - _middle(points, names, "ear"))
    return np.sum(found, axis=0) if found else np.zeros(3)


def _across(points: Float[np.ndarray, "k 3"], names: Sequence[str]) -> Float[np.ndarray, "3"]:
    side = lambda part: points[names.index(f"left_{part}")] - points[names.index(f"right_{part}")]
    return side("shoulder") + side("hip")


def _handedness(points: Float[np.ndarray, "k 3"], names: Sequence[str]) -> float:
    """Positive if the left side is to the left of somebody who looks to the front."""
    up = _middle(points, names, "shoulder") - _middle(points, names, "hip")
    return float(np.linalg.det(np.stack([_across(points, names), up, _front(points, names)])))


def _in_world(seen: PersonViews, rig: Rig, height: float | None) -> tuple[tuple[Camera, ...], Float[np.ndarray, "k 3"]]:
    """Cameras, and landmarks (k, 3), of a person who stands upright at the origin, of this height."""
    points, rotations, places, focal = rig.landmarks, rig.rotations, rig.places, rig.focal
    names = seen.names
    hips, shoulders, ankles = (_middle(points, names, part) for part in ("hip", "shoulder", "ankle"))
    body = (shoulders - ankles) / np.linalg.norm(shoulders - ankles)
    level = rotations[:, 0]  # images' x axes: horizontal if the cameras are level
    precision = level.T @ level / LEVEL**2 + np.eye(3) / UPRIGHT**2
    up = np.linalg.solve(precision, body)
    up /= np.linalg.norm(up)
    left = _across(points, names)
    left -= (left @ up) * up
    left /= np.linalg.norm(left)
    world_from_rig = np.stack([left, up, np.cross(left, up)])
    scale = 1.0
    if height is not None:
        part = lambda a, b: np.mean(
            [np.linalg.norm(points[names.index(f"{s}_{a}")] - points[names.index(f"{s}_{b}")]) for s in ("left", "right")]
        )
        scale = height / (STATURE * (np.linalg.norm(shoulders - hips) + part("hip", "knee") + part("knee", "ankle")))
    turned = scale * points @ world_from_rig.T
    middle = scale * world_from_rig @ hips
    origin = np.asarray([middle[0], turned[:, 1].min(), middle[2]])
    cameras = []
    for (width, tall), rotation, place, f in zip(seen.sizes, rotations, places, focal, strict=True):
        matrix = np.eye(4)
        matrix[:3, :3] = rotation @ world_from_rig.T
        matrix[:3, 3] = scale * place + matrix[:3, :3] @ origin
        cameras.append(Camera.from_opencv([[f, 0, width / 2], [0, f, tall / 2], [0, 0, 1]], matrix, width, tall))
    return tuple(cameras), turned - origin


def _warnings(seen: PersonViews, mirrored: Bool[np.ndarray, " c"], height: float | None) -> Iterator[str]:
    if height is None:
        yield "the person's height is not given: lengths are a detector's guess, often 6 to 11 % too small"
    if not np.isfinite(seen.focal).any():
        yield f"no photo says its focal length: {USUAL_FOCAL:.0f} mm of 35-mm film, give or take {USUAL_STD:.0%}, is supposed"
    for photo in np.asarray(seen.photos, object)[mirrored]:
        yield f"{photo}: the detector exchanged left and right; they are changed back"


def scaled_to_height(capture: Capture, height: float) -> Capture:
    """A capture in which the person is so tall at rest, metres: cameras, places and shape change alike; photos show the same."""
    betas = np.asarray(capture.betas, np.float64)
    before = shape_body(capture.body, jnp.asarray(betas, jnp.float32))
    heights = np.asarray(before.vertices)[:, 1]
    top, bottom = int(np.argmax(heights)), int(np.argmin(heights))
    directions = np.asarray(capture.body.shape_directions, np.float64)[..., : len(betas)]
    scale = height / float(heights[top] - heights[bottom])
    # joints as if all of the body were scaled, the stature exactly so
    joints = np.asarray(before.joints, np.float64)
    bones = np.einsum("jn,nas->jas", np.asarray(capture.body.joint_regressor, np.float64), directions)
    rows = [
        (bones - bones[:1]).reshape(-1, len(betas)) / BONES_STD,
        (directions[top, 1] - directions[bottom, 1])[None] / STATURE_STD,
        np.eye(len(betas)),
    ]
    wanted = [
        (scale - 1) * (joints - joints[:1]).ravel() / BONES_STD,
        [(height - float(heights[top] - heights[bottom])) / STATURE_STD],
        np.zeros(len(betas)),
    ]
    betas = betas + np.linalg.lstsq(np.concatenate(rows), np.concatenate(wanted), rcond=None)[0]
    after = shape_body(capture.body, jnp.asarray(betas, jnp.float32))
    roots = scale * (before.joints[0] + capture.poses.translation)
    matrices = capture.cameras.cam_from_world
    return dataclasses.replace(
        capture,
        betas=np.asarray(betas, np.float32),
        poses=replace(capture.poses, translation=roots - after.joints[0]),
        cameras=replace(capture.cameras, cam_from_world=matrices.at[:, :3, 3].multiply(scale)),
        displacement=None if capture.displacement is None else scale * capture.displacement,
    )
