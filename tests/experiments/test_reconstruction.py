"""Measurements of reconstruction: counted operations, memory, and what savings change."""

import json

import numpy as np
import pytest

from experiments import reconstruction
from experiments.harness import call


@pytest.mark.slow
def test_counts_shares_and_savings(tmp_path):
    out = tmp_path / "out.json"
    shared = ["--preset", "tiny", "--size", "256", "--repeats", "1", "--views", "2", "--json", str(out)]
    # fewer vertices than pixels of a map
    assert call(reconstruction.reconstruction_benchmark, [*shared, "--memory", "1", "2", "--memory-size", "64"]) == 0
    numbers = json.loads(out.read_text())["numbers"]
    found, memory = numbers["reconstruction_benchmark"], numbers["reconstruction_memory"]
    assert 0 < found["foreground"]["flops"] < found["all"]["flops"] < found["published_flops"]
    assert all(0 < found[name]["share_of_peak"] < 2 for name in ("all", "foreground"))
    assert 0.1 < found["foreground_share"] < 0.5
    gain = found["speed_up"]
    np.testing.assert_allclose(gain["fraction"], gain["measured"] / gain["promised"])
    assert memory["all"][1]["temporary_mb"] > memory["all"][0]["temporary_mb"] > 0

    assert call(reconstruction.reconstruction_savings, shared) == 0
    rows = json.loads(out.read_text())["numbers"]["reconstruction_savings"]["rows"]
    exact = rows["last convolution where read"], rows["only views that see the vertex"]
    assert all(row["offsets_relative_l2"] < 1e-5 and row["psnr"] > 80 for row in exact)
    assert rows["foreground tokens"]["flops"] < exact[0]["flops"] < rows["as published"]["flops"]
