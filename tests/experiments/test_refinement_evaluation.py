"""Scores and table of `experiments/evaluation/refinement.py`, without rendering anybody."""

from experiments.evaluation.refinement import report_of, section

TASKS = ("novel", "animation")


def row(psnr):
    scores = {"psnr": psnr, "ssim": 0.9, "psnr_foreground": 18.0, "foreground": 0.1, "psnr_outline": 15.0, "fog": 0.1}
    return {task: scores for task in TASKS}


def test_means_gains_and_the_table():
    rows = {
        1: {"256 4 network": {"0": row(20.0), "5": row(22.0)}},
        2: {"256 4 network": {"0": row(24.0), "5": row(24.5)}},
    }
    report = report_of(rows, {"split": "test"}, [1, 2, 3])
    cell = report["means"]["256 4 network"]["5"]
    assert cell["novel"]["psnr"] == 23.25 and cell["least_gain"] == 0.5
    assert [person["seed"] for person in report["subjects"]] == [1, 2]
    table = section(report)
    assert "| 4 of 256 px | network | 5 | new views, same pose | 23.25 | 18.00 | 15.00 | 0.100 | 0.50 |" in table
    assert "| 4 of 256 px | network | 0 | new views, same pose | 22.00 | 18.00 | 15.00 | 0.100 |  |" in table
