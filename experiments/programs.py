"""Notes which programs XLA compiles or reads from its cache while something runs: their names,
their seconds, and the line of the package that asked for each.

`python -m experiments.programs WORD...` runs a `humangs` command and prints a line of JSON at the
end.
"""

import contextlib
import dataclasses
import json
import os
import sys
import threading
import time
import traceback
from collections.abc import Generator
from pathlib import Path
from typing import Any

PARTS = {
    "/jax/core/compile/jaxpr_trace_duration": "trace",
    "/jax/core/compile/jaxpr_to_mlir_module_duration": "lower",
    "/jax/core/compile/backend_compile_duration": "compile",
}
"""{event of JAX: our name for it}. Compiling includes reading from the cache on disk."""
HIT = "/jax/compilation_cache/cache_hits"
"""JAX's event of a program that the cache on disk had."""
PACKAGE = "humangs_jax"


@dataclasses.dataclass(frozen=True)
class Program:
    """A program that was compiled, or read from the cache on disk."""

    name: str
    """Name of the function, as JAX has it."""
    stage: str
    """The stage of the command that ran (`core.progress`), empty outside of stages."""
    asked: str
    """The innermost line of the package on the stack, as file:line."""
    begin: float
    """Seconds from the begin of the watch to that of compiling."""
    seconds: float
    """Seconds of compiling or reading."""
    beside: bool
    """Whether another thread than the main one compiled it."""


@dataclasses.dataclass
class Watch:
    """What `watched` has seen."""

    began: float = dataclasses.field(default_factory=time.perf_counter)
    """Time at which the watch began, of `time.perf_counter`."""
    programs: list[Program] = dataclasses.field(default_factory=list)
    """All programs in their order."""
    seconds: dict[str, float] = dataclasses.field(
        default_factory=lambda: dict.fromkeys(PARTS.values(), 0.0)
    )
    """{part of `PARTS`: seconds of all programs}. Traces within traces count twice."""
    hits: int = 0
    """Number of programs that the cache on disk had."""
    shown: Any = None
    """The `core.progress.Progress` of the command, which has the seconds of its stages."""

    def names(self) -> dict[str, int]:
        """Returns {name: number of its programs}, the most frequent first."""
        found: dict[str, int] = {}
        for program in self.programs:
            found[program.name] = found.get(program.name, 0) + 1
        return dict(sorted(found.items(), key=lambda item: -item[1]))


@contextlib.contextmanager
def watched() -> Generator[Watch]:
    """Yields a watch that notes every program of the block, in all threads."""
    import jax

    from humangs_jax.core import progress

    watch = Watch()
    lock = threading.Lock()

    def on_duration(event: str, duration_secs: float, **kwargs: str | int) -> None:
        part = PARTS.get(event)
        if part is None:
            return
        with lock:
            watch.seconds[part] += duration_secs
            # each program is compiled once, and may be traced in several parts
            if part == "compile":
                watch.shown = progress.current()
                names = watch.shown.names
                program = Program(
                    str(kwargs.get("fun_name", "?")),
                    names[0] if names else "",
                    _asked(),
                    time.perf_counter() - watch.began - duration_secs,
                    duration_secs,
                    threading.current_thread() is not threading.main_thread(),
                )
                watch.programs.append(program)

    def on_event(event: str, **kwargs: str | int) -> None:
        watch.hits += event == HIT

    jax.monitoring.register_event_duration_secs_listener(on_duration)
    jax.monitoring.register_event_listener(on_event)
    try:
        yield watch
    finally:
        jax.monitoring.unregister_event_duration_listener(on_duration)
        jax.monitoring.unregister_event_listener(on_event)


def _asked() -> str:
    """Returns the innermost line of the package on the stack, as file:line."""
    for frame in reversed(traceback.extract_stack()):
        parts = Path(frame.filename).parts
        if PACKAGE in parts and "site-packages" not in parts:
            inside = parts[len(parts) - parts[::-1].index(PACKAGE) :]
            return f"{'/'.join(inside)}:{frame.lineno}"
    return ""


def run_command(words: list[str]) -> dict[str, Any]:
    """Runs a `humangs` command in this process, and returns its exit status, programs, stages and
    seconds.
    """
    from humangs_jax.cli import execute

    began = time.perf_counter()
    with watched() as watch:
        status = execute(words)
    taken = os.times()
    return {
        "status": status,
        "wall": time.perf_counter() - began,
        "cpu": taken.user + taken.system,
        "stages": watch.shown.seconds if watch.shown else {},
        "hits": watch.hits,
        "seconds": watch.seconds,
        "programs": [dataclasses.asdict(program) for program in watch.programs],
    }


if __name__ == "__main__":
    from humangs_jax.cli import _prepare

    _prepare(False)
    print(json.dumps(run_command(sys.argv[1:])))
