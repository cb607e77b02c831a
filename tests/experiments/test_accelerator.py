"""The day on an accelerator, rehearsed on this machine at tiny sizes."""

import json

import pytest

from experiments.accelerator import accelerator, fastest_batch
from experiments.harness import call

LIMIT = 16 * 2**20
"""Bytes of each of at most eight files that come back."""


@pytest.mark.slow
def test_every_stage_runs_and_leaves_few_small_files(tmp_path):
    out = tmp_path / "out"
    assert call(accelerator, ["--out", str(out), "--tiny", "--minutes", "60", "--json", str(out / "day.json")]) == 0
    found = json.loads((out / "day.json").read_text())["rows"]
    assert not [name for name, numbers in found.items() if "failed" in numbers], found
    assert len({name.split(":")[0] for name in found}) == 6 and found["check: resumed run"]["bitwise"]
    files = list(out.iterdir())
    assert len(files) <= 8 and max(file.stat().st_size for file in files) <= LIMIT


def test_the_fastest_batch_that_ran_is_taken():
    assert fastest_batch({}) == 1
    speeds = {"batch: batch 1": {"subjects a second": 2.0}, "batch: batch 8": {"subjects a second": 9.0}}
    assert fastest_batch(speeds | {"batch: batch 16": {"failed": "memory"}}) == 8
