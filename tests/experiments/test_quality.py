"""Quality of reconstructions: every number is that of the images that were drawn; rows, tables and
verdicts.

The network is `tiny` with variables of zero; for bodies of other sizes its avatars are made up.
"""

import json
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from evaluation_cases import capture_from, random_lpips

from experiments import appearance, bodies, harness, quality, subjects
from experiments.refinement import body_off
from humangs_jax.body.model import BodyPose
from humangs_jax.losses.perceptual import lpips
from humangs_jax.network.presets import tiny
from humangs_jax.network.weights import expected_variables, save_weights

SMALL = ("--held-out", "1", "--poses", "1", "--pose-views", "1", "--size", "48")


@pytest.fixture
def weights(tmp_path):
    zeros = jax.tree.map(lambda leaf: np.zeros(leaf.shape, leaf.dtype), expected_variables(tiny()))
    save_weights(tmp_path / "weights.safetensors", zeros, tiny())
    return tmp_path / "weights.safetensors"


def run(function, *options):
    assert harness.call(function, [str(option) for option in options]) == 0


@pytest.mark.slow
def test_scores_by_task_are_means_over_views():
    """With LPIPS of any net; without weights it is missing."""
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


@pytest.mark.parametrize("function", [quality.evaluation_views, bodies.evaluation_bodies])
def test_wrong_options_are_one_line(function, capsys):
    for said, option in {
        "--views": "--views=5",
        "--subjects": "--subjects=0",
        "reach beyond": "--first=999999",
    }.items():
        with pytest.raises(SystemExit) as exit_:
            run(function, option)
        assert exit_.value.code == 2 and said in capsys.readouterr().err.splitlines()[-1]


def mean_psnr(drawn, truth, chosen):
    """Mean over the chosen views, by the formula."""
    errors = (np.clip(drawn, 0, 1) - truth).astype(np.float64)[chosen] ** 2
    return np.mean(-10 * np.log10(errors.mean(axis=(1, 2, 3))))


@pytest.mark.slow
def test_a_person_is_made_once_and_rows_are_kept(weights, tmp_path, monkeypatch):
    """People, reconstruction and drawing are real; every reported number is that of the images that
    were drawn.
    """
    made, ours, painted = [], [], []
    make, draw, paint = (
        subjects.make_evaluation_subject,
        quality.draw_views,
        quality.draw_painted_body,
    )
    kept = lambda seen, images, truth: (
        seen.append((images, truth.images, np.asarray(truth.frames))) or images
    )
    monkeypatch.setattr(
        subjects, "make_evaluation_subject", lambda *a: made.append(a[0]) or make(*a)
    )
    observed = lambda avatar, truth: SimpleNamespace(
        images=kept(ours, draw(avatar, truth).images, truth)
    )
    monkeypatch.setattr(quality, "draw_views", observed)
    monkeypatch.setattr(
        quality,
        "draw_painted_body",
        lambda colors, truth: kept(painted, paint(colors, truth), truth),
    )
    out, first, second = tmp_path / "a.json", 2_000_000, 2_000_001

    def evaluated(*views):
        made.clear()
        run(
            quality.evaluation_views,
            "--subjects",
            2,
            "--weights",
            weights,
            "--json",
            out,
            *SMALL,
            "--views",
            *views,
        )
        assert made == [first, second]
        return json.loads(out.read_text())["numbers"]["evaluation_views"]

    numbers = evaluated(1)
    assert numbers["views"] == 1 and len(ours) == 2
    numbers = evaluated(2, 1)
    assert len(ours) == len(painted) == 4  # the rows of one photo are kept
    assert numbers["views"] == numbers["people"] == 2
    for count, those in (("1", slice(2)), ("2", slice(2, 4))):
        for task, frames in (("novel", lambda x: x == 0), ("animation", lambda x: x != 0)):
            for key, seen in (("psnr", ours), ("baseline_psnr", painted)):
                expected = np.mean(
                    [mean_psnr(images, truth, frames(at)) for images, truth, at in seen[those]]
                )
                assert numbers["by_views"][count][task][key] == pytest.approx(expected, abs=1e-4)


