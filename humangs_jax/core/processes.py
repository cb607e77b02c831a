"""Functions that concern whole processes: the memory they keep, Ctrl-C at times when it would do
harm, worker processes, and compiled programs on disk.

XLA's CPU backend allocates the temporaries of a program as one block in each call and frees it
afterwards. glibc gives blocks above 32 MiB back to the system, and the next call waits for each of
its pages to be mapped anew. `keep_freed_memory` prevents this.
"""

import collections
import contextlib
import ctypes
import functools
import gc
import hashlib
import multiprocessing
import os
import pickle
import platform
import signal
import stat
import sys
import tempfile
import threading
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping
from importlib.metadata import version
from multiprocessing import connection
from pathlib import Path
from typing import Any, TypeVar


def keep_freed_memory() -> bool:
    """Makes the process keep freed blocks of up to 1 GiB for its next arrays. Returns whether the C
    library took these settings, which glibc does.

    Programs call it once, before the first large array; the library never does. The process then
    hardly gets smaller than its peak.
    """
    if not sys.platform.startswith("linux"):
        return False
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    # numbers of malloc.h: blocks of up to 1 GiB stay with the process once it has needed them, and
    # there is one arena for all threads (the others would hold 64 MiB at most)
    mmap_threshold, trim_threshold, arena_max, kept = -3, -1, -8, 1 << 30
    settings = ((mmap_threshold, kept), (trim_threshold, kept), (arena_max, 1))
    return mallopt is not None and all([mallopt(*setting) for setting in settings])


@contextlib.contextmanager
def peak_memory() -> Generator[list[float | None]]:
    """Yields a list of one number. After the block, the number is the memory in MiB that the block
    added to the process at its peak.

    The number is None on systems other than Linux with glibc, and where /proc cannot be written to.
    It does not include the memory of a GPU or TPU.
    """
    result: list[float | None] = [None]
    trim = None
    if sys.platform.startswith("linux"):
        trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
    if trim is None:
        yield result
        return
    gc.collect()  # what was kept from earlier work would hide what this one needs
    trim(0)
    try:
        Path("/proc/self/clear_refs").write_text("5")  # the high-water mark starts anew
        before = memory_status("VmRSS")
    except OSError:
        before = None
    yield result
    if before is not None:
        result[0] = max(0.0, memory_status("VmHWM") - before)


def memory_status(name: str) -> float:
    """Returns a number of /proc/self/status in MiB. "VmRSS" is the resident memory now, and "VmHWM"
    is its peak.

    This works on Linux only.
    """
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) / 1024 for line in lines if line.startswith(f"{name}:"))


@contextlib.contextmanager
def undisturbed() -> Generator[None]:
    """Makes Ctrl-C wait until the end of the block. Use it for short work that must not be left
    half-done. It does nothing in a thread other than the main one, because Ctrl-C reaches only the
    main thread.
    """
    if threading.current_thread() is not threading.main_thread():  # only that one gets it
        yield
        return
    waiting: list[int] = []
    previous = signal.signal(signal.SIGINT, lambda number, _: waiting.append(number))
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, previous)
        if waiting:
            signal.raise_signal(signal.SIGINT)


@contextlib.contextmanager
def started_deaf() -> Generator[None]:
    """Makes the processes that are started in the block ignore Ctrl-C. A terminal sends Ctrl-C to
    all of its processes, but the starting process is to decide when the others end.

    Without this, Ctrl-C ends processes that are still importing, with tracebacks. This still
    happens on Windows, which has no masks of signals.
    """
    with undisturbed():
        if not hasattr(signal, "pthread_sigmask"):
            yield
            return
        before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})  # children inherit it
        try:
            yield
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)


K = TypeVar("K")
T = TypeVar("T")


