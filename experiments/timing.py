"""Times programs on a machine that others use too. Programs that are compared take turns in one
process, so that all see the same load.

CPU time of the process counts the work of all threads. Wall time is what a user waits. Other
programs on the machine multiply wall time by several times, and CPU time (caches, clock) by up to a
third, so ratios of CPU times are compared first.
"""

import os
import time
from collections.abc import Callable, Mapping

import numpy as np


def prepare_process() -> None:
    """Sets what has to be set before JAX starts: OpenMP threads that sleep, and an allocator that
    keeps freed memory.
    """
    # the CPU time of threads that spin would be counted
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")

    from humangs_jax.core.processes import keep_freed_memory

    keep_freed_memory()


def timed(function: Callable[[], object]) -> tuple[float, float]:
    """Returns the wall ms of one call, and the CPU ms of all threads of the process."""
    cpu, wall = time.process_time(), time.perf_counter()
    function()
    return 1e3 * (time.perf_counter() - wall), 1e3 * (time.process_time() - cpu)


def medians(
    runs: Mapping[str, Callable[[], object]], repeats: int, warm_up: int = 1
) -> dict[str, np.ndarray]:
    """Returns {run: (wall ms, CPU ms)}, medians over `repeats` iterations in which each run has one
    turn. Before that each run is called `warm_up` times.
    """
    for _ in range(warm_up):
        for run in runs.values():
            run()
    samples = {name: [] for name in runs}
    for _ in range(repeats):
        for name, run in runs.items():
            samples[name].append(timed(run))
    return {name: np.median(np.asarray(sample), axis=0) for name, sample in samples.items()}
