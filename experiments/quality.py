"""Measures how well unseen synthetic people are reconstructed, by the number of photos."""

import functools
import itertools
import os
from pathlib import Path
from typing import Any

import numpy as np

from experiments.harness import Run, entry, figure, means
from experiments.results import cells, markdown_table, page_of
from experiments.subjects import RING, TASKS, People, score_tasks
from humangs_jax.avatar.reconstruct import reconstruct
from humangs_jax.evaluation.cases import draw_painted_body, painted_body, predict_views

COLUMNS = {  # heading and digits
    "psnr": ("PSNR", 2),
    "ssim": ("SSIM", 3),
    "lpips": ("LPIPS", 3),
    "psnr_fg": ("foreground PSNR", 2),
    "baseline_psnr": ("vertex-color baseline: PSNR", 2),
    "baseline_ssim": ("SSIM", 3),
    "baseline_lpips": ("LPIPS", 3),
    "baseline_psnr_fg": ("foreground PSNR", 2),
}


@entry
def evaluation_views(
    run: Run,
    people: People = People(32),
    views: tuple[int, ...] = (1, 2, 4, 6),
    plot: Path | None = None,
) -> None:
    """Compares unseen people, reconstructed from 1 to 6 photos, with held-out views in the pose of
    the photos and in other poses.

    The baseline is the body's mesh, with each vertex painted in the mean color of the photos that
    see it, and grey where none does. Takes about 10 s of CPU time a person, and a minute or two of
    compiling.

    Options:
    views: numbers of photos that the network sees; they divide 12
    plot: figure to write, with PSNR against the number of photos
    """
    start, views = people.start(), tuple(sorted(set(views)))
    if any(count < 1 or RING % count for count in views):
        raise ValueError(f"--views: expected numbers that divide {RING}, got {views}")

    @functools.lru_cache(1)
    def subject(seed):
        return start.subject(seed, views)

    # scores of a person by task, ours and those of the baseline
    def measure(seed, count):
        truth, inputs = subject(seed).held_out, subject(seed).inputs(count)
        drawn = predict_views(reconstruct(start.variables, start.config, inputs), truth).images
        painted = draw_painted_body(painted_body(inputs), truth)
        ours = score_tasks(drawn, truth, start.lpips)
        baseline = score_tasks(painted, truth, start.lpips)

        def compared(task):
            return {
                f"baseline_{name}": baseline[task][name]
                for name in ("psnr", "ssim", "psnr_fg", "lpips")
            }

        return {task: ours[task] | compared(task) for task in ours}

    # single people are described for one number of photos
    chosen = 4 if 4 in views else max(views)
    cases = {
        f"{s}, {n} photos": functools.partial(measure, s, n) for s in start.seeds for n in views
    }
    rows = run.rows(cases, start.settings)
    by_views = {n: {seed: rows[f"{seed}, {n} photos"] for seed in start.seeds} for n in views}
    section = views_section(by_views, chosen, start.about())
    if plot:
        plot_views(plot, {n: means(list(row.values())) for n, row in by_views.items()})
        link = Path(os.path.relpath(plot, page_of(run.table).parent)).as_posix()
        section += f"\n\n![PSNR against the number of photos]({link})"
    numbers = {n: means(list(row.values())) for n, row in by_views.items()}
    run.show(
        section,
        {
            "views": chosen,
            "by_views": numbers,
            "settings": start.settings,
            "people": len(start.seeds),
        },
    )


def views_section(by_views: dict[int, dict[int, Any]], chosen: int, about: str) -> str:
    """Formats scores by number of photos and task, and sentences on whether more photos help.

    Args:
        by_views: {number of photos: {seed: scores}}
        chosen: the number of photos for which single people are described
        about: the first paragraph
    """
    mean = {n: means(list(rows.values())) for n, rows in by_views.items()}
    tasks = [task for task in TASKS if task in mean[chosen]]
    columns = {
        key: column
        for key, column in COLUMNS.items()
        if mean[chosen][tasks[0]].get(key) is not None
    }
    rows = [[TASKS[task], n, *cells(mean[n][task], columns)] for task in tasks for n in mean]
    return "\n\n".join(
        (
            about,
            markdown_table(["task", "photos", *(heading for heading, _ in columns.values())], rows),
            " ".join(verdict(by_views, chosen, task) for task in tasks),
        )
    )


def verdict(by_views: dict[int, dict[int, Any]], chosen: int, task: str) -> str:
    """Describes whether more photos are ever worse, and how many people have better scores than
    their vertex-color baseline.
    """
    mean = [
        (n, float(np.mean([row[task]["psnr"] for row in rows.values()])))
        for n, rows in by_views.items()
    ]
    worse = [
        f"by {x - y:.2f} dB from {few} to {many} photos"
        for (few, x), (many, y) in itertools.pairwise(mean)
        if y < x
    ]
    trend = "more photos are never worse on average"
    if worse:
        trend = "on average, PSNR falls " + ", ".join(worse)
    rows = [row[task] for row in by_views[chosen].values()]
    whole, person = (
        sum(row[key] > row[f"baseline_{key}"] for row in rows) for key in ("psnr", "psnr_fg")
    )
    return (
        f"{TASKS[task].capitalize()}: {trend}; with {chosen}, {whole} of {len(rows)} people have a"
        f" higher PSNR than their vertex-color baseline, {person} in the foreground alone."
    )


def plot_views(path: Path, mean: dict[int, Any]) -> None:
    """Draws the PSNR of the whole image and of the foreground against the number of photos, of ours
    and of the vertex-color baseline.
    """
    with figure(path, 2, legend=0.15) as axes:
        for axis, key, title in zip(
            axes, ("psnr", "psnr_fg"), ("whole picture", "foreground PSNR"), strict=True
        ):
            for color, task in enumerate(TASKS):
                for prefix, style, name in (
                    ("", "o-", "ours"),
                    ("baseline_", "s--", "vertex-color baseline"),
                ):
                    values = [tasks[task][prefix + key] for tasks in mean.values() if task in tasks]
                    label = f"{name}: {TASKS[task]}"
                    axis.plot(
                        list(mean)[: len(values)],
                        values,
                        style,
                        ms=4,
                        color=f"C{color}",
                        label=label,
                    )
            axis.set(xlabel="photos", ylabel="PSNR, dB", title=title, xticks=list(mean))
