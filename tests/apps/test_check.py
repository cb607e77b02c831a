"""The check of a capture: its sheet, its report, and the warnings of a quick look."""

import dataclasses
import functools

import jax.numpy as jnp
import numpy as np
import pytest

from humangs_jax.apps.check import (
    TINTS,
    CheckReport,
    ViewCheck,
    check_capture,
    draw_body,
    overlay,
    side_tints,
)
from humangs_jax.apps.quick_check import faults, likely_mistakes
from humangs_jax.body.model import BodyModel, person_vertices, rest_pose
from humangs_jax.core.pytree import replace
from humangs_jax.data.body_and_masks import surface_points
from humangs_jax.data.capture import capture_from_arrays, load_capture
from humangs_jax.geometry.camera import intrinsics_from_fov, orbit
from humangs_jax.io.images import read_image

SIZE = 64


@functools.cache
def boxes():
    """Returns a body of a torso and two arms, each a box that one joint moves.

    It is 1 m tall and 1.2 m wide, and its front and back differ.
    """

    def box(low, high):
        corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], float)
        return low + corners * (np.asarray(high) - low)

    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    triangles = np.array([t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))])
    parts = [box([-0.2, -0.6, -0.1], [0.2, 0.4, 0.1]), box([0.2, 0.1, -0.05], [0.7, 0.3, 0.05])]
    parts += [box([-0.5, 0.1, -0.05], [-0.2, 0.3, 0.05])]
    weights = np.repeat(np.eye(3), 8, axis=0)
    return BodyModel(
        template=jnp.asarray(np.concatenate(parts), jnp.float32),
        shape_directions=jnp.zeros((24, 3, 2)),
        pose_directions=None,
        joint_regressor=jnp.asarray(weights.T / 8, jnp.float32),
        skinning_weights=jnp.asarray(weights, jnp.float32),
        faces=jnp.asarray(np.concatenate([triangles + 8 * i for i in range(3)])),
        parents=(-1, 0, 0),
        joint_names=("pelvis", "left_arm", "right_arm"),
        name="boxes",
    )


def cameras(views=3, width=SIZE, height=SIZE):
    K = intrinsics_from_fov(0.8, width, height)
    azimuths = 0.4 + jnp.arange(views) * 2 * jnp.pi / views
    return orbit(jnp.asarray([0.1, -0.1, 0.0]), 2.5, azimuths, 0.1, K, width, height)


@functools.cache
def photos():
    """Returns (images, masks) of the boxes, seen by three cameras."""
    white = np.ones((SIZE, SIZE, 3), np.float32)
    pose, seen = rest_pose(boxes()), cameras()
    drawn = [draw_body(boxes(), jnp.zeros(0), pose, seen[i], white)[1] for i in range(3)]
    covered = np.stack([np.asarray(image.covered) for image in drawn])
    shaded = np.stack([np.asarray(image.shaded) for image in drawn])
    return np.where(covered[..., None], shaded, 1.0), covered.astype(np.float32)


def capture(masks=True, empty_masks=False, **arrays):
    """A capture of the boxes themselves."""
    seen, body = cameras(), boxes()
    images, covered = photos()
    values = dict(
        images=images,
        masks=covered * (not empty_masks) if masks else None,
        K=seen.K,
        cam_from_world=seen.cam_from_world,
        rotations=np.zeros((1, 3, 3)),
        translations=np.zeros((1, 3)),
        body=body,
    )
    return capture_from_arrays(**{**values, **arrays})


@pytest.mark.slow
def test_a_right_capture_has_full_overlap_and_no_warning(tmp_path):
    report = check_capture(capture(), tmp_path / "check.png")
    assert report.ok and len(report.views) == 3
    for view in report.views:
        assert view.iou == 1.0 and view.inside == 1.0 and view.outside < 0.01
    text = str(report)
    assert "000" in text and "1.000" in text and "100%" in text and "warning:" not in text
    sheet, _ = read_image(tmp_path / "check.png")
    assert (np.abs(sheet - TINTS.boundary).max(-1) < 0.01).sum() > 100  # the silhouettes
    assert (sheet[..., 2] - sheet[..., 0] > 0.2).sum() > 50  # something blue
    assert (sheet[..., 0] - sheet[..., 2] > 0.2).sum() > 50  # something red
    assert [p.name for p in tmp_path.iterdir()] == ["check.png"]


