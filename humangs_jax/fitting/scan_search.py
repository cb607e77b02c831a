"""Where a scan is, how large and in which stance; and the iterations that bring a body to it.

From landmarks: the similarity that takes the trunk's landmarks to those of a resting body, robustly. Without landmarks: the
root mean square distance from the centre of the surface gives the scale; turns and stances are compared by the distances of few
points, and the best are followed for a few coarse iterations. A surface hardly distinguishes a person's front from the back as
long as the limbs are in the same place, so the best are also followed for a body that faces the other way.

A round pairs scan and body as they are, then takes a few steps of damped least squares with these pairs.
"""

import dataclasses
import functools
from collections.abc import Callable, Iterator, Sequence

import jax
import jax.numpy as jnp
import numpy as np

from humangs_jax.body.joints import BODY_NAMES
from humangs_jax.body.model import BodyPose
from humangs_jax.core.array_types import Array, Float
from humangs_jax.core.pytree import replace
from humangs_jax.data.keypoints.keypoints import mirrored_name
from humangs_jax.fitting.landmark_fit import cube_rotations
from humangs_jax.fitting.residuals.keypoints import trunk_weights
from humangs_jax.fitting.residuals.scan import (
    BodySurface,
    Given,
    ScanMatches,
    ScanProblem,
    Target,
    Tolerances,
    pose_surface,
    pose_vertices,
    scan_problem,
    scan_residuals,
)
from humangs_jax.fitting.scan_files import Scan, directions_around
from humangs_jax.fitting.state import MIRROR, FitState, Outcome, half_squares, pose_prior, scale_of, solve, state_of
from humangs_jax.fitting.triangulation import Similarity, align_robustly
from humangs_jax.geometry import quaternion


@dataclasses.dataclass(frozen=True)
class ScanFitConfig:
    """Settings of a fit to a scan."""

    samples: int = 30_000
    """Points taken from the scan."""
    points: int = 2500
    """Of them, and of the body's vertices, that look for partners."""


COARSE_POINTS = 600
"""The same in the search."""
STEPS, SHAPES = 4, 32
"""Of the solver in a round; coefficients that are fitted."""
FOLLOWED, TURNED = 16, 2
"""Starts that are followed; and how many of the best are also followed facing the other way."""


@dataclasses.dataclass(frozen=True)
class Round:
    """Settings of a round: gate and robust_scale of `Target.matches`, about metres; weight of the pose prior."""

    gate: float
    robust_scale: float
    prior: float = 1.0


COARSE = (
    *(Round(1.0, 0.4, 3.0), Round(0.6, 0.3, 3.0), Round(0.5, 0.3, 2.0), Round(0.4, 0.2, 2.0)),
    *(Round(0.3, 0.15), Round(0.3, 0.15), Round(0.2, 0.1), Round(0.2, 0.1), Round(0.15, 0.07), Round(0.15, 0.07)),
)
"""Rounds of every start of the search."""
ALONE = 0.1
"""Metres: when starts are compared, a point without a partner counts like one at this distance."""
COARSE_NORMAL = 0.06
"""Metres that a difference of 1 between normals counts like in the search."""
LOOSE = 0.01
"""Metres: std of the skin, on both sides, in the search."""


def run_iterations(
    problem: ScanProblem, target: Target, given: Given, tolerances: Tolerances, state: FitState, iterations: tuple[Round, ...]
) -> tuple[FitState, list[Outcome]]:
    """The body after some iterations, and what the solver did in each."""
    outcomes = []
    for each in iterations:
        matches = target.matches(problem, state, each.gate, each.robust_scale, tolerances)
        own = dataclasses.replace(tolerances, prior=jnp.float32(each.prior))
        state, outcome = improve(problem, matches, given, own, state)
        outcomes.append(outcome)
    return state, outcomes


@functools.partial(jax.jit, static_argnames="steps")
def improve(
    problem: ScanProblem, matches: ScanMatches, given: Given, tolerances: Tolerances, state: FitState, steps: int = STEPS
) -> tuple[FitState, Outcome]:
    """The body after at most `steps` steps of the solver with these pairs, and what the solver did."""
    return solve(lambda y: scan_residuals(problem, matches, given, tolerances, y), state, steps, method="lm")


