"""Inputs of training with the faults of real captures."""

import dataclasses
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import ndimage

from humangs_jax.core.pytree import replace
from humangs_jax.data.loading import CaptureCache, CaptureSource, Loader
from humangs_jax.geometry.camera import project
from humangs_jax.training import augmentation
from humangs_jax.training.augmentation import Augmentation, augment_cameras, augment_photos, augment_views
from humangs_jax.training.config import tiny

CONFIG = tiny()
NOTHING = Augmentation(1.0, 0.0, 0.0, 0, 0.0, 0.0, 0.0, 0.0, 0.0)
ROUNDING = 1e-6
"""Of a few float32 operations on numbers up to 1."""
VIEWS = 64


@pytest.fixture(scope="module")
def photos():
    """Discs of random colors on white, with soft silhouettes."""
    y, x = np.mgrid[:24, :24] - 11.5
    mask = np.clip(8.5 - np.hypot(x, y), 0, 1).astype(np.float32)
    colors = np.random.default_rng(0).random((VIEWS, 24, 24, 3), np.float32) * 0.8
    masks = np.repeat(mask[None], VIEWS, 0)
    return masks[..., None] * (colors - 1) + 1, masks


@pytest.fixture(scope="module")
def example(body, captures):
    views = CaptureCache(captures, body), CONFIG.views, CONFIG.model.conventions.image_size, CONFIG.target_size
    return jax.tree.map(lambda x: x[0], Loader(CaptureSource(*views), 1).batch_at(0))


def test_without_disturbances_photos_stay(photos):
    images, masks = augment_photos(jax.random.key(0), *map(jnp.asarray, photos), NOTHING)
    certain = (photos[1] == 0) | (photos[1] == 1)  # soft silhouettes show the background
    np.testing.assert_allclose(np.asarray(images)[certain], photos[0][certain], atol=ROUNDING)
    np.testing.assert_array_equal(masks, photos[1])


def test_masks_grow_and_shrink_by_squares(photos):
    _, masks = augment_photos(jax.random.key(1), *map(jnp.asarray, photos), dataclasses.replace(NOTHING, mask_pixels=2))
    possible = [photos[1][0]]
    for size in (3, 5):
        possible += [filter_(photos[1][0], size, mode="nearest") for filter_ in (ndimage.maximum_filter, ndimage.minimum_filter)]
    which = [[np.array_equal(mask, other) for other in possible] for mask in np.asarray(masks)]
    assert np.all(np.sum(which, axis=1) == 1), "each mask is one of five"
    assert np.all(np.any(which, axis=0)), "each of the five occurs in 64 photos"


def test_a_larger_mask_shows_the_background_there_alone(photos):
    settings = dataclasses.replace(NOTHING, mask_pixels=2)
    images, masks = augment_photos(jax.random.key(1), *map(jnp.asarray, photos), settings)
    inner, outer = photos[1] == 1, (photos[1] == 0) & (np.asarray(masks) == 1)
    kept = inner & (np.asarray(masks) == 1)
    np.testing.assert_allclose(np.asarray(images)[kept], photos[0][kept], atol=ROUNDING)
    for image, place in zip(np.asarray(images), outer, strict=True):
        if place.any():  # one color, not white
            assert np.ptp(image[place], axis=0).max() < ROUNDING and image[place].min() < 0.999
    np.testing.assert_array_equal(np.asarray(images)[np.asarray(masks) == 0], 1)


def test_exposure_has_its_standard_deviation(photos):
    grey = jnp.full((2000, 1, 1, 3), 0.3), jnp.ones((2000, 1, 1))
    images, _ = augment_photos(jax.random.key(2), *grey, dataclasses.replace(NOTHING, exposure=0.1))
    gains = np.log(np.asarray(images)[:, 0, 0] / 0.3)
    assert np.std(gains) == pytest.approx(0.1, rel=0.1)
    np.testing.assert_allclose(gains, np.repeat(gains[:, :1], 3, 1), atol=ROUNDING * 10)


