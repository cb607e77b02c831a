"""Lens distortion: where it puts points, and photos without it."""

import numpy as np
import pytest

from humangs_jax.data.calibration.calibration import _squared_reach, distort, undistort, undistort_person


def test_dots_land_where_the_pinhole_says():
    K = np.asarray([[110.0, 0, 63.5], [0, 108, 50], [0, 0, 1]])
    coefficients = np.asarray([-0.25, 0.08, 0.004, -0.003, 0.01])
    dots = np.stack(np.meshgrid(np.arange(-4, 5) * 0.12, np.arange(-3, 4) * 0.12), axis=-1).reshape(-1, 2)
    pinhole, lens = (plane * np.diag(K)[:2] + K[:2, 2] for plane in (dots, distort(dots, coefficients)))
    assert np.linalg.norm(pinhole - lens, axis=-1).max() > 4  # the lens matters
    columns, rows = np.meshgrid(np.arange(128) + 0.5, np.arange(100) + 0.5)
    spots = lambda where: np.exp(-((columns - where[0]) ** 2 + (rows - where[1]) ** 2) / (2 * 1.5**2))
    photo = sum(spots(where) for where in lens).astype(np.float32)
    straight = undistort(photo, K, coefficients, fill=0.0)
    for where in pinhole:
        near = straight * (np.hypot(columns - where[0], rows - where[1]) < 5)
        centroid = np.asarray([(near * columns).sum(), (near * rows).sum()]) / near.sum()
        np.testing.assert_allclose(centroid, where, atol=0.06)  # of bilinear lookups; the dots move by up to 4.9 px


@pytest.mark.parametrize("focal, coefficients", [(400, [-0.1, 0.03, 1e-3, -1e-3, 0]), (60, [-0.3, 0, 0, 0, 0])])
def test_a_person_is_undistorted_as_the_whole_photo_is(focal, coefficients):
    """Also where the lens folds, and with nobody in the photo."""
    K, coefficients = np.asarray([[focal, 0, 66.0], [0, focal, 50], [0, 0, 1]]), np.asarray(coefficients)
    random = np.random.default_rng(0)
    for rows, columns in ((slice(30, 70), slice(50, 75)), (slice(0, 20), slice(100, 130)), (slice(0), slice(0))):
        mask = np.zeros((100, 130), np.float32)
        mask[rows, columns] = 1
        image = np.where(mask[..., None] > 0, random.random((100, 130, 3), np.float32), np.float32(1))
        straight, person = undistort_person(image, mask, K, coefficients)
        np.testing.assert_array_equal(person, undistort(mask, K, coefficients, fill=0.0))
        np.testing.assert_allclose(straight, undistort(image, K, coefficients, fill=1.0), atol=1e-6)


def test_distortion_is_opencvs():
    # by hand: r^2 = 0.05, radial = 1 + 0.1 * 0.05 - 0.2 * 0.0025 + 0.5 * 0.000125
    radial = 1 + 0.005 - 0.0005 + 0.0000625
    x = 0.1 * radial + 2 * 0.01 * 0.02 + 0.03 * (0.05 + 0.02)
    y = 0.2 * radial + 0.01 * (0.05 + 0.08) + 2 * 0.03 * 0.02
    got = distort(np.asarray([0.1, 0.2]), np.asarray([0.1, -0.2, 0.01, 0.03, 0.5]))
    np.testing.assert_allclose(got, [x, y], rtol=1e-12)


def test_a_folded_lens_shows_nothing_twice():
    K = np.asarray([[30.0, 0, 40], [0, 30, 40], [0, 0, 1]])
    photo = np.zeros((80, 80), np.float32)
    straight = undistort(photo, K, np.asarray([-0.3, 0, 0, 0, 0.0]), fill=1.0)
    r = np.hypot(*(np.mgrid[:80, :80] + 0.5 - 40)) / 30
    np.testing.assert_array_equal(straight[r**2 >= 1 / 0.9], 1)
    np.testing.assert_array_equal(straight[r**2 < 1 / 0.9 - 0.05], 0)


@pytest.mark.parametrize("folds", [(2,), (3, 2), (5, 2, 3), (-1, 4), (-1, -2, -3), ()])
def test_a_lens_folds_at_the_first_root_of_its_slope(folds):
    """The slope d/dr (r + k1 r^3 + k2 r^5 + k3 r^7) as a product of (1 - r^2 / fold)."""
    slope = np.polynomial.Polynomial([1.0])
    for fold in folds:
        slope *= np.polynomial.Polynomial([1, -1 / fold])
    k1, k2, k3 = np.pad(slope.coef, (0, 4 - len(slope.coef)))[1:] / [3, 5, 7]
    expected = min((fold for fold in folds if fold > 0), default=np.inf)
    assert _squared_reach(np.array([k1, k2, 0, 0, k3])) == pytest.approx(expected, rel=1e-9)


def test_coefficients_of_a_lens_may_be_tiny_or_huge():
    for k3 in (1e-310, -1e-310):
        assert _squared_reach([-0.3, 0, 0, 0, k3]) == pytest.approx(1 / 0.9, rel=1e-9)
    assert 0 < _squared_reach(np.full(5, -1e308)) < 1e-30
