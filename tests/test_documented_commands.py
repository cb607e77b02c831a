"""Every `humangs` and `python` line of README, docs and notebooks is one that the real parser
takes; quick ones are run.
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
FENCE = re.compile(
    r"^(?P<fence>```+|~~~+)[ \t]*(?P<kind>[\w+-]*)[^\n]*\n(?P<text>.*?)^(?P=fence)[ \t]*$",
    re.DOTALL | re.MULTILINE,
)
SPAN = re.compile(r"(?<!`)`(?P<text>[^`]+)`(?!`)")
SHELLS = ("", "sh", "bash", "shell", "console", "text", "zsh")
ENDS, BAR = {"&&", "||", "|", ";", "&"}, "\N{BROKEN BAR}"
LAUNCHERS = ("srun", "env", "time", "nice", "nohup", "sudo", "exec")
PROGRAM = re.compile(r"(?:.*/)?(humangs|python3?)$")


class Command(NamedTuple):
    """words: without prompt and program before it, placeholders as they stand. whole: of a block,
    or the beginning of an item of a list; others may lack arguments.
    """

    page: str
    words: tuple[str, ...]
    whole: bool

    def __str__(self):
        return f"{self.page}: {' '.join(self.words)}"


def commands_of(path):
    """All commands of a page or notebook, each once, in its order."""
    text = path.read_text()
    if path.suffix != ".ipynb":
        return commands_in(text, path.name)
    found = []
    for cell in json.loads(text)["cells"]:
        source = "".join(cell["source"])
        if cell["cell_type"] == "markdown":
            found += commands_in(source, path.name)
        elif cell["cell_type"] == "code":
            lines = "\n".join(
                line.lstrip()[1:] for line in source.splitlines() if line.lstrip().startswith("!")
            )
            found += [Command(path.name, words, True) for words in split_shell(lines)]
    return list(dict.fromkeys(found))


def commands_in(text, page):
    """Of a Markdown text: those of its shell blocks, and those in its code spans."""
    found = []
    for block in FENCE.finditer(text):
        if block["kind"].lower() in SHELLS:
            found += [Command(page, words, True) for words in split_shell(block["text"])]
    prose = FENCE.sub("", text)
    for span in SPAN.finditer(prose):
        item = prose[: span.start()].endswith(("\n- ", "\n* "))
        found += [
            Command(page, words, item) for words in split_shell(" ".join(span["text"].split()))
        ]
    return list(dict.fromkeys(found))


def split_shell(text):
    """The commands of `humangs` and `python` in lines of a shell: continued lines, comments,
    prompts, `a && b`, `X=1 a`, what a launcher (srun) starts, and what stands in quotes after one
    (ssh --command "a").
    """
    text = re.sub(r"\\\n[ \t]*", " ", text)
    found = []
    for line in text.splitlines():
        line = re.sub(r"^\s*(?:\$|>|%)\s+", "", line)
        line = re.sub(r"(?<=\S)\|(?=\S)", BAR, line)  # one of several values, and no pipe
        lexer = shlex.shlex(line, posix=True, punctuation_chars="&|;")
        lexer.whitespace_split, lexer.commenters = True, "#"
        try:
            words = [*(word.replace(BAR, "|") for word in lexer), ";"]
        except ValueError:  # an apostrophe: prose
            continue
        start = 0
        for i, word in enumerate(words):
            if word in ENDS:
                found += of_one(words[start:i])
                start = i + 1
    return found


def of_one(words):
    """The command among the words of one line of a shell: none, one, or those in a quoted
    argument.
    """
    for i, word in enumerate(words):
        if match := PROGRAM.fullmatch(word):
            return [(match[1].replace("python3", "python"), *words[i + 1 :])]
        if word not in LAUNCHERS and not re.match(r"\w+=", word):
            break
    return [command for word in words if " " in word for command in split_shell(word)]


def filled(words):
    """Optional parts as if they were given, the first of several values, and 1 for what is in
    capitals or is a variable.
    """
    words = [word.strip("[]").split("|")[0] for word in words if word not in ("...", "…")]
    return [re.sub(r"\$\{?\w+\}?|(?<![\w.])[A-Z][A-Z_]*(?![\w.])", "1", word) for word in words]


# The tests
# --------------------------------------------------------------------------------------------------


COMMANDS = [command for page in PAGES for command in commands_of(page)]
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
    "refine avatar.npz CAPTURE --limit 15s --out sharp.npz",
    "export avatar.npz --out person.glb --mesh --motion dance.bvh",
    "export avatar.npz --out person.obj",
    "render avatar.npz --out views --views 8 --exr --channels rgba,z,position,normal,part",
    "render avatar.npz --out views --capture CAPTURE",
    "animate avatar.npz",
    "evaluate me --avatar avatar.npz --protocol lhm",
)
"""And on the demo's photos, in this order: the first ones make what the others read."""


def refused(command):
    """None, or why a line of a page cannot be typed: what the parser says; of a span, a name or an
    option that does not exist.
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
    ("text", "expected"),
    [
        ("$ humangs check me   # look", ["humangs check me"]),
        ("humangs train a \\\n    --out b \\\n    --fsdp 8", ["humangs train a --out b --fsdp 8"]),
        (
            "python3 -m venv .venv && .venv/bin/humangs demo --out o",
            ["python -m venv .venv", "humangs demo --out o"],
        ),
        ("X=1 humangs demo; humangs view a &", ["humangs demo", "humangs view a"]),
        ('ssh NAME --command "humangs train p --out o"', ["humangs train p --out o"]),
        ("srun humangs train p --background '#1' # 2", ["humangs train p --background #1"]),
        ("# humangs is not a command here\nit's humangs", []),
        (
            "humangs preprocess thuman|thuman4 SRC | tee log",
            ["humangs preprocess thuman|thuman4 SRC"],
        ),
    ],
)
def test_lines_of_a_shell_are_read_as_a_shell_reads_them(text, expected):
    assert [" ".join(words) for words in split_shell(text)] == expected


def test_blocks_and_beginnings_of_items_are_whole_and_other_spans_are_not():
    text = (
        "See `humangs fit\nme --scan S`.\n```sh\nhumangs fit me\n```\n```python\nhumangs ="
        " 1\n```\n~~~\nhumangs view x\n~~~\n"
    )
    found = commands_in(text + "- `humangs check me`, `humangs tune`\n", "page")
    assert found == [
        Command("page", ("humangs", "fit", "me"), True),
        Command("page", ("humangs", "view", "x"), True),
        Command("page", ("humangs", "fit", "me", "--scan", "S"), False),
        Command("page", ("humangs", "check", "me"), True),
        Command("page", ("humangs", "tune"), False),
    ]
    assert filled(["SOURCE", "[--up=+z]", "integer|half", "$A/x.npz", "..."]) == [
        "1",
        "--up=+z",
        "integer",
        "1/x.npz",
    ]


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
    """The files that the commands above name: a capture, an avatar, two motions."""
    rest = np.asarray(shape_body(load_body(), jnp.zeros(0)).joints)
    save_tiny_avatar(tmp_path / "avatar.npz", rest)
    (tmp_path / "dance.bvh").write_text(write_bvh(rest, np.zeros((201, len(rest), 3)), CMU))
    shutil.copyfile(ROOT / "humangs_jax/assets/walk.npz", tmp_path / "dance.npz")
    monkeypatch.chdir(tmp_path)
    return tmp_path


def run_all(lines, humangs):
    """The exit codes; every line must stand on a page."""
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
