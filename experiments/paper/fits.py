"""A system that is fitted to one person."""

import json
import tempfile
import time
from pathlib import Path
from typing import Any, Literal

from experiments.harness import Run, entry
from experiments.paper.rows import load_networks, measured, triple
from experiments.results import markdown_table, significant, write_json
from experiments.systems import SYSTEMS
from humangs_jax.data.capture import load_capture
from humangs_jax.data.loading import ViewSampling
from humangs_jax.data.loading.captures import find_captures
from humangs_jax.people.writer import Layout, write_set
from humangs_jax.training.config import LossConfig, OptimizerConfig, TrainConfig
from humangs_jax.training.loop import train

SYSTEM = "animatable"
QUICK_STEPS, QUICK_SIZE = 60, 128


@entry
def paper_fits(
    run: Run,
    people: Path | None = None,
    lpips: tuple[Path, ...] = (),
    quick: bool = False,
    out: Path | None = None,
    steps: int = 3000,
    size: Literal["bench", "published"] = "bench",
) -> None:
    """The Animatable-Gaussians-style system, fitted to one person after the other: its row of the paper's table 1.

    A fit starts from nothing, sees the photos of one capture only, and belongs to that person. Seconds of the fit, of a frame,
    for which the networks run again, and scores of held-out views: in a pose of the capture, and in others. A fit that was
    interrupted goes on when it is called again.

    Options:
    people: captures of several poses, with held_out/ (`humangs synth` writes both)
    lpips: weights of LPIPS vgg: BACKBONE and HEADS
    quick: a synthetic person of 128 pixels, and few steps
    out: folder of the fits; default: they are not kept
    steps: of each fit (theirs: 800,000)
    size: of the maps and networks
    """
    if not (people or quick):
        raise ValueError("--people is needed, or --quick")
    with tempfile.TemporaryDirectory() as folder:
        if people is None:
            people, steps = write_quick_person(Path(folder) / "people"), min(steps, QUICK_STEPS)
        place, networks, rows = out or Path(folder) / "fits", load_networks(lpips), {}
        for capture in find_captures(people):
            weights, seconds = fit(capture, place / capture.name, steps, size)
            found = measured(weights, capture, 1, None, networks)
            if found is not None:
                rows[capture.name] = found | {"fit_s": seconds, "steps": steps, "size": size}
    lines = [
        [
            name,
            significant(row["fit_s"]),
            significant(row["frame_s"]),
            triple(row["reconstruction"]),
            triple(row["animation"]),
        ]
        for name, row in rows.items()
    ]
    header = ["person", "fit, s", "frame, s", "pose of the capture", "another pose"]
    run.show(markdown_table(header, lines, "lrrrr"), rows)


def write_quick_person(folder: Path) -> Path:
    """A person in 6 frames of a motion, 4 views each; held out are 2 views of the first pose and of another one."""
    layout = Layout(QUICK_SIZE, poses=6, views=4, held_out_views=2, novel_poses=1, frames=60)
    write_set(folder, 1, layout, "test", progress=False)
    return folder


def configuration(steps: int, size: Any) -> Any:
    """Their loss without LPIPS, whose part structural dissimilarity takes: L1, and 0.005 of the squared offsets."""
    model = SYSTEMS[SYSTEM](size)
    return TrainConfig(
        model=model,
        views=ViewSampling(input_counts=(1,), target_count=3),  # a photo has to be given, and is not looked at
        loss=LossConfig(squared=0.0, absolute=1.0, tightness=0.005),
        optimizer=OptimizerConfig(learning_rate=5e-4 if size == "published" else 2e-3, warmup_steps=min(50, steps // 4)),
        target_size=model.conventions.image_size,
        steps=steps,
        log_every=min(20, steps),
        checkpoint_every=min(200, steps),
    )


def fit(capture: Path, out: Path, steps: int, size: Any) -> tuple[tuple[Any, Any], float]:
    """((variables, configuration), seconds of all calls) of one person, whose run is the folder `out`."""
    config, body = configuration(steps, size), load_capture(capture).body
    clock, start = out / "seconds.json", time.perf_counter()
    before = json.loads(clock.read_text()) if clock.exists() else 0.0
    state = train(config, body, [capture], out, progress=False)
    seconds = before + time.perf_counter() - start
    write_json(clock, seconds)
    if int(state.step) < steps:
        raise ValueError(f"{out}: interrupted at step {int(state.step)} of {steps}: call it again to go on")
    return (state.variables, config.model), seconds
