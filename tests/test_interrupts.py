"""Ctrl-C gives exit code 130, one line, and nothing half-written, whatever the process does.

tests/io/test_atomic.py tests files that are being written. `train` has another handler
(tests/training).
"""

import os
import signal
import subprocess
import sys
import textwrap
import time
from pathlib import Path

import pytest

from humangs_jax import cli
from humangs_jax.cli.screen import PATIENCE
from humangs_jax.data.capture import load_capture, save_capture

pytestmark = pytest.mark.skipif(
    not hasattr(signal, "setitimer"), reason="needs Linux's or macOS's signals"
)
START = (
    "import signal; signal.signal(signal.SIGINT, signal.default_int_handler);"
    " signal.signal(signal.SIGHUP, signal.SIG_DFL); from humangs_jax import cli; "
)
"""Sets the usual handlers: shells start background processes without them."""
ENVIRONMENT = os.environ | {"PYTHONPATH": str(Path(cli.__file__).parents[2])}


def process(code, folder=None, environment=None, arguments=()):
    """Starts a Python process whose output can be read."""
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    environment = ENVIRONMENT if environment is None else environment
    return subprocess.Popen(
        [sys.executable, "-c", code, *arguments], cwd=folder, env=environment, **pipes
    )


def command(work, more=""):
    """Returns the code of a command line whose command does this work."""
    run = f"class Own:\n    def run(self):\n{textwrap.indent(textwrap.dedent(work), ' ' * 8)}\n"
    return (
        f"{START}\n{textwrap.dedent(more)}\n{run}cli._parsed = lambda arguments: Own()\ncli.main()"
    )


def interrupted(program, number=signal.SIGINT):
    """Interrupts a process after it has begun; returns (stdout, stderr)."""
    assert program.stdout.readline() == "begun\n"
    time.sleep(0.5)  # now it is in there
    program.send_signal(number)
    return program.communicate(timeout=250)


@pytest.mark.slow
def test_an_interrupt_that_python_does_not_hear_ends_the_process(tmp_path):
    """A compilation is a long call into C, during which Python does not act. What it was writing is
    removed.
    """
    writing = """
        import hashlib
        from humangs_jax.io import atomic
        def work(folder, file):
            folder.mkdir()
            for path in (file, folder / "x"):
                path.write_text("half")
            print("begun", flush=True)
            hashlib.pbkdf2_hmac("sha256", b"", b"", 200_000_000)
        write = lambda folder: atomic.replace_file("file", lambda file: work(folder, file))
    """
    program, began = (
        process(command("atomic.replace_folder('new', write, mark='x')", writing), tmp_path),
        time.monotonic(),
    )
    _, error = interrupted(program)
    assert program.returncode == cli.INTERRUPTED and error.endswith("humangs: interrupted\n")
    assert PATIENCE <= time.monotonic() - began < 50
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("name", ["SIGTERM", "SIGHUP"])
def test_what_is_asked_to_end_tidies_up(name, tmp_path):
    """`timeout` or a closed terminal ends it; the lock of a place is removed, too."""
    work = """
        import time
        from humangs_jax.io import atomic
        with atomic.only_writer("me", replaced=True):
            print("begun", flush=True)
            time.sleep(300)
    """
    program = process(command(work), tmp_path)
    _, error = interrupted(program, getattr(signal, name))
    assert program.returncode == cli.INTERRUPTED and error.endswith("humangs: interrupted\n"), error
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_a_run_that_saves_for_longer_than_our_patience_is_not_ended(tmp_path):
    saving = """
        with stop_requested() as stopping:
            print("begun", flush=True)
            while not stopping(0):
                pass
            time.sleep(1)
        print("saved", flush=True)
        raise KeyboardInterrupt
    """
    more = """
        import time
        from humangs_jax.cli import screen
        from humangs_jax.training.loop import stop_requested
        screen.PATIENCE = 0.2
    """
    program = process(command(saving, more), tmp_path)
    assert interrupted(program)[0] == "saved\n" and program.returncode == cli.INTERRUPTED


