"""The number of programs that commands compile: each costs some ten milliseconds or more."""

import json
import subprocess
import sys

import pytest

from experiments.first_run import write_photos
from humangs_jax.core.processes import spare_cores

MOST = {"demo": 48, "animate": 8, "start": 100}
"""The most programs of a command: about a quarter more than there were when this was written."""
AHEAD = {"jit(fit_frames)", "jit(solve_round)", "jit(_reconstruct)"}
"""The slowest programs of `start`: threads compile them ahead where a machine has spare cores."""


def ran(*words):
    """Runs a command in another process and returns the programs that it compiled."""
    command = [sys.executable, "-m", "experiments.programs", *map(str, words)]
    found = subprocess.run(command, capture_output=True, text=True, check=False)
    assert found.returncode == 0, found.stderr[-2000:]
    result = json.loads(found.stdout.splitlines()[-1])
    assert result["status"] == 0, found.stderr[-2000:]
    return result["programs"]


def programs_of(*words):
    """Returns the names of the programs of a command, with the function that asked for each."""
    return [f"{program['name']} by {program['asked']}" for program in ran(*words)]


@pytest.mark.slow
def test_the_demo_and_a_video_of_its_avatar_need_few_programs(tmp_path):
    demo = programs_of("demo", "--out", tmp_path / "demo", "--refine", "1steps")
    assert len(demo) <= MOST["demo"], "\n".join(demo)
    drawn = programs_of(
        *("animate", tmp_path / "demo" / "avatar.npz", "--out", tmp_path / "a.mp4", "--size", "64")
    )
    assert len(drawn) <= MOST["animate"], "\n".join(drawn)


@pytest.mark.slow
def test_a_person_from_photos_needs_few_programs_and_long_ones_are_compiled_ahead(tmp_path):
    write_photos(tmp_path / "photos", 512)
    found = ran("start", tmp_path / "photos", "--out", tmp_path / "me", "--no-browser")
    names = [f"{program['name']} by {program['asked']}" for program in found]
    assert len(found) <= MOST["start"], "\n".join(names)
    if spare_cores():
        assert not AHEAD & {each["name"] for each in found if not each["beside"]}
