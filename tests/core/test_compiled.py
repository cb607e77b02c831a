import dataclasses
import functools
import math
import os
import pickle
import stat
import subprocess
import sys
import types

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from humangs_jax.core import compiled as module
from humangs_jax.core import processes
from humangs_jax.core.compiled import compiled
from humangs_jax.core.pytree import replace
from humangs_jax.geometry.camera import Camera
from humangs_jax.rendering.buffers import needed_by


@pytest.fixture(autouse=True)
def nothing_in_the_cache_of_jax(monkeypatch):
    """Keeps these programs out of JAX's cache: XLA cannot write what it has read from there."""
    monkeypatch.setattr(processes, "_programs", [])
    module._folder.cache_clear()
    quickest = jax.config.jax_persistent_cache_min_compile_time_secs
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 1e6)
    yield
    jax.config.update("jax_persistent_cache_min_compile_time_secs", quickest)
    module._folder.cache_clear()


@pytest.fixture
def folder(tmp_path):
    """The folder of programs, kept as by the console script."""
    processes.keep_programs(tmp_path)
    return tmp_path / "programs"


traces = []


def values(camera, x, power):
    """Returns the camera and 3 x^power + 1 for the camera below."""
    traces.append(jnp.shape(x))
    return camera, 1 + camera.K[0, 0] * x**power


def anew(**options):
    """Returns the function as a new process has it: nothing of it is in memory."""
    # JAX remembers traces by the function
    copy = functools.update_wrapper(types.FunctionType(values.__code__, globals()), values)
    return compiled(static=["power"], **options)(copy)


CAMERA = Camera(jnp.diag(jnp.float32([3, 1, 1])), jnp.eye(4), 8, 6)


def test_a_second_process_finds_a_program_without_tracing(folder):
    x = np.arange(4, dtype=np.float32)
    traces.clear()
    first = anew()(CAMERA, x, power=2)
    assert len(traces) == 1 and len(list(folder.glob("values-*-cache"))) == 1
    second, again = anew(), anew()(CAMERA, jnp.asarray(x), 2)
    assert np.array_equal(second(CAMERA, x, 2)[1], 3 * x**2 + 1)
    assert np.array_equal(again[1], first[1])
    assert (again[0].width, again[0].height) == (8, 6)
    assert len(traces) == 1


@pytest.mark.parametrize(
    "other",
    [
        lambda f: f(CAMERA, np.ones(5, np.float32), 2),
        lambda f: f(CAMERA, np.ones(4, np.int32), 2),
        lambda f: f(CAMERA, np.ones(4, np.float32), 3),
        lambda f: f(replace(CAMERA, width=9), np.ones(4, np.float32), 2),
        lambda f: f(CAMERA, 5.0, 2),
    ],
    ids=["shape", "type", "static argument", "static field", "a number of Python"],
)
def test_other_arguments_are_another_program(folder, other):
    anew()(CAMERA, np.ones(4, np.float32), 2)
    traces.clear()
    other(anew())
    assert len(traces) == 1
    other(anew())
    assert len(traces) == 1


def test_settings_and_options_are_part_of_a_program(folder):
    x = np.ones(4, np.float32)
    anew()(CAMERA, x, 2)
    traces.clear()
    anew(options=lambda: {"xla_backend_optimization_level": 1})(CAMERA, x, 2)
    assert len(traces) == 1
    with jax.default_matmul_precision("highest"):
        anew()(CAMERA, x, 2)
    assert len(traces) == 2
    with jax.enable_x64(True):
        wide = anew()(CAMERA, x.astype(float), 2)[1]
    assert len(traces) == 3 and wide.dtype == np.float64


def test_another_source_is_another_program(folder, monkeypatch):
    x = np.ones(4, np.float32)
    anew()(CAMERA, x, 2)
    traces.clear()
    monkeypatch.setattr(module, "_surroundings", lambda: "another source")
    anew()(CAMERA, x, 2)
    assert len(traces) == 1


def test_another_processor_is_another_program(folder, monkeypatch):
    """A folder that JAX's own variable names may be on a disk that several machines share."""
    x = np.ones(4, np.float32)
    anew()(CAMERA, x, 2)
    with monkeypatch.context() as patch:
        patch.setattr(module, "processor", lambda: "another")
        patch.setattr(module, "_surroundings", module._surroundings.__wrapped__)  # nothing cached
        traces.clear()
        anew()(CAMERA, x, 2)
    assert len(traces) == 1


def test_nothing_is_kept_after_the_source_was_edited(folder, monkeypatch):
    monkeypatch.setattr(module, "source_has_changed", lambda: True)
    anew()(CAMERA, np.ones(4, np.float32), 2)
    assert list(folder.iterdir()) == []


