"""How well unseen synthetic people are reconstructed, and what changes that: number of photos, light, masks, choice of photos."""

import dataclasses
import functools
import itertools
import os
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy import ndimage

from experiments.harness import Run, entry, figure, means
from experiments.pictures import cropped, frontal_view, strip_of, write_sheet, write_triples
from experiments.results import markdown_table, page_of
from experiments.subjects import (
    RING,
    TASKS,
    HeldOut,
    People,
    Scores,
    draw_person,
    make_evaluation_subject,
    score_person,
    score_tasks,
    shipped_digest,
)
from humangs_jax.avatar.frames import capture_renderings
from humangs_jax.avatar.reconstruct import reconstruct
from humangs_jax.body.library import load_body
from humangs_jax.data.loading import ViewSampling, find_captures
from humangs_jax.data.masks import masks_at_edges
from humangs_jax.data.photos import cut_out
from humangs_jax.data.views import gaussian_body, select_views
from humangs_jax.evaluation.cases import draw_views
from humangs_jax.evaluation.scores import score
from humangs_jax.losses import metrics
from humangs_jax.network.weights import load_weights
from humangs_jax.people.cameras import cameras_around, spread_azimuths
from humangs_jax.people.subject import make_subject, seeds_of
from humangs_jax.people.writer import View, capture_views, sample_pose
from humangs_jax.refinement.config import RefineConfig
from humangs_jax.refinement.learned import SHIPPED as SHIPPED_REFINER
from humangs_jax.refinement.refine import refine
from humangs_jax.training.config import TrainConfig
from humangs_jax.training.forward import predict
from humangs_jax.training.sources import captured_people
from humangs_jax.training.validation import validation_examples

PHOTOS = 4
ITERATIONS_ALONE = RefineConfig(steps=0, seconds=None)

# Numbers of photos ---------------------------------------------------------------------------------------------------

COLUMNS = {  # heading and digits
    "psnr": ("PSNR", 2),
    "ssim": ("SSIM", 3),
    "lpips": ("LPIPS", 4),
    "psnr_fg": ("foreground PSNR", 2),
    "baseline_psnr": ("vertex-color baseline: PSNR", 2),
    "baseline_ssim": ("SSIM", 3),
    "baseline_lpips": ("LPIPS", 4),
    "baseline_psnr_fg": ("foreground PSNR", 2),
}
EXTREMES = 5
"""People at either end who are shown."""


@entry
def evaluation_views(
    run: Run,
    people: People = People(32),
    views: tuple[int, ...] = (1, 2, 4, 6),
    images: Path | None = None,
    plot: Path | None = None,
) -> None:
    """Unseen people from 1 to 6 photos against held-out views, in the pose of the photos and in others.

    The baseline is the body's mesh, each vertex painted with the mean color of the photos that see it (grey where none does).
    About 10 s of CPU time a person, and a minute or two of compiling.

    Options:
    views: numbers of photos that the network sees; they divide 12
    images: the best five people beside the worst five, by PSNR
    plot: PSNR against the number of photos
    """
    start, views = people.start(), tuple(sorted(set(views)))
    if any(count < 1 or RING % count for count in views):
        raise ValueError(f"--views: expected numbers that divide {RING}, got {views}")
    subject = functools.lru_cache(1)(
        lambda seed: make_evaluation_subject(seed, start.body, views, start.size, start.held_out)
    )

    def measure(seed, count):
        drawn, truth = draw_person(start.variables, start.config, subject(seed), count), subject(seed).held_out
        return score_person(drawn, truth, start.lpips), strip_of(drawn, truth)

    chosen = 4 if 4 in views else max(views)
    cases = {f"{s}, {n} photos": functools.partial(measure, s, n) for s in start.seeds for n in views}
    rows = run.rows(cases, start.settings)
    by_views = {n: {seed: rows[f"{seed}, {n} photos"] for seed in start.seeds} for n in views}
    section = views_section(by_views, chosen, start.about())
    link = lambda path: Path(os.path.relpath(path, page_of(run.table).parent)).as_posix()
    if plot:
        plot_views(plot, {n: means(list(row.values())) for n, row in by_views.items()})
        section += f"\n\n![PSNR against the number of photos]({link(plot)})"
    if images:
        shown = extremes(by_views[chosen])
        strips = {seed: run.pictures.get(f"{seed}, {chosen} photos") for seed in (*shown[0], *shown[1])}
        strips = {seed: strip or measure(seed, chosen)[1] for seed, strip in strips.items()}
        write_sheet(images, shown, by_views[chosen], strips)
        section += f"\n\n![The best people beside the worst: truth, ours, vertex-color baseline]({link(images)})"
    numbers = {n: means(list(row.values())) for n, row in by_views.items()}
    run.show(section, {"views": chosen, "by_views": numbers, "settings": start.settings, "people": len(start.seeds)})


