"""Checkpoints come back bit for bit: the newest and the best, and never those of another run."""

import dataclasses
import gc
import os
import shutil

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from training_cases import without_upsampler

from humangs_jax.io.reading import FileError
from humangs_jax.training.checkpoint import (
    Checkpoints,
    _checksum,
    _without_score,
    load_config,
    save_config,
)
from humangs_jax.training.config import tiny
from humangs_jax.training.state import OptimizerConfig, TrainState, make_optimizer

pytestmark = pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
"""Orbax leaves callbacks behind when reading fails."""


LARGE = 300


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


def test_a_restored_state_has_the_same_bits_and_can_be_donated(checkpoints, same):
    with pytest.raises(FileNotFoundError, match="no checkpoint"):
        checkpoints.restore(state_at(0))
    checkpoints.save(state_at(3))
    restored = checkpoints.restore(state_at(0))
    assert same(restored, state_at(3))
    double = jax.jit(lambda state: jax.tree.map(lambda x: 2 * x, state), donate_argnums=0)
    assert int(double(restored).step) == 6
    # is there: the first one stays
    checkpoints.save(dataclasses.replace(state_at(5), step=jnp.asarray(3, jnp.int32)))
    assert same(checkpoints.restore(state_at(0)), state_at(3))
    with pytest.raises(FileNotFoundError, match="no checkpoint of step 7"):
        checkpoints.restore(state_at(0), 7)


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


def test_a_score_that_is_not_a_number_is_none(checkpoints):
    for step, score in enumerate([float("nan"), 20.0, float("nan"), 19.0]):
        checkpoints.save(state_at(step), score)
    checkpoints.wait()
    assert checkpoints.best_step == 1 and checkpoints.steps == [1, 2, 3]
    assert [checkpoints.score(step) for step in (1, 2, 3)] == [20.0, None, 19.0]


def largest_file(step):
    return max((step / "default").rglob("d/*"), key=lambda path: path.stat().st_size)


def flip_a_bit(step):
    """Flips a bit of a number, which only the checksum detects."""
    file = largest_file(step)
    data = bytearray(file.read_bytes())
    data[len(data) // 2] ^= 4
    file.write_bytes(data)


def cut_off(step):
    os.truncate(largest_file(step), 40)


def empty(step):
    shutil.rmtree(step)
    step.mkdir()


def without_numbers(step):
    shutil.rmtree(step / "default" / "d")


def without_score(step):
    (step / "metrics" / "metrics").write_text("{")


def test_what_cannot_be_written_is_one_line_that_names_the_folder(tmp_path, monkeypatch, capfd):
    checkpoints = Checkpoints(tmp_path / "checkpoints")

    def fail(*_, **__):
        raise RuntimeError("RESOURCE_EXHAUSTED: Error writing\nlocal file: No space left on device")

    monkeypatch.setattr(checkpoints._manager, "wait_until_finished", fail)
    with pytest.raises(
        FileError, match=r"checkpoints: a checkpoint cannot be written: .*No space left"
    ) as error:
        checkpoints.wait()
    assert "\n" not in str(error.value) and str(tmp_path) in str(error.value)
    assert capfd.readouterr() == ("", "")


@pytest.mark.slow
def test_a_damaged_checkpoint_is_set_aside_and_the_one_before_is_used(tmp_path, same, caplog):
    first = Checkpoints(tmp_path / "whole", keep=3)
    for step in (1, 2, 3):
        first.save(state_at(step, LARGE))
    first.close()
    for damage in (flip_a_bit, cut_off, empty, without_numbers, without_score):
        folder = tmp_path / damage.__name__
        shutil.copytree(tmp_path / "whole", folder)
        damage(folder / "3")
        caplog.clear()
        again = Checkpoints(folder, keep=3)
        assert same(again.restore(state_at(0, LARGE)), state_at(2, LARGE)), damage
        assert f"{folder / '3'}: " in caplog.text and "set aside as damaged-3" in caplog.text
        again.save(state_at(3, LARGE))  # its place is free
        again.wait()
        assert same(again.restore(state_at(0, LARGE)), state_at(3, LARGE)), damage
        again.close()
        assert sorted(path.name for path in folder.iterdir()) == ["1", "2", "3", "damaged-3"], (
            damage
        )
    gc.collect()  # what Orbax left behind ends here, not in a later test


def test_scores_are_numbers(tmp_path):
    for step, score in enumerate(("20.5", "null", '"20.5"', '"nan"', "[20.5]", "20")):
        (tmp_path / f"{step}" / "metrics").mkdir(parents=True)
        (tmp_path / f"{step}" / "metrics" / "metrics").write_text(f'{{"score": {score}}}')
    assert [path.name for path in _without_score(tmp_path)] == ["1", "2", "3", "4"]


def test_no_good_checkpoint_or_none_of_this_model_is_one_line_and_changes_nothing(tmp_path):
    first = Checkpoints(tmp_path / "c", keep=3)
    for step in (1, 2):
        first.save(state_at(step, LARGE))
    with pytest.raises(FileError, match=r"c/1: its arrays are those of another model"):
        first.restore(state_at(0, width=5))
    for step in (1, 2):
        flip_a_bit(tmp_path / "c" / str(step))
    with pytest.raises(FileError, match=r"c: none of 2 checkpoints can be used, .*c/1: ") as caught:
        first.restore(state_at(0, LARGE))
    with pytest.raises(FileError, match=r"c/2: "):
        first.restore(state_at(0, LARGE), 2)
    first.close()
    assert "\n" not in str(caught.value)
    assert sorted(path.name for path in (tmp_path / "c").iterdir()) == ["1", "2"]


def test_the_checksum_sees_every_word_and_no_layout():
    state = state_at(1)
    kernel = state.params["dense"]["kernel"]
    found = {_checksum(state)}
    for index in range(kernel.size):
        word = np.asarray(kernel).view(np.uint32).copy()
        word.reshape(-1)[index] ^= 1
        params = {"dense": state.params["dense"] | {"kernel": jnp.asarray(word.view(np.float32))}}
        found.add(_checksum(dataclasses.replace(state, params=params)))
    assert len(found) == kernel.size + 1
    swapped = {"dense": state.params["dense"] | {"kernel": kernel[::-1]}}
    assert _checksum(dataclasses.replace(state, params=swapped)) not in found


def test_a_folder_belongs_to_one_configuration(tmp_path):
    save_config(tmp_path, tiny())
    save_config(tmp_path, dataclasses.replace(tiny(), log_every=7))
    with pytest.raises(ValueError, match=r"started with steps = 60, not 5"):
        save_config(tmp_path, dataclasses.replace(tiny(), steps=5))
    # not finished: its learning rate would change on the way
    with pytest.raises(ValueError, match="steps = 60, not 90"):
        save_config(tmp_path, dataclasses.replace(tiny(), steps=90))
    (tmp_path / "checkpoints" / "60").mkdir(parents=True)
    with pytest.raises(ValueError, match="steps = 60, not 5"):
        save_config(tmp_path, dataclasses.replace(tiny(), steps=5))
    save_config(tmp_path, dataclasses.replace(tiny(), steps=90))
    assert load_config(tmp_path).steps == 90
    other = dataclasses.replace(tiny(), loss=dataclasses.replace(tiny().loss, structural=9.0))
    with pytest.raises(ValueError, match=r"loss\.structural = "):
        save_config(tmp_path, other)
    # a part is gone
    with pytest.raises(ValueError, match=r"model\.architecture\.encoder\.upsampler.* not None"):
        save_config(
            tmp_path, dataclasses.replace(tiny(), steps=90, model=without_upsampler(tiny().model))
        )
