"""Cameras around a person from landmarks alone: a start from the detector's 3D landmarks, then bundle adjustment.

A detector that sees one photo gives landmarks in metres in the axes of that photo's camera, as if the camera looked straight at
the person. Their depths are guesses, 5 to 10 cm off, and the whole is turned by up to 20 degrees. Rotations that bring those of
several photos together (generalised Kabsch: Gower 1975, https://doi.org/10.1007/BF02291478) are a start. Bundle adjustment then
needs the pixels only; the 3D landmarks keep the size, and what pixels leave open.

On the host in float64: a hundred unknowns, and every number of photos would be another program to compile.
"""

import dataclasses
from collections.abc import Callable

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from humangs_jax.core.array_types import Float, Int
from humangs_jax.fitting.triangulation import align_points

NEAR = 0.05
"""Metres: depths are clamped to at least this."""
LANDMARK, TURN, PLACE = 0.05, 0.1, 0.1
"""Metres, radians and shares of the distance that count as one unit of the unknowns."""
WORLD = 0.15
"""Std of the detector's 3D landmarks, metres, shared errors included: pixels decide where several views see them."""
BONES = 0.01
"""Std of the difference of left and right bones, metres."""
SIZE = 0.01
"""Std of the logarithm of the person's size against the detector's 3D landmarks: what keeps the scale."""
ROBUST_SCALES = (40.0, 6.0)
"""Of pixels, standard deviations: the start is off by tens of them."""
UNSEEN = 1e-4
"""Weight of where landmarks start, for those that no photo shows."""
STEPS, TOLERANCE = 60, 1e-9
DIFFERENCE = 1e-6
"""Step of the forward differences, units of the unknowns."""
ALTERNATIONS = 20


@dataclasses.dataclass(frozen=True, eq=False)
class Evidence:
    """Landmarks of a person in c photos. points: (c, k, 2) pixels from the principal point. weights: (c, k). noise: (c,) pixels.

    world: (c, k, 3) metres in camera axes about their weighted mean, all of one size. focal: (c,) pixels; focal_std: (c,) of
    its logarithm. bones: (b, 2, 2) landmarks of left bones and of their right partners.
    """

    points: Float[np.ndarray, "c k 2"]
    weights: Float[np.ndarray, "c k"]
    noise: Float[np.ndarray, " c"]
    world: Float[np.ndarray, "c k 3"]
    focal: Float[np.ndarray, " c"]
    focal_std: Float[np.ndarray, " c"]
    bones: Int[np.ndarray, "b 2 2"]


@dataclasses.dataclass(frozen=True, eq=False)
class Rig:
    """c cameras about a person. landmarks: (k, 3) metres. rotations: (c, 3, 3) and places: (c, 3) take them to camera axes.

    focal: (c,) pixels. While it is searched all of them have further axes in front.
    """

    landmarks: Float[np.ndarray, "*n k 3"]
    rotations: Float[np.ndarray, "*n c 3 3"]
    places: Float[np.ndarray, "*n c 3"]
    focal: Float[np.ndarray, "*n c"]


def align_views(
    worlds: Float[np.ndarray, "c k 3"], weights: Float[np.ndarray, "c k"]
) -> tuple[Float[np.ndarray, "k 3"], Float[np.ndarray, "c 3 3"]]:
    """Generalised Kabsch: the mean shape (k, 3) of landmarks that are turned together, and the rotations (c, 3, 3) from it to
    each view's axes.
    """
    shape, rotations = worlds[int(np.argmax(weights.sum(1)))], np.tile(np.eye(3), (len(worlds), 1, 1))
    for _ in range(ALTERNATIONS if len(worlds) > 1 else 0):
        rotations = np.asarray([_turn(shape, *own) for own in zip(worlds, weights, strict=True)])
        total = np.maximum(weights.sum(0), 1e-9)[:, None]
        shape = np.einsum("ck,cba,ckb->ka", weights, rotations, worlds) / total
    return shape, rotations


def _turn(
    source: Float[np.ndarray, "k 3"], target: Float[np.ndarray, "k 3"], weights: Float[np.ndarray, " k"]
) -> Float[np.ndarray, "3 3"]:
    try:
        return align_points(source, target, weights).rotation
    except ValueError:  # the points of a view lie on a line: any turn about it
        return np.eye(3)


def place_person(
    points: Float[np.ndarray, "k 2"], weights: Float[np.ndarray, " k"], offsets: Float[np.ndarray, "k 3"], focal: float
) -> Float[np.ndarray, "3"]:
    """Where landmarks at `offsets`, in camera axes, have to be put to project to their pixels: with (x, y) a pixel over the focal
    length, x (z + t_z) = X + t_x and likewise y, linear in t. By the person's size where that puts it behind the camera.
    """
    xy = points / focal
    rows = np.zeros((*xy.shape, 3))
    rows[:, 0, 0] = rows[:, 1, 1] = 1
    rows[..., 2] = -xy
    right = xy * offsets[:, 2:] - offsets[:, :2]
    w = np.sqrt(weights)[:, None]
    place = np.linalg.lstsq((w[..., None] * rows).reshape(-1, 3), (w * right).ravel(), rcond=None)[0]
    share = weights / weights.sum()
    spread = lambda p: float(np.sqrt(share @ np.sum((p - share @ p) ** 2, axis=1)))
    distance = spread(offsets[:, :2]) / max(spread(xy), 1e-9)
    if distance / 3 < place[2] < 3 * distance:
        return place
    return np.asarray([*(share @ (xy * distance - offsets[:, :2])), distance])


