"""One of the demo's photos misleads: views that nothing saw must not get worse by refinement."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from humangs_jax.avatar.reconstruct import reconstruct
from humangs_jax.core.pytree import replace
from humangs_jax.data.capture import load_capture
from humangs_jax.evaluation.cases import predict_views
from humangs_jax.network.weights import load_weights
from humangs_jax.refinement.refine import refine_with_report

SIZE = 256
ALLOWED = 0.1
"""Largest loss, decibels."""
STEPS = 60


def without_mask(capture, view):
    images, masks = np.array(capture.images), np.array(capture.masks)
    images[view], masks[view] = 1, 0
    return dataclasses.replace(capture, images=images, masks=masks)


def with_pose_off(capture, view, joints):
    """Returns the capture with the pose of one photo off by 10 degrees.

    For one joint the whole body turns about the vertical; else each joint turns about some axis.
    """
    frames = np.asarray(capture.frames)
    rotations, axes = np.array(capture.poses.rotations)[frames], np.asarray([[0.0, 1.0, 0.0]])
    if joints > 1:
        axes = np.random.default_rng(view).normal(size=(joints, 3))
    turns = Rotation.from_rotvec(
        np.radians(10) * axes / np.linalg.norm(axes, axis=1, keepdims=True)
    )
    rotations[view, :joints] = (turns * Rotation.from_rotvec(rotations[view, :joints])).as_rotvec()
    poses = replace(
        capture.poses,
        rotations=jnp.asarray(rotations),
        translation=jnp.asarray(capture.poses.translation)[frames],
    )
    return dataclasses.replace(
        capture, poses=poses, frames=np.arange(len(frames), dtype=frames.dtype)
    )


WRONG = {
    "nothing": lambda capture: capture,
    "a mask": lambda capture: without_mask(capture, 1),
    "a turned body": lambda capture: with_pose_off(capture, 0, 1),
    "all joints": lambda capture: with_pose_off(capture, 2, 22),
}


@pytest.mark.slow
@pytest.mark.parametrize("wrong", WRONG)
def test_views_that_nothing_saw_do_not_get_worse(wrong):
    truth = load_capture("demo_capture/held_out").resized(SIZE)
    capture = WRONG[wrong](load_capture("demo_capture").resized(SIZE))

    def score(avatar):
        squared = np.square(predict_views(avatar, truth).images - truth.images).mean(-1)
        inside = (squared * truth.masks).sum((1, 2)) / truth.masks.sum((1, 2))
        return np.asarray([np.mean(-10 * np.log10(x)) for x in (squared.mean((1, 2)), inside)])

    avatar = reconstruct(*load_weights(None), capture)
    start = score(avatar)
    for steps in (0, STEPS):
        report = refine_with_report(avatar, capture, steps=steps)
        gain = score(report.avatar) - start
        assert (gain > (2.0 if wrong == "nothing" else -ALLOWED)).all(), (gain, report.summary())
