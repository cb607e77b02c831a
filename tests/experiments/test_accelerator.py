"""The day on an accelerator, rehearsed on this machine at tiny sizes."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from experiments.accelerator.run_all import STAGES, fastest_batch

SCRIPT = Path(__file__).parents[2] / "experiments" / "accelerator" / "run_all.py"
LIMIT = 16 * 2**20
"""Bytes of each of at most eight files that come back."""


@pytest.mark.slow
def test_every_stage_runs_and_leaves_few_small_files(tmp_path):
    command = [sys.executable, str(SCRIPT), "--out", str(tmp_path / "out"), "--tiny", "--minutes", "60"]
    environment = os.environ | {"JAX_DISABLE_MOST_OPTIMIZATIONS": "0"}
    done = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path, env=environment, check=False)
    assert done.returncode == 0, done.stderr
    results = {stage: json.loads((tmp_path / "out" / f"{stage}.json").read_text()) for stage in STAGES}
    for stage, found in results.items():
        measured = {name: numbers for name, numbers in found.items() if isinstance(numbers, dict)}
        assert measured and not [name for name, numbers in measured.items() if "failed" in numbers], (stage, found)
    assert results["check"]["resumed run"]["bitwise"]
    files = list((tmp_path / "out").iterdir())
    assert len(files) <= 8 and max(file.stat().st_size for file in files) <= LIMIT


def test_the_fastest_batch_that_ran_is_taken(tmp_path):
    path = tmp_path / "batch.json"
    assert fastest_batch(path) == 1
    rows = {
        "batch 1": {"subjects a second": 2.0},
        "batch 8": {"subjects a second": 9.0},
        "batch 16": {"failed": "memory"},
    }
    path.write_text(json.dumps({"device": "x", "jax": "y"} | rows))
    assert fastest_batch(path) == 8
