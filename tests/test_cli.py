import dataclasses
import functools
import json
import logging
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from command_line import run, save_tiny_avatar

from humangs_jax import __version__, cli
from humangs_jax.cli import fit, screen
from humangs_jax.cli.options import UsageError
from humangs_jax.cli.screen import PATIENCE
from humangs_jax.core import progress
from humangs_jax.core.configuration import ArgumentError
from humangs_jax.core.progress import stage
from humangs_jax.data.capture import load_capture, save_capture
from humangs_jax.io.images import read_image, write_png

COMMANDS = tuple(cli.COMMANDS)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A copy of the shipped capture: with its four photos, so that the demo's programs are compiled once for both."""
    path = tmp_path_factory.mktemp("captures") / "someone"
    save_capture(path, load_capture("demo_capture"))
    return path


def test_every_page_that_a_help_text_names_exists():
    docs = Path(__file__).parents[1]
    sources = [file.read_text() for file in Path(cli.__file__).parent.glob("*.py")]
    pages = {page for text in sources for page in re.findall(r"docs/\w+\.md", text)}
    assert len(pages) > 4 and all((docs / page).is_file() for page in pages), pages


def test_help_names_every_command_and_imports_nothing_heavy():
    code = "import sys; from humangs_jax import cli; sys.argv = ['humangs', '--help']\ntry: cli.main()\nexcept SystemExit: pass\n"
    code += "assert 'jax' not in sys.modules and 'flax' not in sys.modules"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr
    assert all(name in result.stdout for name in COMMANDS)


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_explains_itself(command, monkeypatch, capsys):
    code, out, _ = run(monkeypatch, capsys, command, "--help")
    assert code == 0 and ("--out" in out or command in ("view", "evaluate")) and "docstring" not in out


@pytest.mark.parametrize(
    ("words", "usage"),
    [("import cameras", "import cameras [-h] [OPTIONS] PATH"), ("import", "import [-h] [OPTIONS] {cameras}")],
)
def test_the_usage_of_an_import_can_be_typed_as_it_stands(words, usage, monkeypatch, capsys):
    _, out, _ = run(monkeypatch, capsys, *words.split(), "--help")
    assert out.startswith(f"usage: humangs {usage}")


def spoil_json(change):
    def spoil(path):
        file = path / "capture.json"
        description = json.loads(file.read_text())
        change(description)
        file.write_text(json.dumps(description))

    return spoil


def spoil_body(change):
    def spoil(path):
        arrays = dict(np.load(path / "body.npz"))
        change(arrays)
        np.savez(path / "body.npz", **arrays)

    return spoil


BAD_CAPTURES = {
    "missing image": (lambda path: next((path / "images").iterdir()).unlink(), "images/"),
    "wrong K shape": (spoil_json(lambda d: d["views"][0].update(K=[[1, 0], [0, 1]])), "views[0].K"),
    "NaN pose": (spoil_body(lambda a: a["rotations"].__setitem__((0, 0, 0), np.nan)), "rotations"),
    "mismatched counts": (spoil_body(lambda a: a.update(translations=np.zeros((7, 3)))), "translations"),
    "frame out of range": (spoil_json(lambda d: d["views"][1].update(frame=5)), "views[1].frame"),
    "singular camera": (
        spoil_json(lambda d: d["views"][0].update(cam_from_world=[[0, 0, 0, 0]] * 3 + [[0, 0, 0, 1]])),
        "cam_from_world",
    ),
    "0 views": (spoil_json(lambda d: d.update(views=[])), "views"),
}


@pytest.mark.parametrize("case", BAD_CAPTURES)
@pytest.mark.parametrize("command", ["reconstruct", "check"])
def test_a_bad_capture_is_one_line_and_nothing_is_written(case, command, folder, tmp_path, monkeypatch, capsys):
    spoil, field = BAD_CAPTURES[case]
    bad, out = tmp_path / "bad", tmp_path / "out"
    shutil.copytree(folder, bad)
    spoil(bad)
    out.mkdir()
    result = out / {"check": "result.png"}.get(command, "result.npz")
    code, printed, error = run(monkeypatch, capsys, command, bad, "--out", result)
    assert code == cli.BAD_DATA and printed == ""
    assert error.count("\n") == 1 and error.startswith("humangs: error: ")
    assert field in error and "bad" in error  # names the field and the file
    assert list(out.iterdir()) == []


