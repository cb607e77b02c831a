"""Measures what refinement gains, and makes README's tables of it."""

import dataclasses
import itertools
import json
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from experiments.harness import Run, entry, figure, means
from experiments.pictures import cropped, details, frontal_view, write_triples
from experiments.results import REPOSITORY, cells, markdown_table, significant
from experiments.subjects import TASKS, People, score_tasks, shipped_digest, task_views
from humangs_jax.avatar.reconstruct import reconstruct
from humangs_jax.core.pytree import replace
from humangs_jax.evaluation.cases import predict_views
from humangs_jax.losses.losses import semi_transparent
from humangs_jax.losses.perceptual import Lpips
from humangs_jax.refinement.config import ITERATIONS, RefineConfig
from humangs_jax.refinement.learned import SHIPPED
from humangs_jax.refinement.refine import refine_with_report

DEGREES, SHAPES = 0.2, 0.02
"""Standard deviations of a joint's turn in degrees and of the change of a shape coefficient, for
each millimetre of --off.
"""
SHOWN = {
    "psnr": ("PSNR", 2),
    "psnr_fg": ("foreground PSNR", 2),
    "lpips": ("LPIPS", 3),
    "psnr_boundary": ("silhouette", 2),
    "semi_transparent": ("semi-transparent foreground", 3),
}
OF_POSES = ("psnr", "psnr_fg", "lpips")
"""The scores of `SHOWN` that tables have of novel poses."""


@entry
def refinement(
    run: Run,
    people: People = People(8),
    seconds: tuple[float, ...] = (1, 5, 15),
    sizes: tuple[int, ...] = (256, 512),
    views: tuple[int, ...] = (4,),
    iterations: tuple[int, ...] = (0, ITERATIONS),
    off: tuple[float, ...] = (0.0,),
    plot: Path | None = None,
    sheet: Path | None = None,
    details_sheet: Path | None = None,
) -> None:
    """Measures what refinement gains on held-out views, against its seconds.

    0 seconds is the avatar before refinement. Seconds do not count compilation. The device is one
    core of a CPU. With --off, held-out views show the pose of the photos and are drawn with the
    same wrong body.

    Options:
    seconds: lengths of the runs
    sizes: sides of the photos in pixels (--size is not used)
    views: numbers of photos
    iterations: numbers of iterations of the learned update; 0: Adam alone
    off: standard deviations of the body's translation in millimetres; for each millimetre joints
    turn by 0.2 degrees, and shapes change by 0.02
    plot: figure to write, with PSNR against seconds
    sheet: image to write, with the truth, the feed-forward avatar and the longest run of every
    person at the largest size
    details_sheet: image to write, with faces, hands, hems and shoes of the same
    """
    start = people.start()
    settings: dict[str, Any] = {
        "seconds": seconds,
        "sizes": sizes,
        "views": views,
        "off": off,
        "iterations": iterations,
    }
    if any(iterations):
        settings["refiner"] = shipped_digest(SHIPPED)
    hows = {}
    for count in iterations:
        name = f"{count} iterations, Adam" if count else "Adam"
        hows[name] = RefineConfig(iterations=count)

    # every way to refine at every size, number of photos and error of the body
    def measure(seed):
        row, pictures = {}, None
        for size in sizes:
            subject = start.subject(seed, views, size)
            for count, wrong, how in itertools.product(views, off, hows):
                person = with_body_off(subject, wrong)
                cell, drawn = _refined(start, person, count, hows[how], seconds)
                row[f"{size} {count} {wrong:g} {how}"] = cell
                if count == max(views):
                    pictures = drawn
        return row, pictures

    rows = start.rows(run, measure, settings, bool(sheet or details_sheet))
    settings = start.settings | settings
    numbers = refinement_means(rows)
    text = refinement_section(numbers, settings, len(rows))
    run.show(text, {"settings": settings, "means": numbers, "people": len(rows)})

    # pictures of all people
    if sheet:
        strips = {seed: list(map(cropped, drawn)) for seed, (drawn, _) in run.pictures.items()}
        write_triples(sheet, strips)
    if details_sheet:
        write_triples(details_sheet, {seed: close for seed, (_, close) in run.pictures.items()}, 1)
    if plot:
        plot_refinement(plot, numbers)


