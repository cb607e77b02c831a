"""Shows stages of long work, bars and lines of text (`say`) on a terminal. Characters that a
terminal would act on are escaped in lines of text, names of stages and descriptions of bars.

    with stage("reading the capture"):
        ...
    for view in bar(views, desc="render"):
        ...

No other module prints. The library opens stages where work takes long. A stage shows nothing and
costs nothing unless a program has called `begin`. Only stages outside of all others are measured,
and `Progress.seconds` keeps their times. Stages inside of them only change the line that is shown.
"""

import contextlib
import dataclasses
import sys
import threading
import time
import unicodedata
import weakref
from collections.abc import Generator, Hashable, Iterable, Iterator, Sequence
from typing import Any


def printable(text: object, lines: bool = False) -> str:
    r"""Returns a text in which all characters that a terminal would act on are escaped, as Python
    escapes them (\x1b, \u202e, \n).

    These are control characters, C1 included, marks of direction and other format characters,
    separators of lines, and bytes of file names that are not UTF-8 (\xe9). lines: whether line
    feeds and tabs stay, for a report of several lines.
    """
    text = str(text)
    if text.isprintable():
        return text
    kept = "\n\t" if lines else ""
    return "".join(c if c in kept else _printable_character(c) for c in text)


def _printable_character(c: str) -> str:
    """Returns a character, escaped if a terminal would act on it."""
    # wide spaces and characters newer than Python, which `repr` escapes, too, are harmless; words
    # of Persian and Indic languages need the two joiners
    harmless = c in "\u200c\u200d" or unicodedata.category(c) in ("Zs", "Cn", "Co")
    if c.isprintable() or harmless:
        return c
    if "\udc80" <= c <= "\udcff":  # a byte of a file name, as os.fsdecode has it
        return f"\\x{ord(c) - 0xDC00:02x}"
    return c.encode("unicode_escape").decode("ascii")


def text_table(rows: Sequence[Sequence[str]], left: int = 1) -> list[str]:
    """Returns the lines of a table. The first `left` columns are aligned to the left, the others to
    the right. A row may have fewer cells than others.
    """
    widths = [max(len(row[i]) for row in rows if i < len(row)) for i in range(max(map(len, rows)))]

    def aligned(row):
        return (f"{cell:{'<' if i < left else '>'}{widths[i]}}" for i, cell in enumerate(row))

    return ["  ".join(aligned(row)).rstrip() for row in rows]


TICK = 0.2
"""Seconds between two updates of the line of a stage."""
LONG = 10.0
"""Seconds between two updates of a bar, and seconds after which the name of a running stage is
printed. Both apply only if stderr is no terminal.
"""
CLEAR = "\r\033[K"
"""Text that puts the cursor of a terminal at the beginning of an empty line."""


@dataclasses.dataclass
class Progress:
    """What a program shows of its work, and the times that were measured."""

    ticking: bool = False
    """Whether a line on stderr counts the seconds of a stage while it runs."""
    naming: bool = False
    """Whether the name of an outermost stage is printed on stderr if the stage takes longer than
    `LONG`. `begin` sets this if stderr is no terminal.
    """
    lines: bool = False
    """Whether each outermost stage leaves a line with its seconds, even where stderr is no
    terminal.
    """
    quiet: bool = False
    """Whether neither stages nor bars are shown."""
    started: float = dataclasses.field(default_factory=time.perf_counter)
    """Time at which the program began, seconds of `time.perf_counter`."""
    seconds: dict[str, float] = dataclasses.field(default_factory=dict)
    """Seconds that the finished outermost stages took, by name. The seconds of stages with the same
    name are added up.
    """
    names: list[str] = dataclasses.field(default_factory=list)
    """Names of the stages that run, the outermost first."""
    next: list[str] = dataclasses.field(default_factory=list)
    """Lines about what the user may do next, for the program that called `begin`."""
    paused: bool = False
    """Whether the line of the stage is hidden, because a bar is shown in its place."""


_current = Progress()
_bars: "weakref.WeakSet[Any]" = weakref.WeakSet()
"""Bars that may not be closed yet."""


def begin(*, quiet: bool = False, lines: bool = False) -> Progress:
    """Starts to show stages, and returns the settings. If stderr is a terminal, a line there counts
    the seconds of a stage.

    Arguments: quiet: whether neither stages nor bars are shown. lines: whether each outermost stage
    leaves a line, wherever stderr goes.
    """
    global _current
    terminal, shown = sys.stderr.isatty(), not quiet
    _current = Progress(
        ticking=terminal and shown,
        naming=shown and not terminal,
        lines=lines and shown,
        quiet=quiet,
    )
    return _current


def current() -> Progress:
    """Returns the settings of what is shown now."""
    return _current


def end() -> None:
    """Stops showing stages, so that all is as before `begin`. All bars that are still open are
    closed, which shows their last line.
    """
    global _current
    _current = Progress()
    _close(set(_bars))


