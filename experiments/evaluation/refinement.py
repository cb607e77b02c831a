"""What refinement gains on held-out views, against its seconds, from the feed-forward avatar or from random colors.

    python experiments/evaluation/refinement.py --subjects 8 --json refinement.json [--seconds 1 2 5 15] [--sizes 256 512]
        [--views 4] [--iterations 0 4] [--off 0 2.5 5] [--longest-edge 0.017]
        [--page docs/refinement.md] [--table NAME] [--plot PLOT] [--sheet SHEET] [--details SHEET]

People and held-out views are those of `evaluation/subjects.py`. "network" starts from the reconstruction, "random
colors" from as many round Gaussians of random colors on the vertices of the body. Scores: docs/evaluation.md.

--off gives the photos a wrong body. Its value is the standard deviation of the translation, in millimetres. For each millimetre,
joints turn by 0.2 degrees about each axis, and shape coefficients change by 0.02 (standard deviations). Held-out views show the
pose of the photos and are drawn with the same wrong body.

0 seconds are the start. A later run continues: finished people in the JSON with the same settings are not computed again.

Seconds do not count compilation. One device: one core of a CPU.
"""

import argparse
import dataclasses
import itertools
import sys
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[2]))
from experiments.common.results import markdown_table, publish, write_json
from experiments.evaluation.options import (
    add_people_options,
    check_people_options,
    load_network,
    seeds_asked_for,
    settings_of,
    shipped_digest,
)
from experiments.evaluation.results import TASK_NAMES, kept_rows
from humangs_jax.evaluation.tables import mean_scores
from humangs_jax.refinement.config import ITERATIONS, RefineConfig

DEGREES, SHAPES = 0.2, 0.02
"""Of --off: turn of a joint and change of a shape coefficient for each millimetre."""
STARTS = ("network", "random colors")
SHOWN = {
    "psnr": ("PSNR", 2),
    "psnr_fg": ("on the person", 2),
    "psnr_boundary": ("boundary", 2),
    "semi_transparent": ("semi_transparent", 3),
}


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add_people_options(parser, subjects=8)
    parser.add_argument("--seconds", type=float, nargs="*", default=[1, 2, 5, 15], help="lengths of the runs")
    parser.add_argument("--sizes", type=int, nargs="+", default=[256, 512], help="sides of the photos in pixels")
    parser.add_argument("--scored-at", type=int, help="side of the held-out views in pixels; default: as the photos")
    parser.add_argument("--views", type=int, nargs="+", default=[4], help="numbers of photos")
    parser.add_argument("--starts", nargs="+", choices=STARTS, default=["network"], help="what is refined")
    parser.add_argument(
        "--iterations", type=int, nargs="+", default=[0, ITERATIONS], help="of the learned update; 0: Adam alone"
    )
    parser.add_argument(
        "--off", type=float, nargs="+", default=[0.0], help="millimetres that the body is off, see above"
    )
    parser.add_argument("--refine-poses", action="store_true", help="the pose of each photo is refined, too")
    parser.add_argument("--longest-edge", type=float, help="split the body's edges to this, metres")
    parser.add_argument("--table", default="refinement", help="name of the table on the page")
    parser.add_argument("--plot", type=Path, help="draw PSNR against seconds here")
    parser.add_argument(
        "--sheet", type=Path, help="truth, feed-forward and the longest run of every person, largest size"
    )
    parser.add_argument("--details", type=Path, help="the same of faces, hands, hems and shoes")
    arguments = parser.parse_args()
    check_people_options(parser, arguments)
    report = evaluate(arguments)
    text = section(report)
    print(text)
    if arguments.page:
        numbers = {name: report[name] for name in ("settings", "means")} | {"people": len(report["subjects"])}
        publish(arguments.page, arguments.table, text, numbers)
    if arguments.plot:
        plot(arguments.plot, report)


