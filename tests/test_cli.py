import dataclasses
import functools
import inspect
import io
import logging
import os
import re
import shlex
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace
from typing import ClassVar

import pytest

from humangs_jax import __version__, cli
from humangs_jax.cli import fit, options, screen
from humangs_jax.cli.options import UsageError
from humangs_jax.core import progress
from humangs_jax.core.configuration import ArgumentError
from humangs_jax.core.progress import stage

COMMANDS = tuple(cli.COMMANDS)


def test_every_page_that_a_help_text_names_exists():
    docs = Path(__file__).parents[1]
    sources = [file.read_text() for file in Path(cli.__file__).parent.glob("*.py")]
    pages = {page for text in sources for page in re.findall(r"\bdocs: (\w+)", text)}
    assert len(pages) > 4 and all((docs / f"docs/{page}.md").is_file() for page in pages), pages


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_explains_itself(command, humangs):
    code, out, _ = humangs(command, "--help")
    assert (
        code == 0 and ("--out" in out or command in ("view", "evaluate")) and "docstring" not in out
    )
    assert "None" not in out and "docs/" not in out
    lines = out.split("examples:\n")[1].splitlines()
    assert len(lines) == len(set(lines)) == 2
    for line in lines:
        assert line.startswith(f"  humangs {command} ")
        cli._parsed(shlex.split(line)[1:])
    shown = set(re.findall(r"^.? (--[a-z][\w-]*)", out, re.MULTILINE))  # with boxes or without
    assert shown == options.option_names(cli._command(command))


@pytest.mark.parametrize("command", COMMANDS)
def test_the_help_of_a_switch_that_is_on_says_what_typing_it_does(command, humangs):
    """A user can type `--no-x`: its help says what that does; the field's, what the switch does."""
    _, out, _ = humangs(command, "--help")
    shown = " ".join(re.sub("[\u2500-\u257f]", " ", out).split())
    source = inspect.getsource(cli._command(command))
    for field, hint in options.fields_of(cli._command(command)):
        if field.default is not True:
            continue
        (off,) = [each.help for each in hint.__metadata__ if getattr(each, "help", None)]
        assert off.startswith("Do not ") and f"--no-{field.name.replace('_', '-')} {off}" in shown
        written = rf'^    {field.name}: .*?\n    """(.*?)"""'
        about = re.findall(written, source, re.MULTILINE | re.DOTALL)[0]
        assert not re.match(
            r"(do not|no|not|without|skip|take|leave|print)\b", about, re.IGNORECASE
        ), about


def test_the_package_runs_as_a_module():
    run = [sys.executable, "-m", "humangs_jax", "--version"]
    done = subprocess.run(run, capture_output=True, text=True, check=True)
    assert (done.stdout, done.stderr) == (f"humangs_jax {__version__}\n", "")


def test_the_usage_of_an_import_can_be_typed_as_it_stands(humangs):
    _, out, _ = humangs("import", "cameras", "--help")
    assert out.startswith("usage: humangs import cameras [-h] [OPTIONS] SOURCE")


def test_the_options_of_each_way_to_fit_exist():
    parts = (fit.Detections, fit.MaskFit, fit.Fit)
    options = {field.name for part in parts for field in dataclasses.fields(part)}
    for way, others in fit.WAYS.items():
        assert others | {way.removeprefix("--").replace("-", "_")} <= options


@pytest.mark.parametrize(("done", "code"), [(3, cli.INTERRUPTED), (5, 0)])
def test_training_that_was_stopped_says_how_far_it_came(done, code, tmp_path, monkeypatch, capsys):
    """After Ctrl-C `train` saves and raises; the exit code shows it, unless all steps were done."""
    from humangs_jax.training import loop, sources

    def interrupted(*arguments, **options):
        # a whole state is not needed
        stopped = loop.TrainingInterrupted.__new__(loop.TrainingInterrupted)
        stopped.state = SimpleNamespace(step=done)
        raise stopped

    monkeypatch.setattr(sources, "training_people", lambda *arguments: None)
    monkeypatch.setattr(loop, "train", interrupted)
    words = [
        "train",
        "--config",
        "tiny",
        "--steps",
        "5",
        "--on-the-fly",
        "1",
        "--out",
        str(tmp_path),
    ]
    assert cli.execute(words) == code
    out, err = capsys.readouterr()
    assert f"{tmp_path}: {done} of 5 steps" in out and ("interrupted" in err) == (code != 0)
    assert (f"--weights {tmp_path / 'weights.safetensors'}" in out) == (code == 0)


# What a command shows
# -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("words", "problem"),
    [
        (
            "reconstruct me --refin 15s",
            "--refin: no option of humangs reconstruct: did you mean --refine?",
        ),
        (
            "start photos --out me --fit-masks",
            "--fit-masks: no option of humangs start: did you mean --no-fit-masks?",
        ),
        ("synth --zzz", "--zzz: no option of humangs synth"),
    ],
)
def test_a_wrong_option_is_one_line_with_the_nearest(words, problem, humangs):
    assert humangs(*words.split()) == (cli.BAD_USAGE, "", f"humangs: error: {problem}\n")


def test_version_and_unknown_commands(humangs):
    assert humangs("--version") == (0, f"humangs_jax {__version__}\n", "")
    assert humangs("check", "--version")[0] == 0
    assert humangs("chekc") == (
        cli.BAD_USAGE,
        "",
        "humangs: error: 'chekc' is no command: did you mean 'check'?\n",
    )


