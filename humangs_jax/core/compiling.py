"""How XLA compiles: programs kept on disk between runs, and options for a CPU.

A program of this package takes seconds to a minute to compile. JAX has the cache; this module decides where it lies and how large
it may grow.
"""

import contextlib
import hashlib
import os
import platform
import sys
import tempfile
from importlib.metadata import version
from pathlib import Path
from typing import Any

VARIABLE, OF_JAX = "HUMANGS_COMPILE_CACHE", "JAX_COMPILATION_CACHE_DIR"
LARGEST = 2 << 30
"""Bytes; the files that were not used for longest are deleted beyond. JAX's own limit needs the package `filelock`."""


def enable_compile_cache(folder: str | os.PathLike[str] | None = None) -> Path | None:
    """Turn on JAX's persistent compilation cache, in a folder for each version of JAX and kind of processor.

    Programs call it once, before the first computation; the library never does. JAX is not imported here: it finds the folder
    in its environment variable, as do the programs that this one starts. A cache that JAX already has
    (`JAX_COMPILATION_CACHE_DIR`) stays.

    Args:
        folder: where the cache lies. None: what the environment variable `HUMANGS_COMPILE_CACHE` names, else `humangs_jax`
            in the user's cache folder (`XDG_CACHE_HOME`, or what the platform has in its place).

    Returns:
        The folder in use, or None where there is none: `HUMANGS_COMPILE_CACHE=0` turns the cache off, and a folder that
        cannot be written to is not an error.

    Examples:
        >>> hg.enable_compile_cache()
    """
    wish = os.environ.get(VARIABLE, "")
    if wish == "0":
        return None
    if given := _folder_of_jax():
        return Path(given)
    try:
        root = Path(folder or wish or user_cache() / "humangs_jax").expanduser()
        cache = root / f"jax-{version('jax')}-{version('jaxlib')}-{_processor()}"
        cache.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=cache).close()
        _delete_oldest(root, LARGEST)
    except (OSError, RuntimeError):  # RuntimeError: no home
        return None
    os.environ[OF_JAX] = str(cache)
    if "jax" in sys.modules:
        sys.modules["jax"].config.update("jax_compilation_cache_dir", str(cache))
    return cache


def _folder_of_jax() -> str | None:
    return sys.modules["jax"].config.jax_compilation_cache_dir if "jax" in sys.modules else os.environ.get(OF_JAX)


def user_cache() -> Path:
    """The user's cache folder, as the platform has it. Raises: RuntimeError without a home."""
    if folder := os.environ.get("XDG_CACHE_HOME"):
        return Path(folder)
    if sys.platform == "win32" and (folder := os.environ.get("LOCALAPPDATA")):
        return Path(folder)
    return Path.home() / ("Library/Caches" if sys.platform == "darwin" else ".cache")


def _processor() -> str:
    """A short mark of the processor and its instructions: machines of a cluster share a home, not their programs."""
    about = platform.machine() + platform.processor()
    with contextlib.suppress(OSError):
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        about += next((line for line in lines if line.startswith(("flags", "Features"))), "")
    return hashlib.sha256(about.encode()).hexdigest()[:8]


def _delete_oldest(root: Path, largest: int) -> None:
    """Deletes the cached programs under `root`, of all versions, that were not used for longest, beyond `largest` bytes."""
    files = []
    for file in root.glob("jax-*/*-cache"):
        with contextlib.suppress(OSError):  # another program deletes, too
            files.append((file, file.stat()))
    total = sum(stat.st_size for _, stat in files)
    for file, stat in sorted(files, key=lambda item: max(item[1].st_atime, item[1].st_mtime)):
        if total <= largest:
            break
        file.unlink(missing_ok=True)  # another program may be doing the same
        total -= stat.st_size


CPU_COMPILER_OPTIONS = {
    "xla_cpu_prefer_vector_width": 512,
    "xla_disable_hlo_passes": "cpu-parallel-task-assigner,cse_barrier_expander,small-while-loop-hoisting",
}
"""`jax.jit(..., compiler_options=compiler_options())` of a program that draws on a CPU: wide vectors make the loops over
pixels up to a third faster where there is AVX-512; XLA no longer divides its small kernels, tens of microseconds each,
among several threads, which took twice the CPU time and gained nothing; and it keeps barriers, so that tables are stored
before they are gathered from (the loops of tiny images must then not become single kernels, which know no barriers).
Eager calls use it; your own jitted functions need it themselves. Works from jax 0.10 to 0.12."""


def compiler_options() -> dict[str, Any] | None:
    """Options for `jax.jit` that make programs like these faster on CPUs.

    Call it late: asking for the backend starts it.

    Returns:
        `CPU_COMPILER_OPTIONS` if the default backend is the CPU, else None.

    Examples:
        >>> step = jax.jit(step, compiler_options=hg.compiler_options())
    """
    import jax

    return CPU_COMPILER_OPTIONS if jax.default_backend() == "cpu" else None