def test_an_edit_of_the_source_is_seen(tmp_path, monkeypatch):
    (tmp_path / "a.py").write_text("x = 1")
    monkeypatch.setattr(processes, "_source_files", lambda: sorted(tmp_path.glob("*.py")))
    monkeypatch.setattr(processes, "_times_at_start", functools.cache(processes._source_times))
    assert not processes.source_has_changed()
    (tmp_path / "b.py").symlink_to(tmp_path / "a lock of an editor")
    assert not processes.source_has_changed()
    (tmp_path / "a.py").write_text("x = 10")
    assert processes.source_has_changed()


def test_a_full_disk_leaves_no_part_of_a_file(folder, monkeypatch):
    def full(*paths):
        raise OSError("no space left")

    monkeypatch.setattr(module.os, "replace", full)
    assert np.array_equal(anew()(CAMERA, np.ones(4, np.float32), 2)[1], np.full(4, 4))
    assert list(folder.iterdir()) == []


def test_a_folder_that_cannot_be_written_is_read(folder, monkeypatch):
    def read_only(*paths):
        raise OSError("read-only file system")

    anew()(CAMERA, np.ones(4, np.float32), 2)
    monkeypatch.setattr(module.os, "utime", read_only)
    traces.clear()
    anew()(CAMERA, np.ones(4, np.float32), 2)
    assert traces == []


def test_faults_are_looked_for_as_without_keeping(folder):
    x = np.ones(4, np.float32)
    anew()(CAMERA, x, 2)
    with jax.disable_jit():
        traces.clear()
        anew()(CAMERA, x, 2)
        assert len(traces) == 1
    with jax.debug_nans(True), pytest.raises(FloatingPointError):
        anew()(CAMERA, x * np.nan, 2)


def test_equal_numbers_of_other_types_are_other_programs(folder):
    @compiled(static=["power"])
    def raised(x, power):
        return x**power

    x = np.arange(4, dtype=np.int32)
    assert raised(x, 2).dtype == jnp.int32
    assert raised(x, 2.0).dtype == jnp.float32


def test_ctrl_c_leaves_nothing_that_others_wait_for(folder, monkeypatch):
    def interrupted(*args):
        raise KeyboardInterrupt

    f, x = anew(), np.ones(4, np.float32)
    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(module, "_stands_alone", interrupted)
        f(CAMERA, x, 2)
    assert np.array_equal(f(CAMERA, x, 2)[1], np.full(4, 4))


