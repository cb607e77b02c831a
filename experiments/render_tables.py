"""Renders the tables of README.md and docs/ from docs/results/*.json, and those of formats from the
package.

    python experiments/render_tables.py [--check]

Every section `<!-- table: NAME -->` ... `<!-- end -->` gets the contents of docs/results/NAME.json,
whose format `experiments/results.py` describes. Every section `<!-- formats: NAME -->` ...
`<!-- end -->` gets one of `TABLES`, which the code makes. --check writes nothing. The exit status
is 1 if a section has no file, if a file is shown nowhere, or, with --check, if a page differs.
"""

import argparse
import ast
import inspect
import re
import sys
import tomllib
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))
from experiments.results import REPOSITORY, SECTION, pages, rendered, write_text

FORMATS = re.compile(r"(?<=<!-- formats: )(?P<name>\w+)( -->\n).*?(?=<!-- end -->)", re.DOTALL)

FLOORS = "a module imports only from lower floors"
"""The contract of `lint-imports` that orders the rooms."""
Table = tuple[Sequence[str], Sequence[Sequence[str]]]
"""A header and rows of cells."""


def main() -> int:
    """Runs the command line and returns its exit status."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--check", action="store_true", help="report what differs instead of writing it"
    )
    arguments = parser.parse_args()
    faults = render_pages(REPOSITORY, write=not arguments.check)
    print("\n".join(faults) or "All tables are those of docs/results.")
    return 1 if faults else 0


def render_pages(repository: Path, write: bool) -> list[str]:
    """Renders README.md and docs/*.md, and returns what is wrong, one line for each fault.

    If `write` is false, nothing is written, and pages that differ are faults.
    """
    results, faults, shown = repository / "docs" / "results", [], set()
    known = {path.stem for path in results.glob("*.json")}
    for page in pages(repository):
        # sections with a file, and markers without an end
        old = page.read_text()
        names = [match["name"] for match in SECTION.finditer(old)]
        faults += [
            f"{page.name}: no docs/results/{name}.json for its table"
            for name in names
            if name not in known
        ]
        faults += [
            f"{page.name}: a table marker without its end"
            for _ in range(old.count("<!-- table: ") - len(names))
        ]
        shown.update(names)
        new = rendered(old, results, [name for name in names if name in known])
        new = FORMATS.sub(lambda match: match["name"] + match[2] + format_table(match["name"]), new)
        if new != old and write:
            write_text(page, new)
        elif new != old:
            faults.append(
                f"{page.name}: differs from docs/results; run experiments/render_tables.py"
            )
    return faults + [
        f"docs/results/{name}.json: shown on no page" for name in sorted(known - shown)
    ]


def format_table(name: str) -> str:
    """Returns the table of `TABLES` with this name in Markdown."""
    header, rows = TABLES[name]()
    return "".join(f"| {' | '.join(row)} |\n" for row in (header, ["---"] * len(header), *rows))


def _quoted(words: Iterable[str]) -> str:
    """Joins words as code."""
    return ", ".join(f"`{word}`" for word in words)


def _cameras() -> Table:
    """Returns the formats of calibrations."""
    from humangs_jax.data.formats import CAMERAS

    centers = {"half": "+0.5", "integer": "whole numbers"}
    header = ("format", "usual names", "content", "pixel centres", "up", "one camera for each")
    return header, [
        (
            each.about,
            _quoted(each.names),
            each.content,
            centers[each.pixel_centers],
            each.up,
            ("camera", "image")[each.per_image],
        )
        for each in CAMERAS.values()
    ]


def _keypoints() -> Table:
    """Returns the formats of keypoints."""
    from humangs_jax.data.formats import KEYPOINTS

    rows = [(each.about, _quoted(each.names), each.content) for each in KEYPOINTS.values()]
    return ("format", "usual names", "content"), rows


def _motions() -> Table:
    """Returns the layouts of arrays of poses."""
    from humangs_jax.data.formats import MOTIONS

    header = ("of", "keys that tell it", "up", "frames per second, where the file has none")
    rows = []
    for each in MOTIONS.values():
        if each.arrays is None:
            continue
        arrays, up = each.arrays, each.arrays.up
        if arrays.also and not arrays.fixed:
            up += f", or {', '.join(arrays.also)} where people stand so"
        rate = "must be given" if arrays.fps is None else f"{arrays.fps:g}"
        rows.append((each.about, _quoted(arrays.keys), up, rate))
    return header, rows


def _limits() -> Table:
    """Returns the limits of what a file or a command may cost."""
    from experiments.knobs import docstrings
    from humangs_jax.io.reading import Limits

    return ("limit", "default", "of"), [
        (f"`{field}`", f"{int(getattr(Limits(), field)):,}", " ".join(text.split()))
        for field, text in docstrings(Limits).items()
    ]


def _protocols() -> Table:
    """Returns the protocols by which images are compared."""
    from humangs_jax.evaluation import scores
    from humangs_jax.losses.losses import GAUSSIAN, TORCHMETRICS, UNIFORM

    windows = {GAUSSIAN: "Gaussian 11", UNIFORM: "uniform 7", TORCHMETRICS: "torchmetrics"}

    def seen(crop: scores.Crop) -> str:
        if isinstance(crop, scores.SquareBox):
            return f"mask box + {crop.margin} px, squared, {crop.side}"
        if isinstance(crop, scores.CentredWindow):
            return f"{crop.height} x {crop.width} around the person, at {crop.side}"
        return "mask box" if isinstance(crop, scores.MaskBox) else "the frame"

    header = (
        *("`--protocol`", "background", "PSNR and SSIM see", "LPIPS sees"),
        *("prediction cut out by the true mask", "LPIPS", "SSIM window", "published at, px"),
    )
    rows = []
    for name, each in scores.PROTOCOLS.items():
        background = "the photos'" if each.background == "dataset" else each.background
        cut_out = "yes: hides errors of the silhouette" if each.masked else "no"
        side = "" if each.published_side is None else str(each.published_side)
        crops = seen(each.crops[0]), seen(each.crops[-1])
        lpips = ", ".join(each.lpips)
        rows.append((name, background, *crops, cut_out, lpips, windows[each.ssim], side))
    return header, rows


def _rooms() -> Table:
    """Returns the folders of the package from the lowest layer up, with the docstrings of their
    modules.
    """
    contracts = tomllib.loads((REPOSITORY / "pyproject.toml").read_text())["tool"]["importlinter"]
    (layers,) = (each for each in contracts["contracts"] if each["name"] == FLOORS)
    (forbidden,) = (each for each in contracts["contracts"] if each["type"] == "forbidden")

    rows = []
    for module in (name for floor in layers["layers"][::-1] for name in floor.split(" | ")):
        room = module.partition(".")[2]
        text = (REPOSITORY / "humangs_jax" / room / "__init__.py").read_text()
        about = ast.get_docstring(ast.parse(text)) or ""
        kind = "on top"
        if module in forbidden["source_modules"]:
            kind = "core"
        elif module in forbidden["forbidden_modules"]:
            kind = "wing"
        rows.append((kind, f"`{room}/`", " ".join(about.partition("\n\n")[0].split())))
    order = ("core", "wing", "on top")
    return ("", "room", "contents"), sorted(rows, key=lambda row: order.index(row[0]))


def _exports() -> Table:
    """Returns the files of other programs that an avatar can become."""
    from humangs_jax.avatar.export import EXPORTS

    rows = []
    for each in EXPORTS.values():
        shared = sum(other.suffixes == each.suffixes for other in EXPORTS.values()) > 1
        option = " --mesh" if each.mesh and shared else ""
        what = each.about.removeprefix("with --mesh ")
        rows.append((f"`{each.suffixes[0]}{option}`", what, each.up))
    return ("file", "what", "up"), rows


def _videos() -> Table:
    """Returns the files that a motion can become."""
    from humangs_jax.avatar.export import VIDEOS
    from humangs_jax.core.registry import FOLDER

    rows = []
    for each in VIDEOS.values():
        ending = "none: a folder" if FOLDER in each.suffixes else f"`{each.suffixes[0]}`"
        rows.append((ending, each.about, "yes" if each.transparent else "no"))
    return ("name ends in", "what", "transparent"), rows


def _systems() -> Table:
    """Returns the networks that the paper is compared with."""
    from experiments.systems import ONE_PHOTO, SYSTEMS

    rows = []
    for name, system in SYSTEMS.items():
        first = " ".join((inspect.getdoc(system) or "").partition("\n\n")[0].split())
        photos = {"animatable": "none", "gps": "2"}.get(name, "any")
        rows.append((f"`{name}`", "1" if name in ONE_PHOTO else photos, first))
    return ("system", "photos", "what makes it that system"), rows


TABLES: dict[str, Callable[[], Table]] = {
    "cameras": _cameras,
    "exports": _exports,
    "keypoints": _keypoints,
    "limits": _limits,
    "motions": _motions,
    "protocols": _protocols,
    "rooms": _rooms,
    "systems": _systems,
    "videos": _videos,
}
"""{name in `<!-- formats: NAME -->`: function that makes the table}."""


if __name__ == "__main__":
    sys.exit(main())
