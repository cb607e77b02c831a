"""A skirt is found in the masks, with its surface in the right place; trousers have none."""

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
from humangs_jax.data import skirt
from humangs_jax.data.capture import capture_from_arrays
from humangs_jax.data.skirt import (
    BOTTOM,
    GAP,
    HALF,
    LEGS,
    ROWS,
    TOP,
    add_skirt,
    find_hem,
    with_tube,
)
from humangs_jax.geometry.camera import intrinsics_from_fov, orbit
from humangs_jax.rendering.mesh.rasterizer import rasterize_mesh, vertex_normals

SIZE, VIEWS = 384, 6
HEM = 2 * (BOTTOM - TOP) / (ROWS - 1)
"""Largest error of the hem: a row of the mesh on both sides.

Cameras above see the hem's front lower and its back higher than the points between the legs.
"""
SURFACE = 0.016
"""Largest median error of the surface, metres: two pixels of these masks.

Between the photos the section is a smooth guess. The error starts at some 0.06.
"""
STRETCH = 3.0
"""Longest edge with legs 60 degrees apart, over that in the T-pose: the skirt does not tear."""
CONE = (0.28, 0.17)
"""Half axes of the hem, metres."""


@pytest.fixture(scope="module")
def body():
    return decimate(load_body(), 1500)


@functools.cache
def rasterizer():
    return jax.jit(rasterize_mesh)


def cone(body, hem):
    """Returns ((vertices, faces), height at the hem) of an elliptic cone around the legs.

    It reaches from the hips (`hem` 0) down towards the ankles (1).
    """
    joints = np.asarray(body.joint_regressor @ body.template)
    names = list(body.joint_names)
    leg = joints[[names.index(name) for name in LEGS[0]]]
    levels = np.linspace(0.0, hem, 12)
    heights, depths = (np.interp(levels, [0, 0.5, 1], leg[:, i])[:, None] for i in (1, 2))
    turns = np.linspace(0, 2 * np.pi, 49)[:-1]
    grow = (0.6 + 0.4 * levels / hem)[:, None]
    points = np.stack(
        np.broadcast_arrays(
            CONE[0] * grow * np.cos(turns), heights, depths + CONE[1] * grow * np.sin(turns)
        ),
        -1,
    )
    index = np.arange(points[..., 0].size).reshape(12, -1)
    following = np.roll(index, -1, axis=1)
    faces = [
        np.stack(x, -1).reshape(-1, 3)
        for x in (
            (index[:-1], following[:-1], index[1:]),
            (following[:-1], following[1:], index[1:]),
        )
    ]
    return points.reshape(-1, 3), np.concatenate(faces)


def in_clothes(body, rotations=None, worn=None, grown=0.0):
    """Returns a capture of a body, in views all around, with masks.

    Args:
        body: the body model.
        rotations: its pose; without one the T-pose.
        worn: (vertices, faces) of something that is seen as well and does not move.
        grown: distance by which the skin lies outwards, metres.
    """
    pose = BodyPose(
        jnp.zeros((len(body.parents), 3)) if rotations is None else rotations, jnp.zeros(3)
    )
    rest = shape_body(body, jnp.zeros(len(body.shape_names)))
    skin = replace(rest, vertices=rest.vertices + grown * vertex_normals(rest.vertices, body.faces))
    posed = pose_body(body, skin, pose).vertices
    parts = [(posed, body.faces)]
    if worn is not None:
        parts.append((jnp.asarray(worn[0], jnp.float32), jnp.asarray(worn[1])))
    K = intrinsics_from_fov(np.pi / 3, SIZE, SIZE)
    angles = jnp.linspace(0, 2 * np.pi, VIEWS + 1)[:-1]
    cameras = orbit(jnp.asarray([0.0, -0.5, 0.0]), 2.4, angles, 0.1, K, SIZE, SIZE)

    # a pixel belongs to the person where any part is seen
    def shown(i):
        return np.any(
            [np.asarray(rasterizer()(*part, cameras[i]).face_ids) >= 0 for part in parts], axis=0
        )

    masks = np.stack([shown(i) for i in range(VIEWS)]).astype(np.float32)
    return capture_from_arrays(
        np.ones((*masks.shape, 3), np.float32),
        cameras.K,
        cameras.cam_from_world,
        pose.rotations[None],
        pose.translation[None],
        masks=masks,
        background="white",
        body=body,
    )


def turned_hips(body, degrees):
    rotations = np.zeros((len(body.parents), 3), np.float32)
    for name, sign in (("left_hip", 1), ("right_hip", -1)):
        rotations[list(body.joint_names).index(name), 2] = sign * np.radians(degrees)
    return jnp.asarray(rotations)


