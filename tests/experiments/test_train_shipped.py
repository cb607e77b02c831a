"""The commands that train the shipped weights."""

import typing
from pathlib import Path

import jax
import numpy as np
import pytest
import tyro

from experiments import train_shipped
from humangs_jax.network.presets import tiny
from humangs_jax.network.weights import expected_variables, load_weights, save_weights
from humangs_jax.training.config import tiny as tiny_run

HALF_PRECISION = 2**-11
"""Relative rounding: the file has float16."""


@pytest.mark.parametrize(
    ("given", "expected"), [("shipped", "shipped"), ("old.safetensors", Path("old.safetensors"))]
)
def test_the_shipped_weights_have_a_name(given, expected):
    wanted = typing.get_type_hints(train_shipped.main)["init_weights"]

    def command(init_weights: wanted = None):
        return init_weights

    assert tyro.cli(command, args=["--init-weights", given]) == expected


@pytest.mark.slow
def test_the_mean_of_the_first_and_the_trained_weights(tmp_path):
    random = np.random.default_rng(0)
    first, last = (
        jax.tree.map(lambda x: random.normal(size=x.shape), expected_variables(tiny()))
        for _ in range(2)
    )
    save_weights(tmp_path / "weights.safetensors", last, tiny())
    train_shipped.write_mean(tmp_path, first, 0.25)
    mean, model = load_weights(tmp_path / "mean.safetensors")
    assert model.conventions == tiny().conventions
    expected = jax.tree.map(lambda a, b: 0.25 * np.asarray(a) + 0.75 * np.asarray(b), first, last)
    jax.tree.map(lambda x, y: np.testing.assert_allclose(x, y, HALF_PRECISION), mean, expected)


def test_wrong_first_weights_are_an_error(tmp_path):
    with pytest.raises(ValueError, match=r"start_share 0.5: expected .* init_weights"):
        train_shipped.main(tmp_path, start_share=0.5)
    with pytest.raises(ValueError, match="shipped: tensor"):
        train_shipped.main(tmp_path, init_weights="shipped", config=tiny_run())
