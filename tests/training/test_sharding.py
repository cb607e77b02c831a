"""Divided states: gathered ones are whole, and gradients come back as parts of the mean.

Eight devices agree with one.
"""

import inspect
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.sharding import PartitionSpec

from humangs_jax.cli.training import Processes
from humangs_jax.training.sharding import (
    SMALLEST_DIVIDED,
    divided_axis,
    join_processes,
    mean_parts,
    training_mesh,
)

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
    with pytest.raises(
        ValueError, match="give coordinator, number of processes and process index, or none"
    ):
        join_processes("localhost:1234", 2, None)


@pytest.mark.parametrize(
    "words", [{"processes": 2}, {"process": 0}, {"processes": 2, "process": 1}]
)
def test_the_command_refuses_a_part_of_the_processes(words):
    """Each process would train alone otherwise."""
    with pytest.raises(ValueError, match="give coordinator, number of processes"):
        Processes(**words).join()


def test_gradients_are_means_over_all_devices_whichever_hold_the_parts():
    """Four devices, two by two, are nested maps with the names of a mesh's axes."""
    # data, fsdp, rows, columns
    gradients = jnp.asarray(np.random.default_rng(0).normal(size=(2, 2, 3, 4)), jnp.float32)
    mesh = SimpleNamespace(size=4)

    def parts(spec):
        return jax.vmap(
            jax.vmap(
                lambda g: inspect.unwrap(mean_parts)({"x": g}, {"x": spec}, mesh)["x"],
                axis_name="fsdp",
            ),
            axis_name="data",
        )(gradients)

    mean = np.asarray(gradients).mean(axis=(0, 1))
    np.testing.assert_allclose(
        parts(PartitionSpec()), np.broadcast_to(mean, (2, 2, 3, 4)), rtol=1e-5
    )
    divided = parts(PartitionSpec(None, "fsdp"))
    for data in range(2):
        np.testing.assert_allclose(np.concatenate(divided[data], axis=1), mean, rtol=1e-5)


def on_eight_devices(name):
    """Runs a function of eight_devices.py in a process that has eight devices."""
    finished = subprocess.run(
        [sys.executable, str(EIGHT_DEVICES), name],
        capture_output=True,
        text=True,
        timeout=900,
        check=False,
    )
    assert finished.returncode == 0, finished.stdout + finished.stderr


@pytest.mark.slow
def test_parts_are_gathered_and_gradients_come_back_as_parts_of_the_mean():
    on_eight_devices("a_linear_model")


@pytest.mark.slow
def test_eight_devices_take_the_step_of_one():
    on_eight_devices("a_training_step")
