"""The training loop: resuming is bitwise, signals save, and unseen people are looked at.

Nothing is left out without a message.
"""

import dataclasses
import logging
import signal

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from training_runs import lines

from humangs_jax.core.pytree import replace
from humangs_jax.network.weights import load_weights
from humangs_jax.training import loop, step
from humangs_jax.training.checkpoint import Checkpoints
from humangs_jax.training.config import Phase, tiny
from humangs_jax.training.loop import train
from humangs_jax.training.sources import captured_people, stage_loader
from humangs_jax.training.state import init_state
from humangs_jax.training.step import train_step

CONFIG = tiny()


@pytest.fixture(scope="module")
def run(body, captures, variables):
    """Returns `train` on two of the captures, validated on the third."""
    options = {
        "training": captures[:2],
        "validation": captures[2:],
        "variables": variables,
        "progress": False,
    }
    return lambda out, config=CONFIG, **how: train(config, body, out=out, **options | how)


@pytest.fixture(scope="module")
def whole(run, tmp_path_factory):
    """Returns (result, folder) of an uninterrupted run of four steps."""
    out = tmp_path_factory.mktemp("whole")
    return run(out, stop_at=4), out


def losses(out):
    """Returns (step, loss) of every line, in order."""
    return [(line["step"], line["loss"]) for line in lines(out) if "loss" in line]


@pytest.mark.slow
def test_resume_after_two_steps_ends_bit_for_bit_where_four_steps_end(run, tmp_path, whole, same):
    assert int(run(tmp_path, stop_at=2).step) == 2
    assert same(run(tmp_path, stop_at=4), whole[0]) and losses(tmp_path) == losses(whole[1])
    assert len(losses(tmp_path)) == 4
    before = len(lines(tmp_path))
    # there is nothing left to do
    assert same(run(tmp_path, stop_at=4), whole[0]) and len(lines(tmp_path)) == before


@pytest.mark.slow
def test_a_finished_run_goes_on_when_it_gets_more_steps(run, tmp_path):
    for steps in (2, 3):
        run(tmp_path, dataclasses.replace(CONFIG, steps=steps), validation=())
    assert [step for step, _ in losses(tmp_path)] == [1, 2, 3]


@pytest.mark.slow
def test_a_first_validation_that_is_not_a_number_keeps_no_later_one_from_being_the_best(
    run, tmp_path, monkeypatch
):
    scores, validate = iter([float("nan"), 20.0]), loop.validate

    def watched(*arguments):
        numbers, images = validate(*arguments)
        return numbers | {"psnr": next(scores)}, images

    monkeypatch.setattr(loop, "validate", watched)
    config = dataclasses.replace(CONFIG, validate_every=1, steps=2)
    run(tmp_path, config, stop_at=1)
    assert not (tmp_path / "best.safetensors").exists()
    run(tmp_path, config, stop_at=2)
    assert (tmp_path / "best.safetensors").is_file()


@pytest.mark.slow
def test_what_a_run_leaves_behind(whole):
    state, out = whole
    validations = [line for line in lines(out) if "val_psnr" in line]
    assert [line["step"] for line in validations] == [2, 4]
    assert all(
        np.isfinite(list(line.values())).all() and line["val_overflow"] == 0 for line in validations
    )
    from PIL import Image

    side, shown = (
        CONFIG.model.conventions.image_size,
        CONFIG.views.input_counts[0] + 2 * CONFIG.views.target_count,
    )
    with Image.open(out / "sheets" / "0000004.png") as sheet:
        assert sheet.size == (shown * side, side)
    variables, model = load_weights(out / "weights.safetensors")
    assert model == CONFIG.model.trained
    halved = jax.tree.map(
        lambda x: np.asarray(x).astype(np.float16).astype(np.float32), state.variables
    )
    assert jax.tree.all(
        jax.tree.map(lambda a, b: bool((np.asarray(a) == b).all()), variables, halved)
    )
    checkpoints = Checkpoints(out / "checkpoints")
    best = max(validations, key=lambda line: line["val_psnr"])
    assert (
        checkpoints.best_step == best["step"]
        and checkpoints.score(best["step"]) == best["val_psnr"]
    )
    checkpoints.close()


def quick(step=None):
    """Returns a step that computes nothing and then calls `step` with its number."""

    def made(state, batch, body, config, networks, mesh):
        if step is not None:
            step(int(state.step) + 1)
        names = ("loss", "psnr", "grad_norm", "skipped", "nonfinite", "overflow")
        return replace(state, step=state.step + 1), dict.fromkeys(names, jnp.ones(()) * 0)

    return made


