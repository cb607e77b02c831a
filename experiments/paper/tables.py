"""The paper's tables with our rows beside the printed ones.

PSNR / SSIM / LPIPS by the protocol of the paper; LPIPS needs weights. Printed rows say so and are of the paper's data and
training: they are no measure of ours. Systems are those whose training is finished, and the shipped weights; those that take one
photo get the first; those that docs/paper.md calls not trained are marked.
"""

import dataclasses
import functools
import tempfile
from collections.abc import Callable, Collection, Mapping
from pathlib import Path
from typing import Any

import jax

from experiments.harness import Run, entry
from experiments.paper.bench import (
    ABLATIONS,
    ANIMATION,
    DOMAINS,
    GAUSSIANS,
    NOT_TRAINED,
    ONE_PHOTO,
    PAPER,
    PHOTOS,
    RECONSTRUCTION,
    SHIPPED,
    VIEWS,
    Tested,
    load_networks,
    measured,
    takes_one,
    trained,
    triple,
    untrained_on_the_page,
)
from experiments.results import markdown_table, significant
from experiments.subjects import file_digest
from humangs_jax.evaluation.tables import mean_scores
from humangs_jax.io.reading import read_json

COUNTS = (1, 2, 4, 6)
SPLIT = ", on the other split"
"""End of the names of systems that were trained on other people."""
K_VARIANTS = ("1 Gaussian a vertex", "humangs", "1 + 4 Gaussians a vertex", "1 + 8 Gaussians a vertex")
Measure = Callable[[str, Path | None, int], dict[str, Any] | None]
"""(system, people, photos) -> what `bench.measured` gives; each is measured once."""


@dataclasses.dataclass(frozen=True)
class Compared(Tested):
    """Options:
    runs: the OUT of `paper`; without it the shipped weights alone
    people: captures with held_out/, or any data set (docs/datasets.md)
    body: body model of a data set
    lpips: weights of LPIPS vgg: BACKBONE and HEADS
    quick: two synthetic people of 128 pixels, made in a minute
    other: folders of people of other kinds
    split: another division of the people: RUNS, and PEOPLE whom they have not seen
    near: people seen by nearer cameras
    fits: the OUT of `paper_fits`, for table 1
    """

    other: tuple[Path, ...] = ()
    split: tuple[Path, ...] = ()
    near: Path | None = None
    fits: Path | None = None

    @property
    def gray(self) -> list[str]:
        """Systems that are not trained."""
        return untrained_on_the_page()


@entry
def paper_tables(run: Run, options: Compared = Compared(), only: tuple[str, ...] = ()) -> None:
    """The paper's tables with our rows beside the printed ones.

    animation: table 1, novel poses and views; reconstruction: table 2, views in the pose of the photos, and in others; domains:
    table 3, people like those of training, and of other kinds; systems that were trained on another division of the people;
    views: 1, 2, 4 and 6 photos, cameras at the distance of training and nearer; gaussians: 1 against 1 + 4 and 1 + 8 Gaussians a
    vertex.

    Options:
    only: which tables
    """
    with tempfile.TemporaryDirectory() as folder:
        options = options.with_people(Path(folder))
        systems, networks = trained(options.runs), load_networks(options.lpips)
        if options.split:
            others = trained(options.split[0])
            systems |= {f"{name}{SPLIT}": others[name] for name in others if name != SHIPPED}
        settings, numbers = settings_of(options), {}

        def measure(name: str, people: Path | None, photos: int) -> dict[str, Any] | None:
            if people is None or name not in systems:
                return None
            alone = takes_one(systems[name][1]) or name.endswith(ONE_PHOTO)
            photos = 1 if alone and photos == PHOTOS else photos
            key = f"{name}, {people.name}, {photos}"
            if key not in numbers:
                one = functools.partial(measured, systems[name], people, photos, options.body, networks)
                numbers.update(run.rows({key: one}, settings))
                jax.clear_caches()  # programs map memory, and Linux ends a process with too many mappings
            return numbers[key]

        names = [name for name in systems if not any(mark in name for mark in (*ABLATIONS, SPLIT))]
        texts = [f"**{name}**\n\n{TABLES[name](names, measure, options)}" for name in only or TABLES]
    rows = {key: row and {name: shown(x) for name, x in row.items()} for key, row in numbers.items()}
    run.show("\n\n".join(texts), {"settings": settings, "rows": rows})


def shown(value: Any) -> Any:
    """Of the scores, those that the tables have."""
    return [value[name] for name in ("psnr", "ssim", "lpips_vgg")] if isinstance(value, dict) else value


def settings_of(arguments: Any) -> dict[str, Any]:
    """What decides the numbers: the weights and the people."""
    runs = [path for path in (arguments.runs, arguments.split and arguments.split[0]) if path]
    folders = [arguments.people, arguments.near, *arguments.other, arguments.split and arguments.split[1]]
    return {
        "runs": {path.name: file_digest(path / "results.json") for path in runs},
        "people": [path.name for path in folders if path],
        "lpips": bool(arguments.lpips),
    }


