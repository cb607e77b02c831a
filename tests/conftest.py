"""Settings that every test shares: the compile cache, switches of `.ci/run isa`, the shipped body.

Environment variables:

- JAX_COMPILATION_CACHE_DIR: folder of compiled programs; `cache_folder()` by default.
- HUMANGS_TOLERANCE_SCALE: factor on all float32 bounds, see rounding.py.
- JAX_DISABLE_MOST_OPTIMIZATIONS: 1 by default, because most of the time of a run is compilation;
  0 compiles as users do.
- HUMANGS_PLAIN_COMPILER: if set, programs are compiled without `processes.CPU_COMPILER_OPTIONS`
  (wide vectors).
"""

import contextlib
import hashlib
import importlib.metadata
import os
import platform
import signal
import sys
import zlib
from pathlib import Path

# XLA compiles the programs of tests without its optimizations: compiling is most of a run, and what
# is tested (formulas, gradients, shapes) does not depend on them. Set to 0 to compile as users do.
# Before JAX is imported; the programs that tests start inherit it
os.environ.setdefault("JAX_DISABLE_MOST_OPTIMIZATIONS", "1")
if os.environ["JAX_DISABLE_MOST_OPTIMIZATIONS"] == "1" and importlib.metadata.version(
    "jaxlib"
).startswith("0.10."):
    # the emitters make faster programs, but took more than a third of the CPU time of a run with an
    # empty cache. XLA aborts at flags that it does not know, and other versions of jaxlib may not
    # have this one
    os.environ["XLA_FLAGS"] = (
        f"--xla_cpu_use_fusion_emitters=false {os.environ.get('XLA_FLAGS', '')}".strip()
    )

# in the background of a shell; programs that tests interrupt inherit it
if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

import jax
import numpy as np
import pytest
import rounding
from hypothesis import HealthCheck, settings
from rooms import CORE, NEEDS_WINGS, HiddenWings

jax.config.update("jax_platforms", "cpu")  # numbers in the tests are the CPU's

settings.register_profile(
    "humangs", deadline=None, max_examples=15, suppress_health_check=[HealthCheck.too_slow]
)
settings.load_profile("humangs")

MOST_MAPPINGS = 35_000
"""Memory mappings after which compiled programs are dropped.

Each program maps memory. Linux allows a process 65,530 mappings; beyond them XLA aborts in
mid-compilation.
"""
MAPPINGS = Path("/proc/self/maps")

CACHE_BYTES = 1 << 30
"""Size to which the compile cache is cut before a run; files unused for longest go first."""


def cache_folder() -> Path:
    """Returns the folder of compiled programs of this jaxlib on this kind of processor.

    JAX's own keys name neither.
    """
    root = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    cpu = Path("/proc/cpuinfo")
    lines = cpu.read_text().splitlines() if cpu.exists() else []
    flags = [line for line in lines if line.startswith(("flags", "Features"))]
    machine = hashlib.sha256(f"{platform.machine()} {flags[:1]}".encode()).hexdigest()[:12]
    return (
        root / "humangs_jax" / "tests" / f"jaxlib-{importlib.metadata.version('jaxlib')}-{machine}"
    )


def prune(folder: Path, size: int) -> None:
    """Deletes the files used longest ago until `size` bytes are left."""
    files = []
    for path in filter(Path.is_file, folder.rglob("*")):  # some are in `programs`
        with contextlib.suppress(FileNotFoundError):  # another run prunes at the same time
            stat = path.stat()
            files.append((max(stat.st_atime, stat.st_mtime), stat.st_size, path))
    excess = sum(bytes_ for _, bytes_, _ in files) - size
    for _, bytes_, path in sorted(files):
        if excess <= 0:
            break
        path.unlink(missing_ok=True)
        excess -= bytes_


