"""Links of pages and notebooks lead to files and headings."""

import json
import subprocess

from experiments.count import broken_links
from experiments.results import REPOSITORY


def test_broken_links_are_found(tmp_path):
    (tmp_path / "b.md").write_text("# B\n## One, two: `three`\n```\n# no heading\n```\n")
    page = "[a](b.md) [b](b.md#one-two-three) [c](#here) [d](https://x.y/z) `[e](no.md)`\n```\n[f](no.md)\n```\n# Here\n"
    wrong = ["gone.md", "b.md#no-heading", "#there"]
    (tmp_path / "a.md").write_text(page + " ".join(f"[x]({target})" for target in wrong))
    cell = {"cell_type": "markdown", "source": ["[a](b.md) [b](gone.png)"]}
    (tmp_path / "n.ipynb").write_text(json.dumps({"cells": [cell, {"cell_type": "code", "source": ["[a](gone.md)"]}]}))
    assert broken_links(tmp_path, "a.md") == [f"a.md: {target}" for target in wrong]
    assert broken_links(tmp_path, "n.ipynb") == ["n.ipynb: gone.png"]


def test_no_link_is_broken():
    names = subprocess.run(["git", "ls-files"], cwd=REPOSITORY, capture_output=True, text=True, check=True).stdout.splitlines()
    pages = [name for name in names if name.endswith((".md", ".ipynb"))]
    assert len(pages) > 50 and [link for name in pages for link in broken_links(REPOSITORY, name)] == []
