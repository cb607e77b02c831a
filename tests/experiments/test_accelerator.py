"""The measurements of an accelerator, rehearsed on this machine at small sizes."""

import json

import pytest

from experiments.accelerator import accelerator
from experiments.harness import call


@pytest.mark.slow
def test_every_stage_runs(tmp_path):
    assert call(accelerator, ["--small", "--json", str(tmp_path / "day.json")]) == 0
    found = json.loads((tmp_path / "day.json").read_text())["rows"]
    assert not [name for name, numbers in found.items() if "failed" in numbers], found
    assert len({name.split(":")[0] for name in found}) == 7
