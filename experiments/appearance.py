"""Measures what the eye sees of an avatar: LPIPS of the whole person and of the head, errors in the
foreground, and what is drawn outside of the person.
"""

import functools
import itertools
from pathlib import Path
from typing import Any

import jax
import numpy as np

from experiments.harness import Run, entry, means
from experiments.pictures import details, frontal_view, write_triples
from experiments.refinement import with_body_off
from experiments.results import cells, markdown_table
from experiments.subjects import TASKS, People, shipped_digest, task_views
from humangs_jax.avatar.reconstruct import reconstruct
from humangs_jax.data.body_and_masks import MASK_THRESHOLD
from humangs_jax.data.views import gaussian_body, prepare_inputs, to_network_views
from humangs_jax.evaluation.cases import predict_views
from humangs_jax.losses.loss_networks import load_lpips
from humangs_jax.losses.perceptual import lpips
from humangs_jax.refinement.config import HEAD_STEPS, ITERATIONS, RefineConfig
from humangs_jax.refinement.learned import SHIPPED
from humangs_jax.refinement.refine import refine

VIEWS = 4
NETS = ("alex", "vgg")
LOOSEST, WORST = 10, 5
"""How many people are listed apart: those whose clothes are farthest from the body, and those
whose foreground is worst.
"""
SHOWN = {
    "psnr": ("PSNR", 2),
    "psnr_fg": ("foreground", 2),
    "alex": ("LPIPS alex", 3),
    "alex_head": ("head", 3),
    "vgg": ("LPIPS vgg", 3),
    "vgg_head": ("head", 3),
    "outside": ("alpha outside", 3),
}
BEFORE, DEFAULT = "iterations alone", "default"
VARIANTS: dict[str, tuple[bool | None, int]] = {BEFORE: (False, 0), DEFAULT: (None, HEAD_STEPS)}
"""{variant: (whether the body is displaced to the masks, None: as configured; steps on the head)}.
"""


@entry
def appearance(
    run: Run,
    people: People = People(32, held_out=6, poses=1),
    sizes: tuple[int, ...] = (256, 512),
    off: tuple[float, ...] = (0.0,),
    details_sheet: Path | None = None,
) -> None:
    """Compares avatars of four photos, as `humangs reconstruct` makes them, with held-out views
    from other cameras.

    Needs the extra `lpips`. "iterations alone" does not displace the body and does no steps on the
    head. "alpha outside" is a share of the area of the true mask.

    Options:
    sizes: sides of the photos in pixels (--size is not used)
    off: millimetres that the body is off, see `refinement`
    details_sheet: image to write, with faces, hands, hems and shoes of the truth and of both
        avatars at the largest size
    """
    start = people.start()
    networks = {net: load_lpips(net) for net in NETS}
    settings: dict[str, Any] = {
        "sizes": sizes,
        "off": off,
        "variants": tuple(VARIANTS),
        "refiner": shipped_digest(SHIPPED),
    }

    def measure(seed):
        row: dict[str, Any] = {}
        person = functools.cache(lambda size: start.subject(seed, (VIEWS,), size))
        # every variant at every size of the photos, with the body off by so much
        for size, wrong in itertools.product(sorted(sizes), off):
            subject = with_body_off(person(size), wrong)
            truth, inputs = subject.held_out, subject.inputs(VIEWS)
            drawn = {
                name: predict_views(_made(start, inputs, *how), truth)
                for name, how in VARIANTS.items()
            }
            scores = {name: by_task(each, truth, networks) for name, each in drawn.items()}
            row |= {
                f"{size} {wrong:g} {task}": {name: scores[name][task] for name in scores}
                for task in scores[DEFAULT]
            }
        # the pictures show the last size and the last distance
        view = frontal_view(subject.photos, truth, task_views(truth)["novel"].tolist())
        pictures = [truth.images[view], *(each.images[view] for each in drawn.values())]
        strips = [np.concatenate(list(details(image, truth, view)), axis=1) for image in pictures]
        row["loose"] = looseness(person(min(sizes)).inputs(VIEWS), start.config)
        return row, strips

    rows = start.rows(run, measure, settings, again=bool(details_sheet))

    # a line for each case, group of people and variant
    numbers = {group: means(chosen) for group, chosen in groups_of(rows, BEFORE).items()}
    table = []
    for case in [case for case in numbers["all"] if case != "loose"]:
        size, wrong, task = case.split()
        for (group, mean), name in itertools.product(numbers.items(), VARIANTS):
            line = [f"{size} px", f"{wrong} mm", TASKS[task], group, name]
            table.append(line + cells(mean[case][name], SHOWN))
    header = ["photos", "body off", "views", "people", "avatar"]
    header += [heading for heading, _ in SHOWN.values()]
    about = (
        f"{len(start.seeds)} people of the {start.settings['split']} seeds, {VIEWS} photos; other"
        " cameras."
    )
    text = f"{about}\n\n{markdown_table(header, table, 'lllll' + 'r' * len(SHOWN))}"
    run.show(text, {"settings": start.settings | settings, "means": numbers, "people": len(rows)})
    if details_sheet:
        write_triples(details_sheet, run.pictures, 1, headers=("truth", *VARIANTS))


