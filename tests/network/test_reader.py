"""What vertices read: where they are seen, means over views, and shells.

A round body wears a wide round coat, for which the values of shells are known.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from network_cases import TINY, random_inputs

from humangs_jax.core.pytree import replace
from humangs_jax.geometry.camera import Camera, intrinsics_from_fov, orbit, project
from humangs_jax.network.parts import Encoding, subject_unit
from humangs_jax.network.reader import (
    UNSEEN_COLOR,
    PixelAlignedReader,
    on_the_person,
    photo_colors,
    project_and_test,
    project_vertices,
    sample_shells,
    sum_over_views,
    visible_vertices,
)

SIZE = (32, 16)
AXIS_CAMERA = Camera(intrinsics_from_fov(0.9, *SIZE), jnp.eye(4), *SIZE)
CONVENTIONS = ["half_pixel", "mixed"]


def test_projection_is_the_cameras():
    points = jnp.asarray(
        np.random.default_rng(0).uniform([-1, -1, 1], [1, 1, 3], (20, 3)), jnp.float32
    )
    pixels, depths = project_vertices(AXIS_CAMERA, points)
    expected, z = project(AXIS_CAMERA, points)
    # 1e-6 in z moves a pixel by 1e-5
    assert np.allclose(pixels, expected, atol=1e-3) and np.allclose(depths, z)


@pytest.mark.parametrize("z", [0.0, -1e-6, 1e-6, -2e-6, 1e-30, -1.0, -1e-3])
def test_projection_is_finite_in_and_behind_the_camera_plane(z):
    points = jnp.asarray([[0.0, 0.0, z], [0.3, -0.2, z], [1e3, 1e3, z]])
    pixels, gradient = jax.vjp(lambda p: project_vertices(AXIS_CAMERA, p)[0], points)
    assert np.isfinite(pixels).all() and np.isfinite(gradient(jnp.ones_like(pixels))[0]).all()


@pytest.mark.parametrize("convention", CONVENTIONS)
def test_visibility(convention):
    depth_map = jnp.full(SIZE[::-1], -1.0).at[4:12, 8:24].set(2.0)
    pixels = jnp.asarray([[16.0, 8], [16, 8], [16, 8], [2, 2], [40, 8], [16, -1], [16, 8]])
    # units: 5 cm behind the surface is hidden
    depths = jnp.asarray([2.0, 2.045, 2.055, 2, 2, 2, -1])
    # seen, just so, hidden, background, outside x 2, behind
    expected = [
        True,
        True,
        False,
        False,
        False,
        False,
        False,
    ]
    assert np.array_equal(visible_vertices(pixels, depths, depth_map, SIZE, convention), expected)


def test_visibility_reads_the_pixel_that_holds_the_vertex():
    depth_map = jnp.full(SIZE[::-1], -1.0).at[7, 30].set(2.0)
    pixels, depths = (
        jnp.asarray([[30.1, 7.9], [29.9, 7.5], [31.1, 7.5], [30.5, 8.1]]),
        jnp.full(4, 2.0),
    )
    assert np.array_equal(
        visible_vertices(pixels, depths, depth_map, SIZE, "half_pixel"), [True, False, False, False]
    )
    nearest = np.round(np.asarray(pixels) / SIZE * (np.asarray(SIZE) - 1))  # published
    expected = (nearest == [30, 7]).all(-1)
    assert np.array_equal(visible_vertices(pixels, depths, depth_map, SIZE, "mixed"), expected)


def read_row(grid, positions):
    """Stands in for a lookup: returns the map's first row plus the positions."""
    return {"row": grid[0, 0] + positions[:, :1], "first": positions[:, 0]}


def views_to_read(views=3, vertices=6):
    rng = np.random.default_rng(3)
    maps = jnp.asarray(rng.normal(size=(views, 2, 2, 4)), jnp.float32)
    positions = jnp.asarray(rng.normal(size=(views, vertices, 2)), jnp.float32)
    weights = jnp.asarray([[1.0, 0, 1, 0, 0, 1], [0, 0, 1, 1, 0, 0], [0, 0, 0, 0, 0, 0]])
    return maps, positions, weights


