"""Watches what reading a file does.

A reader may start no program, open no connection, write only in the file's folder, and take bounded
memory and time.
"""

import contextlib
import os
import resource
import signal
import sys
import time
from pathlib import Path

from humangs_jax.core.progress import printable

MEMORY = 3 << 30
"""Bytes of address space that reading a file may add to what the process has."""
RESIDENT = 1 << 30
"""Bytes that reading a file may make resident."""
SECONDS = 10.0
"""Seconds of the processor that reading a file may take."""
KILLED = 60
"""Seconds of the processor after which the run of all tests ends: loops in C hear no signal."""
LONGEST_LINE = 1500
FORBIDDEN = {
    *("subprocess.Popen", "os.system", "os.exec", "os.posix_spawn", "os.fork", "pty.spawn"),
    *("socket.connect", "socket.bind", "socket.getaddrinfo", "urllib.Request", "webbrowser.open"),
}
MODULES = ("antigravity", "this", "webbrowser", "humangs_jax.cli.__main__")
"""Modules that hostile files name; none of them may be imported."""
CHANGES = {
    *("os.remove", "os.rmdir", "os.rename", "os.mkdir", "os.link", "os.symlink", "os.chmod"),
    *("os.truncate", "shutil.rmtree", "shutil.copyfile", "shutil.move"),
}
DESCRIPTORS = {"os.remove": 1, "os.rmdir": 1, "os.mkdir": 2, "os.rename": 2}
"""Number of the argument that is the descriptor of the folder a path is relative to."""
CACHES = os.environ.get("JAX_COMPILATION_CACHE_DIR", "")


class Forbidden(BaseException):
    """Raised for what is forbidden; no reader catches it."""


class Watch:
    """An audit hook, which stays for ever and therefore acts only while `folder` is set."""

    def __init__(self):
        self.folder, self.seen = None, []
        sys.addaudithook(self.audit)

    def audit(self, event, arguments):
        if self.folder is None:
            return
        if event in FORBIDDEN or (event == "import" and arguments[0] in MODULES):
            self.stop(event, arguments)
        if event == "open" and isinstance(arguments[0], str | bytes | os.PathLike):
            path, mode, flags = arguments
            made = (flags or 0) & (os.O_WRONLY | os.O_RDWR | os.O_CREAT)
            if made or any(letter in (mode or "") for letter in "wax+"):
                self.check(event, path)
        elif event in CHANGES:
            where = arguments[DESCRIPTORS[event]] if event in DESCRIPTORS else -1
            for path in arguments[:2]:
                if isinstance(path, str | bytes | os.PathLike):
                    self.check(event, path, where)

    def check(self, event, path, where=-1):
        """Stops an event outside of the folder.

        `where` is the descriptor of the folder that the path is relative to, -1 for the working
        folder.
        """
        base = os.getcwd() if where == -1 else os.readlink(f"/proc/self/fd/{where}")
        place = Path(os.path.abspath(os.path.join(base, os.fsdecode(path))))
        allowed = place.is_relative_to(self.folder) or place == Path(os.devnull)
        if not allowed and not (CACHES and place.is_relative_to(CACHES)):
            self.stop(event, path)

    def stop(self, event, arguments):
        self.seen.append(f"{event} {arguments!r}"[:300])
        raise Forbidden(self.seen[-1])


WATCH = Watch()


def too_long(*_):
    raise Forbidden(f"more than {SECONDS:g} s of the processor")


@contextlib.contextmanager
def watched(folder):
    """Forbids what this module names while the context is open."""
    status = Path("/proc/self/statm")
    pages = [int(number) for number in status.read_text().split()]
    size = resource.getpagesize()
    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    times = resource.getrlimit(resource.RLIMIT_CPU)
    before = signal.signal(signal.SIGPROF, too_long)
    bytecode, sys.dont_write_bytecode = sys.dont_write_bytecode, True  # of modules imported late
    WATCH.folder, WATCH.seen = Path(folder).resolve(), []
    resource.setrlimit(resource.RLIMIT_AS, (pages[0] * size + MEMORY, hard))
    resource.setrlimit(resource.RLIMIT_CPU, (int(time.process_time()) + KILLED, times[1]))
    signal.setitimer(signal.ITIMER_PROF, SECONDS)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        resource.setrlimit(resource.RLIMIT_AS, (soft, hard))
        resource.setrlimit(resource.RLIMIT_CPU, times)
        WATCH.folder, sys.dont_write_bytecode = None, bytecode
        signal.signal(signal.SIGPROF, before)
    assert not WATCH.seen
    assert (int(status.read_text().split()[1]) - pages[1]) * size < RESIDENT


def chain(error):
    while error is not None:
        yield error
        error = error.__cause__ or error.__context__


def outcome(read, path, folder):
    """Returns "read" or "refused".

    Raises:
        AssertionError: if a refusal is no line that names a full path.
        Exception: whatever else reading raises.
    """
    try:
        with watched(folder):
            read(path)
    except (ValueError, OSError) as error:
        line = str(error)
        assert line == printable(line) and "\n" not in line and len(line) < LONGEST_LINE, line
        assert str(folder) in line
        assert not any(isinstance(each, MemoryError) for each in chain(error)), line
        return "refused"
    return "read"
