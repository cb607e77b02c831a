"""Ctrl-C at random moments of every command: exit code 130, and nothing half-written.

SIGINT is raised at moments that are spread over a whole run, in one process whose programs are compiled: a run costs about
its half. A fit's solver is replaced by its result: signals wait anyway until a compiled program returns. HUMANGS_INTERRUPTS: how
many for each command, 100 by default. `train` has its own handler (tests/training). Real processes are ended at the end.
"""

import contextlib
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from experiments.fitting.your_photos import landmarks_in, write_material
from humangs_jax import cli
from humangs_jax.avatar.avatar import Avatar
from humangs_jax.data.capture import load_capture, save_capture
from humangs_jax.data.motion import Motion, load_motion, save_motion

COUNT = int(os.environ.get("HUMANGS_INTERRUPTS", "100"))
pytestmark = [
    pytest.mark.slow,
    pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning"),  # an ffmpeg that has lost its parent
    pytest.mark.skipif(not hasattr(signal, "setitimer"), reason="needs timers that raise signals"),
]

WORKS = {
    "import": ("import", "cameras", "photos/calibration.json", "--images", "photos/images", "--masks", "photos/masks"),
    "fit": ("fit", "seen", "--keypoints", "photos/keypoints"),
    "start": ("start", "photos", "--no-browser"),
    "check": ("check", "me"),
    "reconstruct": ("reconstruct", "me"),
    "refine": ("refine", "me.npz", "me", "--limit", "3steps", "--image-size", "64"),
    "animate": ("animate", "me.npz", "--motion", "steps.npz", "--size", "64"),
    "render": ("render", "me.npz", "--views", "3", "--size", "64", "--exr"),
    "export": ("export", "me.npz"),
    "demo": ("demo", "--size", "32", "--refine", "0"),
    "synth": ("synth", "--subjects", "1", "--size", "128", "--views", "2", "--close-views", "0", "--workers", "1"),
}
OUT = {
    "check": "new.png",
    "reconstruct": "new.npz",
    "refine": "new.npz",
    "animate": "new.mp4",
    "export": "new.ply",
}
"""Where a command writes, if it is not the folder "new"."""


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """A folder with an input for every command."""
    folder = tmp_path_factory.mktemp("place")
    capture = load_capture("demo_capture")
    save_capture(folder / "me", capture)
    write_material(folder / "photos", capture, landmarks_in(capture))
    with contextlib.chdir(folder):
        assert cli.execute([*WORKS["import"], "--out", "seen"]) == 0
        assert cli.execute(["reconstruct", "me", "--out", "me.npz"]) == 0
    walk = load_motion()
    save_motion(folder / "steps.npz", Motion(walk.rotations[:6], walk.translations[:6], walk.fps))
    return folder


@pytest.fixture
def quick_solver(monkeypatch):
    """A fit is computed once."""
    from humangs_jax.apps import demo
    from humangs_jax.fitting import fit_capture

    fit, known = fit_capture.fit_photos, []

    def remembered(*arguments, **options):
        if not known:
            known.append(fit(*arguments, **options))
            assert known[0].report.views  # a cached property: computed here
        return known[0]

    monkeypatch.setattr(fit_capture, "fit_photos", remembered)
    walk = load_motion()
    short = Motion(walk.rotations[:4], walk.translations[:4], walk.fps)
    monkeypatch.setattr(demo, "load_motion", lambda: short)


def contents(folder):
    """Every file below, with its size: what is half-written differs."""
    return {str(path.relative_to(folder)): path.stat().st_size for path in folder.rglob("*") if path.is_file()}


@contextlib.contextmanager
def interrupted_after(seconds):
    """SIGINT so much later, unless the block has ended."""
    previous = signal.signal(signal.SIGALRM, lambda *_: signal.raise_signal(signal.SIGINT))
    signal.signal(signal.SIGINT, signal.default_int_handler)  # shells start what runs in the background without it
    note = sys.unraisablehook  # what a callback of the garbage collector drops comes again, as in `cli.screen`
    again = lambda what: (
        signal.setitimer(signal.ITIMER_REAL, 0.02) if what.exc_type is KeyboardInterrupt else note(what)
    )
    sys.unraisablehook = again
    signal.setitimer(signal.ITIMER_REAL, max(seconds, 1e-4))
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        sys.unraisablehook = note
        signal.signal(signal.SIGALRM, previous)


