"""Reads hostile files in a process that may do little else: python worker.py FOLDER NAMES.json
writes a line for each.

Limits: address space (`MEMORY` above what the imports took), seconds a file, and an audit hook that
forbids programs, sockets, and writing or deleting outside of the file's own folder. A worker that
dies is started again behind the file that killed it.
"""

import json
import os
import resource
import signal
import sys
import time
import traceback
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
MEMORY, RESIDENT, SECONDS, WAITING = 3 << 30, 1 << 30, 10.0, 120.0
"""Bytes of address space, bytes that a file may make resident, seconds of the processor and of the
clock that it may take.
"""
FORBIDDEN = (
    *(
        "subprocess.Popen",
        "os.system",
        "os.exec",
        "os.posix_spawn",
        "os.spawn",
        "os.fork",
        "os.forkpty",
        "pty.spawn",
    ),
    *("socket.connect", "socket.bind", "socket.getaddrinfo", "urllib.Request", "webbrowser.open"),
)
MODULES = ("antigravity", "this", "webbrowser", "humangs_jax.cli.__main__")
"""A file may name modules: none of these is imported."""
CHANGES = (
    *(
        "os.remove",
        "os.rmdir",
        "os.rename",
        "os.mkdir",
        "os.link",
        "os.symlink",
        "os.chmod",
        "os.truncate",
        "os.utime",
    ),
    *("shutil.rmtree", "shutil.copyfile", "shutil.move"),
)

DESCRIPTORS = {"os.remove": 1, "os.rmdir": 1, "os.mkdir": 2, "os.rename": 2}
"""Which of their arguments is the descriptor of a folder: `shutil.rmtree` deletes with these."""


class Forbidden(BaseException):
    """No reader catches it."""


class TooLong(BaseException):
    """Raised after too many seconds; no reader catches it."""


class Watch:
    """The audit hook; hooks stay for ever, so that this one is switched on and off."""

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
            writes = any(c in (mode or "") for c in "wax+") or (flags or 0) & (
                os.O_WRONLY | os.O_RDWR | os.O_CREAT
            )
            if writes:
                self.check(event, path)
        elif event in CHANGES:
            for path in arguments[:2]:
                if isinstance(path, str | bytes | os.PathLike):
                    self.check(
                        event, path, arguments[DESCRIPTORS[event]] if event in DESCRIPTORS else -1
                    )

    def check(self, event, path, folder=-1):
        """folder: descriptor of the folder that the path is relative to, -1 for the working
        folder.
        """
        base = os.getcwd() if folder == -1 else os.readlink(f"/proc/self/fd/{folder}")
        if not Path(os.path.abspath(os.path.join(base, os.fsdecode(path)))).is_relative_to(
            self.folder
        ):
            self.stop(event, path)

    def stop(self, event, arguments):
        self.seen.append(f"{event} {arguments!r}"[:300])
        raise Forbidden(self.seen[-1])


def chain(error):
    while error is not None:
        yield error
        error = error.__cause__ or error.__context__


def run(case, read, folder, watch, measured=True):
    """The result of one file as a dict. measured: whether to look at the memory that it takes,
    which is slow.
    """
    path = case.make(folder)
    if measured:
        Path("/proc/self/clear_refs").write_text("5")  # forget the most that was resident so far
    before, start = resident(), time.process_time()
    result = {"name": case.name, "reader": case.reader, "path": str(path)}
    watch.folder, watch.seen = folder.resolve(), []
    signal.setitimer(signal.ITIMER_PROF, SECONDS)
    signal.setitimer(signal.ITIMER_REAL, WAITING)
    try:
        read(path)
        result |= {"outcome": "read", "message": ""}
    except (ValueError, OSError) as error:
        result |= {"outcome": "refused", "message": str(error), "type": type(error).__name__}
        if any(isinstance(each, MemoryError) for each in chain(error)):
            result |= {"outcome": "memory"}
    except (Forbidden, TooLong) as error:
        result |= {"outcome": type(error).__name__, "message": str(error)}
    except BaseException as error:
        result |= {
            "outcome": "traceback",
            "message": "".join(traceback.format_exception(error))[-1500:],
        }
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        signal.setitimer(signal.ITIMER_REAL, 0)
        watch.folder = None
    if watch.seen:
        result |= {"outcome": "Forbidden", "message": watch.seen[0]}
    grown = resident() - before
    if grown > RESIDENT:
        result |= {"outcome": "memory", "message": f"{grown:,} bytes more resident"}
    return result | {"seconds": round(time.process_time() - start, 4), "bytes": grown}


def resident():
    """The most that was resident, bytes."""
    (line,) = (
        each
        for each in Path("/proc/self/status").read_text().splitlines()
        if each.startswith("VmHWM")
    )
    return int(line.split()[1]) * 1024


def limit_memory():
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (used + MEMORY, used + MEMORY))


def too_long(*_):
    raise TooLong(f"more than {SECONDS:g} s of the processor, or {WAITING:g} s")


def prepare():
    """Paths of the test helpers, JAX on one CPU, and everything imported that readers import
    late.
    """
    sys.path[:0] = [
        str(ROOT / "tests" / name)
        for name in ("hostile", "network", "capture", "data/datasets", "")
    ]
    os.environ |= {"JAX_PLATFORMS": "cpu", "JAX_ENABLE_COMPILATION_CACHE": "0"}
    import jax

    jax.config.update("jax_platforms", "cpu")
    signal.signal(signal.SIGALRM, too_long)
    signal.signal(signal.SIGPROF, too_long)


def warm_up(readers, folder):
    """Reads every honest file once; what is wrong with one is raised."""
    for name, each in readers.FORMATS.items():
        if each.make is not None:
            place = folder / "honest" / name.replace(" ", "_")
            place.mkdir(parents=True)
            each.read(each.make(place))


def main():
    folder, names = Path(sys.argv[1]), set(json.loads(Path(sys.argv[2]).read_text()))
    prepare()
    import hostile_cases
    import readers

    warm_up(readers, folder)
    watch = Watch()
    limit_memory()
    with open(folder / "results.jsonl", "a", buffering=1) as results:
        for number, case in enumerate(
            each for each in hostile_cases.all_cases() if each.name in names
        ):
            results.write(json.dumps({"begun": case.name}) + "\n")
            place = folder / f"case{number}"
            place.mkdir()
            results.write(
                json.dumps(run(case, readers.FORMATS[case.reader].read, place, watch)) + "\n"
            )


if __name__ == "__main__":
    main()