def test_wrong_options_are_one_line_too(folder, tmp_path, monkeypatch, capsys):
    usage, data = cli.BAD_USAGE, cli.BAD_DATA
    for expected, *arguments in (
        (data, "reconstruct", tmp_path / "nowhere", "--out", tmp_path / "a.npz"),
        (usage, "reconstruct", folder, "--out", tmp_path / "no" / "such" / "folder.npz"),
        (data, "animate", tmp_path / "no_avatar.npz", "--out", tmp_path / "a.mp4"),
        (usage, "animate", tmp_path / "no_avatar.npz", "--out", tmp_path / "a.txt"),
        (data, "export", folder / "body.npz", "--out", tmp_path / "a.ply"),
        (data, "reconstruct", folder, "--weights", folder / "body.npz", "--no-check", "--out", tmp_path / "a.npz"),
        (usage, "reconstruct", folder, "--refine", "soon", "--out", tmp_path / "a.npz"),
        (usage, "refine", tmp_path / "no_avatar.npz", folder, "--limit", "0s"),
        (usage, "synth", "--subjects", "0", "--out", tmp_path / "people"),
    ):
        code, _, error = run(monkeypatch, capsys, *arguments)
        assert code == expected and error.count("\n") == 1, (arguments, error)
    assert list(tmp_path.iterdir()) == []


def test_refinement_without_masks_is_refused_before_the_work(folder, tmp_path, monkeypatch, capsys):
    photos = dataclasses.replace(load_capture(folder), masks=None)
    save_capture(tmp_path / "bare", photos)
    code, _, error = run(
        monkeypatch,
        capsys,
        "reconstruct",
        tmp_path / "bare",
        "--no-check",
        "--refine",
        "15s",
        "--out",
        tmp_path / "a.npz",
    )
    assert code == cli.BAD_USAGE and error.count("\n") == 1 and "--refine 15s: needs masks" in error


@pytest.mark.slow
def test_from_photos_to_images(folder, tmp_path, monkeypatch, capsys):
    """reconstruct, render, animate, export and check, one after the other, as a user would."""
    import plyfile

    monkeypatch.chdir(tmp_path)
    for arguments in (
        ("reconstruct", folder, "--out", "avatar.npz"),
        ("refine", "avatar.npz", folder, "--limit", "2steps", "--image-size", "64", "--live", "--out", "refined.npz"),
        ("render", "refined.npz", "--out", "views", "--views", "2", "--size", "64", "--exr"),
        ("export", "avatar.npz", "--out", "avatar.ply"),
        ("check", folder, "--out", "check.png"),
    ):
        code, _, error = run(monkeypatch, capsys, *arguments)
        assert code == 0, error
    image, _ = read_image("views/view_000.png")
    assert image.shape == (64, 64, 3) and image.std() > 10 / 255 and image[0].min() == 1
    assert Path("views/views.exr").stat().st_size > 1000
    assert len(plyfile.PlyData.read("avatar.ply")["vertex"].data) > 10_000
    assert read_image("check.png")[0].std() > 10 / 255


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "give either a CAPTURE folder or --scan MESH"),
        (["FOLDER", "--scan", "scan.obj"], "give either a CAPTURE folder or --scan MESH"),
        (["FOLDER"], "body.npz exists: --overwrite replaces it"),
        (["FOLDER", "--keypoints", "k.json"], "body.npz exists: --overwrite replaces it"),
        (["FOLDER", "--bare"], "--bare is for --scan or --refine, not for --keypoints"),
        (["FOLDER", "--refine", "--smoothness", "0.1"], "--smoothness is for --keypoints, not for --refine"),
        (["FOLDER", "--keypoints", "k.json", "--out", "new"], "k.json"),
        (
            ["FOLDER", "--keypoints", "k.json", "--smoothness", "-1", "--out", "new"],
            "--smoothness -1.0: expected at least 0",
        ),
        (["--scan", "scan.obj", "--refine"], "--refine is for captures, not for --scan"),
        (["--scan", "scan.obj"], "--out FOLDER is missing"),
        (["--scan", "scan.obj", "--out", "new"], "scan.obj"),
        (["--scan", "scan.obj", "--views", "v"], "scan.obj"),
        (["--scan", "scan.obj", "--keypoints", "k.json", "--out", "new"], "needs --views FOLDER"),
        (["--scan", "scan.obj", "--joints", "j.json", "--views", "v"], "--joints and --views: give one"),
    ],
)
def test_fit_says_what_is_missing(folder, tmp_path, monkeypatch, capsys, arguments, message):
    monkeypatch.chdir(tmp_path)
    arguments = [folder if argument == "FOLDER" else argument for argument in arguments]
    code, _, err = run(monkeypatch, capsys, "fit", *arguments)
    of_data = message in ("k.json", "scan.obj")
    assert code == (cli.BAD_DATA if of_data else cli.BAD_USAGE) and message in err and err.count("\n") == 1, err
    assert not any(tmp_path.iterdir())


