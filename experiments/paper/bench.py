"""Has what the experiments of the paper share: the variants that are trained, the training of a
run, its scores, and the differences between variants.

The reference is the network of the paper, narrower and with fewer layers. Every variant differs
from it in what its name says. All variants see the same people, views and targets in the same
order, have the same losses and learning rate, and are compared on the same views of the same unseen
people.

A run is trained in rounds of `ROUND` steps with the squared error and the tightness of the paper.
The learning rate ends at 0 in each round. Rounds end when the run is `MARGIN` above the
vertex-color baseline in the foreground of the validation people, or when it is above the baseline
and a round has gained less than `FLAT`, or after `MOST_ROUNDS` rounds; then it counts as not
trained. A quarter of a round with the perceptual loss follows. A run that falls below the vertex
colors there is not trained either. So all variants that learn fast have the same number of steps.

People are plain (`people.py`). On richer people the systems that attend to photos still show grey
bodies after as many steps.
"""

import dataclasses
import functools
import json
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from scipy.stats import t as student

from experiments.costs import costs_of
from experiments.paper.people import on_disk
from experiments.results import REPOSITORY, write_json
from experiments.systems import ADDED, BENCH_WIDTH, SYSTEMS
from experiments.systems import ONE_PHOTO as TAKE_ONE
from experiments.systems.grouped import GroupReader
from humangs_jax.avatar.reconstruct import reconstruct
from humangs_jax.body.library import load_body
from humangs_jax.data.loading import ViewSampling
from humangs_jax.data.views import gaussian_body
from humangs_jax.evaluation.cases import (
    Method,
    Predicted,
    draw_painted_body,
    painted_body,
    predict_views,
)
from humangs_jax.evaluation.means import person_means
from humangs_jax.evaluation.run import evaluate
from humangs_jax.evaluation.scores import EvaluationProtocol
from humangs_jax.losses.loss_networks import LossNetworks, load_loss_networks
from humangs_jax.losses.losses import LossConfig
from humangs_jax.network.config import HumanGSConfig, paper_parts
from humangs_jax.network.upsampler import UpsamplerConfig
from humangs_jax.network.weights import load_weights
from humangs_jax.training.config import OptimizerConfig, TrainConfig, compiled_for
from humangs_jax.training.loop import TrainingInterrupted, train
from humangs_jax.training.sources import stage_loader
from humangs_jax.training.state import init_state
from humangs_jax.training.step import seed_numbers, update

PAGE = REPOSITORY / "docs" / "paper.md"
SCORES = {
    "psnr": ("PSNR, dB", 2),
    "psnr_fg": ("foreground PSNR, dB", 2),
    "ssim": ("SSIM", 3),
    "lpips_alex": ("LPIPS (Alex)", 3),
}
TASKS = {"reconstruction": "pose of the photos", "animation": "another pose"}
PHOTOS = 4
"""Number of photos that a network is trained with, unless it takes only one."""
COUNTS = ("1", "2", "4", "6")
"""Tests of a network that takes several photos, by the number of photos."""
NEAR = tuple(f"near {count}" for count in COUNTS)
"""The same tests with photos of nearer cameras."""
REFERENCE = "paper"
"""The variant that all others are compared with."""
ROUND, BATCH, MOST_ROUNDS = 300, 8, 12
"""Steps of a round, people of a step, and the largest number of rounds."""
FLAT, MARGIN = 0.2, 2.0
"""Decibels of foreground PSNR that end the rounds: a smaller gain in a round, and a larger distance
from the vertex colors.
"""
SEEDS = 3
"""Training seeds of the reference and of the systems that claims are about."""
PROTOCOL = EvaluationProtocol(lpips=("alex",))
PER_PERSON = ("animatable",)
"""Systems that are fitted to one person, and so cannot be trained on many."""
PAINTED = "vertex-color baseline"
"""Name of the baseline without a network."""
NOT_TRAINED = "not trained"


class Variant(NamedTuple):
    """A network that is trained, and how."""

    model: HumanGSConfig
    """The network."""
    photos: int = PHOTOS
    """Number of photos that it is trained with."""
    about: str = ""
    """What the variant tests, empty for a system."""
    fields: Mapping[str, Any] = {}
    """Fields of its `TrainConfig` that differ from the reference."""