def say(text: object, *, error: bool = False, lines: bool = True) -> None:
    """Prints text on stdout, with everything that a terminal would act on escaped. Bars and the
    line of a stage make room for it.

    Arguments: error: whether to print on stderr instead. lines: whether the text may have several
    lines; otherwise line feeds and tabs are escaped, too.
    """
    stream = sys.stderr if error else sys.stdout
    encoding = getattr(stream, "encoding", None) or "utf-8"  # a terminal may know ASCII only
    text = printable(text, lines).encode(encoding, "backslashreplace").decode(encoding)
    tqdm = sys.modules.get("tqdm")
    beside_bars = contextlib.nullcontext()
    if tqdm and len(_bars):
        beside_bars = tqdm.tqdm.external_write_mode(stream)
    with beside_bars:
        if _current.ticking and (error or _current.names):
            sys.stderr.write(CLEAR)
            sys.stderr.flush()
        print(text, file=stream, flush=True)


@contextlib.contextmanager
def stage(name: str) -> Generator[None]:
    """Shows a part of long work while the block runs. If no other stage runs, its seconds are
    measured.
    """
    # what is shown around this stage comes back at its end
    current, paused, bars = _current, _current.paused, set(_bars)
    name = printable(name)
    current.names.append(name)
    current.paused = False
    # a thread counts seconds on a terminal, or names long stages in a log
    started, stop = time.perf_counter(), threading.Event()
    outermost = len(current.names) == 1
    show = _tick if current.ticking else _name
    ticker = threading.Thread(target=show, args=(current, stop, started), daemon=True)
    if outermost and (current.ticking or current.naming):
        ticker.start()
    try:
        yield
    except BaseException:
        # else the traceback keeps them open, and the next line is glued to them
        _close(set(_bars) - bars)
        raise
    finally:
        stop.set()
        if ticker.is_alive():
            ticker.join()
        current.names.pop()
        current.paused = paused
        seconds = time.perf_counter() - started
        # only outermost stages are measured
        if outermost:
            current.seconds[name] = current.seconds.get(name, 0.0) + seconds
            if current.ticking or current.lines:
                say(f"{name}: {seconds:.1f} s", error=True)


COMPILING = "compiling, once"
"""Text of a bar or a stage while a program of JAX is compiled, which takes many seconds."""


_compiled: set[Hashable] = set()
"""The programs of this process whose first run has been shown by `compiling`."""


@contextlib.contextmanager
def compiling(program: Hashable = None) -> Generator[None]:
    """Shows `COMPILING` during the block: on all open bars, or as a stage if no bar is open.

    Arguments: program: the program that is compiled. The text is shown only at its first run in a
    process. None: the text is shown always.
    """
    if program is not None and program in _compiled:
        yield
        return
    if program is not None:
        _compiled.add(program)
    bars = [each for each in _bars if not each.disable]
    if not bars:
        with stage(COMPILING):
            yield
        return
    before = [each.postfix for each in bars]
    for each in bars:
        each.set_postfix_str(COMPILING)
    try:
        yield
    finally:
        for each, postfix in zip(bars, before, strict=True):
            each.set_postfix_str(postfix or "", refresh=False)


def bar(
    iterable: Iterable[Any] | None = None, *, shown: bool = True, first: str = "", **how: Any
) -> Any:
    """Returns a bar of tqdm. On a terminal, it takes the place of the stage's line until a stage
    begins or ends.

    Where stderr is no terminal (a log, a notebook), the bar moves every `LONG` seconds.

    Arguments: shown: whether a bar is wanted; a program may still hide all bars, see `begin`.
    first: text that the bar shows until the first item is there. how: further options of tqdm.
    """
    from tqdm import tqdm

    if shown and _current.ticking and _current.names:
        _current.paused = True
        sys.stderr.write(CLEAR)
    if how.get("desc") is not None:
        how["desc"] = printable(how["desc"])
    if not sys.stderr.isatty():
        how = {"mininterval": LONG, "maxinterval": LONG} | how
    made = tqdm(iterable, disable=not shown or _current.quiet, **how)
    if not made.disable:
        _bars.add(made)
        if first:
            made.set_postfix_str(first)
            made.iterable = _without_postfix(iterable or (), made)
    return made


def _without_postfix(items: Iterable[Any], made: Any) -> Iterator[Any]:
    """Yields the items, and removes the bar's text when the first item is there."""
    for i, item in enumerate(items):
        if i == 0:
            made.set_postfix_str("", refresh=False)
        yield item


def _close(bars: set[Any]) -> None:
    """Closes bars, so that they show their last line."""
    for each in bars:
        each.close()


def followed() -> bool:
    """Says whether a program shows stages, on a terminal or in a log."""
    return _current.ticking or _current.naming


def watched() -> bool:
    """Says whether a program shows stages on a terminal. Callers then show a bar for a long loop
    that has none otherwise.
    """
    return _current.ticking


def _name(current: Progress, stop: threading.Event, _: float) -> None:
    """Prints the names of the running stages in a log if the outermost one takes longer than
    `LONG`.
    """
    if not stop.wait(LONG) and current.names:
        say(f"{_named(current)} ...", error=True)


def _named(current: Progress) -> str:
    """Returns the names of the outermost and the innermost running stage as text, or one name if
    they are the same.
    """
    return ": ".join(dict.fromkeys((current.names[0], current.names[-1])))


def _tick(current: Progress, stop: threading.Event, started: float) -> None:
    """Updates the line of a stage with its seconds on a terminal, until `stop` is set."""
    while not stop.wait(TICK):
        if not current.paused and current.names:
            sys.stderr.write(f"{CLEAR}{_named(current)} ... {time.perf_counter() - started:.0f} s")
            sys.stderr.flush()