def test_fit_deletes_no_folder_with_something_of_its_own_or_of_the_user(folder, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    capture = Path("out/capture.json")
    for name in ("docs/me.obj", "docs/scan_fit.json", "papers/thesis.tex", "out/k.json", capture):
        Path(name).parent.mkdir(exist_ok=True)
        Path(name).write_text("mine")
    shutil.copyfile(folder / "capture.json", capture)
    before = sorted(tmp_path.rglob("*"))
    for arguments, message in (
        (("--scan", "docs/me.obj", "--out", "docs"), "docs/me.obj lies in it and would be deleted"),
        (("--scan", "docs/me.obj", "--out", "papers"), "the folder holds no scan_fit.json"),
        ((folder, "--keypoints", "out/k.json", "--out", "papers"), "the folder holds no capture.json"),
        ((folder, "--keypoints", "out/k.json", "--out", "out"), "out/k.json lies in it and would be deleted"),
        ((folder, "--keypoints", "k", "--body", "out/k.json", "--out", "out"), "out/k.json lies in it"),
    ):
        code, _, error = run(monkeypatch, capsys, "fit", *arguments, "--overwrite")
        assert code == 2 and message in error and error.count("\n") == 1, (arguments, error)
    assert sorted(tmp_path.rglob("*")) == before
    code, printed, _ = run(monkeypatch, capsys, "fit", "--scan", "none.obj", "--out", "docs", "--overwrite")
    assert (
        code == cli.BAD_DATA
        and "this is deleted: me.obj, scan_fit.json" in printed
        and sorted(tmp_path.rglob("*")) == before
    )


def test_the_options_of_each_way_to_fit_exist():
    parts = (fit.Detections, fit.Scan, fit.Refinement, fit.Fit)
    options = {field.name for part in parts for field in dataclasses.fields(part)}
    for way, others in fit.WAYS.items():
        assert others | {way.removeprefix("--")} <= options


def test_training_goes_on_from_weights_as_they_were_trained(tmp_path, monkeypatch, capsys):
    """Their network and the way their Gaussians are drawn; the run's other knobs stay."""
    from humangs_jax.network import presets, weights
    from humangs_jax.training import loop, sources

    started = []
    model = presets.tiny().with_conventions(rendering="inria")
    monkeypatch.setattr(weights, "load_weights", lambda path: ({}, model))
    monkeypatch.setattr(sources, "training_people", lambda *arguments: None)
    monkeypatch.setattr(loop, "train", lambda settings, *arguments, **options: started.append(settings))
    for config in ("tiny", "published"):
        arguments = ("--config", config, "--init-weights", "w", "--out", tmp_path)
        code, _, error = run(monkeypatch, capsys, "train", "--on-the-fly", "1", *arguments)
        assert code == 0, error
    assert all(settings.splat.square and settings.splat.radius_sigma == 3 for settings in started)
    assert [settings.model.conventions.rendering for settings in started] == ["inria", "inria"]


@pytest.mark.parametrize(("done", "code"), [(3, cli.INTERRUPTED), (5, 0)])
def test_training_that_was_stopped_says_how_far_it_came(done, code, tmp_path, monkeypatch, capsys):
    """Ctrl-C: `train` saves and raises, and the exit code tells that it was interrupted, unless all steps were done."""
    from humangs_jax.training import loop, sources

    def interrupted(*arguments, **options):
        stopped = loop.TrainingInterrupted.__new__(loop.TrainingInterrupted)  # a whole state is not needed
        stopped.state = SimpleNamespace(step=done)
        raise stopped

    monkeypatch.setattr(sources, "training_people", lambda *arguments: None)
    monkeypatch.setattr(loop, "train", interrupted)
    words = ["train", "--config", "tiny", "--steps", "5", "--on-the-fly", "1", "--out", str(tmp_path)]
    assert cli.execute(words) == code
    out, err = capsys.readouterr()
    assert f"{tmp_path}: {done} of 5 steps" in out and ("interrupted" in err) == (code != 0)
    assert (f"--weights {tmp_path / 'weights.safetensors'}" in out) == (code == 0)


def test_import_of_what_is_no_calibration_is_one_line(folder, tmp_path, monkeypatch, capsys):
    code, _, err = run(
        monkeypatch,
        capsys,
        "import",
        "cameras",
        tmp_path / "none",
        "--images",
        folder / "images",
        "--out",
        tmp_path / "new",
    )
    assert code == cli.BAD_DATA and "none" in err and err.count("\n") == 1
    assert not (tmp_path / "new").exists()


# What a command shows -------------------------------------------------------------------------------------------------


def test_version_and_unknown_commands(monkeypatch, capsys):
    assert run(monkeypatch, capsys, "--version") == (0, f"humangs_jax {__version__}\n", "")
    assert run(monkeypatch, capsys, "check", "--version")[0] == 0
    assert run(monkeypatch, capsys, "chekc")[0] == cli.BAD_USAGE


@dataclasses.dataclass(frozen=True)
class Sample:
    """A command of two stages."""

    fails: str = ""

    def run(self) -> None:
        with stage("counting"), stage("inside"):
            screen.warn("odd")
        with stage("writing"):
            if self.fails:
                raise {"usage": UsageError, "data": ValueError, "keys": KeyboardInterrupt}.get(
                    self.fails, functools.partial(ArgumentError, "frame_ms")
                )("no good")
        screen.tell("the report")
        screen.wrote(Path("my file.npz"), "3 numbers")
        screen.suggest("humangs view", Path("my file.npz"))


@pytest.fixture
def sample(monkeypatch):
    monkeypatch.setattr(cli, "_command", lambda name: Sample)
    monkeypatch.setitem(cli.COMMANDS, "sample", "")


def test_a_command_ends_with_what_it_wrote_how_long_it_took_and_what_is_next(sample, capsys):
    assert cli.execute(["sample"]) == 0
    out, err = capsys.readouterr()
    report, written, took, following = out.splitlines()
    assert (report, written, err) == ("the report", "my file.npz: 3 numbers", "humangs: warning: odd\n")
    assert re.fullmatch(r"took \d+\.\d s: counting \d+\.\d, writing \d+\.\d", took)
    assert following == "next: humangs view 'my file.npz'"


@pytest.mark.parametrize("verbose", [(), ("--verbose",)])
def test_what_a_file_says_does_not_act_on_the_terminal(verbose, monkeypatch, sample, capsys):
    hostile = "x\x1b]0;OWNED\x07\x9b2J\u202e\r\nhumangs: error: forged\udce9"

    def run(self):
        screen.warn(hostile)
        screen.tell(hostile)
        screen.wrote(Path(hostile), hostile)
        # pytest-xdist cannot send a captured log with half a surrogate
        logging.getLogger("humangs_jax.sample").warning("%s", hostile[:-1])
        with stage(hostile):
            raise ValueError(hostile)

    monkeypatch.setattr(Sample, "run", run)
    assert cli.execute(["sample", *verbose]) == cli.BAD_DATA
    out, err = capsys.readouterr()
    assert set((out + err).replace("\n", "")) == {c for c in out + err if c.isprintable()}
    last = err.splitlines()[-1]
    assert last == r"humangs: error: x\x1b]0;OWNED\x07\x9b2J\u202e\r\nhumangs: error: forged\xe9"


def test_quiet_and_verbose(sample, capsys):
    assert cli.execute(["--quiet", "sample"]) == 0
    assert capsys.readouterr() == ("the report\n", "humangs: warning: odd\n")
    assert cli.execute(["sample", "--verbose"]) == 0
    assert re.search(r"counting: \d+\.\d s\nwriting: ", capsys.readouterr().err)
    assert cli.execute(["sample", "--verbose", "--fails", "data"]) == cli.BAD_DATA
    assert "Traceback" in capsys.readouterr().err


@pytest.mark.parametrize(("fails", "code"), [("usage", 2), ("data", 1), ("option", 2), ("keys", 130)])
def test_exit_codes(sample, capsys, fails, code):
    """An argument of the library that is wrong is an option here."""
    assert cli.execute(["sample", "--fails", fails]) == code
    out, err = capsys.readouterr()
    last = err.splitlines()[-1]
    begins = {"keys": "humangs: interrupted", "option": "humangs: error: --frame-ms no good"}
    assert out == "" and last.startswith(begins.get(fails, "humangs: error: no good"))


def test_another_error_because_of_an_interrupt_is_an_interrupt(sample, monkeypatch, capsys):
    """Extensions that are interrupted while they are imported raise ImportError."""

    def run(self):
        screen.heard.set()
        raise ImportError("while initializing the extension")

    monkeypatch.setattr(Sample, "run", run)
    assert cli.execute(["sample"]) == cli.INTERRUPTED and capsys.readouterr().err == "\nhumangs: interrupted\n"
    monkeypatch.setattr(Sample, "run", lambda self: 1 / 0)  # a mistake of ours is not hidden
    with pytest.raises(ZeroDivisionError):
        cli.execute(["sample"])


def test_a_stage_on_a_terminal_counts_its_seconds(sample, monkeypatch, capsys):
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True, raising=False)
    monkeypatch.setattr(progress, "TICK", 0.01)
    shown = progress.begin()
    try:
        with stage("compiling"):
            time.sleep(0.1)
            with stage("the step"):
                time.sleep(0.1)
            assert list(progress.bar(range(3), desc="steps")) == [0, 1, 2]  # takes the line
    finally:
        progress.end()
    err = capsys.readouterr().err
    assert "compiling ... 0 s" in err and "compiling: the step ... 0 s" in err and "steps: 100%" in err
    assert re.search(r"compiling: 0\.\d s\n$", err) and list(shown.seconds) == ["compiling"]


