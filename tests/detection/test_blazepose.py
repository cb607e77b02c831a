"""Pre- and postprocessing of BlazePose: pure functions on small inputs."""

import importlib

import numpy as np
import pytest

from humangs_jax.detection.people import (
    ENLARGED,
    Crop,
    Detection,
    Landmarks,
    Networks,
    _anchors,
    _merged,
    bilinear,
    distinct,
    mask_at,
    mask_in_photo,
    refined,
    sampled,
    windows,
)

ROUNDING = 1e-9
"""Of float64 pixels up to some thousands."""


@pytest.mark.parametrize("angle", [0.0, 0.4, np.pi / 2, -3.0])
def test_a_crop_maps_to_the_photo_and_back(angle):
    crop = Crop(np.asarray([120.0, 80.0]), 50.0, angle)
    points = np.random.default_rng(0).uniform(-1, 2, (7, 5, 2))
    np.testing.assert_allclose(crop.from_photo(crop.to_photo(points)), points, atol=ROUNDING)
    np.testing.assert_allclose(crop.to_photo(np.asarray([0.5, 0.5])), crop.center, atol=ROUNDING)


@pytest.mark.parametrize("head", [(0.0, -10.0), (10.0, 0.0), (0.0, 10.0), (-6.0, 8.0)])
def test_the_second_point_of_a_detection_is_above_the_middle_of_its_crop(head):
    hips = np.asarray([40.0, 30.0])
    crop = Detection(0.9, hips, hips + head).crop()
    assert crop.side == pytest.approx(2 * ENLARGED * 10)
    np.testing.assert_allclose(crop.from_photo(hips + head), [0.5, 0.5 - 0.5 / ENLARGED], atol=ROUNDING)


def test_anchors_are_the_detectors():
    anchors = _anchors()
    assert anchors.shape == (2254, 2)  # 28 * 28 * 2 + 14 * 14 * 2 + 7 * 7 * 6
    np.testing.assert_allclose(anchors[:3], [[4 / 224] * 2, [4 / 224] * 2, [12 / 224, 4 / 224]], atol=ROUNDING)
    np.testing.assert_allclose(anchors[-1], [1 - 16 / 224] * 2, atol=ROUNDING)


def test_boxes_that_overlap_the_best_are_averaged_by_score():
    boxes = np.zeros((3, 12))
    boxes[:, 2:4] = 0.2
    boxes[:, 0] = 0.30, 0.32, 0.70
    (best, mean), (other, alone) = _merged(np.asarray([0.6, 0.9, 0.7]), boxes)
    assert (best, other) == (0.9, 0.7)
    assert mean[0] == pytest.approx((0.6 * 0.30 + 0.9 * 0.32) / 1.5) and alone[0] == pytest.approx(0.70)


def test_landmarks_move_to_the_centroid_of_their_peak_only():
    heatmaps = np.zeros((16, 16, 3))
    heatmaps[6, 8, 0], heatmaps[6, 9, 0] = 0.6, 0.2
    heatmaps[6, 8, 1] = 0.4  # too low
    points = np.asarray([[7.5, 5.5], [7.5, 5.5], [20.0, 3.0]]) / 16  # the last: outside of the heatmap
    moved = refined(points, heatmaps) * 16
    np.testing.assert_allclose(moved, [[8.25, 6.0], [7.5, 5.5], [20.0, 3.0]], atol=ROUNDING)


def test_a_peak_at_the_border_of_the_heatmap_counts():
    heatmaps = np.zeros((16, 16, 1))
    heatmaps[0, 15, 0] = 0.9
    np.testing.assert_allclose(refined(np.asarray([[15.9, 0.1]]) / 16, heatmaps) * 16, [[15.0, 0.0]], atol=ROUNDING)


