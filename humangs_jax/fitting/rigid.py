"""Where a body is and which way it faces, before its pose is known.

From two views or more the trunk is triangulated, and a resting body's turned onto it (Kabsch 1976). Besides, the 24 orientations
of a cube are tried; the place that goes with an orientation follows from linear equations. The best by keypoints are kept.
"""

import itertools

import jax
import jax.numpy as jnp
import numpy as np

from humangs_jax.body.landmarks import pose_landmarks
from humangs_jax.core.array_types import Array, Float
from humangs_jax.core.pytree import replace
from humangs_jax.fitting.body_state import HEADING, METRE, BodyState, pose_of
from humangs_jax.fitting.objective import Problem, keypoint_residuals
from humangs_jax.fitting.observations import Observations
from humangs_jax.geometry import quaternion

TRUNK = ("shoulder", "hip", "neck", "mid_hip", "nose", "eye", "ear")
"""Landmarks that hardly depend on the pose."""
LIMBS = 0.02
"""Weight of the others: they count where the trunk is not seen."""
COARSE = 30.0
"""Standard deviations at which a keypoint stops to count, as long as the body is at rest."""


def cube_rotations() -> Float[np.ndarray, "24 3 3"]:
    """(24, 3, 3) the rotations that take the axes to each other."""
    signed = (
        np.eye(3)[list(order)] * np.asarray(signs)[:, None]
        for order in itertools.permutations(range(3))
        for signs in itertools.product((1, -1), repeat=3)
    )
    return np.stack([m for m in signed if np.linalg.det(m) > 0])


def trunk_weights(names: tuple[str, ...]) -> Float[np.ndarray, " k"]:
    """(k,) 1 for landmarks of the trunk, little for others."""
    kind = lambda name: name.split("_", 1)[1] if name.startswith(("left_", "right_")) else name
    return np.asarray([1.0 if kind(name) in TRUNK else LIMBS for name in names], np.float32)


def rigid_starts(
    problem: Problem,
    observations: Observations,
    points: Float[Array, "k 3"],
    counts: Float[Array, " k"],
    resting: BodyState,
    kept: int,
) -> BodyState:
    """The `kept` best places and headings of a resting body, a batch.

    Arguments: points, counts: triangulated landmarks (k, 3) and how many views agree with each (k,), 0: unknown.
    """
    landmarks, joints = pose_landmarks(problem.model, resting.betas, pose_of(problem.prior, problem.joints, resting))
    pelvis = joints[0]
    weights = trunk_weights(problem.model.names) * problem.known
    turned = _kabsch(landmarks, points, weights * (counts >= 2))
    rotations = jnp.concatenate([turned[None], jnp.asarray(cube_rotations(), jnp.float32)])
    places = jax.vmap(lambda r: _place(observations, (landmarks - pelvis) @ r.T, weights))(rotations)
    headings = quaternion.to_axis_angle(quaternion.from_matrix(rotations))
    start = lambda heading, place: replace(resting, heading=heading / HEADING, place=(place - pelvis) / METRE)
    starts = jax.vmap(start)(headings, places)
    costs = jax.vmap(lambda state: _cost(problem, observations, state, weights))(starts)
    best = jnp.argsort(costs)[:kept]
    return jax.tree.map(lambda leaf: leaf[best], starts)


def _cost(problem, observations, state, weights):
    """Half the square sum of keypoint residuals, weighted (k,), with little trust in each."""
    landmarks, _ = pose_landmarks(problem.model, state.betas, pose_of(problem.prior, problem.joints, state))
    found = keypoint_residuals(problem, observations, landmarks, COARSE)
    return 0.5 * jnp.sum(weights[:, None] * jnp.square(found))


def _kabsch(a, b, weights):
    """The rotation that, about weighted centres, takes points a to b best; the identity where nothing is known."""
    share = weights / jnp.maximum(jnp.sum(weights), 1e-9)
    centered_a, centered_b = (x - jnp.sum(share[:, None] * x, axis=0) for x in (a, b))
    u, _, vt = jnp.linalg.svd(jnp.einsum("k,ka,kb->ab", share, centered_b, centered_a) + 1e-9 * jnp.eye(3))
    sign = jnp.sign(jnp.linalg.det(u @ vt))
    return (u * jnp.stack([jnp.ones(()), jnp.ones(()), sign])) @ vt


def _place(observations, offsets, weights):
    """The point from which landmarks at `offsets` (k, 3) are seen where they are: with (x, y) a detection over the focal
    length, x (z + t_z) = X + t_x and likewise y, linear in t.
    """
    rotation, translation = observations.cam_from_world[:, :3, :3], observations.cam_from_world[:, :3, 3]
    focal = jnp.stack([observations.K[:, 0, 0], observations.K[:, 1, 1]], axis=-1)[:, None]
    xy = (observations.points - observations.K[:, None, :2, 2]) / focal
    known = jnp.einsum("cab,kb->cka", rotation, offsets) + translation[:, None]
    rows = rotation[:, None, :2] - xy[..., None] * rotation[:, None, 2:]
    right = xy * known[..., 2:] - known[..., :2]
    w = observations.confidences * weights
    matrix = jnp.einsum("ck,ckia,ckib->ab", w, rows, rows)
    vector = jnp.einsum("ck,ckia,cki->a", w, rows, right)
    scale = jnp.maximum(jnp.trace(matrix), 1e-9)
    return jnp.linalg.solve(matrix / scale + 1e-7 * jnp.eye(3), vector / scale)
