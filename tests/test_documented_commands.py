"""The real parser accepts every `humangs` and `python` line of README, docs and notebooks.

Some lines are run.
"""

import contextlib
import importlib
import io
import json
import re
import shlex
import shutil
from pathlib import Path
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
import pytest
from bvh_files import CMU, write_bvh
from command_line import save_tiny_avatar

from experiments.harness import listed, parser_of
from humangs_jax import cli
from humangs_jax.body.library import load_body
from humangs_jax.body.model import shape_body
from humangs_jax.cli.options import UsageError, option_names
from humangs_jax.data.capture import load_capture, save_capture

ROOT = Path(__file__).parents[1]
PAGES = [
    ROOT / "README.md",
    *sorted((ROOT / "docs").glob("*.md")),
    ROOT / "humangs_jax/assets/weights.md",
    *sorted((ROOT / "notebooks").glob("*.ipynb")),
    ROOT / "colab/humangs_jax.ipynb",
]
BLOCK = re.compile(r"^ *```(\w*)\n(.*?)^ *```", re.DOTALL | re.MULTILINE)
SPAN = re.compile(r"(\n[-*] )?`([^`]+)`")
SEPARATOR = r"&&|;| \| |srun |ssh .*?--command|^(?:\w+=\S+ )+"
PROGRAM = re.compile(r"(?:.*/)?(humangs|python)3?")


class Command(NamedTuple):
    """A command on a page: its words with placeholders.

    `whole` is true in a block and at the beginning of a list item; other commands may lack
    arguments.
    """

    page: str
    words: tuple[str, ...]
    whole: bool

    def __str__(self):
        return f"{self.page}: {' '.join(self.words)}"


def text_of(path):
    """Returns the text of a page; a notebook's lines for the shell are added as a block."""
    if path.suffix != ".ipynb":
        return path.read_text()
    cells = json.loads(path.read_text())["cells"]
    lines = ["".join(cell["source"]) for cell in cells if cell["cell_type"] == "markdown"]
    code = ["".join(cell["source"]) for cell in cells if cell["cell_type"] == "code"]
    shell = re.findall(r"^!(.*)$", "\n".join(code), re.MULTILINE)
    return "\n".join([*lines, "```sh", *shell, "```"])


def commands_of(path):
    """Yields the commands in the shell blocks and in the code spans of a page."""
    text = text_of(path)
    blocks = [block for kind, block in BLOCK.findall(text) if kind in ("", "sh", "bash")]
    lines = [(line, True) for block in blocks for line in re.sub(r"\\\n", " ", block).splitlines()]
    prose = BLOCK.sub("", text)
    lines += [(" ".join(span.split()), bool(item)) for item, span in SPAN.findall(prose)]
    for line, whole in lines:
        for part in re.split(SEPARATOR, line.split(" #")[0]):
            words = part.strip(' "').split(" ")
            program = PROGRAM.fullmatch(words[0])
            if program:
                yield Command(path.name, (program[1], *shlex.split(" ".join(words[1:]))), whole)


def filled(words):
    """Returns the words with values for placeholders.

    Optional parts are given, of several values the first is taken, and 1 stands for variables and
    words in capitals.
    """
    words = [word.strip("[]").split("|")[0] for word in words if word not in ("...", "…")]
    return [re.sub(r"\$\{?\w+\}?|(?<![\w.])[A-Z][A-Z_]*(?![\w.])", "1", word) for word in words]


COMMANDS = list(dict.fromkeys(command for page in PAGES for command in commands_of(page)))
OURS = [command for command in COMMANDS if command.words[0] == "humangs" and len(command.words) > 1]
QUICK = (
    "export avatar.npz --out person.ply",
    "export avatar.npz --out person.spz --motion dance.bvh --frame 40",
    "export avatar.npz --out dance.ply --motion dance.bvh --frames 0:200:5",
    "export avatar.npz --html avatar.html",
    "export avatar.npz --html dance.html --motion dance.npz",
)
"""Commands that are run as documented on an avatar of three Gaussians."""
SLOW = (
    "check me --out check.png",
    "reconstruct CAPTURE --out avatar.npz",
    "refine avatar.npz CAPTURE --refine 15s --out sharp.npz",
    "export avatar.npz --out person.glb --mesh --motion dance.bvh",
    "export avatar.npz --out person.obj",
    "render avatar.npz --out views --views 8 --exr --channels rgba,z,position,normal,part",
    "render avatar.npz --out views --capture CAPTURE",
    "animate avatar.npz",
    "evaluate me --avatar avatar.npz --protocol lhm",
)
"""Commands that are run on the demo's photos, in this order: early ones make inputs of later ones.
"""


