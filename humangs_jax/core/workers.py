"""Processes that work for another one, as in `concurrent.futures.ProcessPoolExecutor`."""

import multiprocessing
import os
import threading
from multiprocessing import connection


def end_with_parent() -> None:
    """Called in a worker: it ends as soon as the process that started it has ended, however that ended.

    The workers of a pool whose process is killed would otherwise wait for work for ever: their queue stays open in each other.
    """
    parent = multiprocessing.parent_process()
    if parent is not None:
        threading.Thread(target=_wait, args=(parent.sentinel,), daemon=True).start()


def _wait(sentinel):
    connection.wait([sentinel])
    os._exit(1)