def in_processes(
    work: Callable[..., T],
    tasks: Mapping[K, tuple[Any, ...]],
    workers: int,
    prepare: Callable[..., object],
    *given: Any,
) -> Iterator[tuple[K, T]]:
    """Yields (name, work(*arguments)) for each named task, in the order in which the tasks end. The
    tasks run in several processes, each with one thread, on the CPU.

    If the caller stops, by Ctrl-C or otherwise, or if a task fails, unfinished tasks are dropped
    and the worker processes are ended. Other processes of the caller go on.

    Arguments: work: a function. tasks: the arguments of `work` by name. workers: largest number of
    processes. prepare: called as prepare(*given) when a process starts. Both functions, their
    arguments and the results are pickled.

    Raises: OSError if a process is killed, or if `prepare` fails; PicklingError and others if the
    arguments cannot be pickled; ValueError if there are no tasks, or if `workers` is below 1;
    anything that `work` raises.
    """
    import concurrent.futures.process

    # Python pickles tasks in a thread of the pool. If that fails while the processes end, this
    # thread and another one of the pool wait for each other for ever (seen with 3.12.1)
    calls = {name: pickle.dumps((work, arguments)) for name, arguments in tasks.items()}
    context = multiprocessing.get_context("spawn")  # a forked process may hang in jax's threads
    count = min(workers, len(tasks))
    with concurrent.futures.ProcessPoolExecutor(count, context, _begin, (prepare, given)) as pool:
        try:
            with started_deaf():
                futures = {pool.submit(_call, call): name for name, call in calls.items()}
            for future in concurrent.futures.as_completed(futures):
                yield futures[future], future.result()
        except concurrent.futures.process.BrokenProcessPool as error:
            raise OSError(
                "a working process was killed, perhaps for want of memory: try fewer workers"
            ) from error
        except BaseException:
            started = list(pool._processes.values())  # Python 3.14 has terminate_workers
            pool.shutdown(wait=False, cancel_futures=True)
            for process in started:
                process.terminate()
            raise


def _call(pickled: bytes) -> Any:
    """Returns the result of a pickled function and its arguments."""
    work, arguments = pickle.loads(pickled)
    return work(*arguments)


def _begin(prepare: Callable[..., object], given: tuple[Any, ...]) -> None:
    """Prepares a worker process. XLA gets one thread in it, because the processes run side by
    side.
    """
    import signal

    import jax

    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent decides
    end_with_parent()
    os.environ["XLA_FLAGS"] = (
        os.environ.get("XLA_FLAGS", "") + " --xla_cpu_multi_thread_eigen=false"
    )
    jax.config.update("jax_platforms", "cpu")
    prepare(*given)


def usable_cores() -> int:
    """Returns the number of cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def in_threads(
    work: Callable[..., T], tasks: Iterable[tuple[Any, ...]], threads: int
) -> Iterator[T]:
    """Yields work(*arguments) for each task, in the order of the tasks. At most `threads` tasks run
    at a time. The work is at most `threads` + 1 results ahead of the caller.

    XLA draws an image on one core of a CPU, but several threads can draw at the same time. The
    tasks run under the values that JAX's settings `enable_x64` and `default_matmul_precision` have
    in the calling thread.

    If the caller stops, by Ctrl-C or otherwise, or if a task fails, tasks that have not begun are
    dropped.

    Raises: anything that `work` raises, when it is the task's turn.
    """
    if threads == 1:
        for arguments in tasks:
            yield work(*arguments)
        return
    import concurrent.futures

    import jax

    wide, precision = jax.config.jax_enable_x64, jax.config.jax_default_matmul_precision

    def run(arguments: tuple[Any, ...]) -> T:
        with jax.enable_x64(wide), jax.default_matmul_precision(precision):
            return work(*arguments)

    pool = concurrent.futures.ThreadPoolExecutor(threads, "humangs")
    begun: collections.deque[concurrent.futures.Future[T]] = collections.deque()
    try:
        for arguments in tasks:
            begun.append(pool.submit(run, arguments))
            if len(begun) > threads:
                yield begun.popleft().result()
        while begun:
            yield begun.popleft().result()
    finally:
        pool.shutdown(cancel_futures=True)


def end_with_parent() -> None:
    """Makes a worker process end as soon as the process that started it has ended, for any reason.
    Call it in the worker.

    Without it, the workers of a pool would wait for work for ever if the pool's process is killed.
    They would not notice, because each worker keeps the others' queue open.
    """
    parent = multiprocessing.parent_process()
    if parent is None:
        return

    def wait() -> None:
        connection.wait([parent.sentinel])
        os._exit(1)

    threading.Thread(target=wait, daemon=True).start()


# How XLA compiles: a program of this package takes seconds to a minute. JAX has the cache; here is
# where it lies, and how large it may grow.

VARIABLE = "HUMANGS_COMPILE_CACHE"
"""Environment variable that names the folder of compiled programs. 0: no folder."""
OF_JAX = "JAX_COMPILATION_CACHE_DIR"
"""JAX's environment variable for the folder of compiled programs."""
LARGEST = 2 << 30
"""Largest size of the cache, bytes. From a larger cache, `enable_compile_cache` deletes the files
that were not used for longest. JAX's own limit needs the package `filelock`.
"""


