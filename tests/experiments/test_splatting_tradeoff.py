"""Measurements of splatting: errors against float64, labels, and the front."""

import numpy as np
import pytest

from experiments import splatting
from experiments.harness import staircase


def test_errors_are_of_the_image_and_of_the_worst_gradient():
    truth = {name: np.ones(4) for name in ("image", *splatting.PARAMETERS)}
    found = truth | {"image": truth["image"] + [0, 0, 0, 0.2], "scales": 1.5 * truth["scales"]}
    assert splatting.differences(found, truth) == {
        "psnr": pytest.approx(20.0),
        "max_abs_error": pytest.approx(0.2),
        "gradient_relative_l2": 0.5,
    }


def test_the_front_holds_what_nothing_beats():
    assert staircase([(1, 100), (0.5, 40), (0.6, 39), (0.8, 60), (0.8, 55), (1.2, 99)]) == [
        (0.5, 40),
        (0.8, 60),
        (1, 100),
    ]
    assert [splatting.short(v) for v in (1 / 64, 0.05, 1e-3, 8, 2.5)] == [
        "1/64",
        "0.05",
        "0.001",
        "8",
        "2.5",
    ]
