import jax
import jax.numpy as jnp
import numpy as np
import pytest
from fit_people import model_of, observe
from scipy.spatial.transform import Rotation

from humangs_jax.core.pytree import replace
from humangs_jax.fitting import triangulation
from humangs_jax.fitting.triangulation import (
    Similarity,
    align_points,
    align_robustly,
    reprojection_errors,
    triangulate,
    triangulate_robustly,
)

EXACT = 2e-4  # metres: float32 pixels of 512 at 3 metres
KNOWN = np.asarray(model_of().known)

plain, robust = (jax.jit(jax.vmap(f)) for f in (triangulate, triangulate_robustly))


def scene(**changes):
    joints, _, seen = observe(["standing", "crouching"], **changes)
    return joints, seen


def truth(joints):
    """The landmarks that are joints: both knees and wrists, by name."""
    names = ("left_knee", "right_knee", "left_wrist", "right_wrist")
    rows = [model_of().names.index(name) for name in names]
    return rows, joints[:, [model_of().joint_names.index(name) for name in names]]


@pytest.mark.slow
@pytest.mark.parametrize("method", [plain, robust], ids=["plain", "robust"])
@pytest.mark.parametrize("views", [2, 5])
def test_exact_points_are_found(method, views):
    joints, seen = scene(views=views)
    points, counts = method(seen)[:2]
    rows, expected = truth(joints)
    np.testing.assert_allclose(np.asarray(points)[:, rows], expected, atol=EXACT)
    assert (np.asarray(counts)[:, KNOWN] == views).all()
    assert (np.asarray(counts)[:, ~KNOWN] == 0).all()


@pytest.mark.slow
def test_a_wrong_view_is_left_out():
    joints, seen = scene(views=4)
    off = replace(seen, points=seen.points.at[:, 2].add(80.0))
    rows, expected = truth(joints)
    error = lambda found: np.linalg.norm(np.asarray(found[0])[:, rows] - expected, axis=-1).max()
    assert error(robust(off)) < EXACT < 0.05 < error(plain(off))
    weights = np.asarray(robust(off)[2])
    assert (weights[:, 2][:, KNOWN] == 0).all() and (weights[:, [0, 1, 3]][:, :, KNOWN] > 0).all()


def test_what_no_two_views_agree_on_is_unknown():
    _, seen = scene(views=2)
    apart = replace(seen, points=seen.points.at[:, 0, :, 1].add(120.0))
    _, counts, weights = robust(apart)
    assert (np.asarray(counts)[:, KNOWN] == 0).mean() > 0.8  # some agree by chance, far away
    assert np.isfinite(weights).all()


def test_of_noisy_points_the_pixels_errors_are_least():
    """Cameras of several focal lengths: no other point in space has smaller squared errors."""
    _, seen = scene(views=4)
    one, scale = jax.tree.map(lambda leaf: leaf[0], seen), jnp.asarray([1.0, 4.0, 0.3, 2.0])
    middle, noise = one.K[:, None, :2, 2], np.random.default_rng(0).normal(0, 3, one.points.shape)
    K = one.K.at[:, :2, :2].multiply(scale[:, None, None])
    one = replace(one, points=(one.points - middle) * scale[:, None, None] + middle + noise, K=K)
    points = triangulate(one)[0]
    cost = lambda points: np.square(reprojection_errors(one, points)).sum(axis=0)[KNOWN]
    moves = 0.004 * np.concatenate([np.eye(3), -np.eye(3)]).astype(np.float32)  # metres
    least = np.min([cost(points + move) for move in moves], axis=0)
    assert (cost(points) < least).all()


def test_one_view_has_no_points_in_space():
    _, seen = scene(views=1)
    points, counts, _ = robust(seen)
    assert not np.asarray(counts).any() and np.isfinite(points).all()


def test_parallel_rays_stay_finite():
    _, seen = scene(views=2)
    same = jax.tree.map(lambda leaf: leaf.at[:, 1].set(leaf[:, 0]) if leaf.ndim > 1 else leaf, seen)
    assert np.isfinite(plain(same)[0]).all() and np.isfinite(robust(same)[0]).all()


