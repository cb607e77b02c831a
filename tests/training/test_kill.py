"""A run that is killed loses the steps since its last checkpoint, and nothing else."""

import random
import subprocess
import time

import pytest
from safetensors.numpy import load_file
from training_runs import losses, worker

KILLS = 15
WAIT_SECONDS = 300


def finished_checkpoints(out):
    return sorted(int(path.name) for path in (out / "checkpoints").glob("*") if path.name.isdigit())


def kill_in_a_checkpoint_write(arguments, out, delay):
    """Kills a run a little after a checkpoint began to be written.

    Returns the newest checkpoint at that time.
    """
    process = subprocess.Popen(
        [*worker(), *arguments], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    )
    deadline = time.monotonic() + WAIT_SECONDS
    try:
        known = finished_checkpoints(out)
        # not the first write: some steps should come through
        while not any(
            ".orbax-checkpoint-tmp" in path.name for path in (out / "checkpoints").glob("*")
        ) or (finished_checkpoints(out)[-1:] == known[-1:]):
            assert process.poll() is None, process.stdout.read()
            assert time.monotonic() < deadline, "no checkpoint was written"
            time.sleep(0.001)
        time.sleep(delay)
        newest = finished_checkpoints(out)[-1]
    finally:
        process.kill()
        process.wait()
        process.stdout.close()
    return newest


@pytest.mark.slow
def test_killed_in_checkpoint_writes_a_run_ends_as_one_that_never_was(tmp_path, captures):
    options = ["--no-validation", "--batch", "1", "--cache", str(tmp_path / "compiled")]
    killed, whole, generator = tmp_path / "killed", tmp_path / "whole", random.Random(0)
    folder = str(captures[0].parent)
    done = 0
    for _ in range(KILLS):
        newest = kill_in_a_checkpoint_write(
            [str(killed), folder, *options], killed, generator.uniform(0, 0.05)
        )
        assert newest > done, "a checkpoint was lost"
        done = newest
    end = done + 3
    for out in (killed, whole):
        subprocess.run(
            [*worker(), str(out), folder, *options, "--stop-at", str(end)],
            check=True,
            timeout=WAIT_SECONDS,
        )
    curve = losses(killed)
    assert list(curve) == list(range(1, end + 1)) and curve == losses(whole)
    weights = load_file(whole / "weights.safetensors")
    assert all(
        (tensor == weights[name]).all()
        for name, tensor in load_file(killed / "weights.safetensors").items()
    )
    assert not list((killed / "checkpoints").glob("*tmp*"))
