"""Timing on a machine that others use too: competitors take turns in one process, so that all see
the same load.

Process CPU time counts what all threads worked; wall time is what a user waits. Other programs
stretch wall time by several times, and CPU time (caches, clock) by a third: compare ratios of CPU
times first.
"""

import os
import time
from collections.abc import Callable, Mapping

import numpy as np


def prepare_process() -> None:
    """What has to be set before JAX starts: sleeping OpenMP threads, and an allocator that keeps
    what it has.
    """
    os.environ.setdefault(
        "OMP_WAIT_POLICY", "passive"
    )  # spinning ones would be counted as CPU time

    from humangs_jax.core.processes import keep_freed_memory

    keep_freed_memory()


def timed(function: Callable[[], object]) -> tuple[float, float]:
    """Wall ms and process CPU ms (all threads) of one call."""
    cpu, wall = time.process_time(), time.perf_counter()
    function()
    return 1e3 * (time.perf_counter() - wall), 1e3 * (time.process_time() - cpu)


def medians(
    runs: Mapping[str, Callable[[], object]], repeats: int, warm_up: int = 1
) -> dict[str, np.ndarray]:
    """(wall ms, CPU ms) of every run: medians over `repeats` iterations in which each has one
    turn.
    """
    for _ in range(warm_up):
        for run in runs.values():
            run()
    samples = {name: [] for name in runs}
    for _ in range(repeats):
        for name, run in runs.items():
            samples[name].append(timed(run))
    return {name: np.median(np.asarray(sample), axis=0) for name, sample in samples.items()}
