"""Rows, means and tables of the evaluation: plain data, no images."""

import json

import pytest

from experiments.evaluation import results

SETTINGS = {
    "weights": "0123456789abcdef",
    "tokens": "all",
    "split": "test",
    "image_size": 64,
    "held_out": 8,
    "poses": 2,
    "pose_views": 4,
    "ring": 12,
    "generator": 2,
    "lpips_net": None,
}


def scores(psnr, baseline=15.0):
    return {
        "psnr": psnr,
        "ssim": 0.9,
        "psnr_fg": psnr - 6,
        "foreground": 0.1,
        "lpips": None,
        "baseline_psnr": baseline,
        "baseline_ssim": 0.8,
        "baseline_psnr_fg": 9.0,
        "baseline_lpips": None,
    }


def row(**psnr):
    return {count[1:]: {"novel": scores(x), "animation": scores(x - 1)} for count, x in psnr.items()}


def test_means_are_over_people_and_missing_scores_stay_missing():
    report = results.views_report({5: row(v1=20, v4=24), 7: row(v1=18, v4=28)}, SETTINGS, [5, 7], [1, 4])
    assert report["psnr"] == report["by_views"]["4"]["novel"]["psnr"] == 26 and report["views"] == 4
    assert report["by_views"]["1"]["animation"]["psnr"] == 18 and report["lpips"] is None
    assert [person["seed"] for person in report["subjects"]] == [5, 7] and report["subjects"][1]["psnr"] == 28
    assert results.mean_scores([{"lpips": 1.0}, {"lpips": None}]) == {"lpips": None}


def test_four_photos_stand_for_all_or_the_most():
    assert [results.headline(counts) for counts in ([1, 2, 4, 6], [1, 2], [6])] == ["4", "2", "6"]


def test_rows_are_kept_if_the_settings_are_the_same(tmp_path):
    rows = {5: row(v1=20, v4=24), 7: row(v4=25), 9: row(v1=3, v4=4)}
    report = results.views_report(rows, SETTINGS, [5, 7], [1, 4])
    assert [person["seed"] for person in report["subjects"]] == [5]  # 7 is not finished, 9 not asked for
    path = tmp_path / "a.json"
    assert results.kept_rows(path, SETTINGS, "by_views") == {}
    path.write_text(json.dumps(report))
    assert results.kept_rows(path, SETTINGS, "by_views") == rows
    assert results.kept_rows(path, SETTINGS | {"weights": "other"}, "by_views") == {}
    path.write_text('{"psnr": 26.0, "subjects": []}')  # of an earlier version
    assert results.kept_rows(path, SETTINGS, "by_views") == {}
    for text in ("not json", "[]"):
        path.write_text(text)
        with pytest.raises(ValueError, match=r"a\.json"):
            results.kept_rows(path, SETTINGS, "by_views")


def test_the_best_and_the_worst_are_different_people():
    rows = {seed: row(v4=20 + seed) for seed in range(13)}
    best, worst = results.extremes(results.views_report(rows, SETTINGS, range(13), [4]))
    assert [p["seed"] for p in best] == [12, 11, 10, 9, 8] and [p["seed"] for p in worst] == [0, 1, 2, 3, 4]
    best, worst = results.extremes(results.views_report(rows, SETTINGS, [3, 6, 4], [4]))
    assert [p["seed"] for p in best] == [6] and [p["seed"] for p in worst] == [3]
    best, worst = results.extremes(results.views_report(rows, SETTINGS, [3], [4]))
    assert [p["seed"] for p in best] == [3] and worst == []


def test_it_is_told_where_more_photos_are_worse():
    better = results.views_report({5: row(v1=20, v2=21, v4=22)}, SETTINGS, [5], [1, 2, 4])
    assert results.falls(better, "novel") == []
    assert "never worse" in results.verdict(better, "novel") and "1 of 1 people" in results.verdict(better, "novel")
    worse = results.views_report({5: row(v1=20, v2=19.5, v4=14)}, SETTINGS, [5], [1, 2, 4])
    said = results.verdict(worse, "animation")
    assert "by 0.50 dB from 1 to 2" in said and "by 5.50 dB from 2 to 4" in said and "0 of 1 people" in said


def test_the_page_has_the_tables_and_its_images(tmp_path):
    report = results.views_report({s: row(v1=20 + s, v4=24 + s) for s in (1, 2)}, SETTINGS, [1, 2], [1, 4])
    section = results.views_section(report, tmp_path / "docs/page.md", tmp_path / "docs/images/sheet.png")
    assert "| new views, unseen poses | 4 | 24.50 | 0.900 | 18.50 | 15.00 | 0.800 | 9.00 |" in section
    assert "LPIPS" not in section and "(images/sheet.png)" in section and "| worst 1 | 1 | 25.00 |" in section
    assert "-" in results.printed_table(report["by_views"])