def variants() -> dict[str, Variant]:
    """Returns all variants that `train_all.py` trains, by name, in the order of its queue."""
    # the systems
    models = {name: make("bench") for name, make in SYSTEMS.items() if name not in PER_PERSON}
    paper, ours = models.pop("humangs"), models.pop("ours")
    encoder, reader, decoder = paper_parts(paper.architecture)

    def part(about, **changes):
        return Variant(paper.with_parts(**changes), about=about)

    found = {REFERENCE: Variant(paper)}
    for name, model in models.items():
        found[name] = Variant(model, 1 if name in TAKE_ONE else PHOTOS)

    # the reference without a part of the paper, and with an addition of ours
    tokenless = dataclasses.replace(encoder.transformer, class_token=False)
    upsampler = UpsamplerConfig(BENCH_WIDTH // 3, "final")
    normal, shells = decoder.clone(frame="normal"), paper_parts(ours.architecture)[1].shells
    return found | {
        "one depth": part("features of four depths", encoder=encoder.clone(upsampler=upsampler)),
        "no global token": part("global token", encoder=encoder.clone(transformer=tokenless)),
        "1 Gaussian a vertex": part("1 + 4 Gaussians a vertex", decoder=decoder.clone(free=0)),
        "pooling over all views": Variant(
            paper.with_conventions(pool="all"), about="pooling over visible views"
        ),
        "tightness 0": Variant(
            paper, about="tightness", fields={"loss": dataclasses.replace(LOSS, tightness=0.0)}
        ),
        "all additions": Variant(ours, about="ours"),
        "photo colors": part(
            "ours", reader=reader.clone(sample_rgb=True), decoder=decoder.clone(residual_color=True)
        ),
        "normal frame": part("ours", decoder=normal),
        "shells and normal frame": part("ours", reader=reader.clone(shells=shells), decoder=normal),
        "foreground tokens": Variant(paper.with_conventions(tokens="foreground"), about="ours"),
    }


LOSS = LossConfig(structural=0.0, structural_scales=1, silhouette=0.0, random_background=0.0)
"""The loss of the paper without its perceptual term."""


def configuration(variant: Variant, seed: int, steps: int, perceptual: bool = False) -> TrainConfig:
    """Returns the configuration of one round.

    The optimizer is that of the paper with a shorter warm-up. `perceptual` adds that loss.
    """
    photos = ViewSampling(
        (variant.photos,), target_count=1, jitter=0.0, scattered_share=0.0, mixed_pose_share=0.0
    )
    config = TrainConfig(
        model=variant.model,
        views=photos,
        loss=LOSS,
        optimizer=OptimizerConfig(warmup_steps=min(50, steps // 4)),
        target_size=variant.model.image_size,
        steps=steps,
        batch_size=BATCH,
        checkpoint_every=min(100, steps),
        seed=seed,
    )
    config = dataclasses.replace(config, **variant.fields)
    if perceptual:
        return dataclasses.replace(config, loss=dataclasses.replace(config.loss, vgg16=1.0))
    return config


def tests_of(name: str, variant: Variant) -> tuple[str, ...]:
    """Returns the tests of a variant: those of `COUNTS` and `NEAR` that claims need."""
    if variant.photos == 1:
        return ("1",)
    counts, near = (str(PHOTOS),), ()
    if name in (REFERENCE, "no global token", *SYSTEMS) and name not in ADDED:
        counts = COUNTS
    if name in ("lvsm", "humanram", "ghg", REFERENCE, "no global token", "1 Gaussian a vertex"):
        near = NEAR
    return *counts, *near


# One run
# --------------------------------------------------------------------------------------------------


def enough(curve: list[float], painted: float) -> bool:
    """Whether a run needs no more rounds.

    Args:
        curve: foreground PSNR of the validation people after each round, dB
        painted: that of the vertex colors, dB
    """
    return len(curve) >= MOST_ROUNDS or meets(curve, painted)


def meets(curve: list[float], painted: float) -> bool:
    """Whether a run is trained: it is `MARGIN` above the vertex colors, or above them and flat.

    Being flat is not enough, because networks stay white for long before they reach the vertex
    colors. The arguments are those of `enough`.
    """
    flat = len(curve) > 1 and painted < curve[-1] < max(curve[:-1]) + FLAT
    return flat or bool(curve and curve[-1] >= painted + MARGIN)


def train_run(
    variant: Variant,
    seed: int,
    out: Path,
    people: Path,
    row: dict[str, Any],
    painted: float,
    round_steps: int = ROUND,
) -> dict[str, Any] | None:
    """Trains a run for one more round and returns its row, or None if it was interrupted.

    An interrupted round continues where it was the next time.

    Args:
        variant: what is trained
        seed: seed of the training
        out: folder of the run
        people: folder with `train` and `validation` of `people.write_plain`
        row: row after the rounds before, {} at first
        painted: foreground PSNR of the vertex colors, dB
        round_steps: steps of a round
    """
    # the last round is shorter and has the perceptual loss
    curve, body, networks = row.get("curve", []), load_body(), load_loss_networks(installed=True)
    number, perceptual = len(curve), enough(curve, painted)
    if networks.vgg16 is None:
        raise ValueError("the perceptual loss needs VGG-16: pip install humangs_jax[lpips]")
    networks = networks if perceptual else LossNetworks()
    steps = round_steps // 4 if perceptual else round_steps
    config = configuration(variant, seed, steps, perceptual)

    # a system that cannot be posed is trained on the pose of the photos
    one_pose, folder = not animatable(variant.model), out / str(number)
    source = on_disk(people / "train", one_pose, recolored=True)
    before = None
    if number:
        before, _ = load_weights(out / str(number - 1) / "weights.safetensors")
    clock = folder / "seconds.json"
    spent = json.loads(clock.read_text()) if clock.exists() else 0.0
    start, interrupted = time.process_time(), False
    # another seed also means other people at each step, and rounds do not repeat the steps before
    config = dataclasses.replace(config, seed=100 * seed + number)
    try:
        state = train(
            config, body, source, folder, variables=before, networks=networks, progress=False
        )
    except TrainingInterrupted as stopped:
        state, interrupted = stopped.state, True
    spent += time.process_time() - start
    write_json(clock, spent)
    if interrupted and int(state.step) < config.steps:
        return None

    # the score of the validation people, and the sums over the rounds
    trained, model = jax.device_get(state.variables), variant.model
    score = tested(
        network(trained, model), people / "validation", variant.photos, animatable(model)
    )
    psnr = float(np.mean(score["reconstruction"]["psnr_fg"]))
    spent_operations = operations(config, source, networks) * config.steps
    return {
        "curve": curve if perceptual else [*curve, psnr],
        "validation": psnr,
        "done": perceptual,
        "photos": variant.photos,
        "steps": row.get("steps", 0) + config.steps,
        "operations": row.get("operations", 0) + spent_operations,
        "parameters": sum(x.size for x in jax.tree.leaves(trained["params"])),
        "cpu_seconds": row.get("cpu_seconds", 0.0) + spent,
    }


def operations(config: TrainConfig, source: Any, networks: Any) -> int:
    """Returns the operations of a training step, forwards and backwards, as its program is
    written.
    """
    state = jax.eval_shape(lambda: init_state(config))
    body = gaussian_body(load_body(), config.model)
    step = functools.partial(update, config=compiled_for(config))
    batch = stage_loader(source, config, 0).batch_at(0)
    return costs_of(jax.jit(step).trace(state, batch, body, networks, seed_numbers(0))).flops


def network(variables: Any, model: HumanGSConfig) -> Method:
    """Returns a network as a method that `evaluate` scores."""
    return lambda case, background: shown((variables, model), case, background)[0]


def painted(case: Any, background: float) -> Predicted:
    """Draws the vertex-color baseline: a vertex has the mean color of the photos that see it, and
    is grey where none does.
    """
    images = draw_painted_body(painted_body(case.inputs), case.truth)
    return Predicted(np.clip(images, 0, 1), None, tuple(range(len(images))))


def tested(method: Method, people: Path, count: int, moves: bool = True) -> dict[str, Any]:
    """Scores a method from `count` photos on the people of a folder with held_out/.

    Returns {task: {score: a number for each person}}. Animation is left out if `moves` is false.
    """
    rows = evaluate(people, method=method, inputs=count, protocol=PROTOCOL).rows
    found = {}
    for task, first in zip(TASKS, (True, False), strict=True):
        means = person_means([row for row in rows if (row.frame == 0) == first]).values()
        if first or moves:
            for name in SCORES:
                known = (row[name] for row in means)
                rounded = [round(x, 4) for x in known if x is not None]
                found.setdefault(task, {})[name] = rounded
    return found


# Differences
# --------------------------------------------------------------------------------------------------


class Difference(NamedTuple):
    """The difference between two variants, in the unit of a score."""

    mean: float
    """Mean difference over the people."""
    half: float | None
    """Half of the 95 % interval, None where there is no second seed."""
    seeds: tuple[int, int]
    """Number of seeds of both variants."""
    people: int
    """Number of people."""

    def text(self, digits: int = 2) -> str:
        """Formats the mean, and half of the interval where it is known."""
        mean = f"{self.mean:+.{digits}f}"
        return mean if self.half is None else f"{mean} +-{self.half:.{digits}f}"

    __str__ = text


def difference(
    runs: Mapping[str, Any],
    a: tuple[str, int | str],
    b: tuple[str, int | str],
    task: str = "reconstruction",
    score: str = "psnr_fg",
) -> Difference:
    """Returns the difference between two variants over the same people.

    A variant is given as (name, test), see `tests_of`. The variance is the sum of that over people
    of the paired differences, and that of seeds, which is pooled over all variants with several
    seeds. The interval is that of Student's t with the degrees of freedom of Welch and
    Satterthwaite.
    """

    def values(name, photos):
        return np.asarray([x["scores"][str(photos)][task][score] for x in finished(runs, name)])

    # differences paired by person, between means over the seeds
    first, second = values(*a), values(*b)
    paired = first.mean(axis=0) - second.mean(axis=0)
    people = np.var(paired, ddof=1) / len(paired)
    seeds, freedom = seed_variance(runs, task, score)
    count = len(first), len(second)
    if not freedom:
        return Difference(float(paired.mean()), None, count, len(paired))

    # Welch's variance and Satterthwaite's degrees of freedom
    seeds = seeds * (1 / count[0] + 1 / count[1])
    total = people + seeds
    degrees = 1.0
    if total:
        degrees = total**2 / (people**2 / (len(paired) - 1) + seeds**2 / freedom)
    half = float(student.ppf(0.975, degrees) * np.sqrt(total))
    return Difference(float(paired.mean()), half, count, len(paired))


def seed_variance(runs: Mapping[str, Any], task: str, score: str) -> tuple[float, int]:
    """Returns the variance of a run's mean over its seeds, and the degrees of freedom."""
    squares, freedom = 0.0, 0
    for name in runs:
        scores = [headline(run) for run in finished(runs, name)]
        means = [np.mean(own[task][score]) for own in scores if task in own]
        if len(means) > 1:
            squares += np.var(means) * len(means)
            freedom += len(means) - 1
    return (squares / freedom if freedom else 0.0), freedom


def finished(runs: Mapping[str, Any], name: str) -> list[dict[str, Any]]:
    """Returns the runs of a variant that have test scores, in the order of their seeds."""
    return [row for _, row in sorted(runs.get(name, {}).items()) if "scores" in row]


def headline(row: Mapping[str, Any]) -> dict[str, Any]:
    """Returns the scores of a run with as many photos as it was trained with."""
    return row["scores"][str(row["photos"])]


def is_trained(row: Mapping[str, Any], painted: float) -> bool:
    """Whether a run is done, `meets` the criterion, and is still above the vertex colors after its
    perceptual steps.

    `painted` is the foreground PSNR of the vertex-color baseline, dB.
    """
    return row["done"] and meets(row["curve"], painted) and row["validation"] > painted


def state_of(report: Mapping[str, Any], name: str) -> str:
    """Describes the state of a variant that has no trained run with scores."""
    rows, painted = list(report["runs"].get(name, {}).values()), report["painted"]["validation"]
    how = "trained, not scored" if any(is_trained(row, painted) for row in rows) else NOT_TRAINED
    return f"{how}: {max((row['steps'] for row in rows), default=0)} steps"


def trained_names(report: Mapping[str, Any]) -> list[str]:
    """Returns the variants of which a run is trained and has scores."""
    painted = report["painted"]["validation"]
    return [
        name
        for name, own in report["runs"].items()
        if any("scores" in x and is_trained(x, painted) for x in own.values())
    ]


def results(name: str) -> Any:
    """Returns the unrounded numbers of docs/results/NAME.json."""
    return json.loads((PAGE.parent / "results" / f"{name}.json").read_text())["numbers"]


# Trained systems
# --------------------------------------------------------------------------------------------------


def folder_of(name: str) -> str:
    """Returns the name of the folder of a variant inside OUT."""
    return name.replace(" ", "_").replace(",", "").replace("+", "and")


def last_weights(run: Path) -> Path:
    """Returns the weights of the last round of a run."""
    return max(run.glob("*/weights.safetensors"), key=lambda path: int(path.parent.name))


def shown(weights: tuple[Any, Any], case: Any, background: float = 1.0) -> tuple[Any, float, float]:
    """Draws what a system shows of a `Case`.

    Returns the images as `Predicted`, the seconds to model the person, and the seconds to draw all
    views. A system that runs for each target models in 0 seconds.
    """
    start = modelled = time.perf_counter()
    driver = weights[1].architecture.driver
    if driver is not None:
        images, alpha = driver.show(*weights, case.inputs, case.truth, background)
        predicted = Predicted(images, alpha, tuple(range(case.truth.view_count)))
    else:
        avatar = jax.block_until_ready(reconstruct(*weights, case.inputs))
        modelled, predicted = time.perf_counter(), predict_views(avatar, case.truth, background)
    return predicted, modelled - start, time.perf_counter() - modelled


def takes_one(config: Any) -> bool:
    """Whether a system refuses a second photo."""
    reader = config.architecture.reader
    return isinstance(reader, GroupReader) or getattr(reader, "most_views", None) == 1


def animatable(config: Any) -> bool:
    """Whether a system can show a pose that no photo shows."""
    return getattr(config.architecture.driver, "moves", True)