def adjust(evidence: Evidence, start: Rig) -> tuple[Rig, float]:
    """Bundle adjustment by Levenberg and Marquardt: the cameras, and half the square sum of the residuals."""
    c, k = evidence.weights.shape
    unknowns, cost = np.zeros(3 * k + 6 * c + 1), np.inf
    for scale in ROBUST_SCALES:
        of = lambda y, scale=scale: _residuals(evidence, start, y, scale)
        found = least_squares(
            lambda y, of=of: of(y[None])[0],
            unknowns,
            jac=lambda y, of=of: _jacobian(of, y),
            method="lm",
            max_nfev=STEPS,
            xtol=TOLERANCE,
            ftol=TOLERANCE,
            gtol=TOLERANCE,
        )
        unknowns, cost = found.x, float(found.cost)
    moved = _moved(evidence, start, unknowns[None])
    return Rig(*(getattr(moved, field.name)[0] for field in dataclasses.fields(Rig))), cost


def _jacobian(residuals: Callable[[np.ndarray], np.ndarray], y: Float[np.ndarray, " u"]) -> Float[np.ndarray, "r u"]:
    """By forward differences, all at once."""
    found = residuals(np.concatenate([y[None], y + DIFFERENCE * np.eye(len(y))]))
    return (found[1:] - found[0]).T / DIFFERENCE


def _moved(evidence: Evidence, start: Rig, y: Float[np.ndarray, "n u"]) -> Rig:
    """Rigs of unknowns (n, 3 k + 6 c + 1): changes of landmarks, turns, places, and one of all focal lengths."""
    c, k = evidence.weights.shape
    landmarks, turns, change, focal = np.split(y, np.cumsum([3 * k, 3 * c, 3 * c]), axis=1)
    landmarks, turns, change = (x.reshape(len(y), -1, 3) for x in (landmarks, turns, change))
    matrices = Rotation.from_rotvec(TURN * turns.reshape(-1, 3)).as_matrix().reshape(len(y), c, 3, 3)
    depth = start.places[:, 2] * np.exp(np.clip(PLACE * change[..., 2], -5, 5))  # never behind the camera
    sideways = start.places[:, :2] / start.places[:, 2:] + PLACE * change[..., :2]
    return Rig(
        landmarks=start.landmarks + LANDMARK * landmarks,
        rotations=matrices @ start.rotations,
        places=np.concatenate([sideways * depth[..., None], depth[..., None]], axis=-1),
        focal=evidence.focal * np.exp(np.clip(evidence.focal_std * focal, -5, 5)),
    )


def pixel_errors(evidence: Evidence, rig: Rig) -> Float[np.ndarray, "*n c k 2"]:
    """Landmarks as the cameras see them, less those detected, pixels."""
    return _pixel_errors(evidence, rig, _turned(rig))


def _pixel_errors(evidence: Evidence, rig: Rig, turned: Float[np.ndarray, "*n c k 3"]) -> Float[np.ndarray, "*n c k 2"]:
    seen = turned + rig.places[..., None, :]
    return seen[..., :2] / np.maximum(seen[..., 2:], NEAR) * rig.focal[..., None, None] - evidence.points


def _turned(rig: Rig) -> Float[np.ndarray, "*n c k 3"]:
    return rig.landmarks[..., None, :, :] @ np.swapaxes(rig.rotations, -1, -2)


def _residuals(evidence: Evidence, start: Rig, y: Float[np.ndarray, "n u"], scale: float) -> Float[np.ndarray, "n r"]:
    rig = _moved(evidence, start, y)
    turned, root = _turned(rig), np.sqrt(evidence.weights)[..., None]
    errors = _pixel_errors(evidence, rig, turned) / evidence.noise[:, None, None]
    errors = errors * (scale / np.sqrt(scale**2 + np.sum(errors**2, axis=-1, keepdims=True)))  # as `state.robust`
    share = evidence.weights / evidence.weights.sum(axis=1, keepdims=True)
    centered = turned - np.sum(share[..., None] * turned, axis=-2, keepdims=True)
    radius = lambda points: 0.5 * np.log(np.sum(share[..., None] * points**2, axis=(-2, -1)).sum(-1) + 1e-12)
    bone = rig.landmarks[:, evidence.bones]
    lengths = np.linalg.norm(bone[..., 0, :] - bone[..., 1, :], axis=-1)
    k, c = evidence.weights.shape[1], len(evidence.noise)
    parts = [
        root * errors,
        root * (centered - evidence.world) / WORLD,
        (lengths[..., 0] - lengths[..., 1]) / BONES,
        (radius(centered) - radius(evidence.world)) / SIZE,
        y[:, -1],
        # what no evidence tells: axes and origin of the landmarks
        y[:, 3 * k : 3 * k + 3] / TURN,
        y[:, : 3 * k].reshape(len(y), k, 3).mean(axis=1),
        UNSEEN * y[:, : 3 * k + 6 * c],
    ]
    return np.concatenate([part.reshape(len(y), -1) for part in parts], axis=1)
