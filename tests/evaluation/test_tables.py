"""Means, intervals and tables of plain numbers."""

import csv
import io

import numpy as np
import pytest

from humangs_jax.evaluation.means import (
    Mean,
    Scored,
    bootstrap,
    mean_scores,
    overall_means,
    person_means,
)
from humangs_jax.evaluation.run import csv_text, latex_table, markdown_table, shown_mean

ROWS = [
    Scored("a", 0, "x", {"psnr": 10.0, "patch_psnr": None}),
    Scored("a", 0, "y", {"psnr": 14.0, "patch_psnr": 3.0}),
    Scored("a", 1, "x", {"psnr": 20.0, "patch_psnr": None}),
    Scored("b", 0, "x", {"psnr": 30.0, "patch_psnr": None}),
]


def test_means_are_over_images_then_frames_then_people():
    people = person_means(ROWS)
    assert (
        people["a"] == {"psnr": (12 + 20) / 2, "patch_psnr": 3.0}
        and people["b"]["patch_psnr"] is None
    )
    means = overall_means(ROWS)
    assert means["psnr"].mean == (16 + 30) / 2 and (means["psnr"].count, means["psnr"].over) == (
        2,
        "people",
    )
    assert means["patch_psnr"] == Mean(3.0, None, None, 1, "people")
    one = overall_means(ROWS[:3])["psnr"]
    assert (one.mean, one.count, one.over) == (16.0, 2, "frames")
    frame = overall_means(ROWS[:2])["psnr"]
    assert (frame.mean, frame.count, frame.over) == (12.0, 2, "images")
    assert overall_means([ROWS[0]])["patch_psnr"] is None


def test_a_score_that_one_lacks_has_no_plain_mean():
    assert mean_scores([{"psnr": 1.0, "lpips": 1.0}, {"psnr": 3.0, "lpips": None}]) == {
        "psnr": 2.0,
        "lpips": None,
    }


def test_the_interval_covers_the_true_mean_as_often_as_it_says():
    """It does so in 93 % of 200 samples of 40 normal numbers: percentile intervals of few numbers
    are short.
    """
    rng = np.random.default_rng(0)
    intervals = [bootstrap(rng.normal(5.0, 2.0, 40).tolist(), seed=i) for i in range(200)]
    covered = np.mean([low <= 5.0 <= high for low, high in intervals])
    assert 0.88 < covered < 0.98  # 93 % of 200: standard deviation 1.8 %
    width = np.mean([high - low for low, high in intervals])
    assert width == pytest.approx(2 * 1.96 * 2 / np.sqrt(40), rel=0.06)
    assert bootstrap([1.0, 2.0]) == bootstrap([1.0, 2.0]) and bootstrap([3.0]) == (None, None)


def test_tables_of_people():
    assert shown_mean(Mean(12.3456, 11.0, 13.0, 4, "people"), "psnr") == "12.35 [11.00, 13.00]"
    assert (
        markdown_table(["person", "PSNR"], [["a|b", "1.00"]])
        == "| person | PSNR |\n| --- | ---: |\n| a\\|b | 1.00 |\n"
    )
    lines = latex_table(["person", "PSNR"], [["a_b & 5%", "1.00"], ["mean", "-"]]).splitlines()
    assert lines[0] == r"\begin{tabular}{lr}" and lines[4] == r"a\_b \& 5\% & 1.00 \\"
    assert lines[-2:] == [r"\bottomrule", r"\end{tabular}"]


def test_the_csv_reads_back():
    rows = [*ROWS, Scored('c, "d"', 2, "x", {"psnr": 1 / 3, "patch_psnr": None})]
    found = list(csv.DictReader(io.StringIO(csv_text(rows))))
    assert [row["person"] for row in found] == ["a", "a", "a", "b", 'c, "d"']
    assert (
        float(found[-1]["psnr"]) == 1 / 3
        and found[-1]["patch_psnr"] == ""
        and found[2]["frame"] == "1"
    )


HOSTILE = (
    "=1+1",
    "@SUM(A1)",
    "+cmd",
    "-2",
    " =1",
    "\uff1d1",
    "\t=1",
    "<img src=x onerror=alert(1)>",
    "a|b",
    "a\nb\x1b[2J",
)
HOSTILE += ("[here](javascript:alert(1))", "\\|`x`", "\\input{secret}")


@pytest.mark.parametrize("name", HOSTILE)
def test_names_are_names_in_every_table(name):
    text = csv_text([Scored(name, 0, name, {"psnr": -1.0})])
    rows = list(csv.reader(io.StringIO(text)))
    assert len(rows) == 2 == text.count("\n") and rows[1][3] == "-1.0"
    for cell in (rows[1][0], rows[1][2]):
        assert cell.isprintable() and cell.lstrip()[0] not in "=+-@\uff1d"
    lines = markdown_table(["person", "PSNR"], [[name, "1.00"]]).splitlines()
    assert (
        len(lines) == 3 and lines[2].isprintable() and "<" not in lines[2] and "](" not in lines[2]
    )
    unescaped = lines[2].replace("\\\\", "").replace("\\|", "")
    assert unescaped.count("|") == 3 and "`" not in unescaped.replace("\\`", "")
    (row,) = [
        line
        for line in latex_table(["person", "PSNR"], [[name, "1.00"]]).splitlines()
        if "1.00" in line
    ]
    assert "\\input" not in row and row.isprintable()


@pytest.mark.parametrize("name", ["0012", "front", "a_b", "naïve 写真"])
def test_usual_names_stay(name):
    assert (
        csv_text([Scored(name, 0, name, {"psnr": 1.0})]).splitlines()[1] == f"{name},0,{name},1.0"
    )
    assert f"| {name} |" in markdown_table(["person"], [[name]])