def test_a_point_behind_a_camera_is_no_match():
    _, seen = scene(views=2)
    one = jax.tree.map(lambda leaf: leaf[0], seen)
    rotation, translation = np.asarray(one.cam_from_world[0, :3, :3]), np.asarray(one.cam_from_world[0, :3, 3])
    behind = -rotation.T @ translation - 3 * rotation[2]
    errors = reprojection_errors(one, jnp.asarray(np.broadcast_to(behind, (133, 3)), jnp.float32))
    assert (np.asarray(errors)[0] > 1e5).all()


@pytest.mark.slow
def test_pairs_of_views_are_compared_a_few_at_a_time_with_the_same_result(monkeypatch):
    _, seen = scene(views=12)
    found, bytes_ = {}, {}
    for pairs in (4, 66):  # all 66: at once
        monkeypatch.setattr(triangulation, "PAIRS_AT_ONCE", pairs)
        program = jax.jit(jax.vmap(lambda seen: triangulate_robustly(seen))).lower(seen).compile()
        found[pairs], bytes_[pairs] = program(seen), program.memory_analysis().temp_size_in_bytes
    assert bytes_[4] < bytes_[66] / 4
    np.testing.assert_array_equal(found[4][1], found[66][1])
    np.testing.assert_allclose(found[4][0][:, KNOWN], found[66][0][:, KNOWN], atol=EXACT)


def random_similarity(seed):
    rng = np.random.default_rng(seed)
    scale = float(10 ** rng.uniform(-2, 2))
    return Similarity(scale, Rotation.random(rng=rng).as_matrix(), scale * rng.normal(size=3))


@pytest.mark.parametrize("seed", range(5))
def test_the_similarity_between_points_is_found(seed):
    true, points = random_similarity(seed), np.random.default_rng(seed).normal(size=(6, 3))
    found = align_points(points, true(points), np.ones(6))
    np.testing.assert_allclose(found.matrix(), true.matrix(), atol=1e-9 * true.scale)


def test_mirrored_points_get_a_proper_rotation():
    points = np.random.default_rng(0).normal(size=(8, 3))
    assert np.linalg.det(align_points(points, points * [-1, 1, 1], np.ones(8)).rotation) == pytest.approx(1)


def test_points_without_weight_do_not_count():
    true, points = random_similarity(1), np.random.default_rng(1).normal(size=(6, 3))
    target = true(points)
    target[5] += 100
    found = align_points(points, target, np.asarray([1.0, 1, 1, 1, 1, 0]))
    np.testing.assert_allclose(found.matrix(), true.matrix(), atol=1e-9 * true.scale)


def test_a_wild_point_is_outweighed():
    rng = np.random.default_rng(2)
    points = rng.normal(size=(12, 3))
    target = points.copy()
    target[0] += 3
    off = lambda found: np.abs(found(points[1:]) - points[1:]).max()
    robust = off(align_robustly(points, target, np.ones(12), 0.02))
    assert robust < 0.02
    assert off(align_points(points, target, np.ones(12))) > 10 * robust


def test_similarities_compose_and_invert():
    first, second, points = random_similarity(3), random_similarity(4), np.random.default_rng(3).normal(size=(5, 3))
    np.testing.assert_allclose(second.after(first)(points), second(first(points)), rtol=1e-12)
    np.testing.assert_allclose(first.inverse()(first(points)), points, rtol=1e-10)
    homogeneous = np.concatenate([points, np.ones((5, 1))], axis=1)
    np.testing.assert_allclose((homogeneous @ first.matrix().T)[:, :3], first(points), rtol=1e-12)


@pytest.mark.parametrize("points", [np.eye(3)[:2], np.outer(np.arange(4.0), [1, 2, 3])], ids=["two", "on a line"])
def test_points_that_say_nothing_are_refused(points):
    with pytest.raises(ValueError, match="three points"):
        align_points(points, points, np.ones(len(points)))