def test_a_damaged_file_is_made_again(folder):
    x = np.ones(4, np.float32)
    anew()(CAMERA, x, 2)
    (file,) = folder.iterdir()
    whole = file.read_bytes()
    flipped = whole[:-1] + bytes([whole[-1] ^ 1])
    for damaged in (b"", whole[: len(whole) // 2], pickle.dumps(("a", "b")), flipped):
        file.write_bytes(damaged)
        traces.clear()
        assert np.array_equal(anew()(CAMERA, x, 2)[1], np.full(4, 4))
        assert len(traces) == 1 and list(folder.iterdir()) == [file]
        assert len(file.read_bytes()) > len(whole) // 2


@dataclasses.dataclass(frozen=True)
class Foreign:
    """A class whose source is not the package's."""

    power: int = 2

    def __rpow__(self, x):
        return x**self.power


def test_what_other_packages_define_is_not_kept(folder):
    x = np.full(4, 2, np.float32)
    for _ in range(2):
        traces.clear()
        assert np.array_equal(anew()(CAMERA, x, Foreign())[1], np.full(4, 13))
        assert len(traces) == 1
    assert list(folder.iterdir()) == []


def test_transformations_see_the_function(folder):
    f = anew()
    slope = jax.grad(lambda x: f(CAMERA, x, 2)[1])(jnp.float32(5))
    assert slope == 30
    assert np.array_equal(jax.vmap(lambda x: f(CAMERA, x, 2)[1])(jnp.ones(3)), np.full(3, 4))
    assert list(folder.iterdir()) == []


def test_shapes_of_results_are_kept(folder):
    shape = jax.ShapeDtypeStruct((6,), np.float32)
    traces.clear()
    for _ in range(2):
        assert anew().eval_shape(CAMERA, shape, 2)[1].shape == (6,)
    assert len(traces) == 1


def test_a_prepared_program_is_not_compiled_again(folder):
    f = anew()
    f.prepare(CAMERA, jax.ShapeDtypeStruct((7,), np.float32), 2)
    traces.clear()
    f(CAMERA, np.ones(7, np.float32), 2)
    assert traces == []


@pytest.mark.skipif(not hasattr(os, "getuid"), reason="files have no permissions here")
def test_nothing_is_read_from_a_folder_that_others_may_write_to(tmp_path, monkeypatch):
    folder = tmp_path / "programs"
    processes.keep_programs(tmp_path)
    assert processes.kept_programs() == folder
    assert stat.S_IMODE(folder.stat().st_mode) == 0o700
    monkeypatch.setattr(processes, "_programs", [])
    folder.chmod(0o770)
    processes.keep_programs(tmp_path)
    assert processes.kept_programs() is None


@pytest.mark.skipif(not hasattr(os, "getuid"), reason="files have no permissions here")
def test_nothing_is_read_from_a_folder_that_others_may_exchange(tmp_path):
    tmp_path.chmod(0o777)
    processes.keep_programs(tmp_path)
    assert processes.kept_programs() is None
    tmp_path.chmod(0o700)
    (tmp_path / "programs").rename(tmp_path / "elsewhere")
    (tmp_path / "programs").symlink_to(tmp_path / "elsewhere")
    processes.keep_programs(tmp_path)
    assert processes.kept_programs() is None


def test_the_folder_does_not_grow_without_end(folder, monkeypatch):
    for power in (2, 3, 4):
        anew()(CAMERA, np.ones(4, np.float32), power)
    one = max(file.stat().st_size for file in folder.iterdir())
    monkeypatch.setattr(processes, "LARGEST", one)
    processes.keep_programs(folder.parent)
    assert len(list(folder.iterdir())) == 1


PROGRAM = """
import sys
from pathlib import Path
import jax
import jax.numpy as jnp
import numpy as np
from humangs_jax.core.compiled import compiled
from humangs_jax.core.processes import keep_programs

keep_programs(Path(sys.argv[1]))
traced = []

@compiled()
def largest(x):
    traced.append(x)
    return jnp.linalg.eigvalsh(x)[-1]

print(float(largest(np.diag([1, 5, 3]).astype(np.float32))), len(traced))
"""


def test_a_new_process_calls_lapack(tmp_path):
    environment = {key: value for key, value in os.environ.items() if not key.startswith("JAX_")}
    environment |= {"JAX_PLATFORMS": "cpu"}
    said = [
        subprocess.run(
            [sys.executable, "-c", PROGRAM, str(tmp_path)],
            env=environment,
            capture_output=True,
            text=True,
            check=True,
        ).stdout
        for _ in range(2)
    ]
    assert said == ["5.0 1\n", "5.0 0\n"]


READ_BEFORE = """
import sys
from pathlib import Path
import jax.numpy as jnp
import numpy as np
from humangs_jax.core import compiled as module
from humangs_jax.core.processes import enable_compile_cache, keep_programs

cache = enable_compile_cache()

@module.compiled()
def product(x, factor):
    return jnp.sin(x @ x) + factor / 2

x = np.eye(64, dtype=np.float32)
if sys.argv[1] != "keep":
    product(x, 2.0)
    module._folder.cache_clear()
if sys.argv[1] != "do not keep":
    keep_programs(cache)
if sys.argv[1] == "keep what was read as another program":
    product(x, jnp.asarray(2.0))
print(float(product(x, 2.0)[0, 0]))
"""


@pytest.mark.parametrize("how", ["keep what was read", "keep what was read as another program"])
def test_a_program_that_was_read_is_not_written(how, tmp_path):
    """XLA writes a program that it has read without its functions, and a process that reads that
    file fails. The second process here has the program in memory, read by an earlier call.
    """
    environment = {key: value for key, value in os.environ.items() if not key.startswith("JAX_")}
    environment |= {
        "JAX_PLATFORMS": "cpu",
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
        "HUMANGS_COMPILE_CACHE": str(tmp_path),
    }
    for what in ("do not keep", how, "keep"):
        said = subprocess.run(
            [sys.executable, "-c", READ_BEFORE, what],
            env=environment,
            capture_output=True,
            text=True,
            check=True,
        ).stdout
        assert float(said) == pytest.approx(1 + math.sin(1))


def test_what_calls_python_is_not_kept(folder):
    @compiled()
    def told(x):
        jax.debug.callback(lambda x: None, x)
        return 2 * x

    assert np.array_equal(told(np.ones(3, np.float32)), np.full(3, 2))
    assert list(folder.iterdir()) == []


def test_a_compiled_function_is_pickled_by_its_name():
    assert pickle.loads(pickle.dumps(needed_by)) is needed_by


def test_without_the_console_script_nothing_is_kept():
    assert np.array_equal(anew()(CAMERA, np.ones(4, np.float32), 2)[1], np.full(4, 4))
    assert module._folder() is None
