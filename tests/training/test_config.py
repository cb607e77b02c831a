"""Configurations of runs: stages, JSON, and losses whose networks are missing."""

import dataclasses
import logging

import pytest

from humangs_jax.core.configuration import config_from_json, config_to_json
from humangs_jax.losses.loss_networks import LossNetworks
from humangs_jax.training import config
from humangs_jax.training.config import Phase, TrainConfig, fitting_losses, read_config, tiny
from humangs_jax.training.sources import training_people

STAGED = dataclasses.replace(
    tiny(),
    steps=10,
    batch_size=3,
    stages=(Phase(4, image_size=64, batch_size=2), Phase(8, target_size=32)),
)


def test_a_stage_changes_what_it_names_until_the_next_adds_to_it():
    assert STAGED.at(3) == dataclasses.replace(STAGED, stages=())
    assert (
        STAGED.at(4).model.conventions.image_size,
        STAGED.at(4).batch_size,
        STAGED.at(4).target_size,
    ) == (64, 2, 16)
    assert (
        STAGED.at(9).model.conventions.image_size,
        STAGED.at(9).batch_size,
        STAGED.at(9).target_size,
    ) == (64, 2, 32)
    assert STAGED.spans(0, 10) == [(0, 4), (4, 8), (8, 10)]
    assert (
        STAGED.spans(5, 7) == [(5, 7)]
        and STAGED.spans(4, 9) == [(4, 8), (8, 9)]
        and STAGED.spans(3, 3) == []
    )


def test_examples_are_counted_over_stages():
    assert [STAGED.examples_before(step) for step in (0, 1, 4, 5, 8, 10)] == [0, 3, 12, 14, 20, 24]


@pytest.mark.parametrize("starts", [(5, 3), (4, 4), (10,)])
def test_stages_out_of_order_are_refused(starts):
    with pytest.raises(ValueError, match="stages start at"):
        dataclasses.replace(tiny(), steps=10, stages=tuple(Phase(start) for start in starts))


def test_sizes_that_do_not_fit_are_refused_before_the_run():
    with pytest.raises(ValueError, match="not a multiple of patch_size"):
        dataclasses.replace(tiny(), steps=10, stages=(Phase(4, image_size=65),))


@pytest.mark.parametrize("name", sorted(config.PRESETS))
def test_runs_survive_json(name):
    run = dataclasses.replace(config.PRESETS[name](), ema_decay=0.99)
    assert config_from_json(TrainConfig, config_to_json(run)) == run


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            '{"stages": [{"start": 5, "size": 3}]}',
            r"config\.stages\[0\]\.size: Phase has no such field",
        ),
        (
            '{"optimizer": {"name": "sgd"}}',
            r"config\.optimizer\.name: expected .*adamw.*, got 'sgd'",
        ),
        ('{"model": {"runtime": {"dtype": "float16"}}}', "float16: gradients underflow"),
        ('{"steps": 2', "the configuration is not JSON"),
    ],
)
def test_errors_name_file_and_field(text, message, tmp_path):
    path = tmp_path / "config.json"
    path.write_text(text)
    with pytest.raises(ValueError, match=message) as error:
        read_config(path)
    assert str(path) in str(error.value)


def test_presets_by_name_and_files_that_are_not_there():
    assert read_config("tiny") == tiny()
    with pytest.raises(
        FileNotFoundError, match=r"huge: neither a file nor one of the presets published, paper"
    ):
        read_config("huge")


def test_a_loss_without_its_network_gives_way_and_says_so(caplog):
    with caplog.at_level(logging.WARNING):
        fitted = fitting_losses(config.published(), LossNetworks())
    assert (fitted.loss.perceptual, fitted.loss.lpips, fitted.loss.structural) == (0, 0, 0.2)
    assert (
        "no network is given for the loss perceptual and lpips" in caplog.text
        and "structural dissimilarity" in caplog.text
    )
    assert fitting_losses(config.small(), LossNetworks()) == config.small()


def test_nobody_to_train_on_is_an_error(tmp_path, body):
    with pytest.raises(ValueError, match="nobody to train on"):
        training_people(None, 0, tmp_path, body)
