"""The rasterizer against rays: in float64 numpy every face meets the ray of every pixel."""

import itertools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from humangs_jax.geometry.camera import Camera, intrinsics_from_fov, look_at, orbit
from humangs_jax.rendering.mesh.rasterizer import (
    RasterConfig,
    interpolate_attributes,
    rasterize_mesh,
    sample_texture,
)

PIXEL_ERROR = 1e-4
"""Error of float32 pixel positions: tens of pixels round to 4e-6, after a few operations each."""
DEPTH_TIE = 1e-5
"""Relative difference of depths below which float32 may order two faces either way."""
SMALL_STEPS = RasterConfig(rows_per_step=64, fragments_per_step=128)
"""A configuration that makes many steps of both loops on small meshes."""
WIDTH, HEIGHT = 33, 21


class RayReference(NamedTuple):
    """Maps (h, w) of what rays hit.

    `unsure` marks pixels with an edge within PIXEL_ERROR, or two depths within DEPTH_TIE.
    """

    face_ids: np.ndarray
    depth: np.ndarray
    barycentrics: np.ndarray
    steepness: np.ndarray  # |change of depth per pixel| of the face that is hit
    unsure: np.ndarray


def ray_reference(vertices, faces, camera, near=0.01):
    """Intersects the rays of all pixels with all faces.

    A ray z d hits the plane of a face where z d = [v0 v1 v2] b, with weights b that add up to 1.
    """
    transform, K = np.asarray(camera.cam_from_world, np.float64), np.asarray(camera.K, np.float64)
    points = np.asarray(vertices, np.float64) @ transform[:3, :3].T + transform[:3, 3]
    v = points[np.asarray(faces)]  # (f, corner, xyz)
    x, y = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    d = np.stack([(x - K[0, 2]) / K[0, 0], (y - K[1, 2]) / K[1, 1], np.ones_like(x)], axis=-1)
    normals = np.stack(
        [np.cross(v[:, 1], v[:, 2]), np.cross(v[:, 2], v[:, 0]), np.cross(v[:, 0], v[:, 1])], axis=1
    )
    determinant = np.einsum("fi,fi->f", v[:, 0], normals[:, 0])
    drawn = (v[..., 2] > near).all(-1) & (np.abs(determinant) > 1e-14 * np.abs(v).max((1, 2)) ** 3)
    scaled = normals[drawn] / determinant[drawn, None, None]
    ids = np.flatnonzero(drawn)
    weights = np.einsum("hwi,fci->fhwc", d, scaled)  # b / z
    with np.errstate(divide="ignore"):
        z = 1 / weights.sum(-1)
    distance = (
        weights / np.linalg.norm(scaled[..., :2] / [K[0, 0], K[1, 1]], axis=-1)[:, None, None]
    ).min(-1)
    hits = np.where(distance >= 0, z, np.inf)
    nearest = hits.argmin(0)  # of equal ones the first
    row, column = np.indices(nearest.shape)
    depth = hits[nearest, row, column]
    hit = np.isfinite(depth)
    unsure = (
        (np.abs(distance) < PIXEL_ERROR) & (z < np.where(hit, depth * (1 + DEPTH_TIE), np.inf))
    ).any(0)
    unsure |= ((hits > depth) & (hits < depth * (1 + DEPTH_TIE))).any(0)
    slope = np.linalg.norm(scaled.sum(1)[:, :2] / [K[0, 0], K[1, 1]], axis=-1)[nearest]
    finite = np.where(hit, depth, 0)
    return RayReference(
        face_ids=np.where(hit, ids[nearest], -1),
        depth=np.where(hit, depth, -1),
        barycentrics=np.where(hit[..., None], weights[nearest, row, column] * finite[..., None], 0),
        steepness=finite**2 * slope,
        unsure=unsure,
    )