def views_section(by_views: dict[int, dict[int, Any]], chosen: int, about: str) -> str:
    """Scores by number of photos and task, whether more photos help, the best and the worst people.

    by_views: scores by number of photos and seed. chosen: the number of photos of what is said of single people.
    """
    mean = {n: means(list(rows.values())) for n, rows in by_views.items()}
    tasks = [task for task in TASKS if task in mean[chosen]]
    keys = [key for key in COLUMNS if mean[chosen][tasks[0]].get(key) is not None]
    rows = [[TASKS[task], n, *cells(mean[n][task], keys)] for task in tasks for n in mean]
    best, worst = extremes(by_views[chosen])
    header, ends = ["", "seed"], []
    for task in tasks:
        header += [f"{TASKS[task]}: PSNR", "foreground PSNR", "vertex-color baseline"]
    for name, seeds in (("best", best), ("worst", worst)):
        for place, seed in enumerate(seeds, 1):
            numbers = [cells(by_views[chosen][seed][task], ("psnr", "psnr_fg", "baseline_psnr")) for task in tasks]
            ends.append([f"{name} {place}", seed, *itertools.chain(*numbers)])
    return "\n\n".join(
        (
            about,
            markdown_table(["task", "photos", *(COLUMNS[key][0] for key in keys)], rows),
            " ".join(verdict(by_views, chosen, task) for task in tasks),
            markdown_table(header, ends),
        )
    )


def cells(scores: Scores, keys: Sequence[str]) -> list[str]:
    """Numbers with their digits; a dash for what is missing."""
    values = [(scores.get(key), COLUMNS[key][1]) for key in keys]
    return ["-" if value is None else f"{value:.{digits}f}" for value, digits in values]


