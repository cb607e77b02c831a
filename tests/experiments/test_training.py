"""Training's measurements: what a step costs, what becomes of extremes."""

import json

import pytest

from experiments import training, training_checks
from experiments.harness import call


@pytest.mark.slow
def test_the_share_of_the_floor_is_one(tmp_path):
    assert call(training.training_steps, ["--only", "tiny 32", "--repeats", "1", "--json", str(tmp_path / "a")]) == 0
    (row,) = json.loads((tmp_path / "a").read_text())["rows"].values()
    assert row["flops"] > 0 and 0 < row["share_of_floor"] < 1 and row["losses"]["skipped"] == 0
    assert row["losses"]["overflow"] == 0


@pytest.mark.slow
def test_training_at_the_extremes(tmp_path):
    plain, white, half = training_checks.PLAIN, "an all-white photo in every batch", "float16 compute"
    options = ["--only", plain, white, half, "--steps", "4", "--json", str(tmp_path / "a")]
    assert call(training_checks.training_extremes, options) == 0
    results = json.loads((tmp_path / "a").read_text())["rows"]
    assert set(results) == {plain, white, half} and "float16: gradients underflow" in results[half]["error"]
    for name in (plain, white):
        row = results[name]
        assert row["steps"] == 4 and row["skipped"] == row["nonfinite"] == 0 and 0 < row["loss"] < 1
