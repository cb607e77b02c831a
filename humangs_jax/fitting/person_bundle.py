"""Cameras around a person from landmarks alone: a start from the detector's 3D landmarks, then bundle adjustment.

A detector that sees one photo gives landmarks in metres in the axes of that photo's camera, as if the camera looked straight at
the person. Their depths are guesses, 5 to 10 cm off, and the whole is turned by up to 20 degrees. Rotations that bring those of
several photos together (generalised Kabsch: Gower 1975, https://doi.org/10.1007/BF02291478) are a start. Bundle adjustment then
needs the pixels only; the 3D landmarks keep the size, and what pixels leave open.
"""

import jax
import jax.numpy as jnp
import numpy as np

from humangs_jax.core.array_types import Array, Float, Int
from humangs_jax.core.pytree import pytree_dataclass
from humangs_jax.fitting.similarity import align_points
from humangs_jax.fitting.solve import Outcome, robust, solve
from humangs_jax.geometry import quaternion
from humangs_jax.geometry.transform import EXACT

NEAR = 0.05
"""Metres: depths are clamped to at least this."""
LANDMARK, TURN, PLACE = 0.05, 0.1, 0.1
"""Metres, radians and shares of the distance that count as one unit of the unknowns."""
WORLD = 0.15
"""Std of the detector's 3D landmarks, metres, shared errors counted: pixels decide where several views have them."""
BONES = 0.01
"""Std of the difference of left and right bones, metres."""
SIZE = 0.01
"""Std of the logarithm of the person's size against the detector's 3D landmarks: what keeps the scale."""
ROBUST_SCALES = (40.0, 6.0)
"""Of pixels, standard deviations: the start is off by tens of them."""
UNSEEN = 0.01
"""Weight of where landmarks start, for those that no photo shows."""
STEPS, TOLERANCE = 40, 3e-4
ALTERNATIONS = 20


@pytree_dataclass
class Evidence:
    """Landmarks of a person in c photos. points: (c, k, 2) pixels from the principal point. weights: (c, k). noise: (c,) pixels.

    world: (c, k, 3) metres in camera axes about their weighted mean, all of one size. focal: (c,) pixels; focal_std: (c,) of
    its logarithm. bones: (b, 2, 2) landmarks of left bones and of their right partners.
    """

    points: Float[Array, "c k 2"]
    weights: Float[Array, "c k"]
    noise: Float[Array, " c"]
    world: Float[Array, "c k 3"]
    focal: Float[Array, " c"]
    focal_std: Float[Array, " c"]
    bones: Int[Array, "b 2 2"]


@pytree_dataclass
class Rig:
    """c cameras about a person. landmarks: (k, 3) metres. rotations: (c, 3, 3) and places: (c, 3) take them to camera axes."""

    landmarks: Float[Array, "k 3"]
    rotations: Float[Array, "c 3 3"]
    places: Float[Array, "c 3"]
    focal: Float[Array, " c"]


@pytree_dataclass
class _Unknowns:
    """Changes of a start, of unit size. focal: one factor for all cameras, in standard deviations."""

    landmarks: Float[Array, "k 3"]
    turns: Float[Array, "c 3"]
    places: Float[Array, "c 3"]
    focal: Float[Array, ""]


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


def _turn(source, target, weights):
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


@jax.jit
def adjust(evidence: Evidence, start: Rig) -> tuple[Rig, Outcome]:
    """Bundle adjustment: cameras and landmarks that explain the evidence, from a start."""
    c, k = evidence.weights.shape
    unknowns = _Unknowns(jnp.zeros((k, 3)), jnp.zeros((c, 3)), jnp.zeros((c, 3)), jnp.zeros(()))

    def stage(unknowns, scale):
        return solve(lambda y: _residuals(evidence, start, y, scale), unknowns, STEPS, method="lm", tolerance=TOLERANCE)

    unknowns, outcomes = jax.lax.scan(stage, unknowns, jnp.asarray(ROBUST_SCALES))
    outcome = jax.tree.map(lambda leaf: leaf[-1], outcomes)
    return _moved(evidence, start, unknowns), outcome


def _moved(evidence, start, y) -> Rig:
    turns = quaternion.matrix_from_axis_angle(TURN * y.turns)
    place, change = start.places, PLACE * y.places
    depth = place[:, 2] * jnp.exp(change[:, 2])  # never behind the camera
    sideways = (place[:, :2] / place[:, 2:] + change[:, :2]) * depth[:, None]
    return Rig(
        landmarks=start.landmarks + LANDMARK * y.landmarks,
        rotations=jnp.matmul(turns, start.rotations, precision=EXACT),
        places=jnp.concatenate([sideways, depth[:, None]], axis=-1),
        focal=evidence.focal * jnp.exp(evidence.focal_std * y.focal),
    )


def pixel_errors(evidence: Evidence, rig: Rig) -> Float[Array, "c k 2"]:
    """Landmarks as the cameras see them, less those detected, pixels."""
    seen = _turned(rig) + rig.places[:, None]
    return seen[..., :2] / jnp.maximum(seen[..., 2:], NEAR) * rig.focal[:, None, None] - evidence.points


def _turned(rig):
    return jnp.einsum("cab,kb->cka", rig.rotations, rig.landmarks, precision=EXACT)


def _residuals(evidence, start, y, scale):
    rig = _moved(evidence, start, y)
    root = jnp.sqrt(jnp.where(evidence.weights > 0, evidence.weights, 1.0))[..., None]
    weigh = lambda errors: jnp.where(evidence.weights[..., None] > 0, root * errors, 0.0)
    turned = _turned(rig)
    share = evidence.weights / jnp.maximum(jnp.sum(evidence.weights, axis=1, keepdims=True), 1e-9)
    center = lambda points: points - jnp.sum(share[..., None] * points, axis=1, keepdims=True)
    radius = lambda points: 0.5 * jnp.log(jnp.sum(share[..., None] * jnp.square(points)) + 1e-9)
    bone = rig.landmarks[evidence.bones]
    lengths = jnp.sqrt(jnp.sum(jnp.square(bone[:, :, 0] - bone[:, :, 1]), axis=-1) + 1e-9)
    return {
        "pixels": weigh(robust(pixel_errors(evidence, rig) / evidence.noise[:, None, None], scale)),
        "world": weigh((center(turned) - evidence.world) / WORLD),
        "bones": (lengths[:, 0] - lengths[:, 1]) / BONES,
        "size": (radius(center(turned)) - radius(evidence.world)) / SIZE,
        "focal": y.focal,
        # what no evidence tells: axes and origin of the landmarks
        "axes": y.turns[0] / TURN,
        "origin": jnp.mean(y.landmarks, axis=0),
        "unseen": UNSEEN * y.landmarks,
    }