def with_body_off(subject: Any, millimetres: float) -> Any:
    """Returns a person whose photos and held-out views of the same pose come with a body that is
    off.
    """
    if not millimetres:
        return subject
    poses, betas = subject.photos.poses[:1], subject.photos.betas
    poses, betas = body_off(poses, betas, millimetres, subject.seed)

    def moved(capture):
        return dataclasses.replace(capture, poses=poses, betas=betas)

    still = subject.held_out.select(task_views(subject.held_out)["novel"])
    return dataclasses.replace(subject, photos=moved(subject.photos), held_out=moved(still))


def body_off(poses: Any, betas: Any, millimetres: float, seed: int) -> tuple[Any, Any]:
    """Returns poses (p,) and shape coefficients with the errors of a fit, which are the same in all
    poses.
    """
    rng = np.random.default_rng(seed)

    def off(array, std):
        return jnp.asarray(millimetres * std * rng.normal(size=array.shape), jnp.float32)

    rotations = poses.rotations + off(poses.rotations[:1], np.radians(DEGREES))
    poses = replace(
        poses, rotations=rotations, translation=poses.translation + off(poses.translation[:1], 1e-3)
    )
    return poses, jnp.asarray(betas) + off(betas, SHAPES)


def _refined(start, subject, count, how, seconds):
    """Refines an avatar for each of the seconds.

    Returns {seconds: {task: scores}}, and pictures of a held-out view from the front: the truth,
    the feed-forward avatar and the longest refinement, as whole images and as details.
    """
    inputs = subject.inputs(count)
    avatar = reconstruct(start.variables, start.config, inputs)
    novel = task_views(subject.held_out)["novel"].tolist()
    view = frontal_view(subject.photos, subject.held_out, novel)
    scores, first = score_all(avatar, subject.held_out, start.lpips, view)
    cell, last = {"0": scores}, first
    for length in seconds:
        refined = refine_with_report(avatar, inputs, dataclasses.replace(how, seconds=length))
        scores, last = score_all(refined.avatar, subject.held_out, start.lpips, view)
        about = {
            "steps": refined.steps,
            "compile_seconds": round(refined.compile_seconds, 1),
            "kept": refined.kept,
        }
        cell[f"{length:g}"] = scores | {"run": about | {"photos_psnr": refined.psnr[1]}}
    drawn = (subject.held_out.images[view], first, last)
    close = [list(details(image, subject.held_out, view)) for image in drawn]
    return cell, (drawn, [np.concatenate(each, axis=1) for each in close])


def score_all(
    avatar: Any, held_out: Any, lpips: Lpips | None = None, view: int = 0
) -> tuple[dict[str, Any], np.ndarray]:
    """Returns {task: scores} of an avatar, and the image of a view.

    The scores also have the share of semi-transparent foreground in the true images.
    """
    drawn = predict_views(avatar, held_out)
    scores = score_tasks(drawn.images, held_out, lpips, drawn.alpha)
    for task, views in task_views(held_out).items():
        if task in scores:
            masks = jnp.asarray(held_out.masks)[views]
            true = [float(semi_transparent(mask, mask)) for mask in masks]
            scores[task]["semi_transparent_of_truth"] = sum(true) / len(true)
    return scores, drawn.images[view]


