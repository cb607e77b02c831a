"""Where a scan is, how large and in which stance, before its pose is known: a similarity and a pose to start from.

From landmarks: the similarity that takes the trunk's to those of a resting body, robustly. Without: the root mean square distance
from the centre of the surface tells the scale; turns and stances are compared by the distances of few points, both ways.
"""

import dataclasses

import jax.numpy as jnp
import numpy as np

from humangs_jax.body.model import BodyPose
from humangs_jax.core.array_types import Float
from humangs_jax.fitting.pose_prior import MIRROR, pose_prior
from humangs_jax.fitting.rigid import cube_rotations, trunk_weights
from humangs_jax.fitting.scans.body_surface import BodySurface, pose_surface
from humangs_jax.fitting.scans.reading import Scan, directions_around
from humangs_jax.fitting.scans.similarity import Similarity, align_robustly
from humangs_jax.geometry import quaternion

STANCES = {
    "T": {"left_shoulder": (0, 0, 0), "left_elbow": (0, 0, 0)},
    "A": {"left_shoulder": (0, 0, -0.8), "left_elbow": (0, -0.2, 0)},
    "arms down": {"left_shoulder": (0, 0, -1.3), "left_elbow": (0, -0.2, 0)},
    "arms up": {"left_shoulder": (0, 0, 1.2), "left_elbow": (0, -0.3, 0)},
    "arms forward": {"left_shoulder": (0, -1.2, -0.3), "left_elbow": (0, -0.6, 0)},
    "hands at the waist": {"left_shoulder": (0.3, 0, -0.9), "left_elbow": (0, -1.7, 0)},
    "crouch": {"left_shoulder": (0, -0.8, -0.6), "left_hip": (-1.5, 0, 0.2), "left_knee": (1.8, 0, 0)},
}
"""Rotation vectors of the left side, which the right mirrors; the other joints rest."""
POINTS = 400
"""Of scan and body that are compared."""
TURNS = 24
"""About each of the directions that the body's axis is tried along."""
CROWDED = 0.9
"""Metres: farther apart than this counts no more."""
TRUNK_SPREAD = 0.06
"""Metres by which landmarks of a trunk differ from a resting one's."""


@dataclasses.dataclass(frozen=True, eq=False)
class Start:
    """align: from the scan to a frame in which a body in this pose is nearly right. rotations: (j, 3). cost: lower is better."""

    align: Similarity
    rotations: Float[np.ndarray, "j 3"]
    cost: float


def stance_rotations(joint_names: tuple[str, ...]) -> dict[str, Float[np.ndarray, "j 3"]]:
    """(j, 3) rotations of each stance; joints that the body lacks are left out."""
    usual = pose_prior(joint_names).usual
    found = {}
    for stance, turns in STANCES.items():
        rotations = usual.copy()
        for name, turn in turns.items():
            for side, sign in (("left", np.ones(3)), ("right", MIRROR)):
                if (joint := name.replace("left", side)) in joint_names:
                    rotations[joint_names.index(joint)] = sign * np.asarray(turn)
        found[stance] = rotations
    return found


def start_from_landmarks(
    surface: BodySurface,
    resting: Float[np.ndarray, "k 3"],
    points: Float[np.ndarray, "k 3"],
    known: Float[np.ndarray, " k"],
) -> Start:
    """The start that given landmarks say.

    Arguments: resting: (k, 3) of the body in its usual pose, metres. points: (k, 3) in the scan. known: (k,) 1 or 0.
    Raises: ValueError if fewer than three of them are known.
    """
    model = surface.landmarks
    weights = known * np.square(trunk_weights(model.names))
    align = align_robustly(points, resting, weights, TRUNK_SPREAD)
    return Start(align, pose_prior(model.joint_names).usual, 0.0)