def check_against_rays(
    fragments, vertices, faces, camera, pixel_error=PIXEL_ERROR, most_unsure=0.1
):
    expected = ray_reference(vertices, faces, camera)
    assert expected.unsure.mean() <= most_unsure  # or the test would be empty
    ids = np.asarray(fragments.face_ids)
    np.testing.assert_array_equal(ids[~expected.unsure], expected.face_ids[~expected.unsure])
    np.testing.assert_array_equal(np.asarray(fragments.depth)[ids < 0], -1)
    np.testing.assert_array_equal(np.asarray(fragments.barycentrics)[ids < 0], 0)
    same = (ids == expected.face_ids) & (ids >= 0)
    depth, weights = (
        np.asarray(fragments.depth, np.float64)[same],
        np.asarray(fragments.barycentrics, np.float64)[same],
    )
    assert weights.min(initial=0) >= 0
    np.testing.assert_allclose(weights.sum(-1), 1, atol=1e-6)
    allowed = pixel_error * (expected.steepness[same] + expected.depth[same])
    assert (np.abs(depth - expected.depth[same]) <= allowed).all()
    # the weights say where on the face: the same point, seen from the camera, as the ray's
    corners = np.asarray(vertices, np.float64)[np.asarray(faces)[ids[same]]]
    error = np.linalg.norm(
        np.einsum("pc,pci->pi", weights - expected.barycentrics[same], corners), axis=-1
    )
    assert (error <= allowed).all()
    return expected


def sphere(rows=12, columns=18, radius=1.0):
    """Returns a closed sphere, whose vertices at the seam and at the poles are shared."""
    polar = np.pi * np.arange(1, rows) / rows
    around = 2 * np.pi * np.arange(columns) / columns
    ring = np.stack([np.cos(around), 0 * around, np.sin(around)], -1)
    body = np.sin(polar)[:, None, None] * ring + np.cos(polar)[:, None, None] * np.array([0, 1, 0])
    vertices = radius * np.concatenate([body.reshape(-1, 3), [[0, 1, 0], [0, -1, 0]]])
    i, j = (
        a.reshape(-1) for a in np.meshgrid(np.arange(rows - 2), np.arange(columns), indexing="ij")
    )
    a, b = i * columns + j, i * columns + (j + 1) % columns
    faces = [np.stack([a, b, a + columns], -1), np.stack([b, b + columns, a + columns], -1)]
    j = np.arange(columns)
    top, bottom, last = len(vertices) - 2, len(vertices) - 1, (rows - 2) * columns
    faces.append(np.stack([0 * j + top, (j + 1) % columns, j], -1))
    faces.append(np.stack([0 * j + bottom, last + j, last + (j + 1) % columns], -1))
    return vertices.astype(np.float32), np.concatenate(faces).astype(np.int32)


def some_camera(seed=0, distance=3.0, width=WIDTH, height=HEIGHT):
    eye = np.random.default_rng(seed).normal(size=3)
    eye = jnp.asarray(distance * eye / np.linalg.norm(eye), jnp.float32)
    K = intrinsics_from_fov(0.8, width, height)
    return look_at(eye, jnp.zeros(3), jnp.asarray([0.1, 1.0, 0.2]), K, width, height)


def flat_camera(width=WIDTH, height=HEIGHT):
    """Returns a camera that sees the point (x, y, 1) at exactly the pixel position (x, y)."""
    return Camera.from_opencv(np.eye(3), np.eye(4), width, height)


def draw(vertices, faces, camera, config=SMALL_STEPS):
    """Rasterizes a mesh that is padded by faces without area, so that tests share a compilation.

    Such faces do no harm, see `test_bad_faces_are_harmless`.
    """
    vertices, faces = jnp.asarray(vertices), jnp.asarray(faces, jnp.int32)
    vertices = jnp.pad(vertices, ((0, -len(vertices) % 128), (0, 0)))
    faces = jnp.pad(faces, ((0, -len(faces) % 128), (0, 0)))
    return rasterize_mesh(vertices, faces, camera, config)


# ---------------------------------------------------------------------------------------------
# against rays


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 10_000), st.sampled_from([0.02, 0.2, 1.0, 4.0]))
def test_random_triangles_equal_rays(seed, size):
    rng = np.random.default_rng(seed)
    centers = rng.uniform(-1, 1, (40, 1, 3))
    vertices = (centers + size * rng.normal(size=(40, 3, 3))).reshape(-1, 3).astype(np.float32)
    faces = np.arange(120).reshape(40, 3)
    camera = some_camera(seed)
    check_against_rays(draw(vertices, faces, camera), vertices, faces, camera)


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_sphere_equals_rays(seed):
    vertices, faces = sphere()
    camera = some_camera(seed)
    expected = check_against_rays(draw(vertices, faces, camera), vertices, faces, camera)
    assert 0.2 < (expected.face_ids >= 0).mean() < 0.9


def test_faces_smaller_than_pixels_equal_rays():
    vertices, faces = sphere(30, 45)
    camera = some_camera(5)
    check_against_rays(draw(vertices, faces, camera, RasterConfig()), vertices, faces, camera)


