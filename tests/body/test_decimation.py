import jax.numpy as jnp
import numpy as np
import pytest
from body_cases import areas, edge_counts, is_closed, made_up_body, signed_volume

from humangs_jax.body.model import shape_body
from humangs_jax.body.resolution import collapse_sequence, decimate, exposure
from humangs_jax.core.pytree import replace

SAME_JOINTS = 1e-5  # metres: float32 sums of 200 vertices, and the ridge of the refit
LEVELS = (3345, 669)


@pytest.fixture(scope="module", params=LEVELS)
def small(request, body):
    return decimate(body, request.param)


def places(small, body):
    """Returns the index in the full body of each vertex of the small one."""
    where = {tuple(v): i for i, v in enumerate(np.asarray(body.template).tolist())}
    return np.asarray([where[tuple(v)] for v in np.asarray(small.template).tolist()])


def test_vertices_are_a_subset_with_everything_they_carry(small, body):
    kept = places(small, body)
    assert len(np.unique(kept)) == len(kept) == small.template.shape[0]
    assert np.array_equal(small.shape_directions, body.shape_directions[kept])
    assert np.array_equal(small.skinning_weights, body.skinning_weights[kept])
    assert (small.parents, small.joint_names, small.shape_names) == (
        body.parents,
        body.joint_names,
        body.shape_names,
    )


def test_the_surface_stays_closed_and_solid(small, body):
    faces, vertices = np.asarray(small.faces), np.asarray(small.template)
    assert is_closed(faces)
    assert np.unique(faces).size == len(vertices)
    # Euler's formula
    assert len(faces) == 2 * len(vertices) - (2 * body.template.shape[0] - body.faces.shape[0])
    assert areas(vertices, faces).min() > 1e-9
    full = signed_volume(body.template, body.faces)
    assert abs(signed_volume(vertices, faces) / full - 1) < 0.04
    assert np.allclose(
        np.ptp(vertices, axis=0), np.ptp(np.asarray(body.template), axis=0), atol=0.015
    )


def test_joints_are_those_of_the_full_body_for_any_shape(small, body):
    betas = jnp.asarray(np.random.default_rng(0).normal(size=len(body.shape_names)), jnp.float32)
    assert np.allclose(
        shape_body(small, betas).joints, shape_body(body, betas).joints, atol=SAME_JOINTS
    )
    assert np.allclose(np.asarray(small.joint_regressor).sum(1), 1, atol=1e-5)


def test_texture_corners_belong_to_their_vertices_and_stay_in_their_charts(small, body):
    kept = places(small, body)
    uv_of = {
        (int(v), *uv)
        for v, uv in zip(
            np.asarray(body.faces).ravel(),
            np.asarray(body.uvs)[np.asarray(body.uv_faces).ravel()].tolist(),
            strict=True,
        )
    }
    uvs = np.asarray(small.uvs)[np.asarray(small.uv_faces)]
    for v, uv in zip(
        kept[np.asarray(small.faces)].ravel(), uvs.reshape(-1, 2).tolist(), strict=True
    ):
        assert (int(v), *uv) in uv_of
    # A face torn between two charts would be long in the texture and short on the skin.
    corners = np.asarray(small.template)[np.asarray(small.faces)]
    skin = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(1)
    texture = np.linalg.norm(uvs - np.roll(uvs, 1, axis=1), axis=2).max(1)
    assert np.mean(texture > 4 * skin) < 0.02


def test_vertices_spread_over_the_skin(body):
    """Face, ears and hands are crowded in the full body; half of the vertices must leave them."""
    owner = lambda b: np.asarray(b.skinning_weights).argmax(1)
    crowded = [12, 15, 20, 21, *range(25, 55)]
    share = lambda b: np.isin(owner(b), crowded).mean()
    half = decimate(body, 3345)
    assert share(body) > 0.5 and share(half) < 0.3
    # Every finger keeps the vertices that bend it.
    assert set(range(25, 55)) <= set(owner(half))


def test_the_whole_size_changes_nothing_and_others_are_refused(body):
    same = decimate(body, 13380)
    assert np.array_equal(same.faces, body.faces) and np.array_equal(same.template, body.template)
    for count in (0, 13381):
        with pytest.raises(ValueError, match="13380 vertices"):
            decimate(body, count)
    with pytest.raises(ValueError, match=r"can be reduced to \d+ vertices at least"):
        decimate(body, 2)


def test_what_is_measured_on_the_full_body_does_not_stay(body):
    known = replace(body, relative_vertex_spacing=jnp.ones(len(body.template)))
    assert decimate(known, 4000).relative_vertex_spacing is None


