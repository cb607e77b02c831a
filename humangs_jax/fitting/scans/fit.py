"""A body inside a scan: `fit_scan(mesh file, body=...)`.

start   where, how large and in which stance: from given landmarks, or by a search over turns and stances (see `start`)
coarse  without landmarks: few points and the body's joints, from several starts; the best by what is left goes on
fine    all joints and the shape, many points, pairs found anew in every round

A scan has no unit: scale and height are those of a body of likely shape, unless `height` is given. Nor has it an up: the
scan's axis nearest to the person's is taken for it if one is near (`UPRIGHT`), otherwise the person's own.
"""

import dataclasses
from pathlib import Path

import jax.numpy as jnp
import numpy as np

from humangs_jax.body.model import BodyModel, BodyPose
from humangs_jax.core.array_types import Float
from humangs_jax.fitting.scans.body_surface import body_surface
from humangs_jax.fitting.scans.config import (
    CLOSER,
    DEFAULT_CONFIG,
    FINE,
    FINE_NORMAL,
    LANDMARK_ROUNDS,
    LANDMARK_STEPS,
    LEAST_CUT,
    SETTLED,
    ScanFitConfig,
)
from humangs_jax.fitting.scans.joints import SCAN_LANDMARKS, checked_joints
from humangs_jax.fitting.scans.matches import Target
from humangs_jax.fitting.scans.objective import Given, Matches, Tolerances, scale_of, scan_problem
from humangs_jax.fitting.scans.reading import Scan, read_scan
from humangs_jax.fitting.scans.result import ScanFit
from humangs_jax.fitting.scans.rounds import improve, run_rounds
from humangs_jax.fitting.scans.search import landmarks_and_joints, search, start_state
from humangs_jax.fitting.scans.start import start_from_landmarks
from humangs_jax.fitting.scans.world import Placement, place_upright


def fit_scan(
    mesh_path: str | Path,
    *,
    body: BodyModel,
    joints: dict[str, Float[np.ndarray, "3"]] | None = None,
    clothed: bool = True,
    height: float | None = None,
    config: ScanFitConfig = DEFAULT_CONFIG,
) -> ScanFit:
    """Fit a body to a mesh file.

    Arguments: joints: landmarks by name, in the file's coordinates; any of `SCAN_LANDMARKS`, three of the trunk at least.
    clothed: whether the surface may be outside of the skin. height: of the person without shoes, metres, if it is known.
    Raises: ValueError, naming the file, if it holds no usable surface; ValueError for joints that do not exist or do not suffice.
    """
    return fit_scan_points(
        read_scan(mesh_path, config.samples), body=body, joints=joints, clothed=clothed, height=height, config=config
    )


def fit_scan_points(
    scan: Scan,
    *,
    body: BodyModel,
    joints: dict[str, Float[np.ndarray, "3"]] | None = None,
    clothed: bool = True,
    height: float | None = None,
    config: ScanFitConfig = DEFAULT_CONFIG,
) -> ScanFit:
    """The same for a scan that is in memory. Raises: see `fit_scan`."""
    points, known = checked_joints(joints or {})
    if height is not None and not 0.5 < height < 2.6:
        raise ValueError(f"--height {height}: expected metres, 0.5 to 2.6")
    surface = body_surface(body, SCAN_LANDMARKS)
    known = known * np.asarray(surface.landmarks.known)
    whole = scan_problem(surface, surface.landmarks.joint_names)
    effective = config.effective[int(clothed)]
    tolerances = _tolerances(config, clothed)
    given = lambda align: _given(align, points, known, height, config)
    if known.any():
        start = start_from_landmarks(surface, _resting_landmarks(whole), points, known)
        state = _to_landmarks(whole, given(start.align), tolerances, start_state(whole, start.rotations, config))
        rounds = FINE
    else:
        start, state = search(scan, whole, tolerances, given, config, effective)
        rounds = (*CLOSER, *FINE)
    target = Target(scan, start.align, config.points, effective, FINE_NORMAL)
    if clothed:
        rounds = tuple(dataclasses.replace(each, cut=max(each.cut, LEAST_CUT)) for each in rounds)
    state, outcome = run_rounds(whole, target, given(start.align), tolerances, state, rounds, config.steps)
    placed = place_upright(body, scan, state.body.betas, whole.pose(state), start.align, float(scale_of(state)))
    away, covered = target.distances(whole, state, rounds[-1].gate)
    settled = float(outcome.before - outcome.after) < SETTLED * float(outcome.before)
    return _result(body, state, placed, scan, float(scale_of(state)) * away, covered, bool(known.any()), settled)


def _tolerances(config, clothed):
    outside = config.cloth if clothed else config.skin
    return Tolerances(*(jnp.float32(x) for x in (config.skin, outside, 1.0)))


def _given(align, points, known, height, config):
    number = lambda x: jnp.asarray(x, jnp.float32)
    return Given(
        points=number(np.where(known[:, None] > 0, align(points), 0.0)),
        weights=number(known),
        spread=number(config.joint_spread),
        height=number(height or 0.0),
        height_weight=number(height is not None),
    )


def _resting_landmarks(problem):
    rotations = jnp.asarray(problem.prior.usual)
    betas = jnp.zeros(problem.surface.points.directions.shape[-1])
    return np.asarray(landmarks_and_joints(problem, betas, BodyPose(rotations, jnp.zeros(3)))[0], np.float64)


def _to_landmarks(problem, given, tolerances, state):
    for spread in LANDMARK_ROUNDS:
        own = dataclasses.replace(given, spread=jnp.float32(spread))
        state, _ = improve(problem, Matches.none(), own, tolerances, state, LANDMARK_STEPS)
    return state


def _result(body, state, placed: Placement, scan, away, covered, given, settled):
    return ScanFit(
        body=body,
        betas=np.asarray(state.body.betas),
        pose=placed.pose,
        world_from_scan=placed.world_from_scan,
        distances=away,
        covered=covered,
        turned=scan.turned,
        hidden=scan.hidden,
        start="landmarks" if given else "search",
        up=placed.up,
        converged=settled,
    )
