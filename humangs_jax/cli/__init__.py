"""The `humangs` program. Each command is a dataclass: its fields are options, and `run` does the
work.

Modules here import nothing heavy, so that `--help` is fast. A command imports what it needs when it
runs, after its options and output places were checked. All commands take --quiet, --verbose and
--version.

Exit codes: 0 for success; 1 for bad data (a capture, a file that cannot be read); 2 for bad usage
(an option, a place that cannot be written to); 130 after Ctrl-C; 141 if the reader of a pipe has
closed it. Errors are one line on stderr, and no file is left half-written.
"""

import difflib
import importlib
import os
import sys
from collections.abc import Sequence
from typing import Any, ClassVar, Protocol, runtime_checkable

from humangs_jax import __version__

BAD_DATA = 1
"""Exit status if files or data are wrong."""
BAD_USAGE = 2
"""Exit status if the command line is wrong."""
INTERRUPTED = 130
"""Exit status after Ctrl-C, which is 128 plus the number of the signal, as in shells."""
BROKEN_PIPE = 141
"""Exit status if the reader of the output has closed it, which is 128 plus the number of the
signal.
"""


@runtime_checkable
class Command(Protocol):
    """A subcommand with its options.

    The first paragraph of its docstring is its line in `humangs --help`.
    """

    examples: ClassVar[tuple[str, ...]]
    """Examples of command lines, shown at the end of --help."""

    def run(self) -> None:
        """Does the work of the command. Raises: ValueError or OSError for wrong input."""
        ...


GROUPS = {
    "Make an avatar": {
        "start": "start.Start",
        "reconstruct": "avatars.Reconstruct",
        "refine": "avatars.Refine",
        "tune": "avatars.Tune",
        "demo": "avatars.Demo",
    },
    "Look at it": {
        "animate": "animate.Animate",
        "render": "animate.Render",
        "view": "animate.View",
    },
    "Take it along": {"export": "export.Export"},
    "Prepare photos": {
        "detect": "captures.Detect",
        "import": "captures.ImportCameras",
        "fit": "fit.Fit",
        "check": "fit.Check",
        "motion": "motion.MotionOfVideo",
    },
    "Research": {
        "evaluate": "training.Evaluate",
        "synth": "captures.Synth",
        "preprocess": "training.Preprocess",
        "train": "training.Train",
        "convert": "training.Convert",
    },
}
"""Commands by purpose, each with its module and class, which are imported when they are needed."""
COMMANDS = {name: place for group in GROUPS.values() for name, place in group.items()}
EVERYWHERE = """Options of every command:
  --help       its options, with examples
  --quiet      results, warnings and errors only
  --verbose    also what libraries log
  --version    the version
Completion for bash, zsh or tcsh: humangs --tyro-print-completion SHELL"""


def main() -> None:
    """Runs the console script. The handler of Ctrl-C is installed before any slow import."""
    try:
        _prepare("--verbose" in sys.argv)
        code = execute(sys.argv[1:])
    except KeyboardInterrupt:  # before the command has begun, or the second one
        code = _interrupted()
    if code == INTERRUPTED:
        # XLA's threads may still be computing: they crash when the interpreter takes their arrays
        # away
        os._exit(code)
    if code:
        sys.exit(code)


def execute(arguments: Sequence[str]) -> int:
    """Runs a command line in this process and returns the exit code. arguments: words after
    `humangs`.

    Raises: SystemExit for --help, or if there are no words. Also an error of the command that is
    neither a ValueError nor an OSError, and does not mean that memory was short.
    """
    from humangs_jax.cli import screen
    from humangs_jax.cli.options import check_options
    from humangs_jax.core import progress

    # options of every command are taken out first
    screen.heard.clear()
    everywhere = {"--quiet", "--verbose", "--version"}
    given = everywhere & set(arguments)
    arguments = [word for word in arguments if word not in everywhere]
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
        # Python flushes once more at its end
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return BROKEN_PIPE
    except KeyboardInterrupt:
        return _interrupted()
    except Exception as error:
        if screen.heard.is_set():  # importing an extension makes another error of it
            return _interrupted()
        if isinstance(error, ValueError | OSError):
            return _failed(error, verbose)
        # numpy; XLA, whose text has many lines
        if isinstance(error, MemoryError) or "RESOURCE_EXHAUSTED" in str(error):
            lines = str(error).splitlines() or [""]
            return _failed(MemoryError(f"out of memory: {lines[0]}"), verbose)
        raise
    finally:
        progress.end()


