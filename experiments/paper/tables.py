"""The paper's tables with our rows beside the printed ones, on real data or synthetic people.

PSNR / SSIM / LPIPS by the protocol of the paper. Printed rows say so and are of the paper's data and training: they are no
measure of ours. Rows are weights of any run or checkpoint, variants of the bench that are trained, and the shipped weights; those
that take one photo get the first.
"""

import dataclasses
import functools
import tempfile
from collections.abc import Callable, Collection, Mapping
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
    Tested,
    load_networks,
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
from humangs_jax.evaluation.scores import mean_scores
from humangs_jax.io.reading import read_json
from humangs_jax.losses.loss_networks import load_loss_networks
from humangs_jax.training.config import read_config
from humangs_jax.training.loop import train
from humangs_jax.training.sources import people_on_disk

COUNTS = (1, 2, 4, 6)
SPLIT = ", on the other split"
"""End of the names of systems that were trained on other people."""
K_VARIANTS = ("1 Gaussian a vertex", REFERENCE)
Measure = Callable[..., dict[str, Any] | None]
"""(name, people, photos, whether these show other poses) -> what `bench.measured` gives; each is measured once."""


@dataclasses.dataclass(frozen=True)
class Compared(Tested):
    """Options:
    other: people of other kinds
    near: people seen by nearer cameras
    split: another division: people whom the rows NAME=FILE that follow have not seen
    fits: the OUT of `paper_fits`, for table 1
    times: measure the times of table 1; first people compile
    train: folder of a run on the data set --train-on, which comes first, or goes on there: a row
    train_on: the people of that run
    config: of that run, a preset or a JSON file
    vgg19: weights of its perceptual loss
    """

    other: tuple[Path, ...] = ()
    near: Path | None = None
    split: tuple[str, ...] = ()
    fits: Path | None = None
    times: bool = False
    train: Path | None = None
    train_on: Path | None = None
    config: str = "paper"
    vgg19: Path | None = None


@entry
def tables(run: Run, options: Compared = Compared(), only: tuple[str, ...] = ()) -> None:
    """The paper's tables with our rows beside the printed ones, on real data or synthetic people.

    animation: table 1, inputs of varying poses, novel poses and views; reconstruction: table 2, views in the pose of the photos,
    and in others; domains: table 3, people like those of training, of other kinds, of another division; views: 1, 2, 4 and 6
    photos, cameras at the distance of training and nearer; gaussians: 1 against 1 + 4 Gaussians a vertex, on all of these people.

    Options:
    only: which tables
    """
    if unknown := set(only) - set(TABLES):
        raise ValueError(f"--only {unknown.pop()}: expected some of {', '.join(TABLES)}")
    enable_compile_cache()
    with tempfile.TemporaryDirectory() as folder:
        options = options.with_people(Path(folder))
        given = options.weights + (train_first(options) if options.train else ())
        systems, networks = trained(options.runs, given), load_networks(options.lpips)
        if options.split:
            systems |= {f"{name}{SPLIT}": x for name, x in trained(None, options.split[1:]).items()}
        settings, numbers = settings_of(options, given), {}

        def measure(name: str, people: Path | None, photos: int, varying: bool = False) -> dict[str, Any] | None:
            if people is None or name not in systems:
                return None
            photos = 1 if takes_one(systems[name][1]) and photos == PHOTOS else photos
            key = f"{name}, {title(people)}, {photos}{', varying poses' if varying else ''}"
            if key not in numbers:
                fixed = options.indices if people == options.data and photos == PHOTOS else None
                beside = people.with_name(f"evaluation_{photos}.json")
                if not fixed and not varying and people.suffix == ".json" and beside.is_file():
                    fixed = beside
                views = read_evaluation(fixed) if fixed else views_of(people, photos, options.body, varying)
                one = functools.partial(measured, systems[name], people, photos, options.body, networks, views)
                numbers.update(run.rows({key: one}, settings))
                jax.clear_caches()  # programs map memory, and Linux ends a process with too many mappings
            return numbers[key]

        left_out = {name for name, variant in variants().items() if variant.about}
        names = [name for name in systems if name not in left_out and SPLIT not in name]
        texts = [f"**{name}**\n\n{TABLES[name](names, measure, options)}" for name in only or TABLES]
    rows = {key: row and {name: shown(x) for name, x in row.items()} for key, row in numbers.items()}
    run.show("\n\n".join(texts), {"settings": settings, "rows": rows})


def train_first(options: Compared) -> tuple[str, ...]:
    """Train the configuration, or go on there; its row. Raises: ValueError without people or VGG-19 where the loss needs it."""
    config, out, people = read_config(options.config), options.train, options.train_on
    if people is None or out is None:
        raise ValueError("--train needs --train-on: the people that the network learns from")
    if config.loss.perceptual and options.vgg19 is None:
        raise ValueError(f"--config {options.config} has the perceptual loss: it needs --vgg19 (docs/loss_networks.md)")
    body = FileBody.load(options.body)
    networks = load_loss_networks(options.vgg19)
    train(config, body.model, people_on_disk(people, body), out, networks=networks)
    return (f"{out.name}={out / 'weights.safetensors'}",)


def title(people: Path) -> str:
    """The name of people: that of their folder, also of a scene list."""
    return people.parent.name if people.suffix == ".json" else people.name