@pytest.mark.slow
def test_left_is_blue_and_right_is_red_on_the_photo():
    body = boxes()
    front = orbit(
        jnp.zeros(3), 3.0, jnp.zeros(1), 0.0, intrinsics_from_fov(0.6, SIZE, SIZE), SIZE, SIZE
    )[0]
    image, parts = draw_body(
        body, jnp.zeros(0), rest_pose(body), front, np.ones((SIZE, SIZE, 3), np.float32)
    )
    # seen from the front the person's left arm (x > 0) is on the right of the image
    covered = np.asarray(parts.covered)
    row = int(SIZE / 2 - 0.2 / (3 * np.tan(0.3)) * SIZE / 2)
    columns = np.flatnonzero(covered[row])
    assert image[row, columns[-3], 2] > image[row, columns[-3], 0] + 0.2
    assert image[row, columns[2], 0] > image[row, columns[2], 2] + 0.2
    np.testing.assert_allclose(
        side_tints(body)[:8], np.broadcast_to(TINTS.middle, (8, 3)), atol=1e-6
    )


def test_without_names_of_sides_the_tints_go_by_position():
    body = dataclasses.replace(boxes(), joint_names=("a", "b", "c"))
    np.testing.assert_allclose(side_tints(body)[8:], side_tints(boxes())[8:], atol=1e-6)


def test_overlay_changes_only_the_body():
    photo = np.random.default_rng(0).random((SIZE, SIZE, 3)).astype(np.float32)
    image, parts = draw_body(boxes(), jnp.zeros(0), rest_pose(boxes()), cameras()[0], photo)
    covered = np.asarray(parts.covered)
    assert 0.05 < covered.mean() < 0.5
    np.testing.assert_array_equal(image[~covered], photo[~covered])
    edge = np.abs(image - TINTS.boundary).max(-1) < 1e-6
    assert edge.any() and not (edge & ~covered).any() and edge.sum() < covered.sum() / 2
    inner = covered & ~edge
    expected = (1 - TINTS.opacity) * photo + TINTS.opacity * np.asarray(parts.shaded)
    np.testing.assert_allclose(image[inner], expected[inner], atol=1e-6)
    np.testing.assert_array_equal(overlay(photo, parts), image)


def test_mistakes_that_no_single_view_shows_are_named():
    whole = faults(capture(rotations=np.full((1, 3, 3), 30.0))).whole
    assert "the poses seem to be in degrees: rotations up to 52" in whole[0]
    report = CheckReport((ViewCheck("a", 1.0, 0.0, 1.0),), whole)
    assert not report.ok
    assert f"warning: {whole[0]}" in str(report) and "no warnings" not in str(report)


def test_warnings_tell_what_is_wrong():
    warning = lambda **arrays: faults(capture(**arrays)).views[0]
    behind = np.asarray(cameras()[0].center) * 3
    assert "or behind the camera" in warning(translations=behind[None])
    assert "outside the frame" in warning(translations=np.array([[0.0, 5.0, 0.0]]))
    assert "body and mask do not agree" in warning(translations=np.array([[0.0, 0.7, 0.0]]))
    assert "the body is tiny, in metres" in warning(translations=-50 * behind[None])
    assert "mask is empty" in warning(empty_masks=True)


