import jax.numpy as jnp
import numpy as np
import pytest
from body_cases import areas, is_closed, signed_volume

from humangs_jax.body.model import shape_body
from humangs_jax.body.resolution import decimate, split_long_edges
from humangs_jax.core.pytree import replace
from humangs_jax.geometry.mesh import vertex_areas

LONGEST = 0.05
JOINT_TOLERANCE = 1e-6  # metres: joints are regressed from the same vertices


def area(vertices, faces):
    return areas(vertices, faces).sum()


@pytest.fixture(scope="module")
def coarse(body):
    return decimate(body, 800)


def test_edges_are_short_and_the_surface_is_the_same(coarse):
    fine = split_long_edges(coarse, LONGEST)[0]
    x, corners = np.asarray(fine.template), np.asarray(fine.template)[np.asarray(fine.faces)]
    assert np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max() <= LONGEST
    assert len(x) > len(coarse.template)
    # no T-junction, no crack
    assert is_closed(np.asarray(coarse.faces)) and is_closed(np.asarray(fine.faces))
    for of in (area, signed_volume):
        np.testing.assert_allclose(
            of(fine.template, fine.faces), of(coarse.template, coarse.faces), rtol=1e-5
        )
    np.testing.assert_array_equal(x[: len(coarse.template)], coarse.template)


def test_midpoints_stay_midpoints_in_every_shape_and_weights_sum_to_one(coarse):
    fine = split_long_edges(coarse, LONGEST)[0]
    np.testing.assert_allclose(fine.skinning_weights.sum(-1), 1, atol=1e-5)
    betas = jnp.asarray([1.0, -2.0, 1.5])
    before, after = shape_body(coarse, betas), shape_body(fine, betas)
    np.testing.assert_allclose(after.joints, before.joints, atol=JOINT_TOLERANCE)
    np.testing.assert_allclose(
        area(after.vertices, fine.faces), area(before.vertices, coarse.faces), rtol=1e-5
    )


@pytest.mark.parametrize("longest", [0.0, -1.0, float("nan"), 1e-9])
def test_impossible_lengths_are_refused(coarse, longest):
    with pytest.raises(ValueError, match="longest edge"):
        split_long_edges(coarse, longest)


def test_spacing_says_how_much_closer_vertices_are(body):
    """All edges of a square of two triangles are halved twice: the spacing is a quarter."""
    square = np.asarray([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], np.float32)
    n = len(square)
    flat = replace(
        body,
        template=jnp.asarray(square),
        shape_directions=jnp.zeros((n, 3, 1)),
        joint_regressor=jnp.zeros((55, n)),
        skinning_weights=jnp.ones((n, 55)) / 55,
        faces=jnp.asarray([[0, 1, 2], [0, 2, 3]]),
        expressions=None,
    )
    coarse, fine = split_long_edges(flat, 0.8)[0], split_long_edges(flat, 0.4)[0]
    assert len(coarse.template) == 9 and len(fine.template) == 25
    around = lambda mesh: vertex_areas(np.asarray(mesh.template), np.asarray(mesh.faces))
    np.testing.assert_allclose(around(fine).sum(), 1, rtol=1e-6)
    # the four corners keep their faces' shape: a quarter of the length is a sixteenth of the area
    np.testing.assert_allclose(fine.relative_vertex_spacing[:n], 0.25, rtol=1e-5)
    np.testing.assert_allclose(coarse.relative_vertex_spacing[:n], 0.5, rtol=1e-5)
    same = split_long_edges(flat, 10.0)[0]
    assert same.relative_vertex_spacing == pytest.approx(1.0) and np.array_equal(
        same.faces, flat.faces
    )
