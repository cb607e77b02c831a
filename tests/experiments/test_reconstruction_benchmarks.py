"""The benchmarks of reconstruction, run as a user would: another directory, small sizes."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

REPOSITORY = Path(__file__).parents[2]
EXPERIMENTS = REPOSITORY / "experiments"


def run(script, *arguments, folder):
    command = [sys.executable, str(EXPERIMENTS / f"{script}.py"), *map(str, arguments)]
    result = subprocess.run(command, capture_output=True, text=True, cwd=folder, check=False)
    assert result.returncode == 0, result.stderr
    return result.stdout


@pytest.mark.slow
def test_the_page_is_made_of_what_the_benchmarks_write(tmp_path):
    shared = ("--size", 256, "--repeats", 1)  # fewer vertices than pixels of a map
    options = {
        "benchmark": (
            "reconstruction/benchmark",
            "--preset",
            "tiny",
            *shared,
            "--views",
            2,
            "--stages",
            "--memory",
            1,
            2,
        ),
        "savings": ("reconstruction/savings", "--preset", "tiny", *shared, "--views", 2),
    }
    page = tmp_path / "page.md"
    page.write_text((REPOSITORY / "docs" / "performance.md").read_text())
    for name, (script, *arguments) in options.items():
        size = ("--memory-size", 64) if name == "benchmark" else ()
        out = ("--json", tmp_path / f"{name}.json", "--page", page)
        run(script, *arguments, *size, *out, folder=tmp_path)
    results = {name: json.loads((tmp_path / f"{name}.json").read_text()) for name in options}

    benchmark = results["benchmark"]
    for case in (benchmark["all"], benchmark["foreground"]):
        assert case["flops"] > 0 and 0 < case["share_of_peak"] < 2
        np.testing.assert_allclose(case["share_of_peak"] * case["ratio_to_matmul"], 1)
    assert benchmark["foreground"]["flops"] < benchmark["all"]["flops"] < benchmark["published_flops"]
    assert 0.1 < benchmark["foreground_share"] < 0.5
    speed_up = benchmark["speed_up"]
    np.testing.assert_allclose(speed_up["fraction"], speed_up["measured"] / speed_up["promised"])
    assert benchmark["memory"]["all"]["2"]["temporary_mb"] > benchmark["memory"]["all"]["1"]["temporary_mb"] > 0

    rows = results["savings"]["rows"]
    exact = rows["last convolution where read"], rows["only views that see the vertex"]
    assert all(row["offsets_relative_l2"] < 1e-5 and row["psnr"] > 80 for row in exact)
    assert rows["foreground tokens"]["flops"] < exact[0]["flops"] < rows["as published"]["flops"]

    assert "tiny, 2 views of 256" in page.read_text()
