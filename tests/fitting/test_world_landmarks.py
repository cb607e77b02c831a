"""3D landmarks of a detector as evidence where a frame has one view."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from fitting.fit_people import betas_of, model_of, observe, rotations_of

from humangs_jax.body.landmarks import pose_landmarks
from humangs_jax.body.model import BodyPose
from humangs_jax.core.pytree import replace
from humangs_jax.fitting.landmark_fit import fit_landmarks
from humangs_jax.fitting.residuals.keypoints import world_residuals

POSES = ("standing", "crouching", "facing away")
NOISE = 0.04
"""Metres: of a detector's landmarks in space."""


def seen_in_space(model, observations, seed):
    """The landmarks of `POSES` in camera axes, too small by a tenth, about another middle, with noise: (m, 1, k, 3)."""
    rotations, none = jnp.stack([rotations_of(pose) for pose in POSES]), jnp.zeros(3)
    betas = jnp.asarray(betas_of(seed))
    landmarks = jax.vmap(lambda r: pose_landmarks(model, betas, BodyPose(r, none))[0])(rotations)
    turned = np.einsum("mcab,mkb->mcka", observations.cam_from_world[..., :3, :3], landmarks)
    return 0.9 * turned + 3.0 + np.random.default_rng(seed).normal(0, NOISE, turned.shape)


@pytest.mark.slow
def test_of_one_view_depths_are_better_where_the_detector_sees_them():
    model, seed = model_of(), 3
    joints, _, seen = observe(POSES, seed=seed, views=1, noise=1.0)
    spatial = replace(seen, world=jnp.asarray(seen_in_space(model, seen, seed), jnp.float32))

    def error(observations):
        found = np.asarray(fit_landmarks(model, observations).joints)[:, :22]
        centered = lambda x: x - x.mean(1, keepdims=True)
        return np.linalg.norm(centered(found) - centered(joints[:, :22]), axis=-1).mean()

    without, with_them = error(seen), error(spatial)
    assert with_them < 0.8 * without


def test_size_and_place_in_space_do_not_count_and_unseen_landmarks_neither():
    model, seed = model_of(), 1
    _, _, seen = observe(POSES, seed=seed, views=1)
    landmarks = jnp.asarray(np.random.default_rng(0).normal(0, 0.5, (len(model.names), 3)), jnp.float32)
    rotation = seen.cam_from_world[0, :, :3, :3]
    world = 1.7 * jnp.einsum("cab,kb->cka", rotation, landmarks) - 2.0
    first = jax.tree.map(lambda leaf: leaf[0], seen)
    hidden = first.confidences.at[:, :5].set(0.0)
    residuals = lambda world: world_residuals(model, replace(first, confidences=hidden, world=world), landmarks, 5.0)
    np.testing.assert_allclose(residuals(world), 0, atol=2e-2)  # the size has a floor of 5 cm
    np.testing.assert_array_equal(residuals(world.at[:, :5].add(9.0))[:, :5], 0)
    assert float(jnp.abs(residuals(world.at[:, 8].add(0.5))).max()) > 0.5
