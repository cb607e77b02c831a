"""Settings that every test shares."""

import atexit
import os
import shutil
import tempfile
from pathlib import Path

import jax
import pytest
from hypothesis import HealthCheck, settings

jax.config.update("jax_platforms", "cpu")  # numbers in the tests are the CPU's

settings.register_profile("humangs", deadline=None, max_examples=15, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("humangs")

MOST_MAPPINGS = 20_000
"""Every compiled program maps memory, and Linux ends a process that has 65,530 mappings: XLA then aborts in mid-compilation."""
MAPPINGS = Path("/proc/self/maps")

if "PYTEST_XDIST_WORKER" not in os.environ and "JAX_COMPILATION_CACHE_DIR" not in os.environ:
    # workers, and the programs that tests start, inherit it: what one has compiled the others need not
    folder = tempfile.mkdtemp(prefix="humangs_compiled_")
    os.environ["JAX_COMPILATION_CACHE_DIR"] = folder
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
jax.config.update("jax_compilation_cache_dir", os.environ["JAX_COMPILATION_CACHE_DIR"])


@pytest.fixture(autouse=True, scope="module")
def _forget_programs():
    yield
    if MAPPINGS.exists() and MAPPINGS.read_bytes().count(b"\n") > MOST_MAPPINGS:
        jax.clear_caches()