def test_bilinear_is_linear_between_pixels_and_repeats_or_ends_at_the_edge():
    image = np.asarray([[0.0, 1.0, 2.0], [4.0, 5.0, 6.0]], np.float32)
    points = np.asarray([[[0.5, 0.5], [2.0, 1.0], [-0.5, 0.0], [-7.0, 0.0], [1.0, 9.0]]])
    np.testing.assert_allclose(bilinear(image, points), [[2.5, 6.0, 0.0, 0.0, 5.0]])
    np.testing.assert_allclose(bilinear(image, points, outside=-1.0), [[2.5, 6.0, 0.0, -1.0, -1.0]])
    colors = bilinear(np.stack([image, image + 1], axis=-1), points)
    np.testing.assert_allclose(colors[..., 1] - colors[..., 0], 1.0)


@pytest.mark.parametrize("angle", [0.0, 0.7, -3.0])
def test_the_mask_of_a_crop_at_the_size_of_the_photo_is_the_one_at_its_pixels(angle):
    noise = np.random.default_rng(0).uniform(size=(16, 16))
    mask = np.kron(noise, np.ones((16, 16))).astype(np.float32)
    mask[:2] = mask[-2:] = mask[:, :2] = mask[:, -2:] = 0  # the two differ in how the last half pixel ends
    crop = Crop(np.asarray([30.0, 21.0]), 40.0, angle)
    nobody = Landmarks(np.zeros((33, 2)), np.ones(33), np.zeros((33, 3)), 1.0, mask, crop, Detection(1.0, *np.eye(2)))
    grid = np.stack(np.meshgrid(np.arange(64), np.arange(36)), axis=-1).astype(float)
    expected = mask_at(nobody, grid.reshape(-1, 2)).reshape(36, 64)
    assert expected.max() > 0.9
    np.testing.assert_allclose(mask_in_photo(nobody, 64, 36), expected, atol=1e-3)


@pytest.mark.parametrize("shape", [(1, 1), (1, 5), (5, 1)])
def test_bilinear_of_a_photo_of_one_row_or_column(shape):
    image = np.arange(np.prod(shape), dtype=np.float32).reshape(shape)
    grid = np.stack(np.meshgrid(np.arange(shape[1]), np.arange(shape[0])), axis=-1).astype(float)
    np.testing.assert_array_equal(bilinear(image, grid), image)


def test_an_upright_crop_of_the_photos_size_is_the_photo():
    photo = np.random.default_rng(0).uniform(size=(8, 8, 3)).astype(np.float32)
    np.testing.assert_allclose(sampled(photo, Crop(np.asarray([4.0, 4.0]), 8.0, 0.0), 8), photo, atol=1e-6)


@pytest.mark.parametrize("size", [(640, 640), (1920, 1080), (300, 4000), (7, 5)])
def test_windows_cover_the_photo_at_every_scale_and_none_is_beside_it(size):
    found = windows(*size)
    sides = sorted({round(window.side, 6) for window in found}, reverse=True)
    assert sides == [round(max(size) * share, 6) for share in (1.0, 0.5, 0.25)]
    for side in sides:
        low = np.stack([window.center - side / 2 for window in found if round(window.side, 6) == side])
        assert ((low < size) & (low + side > 0)).all()
        points = np.random.default_rng(0).uniform(0, size, (200, 2))
        covered = (points[:, None] >= low - ROUNDING) & (points[:, None] <= low + side + ROUNDING)
        assert covered.all(-1).any(-1).all()


def test_detections_of_one_person_are_one_and_the_best_is_kept():
    person = lambda score, x, size: Detection(score, np.asarray([x, 50.0]), np.asarray([x, 50.0 - size]))
    found = [person(0.9, 50.0, 20.0), person(0.8, 53.0, 22.0), person(0.7, 50.0, 40.0), person(0.6, 90.0, 20.0)]
    assert [each.score for each in distinct(found, 200)] == [0.9, 0.7, 0.6]
    assert distinct(found, 20_000) == []  # specks


def test_without_litert_the_line_says_what_to_install(monkeypatch):
    def missing(name):
        raise ImportError(name)

    monkeypatch.setattr(importlib, "import_module", missing)
    with pytest.raises(ImportError, match=r"pip install 'humangs_jax\[photos\]'"):
        Networks()