def refinement_means(rows: list[Any]) -> dict[str, Any]:
    """Returns {cell: {seconds: {task: mean scores, "least_gain": that of any person}}} of the rows
    of people.
    """
    found = {}
    for name, lengths in rows[0].items():
        found[name] = {}
        for seconds in lengths:
            known = [task for task in TASKS if task in lengths[seconds]]
            tasks = means([{task: row[name][seconds][task] for task in known} for row in rows])

            def gain(row, name=name, seconds=seconds):
                return row[name][seconds]["novel"]["psnr"] - row[name]["0"]["novel"]["psnr"]

            found[name][seconds] = tasks | {"least_gain": min(map(gain, rows))}
    return found


def refinement_section(numbers: dict[str, Any], settings: dict[str, Any], people: int) -> str:
    """Formats the table of the page.

    The avatar before refinement is shown once, because it is the same for all ways to refine.
    """
    # columns (task, score) that the rows have
    first, off = next(iter(numbers.values()))["0"], any(settings["off"])
    wanted = {"novel": tuple(SHOWN), "animation": OF_POSES}
    columns = [
        (task, key)
        for task in TASKS
        if task in first
        for key in wanted[task]
        if first[task].get(key) is not None
    ]

    # a line for each way to refine and its seconds
    rows, begun = [], set()
    for name, lengths in numbers.items():
        size, count, wrong, how = name.split(" ", 3)
        what = [f"{count} of {size} px"]
        if off:
            what.append(f"{wrong} mm")
        for seconds, cell in lengths.items():
            scores = [f"{cell[task][key]:.{SHOWN[key][1]}f}" for task, key in columns]
            if seconds != "0":
                rows.append([*what, how, seconds, *scores, f"{cell['least_gain']:.2f}"])
            elif tuple(what) not in begun:
                begun.add(tuple(what))
                rows.append([*what, "none", seconds, *scores, ""])

    # the first column of a task names the task
    header = ["photos", "body off"] if off else ["photos"]
    header += ["refinement", "seconds"]
    for task, key in columns:
        heading = SHOWN[key][0]
        header.append(f"{TASKS[task]}: {heading}" if key == "psnr" else heading)
    header.append("worst-subject gain")

    about = f"Means over {people} people of the {settings['split']} seeds; PSNR in dB"
    if settings.get("lpips_net"):
        about += f"; LPIPS {settings['lpips_net']}"
    about += (
        "; seconds: of the whole run on one core, without compilation; silhouette: PSNR within 3"
        " pixels (of 256) of the true one; worst-subject gain: the least of any person in novel"
        " views."
    )
    true = {
        name.split()[0]: lengths["0"]["novel"]["semi_transparent_of_truth"]
        for name, lengths in numbers.items()
        if "semi_transparent_of_truth" in lengths["0"]["novel"]
    }
    if true:
        shares = ", ".join(f"{share:.3f} at {size} px" for size, share in true.items())
        about += f" Semi-transparent foreground of the true images: {shares}."
    return f"{about}\n\n{markdown_table(header, rows, 'l' * (3 + off) + 'r' * (len(columns) + 1))}"


def plot_refinement(path: Path, numbers: dict[str, Any]) -> None:
    """Draws the PSNR of the whole image and of the foreground against seconds."""
    with figure(path, 2, (9, 3.6), legend=0.2) as axes:
        for axis, key, title in zip(
            axes, ("psnr", "psnr_fg"), ("whole image", SHOWN["psnr_fg"][0]), strict=True
        ):
            for i, (name, lengths) in enumerate(numbers.items()):
                size, count, _, how = name.split(" ", 3)
                for task, style in zip(TASKS, ("o-", "s--"), strict=True):
                    values = [cell[task][key] for cell in lengths.values() if task in cell]
                    label = f"{count} photos of {size} px, {how}: {TASKS[task]}"
                    axis.plot(
                        [float(x) for x in lengths][: len(values)],
                        values,
                        style,
                        ms=4,
                        color=f"C{i}",
                        label=label,
                    )
            axis.set(xlabel="seconds", ylabel="PSNR, dB", title=title)
            axis.set_xscale("symlog", linthresh=1)


# README
# --------------------------------------------------------------------------------------------------


