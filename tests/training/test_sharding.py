"""Divided states: what is gathered is whole, gradients come back as parts of the mean, eight devices agree with one."""

import subprocess
import sys
from pathlib import Path

import jax
import pytest

from humangs_jax.training.sharding import SMALLEST_DIVIDED, divided_axis, training_mesh

EIGHT_DEVICES = Path(__file__).with_name("eight_devices.py")


def test_the_longest_axis_that_can_be_is_divided():
    assert divided_axis((64, 256), 8) == 1
    assert divided_axis((512, 257), 8) == 0
    assert divided_axis((8, 3, 3, 1001), 8) == 0
    assert divided_axis((1001, 1003), 8) is None
    assert divided_axis((SMALLEST_DIVIDED // 2,), 8) is None
    assert divided_axis((512, 512), 1) is None
    assert divided_axis((), 8) is None


def test_a_mesh_of_what_does_not_divide_is_refused():
    with pytest.raises(ValueError, match="fsdp 3 does not divide"):
        training_mesh(3, jax.devices()[:1])
    assert dict(training_mesh(devices=jax.devices()[:1]).shape) == {"data": 1, "fsdp": 1}


def on_eight_devices(name):
    """Run a function of eight_devices.py in a process that has eight."""
    finished = subprocess.run(
        [sys.executable, str(EIGHT_DEVICES), name], capture_output=True, text=True, timeout=900, check=False
    )
    assert finished.returncode == 0, finished.stdout + finished.stderr


@pytest.mark.slow
def test_parts_are_gathered_and_gradients_come_back_as_parts_of_the_mean():
    on_eight_devices("a_linear_model")


@pytest.mark.slow
def test_eight_devices_take_the_step_of_one():
    on_eight_devices("a_training_step")
