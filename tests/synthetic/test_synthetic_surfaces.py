"""Cuts, hems and silhouettes: the geometry under the garments."""

import numpy as np
import pytest

from humangs_jax.synthetic.surfaces import (
    ANGLES,
    Boundaries,
    Surface,
    boundaries,
    boundary_edges,
    cut,
    grid_faces,
    hanging,
    join,
    smooth,
    turn_in_hems,
    vertex_normals,
)

ROUNDING = 1e-5
"""Rounding of float32 sums of a few hundred numbers of size 1."""


def plane(rows=9, columns=12):
    """Returns the unit square in x and y, seen from +z, with rows that run down."""
    y, x = np.meshgrid(np.linspace(1, 0, rows), np.linspace(0, 1, columns), indexing="ij")
    vertices = np.stack([x.ravel(), y.ravel(), 0 * x.ravel()], -1).astype(np.float32)
    weights = np.stack([vertices[:, 0], 1 - vertices[:, 0]], -1)
    return Surface(
        vertices, grid_faces(rows, columns, closed=False), weights, {"copy": vertices.copy()}
    )


def area(surface):
    a, b, c = (surface.vertices[surface.faces[:, i]] for i in range(3))
    return 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1).sum()


def test_grid_faces_look_towards_the_viewer():
    surface = plane()
    np.testing.assert_allclose(
        vertex_normals(surface.vertices, surface.faces), [[0, 0, 1]] * len(surface.vertices)
    )


@pytest.mark.parametrize(
    "slope, level, expected",
    [(0.0, 0.37, 0.37), (1.0, 0.5, 0.5 * 0.5**2), (0.3, 0.61, 0.61 - 0.15)],
)
def test_a_cut_is_exact(slope, level, expected):
    surface = plane()
    x, y, _ = surface.vertices.T
    kept = cut(surface, level - slope * x - y)
    assert area(kept) == pytest.approx(expected, abs=ROUNDING)
    # attributes move along
    np.testing.assert_allclose(kept.attributes["copy"], kept.vertices, atol=ROUNDING)
    np.testing.assert_allclose(kept.weights.sum(1), 1, atol=ROUNDING)
    a, b, c = (kept.vertices[kept.faces[:, i], :2] for i in range(3))
    assert (np.linalg.det(np.stack([b - a, c - a], -1)) > -ROUNDING).all()  # no face turned over
    assert kept.faces.max() == len(kept.vertices) - 1
    corners = kept.vertices[np.unique(boundary_edges(kept.faces))]
    inner = (corners[:, 0] > 0.01) & (corners[:, 0] < 0.99) & (corners[:, 1] > 0.01)
    on_line = corners[inner, 1] + slope * corners[inner, 0]
    # no cracks: all inner borders are the cut
    np.testing.assert_allclose(on_line, level, atol=ROUNDING)


def test_both_halves_of_a_cut_make_the_whole_without_gaps():
    surface = plane()
    field = np.sin(5 * surface.vertices[:, 0]) - surface.vertices[:, 1]
    assert area(join([cut(surface, field), cut(surface, -field)])) == pytest.approx(
        1.0, abs=ROUNDING
    )


def test_smoothing_keeps_hems_in_place_and_flattens_bumps():
    surface = plane()
    bumpy = surface.vertices.copy()
    bumpy[:, 2] += 0.1 * (-1.0) ** np.arange(len(bumpy))
    flat = smooth(bumpy, surface.faces, 5)
    assert np.abs(flat[:, 2]).mean() < 0.02
    kept = smooth(surface.vertices, surface.faces, 5, keep_hems=True)
    hem = np.unique(boundary_edges(surface.faces))
    assert np.abs(kept[hem] - surface.vertices[hem]).max() < 0.1  # only corners are rounded
    assert np.abs(kept[hem][:, [0, 1]] - 0.5).max(1).min() > 0.4


def test_hems_are_turned_in_against_the_normal():
    surface = plane()
    with_hem = turn_in_hems(surface, 0.05)
    added = with_hem.vertices[len(surface.vertices) :]
    assert len(added) == len(np.unique(boundary_edges(surface.faces)))
    np.testing.assert_allclose(added[:, 2], -0.05, atol=ROUNDING)
    new_faces = with_hem.faces[len(surface.faces) :]
    outward = np.cross(
        with_hem.vertices[new_faces[:, 1]] - with_hem.vertices[new_faces[:, 0]],
        with_hem.vertices[new_faces[:, 2]] - with_hem.vertices[new_faces[:, 0]],
    )
    middle = with_hem.vertices[new_faces].mean(1) - [0.5, 0.5, 0]
    assert ((outward * middle).sum(1) > 0).mean() > 0.99


def ellipse_points(a=0.2, b=0.1):
    angle = np.linspace(0, 2 * np.pi, 400, endpoint=False)
    levels = np.linspace(-0.5, 0.5, 60)
    along, angle = (x.ravel() for x in np.meshgrid(levels, angle))
    return along, np.stack([a * np.sin(angle), b * np.cos(angle)], -1)


def test_boundaries_of_an_ellipse():
    along, across = ellipse_points()
    found = boundaries(along, across, np.linspace(-0.4, 0.4, 9), np.zeros((9, 2)), 0.03)
    angle = np.linspace(-3, 3, 31)
    expected = 1 / np.sqrt((np.sin(angle) / 0.2) ** 2 + (np.cos(angle) / 0.1) ** 2)
    chord = 0.04  # 48 angles: polygons instead of curves
    np.testing.assert_allclose(found.radius(np.zeros(31), angle), expected, rtol=chord)


def test_boundaries_bridge_hollows():
    along, across = ellipse_points()
    hollow = np.linalg.norm(across - [0.0, 0.1], axis=1) < 0.06  # a dent in front
    found = boundaries(
        along[~hollow], across[~hollow], np.asarray([-0.1, 0.0, 0.1]), np.zeros((3, 2)), 0.03
    )
    assert found.radius(np.zeros(1), np.zeros(1))[0] > 0.07


def test_hanging_cloth_narrows_no_faster_than_its_slope():
    radii = np.random.default_rng(0).uniform(0.05, 0.2, (9, ANGLES))
    shape = Boundaries(np.linspace(0, 0.8, 9), np.zeros((9, 2)), radii)
    hung = hanging(shape, slope=0.5)
    assert (hung.radii >= radii).all()
    assert (hung.radii[:-1] - hung.radii[1:] >= -0.5 * 0.1 - ROUNDING).all()
    np.testing.assert_array_equal(hung.radii[-1], radii[-1])