@dataclasses.dataclass(frozen=True)
class Sample:
    """A command of two stages."""

    examples: ClassVar = ()

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


@pytest.mark.parametrize("encoding", ["ascii", "utf-8"])
@pytest.mark.parametrize("name", ["für mich", "it's \\ 1", "a\nb", "\udce9t\udce9", "plain"])
def test_a_path_of_the_next_command_can_be_pasted(name, encoding, monkeypatch):
    """bash gets the bytes of the name, whatever the terminal shows."""
    monkeypatch.setattr(sys, "stdout", io.TextIOWrapper(io.BytesIO(), encoding=encoding))
    text = screen.quoted(Path(name))
    assert text.isprintable() and text.encode(encoding)
    bash = ["bash", "-c", f"printf %s {text}"]
    assert subprocess.run(
        bash, capture_output=True, check=True, env={"LC_ALL": "C.UTF-8"}
    ).stdout == os.fsencode(name)


def test_a_command_ends_with_what_it_wrote_how_long_it_took_and_what_is_next(sample, capsys):
    assert cli.execute(["sample"]) == 0
    out, err = capsys.readouterr()
    report, written, took, following = out.splitlines()
    assert (report, written, err) == (
        "the report",
        "my file.npz: 3 numbers",
        "humangs: warning: odd\n",
    )
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
    assert "--quiet      results, warnings and errors only" in cli.EVERYWHERE
    assert cli.execute(["sample", "--verbose"]) == 0
    assert re.search(r"counting: \d+\.\d s\nwriting: ", capsys.readouterr().err)
    assert cli.execute(["sample", "--verbose", "--fails", "data"]) == cli.BAD_DATA
    assert "Traceback" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("fails", "code"), [("usage", 2), ("data", 1), ("option", 2), ("keys", 130)]
)
def test_exit_codes(sample, capsys, fails, code):
    """A wrong argument of the library is a wrong option of the command."""
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
    assert (
        cli.execute(["sample"]) == cli.INTERRUPTED
        and capsys.readouterr().err == "\nhumangs: interrupted\n"
    )
    monkeypatch.setattr(Sample, "run", lambda self: 1 / 0)  # a mistake of ours is not hidden
    with pytest.raises(ZeroDivisionError):
        cli.execute(["sample"])


def test_a_stage_on_a_terminal_counts_its_seconds(monkeypatch, capsys):
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
    assert (
        "compiling ... 0 s" in err and "compiling: the step ... 0 s" in err and "steps: 100%" in err
    )
    assert re.search(r"compiling: 0\.\d s\n$", err) and list(shown.seconds) == ["compiling"]


def test_bars_are_hidden_by_quiet(capsys):
    progress.begin(quiet=True)
    try:
        assert list(progress.bar(range(3))) == [0, 1, 2] and not progress.watched()
    finally:
        progress.end()
    assert capsys.readouterr().err == ""


def test_a_reader_that_has_gone_ends_a_command_quietly():
    """As in `humangs check X | head -0`, the other end of a real pipe is closed at once."""
    program = subprocess.Popen(
        [sys.executable, "-m", "humangs_jax.cli", "--version"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
    )
    program.stdout.close()
    error = program.stderr.read()
    program.stderr.close()
    assert program.wait() == cli.BROKEN_PIPE and error == b""


@pytest.mark.parametrize("verbose", [False, True])
def test_what_libraries_say_stays_off_the_screen(verbose):
    """Orbax warns through absl's logger, and errors in TensorStore's threads have no receiver. Our
    warnings are shown.
    """
    code = (
        "from humangs_jax.cli.screen import silence; import logging, threading, warnings;"
        f" silence({verbose})\nlogging.getLogger('absl').warning('theirs');"
        " warnings.warn('theirs')\nlogging.getLogger('humangs_jax.training').warning('ours')\nclass"
        " Broken:\n    def __init__(self, name): self.name = name\n    def __del__(self): raise"
        " RuntimeError(self.name)\nthread = threading.Thread(target=Broken, args=('theirs',));"
        " thread.start(); thread.join(); Broken('ours')"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert ("theirs" in done.stderr) == verbose and "RuntimeError: ours" in done.stderr, done.stderr
    assert verbose or done.stderr.startswith("humangs: ours\n")


def test_help_and_checks_of_places_import_nothing_heavy(tmp_path):
    code = (
        "import sys; from humangs_jax import cli; print(cli.overview())\nfor words in"
        " (['reconstruct', 'x', '--out', 'a.zip'], ['refine', 'x', 'y', '--out', 'a.zip'],"
        " ['check', 'x', '--out', 'a.npz'], ['convert', 'x', '--out', 'a.npz'], ['demo', '--size',"
        " '0'], ['synth', '--workers', '0'], ['fit', 'x', '--keypoints', 'k', '--out', '.'],"
        " ['import', 'cameras', 'c', '--images', 'i', '--out', '.'], ['start', 'p', '--out', '.'],"
        " ['train', '--on-the-fly', '-1'], ['animate', 'x', '--out', 'a.txt'], ['render', 'x',"
        " '--size', '0'], ['export', 'x', '--out', 'a.zip']):\n    assert cli.execute(words) =="
        " cli.BAD_USAGE, words\nassert 'jax' not in sys.modules and 'numpy' not in sys.modules"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, cwd=tmp_path, check=False
    )
    assert done.returncode == 0, done.stderr
    assert len(done.stderr.splitlines()) == 13 and list(tmp_path.iterdir()) == []
    assert all(name in done.stdout for name in COMMANDS)