def settings_of(options: Compared, given: Collection[str]) -> dict[str, Any]:
    """What decides the numbers: the weights and the people. Raises: ValueError for people of one name, by which rows are kept."""
    files = {name: file_digest(Path(file)) for name, _, file in (x.partition("=") for x in (*given, *options.split[1:]))}
    folders = {path for path in (options.data, options.near, *options.other, *map(Path, options.split[:1])) if path}
    names = sorted(map(title, folders))
    if len(set(names)) < len(names):
        raise ValueError(f"people in folders of one name: {', '.join(names)}: expected a name for each")
    return {
        "weights": files,
        "runs": file_digest(options.runs / "results.json") if options.runs else None,
        "indices": file_digest(options.indices) if options.indices else None,
        "people": names,
    }


def shown(value: Any) -> Any:
    """Of the scores, those that the tables have."""
    return [value[name] for name in ("psnr", "ssim", "lpips_vgg")] if isinstance(value, dict) else value


def of(found: Mapping[str, Any] | None, task: str) -> str:
    """Scores of one task as text."""
    return "-" if found is None else triple(found[task])


def photos_of(found: Mapping[str, Any]) -> str:
    """How many a system got."""
    return "1 photo" if found["photos"] == 1 else f"{found['photos']} photos"


def seconds(value: float | None) -> str:
    """A time, or a dash."""
    return "-" if value is None else significant(value)


def animation(names: list[str], measure: Measure, options: Any) -> str:
    """Table 1."""
    rows = [[name, PAPER, triple(x[:3]), seconds(x[3]), seconds(x[4])] for name, x in ANIMATION.items()]
    for name in names:
        found = measure(name, options.data, PHOTOS, varying=True)
        if found is not None:
            times = [seconds(found[key]) if options.times else "" for key in ("model_s", "frame_s")]
            rows.append([name, photos_of(found), of(found, "animation"), *times])
    text = markdown_table(["method", "", "PSNR / SSIM / LPIPS", "modelling s", "synthesis s"], rows, "llrrr")
    return f"{text}\n\n{fitted(read_json(options.fits)['numbers']['paper_fits'].values())}" if options.fits else text


def fitted(fits: Collection[Mapping[str, Any]]) -> str:
    """The system that is fitted to one person: other people and many more photos, so no row among the others."""
    scores = triple(mean_scores(fit["animation"] for fit in fits))
    row = ["animatable", f"fitted to each of {len(fits)} other people", scores]
    return markdown_table(["fitted to one person", "", "PSNR / SSIM / LPIPS"], [row], "llr")


def reconstruction(names: list[str], measure: Measure, options: Any) -> str:
    """Table 2."""
    rows = [[name, PAPER, *map(triple, x)] for name, x in RECONSTRUCTION.items()]
    for name in names:
        found = measure(name, options.data, PHOTOS)
        if found is not None:
            rows.append([name, photos_of(found), of(found, "reconstruction"), of(found, "animation")])
    return markdown_table(["method", "", "reconstruction", "reconstruction + animation"], rows, "llrr")


def domains(names: list[str], measure: Measure, options: Any) -> str:
    """Table 3."""
    others = options.other or [None]
    rows = [[name, PAPER, *map(triple, x), *[""] * (len(others) - 1)] for name, x in DOMAINS.items()]
    for name in names:
        found = [measure(name, people, PHOTOS) for people in (options.data, *others)]
        if found[0] is not None:
            rows.append([name, photos_of(found[0]), *(of(x, "reconstruction") for x in found)])
    for name, _, _ in (x.partition("=") for x in options.split[1:]):
        if (x := measure(f"{name}{SPLIT}", Path(options.split[0]), PHOTOS)) is not None:
            rows.append([f"{name}{SPLIT}", photos_of(x), of(x, "reconstruction"), *["-" for _ in others]])
    heads = [f"cross-domain: {title(people)}" if people else "cross-domain" for people in others]
    return markdown_table(["method", "", "in domain", *heads], rows, "llr" + "r" * len(heads))


def views(names: list[str], measure: Measure, options: Any) -> str:
    """Numbers of photos."""
    rows = [[name, f"{PAPER}, near", *map(triple, x)] for name, x in VIEWS.items()]
    for kind, people in (("standard", options.data), ("near", options.near)):
        for name in names:
            each = [measure(name, people, count) for count in COUNTS]
            # those that take one photo are measured with it, whatever is asked for
            found = [
                of(row if row and row["photos"] == count else None, "reconstruction")
                for count, row in zip(COUNTS, each, strict=True)
            ]
            if set(found) != {"-"}:
                rows.append([name, kind, *found])
    return markdown_table(["method", "cameras", *map(str, COUNTS)], rows, "ll" + "r" * len(COUNTS))


def gaussians(names: list[str], measure: Measure, options: Any) -> str:
    """Gaussians a vertex, on as many sets as there are: those of training, near ones, others."""
    sets = [people for people in (options.data, options.near, *options.other) if people]
    rows = [[f"1, {name}", PAPER, triple(one), *[""] * (len(sets) - 1)] for name, (one, _) in GAUSSIANS.items()]
    rows += [[f"1 tight + 4 free, {name}", PAPER, triple(five), *[""] * (len(sets) - 1)] for name, (_, five) in GAUSSIANS.items()]
    for name in dict.fromkeys((*K_VARIANTS, *names)):
        found = [measure(name, people, PHOTOS) for people in sets]
        if found[0] is not None:
            rows.append([name, photos_of(found[0]), *(of(x, "reconstruction") for x in found)])
    return markdown_table(["Gaussians a vertex", "", *map(title, sets)], rows, "ll" + "r" * len(sets))


TABLES: dict[str, Callable[[list[str], Measure, Any], str]] = {
    "animation": animation,
    "reconstruction": reconstruction,
    "domains": domains,
    "views": views,
    "gaussians": gaussians,
}
