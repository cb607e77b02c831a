"""How the C library's allocator treats the large temporary arrays of compiled programs.

XLA's CPU backend allocates the temporaries of a program as one block in each call and frees it afterwards. glibc gives
blocks above 32 MiB back to the system, and so the next call waits for each of its pages to be mapped anew: measured, a
fifth of the time of drawing a person at 512 x 512 with gradients, and more in training.
"""

import contextlib
import ctypes
import gc
import sys
from collections.abc import Generator
from pathlib import Path

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


def _status(name):
    """A line of /proc/self/status, MiB."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) / 1024 for line in lines if line.startswith(f"{name}:"))
