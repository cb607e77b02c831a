"""Pixels where somebody may stand in front of the person.

Nothing is concluded from them, and they are kept with a capture.
"""

import dataclasses

import numpy as np
import pytest
from changes import edit_json

from humangs_jax.capture.fitting.residuals.silhouettes import mask_boundary
from humangs_jax.capture.fitting.silhouette_fit import overlap
from humangs_jax.core.pytree import replace
from humangs_jax.data.body_and_masks import views_without_person
from humangs_jax.data.capture import CaptureError, load_capture, save_capture
from humangs_jax.data.hidden import hidden_line, hidden_parts, with_hidden_parts
from humangs_jax.data.prepared import prepare_capture
from humangs_jax.data.vertex_offsets import fit_vertex_offsets
from humangs_jax.data.views import cropped
from humangs_jax.evaluation.scores import score
from humangs_jax.io.images import read_grey, write_png
from humangs_jax.refinement.photos import crop_to_person, photos_of


@pytest.fixture
def hidden(demo):
    """The demo with a bar before the left half of the person in the first photo.

    Pixels of the bar are unknown, white, and outside of the mask.
    """
    unknown = np.zeros(demo.masks.shape, bool)
    columns = np.flatnonzero((demo.masks[0] > 0.5).any(0))
    left, right = columns[0] - 4, (columns[0] + columns[-1]) // 2
    unknown[0, :, left:right] = True
    images = np.where(unknown[..., None], np.float32(1), demo.images)
    masks = np.where(unknown, np.float32(0), demo.masks)
    return dataclasses.replace(demo, images=images, masks=masks, unknown=unknown)


def test_what_is_unknown_is_kept_and_the_mask_is_empty_there(hidden, demo, tmp_path):
    save_capture(tmp_path / "c", hidden)
    read = load_capture(tmp_path / "c")
    np.testing.assert_array_equal(read.unknown, hidden.unknown)
    assert not read.masks[hidden.unknown].any() and (read.images[hidden.unknown] == 1).all()
    # the file of the mask may say what it likes there
    write_png(tmp_path / "c" / "masks" / f"{demo.names[0]}.png", demo.masks[0])
    assert not load_capture(tmp_path / "c").masks[hidden.unknown].any()
    for smaller in (read.select([1, 0]), read.resized(128), cropped(read, 128)):
        assert smaller.unknown.shape == smaller.masks.shape and smaller.unknown.any()
    assert not (tmp_path / "c" / "unknown" / f"{demo.names[1]}.png").exists()


def test_an_image_of_what_is_unknown_is_checked(hidden, tmp_path):
    save_capture(tmp_path / "c", hidden)
    write_png(tmp_path / "c" / "unknown" / f"{hidden.names[0]}.png", np.ones((8, 8), np.float32))
    with pytest.raises(CaptureError, match=r"unknown/.*8 x 8, but its image has 512 x 512"):
        load_capture(tmp_path / "c")
    edit_json(tmp_path / "c" / "capture.json", lambda d: [v.pop("mask") for v in d["views"]])
    assert load_capture(tmp_path / "c").unknown is None  # without masks nothing is background


@pytest.mark.slow  # three displacements
def test_a_body_is_not_carved_where_somebody_stands_in_front(hidden, demo):
    whole = fit_vertex_offsets(demo.body, demo)
    carved = fit_vertex_offsets(demo.body, dataclasses.replace(hidden, unknown=None))
    kept = fit_vertex_offsets(demo.body, hidden)
    off = lambda moves: float(np.linalg.norm(moves - whole, axis=1).mean())
    assert off(kept) < 0.25 * off(carved)


def test_a_view_is_judged_by_what_it_shows(hidden):
    """A view whose mask lacks most of the person is not one of another person."""
    unknown = hidden.masks > 0.5
    unknown[:, :, :] = unknown | hidden.unknown
    unknown[0, 200:, :] = True
    masks = np.where(unknown, np.float32(0), hidden.masks)
    masks[0, :8, :8] = 1
    nearly = dataclasses.replace(hidden, unknown=unknown, masks=masks)
    assert 0 in views_without_person(nearly)
    assert not views_without_person(hidden)


def test_silhouettes_end_where_the_person_does(hidden):
    mask, unknown = hidden.masks[0], hidden.unknown[0]
    border = np.flatnonzero(unknown.any(0))[-1] + 1
    edge = lambda points: np.abs(points.positions[:, 0] - border) < 2
    assert edge(mask_boundary(mask, 500)).mean() > 0.1
    grown = np.zeros_like(unknown)
    grown[:, : border + 3] = True
    assert not edge(mask_boundary(mask, 500, grown)).any()


def test_agreement_of_body_and_mask_is_counted_where_it_is_known(hidden, demo):
    covered = demo.masks[0] > 0.5
    assert overlap(covered, hidden.masks[0]) < 0.8
    assert overlap(covered, hidden.masks[0], ~hidden.unknown[0]) == 1


