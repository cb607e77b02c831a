"""The peak of memory, interrupts that wait, threads, and workers that end with their process."""

import multiprocessing
import os
import pickle
import signal
import subprocess
import sys
import threading
import time

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from humangs_jax.core.processes import (
    in_processes,
    in_threads,
    peak_memory,
    started_deaf,
    undisturbed,
)

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
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM, mode], capture_output=True, text=True, check=True
    )
    return [int(word) for word in done.stdout.split()]


def test_freed_blocks_stay_with_the_process():
    kept, faults = run("keep")
    if not kept:
        pytest.skip("this C library has no such setting")
    assert faults < 10
    assert run("default")[1] > 10 * max(faults, 1)  # one for each 4 KiB page, or for each huge one


def test_the_peak_is_that_of_the_work_inside():
    """Memory that was freed before, or is kept from before, does not count."""
    kept = np.ones(16 << 20, np.uint8)
    for size in (96, 32):
        with peak_memory() as peak:
            block = np.ones(size << 20, np.uint8)
            del block
        if peak[0] is None:
            pytest.skip("this system does not tell")
        assert size - 1 <= peak[0] < size + 24, peak
    del kept


pytestmark = pytest.mark.skipif(
    not hasattr(signal, "pthread_sigmask"), reason="needs signals of POSIX"
)


@pytest.fixture(autouse=True)
def _default_handler():
    """Sets Python's handler of interrupts: shells start background processes without it."""
    previous = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, previous)


def test_an_interrupt_waits_for_the_end_of_the_block():
    done = []
    with pytest.raises(KeyboardInterrupt), undisturbed():
        signal.raise_signal(signal.SIGINT)
        done.append("all of it")
    assert done == ["all of it"] and signal.getsignal(signal.SIGINT) is signal.default_int_handler
    with undisturbed():
        pass
    # only the main thread may set handlers
    thread = threading.Thread(target=lambda: undisturbed().__enter__())
    thread.start()
    thread.join()
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_an_interrupt_that_ends_the_process_waits_too():
    """Programs of other languages start Python without its handler."""
    code = (
        "import signal; from humangs_jax.core.processes import undisturbed\n"
        "signal.signal(signal.SIGINT, signal.SIG_DFL)\n"
        "with undisturbed():\n"
        "    signal.raise_signal(signal.SIGINT); print('all of it', flush=True)\n"
        "print('more')"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (-signal.SIGINT, "all of it\n")


def test_a_process_that_is_started_deaf_survives_an_interrupt():
    code = "import os, signal; os.kill(os.getpid(), signal.SIGINT); print('alive')"
    ends = {}
    for deaf in (True, False):
        if deaf:
            with started_deaf():
                program = subprocess.Popen(
                    [sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL
                )
        else:
            program = subprocess.Popen(
                [sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL
            )
        ends[deaf] = program.communicate()[0]
    assert ends == {True: b"alive\n", False: b""}
    assert signal.SIGINT not in signal.pthread_sigmask(signal.SIG_BLOCK, set())


def test_work_that_ends_early_ends_its_own_processes_and_no_others():
    context = multiprocessing.get_context("spawn")
    other = context.Process(target=time.sleep, args=(60,), daemon=True)
    other.start()
    try:
        with pytest.raises(ValueError, match="must be non-negative"):
            list(in_processes(time.sleep, {"wrong": (-1,), "long": (60,)}, 2, print))
        other.join(0.2)
        assert multiprocessing.active_children() == [other]
    finally:
        other.kill()
        other.join()


def test_work_that_cannot_be_pickled_fails_before_processes_start(monkeypatch):
    monkeypatch.setattr(multiprocessing, "get_context", None)
    with pytest.raises((pickle.PicklingError, AttributeError), match="lambda"):
        list(in_processes(lambda: 0, {"one": (), "two": ()}, 2, print))


@pytest.mark.parametrize("threads", [1, 3])
def test_results_of_threads_come_in_the_order_of_the_tasks(threads):
    def late(number):
        time.sleep(0.02 * (number % 3 == 0))
        return number

    assert list(in_threads(late, ((n,) for n in range(20)), threads)) == list(range(20))
    assert list(in_threads(late, [], threads)) == []


def test_as_many_tasks_run_at_a_time_as_there_are_threads():
    meeting = threading.Barrier(3)
    running = in_threads(meeting.wait, [(60,)] * 6, 3)  # fails unless three are there
    assert sorted(running) == [0, 0, 1, 1, 2, 2]


def test_few_tasks_begin_before_the_caller_asks():
    begun = []
    running = in_threads(begun.append, ((n,) for n in range(50)), 2)
    next(running)
    time.sleep(0.05)
    assert len(begun) <= 3
    running.close()
    assert len(begun) <= 3


@pytest.mark.parametrize("threads", [1, 2])
def test_the_first_error_of_a_task_is_raised_in_its_turn(threads):
    found = []
    with pytest.raises(ZeroDivisionError):
        for result in in_threads(lambda x: 1 / x, [(2,), (1,), (0,), (4,)], threads):
            found.append(result)
    assert found == [0.5, 1]


def test_settings_of_jax_hold_in_the_threads():
    """JAX keeps what a block of code sets for the thread that runs the block."""

    def made(number):
        return jnp.zeros(number).dtype, jax.config.jax_default_matmul_precision

    with jax.enable_x64(True), jax.default_matmul_precision("highest"):
        assert set(in_threads(made, [(1,), (2,)], 2)) == {(np.dtype("float64"), "highest")}
    assert set(in_threads(made, [(1,), (2,)], 2)) == {(np.dtype("float32"), None)}


POOL = """
import concurrent.futures, multiprocessing, os, time
from humangs_jax.core.processes import end_with_parent
if __name__ == "__main__":
    end_with_parent()  # of no pool: nothing happens
    context = multiprocessing.get_context("spawn")
    with concurrent.futures.ProcessPoolExecutor(2, context, end_with_parent) as pool:
        print(pool.submit(os.getpid).result(), flush=True)
        time.sleep(600)
"""


def runs(pid):
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return True


def test_workers_of_a_killed_process_end(tmp_path):
    script = tmp_path / "pool.py"
    script.write_text(POOL)
    with subprocess.Popen(
        [sys.executable, str(script)], stdout=subprocess.PIPE, text=True
    ) as process:
        worker = int(process.stdout.readline())
        process.send_signal(signal.SIGKILL)
    deadline = time.monotonic() + 60
    while runs(worker):
        assert time.monotonic() < deadline, "the worker waits for ever"
        time.sleep(0.02)