@pytest.mark.parametrize("command", WORKS)
def test_interrupts_leave_nothing_half_written(command, place, quick_solver, monkeypatch, capsys):
    monkeypatch.chdir(place)
    out = place / OUT.get(command, "new")
    words = [*WORKS[command], "--out", out.name]

    def clean():
        out.unlink() if out.is_file() else shutil.rmtree(out, ignore_errors=True)

    before = contents(place)
    for _ in range(2):  # compiled, then timed
        clean()
        began = time.perf_counter()
        assert cli.execute(words) == 0, capsys.readouterr().err
        duration = time.perf_counter() - began
    whole = contents(place)
    codes = {0: 0, cli.INTERRUPTED: 0}
    moments = random.Random(0)
    for number in range(COUNT):
        clean()
        code = None
        delay = duration * (number + moments.random()) / COUNT
        try:
            with interrupted_after(delay):
                code = cli.execute(words)
        except KeyboardInterrupt:  # between the end of the command and that of the timer
            code = 0 if code is None else code
        assert code in codes, (delay, code, capsys.readouterr().err)
        codes[code] += 1
        now, partial = contents(place), contents(out) if out.is_dir() else {}
        assert not [name for name in now if "/." in f"/{name}"], (delay, now)  # no temporary file or folder
        if code == 0:
            assert now.keys() == whole.keys()
        elif command == "synth":  # people that are finished stay; the next run goes on
            people = {name.split("/")[0] for name in partial if "/" in name}
            assert all((out / person / "capture.json").is_file() for person in people)
        elif command == "start":  # so does the imported capture, and then its body, its sheet, its avatar
            assert not partial or load_capture_or_photos(out)
        elif command == "refine" and out.exists():  # the best avatar until then
            assert len(Avatar.load(out).gaussians.means) > 10_000
        else:
            assert now == before or now.keys() == whole.keys(), (delay, sorted(now.keys() - before.keys()))
    clean()
    assert cli.execute(words) == 0  # the process is as it was
    clean()
    print(f"{command}: {codes[cli.INTERRUPTED]} of {COUNT} interrupted, a whole run takes {duration:.1f} s")


def load_capture_or_photos(folder):
    """A capture that was imported is whole, with or without its body."""
    from humangs_jax.data.photos import load_photos

    return load_capture(folder) if (folder / "body.npz").exists() else load_photos(folder)


START = (
    "import signal; signal.signal(signal.SIGINT, signal.default_int_handler); from humangs_jax.cli import main; main()"
)
REAL = {**WORKS, "view": ("view", "me.npz", "--no-browser")}


@pytest.mark.parametrize("command", REAL)
@pytest.mark.parametrize("share", [0.15, 0.5, 0.85])
def test_a_process_that_is_interrupted_exits_with_130(command, share, place, tmp_path):
    """As in a shell: the whole process, with XLA's threads, which crashed at its end."""
    seconds = {"import": 4, "export": 6, "view": 4}.get(command, 15)
    out = () if command == "view" else ("--out", str(tmp_path / OUT.get(command, "new")))
    program = subprocess.Popen(
        [sys.executable, "-c", START, *REAL[command], *out],
        cwd=place,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        env=os.environ | {"PYTHONPATH": str(Path(cli.__file__).parents[2])},
        text=True,
    )
    time.sleep(share * seconds)
    program.send_signal(signal.SIGINT)
    _, error = program.communicate(timeout=300)
    if program.returncode == 0:  # done before, or `view`, which Ctrl-C ends by design
        return
    assert program.returncode == cli.INTERRUPTED, (program.returncode, error)
    assert error.splitlines()[-1:] == ["humangs: interrupted"] and "Traceback" not in error
    hidden = [path for path in tmp_path.rglob(".*")]
    assert not hidden, hidden
    assert np.all([path.stat().st_size > 0 for path in tmp_path.rglob("*")])
