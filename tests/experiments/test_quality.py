"""Quality of reconstructions: every number is that of the images that were drawn; rows, tables and verdicts.

The network is `tiny` with variables of zero; for bodies of other sizes its avatars are made up.
"""

import json
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from evaluation_cases import capture_from, random_lpips

from experiments import appearance, bodies, harness, pictures, quality, subjects
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
    assert found["novel"]["psnr"] == pytest.approx(mean_psnr(drawn + 0.5, truth, frames == 0), abs=1e-4)
    assert found["animation"]["psnr"] == pytest.approx(mean_psnr(drawn + 0.5, truth, frames == 1), abs=1e-4)
    assert found["novel"]["lpips"] is None
    weights = random_lpips("alex")
    found = subjects.score_tasks(drawn + 0.5, held_out, weights)["animation"]["lpips"]
    expected = jax.jit(lpips)(weights, np.clip(drawn[2] + 0.5, 0, 1), truth[2])
    assert found == pytest.approx(float(expected), rel=1e-5) and found > 0


@pytest.mark.parametrize("function", [quality.evaluation_views, bodies.evaluation_bodies])
def test_wrong_options_are_one_line(function, tmp_path, capsys):
    (tmp_path / "a.pth").write_bytes(b"something")
    wrong = {
        "a.pth": (["--lpips-backbone", tmp_path / "a.pth"], ["--lpips-heads", tmp_path / "a.pth"]),
        "--views": (["--views", "5"],),
        "--subjects": (["--subjects", "0"],),
        "reach beyond": (["--first", "999999"],),
    }
    for said, cases in wrong.items():
        for options in cases:
            with pytest.raises(SystemExit) as exit_:
                run(function, *options)
            assert exit_.value.code == 2 and said in capsys.readouterr().err.splitlines()[-1]


def mean_psnr(drawn, truth, chosen):
    """Mean over the chosen views, by the formula."""
    errors = (np.clip(drawn, 0, 1) - truth).astype(np.float64)[chosen] ** 2
    return np.mean(-10 * np.log10(errors.mean(axis=(1, 2, 3))))


@pytest.mark.slow
def test_a_person_is_made_once_and_rows_are_kept(weights, tmp_path, monkeypatch):
    """People, reconstruction and drawing are real; every reported number is that of the images that were drawn."""
    made, drawn, expected = [], [], {}
    make, draw = quality.make_evaluation_subject, quality.draw_person

    def observed(variables, config, subject, count):
        drawn.append((subject.seed, count))
        images, truth = draw(variables, config, subject, count), subject.held_out
        for task, chosen in (("novel", truth.frames == 0), ("animation", truth.frames != 0)):
            expected[subject.seed, count, task] = [
                mean_psnr(x, truth.images, np.asarray(chosen)) for x in (images.ours, images.painted)
            ]
        return images

    monkeypatch.setattr(quality, "make_evaluation_subject", lambda *a: made.append(a[0]) or make(*a))
    monkeypatch.setattr(quality, "draw_person", observed)
    out, sheet = tmp_path / "a.json", tmp_path / "sheet.png"
    options = ("--weights", weights, "--json", out, *SMALL)
    first, second = 2_000_000, 2_000_001
    run(quality.evaluation_views, "--subjects", 2, "--views", 1, *options)
    assert made == [first, second] and drawn == [(first, 1), (second, 1)]
    numbers = lambda: json.loads(out.read_text())["numbers"]["evaluation_views"]
    assert numbers()["views"] == 1 and numbers()["by_views"]["1"]["novel"]["lpips"] is None

    made.clear(), drawn.clear()
    run(quality.evaluation_views, "--subjects", 2, "--views", 2, 1, *options, "--images", sheet)
    assert made == [first, second] and drawn == [(first, 2), (second, 2)]  # the rows of one photo are kept
    assert numbers()["views"] == 2 and numbers()["people"] == 2
    for count in (1, 2):
        for task in ("novel", "animation"):
            row = numbers()["by_views"][str(count)][task]
            ours, painted = np.mean([expected[seed, count, task] for seed in (first, second)], axis=0)
            assert row["psnr"] == pytest.approx(ours, abs=1e-4)
            assert row["baseline_psnr"] == pytest.approx(painted, abs=1e-4)

    made.clear(), drawn.clear()
    sheet.unlink()
    run(quality.evaluation_views, "--subjects", 1, "--views", 2, *options, "--images", sheet)
    assert drawn == [(first, 2)] and sheet.is_file()  # for its sheet alone