def test_refinement_compares_and_scores_count_what_is_seen(hidden, demo):
    photos = photos_of(crop_to_person(prepare_capture(hidden)))
    counted = np.asarray(photos.counted)
    assert not counted[0].all() and counted[1:].all()
    assert not np.asarray(photos.mask)[~counted].any()
    first = hidden.select([0])
    assert score(demo.images[:1], first).psnr > 60
    assert score(demo.images[:1], dataclasses.replace(first, unknown=None)).psnr < 30


def test_an_image_of_what_is_unknown_is_grey(hidden, tmp_path):
    save_capture(tmp_path / "c", hidden)
    file = tmp_path / "c" / "unknown" / f"{hidden.names[0]}.png"
    np.testing.assert_array_equal(read_grey(file) > 0.5, hidden.unknown[0])


def test_a_crop_knows_nothing_beyond_the_border_that_cuts_the_person_off(demo):
    first = demo.select([0])
    rows = np.flatnonzero((first.masks[0] > 0.5).any(1))
    height = rows[0] + int(0.7 * np.ptp(rows))
    cut = dataclasses.replace(
        first,
        images=first.images[:, :height],
        masks=first.masks[:, :height],
        cameras=replace(first.cameras, height=height),
    )
    part, whole = cropped(cut, 64), cropped(first, 64)
    assert whole.unknown is None
    assert part.unknown is not None and part.unknown[0, -1].all()
    assert not part.unknown[part.masks > 0.5].any() and not part.unknown[0, 20:40, 20:40].any()


# What is in front, by the body
# --------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def small(demo):
    """Returns two photos of the demo at a small size."""
    return demo.select([0, 1]).resized(256)


def with_bar(capture, low, high):
    """Returns (capture whose first mask a bar cuts, pixels where the bar hides the person).

    The bar lies between two shares of the person's height.
    """
    rows = np.flatnonzero((capture.masks[0] > 0.5).any(1))
    masks = capture.masks.copy()
    masks[0, rows[0] + int(low * np.ptp(rows)) : rows[0] + int(high * np.ptp(rows))] = 0
    images = np.where(masks[..., None] > 0, capture.images, np.float32(1))
    cut = dataclasses.replace(capture, images=images, masks=masks)
    return cut, (capture.masks > 0.5) & (masks == 0)


def moved(capture, degrees, seed=0):
    """Returns the capture with a body whose joints are off by random turns, degrees."""
    turns = np.random.default_rng(seed).normal(0, np.radians(degrees), (1, 55, 3))
    rotations = np.asarray(capture.poses.rotations) + turns
    poses = replace(capture.poses, rotations=rotations.astype(np.float32))
    return dataclasses.replace(capture, poses=poses)


@pytest.mark.parametrize("degrees", [0, 2, 4])
def test_nothing_is_in_front_where_masks_show_the_whole_person(degrees, small):
    """Nor is the gap between arm and trunk in front, with a body that is a little off."""
    assert hidden_parts(moved(small, degrees)) is None
    assert with_hidden_parts(small) is small and hidden_line(small, small) is None


@pytest.mark.parametrize("degrees", [0, 2])
@pytest.mark.parametrize(("low", "high"), [(0.3, 0.4), (0.6, 1.0)])
def test_a_bar_in_front_of_the_body_is_unknown(low, high, degrees, small):
    cut, truth = with_bar(moved(small, degrees), low, high)
    found = hidden_parts(cut)
    assert found is not None and not found[1:].any()
    assert (found & truth).sum() > 0.6 * truth.sum()
    # little of what the mask shows, and of what is beside the person
    assert (found & (cut.masks > 0.5)).sum() < 0.02 * (cut.masks > 0.5).sum()
    assert (found[0] & (small.masks[0] == 0)).sum() < 0.6 * truth.sum()
    seen = with_hidden_parts(cut)
    assert not seen.masks[seen.unknown].any() and (seen.images[seen.unknown] == 1).all()
    line = hidden_line(cut, seen)
    assert line is not None and line.startswith(f"{small.names[0]}: the mask has a hole where")
    assert with_hidden_parts(seen) is seen


def test_a_limb_that_the_body_has_elsewhere_is_not_hidden(small):
    """The body's left leg is lifted to the side, and the mask shows it at rest."""
    rotations = np.asarray(small.poses.rotations).copy()
    rotations[:, small.body.joint_names.index("left_hip"), 2] += 0.5
    poses = replace(small.poses, rotations=rotations)
    assert hidden_parts(dataclasses.replace(small, poses=poses)) is None


def test_a_body_that_is_not_where_the_person_is_says_nothing(small):
    poses = replace(small.poses, translation=small.poses.translation + np.asarray([0.45, 0, -0.45]))
    cut, _ = with_bar(dataclasses.replace(small, poses=poses), 0.5, 0.8)
    assert hidden_parts(cut) is None
