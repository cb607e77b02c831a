"""The adjustment of cameras around a person: derivatives, elimination, and the step."""

import dataclasses

import numpy as np
import pytest
from fit_people import cameras_around, posed, seen_by

from humangs_jax.capture.fitting.person_bundle import (
    NEAR,
    VIEW,
    NormalEquations,
    Rig,
    Step,
    adjust,
    derivatives,
    moved,
    normal_equations,
    pixel_errors,
    residuals,
    solve,
)
from humangs_jax.capture.fitting.person_moments import evidence_of

SCALE, DIFFERENCE = 6.0, 1e-6
"""Robust scale of pixels, and half the distance of central differences in metres and radians."""
RELATIVE = 1e-6
"""Relative error of differences in float64: the distance squared times third derivatives."""


def problem(views=3, seed=0, known=2):
    """Returns (evidence, rig) of noisy photos; the rig is some way from the minimum.

    The focal lengths of the first `known` photos are known.
    """
    rng = np.random.default_rng(seed)
    seen = seen_by(
        posed("crouching", seed, 0.2),
        cameras_around(views, seed),
        seed=seed,
        pixels=4.0,
        world=0.04,
        turn=10.0,
    )
    focal = np.where(np.arange(views) < known, seen.focal, np.nan)
    visibility = seen.visibility * rng.uniform(0.2, 1.0, seen.visibility.shape)
    visibility[0, 3] = 0.0
    evidence, start = evidence_of(
        dataclasses.replace(seen, focal=focal, visibility=visibility), np.zeros(views, bool)
    )
    return evidence, moved(evidence, start, random_step(evidence, start, rng, 0.02))


def random_step(evidence, rig, rng, size):
    """Returns a random step; the means of views follow from the other changes."""
    c, k = evidence.weights.shape
    step = Step(
        rng.normal(0, size, (k, 3)),
        rng.normal(0, size, (c, VIEW)),
        rng.normal(0, size, int(evidence.kinds.max()) + 1),
    )
    turned = rig.landmarks @ np.swapaxes(rig.rotations, -1, -2)
    moves = step.landmarks @ np.swapaxes(rig.rotations, -1, -2) + np.cross(
        step.views[:, None, :3], turned
    )
    share = evidence.weights / evidence.weights.sum(1, keepdims=True)
    step.views[:, 6:] = np.einsum("ck,cka->ca", share, moves)
    return step


def scaled(step, factor):
    return Step(factor * step.landmarks, factor * step.views, factor * step.focal)


def changes(evidence, slopes, step):
    """Returns what the derivatives predict for a step.

    The two arrays are changes of the residuals of landmarks in views, and of those that tie
    landmarks.
    """
    seen = np.einsum("ckra,ka->ckr", slopes.by_landmark, step.landmarks) + np.einsum(
        "ckra,ca->ckr", slopes.by_view, step.views
    )
    seen += slopes.by_focal * step.focal[evidence.kinds][:, None, None]
    return seen, np.einsum("tka,ka->t", slopes.tied, step.landmarks)


@pytest.mark.parametrize(("views", "known"), [(1, 1), (3, 2), (4, 0)])
def test_derivatives_are_those_of_central_differences(views, known):
    evidence, rig = problem(views, known=known)
    slopes, rng = derivatives(evidence, rig, SCALE), np.random.default_rng(1)
    for _ in range(5):
        step = random_step(evidence, rig, rng, 1.0)
        after, before = (
            residuals(evidence, moved(evidence, rig, scaled(step, d)), SCALE)
            for d in (DIFFERENCE, -DIFFERENCE)
        )
        seen, tied = changes(evidence, slopes, step)
        for name, found in (("seen", seen), ("tied", tied), ("focal", step.focal)):
            expected = (getattr(after, name) - getattr(before, name)) / (2 * DIFFERENCE)
            np.testing.assert_allclose(found, expected, atol=RELATIVE * np.abs(expected).max())


def test_the_depth_of_a_landmark_behind_the_camera_does_not_move_its_pixel():
    evidence, rig = problem()
    places = rig.places * [1.0, 1.0, 0.0] + [0.0, 0.0, -2.0]
    behind = dataclasses.replace(rig, places=places)
    assert np.all(
        (behind.landmarks @ np.swapaxes(rig.rotations, -1, -2) + places[:, None])[..., 2] < NEAR
    )
    slopes = derivatives(evidence, behind, SCALE)
    step = Step(np.zeros_like(rig.landmarks), np.zeros((3, VIEW)), np.zeros(2))
    deeper = behind.rotations[0].T @ [0.0, 0.0, 1.0]
    seen, _ = changes(
        evidence,
        slopes,
        dataclasses.replace(step, landmarks=np.tile(deeper, (len(rig.landmarks), 1))),
    )
    np.testing.assert_allclose(seen[0, :, :2], 0, atol=1e-9)


