"""Silhouettes of a sphere and of a disc, which are known, and what of two silhouettes belongs together."""

import jax.numpy as jnp
import numpy as np
import pytest
import trimesh

from humangs_jax.fitting.residuals.silhouettes import (
    BodyView,
    MaskView,
    body_boundary,
    distances,
    mask_boundary,
    match,
    mesh_edges,
    silhouette_residuals,
    view_body,
)
from humangs_jax.geometry.camera import Camera

SIZE, FOCAL, DISTANCE, RADIUS = 128, 160.0, 3.0, 0.8
IMAGE_RADIUS = FOCAL * RADIUS / np.sqrt(DISTANCE**2 - RADIUS**2)
COUNT = 90


def camera(x=0.0, z=DISTANCE):
    matrix = np.eye(4)
    matrix[:3, 3] = [x, 0, z]
    return Camera.from_opencv([[FOCAL, 0, SIZE / 2], [0, FOCAL, SIZE / 2], [0, 0, 1]], matrix, SIZE, SIZE)


@pytest.fixture(scope="module")
def sphere():
    mesh = trimesh.creation.icosphere(subdivisions=4, radius=RADIUS)
    return np.asarray(mesh.vertices, np.float32), np.asarray(mesh.faces, np.int32)


def boundary_of(sphere, camera):
    vertices, faces = sphere
    return body_boundary(
        view_body(jnp.asarray(vertices), jnp.asarray(faces, jnp.int32), camera), faces, mesh_edges(faces), COUNT
    )


def disc(radius, x=SIZE / 2):
    """Coverage of a disc, with soft edges."""
    rows, columns = np.mgrid[:SIZE, :SIZE] + 0.5
    return np.clip(radius - np.hypot(columns - x, rows - SIZE / 2) + 0.5, 0, 1).astype(np.float32)


def test_edges_of_a_tetrahedron_have_two_faces_each_and_of_a_triangle_one():
    tetrahedron = np.asarray([[0, 1, 2], [0, 3, 1], [1, 3, 2], [2, 3, 0]])
    edges = mesh_edges(tetrahedron)
    assert len(edges.ends) == 6
    for ends, faces in zip(edges.ends, edges.faces, strict=True):
        assert set(faces) == {f for f in range(4) if set(ends) <= set(tetrahedron[f])} and len(set(faces)) == 2
    assert set(mesh_edges(tetrahedron[:1]).faces[:, 1]) == {-1}


def test_a_sphere_s_boundary_is_the_circle_of_its_tangents(sphere):
    boundary = boundary_of(sphere, camera())
    offsets = boundary.positions - SIZE / 2
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
        np.abs(np.linalg.norm(cut.positions - [SIZE / 2 - FOCAL / DISTANCE, SIZE / 2], axis=1) - IMAGE_RADIUS).max() < 3
    )
    assert len(boundary_of(sphere, camera(z=-DISTANCE)).positions) == 0


def test_an_edge_before_the_body_is_no_boundary():
    """A small square before a large one: only the large one's border is the silhouette."""
    square = np.asarray([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], np.float32)
    vertices = np.concatenate([square, 0.3 * square - [0, 0, 0.5]]).astype(np.float32)
    faces = np.asarray([[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]])
    image = view_body(jnp.asarray(vertices), jnp.asarray(faces, jnp.int32), camera())
    outwards = np.concatenate([square[:, :2]] * 2) / np.sqrt(2)  # normals of a flat mesh do not show its border
    image = BodyView(image.pixels, image.depths, outwards.astype(np.float32), image.covered)
    boundary = body_boundary(image, faces, mesh_edges(faces), COUNT)
    assert len(boundary.positions) == COUNT and boundary.ends.max() < 4


def test_a_disc_s_boundary_is_its_circle_to_a_tenth_of_a_pixel():
    boundary = mask_boundary(disc(30.0), COUNT)
    offsets = boundary.positions - SIZE / 2
    np.testing.assert_allclose(np.linalg.norm(offsets, axis=1), 30.0, atol=0.1)
    assert (np.sum(offsets / 30 * boundary.normals, axis=1) > 0.98).all()


def test_masks_without_an_boundary_have_no_points_and_specks_none_either():
    assert len(mask_boundary(np.zeros((SIZE, SIZE), np.float32), COUNT).positions) == 0
    assert len(mask_boundary(np.ones((SIZE, SIZE), np.float32), COUNT).positions) == 0
    speckled = disc(30.0)
    speckled[5, 5] = 1
    assert (np.linalg.norm(mask_boundary(speckled, COUNT).positions - SIZE / 2, axis=1) < 31).all()
    cut = mask_boundary(disc(30.0, x=SIZE - 10), COUNT).positions
    assert len(cut) == COUNT and cut.max() < SIZE - 1, "the image's edge is no silhouette"


def test_points_find_the_mask_in_reach_and_tell_how_far_outside_they_are(sphere):
    boundary = boundary_of(sphere, camera())
    gap = 4.0
    mask = disc(IMAGE_RADIUS + gap)
    view = MaskView(mask, mask_boundary(mask, COUNT))
    matches = match(boundary, view, 10.0, COUNT)
    assert matches.weights.shape == (2 * COUNT,) and float(matches.weights.mean()) == 1.0
    off = distances(matches, jnp.asarray(boundary.positions, jnp.float32))
    np.testing.assert_allclose(off, -gap, atol=0.35)  # inside; polygons and the nearest of 90 points make up the rest
    assert float(match(boundary, view, 2.0, COUNT).weights.sum()) == 0, "out of reach"


def test_an_empty_boundary_matches_nothing(sphere):
    mask = np.zeros((SIZE, SIZE), np.float32)
    matches = match(boundary_of(sphere, camera()), MaskView(mask, mask_boundary(mask, COUNT)), 10.0, COUNT)
    assert float(matches.weights.sum()) == 0


def test_clothes_explain_a_gap_and_a_body_outside_costs_more_than_one_inside(sphere):
    boundary = boundary_of(sphere, camera())
    pixels = jnp.asarray(boundary.positions, jnp.float32)

    def cost(gap, clothes):
        mask = disc(IMAGE_RADIUS + gap)
        matches = match(boundary, MaskView(mask, mask_boundary(mask, COUNT)), 10.0, COUNT)
        thick = jnp.full(len(pixels), clothes)
        residuals = silhouette_residuals(
            matches, pixels, thick, jnp.asarray(1.0), (jnp.asarray(10.0), jnp.asarray(3.0)), 40.0
        )
        return float(jnp.sum(jnp.square(residuals)))

    assert cost(4.0, 4.0) < 0.02 * cost(4.0, 0.0)
    assert cost(-4.0, 0.0) > 1.5 * cost(4.0, 0.0)
    assert cost(4.0, 0.0) < 40 * 4.0**2, "180 equations count for 40"
