"""What eyes see of an avatar: LPIPS of the whole person and of the head, errors in the foreground, what is drawn beside it."""

import functools
import itertools
from pathlib import Path
from typing import Any, Literal

import jax
import numpy as np

from experiments.harness import Run, entry, means
from experiments.pictures import details, frontal_view, write_triples
from experiments.refinement import with_body_off
from experiments.results import markdown_table
from experiments.subjects import People, make_evaluation_subject, shipped_digest, task_views
from humangs_jax.avatar.reconstruct import reconstruct
from humangs_jax.evaluation.cases import draw_views
from humangs_jax.losses.loss_networks import load_lpips
from humangs_jax.losses.perceptual import lpips
from humangs_jax.refinement.config import HEAD_STEPS, ITERATIONS, RefineConfig
from humangs_jax.refinement.learned import SHIPPED
from humangs_jax.refinement.refine import refine

VIEWS = 4
NETS = ("alex", "vgg")
SHOWN = {
    "psnr": ("PSNR", 2),
    "psnr_fg": ("foreground", 2),
    "alex": ("LPIPS alex", 3),
    "alex_head": ("head", 3),
    "vgg": ("LPIPS vgg", 3),
    "vgg_head": ("head", 3),
    "outside": ("alpha outside", 3),
}
Variant = Literal["iterations alone", "displaced body", "steps on the head", "default"]
VARIANTS: dict[Variant, dict[str, Any]] = {
    "iterations alone": {"displacement": False, "head_steps": 0},
    "displaced body": {"displacement": True, "head_steps": 0},
    "steps on the head": {"displacement": False, "head_steps": HEAD_STEPS},
    "default": {"displacement": None, "head_steps": HEAD_STEPS},
}
"""How the body is displaced to the masks, and steps on the head."""


@entry
def appearance(
    run: Run,
    people: People = People(8, held_out=6, poses=0),
    sizes: tuple[int, ...] = (256, 512),
    off: tuple[float, ...] = (0.0, 5.0),
    variants: tuple[Variant, ...] = ("iterations alone", "default"),
    details_sheet: Path | None = None,
) -> None:
    """What eyes see of avatars of four photos, as `humangs reconstruct` makes them, from other cameras.

    Needs the extra `lpips`. Alpha outside: of the area of the true mask.

    Options:
    sizes: sides of the photos in pixels (--size is not used)
    off: millimetres that the body is off, see `refinement`
    variants: how avatars are made
    details_sheet: faces, hands, hems and shoes: truth and the first two variants, largest size
    """
    start = people.start()
    networks = {net: load_lpips(net) for net in NETS}
    settings = start.settings | {"sizes": sizes, "off": off, "variants": variants, "refiner": shipped_digest(SHIPPED)}

    def measure(seed):
        row: dict[str, Any] = {}
        person = functools.cache(lambda size: make_evaluation_subject(seed, start.body, (VIEWS,), size, start.held_out))
        for size, wrong in itertools.product(sizes, off):
            subject = with_body_off(person(size), wrong)
            still = subject.held_out.select(task_views(subject.held_out)["novel"])
            drawn = {name: _drawn(start, subject.inputs(VIEWS), still, **VARIANTS[name]) for name in variants}
            row[f"{size} {wrong:g}"] = {name: scores_of(*images, still, networks) for name, images in drawn.items()}
        view = frontal_view(subject.photos, still, list(range(still.view_count)))
        pictures = [still.images[view], *(images[view] for images, _ in drawn.values())][:3]
        return row, [np.concatenate(list(details(image, still, view)), axis=1) for image in pictures]

    cases = {str(seed): functools.partial(measure, seed) for seed in start.seeds}
    rows = list(run.rows(cases, settings, again=bool(details_sheet)).values())
    numbers = means(rows)
    run.show(appearance_section(numbers, start), {"settings": settings, "means": numbers, "people": len(rows)})
    if details_sheet:
        write_triples(details_sheet, run.pictures, 1)


def _drawn(start, photos, held_out, displacement, head_steps):
    """Images and alpha of held-out views of an avatar."""
    config = start.config.with_runtime(displacement=displacement)
    how = RefineConfig(iterations=ITERATIONS, steps=0, head_steps=head_steps)
    drawn = draw_views(refine(reconstruct(start.variables, config, photos), photos, how), held_out)
    return drawn.images, np.asarray(drawn.alpha)


def scores_of(images: np.ndarray, alpha: np.ndarray, truth: Any, networks: dict[str, Any]) -> dict[str, float]:
    """Means over views (v, h, w, 3)."""
    masks, errors = truth.masks, np.square(np.clip(images, 0, 1) - truth.images).mean(-1)
    decibels = lambda squared: float(-10 * np.log10(np.maximum(squared, 1e-10)).mean())
    heads = [_heads(x, truth) for x in (images, truth.images)]
    found = {
        "psnr": decibels(errors.mean((1, 2))),
        "psnr_fg": decibels((errors * masks).sum((1, 2)) / masks.sum((1, 2))),
        "outside": float(((1 - masks) * alpha).sum() / masks.sum()),
    }
    for net, weights in networks.items():
        found[net] = float(np.mean([_lpips(weights, *pair) for pair in zip(images, truth.images, strict=True)]))
        found[f"{net}_head"] = float(np.mean([_lpips(weights, *pair) for pair in zip(*heads, strict=True)]))
    return found


_lpips = jax.jit(lpips)


def _heads(images, views):
    """A square around the face in each view."""
    return np.stack([details(image, views, i)[0] for i, image in enumerate(images)]).astype(np.float32)


def appearance_section(numbers: dict[str, Any], start: Any) -> str:
    """The table."""
    rows = []
    for case, variants in numbers.items():
        size, off = case.split()
        for name, scores in variants.items():
            shown = [f"{scores[key]:.{digits}f}" for key, (_, digits) in SHOWN.items()]
            rows.append([f"{size} px", f"{off} mm", name, *shown])
    header = ["photos", "body off", "avatar", *(heading for heading, _ in SHOWN.values())]
    about = f"{len(start.seeds)} people of the {start.settings['split']} seeds, {VIEWS} photos; other cameras, the same pose."
    return f"{about}\n\n{markdown_table(header, rows, 'lll' + 'r' * len(SHOWN))}"
