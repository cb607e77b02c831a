"""From what a user gives on a command line to the arguments of `loop.train`: whom to train on, and what to compare with."""

import logging
import os
from pathlib import Path

import jax

from humangs_jax.body.model import BodyModel
from humangs_jax.core.configuration import config_from_file
from humangs_jax.objectives.loss_networks import LossNetworks
from humangs_jax.people.bank import build_bank, load_bank, save_bank
from humangs_jax.people.manifest import find_people
from humangs_jax.people.seeds import SPLITS
from humangs_jax.training.config import PRESETS, TrainConfig, without_losses
from humangs_jax.training.sources import MakeSource, captured_people, mixed_people, on_the_fly_people

logger = logging.getLogger(__name__)


def read_config(preset_or_path: str | Path) -> TrainConfig:
    """A preset by its name, or a JSON file such as the config.json of a run.

    Raises: FileNotFoundError if it is neither; ValueError, naming file and field.
    """
    if str(preset_or_path) in PRESETS:
        return PRESETS[str(preset_or_path)]()
    path = Path(preset_or_path)
    if not path.is_file():
        raise FileNotFoundError(f"{path}: neither a file nor one of the presets {', '.join(PRESETS)}")
    return config_from_file(TrainConfig, path)


def training_people(data: Path | None, live: int, out: Path, body: BodyModel) -> MakeSource:
    """The people of a folder of captures, `live` people made on the fly, or both by halves.

    The latter are made once, into out/people.npz, by one process. Raises: ValueError if there are none.
    """
    parts = []
    if data is not None:
        parts.append(captured_people(find_people(data), body))
    if live:
        parts.append(on_the_fly_people(_bank(live, out, body)))
    if not parts:
        raise ValueError("nobody to train on: name a folder of captures, or give --live a number of people")
    return parts[0] if len(parts) == 1 else mixed_people(parts, [1] * len(parts))


def _bank(people, out, body):
    """The bank in out/people.npz, which one process makes unless it is there."""
    path, seeds, bank = out / "people.npz", SPLITS["train"][:people], None
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


def fitting_losses(config: TrainConfig, networks: LossNetworks) -> TrainConfig:
    """The configuration without the losses whose networks are missing; a warning names them."""
    missing = [
        name for name in ("perceptual", "lpips") if getattr(config.loss, name) and getattr(networks, name) is None
    ]
    if not missing:
        return config
    changed = without_losses(config, missing)
    logger.warning(
        "the loss %s is left out, its network is not given; structural dissimilarity (weight %g) takes its place",
        " and ".join(missing),
        changed.loss.structural,
    )
    return changed
