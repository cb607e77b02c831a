"""Tables of README.md and docs/ from docs/results/*.json, and those of formats from the package.

    python experiments/render_tables.py [--check]

Every section `<!-- table: NAME -->` ... `<!-- end -->` becomes what docs/results/NAME.json holds
(format: `experiments/results.py`). --check writes nothing; exit status 1 if a page differs from its
JSON files, if a section has no file, or if a file is shown nowhere. `<!-- formats: NAME -->` ...
`<!-- end -->` becomes the formats that the package reads, or its limits.
"""

import argparse
import re
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))
from experiments.results import REPOSITORY, SECTION, pages, rendered, write_text

FORMATS = re.compile(r"(?<=<!-- formats: )(?P<name>\w+)( -->\n).*?(?=<!-- end -->)", re.DOTALL)


def main() -> int:
    """Command line; the exit status."""
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
    """Renders README.md and docs/*.md; returns what is wrong, one line each."""
    results, faults, shown = repository / "docs" / "results", [], set()
    known = {path.stem for path in results.glob("*.json")}
    for page in pages(repository):
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
    """The "cameras", "keypoints" or "motions" that are read, or the "limits", as a table in
    Markdown.
    """
    from humangs_jax.data.formats import CAMERAS, KEYPOINTS, MOTIONS
    from humangs_jax.io.reading import Limits

    centers = {"half": "+0.5", "integer": "whole numbers"}
    quoted = lambda files: ", ".join(f"`{file}`" for file in files)
    if name == "cameras":
        header = ("format", "usual names", "content", "pixel centres", "up", "one camera for each")
        rows = [
            (
                each.about,
                quoted(each.names),
                each.content,
                centers[each.pixel_centers],
                each.up,
                ("camera", "image")[each.per_image],
            )
            for each in CAMERAS.values()
        ]
    elif name == "motions":
        header = ("of", "keys that tell it", "up", "frames per second, where the file has none")
        arrays = [(each.about, each.arrays) for each in MOTIONS.values() if each.arrays is not None]
        rows = [
            (
                about,
                quoted(each.keys),
                each.up
                if each.fixed or not each.also
                else f"{each.up}, or {', '.join(each.also)} where people stand so",
                "must be given" if each.fps is None else f"{each.fps:g}",
            )
            for about, each in arrays
        ]
    elif name == "limits":
        from experiments.knobs import docstrings

        header = ("limit", "default", "of")
        rows = [
            (f"`{field}`", f"{int(getattr(Limits(), field)):,}", " ".join(text.split()))
            for field, text in docstrings(Limits).items()
        ]
    else:
        header = ("format", "usual names", "content")
        rows = [(each.about, quoted(each.names), each.content) for each in KEYPOINTS.values()]
    return "".join(f"| {' | '.join(row)} |\n" for row in (header, ["---"] * len(header), *rows))


if __name__ == "__main__":
    sys.exit(main())