def dense(evidence, rows, slopes):
    """Returns all derivatives as one matrix and all residuals as one vector.

    Loops go over the blocks of landmarks, views and focal lengths.
    """
    c, k = evidence.weights.shape
    g = len(rows.focal)
    J, r = [], []
    for v in range(c):
        for j in range(k):
            block = np.zeros((5, 3 * k + VIEW * c + g))
            block[:, 3 * j : 3 * j + 3] = slopes.by_landmark[v, j]
            block[:, 3 * k + VIEW * v : 3 * k + VIEW * (v + 1)] = slopes.by_view[v, j]
            block[:, 3 * k + VIEW * c + evidence.kinds[v]] = slopes.by_focal[v, j]
            J.append(block)
            r.append(rows.seen[v, j])
    J.append(np.pad(slopes.tied.reshape(len(rows.tied), 3 * k), ((0, 0), (0, VIEW * c + g))))
    J.append(np.pad(np.eye(g), ((0, 0), (3 * k + VIEW * c, 0))))
    return np.concatenate(J), np.concatenate([*r, rows.tied, rows.focal])


@pytest.mark.parametrize(("views", "known"), [(1, 1), (3, 2), (5, 0)])
def test_eliminated_landmarks_give_the_step_of_the_dense_normal_equations(views, known):
    evidence, rig = problem(views, known=known)
    rows, slopes = residuals(evidence, rig, SCALE), derivatives(evidence, rig, SCALE)
    normal, (J, r) = normal_equations(evidence, rows, slopes), dense(evidence, rows, slopes)
    k, m, damping = len(rig.landmarks), len(normal.by_cameras), 0.01
    # what is damped is what the elimination adds to its diagonals: not of the rows that tie
    # landmarks
    own = J[: -len(rows.tied) - len(rows.focal)]
    diagonal = np.sum(own**2, axis=0) + np.concatenate(
        [np.zeros(3 * k + VIEW * views), np.ones(len(rows.focal))]
    )
    added = damping * diagonal + 1e-6
    expected = -np.linalg.solve(J.T @ J + np.diag(added), J.T @ r)
    step, decrease = solve(normal, damping)
    found = np.concatenate([step.landmarks.ravel(), step.views.ravel(), step.focal])
    np.testing.assert_allclose(found, expected, atol=1e-7 * np.abs(expected).max())
    assert decrease == pytest.approx(-(J.T @ r) @ expected - 0.5 * expected @ (J.T @ J) @ expected)
    assert isinstance(normal, NormalEquations) and m == VIEW * views + len(rows.focal)


@pytest.mark.parametrize("views", [1, 2, 6])
def test_at_the_minimum_nothing_near_it_costs_less(views):
    evidence, rig = problem(views)
    found, cost = adjust(evidence, rig)
    assert cost == pytest.approx(residuals(evidence, found, SCALE).cost)
    assert cost < residuals(evidence, rig, SCALE).cost
    rng = np.random.default_rng(2)
    for _ in range(20):
        near = moved(evidence, found, random_step(evidence, found, rng, 1e-3))
        assert residuals(evidence, near, SCALE).cost > cost * (1 - 1e-7)


def test_focal_lengths_of_one_kind_keep_their_ratio_and_kinds_do_not_move_each_other():
    evidence, rig = problem(4, known=2)
    one = moved(
        evidence,
        rig,
        Step(np.zeros_like(rig.landmarks), np.zeros((4, VIEW)), np.asarray([1.0, 0.0])),
    )
    ratio = one.focal / rig.focal
    assert ratio[0] == pytest.approx(ratio[1]) and ratio[0] > 1.01
    np.testing.assert_allclose(ratio[2:], 1)


def test_turning_and_moving_everything_changes_no_residual():
    evidence, rig = problem(3)
    turn, shift = (
        np.linalg.qr(np.random.default_rng(3).normal(size=(3, 3)))[0],
        np.asarray([0.3, -0.2, 0.5]),
    )
    turn *= np.linalg.det(turn)
    elsewhere = Rig(
        landmarks=rig.landmarks @ turn.T + shift,
        rotations=rig.rotations @ turn.T,
        places=rig.places - rig.rotations @ turn.T @ shift,
        focal=rig.focal,
    )
    np.testing.assert_allclose(
        pixel_errors(evidence, elsewhere), pixel_errors(evidence, rig), atol=1e-8
    )
    assert residuals(evidence, elsewhere, SCALE).cost == pytest.approx(
        residuals(evidence, rig, SCALE).cost
    )
