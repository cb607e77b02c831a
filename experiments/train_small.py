"""Train the network that comes with the package on synthetic people, from nothing or from the shipped weights.

    python experiments/train_small.py --out runs/small

Makes the people first (`--subjects` of the training seeds, and a few of the validation seeds to look at) unless `--people`
and `--validation` name folders of captures. Continues the run in `--out` if there is one; Ctrl-C saves. Every setting
of `TrainConfig` is an option: `--steps 4000 --optimizer.learning-rate 2e-4`.

On 2 CPU cores: 3 s per subject to make them, then 0.9 s per step on an otherwise quiet machine. The shipped weights had two
runs of 994 and 2,000 steps with the settings in docs/training.md (22.7 dB on the validation views at 256 x 256 after 250
steps, 24.7 after 750, 26.7 at the end); the preset here is one longer run with the same losses and views.
"""

import dataclasses
from pathlib import Path
from typing import Annotated, Literal

import tyro

from humangs_jax.allocator import keep_freed_memory
from humangs_jax.training.config import TrainConfig, small

SMALL = small()
VALIDATION_SUBJECTS = 8


def main(
    out: Path,
    people: Path | None = None,
    validation: Path | None = None,
    subjects: int = 600,
    init_weights: Path | Literal["shipped"] | None = None,
    config: Annotated[TrainConfig, tyro.conf.arg(name="")] = SMALL,
) -> None:
    """Train on synthetic people.

    Args:
        out: checkpoints, log, pictures and weights of the run.
        people: folder of capture folders to train on; made in out/people if not given.
        validation: folder of captures of other people, looked at now and then; made in out/validation if not given.
        subjects: how many people to make.
        init_weights: start from these weights (and their network) instead of fresh ones; "shipped": the package's own.
        config: the run.
    """
    import logging

    from humangs_jax.body.library import load_body
    from humangs_jax.data.loader import find_captures
    from humangs_jax.data.synthetic import SPLITS, synthesize
    from humangs_jax.models.weights import load_weights
    from humangs_jax.training.loop import train

    logging.basicConfig(level=logging.WARNING, format="%(message)s")
    variables = None
    if init_weights is not None:
        variables, model = load_weights(None if init_weights == "shipped" else init_weights)
        config = dataclasses.replace(config, model=model)
    if people is None:
        people = out / "people"
        synthesize(people, subjects, SPLITS["train"].start)
    if validation is None:
        validation = out / "validation"
        synthesize(validation, VALIDATION_SUBJECTS, SPLITS["validation"].start)
    train(config, load_body(), find_captures(people), out, validation=find_captures(validation), variables=variables)


if __name__ == "__main__":
    keep_freed_memory()
    tyro.cli(main, description=__doc__)
