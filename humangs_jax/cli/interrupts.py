"""Ctrl-C that would get lost.

While a program compiles or runs, Python hears of it only when that returns, which can be minutes later. In callbacks of the
garbage collector (JAX has one) and destructors, Python drops the KeyboardInterrupt with a note, and the command would go on. And
extensions crash where it comes while they are imported.
"""

import atexit
import os
import signal
import sys
import threading
import time

from humangs_jax.cli import INTERRUPTED

heard = threading.Event()
"""Whether Python has heard of Ctrl-C in this command."""
AGAIN = 0.02
"""Seconds after which an interrupt that was dropped, or came at a bad time, is repeated."""
PATIENCE = 2.0
"""Seconds that Python gets to hear of it and to tidy up; files are written by calls that are shorter."""


def end_within_seconds() -> None:
    """From now on Ctrl-C ends this process by a KeyboardInterrupt or, if that is not heard in time, at once.

    For the console script. Where a command handles the signal itself, as training does to save its state, nothing is forced.
    """
    if sys.platform == "win32" or signal.getsignal(signal.SIGINT) is not signal.default_int_handler:
        return  # there, wake-up descriptors are sockets; or somebody else handles it

    def again():
        threading.Timer(AGAIN, os.kill, (os.getpid(), signal.SIGINT)).start()

    def interrupt(number, frame):
        if _importing(frame):
            again()
            return
        heard.set()
        signal.default_int_handler(number, frame)

    reader, writer = os.pipe()
    os.set_blocking(writer, False)
    signal.signal(signal.SIGINT, interrupt)
    signal.set_wakeup_fd(writer, warn_on_full_buffer=False)
    # when Python ends it gives signals back to the system, whose handler kills: a command that was done had no exit code
    atexit.register(signal.signal, signal.SIGINT, signal.SIG_IGN)

    def watch():
        while number := os.read(reader, 1):
            if number[0] != signal.SIGINT or signal.getsignal(signal.SIGINT) is not interrupt:
                continue
            time.sleep(PATIENCE)
            if not heard.is_set():
                if atomic := sys.modules.get("humangs_jax.io.atomic"):  # not imported now
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


def _importing(frame):
    """Whether a module is being imported: extensions that are interrupted while they begin crash, or raise other errors."""
    while frame is not None:
        if frame.f_code.co_filename.startswith("<frozen importlib"):
            return True
        frame = frame.f_back
    return False
