"""Examples in order, made by several threads: by grain where it is installed, by the standard library where it is not.

Both call the same pure function with the same numbers, so what comes out is equal to the bit. Threads suffice: decoding and
jitted functions let go of the interpreter's lock, and worker processes of grain take seconds to start.
"""

import collections
import concurrent.futures
import importlib
import importlib.util
from collections.abc import Callable, Generator
from typing import Any, Literal, TypeVar

T = TypeVar("T")
Reader = Literal["auto", "grain", "plain"]


def has_grain() -> bool:
    """Whether grain can be imported."""
    return importlib.util.find_spec("grain") is not None


def read_in_order(
    make: Callable[[int], T], count: int, threads: int, ahead: int, reader: Reader = "auto"
) -> Generator[T, None, None]:
    """make(0), make(1), ..., make(count - 1), up to `ahead` of them begun before they are asked for.

    Raises: ImportError if reader is "grain" and there is none; whatever `make` raises, when its turn comes.
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
