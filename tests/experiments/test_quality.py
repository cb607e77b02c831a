"""Quality of reconstructions: numbers are those of the drawn images; rows, tables, verdicts.

The network is `tiny` with variables of zero; avatars of other sizes are made up.
"""

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from evaluation_cases import capture_from, random_lpips

from experiments import bodies, harness, quality, subjects
from experiments.refinement import body_off
from humangs_jax.body.model import BodyPose
from humangs_jax.losses.perceptual import lpips
from humangs_jax.network.presets import tiny
from humangs_jax.network.weights import expected_variables, save_weights


@pytest.fixture
def weights(tmp_path):
    zeros = jax.tree.map(lambda leaf: np.zeros(leaf.shape, leaf.dtype), expected_variables(tiny()))
    save_weights(tmp_path / "weights.safetensors", zeros, tiny())
    return tmp_path / "weights.safetensors"


def run(function, *options):
    assert harness.call(function, [str(option) for option in options]) == 0


@pytest.mark.slow
def test_scores_by_task_are_means_over_views():
    """LPIPS may be of any net; without weights it is missing."""
    rng, frames = np.random.default_rng(0), np.asarray([0, 0, 1])
    truth, drawn = rng.random((2, 3, 48, 48, 3)).astype(np.float32)
    held_out = capture_from(truth, np.ones((3, 48, 48), np.float32), frames)
    found = subjects.score_tasks(drawn + 0.5, held_out)
    assert found["novel"]["psnr"] == pytest.approx(
        mean_psnr(drawn + 0.5, truth, frames == 0), abs=1e-4
    )
    assert found["animation"]["psnr"] == pytest.approx(
        mean_psnr(drawn + 0.5, truth, frames == 1), abs=1e-4
    )
    assert found["novel"]["lpips"] is None
    weights = random_lpips("alex")
    found = subjects.score_tasks(drawn + 0.5, held_out, weights)["animation"]["lpips"]
    expected = jax.jit(lpips)(weights, np.clip(drawn[2] + 0.5, 0, 1), truth[2])
    assert found == pytest.approx(float(expected), rel=1e-5) and found > 0


@pytest.mark.slow
@pytest.mark.parametrize("function", [quality.evaluation_views, bodies.evaluation_bodies])
def test_wrong_options_are_one_line(function, capsys):
    for problem, option in {
        "--views": "--views=5",
        "--subjects": "--subjects=0",
        "reach beyond": "--first=999999",
    }.items():
        with pytest.raises(SystemExit) as exit_:
            run(function, option)
        assert exit_.value.code == 2 and problem in capsys.readouterr().err.splitlines()[-1]


def mean_psnr(drawn, truth, chosen):
    """Returns the mean PSNR of the chosen views, by its formula."""
    errors = (np.clip(drawn, 0, 1) - truth).astype(np.float64)[chosen] ** 2
    return np.mean(-10 * np.log10(errors.mean(axis=(1, 2, 3))))


@pytest.mark.slow  # a person made, reconstructed and drawn
def test_the_shipped_weights_beat_the_painted_body(tmp_path):
    options = (
        "--subjects",
        1,
        "--held-out",
        1,
        "--poses",
        1,
        "--pose-views",
        1,
        "--size",
        128,
        "--views",
        4,
    )
    out, plot = tmp_path / "a.json", tmp_path / "plot.png"
    run(quality.evaluation_views, *options, "--json", out)
    tasks = json.loads(out.read_text())["numbers"]["evaluation_views"]["by_views"]["4"]
    quality.plot_views(plot, {4: tasks})
    assert plot.is_file() and tasks["novel"]["baseline_psnr"] > 10
    assert all(scores["psnr"] > scores["baseline_psnr"] for scores in tasks.values())


# Tables
# --------------------------------------------------------------------------------------------------


# What eyes see
# --------------------------------------------------------------------------------------------------


def test_a_body_that_is_off_is_off_by_the_same_in_all_poses():
    poses = jax.vmap(BodyPose)(jnp.zeros((3, 4, 3)), jnp.zeros((3, 3)))
    moved, betas = body_off(poses, jnp.zeros(5), 5.0, seed=1)
    for array in (moved.rotations, moved.translation):
        np.testing.assert_array_equal(array[0], array[2])
        assert np.asarray(array).any()
    assert (
        np.asarray(betas).any()
        and not np.asarray(body_off(poses, jnp.zeros(5), 0.0, seed=1)[1]).any()
    )
