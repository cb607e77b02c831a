"""Freed blocks are used again instead of being mapped anew: counted in page faults of a fresh process."""

import subprocess
import sys

import numpy as np
import pytest

from humangs_jax.core.processes import peak_memory

PROGRAM = """
import resource
import sys
import numpy as np
from humangs_jax.core.processes import keep_freed_memory

kept = keep_freed_memory() if sys.argv[1] == "keep" else False
faults = []
for _ in range(6):
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    block = np.empty(48 << 20, np.uint8)
    block[::4096] = 1
    del block
    faults.append(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
print(int(kept), faults[-1])
"""


def run(mode):
    done = subprocess.run([sys.executable, "-c", PROGRAM, mode], capture_output=True, text=True, check=True)
    return [int(word) for word in done.stdout.split()]


def test_freed_blocks_stay_with_the_process():
    kept, faults = run("keep")
    if not kept:
        pytest.skip("this C library has no such setting")
    assert faults < 10
    assert run("default")[1] > 10 * max(faults, 1)  # one for each 4 KiB page, or for each huge one


def test_the_peak_is_that_of_the_work_inside():
    """Not of what was freed before, nor of what is kept."""
    kept = np.ones(16 << 20, np.uint8)
    for size in (96, 32):
        with peak_memory() as peak:
            block = np.ones(size << 20, np.uint8)
            del block
        if peak[0] is None:
            pytest.skip("this system does not tell")
        assert size - 1 <= peak[0] < size + 24, peak
    del kept