@pytest.mark.slow
def test_bodies_see_the_same_photos(weights, tmp_path, monkeypatch):
    seen, held_out = [], []
    drawings = {
        "ours": lambda views: np.clip(views.images + 0.1, 0, 1),
        "painted": lambda views: 0.5 * views.images,
    }

    def reconstructed(variables, config, capture):
        assert (
            config.conventions.body_vertices is None and config.conventions.max_edge_length is None
        )
        seen.append((len(capture.body.template), capture.images))
        return SimpleNamespace(
            gaussians=SimpleNamespace(means=np.zeros((3 * len(capture.body.template), 3)))
        )

    drawn = lambda avatar, views: (
        held_out.append(views) or SimpleNamespace(images=drawings["ours"](views))
    )
    for name, fake in {
        "SMPLX_SEED_VERTICES": 600,
        "reconstruct": reconstructed,
        "draw_views": drawn,
        "painted_body": lambda inputs: None,
        "draw_painted_body": lambda colors, views: drawings["painted"](views),
    }.items():
        monkeypatch.setattr(bodies, name, fake)
    out = tmp_path / "a.json"
    run(
        bodies.evaluation_bodies,
        "--subjects",
        1,
        "--views",
        1,
        "--weights",
        weights,
        "--json",
        out,
        *SMALL,
    )
    assert [count for count, _ in seen] == [13380, 1796, 3345, 836]
    assert all(np.array_equal(images, seen[0][1]) for _, images in seen)
    found = json.loads(out.read_text())["numbers"]["evaluation_bodies"]["bodies"]
    assert found["1/16"]["vertices"] == 836
    for kind, name in (("default", "ours"), ("painted default body", "painted")):
        animation = np.asarray(held_out[-1].frames) != 0
        expected = mean_psnr(drawings[name](held_out[-1]), held_out[-1].images, animation)
        assert found[kind]["animation"]["psnr"] == pytest.approx(expected, abs=1e-4)
    assert bodies.bodies_table(found).count("\n| ") == len(found) + 1


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


def people(**psnrs):
    """Scores by number of photos and seed; seeds count from 1."""
    base = {
        "ssim": 0.9,
        "lpips": None,
        "baseline_ssim": 0.8,
        "baseline_psnr_fg": 9.0,
        "baseline_psnr": 15.0,
    }
    scores = lambda psnr: base | {"psnr": psnr, "psnr_fg": psnr - 6, "baseline_lpips": None}
    rows = lambda values: {
        seed: {"novel": scores(x), "animation": scores(x - 1)} for seed, x in enumerate(values, 1)
    }
    return {int(count[1:]): rows(values) for count, values in psnrs.items()}


def test_it_is_told_where_more_photos_are_worse():
    said = quality.verdict(people(v1=[20], v2=[21], v4=[22]), 4, "novel")
    assert "never worse" in said and "1 of 1 people" in said
    said = quality.verdict(people(v1=[20], v2=[19.5], v4=[14]), 4, "animation")
    assert (
        "by 0.50 dB from 1 to 2" in said
        and "by 5.50 dB from 2 to 4" in said
        and "0 of 1 people" in said
    )


def test_the_section_has_means():
    section = quality.views_section(people(v1=[21, 22], v4=[25, 26]), 4, "about")
    assert "| novel poses | 4 | 24.50 | 0.900 | 18.50 | 15.00 | 0.800 | 9.00 |" in section
    assert "LPIPS" not in section


# What eyes see
# --------------------------------------------------------------------------------------------------


def test_loosest_and_worst_people_are_listed_apart():
    rows = [
        {"512 0 novel": {"before": {"psnr_fg": float(i)}}, "loose": -float(i)} for i in range(12)
    ]
    groups = appearance.groups_of(rows, "before")
    assert groups == {"all": rows, "10 loosest": rows[:10], "5 worst": rows[:5]}
    assert list(appearance.groups_of(rows[:10], "before")) == ["all"]


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