@entry
def readme(run: Run, refined: Path, timed: Path | None = None) -> None:
    """Makes README's tables of quality and of the demo's times, from two runs of the demo and from
    tables of the docs.

    The runs are made by these commands, on an idle machine and without a compile cache:

        HUMANGS_COMPILE_CACHE=0 humangs demo --refine 0 --out a
        humangs demo --out b
        python -m experiments readme b/report.json --timed a/report.json

    Tables: readme_quality

    Options:
    refined: report of the refined demo
    timed: report of the unrefined demo, with nothing compiled before; default: times are not
    changed
    """
    paths = (
        REPOSITORY / "docs" / "results" / f"{name}.json"
        for name in ("evaluation_views", "appearance")
    )
    people = [json.loads(path.read_text())["numbers"] for path in paths]
    run.show(readme_quality(json.loads(refined.read_text()), *people), table="readme_quality")
    if timed:
        run.show(readme_times(json.loads(timed.read_text())), table="readme_demo")


def readme_quality(demo: dict[str, Any], people: dict[str, Any], refined: dict[str, Any]) -> str:
    """Formats README's table of quality, of the demo's person and of the test people.

    Args:
        demo: report of the refined demo
        people: numbers of the table evaluation_views
        refined: numbers of the table appearance

    Raises: ValueError if the demo was not refined, or if the two tables are of different weights.
    """
    if "refined" not in demo:
        raise ValueError(
            "the report of the refined demo has no refined scores: expected `humangs demo` without"
            " --refine 0"
        )
    if people["settings"]["weights"] != refined["settings"]["weights"]:
        raise ValueError(
            "evaluation_views and appearance are of different weights: measure them again"
        )

    def scored(size, task):
        return refined["means"]["all"][f"{size} 0 {task}"]["default"]

    columns = {"psnr": ("PSNR", 1), "psnr_fg": ("foreground PSNR", 1), "alex": ("LPIPS (Alex)", 3)}
    # evaluation_views has LPIPS of one network under another name
    own = {"psnr": "psnr", "psnr_fg": "psnr_fg"}
    if people["settings"].get("lpips_net") == "alex":
        own["alex"] = "lpips"
    feed_forward = people["by_views"]["4"]["novel"]
    rows = {
        f"{people['people']} synthetic people, 256 px, feed-forward": {
            name: feed_forward[key] for name, key in own.items()
        },
        f"{refined['people']} of them, with the default refinement": scored(256, "novel"),
        "the same, 512 px": scored(512, "novel"),
        "the same, 512 px, in poses that no photo shows": scored(512, "animation"),
        f"the demo's person, {demo['image_size'][0]} px, refined for 15 s": demo["refined"],
        "vertex-color baseline, 256 px": {
            name: feed_forward.get(f"baseline_{key}") for name, key in own.items()
        },
    }
    header = ["", *(heading for heading, _ in columns.values())]
    return markdown_table(
        header, [[name, *cells(scores, columns, "")] for name, scores in rows.items()]
    )


def readme_times(demo: dict[str, Any]) -> str:
    """Formats README's table of the demo's times, from the report of the unrefined demo."""
    spent, views = demo["timings"], demo["views"]
    photos = f"{views['input']} photos of {demo['image_size'][0]} px"
    stages = {
        f"reconstruct: {photos} -> {demo['gaussians']:,} Gaussians": "reconstruct",
        "animate: one pose": "animate",
        f"render {views['held_out']} views": "render_held_out",
    }

    def seconds(stage):
        return [
            f"{spent[stage]['compile']:.1f} s",
            f"{significant(1000 * spent[stage]['run'])} ms",
        ]

    rows = [[name, *seconds(stage)] for name, stage in stages.items()]
    whole = [
        "everything, files included, without refinement (`--refine 0`)",
        "",
        f"{demo['total_seconds']:.0f} s",
    ]
    return markdown_table(["stage", "compile", "run"], [*rows, whole], "lll")
