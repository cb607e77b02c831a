"""Shows a command's stages, warnings and results on the screen, and handles Ctrl-C.

At its end a command shows how long its stages took, and what to do next. Commands use `stage`,
`tell`, `wrote`, `warn` and `suggest`; `humangs_jax.cli.execute` calls `finish` and `fail`. Results,
times and suggestions go to stdout. Stages, bars, warnings and errors go to stderr. --quiet hides
stages, bars, times, suggestions and what `wrote` shows. --verbose also shows what libraries log.
"""

import atexit
import io
import logging
import os
import shlex
import signal
import sys
import threading
import time
import traceback
import warnings
from pathlib import Path
from types import FrameType

from humangs_jax.cli import INTERRUPTED
from humangs_jax.core import progress
from humangs_jax.core.progress import bar as bar
from humangs_jax.core.progress import say
from humangs_jax.core.progress import stage as stage

# Ctrl-C that would get lost. While a program compiles or runs, Python hears of it only when that
# returns, which can be minutes later. In callbacks of the garbage collector (JAX has one) and
# destructors, Python drops the KeyboardInterrupt with a note, and the command would go on. And
# extensions crash where it comes while they are imported.
heard = threading.Event()
"""Event that is set once Python has received Ctrl-C in this command."""
PATIENCE = 2.0
"""Time that Python has to receive Ctrl-C and to tidy up, seconds. Calls that write files are
shorter.
"""


def end_within_seconds() -> None:
    """Makes Ctrl-C end this process within seconds. The console script calls this.

    Ctrl-C raises KeyboardInterrupt. If Python does not receive the signal in time, the process ends
    at once. Signals that ask a process to end (from `timeout`, or from a terminal that is closed)
    have the same effect. While a command handles Ctrl-C itself, as training does to save its state,
    nothing is forced.
    """
    if sys.platform == "win32" or signal.getsignal(signal.SIGINT) is not signal.default_int_handler:
        return  # there, wake-up descriptors are sockets; or somebody else handles it

    def again():
        """Sends an interrupt again after 20 ms, because it was dropped or came at a bad time."""
        threading.Timer(0.02, os.kill, (os.getpid(), signal.SIGINT)).start()

    def interrupt(number, frame):
        if _importing(frame):
            again()
            return
        heard.set()
        signal.default_int_handler(number, frame)

    def end(number, frame):
        """Does nothing, because `watch` receives the signal."""

    reader, writer = os.pipe()
    os.set_blocking(writer, False)
    signal.signal(signal.SIGINT, interrupt)
    for number in (signal.SIGTERM, signal.SIGHUP):
        if signal.getsignal(number) is signal.SIG_DFL:  # not below nohup
            signal.signal(number, end)
    signal.set_wakeup_fd(writer, warn_on_full_buffer=False)
    # when Python ends it gives signals back to the system, whose handler kills: a command that was
    # done had no exit code
    atexit.register(signal.signal, signal.SIGINT, signal.SIG_IGN)

    def watch():
        while True:
            number = os.read(reader, 1)
            if not number:
                break
            if signal.getsignal(number[0]) is end:
                os.kill(os.getpid(), signal.SIGINT)
            if number[0] != signal.SIGINT or signal.getsignal(signal.SIGINT) is not interrupt:
                continue
            time.sleep(PATIENCE)
            if not heard.is_set():
                atomic = sys.modules.get("humangs_jax.io.atomic")  # not imported now
                if atomic:
                    atomic.remove_unfinished()
                os.write(2, b"\nhumangs: interrupted\n")
                os._exit(INTERRUPTED)

    threading.Thread(target=watch, daemon=True).start()
    note = sys.unraisablehook

    def dropped(what):
        if what.exc_type is KeyboardInterrupt:
            again()
        else:
            note(what)

    sys.unraisablehook = dropped


def _importing(frame: FrameType | None) -> bool:
    """Returns whether a module is being imported.

    Extensions that are interrupted while they are imported crash, or raise other errors.
    """
    while frame is not None:
        if frame.f_code.co_filename.startswith("<frozen importlib"):
            return True
        frame = frame.f_back
    return False


