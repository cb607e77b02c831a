"""Links of pages and notebooks lead to files and headings; pages use the words of the field."""

import json
import re
import subprocess
from pathlib import Path

from experiments.results import REPOSITORY

TERMS = (
    "rounds of the learned|on the person(?!')|fog|painted body|yardstick|unseen poses|new"
    " views|psnr_mask|psnr_foreground"
)
DIALECT = re.compile(rf"\b({TERMS}|colour\w*)\b")
"""Words that the field does not use."""
GENERATED = ("docs/benchmarks/", "docs/knobs.md", "docs/api/")
"""Pages that scripts write."""


def written(text: str) -> str:
    """Returns a page without code and without what scripts write into it."""
    text = re.sub(r"<!-- (table|formats): .*?<!-- end -->", "", text, flags=re.DOTALL)
    return re.sub(r"^```.*?^```", "", text, flags=re.DOTALL | re.MULTILINE)


def broken_links(root: Path, name: str) -> list[str]:
    """Returns a page's or notebook's links to missing files and headings; it opens no address."""
    text = (root / name).read_text()
    if name.endswith(".ipynb"):
        text = "\n\n".join(
            "".join(cell["source"])
            for cell in json.loads(text)["cells"]
            if cell["cell_type"] == "markdown"
        )
    broken = []
    for target in re.findall(
        r"\]\(([^)\s]+)\)",
        re.sub(r"^ *```.*?^ *```|`[^`\n]*`", "", text, flags=re.DOTALL | re.MULTILINE),
    ):
        path, _, heading = target.partition("#")
        file = (root / name).parent / path if path else root / name
        if "://" in target or target.startswith("mailto:"):
            continue
        if not file.exists() or (
            heading and file.suffix == ".md" and heading not in headings(file.read_text())
        ):
            broken.append(f"{name}: {target}")
    return broken


def headings(text: str) -> set[str]:
    """Returns the names by which headings of a page are linked."""
    titles = re.findall(
        r"^#+ (.*)$", re.sub(r"^```.*?^```", "", text, flags=re.DOTALL | re.MULTILINE), re.MULTILINE
    )
    return {
        re.sub(r"[-\s]+", "-", re.sub(r"[^\w\s-]", "", title).strip().lower()) for title in titles
    }


def test_broken_links_are_found(tmp_path):
    (tmp_path / "b.md").write_text("# B\n## One, two: `three`\n```\n# no heading\n```\n")
    page = (
        "[a](b.md) [b](b.md#one-two-three) [c](#here) [d](https://x.y/z)"
        " `[e](no.md)`\n```\n[f](no.md)\n```\n# Here\n"
    )
    wrong = ["gone.md", "b.md#no-heading", "#there"]
    (tmp_path / "a.md").write_text(page + " ".join(f"[x]({target})" for target in wrong))
    cell = {"cell_type": "markdown", "source": ["[a](b.md) [b](gone.png)"]}
    (tmp_path / "n.ipynb").write_text(
        json.dumps({"cells": [cell, {"cell_type": "code", "source": ["[a](gone.md)"]}]})
    )
    assert broken_links(tmp_path, "a.md") == [f"a.md: {target}" for target in wrong]
    assert broken_links(tmp_path, "n.ipynb") == ["n.ipynb: gone.png"]


def test_no_link_is_broken():
    names = subprocess.run(
        ["git", "ls-files"], cwd=REPOSITORY, capture_output=True, text=True, check=True
    ).stdout.splitlines()
    pages = [name for name in names if name.endswith((".md", ".ipynb"))]
    assert (
        len(pages) > 50
        and [link for name in pages for link in broken_links(REPOSITORY, name)] == []
    )


def test_pages_use_the_words_of_the_field():
    pages = [REPOSITORY / "README.md", *(REPOSITORY / "docs").rglob("*.md")]
    by_hand = [
        page for page in pages if not page.relative_to(REPOSITORY).as_posix().startswith(GENERATED)
    ]
    found = {page.name: DIALECT.findall(written(page.read_text())) for page in by_hand}
    assert len(found) > 20 and not {name: words for name, words in found.items() if words}


DOCS_WORDS = 16_000
"""Most words of all pages without code and generated parts: they are read in an hour."""


def test_the_pages_by_hand_are_short():
    pages = (REPOSITORY / "docs").rglob("*.md")
    by_hand = [
        page for page in pages if not page.relative_to(REPOSITORY).as_posix().startswith(GENERATED)
    ]
    assert sum(len(written(page.read_text()).split()) for page in by_hand) <= DOCS_WORDS
