"""Refinement on small images of the bare body, and its report where it cannot improve."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh

from humangs_jax.body.landmarks import landmark_model, pose_landmarks
from humangs_jax.body.model import BodyPose, pose_body, shape_body
from humangs_jax.capture.fitting import silhouette_fit as module
from humangs_jax.capture.fitting.residuals import silhouettes
from humangs_jax.capture.fitting.residuals.silhouettes import (
    BodyView,
    body_boundary,
    body_edges,
    distances,
    mask_boundary,
    match,
    silhouette_residuals,
    view_body,
)
from humangs_jax.capture.fitting.silhouette_fit import (
    CaptureRefineConfig,
    Score,
    SilhouetteFit,
    refine_capture,
    start_state,
)
from humangs_jax.capture.keypoints.keypoints import COCO_17, Keypoints
from humangs_jax.core.pytree import replace
from humangs_jax.data.capture import Capture
from humangs_jax.data.capture_checks import CaptureError
from humangs_jax.geometry import quaternion, transform
from humangs_jax.geometry.camera import Camera, intrinsics_from_fov, orbit, project
from humangs_jax.rendering.mesh.rasterizer import rasterize_mesh
from tests.capture.fit_people import default_body, rotations_of

SIZE, VIEWS = 192, 3
CONFIG = CaptureRefineConfig(iterations=6, points=120)


@functools.cache
def truth():
    """Returns a capture of a person who stands, with masks of the bare body."""
    body = default_body()
    rotations, translation = jnp.asarray(rotations_of("standing")), jnp.asarray([0.0, 0.4, 0.0])
    pose = BodyPose(rotations, translation)
    K = intrinsics_from_fov(0.9, SIZE, SIZE)
    cameras = orbit(translation, 2.6, jnp.asarray([0.2, 2.2, 4.4]), 0.1, K, SIZE, SIZE)
    vertices = jax.jit(lambda: pose_body(body, shape_body(body, jnp.zeros(3)), pose).vertices)()
    large = [
        rasterize_mesh(vertices, body.faces, cameras[i].resized(2 * SIZE, 2 * SIZE)).face_ids
        for i in range(VIEWS)
    ]
    masks = np.stack(
        [(np.asarray(ids) >= 0).reshape(SIZE, 2, SIZE, 2).mean((1, 3)) for ids in large]
    ).astype(np.float32)
    images = np.repeat(1 - masks[..., None], 3, axis=-1)
    poses = jax.tree.map(lambda leaf: leaf[None], pose)
    names = ("front", "left", "right")
    return Capture(
        images,
        masks,
        cameras,
        np.zeros(VIEWS, np.int32),
        body,
        np.zeros(3, np.float32),
        poses,
        names,
    )


def turned(capture, degrees, axis=(0, 1, 0)):
    turn = quaternion.matrix_from_axis_angle(jnp.radians(degrees) * jnp.asarray(axis, jnp.float32))
    matrices = transform.make(turn, jnp.zeros(3)) @ capture.cameras.cam_from_world
    return dataclasses.replace(capture, cameras=replace(capture.cameras, cam_from_world=matrices))


@functools.cache
def augmented():
    """Returns the capture with errors: focal lengths 5 % too long, cameras turned by 2 degrees,
    joints by 3.
    """
    rng = np.random.default_rng(1)
    axes = rng.normal(size=(VIEWS + 22, 3))
    axes = jnp.asarray(axes / np.linalg.norm(axes, axis=1, keepdims=True), jnp.float32)
    turns = transform.make(
        quaternion.matrix_from_axis_angle(jnp.radians(2.0) * axes[:VIEWS]), jnp.zeros(3)
    )
    capture = truth()
    K = capture.cameras.K * jnp.asarray([[1.05, 1, 1], [1, 1.05, 1], [1, 1, 1]])
    rotations = capture.poses.rotations.at[0, :22].add(jnp.radians(3.0) * axes[VIEWS:])
    cameras = replace(capture.cameras, K=K, cam_from_world=turns @ capture.cameras.cam_from_world)
    return dataclasses.replace(
        capture, cameras=cameras, poses=replace(capture.poses, rotations=rotations)
    )


@jax.jit
def _joints(body, betas, pose):
    return pose_body(body, shape_body(body, betas), pose).joints


def aligned_error(capture):
    """Returns the mean distance of joints from the truth, metres, after the best rigid motion."""
    a, b = (
        np.asarray(_joints(c.body, jnp.asarray(c.betas), c.pose(0)))[:22]
        for c in (capture, truth())
    )
    a, b = a - a.mean(0), b - b.mean(0)
    u, _, vt = np.linalg.svd(b.T @ a)
    return np.linalg.norm(a @ ((u * [1, 1, np.linalg.det(u @ vt)]) @ vt).T - b, axis=-1).mean()


def keypoints(confidence=1.0):
    """Returns keypoints at the true landmarks."""
    model, capture = landmark_model(default_body(), COCO_17.names), truth()
    landmarks, _ = pose_landmarks(model, jnp.zeros(3), capture.pose(0))
    points = np.stack([project(capture.cameras[i], landmarks)[0] for i in range(VIEWS)])
    return Keypoints(
        points.astype(np.float32), np.full(points.shape[:2], confidence, np.float32), COCO_17
    )


@pytest.mark.slow
def test_silhouettes_mend_cameras_focal_length_and_pose():
    refined = refine_capture(augmented(), config=CONFIG)
    report = refined.report
    assert report.kept and report.errors["silhouette_iou"].before < 0.75
    assert report.errors["silhouette_iou"].after > 0.95
    assert aligned_error(refined.capture) < 0.5 * aligned_error(augmented())
    focal = np.asarray(refined.capture.cameras.K[:, 0, 0] / truth().cameras.K[:, 0, 0])
    np.testing.assert_allclose(focal, 1.0, atol=0.025)
    assert report.moved["camera_degrees"] == pytest.approx(2.0, abs=0.5)
    before = [view.iou_before for view in report.views]
    assert np.mean(before) == pytest.approx(report.errors["silhouette_iou"].before)
    text = str(report)
    assert "kept: refined" in text and "focal length x 0.9" in text and "front" in text


@pytest.mark.slow
def test_keypoints_alone_mend_them_too_and_with_masks_both_errors_fall():
    alone = refine_capture(
        dataclasses.replace(augmented(), masks=None), keypoints=keypoints(), config=CONFIG
    )
    assert alone.report.kept and "silhouette_iou" not in alone.report.errors
    error = alone.report.errors["keypoint_error_px"]
    assert error.after < 0.2 * error.before
    assert aligned_error(alone.capture) < 0.6 * aligned_error(augmented())
    assert "no mask" in str(alone.report)
    both = refine_capture(augmented(), keypoints=keypoints(), config=CONFIG)
    errors = both.report.errors
    assert errors["silhouette_iou"].after > 0.95 and errors["keypoint_error_px"].after < 1.0


@pytest.mark.slow
def test_a_start_that_is_right_stays():
    refined = refine_capture(truth(), config=CONFIG)
    assert not refined.report.kept and refined.capture is truth()
    assert all(change.before == change.after for change in refined.report.errors.values())
    assert "no sufficient improvement" in str(refined.report) and "moved:" not in str(
        refined.report
    )


@pytest.mark.slow
def test_views_with_an_empty_mask_take_no_part():
    masks = np.array(truth().masks)
    masks[1] = 0
    refined = refine_capture(dataclasses.replace(augmented(), masks=masks), config=CONFIG)
    assert refined.report.kept and np.isnan(refined.report.views[1].iou_after)
    assert refined.report.errors["silhouette_iou"].after > 0.93
    moved = refined.capture.cameras.cam_from_world - augmented().cameras.cam_from_world
    assert np.abs(moved[1]).max() < 1e-4 < np.abs(moved[0]).max(), "nothing is known of its camera"
    masks[2] = 0
    refined = refine_capture(dataclasses.replace(augmented(), masks=masks), config=CONFIG)
    assert refined.report.kept and refined.report.errors["silhouette_iou"].after > 0.92
    assert all(
        np.isfinite(leaf).all()
        for leaf in jax.tree.leaves((refined.capture.poses, refined.capture.cameras))
    )


@pytest.mark.slow
def test_cameras_that_look_the_other_way_are_named_and_left():
    away = turned(truth(), 180.0)
    refined = refine_capture(away, config=CONFIG)
    assert not refined.report.kept and refined.capture is away
    assert refined.report.errors["silhouette_iou"].after == 0
    assert "the start was too far off" in str(refined.report)


def test_nothing_to_refine_by_is_an_error_and_keypoints_of_other_views_are():
    for masks in (None, np.zeros((VIEWS, SIZE, SIZE), np.float32)):
        blind = dataclasses.replace(truth(), masks=masks)
        for known in (None, keypoints(confidence=0.0)):
            with pytest.raises(
                CaptureError, match="masks: none shows anybody, and there are no keypoints"
            ):
                refine_capture(blind, keypoints=known)
    with pytest.raises(ValueError, match="of 3 views, but the capture has 2"):
        refine_capture(truth().select([0, 1]), keypoints=keypoints())


@pytest.mark.parametrize(
    "before, after, kept",
    [
        ((0.25, 4.0), (0.24, 4.0), True),  # a twenty-fifth of the loss
        ((0.25, 4.0), (0.247, 4.0), False),  # less than a fiftieth
        ((0.25, 4.0), (0.26, 3.9), False),
        ((0.25, 4.0), (0.20, 6.0), False),  # fills the masks, and leaves the keypoints
        ((0.25, 4.0), (0.20, 4.6), True),  # within what chance does
        ((0.25, None), (0.22, None), False),  # masks alone: clothes fit wrong bodies better
        ((0.25, None), (0.19, None), True),
        ((0.02, 1.0), (0.018, 1.0), False),  # rounding of pixels
    ],
)
def test_small_gains_are_kept_where_keypoints_do_not_get_worse(before, after, kept):
    score = lambda loss, keypoints: Score(np.zeros(1), 1 - loss, keypoints, loss)
    assert (
        module._better(score(*after), score(*before), module.DEFAULT_CONFIG.keypoints_worse) is kept
    )
    bare = module._better(score(*after), score(*before), np.inf)
    assert bare is (kept or after == (0.20, 6.0))


def test_keypoints_of_long_narrow_photos_are_where_they_are():
    """In the smaller image the height is 0.853 of the photo's, and the width, in whole pixels,
    0.856.
    """
    known, cameras = keypoints(), truth().cameras.resized(90, 600)
    known = dataclasses.replace(known, points=known.points * np.float32([90 / SIZE, 600 / SIZE]))
    images = np.broadcast_to(np.float32(0), (VIEWS, 600, 90, 3))
    capture = dataclasses.replace(truth(), images=images, masks=None, cameras=cameras)
    scene = SilhouetteFit.of(capture, known, CONFIG)
    assert scene.score(capture).keypoints < 0.01
    width, height = scene.cameras.width, scene.cameras.height
    np.testing.assert_allclose(
        np.asarray(scene.observations.points)[:, 0] / [width, height],
        known.points / [90, 600],
        atol=1e-5,
    )


@pytest.mark.slow
def test_keypoints_weigh_by_the_noise_that_the_body_finds():
    """A detector's bias of 6 pixels must not count as noise of 0.8."""
    known = keypoints()
    biased = dataclasses.replace(known, points=known.points + np.float32(6.0))
    noises = []
    for each in (known, biased):
        scene = SilhouetteFit.of(truth(), each, CONFIG)
        expected = scene.observations.noise
        noises.append(
            np.asarray(
                scene.look(start_state(scene.origin, CONFIG), 5.0).keypoints.noise / expected
            )
        )
    assert noises[0] == pytest.approx(0.5) and (noises[1] > 5).all()