def test_an_interrupt_that_python_drops_is_repeated():
    collecting = """
        import gc, time
        def interrupt_once(*_):
            done.append(1)
            if len(done) == 1:
                signal.raise_signal(signal.SIGINT)
        gc.callbacks.append(interrupt_once)
        gc.collect()
        time.sleep(300)
    """
    program = process(command(collecting, "done = []"))
    _, error = program.communicate(timeout=250)
    assert program.returncode == cli.INTERRUPTED and error.endswith("humangs: interrupted\n"), error
    assert "Traceback" not in error


@pytest.mark.parametrize("code", [0, 2])
def test_an_interrupt_after_the_work_is_done_changes_nothing(code):
    """The interrupt comes while Python ends."""
    late = """
        import os, sys
        class Late:
            def __del__(self, kill=os.kill, own=os.getpid(), number=signal.SIGINT):
                kill(own, number)
        sys.late = Late()
    """
    program = process(
        f"{START}\n{textwrap.dedent(late)}cli.execute = lambda arguments: {code}\ncli.main()"
    )
    _, error = program.communicate(timeout=250)
    assert (program.returncode, error) == (code, "")


def test_an_interrupt_during_an_import_waits_for_it(tmp_path):
    """Extensions that are interrupted in their initialisation crash or raise ImportError."""
    (tmp_path / "slow_to_import.py").write_text(
        "import signal, time; signal.raise_signal(signal.SIGINT)\ntry:\n    time.sleep(0.2)\nexcept"
        " BaseException as error:\n    raise ImportError('half-imported') from"
        " error\nprint('imported', flush=True)\n"
    )
    path = os.pathsep.join([str(tmp_path), ENVIRONMENT["PYTHONPATH"]])
    program = process(
        command("import slow_to_import, time; time.sleep(300)"),
        environment=ENVIRONMENT | {"PYTHONPATH": path},
    )
    out, error = program.communicate(timeout=250)
    assert (program.returncode, out) == (cli.INTERRUPTED, "imported\n"), error


# Real commands, at moments of a run
# ----------------------------------------------------------------------------------


WORKS = {
    "new.npz": ("reconstruct", "me"),
    "refined.npz": ("refine", "me.npz", "me", "--refine", "3steps", "--image-size", "64"),
    "views": ("render", "me.npz", "--views", "3", "--size", "64", "--exr"),
    "demo": ("demo", "--size", "32", "--refine", "0"),
    "people": (
        "synth",
        "--subjects",
        "1",
        "--size",
        "128",
        "--views",
        "2",
        "--close-views",
        "0",
        "--workers",
        "1",
    ),
}
"""Commands that compute for long, by the file that they write."""


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """Returns a folder with an input for every command."""
    folder = tmp_path_factory.mktemp("place")
    save_capture(folder / "me", load_capture("demo_capture"))
    assert cli.execute(["reconstruct", str(folder / "me"), "--out", str(folder / "me.npz")]) == 0
    return folder


@pytest.mark.slow
@pytest.mark.parametrize("out", WORKS)
@pytest.mark.parametrize("seconds", [2.3, 7.5, 12.8])
def test_a_process_that_is_interrupted_exits_with_130(out, seconds, place, tmp_path):
    """The whole process is interrupted, with XLA's threads, which once crashed at its end."""
    program = process(
        START + "cli.main()", place, arguments=(*WORKS[out], "--out", str(tmp_path / out))
    )
    time.sleep(seconds)
    program.send_signal(signal.SIGINT)
    _, error = program.communicate(timeout=300)
    if program.returncode == 0:  # done before
        return
    assert program.returncode == cli.INTERRUPTED, (program.returncode, error)
    assert error.splitlines()[-1:] == ["humangs: interrupted"] and "Traceback" not in error
    assert not [*tmp_path.rglob(".*")] and all(path.stat().st_size for path in tmp_path.rglob("*"))
