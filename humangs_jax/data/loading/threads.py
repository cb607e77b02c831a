"""Work ahead of a loop: several threads make examples in order, one thread prepares the batches that are asked for next.

Threads suffice: decoding and jitted functions release the interpreter's lock.
"""

import collections
import concurrent.futures
import dataclasses
import queue
import threading
import time
from collections.abc import Callable, Generator, Iterator
from typing import TypeVar

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


def read_in_order(make: Callable[[int], T], count: int, threads: int, ahead: int) -> Generator[T, None, None]:
    """make(0), make(1), ..., make(count - 1), up to `ahead` of them started before they are needed.

    Raises: what `make` raises, in its turn.
    """
    threads, ahead = max(1, threads), max(1, ahead, threads)
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
