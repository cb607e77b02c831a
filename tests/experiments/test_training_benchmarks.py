"""The benchmarks of training: pages from what the scripts measure."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from experiments.training import extremes

REPOSITORY = Path(__file__).parents[2]
EXPERIMENTS = REPOSITORY / "experiments"


@pytest.fixture
def page(tmp_path):
    """A copy of a page to write into."""

    def copied(name):
        path = tmp_path / name
        path.write_text((REPOSITORY / "docs" / name).read_text())
        return path

    return copied


@pytest.mark.slow
def test_the_page_is_made_of_what_the_benchmark_writes(tmp_path, page):
    numbers, path = tmp_path / "numbers.json", page("performance.md")
    command = [sys.executable, str(EXPERIMENTS / "training" / "benchmark.py"), "--json", str(numbers)]
    options = ["--only", "tiny 32", "--repeats", "1"]
    subprocess.run([*command, *options], check=True, cwd=tmp_path)
    (row,) = json.loads(numbers.read_text()).values()
    assert row["flops"] > 0 and 0 < row["share_of_floor"] < 1 and row["losses"]["skipped"] == 0
    assert row["losses"]["overflow"] == 0

    subprocess.run([*command, "--page", str(path)], check=True, cwd=tmp_path)
    assert "tiny 32, 2 + 2 views" in path.read_text()


@pytest.mark.slow
def test_training_at_the_extremes():
    results = extremes.measure(quick=True)
    assert tuple(results) == tuple(name for name in extremes.runs() if name in extremes.QUICK)
    assert "float16: gradients underflow" in results["float16 compute"]["error"]
    for name in (extremes.PLAIN, "an all-white photo in every batch"):
        row = results[name]
        assert row["steps"] == 4 and row["skipped"] == row["nonfinite"] == 0 and 0 < row["loss"] < 1
    assert extremes.section(results).count("\n") == 1 + len(results)
