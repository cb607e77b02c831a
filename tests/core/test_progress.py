"""Text of files cannot act on the terminal, and one module writes there."""

import io
import re
import sys
import time
from pathlib import Path

import pytest

import humangs_jax
from humangs_jax.core import progress
from humangs_jax.core.progress import printable
from humangs_jax.io.reading import FileError

PACKAGE = Path(humangs_jax.__file__).parent
OWN = ("core/progress.py", "cli/screen.py")
"""Modules that may write: the one for all, and the one that writes while the process ends."""


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("\x1b]0;OWNED\x07", r"\x1b]0;OWNED\x07"),
        ("\x1b[2J\x9b2J\x85", r"\x1b[2J\x9b2J\x85"),
        ("a\r\nb\tc\x00\x7f", r"a\r\nb\tc\x00\x7f"),
        ("\u202egnp.\u2066\u2069\u200e\ufeff", r"\u202egnp.\u2066\u2069\u200e\ufeff"),
        ("\u2028\u2029", r"\u2028\u2029"),
        ("caf\udce9 \udc9b2J \ud800", r"caf\xe9 \x9b2J \ud800"),
        ("\U000e0041", r"\U000e0041"),
    ],
)
def test_what_a_terminal_acts_on_is_escaped(text, shown):
    assert printable(text) == shown and shown.isprintable()


@pytest.mark.parametrize(
    "text", ["photo_01.png", "naïve", "写真　三", "صورة", "می‌خواهم", "a\u00a0b", "👩‍🎤"]
)
def test_words_of_all_languages_stay(text):
    assert printable(text) == text


def test_reports_keep_their_lines():
    assert printable("a\n\tb\r\x1b[2J", lines=True) == "a\n\tb\\r\\x1b[2J"


def test_errors_of_files_are_printable():
    error = FileError("me\x1b[2J.npz", "views\u202e", "a\nb\x9b")
    assert str(error) == r"me\x1b[2J.npz: views\u202e: a b\x9b"


def test_one_module_writes_to_the_terminal():
    """Other modules could forget what `say` does to unsafe text."""
    writes = re.compile(
        r"\bprint\(|std(out|err)\.write|\bbar\.write|tqdm\.write"
        r"|os\.write\([12],|logging\.StreamHandler"
    )
    found = {
        f"{path.relative_to(PACKAGE)}: {line.strip()}"
        for path in PACKAGE.rglob("*.py")
        if str(path.relative_to(PACKAGE)) not in OWN
        for line in path.read_text().splitlines()
        if writes.search(line.split("#")[0]) and not re.search(r"(?:hg|jax)\.|diagnose_\w+\(", line)
    }
    assert not found


@pytest.mark.parametrize("encoding", ["ascii", "latin-1", "utf-8"])
def test_any_name_can_be_printed_on_any_terminal(encoding, monkeypatch):
    stream = io.TextIOWrapper(io.BytesIO(), encoding=encoding)
    monkeypatch.setattr(sys, "stdout", stream)
    progress.say("写真 caf\udce9.png: 3 × 4\nsecond")
    stream.seek(0)
    first, second = stream.buffer.getvalue().decode(encoding).splitlines()
    assert "\\xe9.png: 3 " in first and second == "second"


def lines_of(shown):
    """Returns what is left on a terminal: the last text of every line."""
    return [line.rsplit("\r", 1)[-1].removeprefix("\033[K") for line in shown.split("\n")]


@pytest.mark.parametrize("terminal", [True, False])
def test_an_error_in_a_bar_is_a_line_of_its_own(terminal, monkeypatch, capsys):
    monkeypatch.setattr(sys.stderr, "isatty", lambda: terminal)
    progress.begin()
    try:
        with progress.stage("rendering"):
            for number in progress.bar(range(5), desc="render"):
                assert number < 3
    except AssertionError as error:
        progress.end()
        kept = error  # a traceback keeps the bar alive
        progress.say("humangs: error: no", error=True)
    assert kept
    assert "humangs: error: no" in lines_of(capsys.readouterr().err)


def test_a_message_beside_a_bar_has_a_line_for_itself(capsys):
    with progress.bar(total=3, desc="a\x1b[2J\nb") as shown:
        shown.update(1)
        shown.refresh()
        progress.say("humangs: warning: odd", error=True)
        shown.update(2)
    captured = capsys.readouterr().err
    assert (
        "humangs: warning: odd" in lines_of(captured)
        and r"a\x1b[2J\nb" in captured
        and "\x1b[2J" not in captured
    )


def test_a_bar_in_a_log_is_a_few_lines(capsys):
    for _ in progress.bar(range(300), desc="render"):
        time.sleep(0.001)
    assert capsys.readouterr().err.count("render") <= 3  # the first, perhaps one between, the last


def test_tables_are_aligned_and_rows_may_end_early():
    rows = [["view", "error", "share"], ["a long name", "1.0 px", "7%", "!"], ["b", "-"]]
    assert progress.text_table(rows) == [
        "view          error  share",
        "a long name  1.0 px     7%  !",
        "b                 -",
    ]
    assert progress.text_table([["a", "b"], ["cc", "d"]], left=2) == ["a   b", "cc  d"]


def test_long_stages_are_named_where_there_is_no_terminal(monkeypatch, capsys):
    monkeypatch.setattr(progress, "LONG", 0.05)
    for quiet in (False, True):
        progress.begin(quiet=quiet)
        with progress.stage("short"):
            pass
        with progress.stage("fitting"):
            time.sleep(0.3)
        progress.end()
        assert capsys.readouterr().err == ("" if quiet else "fitting ...\n")


def test_a_bar_says_why_its_first_item_takes_long(capsys):
    seen = []
    with progress.bar(iter("abc"), total=3, desc="render", first=progress.COMPILING) as shown:
        before = capsys.readouterr().err
        for item in shown:
            seen.append((item, shown.postfix))
    assert seen == [("a", ""), ("b", ""), ("c", "")]
    assert "render:   0%" in before and "compiling, once" in before
    assert "compiling" not in capsys.readouterr().err.rpartition("\r")[2]
    assert (
        list(progress.bar("abc", shown=False, first="x")) == ["a", "b", "c"]
        and capsys.readouterr().err == ""
    )


def test_long_loops_show_bars_where_a_program_shows_stages(capsys):
    assert not progress.followed()
    progress.begin()
    assert progress.followed()
    progress.begin(quiet=True)
    assert not progress.followed()
    progress.end()
