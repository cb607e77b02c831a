import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from humangs_jax.body.model import BodyPose, pose_body, shape_body
from humangs_jax.fitting.residuals.scan import (
    Given,
    ScanMatches,
    Tolerances,
    body_surface,
    one_sided,
    pose_surface,
    pose_vertices,
    scan_problem,
    scan_residuals,
)
from humangs_jax.fitting.scan_search import start_state


@pytest.fixture(scope="module")
def problem(body):
    return scan_problem(body_surface(body, ("left_hip", "nose"), 1500), body.joint_names)


@pytest.fixture(scope="module")
def case(problem):
    """Pairs, given landmarks, tolerances and a state, random."""
    rng, number = np.random.default_rng(0), lambda x: jnp.asarray(x, jnp.float32)
    rows = rng.integers(0, 1500, 600)
    normals = rng.normal(size=(600, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    matches = ScanMatches(
        jnp.asarray(rows, jnp.int32),
        number(rng.normal(size=(600, 3))),
        number(normals),
        jnp.full(600, 0.02),
        jnp.ones(600),
    )
    given = Given(jnp.zeros((2, 3)), jnp.ones(2), number(0.1), number(1.8), number(1))
    state = start_state(problem, problem.prior.mean)
    return matches, given, Tolerances(number(0.01), number(0.02), number(1.0)), state


def test_the_surface_is_the_bodys(body):
    surface = body_surface(body, ("nose",), 13380)
    rng = np.random.default_rng(0)
    pose = BodyPose(jnp.asarray(0.3 * rng.normal(size=(55, 3)), jnp.float32), jnp.asarray([0.1, 0.2, 0.3]))
    betas = jnp.asarray(rng.normal(size=22), jnp.float32)
    true = pose_body(body, shape_body(body, betas), pose)
    vertices, normals = pose_surface(surface, betas, pose)
    some, _, joints = pose_vertices(surface, jnp.asarray([5, 2]), betas, pose)
    np.testing.assert_allclose(vertices, true.vertices, atol=1e-5)
    np.testing.assert_allclose(some, true.vertices[jnp.asarray([5, 2])], atol=1e-5)
    np.testing.assert_allclose(joints, true.joints, atol=1e-5)
    assert np.linalg.norm(normals, axis=1).min() > 0.99


def test_hands_are_what_is_not_covered(problem):
    surface, names = problem.surface, problem.surface.landmarks.joint_names
    owner = np.asarray(names)[np.asarray(surface.points.weights).argmax(1)]
    covered = np.asarray(surface.covered)
    assert covered[owner == "left_index3"].max() < 0.1
    assert covered[owner == "left_knee"].min() > 0.99


@pytest.mark.slow
def test_columns_of_the_jacobian_are_derivatives(problem, case):
    """XLA's CPU compiler got them wrong where the distances were sums over an axis."""
    matches, given, tolerances, state = case
    leaves, tree = jax.tree.flatten(state)
    residuals = lambda y: scan_residuals(problem, matches, given, tolerances, jax.tree.unflatten(tree, y))["surface"]
    columns = jax.jit(jax.jacfwd(residuals))(leaves)
    one = jax.jit(lambda y, direction: jax.jvp(residuals, (y,), (direction,))[1])
    for i in (0, len(leaves) - 1):  # shape and size
        direction = [jnp.zeros_like(leaf) for leaf in leaves]
        direction[i] = direction[i].reshape(-1).at[0].set(1.0).reshape(leaves[i].shape)
        column = np.asarray(columns[i]).reshape(len(matches.rows), -1)[:, 0]
        np.testing.assert_allclose(column, one(leaves, direction), atol=2e-3)


@pytest.mark.slow
def test_a_smaller_scan_is_no_nearer(problem, case):
    """Shrinking body and scan together changes no distance: in the body's own metres it would."""
    matches, given, tolerances, state = case
    away = lambda s, m: np.asarray(scan_residuals(problem, m, given, tolerances, s)["surface"])
    posed, _ = pose_surface(problem.surface, *problem.body(state))
    exact = dataclasses.replace(matches, points=posed[matches.rows])
    assert np.abs(away(state, exact)).max() < 1e-3
    half = dataclasses.replace(state, log_scale=jnp.float32(np.log(0.5) / 0.05))  # metres per unit of the frame
    twice = dataclasses.replace(matches, points=2 * posed[matches.rows] + 0.01 * matches.normals)
    np.testing.assert_allclose(away(half, twice), 0.01 / 0.02, atol=1e-3)


def test_outside_counts_less_than_inside():
    away = one_sided(jnp.asarray([0.01, -0.01]), jnp.asarray([0.02, 0.02]), jnp.asarray(0.005))
    np.testing.assert_allclose(away, [0.5, -2.0])