# Silhouettes of a sphere and of a disc, which are known, and what of two silhouettes belongs
# together -----------------


SIDE, FOCAL, DISTANCE, RADIUS = 128, 160.0, 3.0, 0.8
IMAGE_RADIUS = FOCAL * RADIUS / np.sqrt(DISTANCE**2 - RADIUS**2)
COUNT = 90


def camera(x=0.0, z=DISTANCE):
    matrix = np.eye(4)
    matrix[:3, 3] = [x, 0, z]
    return Camera.from_opencv(
        [[FOCAL, 0, SIDE / 2], [0, FOCAL, SIDE / 2], [0, 0, 1]], matrix, SIDE, SIDE
    )


@pytest.fixture(scope="module")
def sphere():
    mesh = trimesh.creation.icosphere(subdivisions=4, radius=RADIUS)
    return np.asarray(mesh.vertices, np.float32), np.asarray(mesh.faces, np.int32)


def boundary_of(sphere, camera):
    vertices, faces = sphere
    return body_boundary(
        view_body(jnp.asarray(vertices), jnp.asarray(faces, jnp.int32), camera),
        faces,
        body_edges(faces),
        COUNT,
    )


def disc(radius, x=SIDE / 2):
    """Returns the coverage of a disc with soft edges."""
    rows, columns = np.mgrid[:SIDE, :SIDE] + 0.5
    return np.clip(radius - np.hypot(columns - x, rows - SIDE / 2) + 0.5, 0, 1).astype(np.float32)


