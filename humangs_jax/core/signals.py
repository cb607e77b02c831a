"""Ctrl-C at times when it would do harm."""

import contextlib
import signal
import threading
from collections.abc import Generator


@contextlib.contextmanager
def undisturbed() -> Generator[None]:
    """Ctrl-C waits until the block is over: for what is short and must not be left half-done."""
    if threading.current_thread() is not threading.main_thread():  # only that one gets it
        yield
        return
    waiting: list[tuple] = []
    previous = signal.signal(signal.SIGINT, lambda *arguments: waiting.append(arguments))
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, previous)
        if waiting and callable(previous):
            previous(*waiting[0])


@contextlib.contextmanager
def started_deaf() -> Generator[None]:
    """Processes that are started in the block never hear Ctrl-C, which reaches all processes of a terminal: this one decides.

    Else it ends, with tracebacks, those that are still importing. Windows has no such masks: there it does.
    """
    with undisturbed():
        if not hasattr(signal, "pthread_sigmask"):
            yield
            return
        before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})  # children inherit it
        try:
            yield
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)