@pytest.mark.slow
def test_bodies_see_the_same_photos(weights, tmp_path, monkeypatch):
    seen, held_out = [], []
    drawings = {"ours": lambda views: np.clip(views.images + 0.1, 0, 1), "painted": lambda views: 0.5 * views.images}

    def reconstructed(variables, config, capture):
        assert config.conventions.body_vertices is None and config.conventions.longest_edge is None
        seen.append((len(capture.body.template), capture.images))
        return SimpleNamespace(gaussians=SimpleNamespace(means=np.zeros((3 * len(capture.body.template), 3))))

    drawn = lambda avatar, views: held_out.append(views) or SimpleNamespace(images=drawings["ours"](views))
    for name, fake in {
        "SMPLX_SEED_VERTICES": 600,
        "reconstruct": reconstructed,
        "draw_views": drawn,
        "painted_body": lambda inputs: None,
        "draw_painted_body": lambda colors, views: drawings["painted"](views),
    }.items():
        monkeypatch.setattr(bodies, name, fake)
    out = tmp_path / "a.json"
    run(bodies.evaluation_bodies, "--subjects", 1, "--views", 1, "--weights", weights, "--json", out, *SMALL)
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
    options = ("--subjects", 1, "--held-out", 1, "--poses", 1, "--pose-views", 1, "--size", 128, "--views", 4)
    out, plot = tmp_path / "a.json", tmp_path / "plot.png"
    run(quality.evaluation_views, *options, "--json", out)
    tasks = json.loads(out.read_text())["numbers"]["evaluation_views"]["by_views"]["4"]
    quality.plot_views(plot, {4: tasks})
    assert plot.is_file() and tasks["novel"]["lpips"] is None and tasks["novel"]["baseline_psnr"] > 10
    assert all(scores["psnr"] > scores["baseline_psnr"] for scores in tasks.values())


# Tables --------------------------------------------------------------------------------------------------------------


def people(**psnrs):
    """Scores by number of photos and seed; seeds count from 1."""
    base = {"ssim": 0.9, "lpips": None, "baseline_ssim": 0.8, "baseline_psnr_fg": 9.0, "baseline_psnr": 15.0}
    scores = lambda psnr: base | {"psnr": psnr, "psnr_fg": psnr - 6, "baseline_lpips": None}
    rows = lambda values: {seed: {"novel": scores(x), "animation": scores(x - 1)} for seed, x in enumerate(values, 1)}
    return {int(count[1:]): rows(values) for count, values in psnrs.items()}


def test_the_best_and_the_worst_are_different_people():
    extremes = lambda values: quality.extremes(people(v4=values)[4])
    assert extremes([20 + i for i in range(13)]) == ([13, 12, 11, 10, 9], [1, 2, 3, 4, 5])
    assert extremes([3, 6, 4]) == ([2], [1]) and extremes([3]) == ([1], [])


def test_it_is_told_where_more_photos_are_worse():
    said = quality.verdict(people(v1=[20], v2=[21], v4=[22]), 4, "novel")
    assert "never worse" in said and "1 of 1 people" in said
    said = quality.verdict(people(v1=[20], v2=[19.5], v4=[14]), 4, "animation")
    assert "by 0.50 dB from 1 to 2" in said and "by 5.50 dB from 2 to 4" in said and "0 of 1 people" in said


def test_the_section_has_means():
    section = quality.views_section(people(v1=[21, 22], v4=[25, 26]), 4, "about")
    assert "| novel poses | 4 | 24.50 | 0.900 | 18.50 | 15.00 | 0.800 | 9.00 |" in section
    assert "LPIPS" not in section


