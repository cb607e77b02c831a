"""The evaluation scripts as commands: one person for all numbers of photos, rows kept, LPIPS missing without weights.

The network is `tiny` with variables of zero; for bodies of other sizes its avatars are made up.
"""

import json
import sys
from types import SimpleNamespace

import jax
import numpy as np
import pytest
from evaluation_cases import capture_from, random_lpips

from experiments.evaluation import bodies, body_cases, subjects, synthetic
from humangs_jax.losses.perceptual import lpips
from humangs_jax.network.presets import tiny
from humangs_jax.network.weights import expected_variables, save_weights

SMALL = ("--held-out", "1", "--poses", "1", "--pose-views", "1", "--size", "48")


@pytest.fixture
def weights(tmp_path):
    zeros = jax.tree.map(lambda leaf: np.zeros(leaf.shape, leaf.dtype), expected_variables(tiny()))
    save_weights(tmp_path / "weights.safetensors", zeros, tiny())
    return tmp_path / "weights.safetensors"


def run(script, monkeypatch, *arguments):
    monkeypatch.setattr(sys, "argv", [f"{script.__name__}.py", *map(str, arguments)])
    script.main()


@pytest.mark.slow
def test_scores_by_task_are_means_over_views():
    """With LPIPS of any net; without weights it is missing."""
    rng, frames = np.random.default_rng(0), np.asarray([0, 0, 1])
    truth, drawn = rng.random((2, 3, 48, 48, 3)).astype(np.float32)
    held_out = capture_from(truth, np.ones((3, 48, 48), np.float32), frames)
    found = subjects.score_tasks(drawn + 0.5, held_out)
    assert found["novel"]["psnr"] == pytest.approx(mean_psnr(drawn + 0.5, truth, frames == 0), abs=1e-4)
    assert found["animation"]["psnr"] == pytest.approx(mean_psnr(drawn + 0.5, truth, frames == 1), abs=1e-4)
    assert found["novel"]["lpips"] is None
    weights = random_lpips("alex")
    found = subjects.score_tasks(drawn + 0.5, held_out, weights)["animation"]["lpips"]
    expected = jax.jit(lpips)(weights, np.clip(drawn[2] + 0.5, 0, 1), truth[2])
    assert found == pytest.approx(float(expected), rel=1e-5) and found > 0


@pytest.mark.parametrize("script", [synthetic, bodies])
def test_wrong_arguments_are_one_line(script, tmp_path, monkeypatch, capsys):
    (tmp_path / "a.pth").write_bytes(b"something")
    wrong = {
        "a.pth": (["--lpips-backbone", tmp_path / "a.pth"], ["--lpips-heads", tmp_path / "a.pth"]),
        "--views": (["--views", "5"],),
        "--subjects": (["--subjects", "0"],),
        "reach beyond": (["--first", "999999"],),
    }
    for said, cases in wrong.items():
        for arguments in cases:
            with pytest.raises(SystemExit) as exit_:
                run(script, monkeypatch, *arguments)
            assert exit_.value.code == 2 and said in capsys.readouterr().err.splitlines()[-1]


def mean_psnr(drawn, truth, chosen):
    """Mean over the chosen views, by the formula."""
    errors = (np.clip(drawn, 0, 1) - truth).astype(np.float64)[chosen] ** 2
    return np.mean(-10 * np.log10(errors.mean(axis=(1, 2, 3))))


@pytest.mark.slow
def test_a_person_is_made_once_and_rows_are_kept(weights, tmp_path, monkeypatch):
    """People, reconstruction and drawing are real; every reported number is that of the images that were drawn."""
    made, drawn, expected = [], [], {}
    make, draw = subjects.make_evaluation_subject, subjects.draw_person

    def observed(variables, config, subject, count):
        drawn.append((subject.seed, count))
        images, truth = draw(variables, config, subject, count), subject.held_out
        for task, chosen in (("novel", truth.frames == 0), ("animation", truth.frames != 0)):
            expected[subject.seed, count, task] = [
                mean_psnr(x, truth.images, np.asarray(chosen)) for x in (images.ours, images.painted)
            ]
        return images

    monkeypatch.setattr(subjects, "make_evaluation_subject", lambda *a: made.append(a[0]) or make(*a))
    monkeypatch.setattr(subjects, "draw_person", observed)
    page, out, sheet = tmp_path / "page.md", tmp_path / "a.json", tmp_path / "sheet.png"
    page.write_text("Before\n<!-- table: evaluation_views -->\nold\n<!-- end -->\nAfter\n")
    options = ("--weights", weights, "--json", out, *SMALL)
    run(synthetic, monkeypatch, "--subjects", 2, "--views", 1, *options)
    first, second = 2_000_000, 2_000_001
    assert made == [first, second] and drawn == [(first, 1), (second, 1)]
    report = json.loads(out.read_text())
    assert report["views"] == 1 and report["lpips"] is None and set(report["by_views"]) == {"1"}

    made.clear(), drawn.clear()
    run(synthetic, monkeypatch, "--subjects", 2, "--views", 2, 1, *options, "--page", page, "--images", sheet)
    assert made == [first, second] and drawn == [(first, 2), (second, 2)]  # the rows of one photo are kept
    assert "| new views, same pose | 2 |" in page.read_text() and page.read_text().endswith("After\n")
    report = json.loads(out.read_text())
    assert report["views"] == 2 and [person["seed"] for person in report["subjects"]] == [first, second]
    for count in (1, 2):
        for task in ("novel", "animation"):
            row = report["by_views"][str(count)][task]
            ours, painted = np.mean([expected[seed, count, task] for seed in (first, second)], axis=0)
            assert row["psnr"] == pytest.approx(ours, abs=1e-4)
            assert row["baseline_psnr"] == pytest.approx(painted, abs=1e-4)
    assert report["psnr"] == report["by_views"]["2"]["novel"]["psnr"]

    made.clear(), drawn.clear()
    sheet.unlink()
    run(synthetic, monkeypatch, "--subjects", 1, "--views", 2, *options, "--images", sheet)
    assert drawn == [(first, 2)] and sheet.is_file()  # for its sheet alone
    report = json.loads(out.read_text())
    assert [person["seed"] for person in report["others"]] == [second] and len(report["subjects"]) == 1


