"""Writes results beside the docs, and the tables that pages show of them.

`docs/results/NAME.json` holds

    script, arguments   what made it
    source              where the rows come from, if not from that script's own run
    date, machine, versions   of the run; null if unknown
    blocks              the section as data: paragraphs (text) and tables ({"header", "rows",
                        "align"})
    numbers             the unrounded numbers, as the script wrote them; null if unknown

A page shows a result between `<!-- table: NAME -->` and `<!-- end -->`. `publish` writes the result
and its page. `render_tables.py` renders all pages again.
"""

import datetime
import json
import math
import os
import platform
import re
import shlex
import sys
from collections.abc import Mapping, Sequence
from importlib import metadata
from pathlib import Path
from typing import Any

REPOSITORY = Path(__file__).resolve().parents[1]
SECTION = re.compile(
    r"(<!-- table: (?P<name>[\w-]+) -->\n)(?P<text>.*?)(?=<!-- end -->)", re.DOTALL
)
PACKAGES = ("humangs_jax", "jax", "jaxlib", "flax", "numpy")
ALIGNMENTS = {"l": "---", "r": "---:"}


def write_text(path: Path, text: str) -> None:
    """Writes a file whole or not at all, and makes its folder."""
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.part")
    temporary.write_text(text)
    os.replace(temporary, path)


def write_json(path: Path, result: object) -> None:
    """Writes a result as JSON, with each list of plain values on one line."""
    write_text(path, json_text(result) + "\n")


def json_text(value: Any, indent: str = "") -> str:
    """Returns JSON with one line for every list of plain values. NumPy arrays become lists."""
    inner = indent + "  "
    nested = (dict, list, tuple)
    if isinstance(value, dict) and value:
        # a key that is no string becomes one as json.dumps makes it
        keys = [next(iter(json.loads(json.dumps({key: None})))) for key in value]
        items = [
            f"{json.dumps(key)}: {json_text(item, inner)}"
            for key, item in zip(keys, value.values(), strict=True)
        ]
        brackets = "{}"
    elif isinstance(value, list | tuple) and any(isinstance(item, nested) for item in value):
        items, brackets = [json_text(item, inner) for item in value], "[]"
    else:
        return json.dumps(value, ensure_ascii=False, default=lambda array: array.tolist())
    lines = ",\n".join(inner + item for item in items)
    return f"{brackets[0]}\n{lines}\n{indent}{brackets[1]}"


def markdown_table(
    header: Sequence[str], rows: Sequence[Sequence[object]], align: str | None = None
) -> str:
    """Formats a table in Markdown.

    `align` has "l" or "r" for each column. By default the first column is aligned to the left, and
    the others to the right.
    """
    rule = [ALIGNMENTS[side] for side in align or default_alignment(header)]
    return "\n".join(
        "| " + " | ".join(str(cell) for cell in row) + " |" for row in (header, rule, *rows)
    )


def cells(
    numbers: Mapping[str, float | None], columns: Mapping[str, tuple[str, int]], missing: str = "-"
) -> list[str]:
    """Formats the numbers of a row in the order of columns {key: (heading, digits)}.

    `missing` stands for a number that is missing or None.
    """
    values = ((numbers.get(key), digits) for key, (_, digits) in columns.items())
    return [missing if value is None else f"{value:,.{digits}f}" for value, digits in values]


def significant(value: float, digits: int = 2) -> str:
    """Formats a number with at least `digits` significant digits, without an exponent."""
    decimals = digits - 1
    if value:
        decimals -= math.floor(math.log10(abs(value)))
    return f"{value:.{max(0, decimals)}f}"


def default_alignment(header: Sequence[str]) -> str:
    """Returns "l" for the first column, and "r" for the others."""
    return "l" + "r" * (len(header) - 1)


def blocks_of(text: str) -> list[str | dict[str, Any]]:
    """Returns the paragraphs and tables of a section as data. `text_of` is the inverse."""
    blocks: list[str | dict[str, Any]] = []
    for paragraph in re.split(r"\n\s*\n", text.strip()):
        if paragraph.startswith("|"):
            header, rule, *rows = [
                [c.strip() for c in line.strip()[1:-1].split("|")] for line in paragraph.split("\n")
            ]
            align = "".join("r" if side.endswith(":") else "l" for side in rule)
            blocks.append({"header": header, "rows": rows})
            if align != default_alignment(header):
                blocks[-1] = {"header": header, "align": align, "rows": rows}
        elif paragraph:
            blocks.append(paragraph)
    return blocks