def test_bars_are_hidden_by_quiet(capsys):
    progress.begin(quiet=True)
    try:
        assert list(progress.bar(range(3))) == [0, 1, 2] and not progress.watched()
    finally:
        progress.end()
    assert capsys.readouterr().err == ""


def test_a_reader_that_has_gone_ends_a_command_quietly(tmp_path):
    """As `humangs check X | head -0`: through a real pipe, whose other end is closed at once."""
    program = subprocess.Popen(
        [sys.executable, "-m", "humangs_jax.cli", "--version"], stdout=subprocess.PIPE, stderr=subprocess.PIPE
    )
    program.stdout.close()
    error = program.stderr.read()
    program.stderr.close()
    assert program.wait() == cli.BROKEN_PIPE and error == b""


def test_an_interrupt_that_python_does_not_hear_ends_the_process(tmp_path):
    """As in a compilation: a long call into C, which gives Python no turn. What it was writing goes, too."""
    code = (
        "import hashlib, signal; signal.signal(signal.SIGINT, signal.default_int_handler)\n"
        "from humangs_jax import cli\n"
        "from humangs_jax.io import atomic\n"
        "class Long:\n"
        "    def run(self):\n"
        "        write = lambda folder: atomic.replace_file('file', lambda file: work(folder, file))\n"
        "        atomic.replace_folder('new', write, mark='x')\n"
        "def work(folder, file):\n"
        "    folder.mkdir()\n"
        "    for path in (file, folder / 'x'):\n"
        "        path.write_text('half')\n"
        "    print('begun', flush=True)\n"
        "    hashlib.pbkdf2_hmac('sha256', b'', b'', 200_000_000)\n"
        "cli._parsed = lambda arguments: Long()\n"
        "cli.main()"
    )
    command = [sys.executable, "-c", code]
    program = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, cwd=tmp_path)
    assert program.stdout.readline() == b"begun\n"
    time.sleep(0.5)  # now it is in there
    began = time.monotonic()
    program.send_signal(signal.SIGINT)
    _, error = program.communicate(timeout=60)
    assert program.returncode == cli.INTERRUPTED and error.endswith(b"humangs: interrupted\n")
    assert PATIENCE <= time.monotonic() - began < 50
    assert not list(tmp_path.iterdir())


