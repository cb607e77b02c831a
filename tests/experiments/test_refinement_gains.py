"""Means and tables of refinement, without rendering."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments.pictures import DETAIL_PIXELS, DETAILS, details, frontal_view
from humangs_jax.body.library import load_body
from humangs_jax.body.model import rest_pose, shape_body
from humangs_jax.data.capture import Capture
from humangs_jax.geometry.camera import intrinsics_from_fov, orbit


@pytest.mark.slow
def test_details_are_squares_around_the_joints():
    body = load_body()
    rest = shape_body(body, jnp.zeros(2))
    head = rest.joints[body.joint_names.index("left_eye")]
    cameras = orbit(
        head, 1.5, jnp.asarray([0.0, np.pi]), 0.0, intrinsics_from_fov(0.8, 64, 64), 64, 64
    )
    images = np.zeros((2, 64, 64, 3), np.float32)
    images[0, 24:40, 24:40] = [1, 0, 0]  # the middle of the picture: the face
    poses = jax.tree.map(lambda x: x[None], rest_pose(body))
    capture = Capture(
        images, None, cameras, np.zeros(2, int), body, np.zeros(2, np.float32), poses, ("a", "b")
    )
    found = details(images[0], capture, 0)
    assert found.shape == (len(DETAILS), DETAIL_PIXELS, DETAIL_PIXELS, 3)
    np.testing.assert_allclose(found[0][40:56, 40:56].mean((0, 1)), [1, 0, 0], atol=0.01)
    assert found[3][-10:].min() > 0.99 and found[3][:3].max() < 1  # the shoe is below the picture
    assert frontal_view(capture.select([1]), capture, (0, 1)) == 1
