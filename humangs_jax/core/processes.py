"""What concerns whole processes: the memory that they keep, Ctrl-C at times when it would do harm, and workers.

XLA's CPU backend allocates the temporaries of a program as one block in each call and frees it afterwards. glibc gives blocks
above 32 MiB back to the system, and the next call waits for each of its pages to be mapped anew: `keep_freed_memory` prevents it.
"""

import contextlib
import ctypes
import gc
import multiprocessing
import os
import signal
import sys
import threading
from collections.abc import Callable, Generator, Iterator, Mapping
from multiprocessing import connection
from pathlib import Path
from typing import Any, TypeVar

_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD, _M_ARENA_MAX = -1, -3, -8  # malloc.h
_KEPT = 1 << 30
"""Bytes; blocks up to this size stay with the process once it has needed them."""


def keep_freed_memory() -> bool:
    """Lets the process keep what it frees. Programs call it once, before the first large array; the library never does.

    Returns whether this C library has the setting (glibc). The process then never gets smaller than its peak.
    """
    if not sys.platform.startswith("linux"):
        return False
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    # one arena for all threads: the others hold 64 MiB at most
    settings = ((_M_MMAP_THRESHOLD, _KEPT), (_M_TRIM_THRESHOLD, _KEPT), (_M_ARENA_MAX, 1))
    return mallopt is not None and all([mallopt(*setting) for setting in settings])


@contextlib.contextmanager
def peak_memory() -> Generator[list[float | None]]:
    """What the work inside adds to the memory of the process at its peak, MiB, in a list of one number.

    None where the system does not tell: it is read from Linux's /proc, with glibc. Memory of a GPU or TPU is not in it.
    """
    result: list[float | None] = [None]
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None) if sys.platform.startswith("linux") else None
    if trim is None:
        yield result
        return
    gc.collect()  # what was kept from earlier work would hide what this one needs
    trim(0)
    try:
        Path("/proc/self/clear_refs").write_text("5")  # the high-water mark starts anew
        before = _status("VmRSS")
    except OSError:
        before = None
    yield result
    if before is not None:
        result[0] = max(0.0, _status("VmHWM") - before)


def _status(name: str) -> float:
    """A line of /proc/self/status, MiB."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) / 1024 for line in lines if line.startswith(f"{name}:"))


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


K = TypeVar("K")
T = TypeVar("T")


def in_processes(
    work: Callable[..., T], tasks: Mapping[K, tuple[Any, ...]], workers: int, prepare: Callable[..., object], *given: Any
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


def _begin(prepare: Callable[..., object], given: tuple[Any, ...]) -> None:
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


def _wait(sentinel: int) -> None:
    connection.wait([sentinel])
    os._exit(1)