if "JAX_COMPILATION_CACHE_DIR" not in os.environ:
    # workers, and the programs that tests start, inherit it: what one has compiled the others need
    # not
    folder = cache_folder()
    folder.mkdir(parents=True, exist_ok=True)
    prune(folder, CACHE_BYTES)
    os.environ["JAX_COMPILATION_CACHE_DIR"] = str(folder)
    # of every program (default: those that took a second): measured, one operation is read in 15 ms
    # and compiled in 68
    os.environ["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = "0"
jax.config.update("jax_compilation_cache_dir", os.environ["JAX_COMPILATION_CACHE_DIR"])
jax.config.update(
    "jax_persistent_cache_min_compile_time_secs",
    float(os.environ.get("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "1")),
)

if rounding.SCALE != 1:
    # `.ci/run tight` alone: numpy's own comparisons of float32 become stricter by that factor, so
    # that no test has to know about it. In every other run numpy is as it is
    for owner, name in ((np.testing, "assert_allclose"), (np, "allclose"), (np, "isclose")):
        setattr(owner, name, rounding.scaled_comparison(getattr(owner, name)))


def pytest_addoption(parser):
    parser.addoption(
        "--core-alone",
        action="store_true",
        help="hide capture/, motion/, synthetic/ and viewer/, and run the tests of the core",
    )
    parser.addoption(
        "--slice", metavar="I/N", help="run only the I-th (from 0) of N slices of the tests"
    )


def pytest_report_header():
    """Says how a run differs from a usual program."""
    off = os.environ["JAX_DISABLE_MOST_OPTIMIZATIONS"] == "1"
    return f"XLA's optimizations: {'off' if off else 'on'}; float32 bounds times {rounding.SCALE:g}"


def pytest_configure(config):
    if config.getoption("--core-alone"):
        sys.meta_path.insert(0, HiddenWings())


def pytest_ignore_collect(collection_path, config):
    """Leaves out files with --core-alone that test no room of the core, or import a wing."""
    if not config.getoption("--core-alone"):
        return None
    inside = collection_path.relative_to(Path(__file__).parent).parts
    if not inside or collection_path.is_dir():
        return bool(inside) and inside[0] not in CORE
    if collection_path.suffix != ".py":
        return True
    return inside[0] not in CORE or NEEDS_WINGS.search(collection_path.read_text()) is not None


def pytest_collection_modifyitems(config, items):
    """Keeps one slice of the tests, and with --core-alone those that need no wing.

    A test's slice depends on its name alone, so that N runs cover all tests.
    """
    if config.getoption("--core-alone"):
        dropped = [item for item in items if item.get_closest_marker("wings")]
        items[:] = [item for item in items if not item.get_closest_marker("wings")]
        config.hook.pytest_deselected(items=dropped)
    wish = config.getoption("--slice")
    if wish is None:
        return
    wanted, count = map(int, wish.split("/"))
    slices = [zlib.crc32(item.nodeid.encode()) % count for item in items]
    dropped = [item for item, own in zip(items, slices, strict=True) if own != wanted]
    items[:] = [item for item, own in zip(items, slices, strict=True) if own == wanted]
    config.hook.pytest_deselected(items=dropped)


@pytest.fixture(scope="session", autouse=True)
def _plain_compiler():
    if "HUMANGS_PLAIN_COMPILER" in os.environ:
        from humangs_jax.core.processes import CPU_COMPILER_OPTIONS

        CPU_COMPILER_OPTIONS.clear()


@pytest.fixture(autouse=True)
def _nothing_ahead(monkeypatch):
    """Compiles no programs ahead: tests call few of those of a command."""
    monkeypatch.setattr("humangs_jax.core.processes.Ahead.add", lambda self, calls: None)


@pytest.fixture(autouse=True, scope="module")
def _forget_programs():
    yield
    if MAPPINGS.exists() and MAPPINGS.read_bytes().count(b"\n") > MOST_MAPPINGS:
        jax.clear_caches()


@pytest.fixture(scope="session")
def body():
    """Returns the shipped body; modules that need another one define a fixture of this name."""
    from humangs_jax.body.library import load_body

    return load_body()


@pytest.fixture(scope="session")
def demo():
    """Returns the shipped capture."""
    from humangs_jax.data.capture import load_capture

    return load_capture("demo_capture")


@pytest.fixture
def float64():
    """Makes JAX compute in 64 bits."""
    with jax.enable_x64(True):
        yield


@pytest.fixture(scope="session")
def capture_folder(demo, tmp_path_factory):
    """Returns a copy of the shipped capture with its four photos.

    As the sizes are the same, programs are compiled once for both.
    """
    from humangs_jax.data.capture import save_capture

    path = tmp_path_factory.mktemp("captures") / "someone"
    save_capture(path, demo)
    return path


@pytest.fixture
def humangs(monkeypatch, capsys):
    """Returns a function of words that runs the command line: (exit code, stdout, stderr)."""
    from command_line import run

    return lambda *words: run(monkeypatch, capsys, *words)
