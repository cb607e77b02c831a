"""Results beside the docs, and the tables that pages show of them.

`docs/results/NAME.json` holds

    script, arguments   what made it
    source              where the rows come from, if not from that script's own run
    date, machine, versions   of the run; null if unknown
    blocks              the section as data: paragraphs (text) and tables ({"header", "rows", "align"})
    numbers             the unrounded numbers, as the script wrote them; null if unknown

A page shows it between `<!-- table: NAME -->` and `<!-- end -->`. Scripts write both with `publish`;
`experiments/render_tables.py` renders all pages from the JSON files again.
"""

import argparse
import datetime
import json
import math
import os
import platform
import re
import shlex
import sys
from collections.abc import Sequence
from importlib import metadata
from pathlib import Path
from typing import Any

REPOSITORY = Path(__file__).resolve().parents[2]
SECTION = re.compile(r"(<!-- table: (?P<name>[\w-]+) -->\n)(?P<text>.*?)(?=<!-- end -->)", re.DOTALL)
PACKAGES = ("humangs_jax", "jax", "jaxlib", "flax", "numpy")
ALIGNMENTS = {"l": "---", "r": "---:"}


def write_text(path: Path, text: str) -> None:
    """Writes a file whole or not at all; makes its folder."""
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.part")
    temporary.write_text(text)
    os.replace(temporary, path)


def write_json(path: Path, result: object) -> None:
    """Writes a result, a list of plain values on one line."""
    write_text(path, json_text(result) + "\n")


def json_text(value: Any, indent: str = "") -> str:
    """JSON with one line for every list of plain values."""
    inner = indent + "  "
    if isinstance(value, dict) and value:
        # a key that is no string becomes one as json.dumps makes it
        keys = [next(iter(json.loads(json.dumps({key: None})))) for key in value]
        items = [f"{json.dumps(key)}: {json_text(item, inner)}" for key, item in zip(keys, value.values(), strict=True)]
        brackets = "{}"
    elif isinstance(value, list | tuple) and any(isinstance(item, dict | list | tuple) for item in value):
        items, brackets = [json_text(item, inner) for item in value], "[]"
    else:
        return json.dumps(value, ensure_ascii=False)
    return f"{brackets[0]}\n" + ",\n".join(inner + item for item in items) + f"\n{indent}{brackets[1]}"


def markdown_table(header: Sequence[str], rows: Sequence[Sequence[object]], align: str | None = None) -> str:
    """A table. align holds "l" or "r" for each column; by default the first is aligned to the left, others to the right."""
    rule = [ALIGNMENTS[side] for side in align or default_alignment(header)]
    return "\n".join("| " + " | ".join(str(cell) for cell in row) + " |" for row in (header, rule, *rows))


def significant(value: float, digits: int = 2) -> str:
    """A number with at least `digits` significant digits, without an exponent."""
    decimals = digits - 1 - math.floor(math.log10(abs(value))) if value else digits - 1
    return f"{value:.{max(0, decimals)}f}"


def default_alignment(header: Sequence[str]) -> str:
    """Of a table with these columns."""
    return "l" + "r" * (len(header) - 1)


def blocks_of(text: str) -> list[str | dict[str, Any]]:
    """Paragraphs and tables of a section as data. `text_of` is the inverse."""
    blocks: list[str | dict[str, Any]] = []
    for paragraph in re.split(r"\n\s*\n", text.strip()):
        if paragraph.startswith("|"):
            header, rule, *rows = [[c.strip() for c in line.strip()[1:-1].split("|")] for line in paragraph.split("\n")]
            align = "".join("r" if side.endswith(":") else "l" for side in rule)
            blocks.append({"header": header, "rows": rows})
            if align != default_alignment(header):
                blocks[-1] = {"header": header, "align": align, "rows": rows}
        elif paragraph:
            blocks.append(paragraph)
    return blocks


def text_of(blocks: Sequence[str | dict[str, Any]]) -> str:
    """A section in Markdown."""
    return "\n\n".join(block if isinstance(block, str) else markdown_table(**block) for block in blocks)


