"""Makes the paper's tables with our rows beside the printed ones, on real data or synthetic people.

The numbers are PSNR / SSIM / LPIPS by the protocol of the paper. Printed rows are marked. They come
from the paper's data and training, so our rows cannot be compared with them. Our rows are weights
of any run or checkpoint, trained variants of the bench, and the shipped weights. A network that
takes one photo gets the first one.
"""

import dataclasses
import functools
from collections.abc import Callable, Collection, Sequence
from pathlib import Path
from typing import Any

import jax

from experiments.harness import Run, entry
from experiments.paper.bench import PHOTOS, REFERENCE, takes_one, variants
from experiments.paper.rows import (
    ANIMATION,
    DOMAINS,
    GAUSSIANS,
    PAPER,
    RECONSTRUCTION,
    VIEWS,
    measured,
    trained,
    triple,
    views_of,
)
from experiments.results import markdown_table, significant
from experiments.subjects import file_digest
from humangs_jax.core.processes import enable_compile_cache
from humangs_jax.data.datasets.scene_list import read_evaluation
from humangs_jax.data.datasets.subject import FileBody
from humangs_jax.losses.loss_networks import load_loss_networks
from humangs_jax.training.config import read_config
from humangs_jax.training.loop import train
from humangs_jax.training.sources import people_on_disk

COUNTS = (1, 2, 4, 6)
K_VARIANTS = ("1 Gaussian a vertex", REFERENCE)
Measure = Callable[..., Any]
"""Function (name, people, photos, whether the photos show other poses) -> what `rows.measured`
returns, or None. Each combination is measured once.
"""


@dataclasses.dataclass(frozen=True)
class Compared:
    """Options:
    data: captures with held_out/, or any data set (docs/datasets.md)
    body: body model of a data set
    indices: JSON file with the views of each person of --data, "context" and "target"; default:
        evaluation_N.json beside a scene list, else evenly spaced ones
    weights: rows, NAME=FILE: runs of `humangs train`, checkpoints after `humangs convert`
    runs: the OUT of `paper`, whose trained variants are rows, too
    other: people of other kinds
    near: people seen by nearer cameras
    train: folder of a run on the data set --train-on, which is trained first, or continued; it is
        a row
    train_on: the people of that run
    config: configuration of that run, a preset or a JSON file
    vgg19: weights of the perceptual loss of that run
    """

    data: Path | None = None
    body: Path | None = None
    indices: Path | None = None
    weights: tuple[str, ...] = ()
    runs: Path | None = None
    other: tuple[Path, ...] = ()
    near: Path | None = None
    train: Path | None = None
    train_on: Path | None = None
    config: str = "paper"
    vgg19: Path | None = None


