import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from fit_people import POSES, model_of, observe

from humangs_jax.core.pytree import replace
from humangs_jax.fitting import landmark_fit
from humangs_jax.fitting.fit_capture import fit_uncertainty
from humangs_jax.fitting.landmark_fit import STAGES, FitConfig, fit_landmarks
from humangs_jax.fitting.state import pose_prior, violations

CONFIG = FitConfig()
NAMES = list(POSES)
EXACT_MM = 6.0
"""Mean joint error without noise: priors pull by millimetres at what keypoints leave open, collars and the spine."""
NOISY_MM, OUTLIER_MM = 10.0, 20.0
"""What issue 8 asks for, 2 pixels of noise at 512; and with 20 % of the points up to 140 pixels off."""


def mean_mm(fit, joints, rows=slice(None)):
    return 1000 * np.linalg.norm(np.asarray(fit.joints) - joints, axis=-1)[rows].mean()


@pytest.fixture(scope="module")
def noisy():
    joints, betas, seen = observe(NAMES, noise=2.0)
    return joints, betas, seen, fit_landmarks(model_of(), seen, CONFIG)


def test_frames_are_a_batch(monkeypatch):
    """Without the fit itself, which takes minutes: the fast tests know that its arguments pass."""
    _, _, seen = observe(NAMES[:2])

    class Reached(Exception):
        pass

    def reached(model, observations, config):
        raise Reached(observations)

    monkeypatch.setattr(landmark_fit, "_fit_frames", reached)
    with pytest.raises(Reached) as caught:
        fit_landmarks(model_of(), seen, CONFIG)
    assert caught.value.args[0].batch_shape == (2,)
    with pytest.raises(ValueError, match=r"observations.K: expected shape \(2, 4, 3, 3\), got \(2, 3, 3, 3\)"):
        fit_landmarks(model_of(), replace(seen, K=seen.K[:, :3]), CONFIG)


@pytest.mark.slow
def test_keypoints_without_noise():
    joints, _, seen = observe(NAMES, seed=3)
    fit = fit_landmarks(model_of(), seen, CONFIG)
    for i, pose in enumerate(NAMES):
        assert mean_mm(fit, joints, i) < EXACT_MM, pose


@pytest.mark.slow
def test_keypoints_with_noise(noisy):
    joints, _, _, fit = noisy
    for i, pose in enumerate(NAMES):
        assert mean_mm(fit, joints, i) < NOISY_MM, pose
    assert (np.abs(np.asarray(fit.noise) - 2.0) < 0.5).all()
    for stage in STAGES:
        outcome = fit.outcomes[stage]
        assert (np.asarray(outcome.after) <= np.asarray(outcome.before)).all()
        assert (np.asarray(outcome.steps) > 0).all()


@pytest.mark.slow
def test_limits_are_kept(noisy):
    prior = pose_prior(model_of().joint_names)
    for rotations in np.asarray(noisy[3].poses.rotations)[[NAMES.index("standing"), NAMES.index("crouching")]]:
        assert violations(prior, rotations, slack=0.15) == []


@pytest.mark.slow
def test_outliers_are_told_apart():
    joints, _, seen = observe(NAMES, seed=1, noise=2.0, outliers=0.2)
    fit = fit_landmarks(model_of(), seen, CONFIG)
    for i, pose in enumerate(NAMES):
        assert mean_mm(fit, joints, i) < OUTLIER_MM, pose


@pytest.mark.slow
def test_a_view_without_keypoints_is_left_out(noisy):
    joints, _, seen, _ = noisy
    blind = replace(seen, confidences=seen.confidences.at[:, 1].set(0.0), points=seen.points.at[:, 1].set(1e6))
    fit = fit_landmarks(model_of(), blind, CONFIG)
    assert mean_mm(fit, joints) < 1.5 * NOISY_MM


@pytest.mark.slow
def test_a_frame_without_keypoints_is_as_the_prior_has_it_and_the_others_do_not_mind(noisy):
    joints, _, seen, whole = noisy
    blind = replace(seen, confidences=seen.confidences.at[2].set(0.0))
    fit = fit_landmarks(model_of(), blind, CONFIG)
    others = [0, 1, 3, 4]
    assert mean_mm(fit, joints, others) < NOISY_MM
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(fit))
    usual = pose_prior(model_of().joint_names).mean
    np.testing.assert_allclose(np.asarray(fit.poses.rotations)[2, 1:], usual[1:], atol=1e-3)
    assert not np.allclose(np.asarray(whole.poses.rotations)[2, 1:], usual[1:], atol=0.1)