def test_a_run_that_saves_for_longer_than_our_patience_is_not_ended(tmp_path):
    code = (
        "import signal, time; signal.signal(signal.SIGINT, signal.default_int_handler)\n"
        "from humangs_jax import cli\n"
        "from humangs_jax.cli import screen\n"
        "from humangs_jax.training.loop import stop_requested\n"
        "screen.PATIENCE = 0.2\n"
        "class Training:\n"
        "    def run(self):\n"
        "        with stop_requested() as stopping:\n"
        "            print('begun', flush=True)\n"
        "            while not stopping(0):\n"
        "                pass\n"
        "            time.sleep(1)\n"
        "        print('saved', flush=True)\n"
        "        raise KeyboardInterrupt\n"
        "cli._parsed = lambda arguments: Training()\n"
        "cli.main()"
    )
    program = subprocess.Popen(
        [sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.PIPE, cwd=tmp_path
    )
    assert program.stdout.readline() == b"begun\n"
    program.send_signal(signal.SIGINT)
    out, _ = program.communicate(timeout=60)
    assert out == b"saved\n" and program.returncode == cli.INTERRUPTED


def test_an_interrupt_that_python_drops_is_repeated():
    code = (
        "import gc, signal, time; signal.signal(signal.SIGINT, signal.default_int_handler)\n"
        "from humangs_jax import cli\n"
        "class Collected:\n"
        "    def run(self):\n"
        "        gc.callbacks.append(lambda *_: done.append(1) or len(done) == 1 and signal.raise_signal(signal.SIGINT))\n"
        "        gc.collect()\n"
        "        time.sleep(300)\n"
        "done = []\n"
        "cli._parsed = lambda arguments: Collected()\n"
        "cli.main()"
    )
    program = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False, timeout=250)
    assert program.returncode == cli.INTERRUPTED and program.stderr.endswith("humangs: interrupted\n"), program.stderr
    assert "Traceback" not in program.stderr


