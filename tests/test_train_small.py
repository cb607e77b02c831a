"""The command that trains the shipped weights."""

import importlib
import sys
import typing
from pathlib import Path

import pytest
import tyro

EXPERIMENTS = Path(__file__).parents[1] / "experiments"


@pytest.mark.parametrize(("given", "expected"), [("shipped", "shipped"), ("old.safetensors", Path("old.safetensors"))])
def test_the_shipped_weights_have_a_name(given, expected, monkeypatch):
    monkeypatch.setattr(sys, "path", [str(EXPERIMENTS), *sys.path])
    wanted = typing.get_type_hints(importlib.import_module("train_small").main)["init_weights"]

    def command(init_weights: wanted = None):
        return init_weights

    assert tyro.cli(command, args=["--init-weights", given]) == expected
