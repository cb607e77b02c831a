"""The table of keypoint fits is resumed."""

import json

from experiments.fitting.keypoints import Bench, measured


def record(views, error):
    setting = {"keypoints": "coco17", "views": views, "noise_px": 2.0, "outliers": 0.2, "people": 4, "frames": 16}
    return setting | {"mean_joint_error_mm": error}


def test_what_an_interrupted_run_measured_is_kept(tmp_path, monkeypatch):
    path = tmp_path / "fit.json"
    assert measured(path) == []
    whole = record(4, 5.0) | {"without_outliers": record(4, 4.0) | {"outliers": 0.0}, "over_views": [record(2, 9.0)]}
    path.write_text(json.dumps(whole))
    bench = Bench(4, 16, measured(path))
    monkeypatch.setattr(bench, "errors", lambda *setting: {"mean_joint_error_mm": 1.0})
    found = lambda views, outliers: bench.measure("coco17", views, 2.0, outliers)["mean_joint_error_mm"]
    assert (found(4, 0.2), found(4, 0.0), found(2, 0.2)) == (5.0, 4.0, 9.0)
    assert found(8, 0.2) == 1.0 and bench.measure("coco17", 8, 2.0, 0.2) == record(8, 1.0)