def sphere(rings=12, radius=1.0, open_below=False):
    """Returns vertices and faces of a sphere, or of its upper part, which has a rim."""
    columns = 2 * rings
    angles = np.linspace(0, np.pi, rings + 1)[1:-1]
    angles = angles[: len(angles) // 2 + 1] if open_below else angles
    turn = np.arange(columns) * 2 * np.pi / columns
    # rings between two poles, a little twisted against each other
    grid = [
        [
            [np.sin(a) * np.sin(t + 0.1 * a), np.cos(a), np.sin(a) * np.cos(t + 0.1 * a)]
            for t in turn
        ]
        for a in angles
    ]
    vertices = np.concatenate([[[0, 1.0, 0]], np.reshape(grid, (-1, 3)), [[0, -1.0, 0]]])
    vertex_at = lambda r, c: 1 + r * columns + c % columns
    # a fan at the upper pole, two triangles between the rings, a fan at the lower pole
    faces = [(0, vertex_at(0, c), vertex_at(0, c + 1)) for c in range(columns)]
    for r in range(len(angles) - 1):
        for c in range(columns):
            faces += [
                (vertex_at(r, c), vertex_at(r + 1, c), vertex_at(r, c + 1)),
                (vertex_at(r, c + 1), vertex_at(r + 1, c), vertex_at(r + 1, c + 1)),
            ]
    if open_below:
        vertices = vertices[:-1]
    else:
        last = len(vertices) - 1
        faces += [
            (last, vertex_at(len(angles) - 1, c + 1), vertex_at(len(angles) - 1, c))
            for c in range(columns)
        ]
    return radius * vertices, np.asarray(faces)


def bare_body(vertices, faces):
    n = len(vertices)
    body = made_up_body(n=n, pose_directions=True)
    return replace(
        body, template=jnp.asarray(vertices, jnp.float32), faces=jnp.asarray(faces, jnp.int32)
    )


def test_a_vertex_of_no_face_outside_of_all_faces_is_seen():
    vertices, faces = sphere(rings=4)
    for loose in ([0, 2.0, 0], [-3.0, -3, -3]):
        assert exposure(np.concatenate([vertices, [loose]]), faces)[-1] > 0.5


def test_a_body_without_collapses_finds_them():
    vertices, faces = sphere(rings=8)
    body = bare_body(vertices, faces)
    small = decimate(body, 60)
    assert small.template.shape == (60, 3) and small.pose_directions.shape[0] == 60
    assert small.uvs is None and is_closed(np.asarray(small.faces))
    assert signed_volume(small.template, small.faces) > 0.9 * signed_volume(vertices, faces) > 0
    # the result carries its own
    assert np.array_equal(decimate(small, 40).template, decimate(body, 40).template)


@pytest.mark.slow
def test_a_rim_stays_a_rim():
    vertices, faces = sphere(open_below=True)
    rim = lambda f: {e for e in edge_counts(f) if (e[1], e[0]) not in edge_counts(f)}
    lowest = vertices[:, 1].min()
    small = decimate(bare_body(vertices, faces), len(vertices) // 3)
    edges = rim(np.asarray(small.faces))
    assert 3 <= len(edges) < len(rim(faces))
    assert np.allclose(
        np.asarray(small.template)[np.asarray(sorted(edges))][..., 1], lowest, atol=1e-6
    )
    # one closed loop, each corner entered and left once
    assert len({a for a, _ in edges}) == len(edges)


@pytest.mark.slow
def test_what_is_hidden_goes_first():
    outer, faces = sphere(rings=20)
    inner, inner_faces = sphere(rings=8, radius=0.4)
    vertices = np.concatenate([outer, inner])
    all_faces = np.concatenate([faces, inner_faces + len(outer)])
    seen = exposure(vertices, all_faces)
    assert (seen[: len(outer)] > 0.2).all() and (seen[len(outer) :] == 0).all()
    order, into = collapse_sequence(vertices, all_faces)
    assert sorted(order) == list(range(len(vertices)))
    moved = into != np.arange(len(vertices))
    assert (order[into[moved]] < order[moved]).all()  # a vertex moves onto one that stays longer
    first = np.argsort(-order)[: len(inner) // 4]
    assert (first >= len(outer)).all()


def test_texture_seams_stay_closed():
    """A vertex with two texture vertices moves along the seam only, so that its two charts still
    meet.
    """
    vertices, faces = sphere(rings=8)
    right = vertices[faces].mean(1)[:, 0] > 0
    uv_faces = np.where(right[:, None], faces, faces + len(vertices))
    _, into = collapse_sequence(vertices, faces, uv_faces)
    charts = [set(right[(faces == v).any(1)].tolist()) for v in range(len(vertices))]
    assert sum(len(chart) == 2 for chart in charts) > 8
    moved = np.flatnonzero(into != np.arange(len(vertices)))
    assert len(moved) > 0.7 * len(vertices)
    assert all(charts[v] <= charts[into[v]] for v in moved)
