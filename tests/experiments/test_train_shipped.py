"""The command that trains the shipped weights."""

import typing
from pathlib import Path

import pytest
import tyro

from experiments.training import train_shipped


@pytest.mark.parametrize(("given", "expected"), [("shipped", "shipped"), ("old.safetensors", Path("old.safetensors"))])
def test_the_shipped_weights_have_a_name(given, expected):
    wanted = typing.get_type_hints(train_shipped.main)["init_weights"]

    def command(init_weights: wanted = None):
        return init_weights

    assert tyro.cli(command, args=["--init-weights", given]) == expected