def of(found: Mapping[str, Any] | None, task: str) -> str:
    """Scores of one task as text."""
    return "-" if found is None else triple(found[task])


def photos_of(found: Mapping[str, Any], name: str, gray: Collection[str]) -> str:
    """How many a system got, and whether it is one of those that are not trained."""
    count = "1 photo" if found["photos"] == 1 else f"{found['photos']} photos"
    return f"{count}, {NOT_TRAINED}" if name in gray else count


def seconds(value: float | None) -> str:
    """A time, or a dash."""
    return "-" if value is None else significant(value)


def animation(names: list[str], measure: Measure, arguments: Any) -> str:
    """Table 1."""
    rows = [[name, PAPER, triple(x[:3]), seconds(x[3]), seconds(x[4])] for name, x in ANIMATION.items()]
    for name in names:
        found = measure(name, arguments.people, PHOTOS)
        if found is not None:
            rows.append([name, photos_of(found, name, arguments.gray), of(found, "animation"), "", ""])
    text = markdown_table(["method", "", "PSNR / SSIM / LPIPS", "modelling s", "synthesis s"], rows, "llrrr")
    return f"{text}\n\n{fitted(read_json(arguments.fits)['numbers']['paper_fits'].values())}" if arguments.fits else text


def fitted(fits: Collection[Mapping[str, Any]]) -> str:
    """The system that is fitted to one person: other people and many more photos, so no row among the others."""
    scores = triple(mean_scores(fit["animation"] for fit in fits))
    row = ["animatable", f"fitted to each of {len(fits)} other people", scores]
    return markdown_table(["fitted to one person", "", "PSNR / SSIM / LPIPS"], [row], "llr")


def reconstruction(names: list[str], measure: Measure, arguments: Any) -> str:
    """Table 2."""
    rows = [[name, PAPER, *map(triple, x)] for name, x in RECONSTRUCTION.items()]
    for name in names:
        found = measure(name, arguments.people, PHOTOS)
        if found is not None:
            rows.append([name, photos_of(found, name, arguments.gray), of(found, "reconstruction"), of(found, "animation")])
    return markdown_table(["method", "", "reconstruction", "reconstruction + animation"], rows, "llrr")


def domains(names: list[str], measure: Measure, arguments: Any) -> str:
    """Table 3."""
    others = arguments.other or [None]
    rows = [[name, PAPER, *map(triple, x), *[""] * (len(others) - 1)] for name, x in DOMAINS.items()]
    for name in names:
        found = [measure(name, people, PHOTOS) for people in (arguments.people, *others)]
        if found[0] is not None:
            rows.append([name, photos_of(found[0], name, arguments.gray), *(of(x, "reconstruction") for x in found)])
        if arguments.split and (x := measure(f"{name}{SPLIT}", arguments.split[1], PHOTOS)) is not None:
            rows.append([f"{name}{SPLIT}", photos_of(x, name, arguments.gray), of(x, "reconstruction"), *["-" for _ in others]])
    heads = [f"cross-domain: {people.name}" if people else "cross-domain" for people in others]
    return markdown_table(["method", "", "in domain", *heads], rows, "llr" + "r" * len(heads))


def views(names: list[str], measure: Measure, arguments: Any) -> str:
    """Numbers of photos."""
    rows = [[name, f"{PAPER}, near", *map(triple, x)] for name, x in VIEWS.items()]
    several = [name for name in names if not name.endswith(ONE_PHOTO)]
    for kind, people in (("standard", arguments.people), ("near", arguments.near)):
        for name in several:
            each = [measure(name, people, count) for count in COUNTS]
            # those that take one photo are measured with it, whatever is asked for
            found = [
                of(row if row and row["photos"] == count else None, "reconstruction")
                for count, row in zip(COUNTS, each, strict=True)
            ]
            if set(found) != {"-"}:
                mark = f", {NOT_TRAINED}" if name in arguments.gray else ""
                rows.append([name, f"{kind}{mark}", *found])
    return markdown_table(["method", "cameras", *map(str, COUNTS)], rows, "ll" + "r" * len(COUNTS))


def gaussians(names: list[str], measure: Measure, arguments: Any) -> str:
    """Gaussians a vertex."""
    rows = [[f"1, {name}", PAPER, triple(one)] for name, (one, _) in GAUSSIANS.items()]
    rows += [[f"1 tight + 4 free, {name}", PAPER, triple(five)] for name, (_, five) in GAUSSIANS.items()]
    for name in K_VARIANTS:
        found = measure(name, arguments.people, PHOTOS)
        if found is not None:
            rows.append([name, photos_of(found, name, arguments.gray), of(found, "reconstruction")])
    return markdown_table(["Gaussians a vertex", "", "PSNR / SSIM / LPIPS"], rows, "llr")


TABLES: dict[str, Callable[[list[str], Measure, Any], str]] = {
    "animation": animation,
    "reconstruction": reconstruction,
    "domains": domains,
    "views": views,
    "gaussians": gaussians,
}