def evaluate(arguments: argparse.Namespace) -> dict[str, Any]:
    """Rows of all people, written to the JSON after each."""
    from tqdm import tqdm

    from experiments.evaluation.pictures import cropped, write_triples
    from experiments.evaluation.subjects import HeldOut, make_evaluation_subject
    from humangs_jax.body.library import load_body
    from humangs_jax.refinement.learned import SHIPPED

    body, (variables, config, digest) = load_body(), load_network(arguments)
    drawing = arguments.sheet or arguments.details
    config = config.with_runtime(longest_edge=arguments.longest_edge)
    settings = settings_of(arguments, digest, config.tokens, None)
    settings |= {
        name: getattr(arguments, name)
        for name in ("seconds", "sizes", "views", "starts", "iterations", "off", "refine_poses", "longest_edge")
    }
    settings |= {"scored_at": arguments.scored_at} if arguments.scored_at else {}
    learned = any(arguments.iterations)
    settings |= {"refiner": shipped_digest(SHIPPED)} if learned else {}
    rows, images = kept_rows(arguments.json, settings, "cells"), {}
    held_out = HeldOut(arguments.held_out, arguments.poses, arguments.pose_views)
    seeds = seeds_asked_for(arguments, body)
    for seed in tqdm(seeds, desc="people"):
        if seed in rows and not drawing:
            continue
        row: dict[str, Any] = {}
        for size in arguments.sizes:
            subject = make_evaluation_subject(seed, body, arguments.views, size, held_out)
            if arguments.scored_at:
                scored = make_evaluation_subject(seed, body, arguments.views, arguments.scored_at, held_out)
                subject = dataclasses.replace(subject, held_out=scored.held_out)
            choices = (arguments.views, arguments.off, arguments.starts, arguments.iterations)
            for count, off, start, iterations in itertools.product(*choices):
                how = RefineConfig(iterations=iterations, poses=arguments.refine_poses)
                moved = with_body_off(subject, off)
                cell, drawn = measure(variables, config, moved, count, start, how, arguments.seconds)
                also = f", {iterations} iterations" if iterations else ""
                also += f", body {off:g} mm off" if off else ""
                row[f"{size} {count} {start}{also}"] = cell
                if start == "network" and count == max(arguments.views):
                    images[seed] = drawn
        rows[seed] = row
        if arguments.json:
            write_json(arguments.json, report_of(rows, settings, seeds))
    if arguments.sheet:
        write_triples(
            arguments.sheet, {seed: [cropped(image) for image in drawn] for seed, (drawn, _) in images.items()}
        )
    if arguments.details:
        write_triples(arguments.details, {seed: close for seed, (_, close) in images.items()}, 1)
    return report_of(rows, settings, seeds)


def with_body_off(subject, millimetres):
    """The person, whose photos and held-out views of the same pose come with a body that is off."""
    import jax.numpy as jnp
    import numpy as np

    from experiments.evaluation.subjects import task_views
    from humangs_jax.core.pytree import replace

    if not millimetres:
        return subject
    rng = np.random.default_rng(subject.seed)
    poses = subject.photos.poses
    off = lambda array, std: jnp.asarray(
        np.asarray(array) + millimetres * std * rng.normal(size=array.shape), jnp.float32
    )
    poses = replace(
        poses,
        rotations=off(poses.rotations[:1], np.radians(DEGREES)),
        translation=off(poses.translation[:1], 1e-3),
    )
    betas = off(np.asarray(subject.photos.betas), SHAPES)
    moved = lambda capture: dataclasses.replace(capture, poses=poses, betas=betas)
    still = subject.held_out.select(task_views(subject.held_out)["novel"])
    return dataclasses.replace(subject, photos=moved(subject.photos), held_out=moved(still))


def measure(variables, config, subject, count, start, how, seconds):
    """Scores by seconds and task; truth, feed-forward and refined of a held-out view from the front, whole and in details."""
    import numpy as np

    from experiments.evaluation.pictures import details, frontal_view
    from experiments.evaluation.subjects import task_views
    from humangs_jax.avatar.reconstruct import reconstruct
    from humangs_jax.refinement.refine import refine_with_report

    inputs = subject.inputs(count)
    avatar = reconstruct(variables, config, inputs)
    if start == "random colors":
        avatar = random_start(avatar, subject.seed)
    view = frontal_view(subject.photos, subject.held_out, task_views(subject.held_out)["novel"].tolist())
    scores, first = score_all(avatar, subject.held_out, view)
    cell, last = {"0": scores}, first
    for length in seconds:
        refined = refine_with_report(avatar, inputs, dataclasses.replace(how, seconds=length))
        scores, last = score_all(refined.avatar, subject.held_out, view)
        about = {"steps": refined.steps, "compile_seconds": round(refined.compile_seconds, 1), "kept": refined.kept}
        cell[f"{length:g}"] = scores | {"run": about | {"photos_psnr": refined.psnr[1]}}
    drawn = (subject.held_out.images[view], first, last)
    return cell, (drawn, [np.concatenate(list(details(image, subject.held_out, view)), axis=1) for image in drawn])


