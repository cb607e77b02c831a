"""Processes that work for another one, as in `concurrent.futures.ProcessPoolExecutor`."""

import multiprocessing
import os
import threading
from collections.abc import Callable, Iterator, Mapping
from multiprocessing import connection
from typing import Any, TypeVar

from humangs_jax.core.signals import started_deaf

K = TypeVar("K")
T = TypeVar("T")


def in_processes(
    work: Callable[..., T],
    tasks: Mapping[K, tuple[Any, ...]],
    workers: int,
    prepare: Callable[..., object],
    *given: Any,
) -> Iterator[tuple[K, T]]:
    """Yields (name, work(*arguments)) of tasks by name, as they end, from several processes of one thread each, on the CPU.

    Arguments: prepare: called as prepare(*given) when a process starts. All of it is pickled. If the caller stops, by Ctrl-C or
    otherwise, unfinished tasks are dropped and the processes end.
    Raises: OSError if a process is killed.
    """
    import concurrent.futures.process

    context = multiprocessing.get_context("spawn")  # a forked process may hang in jax's threads
    count = min(workers, len(tasks))
    with concurrent.futures.ProcessPoolExecutor(count, context, _begin, (prepare, given)) as pool:
        try:
            with started_deaf():
                futures = {pool.submit(work, *arguments): name for name, arguments in tasks.items()}
            for future in concurrent.futures.as_completed(futures):
                yield futures[future], future.result()
        except concurrent.futures.process.BrokenProcessPool as error:
            raise OSError("a working process was killed, perhaps for want of memory: try fewer workers") from error
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            for process in multiprocessing.active_children():
                process.terminate()
            raise


def _begin(prepare, given):
    """One thread each: the processes are the parallelism."""
    import signal

    import jax

    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent decides
    end_with_parent()
    os.environ["XLA_FLAGS"] = os.environ.get("XLA_FLAGS", "") + " --xla_cpu_multi_thread_eigen=false"
    jax.config.update("jax_platforms", "cpu")
    prepare(*given)


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