QUICKEST_OF_JAX = "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"
QUICKEST = 0.1
"""A program is kept on disk if its compilation takes at least this long, seconds. JAX's default is
a second, with which most programs of a command are compiled again each time.
"""


def enable_compile_cache(folder: str | os.PathLike[str] | None = None) -> Path | None:
    """Turns on JAX's persistent compilation cache, in a folder for each version of JAX and of this
    package and each kind of processor.

    Programs call it once, before the first computation; the library never does. JAX is not imported
    here. It finds the folder in its environment variable, and so do the programs that this one
    starts.

    If JAX already has a cache (`JAX_COMPILATION_CACHE_DIR`), this cache stays in use and nothing
    changes. `HUMANGS_COMPILE_CACHE=0` does not turn it off.

    Args:
        folder: the folder that holds the caches. None: the folder that the environment variable
            `HUMANGS_COMPILE_CACHE` names, else `humangs_jax` in the user's cache folder
            (`XDG_CACHE_HOME`, or what the platform has in its place).

    Returns:
        The folder in use, which lies in `folder`, or the one that JAX already had. None if JAX had
        none and `HUMANGS_COMPILE_CACHE` is 0, if the folder cannot be written to, or if there is no
        home.

    Examples:
        >>> hg.enable_compile_cache()
    """
    # a cache that JAX has already stays
    if "jax" in sys.modules:
        given = sys.modules["jax"].config.jax_compilation_cache_dir
    else:
        given = os.environ.get(OF_JAX)
    if given:
        return Path(given)
    wish = os.environ.get(VARIABLE, "")
    if wish == "0":
        return None
    from humangs_jax import __version__  # late: the package is being imported above

    # a folder for each version and processor, if it can be written to
    try:
        root = Path(folder or wish or user_cache() / "humangs_jax").expanduser()
        cache = root / f"jax-{version('jax')}-{version('jaxlib')}-{__version__}-{processor()}"
        cache.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=cache).close()
        _delete_oldest(root.glob("jax-*/**/*-cache"), LARGEST)
    except (OSError, RuntimeError):  # RuntimeError: no home
        return None
    # for programs that this one starts, and for a JAX that is imported already
    os.environ[OF_JAX] = str(cache)
    settings: dict[str, Any] = {"jax_compilation_cache_dir": str(cache)}
    if QUICKEST_OF_JAX not in os.environ:
        os.environ[QUICKEST_OF_JAX] = str(QUICKEST)
        settings["jax_persistent_cache_min_compile_time_secs"] = QUICKEST
    if "jax" in sys.modules:
        for name, value in settings.items():
            sys.modules["jax"].config.update(name, value)
    return cache


_programs: list[Path] = []
"""The folder of `keep_programs`. Empty if programs are not kept."""


def keep_programs(cache: Path) -> None:
    """Keeps the programs of `core.compiled` in a folder, if the folder is safe. Call this once in a
    process, before the first computation.

    A program is code, and its file is read with `pickle`. So the folder is made for the user alone.
    Nothing is kept if the folder belongs to somebody else or is a link. Nothing is kept, either, if
    others may write to it or exchange it for another. Windows has no such owners; there the user's
    cache folder is private.

    Args:
        cache: the folder of JAX's own cache, in which the folder is made.
    """
    folder = cache / "programs"
    with contextlib.suppress(OSError):
        folder.mkdir(mode=0o700, exist_ok=True)
        if sys.platform == "win32" or _is_private(folder):
            source_at_start()  # before more of the package is imported
            _delete_oldest(folder.glob("*-cache"), LARGEST)
            _programs[:] = [folder]


