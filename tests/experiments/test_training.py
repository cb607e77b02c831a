"""Training's measurements: what a step costs."""

import json

import pytest

from experiments import training
from experiments.harness import call


@pytest.mark.slow
def test_the_share_of_the_floor_is_one(tmp_path):
    assert (
        call(
            training.training_steps,
            ["--only", "tiny 32", "--repeats", "1", "--json", str(tmp_path / "a")],
        )
        == 0
    )
    (row,) = json.loads((tmp_path / "a").read_text())["rows"].values()
    assert row["flops"] > 0 and 0 < row["share_of_floor"] < 1 and row["losses"]["skipped"] == 0
    assert row["losses"]["overflow"] == 0
