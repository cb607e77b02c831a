"""Faults of versions of JAX: the wrong sums, the flag that avoids them, and other versions."""

import os
import subprocess
import sys

import numpy as np
import pytest

from humangs_jax.core import jax_faults
from humangs_jax.core.jax_faults import RIGHT_SUMS, WRONG_SUMS, avoid_wrong_sums

SUMS = """
import humangs_jax, jax, jax.numpy as jnp, numpy as np
rng = np.random.default_rng(0)
m, x = rng.standard_normal((3, 3)), rng.standard_normal((36_000, 3))
m, x = np.float32(m), np.float32(x)
squares = jax.jit(jax.vmap(lambda row: jnp.sum((m @ row) ** 2)))
print(float(np.abs(squares(x) - ((np.float64(x) @ np.float64(m).T) ** 2).sum(1)).max()))
"""


def test_sums_of_many_small_products_are_right_after_the_import_alone():
    environment = {name: value for name, value in os.environ.items() if name != "XLA_FLAGS"}
    command = [sys.executable, "-c", SUMS]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    # sums are up to 200: float32 rounds them by 2e-5; the fault is as large as the sums
    assert float(done.stdout) < 1e-3


@pytest.fixture
def faulty(monkeypatch):
    """Sets the version of jaxlib with wrong sums, and a flag of the user."""
    monkeypatch.setattr(jax_faults, "version", lambda name: WRONG_SUMS)
    monkeypatch.setenv("XLA_FLAGS", "--xla_cpu_max_isa=AVX2")
    monkeypatch.setattr(jax_faults, "_has_started", lambda: False)


def test_the_flag_is_added_to_those_of_the_user(faulty):
    avoid_wrong_sums()
    assert os.environ["XLA_FLAGS"] == f"--xla_cpu_max_isa=AVX2 {RIGHT_SUMS}"
    avoid_wrong_sums()
    assert os.environ["XLA_FLAGS"].count("ynn") == 1


def test_a_choice_of_the_user_stays(faulty, monkeypatch):
    monkeypatch.setenv("XLA_FLAGS", "--xla_cpu_experimental_ynn_fusion_type=")
    avoid_wrong_sums()
    assert os.environ["XLA_FLAGS"] == "--xla_cpu_experimental_ynn_fusion_type="


def test_other_versions_are_left_alone(faulty, monkeypatch):
    monkeypatch.setattr(jax_faults, "version", lambda name: "0.11.2")
    avoid_wrong_sums()
    assert os.environ["XLA_FLAGS"] == "--xla_cpu_max_isa=AVX2"


def test_it_is_a_warning_where_jax_has_begun(faulty, monkeypatch):
    monkeypatch.undo()
    monkeypatch.setattr(jax_faults, "version", lambda name: WRONG_SUMS)
    monkeypatch.setenv("XLA_FLAGS", "")
    import jax

    np.asarray(jax.numpy.ones(1))
    with pytest.warns(RuntimeWarning, match="Python 3.12 with jax 0.11.2"):
        avoid_wrong_sums()
