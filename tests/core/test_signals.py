import signal
import subprocess
import sys
import threading

import pytest

from humangs_jax.core.processes import started_deaf, undisturbed

pytestmark = pytest.mark.skipif(not hasattr(signal, "pthread_sigmask"), reason="needs signals of POSIX")


@pytest.fixture(autouse=True)
def _default_handler():
    """Shells start what runs in the background without it."""
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
    thread = threading.Thread(target=lambda: undisturbed().__enter__())  # only the main thread may set handlers
    thread.start()
    thread.join()
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


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
            program = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL)
        ends[deaf] = program.communicate()[0]
    assert ends == {True: b"alive\n", False: b""}
    assert signal.SIGINT not in signal.pthread_sigmask(signal.SIG_BLOCK, set())
