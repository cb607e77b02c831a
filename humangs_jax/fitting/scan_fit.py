"""A body inside a scan: `fit_scan(mesh file, body=...)`.

start   position, size and stance: from given landmarks, or by a search over turns and stances
coarse  without landmarks: few points and the body's joints, from several starts; the best goes on
fine    all joints and the shape, many points; every iteration pairs scan and body anew, for a few
        steps of damped least squares

A scan has no unit: scale and height are those of a body of likely shape, unless `height` is given.
Nor has it an up axis: the scan's axis nearest to the person's is used if one is near (`UPRIGHT`),
otherwise the person's own.

From landmarks: the similarity that takes the trunk's landmarks to those of a resting body,
robustly. Without landmarks: the root mean square distance from the centre of the surface gives the
scale; turns and stances are compared by the distances of few points, and the best are followed for
a few coarse iterations. A surface hardly distinguishes a person's front from the back as long as
the limbs are in the same place, so the best are also followed for a body that faces the other way.
"""

import dataclasses
import functools
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation

from humangs_jax.body.joints import BODY_NAMES
from humangs_jax.body.model import (
    BodyModel,
    BodyPose,
    person_vertices,
    shape_body,
    without_expression,
)
from humangs_jax.core.array_types import Array, Float
from humangs_jax.core.configuration import ArgumentError
from humangs_jax.core.pytree import replace
from humangs_jax.data.keypoints.keypoints import mirrored_name
from humangs_jax.fitting.landmark_fit import cube_rotations
from humangs_jax.fitting.report import Change, FitReport, limit_violations
from humangs_jax.fitting.residuals.keypoints import trunk_weights
from humangs_jax.fitting.residuals.scan import (
    BodySurface,
    Given,
    ScanMatches,
    ScanProblem,
    Target,
    Tolerances,
    body_surface,
    pose_surface,
    pose_vertices,
    scan_problem,
    scan_residuals,
)
from humangs_jax.fitting.scan_files import SCAN_LANDMARKS, Scan, checked_joints, read_scan
from humangs_jax.fitting.state import (
    MIRROR,
    FitState,
    half_squares,
    pose_prior,
    scale_of,
    solve,
    state_of,
)
from humangs_jax.fitting.triangulation import Similarity, align_robustly
from humangs_jax.geometry.mesh import directions_around, face_areas

COARSE_POINTS, FINE_POINTS = 600, 2500
"""Points of the scan and vertices of the body that are matched: in the search, and in the last
iterations.
"""
STEPS, SHAPES = 4, 32
"""Steps of the solver in an iteration; coefficients that are fitted."""
FOLLOWED, TURNED = 16, 2
"""Starts that are followed; and how many of the best are also followed facing the other way."""


@dataclasses.dataclass(frozen=True)
class Round:
    """Settings of an iteration: gate and robust_scale of `Target.matches`, about metres; weight of
    the pose prior.
    """

    gate: float
    robust_scale: float
    prior: float = 1.0


COARSE = (
    *(Round(1.0, 0.4, 3.0), Round(0.6, 0.3, 3.0), Round(0.5, 0.3, 2.0), Round(0.4, 0.2, 2.0)),
    *(
        Round(0.3, 0.15),
        Round(0.3, 0.15),
        Round(0.2, 0.1),
        Round(0.2, 0.1),
        Round(0.15, 0.07),
        Round(0.15, 0.07),
    ),
)
"""Rounds of every start of the search."""
ALONE = 0.1
"""Metres: when starts are compared, a point without a partner counts like one at this distance."""
COARSE_NORMAL = 0.06
"""Metres that a difference of 1 between normals counts like in the search."""
LOOSE = 0.01
"""Metres: std of the skin, on both sides, in the search."""


def run_iterations(
    problem: ScanProblem,
    target: Target,
    given: Given,
    tolerances: Tolerances,
    state: FitState,
    iterations: tuple[Round, ...],
) -> tuple[FitState, Float[Array, "2"]]:
    """The body after some iterations, and the cost before and after the last one."""
    costs = jnp.zeros(2)
    for each in iterations:
        matches = target.matches(problem, state, each.gate, each.robust_scale, tolerances)
        own = dataclasses.replace(tolerances, prior=jnp.float32(each.prior))
        state, costs = improve(problem, matches, given, own, state)
    return state, costs


