"""What refinement gains, and README's tables, which are made of it."""

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
"""Of --off: turn of a joint and change of a shape coefficient (standard deviations) for each
millimetre.
"""
SHOWN = {
    "psnr": ("PSNR", 2),
    "psnr_fg": ("foreground PSNR", 2),
    "lpips": ("LPIPS", 3),
    "psnr_boundary": ("silhouette", 2),
    "semi_transparent": ("semi-transparent foreground", 3),
}
OF_POSES = ("psnr", "psnr_fg", "lpips")
"""Of `SHOWN`, those that tables have of novel poses."""


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
    """What refinement gains on held-out views, against its seconds.

    0 seconds are the start; seconds do not count compilation. One device: one core of a CPU. With
    --off, held-out views show the pose of the photos and are drawn with the same wrong body.

    Options:
    seconds: lengths of the runs
    sizes: sides of the photos in pixels (--size is not used)
    views: numbers of photos
    iterations: of the learned update; 0: Adam alone
    off: standard deviations of the body's translation, millimetres; for each, joints turn by 0.2
    degrees, shapes change by 0.02
    plot: PSNR against seconds
    sheet: truth, feed-forward and the longest run of every person, largest size
    details_sheet: the same of faces, hands, hems and shoes
    """
    start = people.start()
    settings: dict[str, Any] = {
        "seconds": seconds,
        "sizes": sizes,
        "views": views,
        "off": off,
        "iterations": iterations,
    }
    settings |= {"refiner": shipped_digest(SHIPPED)} if any(iterations) else {}
    hows = {
        f"{n} iterations, Adam" if n else "Adam": RefineConfig(iterations=n) for n in iterations
    }

    def measure(seed):
        row, pictures = {}, None
        for size in sizes:
            subject = start.subject(seed, views, size)
            for count, wrong, how in itertools.product(views, off, hows):
                cell, drawn = _refined(
                    start, with_body_off(subject, wrong), count, hows[how], seconds
                )
                row[f"{size} {count} {wrong:g} {how}"] = cell
                pictures = drawn if count == max(views) else pictures
        return row, pictures

    rows, settings = (
        start.rows(run, measure, settings, bool(sheet or details_sheet)),
        start.settings | settings,
    )
    numbers = refinement_means(rows)
    run.show(
        refinement_section(numbers, settings, len(rows)),
        {"settings": settings, "means": numbers, "people": len(rows)},
    )
    if sheet:
        write_triples(
            sheet,
            {
                seed: [cropped(image) for image in drawn]
                for seed, (drawn, _) in run.pictures.items()
            },
        )
    if details_sheet:
        write_triples(details_sheet, {seed: close for seed, (_, close) in run.pictures.items()}, 1)
    if plot:
        plot_refinement(plot, numbers)


def with_body_off(subject: Any, millimetres: float) -> Any:
    """The person, whose photos and held-out views of the same pose come with a body that is off."""
    if not millimetres:
        return subject
    poses, betas = subject.photos.poses[:1], subject.photos.betas
    poses, betas = body_off(poses, betas, millimetres, subject.seed)

    def moved(capture):
        return dataclasses.replace(capture, poses=poses, betas=betas)

    still = subject.held_out.select(task_views(subject.held_out)["novel"])
    return dataclasses.replace(subject, photos=moved(subject.photos), held_out=moved(still))


def body_off(poses: Any, betas: Any, millimetres: float, seed: int) -> tuple[Any, Any]:
    """Poses (p,) and shape coefficients with the errors of a fit, the same of all poses."""
    rng = np.random.default_rng(seed)

    def off(array, std):
        return jnp.asarray(millimetres * std * rng.normal(size=array.shape), jnp.float32)

    rotations = poses.rotations + off(poses.rotations[:1], np.radians(DEGREES))
    poses = replace(
        poses, rotations=rotations, translation=poses.translation + off(poses.translation[:1], 1e-3)
    )
    return poses, jnp.asarray(betas) + off(betas, SHAPES)


def _refined(start, subject, count, how, seconds):
    """Scores by seconds and task; truth, feed-forward and refined of a held-out view from the
    front, whole and in details.
    """
    inputs = subject.inputs(count)
    avatar = reconstruct(start.variables, start.config, inputs)
    view = frontal_view(
        subject.photos, subject.held_out, task_views(subject.held_out)["novel"].tolist()
    )
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
    return cell, (
        drawn,
        [np.concatenate(list(details(image, subject.held_out, view)), axis=1) for image in drawn],
    )


