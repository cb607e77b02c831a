"""Training inputs with the faults of real captures."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import ndimage

from humangs_jax.core.draws import uniform_by_name
from humangs_jax.core.pytree import replace
from humangs_jax.data.loading import CaptureCache, CaptureSource, Loader
from humangs_jax.training import augmentation
from humangs_jax.training.augmentation import (
    Augmentation,
    augment_photos,
    augment_views,
    random_numbers,
)
from humangs_jax.training.config import tiny

CONFIG = tiny()
NOTHING = Augmentation(1.0, 0.0, 0.0, 0, 0.0, 0.0, 0.0, 0.0, 0.0)
OTHER_MASKS = dataclasses.replace(NOTHING, mask_pixels=2)
ROUNDING = 1e-6
"""Rounding of a few float32 operations on numbers up to 1."""
VIEWS = 64


@pytest.fixture(scope="module")
def photos():
    """Returns (images, masks) of discs of random colors on white, with soft silhouettes."""
    y, x = np.mgrid[:24, :24] - 11.5
    mask = np.clip(8.5 - np.hypot(x, y), 0, 1).astype(np.float32)
    colors = np.random.default_rng(0).random((VIEWS, 24, 24, 3), np.float32) * 0.8
    masks = np.repeat(mask[None], VIEWS, 0)
    return masks[..., None] * (colors - 1) + 1, masks


@pytest.fixture(scope="module")
def example(body, captures):
    views = (
        CaptureCache(captures, body),
        CONFIG.views,
        CONFIG.model.conventions.image_size,
        CONFIG.target_size,
    )
    return jax.tree.map(lambda x: x[0], Loader(CaptureSource(*views), 1).batch_at(0))


@functools.partial(jax.jit, static_argnames="settings")
def changed(seed, images, masks, settings=NOTHING):
    count = len(images)
    shapes = {"gains": (count, 1, 1, 1), "tints": (count, 1, 1, 3)}
    shapes |= {"radii": (count,), "backgrounds": (count, 1, 1, 3)}
    numbers = uniform_by_name(jax.random.key(seed), shapes)
    return augment_photos(numbers, images, masks, settings)


def test_without_disturbances_photos_stay(photos):
    images, masks = changed(0, *photos)
    certain = (photos[1] == 0) | (photos[1] == 1)  # soft silhouettes show the background
    np.testing.assert_allclose(np.asarray(images)[certain], photos[0][certain], atol=ROUNDING)
    np.testing.assert_array_equal(masks, photos[1])


def test_masks_grow_and_shrink_by_squares(photos):
    _, masks = changed(1, *photos, OTHER_MASKS)
    possible = [photos[1][0]]
    for size in (3, 5):
        possible += [
            filter_(photos[1][0], size, mode="nearest")
            for filter_ in (ndimage.maximum_filter, ndimage.minimum_filter)
        ]
    which = [[np.array_equal(mask, other) for other in possible] for mask in np.asarray(masks)]
    assert np.all(np.sum(which, axis=1) == 1), "each mask is one of five"
    assert np.all(np.any(which, axis=0)), "each of the five occurs in 64 photos"


def test_a_larger_mask_shows_the_background_there_alone(photos):
    images, masks = changed(1, *photos, OTHER_MASKS)
    inner, outer = photos[1] == 1, (photos[1] == 0) & (np.asarray(masks) == 1)
    kept = inner & (np.asarray(masks) == 1)
    np.testing.assert_allclose(np.asarray(images)[kept], photos[0][kept], atol=ROUNDING)
    for image, place in zip(np.asarray(images), outer, strict=True):
        if place.any():  # one color, not white
            assert np.ptp(image[place], axis=0).max() < ROUNDING and image[place].min() < 0.999
    np.testing.assert_array_equal(np.asarray(images)[np.asarray(masks) == 0], 1)


def test_exposure_has_its_standard_deviation():
    grey = jnp.full((2000, 1, 1, 3), 0.3), jnp.ones((2000, 1, 1))
    images, _ = changed(2, *grey, dataclasses.replace(NOTHING, exposure=0.1))
    gains = np.log(np.asarray(images)[:, 0, 0] / 0.3)
    assert np.std(gains) == pytest.approx(0.1, rel=0.1)
    np.testing.assert_allclose(gains, np.repeat(gains[:, :1], 3, 1), atol=ROUNDING * 10)


def test_cameras_turn_about_the_person_wherever_it_stands(example):
    """The posed pelvis stays at its pixel, also 5 m from the world's origin."""
    pelvis, views, settings = (
        np.float32([0.0, 0.9, 0.1]),
        example.inputs,
        dataclasses.replace(NOTHING, camera_degrees=2.0),
    )
    views = replace(views, translations=views.translations + jnp.asarray([5.0, 0.0, 0.0]))
    turn = jax.jit(
        lambda key: augment_views(random_numbers(key, views), views, jnp.asarray(pelvis), settings)
    )
    before, after = (
        np.asarray(x.cameras.cam_from_world)[:, :3] for x in (views, turn(jax.random.key(5)))
    )
    place = np.append(np.asarray(views.translations) + pelvis, np.ones((len(before), 1)), axis=1)[
        ..., None
    ]
    np.testing.assert_allclose(after @ place, before @ place, atol=1e-4)
    traces = np.einsum("vij,vij->v", after[..., :3], before[..., :3])
    degrees = np.degrees(np.arccos(np.minimum(1, (traces - 1) / 2)))
    assert degrees.min() > 0.05 and degrees.max() < 12


def test_an_example_is_disturbed_by_one_draw_of_random_numbers(example, body):
    """Each further draw of another shape adds 230 lines to the program."""
    settings = Augmentation(share=0.5)
    program = jax.make_jaxpr(lambda key: augmentation.augment(key, example, body, settings))
    assert str(program(jax.random.key(0))).count("random_bits[") == 1


def test_all_photos_of_an_example_have_the_same_wrong_body(example):
    views, settings = (
        example.inputs,
        dataclasses.replace(NOTHING, pose_degrees=1.0, body_metres=0.01),
    )
    off = jax.jit(
        lambda key: augment_views(random_numbers(key, views), views, jnp.zeros(3), settings)
    )(jax.random.key(4))
    for name in ("rotations", "translations"):
        change = np.asarray(getattr(off, name) - getattr(views, name))
        np.testing.assert_allclose(change, np.repeat(change[:1], len(change), 0), atol=ROUNDING)
        assert np.abs(change).max() > 1e-3
    np.testing.assert_allclose(
        off.cameras.cam_from_world, views.cameras.cam_from_world, atol=ROUNDING
    )


def test_every_example_has_its_exposures_a_share_the_rest_and_targets_keep_photos_and_cameras(
    example, body
):
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
    """Checks that a photo's person is multiplied by one gain in each channel.

    The background stays as white as before.
    """
    for image, own, mask in zip(
        *map(np.asarray, (images, before.images, before.masks)), strict=True
    ):
        whole = (mask == 1)[..., None] & (image < 1) & (own > 0.1)
        for channel in range(3):
            at = whole[..., channel]
            ratios = image[at, channel] / own[at, channel]
            assert np.ptp(ratios) < 20 * ROUNDING  # over values from 0.1 on
        np.testing.assert_allclose(image[mask == 0], own[mask == 0], atol=ROUNDING)
