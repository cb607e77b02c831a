import json

import pytest

from humangs_jax.training import ablation
from humangs_jax.training.ablation import Ablation, ablate

CLASS_TOKEN = "model.architecture.encoder.transformer.class_token"
WITHOUT = {"no class token": {CLASS_TOKEN: False}}


@pytest.fixture
def trained(monkeypatch, tmp_path):
    """The runs that were asked for; the score of one is its seed, and 1 more without the class token and for seed 2."""
    runs = []

    def stand_in(config, body, people, folder, **how):
        runs.append((folder.parent.name, config.seed))
        token = config.model.architecture.encoder.transformer.class_token
        folder.mkdir(parents=True, exist_ok=True)
        score = config.seed + (not token) * (1.0 + (config.seed == 2))
        (folder / "log.jsonl").write_text(json.dumps({"step": config.steps, "val_psnr_fg": score}))

    monkeypatch.setattr(ablation, "train", stand_in)
    return runs


def run(tmp_path, **how):
    nobody = how.pop("people", [])
    return ablate(how.pop("base", "tiny"), how.pop("variants", WITHOUT), out=tmp_path, people=nobody, **how, progress=False)


def test_differences_are_paired_by_seed(trained, tmp_path):
    result = run(tmp_path, validation=[], seeds=3)
    assert trained == [(name, seed) for seed in range(3) for name in ("base", "no_class_token")]
    base, without = result.rows
    assert (base.mean, without.mean, without.difference) == (1.0, pytest.approx(7 / 3), pytest.approx(4 / 3))
    # differences 1, 1, 2: deviation 0.577, t(0.975; 2) = 4.303
    assert without.interval == pytest.approx(4.3027 * 0.57735 / 3**0.5, rel=1e-4) and not without.clear
    assert "+1.33  +-1.43, unclear" in str(result)


def test_a_budget_ends_before_a_run_and_a_later_call_goes_on(trained, tmp_path, monkeypatch):
    times = iter(range(0, 10_000, 40))
    monkeypatch.setattr(ablation.time, "monotonic", lambda: float(next(times)))
    result = run(tmp_path, validation=[], seeds=2, budget="2min")
    assert trained == [("base", 0)] and result.missing == 3
    assert str(result).endswith("3 runs are missing: the budget was used up")
    assert run(tmp_path, validation=[], seeds=2).missing == 0


def test_one_seed_has_no_interval():
    row = Ablation("psnr", {"base": {0: 20.0}, "a": {0: 21.0}}).rows[1]
    assert (row.difference, row.interval, row.clear) == (1.0, None, False)


@pytest.mark.parametrize(
    ("how", "said"),
    [
        ({"variants": {"base": {}}}, "'base': is the name"),
        ({"variants": {"a": {"model.depth": 1}}}, "model.depth: TrainConfig has no such field"),
        ({"seeds": 0}, "seeds 0: expected at least 1"),
        ({"budget": "soon"}, "budget 'soon': expected a time"),
        ({"metric": "mse"}, "'mse': is none of validation: psnr_fg"),
    ],
)
def test_what_cannot_be_meant_is_refused(how, said, trained, tmp_path):
    with pytest.raises(ValueError, match=said):
        run(tmp_path, validation=[], **how)


@pytest.mark.slow
def test_two_tiny_runs_are_compared(tmp_path):
    from humangs_jax.core.configuration import vary
    from humangs_jax.training.config import read_config

    base = vary(read_config("tiny"), {"steps": 4})
    result = run(tmp_path, base=base, people=2, validation=1, seeds=1)
    assert [row.name for row in result.rows] == ["base", "no class token"] and result.missing == 0
    assert all(5 < row.mean < 40 for row in result.rows)
    assert result.plot().axes[0].get_yticklabels()[0].get_text() == "no class token"
