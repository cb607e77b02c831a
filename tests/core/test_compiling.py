"""The cache of compiled programs: its folder, how it is turned off, and how it stays small."""

import os
import subprocess
import sys
import threading
import time

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compiled_programs import compiled_programs

from humangs_jax.core import processes
from humangs_jax.core.processes import (
    OF_JAX,
    QUICKEST,
    QUICKEST_OF_JAX,
    VARIABLE,
    Ahead,
    compile_ahead,
    enable_compile_cache,
)

USE = """
import sys
from humangs_jax.core.processes import enable_compile_cache
print(enable_compile_cache(), "jax" in sys.modules)
import jax, jax.numpy as jnp
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0)
jax.jit(lambda x: jnp.sin(x) @ x)(jnp.ones((8, 8))).block_until_ready()
"""


ADD = Ahead.add
"""The package's method; that of the tests compiles nothing ahead."""


@pytest.fixture(autouse=True)
def compiles_ahead(monkeypatch):
    monkeypatch.setattr(Ahead, "add", ADD)


@pytest.fixture(autouse=True)
def no_cache(monkeypatch, tmp_path):
    """Restores JAX's settings as in a program without a cache, and the tests' own afterwards."""
    before = jax.config.jax_compilation_cache_dir
    jax.config.update("jax_compilation_cache_dir", None)
    quickest = jax.config.jax_persistent_cache_min_compile_time_secs
    for name in (VARIABLE, OF_JAX, QUICKEST_OF_JAX):
        monkeypatch.setenv(name, "")  # so that it is put back even if it was not there
        monkeypatch.delenv(name)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "home"))
    yield
    jax.config.update("jax_compilation_cache_dir", before)
    jax.config.update("jax_persistent_cache_min_compile_time_secs", quickest)


def test_it_lies_in_the_users_cache_folder_by_version(tmp_path):
    folder = enable_compile_cache()
    assert (
        folder is not None
        and folder.parent == tmp_path / "home" / "humangs_jax"
        and folder.is_dir()
    )
    assert jax.__version__ in folder.name and jax.config.jax_compilation_cache_dir == str(folder)
    assert not list(folder.iterdir())


def test_quick_programs_are_kept_too_unless_the_user_says_from_when_on(tmp_path, monkeypatch):
    enable_compile_cache(tmp_path)
    assert jax.config.jax_persistent_cache_min_compile_time_secs == QUICKEST < 1
    assert os.environ[QUICKEST_OF_JAX] == str(QUICKEST)  # for programs that this one starts
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 5.0)
    jax.config.update("jax_compilation_cache_dir", None)
    monkeypatch.delenv(OF_JAX)
    monkeypatch.setenv(QUICKEST_OF_JAX, "5")
    enable_compile_cache(tmp_path)
    assert jax.config.jax_persistent_cache_min_compile_time_secs == 5.0


def test_the_environment_turns_it_off_or_moves_it(tmp_path, monkeypatch):
    monkeypatch.setenv(VARIABLE, "0")
    assert enable_compile_cache() is None and enable_compile_cache(tmp_path) is None
    assert jax.config.jax_compilation_cache_dir is None and not (tmp_path / "home").exists()
    monkeypatch.setenv(VARIABLE, str(tmp_path / "there"))
    folder = enable_compile_cache()
    assert folder is not None and folder.parent == tmp_path / "there"
    jax.config.update("jax_compilation_cache_dir", None)
    monkeypatch.delenv(OF_JAX)
    # an argument comes first
    assert enable_compile_cache(tmp_path / "here").parent == tmp_path / "here"


@pytest.mark.parametrize("wish", ["", "0"])
def test_a_cache_that_jax_has_already_stays(wish, tmp_path, monkeypatch):
    monkeypatch.setenv(VARIABLE, wish)
    jax.config.update("jax_compilation_cache_dir", str(tmp_path))
    assert enable_compile_cache() == tmp_path and jax.config.jax_compilation_cache_dir == str(
        tmp_path
    )


