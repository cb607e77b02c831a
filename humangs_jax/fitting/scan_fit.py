"""A body inside a scan: `fit_scan(mesh file, body=...)`.

start   position, size and stance: from given landmarks, or by a search over turns and stances (see `scan_search`)
coarse  without landmarks: few points and the body's joints, from several starts; the best goes on
fine    all joints and the shape, many points, new pairs in every round

A scan has no unit: scale and height are those of a body of likely shape, unless `height` is given. Nor has it an up axis: the
scan's axis nearest to the person's is used if one is near (`UPRIGHT`), otherwise the person's own.
"""

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from humangs_jax.body.model import BodyModel, BodyPose, person_vertices, shape_body, without_expression
from humangs_jax.core.array_types import Array, Float
from humangs_jax.core.configuration import ArgumentError
from humangs_jax.fitting.report import Change, FitReport, Stage, limit_violations
from humangs_jax.fitting.residuals.scan import Given, ScanMatches, Target, Tolerances, body_surface, scan_problem
from humangs_jax.fitting.scan_files import SCAN_LANDMARKS, Scan, checked_joints, read_scan
from humangs_jax.fitting.scan_search import (
    COARSE,
    SHAPES,
    Round,
    ScanFitConfig,
    improve,
    landmarks_and_joints,
    run_iterations,
    search,
    start_from_landmarks,
    start_state,
)
from humangs_jax.fitting.state import Outcome, scale_of
from humangs_jax.fitting.triangulation import Similarity
from humangs_jax.geometry import quaternion

LANDMARK_STDS = (0.2, 0.1, 0.05, 0.02, 0.01)
"""Metres: std of given joints in the iterations that bring a body to them."""
LANDMARK_STEPS = 5
"""Steps of the solver in each of these iterations."""
CLOSER = COARSE[4:]
"""Rounds of the best start of a search with all joints."""
FINE = (Round(0.15, 0.07), Round(0.1, 0.05), Round(0.1, 0.03), Round(0.08, 0.03), *(Round(0.05, 0.02),) * 6)
"""The last iterations."""
FINE_NORMAL = 0.02
"""Metres that a difference of 1 between normals counts like in the last iterations."""
LEAST_SCALE = 0.03
"""Metres: least robust scale for clothed people, the depth of folds."""
SETTLED = 0.02
"""A fit has converged if the last round gains less than this share of the cost."""
LITTLE = 0.6
"""A smaller share of the scan near the body puts the fit in doubt. Wide skirts and long hair leave 0.7."""
UPRIGHT = np.cos(np.radians(25.0))
"""Cosine between an axis of the scan and the person's axis from which the former is up."""
SKIN, CLOTH, JOINT_STD = 0.004, 0.015, 0.01
"""Metres: std of a scan on bare skin, and of a body that pokes out of clothes; of clothes off the skin; of given joints."""
EFFECTIVE = (1500.0, 300.0)
"""Number of independent points that all pairs count for, bare and clothed, because neighbours on a surface err together."""
DEFAULT_CONFIG = ScanFitConfig()