@pytest.mark.slow
def test_a_skirt_is_found_and_lies_on_the_masks(body, monkeypatch):
    hem = 0.65
    monkeypatch.setattr(skirt, "REACH", dataclasses.replace(skirt.REACH, inset=(0.0, 0.0)))
    points, faces = cone(body, hem)
    capture = in_clothes(body, worn=(points, faces))
    assert abs(find_hem(body, capture) - hem) <= HEM
    worn, moved = add_skirt(body, capture, np.zeros(body.template.shape))
    count = len(body.template)
    assert not moved[:count].any() and np.isfinite(worn.relative_vertex_spacing).all()
    own = np.asarray(worn.template)[count:] + moved[count:]
    joints = np.asarray(body.joint_regressor @ body.template)
    leg = joints[[list(body.joint_names).index(name) for name in LEGS[0]]]
    level = np.interp(-own[:, 1], -leg[:, 1], [0, 0.5, 1])
    low = (level > 0.25) & (level < hem - HEM)  # above, the body itself is as wide
    grow = 0.6 + 0.4 * level[low] / hem
    depth = np.interp(level[low], [0, 0.5, 1], leg[:, 2])
    x, z = own[low, 0] / (CONE[0] * grow), (own[low, 2] - depth) / (CONE[1] * grow)
    off = np.abs(np.hypot(x, z) - 1) * np.hypot(own[low, 0], own[low, 2] - depth)
    assert np.median(off) < SURFACE


@pytest.mark.parametrize(
    ("degrees", "grown"),
    [(12, 0.0), (0, 0.025), (-6, 0.04)],
    ids=["apart", "trousers", "wide trousers"],
)
def test_legs_have_no_skirt(body, degrees, grown):
    assert find_hem(body, in_clothes(body, turned_hips(body, degrees), grown=grown)) is None


def test_what_says_nothing_is_no_skirt(body):
    capture = in_clothes(body, worn=cone(body, 0.85))
    assert abs(find_hem(body, capture) - 0.85) <= HEM
    assert find_hem(body, dataclasses.replace(capture, masks=None)) is None
    assert find_hem(body, dataclasses.replace(capture, masks=0 * capture.masks)) is None
    assert find_hem(body, capture.select([0, 3])) is not None  # the front and the back show it
    strange = replace(body, joint_names=tuple(f"joint {i}" for i in range(len(body.joint_names))))
    assert find_hem(strange, capture) is None
    with pytest.raises(ValueError, match="expected joints"):
        with_tube(strange, 0.5)


def test_a_tube_is_made_of_the_body_and_moves_no_joint(body):
    worn, longer = with_tube(body, 0.5), with_tube(body, 0.9)
    count = len(body.template)
    assert worn.template.shape == longer.template.shape == (count + ROWS * 2 * (GAP + HALF), 3)
    for name in ("template", "shape_directions", "skinning_weights"):
        assert np.array_equal(getattr(worn, name)[:count], getattr(body, name))
    weights = np.asarray(worn.skinning_weights)
    assert np.allclose(weights.sum(-1), 1, atol=1e-5) and weights.min() >= -1e-6
    betas = jnp.asarray(np.random.default_rng(0).normal(size=len(body.shape_names)), jnp.float32)
    assert np.allclose(shape_body(worn, betas).joints, shape_body(body, betas).joints, atol=1e-6)
    tube = np.asarray(worn.template)[count:].reshape(ROWS, -1, 3)
    assert (np.diff(tube[:, :, 1], axis=0) < 0).all()  # rows go down
    normals = np.asarray(vertex_normals(worn.template, worn.faces))[count:].reshape(ROWS, -1, 3)
    middle = GAP // 2
    # front and back
    assert (normals[:, middle, 2] > 0.7).all() and (normals[:, GAP + HALF + middle, 2] < -0.7).all()


def test_a_skirt_bends_between_the_legs(body):
    worn, count = with_tube(body, 0.7), len(body.template)
    rest = shape_body(worn, jnp.zeros(len(worn.shape_names)))
    sides = np.asarray(worn.faces)[(np.asarray(worn.faces) >= count).all(-1)]

    def length(x):
        return np.linalg.norm(
            np.asarray(x)[sides] - np.asarray(x)[np.roll(sides, -1, 1)], axis=-1
        ).max()

    posed = pose_body(worn, rest, BodyPose(turned_hips(worn, 30), jnp.zeros(3))).vertices
    assert length(posed) < STRETCH * length(rest.vertices)
    between = np.asarray(posed)[count:].reshape(ROWS, -1, 3)[:, GAP // 2]
    assert np.abs(between[:, 0]).max() < 0.02  # the middle stays in the middle
