"""Processes that work for this one, and Ctrl-C: it reaches all of them, but this one decides."""

import contextlib
import signal
from collections.abc import Generator


@contextlib.contextmanager
def started_deaf() -> Generator[None]:
    """Processes that are started in the block never hear Ctrl-C: else it ends those that are still importing, with tracebacks.

    This process hears it as before. Windows has no such masks: nothing is changed there.
    """
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})  # children inherit it
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
