"""States of fits: what they move, and how; the prior of poses."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from humangs_jax.body.joints import JOINT_NAMES
from humangs_jax.body.model import BodyPose
from humangs_jax.core.pytree import replace
from humangs_jax.data.capture import Capture
from humangs_jax.fitting.refine import CaptureRefineConfig, capture_origin
from humangs_jax.fitting.state import (
    StateStd,
    camera_origin,
    zero_state,
)
from humangs_jax.geometry.camera import intrinsics_from_fov, orbit
from tests.fitting.fit_people import default_body

STD = StateStd()


@pytest.fixture(scope="module")
def capture():
    """Two frames; view 2 is by the camera of view 0. The root is turned by nearly half a turn."""
    K = intrinsics_from_fov(1.0, 64, 48)
    cameras = orbit(jnp.zeros(3), 3.0, jnp.asarray([0.3, 2.0, 0.3]), 0.1, K, 64, 48)
    rotations = np.random.default_rng(0).normal(0, 0.2, (2, len(JOINT_NAMES), 3)).astype(np.float32)
    rotations[:, 0] = [[0, 3.1, 0.2], [0, 0, 0]]
    poses = BodyPose(jnp.zeros((1, 3)), jnp.zeros(3))
    poses = replace(poses, rotations=jnp.asarray(rotations), translation=jnp.asarray([[0, 0.1, 0], [0.2, 0, 0.0]]))
    images = np.ones((3, 48, 64, 3), np.float32)
    frames = np.asarray([0, 0, 1], np.int32)
    return Capture(images, None, cameras, frames, default_body(), np.zeros(3, np.float32), poses, ("a", "b", "c"))


@pytest.fixture(scope="module")
def origin(capture):
    return capture_origin(capture, capture.cameras, CaptureRefineConfig(coefficients=5))


def random_state(origin, seed=0):
    rng = np.random.default_rng(seed)
    return jax.tree.map(lambda leaf: jnp.asarray(rng.normal(size=leaf.shape), jnp.float32), zero_state(origin))


def moved(state, **changes):
    """With some fields of the cameras changed."""
    return replace(state, cameras=replace(state.cameras, **changes))


def test_views_by_one_camera_share_it_and_equal_focal_lengths_are_one(capture):
    of = lambda cameras: camera_origin(cameras, capture.frames)
    assert of(capture.cameras).camera.tolist() == [0, 1, 0]
    assert of(capture.cameras).focal.tolist() == [0, 0, 0]
    zoomed = replace(capture.cameras, K=capture.cameras.K.at[1, 0, 0].multiply(1.01))
    assert of(zoomed).focal.tolist() == [0, 1, 0]
