"""When a run should end early: Ctrl-C, or a signal that the machine is about to be taken away.

One process checks its own signals. Several processes may receive the signal at different steps, so that jax's coordination
service agrees on one (https://docs.jax.dev/en/latest/_autosummary/jax.experimental.multihost_utils.html).
"""

import contextlib
import logging
import signal
import threading
from collections.abc import Callable, Generator

import jax

logger = logging.getLogger(__name__)


@contextlib.contextmanager
def stop_requested() -> Generator[Callable[[int], bool], None, None]:
    """A function of the number of steps done: whether to stop after them. All processes must ask it after every step."""
    if jax.process_count() > 1:
        from jax.experimental import multihost_utils

        yield multihost_utils.reached_preemption_sync_point
        return
    with _own_signals() as stop:
        yield lambda _: stop.is_set()


@contextlib.contextmanager
def _own_signals():
    """An event that SIGINT and SIGTERM set; the second SIGINT is a KeyboardInterrupt again."""
    stop = threading.Event()
    if threading.current_thread() is not threading.main_thread():  # only the main thread may catch signals
        yield stop
        return

    def handle(number, _frame):
        stop.set()
        signal.signal(number, previous[number])
        logger.warning("stopping after this step; what is done is saved")

    previous = {number: signal.signal(number, handle) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield stop
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)
