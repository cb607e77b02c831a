"""The `humangs` command. Each subcommand is a frozen dataclass whose fields are its options; `run` does the work.

Modules here import nothing heavy, so that `--help` is fast: what a command needs is imported when it runs, after its options
and the places that it will write to were checked. --quiet, --verbose and --version are for all commands.

Exit codes: 0; 1 for bad data (a capture, a file that cannot be read); 2 for bad usage (an option, a place that cannot be written
to); 130 after Ctrl-C; 141 where the reader of a pipe has gone. Errors are one line on stderr, with nothing half-written.
"""

import importlib
import os
import sys
from collections.abc import Callable, Sequence
from typing import Any, Protocol, runtime_checkable

from humangs_jax import __version__

BAD_DATA, BAD_USAGE, INTERRUPTED, BROKEN_PIPE = 1, 2, 130, 141
"""The last two: 128 and the number of the signal, as in shells."""


@runtime_checkable
class Command(Protocol):
    """A subcommand with its options."""

    def run(self) -> None:
        """Do the work. Raises: ValueError or OSError for wrong input."""
        ...


COMMANDS = {
    "start": "start.Start",
    "detect": "captures.Detect",
    "import": "captures.ImportCameras",
    "fit": "fit.Fit",
    "check": "fit.Check",
    "demo": "avatars.Demo",
    "reconstruct": "avatars.Reconstruct",
    "refine": "avatars.Refine",
    "tune": "avatars.Tune",
    "animate": "animate.Animate",
    "render": "animate.Render",
    "export": "avatars.Export",
    "evaluate": "evaluate.Evaluate",
    "view": "animate.View",
    "synth": "captures.Synth",
    "preprocess": "training.Preprocess",
    "train": "training.Train",
    "convert": "training.Convert",
}
"""Module and class of each command, imported when it is asked for."""
DESCRIPTION = (
    "Animatable 3D Gaussian humans from a few photos with body poses. For every command: --quiet shows results and errors "
    "only, --verbose also what libraries log, --version the version."
)


def main() -> None:
    """Entry point of the console script. What takes time is imported where Ctrl-C is heard."""
    try:
        _prepare("--verbose" in sys.argv)
        code = execute(sys.argv[1:])
    except KeyboardInterrupt:  # before the command has begun, or the second one
        code = _interrupted()
    if code == INTERRUPTED:
        # XLA's threads may still be computing: they crash when the interpreter takes their arrays away
        os._exit(code)
    if code:
        sys.exit(code)


def execute(arguments: Sequence[str]) -> int:
    """Run a command line in this process. Returns the exit code. Raises: SystemExit for --help and what tyro refuses."""
    from humangs_jax.cli import screen
    from humangs_jax.cli.options import check_options
    from humangs_jax.core import progress

    screen.heard.clear()
    everywhere = {"--quiet", "--verbose", "--version"}
    given, arguments = everywhere & set(arguments), [word for word in arguments if word not in everywhere]
    verbose = "--verbose" in given
    try:
        if "--version" in given:
            screen.tell(f"humangs_jax {__version__}")
        else:
            command = _parsed(arguments)
            check_options(command)
            progress.begin(quiet="--quiet" in given, lines=verbose)
            command.run()
            screen.finish()
        sys.stdout.flush()
        return 0
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # Python flushes once more at its end
        return BROKEN_PIPE
    except KeyboardInterrupt:
        return _interrupted()
    except Exception as error:
        if screen.heard.is_set():  # importing an extension makes another error of it
            return _interrupted()
        if isinstance(error, ValueError | OSError):
            return _failed(error, verbose)
        if isinstance(error, MemoryError) or "RESOURCE_EXHAUSTED" in str(
            error
        ):  # numpy; XLA, whose text has many lines
            return _failed(MemoryError(f"out of memory: {(str(error).splitlines() or [''])[0]}"), verbose)
        raise
    finally:
        progress.end()


def _prepare(verbose: bool) -> None:
    """Settings of the process."""
    from humangs_jax.cli.screen import end_within_seconds, silence

    end_within_seconds()
    from humangs_jax.core.compiling import enable_compile_cache
    from humangs_jax.core.processes import keep_freed_memory

    silence(verbose)
    keep_freed_memory()
    enable_compile_cache()


def _parsed(arguments: list[str]) -> Command:
    """The command with its options. Only its own module is imported, and only its options are looked at: that is faster."""
    import tyro

    if arguments and arguments[0] in COMMANDS:
        words = 2 if arguments[:2] == ["import", "cameras"] else 1  # tyro's usage has no word that is given already
        prog = " ".join(["humangs", *arguments[:words]])
        return tyro.cli(_command(arguments[0]), prog=prog, args=arguments[1:])
    every = {name: _command(name) for name in COMMANDS}
    return tyro.extras.subcommand_cli_from_dict(every, prog="humangs", description=DESCRIPTION, args=arguments)


def _command(name: str) -> Callable[..., Any]:
    module, _, kind = COMMANDS[name].partition(".")
    return getattr(importlib.import_module(f"humangs_jax.cli.{module}"), kind)


def _failed(error: Exception, verbose: bool) -> int:
    """One line. An argument of the library is an option here."""
    from humangs_jax.cli import screen
    from humangs_jax.cli.options import UsageError, option_of
    from humangs_jax.core.configuration import ArgumentError

    if isinstance(error, UnicodeEncodeError):  # of a library that takes names in UTF-8 only
        error = ValueError(f"{error.object[:200]}: expected a name in UTF-8")
    if isinstance(error, ArgumentError):
        error = UsageError(f"{option_of(error.argument)} {error.problem}").with_traceback(error.__traceback__)
    screen.fail(error, verbose)
    return BAD_USAGE if isinstance(error, UsageError) else BAD_DATA


def _interrupted() -> int:
    from humangs_jax.core.progress import end, say

    end()
    say("\nhumangs: interrupted", error=True)  # after the terminal's ^C
    return INTERRUPTED
