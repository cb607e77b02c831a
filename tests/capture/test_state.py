"""States of fits: which views share a camera, and the prior of poses."""

import jax.numpy as jnp
import numpy as np

from humangs_jax.body.joints import JOINT_NAMES
from humangs_jax.capture.fitting.state import MIRROR, camera_origin, limit_residuals, pose_prior
from humangs_jax.core.pytree import replace
from humangs_jax.geometry.camera import intrinsics_from_fov, orbit


def test_views_by_one_camera_share_it_and_equal_focal_lengths_are_one():
    cameras = orbit(
        jnp.zeros(3),
        3.0,
        jnp.asarray([0.3, 2.0, 0.3]),
        0.1,
        intrinsics_from_fov(1.0, 64, 48),
        64,
        48,
    )
    origin_of = lambda cameras: camera_origin(cameras, np.asarray([0, 0, 1]))
    assert origin_of(cameras).camera.tolist() == [0, 1, 0] and origin_of(
        cameras
    ).focal.tolist() == [0, 0, 0]
    zoomed = replace(cameras, K=cameras.K.at[1, 0, 0].multiply(1.01))
    assert origin_of(zoomed).focal.tolist() == [0, 1, 0]


def test_right_joints_are_mirror_images_of_left_ones_and_unknown_ones_have_no_limits():
    prior = pose_prior((*JOINT_NAMES, "tail"))
    assert (prior.lower <= prior.mean).all() and (prior.mean <= prior.upper).all()
    for left, right in (
        (j, JOINT_NAMES.index(n.replace("left", "right")))
        for j, n in enumerate(JOINT_NAMES)
        if "left" in n
    ):
        np.testing.assert_array_equal(
            prior.mean[right], MIRROR.astype(np.float32) * prior.mean[left]
        )
        np.testing.assert_array_equal(prior.std[right], prior.std[left])
        ends = np.sort([prior.lower[left] * MIRROR, prior.upper[left] * MIRROR], axis=0)
        np.testing.assert_array_equal(
            [prior.lower[right], prior.upper[right]], ends.astype(np.float32)
        )
    assert np.array_equal(prior.mean[-1], np.zeros(3)) and prior.upper[-1].min() > 3.1


def test_a_tenth_of_a_radian_beyond_a_limit_is_two_standard_deviations_and_nothing_inside_counts():
    prior, knees = (
        pose_prior(JOINT_NAMES),
        tuple(JOINT_NAMES.index(f"{side}_knee") for side in ("left", "right")),
    )
    rotations = (
        jnp.asarray(prior.mean)
        .at[knees[0]]
        .set(prior.upper[knees[0]] + np.float32([0.1, 0, -0.01]))
    )
    rotations = rotations.at[knees[1], 1].set(prior.lower[knees[1], 1] - 0.1)
    np.testing.assert_allclose(
        limit_residuals(prior, knees, rotations), [[2, 0, 0], [0, 2, 0]], atol=1e-5
    )
