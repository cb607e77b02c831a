"""The list of commands for a quarter of an hour on an accelerator.

Every command exists, finished ones are not repeated, and slow ones are cut.
"""

import importlib
import sys

import pytest

from experiments import quarter_hour
from experiments.harness import listed, parser_of
from experiments.quarter_hour import Stage, ran, stages


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