def random_start(avatar, seed):
    """Round Gaussians of random colors where the body's surface is, as many as the avatar has."""
    import jax.numpy as jnp
    import numpy as np

    from humangs_jax.core.pytree import replace

    rng = np.random.default_rng(seed)
    count = len(avatar.gaussians.means)
    means = jnp.repeat(avatar.rest_vertices, count // len(avatar.rest_vertices), axis=0)
    gaussians = replace(
        avatar.gaussians,
        means=means + jnp.asarray(0.005 * rng.normal(size=means.shape), jnp.float32),
        quats=jnp.tile(jnp.asarray([1.0, 0, 0, 0]), (count, 1)),
        scales=jnp.full((count, 3), 0.01),
        opacities=jnp.full(count, 0.5),
        colors=jnp.asarray(rng.random((count, 3)), jnp.float32),
        low_pass=None,
    )
    return replace(avatar, gaussians=gaussians, light=None)


def score_all(avatar, held_out, view=0):
    """Scores by task, also the semi-transparent foreground of the true images, and the image of a view."""
    from experiments.evaluation.subjects import score_tasks, task_views
    from humangs_jax.evaluation.cases import draw_views
    from humangs_jax.losses.metrics import semi_transparent

    drawn = draw_views(avatar, held_out)
    scores = score_tasks(drawn.images, held_out, alpha=drawn.alpha)
    for task, views in task_views(held_out).items():
        if task in scores:
            masks = held_out.masks[views]
            scores[task]["semi_transparent_of_truth"] = sum(
                float(semi_transparent(mask, mask)) for mask in masks
            ) / len(masks)
    return scores, drawn.images[view]


def report_of(rows, settings, seeds):
    """What the JSON holds."""
    done = [seed for seed in seeds if seed in rows]
    means: dict[str, Any] = {}
    for name in rows[done[0]]:
        means[name] = {}
        for seconds in rows[done[0]][name]:
            cells = [rows[seed][name][seconds] for seed in done]
            means[name][seconds] = {
                task: mean_scores(cell[task] for cell in cells) for task in TASK_NAMES if task in cells[0]
            }
            gains = [
                rows[seed][name][seconds]["novel"]["psnr"] - rows[seed][name]["0"]["novel"]["psnr"] for seed in done
            ]
            means[name][seconds]["least_gain"] = min(gains)
    people = [{"seed": seed, "cells": rows[seed]} for seed in done]
    return {"settings": settings, "means": means, "subjects": people, "others": []}


def section(report):
    """The table of the page."""
    header = ["photos", "start", "seconds", "task", *(heading for heading, _ in SHOWN.values()), "least gain"]
    rows = []
    for name, lengths in report["means"].items():
        size, count, start = name.split(" ", 2)
        for seconds, cell in lengths.items():
            for task, title in TASK_NAMES.items():
                if task in cell:
                    numbers = [f"{cell[task][key]:.{digits}f}" for key, (_, digits) in SHOWN.items()]
                    least = f"{cell['least_gain']:.2f}" if task == "novel" and seconds != "0" else ""
                    rows.append([f"{count} of {size} px", start, seconds, title, *numbers, least])
    settings, people = report["settings"], len(report["subjects"])
    about = f"Means over {people} people of the {settings['split']} seeds; PSNR in dB; least gain: of any person."
    scored_at = settings.get("scored_at")
    if scored_at:
        about += f" Views of {scored_at} px."
    true = {
        scored_at or name.split()[0]: lengths["0"]["novel"]["semi_transparent_of_truth"]
        for name, lengths in report["means"].items()
        if "semi_transparent_of_truth" in lengths["0"]["novel"]
    }
    if true:
        about += (
            " Semi-transparent foreground of the true images: "
            + ", ".join(f"{semi_transparent:.3f} at {size} px" for size, semi_transparent in true.items())
            + "."
        )
    return f"{about}\n\n{markdown_table(header, rows, 'llll' + 'r' * (len(SHOWN) + 1))}"


def plot(path, report):
    """PSNR of the whole image and on the person against seconds."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, 2, figsize=(9, 3.6))
    for axis, key in zip(axes, ("psnr", "psnr_fg"), strict=True):
        for i, (name, lengths) in enumerate(report["means"].items()):
            size, count, start = name.split(" ", 2)
            for task, style in zip(TASK_NAMES, ("o-", "s--"), strict=True):
                values = [cell[task][key] for cell in lengths.values() if task in cell]
                label = f"{count} photos of {size} px, {start}: {TASK_NAMES[task]}"
                axis.plot([float(x) for x in lengths][: len(values)], values, style, ms=4, color=f"C{i}", label=label)
        axis.set(xlabel="seconds", ylabel="PSNR, dB", title="whole image" if key == "psnr" else SHOWN[key][0])
        axis.set_xscale("symlog", linthresh=1)
        axis.grid(alpha=0.3)
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=2, fontsize=7)
    figure.tight_layout(rect=(0, 0.2, 1, 1))
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)
    plt.close(figure)


if __name__ == "__main__":
    main()
