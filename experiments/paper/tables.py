"""The paper's tables with our rows beside the printed ones.

    python experiments/paper/tables.py --quick                                                 # minutes, synthetic people
    python experiments/paper/tables.py --runs runs/paper --people PEOPLE --other OTHER --near NEAR --split RUNS PEOPLE
    python experiments/paper/tables.py ... --table animation --json tables.json

animation        table 1: unseen poses and views; of the printed rows also the seconds to model a person and to draw a frame
reconstruction   table 2: views in the pose of the photos, and in others
domains          table 3: reconstruction of people like those of training (--people), and of other kinds (--other); systems that
                 were trained on another division of the people (--split: their runs, and people that they have not seen)
views            1, 2, 4 and 6 photos, cameras at the distance of training (--people) and nearer (--near)
gaussians        1 against 1 + 4 and 1 + 8 Gaussians a vertex

PSNR / SSIM / LPIPS by the protocol of the paper; LPIPS needs weights (--lpips). Printed rows say so and are of the paper's data
and training: they are no measure of ours. Systems are those whose training is finished in --runs, and the shipped weights;
those that take one photo get the first; those that docs/paper.md calls not trained are marked. People of another kind are any
other folder: captures of `humangs synth` with other settings, or a data set. --json is written after every measurement; the same
command goes on there.
"""

import argparse
import sys
import tempfile
from collections.abc import Callable, Collection, Mapping
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[2]))
from experiments.common.results import check_section, markdown_table, publish, significant, write_json
from experiments.paper.bench import (
    ABLATIONS,
    ANIMATION,
    DOMAINS,
    GAUSSIANS,
    NOT_TRAINED,
    ONE_PHOTO,
    PAGE,
    PAPER,
    PHOTOS,
    RECONSTRUCTION,
    SHIPPED,
    VIEWS,
    add_people_options,
    load_networks,
    measured,
    quick_people,
    takes_one,
    trained,
    triple,
    untrained_on_the_page,
)
from experiments.subjects import file_digest
from humangs_jax.evaluation.tables import mean_scores
from humangs_jax.io.reading import read_json

COUNTS = (1, 2, 4, 6)
SPLIT = ", on the other split"
"""End of the names of systems that were trained on other people."""
PAGE_TABLE = "paper_tables"
K_VARIANTS = ("1 Gaussian a vertex", "humangs", "1 + 4 Gaussians a vertex", "1 + 8 Gaussians a vertex")
Measure = Callable[[str, Path | None, int], dict[str, Any] | None]
"""(system, people, photos) -> what `bench.measured` gives; each is measured once."""


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add_people_options(parser)
    parser.add_argument("--other", type=Path, nargs="+", default=[], help="folders of people of other kinds")
    parser.add_argument("--split", type=Path, nargs=2, metavar=("RUNS", "PEOPLE"), help="another division, see above")
    parser.add_argument("--near", type=Path, help="people seen by nearer cameras")
    parser.add_argument("--fits", type=Path, help="the JSON of fit_person.py, for table 1")
    parser.add_argument("--page", type=Path, nargs="?", const=PAGE, help=f"write the table {PAGE_TABLE} of this page")
    parser.add_argument("--table", nargs="+", default=["all"], choices=(*TABLES, "all"), help="which ones")
    arguments = parser.parse_args()
    arguments.gray = untrained_on_the_page()
    if not (arguments.people or arguments.quick):
        parser.error("--people is needed, or --quick")
    try:
        if arguments.page:
            check_section(arguments.page, PAGE_TABLE)
        with tempfile.TemporaryDirectory() as folder:
            if arguments.people is None:
                arguments.people = quick_people(Path(folder) / "people")
            write(arguments)
    except (ValueError, OSError) as error:
        parser.error(str(error))


def write(arguments: argparse.Namespace) -> None:
    """Measure and print what was asked for."""
    import jax

    systems, networks = trained(arguments.runs), load_networks(arguments.lpips)
    if arguments.split:
        others = trained(arguments.split[0])
        systems |= {f"{name}{SPLIT}": others[name] for name in others if name != SHIPPED}
    settings = settings_of(arguments)
    numbers: dict[str, Any] = kept(arguments.json, settings)

    def measure(name: str, people: Path | None, photos: int) -> dict[str, Any] | None:
        if people is None or name not in systems:
            return None
        alone = takes_one(systems[name][1]) or name.endswith(ONE_PHOTO)
        photos = 1 if alone and photos == PHOTOS else photos
        key = f"{name}, {people.name}, {photos}"
        if key not in numbers:
            print(key, file=sys.stderr, flush=True)
            numbers[key] = measured(systems[name], people, photos, arguments.body, networks)
            jax.clear_caches()  # programs map memory, and Linux ends a process with too many mappings
            if arguments.json:
                write_json(arguments.json, {"settings": settings, "rows": numbers})
        return numbers[key]

    names = [name for name in systems if not any(mark in name for mark in (*ABLATIONS, SPLIT))]
    texts = []
    for table in TABLES if "all" in arguments.table else arguments.table:
        texts.append(f"**{table}**\n\n{TABLES[table](names, measure, arguments)}")
        print(f"{texts[-1]}\n", flush=True)
    if arguments.page:
        rows = {key: row and {name: shown(x) for name, x in row.items()} for key, row in numbers.items()}
        publish(arguments.page, PAGE_TABLE, "\n\n".join(texts), {"settings": settings, "rows": rows})


