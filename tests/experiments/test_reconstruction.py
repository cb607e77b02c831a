"""Measurements of reconstruction: counted operations and memory."""

import json

import pytest

from experiments import reconstruction
from experiments.harness import call


@pytest.mark.slow
def test_counts_and_shares(tmp_path):
    out = tmp_path / "out.json"
    shared = [
        "--preset",
        "tiny",
        "--size",
        "256",
        "--repeats",
        "1",
        "--views",
        "2",
        "--json",
        str(out),
    ]
    # fewer vertices than pixels of a map
    assert (
        call(
            reconstruction.reconstruction_benchmark,
            [*shared, "--memory", "1", "2", "--memory-size", "64"],
        )
        == 0
    )
    numbers = json.loads(out.read_text())["numbers"]
    found, memory = numbers["reconstruction_benchmark"], numbers["reconstruction_memory"]
    assert 0 < found["foreground"]["flops"] < found["all"]["flops"]
    assert all(found[name]["over_products"] > 0.5 for name in ("all", "foreground"))
    assert 0.1 < found["foreground_share"] < 0.5
    assert memory["all, 2"]["temporary_mb"] > memory["all, 1"]["temporary_mb"] > 0
