import json

import pytest

from humangs_jax.body.library import load_body
from humangs_jax.synthetic import sources
from humangs_jax.training import ablation
from humangs_jax.training.ablation import Ablation, ablate
from humangs_jax.training.config import Phase
from humangs_jax.training.forward import as_validated
from humangs_jax.training.sources import captured_people

CLASS_TOKEN = "model.architecture.encoder.transformer.class_token"
WITHOUT = {"no class token": {CLASS_TOKEN: False}}


@pytest.fixture
def trained(monkeypatch, tmp_path):
    """Replaces training; returns the list of the runs that were asked for.

    The score of a run is its seed, and 1 more without the class token and for seed 2.
    """
    runs = []

    def stand_in(config, body, people, folder, **how):
        runs.append((folder.parent.name, config.seed))
        token = config.model.architecture.encoder.transformer.class_token
        folder.mkdir(parents=True, exist_ok=True)
        score = config.seed + (not token) * (1.0 + (config.seed == 2))
        (folder / "log.jsonl").write_text(json.dumps({"step": config.steps, "val_psnr_fg": score}))

    monkeypatch.setattr(ablation, "train", stand_in)
    return runs


class Nobody:
    """A source without examples."""

    input_counts, broken = (2,), {}

    def __len__(self):
        return 0

    def example(self, seed, index, input_count):
        raise AssertionError("not asked for")

    def describe(self, seed, index, input_count):
        return "nobody"


def run(tmp_path, **how):
    nobody = how.pop("people", [])
    return ablate(
        how.pop("base", "tiny"),
        how.pop("variants", WITHOUT),
        out=tmp_path,
        people=nobody,
        **how,
        progress=False,
    )


def test_differences_are_paired_by_seed(trained, tmp_path):
    result = run(tmp_path, validation=[], seeds=3)
    assert trained == [(name, seed) for seed in range(3) for name in ("base", "no_class_token")]
    base, without = result.rows
    assert (base.mean, without.mean, without.difference) == (
        1.0,
        pytest.approx(7 / 3),
        pytest.approx(4 / 3),
    )
    # differences 1, 1, 2: deviation 0.577, t(0.975; 2) = 4.303
    assert (
        without.interval == pytest.approx(4.3027 * 0.57735 / 3**0.5, rel=1e-4) and not without.clear
    )
    assert "+1.33  +-1.43, unclear" in str(result)


@pytest.mark.parametrize(
    "scores", [{"base": {0: 1.0}, "a": {}}, {"base": {}, "a": {}}, {"base": {}, "a": {0: 2.0}}]
)
def test_a_plot_without_a_difference_says_so_and_has_no_axis(scores):
    pytest.importorskip("matplotlib")
    figure = Ablation("psnr", scores).plot()
    assert not figure.axes and figure.texts[0].get_text().startswith("no variant finished")


def test_variants_of_like_names_have_folders_of_their_own_inside_of_out(trained, tmp_path):
    names = ("a b", "a_b", "A_B", "..", ".", "a/../../b", "x" * 300)
    run(
        tmp_path / "out",
        validation=[],
        seeds=1,
        variants={name: {"loss.squared": 0.5} for name in names},
    )
    folders = {folder for folder, _ in trained}
    assert (
        len({folder.lower() for folder in folders}) == len(names) + 1 and {"base", "a_b"} <= folders
    )
    assert [path.name for path in tmp_path.iterdir()] == ["out"]
    assert {path.name for path in (tmp_path / "out").iterdir()} == folders


def test_all_variants_are_compared_on_the_photos_and_targets_of_the_base(
    trained, tmp_path, monkeypatch
):
    asked, validated = [], []
    stand_in = ablation.train

    def watched(config, body, people, folder, *, validation, validated: int, **how):
        validation(as_validated(config))
        asked.append((config.model.conventions.image_size, validated))
        stand_in(config, body, people, folder, **how)

    monkeypatch.setattr(ablation, "train", watched)
    larger = {
        "model.conventions.image_size": 64,
        "views.input_counts": (1, 3),
        "views.target_count": 5,
        "steps": 80,
    }

    def make(config):
        validated.append(config)
        return Nobody()

    run(tmp_path, validation=make, seeds=1, variants={"larger": larger})
    base, other = validated[-2:]  # before, all of them are looked at without a photo
    assert asked == [(32, 8), (64, 8)]  # the photos that a network reads have its size
    assert [config.model.conventions.image_size for config in validated[-2:]] == [32, 64]
    assert other.views == base.views and other.target_size == base.target_size == 32
    assert base.views.input_counts == (2,) and base.views.target_count == 2