@entry
def tables(run: Run, options: Compared = Compared(), only: tuple[str, ...] = ()) -> None:
    """Makes the paper's tables with our rows beside the printed ones, on real data or synthetic
    people.

    "animation" is table 1, with inputs of varying poses, and novel poses and views.
    "reconstruction" is table 2, with views in the pose of the photos and in others. "domains" is
    table 3, with people like those of training and of other kinds. "views" has 1, 2, 4 and 6
    photos, from cameras at the distance of training and nearer. "gaussians" compares 1 with 1 + 4
    Gaussians a vertex, on all of these people.

    Options:
    only: which tables
    """
    unknown = set(only) - set(TABLES)
    if unknown:
        raise ValueError(f"--only {unknown.pop()}: expected some of {', '.join(TABLES)}")
    if options.data is None:
        raise ValueError("--data is needed: the people that the weights are measured on")
    enable_compile_cache()
    given = options.weights
    if options.train:
        given += train_first(options)
    systems = trained(options.runs, given)
    lpips = load_loss_networks(lpips_net="vgg", installed=True).lpips
    settings, numbers = settings_of(options, given), {}

    def measure(
        name: str, people: Path | None, photos: int, varying: bool = False
    ) -> dict[str, Any] | None:
        if people is None or name not in systems:
            return None
        if takes_one(systems[name][1]) and photos == PHOTOS:
            photos = 1
        key = f"{name}, {title(people)}, {photos}"
        if varying:
            key += ", varying poses"
        if key in numbers:
            return numbers[key]

        # views of a given file, of a file beside the scene list, or chosen here
        fixed, beside = None, people.with_name(f"evaluation_{photos}.json")
        if people == options.data and photos == PHOTOS:
            fixed = options.indices
        if not fixed and not varying and people.suffix == ".json" and beside.is_file():
            fixed = beside
        if fixed:
            views = read_evaluation(fixed)
        else:
            views = views_of(people, photos, options.body, varying)
        networks = () if lpips is None else (lpips,)
        one = functools.partial(
            measured, systems[name], people, photos, options.body, networks, views
        )
        numbers.update(run.rows({key: one}, settings))
        # programs map memory, and Linux ends a process with too many mappings
        jax.clear_caches()
        return numbers[key]

    # rows of the networks that are systems, and not variants of the reference
    left_out = {name for name, variant in variants().items() if variant.about}
    names = [name for name in systems if name not in left_out]
    texts = [f"**{name}**\n\n{TABLES[name](names, measure, options)}" for name in only or TABLES]
    rows: dict[str, Any] = dict.fromkeys(numbers)
    for key, row in numbers.items():
        if row is not None:
            rows[key] = {name: shown(x) for name, x in row.items()}
    run.show("\n\n".join(texts), {"settings": settings, "rows": rows})


def train_first(options: Compared) -> tuple[str, ...]:
    """Trains the configuration of the options, or continues its run, and returns its weights as
    (NAME=FILE,).

    Raises: ValueError without people, or without VGG-19 where the loss needs it.
    """
    config, out, people = read_config(options.config), options.train, options.train_on
    if people is None or out is None:
        raise ValueError("--train needs --train-on: the people that the network learns from")
    if config.loss.perceptual and options.vgg19 is None:
        raise ValueError(
            f"--config {options.config} has the perceptual loss: it needs --vgg19"
            " (docs/loss_networks.md)"
        )
    body = FileBody.load(options.body)
    train(
        config,
        body.model,
        people_on_disk(people, body),
        out,
        networks=load_loss_networks(options.vgg19),
    )
    return (f"{out.name}={out / 'weights.safetensors'}",)


def title(people: Path) -> str:
    """Returns the name of people: that of their folder, or of the folder of a scene list."""
    return people.parent.name if people.suffix == ".json" else people.name


def settings_of(options: Compared, given: Collection[str]) -> dict[str, Any]:
    """Returns what the numbers depend on: the weights and the people.

    Raises: ValueError if two folders of people have one name, because rows are kept by name.
    """
    names = sorted(title(path) for path in {options.data, options.near, *options.other} if path)
    if len(set(names)) < len(names):
        raise ValueError(
            f"people in folders of one name: {', '.join(names)}: expected a name for each"
        )
    weights = {}
    for text in given:
        name, _, file = text.partition("=")
        weights[name] = file_digest(Path(file))
    runs, indices = None, None
    if options.runs:
        runs = file_digest(options.runs / "results.json")
    if options.indices:
        indices = file_digest(options.indices)
    return {"weights": weights, "runs": runs, "indices": indices, "people": names}


def shown(value: Any) -> Any:
    """Returns the scores that the tables have, or a value that is no scores unchanged."""
    if isinstance(value, dict):
        return [value[name] for name in ("psnr", "ssim", "lpips_vgg")]
    return value


# The tables: (names of our rows, measure, options) -> Markdown
# ---------------------------------------------------------