def leftover(problem: ScanProblem, target: Target, given: Given, tolerances: Tolerances, state: FitState) -> float:
    """Half the square sum of all residuals with fresh pairs, by which starts are compared."""
    matches = target.matches(problem, state, ALONE, ALONE, tolerances)
    alone = float(jnp.sum(matches.weights == 0)) * target.effective / len(matches.weights)
    cost = float(_cost(problem, matches, given, tolerances, state))
    return cost + 0.5 * alone * (ALONE / float(tolerances.inside)) ** 2


@jax.jit
def _cost(problem: ScanProblem, matches: ScanMatches, given: Given, tolerances: Tolerances, state: FitState) -> Float[Array, ""]:
    return half_squares(scan_residuals(problem, matches, given, tolerances, state))


def start_state(problem: ScanProblem, rotations: Float[np.ndarray, "j 3"]) -> FitState:
    """The mean body in a pose, at the origin of the frame."""
    pose = BodyPose(jnp.asarray(rotations, jnp.float32), jnp.zeros(3))
    return replace(state_of(problem.origin, problem.origin.betas, pose), log_scale=jnp.zeros(()))


@jax.jit
def landmarks_and_joints(
    problem: ScanProblem, betas: Float[Array, " s"], pose: BodyPose
) -> tuple[Float[Array, "k 3"], Float[Array, "j 3"]]:
    """Landmarks and joints of a body in a pose, metres."""
    return pose_vertices(problem.surface, jnp.zeros(1, jnp.int32), betas, pose)[1:]


# Starts --------------------------------------------------------------------------------------------------------------

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
"""Points of scan and body that are compared in the search."""
TURNS = 24
"""Directions along which the body's axis is tried."""
CROWDED = 0.9
"""Metres: larger distances count like this one."""
TRUNK_STD = 0.06
"""Metres by which landmarks of a trunk differ from a resting one's."""
ALIKE = 3
"""Starts, of different stances, that may be turned alike."""
SAME_TURN = 1 + 2 * np.cos(np.radians(45.0))
"""Trace of the rotation between two turns that are alike."""
HALF_TURN = np.asarray([-1.0, 1.0, -1.0])
"""Half a turn about y, applied to vectors and to rotation vectors."""


@dataclasses.dataclass(frozen=True, eq=False)
class Start:
    """align: from the scan to a frame in which a body in this pose is nearly right. rotations: (j, 3). cost: lower is better."""

    align: Similarity
    rotations: Float[np.ndarray, "j 3"]
    cost: float


def start_from_landmarks(
    surface: BodySurface, resting: Float[np.ndarray, "k 3"], points: Float[np.ndarray, "k 3"], known: Float[np.ndarray, " k"]
) -> Start:
    """The start from given landmarks.

    Arguments: resting: (k, 3) of the body in its usual pose, metres. points: (k, 3) in the scan. known: (k,) 1 or 0.
    Raises: ValueError if fewer than three of them are known.
    """
    model = surface.landmarks
    weights = known * np.square(trunk_weights(model.names))
    align = align_robustly(points, resting, weights, TRUNK_STD)
    return Start(align, pose_prior(model.joint_names).mean, 0.0)


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
    for stance in _stances(surface.landmarks.joint_names):
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


def _stances(joint_names: tuple[str, ...]) -> Iterator[Float[np.ndarray, "j 3"]]:
    for turns in STANCES.values():
        rotations = pose_prior(joint_names).mean.copy()
        for name, turn in turns.items():
            for side, sign in (("left", np.ones(3)), ("right", MIRROR)):
                if (joint := name.replace("left", side)) in joint_names:
                    rotations[joint_names.index(joint)] = sign * np.asarray(turn)
        yield rotations


def _stance_points(
    surface: BodySurface, stance: Float[np.ndarray, "j 3"]
) -> tuple[Float[np.ndarray, "p 3"], Float[np.ndarray, "3"], float]:
    """Evenly spread points of the mean body in a stance about their centre and over their size; centre and size, metres."""
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