def test_edges_of_a_tetrahedron_have_two_faces_each_and_of_a_triangle_one():
    tetrahedron = np.asarray([[0, 1, 2], [0, 3, 1], [1, 3, 2], [2, 3, 0]])
    edges = body_edges(tetrahedron)
    assert len(edges.ends) == 6
    for ends, faces in zip(edges.ends, edges.faces, strict=True):
        assert (
            set(faces) == {f for f in range(4) if set(ends) <= set(tetrahedron[f])}
            and len(set(faces)) == 2
        )
    assert set(body_edges(tetrahedron[:1]).faces[:, 1]) == {-1}


def test_a_sphere_s_boundary_is_the_circle_of_its_tangents(sphere):
    boundary = boundary_of(sphere, camera())
    offsets = boundary.positions - SIDE / 2
    # corners of a mesh of 2,562 vertices: chords cut 0.1 % of the radius off
    np.testing.assert_allclose(np.linalg.norm(offsets, axis=1), IMAGE_RADIUS, atol=0.25)
    assert (np.sum(offsets / IMAGE_RADIUS * boundary.normals, axis=1) > 0.98).all()
    angles = np.sort(np.arctan2(*offsets.T))
    assert np.diff(angles).max() < 2 * 2 * np.pi / COUNT, "evenly spread"
    share = boundary.shares[:, None]
    on_edges = (1 - share) * sphere[0][boundary.ends[:, 0]] + share * sphere[0][boundary.ends[:, 1]]
    projected = FOCAL * on_edges[:, :2] / (on_edges[:, 2:] + DISTANCE)
    np.testing.assert_allclose(
        projected,
        offsets,
        atol=0.05,  # a point of an edge is seen a little off the middle of its ends
    )