def _is_private(folder: Path) -> bool:
    """Returns whether a folder is the user's, and others can neither write to it nor replace it."""
    own, parent = folder.lstat(), folder.parent.stat()
    replaceable = parent.st_mode & stat.S_IWOTH and not parent.st_mode & stat.S_ISVTX
    return (
        stat.S_ISDIR(own.st_mode)
        and own.st_uid == os.getuid()
        and not own.st_mode & (stat.S_IWGRP | stat.S_IWOTH)
        and not replaceable
    )


@functools.cache
def source_at_start() -> str:
    """Returns a hash of the package's source as it was at the first call."""
    _times_at_start()
    root, source = Path(__file__).parents[1], hashlib.sha256()
    for file in _source_files():
        with contextlib.suppress(OSError):  # a lock of an editor is a link to nothing
            source.update(f"{file.relative_to(root)}\0".encode() + file.read_bytes() + b"\0")
    return source.hexdigest()


def source_has_changed() -> bool:
    """Returns whether the package's source was edited after `source_at_start` was first called."""
    return _source_times() != _times_at_start()


def _source_files() -> list[Path]:
    """Returns the files of the package's source."""
    return sorted(Path(__file__).parents[1].rglob("*.py"))


def _source_times() -> list[tuple[Path, int, int]]:
    """Returns the files of the package's source, the times at which they were written, and their
    sizes.
    """
    found = []
    for file in _source_files():
        with contextlib.suppress(OSError):
            found.append((file, file.stat().st_mtime_ns, file.stat().st_size))
    return found


_times_at_start = functools.cache(_source_times)
"""Returns `_source_times` as it was at the first call."""


def kept_programs() -> Path | None:
    """Returns the folder of `keep_programs`. None: programs are not kept."""
    return _programs[0] if _programs else None


def user_cache() -> Path:
    """Returns the user's cache folder on this platform.

    Raises: RuntimeError if there is no home.
    """
    folder = os.environ.get("XDG_CACHE_HOME")
    if folder:
        return Path(folder)
    folder = os.environ.get("LOCALAPPDATA")
    if sys.platform == "win32" and folder:
        return Path(folder)
    if sys.platform == "darwin":
        return Path.home() / "Library/Caches"
    return Path.home() / ".cache"


def processor() -> str:
    """Returns a short hash of the processor and its instructions. Machines of a cluster share a
    home, but not their compiled programs.
    """
    about = platform.machine() + platform.processor()
    with contextlib.suppress(OSError):
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        about += next((line for line in lines if line.startswith(("flags", "Features"))), "")
    return hashlib.sha256(about.encode()).hexdigest()[:8]


def _delete_oldest(programs: Iterable[Path], largest: int) -> None:
    """Deletes cached programs until at most `largest` bytes are left. Programs that were not used
    for longest go first.
    """
    files = []
    for file in programs:
        with contextlib.suppress(OSError):  # another program deletes, too
            files.append((file, file.stat()))
    total = sum(status.st_size for _, status in files)
    for file, status in sorted(files, key=lambda item: max(item[1].st_atime, item[1].st_mtime)):
        if total <= largest:
            break
        file.unlink(missing_ok=True)  # another program may be doing the same
        total -= status.st_size


CPU_COMPILER_OPTIONS = {
    "xla_cpu_prefer_vector_width": 512,
    "xla_disable_hlo_passes": (
        "cpu-parallel-task-assigner,cse_barrier_expander,small-while-loop-hoisting"
    ),
}
"""Compiler options of `jax.jit` for a program that draws on a CPU. They work from jax 0.10 to 0.12.

The first option sets the width of vectors: with AVX-512, wide ones make the loops over pixels up to
a third faster.

The second option turns off three passes of XLA. The first pass would divide kernels of tens of
microseconds among several threads, which took twice the CPU time and gained nothing. The second one
would remove barriers, which make sure that tables are stored before they are gathered from. The
third one would make one kernel of each loop over a tiny image, and inside of a kernel there are no
barriers.

Eager calls use these options. Pass `compiler_options()` to your own jitted functions.
"""