def looseness(photos: Any, config: Any) -> float:
    """Returns the share of the person's pixels in the photos that the body does not cover."""
    views = to_network_views(photos, config.image_size)
    inputs = _prepared(gaussian_body(photos.body, config), views, config)
    mask = np.asarray(views.masks) > MASK_THRESHOLD
    return 1 - float((np.asarray(inputs.depth_maps >= 0) & mask).sum() / mask.sum())


_prepared, _lpips = jax.jit(prepare_inputs), jax.jit(lpips)


def groups_of(rows: list[dict[str, Any]], first: str) -> dict[str, list[dict[str, Any]]]:
    """Returns {group: its rows}: all people, those with the loosest clothes, and those whose
    foreground is worst.

    Groups are made of more than `LOOSEST` people. `first` is the variant whose foreground counts.
    """
    if len(rows) <= LOOSEST:
        return {"all": rows}
    loosest = sorted(rows, key=lambda row: -row["loose"])[:LOOSEST]
    cell = next(iter(rows[0]))
    worst = sorted(rows, key=lambda row: row[cell][first]["psnr_fg"])[:WORST]
    return {"all": rows, f"{LOOSEST} loosest": loosest, f"{WORST} worst": worst}


def _made(start, photos, displacement, head_steps):
    """Returns the refined avatar of photos, as a variant makes it."""
    config = start.config.with_runtime(displacement=displacement)
    how = RefineConfig(iterations=ITERATIONS, steps=0, head_steps=head_steps)
    return refine(reconstruct(start.variables, config, photos), photos, how)


def by_task(drawn: Any, truth: Any, networks: dict[str, Any]) -> dict[str, dict[str, float]]:
    """Returns {task: `scores_of` its drawn views} for the tasks that have views."""
    views = {task: chosen for task, chosen in task_views(truth).items() if len(chosen)}
    alpha = np.asarray(drawn.alpha)
    return {
        task: scores_of(drawn.images[at], alpha[at], truth.select(at), networks)
        for task, at in views.items()
    }


def scores_of(
    images: np.ndarray, alpha: np.ndarray, truth: Any, networks: dict[str, Any]
) -> dict[str, float]:
    """Returns the means over views of PSNR in dB, LPIPS, and the alpha outside of the true mask as
    a share of the mask's area.

    Args:
        images: (v, h, w, 3) drawn views
        alpha: (v, h, w) alpha of the drawn views
        truth: capture with the same views
        networks: {name: LPIPS network}
    """
    masks, errors = truth.masks, np.square(np.clip(images, 0, 1) - truth.images).mean(-1)

    def decibels(squared):
        return float(-10 * np.log10(np.maximum(squared, 1e-10)).mean())

    def faces(images):
        cut = [details(image, truth, i)[0] for i, image in enumerate(images)]
        return np.stack(cut).astype(np.float32)

    def mean_lpips(weights, drawn, true):
        return float(np.mean([_lpips(weights, *pair) for pair in zip(drawn, true, strict=True)]))

    # errors of pixels, then LPIPS of the whole person and of the head
    heads = faces(images), faces(truth.images)
    found = {
        "psnr": decibels(errors.mean((1, 2))),
        "psnr_fg": decibels((errors * masks).sum((1, 2)) / masks.sum((1, 2))),
        "outside": float(((1 - masks) * alpha).sum() / masks.sum()),
    }
    for net, weights in networks.items():
        found[net] = mean_lpips(weights, images, truth.images)
        found[f"{net}_head"] = mean_lpips(weights, *heads)
    return found
