"""Results on disk: JSON and tables in Markdown pages, written whole or not at all."""

import json
import os
from collections.abc import Sequence
from pathlib import Path


def write_text(path: Path, text: str) -> None:
    """Writes a file whole or not at all; makes its folder."""
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.part")
    temporary.write_text(text)
    os.replace(temporary, path)


def write_json(path: Path, result: object) -> None:
    """Writes a result, indented."""
    write_text(path, json.dumps(result, indent=2) + "\n")


def markdown_table(header: Sequence[str], rows: Sequence[Sequence[object]]) -> str:
    """A table; its first column is text, the others are aligned to the right."""
    rule = ["---"] + ["---:"] * (len(header) - 1)
    return "\n".join("| " + " | ".join(str(cell) for cell in row) + " |" for row in (header, rule, *rows))


def write_section(page: Path, name: str, text: str) -> None:
    """Replaces what stands in a Markdown page between `<!-- name -->` and `<!-- end name -->`.

    Raises: see `around_section`.
    """
    before, after = around_section(page, name)
    write_text(page, f"{before}\n{text.strip()}\n{after}")


def around_section(page: Path, name: str) -> tuple[str, str]:
    """What stands before and after a section, with its markers: for long work to ask before it begins, too.

    Raises: FileNotFoundError; ValueError if the page lacks the markers.
    """
    first, last = f"<!-- {name} -->", f"<!-- end {name} -->"
    old = page.read_text()
    if old.count(first) != 1 or old.count(last) != 1:
        raise ValueError(f"{page}: needs the markers {first} and {last} once each")
    before, rest = old.split(first)
    return before + first, last + rest.split(last)[1]
