"""Workers end with the process that started them, even if it is killed."""

import os
import signal
import subprocess
import sys
import time

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
    with subprocess.Popen([sys.executable, str(script)], stdout=subprocess.PIPE, text=True) as process:
        worker = int(process.stdout.readline())
        process.send_signal(signal.SIGKILL)
    deadline = time.monotonic() + 60
    while runs(worker):
        assert time.monotonic() < deadline, "the worker waits for ever"
        time.sleep(0.02)