def test_nothing_seen_at_all_is_finite(noisy):
    seen = noisy[2]
    fit = fit_landmarks(model_of(), replace(seen, confidences=jnp.zeros_like(seen.confidences)), CONFIG)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(fit))


def test_predicted_deviations_are_of_the_size_of_the_errors(noisy):
    joints, _, seen, fit = noisy
    found = fit_uncertainty(model_of(), seen, fit)
    errors = np.linalg.norm(np.asarray(fit.joints) - joints, axis=-1)
    ratio = np.sqrt((errors**2).mean() / (found.joint_std**2).mean())
    assert 0.3 < ratio < 1.5  # landmarks of hips and shoulders are trusted less than these true ones deserve
    names = model_of().joint_names
    share = {name: found.determined[:, names.index(name)].mean() for name in ("left_eye", "left_knee", "left_shoulder")}
    assert share["left_eye"] == 0 < 0.3 < share["left_knee"] and share["left_shoulder"] > 0.7
    np.testing.assert_allclose(found.joint_covariances, found.joint_covariances.swapaxes(-1, -2), atol=1e-12)
    assert np.linalg.eigvalsh(found.joint_covariances).min() > 0


@pytest.fixture(scope="module")
def still():
    """Somebody who stands still, six frames of one view, 4 pixels of noise: joints (j, 3), what is seen, the fit."""
    joints, _, seen = observe(["standing"], views=1)
    noise = np.random.default_rng(0).normal(0, 4, (6, *seen.points.shape[1:]))
    seen = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf[0], (6, *leaf.shape[1:])), seen)
    seen = replace(seen, points=seen.points + noise)
    return joints[0], seen, fit_landmarks(model_of(), seen, CONFIG)


@pytest.mark.slow
def test_what_one_view_does_not_determine_is_told(still):
    joints, seen, fit = still
    found = fit_uncertainty(model_of(), seen, fit)
    camera = np.asarray(seen.cam_from_world[0, 0])
    away = joints + camera[:3, :3].T @ camera[:3, 3]
    depth = away / np.linalg.norm(away, axis=-1, keepdims=True)
    variance = np.einsum("ja,mjab,jb->mj", depth, found.joint_covariances, depth)
    total = np.trace(found.joint_covariances, axis1=-2, axis2=-1)
    assert (variance / total > 0.8).mean() > 0.8  # what is open is the distance
    error = np.linalg.norm(np.asarray(fit.joints) - joints, axis=-1)
    assert error.mean() < 4 * np.sqrt(total).mean()


@pytest.mark.slow
def test_smoothness_shrinks_the_jitter_of_a_motion_that_stands_still(still):
    smooth = fit_landmarks(model_of(), still[1], FitConfig(smoothness=0.002))
    jitter = lambda fit: np.linalg.norm(np.diff(np.asarray(fit.joints), 2, axis=0), axis=-1).mean()
    assert jitter(smooth) < 0.5 * jitter(still[2])


FEW_STEPS, SAME_PATH = 10, 1e-4
"""Steps before rounding decides which step is accepted; metres. After 30 steps the two are 4 to 36 mm apart."""


@pytest.mark.slow
def test_vmap_over_people_is_a_loop():
    config = dataclasses.replace(CONFIG, steps=FEW_STEPS, person_steps=FEW_STEPS)
    several = [observe(NAMES[:2], seed=seed, noise=2.0)[2] for seed in range(2)]
    batch = jax.tree.map(lambda *leaves: jnp.stack(leaves), *several)
    together = jax.vmap(lambda seen: fit_landmarks(model_of(), seen, config))(batch)
    for i, seen in enumerate(several):
        alone = fit_landmarks(model_of(), seen, config)
        difference = np.linalg.norm(np.asarray(together.joints[i]) - np.asarray(alone.joints), axis=-1)
        assert difference.max() < SAME_PATH
