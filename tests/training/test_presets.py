"""Every preset makes a step on all people that `humangs train` accepts.

These are people on disk, in a data set, and made on the fly.
"""

import dataclasses
import logging
import math

import numpy as np
import pytest
from data.datasets.dataset_files import write_avatarrex, write_model

from humangs_jax.body.library import load_body
from humangs_jax.core.pytree import replace
from humangs_jax.data.capture import load_capture, save_capture
from humangs_jax.data.loading import CaptureSource
from humangs_jax.data.views import gaussian_body
from humangs_jax.losses.loss_networks import NO_NETWORKS
from humangs_jax.synthetic.bank import build_bank
from humangs_jax.synthetic.sources import on_the_fly_people
from humangs_jax.synthetic.subject import SPLITS
from humangs_jax.training.config import PRESETS, fitting_losses
from humangs_jax.training.sources import (
    captured_people,
    mixed_people,
    people_on_disk,
    stage_loader,
)
from humangs_jax.training.state import init_state
from humangs_jax.training.step import train_step

SIZE = 32
KINDS = ("captures", "data set", "mixture")


def shrunk(name):
    """Returns the preset with its losses, conventions and schedule, at the smallest sizes."""
    config = fitting_losses(PRESETS[name](), NO_NETWORKS)
    parts = config.model.architecture
    upsampler = parts.encoder.upsampler and dataclasses.replace(parts.encoder.upsampler, hidden=8)
    encoder = dataclasses.replace(
        parts.encoder,
        texture=dataclasses.replace(parts.encoder.texture, resolution=8, channels=2),
        transformer=dataclasses.replace(
            parts.encoder.transformer, width=16, layers=4, head_width=8
        ),
        upsampler=upsampler,
    )
    reader = dataclasses.replace(parts.reader, output_width=None if upsampler is None else 8)
    model = config.model.with_parts(
        encoder=encoder, reader=reader, decoder=dataclasses.replace(parts.decoder, hidden=16)
    )
    model = model.with_conventions(image_size=SIZE, body_vertices=None, max_edge_length=None)
    return dataclasses.replace(
        config,
        model=model.with_runtime(token_capacity=16),
        views=dataclasses.replace(config.views, input_counts=(2,), target_count=1),
        # images of 32 pixels have no third scale
        loss=dataclasses.replace(config.loss, structural_scales=1),
        target_size=SIZE,
        batch_size=4,
        stages=(),
    )


def with_depths(make):
    """Returns the same people with known depths."""

    class Known(CaptureSource):
        def example(self, *which):
            example = super().example(*which)
            known = lambda views: replace(views, depths=2 * views.masks)
            return replace(example, inputs=known(example.inputs), targets=known(example.targets))

    return lambda config: Known(**vars(make(config)))


@pytest.fixture(scope="module")
def data_set(tmp_path_factory):
    folder = tmp_path_factory.mktemp("set")
    body = write_model(folder)
    return people_on_disk(write_avatarrex(folder / "avatarrex_zzr"), body), body.model


MIXED = 1
"""A step whose examples are of both kinds; all those of step 0 come from the first source."""


@pytest.mark.parametrize("kind", KINDS)
def test_the_default_preset_takes_people_of_every_kind(kind, captures, body, data_set, caplog):
    """It compares depths, which people on disk lack; in a batch theirs are 0."""
    people = captured_people(captures, body)
    if kind == "data set":
        people, _ = data_set
    if kind == "mixture":
        people = mixed_people([people, with_depths(people)], [1, 1])
    with caplog.at_level(logging.WARNING):
        depths = stage_loader(people, shrunk("small"), 0).batch_at(MIXED).targets.depths
    assert "people on disk have no depths: loss.depth (weight 0.3) is 0" in caplog.text
    known = np.asarray(depths).any(axis=(1, 2, 3))
    assert known.any() == (kind == "mixture") and not known.all()


@pytest.fixture(scope="module")
def mixture(tmp_path_factory):
    """Returns (source of two people on the fly and one on disk, body)."""
    body, folder = load_body(), tmp_path_factory.mktemp("demo")
    save_capture(folder, load_capture("demo_capture").resized(SIZE))
    bank = build_bank(SPLITS["train"][:2], body, "train", texture_size=128, pose_count=2)
    return mixed_people([captured_people([folder], body), on_the_fly_people(bank)], [1, 1]), body


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("name", PRESETS)
def test_every_preset_makes_a_step(name, kind, captures, body, data_set, request):
    config = shrunk(name)
    people = captured_people(captures, body)
    if kind == "data set":
        people, body = data_set
    if kind == "mixture":
        people, body = request.getfixturevalue("mixture")
    batch = stage_loader(people, config, 0).batch_at(MIXED)
    state, metrics = train_step(
        init_state(config), batch, gaussian_body(body, config.model), config
    )
    assert int(state.step) == 1 and int(metrics["skipped"]) == int(metrics["nonfinite"]) == 0
    assert math.isfinite(float(metrics["loss"])) and float(metrics["grad_norm"]) > 0
