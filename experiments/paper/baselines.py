"""Baselines of the bench: the vertex-color baseline, a system fitted to one person."""

import json
import tempfile
import time
from pathlib import Path
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np

from experiments.harness import Run, entry
from experiments.paper.bench import PAINTED, PHOTOS, TARGETS, load_networks, measured, triple
from experiments.results import markdown_table, significant, write_json
from experiments.systems import SYSTEMS
from humangs_jax.data.capture import load_capture
from humangs_jax.data.loading import CaptureCache, ViewSampling
from humangs_jax.data.loading.captures import find_captures, subject_order, view_generator
from humangs_jax.data.loading.examples import draw_views
from humangs_jax.evaluation.cases import draw_painted_body, find_people, painted_body
from humangs_jax.losses.metrics import masked_psnr, psnr, similarity_map
from humangs_jax.people.writer import Layout, write_set
from humangs_jax.training.config import LossConfig, OptimizerConfig, TrainConfig
from humangs_jax.training.loop import train

VALIDATED = 8
COUNTS = (1, PHOTOS)


@entry
def paper_painted(run: Run, validation: Path, people: Path) -> None:
    """The vertex-color baseline on the people of the bench: what a system must beat before it counts as trained.

    The vertices have the mean colors of the photos that see them, grey where none does. Folders that are missing are made.

    Options:
    validation: the folder `validation` of the OUT of `paper`, scored on the views on which it scores every variant
    people: the --people of `paper_tables`, scored as there, in the pose of the photos
    """
    numbers = {
        "validation": {str(count): on_validation(made(validation, "validation"), count) for count in COUNTS},
        "test": {str(count): on_test(made(people, "test"), count) for count in COUNTS},
    }
    rows = [
        [f"{PAINTED}, {split} people", count, f"{x['psnr']:.2f}", f"{x['psnr_fg']:.2f}", f"{x['ssim']:.3f}"]
        for split, counts in numbers.items()
        for count, x in counts.items()
    ]
    run.show(markdown_table(["", "photos", "PSNR, dB", "foreground PSNR, dB", "SSIM"], rows), numbers)


def made(folder: Path, split: Any) -> Path:
    """The folder, with people as docs/paper.md says if there were none."""
    if not folder.is_dir():
        validation, test = Layout(128, views=12, poses=2), Layout(128, views=12, held_out_views=4, novel_poses=2)
        write_set(folder, VALIDATED, validation if split == "validation" else test, split)
    return folder


def on_validation(folder: Path, count: int) -> dict[str, float]:
    """Scores of the views on which `bench.score` compares variants: drawn as `training.forward` draws them."""
    folders, rows = find_captures(folder)[:VALIDATED], []
    cache = CaptureCache(folders, load_capture(folders[0]).body)
    sampling = ViewSampling((count,), target_count=TARGETS, jitter=0.0, scattered_share=0.0, mixed_pose_share=0.0)
    for index, subject in enumerate(subject_order(0, 0, len(folders))):
        summary = cache.summary(int(subject))
        assert summary is not None
        inputs, targets = draw_views(view_generator(0, index), summary, count, sampling)
        capture = load_capture(folders[int(subject)])
        rows.append(scores(capture.select(inputs), capture.select(targets)))
    return {name: float(np.mean([row[name] for row in rows])) for name in rows[0]}


def on_test(folder: Path, count: int) -> dict[str, float]:
    """Scores as in tables.py, of the views in the pose of the photos."""
    people, rows = find_people(folder, count, None, None), []
    for index in range(len(people.names)):
        case = people.load(index)
        own = np.flatnonzero(np.asarray(case.truth.frames) == 0)
        rows.append(scores(case.inputs, case.truth.select(own.tolist())))
    return {name: float(np.mean([row[name] for row in rows])) for name in rows[0]}


def scores(inputs: Any, truth: Any) -> dict[str, float]:
    """Means over the views, with the names of `bench.SCORES`."""
    images, masks = jnp.asarray(truth.images), jnp.asarray(truth.masks)
    shown = jnp.clip(draw_painted_body(painted_body(inputs), truth), 0, 1)
    return {
        "psnr": float(jnp.mean(jax.vmap(psnr)(shown, images))),
        "psnr_fg": float(jnp.mean(jax.vmap(masked_psnr)(shown, images, masks))),
        "ssim": float(jnp.mean(jax.vmap(similarity_map)(shown, images))),
    }


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