def test_a_folder_that_cannot_be_written_is_no_error(tmp_path):
    (tmp_path / "file").write_text("")
    assert enable_compile_cache(tmp_path / "file") is None
    assert jax.config.jax_compilation_cache_dir is None


def test_the_programs_used_last_are_kept(tmp_path, monkeypatch):
    old = tmp_path / "jax-0.1" / "a-cache"
    old.parent.mkdir()
    files = [old, *(enable_compile_cache(tmp_path) / f"{name}-cache" for name in "bc")]
    for age, file in zip((30, 10, 20), files, strict=True):
        file.write_bytes(bytes(100))
        os.utime(file, (1e9 - age, 1e9 - age))
    other = tmp_path / "jax-0.1" / "notes.txt"
    other.write_bytes(bytes(1000))
    jax.config.update("jax_compilation_cache_dir", None)
    monkeypatch.setattr(processes, "LARGEST", 150)
    enable_compile_cache(tmp_path)
    assert [file.exists() for file in (*files, other)] == [False, True, False, True]


@pytest.mark.slow
def test_a_second_program_finds_what_the_first_one_compiled(tmp_path):
    environment = {key: value for key, value in os.environ.items() if not key.startswith("JAX_")}
    environment |= {VARIABLE: str(tmp_path), "JAX_PLATFORMS": "cpu"}
    seen = []
    for _ in range(2):
        done = subprocess.run(
            [sys.executable, "-c", USE], env=environment, capture_output=True, text=True, check=True
        )
        seen.append({file.name: file.stat().st_mtime_ns for file in tmp_path.glob("jax-*/*-cache")})
    assert (
        done.stdout.startswith(str(tmp_path))
        and done.stdout.endswith(" False\n")
        and done.stderr == ""
    )
    assert len(seen[0]) > 0 and seen[0] == seen[1]


def test_what_is_compiled_ahead_is_not_compiled_again():
    program = jax.jit(lambda x: jnp.sort(jnp.sin(x) @ x))
    shape = jax.ShapeDtypeStruct((9, 9), np.float32)
    with compiled_programs() as programs:
        compile_ahead(program, shape)
        found = program(np.eye(9, dtype=np.float32))  # waits for the thread
    assert len(programs) == 1
    assert np.allclose(found, np.sort(np.sin(np.eye(9))))


def test_a_function_that_cannot_be_compiled_fails_where_it_is_called(capfd):
    program = jax.jit(lambda x: x @ jnp.ones(3))
    compile_ahead(program, jax.ShapeDtypeStruct((4,), np.float32)).join()
    assert capfd.readouterr().err == ""
    with pytest.raises(TypeError, match="dot"):
        program(np.zeros(4, np.float32))


def test_calls_given_ahead_are_compiled_once_and_faults_among_them_are_silent(capfd):
    wrong = jax.jit(lambda x: x @ jnp.ones(3))
    program = jax.jit(lambda x: jnp.sort(jnp.cos(x) @ x))
    shape = jax.ShapeDtypeStruct((7, 7), np.float32)
    with compiled_programs() as programs, Ahead(2) as ahead:
        ahead.add([(wrong, (shape,)), (program, (shape,))])
        deadline = time.monotonic() + 60
        while not programs and time.monotonic() < deadline:
            time.sleep(0.01)
        found = program(np.eye(7, dtype=np.float32))
    assert len(programs) == 1
    assert np.allclose(found, np.sort(np.cos(np.eye(7))))
    assert capfd.readouterr().err == ""


def test_after_the_block_nothing_further_is_compiled_ahead():
    program, asked = jax.jit(lambda x: jnp.tan(x)), threading.Event()

    def calls():
        yield program, (jax.ShapeDtypeStruct((5,), np.float32),)
        asked.set()

    with compiled_programs() as programs:
        with Ahead(2) as ahead:
            pass
        ahead.add(calls())
        assert asked.wait(60)
        time.sleep(0.05)
    assert programs == []
