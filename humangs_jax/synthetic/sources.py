"""Makes sources of synthetic people for training runs. `training.sources` imports it by name."""

import dataclasses
import logging
import os
from pathlib import Path

import jax

from humangs_jax.body.model import BodyModel
from humangs_jax.data.loading import Source
from humangs_jax.synthetic.bank import PeopleBank, build_bank, load_bank, save_bank
from humangs_jax.synthetic.on_the_fly import ON_THE_FLY, OnTheFlyConfig, on_the_fly_source
from humangs_jax.synthetic.subject import seeds_of
from humangs_jax.training.config import TrainConfig
from humangs_jax.training.sources import SourceFactory

logger = logging.getLogger(__name__)


def people_of_run(people: int, out: Path, body: BodyModel) -> SourceFactory:
    """Returns a function that makes a source of the first people of the training split. They are
    rendered anew for every step.

    people: number of people. out: folder of the run, which keeps their bank. body: the package's
    body.

    Raises: ValueError if `people` is less than 1 or more than the split has, if the body is not the
    package's body, or if the bank in the folder cannot be read; OSError if the bank cannot be
    written, or if a process that makes people is killed.
    """
    return on_the_fly_people(_bank(people, out, body))


def people_of_split(
    people: int, body: BodyModel, split: str, size: int, each_once: bool = False
) -> SourceFactory:
    """Returns a function that makes a source of the first people of a split. They are rendered anew
    for every step.

    people: number of people. body: the package's body. size: side of the images, pixels. Textures
    are as fine as images of this size need. each_once: see `on_the_fly_people`.

    Raises: ValueError if `people` is less than 1 or more than the split has, or if the body is not
    the package's body; KeyError if there is no such split.
    """
    texture = 1024
    if size <= 64:
        texture = 128
    elif size <= 256:
        texture = 512
    bank = build_bank(seeds_of(split, 0, people), body, split, texture_size=texture)
    return on_the_fly_people(bank, each_once=each_once)


def on_the_fly_people(
    bank: PeopleBank, settings: OnTheFlyConfig = ON_THE_FLY, each_once: bool = False
) -> SourceFactory:
    """Returns a function that makes a source of the people of a bank. They are rendered for every
    step on the device that trains.

    Image sizes and views are those of the run's configuration. If the default device is not a CPU,
    all views of an example are drawn at once.

    settings: what else the examples show, and how they are drawn. each_once: whether each person is
    shown once, in order, for validation; otherwise people are random.
    """

    def make(config: TrainConfig) -> Source:
        views = config.views
        if views.rule != "random":
            logger.warning(
                'views.rule "%s" is for written people; on-the-fly people are drawn by "random"',
                views.rule,
            )
        drawn = dataclasses.replace(
            settings,
            target_views=views.target_count,
            input_size=config.model.conventions.image_size,
            target_size=config.target_size,
            mixed_pose_share=views.mixed_pose_share,
            jitter=views.jitter,
            scattered_share=views.scattered_share,
            depths=config.loss.depth > 0,
        )
        if jax.default_backend() != "cpu":  # whole images, all views at once
            most = max(views.input_counts) + views.target_count
            drawn = dataclasses.replace(drawn, views_at_once=most, pixels_per_step=1 << 30)
        return on_the_fly_source(bank, drawn, views.input_counts, jax.device_count() > 1, each_once)

    return make


def _bank(people: int, out: Path, body: BodyModel) -> PeopleBank:
    """Returns the bank in out/people.npz. If that file is missing or has other seeds, the first
    process of the run makes a bank and writes it there.
    """
    path, seeds, bank = out / "people.npz", seeds_of("train", 0, people), None
    if jax.process_index() == 0:
        bank = load_bank(path) if path.is_file() else None
        if bank is None or bank.seeds.tolist() != list(seeds):
            out.mkdir(parents=True, exist_ok=True)
            bank = build_bank(seeds, body, "train", processes=os.cpu_count() or 1, progress=True)
            save_bank(path, bank)
    if jax.process_count() > 1:
        from jax.experimental import multihost_utils

        multihost_utils.sync_global_devices("people")
    return load_bank(path) if bank is None else bank