@pytest.mark.parametrize("code", [0, 2])
def test_an_interrupt_after_the_work_is_done_changes_nothing(code):
    """While Python ends. `synth` was ended by the signal, 1 of 72 real runs."""
    program = (
        "import os, signal, sys; signal.signal(signal.SIGINT, signal.default_int_handler)\n"
        "class Late:\n"
        "    def __del__(self, kill=os.kill, own=os.getpid(), number=signal.SIGINT):\n"
        "        kill(own, number)\n"
        "sys.late = Late()\n"
        "from humangs_jax import cli\n"
        f"cli.execute = lambda arguments: {code}\n"
        "cli.main()"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False, timeout=250)
    assert (done.returncode, done.stderr) == (code, "")


@pytest.mark.skipif(not hasattr(signal, "setitimer"), reason="needs Linux's or macOS's signals")
def test_an_interrupt_during_an_import_waits_for_it(tmp_path):
    """Extensions crash or raise ImportError: `view` and `fit` were ended by SIGSEGV, 2 of 42 real runs."""
    (tmp_path / "slow_to_import.py").write_text(
        "import signal, time; signal.raise_signal(signal.SIGINT)\n"
        "try:\n    time.sleep(0.2)\nexcept BaseException as error:\n    raise ImportError('half-imported') from error\n"
        "print('imported', flush=True)\n"
    )
    code = (
        "import signal, time; signal.signal(signal.SIGINT, signal.default_int_handler)\n"
        "from humangs_jax import cli\n"
        "class Importing:\n"
        "    def run(self):\n"
        "        import slow_to_import\n"
        "        time.sleep(300)\n"
        "cli._parsed = lambda arguments: Importing()\n"
        "cli.main()"
    )
    path = os.pathsep.join([str(tmp_path), str(Path(cli.__file__).parents[2])])
    command, env = [sys.executable, "-c", code], os.environ | {"PYTHONPATH": path}
    program = subprocess.run(command, capture_output=True, text=True, check=False, timeout=250, env=env)
    assert (program.returncode, program.stdout) == (cli.INTERRUPTED, "imported\n"), program.stderr