def text_of(blocks: Sequence[str | dict[str, Any]]) -> str:
    """Returns the Markdown of paragraphs and tables."""
    return "\n\n".join(
        block if isinstance(block, str) else markdown_table(**block) for block in blocks
    )


def pages(repository: Path | None = None) -> list[Path]:
    """Returns README.md, all pages of the docs, and README.md of the experiments."""
    repository = repository or REPOSITORY
    found = [
        repository / "README.md",
        repository / "experiments" / "README.md",
        *sorted((repository / "docs").rglob("*.md")),
    ]
    return [page for page in found if page.is_file()]


def page_of(name: str) -> Path:
    """Returns the page that shows a table.

    Raises: ValueError unless exactly one section of the pages has this name.
    """
    found = [
        page
        for page in pages()
        for match in SECTION.finditer(page.read_text())
        if match["name"] == name
    ]
    if len(found) != 1:
        raise ValueError(
            f"needs <!-- table: {name} --> and <!-- end --> once in README.md,"
            f" experiments/README.md or docs/, found {len(found)}"
        )
    return found[0]


def publish(
    page: Path, name: str, text: str, numbers: object = None, record: dict[str, Any] | None = None
) -> None:
    """Writes docs/results/NAME.json, and the section of the page with that name.

    Args:
        page: page that shows the table
        name: name of the table
        text: the section in Markdown
        numbers: the unrounded numbers
        record: what made the result; default: this process (`run_record`)
    """
    folder = next(parent for parent in page.parents if (parent / "docs").is_dir()) / "docs"
    path, blocks = folder / "results" / f"{name}.json", blocks_of(text)
    record = record or run_record()
    write_json(path, record | {"blocks": blocks, "numbers": numbers})
    write_text(page, rendered(page.read_text(), path.parent, (name,)))


def rendered(page: str, results: Path, names: Sequence[str] | None = None) -> str:
    """Returns the text of a page with its sections rendered from the JSON files in `results`.

    Only sections with these names are rendered, or all if `names` is None.

    Raises: FileNotFoundError for a section without a JSON file.
    """

    def section(match: re.Match[str]) -> str:
        if names is not None and match["name"] not in names:
            return match[0]
        result = json.loads((results / f"{match['name']}.json").read_text())
        return f"{match[1]}{text_of(result['blocks'])}\n"

    return SECTION.sub(section, page)


def run_record(name: str | None = None, options: Sequence[str] | None = None) -> dict[str, Any]:
    """Returns what made a result: the experiment and its options, date, machine and versions.

    Absolute paths in the options lose their folders, also after NAME=.

    Args:
        name: the experiment; default: the script of this process
        options: its options; default: the arguments of this process
    """
    script = Path(sys.argv[0]).resolve()
    if name:
        made_by = f"python -m experiments {name}"
    elif script.is_relative_to(REPOSITORY):
        made_by = script.relative_to(REPOSITORY).as_posix()
    else:
        made_by = script.name
    given = sys.argv[1:] if options is None else options
    return {
        "script": made_by,
        "arguments": shlex.join(re.sub(r"(^|=)/.*/", r"\1", each) for each in given),
        "date": datetime.datetime.now(datetime.UTC).date().isoformat(),
        "machine": {"cpu": cpu_model(), "cores": cores()},
        "versions": (
            {"python": platform.python_version()} | {name: version(name) for name in PACKAGES}
        ),
    }


def cores() -> int | None:
    """Returns the number of cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count()


def cpu_model() -> str:
    """Returns the name of the CPU, or of its kind where the name is not known."""
    information = Path("/proc/cpuinfo")
    if information.exists():
        names = re.findall(r"model name\s*: (.*)", information.read_text())
        if names:
            return names[0]
    return platform.processor() or platform.machine()


def version(package: str) -> str | None:
    """Returns the version of an installed package, or None if it is not installed."""
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return None
