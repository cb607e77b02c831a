"""What a command shows: stages while it works, warnings, what it wrote, how long its stages took, and what to do next.

Commands use `stage`, `tell`, `wrote`, `warn` and `suggest`; `humangs_jax.cli.execute` calls `begin`, `finish` and `end`.
Results go to stdout, everything else to stderr. --quiet leaves results and errors, --verbose shows what libraries log as well.
"""

import dataclasses
import logging
import os
import shlex
import sys
import threading
import time
import warnings
from pathlib import Path

from humangs_jax.core import progress
from humangs_jax.core.progress import stage

__all__ = ["begin", "end", "finish", "stage", "suggest", "tell", "warn", "wrote"]

XLA_LEVELS = {False: "3", True: "0"}
"""TF_CPP_MIN_LOG_LEVEL without and with --verbose. 3 leaves fatal errors: XLA logs its boxes about slow compilation as errors,
and real errors of a program arrive as exceptions.
"""


@dataclasses.dataclass
class _Screen:
    quiet: bool = False
    started: float = 0.0
    measured: progress.Progress = dataclasses.field(default_factory=progress.Progress)
    next: list[str] = dataclasses.field(default_factory=list)


_screen = _Screen()


def silence(verbose: bool) -> None:
    """Keep what libraries log off the screen, and errors in threads of their own, for a program of its own (not a test). Before
    JAX is imported.
    """
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", XLA_LEVELS[verbose])
    if not verbose and not sys.warnoptions:
        warnings.simplefilter("ignore")
        os.environ.setdefault("PYTHONWARNINGS", "ignore")  # of processes that this one starts
    shown = sys.unraisablehook

    def unraisable(what):
        # TensorStore's threads have nobody to report to when a disk is full; the command itself says that it is
        if verbose or threading.current_thread() is threading.main_thread():
            shown(what)

    sys.unraisablehook = unraisable
    root = logging.getLogger()
    if not root.handlers:  # else Python prints the warnings of all loggers, Orbax's among them
        handler = logging.StreamHandler()
        handler.addFilter(lambda record: verbose or record.name.startswith("humangs_jax"))
        handler.setFormatter(logging.Formatter("%(name)s: %(message)s" if verbose else "humangs: %(message)s"))
        root.addHandler(handler)


def begin(quiet: bool, verbose: bool) -> None:
    """A command starts."""
    global _screen
    _screen = _Screen(quiet, time.perf_counter(), progress.begin(quiet=quiet, lines=verbose))


def tell(text: object) -> None:
    """A result that was asked for, such as a report: shown with --quiet too."""
    print(text, flush=True)


def wrote(path: str | Path, what: str) -> None:
    """A file or folder was written."""
    if not _screen.quiet:
        print(f"{path}: {what}", flush=True)


def warn(text: object) -> None:
    """Something looks wrong, and the command goes on."""
    clear = progress.CLEAR if _screen.measured.ticking else ""
    print(f"{clear}humangs: warning: {text}", file=sys.stderr, flush=True)


def suggest(*command: str | Path) -> None:
    """What to do next: the parts of a command line; paths are quoted, text is not."""
    _screen.next.append(" ".join(shlex.quote(str(part)) if isinstance(part, Path) else part for part in command))


def finish() -> None:
    """The command is done: its stages and their seconds, and what to do next."""
    seconds, total = _screen.measured.seconds, time.perf_counter() - _screen.started
    if not _screen.quiet and seconds:
        parts = ", ".join(f"{name} {took:.1f}" for name, took in seconds.items())
        print(f"took {total:.1f} s: {parts}")
    if not _screen.quiet and _screen.next:
        print(f"next: {'  or  '.join(_screen.next)}")


def end() -> None:
    """Stages of the library are shown no more, however the command has ended."""
    progress.end()
