"""How many programs the commands compile: each costs some ten milliseconds or more, every time."""

import json
import subprocess
import sys

import pytest

from experiments.first_run import write_photos

MOST = {"demo": 60, "start": 320, "animate": 12}
"""By command: about a quarter more than there were when this was written."""


def programs_of(*words):
    """The programs of a command in a process of its own: names and who asked for them."""
    command = [sys.executable, "-m", "experiments.programs", *map(str, words)]
    found = subprocess.run(command, capture_output=True, text=True, check=False)
    assert found.returncode == 0, found.stderr[-2000:]
    result = json.loads(found.stdout.splitlines()[-1])
    assert result["status"] == 0, found.stderr[-2000:]
    return [f"{program['name']} by {program['asked']}" for program in result["programs"]]


@pytest.mark.slow
def test_the_demo_and_a_video_of_its_avatar_need_few_programs(tmp_path):
    demo = programs_of("demo", "--out", tmp_path / "demo", "--refine", "1steps")
    assert len(demo) <= MOST["demo"], "\n".join(demo)
    drawn = programs_of(
        *("animate", tmp_path / "demo" / "avatar.npz", "--out", tmp_path / "a.mp4", "--size", "64")
    )
    assert len(drawn) <= MOST["animate"], "\n".join(drawn)


@pytest.mark.slow
def test_photos_alone_need_few_programs(tmp_path):
    photos = tmp_path / "photos"
    write_photos(photos, 512)
    started = programs_of(
        *("start", photos, "--out", tmp_path / "out", "--no-browser", "--refine", "1steps")
    )
    assert len(started) <= MOST["start"], "\n".join(started)