def _prepare(verbose: bool) -> None:
    """Sets up Ctrl-C, logs, memory and caches of the process. Call it before JAX is imported.
    verbose: whether logs of libraries are shown.
    """
    from humangs_jax.cli.screen import end_within_seconds, silence

    end_within_seconds()
    from humangs_jax.core.processes import enable_compile_cache, keep_freed_memory, keep_programs

    silence(verbose)
    keep_freed_memory()
    cache = enable_compile_cache()
    if cache is not None:
        keep_programs(cache)


RENAMED = {
    "fit": {"--bare": "--tight-clothes", "--refine": "--to-masks"},
    "refine": {"--limit": "--refine"},
}
"""For each command, old names of options with the new names. An error about an old name shows the
new one.
"""


def _parsed(arguments: list[str]) -> Command:
    """Parses a command line into a command with its options.

    Only the module of that command is imported, which is faster.

    Raises: SystemExit after --help, or if there are no words; UsageError for an unknown command or
    option, or a wrong value.
    """
    from humangs_jax.core.progress import say

    if not arguments or arguments[0] in ("--help", "-h"):
        say(overview())
        raise SystemExit(0 if arguments else BAD_USAGE)
    from humangs_jax.cli.options import UsageError, described, option_names
    from humangs_jax.cli.parsing import parsed

    # completion needs the options of all commands
    name, *options = arguments
    if name == "--tyro-print-completion" or name == "--tyro-write-completion":
        import tyro

        every = {each: described(_command(each)) for each in COMMANDS}
        return tyro.extras.subcommand_cli_from_dict(  # ty: ignore[no-matching-overload]
            every, prog="humangs", args=arguments
        )
    if name not in COMMANDS:
        near = difflib.get_close_matches(name, COMMANDS, n=1)
        hint = "`humangs --help` lists them"
        if near:
            hint = f"did you mean {near[0]!r}?"
        raise UsageError(f"{name!r} is no command: {hint}")
    # unknown options are refused by name before tyro sees the words
    command = described(_command(name))
    known = option_names(command) | {"--help"}
    for word in options:
        option = word.split("=")[0].replace("_", "-")
        renamed = RENAMED.get(name, {}).get(option)
        if renamed is not None:
            raise UsageError(f"{option}: is called {renamed} now")
        if option.startswith("--") and option not in known:
            near = difflib.get_close_matches(option, known, n=1)
            hint = f": did you mean {near[0]}?" if near else ""
            raise UsageError(f"{option}: no option of humangs {name}{hint}")
    # --help ends with examples
    words = 2 if arguments[:2] == ["import", "cameras"] else 1
    try:
        return parsed(command, " ".join(arguments[:words]), options)
    except SystemExit:
        say("\n".join(["examples:", *(f"  {example}" for example in command.examples)]))
        raise


def summary(command: type[Any]) -> str:
    """Returns the first paragraph of a command's docstring on one line."""
    paragraph, _, _ = (command.__doc__ or "").partition("\n\n")
    return " ".join(paragraph.split())


def overview() -> str:
    """Returns the text of `humangs --help`: all commands by purpose, one line each."""
    lines = ["usage: humangs COMMAND [OPTIONS]", ""]
    lines.append("Animatable 3D Gaussian humans from a few photos with body poses.")
    for group, commands in GROUPS.items():
        lines += ["", f"{group}:"]
        lines += [f"  {name:<12} {summary(_command(name))}" for name in commands]
    return "\n".join([*lines, "", EVERYWHERE])


def _command(name: str) -> type[Any]:
    module, _, kind = COMMANDS[name].partition(".")
    return getattr(importlib.import_module(f"humangs_jax.cli.{module}"), kind)


def _failed(error: Exception, verbose: bool) -> int:
    """Shows an error in one line, and returns the exit code. If the error names an argument of the
    library, the option of that name is shown. verbose: whether the traceback is shown, too.
    """
    from humangs_jax.cli import screen
    from humangs_jax.cli.options import UsageError, option_of
    from humangs_jax.core.configuration import ArgumentError

    if isinstance(error, UnicodeEncodeError):  # of a library that takes names in UTF-8 only
        error = ValueError(f"{error.object[:200]}: expected a name in UTF-8")
    if isinstance(error, ArgumentError):
        error = UsageError(error.line(option_of(error.argument))).with_traceback(
            error.__traceback__
        )
    screen.fail(error, verbose)
    if isinstance(error, UsageError):
        return BAD_USAGE
    return BAD_DATA


def _interrupted() -> int:
    from humangs_jax.core.progress import end, say

    end()
    say("\nhumangs: interrupted", error=True)  # after the terminal's ^C
    return INTERRUPTED