def test_each_of_the_people_to_compare_on_is_looked_at(trained, tmp_path, monkeypatch):
    counts, made = [], []

    def people(count, body, split, size, each_once):
        made.append((count, each_once))
        return lambda config: Nobody()

    monkeypatch.setattr(sources, "people_of_split", people)
    stand_in = ablation.train

    def watched(*arguments, validated, **how):
        counts.append(validated)
        stand_in(*arguments, **how)

    monkeypatch.setattr(ablation, "train", watched)
    run(tmp_path / "a", validation=20, seeds=1, variants={})
    monkeypatch.setattr(ablation, "_check_people", lambda *_: None)
    run(tmp_path / "b", validation=["one", "two", "three"], seeds=1, variants={})
    assert counts == [20, 3] and made == [(20, True)]


def test_one_seed_has_no_interval():
    row = Ablation("psnr", {"base": {0: 20.0}, "a": {0: 21.0}}).rows[1]
    assert (row.difference, row.interval, row.clear) == (1.0, None, False)


@pytest.mark.parametrize(
    ("how", "problem"),
    [
        ({"variants": {"base": {}}}, "'base': is the name"),
        ({"variants": {"a": {"model.depth": 1}}}, "model.depth: TrainConfig has no such field"),
        ({"seeds": 0}, "seeds 0: expected at least 1"),
        ({"metric": "mse"}, "'mse': is none of validation: psnr_fg"),
        ({"metric": "lpips"}, "'lpips': is none of validation: psnr_fg"),
        ({"variants": {"a": {"seed": 5}}}, "'a': seed: all variants have the seeds 0, 1"),
        (
            {"variants": {"a": {}, "b": {"loss.lpips": 0.1}}},
            "'b': loss.lpips: expected its network in networks",
        ),
        (
            {"variants": {"a": {"model.architecture.encoder.transformer.head_width": 7}}},
            "'a': width 16 is not a multiple of head_width 7",
        ),
        ({"variants": {"a": {"model.architecture.reader.sample_rgb": False}}}, "'a': "),
    ],
)
def test_what_cannot_be_meant_is_refused_before_the_first_run(how, problem, trained, tmp_path):
    with pytest.raises(ValueError, match=problem):
        run(tmp_path, validation=[], **how)
    assert trained == [] and not any(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("changes", "problem"),
    [
        ({"target_size": 1024}, "512 x 512 cannot be averaged to 1024 x 1024"),
        ({"model.conventions.image_size": 1024}, "512 x 512 cannot be averaged to 1024 x 1024"),
        ({"views.target_count": 9}, "4 views, but inputs and targets need 11"),
        (
            {"stages": (Phase(start=2, target_size=1024),)},
            "512 x 512 cannot be averaged to 1024 x 1024",
        ),
    ],
)
@pytest.mark.parametrize("kind", ["folders", "a source"])
def test_photos_and_views_that_the_captures_lack_are_found_before_the_first_step(
    changes, problem, kind, trained, tmp_path, capture_folder
):
    people = [capture_folder]
    if kind == "a source":
        people = captured_people(people, load_body())
    variants = {"usual": {}, "too large": changes}
    with pytest.raises(ValueError, match=f"'too large': 1 of the people cannot be used.*{problem}"):
        run(tmp_path, people=people, validation=[], seeds=1, variants=variants)
    if changes.keys() & {"target_size", "stages", "views.target_count"}:
        return  # targets to compare on are those of the base
    with pytest.raises(ValueError, match=f"'too large': 1 of the people cannot be used.*{problem}"):
        run(tmp_path, validation=people, seeds=1, variants=variants)
    assert trained == [] and not any(tmp_path.iterdir())


@pytest.mark.slow
def test_two_tiny_runs_are_compared(tmp_path):
    from humangs_jax.core.configuration import vary
    from humangs_jax.training.config import read_config

    base = vary(read_config("tiny"), {"steps": 4})
    result = run(tmp_path, base=base, people=2, validation=1, seeds=1)
    assert [row.name for row in result.rows] == ["base", "no class token"]
    assert all(5 < row.mean < 40 for row in result.rows)
    assert result.plot().axes[0].get_yticklabels()[0].get_text() == "no class token"
