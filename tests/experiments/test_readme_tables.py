"""README's tables from what the demo and the evaluation have written."""

import pytest

from experiments.evaluation.readme import quality, times

SCORES = {"psnr": 27.44, "ssim": 0.9464, "psnr_fg": 18.75}
BASELINE = {"baseline_psnr": 20.67, "baseline_ssim": 0.871, "baseline_psnr_fg": 11.28}
STAGES = {"reconstruct": (11.63, 0.291), "animate": (2.07, 0.0341), "render_held_out": (6.87, 0.1236)}
DEMO = {
    **SCORES,
    **BASELINE,
    "views": {"input": 4, "held_out": 6},
    "image_size": [256, 256],
    "gaussians": 20376,
    "timings": {name: {"compile": first, "run": run} for name, (first, run) in STAGES.items()},
    "total_seconds": 39.5,
}


def test_quality():
    settings = {"settings": {"weights": "a"}}
    people = settings | {
        "people": 3,
        "by_views": {"4": {task: SCORES | BASELINE for task in ("novel", "animation")}},
    }
    lengths = {seconds: {task: SCORES for task in ("novel", "animation")} for seconds in ("0", "1", "15")}
    means = {f"{size} 4 network, 4 iterations": lengths for size in (256, 512)}
    refined = settings | {"people": 3, "means": means}
    demo = DEMO | {"refined": SCORES | {"psnr": 29.16, "seconds": 15.2}}
    rows = quality(demo, people, refined).splitlines()[2:]
    assert rows[0] == "| 3 synthetic people, 256 px, feed-forward | 27.4 | 0.946 | 18.8 |"
    assert rows[4] == "| the demo's person, 256 px, refined for 15 s | 29.2 | 0.946 | 18.8 |"
    assert rows[5] == "| baseline: the painted body mesh, 256 px | 20.7 | 0.871 | 11.3 |" and len(rows) == 6
    with pytest.raises(ValueError, match="expected `humangs demo` without"):
        quality(DEMO, people, refined)
    with pytest.raises(ValueError, match="2 people were refined: expected the same 3"):
        quality(demo, people, refined | {"people": 2})
    with pytest.raises(ValueError, match="of different weights"):
        quality(demo, people, refined | {"settings": {"weights": "b"}})


def test_times():
    rows = times(DEMO).splitlines()[2:]
    assert rows[0] == "| reconstruct: 4 photos of 256 px -> 20,376 Gaussians | 11.6 s | 291 ms |"
    assert rows[1] == "| animate: one pose | 2.1 s | 34 ms |" and rows[3].endswith("|  | 40 s |")
