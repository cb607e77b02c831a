"""The sweep of speed against accuracy: its points, its front, and its files."""

from experiments import tradeoff_report as report
from experiments.tradeoff_report import points


def row(name, reconstruct, frame, psnr, start="network", steps=0):
    scores = {task: {"psnr": psnr, "ssim": 0.9, "psnr_fg": psnr - 6} for task in report.TASKS}
    settings = {"refine_iterations": 0, "refine_steps": steps}
    return {
        "name": name,
        "reconstruct": reconstruct,
        "frame": frame,
        "start": start,
        "size": 512,
        "settings": settings,
    } | scores


def test_the_front_has_what_nothing_else_beats():
    rows = [
        row("fast", 0.3, 0.7, 20),
        row("slow", 1, 1, 22),
        row("refined", 9, 1, 25, steps=100),
        row("beaten", 1.2, 1.1, 21),
        row("slower to draw, better", 1, 2, 24),
        row("naive", 0.1, 0.1, 30, start="vertex-color baseline"),
        row("large", 0.1, 0.1, 30) | {"size": 1024},
    ]
    assert [r["name"] for r in report.front_of(rows)] == [
        "fast",
        "slow",
        "slower to draw, better",
        "refined",
    ]
    assert [report.kind(r) for r in rows[:3]] == ["feed-forward", "feed-forward", "refined"]


def test_the_points_are_many_and_change_one_knob_each():
    found = points()
    names, knobs = (
        [p.name for p in found],
        {p.knob for p in found} - {"default", "combined", "preset"},
    )
    assert len(set(names)) == len(names) >= 60 and len(knobs) >= 8
    default = found[0]
    assert (
        len({(p.settings, p.size, p.start) for p in found if p.knob != "preset"}) == len(found) - 4
    )
    for each in (
        p
        for p in found
        if p.knob in ("photos", "photo size", "precision", "splat preset", "frame size")
    ):
        changed = [
            (each.size, default.size),
            (each.settings.views, default.settings.views),
            (each.settings.runtime, default.settings.runtime),
            (each.settings.splat, default.settings.splat),
        ]
        assert sum(a != b for a, b in changed) == 1, each
