"""Results beside the docs, and the tables that pages show of them.

`docs/results/NAME.json` holds

    script, arguments   what made it
    source              where the rows come from, if not from that script's own run
    date, machine, versions   of the run; null if unknown
    blocks              the section as data: paragraphs (text) and tables ({"header", "rows",
                        "align"})
    numbers             the unrounded numbers, as the script wrote them; null if unknown

A page shows it between `<!-- table: NAME -->` and `<!-- end -->`. `publish` writes both,
`render_tables.py` all pages again.
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
        items = [
            f"{json.dumps(key)}: {json_text(item, inner)}"
            for key, item in zip(keys, value.values(), strict=True)
        ]
        brackets = "{}"
    elif isinstance(value, list | tuple) and any(
        isinstance(item, dict | list | tuple) for item in value
    ):
        items, brackets = [json_text(item, inner) for item in value], "[]"
    else:
        return json.dumps(
            value, ensure_ascii=False, default=lambda array: array.tolist()
        )  # of numpy
    return (
        f"{brackets[0]}\n" + ",\n".join(inner + item for item in items) + f"\n{indent}{brackets[1]}"
    )


def markdown_table(
    header: Sequence[str], rows: Sequence[Sequence[object]], align: str | None = None
) -> str:
    """A table. align holds "l" or "r" for each column; by default the first is aligned to the left,
    others to the right.
    """
    rule = [ALIGNMENTS[side] for side in align or default_alignment(header)]
    return "\n".join(
        "| " + " | ".join(str(cell) for cell in row) + " |" for row in (header, rule, *rows)
    )


def cells(
    numbers: Mapping[str, float | None], columns: Mapping[str, tuple[str, int]], missing: str = "-"
) -> list[str]:
    """Numbers of a row, by columns: key -> heading and digits."""
    values = ((numbers.get(key), digits) for key, (_, digits) in columns.items())
    return [missing if value is None else f"{value:,.{digits}f}" for value, digits in values]


def significant(value: float, digits: int = 2) -> str:
    """A number with at least `digits` significant digits, without an exponent."""
    decimals = digits - 1 - math.floor(math.log10(abs(value))) if value else digits - 1
    return f"{value:.{max(0, decimals)}f}"


def default_alignment(header: Sequence[str]) -> str:
    return "l" + "r" * (len(header) - 1)


def blocks_of(text: str) -> list[str | dict[str, Any]]:
    """Paragraphs and tables of a section as data. `text_of` is the inverse."""
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
    return "\n\n".join(
        block if isinstance(block, str) else markdown_table(**block) for block in blocks
    )


def pages(repository: Path | None = None) -> list[Path]:
    """README.md, all pages of the docs, and that of the experiments."""
    repository = repository or REPOSITORY
    found = [
        repository / "README.md",
        repository / "experiments" / "README.md",
        *sorted((repository / "docs").rglob("*.md")),
    ]
    return [page for page in found if page.is_file()]


def page_of(name: str) -> Path:
    """The page that shows a table.

    Raises: ValueError unless one page does, once.
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
    """Writes docs/results/NAME.json, and the page's section of that name.

    record: what made it, by default this process (`run_record`).
    """
    folder = next(parent for parent in page.parents if (parent / "docs").is_dir()) / "docs"
    path, blocks = folder / "results" / f"{name}.json", blocks_of(text)
    record = record or run_record()
    write_json(path, record | {"blocks": blocks, "numbers": numbers})
    write_text(page, rendered(page.read_text(), path.parent, (name,)))


def rendered(page: str, results: Path, names: Sequence[str] | None = None) -> str:
    """A page's text with its sections (of these names, or all) as the JSON files of a folder have
    them.

    Raises: FileNotFoundError for a section without a JSON file.
    """

    def section(match: re.Match[str]) -> str:
        if names is not None and match["name"] not in names:
            return match[0]
        return (
            match[1]
            + text_of(json.loads((results / f"{match['name']}.json").read_text())["blocks"])
            + "\n"
        )

    return SECTION.sub(section, page)


def run_record(name: str | None = None, options: Sequence[str] | None = None) -> dict[str, Any]:
    """What made a result: an experiment (by default this process's script) and its options
    (absolute paths without their folders, also after NAME=), date, machine, versions.
    """
    script = Path(sys.argv[0]).resolve()
    made_by = (
        script.relative_to(REPOSITORY).as_posix()
        if script.is_relative_to(REPOSITORY)
        else script.name
    )
    given = sys.argv[1:] if options is None else options
    return {
        "script": f"python -m experiments {name}" if name else made_by,
        "arguments": shlex.join(re.sub(r"(^|=)/.*/", r"\1", each) for each in given),
        "date": datetime.datetime.now(datetime.UTC).date().isoformat(),
        "machine": {"cpu": cpu_model(), "cores": cores()},
        "versions": (
            {"python": platform.python_version()} | {name: version(name) for name in PACKAGES}
        ),
    }


def cores() -> int | None:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()


def cpu_model() -> str:
    information = Path("/proc/cpuinfo")
    names = (
        re.findall(r"model name\s*: (.*)", information.read_text()) if information.exists() else []
    )
    return names[0] if names else platform.processor() or platform.machine()


def version(package: str) -> str | None:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return None