@pytest.mark.slow
def test_bodies_see_the_same_photos_and_what_they_cost_is_noted(weights, tmp_path, monkeypatch):
    seen, held_out = [], []
    drawings = {"ours": lambda views: np.clip(views.images + 0.1, 0, 1), "painted": lambda views: 0.5 * views.images}

    def reconstructed(variables, config, capture):
        assert config.conventions.body_vertices is None and config.conventions.longest_edge is None
        seen.append((len(capture.body.template), capture.images))
        return SimpleNamespace(gaussians=SimpleNamespace(means=np.zeros((3 * len(capture.body.template), 3))))

    monkeypatch.setattr(body_cases, "SMPLX_SEED_VERTICES", 600)
    monkeypatch.setattr("humangs_jax.avatar.reconstruct.reconstruct", reconstructed)
    drawn = lambda avatar, views: held_out.append(views) or SimpleNamespace(images=drawings["ours"](views))
    monkeypatch.setattr("humangs_jax.evaluation.cases.draw_views", drawn)
    monkeypatch.setattr("humangs_jax.evaluation.cases.painted_body", lambda inputs: None)
    monkeypatch.setattr(
        "humangs_jax.evaluation.cases.draw_painted_body", lambda colors, views: drawings["painted"](views)
    )
    page, out, sheet = tmp_path / "page.md", tmp_path / "a.json", tmp_path / "bodies.png"
    page.write_text("<!-- table: evaluation_bodies -->\n<!-- end -->\n")
    options = ("--subjects", 1, "--views", 1, "--weights", weights, "--json", out, "--page", page, *SMALL)
    run(bodies, monkeypatch, *options)
    assert [count for count, _ in seen] == [13380, 13380, 1796, 1796, 3345, 3345, 836, 836]  # once to compile
    assert all(np.array_equal(images, seen[0][1]) for _, images in seen)
    costs = json.loads(out.read_text())["bodies"]
    assert costs["1/16"]["vertices"] == 836 and costs["1/4"]["costs"]["gaussians"] == 3 * 3345
    for kind, name in (("default", "ours"), ("painted default body", "painted")):
        animation = np.asarray(held_out[-1].frames) != 0
        expected = mean_psnr(drawings[name](held_out[-1]), held_out[-1].images, animation)
        assert costs[kind]["animation"]["psnr"] == pytest.approx(expected, abs=1e-4)
    assert page.read_text().count("\n| ") == len(costs) + 2

    seen.clear()
    run(bodies, monkeypatch, *options, "--images", sheet)
    assert len(seen) == 8 and sheet.is_file()  # for the sheet alone


@pytest.mark.slow  # a person made, reconstructed and drawn
def test_the_shipped_weights_beat_the_painted_body(tmp_path, monkeypatch):
    options = ["--subjects", "1", "--held-out", "1", "--poses", "1", "--pose-views", "1", "--size", "128"]
    run(
        synthetic,
        monkeypatch,
        *options,
        "--json",
        tmp_path / "a.json",
        "--plot",
        tmp_path / "plot.png",
    )
    report = json.loads((tmp_path / "a.json").read_text())
    assert report["lpips"] is None and report["lpips_net"] is None and report["subjects"][0]["lpips"] is None
    assert report["psnr"] > report["baseline_psnr"] > 10 and (tmp_path / "plot.png").is_file()
    animation = report["by_views"]["4"]["animation"]
    assert animation["psnr"] > animation["baseline_psnr"]
