"""Tables of README.md and docs/ from docs/results/*.json.

    python experiments/render_tables.py [--check]

Every section `<!-- table: NAME -->` ... `<!-- end -->` becomes what docs/results/NAME.json holds (format:
`experiments/common/results.py`). --check writes nothing; exit status 1 if a page differs from its JSON files, if a section has
no file, or if a file is shown nowhere.
"""

import argparse
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))
from experiments.common.results import REPOSITORY, SECTION, rendered, write_text


def main() -> int:
    """Command line; the exit status."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--check", action="store_true", help="report what differs instead of writing it")
    arguments = parser.parse_args()
    faults = render_pages(REPOSITORY, write=not arguments.check)
    print("\n".join(faults) or "All tables are those of docs/results.")
    return 1 if faults else 0


def render_pages(repository: Path, write: bool) -> list[str]:
    """Renders README.md and docs/*.md; returns what is wrong, one line each."""
    results, faults, shown = repository / "docs" / "results", [], set()
    known = {path.stem for path in results.glob("*.json")}
    for page in [repository / "README.md", *sorted((repository / "docs").rglob("*.md"))]:
        old = page.read_text()
        names = [match["name"] for match in SECTION.finditer(old)]
        faults += [f"{page.name}: no docs/results/{name}.json for its table" for name in names if name not in known]
        faults += [
            f"{page.name}: a table marker without its end" for _ in range(old.count("<!-- table: ") - len(names))
        ]
        shown.update(names)
        new = rendered(old, results, [name for name in names if name in known])
        if new != old and write:
            write_text(page, new)
        elif new != old:
            faults.append(f"{page.name}: differs from docs/results; run experiments/render_tables.py")
    return faults + [f"docs/results/{name}.json: shown on no page" for name in sorted(known - shown)]


if __name__ == "__main__":
    sys.exit(main())
