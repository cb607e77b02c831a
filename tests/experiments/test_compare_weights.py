"""Weights side by side."""

import pytest

from experiments.evaluation.compare_weights import compare, section

SCORES = {"psnr": 25.0, "psnr_fg": 18.0, "ssim": 0.9, "semi_transparent": 0.1}


def result(gain=0.0, seed=3):
    scores = {task: SCORES | {"psnr": SCORES["psnr"] + gain} for task in ("novel", "animation")}
    means = {"256 4 network": {"0": scores, "5": scores | {"least_gain": 0.5}}}
    return {"settings": {"weights": f"sha {gain}", "split": "test"}, "subjects": [{"seed": seed}], "means": means}


def test_means_stand_side_by_side():
    means = compare({"a": result(), "b": result(1.5)})
    assert means["a"]["0"]["novel"] == SCORES and means["b"]["5"]["animation"]["psnr"] == 26.5
    assert "| b | 5 | 26.50 | 18.00 | 0.9000 | 0.100 | 26.50 |" in section(means)


def test_other_people_are_an_error():
    with pytest.raises(ValueError, match="b: expected the people and settings of a"):
        compare({"a": result(), "b": result(seed=4)})


def test_results_of_several_starts_are_an_error():
    several = result()
    several["means"]["512 4 network"] = several["means"]["256 4 network"]
    with pytest.raises(ValueError, match="a: expected one size"):
        compare({"a": several})