def extremes(rows: dict[int, Any]) -> tuple[list[int], list[int]]:
    """The best people, best first, and the worst, worst first, by PSNR of new views: at most `EXTREMES` each, nobody twice."""
    order = sorted(rows, key=lambda seed: -rows[seed]["novel"]["psnr"])
    count = min(EXTREMES, max(1, len(order) // 2))
    return order[:count], order[count:][::-1][:count]


def verdict(by_views: dict[int, dict[int, Any]], chosen: int, task: str) -> str:
    """Whether more photos are ever worse, and how many people beat their vertex-color baseline."""
    mean = [(n, float(np.mean([row[task]["psnr"] for row in rows.values()]))) for n, rows in by_views.items()]
    worse = [
        f"by {x - y:.2f} dB from {few} to {many} photos" for (few, x), (many, y) in itertools.pairwise(mean) if y < x
    ]
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


# Light ---------------------------------------------------------------------------------------------------------------

LIGHT_POSES, LIGHT_HELD_OUT = 6, 3
"""Poses of a person, held-out views of each. The first four poses are those of photos, two are unseen."""


@entry
def light(run: Run, people: People = People(16), sheet: Path | None = None) -> None:
    """What the light of the photos gains: avatars with it and without, and the limit of those without.

    "One pose": four photos of one pose. "Four poses": one photo of each of four poses. Avatars are those of the pass and of the
    iterations of refinement. "True surface": the generator's own people in a new pose, with the light that each point has in the
    photos of one pose: the best that an avatar with fixed colors can do.

    Options:
    sheet: JPEG of an novel pose of every person: truth, without and with the light
    """
    start = people.start()
    cases = {str(seed): functools.partial(_light_of, start, seed) for seed in start.seeds}
    mean = means(list(run.rows(cases, start.settings, again=bool(sheet)).values()))
    if sheet:
        write_triples(sheet, run.pictures, 2, ("truth", "fixed colors", "light of the photos"))
    rows, shown = [], lambda scores: [f"{scores[key]:.2f}" for key in ("psnr", "psnr_fg")]
    for name, tasks in mean.items():
        photos, avatar, lit = name.split(", ") if ", " in name else ("", "true surface, fixed colors", "")
        rows.append([photos, avatar, lit, *(shown(tasks["novel"]) if photos else ["", ""]), *shown(tasks["animation"])])
    scores = ["poses of the photos: PSNR", "foreground PSNR", "novel poses: PSNR", "foreground PSNR"]
    table = markdown_table(["photos of", "avatar", "light", *scores], rows, "lllrrrr")
    about = f"Means over {len(start.seeds)} people of the {people.split} seeds, four photos of {people.size} px; dB."
    run.show(f"{about}\n\n{table}", {"settings": start.settings, "means": mean})


def _light_of(start, seed):
    """Scores by avatar and task of one person; an novel pose, true, and after the iterations without and with the light."""
    subject, rng = make_subject(seed, start.body), np.random.default_rng([seed, RING])
    posed = [sample_pose(subject, i) for i in range(LIGHT_POSES)]
    rings = [cameras_around(rng, pose.vertices, spread_azimuths(rng, RING), start.size) for pose in posed]
    held = [cameras_around(rng, pose.vertices, spread_azimuths(rng, LIGHT_HELD_OUT), start.size) for pose in posed]
    of_photos = {
        "one pose": [View(0, f"photo_{i}", rings[0][RING // PHOTOS * i]) for i in range(PHOTOS)],
        "four poses": [View(i, f"photo_{i}", rings[i][RING // PHOTOS * i]) for i in range(PHOTOS)],
    }
    views = [View(i, f"{i}_{k}", held[i][k]) for i in range(LIGHT_POSES) for k in range(LIGHT_HELD_OUT)]
    truth, found = capture_views(subject, start.body, posed, views), {}
    shown = [next(i for i, view in enumerate(views) if view.frame == LIGHT_POSES - 1)]
    images, frames = [truth.images[shown[0]]], np.asarray(truth.frames)

    def scores(drawn, seen):
        by_task = {}
        for task, chosen in (("novel", seen), ("animation", [LIGHT_POSES - 2, LIGHT_POSES - 1])):
            at = np.flatnonzero(np.isin(frames, chosen))
            alone = dataclasses.replace(truth.select(at), frames=np.zeros(len(at), int))
            by_task[task] = score_tasks(drawn[at], alone)["novel"]
        return by_task

    for name, photographed in of_photos.items():
        photos = capture_views(subject, start.body, posed, photographed)
        for lit, how in (("without", start.config.with_conventions(light=False)), ("with", start.config)):
            avatar = reconstruct(start.variables, how, photos)
            iterations = refine(avatar, photos, ITERATIONS_ALONE)
            for label, made in (("pass", avatar), ("4 iterations", iterations)):
                drawn = draw_views(made, truth).images
                found[f"{name}, {label}, {lit}"] = scores(drawn, sorted({view.frame for view in photographed}))
            if name == "one pose":
                images += list(draw_views(iterations, truth.select(shown)).images)
    light_of_first = {key: getattr(posed[0], key) for key in ("normals", "openness", "lit")}
    fixed = [dataclasses.replace(pose, **light_of_first) for pose in posed]
    found["true surface"] = scores(capture_views(subject, start.body, fixed, views).images, [0])
    return found, [cropped(image) for image in images]


# Masks ---------------------------------------------------------------------------------------------------------------

ERRORS = (0, -1, 1, -3, 3)
"""Pixels of 256 that the masks are too large."""
AVATARS = ("pass", "4 iterations")
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
    start = people.start()
    settings = start.settings | {"refiner": shipped_digest(SHIPPED_REFINER)}
    cases = {str(seed): functools.partial(_masks_of, start, seed) for seed in start.seeds}
    mean = means(list(run.rows(cases, settings, again=bool(sheet)).values()))
    if sheet:
        write_triples(sheet, run.pictures, 2, ("truth", "masks 3 pixels too large", "moved to the edges"))
    both = lambda name: [f"{mean[f'{name}, {avatar}'][key]:.2f}" for key in ("psnr", "psnr_fg") for avatar in AVATARS]
    rows = [["exact", "photos on white", *both("exact")]]
    for error in ERRORS:
        rows += [[f"{error:+d}" if error else "0", how, *both(f"{error}, {how}")] for how in ("as they are", "moved")]
    header = ["masks, pixels of 256", "used", *AVATARS, *(f"foreground PSNR, {avatar}" for avatar in AVATARS)]
    about = f"Means over {len(start.seeds)} people of the {people.split} seeds, {PHOTOS} photos of {people.size} px; PSNR in dB."
    run.show(f"{about}\n\n{markdown_table(header, rows, 'llrrrr')}", {"settings": settings, "means": mean})


def _masks_of(start, seed):
    """Scores by masks and avatar of one person; a held-out view, true, and after the iterations without and with moved masks."""
    held = HeldOut(start.held_out.views, 0, 0)
    subject = make_evaluation_subject(seed, start.body, [PHOTOS], start.size, held)
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


def grown(mask: np.ndarray, pixels: int) -> np.ndarray:
    """The mask dilated, or eroded below 0."""
    side = 2 * abs(pixels) + 1
    return mask if pixels == 0 else (ndimage.grey_dilation if pixels > 0 else ndimage.grey_erosion)(mask, (side, side))


# Choice of photos ----------------------------------------------------------------------------------------------------

CHOICES, CHOICE_HELD_OUT, DRAWS = 20, 8, 4


@entry
def evaluation_view_selection(run: Run, subjects: int = 8, count: int = 4) -> None:
    """What choosing photos by coverage gains over random ones: of 20 photos at random azimuths, 4 are used.

    Options:
    subjects: people of the validation seeds
    count: photos that are used
    """
    cases = {str(seed): functools.partial(_choices_of, seed, count) for seed in seeds_of("validation", 0, subjects)}
    rows = list(run.rows(cases, {"count": count}).values())
    titles = {"random": f"{count} at random", "chosen": f"{count} chosen", "all": f"all {CHOICES}"}
    mean = means([{key: row[key] for key in titles} for row in rows])
    table = [[title, *(f"{mean[key][name]:.2f}" for name in ("psnr", "psnr_fg"))] for key, title in titles.items()]
    better = sum(row["chosen"]["psnr"] > row["random"]["psnr"] for row in rows)
    about = (
        f"Means over {len(rows)} people of the validation seeds, {CHOICES} photos of 256 pixels at random azimuths; "
        f"{DRAWS} random choices each. The chosen ones are better for {better} of {len(rows)}; choosing takes "
        f"{np.median([row['seconds'] for row in rows]):.2f} s."
    )
    run.show(
        f"{about}\n\n{markdown_table(['photos', 'PSNR, dB', 'foreground PSNR, dB'], table, 'lrr')}", {"means": mean}
    )


def _choices_of(seed, count):
    rng, body, (variables, config) = np.random.default_rng([seed, CHOICES]), load_body(), load_weights()
    subject = make_subject(seed, body)
    pose, total = sample_pose(subject, 0), CHOICES + CHOICE_HELD_OUT
    cameras = cameras_around(rng, pose.vertices, rng.uniform(0, 2 * np.pi, total), 256)
    capture = capture_views(subject, body, [pose], [View(0, f"{i:02d}", cameras[i]) for i in range(total)])
    photos, held_out = capture.select(range(CHOICES)), capture.select(range(CHOICES, total))

    def score_of(chosen):
        drawn = capture_renderings(reconstruct(variables, config, photos.select(chosen)), held_out)[1]
        found = score(np.stack([np.asarray(rendering.rgb) for rendering in drawn]), held_out)
        return {"psnr": float(found.psnr), "psnr_fg": float(found.psnr_fg)}

    select_views(photos, count)  # compiles
    began = time.perf_counter()
    chosen = select_views(photos, count)
    seconds = time.perf_counter() - began
    random = means([score_of(rng.choice(CHOICES, count, replace=False)) for _ in range(DRAWS)])
    whole = score_of(range(CHOICES))
    return {"seconds": seconds, "photos": chosen, "chosen": score_of(chosen), "random": random, "all": whole}


# Where the error is --------------------------------------------------------------------------------------------------

BAND = 3
"""Pixels to either side that count as the silhouette."""
LEAST_COVERAGE = 0.05
"""Below this coverage the predicted color is undefined; the true one is used."""


@entry
def evaluation_error_shares(
    run: Run,
    people: Path,
    weights: tuple[str, ...] = ("shipped=",),
    sizes: tuple[int, ...] = (256,),
    views: int = 4,
    targets: int = 6,
) -> None:
    """Where the error of reconstructions is: at the silhouette, in holes, in the colors of the person, or around the person.

    Means over all views of all people: PSNR; PSNR of the predicted colors under the true coverage; shares of the squared error;
    semi-transparent foreground, also of the true images. About 20 s and 2 s a person on 2 CPU cores.

    Options:
    people: folder of captures with masks, as `humangs synth --poses 2 --views 12 --close-views 0` writes them
    weights: NAME=FILE of weights to compare; NAME= stands for the shipped ones
    sizes: sides of photos and targets, pixels
    views: photos that the network sees
    targets: other views of each person
    """
    if views < 1 or targets < 1:
        raise ValueError("--views and --targets must be at least 1")
    if unnamed := [pair for pair in weights if "=" not in pair]:
        raise ValueError(f"--weights: expected NAME=FILE, got {unnamed[0]}")
    columns = {}
    for size in sizes:
        for name, file in (pair.split("=", 1) for pair in weights):
            sampling = ViewSampling(input_counts=(views,), target_count=targets)
            columns[f"{name}, {size} px"] = _error_shares(people, Path(file) if file else None, size, sampling)
    run.show(error_shares_section(columns), columns)


def error_shares_section(columns: dict[str, dict[str, float]]) -> str:
    """The table: a column for each size and weights."""
    names = [name for name in next(iter(columns.values())) if name != "squared error"]
    digits = lambda name: 2 if name.startswith("PSNR") else 3
    rows = [[name, *(f"{column[name]:.{digits(name)}f}" for column in columns.values())] for name in names]
    return markdown_table(["", *columns], rows)


def _error_shares(people, weights, size, sampling):
    """Means over people and views; shares are of the squared error of all."""
    variables, model = load_weights(weights)
    config = TrainConfig(model=model.with_conventions(image_size=size), views=sampling)
    body, folders = load_body(), find_captures(people)
    examples = validation_examples(captured_people(folders, body), config, len(folders))
    body, draw, rows = gaussian_body(body, config.model), jax.jit(predict, static_argnames="config"), []
    for example in examples:
        drawn, _ = draw(variables, body, example, config)
        targets = example.targets
        pictures = zip(*(np.asarray(x) for x in (drawn.rgb, drawn.alpha, targets.images, targets.masks)), strict=True)
        same = jnp.max(jnp.abs(targets.rotations - example.inputs.rotations[:1]), axis=(1, 2)) < 1e-3
        for pose, picture in zip(np.asarray(same), pictures, strict=True):
            found = error_shares(*picture)
            psnr = found.pop("PSNR")
            rows.append({f"PSNR, {'pose of the photos' if pose else 'other poses'}, dB": psnr, **found})
    order = lambda name: (not name.startswith("PSNR"), name.startswith("semi_transparent"), name)
    names = sorted({name for row in rows for name in row}, key=order)
    mean = {name: float(np.mean([row[name] for row in rows if name in row])) for name in names}
    return {name: value / (mean["squared error"] if name.startswith("share") else 1) for name, value in mean.items()}


def error_shares(rgb: np.ndarray, alpha: np.ndarray, image: np.ndarray, mask: np.ndarray) -> dict[str, float]:
    """Squared error of one image (h, w, 3) by place, its PSNR, also under the true coverage, semi-transparent foreground."""
    psnr = lambda drawn: float(metrics.psnr(jnp.asarray(drawn), jnp.asarray(image)))
    error = ((np.clip(rgb, 0, 1) - image) ** 2).mean(-1)
    inner = ndimage.binary_erosion(mask > 0.5, iterations=BAND)
    outer = ~ndimage.binary_dilation(mask > 0.5, iterations=BAND)
    color = np.clip((rgb - (1 - alpha[..., None])) / np.maximum(alpha, LEAST_COVERAGE)[..., None], 0, 1)
    color = np.where(alpha[..., None] > LEAST_COVERAGE, color, image)
    covered = color * mask[..., None] + 1 - mask[..., None]
    return {
        "PSNR": psnr(rgb),
        "PSNR with the true silhouette and the predicted colors, dB": psnr(covered),
        "squared error": float(error.mean()),
        "share at the silhouette": float((error * ~(inner | outer)).mean()),
        "share in holes": float((error * (1 - alpha) * inner).mean()),
        "share in colors": float((error * alpha * inner).mean()),
        "share around the person": float((error * outer).mean()),
        "semi_transparent": float(metrics.semi_transparent(jnp.asarray(alpha), jnp.asarray(mask))),
        "semi_transparent of the true images": float(metrics.semi_transparent(jnp.asarray(mask), jnp.asarray(mask))),
    }
