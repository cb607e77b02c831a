"""Position maps against the release's rasterizer and against geometry.

data/mesh_crops.npz has the release's maps, see its `provenance`.
"""

from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

from humangs_jax.geometry.camera import Camera
from humangs_jax.rendering.mesh.rasterizer import (
    gouraud_position_map,
    plain_position_map,
    rasterize_mesh,
    vertex_normals,
)

STORED_AS_FLOAT16 = 5e-4
"""Half of float16's spacing below 1."""
DEPTH_ERROR = 1e-5
"""Difference of two float32 rasterizers at depths of about 2.5."""
GOURAUD_ERROR = 5e-5
"""Difference of colors.

The highlight's 64th power magnifies roundings of normals (1e-7) by 64; interpolation adds a little.
"""


@pytest.fixture(scope="module")
def golden():
    with np.load(Path(__file__).parent / "data" / "mesh_crops.npz") as file:
        return dict(file)


def mesh(golden):
    posed, canonical = (
        jnp.asarray(golden["posed_vertices"]),
        jnp.asarray(golden["canonical_vertices"]),
    )
    return posed, canonical, jnp.asarray(golden["faces"].astype(np.int32))


def camera_of(golden, view):
    fx, fy, cx, cy = golden["fxfycxcy"][view]
    height, width = golden["depth"].shape[1:]
    cam_from_world = np.linalg.inv(golden["c2w"][view].astype(np.float64))
    return Camera.from_opencv([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], cam_from_world, width, height)


@pytest.mark.parametrize("view", [0, 1])
def test_maps_equal_the_release(golden, view):
    posed, canonical, faces = mesh(golden)
    camera = camera_of(golden, view)
    np.testing.assert_array_equal(
        rasterize_mesh(posed, faces, camera).face_ids, golden["face_ids"][view]
    )
    plain, depth = plain_position_map(posed, canonical, faces, camera)
    gouraud, gouraud_depth = gouraud_position_map(posed, canonical, faces, camera)
    np.testing.assert_allclose(plain, golden["position_map_plain"][view], atol=STORED_AS_FLOAT16)
    np.testing.assert_allclose(gouraud, golden["position_map_gouraud"][view], atol=GOURAUD_ERROR)
    np.testing.assert_allclose(depth, golden["depth"][view], atol=DEPTH_ERROR)
    np.testing.assert_array_equal(depth, gouraud_depth)
    background = golden["face_ids"][view] < 0
    assert background.any()
    for image in (plain, gouraud):
        np.testing.assert_array_equal(np.asarray(image)[background], 1)
    np.testing.assert_array_equal(np.asarray(depth)[background], -1)


def test_vertex_normals():
    """An octahedron's normals are its vertices. A vertex without faces, or of faces without area,
    has none.
    """
    corners = np.concatenate([np.eye(3), -np.eye(3), np.full((2, 3), 5.0)])
    faces = [
        [0, 1, 2],
        [1, 3, 2],
        [3, 4, 2],
        [4, 0, 2],
        [1, 0, 5],
        [3, 1, 5],
        [4, 3, 5],
        [0, 4, 5],
        [6, 6, 6],
    ]
    normals = vertex_normals(jnp.asarray(corners, jnp.float32), jnp.asarray(faces))
    np.testing.assert_allclose(normals[:6], corners[:6], atol=1e-6)
    np.testing.assert_array_equal(normals[6:], 0)
