"""The pose of a scan of which nothing is known: starts from all sides, a few coarse rounds each, and the best of them.

A surface hardly tells a person's front from the back as long as limbs are where they are. So the best are also followed for a
body that fills the same place and faces the other way.
"""

import dataclasses
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from humangs_jax.body.joints import BODY_NAMES
from humangs_jax.body.model import BodyPose
from humangs_jax.core.array_types import Array, Float
from humangs_jax.fitting.body_state import state_of
from humangs_jax.fitting.scans.body_surface import pose_vertices
from humangs_jax.fitting.scans.config import COARSE, COARSE_NORMAL, LOOSE, ScanFitConfig
from humangs_jax.fitting.scans.matches import Target
from humangs_jax.fitting.scans.objective import Given, ScanProblem, ScanState, Tolerances, scale_of, scan_problem
from humangs_jax.fitting.scans.reading import Scan
from humangs_jax.fitting.scans.rounds import leftover, run_rounds
from humangs_jax.fitting.scans.similarity import Similarity
from humangs_jax.fitting.scans.start import Start, facing_back, search_starts


def start_state(problem: ScanProblem, rotations: Float[np.ndarray, "j 3"], config: ScanFitConfig) -> ScanState:
    """The mean body in a pose, at the origin of the frame."""
    betas = jnp.zeros(min(problem.surface.points.directions.shape[-1], config.shapes))
    pose = BodyPose(jnp.asarray(rotations, jnp.float32), jnp.zeros(3))
    return ScanState(state_of(problem.prior, np.asarray(problem.joints), betas, pose), jnp.zeros(()))


@jax.jit
def landmarks_and_joints(
    problem: ScanProblem, betas: Float[Array, " s"], pose: BodyPose
) -> tuple[Float[Array, "k 3"], Float[Array, "j 3"]]:
    """Of a body in a pose, metres."""
    return pose_vertices(problem.surface, jnp.zeros(1, jnp.int32), betas, pose)[1:]


def search(
    scan: Scan,
    whole: ScanProblem,
    tolerances: Tolerances,
    given: Callable[[Similarity], Given],
    config: ScanFitConfig,
    effective: float,
) -> tuple[Start, ScanState]:
    """The best start, and the body after its coarse rounds, with all joints of `whole` free.

    Arguments: given: what is known, in the frame that a similarity makes of the scan. effective: see `Target`.
    """
    surface = whole.surface
    trunk = scan_problem(surface, BODY_NAMES)
    loose = dataclasses.replace(tolerances, inside=jnp.float32(LOOSE), outside=jnp.float32(LOOSE))

    def follow(start, state=None):
        target = Target(scan, start.align, config.coarse_points, effective, COARSE_NORMAL)
        state = start_state(trunk, start.rotations, config) if state is None else state
        state, _ = run_rounds(trunk, target, given(start.align), loose, state, COARSE, config.steps)
        return leftover(trunk, target, given(start.align), loose, state), start, state

    found = sorted(map(follow, search_starts(surface, scan, config.starts)), key=lambda each: each[0])
    best = found[: config.turned]
    found = [follow(start, state) for _, start, state in best]  # as many rounds as those that are turned
    found += [follow(_turned(trunk, start, state)) for _, start, state in best]
    _, start, state = min(found, key=lambda each: each[0])
    pose = trunk.pose(state)
    return start, ScanState(state_of(whole.prior, np.asarray(whole.joints), state.body.betas, pose), state.size)


def _turned(problem, start, state):
    pose = problem.pose(state)
    pelvis = landmarks_and_joints(problem, state.body.betas, pose)[1][0]
    return facing_back(
        problem.surface, start, np.asarray(pose.rotations), np.asarray(pelvis, np.float64), float(scale_of(state))
    )
