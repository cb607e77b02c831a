"""How well unseen synthetic people are reconstructed, and what changes that: number of photos, light, masks, choice of photos."""

import dataclasses
import functools
import itertools
import os
from pathlib import Path
from typing import Any

import numpy as np

from experiments.changes import grown
from experiments.harness import Run, entry, figure, means
from experiments.pictures import cropped, frontal_view, write_triples
from experiments.results import cells, markdown_table, page_of
from experiments.subjects import RING, TASKS, HeldOut, People, score_tasks, shipped_digest
from humangs_jax.avatar.reconstruct import reconstruct
from humangs_jax.data.masks import masks_at_edges
from humangs_jax.data.photos import cut_out
from humangs_jax.evaluation.cases import draw_painted_body, draw_views, painted_body
from humangs_jax.refinement.config import RefineConfig
from humangs_jax.refinement.learned import SHIPPED as SHIPPED_REFINER
from humangs_jax.refinement.refine import refine

PHOTOS = 4
AVATARS, ITERATIONS_ALONE = ("pass", "4 iterations"), RefineConfig(steps=0, seconds=None)

# Numbers of photos ---------------------------------------------------------------------------------------------------

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
    run: Run, people: People = People(32), views: tuple[int, ...] = (1, 2, 4, 6), plot: Path | None = None
) -> None:
    """Unseen people from 1 to 6 photos against held-out views, in the pose of the photos and in others.

    The baseline is the body's mesh, each vertex painted with the mean color of the photos that see it (grey where none does).
    About 10 s of CPU time a person, and a minute or two of compiling.

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
        drawn = draw_views(reconstruct(start.variables, start.config, inputs), truth).images
        ours, baseline = (score_tasks(x, truth, start.lpips) for x in (drawn, draw_painted_body(painted_body(inputs), truth)))
        compared = lambda task: {f"baseline_{name}": baseline[task][name] for name in ("psnr", "ssim", "psnr_fg", "lpips")}
        return {task: ours[task] | compared(task) for task in ours}

    chosen = 4 if 4 in views else max(views)
    cases = {f"{s}, {n} photos": functools.partial(measure, s, n) for s in start.seeds for n in views}
    rows = run.rows(cases, start.settings)
    by_views = {n: {seed: rows[f"{seed}, {n} photos"] for seed in start.seeds} for n in views}
    section = views_section(by_views, chosen, start.about())
    if plot:
        plot_views(plot, {n: means(list(row.values())) for n, row in by_views.items()})
        link = Path(os.path.relpath(plot, page_of(run.table).parent)).as_posix()
        section += f"\n\n![PSNR against the number of photos]({link})"
    numbers = {n: means(list(row.values())) for n, row in by_views.items()}
    run.show(section, {"views": chosen, "by_views": numbers, "settings": start.settings, "people": len(start.seeds)})


def views_section(by_views: dict[int, dict[int, Any]], chosen: int, about: str) -> str:
    """Scores by number of photos and task, whether more photos help.

    by_views: scores by number of photos and seed. chosen: the number of photos of what is said of single people.
    """
    mean = {n: means(list(rows.values())) for n, rows in by_views.items()}
    tasks = [task for task in TASKS if task in mean[chosen]]
    columns = {key: column for key, column in COLUMNS.items() if mean[chosen][tasks[0]].get(key) is not None}
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
    mean = [(n, float(np.mean([row[task]["psnr"] for row in rows.values()]))) for n, rows in by_views.items()]
    worse = [f"by {x - y:.2f} dB from {few} to {many} photos" for (few, x), (many, y) in itertools.pairwise(mean) if y < x]
    said = "on average, PSNR falls " + ", ".join(worse) if worse else "more photos are never worse on average"
    rows = [row[task] for row in by_views[chosen].values()]
    whole, person = (sum(row[key] > row[f"baseline_{key}"] for row in rows) for key in ("psnr", "psnr_fg"))
    return (
        f"{TASKS[task].capitalize()}: {said}; with {chosen}, {whole} of {len(rows)} people have a higher PSNR than "
        f"their vertex-color baseline, {person} in the foreground alone."
    )


def plot_views(path: Path, mean: dict[int, Any]) -> None:
    """PSNR of the whole image and of the foreground against the number of photos, ours and the vertex-color baseline."""
    with figure(path, 2, legend=0.15) as axes:
        for axis, key, title in zip(axes, ("psnr", "psnr_fg"), ("whole picture", "foreground PSNR"), strict=True):
            for color, task in enumerate(TASKS):
                for prefix, style, name in (("", "o-", "ours"), ("baseline_", "s--", "vertex-color baseline")):
                    values = [tasks[task][prefix + key] for tasks in mean.values() if task in tasks]
                    label = f"{name}: {TASKS[task]}"
                    axis.plot(list(mean)[: len(values)], values, style, ms=4, color=f"C{color}", label=label)
            axis.set(xlabel="photos", ylabel="PSNR, dB", title=title, xticks=list(mean))


# Masks ---------------------------------------------------------------------------------------------------------------

ERRORS = (0, -1, 1, -3, 3)
"""Pixels of 256 that the masks are too large."""
BOXES, LARGEST, NOISE = 120, 0.3, 0.03
"""Of a room: how many, their largest side in image heights, standard deviation of the noise on the photo."""


@entry
def masks(run: Run, people: People = People(8), sheet: Path | None = None) -> None:
    """What masks that are too large or too small cost, as they are and moved to the edges in the photos.

    Four photos of each person in front of a room of 120 boxes of random colors, which a mask that is too large lets through.
    Masks are dilated or eroded by squares. "Exact": the true masks, and photos that were on white from the start.

    Options:
    sheet: JPEG of every person: truth, masks as they are, masks that were moved
    """
    start, refiner = people.start(), {"refiner": shipped_digest(SHIPPED_REFINER)}
    mean = means(start.rows(run, functools.partial(_masks_of, start), refiner, again=bool(sheet)))
    if sheet:
        write_triples(sheet, run.pictures, 2, ("truth", "masks 3 pixels too large", "moved to the edges"))
    both = lambda name: [f"{mean[f'{name}, {avatar}'][key]:.2f}" for key in ("psnr", "psnr_fg") for avatar in AVATARS]
    rows = [["exact", "photos on white", *both("exact")]]
    for error in ERRORS:
        rows += [[f"{error:+d}" if error else "0", how, *both(f"{error}, {how}")] for how in ("as they are", "moved")]
    header = ["masks, pixels of 256", "used", *AVATARS, *(f"foreground PSNR, {avatar}" for avatar in AVATARS)]
    about = f"Means over {len(start.seeds)} people of the {people.split} seeds, {PHOTOS} photos of {people.size} px; PSNR in dB."
    run.show(f"{about}\n\n{markdown_table(header, rows, 'llrrrr')}", {"settings": start.settings | refiner, "means": mean})


def _masks_of(start, seed):
    """Scores by masks and avatar of one person; a held-out view, true, and after the iterations without and with moved masks."""
    subject = start._replace(held_out=HeldOut(start.held_out.views, 0, 0)).subject(seed, [PHOTOS])
    inputs, held_out = subject.inputs(PHOTOS), subject.held_out
    view = frontal_view(inputs, held_out, list(range(held_out.view_count)))
    found, shown = {}, [held_out.images[view]]

    def scored(name, photos):
        avatar = reconstruct(start.variables, start.config, photos)
        for label, made in zip(AVATARS, (avatar, refine(avatar, photos, ITERATIONS_ALONE)), strict=True):
            drawn = draw_views(made, held_out)
            found[f"{name}, {label}"] = score_tasks(drawn.images, held_out, alpha=drawn.alpha)["novel"]
        return drawn.images[view]

    assert inputs.masks is not None
    scored("exact", inputs)
    photos = in_a_room(inputs.images, inputs.masks, seed)
    for error in ERRORS:
        used = [grown(mask, round(error * mask.shape[0] / 256)) for mask in inputs.masks]
        moved = [mask for mask, _ in masks_at_edges(list(photos), used)]
        for how, each in (("as they are", used), ("moved", moved)):
            each = np.stack(each).astype(np.float32)
            cut = np.stack([cut_out(*pair) for pair in zip(photos, each, strict=True)])
            image = scored(f"{error}, {how}", dataclasses.replace(inputs, images=cut, masks=each))
            if error == max(ERRORS):
                shown.append(image)
    return found, [cropped(image) for image in shown]


def in_a_room(images: np.ndarray, masks: np.ndarray, seed: int) -> np.ndarray:
    """The photos, which are on white, in front of boxes of random colors; in 8 bits."""
    photos = []
    for i, (image, mask) in enumerate(zip(images, masks, strict=True)):
        rng, (height, width) = np.random.default_rng((seed, i)), mask.shape
        y, x = np.mgrid[:height, :width] / height
        room = np.ones((height, width, 3)) * rng.random(3)
        for _ in range(BOXES):
            left, top = rng.random(2) * 1.1 - 0.1
            wide, high = 0.02 + LARGEST * rng.random(2) ** 2
            room[(x > left) & (x < left + wide) & (y > top) & (y < top + high)] = rng.random(3)
        room += NOISE * rng.normal(size=room.shape)
        photos.append(np.round(255 * np.clip(image + (1 - mask[..., None]) * (room - 1), 0, 1)) / 255)
    return np.stack(photos).astype(np.float32)
