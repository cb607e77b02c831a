"""A body is displaced to fill the masks: a known coat is found, and useless masks do no harm."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from humangs_jax.body.library import load_body
from humangs_jax.body.model import BodyPose, pose_body, shape_body
from humangs_jax.body.resolution import decimate
from humangs_jax.core.pytree import replace
from humangs_jax.data import views
from humangs_jax.data.capture import capture_from_arrays
from humangs_jax.data.vertex_offsets import (
    HELD_JOINTS,
    WRAP,
    MaskedView,
    OffsetFitConfig,
    fit_vertex_offsets,
)
from humangs_jax.data.views import gaussian_body, on_gaussian_body, subject_rest
from humangs_jax.geometry import quaternion
from humangs_jax.geometry.camera import intrinsics_from_fov, orbit
from humangs_jax.network.presets import tiny
from humangs_jax.rendering.mesh.rasterizer import rasterize_mesh, vertex_normals

SIZE, COAT = 384, 0.01
FOUND = 0.003
"""Largest error, metres: a pixel shows 6 mm, and an edge is known to half of it."""
BOUND = 2 * max(OffsetFitConfig.inwards, OffsetFitConfig.outwards) + WRAP
POSES = 2


@pytest.fixture(scope="module")
def body():
    return decimate(load_body(), 1500)


@functools.cache
def rasterizer():
    return jax.jit(rasterize_mesh)


def masks_of(body, rest, poses, frames, cameras):
    return np.stack(
        [
            np.asarray(
                rasterizer()(
                    pose_body(body, rest, poses[f]).vertices, body.faces, cameras[i]
                ).face_ids
            )
            >= 0
            for i, f in enumerate(frames)
        ]
    ).astype(np.float32)


def free(body):
    """Returns the share of each vertex that belongs neither to the head nor to hands."""
    held = np.asarray([any(name in joint for name in HELD_JOINTS) for joint in body.joint_names])
    return 1 - np.asarray(body.skinning_weights) @ held


@pytest.fixture(scope="module")
def dressed(body):
    """Returns (capture, offsets (n, 3) of the coat from the body, metres).

    The capture has eight photos in two poses of a person in a coat.
    """
    rng = np.random.default_rng(0)
    betas = jnp.zeros(len(body.shape_names)).at[:2].set(jnp.asarray([0.5, -0.3]))
    rotations = jnp.asarray(0.15 * rng.normal(size=(POSES, len(body.parents), 3)), jnp.float32)
    poses = jax.vmap(BodyPose)(rotations, jnp.asarray([[0, 1.0, 0], [0.3, 1.1, 0.2]], jnp.float32))
    rest = shape_body(body, betas)
    coat = COAT * free(body)[:, None] * np.asarray(vertex_normals(rest.vertices, body.faces))
    frames = np.arange(8) % POSES
    middle, K = jnp.asarray([0.0, 0.75, 0.0]), intrinsics_from_fov(np.pi / 3, SIZE, SIZE)
    cameras = orbit(middle, 2.2, jnp.linspace(0, 2 * np.pi, 9)[:-1], 0.1, K, SIZE, SIZE)
    masks = masks_of(body, replace(rest, vertices=rest.vertices + coat), poses, frames, cameras)
    images = np.ones((*masks.shape, 3), np.float32)
    capture = capture_from_arrays(
        images,
        cameras.K,
        cameras.cam_from_world,
        rotations,
        poses.translation,
        betas=betas,
        masks=masks,
        frames=frames,
        background="white",
        body=body,
    )
    return capture, coat


def along_normals(body, capture, moved):
    normals = np.asarray(
        vertex_normals(shape_body(body, jnp.asarray(capture.betas)).vertices, body.faces)
    )
    return (moved * normals).sum(-1)


@pytest.fixture(scope="module")
def filled(body, dressed):
    """Returns the displacement that fills the masks."""
    return fit_vertex_offsets(body, dressed[0], inset=(0.0, 0.0))


@pytest.mark.parametrize("principal", [20.0, -700.0])
def test_a_metre_has_as_many_pixels_wherever_the_window_lies_in_the_photo(principal):
    """principal: x of the principal point in the window, pixels."""
    turn = np.asarray(quaternion.to_matrix(quaternion.normalize(jnp.asarray([1.0, 0.2, 0.5, 0.1]))))
    K = np.asarray([[500.0, 0, principal], [0, 500, 20], [0, 0, 1]])
    places = np.asarray([[0.1, 0.2, 3.0], [-0.3, 0.1, 4.0]])
    view = MaskedView(
        coverage=np.ones((40, 40)),
        project=np.concatenate([K @ turn, np.zeros((3, 1))], axis=1),
        linear=np.tile(turn.T, (2, 1, 1)),  # from the axes of the camera to those of the world
        offset=np.zeros((2, 3)),
        low=np.zeros(2),
        high=np.full(2, 40.0),
    )
    pixels, per_metre, _ = view.seen(places)
    beside = view.seen(places + np.asarray([1e-3, 0, 0]))[0]
    np.testing.assert_allclose(1e3 * (beside - pixels)[:, 0], per_metre, rtol=1e-4)


def test_a_coat_is_found(body, dressed, filled):
    capture, coat = dressed
    found, true = (along_normals(body, capture, x) for x in (filled, coat))
    worn = free(body) > 0.99
    errors = np.abs(found - true)[worn]
    assert np.median(errors) < FOUND / 2 and np.percentile(errors, 90) < FOUND
    still = np.abs(found)[free(body) < 0.01]
    assert np.median(still) < FOUND


def test_the_inset_is_kept(body, dressed, filled):
    capture, worn = dressed[0], free(body) > 0.99
    near, deep = (
        along_normals(body, capture, x)[worn]
        for x in (filled, fit_vertex_offsets(body, capture, (0.004, 0.004)))
    )
    assert np.median(near - deep) == pytest.approx(0.004, abs=FOUND / 2)


def test_only_a_body_that_sticks_out_of_the_masks_needs_it(body, dressed):
    """Clothes put no body outside of a mask, but a body that is too heavy lies there."""
    capture, _ = dressed
    assert not fit_vertex_offsets(body, capture, always=False).any()
    heavy = capture.betas + 3.0 * np.asarray([name == "weight" for name in body.shape_names])
    wrong = dataclasses.replace(capture, betas=heavy)
    inwards = along_normals(body, wrong, fit_vertex_offsets(body, wrong, always=False))[
        free(body) > 0.99
    ]
    assert np.percentile(inwards, 10) < -COAT / 2


REMESHED = {
    "decimated and split": dict(body_vertices=200, max_edge_length=0.1),
    "decimated": dict(body_vertices=200),
    "split": dict(max_edge_length=0.03),
    "coarser than its weights": dict(max_edge_length=0.1, runtime=dict(body_vertices=200)),
    "finer than its weights": dict(body_vertices=250, runtime=dict(max_edge_length=0.05)),
}


@pytest.mark.parametrize("wish", REMESHED)
def test_a_displacement_is_carried_to_the_vertices_of_another_mesh(body, wish):
    """Remeshing treats it like any quantity of the vertices."""
    conventions = dict(REMESHED[wish])
    config = tiny().with_runtime(**conventions.pop("runtime", {})).with_conventions(**conventions)
    small = decimate(body, 300)
    moved = np.random.default_rng(0).normal(size=(300, 3)).astype(np.float32)
    # carried as columns of the pose directions: they are linear, and no joint depends on them
    carrier = replace(small, pose_directions=jnp.asarray(moved)[..., None])
    carried = gaussian_body(carrier, config).pose_directions[..., 0]
    assert len(carried) != len(small.template)
    found = on_gaussian_body(moved, small, config)
    assert found.dtype == carried.dtype
    # one rounding here, one for each halving of an edge there
    np.testing.assert_allclose(found, carried, rtol=0, atol=4 * np.finfo(np.float32).eps)


def test_a_displacement_of_the_body_itself_stays_as_it_is(body, filled):
    np.testing.assert_array_equal(on_gaussian_body(filled, body, tiny()), filled)


def test_another_displacement_of_a_body_costs_no_decimation(body, monkeypatch):
    config, small = tiny().with_conventions(body_vertices=190), decimate(body, 300)
    gaussian_body(small, config)
    for name in ("decimate_with_kept", "split_long_edges"):
        monkeypatch.setattr(views, name, lambda *_: pytest.fail("made again"))
    for seed in range(2):
        on_gaussian_body(np.random.default_rng(seed).normal(size=(300, 3)), small, config)


def test_joints_stay(body, dressed):
    betas = jnp.asarray(dressed[0].betas)
    before, after = (
        subject_rest(body, betas, None),
        subject_rest(body, betas, jnp.asarray(dressed[1], jnp.float32)),
    )
    np.testing.assert_array_equal(before.joints, after.joints)
    assert np.abs(np.asarray(after.vertices - before.vertices)).max() > COAT / 2


SPOILED = {
    "one photo": lambda c: c.select([0]),
    "a body that is not finite": lambda c: dataclasses.replace(
        c, betas=np.full_like(c.betas, np.nan)
    ),
    "all masks empty": lambda c: dataclasses.replace(c, masks=0 * c.masks),
    "masks of all": lambda c: dataclasses.replace(c, masks=np.ones_like(c.masks)),
    "a hole": lambda c: dataclasses.replace(c, masks=c.masks * (np.arange(SIZE) % 40 > 9)),
}


@pytest.mark.parametrize("spoiled", SPOILED)
def test_bad_masks_do_bounded_harm(body, dressed, spoiled):
    capture = SPOILED[spoiled](dressed[0])
    moved = fit_vertex_offsets(body, capture)
    assert moved.shape == body.template.shape and moved.dtype == np.float32
    assert np.isfinite(moved).all() and np.linalg.norm(moved, axis=-1).max() < BOUND
    if spoiled in ("all masks empty", "masks of all", "a body that is not finite"):
        np.testing.assert_array_equal(moved, 0)


def test_the_border_of_a_photo_is_no_edge_of_the_person(body, dressed):
    capture, coat = dressed
    half = SIZE // 2
    cameras = replace(capture.cameras, height=half)
    upper = dataclasses.replace(
        capture, images=capture.images[:, :half], masks=capture.masks[:, :half], cameras=cameras
    )
    found, true = (
        along_normals(body, capture, x)
        for x in (fit_vertex_offsets(body, upper, inset=(0.0, 0.0)), coat)
    )
    errors = np.abs(found - true)
    # what no photo shows stays where it was
    assert np.percentile(errors[free(body) > 0.99], 95) < COAT + FOUND