@pytest.mark.slow
def test_float64():
    with jax.enable_x64(True):
        vertices, faces = sphere()
        camera = some_camera(3)
        camera = jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float64), camera)
        fragments = draw(vertices.astype(np.float64), faces, camera)
        assert fragments.depth.dtype == fragments.barycentrics.dtype == jnp.float64
        assert fragments.face_ids.dtype == jnp.int32
        check_against_rays(fragments, vertices, faces, camera, pixel_error=1e-11)


# ---------------------------------------------------------------------------------------------
# watertight


def grid(x, y):
    """Returns a sheet at z = 1 through the points x[i, j], y[i, j].

    Cells are cut along alternating diagonals.
    """
    rows, columns = x.shape
    vertices = np.stack([x, y, np.ones_like(x)], -1).reshape(-1, 3).astype(np.float32)
    faces = []
    for i, j in itertools.product(range(rows - 1), range(columns - 1)):
        a, b, c, d = (
            i * columns + j,
            i * columns + j + 1,
            (i + 1) * columns + j,
            (i + 1) * columns + j + 1,
        )
        faces += [[a, b, c], [b, d, c]] if (i + j) % 2 else [[a, b, d], [a, d, c]]
    return vertices, np.array(faces)


@settings(max_examples=15, deadline=None)
@given(
    st.integers(0, 10_000),
    st.sampled_from([0.0, 1e-7, 1e-6, 1e-3, 0.2]),
    st.sampled_from([1.0, 1.4]),
)
def test_sheet_has_no_holes(seed, jitter, spacing):
    """Vertices or edges lie on pixel centres, or miss them by roundings."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[-1:23, -1:35].astype(np.float64)
    x, y = (spacing * a + 0.5 - (spacing - 1) + jitter * rng.normal(size=a.shape) for a in (x, y))
    vertices, faces = grid(x, y)
    faces = np.stack(
        [
            np.roll(face, turn)
            for face, turn in zip(faces, rng.integers(0, 3, len(faces)), strict=True)
        ]
    )
    faces[::2] = faces[::2, ::-1]  # neither winding nor the first corner may matter
    fragments = draw(vertices, faces, flat_camera(), RasterConfig())
    assert (np.asarray(fragments.face_ids) >= 0).all()


# ---------------------------------------------------------------------------------------------
# rules

SQUARE = np.array([[2, 2, 1], [12, 2, 1], [2, 12, 1], [12, 12, 1]], np.float32)
SQUARE_FACES = np.array([[0, 1, 2], [1, 3, 2]])


def test_of_equal_depths_the_lowest_face_wins_whatever_the_step():
    faces = np.concatenate([SQUARE_FACES + 4] + [SQUARE_FACES] * 20)  # many steps apart
    vertices = np.concatenate([SQUARE, SQUARE + np.float32([0, 0, 1]) * 0.5])
    vertices[4:, :2] *= 1.5  # the first two faces lie behind, in the same place of the image
    ids = np.asarray(draw(vertices, faces, flat_camera()).face_ids)
    assert set(np.unique(ids)) == {-1, 2, 3}


def test_edges_belong_to_the_face():
    vertices = np.array([[0.5, 0.5, 1], [4.5, 0.5, 1], [0.5, 4.5, 1]], np.float32)
    ids = np.asarray(draw(vertices, np.array([[0, 1, 2]]), flat_camera()).face_ids)
    # the centres on both axes and on the diagonal too
    expected = np.add.outer(np.arange(HEIGHT), np.arange(WIDTH)) <= 4
    np.testing.assert_array_equal(ids == 0, expected)


def test_near_plane_drops_and_counts():
    """One face is behind the camera, one crosses the near plane, and one is beyond it."""
    vertices = np.concatenate([SQUARE[:3] * [1, 1, -1], SQUARE[:3], SQUARE[:3]]).astype(np.float32)
    vertices[3, 2] = 0.0
    fragments = draw(vertices, np.arange(9).reshape(3, 3), flat_camera())
    assert set(np.unique(fragments.face_ids)) == {-1, 2}
    assert fragments.overflow == 1
    behind = draw(-SQUARE, SQUARE_FACES, flat_camera())
    assert (np.asarray(behind.face_ids) == -1).all() and behind.overflow == 0
    assert (draw(SQUARE * np.float32(1e-3), SQUARE_FACES, flat_camera()).face_ids == -1).all()


@pytest.mark.slow
def test_bad_faces_are_harmless():
    """Points, segments, NaN, infinity and huge numbers leave the other faces as they are."""
    bad = np.array(
        [
            [7, 7, 1],
            [np.nan, 7, 1],
            [7, np.inf, 1],
            [3e38, 3e38, 1],
            [4.5, 4.5, 0.5],
            [8.5, 8.5, 0.5],
        ]
    )
    vertices = np.concatenate([SQUARE, bad]).astype(np.float32)
    faces = [
        [4, 4, 4],
        [0, 3, 0],
        [0, 3, 3],
        [0, 1, 5],
        [6, 1, 2],
        [7, 0, 1],
        [8, 8, 9],
        [8, 9, 9],
        [8, 9, 8],
    ]
    faces = np.concatenate([faces, SQUARE_FACES])
    with_bad = rasterize_mesh(jnp.asarray(vertices), jnp.asarray(faces), flat_camera(), SMALL_STEPS)
    without = rasterize_mesh(
        jnp.asarray(SQUARE), jnp.asarray(SQUARE_FACES), flat_camera(), SMALL_STEPS
    )
    ids = np.asarray(with_bad.face_ids)
    np.testing.assert_array_equal(np.where(ids >= 0, ids - len(faces) + 2, -1), without.face_ids)
    np.testing.assert_array_equal(with_bad.depth, without.depth)
    np.testing.assert_array_equal(with_bad.barycentrics, without.barycentrics)
    assert with_bad.overflow == 3  # NaN, infinity, and the one whose area overflows


def test_faces_without_area_cover_nothing():
    """Three points lie on a line through a pixel centre, where edge functions are roundings."""
    rng = np.random.default_rng(0)
    step = rng.integers(1, 1 << 18, (40, 1, 2)) * rng.choice([-1, 1], (40, 1, 2)) * 2.0**-20
    points = 0.5 + step * np.array([-3, 1, 5])[:, None]
    z = np.array([0.25, 0.5, 1.0])[:, None]
    vertices = (
        np.concatenate([points * z, np.broadcast_to(z, (40, 3, 1))], axis=-1)
        .reshape(-1, 3)
        .astype(np.float32)
    )
    ids = np.asarray(draw(vertices, np.arange(120).reshape(40, 3), flat_camera()).face_ids)
    assert (ids == -1).all()


@pytest.mark.slow
def test_images_of_one_pixel_and_meshes_of_nothing():
    vertices = jnp.asarray(SQUARE)
    assert (
        draw(vertices, SQUARE_FACES, Camera.from_opencv(np.eye(3), np.eye(4), 1, 1)).face_ids == -1
    )
    shifted = Camera.from_opencv([[1, 0, -6.0], [0, 1, -5.0], [0, 0, 1]], np.eye(4), 1, 1)
    assert draw(vertices, SQUARE_FACES, shifted).face_ids == 0
    empty = rasterize_mesh(vertices, jnp.zeros((0, 3), jnp.int32), flat_camera())
    assert (np.asarray(empty.face_ids) == -1).all() and (np.asarray(empty.depth) == -1).all()
    image = interpolate_attributes(
        empty, jnp.zeros((0, 3), jnp.int32), vertices, jnp.asarray([1.0, 2.0, 3.0])
    )
    np.testing.assert_array_equal(image, np.broadcast_to([1.0, 2.0, 3.0], (HEIGHT, WIDTH, 3)))


# ---------------------------------------------------------------------------------------------
# transformations


@pytest.mark.slow
def test_vmap_equals_loop_and_steps_do_not_matter():
    vertices, faces = sphere()
    cameras = orbit(
        jnp.zeros(3),
        3.0,
        jnp.asarray([0.0, 1.0, 4.0]),
        0.3,
        intrinsics_from_fov(0.8, WIDTH, HEIGHT),
        WIDTH,
        HEIGHT,
    )
    # different numbers of steps
    moved = jnp.asarray(vertices) * jnp.asarray([1.0, 0.3, 1.2])[:, None, None]
    batch = jax.vmap(lambda v, camera: draw(v, faces, camera))(moved, cameras)
    for i in range(3):
        one = draw(moved[i], faces, cameras[i], RasterConfig())
        np.testing.assert_array_equal(batch.face_ids[i], one.face_ids)
        np.testing.assert_allclose(batch.depth[i], one.depth, rtol=1e-6)
        np.testing.assert_allclose(batch.barycentrics[i], one.barycentrics, atol=1e-5)


def test_interpolation_of_positions_is_the_seen_point():
    vertices, faces = sphere()
    camera = some_camera(2)
    fragments = draw(vertices, faces, camera)
    background = jnp.asarray([5.0, 6.0, 7.0])
    points = np.asarray(
        interpolate_attributes(fragments, jnp.asarray(faces), jnp.asarray(vertices), background),
        np.float64,
    )
    covered = np.asarray(fragments.face_ids) >= 0
    np.testing.assert_array_equal(
        points[~covered], np.broadcast_to(background, points[~covered].shape)
    )
    transform, K = np.asarray(camera.cam_from_world, np.float64), np.asarray(camera.K, np.float64)
    seen = (points[covered] @ transform[:3, :3].T + transform[:3, 3]) @ K.T
    rows, columns = np.nonzero(covered)
    np.testing.assert_allclose(
        seen[:, :2] / seen[:, 2:], np.stack([columns, rows], -1) + 0.5, atol=PIXEL_ERROR
    )
    np.testing.assert_allclose(seen[:, 2], np.asarray(fragments.depth)[covered], rtol=1e-5)


def test_corner_attributes_have_their_own_numbering():
    fragments = draw(SQUARE, SQUARE_FACES, flat_camera())
    attributes = jnp.asarray([[1.0], [2.0]])
    image = np.asarray(
        interpolate_attributes(
            fragments, jnp.asarray([[0, 0, 0], [1, 1, 1]]), attributes, jnp.zeros(1)
        )
    )[..., 0]
    np.testing.assert_allclose(image, np.asarray(fragments.face_ids) + 1, atol=1e-6)


def test_gradients_reach_attributes_and_nothing_else():
    vertices, faces = jnp.asarray(SQUARE), jnp.asarray(SQUARE_FACES)
    camera = flat_camera()

    def total(vertices, attributes):
        fragments = rasterize_mesh(vertices, faces, camera, SMALL_STEPS)
        image = interpolate_attributes(fragments, faces, attributes, jnp.zeros(1))
        return jnp.sum(image) + jnp.sum(jnp.where(fragments.depth > 0, fragments.depth, 0))

    to_vertices, to_attributes = jax.grad(total, (0, 1))(vertices, jnp.ones((4, 1)))
    np.testing.assert_array_equal(to_vertices, 0)
    fragments = draw(vertices, faces, camera)
    expected = np.zeros(4)
    ids = np.asarray(fragments.face_ids)
    np.add.at(expected, SQUARE_FACES[ids[ids >= 0]], np.asarray(fragments.barycentrics)[ids >= 0])
    np.testing.assert_allclose(to_attributes[:, 0], expected, rtol=1e-5)
    # the square holds 10 x 10 pixel centres
    np.testing.assert_allclose(to_attributes.sum(), 100, rtol=1e-5)


TEXEL_ROUNDING = 2e-6
"""Rounding of float32 positions of up to 16 texels, times color steps of up to 1."""


def lookup(texture, u, v):
    """Returns a bilinear sample, texel by texel, with v up and the border repeated."""
    height, width = texture.shape[:2]
    x, y = np.clip(u * width - 0.5, 0, width - 1), np.clip((1 - v) * height - 0.5, 0, height - 1)
    total = 0
    for row in range(height):
        for column in range(width):
            total = (
                total
                + max(0, 1 - abs(x - column)) * max(0, 1 - abs(y - row)) * texture[row, column]
            )
    return total


@settings(max_examples=8, deadline=None)
@given(st.integers(0, 10_000))
def test_lookup_equals_loop(seed):
    rng = np.random.default_rng(seed)
    texture, uv = (
        rng.uniform(size=(3, 5, 2)).astype(np.float32),
        rng.uniform(-0.3, 1.3, (4, 6, 2)).astype(np.float32),
    )
    expected = [[lookup(texture.astype(np.float64), *uv[i, j]) for j in range(6)] for i in range(4)]
    np.testing.assert_allclose(
        sample_texture(jnp.asarray(texture), jnp.asarray(uv)), expected, atol=TEXEL_ROUNDING
    )


def test_gradient_is_the_weights_of_the_texels():
    texture, uv = jnp.zeros((4, 4, 1)), jnp.asarray([[[0.5, 0.5], [0.0, 0.0]]])
    gradient = jax.grad(lambda t: sample_texture(t, uv).sum())(texture)[..., 0]
    expected = np.zeros((4, 4))
    expected[1:3, 1:3] = 0.25
    expected[3, 0] = 1
    np.testing.assert_allclose(gradient, expected, atol=TEXEL_ROUNDING)
