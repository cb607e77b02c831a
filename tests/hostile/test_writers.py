"""Every command that writes: killed, on full and read-only disks, twice at once. In processes of their own, see `writers`."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

HERE = Path(__file__).parent
MOMENTS = int(os.environ.get("HUMANGS_KILLS", "2"))
"""For each of the commands; docs/results/kills.json has the figures of more."""


def run(script, *arguments):
    environment = os.environ | {"PYTHONDONTWRITEBYTECODE": "1", "JAX_PLATFORMS": "cpu"}
    command = [sys.executable, str(HERE / script), *map(str, arguments)]
    return subprocess.run(command, env=environment, capture_output=True, text=True, check=False)


@pytest.mark.slow
def test_killed_at_any_moment_nothing_is_half_written_or_lost_and_the_next_run_works(tmp_path):
    record = tmp_path / "kills.json"
    done = run("kills.py", tmp_path / "kills", "--moments", MOMENTS, "--json", record)
    assert record.exists(), done.stderr[-3000:]
    commands = json.loads(record.read_text())["commands"]
    assert not {name: each["faults"] for name, each in commands.items() if each["faults"]}
    assert done.returncode == 0 and len(commands) >= 25
    assert (
        sum(each["killed"] for each in commands.values()) > MOMENTS * len(commands) / 2
    )  # some come to their end before


@pytest.mark.slow
def test_full_and_read_only_disks_and_two_runs_at_once_end_in_one_line_and_lose_nothing(tmp_path):
    done = run("disks.py", tmp_path / "disks")
    found = [json.loads(line) for line in done.stdout.splitlines() if line.startswith("{")]
    assert not [each for each in found if any(each.values())]
    assert done.returncode == 0 and len(found) >= 25, done.stderr[-3000:]
