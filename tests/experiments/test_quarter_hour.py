"""The list of an accelerator's quarter of an hour: every line is a command that there is, what is
done stays done, and what is too slow is cut.
"""

import importlib
import json
import sys

import pytest

from experiments import quarter_hour
from experiments.harness import listed, parser_of
from experiments.quarter_hour import Stage, ran, spend, stages


@pytest.mark.parametrize("small", [True, False])
def test_every_stage_is_an_experiment_with_options_that_it_knows(small, tmp_path):
    known = listed()
    for stage in stages(tmp_path, small):
        name, *options = stage.words
        function = getattr(importlib.import_module(known[name][0]), name)
        parser_of(function)[0].parse_args(options)
    names = [stage.name for stage in stages(tmp_path, small)]
    assert len(set(names)) == len(names)


def test_the_list_fits_into_a_quarter_of_an_hour_when_stages_before_training_are_cut(tmp_path):
    whole = stages(tmp_path, small=False)
    trained = [stage.name for stage in whole].index("training by the clock")
    assert sum(stage.seconds for stage in whole[: trained - 3]) < 15 * 60


@pytest.fixture
def counted(monkeypatch):
    """The list of three stages of a pretended program; the first fails."""
    calls = []

    def pretended(stage, limit, environment, log):
        calls.append((stage.name, limit))
        assert environment["XLA_FLAGS"].endswith(stage.flags)
        return {"became": "failed" if stage.name == "first" else "done", "seconds": 1.0}

    three = [Stage("first", (), 30), Stage("second", (), 50, "--flag"), Stage("third", (), 20)]
    monkeypatch.setattr(quarter_hour, "stages", lambda out, small: three)
    monkeypatch.setattr(quarter_hour, "ran", pretended)
    return calls


def test_a_second_call_goes_on_with_what_is_not_done(counted, tmp_path):
    found = spend(tmp_path, 200, small=False)
    assert [each["became"] for each in found.values()] == ["failed", "done", "done"]
    assert json.loads((tmp_path / "clock.json").read_text()) == found
    counted.clear()
    spend(tmp_path, 200, small=False)
    assert [name for name, _ in counted] == ["first"]


def test_no_stage_gets_more_time_than_is_left(counted, tmp_path):
    found = spend(tmp_path, 40 + quarter_hour.GRACE, small=False)
    assert [round(limit) for _, limit in counted] == [30, 40, 20]
    found = spend(tmp_path / "other", quarter_hour.GRACE + 1, small=False)
    assert {each["became"] for each in found.values()} == {"no time"}


def test_a_stage_that_takes_too_long_hears_ctrl_c_and_keeps_what_it_wrote(tmp_path, monkeypatch):
    program = (
        "import pathlib, time\n"
        f"pathlib.Path({str(tmp_path / 'begun')!r}).touch()\n"
        "try:\n    time.sleep(100)\n"
        f"except KeyboardInterrupt:\n    pathlib.Path({str(tmp_path / 'saved')!r}).touch()\n"
    )
    start = quarter_hour.subprocess.Popen
    command = [sys.executable, "-c", program]
    monkeypatch.setattr(
        quarter_hour.subprocess, "Popen", lambda words, **how: start(command, **how)
    )
    found = ran(Stage("slow", (), 2), 2.0, {}, tmp_path / "log")
    assert found["became"] == "cut" and found["seconds"] < 20
    assert (tmp_path / "begun").exists() and (tmp_path / "saved").exists()
