"""Sheets show the person, not the hall."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from test_check import boxes

from humangs_jax.apps.check import check_capture
from humangs_jax.apps.crops import LARGEST_SHARE, around_person
from humangs_jax.body.model import rest_pose
from humangs_jax.data.capture import capture_from_arrays
from humangs_jax.geometry.camera import orbit, project
from humangs_jax.io.images import read_image

SIZE = (400, 300)


def hall(focal=120.0, middles=((60, 80), (200, 150), (330, 210)), masks=True):
    """Returns a capture of a person who is some 40 pixels high in photos of 400 x 300.

    The person is at another place of each photo. The value of a pixel is its position.
    """
    body, (width, height) = boxes(), SIZE
    cameras = orbit(
        jnp.zeros(3),
        4.0,
        jnp.linspace(0, 3, len(middles)),
        0.1,
        jnp.diag(jnp.asarray([focal, focal, 1.0])),
        *SIZE,
    )
    K = np.asarray(cameras.K).copy()
    K[:, :2, 2] = middles
    y, x = np.mgrid[:height, :width]
    images = np.stack([np.stack([x / width, y / height, 0 * x], axis=-1)] * len(middles))
    covered = np.stack([np.hypot(x - u, y - v) < 0.15 * focal for u, v in middles])
    pose = rest_pose(body)
    return capture_from_arrays(
        images.astype(np.float32),
        K,
        cameras.cam_from_world,
        pose.rotations[None],
        pose.translation[None],
        masks=covered.astype(np.float32) if masks else None,
        background="white",
        body=body,
    )


@pytest.mark.parametrize("masks", [True, False])
def test_windows_lie_around_the_person_and_show_the_same(masks):
    capture = hall(masks=masks)
    vertices = {0: capture.body.template}
    close, corners = around_person(capture, vertices)
    height, width = close.images.shape[1:3]
    assert (
        40 < width < 120
        and 30 < height < 100
        and (close.cameras.width, close.cameras.height) == (width, height)
    )
    for view, (x, y) in enumerate(corners):
        np.testing.assert_array_equal(
            close.images[view], capture.images[view, y : y + height, x : x + width]
        )
        before, _ = project(capture.cameras[view], vertices[0])
        after, _ = project(close.cameras[view], vertices[0])
        np.testing.assert_allclose(after + np.asarray([x, y]), before, atol=1e-3)
        margins = np.minimum(
            np.asarray(after).min(axis=0), [width, height] - np.asarray(after).max(axis=0)
        )
        assert (margins > 3).all()
        if masks:
            assert close.masks[view].sum() == capture.masks[view].sum()


def test_a_window_stays_in_the_photo():
    capture = hall(middles=((5, 5), (398, 298)))
    close, corners = around_person(capture, {0: boxes().template})
    size = np.asarray([close.cameras.width, close.cameras.height])
    assert (
        (corners >= 0).all()
        and (corners + size <= SIZE).all()
        and (corners[1] + size == SIZE).all()
    )
    assert len(close.images) == len(capture.images)


def test_a_person_who_fills_a_photo_and_one_who_is_not_seen_leave_photos_as_they_are():
    near = hall(focal=900.0, middles=((200, 150), (200, 150)))
    assert around_person(near, {0: boxes().template})[0] is near
    away = hall(middles=((-900, -900), (-900, -900)), masks=False)
    assert around_person(away, {0: boxes().template})[0] is away
    one = hall(middles=((60, 80), (-900, -900)), masks=False)
    close, corners = around_person(one, {0: boxes().template})
    assert close.images[0].size < LARGEST_SHARE * one.images[0].size
    np.testing.assert_allclose(
        corners[1] + np.asarray([close.cameras.width, close.cameras.height]) / 2, [200, 150], atol=1
    )


def test_marks_are_seen_too():
    capture = hall(masks=False)
    marks = [
        np.asarray([[m[0] + 70.0, m[1]], [np.nan, 0.0]]) for m in ((60, 80), (200, 150), (330, 210))
    ]
    close, corners = around_person(capture, {0: boxes().template}, marks)
    for (x, y), mark in zip(corners, marks, strict=True):
        if mark[0, 0] < SIZE[0]:
            assert (
                x < mark[0, 0] < x + close.cameras.width
                and y < mark[0, 1] < y + close.cameras.height
            )


@pytest.mark.slow
def test_the_sheet_of_a_check_is_of_the_person(tmp_path):
    capture = hall()
    report = check_capture(
        dataclasses.replace(capture, images=0 * capture.images), tmp_path / "check.png"
    )
    sheet, _ = read_image(tmp_path / "check.png")
    assert len(report.views) == 3 and max(sheet.shape[:2]) < 300
    # the hall is black, what is around tiles white
    body = (sheet.max(axis=-1) > 0.05) & (sheet.min(axis=-1) < 0.95)
    assert body.mean() > 0.1
