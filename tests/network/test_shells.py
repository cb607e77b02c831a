"""A round body in a wide round coat: what its shells say can be written down."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from humangs_jax.core.pytree import replace
from humangs_jax.geometry.camera import intrinsics_from_fov, orbit
from humangs_jax.network.pixel_aligned import UNSEEN_COLOR, on_the_person, sample_shells

BODY, COAT = 0.5, 0.8
"""Radii of two spheres about the origin."""
DISTANCES = (0.0, 0.1, 0.2, 0.4)
SIZE = 128
VIEWS = 4
LATERAL = 0.02
"""A pixel is 0.02 wide at the sphere: what happens at the silhouette is known so well."""


def scene(views=VIEWS):
    """Photos of the coat: red as the first view sees it, green as the others do."""
    cameras = orbit(
        jnp.zeros(3), 4.0, jnp.arange(views) * 2 * np.pi / views, 0.0, intrinsics_from_fov(0.6, SIZE, SIZE), SIZE, SIZE
    )
    rng = np.random.default_rng(0)
    normals = rng.normal(size=(200, 3))
    normals = jnp.asarray(normals / np.linalg.norm(normals, axis=-1, keepdims=True), jnp.float32)
    centre = (np.stack(np.meshgrid(np.arange(SIZE), np.arange(SIZE)), -1) + 0.5 - SIZE / 2) / float(cameras.K[0, 0, 0])
    sine = np.linalg.norm(centre, axis=-1) / np.sqrt(1 + np.sum(centre**2, -1))  # of the angle off the axis
    ray = lambda radius: 4 * sine < radius
    depth = 4 / (1 + np.sum(centre**2, -1)) - np.sqrt(np.maximum(BODY**2 - (4 * sine) ** 2, 0)) / np.sqrt(
        1 + np.sum(centre**2, -1)
    )
    depths = np.where(ray(BODY), depth, -1).astype(np.float32)
    colors = np.asarray([[1.0, 0, 0], [0, 1, 0]])[(np.arange(views) > 0).astype(int)]
    mask = ray(COAT)
    images = np.where(mask[None, ..., None], colors[:, None, None], 1).astype(np.float32)
    same = lambda x: jnp.broadcast_to(jnp.asarray(x), (views, *np.shape(x)))
    return (jnp.asarray(images), same(mask), same(depths), cameras, same(BODY * normals), same(normals), normals)


def read(arguments, present=None):
    present = jnp.ones(len(arguments[0]), bool) if present is None else present
    return sample_shells(*arguments[:6], DISTANCES, present, "half_pixel")


def lateral(points, cameras):
    """(v, p) sine of the angle between a point and the optical axis, times the camera's distance."""
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
    assert np.sum(certain) > 20 and np.sum(~inside.all(0) & certain) > 20  # the test tests something
    assert np.allclose(shells.inside[certain, 3], inside.mean(0)[certain], atol=1e-5)
    assert np.allclose(shells.hull[certain, 3], inside.all(0)[certain], atol=1e-5)


@pytest.mark.slow
def test_colors_are_of_the_views_that_face_the_point():
    arguments = scene()
    shells = read(arguments)
    first = np.asarray(arguments[3].center[0]) / 4
    front = np.asarray(arguments[-1]) @ first > 0.95
    assert np.sum(front) > 2 and np.all(shells.colors[front, :3, 0] > 0.8)  # neighbouring views see it at a slant
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
        assert np.allclose(getattr(padded, name), getattr(read((*fewer, arguments[-1])), name), atol=1e-6), name
    camera = arguments[3]
    aside = replace(camera, K=camera.K.at[:, 0, 2].add(10 * SIZE))
    nothing = read((*arguments[:3], aside, *arguments[4:]))
    assert np.all(nothing.hull == 1) and np.all(nothing.inside == 1) and np.all(nothing.seen == 0)
    assert np.all(nothing.colors == UNSEEN_COLOR)


@pytest.mark.slow
def test_batches_by_vmap_and_gradients_are_finite():
    arguments = scene()
    two = jax.tree.map(lambda x: jnp.stack([x, x]), arguments)
    batched = jax.vmap(read)(two)
    assert np.allclose(batched.colors[1], read(arguments).colors, atol=1e-6)
    total = lambda images, vertices: jnp.sum(read((images, *arguments[1:4], vertices, *arguments[5:])).colors)
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
    assert np.allclose(shells.colors[outside, 3], UNSEEN_COLOR) and not np.any(shells.seen[outside, 3])
    assert np.sum(known) > 20 and np.allclose(shells.colors[known, 3, 2], 0, atol=1e-5)  # red and green, never white


def test_a_vertex_is_on_the_person_if_any_photo_shows_the_person_at_any_distance():
    whole, arguments = read(scene()), scene()
    assert np.all(on_the_person(whole))
    foreground = arguments[1]
    nobody = read((arguments[0], jnp.zeros_like(foreground), *arguments[2:]))
    assert not np.any(on_the_person(nobody))
    one = read((arguments[0], foreground & (jnp.arange(VIEWS) == 0)[:, None, None], *arguments[2:]))
    assert np.all(on_the_person(one))  # the body lies within the coat in every photo