def shown(value: Any) -> Any:
    """Of the scores, those that the tables have."""
    return [value[name] for name in ("psnr", "ssim", "lpips_vgg")] if isinstance(value, dict) else value


def settings_of(arguments: argparse.Namespace) -> dict[str, Any]:
    """What decides the numbers: the weights and the people."""
    runs = [path for path in (arguments.runs, arguments.split and arguments.split[0]) if path]
    folders = [arguments.people, arguments.near, *arguments.other, arguments.split and arguments.split[1]]
    return {
        "runs": {path.name: file_digest(path / "results.json") for path in runs},
        "people": [path.name for path in folders if path],
        "lpips": bool(arguments.lpips),
    }


def kept(path: Path | None, settings: Mapping[str, Any]) -> dict[str, Any]:
    """The rows in a file. Raises: ValueError if they were measured with other settings."""
    if path is None or not path.is_file():
        return {}
    report = read_json(path)
    if report["settings"] != settings:
        raise ValueError(f"{path}: rows of other settings, {report['settings']}: give another --json")
    return report["rows"]


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


def animation(names: list[str], measure: Measure, arguments: argparse.Namespace) -> str:
    """Table 1."""
    rows = [[name, PAPER, triple(x[:3]), seconds(x[3]), seconds(x[4])] for name, x in ANIMATION.items()]
    for name in names:
        found = measure(name, arguments.people, PHOTOS)
        if found is not None:
            rows.append([name, photos_of(found, name, arguments.gray), of(found, "animation"), "", ""])
    text = markdown_table(["method", "", "PSNR / SSIM / LPIPS", "modelling s", "synthesis s"], rows, "llrrr")
    return f"{text}\n\n{fitted(read_json(arguments.fits).values())}" if arguments.fits else text


def fitted(fits: Collection[Mapping[str, Any]]) -> str:
    """The system that is fitted to one person: other people and many more photos, so no row among the others."""
    scores = triple(mean_scores(fit["animation"] for fit in fits))
    row = ["animatable", f"fitted to each of {len(fits)} other people", scores]
    return markdown_table(["fitted to one person", "", "PSNR / SSIM / LPIPS"], [row], "llr")


def reconstruction(names: list[str], measure: Measure, arguments: argparse.Namespace) -> str:
    """Table 2."""
    rows = [[name, PAPER, *map(triple, x)] for name, x in RECONSTRUCTION.items()]
    for name in names:
        found = measure(name, arguments.people, PHOTOS)
        if found is not None:
            rows.append(
                [name, photos_of(found, name, arguments.gray), of(found, "reconstruction"), of(found, "animation")]
            )
    return markdown_table(["method", "", "reconstruction", "reconstruction + animation"], rows, "llrr")


def domains(names: list[str], measure: Measure, arguments: argparse.Namespace) -> str:
    """Table 3."""
    others = arguments.other or [None]
    rows = [[name, PAPER, *map(triple, x), *[""] * (len(others) - 1)] for name, x in DOMAINS.items()]
    for name in names:
        found = [measure(name, people, PHOTOS) for people in (arguments.people, *others)]
        if found[0] is not None:
            rows.append([name, photos_of(found[0], name, arguments.gray), *(of(x, "reconstruction") for x in found)])
        if arguments.split and (x := measure(f"{name}{SPLIT}", arguments.split[1], PHOTOS)) is not None:
            rows.append(
                [f"{name}{SPLIT}", photos_of(x, name, arguments.gray), of(x, "reconstruction"), *["-" for _ in others]]
            )
    heads = [f"cross-domain: {people.name}" if people else "cross-domain" for people in others]
    return markdown_table(["method", "", "in domain", *heads], rows, "llr" + "r" * len(heads))


def views(names: list[str], measure: Measure, arguments: argparse.Namespace) -> str:
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


def gaussians(names: list[str], measure: Measure, arguments: argparse.Namespace) -> str:
    """Gaussians a vertex."""
    rows = [[f"1, {name}", PAPER, triple(one)] for name, (one, _) in GAUSSIANS.items()]
    rows += [[f"1 tight + 4 free, {name}", PAPER, triple(five)] for name, (_, five) in GAUSSIANS.items()]
    for name in K_VARIANTS:
        found = measure(name, arguments.people, PHOTOS)
        if found is not None:
            rows.append([name, photos_of(found, name, arguments.gray), of(found, "reconstruction")])
    return markdown_table(["Gaussians a vertex", "", "PSNR / SSIM / LPIPS"], rows, "llr")


TABLES: dict[str, Callable[[list[str], Measure, argparse.Namespace], str]] = {
    "animation": animation,
    "reconstruction": reconstruction,
    "domains": domains,
    "views": views,
    "gaussians": gaussians,
}

if __name__ == "__main__":
    main()