def score_all(
    avatar: Any, held_out: Any, lpips: Lpips | None = None, view: int = 0
) -> tuple[dict[str, Any], np.ndarray]:
    """Scores by task, also the semi-transparent foreground of the true images, and the image of a
    view.
    """
    drawn = predict_views(avatar, held_out)
    scores = score_tasks(drawn.images, held_out, lpips, drawn.alpha)
    for task, views in task_views(held_out).items():
        if task in scores:
            true = [
                float(semi_transparent(mask, mask)) for mask in jnp.asarray(held_out.masks)[views]
            ]
            scores[task]["semi_transparent_of_truth"] = sum(true) / len(true)
    return scores, drawn.images[view]


def refinement_means(rows: list[Any]) -> dict[str, Any]:
    """{cell: {seconds: {task: mean scores, "least_gain": of any person}}} of people's rows."""
    found = {}
    for name, lengths in rows[0].items():
        found[name] = {}
        for seconds in lengths:
            tasks = means(
                [
                    {task: row[name][seconds][task] for task in TASKS if task in lengths[seconds]}
                    for row in rows
                ]
            )

            def gain(row, name=name, seconds=seconds):
                return row[name][seconds]["novel"]["psnr"] - row[name]["0"]["novel"]["psnr"]

            found[name][seconds] = tasks | {"least_gain": min(map(gain, rows))}
    return found


def refinement_section(numbers: dict[str, Any], settings: dict[str, Any], people: int) -> str:
    """The table of the page. Starts are shown once: they are those of all ways to refine."""
    first, off, rows, begun = next(iter(numbers.values()))["0"], any(settings["off"]), [], set()
    wanted = {"novel": tuple(SHOWN), "animation": OF_POSES}
    columns = [
        (t, k) for t in TASKS if t in first for k in wanted[t] if first[t].get(k) is not None
    ]
    for name, lengths in numbers.items():
        size, count, wrong, how = name.split(" ", 3)
        what = [f"{count} of {size} px", *([f"{wrong} mm"] if off else [])]
        for seconds, cell in lengths.items():
            scores = [f"{cell[task][key]:.{SHOWN[key][1]}f}" for task, key in columns]
            if seconds != "0":
                rows.append([*what, how, seconds, *scores, f"{cell['least_gain']:.2f}"])
            elif tuple(what) not in begun:
                begun.add(tuple(what))
                rows.append([*what, "none", seconds, *scores, ""])
    names = [(f"{TASKS[task]}: " if key == "psnr" else "") + SHOWN[key][0] for task, key in columns]
    header = [
        "photos",
        *(["body off"] if off else []),
        "refinement",
        "seconds",
        *names,
        "worst-subject gain",
    ]
    about = (
        f"Means over {people} people of the {settings['split']} seeds; PSNR in dB"
        + (f"; LPIPS {settings['lpips_net']}" if settings.get("lpips_net") else "")
        + "; seconds: of the whole run on one core, without compilation; silhouette: PSNR within 3"
        " pixels (of 256) of the true "
        + "one; worst-subject gain: the least of any person in novel views."
    )
    true = {
        name.split()[0]: lengths["0"]["novel"]["semi_transparent_of_truth"]
        for name, lengths in numbers.items()
        if "semi_transparent_of_truth" in lengths["0"]["novel"]
    }
    shares = ", ".join(f"{share:.3f} at {size} px" for size, share in true.items())
    about += f" Semi-transparent foreground of the true images: {shares}." if true else ""
    return f"{about}\n\n{markdown_table(header, rows, 'l' * (3 + off) + 'r' * (len(columns) + 1))}"


def plot_refinement(path: Path, numbers: dict[str, Any]) -> None:
    """PSNR of the whole image and of the foreground against seconds."""
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
    """README's tables of quality and of the demo's times, from two runs of the demo and from tables
    of the docs.

    HUMANGS_COMPILE_CACHE=0 humangs demo --refine 0 --out a && humangs demo --out b; readme
    b/report.json --timed a/report.json Times are those of an idle machine, from an empty compile
    cache.

    Tables: readme_quality

    Options:
    refined: report of the refined demo
    timed: report of the unrefined demo, nothing compiled before; without it times stay
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
    """The demo person and the test people.

    Raises: ValueError if the demo was not refined, or the weights of the two tables are not the
    same.
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
    own = {"psnr": "psnr", "psnr_fg": "psnr_fg"} | (
        {"alex": "lpips"} if people["settings"].get("lpips_net") == "alex" else {}
    )
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