class _Handler(logging.Handler):
    """Shows what libraries log, with `say` like everything else."""

    def emit(self, record: logging.LogRecord) -> None:
        try:
            say(self.format(record), error=True)
        except Exception:  # as all handlers do: a log must not end the work
            self.handleError(record)


def silence(verbose: bool) -> None:
    """Keeps logs of libraries, and errors in their threads, off the screen.

    Call it before JAX is imported, and only in a whole program, not in a test. verbose: whether
    logs are shown.
    """
    # 3 leaves fatal errors: XLA logs its boxes about slow compilation as errors, and real errors
    # of a program arrive as exceptions
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "0" if verbose else "3")
    if not verbose and not sys.warnoptions:
        warnings.simplefilter("ignore")
        os.environ.setdefault("PYTHONWARNINGS", "ignore")  # of processes that this one starts
    shown = sys.unraisablehook

    def unraisable(what):
        # TensorStore's threads have nobody to report to when a disk is full; the command itself
        # says that it is
        if verbose or threading.current_thread() is threading.main_thread():
            shown(what)

    sys.unraisablehook = unraisable
    sys.excepthook = lambda *what: say(
        "".join(traceback.format_exception(*what)).rstrip(), error=True
    )

    def show(*what, file=None, line=None):
        return say(warnings.formatwarning(*what[:4], line).rstrip(), error=True)

    warnings.showwarning = show  # ty: ignore[invalid-assignment]
    for stream in (sys.stdout, sys.stderr):  # what others print, such as --help; it may be no file
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")
    root = logging.getLogger()
    if not root.handlers:  # else Python prints the warnings of all loggers, Orbax's among them
        handler = _Handler()
        handler.addFilter(lambda record: verbose or record.name.startswith("humangs_jax"))
        handler.setFormatter(
            logging.Formatter("%(name)s: %(message)s" if verbose else "humangs: %(message)s")
        )
        root.addHandler(handler)


def tell(text: object) -> None:
    """Shows a result that the user asked for, such as a report, even with --quiet."""
    say(text)


def wrote(path: str | Path, what: str) -> None:
    """Shows that a file or folder was written, and what it has. what: its content in words."""
    if not progress.current().quiet:
        say(f"{path}: {what}")


def warn(text: object) -> None:
    """Shows a warning about something that looks wrong, even with --quiet. The command goes on."""
    say(f"humangs: warning: {text}", error=True, lines=False)


def fail(error: BaseException, verbose: bool) -> None:
    """Shows the error that ends the command, in one line. verbose: whether its traceback is shown
    before.
    """
    progress.end()
    if verbose:
        say("".join(traceback.format_exception(error)).rstrip(), error=True)
    say(f"humangs: error: {error}", error=True, lines=False)


def suggest(*command: str | Path) -> None:
    """Adds a command line to what `finish` suggests to do next.

    command: the parts of the command line; paths are quoted, text is not.
    """
    progress.current().next.append(
        " ".join(quoted(part) if isinstance(part, Path) else part for part in command)
    )


def quoted(path: Path) -> str:
    r"""Quotes a path for a shell.

    A path that the terminal cannot show is written like $'f\xc3\xbcr', which bash and zsh read.
    """
    text = str(path)
    encoding = getattr(sys.stdout, "encoding", None) or "utf-8"
    try:
        text.encode(encoding)
    except UnicodeEncodeError:
        shown = False
    else:
        shown = progress.printable(text) == text
    if shown:
        return shlex.quote(text)
    plain = [
        chr(byte) if 0x20 <= byte < 0x7F and byte not in b"'\\" else f"\\x{byte:02x}"
        for byte in os.fsencode(path)
    ]
    return f"$'{''.join(plain)}'"


def finish() -> None:
    """Shows the times of the command's stages, seconds, and what to do next."""
    shown = progress.current()
    if not shown.quiet and shown.seconds:
        parts = ", ".join(f"{name} {took:.1f}" for name, took in shown.seconds.items())
        say(f"took {time.perf_counter() - shown.started:.1f} s: {parts}")
    if not shown.quiet and shown.next:
        say(f"next: {'  or  '.join(shown.next)}")