def test_a_body_that_is_wider_than_the_person_is_warned_about(tmp_path):
    right = capture()
    masks = np.array(right.masks)
    masks[:, : SIZE * 3 // 8] = 0  # the person without the upper part of the body
    slimmer = dataclasses.replace(right, masks=masks)
    for view in check_capture(slimmer, tmp_path / "check.png").views:
        assert view.outside > 0.05 and "--to-masks` fits cameras" in view.warning


@pytest.mark.parametrize("masks", [True, False])
def test_the_displacement_of_a_capture_is_drawn(tmp_path, masks):
    moved = np.tile([0, 0.03, 0], (24, 1))
    report = check_capture(capture(masks=masks, displacement=moved), tmp_path / "check.png")
    assert "reconstruct will move the body as body.npz says, by up to 3.0 cm (yellow)" in str(
        report
    )
    yellow = (np.abs(read_image(tmp_path / "check.png")[0] - TINTS.displaced) < 0.01).all(-1)
    assert yellow.sum() > 3 * SIZE / 4


@pytest.mark.slow
def test_each_view_shows_its_own_frame(tmp_path):
    moved = np.array([[0.0, 0.0, 0.0], [0.0, 3.0, 0.0]])
    seen = capture(rotations=np.zeros((2, 3, 3)), translations=moved, frames=[0, 1, 0])
    views = check_capture(seen, tmp_path / "check.png").views
    assert [view.iou for view in views] == [1.0, 0.0, 1.0]
    assert [not view.warning for view in views] == [True, False, True]


# The quick check: what it names, what it leaves alone, what it costs
# ---------------------------------------------------


@pytest.fixture(scope="module")
def right():
    return load_capture("demo_capture")


def with_cameras(capture, order):
    order = jnp.asarray(order)
    cameras = capture.cameras
    return {
        "cameras": replace(
            cameras, K=cameras.K[order], cam_from_world=cameras.cam_from_world[order]
        )
    }


def on_white(capture, images):
    masks = capture.masks[..., None]
    return masks * np.minimum(images, 1) + 1 - masks


CHANGES = {
    "masks are inverted": (
        lambda c: {"masks": 1 - c.masks},
        "if the mask is inverted: view 0_00, 0_01, 0_02, 0_03",
    ),
    "photos are mirrored": (
        lambda c: {"images": c.images[:, :, ::-1], "masks": c.masks[:, :, ::-1]},
        "if the photo is mirrored: view 0_00, 0_01, 0_02, 0_03",
    ),
    "one mask is empty": (
        lambda c: {"masks": np.concatenate([c.masks[:1] * 0, c.masks[1:]])},
        "the mask is empty: view 0_00",
    ),
    "photos are underexposed": (
        lambda c: {"images": on_white(c, c.images / 16)},
        "the person is nearly black",
    ),
    "photos are burnt out": (
        lambda c: {"images": on_white(c, c.images * 16)},
        "most of the person is white",
    ),
    "two cameras are exchanged": (
        lambda c: with_cameras(c, [1, 0, 2, 3]),
        (
            "cameras are exchanged: the body would fit 0_00 by the camera of 0_01, 0_01 by the"
            " camera of 0_00"
        ),
    ),
    "cameras are shifted": (
        lambda c: with_cameras(c, [1, 2, 3, 0]),
        (
            "cameras are exchanged: the body would fit 0_00 by the camera of 0_03, 0_01 by the"
            " camera of 0_00"
        ),
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
FLIP, Z_UP = (
    np.diag([1.0, -1, -1, 1]),
    np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]]),
)
MADE = {
    "is the inverse": np.linalg.inv,
    "looks along -z": lambda m: FLIP @ m,
    "camera to world in OpenGL": lambda m: np.linalg.inv(FLIP @ m),
    "camera's translation is in millimetres": lambda m: np.block(
        [[m[:3, :3], m[:3, 3:] * 1000], [m[3:]]]
    ),
    "a world with z up": lambda m: m @ Z_UP,
}
"""Common mistakes in a camera matrix, by the words with which they are reported."""


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
    """Without masks a mistake is named only if no other one puts the body into the frame."""
    wrong = np.stack(
        [MADE[mistake](np.asarray(matrix, float)) for matrix in right.cameras.cam_from_world]
    )
    cameras = replace(right.cameras, cam_from_world=jnp.asarray(wrong, jnp.float32))
    capture = dataclasses.replace(right, cameras=cameras, masks=right.masks if masks else None)
    found = likely_mistakes(capture)
    explained = [line for line in found if "it would fit if" in line]
    assert all(mistake in line for line in explained) and (
        len(explained) == len(found) > 0 or not masks
    )


def test_a_body_in_millimetres_is_explained(right):
    offset = np.asarray([400.0, 300.0, 200.0], np.float32)
    back = np.eye(4)
    back[:3, 3] = -offset / 1000
    poses = replace(
        right.poses, translation=jnp.asarray(np.asarray(right.poses.translation) * 1000 + offset)
    )
    cameras = replace(
        right.cameras, cam_from_world=right.cameras.cam_from_world @ jnp.asarray(back, jnp.float32)
    )
    (found,) = likely_mistakes(dataclasses.replace(right, poses=poses, cameras=cameras))
    assert "the body's translation is in millimetres" in found


def test_the_points_lie_on_the_body(right):
    """Skinning in numpy gives the body model's vertices, up to its corrections for poses."""
    frame = int(right.frames[0])
    points = surface_points(right.body, right.betas, right.poses, right.frames, 6000)[frame]
    vertices = np.asarray(person_vertices(right.body, jnp.asarray(right.betas), right.pose(frame)))
    nearest = np.array([np.linalg.norm(vertices - point, axis=1).min() for point in points[::60]])
    # half an edge, and what bends at a joint
    assert np.median(nearest) < 0.02 and nearest.max() < 0.06