def test_reads_are_summed_over_the_views_that_count():
    maps, positions, weights = views_to_read()
    sums = sum_over_views(read_row, maps, positions, weights)
    row = np.einsum("vn,vnc->nc", weights, maps[:, 0, 0][:, None] + positions[..., :1])
    assert np.allclose(sums["row"], row, atol=1e-6)
    assert np.allclose(sums["first"], np.sum(weights * positions[..., 0], axis=0), atol=1e-6)


@pytest.mark.slow
def test_photo_colors_are_grey_where_nothing_is_seen():
    images = (
        jnp.zeros((2, 4, 4, 3))
        .at[0]
        .set(jnp.asarray([1.0, 0, 0]))
        .at[1]
        .set(jnp.asarray([0, 0, 1.0]))
    )
    pixels = jnp.full((2, 3, 2), 2.0)
    visible = jnp.asarray([[True, False, False], [True, True, False]])
    colors = photo_colors(images, pixels, visible, "half_pixel")
    assert np.allclose(colors, [[0.5, 0, 0.5], [0, 0, 1], [0.5, 0.5, 0.5]])


@pytest.mark.parametrize("pool", ["visible", "all"])
def test_views_that_do_not_see_a_vertex_do_not_dilute_its_feature(pool):
    """Each photo's map is constant, so that the mean over views is known.

    View 1 sees nothing, and view 2 is padding.
    """
    inputs = random_inputs(views=3)
    inputs = replace(
        inputs, depth_maps=inputs.depth_maps.at[1].set(-1.0), view_count=jnp.asarray(2)
    )
    maps = jnp.asarray([2.0, 6.0, 50.0])[:, None, None, None] * jnp.ones((3, 32, 32, 1))
    reader, how = (
        PixelAlignedReader(output_width=None, sample_rgb=True),
        TINY.with_conventions(pool=pool).forward_context(),
    )
    features = jax.jit(
        lambda maps, inputs: reader.apply({}, Encoding(maps, None, jnp.int32(0)), inputs, how)
    )(maps, inputs)
    unit = subject_unit(inputs.canonical_vertices)
    cameras, vertices = inputs.cameras.in_units(unit), inputs.posed_vertices / unit
    pixels, visible = project_and_test(
        cameras, vertices, inputs.depth_maps, inputs.present, "half_pixel"
    )
    inner = visible[0] & jnp.all((pixels[:2] > 1) & (pixels[:2] < 31), axis=(0, 2))
    assert inner.sum() > 5 and not visible[1:].any()
    np.testing.assert_allclose(features.local[inner], 2.0 if pool == "visible" else 4.0, rtol=1e-5)
    np.testing.assert_allclose(features.visible_fraction[inner], 0.5)


def test_at_the_edge_of_a_mask_a_shell_has_the_color_of_the_person_alone():
    """Half of what a point reads is background, which must not darken it."""
    camera = jax.tree.map(lambda x: x[None], AXIS_CAMERA)
    images = jnp.asarray([0.9, 0.6, 0.3]) * jnp.ones((1, *SIZE[::-1], 3))
    mask = jnp.arange(SIZE[0]) < 16
    images, foreground = (
        jnp.where(mask[:, None], images, 1.0),
        jnp.broadcast_to(mask, (1, *SIZE[::-1])),
    )
    # at the middle: the mask's edge
    vertex, normal = (
        jnp.asarray([[[0.0, 0.0, 2.0]]]),
        jnp.asarray([[[0.0, 0.0, -1.0]]]),
    )
    nothing = jnp.full((1, *SIZE[::-1]), -1.0)
    read_one = jax.jit(
        lambda *arrays: sample_shells(*arrays, (0.0,), jnp.ones(1, bool), "half_pixel")
    )
    shells = read_one(images, foreground, nothing, camera, vertex, normal)
    np.testing.assert_allclose(shells.colors[0, 0], [0.9, 0.6, 0.3], rtol=1e-5)
    np.testing.assert_allclose(shells.inside[0, 0], 0.5, rtol=1e-5)


