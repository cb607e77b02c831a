"""How well unseen synthetic people are reconstructed, by the number of photos."""

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
    """Unseen people from 1 to 6 photos against held-out views, in the pose of the photos and in
    others.

    The baseline is the body's mesh, each vertex painted with the mean color of the photos that see
    it (grey where none does). About 10 s of CPU time a person, and a minute or two of compiling.

    Options:
    views: numbers of photos that the network sees; they divide 12
    plot: PSNR against the number of photos
    """
    start, views = people.start(), tuple(sorted(set(views)))
    if any(count < 1 or RING % count for count in views):
        raise ValueError(f"--views: expected numbers that divide {RING}, got {views}")
    subject = functools.lru_cache(1)(lambda seed: start.subject(seed, views))

    def measure(seed, count):
        truth, inputs = subject(seed).held_out, subject(seed).inputs(count)
        drawn = predict_views(reconstruct(start.variables, start.config, inputs), truth).images
        ours, baseline = (
            score_tasks(x, truth, start.lpips)
            for x in (drawn, draw_painted_body(painted_body(inputs), truth))
        )

        def compared(task):
            return {
                f"baseline_{name}": baseline[task][name]
                for name in ("psnr", "ssim", "psnr_fg", "lpips")
            }

        return {task: ours[task] | compared(task) for task in ours}

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
    """Scores by number of photos and task, whether more photos help.

    by_views: scores by number of photos and seed. chosen: the number of photos of which single
    people are described.
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
    """Whether more photos are ever worse, and how many people beat their vertex-color baseline."""
    mean = [
        (n, float(np.mean([row[task]["psnr"] for row in rows.values()])))
        for n, rows in by_views.items()
    ]
    worse = [
        f"by {x - y:.2f} dB from {few} to {many} photos"
        for (few, x), (many, y) in itertools.pairwise(mean)
        if y < x
    ]
    said = (
        "on average, PSNR falls " + ", ".join(worse)
        if worse
        else "more photos are never worse on average"
    )
    rows = [row[task] for row in by_views[chosen].values()]
    whole, person = (
        sum(row[key] > row[f"baseline_{key}"] for row in rows) for key in ("psnr", "psnr_fg")
    )
    return (
        f"{TASKS[task].capitalize()}: {said}; with {chosen}, {whole} of {len(rows)} people have a"
        f" higher PSNR than their vertex-color baseline, {person} in the foreground alone."
    )


def plot_views(path: Path, mean: dict[int, Any]) -> None:
    """PSNR of the whole image and of the foreground against the number of photos, ours and the
    vertex-color baseline.
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
