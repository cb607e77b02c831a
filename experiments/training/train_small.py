"""Train the network that comes with the package on synthetic people, from nothing or from the shipped weights.

    python experiments/training/train_small.py --out runs/small
    python experiments/training/train_small.py --out runs/more --init-weights shipped

The run is experiments/training/small.json; every setting of it is an option: `--steps 4000 --optimizer.learning-rate 2e-4`.
Makes the people first: `--on-the-fly` of the training seeds that are drawn anew for every step, `--subjects` that are written
as captures, and a few of the validation seeds. Continues the run in `--out` if there is one; Ctrl-C saves.

On 2 CPU cores: 1 s a person on the fly, 5 s a written one, then about 1.2 s a step on an otherwise quiet machine. How the
shipped weights came about is in humangs_jax/assets/weights.md.
"""

from pathlib import Path
from typing import Annotated, Literal

import tyro

from humangs_jax.core.allocator import keep_freed_memory
from humangs_jax.io.text import read_configuration
from humangs_jax.training.config import TrainConfig

SMALL = read_configuration(TrainConfig, Path(__file__).resolve().parent / "small.json")
VALIDATION_SUBJECTS = 8


def main(
    out: Path,
    people: Path | None = None,
    validation: Path | None = None,
    subjects: int = 64,
    on_the_fly: int = 320,
    init_weights: Literal["shipped"] | Path | None = None,  # the word first: tyro takes the first type that fits
    config: Annotated[TrainConfig, tyro.conf.arg(name="")] = SMALL,
) -> None:
    """Train on synthetic people, written and on-the-fly ones by halves.

    Args:
        out: checkpoints, log, images and weights of the run.
        people: folder of capture folders to train on; made in out/people if not given.
        validation: folder of captures of other people, for validation; made in out/validation by default.
        subjects: how many people to write; 0 for on-the-fly ones alone.
        on_the_fly: how many people rendered anew for every step; kept in out/people.npz. 0 for written ones alone.
        init_weights: start from these weights instead of fresh ones, see `fit_variables` for how much their network may
            differ from that of `config`; "shipped": the package's own.
        config: the run.
    """
    import logging

    from humangs_jax.body.library import load_body
    from humangs_jax.data.loader import find_captures
    from humangs_jax.network.weights import fit_variables, load_weights
    from humangs_jax.people.writer import Layout, write_set
    from humangs_jax.training.loop import train
    from humangs_jax.training.sources import training_people

    logging.basicConfig(level=logging.WARNING, format="%(message)s")
    body, variables = load_body(), None
    if init_weights is not None:
        variables, model = load_weights(None if init_weights == "shipped" else init_weights)
        variables = fit_variables(variables, model, config.model)
    if people is None and subjects:
        people = out / "people"
        write_set(people, subjects, Layout(256, poses=2, views=12))
    if validation is None:
        validation = out / "validation"
        write_set(validation, VALIDATION_SUBJECTS, Layout(256, poses=2, views=12), "validation")
    training = training_people(people, on_the_fly, out, body)
    train(config, body, training, out, validation=find_captures(validation), variables=variables)


if __name__ == "__main__":
    keep_freed_memory()
    tyro.cli(main, description=__doc__)