def add_outputs(parser: argparse.ArgumentParser, name: str) -> None:
    """The options of `write_outputs`."""
    parser.add_argument("--json", type=Path, help="write the numbers here")
    parser.add_argument(
        "--page", type=Path, help=f"page whose table {name} is written, with its docs/results/{name}.json"
    )


def write_outputs(arguments: argparse.Namespace, name: str, text: str, numbers: object) -> None:
    """Prints a section; writes the numbers and the page's section of that name where asked."""
    print(text)
    if arguments.json:
        write_json(arguments.json, numbers)
    if arguments.page:
        publish(arguments.page, name, text, numbers)


def publish(page: Path, name: str, text: str, numbers: object = None, row: str | None = None) -> None:
    """Writes results/NAME.json beside a page (for a README.md in its docs/), and the page's section of that name.

    row: the first cell of the rows of this run. They replace those of the same name, other rows and their numbers stay.

    Raises: FileNotFoundError; ValueError if the page lacks the section.
    """
    check_section(page, name)
    folder = next((f for f in page.resolve().parents if f.name == "docs"), page.parent / "docs")
    path, blocks = folder / "results" / f"{name}.json", blocks_of(text)
    record = run_record()
    if row is not None and path.exists():
        old = json.loads(path.read_text())
        blocks, record["source"] = merged(old["blocks"], blocks), old.get("source")
        numbers = (old["numbers"] or {}) | {row: numbers}
    elif row is not None:
        numbers = {row: numbers}
    record |= {"blocks": blocks, "numbers": numbers}
    write_json(path, record)
    write_text(page, rendered(page.read_text(), path.parent, (name,)))


def merged(old: Sequence[Any], new: Sequence[Any]) -> list[Any]:
    """Old blocks with the rows of new tables of the same header, by their first cells; other new blocks behind them."""
    blocks = list(old)
    for block in new:
        same = [
            i for i, o in enumerate(blocks) if o == block or (isinstance(o, dict) and o["header"] == block["header"])
        ]
        if not same:
            blocks.append(block)
        elif isinstance(block, dict):
            rows = {row[0]: row for row in (*blocks[same[0]]["rows"], *block["rows"])}
            blocks[same[0]] = block | {"rows": list(rows.values())}
    return blocks


def check_section(page: Path, name: str) -> None:
    """For long work to ask before it begins.

    Raises: FileNotFoundError; ValueError if the page lacks the section.
    """
    found = [match["name"] for match in SECTION.finditer(page.read_text())].count(name)
    if found != 1:
        raise ValueError(f"{page}: needs <!-- table: {name} --> and <!-- end --> once, found {found}")


def rendered(page: str, results: Path, names: Sequence[str] | None = None) -> str:
    """A page's text with its sections (of these names, or all) as the JSON files of a folder have them.

    Raises: FileNotFoundError for a section without a JSON file.
    """

    def section(match: re.Match[str]) -> str:
        if names is not None and match["name"] not in names:
            return match[0]
        return match[1] + text_of(json.loads((results / f"{match['name']}.json").read_text())["blocks"]) + "\n"

    return SECTION.sub(section, page)


def run_record() -> dict[str, Any]:
    """What made a result: the script and its arguments (absolute paths without their folders, also after NAME=), date, machine,
    versions.
    """
    script = Path(sys.argv[0]).resolve()
    inside = script.is_relative_to(REPOSITORY)
    arguments = [re.sub(r"(^|=)/.*/", r"\1", a) for a in sys.argv[1:]]
    return {
        "script": script.relative_to(REPOSITORY).as_posix() if inside else script.name,
        "arguments": shlex.join(arguments),
        "date": datetime.datetime.now(datetime.UTC).date().isoformat(),
        "machine": {"cpu": cpu_model(), "cores": cores()},
        "versions": {"python": platform.python_version()} | {name: version(name) for name in PACKAGES},
    }


def cores() -> int | None:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()


def cpu_model() -> str:
    """The processor's name."""
    information = Path("/proc/cpuinfo")
    names = re.findall(r"model name\s*: (.*)", information.read_text()) if information.exists() else []
    return names[0] if names else platform.processor() or platform.machine()


def version(package: str) -> str | None:
    """Of an installed package."""
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return None