@pytest.mark.parametrize(("at", "number"), [(1, signal.SIGINT), (3, signal.SIGTERM)])
def test_a_signal_ends_a_run_when_all_is_saved(at, number, run, tmp_path, monkeypatch, caplog):
    """This holds for a signal in the last step, too, which is completed."""
    monkeypatch.setattr(
        loop, "train_step", quick(lambda done: done == at and signal.raise_signal(number))
    )
    handler = signal.getsignal(number)
    with (
        caplog.at_level(logging.WARNING),
        pytest.raises(loop.TrainingInterrupted, match=f"after {at} of 3 steps") as stopped,
    ):
        run(tmp_path, dataclasses.replace(CONFIG, steps=3, validate_every=4), validation=())
    # ends a loop of runs, too
    assert signal.getsignal(number) is handler and isinstance(stopped.value, KeyboardInterrupt)
    assert int(stopped.value.state.step) == at and "stopping after this step" in caplog.text
    checkpoints = Checkpoints(tmp_path / "checkpoints")
    assert checkpoints.steps[-1] == at and (tmp_path / "weights.safetensors").is_file()
    checkpoints.close()


def test_what_was_dropped_is_explained(run, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(loop, "train_step", quick())
    numbers = {"psnr": 20.0, "dropped_tokens": 1.0, "overflow": 0.0}
    monkeypatch.setattr(loop, "validate", lambda *_: (numbers, [np.zeros((2, 32, 32, 3))]))
    run(tmp_path, stop_at=2, progress=True)
    assert f"dropped_tokens 1 ({loop.DROPPED['dropped_tokens']}), overflow 0" in " ".join(
        "".join(capsys.readouterr()).split()
    )


def test_runs_of_other_seeds_share_a_program(body, captures, variables, monkeypatch):
    batch = stage_loader(captured_people(captures, body), CONFIG, 0).batch_at(0)
    asked = []
    monkeypatch.setattr(
        step, "compiled_update", lambda: lambda *given: asked.append(given[-3:]) or (given[0], {})
    )
    for config in (CONFIG, dataclasses.replace(CONFIG, seed=7, log_every=9, keep_checkpoints=5)):
        train_step(init_state(config, variables), batch, body, config)
    assert asked[0][1:] == asked[1][1:] and hash(asked[0][1]) == hash(asked[1][1])
    assert (asked[0][0] != asked[1][0]).any()

    def keys_of(seed):
        return step.subject_keys(jnp.asarray(step.seed_numbers(seed)), jnp.asarray(3), 2)

    expected = jax.random.split(jax.random.fold_in(jax.random.key(7), 3), 2)
    assert (jax.random.key_data(keys_of(7)) == jax.random.key_data(expected)).all()


def test_a_broken_folder_is_named_and_another_configuration_refused(
    body, captures, run, tmp_path, monkeypatch, caplog
):
    monkeypatch.setattr(loop, "train_step", quick())
    broken, out = tmp_path / "broken", tmp_path / "out"
    broken.mkdir()
    (broken / "capture.json").write_text("{}")
    asked = []

    def make(config):
        asked.append(config)
        return captured_people([broken, captures[0]], body)(config)

    with caplog.at_level(logging.WARNING):
        run(out, training=make, validation=(), stop_at=2)
    assert (
        asked == [CONFIG] and str(broken) in caplog.text and lines(out)[-1]["broken_folders"] == 1
    )
    with pytest.raises(ValueError, match="started with seed = 0, not 1"):
        run(out, dataclasses.replace(CONFIG, seed=1))


def test_sizes_of_a_later_stage_are_tried_before_the_run(run, tmp_path):
    config = dataclasses.replace(
        CONFIG, batch_size=2, microbatch_size=2, stages=(Phase(50, batch_size=3),)
    )
    with pytest.raises(
        ValueError, match="3 subjects per device cannot be divided into microbatches of 2"
    ):
        run(tmp_path, config)
    assert not (tmp_path / "log.jsonl").exists()


@pytest.mark.slow
def test_resume_in_a_later_stage_with_changing_numbers_of_views(run, tmp_path, same):
    config = dataclasses.replace(
        CONFIG,
        views=dataclasses.replace(CONFIG.views, input_counts=(1, 2, 3)),
        ema_decay=0.9,
        steps=6,
        stages=(Phase(2, image_size=16, target_size=32, batch_size=2, token_capacity=12),),
    )
    whole = run(tmp_path / "whole", config)
    for stop in (1, 3, 4, 6):
        resumed = run(tmp_path / "parts", config, stop_at=stop)
    assert same(resumed, whole)
    assert (
        losses(tmp_path / "parts") == losses(tmp_path / "whole")
        and len(losses(tmp_path / "whole")) == 6
    )
    assert load_weights(tmp_path / "whole" / "weights.safetensors")[1].image_size == 16
