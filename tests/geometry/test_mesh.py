"""Areas and normals of known surfaces; the smallest turn between two directions."""

import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st

from humangs_jax.geometry.mesh import (
    directions_around,
    face_areas,
    face_crosses,
    in_front,
    smallest_turns,
    unit,
    vertex_areas,
)

EXACT = 1e-9
directions = (
    st.lists(st.floats(-1, 1), min_size=3, max_size=3)
    .map(np.asarray)
    .filter(lambda v: np.abs(v).max() > 1e-3)
)


def test_a_sphere_has_its_area_and_its_normals_point_outwards():
    sphere = trimesh.creation.icosphere(subdivisions=4, radius=2.0)
    vertices, faces = np.asarray(sphere.vertices), np.asarray(sphere.faces)
    # of the polyhedron in it
    assert face_areas(vertices, faces).sum() == pytest.approx(16 * np.pi, rel=0.01)
    assert vertex_areas(vertices, faces).sum() == pytest.approx(sphere.area)
    crosses = face_crosses(vertices, faces)
    np.testing.assert_allclose(np.linalg.norm(crosses, axis=1), 2 * sphere.area_faces, atol=EXACT)
    assert (np.sum(unit(crosses) * unit(vertices[faces].mean(axis=1)), axis=1) > 0.99).all()
    assert not unit(np.zeros((2, 3))).any()


@given(directions, directions)
def test_the_smallest_turn_takes_one_direction_to_the_other(a, b):
    a, b = unit(np.stack([a, b]))
    turn = smallest_turns(a, b, opposite=1e-24)
    np.testing.assert_allclose(turn @ a, b, atol=1e-7)
    np.testing.assert_allclose(turn @ turn.T, np.eye(3), atol=EXACT)
    angle = 2 * np.arctan2(np.linalg.norm(a - b), np.linalg.norm(a + b))
    # no more than that angle
    assert np.trace(turn) == pytest.approx(1 + 2 * np.cos(angle), abs=1e-7)


def test_opposite_directions_are_half_a_turn_apart_and_nothing_turns_nothing():
    axes = np.concatenate([np.eye(3), -np.eye(3)])
    np.testing.assert_allclose(
        np.einsum("nab,nb->na", smallest_turns(axes, -axes), axes), -axes, atol=EXACT
    )
    np.testing.assert_array_equal(
        smallest_turns(np.zeros(3), axes), np.broadcast_to(np.eye(3), (6, 3, 3))
    )


def test_directions_are_spread_and_what_is_behind_is_not_seen():
    directions = directions_around(48)
    np.testing.assert_allclose(np.linalg.norm(directions, axis=1), 1)
    nearest = np.sort(directions @ directions.T, axis=1)[:, -2]
    assert np.degrees(np.arccos(nearest)).min() > 15
    start = [np.arctan2(x[2], x[0]) for x in (directions_around(48, turned=0.0)[0], directions[0])]
    # half a golden angle
    np.testing.assert_allclose(start, [0, np.pi * (3 - np.sqrt(5)) / 2], atol=EXACT)
    x, y = np.meshgrid(np.arange(8.0), np.arange(5.0))
    wall = np.stack([x.ravel(), y.ravel(), 0 * x.ravel()], axis=1)
    for forward in (np.asarray([0, 0, 1.0]), np.asarray([0, 0, -1.0])):
        both = np.concatenate([wall, wall + forward])
        seen = in_front(both, both, forward, 0.9, 0.5)
        assert seen[: len(wall)].all() and not seen[len(wall) :].any()
        beside = np.asarray([[-9.0, 2, 5], [20, 2, 5], [3, -9, 5], [3, 20, 5]]) * [1, 1, forward[2]]
        assert in_front(beside, wall, forward, 0.9, 0.5).all()  # nothing is before them
        assert not in_front(np.concatenate([beside, wall + forward]), wall, forward, 0.9, 0.5)[
            4:
        ].any()