def refused(command):
    """Returns why a line of a page cannot be typed, or None.

    For a whole line the parser tells; for a span, a name or an option that does not exist.
    """
    name, *words = filled(command.words[1:])
    if not command.whole:
        if name not in cli.COMMANDS:
            return None if name.startswith("-") else f"{name} is no command"
        known = option_names(cli._command(name))
        return [
            word for word in words if word.startswith("--") and word.split("=")[0] not in known
        ] or None
    printed = io.StringIO()
    try:
        with contextlib.redirect_stderr(printed), contextlib.redirect_stdout(printed):
            cli._parsed([name, *words])
    except SystemExit as exit_:
        return None if exit_.code in (0, None) else printed.getvalue()
    except UsageError as error:
        return str(error)
    return None


@pytest.mark.parametrize("command", OURS, ids=str)
def test_a_documented_command_is_one_that_the_parser_takes(command):
    assert refused(command) is None, f"{command}\n{refused(command)}"


def test_documented_scripts_and_tests_exist():
    scripts = [
        words[1] for _, words, _ in COMMANDS if words[0] == "python" and words[1:2] != ("-m",)
    ]
    tests = [
        word
        for _, words, _ in COMMANDS
        if words[1:3] == ("-m", "pytest")
        for word in words
        if word.startswith("tests/")
    ]
    assert (
        scripts
        and tests
        and [name for name in (*scripts, *tests) if not (ROOT / name).exists()] == []
    )


def test_documented_experiments_exist_and_take_their_options():
    known, asked = (
        listed(),
        [command for command in COMMANDS if command.words[1:3] == ("-m", "experiments")],
    )
    for command in (command for command in asked if len(command.words) > 3):
        name, *options = command.words[3:]
        assert name in known, command
        if command.whole or options:
            parser_of(getattr(importlib.import_module(known[name][0]), name))[0].parse_args(
                filled(options)
            )


def test_every_command_is_shown_somewhere():
    assert {command.words[1] for command in OURS} >= set(cli.COMMANDS)


@pytest.mark.parametrize(
    "words",
    [
        "train DATA --out RUN --vgg-19 F",
        "export a.npz --out b.ply --frame",
        "import photos",
        "trian DATA",
    ],
)
def test_a_wrong_line_is_noticed(words):
    assert refused(Command("page", ("humangs", *words.split()), True))
    assert refused(Command("page", ("humangs", "train", "--vgg-19"), False))
    assert refused(Command("page", ("humangs", "trian", "--out"), False))


@pytest.fixture
def workspace(tmp_path, monkeypatch):
    """Returns the working folder with the files that commands name: capture, avatar, motions."""
    rest = np.asarray(shape_body(load_body(), jnp.zeros(0)).joints)
    save_tiny_avatar(tmp_path / "avatar.npz", rest)
    (tmp_path / "dance.bvh").write_text(write_bvh(rest, np.zeros((201, len(rest), 3)), CMU))
    shutil.copyfile(ROOT / "humangs_jax/assets/walk.npz", tmp_path / "dance.npz")
    monkeypatch.chdir(tmp_path)
    return tmp_path


def run_all(lines, humangs):
    """Runs lines and checks that they succeed; every line must stand on a page."""
    shown = {" ".join(command.words[1:]) for command in OURS if command.whole}
    assert [line for line in lines if line not in shown] == []
    for line in lines:
        words = line.replace("CAPTURE", "me").split()
        code, _, err = humangs(*words)
        assert code == 0, f"{line}: {err}"


@pytest.mark.slow
def test_documented_exports_run(workspace, humangs):
    run_all(QUICK, humangs)
    made = {path.name for path in workspace.iterdir()}
    assert made >= {
        "person.ply",
        "person.spz",
        "avatar.html",
        "dance.html",
        "dance_0000.ply",
        "dance_0195.ply",
    }


@pytest.mark.slow
def test_documented_commands_run_on_the_photos_of_the_demo(workspace, humangs):
    save_capture(workspace / "me", load_capture("demo_capture"))
    save_capture(workspace / "me" / "held_out", load_capture("demo_capture/held_out"))
    run_all(SLOW, humangs)
    made = {path.name for path in workspace.iterdir()}
    assert made >= {"check.png", "sharp.npz", "person.glb", "person.obj", "animation.mp4", "views"}