@functools.partial(jax.jit, static_argnames="steps")
def improve(
    problem: ScanProblem,
    matches: ScanMatches,
    given: Given,
    tolerances: Tolerances,
    state: FitState,
    steps: int = STEPS,
) -> tuple[FitState, Float[Array, "2"]]:
    """The body after at most `steps` steps of the solver with these pairs, and the cost before and
    after them.
    """
    residuals = lambda y: scan_residuals(problem, matches, given, tolerances, y)
    found, after = solve(residuals, state, steps, method="lm")
    return found, jnp.stack([half_squares(residuals(state)), after])


def leftover(
    problem: ScanProblem, target: Target, given: Given, tolerances: Tolerances, state: FitState
) -> float:
    """Half the square sum of all residuals with fresh pairs, by which starts are compared."""
    matches = target.matches(problem, state, ALONE, ALONE, tolerances)
    alone = float(jnp.sum(matches.weights == 0)) * target.effective / len(matches.weights)
    cost = float(_cost(problem, matches, given, tolerances, state))
    return cost + 0.5 * alone * (ALONE / float(tolerances.inside)) ** 2


@jax.jit
def _cost(
    problem: ScanProblem,
    matches: ScanMatches,
    given: Given,
    tolerances: Tolerances,
    state: FitState,
) -> Float[Array, ""]:
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


# Starts
# --------------------------------------------------------------------------------------------------