def test_what_leaves_the_image_or_is_behind_the_camera_is_no_boundary(sphere):
    cut = boundary_of(sphere, camera(x=-1.0))
    assert len(cut.positions) == COUNT and (cut.positions > 0).all()
    assert (
        np.abs(
            np.linalg.norm(cut.positions - [SIDE / 2 - FOCAL / DISTANCE, SIDE / 2], axis=1)
            - IMAGE_RADIUS
        ).max()
        < 3
    )
    assert len(boundary_of(sphere, camera(z=-DISTANCE)).positions) == 0


def test_an_edge_before_the_body_is_no_boundary():
    """A small square lies before a large one; only the large one's border is the silhouette."""
    square = np.asarray([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], np.float32)
    vertices = np.concatenate([square, 0.3 * square - [0, 0, 0.5]]).astype(np.float32)
    faces = np.asarray([[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]])
    image = view_body(jnp.asarray(vertices), jnp.asarray(faces, jnp.int32), camera())
    # normals of a flat mesh do not show its border
    outwards = np.concatenate([square[:, :2]] * 2) / np.sqrt(2)
    image = BodyView(image.pixels, image.depths, outwards.astype(np.float32), image.covered)
    boundary = body_boundary(image, faces, body_edges(faces), COUNT)
    assert len(boundary.positions) == COUNT and boundary.ends.max() < 4


