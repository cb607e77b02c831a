"""Steps on the head move nothing else; what they compare, and when `refine` makes them."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from refinement_cases import HEIGHT, SAME, squared_error

from humangs_jax.avatar.animate import with_pixel_footprint_of
from humangs_jax.capture.fitting.own_poses import with_own_poses
from humangs_jax.core.pytree import replace
from humangs_jax.data.capture import load_capture
from humangs_jax.data.prepared import prepare_capture
from humangs_jax.refinement import head as heads
from humangs_jax.refinement import refine as refinement
from humangs_jax.refinement.config import HEAD, RefineConfig
from humangs_jax.refinement.head import head_crops, head_loss, shows_heads
from humangs_jax.refinement.photos import crop_to_person, photos_of

ALONE = RefineConfig(iterations=0, steps=0, seconds=None, head_steps=20, held_out=0.0)


@pytest.fixture
def small_photos(monkeypatch):
    """Makes the toy person's photos count as large, so that no crop wants larger ones."""
    monkeypatch.setattr(heads, "LEAST_SIDE", HEIGHT)


@pytest.fixture
def same_head_buffers(monkeypatch):
    monkeypatch.setattr(heads, "planned", lambda avatar, views: SAME)


def of_head(avatar, region=HEAD):
    columns = [
        i for i, name in enumerate(avatar.joint_names) if any(part in name for part in region)
    ]
    return np.asarray(avatar.skinning_weights)[:, columns].sum(axis=1) > 0.5


@pytest.mark.slow
@pytest.mark.usefixtures("small_photos", "same_head_buffers")
def test_the_head_comes_closer_and_nothing_else_moves(four):
    avatar, capture = four
    report = refinement.refine_with_report(avatar, capture, ALONE)
    assert report.kept and report.head_steps == 20 and "20 on the head" in report.summary()
    moved = of_head(avatar)
    start = with_pixel_footprint_of(avatar, crop_to_person(prepare_capture(capture)))
    for name in ("means", "quats", "scales", "opacities", "colors"):
        before, after = (np.asarray(getattr(x.gaussians, name)) for x in (start, report.avatar))
        np.testing.assert_array_equal(after[~moved], before[~moved])
        assert (after[moved] != before[moved]).any()
    assert squared_error(report.avatar, capture) < squared_error(start, capture)


def test_crops_show_the_head(four):
    avatar, capture = four
    crops = head_crops(avatar, prepare_capture(capture), RefineConfig())
    np.testing.assert_array_equal(crops.moved, of_head(avatar))
    assert set(np.flatnonzero(crops.moved)) <= set(crops.drawn.tolist())
    assert len(crops.views.images) == 4 and crops.views.cameras.height < HEIGHT
    assert float(crops.views.masks.mean()) > 0.2
    # of the photos as they are
    larger = head_crops(avatar, prepare_capture(capture), RefineConfig(image_size=HEIGHT // 2))
    assert larger.finer and not crops.finer
    np.testing.assert_allclose(
        larger.views.cameras.K[:, 0, 0], crops.views.cameras.K[:, 0, 0], rtol=1e-6
    )
    neck = ("neck", "collar")
    np.testing.assert_array_equal(
        head_crops(avatar, prepare_capture(capture), RefineConfig(region=neck)).moved,
        of_head(avatar, neck),
    )


def test_a_camera_that_has_the_head_behind_it_is_left_out(four):
    avatar, views = four[0], crop_to_person(prepare_capture(four[1]))
    placed = views.cameras.cam_from_world
    turned = placed.at[0].set(jnp.diag(jnp.asarray([-1.0, 1, -1, 1])) @ placed[0])
    views = replace(views, cameras=replace(views.cameras, cam_from_world=turned))
    seen, _, side = heads._squares(heads._pixels(avatar, views)[:, of_head(avatar)], views)
    assert seen.tolist() == [1, 2, 3] and side < HEIGHT


@pytest.mark.parametrize("spoil", ["no head", "nobody opaque", "out of the frame"])
def test_where_no_photo_shows_a_head_there_are_no_crops(four, spoil):
    avatar, capture = four
    if spoil == "no head":
        avatar = replace(
            avatar, joint_names=tuple(f"bone_{i}" for i in range(len(avatar.joint_names)))
        )
    elif spoil == "nobody opaque":
        avatar = replace(
            avatar,
            gaussians=replace(avatar.gaussians, opacities=jnp.zeros(len(avatar.gaussians.means))),
        )
    else:
        away = avatar.gaussians.means + 9.0 * of_head(avatar)[:, None]
        avatar = replace(avatar, gaussians=replace(avatar.gaussians, means=away))
    assert head_crops(avatar, prepare_capture(capture), RefineConfig()) is None


@pytest.mark.parametrize(
    ("longest", "image_size", "expected"),
    [(512, None, True), (2000, 512, True), (2000, 256, False), (256, None, False)],
)
def test_photos_must_be_large_enough(four, longest, image_size, expected):
    capture = dataclasses.replace(
        four[1], images=np.zeros((4, longest, 4, 3), np.float32), masks=None
    )
    assert shows_heads(capture, RefineConfig(image_size=image_size)) == expected


def test_colors_count_in_the_mask_and_excess_alpha_costs_more(four):
    photo = photos_of(crop_to_person(prepare_capture(four[1])))[0]
    outside, inside = (photo.mask == 0)[..., None], (photo.mask > 0.9)[..., None]
    loss = lambda rgb, alpha: float(head_loss((rgb, alpha), photo, ALONE))
    exact = loss(photo.image, photo.mask)
    assert exact == pytest.approx(0, abs=1e-6)
    assert loss(photo.image + 0.3 * outside, photo.mask) == pytest.approx(exact, abs=1e-6)
    assert loss(photo.image + 0.3 * inside, photo.mask) > 1e-3
    change = 0.1 * (photo.mask == 0), 0.1 * (photo.mask > 0.5)
    grown, shrunk = (
        loss(photo.image, photo.mask + change[0]),
        loss(photo.image, photo.mask - change[1]),
    )
    assert grown / change[0].mean() > 5 * shrunk / change[1].mean()


def test_cameras_from_the_person_blur_a_face_unless_each_photo_has_a_pose():
    capture = load_capture("demo_capture").resized(heads.LEAST_SIDE)
    assert shows_heads(capture, ALONE)
    uncalibrated = dataclasses.replace(capture, calibrated=False)
    assert not shows_heads(uncalibrated, ALONE)
    assert shows_heads(with_own_poses(uncalibrated), ALONE)


def test_steps_are_made_without_those_on_the_head_as_with_seconds(four, monkeypatch):
    """A run of seconds makes none on the head, and its steps repeat it."""
    monkeypatch.setattr(refinement, "_crops", lambda avatar, photos, config: crops(config))
    seen = []

    def crops(config):
        seen.append(config.head_steps)

    for steps in (0, 1):
        refinement.refine_with_report(*four, ALONE, steps=steps)
    assert seen == [20, 0]