def search_starts(surface: BodySurface, scan: Scan, kept: int) -> list[Start]:
    """The best `kept` starts, of different turns, best first."""
    from scipy.spatial import KDTree

    center = scan.points.mean(axis=0)
    points = scan.points - center
    radius = np.sqrt((points**2).sum(axis=1).mean())
    points = points / radius
    some, all_points = points[:POINTS], KDTree(points[: 10 * POINTS])
    axes = np.linalg.svd(points[: 10 * POINTS], full_matrices=False)[2]
    axes[2] *= np.sign(np.linalg.det(axes))
    rotations = np.concatenate([cube_rotations() @ axes, _grid()])
    starts = []
    for stance in stance_rotations(surface.landmarks.joint_names).values():
        skin, middle, size = _stance_points(surface, stance)
        tree, few = KDTree(skin), skin[np.random.default_rng(0).permutation(len(skin))[:POINTS]]
        limit = CROWDED / size
        for rotation in rotations:
            there = np.minimum(tree.query(some @ rotation.T)[0], limit)
            back = np.minimum(all_points.query(few @ rotation)[0], limit)
            scale = size / radius
            align = Similarity(scale, rotation, middle - scale * rotation @ center)
            starts.append(Start(align, stance, float(there.mean() + back.mean())))
    return _different(sorted(starts, key=lambda start: start.cost), kept)


def _stance_points(surface, stance):
    """Evenly spread points of a resting body in a stance about their centre and over their size; centre and size, metres."""
    betas = jnp.zeros(surface.points.directions.shape[-1])
    posed = pose_surface(surface, betas, BodyPose(jnp.asarray(stance, jnp.float32), jnp.zeros(3)))
    vertices, faces = np.asarray(posed[0], np.float64), np.asarray(surface.faces)
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    chosen = np.random.default_rng(0).choice(len(faces), 10 * POINTS, p=area / area.sum())
    points = (a + b + c)[chosen] / 3
    middle = points.mean(axis=0)
    size = np.sqrt(((points - middle) ** 2).sum(axis=1).mean())
    return (points - middle) / size, middle, size


def _grid():
    """Rotations spread over all: the body's axis along many directions, turned about it by steps."""
    found = []
    for up in directions_around(TURNS):
        side = np.linalg.svd(up[None])[2][1]
        frame = np.stack([side, up, np.cross(side, up)])
        for angle in np.arange(8) * np.pi / 4:
            c, s = np.cos(angle), np.sin(angle)
            found.append(np.asarray([[c, 0, s], [0, 1, 0], [-s, 0, c]]) @ frame)
    return np.stack(found)


def _different(starts, kept):
    """The first ones, of those that are turned alike `ALIKE` at most."""
    chosen: list[Start] = []
    for start in starts:
        alike = [np.trace(other.align.rotation.T @ start.align.rotation) > SAME_TURN for other in chosen]
        same = [other.rotations is start.rotations for other in chosen]
        if sum(alike) < ALIKE and not any(np.logical_and(alike, same)):
            chosen.append(start)
        if len(chosen) == kept:
            break
    return chosen


ALIKE = 3
"""Starts, of different stances, that may be turned alike."""
SAME_TURN = 1 + 2 * np.cos(np.radians(45.0))
"""Trace of the rotation between two turns that are alike."""


def facing_back(
    surface: BodySurface, start: Start, rotations: Float[np.ndarray, "j 3"], pelvis: Float[np.ndarray, "3"], size: float
) -> Start:
    """The start for a body that fills the same place but faces the other way, which surfaces of people hardly tell apart.

    Arguments: start: from which a body was fitted; rotations (j, 3), pelvis (3,): of that body, metres; size: metres per unit of
    the start's frame. The left limbs go where the right ones were, as far as joints bend that way.
    """
    model, prior = surface.landmarks, pose_prior(surface.landmarks.joint_names)
    swapped = rotations[[model.joint_names.index(_other_side(name)) for name in model.joint_names]] * HALF_TURN
    swapped = np.clip(swapped, prior.least, prior.greatest)
    swapped[0] = 0
    root = np.asarray(quaternion.matrix_from_axis_angle(jnp.asarray(rotations[0], jnp.float32)), np.float64)
    turn = HALF_TURN[:, None] * root.T
    there = np.asarray(model.joints[0], np.float64)
    move = Similarity(1.0, turn, there - turn @ pelvis)
    return Start(move.after(Similarity(size, np.eye(3), np.zeros(3))).after(start.align), swapped, start.cost)


HALF_TURN = np.asarray([-1.0, 1.0, -1.0])
"""What half a turn about y does to vectors, of rotations too."""


def _other_side(name):
    side, _, part = name.partition("_")
    return {"left": f"right_{part}", "right": f"left_{part}"}.get(side, name)
