"""People found in the demo's photos, whose bodies are known, and steps of BlazePose."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy import ndimage

from humangs_jax.body.landmarks import landmark_model, pose_landmarks
from humangs_jax.capture.detection.painting import painted_over
from humangs_jax.capture.detection.people import (
    ENLARGED,
    Crop,
    Detection,
    Landmarks,
    Networks,
    bilinear,
    distinct,
    find_people,
    mask_at,
    mask_in_photo,
    refined,
    windows,
)
from humangs_jax.capture.detection.sharpening import sharpened
from humangs_jax.io.images import resized


@pytest.fixture(scope="module")
def networks():
    return Networks()


PARTS = {"shoulder": 11, "elbow": 13, "wrist": 15, "hip": 23, "knee": 25, "ankle": 27}
"""Number of the left landmark; the right one follows."""
NAMES = tuple(f"{side}_{part}" for part in PARTS for side in ("left", "right"))
MEDIAN_ERROR, LARGEST_ERROR, LEAST_OVERLAP = 0.035, 0.1, 0.9
"""Bounds on joint errors as shares of the person's height, and on the mask's overlap.

Over all views and turns at most 0.028 and 0.075 and at least 0.915 were measured. A landmark is
some 2 cm from the joint's centre.
"""


def expected(capture, view):
    """Returns (joints in the photo, the person's height), pixels."""
    model = landmark_model(capture.body, NAMES)
    points, _ = pose_landmarks(
        model, jnp.asarray(capture.betas), capture.pose(int(capture.frames[view]))
    )
    transform, K = (
        np.asarray(x[view]) for x in (capture.cameras.cam_from_world, capture.cameras.K)
    )
    seen = (np.asarray(points) @ transform[:3, :3].T + transform[:3, 3]) @ K.T
    return seen[:, :2] / seen[:, 2:], np.ptp(np.flatnonzero((capture.masks[view] > 0.5).any(1)))


def check(person, joints, height, mask):
    indices = [PARTS[name.split("_")[1]] + name.startswith("right") for name in NAMES]
    errors = np.linalg.norm(person.pixels[indices] + 0.5 - joints, axis=-1) / height
    assert np.median(errors) < MEDIAN_ERROR and errors.max() < LARGEST_ERROR
    ours, theirs = mask_in_photo(person, *mask.shape[::-1]) > 0.5, mask > 0.5
    assert (ours & theirs).sum() / (ours | theirs).sum() > LEAST_OVERLAP


@pytest.mark.parametrize(
    ("view", "turns"),
    [
        (0, 0),
        (1, 1),
        *(pytest.param(v, t, marks=pytest.mark.slow) for v in range(4) for t in range(4)),
    ],
)
def test_the_person_is_found_whichever_way_up_the_photo_is(networks, demo, view, turns):
    photo = np.ascontiguousarray(np.rot90(demo.images[view], turns), np.float32)
    (person,) = find_people(networks, photo)
    joints, height = expected(demo, view)
    center = photo.shape[0] / 2
    for _ in range(turns):
        joints = np.stack([joints[:, 1], 2 * center - joints[:, 0]], axis=-1)
    check(person, joints, height, np.rot90(demo.masks[view], turns))
    up = np.asarray([[0, -1], [-1, 0], [0, 1], [1, 0]])[turns]  # the head's direction in the photo
    assert person.world[0, :2] @ up > 0.4  # metres from the hips to the nose


def test_a_small_person_in_a_large_photo(networks, demo):
    scale, corner = 0.4, (180, 620)
    small = resized(demo.images[0], 205, 205)
    photo = np.full((900, 1400, 3), 0.8, np.float32)
    photo[corner[0] : corner[0] + 205, corner[1] : corner[1] + 205] = small
    mask = np.zeros(photo.shape[:2])
    mask[corner[0] : corner[0] + 205, corner[1] : corner[1] + 205] = resized(
        demo.masks[0], 205, 205
    )
    joints, height = expected(demo, 0)
    (person,) = find_people(networks, photo)
    assert scale * height / max(photo.shape) < 0.15  # the detector alone needs twice that
    check(person, joints * 205 / 512 + (corner[1], corner[0]), scale * height, mask)


@pytest.mark.slow
def test_nobody_in_noise_and_in_the_dark(networks):
    noise = np.random.default_rng(0).uniform(size=(160, 160, 3)).astype(np.float32)
    assert find_people(networks, noise) == []
    assert find_people(networks, np.zeros_like(noise)) == []


class Drifting(Networks):
    """A landmark network that sees one person, well in a crop of the right size.

    Larger crops far away drift towards the person, with wrong points.
    """

    hips, side = np.asarray([200.0, 300.0]), 240.0

    def __init__(self):
        """Needs no files of weights."""

    def detect(self, photo, window):
        if window.side < max(photo.shape):
            return []
        about = lambda score, hips, side: Detection(score, hips, hips - [0, side / 2 / ENLARGED])
        return [about(0.9, self.hips, self.side), about(0.6, np.asarray([60.0, 180.0]), 600.0)]

    def landmarks(self, photo, crop):
        right = crop.side < 1.1 * self.side
        points = (
            self.hips + np.random.default_rng(0).uniform(-50, 50, (33, 2)) + (0 if right else 40)
        )
        center, side = (
            (self.hips, self.side) if right else (0.5 * (crop.center + self.hips), 0.9 * crop.side)
        )
        again = Detection(1.0, center, center - np.asarray([0, side / 2 / ENLARGED]))
        return Landmarks(
            points, np.ones(33), np.zeros((33, 3)), 1.0, np.ones((256, 256)), crop, again
        )


def test_the_landmarks_of_a_crop_that_settled_are_taken():
    (person,) = find_people(Drifting(), np.zeros((600, 400, 3), np.float32))
    assert person.crop.side == pytest.approx(Drifting.side)
    np.testing.assert_allclose(person.pixels.mean(0), Drifting.hips, atol=20)


@pytest.mark.parametrize(("anybody", "shares"), [(True, {1.0, 0.5}), (False, {1.0, 0.5, 0.25})])
def test_the_smallest_windows_are_looked_at_only_where_nobody_is_large(
    anybody, shares, monkeypatch
):
    seen, networks = [], Drifting()
    found = networks.detect if anybody else lambda *_: []
    monkeypatch.setattr(
        networks, "detect", lambda photo, window: seen.append(window.side) or found(photo, window)
    )
    assert len(find_people(networks, np.zeros((600, 400, 3), np.float32))) == anybody
    assert {side / 600 for side in seen} == shares


def test_whoever_stands_half_behind_somebody_is_found_without_what_is_covered(networks, demo):
    """The first person is painted over, so that the other one can be found."""
    front = demo.masks[0]
    step = round(0.7 * np.ptp(np.flatnonzero((front > 0.5).any(0))))
    image, mask = (np.roll(each[2], step, axis=1) for each in (demo.images, demo.masks))
    room = np.full_like(image, 0.7)
    photo = image * mask[..., None] + room * (1 - mask[..., None])
    photo = demo.images[0] * front[..., None] + photo * (1 - front[..., None])
    people = find_people(networks, photo)
    assert len(people) == 2
    seen = {"front": front, "behind": mask * (1 - front)}
    masks = [mask_in_photo(each, *mask.shape[::-1]) for each in people]
    for true in seen.values():
        best = max(masks, key=lambda each: (each * true).sum())
        ours, theirs = best > 0.5, true > 0.5
        assert (ours & theirs).sum() / (ours | theirs).sum() > 0.7
    both = (masks[0] > 0.5) & (masks[1] > 0.5)
    assert both.sum() < 0.1 * (mask > 0.5).sum()


def test_who_is_painted_over_takes_the_colors_around():
    photo = np.full((90, 120, 3), 0.2, np.float32)
    photo[:, 60:] = 0.8
    covered = np.zeros((90, 120), bool)
    covered[20:70, 20:40] = True
    shown = np.where(covered[..., None], np.float32(0.5), photo)
    painted, where = painted_over(shown, covered, 1 / 100)
    assert where[covered].all() and where.sum() < 1.5 * covered.sum()
    np.testing.assert_allclose(painted, photo, atol=0.01)


PERSON, ROOM = np.asarray([0.7, 0.5, 0.4], np.float32), np.asarray([0.2, 0.3, 0.6], np.float32)


def scene(scale):
    """Returns (photo, true coverage, mask of a network) of a body with a thin arm.

    The network's mask has one pixel for `scale` pixels of the photo.
    """
    y, x = np.mgrid[: 60 * scale, : 60 * scale] / scale
    true = (
        (np.hypot((x - 30) / 12, (y - 32) / 22) < 1)
        | ((np.abs(y - 20) < 1.2) & (x > 30) & (x < 54))
    ).astype(np.float32)
    photo = PERSON * true[..., None] + ROOM * (1 - true[..., None])
    photo += 0.02 * np.random.default_rng(0).normal(size=photo.shape).astype(np.float32)
    coarse = ndimage.gaussian_filter(resized(true, 60, 60), 0.8)
    return photo.clip(0, 1), true, resized(coarse, 60 * scale, 60 * scale).clip(0, 1)


def overlap(one, other):
    return (one & other).sum() / (one | other).sum()


@pytest.mark.parametrize("scale", [2, 4, 8])
def test_edges_move_to_those_of_the_photo_and_thin_parts_stay(scale):
    photo, true, mask = scene(scale)
    found, inside = sharpened(mask, photo, float(scale)), true > 0.5
    before, after = (overlap(each > 0.5, inside) for each in (mask, found))
    assert 1 - after < 0.5 * (1 - before)
    arm = inside.copy()
    arm[:, : 44 * scale] = False
    assert (found > 0.5)[arm].mean() > max(0.9, (mask > 0.5)[arm].mean())
    assert np.abs(found - true).mean() < np.abs(mask - true).mean()


def test_what_is_far_from_the_person_stays_clear():
    photo, _, mask = scene(4)
    mask[:, :40] = 0
    found = sharpened(mask, photo, 4.0)
    assert not found[:, :20].any()
    np.testing.assert_array_equal(sharpened(np.zeros_like(mask), photo, 4.0), 0)


def test_a_photo_without_edges_leaves_the_place_of_the_edge():
    _, _, mask = scene(4)
    flat = np.full((*mask.shape, 3), 0.5, np.float32)
    found = sharpened(mask, flat, 4.0)
    assert overlap(found > 0.5, mask > 0.4) > 0.9


# Pre- and postprocessing
# -----------------------------------------------------------------------------------------------

ROUNDING = 1e-9
"""Rounding of float64 pixels up to some thousands."""


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
    np.testing.assert_allclose(
        crop.from_photo(hips + head), [0.5, 0.5 - 0.5 / ENLARGED], atol=ROUNDING
    )


def test_landmarks_move_to_the_centroid_of_their_peak_only():
    heatmaps = np.zeros((16, 16, 4))
    heatmaps[6, 8, 0], heatmaps[6, 9, 0] = 0.6, 0.2
    heatmaps[6, 8, 1] = 0.4  # too low
    heatmaps[0, 15, 3] = 0.9  # at the border
    # the third: outside of the heatmap
    points = np.asarray([[7.5, 5.5], [7.5, 5.5], [20.0, 3.0], [15.9, 0.1]]) / 16
    moved = refined(points, heatmaps) * 16
    np.testing.assert_allclose(
        moved, [[8.25, 6.0], [7.5, 5.5], [20.0, 3.0], [15.0, 0.0]], atol=ROUNDING
    )


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
    mask[:2] = mask[-2:] = mask[:, :2] = mask[:, -2:] = (
        0  # the two differ in how the last half pixel ends
    )
    crop = Crop(np.asarray([30.0, 21.0]), 40.0, angle)
    nobody = Landmarks(
        np.zeros((33, 2)),
        np.ones(33),
        np.zeros((33, 3)),
        1.0,
        mask,
        crop,
        Detection(1.0, *np.eye(2)),
    )
    grid = np.stack(np.meshgrid(np.arange(64), np.arange(36)), axis=-1).astype(float)
    expected = mask_at(nobody, grid.reshape(-1, 2)).reshape(36, 64)
    assert expected.max() > 0.9
    np.testing.assert_allclose(mask_in_photo(nobody, 64, 36), expected, atol=1e-3)


@pytest.mark.parametrize("size", [(640, 640), (1920, 1080), (300, 4000), (7, 5)])
def test_windows_cover_the_photo_at_every_scale_and_none_is_beside_it(size):
    found = windows(*size)
    sides = sorted({round(window.side, 6) for window in found}, reverse=True)
    assert sides == [round(max(size) * share, 6) for share in (1.0, 0.5, 0.25)]
    for side in sides:
        low = np.stack(
            [window.center - side / 2 for window in found if round(window.side, 6) == side]
        )
        assert ((low < size) & (low + side > 0)).all()
        points = np.random.default_rng(0).uniform(0, size, (200, 2))
        covered = (points[:, None] >= low - ROUNDING) & (points[:, None] <= low + side + ROUNDING)
        assert covered.all(-1).any(-1).all()


def test_detections_of_one_person_are_one_and_the_best_is_kept():
    def person(score, x, size):
        return Detection(score, np.asarray([x, 50.0]), np.asarray([x, 50.0 - size]))

    found = [
        person(0.9, 50.0, 20.0),
        person(0.8, 53.0, 22.0),
        person(0.7, 50.0, 40.0),
        person(0.6, 90.0, 20.0),
    ]
    assert [each.score for each in distinct(found, 200)] == [0.9, 0.7, 0.6]
    assert distinct(found, 20_000) == []  # specks
