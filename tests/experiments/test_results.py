"""Tables of the docs agree with the JSON files they are rendered from."""

import json
import re
import sys
from pathlib import Path

import pytest

from experiments.render_tables import render_pages
from experiments.results import blocks_of, json_text, publish, text_of
from experiments.robustness import interval

REPOSITORY = Path(__file__).parents[2]
TABLE = "| run | PSNR | name |\n| --- | ---: | --- |\n| a | 1.0 | x |\n| b | 2.0 | y |"


@pytest.fixture
def page(tmp_path):
    path = tmp_path / "docs" / "page.md"
    path.parent.mkdir()
    path.write_text(
        "before\n<!-- table: x -->\nold\n<!-- end -->\nbetween\n<!-- table: y -->\nkept\n<!-- end"
        " -->\nafter\n"
    )
    return path


def test_the_docs_show_what_is_in_their_json_files():
    assert render_pages(REPOSITORY, write=False) == []


@pytest.mark.parametrize(
    "path", sorted((REPOSITORY / "docs" / "results").glob("*.json")), ids=lambda path: path.stem
)
def test_every_result_says_what_made_it(path):
    result = json.loads(path.read_text())
    assert result["script"]
    assert result["date"] and result["machine"]["cpu"] and result["versions"]["jax"]
    assert result["blocks"] and json_text(result) + "\n" == path.read_text()


@pytest.mark.parametrize(
    ("pattern", "begins"), [("*.jpg", b"\xff\xd8\xff"), ("*.png", b"\x89PNG"), ("*.gif", b"GIF8")]
)
def test_images_are_what_their_names_say(pattern, begins):
    images = list((REPOSITORY / "docs/images").glob(pattern))
    assert images and not [
        image.name for image in images if not image.read_bytes().startswith(begins)
    ]


def test_sections_are_data_and_text_again():
    text = f"One line,\nanother.\n\n{TABLE}\n\nMore."
    blocks = blocks_of(text)
    assert blocks[1] == {
        "header": ["run", "PSNR", "name"],
        "align": "lrl",
        "rows": [["a", "1.0", "x"], ["b", "2.0", "y"]],
    }
    assert text_of(json.loads(json_text(blocks))) == text


def test_a_result_is_written_beside_its_page(page, monkeypatch):
    monkeypatch.setattr(
        sys,
        "argv",
        [
            str(REPOSITORY / "experiments" / "a.py"),
            "--size",
            "2",
            "/some/where/file.npz",
            "a=/b c/d.npz",
        ],
    )
    publish(page, "x", TABLE, {"psnr": 1.0})
    assert (
        page.read_text()
        == f"before\n<!-- table: x -->\n{TABLE}\n<!-- end -->\nbetween\n<!-- table: y"
        " -->\nkept\n<!-- end -->\nafter\n"
    )
    result = json.loads((page.parent / "results" / "x.json").read_text())
    assert (result["script"], result["arguments"]) == (
        "experiments/a.py",
        "--size 2 file.npz a=d.npz",
    )
    assert (
        result["numbers"] == {"psnr": 1.0}
        and result["machine"]["cores"] > 0
        and result["versions"]["jax"]
    )


def test_results_of_a_readme_are_in_its_docs(page):
    readme = page.parents[1] / "README.md"
    readme.write_text(page.read_text())
    publish(readme, "x", TABLE, 1)
    assert TABLE in readme.read_text() and (page.parent / "results" / "x.json").exists()


def test_what_differs_is_reported_and_rendered(page):
    (page.parents[1] / "README.md").write_text("")
    publish(page, "x", TABLE)
    publish(page, "y", "text")
    page.write_text(page.read_text().replace("1.0", "9.9"))
    assert render_pages(page.parents[1], write=False) == [
        "page.md: differs from docs/results; run experiments/render_tables.py"
    ]
    assert "9.9" in page.read_text()
    assert render_pages(page.parents[1], write=True) == [] and TABLE in page.read_text()
    page.write_text(
        page.read_text().replace("table: y", "table: z").replace("<!-- end -->\nafter", "")
    )
    assert [re.sub(r".*: ", "", fault) for fault in render_pages(page.parents[1], write=False)] == [
        "a table marker without its end",
        "shown on no page",
    ]
    page.write_text(page.read_text() + "<!-- end -->\n")
    assert any(
        "no docs/results/z.json" in fault for fault in render_pages(page.parents[1], write=False)
    )


def test_ends_are_where_the_loss_crosses_the_bound():
    row = interval("focal length", {-2.0: 3.0, -1.0: 0.5, 1.0: 0.2, 2.0: 0.9})
    assert row["low"] == pytest.approx(-1.2) and row["high"] is None
    assert interval("body moved", {0.5: 0.0, 1.0: 2.0})["low"] == 0  # an error without a sign