# What eyes see ------------------------------------------------------------------------------------------------------------


def pictures_of(people):
    """Details of a person: the truth white, those of "before" dark, those of "now" light."""
    shade = lambda value: np.full((len(pictures.DETAILS), pictures.DETAIL_PIXELS, pictures.DETAIL_PIXELS, 3), value)
    return {str(person): [shade(1.0), shade(0.2), shade(0.8)] for person in range(people)}


def test_the_key_of_a_blind_comparison_names_what_is_shown():
    tiles, key = appearance.shuffled(pictures_of(8), ("before", "now"))
    assert len(tiles) == 3 * len(key) == 3 * 8 * len(appearance.JUDGED)
    for i, pair in enumerate(key):
        shades = [float(tile.mean()) for tile in tiles[3 * i : 3 * i + 3]]
        assert shades == pytest.approx([1.0, *({"before": 0.2, "now": 0.8}[pair[letter]] for letter in "AB")])
    assert {pair["A"] for pair in key} == {"before", "now"}
    assert len({(pair["person"], pair["detail"]) for pair in key}) == len(key)


def test_votes_are_counted_for_what_was_shown(tmp_path, capsys):
    appearance.write_pairs(tmp_path / "pairs", pictures_of(4), ("before", "now"))
    key = json.loads((tmp_path / "pairs" / "key.json").read_text())
    for_now = ["A" if pair["A"] == "now" else "B" for pair in key]
    (tmp_path / "votes.txt").write_text(" ".join(["=", *for_now[1:]]))
    run(appearance.appearance_votes, tmp_path / "pairs", tmp_path / "votes.txt")
    assert f"| all | 0 | {len(key) - 1} | 1 |" in capsys.readouterr().out
    (tmp_path / "votes.txt").write_text("A B")
    with pytest.raises(SystemExit):
        run(appearance.appearance_votes, tmp_path / "pairs", tmp_path / "votes.txt")
    assert f"expected A, B or = for each of {len(key)} pairs" in capsys.readouterr().err


def test_loosest_and_worst_people_are_listed_apart():
    rows = [{"512 0 novel": {"before": {"psnr_fg": float(i)}}, "loose": -float(i)} for i in range(12)]
    groups = appearance.groups_of(rows, "before")
    assert groups == {"all": rows, "10 loosest": rows[:10], "5 worst": rows[:5]}
    assert list(appearance.groups_of(rows[:10], "before")) == ["all"]


def test_a_body_that_is_off_is_off_by_the_same_in_all_poses():
    poses = jax.vmap(BodyPose)(jnp.zeros((3, 4, 3)), jnp.zeros((3, 3)))
    moved, betas = body_off(poses, jnp.zeros(5), 5.0, seed=1)
    for array in (moved.rotations, moved.translation):
        np.testing.assert_array_equal(array[0], array[2])
        assert np.asarray(array).any()
    assert np.asarray(betas).any() and not np.asarray(body_off(poses, jnp.zeros(5), 0.0, seed=1)[1]).any()


def test_logits_of_a_decoder_change_as_said():
    rng = np.random.default_rng(0)
    layer = {"kernel": jnp.asarray(rng.normal(size=(3, 8))), "bias": jnp.asarray(rng.normal(size=8))}
    variables = {"params": {"decoder": {"out": layer, "other": layer}, "encoder": {}}}
    found = appearance.changed(variables, "out", slice(3, None, 4), 2.0, -0.5)["params"]
    hidden, chosen = rng.normal(size=(5, 3)), np.arange(8) % 4 == 3
    logits = lambda layer: np.asarray(hidden @ layer["kernel"] + layer["bias"])
    before, after = logits(layer), logits(found["decoder"]["out"])
    np.testing.assert_allclose(after[:, chosen], 2 * before[:, chosen] - 0.5, atol=1e-5)
    np.testing.assert_array_equal(after[:, ~chosen], before[:, ~chosen])
    assert found["decoder"]["other"] is layer
