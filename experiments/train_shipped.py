"""Trains the network that comes with the package on synthetic people, in one call or several.

    python experiments/train_shipped.py --out runs/shipped --hours 2
    python experiments/train_shipped.py --out runs/more --init-weights shipped --people 480
        --start-share 0.5

The run is the preset `small` of training/config.py. Every setting is an option: `--steps 4000
--optimizer.learning-rate 2e-4`. The people are made first: `--people` of the training seeds, which
are rendered anew for every step, and 8 of the validation seeds. Ctrl-C, SIGTERM and the end of
`--hours` save the run in `--out`, and the same command continues it. `--loss.lpips 0.1` adds LPIPS
(AlexNet), with the extra `lpips`. The mean of the first and the trained weights is often better
than both (Wortsman et al. 2022, https://arxiv.org/abs/2109.01903). `--start-share` writes it.

On 2 CPU cores a person takes 2.6 s, and a step takes 1.2 s on an otherwise idle machine.
humangs_jax/assets/weights.md describes how the shipped weights were trained.
"""

import logging
import os
import signal
import threading
from pathlib import Path
from typing import Annotated, Any, Literal

import jax
import numpy as np
import tyro

from humangs_jax.body.library import load_body
from humangs_jax.core.processes import keep_freed_memory
from humangs_jax.data.loading.captures import find_captures
from humangs_jax.losses.loss_networks import load_loss_networks
from humangs_jax.network.weights import (
    flatten_variables,
    load_weights,
    save_weights,
    variables_from_tensors,
)
from humangs_jax.synthetic.bank import load_bank
from humangs_jax.synthetic.sources import on_the_fly_people
from humangs_jax.synthetic.writer import Layout, write_set
from humangs_jax.training.config import TrainConfig, small
from humangs_jax.training.loop import TrainingInterrupted, train
from humangs_jax.training.sources import training_people

VALIDATION_SUBJECTS = 8
"""Number of validation people."""


def main(
    out: Path,
    people: int = 1000,
    bank: Path | None = None,
    validation: Path | None = None,
    hours: float | None = None,
    # tyro takes the first type that fits, so the word comes before the path
    init_weights: Literal["shipped"] | Path | None = None,
    start_share: float = 0.0,
    config: Annotated[TrainConfig, tyro.conf.arg(name="")] = small(),  # noqa: B008
) -> None:
    """Trains on people rendered on the fly.

    Args:
        out: folder of checkpoints, log, images and weights of the run.
        people: number of people of the training seeds, which are kept in out/people.npz.
        bank: people.npz of another run, instead of new people.
        validation: folder of captures of other people for validation; default: made in
            out/validation.
        hours: save and end after this time; the same command continues. Default: until the last
            step.
        init_weights: start from these weights instead of fresh ones; their network must have the
            same tensors as that of `config`. "shipped": those of the package.
        start_share: also write out/mean.safetensors after the last step, with this share of the
            first weights and the other share of the trained ones.
        config: the run.

    Raises: ValueError for a share that is not in [0, 1), or without `init_weights`, and for weights
        of another network.
    """
    if not 0 <= start_share < 1 or (start_share and init_weights is None):
        raise ValueError(
            f"start_share {start_share}: expected a number in [0, 1), and init_weights if it is"
            " not 0"
        )

    # the end of the hours stops the run in the same way as SIGTERM
    logging.basicConfig(level=logging.WARNING, format="%(message)s")
    if hours is not None:
        timer = threading.Timer(3600 * hours, os.kill, (os.getpid(), signal.SIGTERM))
        timer.daemon = True
        timer.start()

    # weights to start from, and the people
    body, variables = load_body(), None
    if init_weights is not None:
        variables, _ = load_weights(None if init_weights == "shipped" else init_weights)
        tensors = {key: np.asarray(tensor) for key, tensor in flatten_variables(variables).items()}
        variables = variables_from_tensors(tensors, config.model, str(init_weights))
    if validation is None:
        validation = out / "validation"
        write_set(validation, VALIDATION_SUBJECTS, Layout(256, poses=2, views=12), "validation")
    if bank is None:
        training = training_people(None, people, out, body)
    else:
        training = on_the_fly_people(load_bank(bank))

    try:
        networks = load_loss_networks(lpips_net="alex", installed=True)
        state = train(
            config,
            body,
            training,
            out,
            validation=find_captures(validation),
            variables=variables,
            networks=networks,
        )
    except TrainingInterrupted as stopped:
        if hours is None or timer.is_alive():  # it was not the timer
            raise
        state = stopped.state
    if start_share and int(state.step) == config.steps:
        write_mean(out, variables, start_share)


def write_mean(out: Path, start: Any, share: float) -> None:
    """Writes out/mean.safetensors from the first weights and out/weights.safetensors."""
    trained, model = load_weights(out / "weights.safetensors")
    mean = jax.tree.map(lambda first, last: share * first + (1 - share) * last, start, trained)
    save_weights(out / "mean.safetensors", mean, model, "float16")


if __name__ == "__main__":
    keep_freed_memory()
    tyro.cli(main, description=__doc__)