def test_a_disc_s_boundary_is_its_circle_without_specks_and_the_edge_of_the_image():
    boundary = mask_boundary(disc(30.0), COUNT)
    offsets = boundary.positions - SIDE / 2
    np.testing.assert_allclose(np.linalg.norm(offsets, axis=1), 30.0, atol=0.1)
    assert (np.sum(offsets / 30 * boundary.normals, axis=1) > 0.98).all()
    assert len(mask_boundary(np.ones((SIDE, SIDE), np.float32), COUNT).positions) == 0
    speckled = disc(30.0)
    speckled[5, 5] = 1
    assert (np.linalg.norm(mask_boundary(speckled, COUNT).positions - SIDE / 2, axis=1) < 31).all()
    cut = mask_boundary(disc(30.0, x=SIDE - 10), COUNT).positions
    assert len(cut) == COUNT and cut.max() < SIDE - 1


def test_points_find_the_mask_in_reach_and_tell_how_far_outside_they_are(sphere):
    boundary = boundary_of(sphere, camera())
    gap = 4.0
    mask = disc(IMAGE_RADIUS + gap)
    other = mask_boundary(mask, COUNT)
    matches = match(boundary, mask, other, 10.0, COUNT)
    assert matches.weights.shape == (2 * COUNT,) and float(matches.weights.mean()) == 1.0
    off = distances(matches, jnp.asarray(boundary.positions, jnp.float32))
    # inside; polygons and the nearest of 90 points make up the rest
    np.testing.assert_allclose(off, -gap, atol=0.35)
    assert float(match(boundary, mask, other, 2.0, COUNT).weights.sum()) == 0, "out of reach"
    empty = np.zeros((SIDE, SIDE), np.float32)
    assert (
        float(match(boundary, empty, mask_boundary(empty, COUNT), 10.0, COUNT).weights.sum()) == 0
    )


def test_clothes_explain_a_gap_and_a_body_outside_costs_more_than_one_inside(sphere):
    boundary = boundary_of(sphere, camera())
    pixels = jnp.asarray(boundary.positions, jnp.float32)

    def cost(gap, clothes):
        mask = disc(IMAGE_RADIUS + gap)
        matches = match(boundary, mask, mask_boundary(mask, COUNT), 10.0, COUNT)
        thick = jnp.full(len(pixels), clothes)
        residuals = silhouette_residuals(
            matches, pixels, thick, jnp.asarray(1.0), (jnp.asarray(10.0), jnp.asarray(3.0)), 40.0
        )
        return float(jnp.sum(jnp.square(residuals)))

    assert cost(4.0, 4.0) < 0.02 * cost(4.0, 0.0)
    assert cost(-4.0, 0.0) > 1.5 * cost(4.0, 0.0)
    assert cost(4.0, 0.0) < 40 * 4.0**2, "180 equations count for 40"


def shapes_of(arguments):
    """Returns what the compiled program of a call depends on: structure, shapes and functions."""
    leaves, tree = jax.tree.flatten(arguments)
    return tree, [x if callable(x) else str(jax.eval_shape(lambda y: y, x)) for x in leaves]


def test_what_is_compiled_ahead_is_what_a_refinement_calls(monkeypatch):
    unmasked = dataclasses.replace(augmented(), masks=None)
    ahead = list(SilhouetteFit.of(unmasked, keypoints(), CONFIG).calls())
    expected = {program.__name__: shapes_of(arguments) for program, arguments in ahead}
    called = {}

    def note(holder, name, program):
        def noted(*arguments):
            called[name] = shapes_of(arguments)
            return program(*arguments)

        monkeypatch.setattr(holder, name, noted)

    for holder in (module, silhouettes):
        for program, _ in ahead:
            if hasattr(holder, program.__name__):
                note(holder, program.__name__, getattr(holder, program.__name__))
    note(module, "solve_round", lambda model, origin, evidence, state, *settings: state)
    scene = SilhouetteFit.of(augmented(), keypoints(), dataclasses.replace(CONFIG, iterations=1))
    state, _ = scene.run()
    scene.score(module.moved_capture(augmented(), scene.origin, state))
    assert set(expected) == set(called) and len(expected) == 6
    for name, shapes in expected.items():
        assert called[name] == shapes, name
