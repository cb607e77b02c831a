"""An interrupted and continued run equals one that was not interrupted.

It runs on one device, on several, or in several processes.
"""

import signal

import jax
import numpy as np
import pytest
from rounding import bound
from training_runs import losses, run, run_several, several
from training_worker import configuration

from humangs_jax.training.checkpoint import Checkpoints
from humangs_jax.training.state import init_state

ACROSS = 1e-5
"""Error between arrangements of devices, whose sums have other orders; a step moves by 1e-4."""


def state_of(out, step):
    """Returns the checkpoint of a step, on this process's one device."""
    checkpoints = Checkpoints(out / "checkpoints")
    state = checkpoints.restore(init_state(configuration()), step)
    checkpoints.close()
    return state


def largest_difference(a, b):
    return max(
        float(np.abs(np.asarray(x) - np.asarray(y)).max())
        for x, y in zip(*map(jax.tree.leaves, (a, b)), strict=True)
    )


@pytest.mark.slow
def test_resume_of_eight_devices_on_four_and_of_two_processes(captures, tmp_path, same):
    folder = captures[0].parent
    eight, four, stopped = (tmp_path / name for name in ("eight", "four", "stopped"))
    two, two_stopped = tmp_path / "two", tmp_path / "two_stopped"
    cache = ("--cache", tmp_path / "compiled")

    def arguments_on(devices, at_once):
        return ("--batch", 8, "--devices", devices, "--at-once", at_once, *cache)

    # the same arrangement: bit by bit
    run(four, folder, "--stop-at", 4, *arguments_on(4, 2))
    run(stopped, folder, "--stop-at", 2, *arguments_on(4, 2))
    run(stopped, folder, "--stop-at", 4, *arguments_on(4, 2))
    assert same(state_of(stopped, 4), state_of(four, 4))
    assert losses(stopped) == losses(four) and list(losses(four)) == [1, 2, 3, 4]

    # other arrangements, up to rounding
    run(eight, folder, "--stop-at", 2, *arguments_on(8, 1))
    run(eight, folder, "--stop-at", 4, *arguments_on(4, 2))
    assert largest_difference(state_of(eight, 4).params, state_of(four, 4).params) < bound(ACROSS)

    run_several(2, two, folder, "--stop-at", 4, *arguments_on(1, 4))
    run_several(2, two_stopped, folder, "--stop-at", 2, *arguments_on(1, 4))
    run_several(2, two_stopped, folder, "--stop-at", 4, *arguments_on(1, 4))
    assert same(state_of(two_stopped, 4), state_of(two, 4)) and losses(two_stopped) == losses(two)
    assert largest_difference(state_of(two, 4).params, state_of(four, 4).params) < bound(ACROSS)
    assert list(losses(two).values()) == pytest.approx(
        list(losses(four).values()), abs=bound(ACROSS)
    )


@pytest.mark.slow
def test_resume_after_one_of_two_processes_hears_that_it_must_go(captures, tmp_path, same):
    folder, out, whole = captures[0].parent, tmp_path / "out", tmp_path / "whole"
    options = ("--batch", 2, "--no-validation", "--cache", tmp_path / "compiled")
    with several(2, out, folder, *options) as processes:
        checkpoints = out / "checkpoints"
        while not (checkpoints / "2").is_dir():
            assert [process.poll() for process in processes] == [None, None]
        processes[1].send_signal(signal.SIGTERM)
        outputs = [process.communicate(timeout=120)[0] for process in processes]
    assert [process.returncode for process in processes] == [0, 0], outputs
    step = max(losses(out))
    assert 2 <= step < 1000
    run_several(2, out, folder, *options, "--stop-at", step + 2)
    run_several(2, whole, folder, *options, "--stop-at", step + 2)
    assert losses(out) == losses(whole)
    assert same(state_of(out, step + 2), state_of(whole, step + 2))
