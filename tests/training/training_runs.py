"""Runs `training_worker.py` in other processes."""

import contextlib
import json
import socket
import subprocess
import sys
from pathlib import Path

SECONDS = 900
"""Most seconds of a run of a few steps on a loaded machine, with compilation."""


def worker():
    return [sys.executable, str(Path(__file__).with_name("training_worker.py"))]


def run(*arguments):
    """Runs one process to its end."""
    finished = subprocess.run(
        [*worker(), *map(str, arguments)],
        capture_output=True,
        text=True,
        timeout=SECONDS,
        check=False,
    )
    assert finished.returncode == 0, finished.stdout + finished.stderr


@contextlib.contextmanager
def several(count, *arguments):
    """Yields processes that train together, as `Popen`s whose output can be read.

    They are killed at the end.
    """
    with socket.socket() as free:
        free.bind(("localhost", 0))
        port = free.getsockname()[1]
    together = ["--coordinator", f"localhost:{port}", "--processes", str(count)]
    processes = [
        subprocess.Popen(
            [*worker(), *map(str, arguments), *together, "--process", str(index)],
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
        for index in range(count)
    ]
    try:
        yield processes
    finally:
        for process in processes:
            process.kill()
            process.wait()
            process.stdout.close()


def run_several(count, *arguments):
    """Runs several processes to their end."""
    with several(count, *arguments) as processes:
        outputs = [process.communicate(timeout=SECONDS)[0] for process in processes]
        assert [process.returncode for process in processes] == [0] * count, "\n".join(outputs)


def lines(out):
    """Returns the entries of a run's log."""
    return [json.loads(line) for line in (out / "log.jsonl").read_text().splitlines()]


def losses(out):
    """Returns {step: loss}; each step occurs once."""
    found = [
        (line["step"], line["loss"])
        for line in lines(out)
        if "loss" in line and "event" not in line
    ]
    assert len(dict(found)) == len(found)
    return dict(found)
