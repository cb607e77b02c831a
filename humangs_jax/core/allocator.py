"""How the C library's allocator treats the large temporary arrays of compiled programs.

XLA's CPU backend allocates the temporaries of a program as one block in each call and frees it afterwards. glibc gives
blocks above 32 MiB back to the system, and so the next call waits for each of its pages to be mapped anew: measured, a
fifth of the time of drawing a person at 512 x 512 with gradients, and more in training.
"""

import ctypes
import sys

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