def compiler_options() -> dict[str, Any] | None:
    """Returns options for `jax.jit` that make programs of this package faster on CPUs.

    Call it late, because it asks for the backend and so starts it.

    Returns:
        `CPU_COMPILER_OPTIONS` if the default backend is the CPU, else None.

    Examples:
        >>> step = jax.jit(step, compiler_options=hg.compiler_options())
    """
    import jax

    if jax.default_backend() == "cpu":
        return CPU_COMPILER_OPTIONS
    return None


def compile_ahead(program: Any, *arguments: Any) -> threading.Thread:
    """Compiles a jitted function in a thread, beside other work, and returns the thread.

    If the function is then called with arguments of these shapes, the call waits until the
    compilation is done, and compiles nothing itself. An error of the compilation is ignored here,
    and raised where the function is called.

    Args:
        program: a function that `jax.jit` or `core.compiled.compiled` made.
        *arguments: arguments of the call; arrays may be `jax.ShapeDtypeStruct`.
    """

    def compile_it() -> None:
        with contextlib.suppress(Exception):
            _compile(program, arguments)

    thread = threading.Thread(target=compile_it)
    thread.start()
    return thread


def _compile(program: Any, arguments: tuple[Any, ...]) -> None:
    """Compiles a function that `jax.jit` or `core.compiled.compiled` made."""
    if hasattr(program, "prepare"):
        program.prepare(*arguments)
    else:
        program.lower(*arguments).compile()


Call = tuple[Any, tuple[Any, ...]]
"""A function that `jax.jit` or `core.compiled.compiled` made, and the arguments of a call;
arrays may be `jax.ShapeDtypeStruct`.
"""


def spare_cores() -> int:
    """Returns the number of the machine's cores minus two, at least 0. Two cores are busy with the
    threads of Python and XLA that do a command's work.

    Measured on two cores: compiling one program ahead, or two at once, made the demo's first run 15
    s slower, since each program and the work beside it took longer.
    """
    return max(0, (os.cpu_count() or 1) - 2)


class Ahead:
    """Compiles functions in threads, beside the work that will call them: see `compile_ahead`.

        with Ahead() as ahead:
            ahead.add(calls_of_fit(body, kind, views))
            ...

    If a program is never called, its compilation has only cost time. After the end of the block no
    further compilation begins.

    Args:
        at_once: number of programs that are compiled at the same time, each of which takes up to a
            gigabyte of memory. With 0 nothing is compiled ahead. None: as many as `spare_cores`,
            at most two.
    """

    def __init__(self, at_once: int | None = None) -> None:
        self._at_once = min(spare_cores(), 2) if at_once is None else at_once
        self._free = threading.Semaphore(self._at_once)
        self._over = threading.Event()

    def __enter__(self) -> "Ahead":
        return self

    def __exit__(self, *error: object) -> None:
        self._over.set()

    def add(self, calls: Iterable[Call]) -> None:
        """Compiles the functions of these calls, in the order of the calls. If the iterable raises,
        the rest is dropped in silence. If a compilation fails, the error appears where the function
        is called.
        """
        if not self._at_once:
            return
        # threads that do not keep the process alive: its end waits for no program
        threading.Thread(target=self._begin, args=(calls,), daemon=True).start()

    def _begin(self, calls: Iterable[Call]) -> None:
        """Starts a thread for each program, at most `at_once` of them at a time."""
        with contextlib.suppress(Exception):
            for call in calls:
                self._free.acquire()
                threading.Thread(target=self._compile, args=call, daemon=True).start()

    def _compile(self, program: Any, arguments: tuple[Any, ...]) -> None:
        """Compiles one program, unless the block is over."""
        with contextlib.suppress(Exception):
            if not self._over.is_set():
                _compile(program, arguments)
        self._free.release()
