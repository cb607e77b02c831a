import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from humangs_jax.fitting.similarity import Similarity, align_points, align_robustly


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
