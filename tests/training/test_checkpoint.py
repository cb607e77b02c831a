"""Checkpoints: bit for bit, the newest and the best, and never those of another run."""

import dataclasses

import jax
import jax.numpy as jnp
import pytest
from training_cases import without_upsampler

from humangs_jax.training.checkpoint import Checkpoints, save_config
from humangs_jax.training.config import tiny
from humangs_jax.training.optimizer import OptimizerConfig, make_optimizer
from humangs_jax.training.state import TrainState


def state_at(step, width=3):
    keys = jax.random.split(jax.random.key(step), 2)
    params = {"dense": {"kernel": jax.random.normal(keys[0], (width, 4)), "bias": jnp.zeros(4)}}
    optimizer = make_optimizer(OptimizerConfig(), 10)
    gradients = jax.tree.map(lambda x: jax.random.normal(keys[1], x.shape), params)
    _, opt_state = optimizer.update(gradients, optimizer.init(params), params, value=jnp.ones(()))
    return TrainState(jnp.asarray(step, jnp.int32), params, {}, opt_state, None)


@pytest.fixture
def checkpoints(tmp_path):
    checkpoints = Checkpoints(tmp_path / "checkpoints", keep=2)
    yield checkpoints
    checkpoints.close()


@pytest.mark.slow
def test_restores_the_bits_into_the_same_structure(checkpoints, same):
    checkpoints.save(state_at(3))
    assert same(checkpoints.restore(state_at(0)), state_at(3))


def test_a_restored_state_can_be_donated(checkpoints):
    checkpoints.save(state_at(3))
    double = jax.jit(lambda state: jax.tree.map(lambda x: 2 * x, state), donate_argnums=0)
    assert int(double(checkpoints.restore(state_at(0))).step) == 6


def test_keeps_the_newest_and_the_best(tmp_path, checkpoints, same):
    for step, score in enumerate([20.0, 30.0, None, 25.0, None, 28.0]):
        checkpoints.save(state_at(step), score)
    checkpoints.wait()
    assert checkpoints.steps == [1, 4, 5] and checkpoints.best_step == 1
    again = Checkpoints(tmp_path / "checkpoints", keep=2)
    assert again.steps == [1, 4, 5] and again.best_step == 1
    assert [again.score(step) for step in again.steps] == [30.0, None, 28.0]
    assert same(again.restore(state_at(0), 1), state_at(1))
    again.close()


def test_saving_a_step_twice_keeps_the_first(checkpoints, same):
    checkpoints.save(state_at(2))
    checkpoints.save(dataclasses.replace(state_at(5), step=jnp.asarray(2, jnp.int32)))
    assert same(checkpoints.restore(state_at(0)), state_at(2))


def test_nothing_to_restore_and_another_model_are_errors(checkpoints):
    with pytest.raises(FileNotFoundError, match="no checkpoint"):
        checkpoints.restore(state_at(0))
    checkpoints.save(state_at(1))
    with pytest.raises(FileNotFoundError, match="no checkpoint of step 7"):
        checkpoints.restore(state_at(0), 7)


def test_a_folder_belongs_to_one_configuration(tmp_path):
    save_config(tmp_path, tiny())
    save_config(tmp_path, dataclasses.replace(tiny(), log_every=7))
    with pytest.raises(ValueError, match=r"started with steps = 60, not 5"):
        save_config(tmp_path, dataclasses.replace(tiny(), steps=5))
    other = dataclasses.replace(tiny(), loss=dataclasses.replace(tiny().loss, structural=9.0))
    with pytest.raises(ValueError, match=r"loss\.structural = "):
        save_config(tmp_path, other)


def test_a_part_that_is_gone_is_another_configuration(tmp_path):
    save_config(tmp_path, tiny())
    with pytest.raises(ValueError, match=r"model\.architecture\.encoder\.upsampler.* not None"):
        save_config(tmp_path, dataclasses.replace(tiny(), model=without_upsampler(tiny().model)))
