"""What eyes see of an avatar: LPIPS of the whole person and of the head, errors in the foreground,
what is drawn beside it.
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
"""Of the people, those whose clothes are farthest from the body, and those whose foreground is
worst, are listed apart.
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
"""How the body is displaced to the masks, and steps on the head."""


@entry
def appearance(
    run: Run,
    people: People = People(32, held_out=6, poses=1),
    sizes: tuple[int, ...] = (256, 512),
    off: tuple[float, ...] = (0.0,),
    details_sheet: Path | None = None,
) -> None:
    """What eyes see of avatars of four photos, as `humangs reconstruct` makes them, from other
    cameras.

    Needs the extra `lpips`. "iterations alone": no displacement of the body, no steps on the head.
    Alpha outside: of the area of the true mask.

    Options:
    sizes: sides of the photos in pixels (--size is not used)
    off: millimetres that the body is off, see `refinement`
    details_sheet: faces, hands, hems and shoes: truth and both avatars, largest size
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
        # pictures are of the last
        view = frontal_view(subject.photos, truth, task_views(truth)["novel"].tolist())
        pictures = [truth.images[view], *(each.images[view] for each in drawn.values())]
        row["loose"] = looseness(person(min(sizes)).inputs(VIEWS), start.config)
        return row, [
            np.concatenate(list(details(image, truth, view)), axis=1) for image in pictures
        ]

    rows = start.rows(run, measure, settings, again=bool(details_sheet))
    numbers = {group: means(chosen) for group, chosen in groups_of(rows, BEFORE).items()}
    table = []
    for case in [case for case in numbers["all"] if case != "loose"]:
        size, wrong, task = case.split()
        for (group, mean), name in itertools.product(numbers.items(), VARIANTS):
            table.append(
                [
                    f"{size} px",
                    f"{wrong} mm",
                    TASKS[task],
                    group,
                    name,
                    *cells(mean[case][name], SHOWN),
                ]
            )
    header = [
        "photos",
        "body off",
        "views",
        "people",
        "avatar",
        *(heading for heading, _ in SHOWN.values()),
    ]
    about = (
        f"{len(start.seeds)} people of the {start.settings['split']} seeds, {VIEWS} photos; other"
        " cameras."
    )
    text = f"{about}\n\n{markdown_table(header, table, 'lllll' + 'r' * len(SHOWN))}"
    run.show(text, {"settings": start.settings | settings, "means": numbers, "people": len(rows)})
    if details_sheet:
        write_triples(details_sheet, run.pictures, 1, headers=("truth", *VARIANTS))


def looseness(photos: Any, config: Any) -> float:
    """Share of the person in the photos that is beside the body."""
    views = to_network_views(photos, config.image_size)
    inputs = _prepared(gaussian_body(photos.body, config), views, config)
    mask = np.asarray(views.masks) > MASK_THRESHOLD
    return 1 - float((np.asarray(inputs.depth_maps >= 0) & mask).sum() / mask.sum())


_prepared, _lpips = jax.jit(prepare_inputs), jax.jit(lpips)


def groups_of(rows: list[dict[str, Any]], first: str) -> dict[str, list[dict[str, Any]]]:
    """All people, the loosest, and those whose foreground is worst by the first variant."""
    if len(rows) <= LOOSEST:
        return {"all": rows}
    loosest = sorted(rows, key=lambda row: -row["loose"])[:LOOSEST]
    cell = next(iter(rows[0]))
    worst = sorted(rows, key=lambda row: row[cell][first]["psnr_fg"])[:WORST]
    return {"all": rows, f"{LOOSEST} loosest": loosest, f"{WORST} worst": worst}


def _made(start, photos, displacement, head_steps):
    config = start.config.with_runtime(displacement=displacement)
    how = RefineConfig(iterations=ITERATIONS, steps=0, head_steps=head_steps)
    return refine(reconstruct(start.variables, config, photos), photos, how)


def by_task(drawn: Any, truth: Any, networks: dict[str, Any]) -> dict[str, dict[str, float]]:
    """`scores_of` the drawn views of each task that has some."""
    views = {task: chosen for task, chosen in task_views(truth).items() if len(chosen)}
    alpha = np.asarray(drawn.alpha)
    return {
        task: scores_of(drawn.images[at], alpha[at], truth.select(at), networks)
        for task, at in views.items()
    }


def scores_of(
    images: np.ndarray, alpha: np.ndarray, truth: Any, networks: dict[str, Any]
) -> dict[str, float]:
    masks, errors = truth.masks, np.square(np.clip(images, 0, 1) - truth.images).mean(-1)

    def decibels(squared):
        return float(-10 * np.log10(np.maximum(squared, 1e-10)).mean())

    def faces(images):
        return np.stack([details(image, truth, i)[0] for i, image in enumerate(images)]).astype(
            np.float32
        )

    heads = faces(images), faces(truth.images)
    found = {
        "psnr": decibels(errors.mean((1, 2))),
        "psnr_fg": decibels((errors * masks).sum((1, 2)) / masks.sum((1, 2))),
        "outside": float(((1 - masks) * alpha).sum() / masks.sum()),
    }
    for net, weights in networks.items():
        found[net] = float(
            np.mean([_lpips(weights, *pair) for pair in zip(images, truth.images, strict=True)])
        )
        found[f"{net}_head"] = float(
            np.mean([_lpips(weights, *pair) for pair in zip(*heads, strict=True)])
        )
    return found
