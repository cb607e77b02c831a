"""The quick check: what it names, what it leaves alone, what it costs."""

import dataclasses
import time

import jax.numpy as jnp
import numpy as np
import pytest

from humangs_jax.apps.quick_check import likely_mistakes
from humangs_jax.body.model import person_vertices
from humangs_jax.core.pytree import replace
from humangs_jax.data.capture import load_capture
from humangs_jax.data.usable_views import surface_points

SECONDS = 0.5
"""Of the processor, for four photos: 0.07 measured. Less than the import of a library or a compilation would take."""


@pytest.fixture(scope="module")
def right():
    return load_capture("demo_capture")


def with_cameras(capture, order):
    order = jnp.asarray(order)
    cameras = capture.cameras
    return {"cameras": replace(cameras, K=cameras.K[order], cam_from_world=cameras.cam_from_world[order])}


def on_white(capture, images):
    masks = capture.masks[..., None]
    return masks * np.minimum(images, 1) + 1 - masks


CHANGES = {
    "masks are inverted": (lambda c: {"masks": 1 - c.masks}, "if the mask is inverted: view 0_00, 0_01, 0_02, 0_03"),
    "photos are mirrored": (
        lambda c: {"images": c.images[:, :, ::-1], "masks": c.masks[:, :, ::-1]},
        "if the photo is mirrored: view 0_00, 0_01, 0_02, 0_03",
    ),
    "one mask is empty": (lambda c: {"masks": np.concatenate([c.masks[:1] * 0, c.masks[1:]])}, "the mask is empty: view 0_00"),
    "photos are underexposed": (lambda c: {"images": on_white(c, c.images / 16)}, "the person is nearly black"),
    "photos are burnt out": (lambda c: {"images": on_white(c, c.images * 16)}, "most of the person is white"),
    "two cameras are exchanged": (
        lambda c: with_cameras(c, [1, 0, 2, 3]),
        "cameras are exchanged: the body would fit 0_00 by the camera of 0_01, 0_01 by the camera of 0_00",
    ),
    "cameras are shifted": (
        lambda c: with_cameras(c, [1, 2, 3, 0]),
        "cameras are exchanged: the body would fit 0_00 by the camera of 0_03, 0_01 by the camera of 0_00",
    ),
    "poses in degrees": (
        lambda c: {"poses": replace(c.poses, rotations=jnp.degrees(c.poses.rotations))},
        "the poses seem to be in degrees: rotations up to 81, expected radians",
    ),
    "no metres": (
        lambda c: {"poses": replace(c.poses, translation=c.poses.translation * 1000 + 500)},
        "most of the body is outside the frame",
    ),
}
FLIP, Z_UP = np.diag([1.0, -1, -1, 1]), np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
MADE = {
    "is the inverse": np.linalg.inv,
    "looks along -z": lambda m: FLIP @ m,
    "camera to world in OpenGL": lambda m: np.linalg.inv(FLIP @ m),
    "camera's translation is in millimetres": lambda m: np.block([[m[:3, :3], m[:3, 3:] * 1000], [m[3:]]]),
    "a world with z up": lambda m: m @ Z_UP,
}
"""What people do to a right cam_from_world, and what is said of it."""


@pytest.mark.parametrize("change", CHANGES)
def test_mistakes_are_named(change, right):
    make, message = CHANGES[change]
    (found,) = likely_mistakes(dataclasses.replace(right, **make(right)))
    assert message in found


def test_right_captures_have_no_warnings(right):
    assert likely_mistakes(right) == () == likely_mistakes(load_capture("demo_capture/held_out"))
    assert likely_mistakes(dataclasses.replace(right, masks=None)) == ()


@pytest.mark.parametrize("masks", [True, False])
@pytest.mark.parametrize("mistake", MADE)
def test_wrong_cameras_are_explained(mistake, masks, right):
    """Without masks only where nothing else puts the body into the frame."""
    wrong = np.stack([MADE[mistake](np.asarray(matrix, float)) for matrix in right.cameras.cam_from_world])
    cameras = replace(right.cameras, cam_from_world=jnp.asarray(wrong, jnp.float32))
    capture = dataclasses.replace(right, cameras=cameras, masks=right.masks if masks else None)
    found = likely_mistakes(capture)
    explained = [line for line in found if "it would fit if" in line]
    assert all(mistake in line for line in explained) and (len(explained) == len(found) > 0 or not masks)


def test_a_body_in_millimetres_is_explained(right):
    offset = np.asarray([400.0, 300.0, 200.0], np.float32)
    back = np.eye(4)
    back[:3, 3] = -offset / 1000
    poses = replace(right.poses, translation=jnp.asarray(np.asarray(right.poses.translation) * 1000 + offset))
    cameras = replace(right.cameras, cam_from_world=right.cameras.cam_from_world @ jnp.asarray(back, jnp.float32))
    (found,) = likely_mistakes(dataclasses.replace(right, poses=poses, cameras=cameras))
    assert "the body's translation is in millimetres" in found


def test_the_points_lie_on_the_body(right):
    """Skinning by numpy is that of the body model, up to its corrections of poses."""
    frame = int(right.frames[0])
    rotations, translations = np.asarray(right.poses.rotations, float), np.asarray(right.poses.translation, float)
    points = surface_points(right.body, np.asarray(right.betas), rotations, translations, [frame], 6000)[frame]
    vertices = np.asarray(person_vertices(right.body, jnp.asarray(right.betas), right.pose(frame)))
    nearest = np.array([np.linalg.norm(vertices - point, axis=1).min() for point in points[::60]])
    assert np.median(nearest) < 0.02 and nearest.max() < 0.06  # half an edge, and what bends at a joint


def test_it_is_quick_and_looks_at_some_of_many_views(right):
    many = right.select(np.arange(100) % 4)
    for capture, most in ((right, SECONDS), (many, 6 * SECONDS)):
        began = time.process_time()
        assert likely_mistakes(capture) == ()
        assert time.process_time() - began < most
    inverted = dataclasses.replace(many, masks=1 - many.masks)
    assert likely_mistakes(inverted)[0].endswith("and 20 more")  # of the 24 that are looked at