BODY, COAT = 0.5, 0.8
"""Radii of two spheres about the origin, metres."""
DISTANCES = (0.0, 0.1, 0.2, 0.4)
SIDE = 128
VIEWS = 4
LATERAL = 0.02
"""Error at the silhouette: a pixel is 0.02 wide at the sphere."""


def scene(views=VIEWS):
    """Returns photos of the coat, which the first view sees red and the others green."""
    cameras = orbit(
        jnp.zeros(3),
        4.0,
        jnp.arange(views) * 2 * np.pi / views,
        0.0,
        intrinsics_from_fov(0.6, SIDE, SIDE),
        SIDE,
        SIDE,
    )
    rng = np.random.default_rng(0)
    normals = rng.normal(size=(200, 3))
    normals = jnp.asarray(normals / np.linalg.norm(normals, axis=-1, keepdims=True), jnp.float32)
    centre = (np.stack(np.meshgrid(np.arange(SIDE), np.arange(SIDE)), -1) + 0.5 - SIDE / 2) / float(
        cameras.K[0, 0, 0]
    )
    # of the angle off the axis
    sine = np.linalg.norm(centre, axis=-1) / np.sqrt(1 + np.sum(centre**2, -1))
    ray = lambda radius: 4 * sine < radius
    depth = 4 / (1 + np.sum(centre**2, -1)) - np.sqrt(
        np.maximum(BODY**2 - (4 * sine) ** 2, 0)
    ) / np.sqrt(1 + np.sum(centre**2, -1))
    depths = np.where(ray(BODY), depth, -1).astype(np.float32)
    colors = np.asarray([[1.0, 0, 0], [0, 1, 0]])[(np.arange(views) > 0).astype(int)]
    mask = ray(COAT)
    images = np.where(mask[None, ..., None], colors[:, None, None], 1).astype(np.float32)
    same = lambda x: jnp.broadcast_to(jnp.asarray(x), (views, *np.shape(x)))
    return (
        jnp.asarray(images),
        same(mask),
        same(depths),
        cameras,
        same(BODY * normals),
        same(normals),
        normals,
    )


@jax.jit
def read_views(arguments, present):
    return sample_shells(*arguments, DISTANCES, present, "half_pixel")


def read(arguments, present=None):
    return read_views(
        arguments[:6], jnp.ones(len(arguments[0]), bool) if present is None else present
    )


def lateral(points, cameras):
    """Returns the sine (v, p) of the angle between point and optical axis, times the distance."""
    away = points - np.asarray(cameras.center)[:, None]
    axis = np.asarray(cameras.cam_from_world)[:, 2, :3]
    cosine = np.einsum("vpc,vc->vp", away, axis) / np.linalg.norm(away, axis=-1)
    return 4 * np.sqrt(1 - np.minimum(cosine, 1) ** 2)


@pytest.mark.slow
def test_hull_and_share_tell_how_far_the_coat_reaches():
    arguments = scene()
    shells = read(arguments)
    assert np.allclose(shells.hull[:, :3], 1)  # within the coat wherever the body is looked at from
    points = (BODY + DISTANCES[3]) * np.asarray(arguments[-1])
    away = lateral(points, arguments[3])
    certain = np.all(np.abs(away - COAT) > 2 * LATERAL, axis=0)
    inside = away < COAT
    # the test tests something
    assert np.sum(certain) > 20 and np.sum(~inside.all(0) & certain) > 20
    assert np.allclose(shells.inside[certain, 3], inside.mean(0)[certain], atol=1e-5)
    assert np.allclose(shells.hull[certain, 3], inside.all(0)[certain], atol=1e-5)


