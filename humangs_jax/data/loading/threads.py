"""Work ahead of a loop: several threads make examples in order, one thread prepares the batches that are asked for next.

Examples are made by grain if it is installed, else by the standard library. Both call the same pure function with the same
numbers, so the results are equal to the bit. Threads suffice: decoding and jitted functions release the interpreter's lock,
and worker processes of grain take seconds to start.
"""

import collections
import concurrent.futures
import dataclasses
import importlib
import importlib.util
import queue
import threading
import time
from collections.abc import Callable, Generator, Iterator
from typing import Any, Literal, TypeVar

T = TypeVar("T")

THREAD_NAME = "humangs-loader"


@dataclasses.dataclass
class Waiting:
    """How long a loop waited for its data: total seconds, of `items` items, of which the first took `first_seconds`."""

    seconds: float = 0.0
    first_seconds: float = 0.0
    items: int = 0

    def add(self, seconds: float) -> None:
        """One more item."""
        if self.items == 0:
            self.first_seconds = seconds
        self.seconds += seconds
        self.items += 1


def prefetched(make: Callable[[], Iterator[T]], ahead: int, waiting: Waiting | None = None) -> Generator[T, None, None]:
    """The items of the iterator that `make()` returns, up to `ahead` of them prepared by a thread.

    The iterator is used and closed in the thread. Its errors are raised here. Closing the generator (or leaving the
    loop over it) ends the thread. waiting: the time that the loop waited is added to it.
    """
    ready: queue.Queue = queue.Queue(maxsize=max(1, ahead))
    stopped = threading.Event()

    def put(item):
        while not stopped.is_set():
            try:
                ready.put(item, timeout=0.1)
                return
            except queue.Full:
                continue

    def produce():
        iterator = None
        try:
            iterator = make()
            for item in iterator:
                if stopped.is_set():
                    return
                put((item, None, False))
            put((None, None, True))
        except BaseException as error:  # the error is raised in the loop
            put((None, error, True))
        finally:
            close = getattr(iterator, "close", None)
            if close is not None:
                close()

    thread = threading.Thread(target=produce, name=THREAD_NAME, daemon=True)
    thread.start()
    try:
        while True:
            began = time.perf_counter()
            item, error, last = ready.get()
            if error is not None:
                raise error
            if last:
                return
            if waiting is not None:
                waiting.add(time.perf_counter() - began)
            yield item
    finally:
        stopped.set()
        thread.join()


Reader = Literal["auto", "grain", "plain"]


def has_grain() -> bool:
    """Whether grain can be imported."""
    return importlib.util.find_spec("grain") is not None


def read_in_order(
    make: Callable[[int], T], count: int, threads: int, ahead: int, reader: Reader = "auto"
) -> Generator[T, None, None]:
    """make(0), make(1), ..., make(count - 1), up to `ahead` of them started before they are needed.

    Raises: ImportError if reader is "grain" and it is not installed; what `make` raises, in its turn.
    """
    if count <= 0:
        return
    read = _read_with_grain if reader == "grain" or (reader == "auto" and has_grain()) else _read_plainly
    yield from read(make, count, max(1, threads), max(1, ahead))


def _read_with_grain(make, count, threads, ahead):
    grain: Any = importlib.import_module("grain")  # optional, and then unknown to type checkers
    options = grain.ReadOptions(num_threads=threads, prefetch_buffer_size=max(ahead, threads))
    examples = iter(grain.MapDataset.range(count).map(make).to_iter_dataset(options))
    try:
        yield from examples
    finally:
        examples.close()


def _read_plainly(make, count, threads, ahead):
    ahead = max(ahead, threads)
    with concurrent.futures.ThreadPoolExecutor(threads, thread_name_prefix="humangs-reader") as pool:
        pending = collections.deque(pool.submit(make, i) for i in range(min(ahead, count)))
        begun = len(pending)
        try:
            while pending:
                yield pending.popleft().result()
                if begun < count:
                    pending.append(pool.submit(make, begun))
                    begun += 1
        finally:
            for future in pending:
                future.cancel()
