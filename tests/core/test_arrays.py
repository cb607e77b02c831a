"""Small work on arrays gives what JAX gives, and compiles nothing."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compiled_programs import compiled_programs

from humangs_jax.core import arrays
from humangs_jax.core.arrays import from_host, joined, on_host, taken
from humangs_jax.geometry.camera import Camera, stack_cameras


def numbers(*shape):
    return np.random.default_rng(sum(shape)).random(shape).astype(np.float32)


def test_arrays_of_the_host_become_arrays_of_jax_without_a_program():
    with compiled_programs() as programs:
        one = from_host(numbers(3, 17).astype(np.float64), jnp.float32)
        whole = from_host([[1, 2, 3]], jnp.int32)
        bools = from_host(np.ones(19, bool))
    assert programs == []
    assert isinstance(one, jax.Array) and one.dtype == jnp.float32
    assert np.array_equal(one, numbers(3, 17)) and whole.dtype == jnp.int32
    assert bools.dtype == bool


def test_an_array_of_jax_stays_and_a_traced_one_may_have_another_type():
    one = jax.device_put(numbers(4))
    assert from_host(one) is one
    assert jax.jit(lambda x: from_host(x, jnp.int32))(one).dtype == jnp.int32


@pytest.mark.parametrize("index", [1, slice(1, None), np.array([2, 0, 2]), np.arange(3) > 0])
def test_examples_of_a_batch_are_taken_without_a_program(index):
    batch = jax.device_put(numbers(3, 4, 13))
    with compiled_programs() as programs:
        found = taken(batch, index)
    assert programs == []
    assert isinstance(found, jax.Array) and np.array_equal(found, np.asarray(batch)[index])


def test_examples_are_taken_in_programs_too():
    batch = jax.device_put(numbers(3, 5))
    assert np.array_equal(jax.jit(lambda i: taken(batch, i))(2), np.asarray(batch)[2])
    assert np.array_equal(jax.jit(lambda x: taken(x, 1))(batch), np.asarray(batch)[1])


@pytest.mark.parametrize("index", [3, -4, np.int64(3), np.array([0, 3]), jnp.asarray([-4, 0])])
@pytest.mark.parametrize("where", ["host", "accelerator", "program"])
def test_an_index_out_of_range_is_refused_wherever_the_array_is(index, where, monkeypatch):
    batch = jax.device_put(numbers(3, 5))
    if where == "accelerator":
        monkeypatch.setattr(arrays, "SMALL", 0)
        monkeypatch.setattr(arrays, "on_host", lambda array: False)
    with pytest.raises(IndexError, match=r"index (3|-4) is out of bounds for axis 0 with size 3"):
        if where == "program":
            jax.eval_shape(lambda x: taken(x, index), batch)
        else:
            taken(batch, index)


def test_keys_are_no_numbers_and_stay_with_jax():
    keys = jax.random.split(jax.random.key(0), 3)
    assert not on_host(keys)
    assert taken(keys, 1) == keys[1]


def test_stacking_compiles_nothing():
    parts = [jax.device_put(numbers(2, 23)) for _ in range(3)]
    with compiled_programs() as programs:
        found = joined(parts)
    assert programs == [] and np.array_equal(found, np.stack(parts))


def test_cameras_are_made_indexed_resized_and_stacked_without_a_program():
    K = [[90.0, 0, 31], [0, 91, 30], [0, 0, 1]]
    with compiled_programs() as programs:
        one = Camera.from_opencv(K, np.eye(4), 64, 61)
        cameras = stack_cameras([one, one.resized(32, 61).resized(64, 61), one])
        assert len([camera.K for camera in cameras]) == 3
    assert programs == []
    assert np.allclose(cameras[1].K, K, rtol=1e-6)