def _grid() -> Float[np.ndarray, "turns 3 3"]:
    """Rotations from all sides: the body's axis along many directions, turned about it in steps."""
    found = []
    for up in directions_around(TURNS):
        side = np.linalg.svd(up[None])[2][1]
        frame = np.stack([side, up, np.cross(side, up)])
        for angle in np.arange(8) * np.pi / 4:
            c, s = np.cos(angle), np.sin(angle)
            found.append(np.asarray([[c, 0, s], [0, 1, 0], [-s, 0, c]]) @ frame)
    return np.stack(found)


def _different(starts: Sequence[Start], kept: int) -> list[Start]:
    """The first ones, at most `ALIKE` of those that are turned alike."""
    chosen: list[Start] = []
    for start in starts:
        alike = [np.trace(other.align.rotation.T @ start.align.rotation) > SAME_TURN for other in chosen]
        same = [other.rotations is start.rotations for other in chosen]
        if sum(alike) < ALIKE and not any(np.logical_and(alike, same)):
            chosen.append(start)
        if len(chosen) == kept:
            break
    return chosen


def facing_back(
    surface: BodySurface, start: Start, rotations: Float[np.ndarray, "j 3"], pelvis: Float[np.ndarray, "3"], size: float
) -> Start:
    """The start for a body that fills the same place but faces the other way. The left limbs go where the right ones were, as
    far as joints bend that way.

    Arguments: start: from which a body was fitted; rotations (j, 3), pelvis (3,): of that body, metres; size: metres per unit of
    the start's frame.
    """
    model, prior = surface.landmarks, pose_prior(surface.landmarks.joint_names)
    swapped = rotations[[model.joint_names.index(mirrored_name(name)) for name in model.joint_names]] * HALF_TURN
    swapped = np.clip(swapped, prior.lower, prior.upper)
    swapped[0] = 0
    root = np.asarray(quaternion.matrix_from_axis_angle(jnp.asarray(rotations[0], jnp.float32)), np.float64)
    turn = HALF_TURN[:, None] * root.T
    there = np.asarray(model.joints[0], np.float64)
    move = Similarity(1.0, turn, there - turn @ pelvis)
    return Start(move.after(Similarity(size, np.eye(3), np.zeros(3))).after(start.align), swapped, start.cost)


def search(
    scan: Scan, whole: ScanProblem, tolerances: Tolerances, given: Callable[[Similarity], Given], effective: float
) -> tuple[Start, FitState]:
    """The best start, and the body after its coarse iterations, with all joints of `whole` free.

    Arguments: given: what is known, in the frame of an alignment of the scan. effective: see `Target`.
    """
    trunk = scan_problem(whole.surface, BODY_NAMES, SHAPES)
    loose = dataclasses.replace(tolerances, inside=jnp.float32(LOOSE), outside=jnp.float32(LOOSE))

    def follow(start, state=None):
        target = Target(scan, start.align, COARSE_POINTS, effective, COARSE_NORMAL)
        state = start_state(trunk, start.rotations) if state is None else state
        state, _ = run_iterations(trunk, target, given(start.align), loose, state, COARSE)
        return leftover(trunk, target, given(start.align), loose, state), start, state

    def turned(start, state):
        betas, pose = trunk.body(state)
        pelvis = np.asarray(landmarks_and_joints(trunk, betas, pose)[1][0], np.float64)
        return facing_back(whole.surface, start, np.asarray(pose.rotations), pelvis, float(scale_of(state)))

    found = sorted(map(follow, search_starts(whole.surface, scan, FOLLOWED)), key=lambda each: each[0])
    best = found[:TURNED]
    found = [follow(start, state) for _, start, state in best]  # as many rounds as those that are turned
    found += [follow(turned(start, state)) for _, start, state in best]
    _, start, state = min(found, key=lambda each: each[0])
    return start, replace(state_of(whole.origin, *trunk.body(state)), log_scale=state.log_scale)