def test_cameras_turn_about_the_person(example):
    cameras = example.inputs.cameras
    count = len(cameras.K)
    centers = jnp.asarray([[0.1, 0.9, -0.2]] * count)
    turned = augment_cameras(jax.random.key(3), cameras, centers, dataclasses.replace(NOTHING, camera_degrees=2.0))
    for before, after, center in zip(cameras, turned, centers, strict=True):
        np.testing.assert_allclose(project(after, center)[0], project(before, center)[0], rtol=1e-4)
        turn = np.asarray(after.cam_from_world)[:3, :3] @ np.asarray(before.cam_from_world)[:3, :3].T
        degrees = math.degrees(math.acos(min(1, (np.trace(turn) - 1) / 2)))
        assert 0.05 < degrees < 12


def test_the_person_is_turned_about_wherever_it_stands(example):
    """The posed pelvis stays where the photo shows it, also 5 m from the world's origin."""
    pelvis, views = jnp.asarray([0.0, 0.9, 0.1]), example.inputs
    views = replace(views, translations=views.translations + jnp.asarray([5.0, 0.0, 0.0]))
    off = augment_views(jax.random.key(5), views, pelvis, dataclasses.replace(NOTHING, camera_degrees=5.0))
    seen = lambda cameras: jnp.einsum(
        "vij,vj->vi", cameras.cam_from_world[:, :3], jnp.pad(views.translations + pelvis, ((0, 0), (0, 1)), constant_values=1)
    )
    np.testing.assert_allclose(seen(off.cameras), seen(views.cameras), atol=1e-4)
    assert np.abs(off.cameras.cam_from_world - views.cameras.cam_from_world).max() > 0.01


def test_all_photos_of_an_example_have_the_same_wrong_body(example):
    views = example.inputs
    off = augment_views(jax.random.key(4), views, jnp.zeros(3), dataclasses.replace(NOTHING, pose_degrees=1.0, body_metres=0.01))
    for name in ("rotations", "translations"):
        change = np.asarray(getattr(off, name) - getattr(views, name))
        np.testing.assert_allclose(change, np.repeat(change[:1], len(change), 0), atol=ROUNDING)
        assert np.abs(change).max() > 1e-3
    np.testing.assert_allclose(off.cameras.cam_from_world, views.cameras.cam_from_world, atol=ROUNDING)


def test_every_example_has_its_exposures_a_share_the_rest_and_targets_keep_photos_and_cameras(example, body):
    settings = Augmentation(share=0.5)
    augment = jax.jit(lambda key: augmentation.augment(key, example, body, settings))
    changed = []
    for seed in range(12):
        after = augment(jax.random.key(seed))
        changed.append(not np.array_equal(after.inputs.betas, example.inputs.betas))
        assert not np.array_equal(after.inputs.images, example.inputs.images)
        if not changed[-1]:
            same = replace(after.inputs, images=example.inputs.images)
            jax.tree.map(np.testing.assert_array_equal, same, example.inputs)
            _check_one_gain_a_channel(after.inputs.images, example.inputs)
        np.testing.assert_array_equal(after.inputs.betas, after.targets.betas)
        same = replace(after.targets, betas=example.targets.betas)
        jax.tree.map(np.testing.assert_array_equal, same, example.targets)
    assert 0 < sum(changed) < 12


def _check_one_gain_a_channel(images, before):
    """Whole pixels of the person have the ratio of their photo, the background is as white as before."""
    for image, own, mask in zip(*map(np.asarray, (images, before.images, before.masks)), strict=True):
        whole = (mask == 1)[..., None] & (image < 1) & (own > 0.1)
        for channel in range(3):
            at = whole[..., channel]
            ratios = image[at, channel] / own[at, channel]
            assert np.ptp(ratios) < 20 * ROUNDING  # over values from 0.1 on
        np.testing.assert_allclose(image[mask == 0], own[mask == 0], atol=ROUNDING)


def test_a_share_above_one_is_refused():
    with pytest.raises(ValueError, match=r"Augmentation.share 1.5"):
        Augmentation(share=1.5)
