"""Parses the words of a command line into a command with its options.

tyro reports an error in a box of many lines; here it becomes one line.
"""

import contextlib
import difflib
import io
import os
import re
import shlex
from collections.abc import Generator, Sequence
from typing import Any, Literal, get_args, get_origin

from humangs_jax.cli.options import UsageError, fields_of, option_of, types_in


def parsed(command: type[Any], name: str, words: Sequence[str]) -> Any:
    """Parses words into a command with its options. name: name of the command, as it is typed.

    Raises: UsageError for wrong words; SystemExit after --help.
    """
    import tyro

    asked_for_help = "--help" in words or "-h" in words
    printed = io.StringIO()
    try:
        screen = contextlib.nullcontext() if asked_for_help else _wide_screen()
        with contextlib.redirect_stderr(printed), screen:
            return tyro.cli(
                command, prog=f"humangs {name}", args=words, config=(tyro.conf.FlagCreatePairsOff,)
            )
    except SystemExit as end:
        if not end.code:
            raise
        raise UsageError(_one_line(command, name, words, _inside(printed.getvalue()))) from None


def _inside(box: str) -> list[str]:
    """Returns the lines inside of a box that have any words. Their indents stay."""
    # characters that boxes are drawn with, or rules where the terminal knows ASCII only
    frame = "[\u2500-\u257f]+|-{3,}"
    lines = [re.sub(frame, "", line).rstrip() for line in box.splitlines()]
    return [line for line in lines if line]


@contextlib.contextmanager
def _wide_screen() -> Generator[None]:
    """Sets the width of the screen so high that tyro does not wrap its messages."""
    before = os.environ.get("COLUMNS")
    os.environ["COLUMNS"] = "10000"
    try:
        yield
    finally:
        if before is None:
            del os.environ["COLUMNS"]
        else:
            os.environ["COLUMNS"] = before


def _one_line(command: type[Any], name: str, words: Sequence[str], lines: list[str]) -> str:
    """Returns one line that says what is wrong with the words. lines: tyro's message."""
    text = " ".join(line.strip() for line in lines)
    example = f"as in `{command.examples[0]}`"
    match = re.search(r"[Ii]nvalid choice '(?P<given>.*?)' for argument '(?P<option>.*?)'", text)
    if match:
        return _wrong_value(command, match["option"], match["given"])
    match = re.search(r"Error parsing (?P<option>[\w-]+): ", text)
    if match:
        return _wrong_value(command, match["option"], _value_after(words, match["option"]))
    match = re.search(r"Missing value for argument '(?P<option>.*?)'", text)
    if match:
        return _no_value(command, match["option"], words)
    match = re.search(r"Unrecognized options: (?P<given>.*?) (For full|$)", f"{text} ")
    if match:
        return f"{match['given']}: not expected here, {example}"
    if "Missing from" in text:
        missing = _missing(lines)
        listed, verb = missing, "is"
        if len(missing) > 1:
            listed, verb = [", ".join(missing[:-1]), missing[-1]], "are"
        return f"{' and '.join(listed)} {verb} missing, {example}"
    plain = re.sub(r"For full helptext.*", "", text).strip()
    return f"{plain}: `humangs {name} --help` lists the options, {example}"


def _missing(lines: Sequence[str]) -> list[str]:
    """Returns the missing arguments that tyro's message lists: the lines with the least indent."""
    start = next(i for i, line in enumerate(lines) if "Missing from" in line)
    rows = lines[start + 1 :]
    indents = [len(row) - len(row.lstrip()) for row in rows]
    end = next((i for i, row in enumerate(rows) if "For full helptext" in row), len(rows))
    return [
        row.strip()
        for row, indent in zip(rows[:end], indents, strict=False)
        if indent == min(indents[:end])
    ]


def _value_after(words: Sequence[str], option: str) -> str:
    """Returns the value that was given to an option; "" if the words do not have the option."""
    for i, word in enumerate(words):
        typed, _, value = word.partition("=")
        if typed.replace("_", "-") == option:
            return value or " ".join(words[i + 1 : i + 2])
    return ""


def _wrong_value(command: type[Any], option: str, given: str) -> str:
    """Returns the line about a wrong value: what is expected, and the nearest possible word or the
    default.
    """
    choices = _choices(_kind(command, option))
    near = difflib.get_close_matches(given, choices, n=1)
    if near:
        hint = f": did you mean {shlex.quote(near[0])}?"
    else:
        hint = _usual(command, option)
    return f"{_shown(option)} {given}: expected {_expected(command, option)}{hint}"


def _no_value(command: type[Any], option: str, words: Sequence[str]) -> str:
    """Returns the line about an option without a value.

    A value that begins with "-", such as a negative number or an axis, has to be joined with "=".
    """
    following = []
    if option in words:
        following = words[words.index(option) + 1 :]
    joined = ""
    if following and following[0][1:2] not in ("", "-"):
        joined = f", as in {option}={following[0]}"
    return f"{option}: expected {_expected(command, option)} after it{joined}"


def _usual(command: type[Any], option: str) -> str:
    """Returns words about the default of an option if it is a number; else ""."""
    usual = next(
        (field.default for field, _ in fields_of(command) if option_of(field.name) == option), None
    )
    if isinstance(usual, int | float) and not isinstance(usual, bool):
        return f", such as {option} {usual}"
    return ""


def _shown(option: str) -> str:
    return option if option.startswith("-") else option.upper()


def _expected(command: type[Any], option: str) -> str:
    """Returns the possible values of an option in words."""
    kind = _kind(command, option)
    names = {int: "a whole number", float: "a number"}
    numbers = [names[part] for part in types_in(kind) if part in names]
    words = [*numbers, *_choices(kind)]
    if not words:
        return "a value"
    if len(words) == 1:
        return words[0]
    listed = f"{', '.join(words[:-1])} or {words[-1]}"
    return listed if numbers else f"one of {listed}"


def _kind(command: type[Any], option: str) -> Any:
    """Returns the annotated type of an option; None for an unknown option."""
    plain = option.lstrip("-").replace("_", "-").lower()
    for field, kind in fields_of(command):
        if option_of(field.name).lstrip("-") == plain:
            return kind
    return None


def _choices(kind: Any) -> list[str]:
    """Returns the words that a value of a type may be, in their order."""
    literals = [part for part in types_in(kind) if get_origin(part) is Literal]
    return [str(word) for literal in literals for word in get_args(literal)]
