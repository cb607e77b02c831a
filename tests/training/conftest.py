"""A body of 64 vertices and made-up captures of it, on which training takes seconds."""

import functools
from unittest import mock

import jax
import numpy as np
import pytest
from training_cases import tube, write_subject

from humangs_jax.core.processes import CPU_COMPILER_OPTIONS
from humangs_jax.network.humangs import init_humangs
from humangs_jax.training import step
from humangs_jax.training.config import tiny

make_update = step.compiled_update.__wrapped__


@functools.cache
def quick_update():
    """Returns `compiled_update()` without LLVM's optimisations.

    Compilation for `tiny` takes 37 CPU seconds instead of 74.
    """
    with mock.patch.dict(CPU_COMPILER_OPTIONS, {"xla_backend_optimization_level": 0}):
        return make_update()


@pytest.fixture(scope="module", autouse=True)
def _compiled_quickly(request):
    """Compiles training steps without optimisations, unless a module defines OPTIMIZED.

    Most steps run a few times only.
    """
    if getattr(request.module, "OPTIMIZED", False):
        before = jax.config.read("jax_disable_most_optimizations")
        jax.config.update("jax_disable_most_optimizations", False)
        yield
        jax.config.update("jax_disable_most_optimizations", before)
        return
    with mock.patch.object(step, "compiled_update", quick_update):
        yield


@pytest.fixture(scope="session")
def body():
    return tube()


@pytest.fixture(scope="session")
def captures(body, tmp_path_factory):
    """Returns the folders of three subjects."""
    root = tmp_path_factory.mktemp("captures")
    folders = [root / f"subject{i}" for i in range(3)]
    for i, folder in enumerate(folders):
        write_subject(folder, body, i)
    return folders


@pytest.fixture(scope="session")
def variables():
    """Returns fresh variables of `tiny`.

    Without LLVM's optimisations the many small random draws compile four times faster.
    """
    draw = jax.jit(
        init_humangs.__wrapped__,
        static_argnames="config",
        compiler_options={"xla_backend_optimization_level": 0},
    )
    return draw(jax.random.key(0), tiny().model)


@pytest.fixture
def same():
    """Returns a function that tells whether two pytrees hold the same bits."""

    def compare(a, b):
        assert jax.tree.structure(a) == jax.tree.structure(b)
        pairs = zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True)
        return all(np.asarray(x).tobytes() == np.asarray(y).tobytes() for x, y in pairs)

    return compare