def test_the_logs_of_libraries_stay_off_the_screen():
    """Orbax's warnings go through absl's logger; ours are shown."""
    code = (
        "from humangs_jax.cli.screen import silence; import logging, warnings; silence(False)\n"
        "logging.getLogger('absl').warning('noise'); warnings.warn('noise')\n"
        "logging.getLogger('humangs_jax.training').warning('ours')"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stderr == "humangs: ours\n"


@pytest.mark.parametrize("verbose", [False, True])
def test_errors_in_threads_of_libraries_stay_off_the_screen(verbose):
    """TensorStore's have nobody to report to: `train` showed their tracebacks on a full disk. Those of ours are shown."""
    code = (
        f"from humangs_jax.cli.screen import silence; import threading; silence({verbose})\n"
        "class Broken:\n"
        "    def __init__(self, name): self.name = name\n"
        "    def __del__(self): raise RuntimeError(self.name)\n"
        "thread = threading.Thread(target=Broken, args=('theirs',)); thread.start(); thread.join(); Broken('ours')"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert ("theirs" in done.stderr) == verbose and "RuntimeError: ours" in done.stderr, done.stderr


# Places that cannot be written to -------------------------------------------------------------------------------------


PLACES = {
    "a folder": ("folder.npz", "is a folder: expected the name of a file"),
    "in a file": ("file.npz/a.npz", "is no folder"),
    "nowhere": ("nowhere/a.npz", "does not exist"),
    "another suffix": ("a.zip", "expected a name ending in .npz"),
    "of another kind": ("body.npz", "exists and is no avatar"),
    "not writable": ("/proc/a.npz", "cannot write to /proc"),
}


@pytest.mark.parametrize("place", PLACES)
def test_files_that_cannot_be_written_are_refused_before_the_work(place, tmp_path, monkeypatch, capsys):
    name, problem = PLACES[place]
    if name.startswith("/proc") and not sys.platform.startswith("linux"):
        pytest.skip("needs Linux's /proc")
    monkeypatch.chdir(tmp_path)
    Path("folder.npz").mkdir()
    Path("file.npz").write_text("mine")
    np.savez("body.npz", body="makehuman")
    code, out, err = run(monkeypatch, capsys, "reconstruct", "no_capture", "--out", name)
    assert code == cli.BAD_USAGE and out == "" and err.startswith(f"humangs: error: --out {name}: ") and problem in err
    assert sorted(path.name for path in tmp_path.iterdir()) == ["body.npz", "file.npz", "folder.npz"]


FILE = "file"
"""A file where a folder is wanted."""


@pytest.mark.parametrize(
    ("arguments", "option"),
    [
        (("demo", "--out", FILE), "--out"),
        (("synth", "--out", FILE), "--out"),
        (("train", "--on-the-fly", "1", "--out", FILE), "--out"),
        (("import", "cameras", "c", "--images", "i", "--out", FILE), "--out"),
        (("fit", "capture", "--keypoints", "k", "--out", FILE), "--out"),
        (("fit", "--scan", "s.obj", "--out", FILE), "--out"),
        (("fit", "--scan", "s.obj", "--views", FILE), "--views"),
        (("start", "photos", "--out", FILE), "--out"),
        (("render", "me.npz", "--out", FILE), "--out"),
    ],
)
def test_folders_that_cannot_be_written_are_refused_before_the_work(arguments, option, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    Path(FILE).write_text("mine")
    code, out, err = run(monkeypatch, capsys, *arguments)
    assert code == cli.BAD_USAGE and out == "" and err.startswith(f"humangs: error: {option} {FILE}: is a file"), err
    assert Path(FILE).read_text() == "mine"


def test_places_are_checked_before_anything_heavy_is_imported(tmp_path):
    code = (
        "import sys; from humangs_jax import cli\n"
        "for words in (['reconstruct', 'x', '--out', 'no/a.npz'], ['refine', 'x', 'y', '--out', 'no/a.npz'],"
        " ['check', 'x', '--out', 'a.npz'], ['convert', 'x', '--out', 'a.npz'], ['demo', '--size', '0'],"
        " ['synth', '--workers', '0'],"
        " ['fit', 'x', '--keypoints', 'k', '--out', '.'], ['import', 'cameras', 'c', '--images', 'i', '--out', '.'],"
        " ['start', 'p', '--out', '.'], ['train', '--on-the-fly', '-1'], ['animate', 'x', '--out', 'no/a.mp4'],"
        " ['render', 'x', '--size', '0'], ['export', 'x', '--out', 'no/a.ply']):\n"
        "    assert cli.execute(words) == cli.BAD_USAGE, words\n"
        "assert 'jax' not in sys.modules and 'numpy' not in sys.modules"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=tmp_path, check=False)
    assert done.returncode == 0, done.stderr
    assert len(done.stderr.splitlines()) == 13 and list(tmp_path.iterdir()) == []


def test_what_a_command_reads_is_not_replaced(tiny_avatar, folder, monkeypatch, capsys):
    before = tiny_avatar.read_bytes()
    code, _, err = run(monkeypatch, capsys, "refine", tiny_avatar, folder, "--out", tiny_avatar)
    assert code == cli.BAD_USAGE and "is read by this command" in err and tiny_avatar.read_bytes() == before


# Bad input ------------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def tiny_avatar(tmp_path_factory):
    path = tmp_path_factory.mktemp("avatars") / "me.npz"
    save_tiny_avatar(path)
    return path


@pytest.fixture(scope="module")
def things(tmp_path_factory, tiny_avatar):
    """A folder of files that are not what they are taken for."""
    path = tmp_path_factory.mktemp("things")
    data = tiny_avatar.read_bytes()
    shutil.copyfile(tiny_avatar, path / "me.npz")
    (path / "truncated.npz").write_bytes(data[: len(data) // 2])
    middle = data.index(b"quats.npy") + 100
    (path / "altered.npz").write_bytes(data[:middle] + bytes([data[middle] ^ 16]) + data[middle + 1 :])
    arrays = dict(np.load(tiny_avatar))
    header = json.loads(str(arrays["header"]))
    write = lambda name, **changes: np.savez(path / name, **{**arrays, **changes})
    write("other_numbers.npz", colors=np.full((3, 3), 0.25, np.float32))
    del header["checksum"]
    write("nan.npz", header=json.dumps(header), means=np.full((3, 3), np.nan, np.float32))
    np.savez(path / "no_keys.npz", header=arrays["header"])
    write_png(path / "photo.png", np.ones((8, 8, 3)))
    (path / "cloud.ply").write_bytes(b"ply\nformat ascii 1.0\nelement vertex 0\nend_header\n")
    np.savez(path / "ten.npz", poses=np.zeros((2, 30)), trans=np.zeros((2, 3)), mocap_framerate=30)
    np.savez(path / "far.npz", poses=np.zeros((2, 165)), trans=np.full((2, 3), 1e6), mocap_framerate=30)
    np.savez(path / "pickled.npz", poses=np.array([{"a": 1}], dtype=object), trans=np.zeros((1, 3)))
    return path


HUGE = "100000"
BAD_INPUT = [
    (("export", "truncated.npz"), "truncated.npz: not an avatar file"),
    (("export", "altered.npz"), "altered.npz: not an avatar file"),
    (("export", "other_numbers.npz"), "other_numbers.npz"),
    (("export", "nan.npz"), "nan.npz: means: expected"),
    (("export", "no_keys.npz"), "no_keys.npz: missing keys"),
    (("export", "photo.png"), "photo.png: not an avatar file"),
    (("animate", "cloud.ply"), "cloud.ply: not an avatar file"),
    (("reconstruct", "photo.png"), "photo.png"),
    (("reconstruct", "cloud.ply"), "cloud.ply"),
    (("reconstruct", "me.npz"), "me.npz"),
    (("check", "photo.png"), "photo.png"),
    (("fit", "photo.png", "--keypoints", "k.json"), "photo.png"),
    (("start", "cloud.ply", "--out", "new"), "cloud.ply: is a file: expected a folder of photos"),
    (("animate", "me.npz", "--motion", "ten.npz"), "ten.npz: poses: expected"),
    (("animate", "me.npz", "--motion", "pickled.npz"), "pickled.npz: no motion: expected one of the keys"),
    (("animate", "me.npz", "--motion", "far.npz"), "far.npz"),
    (("convert", "nobody.pt"), "nobody.pt: no such file"),
    (("convert", "photo.png"), "photo.png"),
    *((("animate", "me.npz", "--size", size), f"--size {size}: expected") for size in ("-5", "0", HUGE)),
    *((("render", "me.npz", "--size", size), f"--size {size}: expected") for size in ("-5", "0", HUGE)),
    *((("demo", "--size", size), f"--size {size}: expected 16 to 8192") for size in ("-5", "0", HUGE)),
    *((("synth", "--size", size), f"--size {size}: expected 128, 256 or 512") for size in ("-5", "0", "100", HUGE)),
    (("refine", "me.npz", "me", "--image-size", "0"), "--image-size 0: expected 16 to 8192"),
    (("animate", "me.npz", "--azimuth", "nan"), "--azimuth nan: expected a number from"),
    (("demo", "--refine", "inf"), "--refine inf: expected at least 0"),
    (("synth", "--workers", "0"), "--workers 0: expected at least 1"),
    (("synth", "--for-training", "--views", "7"), "--views 7: does not go with --for-training, which means 12"),
    (("start", "me", "--out", "new", "--masks", "m", "--without-masks"), "--masks m: does not go with --without-masks"),
    (("train", "--on-the-fly", "-1"), "--on-the-fly -1: expected at least 0"),
    (("train", "--on-the-fly", "1", "--steps", "0"), "--steps 0: expected at least 1"),
    (("train",), "nobody to train on"),
]


@pytest.mark.parametrize(("arguments", "message"), BAD_INPUT)
def test_bad_input_is_one_line_with_file_and_key(arguments, message, things, tmp_path, monkeypatch, capsys):
    """Bad usage ends with 2, bad data with 1; nothing is written."""
    shutil.copytree(things, tmp_path, dirs_exist_ok=True)
    monkeypatch.chdir(tmp_path)
    before = sorted(tmp_path.rglob("*"))
    code, out, err = run(monkeypatch, capsys, *arguments)
    usage = message.startswith(("--", "nobody to"))
    assert err.count("\n") == 1 and err.startswith("humangs: error: ") and message in err and out == "", (out, err)
    assert code == (cli.BAD_USAGE if usage else cli.BAD_DATA)
    assert sorted(tmp_path.rglob("*")) == before


def test_a_capture_that_looks_wrong_is_warned_about(folder, tmp_path, monkeypatch, capsys):
    """The quick part of `check`; without weights that can be read the command ends before the work."""
    turned = tmp_path / "turned"
    shutil.copytree(folder, turned)
    spoil_body(lambda arrays: arrays.update(rotations=np.degrees(arrays["rotations"])))(turned)
    arguments = ("reconstruct", turned, "--weights", tmp_path / "none", "--out", tmp_path / "a.npz")
    code, _, err = run(monkeypatch, capsys, *arguments)
    assert code == cli.BAD_DATA and "warning: the poses seem to be in degrees" in err and "humangs check" in err
    _, _, err = run(monkeypatch, capsys, *arguments, "--no-check")
    assert "warning" not in err