def ours(
    names: Sequence[str],
    measure: Measure,
    columns: Sequence[tuple[Path | None, int, str]],
    cameras: str = "",
) -> list[list[str]]:
    """Returns our rows: a name, its number of photos, and the scores of each column.

    Networks without a score in the first column are left out.

    Args:
        names: the networks
        measure: see `Measure`
        columns: (people, photos, task) of each column; the task "varying" is animation from photos
            of other poses
        cameras: text to show instead of the number of photos; then a network that takes one photo
            has scores only where the column has one
    """
    rows = []
    for name in names:
        found = [
            measure(name, people, photos, varying=task == "varying")
            for people, photos, task in columns
        ]
        if not found[0]:
            continue
        # a column without a measured row, or with one of another number of photos, has a dash
        cells, count = [], found[0]["photos"]
        for row, (_, photos, task) in zip(found, columns, strict=True):
            scores = None
            if row and (not cameras or row["photos"] == photos):
                scores = row["animation" if task == "varying" else task]
            cells.append(triple(scores))
        given = "1 photo" if count == 1 else f"{count} photos"
        rows.append([name, cameras or given, *cells])
    return rows


def animation(names: list[str], measure: Measure, options: Any) -> str:
    """Makes table 1: animation from photos of varying poses."""

    def seconds(value):
        return "-" if value is None else significant(value)

    rows = [[name, PAPER, triple(x[:3]), *map(seconds, x[3:])] for name, x in ANIMATION.items()]
    for row in ours(names, measure, [(options.data, PHOTOS, "varying")]):
        found = measure(row[0], options.data, PHOTOS, varying=True)
        rows.append([*row, seconds(found["model_s"]), seconds(found["frame_s"])])
    return markdown_table(
        ["method", "", "PSNR / SSIM / LPIPS", "modelling s", "synthesis s"], rows, "llrrr"
    )


def reconstruction(names: list[str], measure: Measure, options: Any) -> str:
    """Makes table 2: reconstruction, and reconstruction with animation."""
    rows = [[name, PAPER, *map(triple, x)] for name, x in RECONSTRUCTION.items()]
    rows += ours(
        names, measure, [(options.data, PHOTOS, task) for task in ("reconstruction", "animation")]
    )
    return markdown_table(
        ["method", "", "reconstruction", "reconstruction + animation"], rows, "llrr"
    )


def domains(names: list[str], measure: Measure, options: Any) -> str:
    """Makes table 3: people like those of training, and of other kinds."""
    others = options.other or [None]
    rows = [
        [name, PAPER, *map(triple, x), *[""] * (len(others) - 1)] for name, x in DOMAINS.items()
    ]
    rows += ours(
        names, measure, [(people, PHOTOS, "reconstruction") for people in (options.data, *others)]
    )
    heads = [f"cross-domain: {title(people)}" if people else "cross-domain" for people in others]
    return markdown_table(["method", "", "in domain", *heads], rows, "llr" + "r" * len(heads))


def views(names: list[str], measure: Measure, options: Any) -> str:
    """Makes the table of numbers of photos, by the distance of the cameras."""
    rows = [[name, f"{PAPER}, near", *map(triple, x)] for name, x in VIEWS.items()]
    for cameras, people in (("standard", options.data), ("near", options.near)):
        rows += ours(
            names, measure, [(people, count, "reconstruction") for count in COUNTS], cameras
        )
    return markdown_table(["method", "cameras", *map(str, COUNTS)], rows, "ll" + "r" * len(COUNTS))


def gaussians(names: list[str], measure: Measure, options: Any) -> str:
    """Makes the table of Gaussians a vertex, on all sets of people that are given."""
    sets = [people for people in (options.data, options.near, *options.other) if people]
    kinds = enumerate(("1", "1 tight + 4 free"))
    rows = [
        [f"{k}, {name}", PAPER, triple(x[i]), *[""] * (len(sets) - 1)]
        for i, k in kinds
        for name, x in GAUSSIANS.items()
    ]
    rows += ours(
        list(dict.fromkeys((*K_VARIANTS, *names))),
        measure,
        [(people, PHOTOS, "reconstruction") for people in sets],
    )
    return markdown_table(
        ["Gaussians a vertex", "", *map(title, sets)], rows, "ll" + "r" * len(sets)
    )


TABLES: dict[str, Callable[[list[str], Measure, Any], str]] = {
    each.__name__: each for each in (animation, reconstruction, domains, views, gaussians)
}
