"""The benchmarks and the cost page of training: traffic between devices counted, pages from what the scripts measure."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from experiments.accelerator import training_cost
from experiments.training import extremes

REPOSITORY = Path(__file__).parents[2]
EXPERIMENTS = REPOSITORY / "experiments"

PROGRAM = """HloModule step, is_scheduled=true

%body (state: (s32[], f32[64,8])) -> (s32[], f32[64,8]) {
  %state = (s32[], f32[64,8]{1,0}) parameter(0)
  %i = s32[] get-tuple-element((s32[], f32[64,8]) %state), index=0
  %one = s32[] constant(1)
  %next = s32[] add(s32[] %i, s32[] %one)
  %x = f32[64,8]{1,0} get-tuple-element((s32[], f32[64,8]) %state), index=1
  %sum = f32[64,8]{1,0} all-reduce(f32[64,8]{1,0} %x), replica_groups={{0,1,2,3}}, to_apply=%add
  ROOT %out = (s32[], f32[64,8]{1,0}) tuple(s32[] %next, f32[64,8]{1,0} %sum)
}

%condition (state: (s32[], f32[64,8])) -> pred[] {
  %state = (s32[], f32[64,8]{1,0}) parameter(0)
  %i = s32[] get-tuple-element((s32[], f32[64,8]) %state), index=0
  %limit = s32[] constant(5)
  ROOT %less = pred[] compare(s32[] %i, s32[] %limit), direction=LT
}

%add (a: f32[], b: f32[]) -> f32[] {
  %a = f32[] parameter(0)
  %b = f32[] parameter(1)
  ROOT %c = f32[] add(f32[] %a, f32[] %b)
}

ENTRY %main (part: f32[16,8]) -> f32[16,8] {
  %part = f32[16,8]{1,0} parameter(0)
  %whole = f32[64,8]{1,0} all-gather(f32[16,8]{1,0} %part), replica_groups=[2,4]<=[8], dimensions={0}
  %zero = s32[] constant(0)
  %start = (s32[], f32[64,8]{1,0}) tuple(s32[] %zero, f32[64,8]{1,0} %whole)
  %loop = (s32[], f32[64,8]{1,0}) while((s32[], f32[64,8]) %start), condition=%condition, body=%body
  %result = f32[64,8]{1,0} get-tuple-element((s32[], f32[64,8]) %loop), index=1
  ROOT %mine = f32[16,8]{1,0} reduce-scatter(f32[64,8]{1,0} %result), replica_groups=[2,4]<=[8], dimensions={0}, to_apply=%add
}
"""
WHOLE = 4 * 64 * 8
"""Bytes of the array that is gathered from four devices."""


@pytest.fixture
def page(tmp_path):
    """A copy of a page to write into."""

    def copied(name):
        path = tmp_path / name
        path.write_text((REPOSITORY / "docs" / name).read_text())
        return path

    return copied


def test_traffic_between_devices():
    counted = training_cost.collectives(PROGRAM, 8)
    assert counted.calls == {"all-gather": 1, "all-reduce": 5, "reduce-scatter": 1}
    assert counted.array_bytes == {"all-gather": WHOLE, "all-reduce": 5 * WHOLE, "reduce-scatter": WHOLE}
    sent = {"all-gather": WHOLE * 3 // 4, "all-reduce": 5 * 2 * WHOLE * 3 // 4, "reduce-scatter": WHOLE * 3 // 4}
    assert counted.sent_bytes == sent and counted.unknown_trips == 0


def test_asynchronous_traffic_counts_once():
    gather = "%whole = f32[64,8]{1,0} all-gather(f32[16,8]{1,0} %part)"
    started = "%s = (f32[16,8]{1,0}, f32[64,8]{1,0}) all-gather-start(f32[16,8]{1,0} %part)"
    text = PROGRAM.replace(gather, started).replace(
        "  %zero = s32[]", "  %whole = f32[64,8]{1,0} all-gather-done((f32[16,8], f32[64,8]) %s)\n  %zero = s32[]"
    )
    assert text.count("all-gather") == 2
    assert training_cost.collectives(text, 8) == training_cost.collectives(PROGRAM, 8)


def test_groups_of_devices():
    assert training_cost.group_size("replica_groups={{0,2,4,6},{1,3,5,7}}, x", 8) == 4
    assert training_cost.group_size("replica_groups=[2,128]<=[256]", 256) == 128
    assert training_cost.group_size("replica_groups={}", 256) == 256


@pytest.mark.slow
def test_the_page_is_made_of_what_the_benchmark_writes(tmp_path, page):
    numbers, path = tmp_path / "numbers.json", page("performance_training.md")
    command = [sys.executable, str(EXPERIMENTS / "training" / "benchmark.py"), "--json", str(numbers)]
    options = ["--only", "tiny 32", "--repeats", "1"]
    subprocess.run([*command, *options], check=True, cwd=tmp_path)
    (row,) = json.loads(numbers.read_text()).values()
    assert row["flops"] > 0 and 0 < row["share_of_floor"] < 1 and row["losses"]["skipped"] == 0
    assert row["losses"]["overflow"] == 0 and not row["uncounted"]

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
