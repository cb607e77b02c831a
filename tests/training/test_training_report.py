"""The page of a training run, made of a run's files."""

import dataclasses
import json

import numpy as np
import pytest

from experiments.training import report
from experiments.training.plot import joined, steps_of, validations_of
from humangs_jax.core.configuration import config_to_json
from humangs_jax.io.images import write_png
from humangs_jax.training.config import tiny

STEPS, LOGGED, VALIDATED, SIZE = 40, 2, 10, 32
MACHINE = {"cores": 2, "architecture": "x86_64", "device": "cpu", "jax": "0.0"}


@pytest.fixture
def run(tmp_path):
    """The files of a run that was killed and went on, skipped a step, and waited for a tenth of its time."""
    folder = tmp_path / "run"
    (folder / "sheets").mkdir(parents=True)
    config = report.reported(dataclasses.replace(tiny(), ema_decay=0.5), STEPS)
    (folder / "config.json").write_text(config_to_json(config))
    facts = {"config": "tiny", "people": 3, "validation": 2, "people_s": 90.0, "peak_mb": 2048.0, "load": 1.5}
    (folder / "report.json").write_text(json.dumps(facts | {"machine": MACHINE, "sessions": 2}))
    lines, rng = [], np.random.default_rng(0)
    counts = {"dropped_tokens": 0, "dropped_reads": 0, "overflow": 0, "skipped": 1, "nonfinite": 1}
    for step in range(LOGGED, STEPS + 1, LOGGED):
        seconds = 30.0 if step == LOGGED else 2.0 if step % VALIDATED == LOGGED else 0.5
        times = {"seconds_per_step": seconds, "data_seconds_per_step": 0.05}
        lines.append({"step": step, "loss": 1.0 / step, "psnr": 10.0 + step, "grad_norm": 0.5} | counts | times)
        if step % VALIDATED == 0:
            lines.append({"step": step, "val_psnr": 20.0 + step / 10, "val_psnr_mask": 15.0, "val_ssim": 0.9})
            width = config.views.input_counts[0] + 2 * config.views.target_count
            write_png(folder / "sheets" / f"{step:07d}.png", rng.random((2 * SIZE, width * SIZE, 3), np.float32))
    lines.insert(3, {"step": 7, "event": "skipped", "loss": None, "grad_norm": 3.0, "skipped": 1, "nonfinite": 1})
    (folder / "log.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    return folder


def test_the_page_tells_what_the_files_hold(run, tmp_path):
    pytest.importorskip("matplotlib")
    page = tmp_path / "docs" / "page.md"
    page.parent.mkdir()
    page.write_text("".join(f"<!-- table: {name} -->\n<!-- end -->\n" for name in report.TABLES))
    report.write_report(run, page, tmp_path / "docs" / "images")
    text = page.read_text()
    assert "| preset `tiny` from fresh weights, 40 steps of " in text
    assert "| 20 | 0.0646 | 26.00 dB | 0.500 | 22.00 dB | 15.00 dB | 0.9000 | no weights |" in text
    assert "| a step | 0.50 s, 2.00 subjects a second (median) |" in text
    assert "| of that, waiting for data | 50 ms, 10.0% |" in text
    minutes = (2 * 30 + 3 * 2 * 2 + 16 * 2 * 0.5) / 60
    assert f"| {minutes:.1f} min in 2 session(s) |" in text and "| steps skipped | 1 |" in text
    assert "averaged weights (0.5) are validated" in " ".join(text.split()) and "nan" not in text
    from PIL import Image

    for name in (".png", "_progress.jpg", "_sheet.jpg"):
        with Image.open(page.parent / "images" / f"training_run{name}") as image:
            assert min(image.size) >= SIZE


def test_shown_validations_begin_dense_and_end_with_the_last():
    assert report.shown_steps(range(50, 501, 50)) == [50, 100, 150, 300, 500]
    assert report.shown_steps([7]) == [7] and report.shown_steps([1, 2]) == [1, 2]


def test_logs_that_continue_each_other_are_joined(run, monkeypatch):
    lines = joined([run / "log.jsonl"] * 2)
    assert [line["step"] for line in validations_of(lines)] == [10, 20, 30, 40, 50, 60, 70, 80]
    assert len(steps_of(lines)) == 2 * STEPS // LOGGED and all(line["loss"] for line in steps_of(lines))