@pytest.mark.slow
def test_colors_are_of_the_views_that_face_the_point():
    arguments = scene()
    shells = read(arguments)
    first = np.asarray(arguments[3].center[0]) / 4
    front = np.asarray(arguments[-1]) @ first > 0.95
    # neighbouring views see it at a slant
    assert np.sum(front) > 2 and np.all(shells.colors[front, :3, 0] > 0.8)
    back = np.asarray(arguments[-1]) @ first < -0.3
    assert np.allclose(shells.colors[back, :3], [0, 1, 0], atol=1e-5)
    level = np.abs(np.asarray(arguments[-1])[:, 1]) < 0.9
    assert np.all(shells.seen[:, :3] <= 1) and np.all(shells.seen[level, 0] > 0.02)


@pytest.mark.slow
def test_one_view_leaves_the_back_grey_and_unseen():
    arguments = scene(views=1)
    shells = read(arguments)
    back = np.asarray(arguments[-1]) @ np.asarray(arguments[3].center[0]) / 4 < -0.2
    assert np.allclose(shells.colors[back], UNSEEN_COLOR) and not np.any(shells.seen[back])


@pytest.mark.slow
def test_absent_views_and_points_out_of_the_image_say_nothing():
    arguments = scene()
    fewer = jax.tree.map(lambda x: x[:2], arguments[:-1])
    padded = read(arguments, jnp.arange(VIEWS) < 2)
    for name in ("colors", "seen", "inside", "hull"):
        assert np.allclose(
            getattr(padded, name), getattr(read((*fewer, arguments[-1])), name), atol=1e-6
        ), name
    camera = arguments[3]
    aside = replace(camera, K=camera.K.at[:, 0, 2].add(10 * SIDE))
    nothing = read((*arguments[:3], aside, *arguments[4:]))
    assert np.all(nothing.hull == 1) and np.all(nothing.inside == 1) and np.all(nothing.seen == 0)
    assert np.all(nothing.colors == UNSEEN_COLOR)


@pytest.mark.slow
def test_batches_by_vmap_and_gradients_are_finite():
    arguments = scene()
    two = jax.tree.map(lambda x: jnp.stack([x, x]), arguments)
    batched = jax.vmap(read)(two)
    # near the rim of a silhouette, where few views weigh little, rounding in float32 moves a mean
    # by 1e-5
    assert np.allclose(batched.colors[1], read(arguments).colors, atol=1e-4)

    def total(images, vertices):
        return jnp.sum(read((images, *arguments[1:4], vertices, *arguments[5:])).colors)

    for gradient in jax.grad(total, (0, 1))(arguments[0], arguments[4]):
        assert np.isfinite(gradient).all() and np.any(gradient)


@pytest.mark.slow
def test_the_background_lends_no_color():
    arguments = scene()
    shells = read(arguments)
    away = lateral((BODY + DISTANCES[3]) * np.asarray(arguments[-1]), arguments[3])
    certain = np.all(np.abs(away - COAT) > 2 * LATERAL, axis=0)
    outside = certain & np.all(away > COAT, axis=0)
    known = certain & ~outside & (np.asarray(shells.seen[:, 3]) > 0)
    assert np.allclose(shells.colors[outside, 3], UNSEEN_COLOR) and not np.any(
        shells.seen[outside, 3]
    )
    # red and green, never white
    assert np.sum(known) > 20 and np.allclose(shells.colors[known, 3, 2], 0, atol=1e-5)


def test_a_vertex_is_on_the_person_if_any_photo_shows_the_person_at_any_distance():
    whole, arguments = read(scene()), scene()
    assert np.all(on_the_person(whole))
    foreground = arguments[1]
    nobody = read((arguments[0], jnp.zeros_like(foreground), *arguments[2:]))
    assert not np.any(on_the_person(nobody))
    one = read((arguments[0], foreground & (jnp.arange(VIEWS) == 0)[:, None, None], *arguments[2:]))
    assert np.all(on_the_person(one))  # the body lies within the coat in every photo