STANCES = {
    "T": {"left_shoulder": (0, 0, 0), "left_elbow": (0, 0, 0)},
    "A": {"left_shoulder": (0, 0, -0.8), "left_elbow": (0, -0.2, 0)},
    "arms down": {"left_shoulder": (0, 0, -1.3), "left_elbow": (0, -0.2, 0)},
    "arms up": {"left_shoulder": (0, 0, 1.2), "left_elbow": (0, -0.3, 0)},
    "arms forward": {"left_shoulder": (0, -1.2, -0.3), "left_elbow": (0, -0.6, 0)},
    "hands at the waist": {"left_shoulder": (0.3, 0, -0.9), "left_elbow": (0, -1.7, 0)},
    "crouch": {
        "left_shoulder": (0, -0.8, -0.6),
        "left_hip": (-1.5, 0, 0.2),
        "left_knee": (1.8, 0, 0),
    },
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
    """align: from the scan to a frame in which a body in this pose is nearly right.

    rotations: (j, 3). cost: lower is better.
    """

    align: Similarity
    rotations: Float[np.ndarray, "j 3"]
    cost: float


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
    """Evenly spread points of the mean body in a stance about their centre and over their size;
    centre and size, metres.
    """
    betas = jnp.zeros(surface.points.directions.shape[-1])
    posed = pose_surface(surface, betas, BodyPose(jnp.asarray(stance, jnp.float32), jnp.zeros(3)))
    vertices, faces = np.asarray(posed[0], np.float64), np.asarray(surface.faces)
    area = face_areas(vertices, faces)
    chosen = np.random.default_rng(0).choice(len(faces), 10 * POINTS, p=area / area.sum())
    points = vertices[faces[chosen]].mean(axis=1)
    middle = points.mean(axis=0)
    size = np.sqrt(((points - middle) ** 2).sum(axis=1).mean())
    return (points - middle) / size, middle, size


def _grid() -> Float[np.ndarray, "turns 3 3"]:
    """Rotations from all sides: the body's axis along many directions, turned about it in steps."""
    turns, found = (
        Rotation.from_euler("y", 45 * np.arange(8)[:, None], degrees=True).as_matrix(),
        [],
    )
    for up in directions_around(TURNS):
        side = np.linalg.svd(up[None])[2][1]
        found.append(turns @ np.stack([side, up, np.cross(side, up)]))
    return np.concatenate(found)


def _different(starts: Sequence[Start], kept: int) -> list[Start]:
    """The first ones, at most `ALIKE` of those that are turned alike."""
    chosen: list[Start] = []
    for start in starts:
        alike = [
            np.trace(other.align.rotation.T @ start.align.rotation) > SAME_TURN for other in chosen
        ]
        same = [other.rotations is start.rotations for other in chosen]
        if sum(alike) < ALIKE and not any(np.logical_and(alike, same)):
            chosen.append(start)
        if len(chosen) == kept:
            break
    return chosen


def facing_back(
    surface: BodySurface,
    start: Start,
    rotations: Float[np.ndarray, "j 3"],
    pelvis: Float[np.ndarray, "3"],
    size: float,
) -> Start:
    """The start for a body that fills the same place but faces the other way: left limbs where
    right ones were, if joints allow.

    Arguments: start: from which a body was fitted. rotations, pelvis: of that body. size: metres
    per unit of the start's frame.
    """
    model, prior = surface.landmarks, pose_prior(surface.landmarks.joint_names)
    swapped = (
        rotations[[model.joint_names.index(mirrored_name(name)) for name in model.joint_names]]
        * HALF_TURN
    )
    swapped = np.clip(swapped, prior.lower, prior.upper)
    swapped[0] = 0
    turn = HALF_TURN[:, None] * Rotation.from_rotvec(rotations[0]).as_matrix().T
    there = np.asarray(model.joints[0], np.float64)
    move = Similarity(1.0, turn, there - turn @ pelvis)
    return Start(
        move.after(Similarity(size, np.eye(3), np.zeros(3))).after(start.align), swapped, start.cost
    )


def search(
    scan: Scan,
    whole: ScanProblem,
    tolerances: Tolerances,
    given: Callable[[Similarity], Given],
    effective: float,
) -> tuple[Start, FitState]:
    """The best start, and the body after its coarse iterations, with all joints of `whole` free.

    Arguments: given: what is known, in the frame of an alignment of the scan. effective: see
    `Target`.
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
        return facing_back(
            whole.surface, start, np.asarray(pose.rotations), pelvis, float(scale_of(state))
        )

    found = sorted(
        map(follow, search_starts(whole.surface, scan, FOLLOWED)), key=lambda each: each[0]
    )
    best = found[:TURNED]
    found = [
        follow(start, state) for _, start, state in best
    ]  # as many iterations as those that are turned
    found += [follow(turned(start, state)) for _, start, state in best]
    _, start, state = min(found, key=lambda each: each[0])
    return start, replace(state_of(whole.origin, *trunk.body(state)), log_scale=state.log_scale)


# The fit
# --------------------------------------------------------------------------------------------------

LANDMARK_STDS = (0.2, 0.1, 0.05, 0.02, 0.01)
"""Metres: std of given joints in the iterations that bring a body to them."""
LANDMARK_STEPS = 5
"""Steps of the solver in each of these iterations."""
CLOSER = COARSE[4:]
"""Rounds of the best start of a search with all joints."""
FINE = (
    Round(0.15, 0.07),
    Round(0.1, 0.05),
    Round(0.1, 0.03),
    Round(0.08, 0.03),
    *(Round(0.05, 0.02),) * 6,
)
"""The last iterations."""
FINE_NORMAL = 0.02
"""Metres that a difference of 1 between normals counts like in the last iterations."""
LEAST_SCALE = 0.03
"""Metres: least robust scale for clothed people, the depth of folds."""
SETTLED = 0.02
"""A last iteration that gains more than this share of the cost: the body was still moving."""
LITTLE = 0.6
"""A smaller share of the scan near the body puts the fit in doubt.

Wide skirts and long hair leave 0.7.
"""
UPRIGHT = np.cos(np.radians(25.0))
"""Cosine between an axis of the scan and the person's axis from which the former is up."""
SKIN, CLOTH, JOINT_STD = 0.004, 0.015, 0.01
"""Metres: std of a scan on bare skin, and of a body that pokes out of clothes; of clothes off the
skin; of given joints.
"""
EFFECTIVE = (1500.0, 300.0)
"""Number of independent points that all pairs count for, bare and clothed, because neighbours on a
surface err together.
"""


@dataclasses.dataclass(frozen=True, eq=False)
class ScanFit:
    """A body in a scan.

    body; betas: (s,). pose: in our world: metres, y up, facing +z, the lowest point of the scan at
    y = 0. world_from_scan: from the file's coordinates to there. up: what of the scan is up, in
    words. distances: (r,) metres by which the scan is outside of the skin at sampled points,
    negative inside; points without a partner nearby are left out.
    """

    body: BodyModel
    betas: Float[np.ndarray, " s"]
    pose: BodyPose
    world_from_scan: Similarity
    up: str
    distances: Float[np.ndarray, " r"]
    report: FitReport


def fit_scan(
    scan: Scan | str | Path,
    *,
    body: BodyModel,
    joints: dict[str, Float[np.ndarray, "3"]] | None = None,
    clothed: bool = True,
    height: float | None = None,
) -> ScanFit:
    """Fit a body to a mesh file, or to a scan in memory.

    Arguments: joints: landmarks by name, in the scan's coordinates; any of `SCAN_LANDMARKS`, at
    least three of the trunk.
    clothed: whether the surface may be outside of the skin. height: of the person without shoes,
    metres, if it is known.
    Raises: ValueError, naming the file, if it holds no usable surface; ValueError for unknown or
    too few joints.
    """
    if not isinstance(scan, Scan):
        scan = read_scan(scan)
    points, known = checked_joints(joints or {})
    if height is not None and not 0.5 < height < 2.6:
        raise ArgumentError("height", f"{height}: expected metres, 0.5 to 2.6")
    surface = body_surface(without_expression(body), SCAN_LANDMARKS)
    known = known * np.asarray(surface.landmarks.known)
    whole = scan_problem(surface, surface.landmarks.joint_names, SHAPES)
    effective = EFFECTIVE[int(clothed)]
    tolerances = Tolerances(
        jnp.float32(SKIN), jnp.float32(CLOTH if clothed else SKIN), jnp.float32(1.0)
    )
    given = lambda align: _given(align, points, known, height)
    if known.any():
        resting = BodyPose(jnp.asarray(whole.prior.mean), jnp.zeros(3))
        landmarks = np.asarray(
            landmarks_and_joints(whole, whole.origin.betas, resting)[0], np.float64
        )
        weights = known * np.square(trunk_weights(surface.landmarks.names))
        start = Start(align_robustly(points, landmarks, weights, TRUNK_STD), whole.prior.mean, 0.0)
        state = start_state(whole, start.rotations)
        for std in LANDMARK_STDS:
            own = dataclasses.replace(given(start.align), std=jnp.float32(std))
            state, _ = improve(whole, ScanMatches.none(), own, tolerances, state, LANDMARK_STEPS)
        iterations = FINE
    else:
        start, state = search(scan, whole, tolerances, given, effective)
        iterations = (*CLOSER, *FINE)
    target = Target(scan, start.align, FINE_POINTS, effective, FINE_NORMAL)
    if clothed:
        iterations = tuple(
            dataclasses.replace(each, robust_scale=max(each.robust_scale, LEAST_SCALE))
            for each in iterations
        )
    state, costs = run_iterations(whole, target, given(start.align), tolerances, state, iterations)
    scale, (betas, pose) = float(scale_of(state)), whole.body(state)
    pose, world_from_scan, up = place_upright(body, scan, betas, pose, start.align, scale)
    away, covered = target.distances(whole, state, iterations[-1].gate)
    report = _report(
        scan, bool(known.any()), world_from_scan.scale, up, scale * away, covered, costs
    )
    violations = limit_violations(body.joint_names, jax.tree.map(lambda leaf: leaf[None], pose))
    report = dataclasses.replace(report, violations=violations)
    return ScanFit(body, np.asarray(betas), pose, world_from_scan, up, scale * away, report)


def _given(
    align: Similarity,
    points: Float[np.ndarray, "k 3"],
    known: Float[np.ndarray, " k"],
    height: float | int | None,
) -> Given:
    number = lambda x: jnp.asarray(x, jnp.float32)
    return Given(
        points=number(np.where(known[:, None] > 0, align(points), 0.0)),
        weights=number(known),
        std=number(JOINT_STD),
        height=number(height or 0.0),
        height_weight=number(height is not None),
    )


def _report(
    scan: Scan,
    from_joints: bool,
    scale: float,
    up: str,
    distances: Float[np.ndarray, " r"],
    covered: float,
    costs: Float[Array, "2"],
) -> FitReport:
    errors = {"scan_near_body": Change(covered)}
    if len(distances):
        low, middle, high = 1000 * np.quantile(distances, (0.05, 0.5, 0.95))
        values = {
            "scan_outside_median_mm": middle,
            "scan_outside_5_mm": low,
            "scan_outside_95_mm": high,
        }
        errors = {name: Change(float(value)) for name, value in values.items()} | errors
    origin = (
        "given joints"
        if from_joints
        else "a search, without joints: look at the result before you use it"
    )
    notes = [f"start: {origin}", f"scale: {scale:.5g} metres per unit of the scan; up: {up}"]
    notes.append(
        f"left out, because it cannot be seen from outside: {scan.hidden:.0%} of the surface"
    )
    if scan.turned:
        notes.append("the faces of the file were inside out and have been reversed")
    before, after = costs.tolist()
    if before - after > SETTLED * before:
        notes.append("the body was still moving in the last round")
    doubt = "much of the scan is not near the body: does it contain a floor, or other things?"
    return FitReport(
        fitted="scan",
        start="landmarks" if from_joints else "search",
        errors=errors,
        notes=tuple(notes),
        warnings=(doubt,) if covered < LITTLE else (),
    )


def place_upright(
    body: BodyModel,
    scan: Scan,
    betas: Float[Array, " s"],
    pose: BodyPose,
    align: Similarity,
    size: float,
) -> tuple[BodyPose, Similarity, str]:
    """A fit in our world: y up, facing +z, the scan standing on y = 0 with the pelvis over the
    origin.

    Arguments: betas (s,), pose: of the body in metres, in a frame where the scan is `size *
    align(points)`.
    Returns: the pose there, the similarity from the file's coordinates to there, and what of the
    scan is up, in words.
    """
    frame_from_scan = Similarity(size, np.eye(3), np.zeros(3)).after(align)
    root = Rotation.from_rotvec(np.asarray(pose.rotations[0], np.float64)).as_matrix()
    axis, up = _up_axis(root[:, 1], frame_from_scan.rotation)
    forward = root[:, 2] - (root[:, 2] @ axis) * axis
    if np.linalg.norm(forward) < 0.1:  # a lying person faces up or down
        forward = root[:, 1] - (root[:, 1] @ axis) * axis
    forward = forward / np.linalg.norm(forward)
    turn = np.stack([np.cross(axis, forward), axis, forward])
    pelvis = np.asarray(shape_body(body, betas).joints[0], np.float64)
    center = turn @ (pelvis + np.asarray(pose.translation, np.float64))
    lowest = (frame_from_scan(scan.points) @ turn.T)[:, 1].min()
    move = -np.asarray([center[0], lowest, center[2]])
    number = lambda x: jnp.asarray(x, jnp.float32)
    rotations = pose.rotations.at[0].set(number(Rotation.from_matrix(turn @ root).as_rotvec()))
    world_from_frame = Similarity(1.0, turn, move)
    return (
        BodyPose(rotations, number(center + move - pelvis)),
        world_from_frame.after(frame_from_scan),
        up,
    )


def _up_axis(
    own: Float[np.ndarray, "3"], rotation: Float[np.ndarray, "3 3"]
) -> tuple[Float[np.ndarray, "3"], str]:
    """Up in the frame, and its name: an axis of the scan near to the person's own axis, or that."""
    along = own @ rotation
    best = int(np.abs(along).argmax())
    if abs(along[best]) < UPRIGHT:
        return own, "the person's own axis (no axis of the scan is near)"
    sign = np.sign(along[best])
    return sign * rotation[:, best], f"{'+' if sign > 0 else '-'}{'xyz'[best]} of the scan"


def body_in_scan(fit: ScanFit) -> Float[np.ndarray, "n 3"]:
    """The body's vertices (n, 3) in the scan's coordinates."""
    vertices = jax.jit(person_vertices)(fit.body, jnp.asarray(fit.betas), fit.pose)
    return fit.world_from_scan.inverse()(np.asarray(vertices, np.float64))