@dataclasses.dataclass(frozen=True, eq=False)
class ScanFit:
    """A body in a scan.

    body; betas: (s,). pose: in our world: metres, y up, facing +z, the lowest point of the scan at y = 0. world_from_scan:
    from the file's coordinates to there. up: what of the scan is up, in words. distances: (r,) metres by which the scan is
    outside of the skin at sampled points, negative inside; points without a partner nearby are left out.
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
    config: ScanFitConfig = DEFAULT_CONFIG,
) -> ScanFit:
    """Fit a body to a mesh file, or to a scan in memory.

    Arguments: joints: landmarks by name, in the scan's coordinates; any of `SCAN_LANDMARKS`, at least three of the trunk.
    clothed: whether the surface may be outside of the skin. height: of the person without shoes, metres, if it is known.
    Raises: ValueError, naming the file, if it holds no usable surface; ValueError for unknown or too few joints.
    """
    if not isinstance(scan, Scan):
        scan = read_scan(scan, config.samples)
    points, known = checked_joints(joints or {})
    if height is not None and not 0.5 < height < 2.6:
        raise ArgumentError("height", f"{height}: expected metres, 0.5 to 2.6")
    surface = body_surface(without_expression(body), SCAN_LANDMARKS)
    known = known * np.asarray(surface.landmarks.known)
    whole = scan_problem(surface, surface.landmarks.joint_names, SHAPES)
    effective = EFFECTIVE[int(clothed)]
    outside = CLOTH if clothed else SKIN
    tolerances = Tolerances(*(jnp.float32(x) for x in (SKIN, outside, 1.0)))
    given = lambda align: _given(align, points, known, height)
    if known.any():
        resting = BodyPose(jnp.asarray(whole.prior.mean), jnp.zeros(3))
        betas = jnp.zeros(surface.points.directions.shape[-1])
        landmarks = np.asarray(landmarks_and_joints(whole, betas, resting)[0], np.float64)
        start = start_from_landmarks(surface, landmarks, points, known)
        state = start_state(whole, start.rotations)
        for std in LANDMARK_STDS:
            own = dataclasses.replace(given(start.align), std=jnp.float32(std))
            state, _ = improve(whole, ScanMatches.none(), own, tolerances, state, LANDMARK_STEPS)
        iterations = FINE
    else:
        start, state = search(scan, whole, tolerances, given, effective)
        iterations = (*CLOSER, *FINE)
    target = Target(scan, start.align, config.points, effective, FINE_NORMAL)
    if clothed:
        iterations = tuple(dataclasses.replace(each, robust_scale=max(each.robust_scale, LEAST_SCALE)) for each in iterations)
    state, outcomes = run_iterations(whole, target, given(start.align), tolerances, state, iterations)
    scale, (betas, pose) = float(scale_of(state)), whole.body(state)
    pose, world_from_scan, up = place_upright(body, scan, betas, pose, start.align, scale)
    away, covered = target.distances(whole, state, iterations[-1].gate)
    report = _report(scan, bool(known.any()), world_from_scan.scale, up, scale * away, covered, outcomes)
    violations = limit_violations(body.joint_names, jax.tree.map(lambda leaf: leaf[None], pose))
    report = dataclasses.replace(report, violations=violations)
    return ScanFit(body, np.asarray(betas), pose, world_from_scan, up, scale * away, report)


def _given(
    align: Similarity, points: Float[np.ndarray, "k 3"], known: Float[np.ndarray, " k"], height: float | int | None
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
    outcomes: Sequence[Outcome],
) -> FitReport:
    errors = {"scan_near_body": Change(covered)}
    if len(distances):
        low, middle, high = 1000 * np.quantile(distances, (0.05, 0.5, 0.95))
        values = {"scan_outside_median_mm": middle, "scan_outside_5_mm": low, "scan_outside_95_mm": high}
        errors = {name: Change(float(value)) for name, value in values.items()} | errors
    origin = "given joints" if from_joints else "a search, without joints: look at the result before you use it"
    notes = [f"start: {origin}", f"scale: {scale:.5g} metres per unit of the scan; up: {up}"]
    notes.append(f"left out, because it cannot be seen from outside: {scan.hidden:.0%} of the surface")
    if scan.turned:
        notes.append("the faces of the file were inside out and have been reversed")
    last = Stage.of("last round", outcomes[-1])
    settled = last.before - last.after < SETTLED * last.before
    if not settled:
        notes.append("the body was still moving in the last round")
    doubt = "much of the scan is not near the body: does it contain a floor, or other things?"
    return FitReport(
        fitted="scan",
        start="landmarks" if from_joints else "search",
        errors=errors,
        stages=(dataclasses.replace(last, converged=int(settled)),),
        notes=tuple(notes),
        warnings=(doubt,) if covered < LITTLE else (),
    )


def place_upright(
    body: BodyModel, scan: Scan, betas: Float[Array, " s"], pose: BodyPose, align: Similarity, size: float
) -> tuple[BodyPose, Similarity, str]:
    """A fit in our world: y up, facing +z, the scan standing on y = 0 with the pelvis over the origin.

    Arguments: betas (s,), pose: of the body in metres, in a frame where the scan is `size * align(points)`.
    Returns: the pose there, the similarity from the file's coordinates to there, and what of the scan is up, in words.
    """
    frame_from_scan = Similarity(size, np.eye(3), np.zeros(3)).after(align)
    root = np.asarray(quaternion.matrix_from_axis_angle(pose.rotations[0]), np.float64)
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
    rotations = pose.rotations.at[0].set(quaternion.to_axis_angle(quaternion.from_matrix(number(turn @ root))))
    world_from_frame = Similarity(1.0, turn, move)
    return BodyPose(rotations, number(center + move - pelvis)), world_from_frame.after(frame_from_scan), up


def _up_axis(own: Float[np.ndarray, "3"], rotation: Float[np.ndarray, "3 3"]) -> tuple[Float[np.ndarray, "3"], str]:
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
