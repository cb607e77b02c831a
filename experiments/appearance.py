"""What eyes see of an avatar: LPIPS of the whole person and of the head, errors in the foreground, what is drawn beside it."""

import contextlib
import dataclasses
import functools
import itertools
from pathlib import Path
from typing import Any
from unittest import mock

import jax
import numpy as np

from experiments.harness import Run, entry, means
from experiments.pictures import details, frontal_view, write_triples
from experiments.refinement import with_body_off
from experiments.results import markdown_table
from experiments.subjects import TASKS, People, file_digest, shipped_digest, task_views
from humangs_jax.avatar import reconstruct as reconstruction
from humangs_jax.avatar.reconstruct import reconstruct
from humangs_jax.data.body_and_masks import MASK_THRESHOLD
from humangs_jax.data.skirt import find_hem
from humangs_jax.data.views import gaussian_body, prepare_inputs, standardize
from humangs_jax.evaluation.cases import draw_views
from humangs_jax.losses.loss_networks import load_lpips
from humangs_jax.losses.perceptual import lpips
from humangs_jax.network.weights import load_weights
from humangs_jax.people.subject import describe
from humangs_jax.refinement import learned
from humangs_jax.refinement.config import HEAD_STEPS, ITERATIONS, RefineConfig
from humangs_jax.refinement.learned import SHIPPED
from humangs_jax.refinement.refine import refine

VIEWS = 4
NETS = ("alex", "vgg")
LOOSEST, WORST = 10, 5
"""Of the people, those whose clothes are farthest from the body, and those whose foreground is worst, are listed apart."""
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
DECODERS: dict[str, tuple[str, slice, float, float]] = {
    "harder opacities": ("appearance_out", slice(3, None, 4), 1.5, 0.0),
    "opacities twice as hard": ("appearance_out", slice(3, None, 4), 2.0, 0.0),
    "harder choice of a shell": ("shells_out", slice(None), 2.0, 0.0),
    "one shell a Gaussian": ("shells_out", slice(None), 20.0, 0.0),
    "flatter along the normal": ("geometry_out", slice(9, None, 10), 1.0, -0.5),
}
"""Changes of the trained decoder without another training: layer, its outputs, factor of their logits, and what is added."""


@entry
def appearance(
    run: Run,
    people: People = People(32, held_out=6, poses=1),
    sizes: tuple[int, ...] = (256, 512),
    off: tuple[float, ...] = (0.0, 5.0),
    first_refiner: Path | None = None,
    first_network: Path | None = None,
    details_sheet: Path | None = None,
) -> None:
    """What eyes see of avatars of four photos, as `humangs reconstruct` makes them, from other cameras.

    Needs the extra `lpips`. "iterations alone": no displacement of the body, no steps on the head. Alpha outside: of the area of
    the true mask.

    Options:
    sizes: sides of the photos in pixels (--size is not used)
    off: millimetres that the body is off, see `refinement`
    first_refiner: weights of the learned update for "iterations alone"; default: the shipped ones
    first_network: weights of the network for it; default: those of --weights
    details_sheet: faces, hands, hems and shoes: truth and both avatars, largest size
    """
    start = people.start()
    networks = {net: load_lpips(net) for net in NETS}
    settings: dict[str, Any] = {"sizes": sizes, "off": off, "variants": tuple(VARIANTS), "refiner": shipped_digest(SHIPPED)}
    settings |= {"first_refiner": first_refiner and file_digest(first_refiner)}
    settings |= {"first_network": first_network and file_digest(first_network)}
    first = load_weights(first_network)[0] if first_network else start.variables

    def measure(seed):
        row: dict[str, Any] = {}
        person = functools.cache(lambda size: start.subject(seed, (VIEWS,), size))
        for size, wrong in itertools.product(sorted(sizes), off):  # pictures are of the last
            subject = with_body_off(person(size), wrong)
            truth, inputs, drawn = subject.held_out, subject.inputs(VIEWS), {}
            for name, how in VARIANTS.items():
                network, refiner = (first, first_refiner) if name == BEFORE else (start.variables, None)
                drawn[name] = draw_views(_made(network, start.config, inputs, refiner, *how), truth)
            scores = {name: by_task(each, truth, networks) for name, each in drawn.items()}
            row |= {f"{size} {wrong:g} {task}": {name: scores[name][task] for name in scores} for task in scores[DEFAULT]}
        view = frontal_view(subject.photos, truth, task_views(truth)["novel"].tolist())
        pictures = [truth.images[view], *(each.images[view] for each in drawn.values())]
        row["loose"] = looseness(person(min(sizes)).inputs(VIEWS), start.config)
        return row, [np.concatenate(list(details(image, truth, view)), axis=1) for image in pictures]

    rows = start.rows(run, measure, settings, again=bool(details_sheet))
    numbers = {group: means(chosen) for group, chosen in groups_of(rows, BEFORE).items()}
    table = []
    for case in [case for case in numbers["all"] if case != "loose"]:
        size, wrong, task = case.split()
        for (group, mean), name in itertools.product(numbers.items(), VARIANTS):
            table.append([f"{size} px", f"{wrong} mm", TASKS[task], group, name, *cells(mean[case][name])])
    header = ["photos", "body off", "views", "people", "avatar", *(heading for heading, _ in SHOWN.values())]
    about = f"{len(start.seeds)} people of the {start.settings['split']} seeds, {VIEWS} photos; other cameras."
    text = f"{about}\n\n{markdown_table(header, table, 'lllll' + 'r' * len(SHOWN))}"
    run.show(text, {"settings": start.settings | settings, "means": numbers, "people": len(rows)})
    if details_sheet:
        write_triples(details_sheet, run.pictures, 1, headers=("truth", *VARIANTS))


def looseness(photos: Any, config: Any) -> float:
    """Share of the person in the photos that is beside the body."""
    views = standardize(photos, config.image_size)
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


def _made(network, config, photos, refiner, displacement, head_steps):
    """An avatar. refiner: weights of the learned update instead of the shipped ones."""
    own = mock.patch.object(learned, "load_refiner", functools.partial(learned.read_refiner, refiner))
    how = RefineConfig(iterations=ITERATIONS, steps=0, head_steps=head_steps)
    with own if refiner else contextlib.nullcontext():
        return refine(reconstruct(network, config.with_runtime(displacement=displacement), photos), photos, how)


def both_ways(network: Any, config: Any, photos: Any) -> dict[str, Any]:
    """The avatar of a network, before and after the learned iterations."""
    first = reconstruct(network, config, photos)
    return {"feed-forward": first, "refined": refine(first, photos, RefineConfig(steps=0, head_steps=0))}


def by_task(drawn: Any, truth: Any, networks: dict[str, Any]) -> dict[str, dict[str, float]]:
    """`scores_of` the drawn views of each task that has some."""
    views = {task: chosen for task, chosen in task_views(truth).items() if len(chosen)}
    alpha = np.asarray(drawn.alpha)
    return {task: scores_of(drawn.images[at], alpha[at], truth.select(at), networks) for task, at in views.items()}


def scores_of(images: np.ndarray, alpha: np.ndarray, truth: Any, networks: dict[str, Any]) -> dict[str, float]:
    masks, errors = truth.masks, np.square(np.clip(images, 0, 1) - truth.images).mean(-1)
    decibels = lambda squared: float(-10 * np.log10(np.maximum(squared, 1e-10)).mean())
    faces = lambda images: np.stack([details(image, truth, i)[0] for i, image in enumerate(images)]).astype(np.float32)
    heads = faces(images), faces(truth.images)
    found = {
        "psnr": decibels(errors.mean((1, 2))),
        "psnr_fg": decibels((errors * masks).sum((1, 2)) / masks.sum((1, 2))),
        "outside": float(((1 - masks) * alpha).sum() / masks.sum()),
    }
    for net, weights in networks.items():
        found[net] = float(np.mean([_lpips(weights, *pair) for pair in zip(images, truth.images, strict=True)]))
        found[f"{net}_head"] = float(np.mean([_lpips(weights, *pair) for pair in zip(*heads, strict=True)]))
    return found


def cells(scores: dict[str, float]) -> list[str]:
    """Of `SHOWN`, what there is."""
    return [f"{scores[key]:.{digits}f}" for key, (_, digits) in SHOWN.items() if key in scores]


# Skirts -------------------------------------------------------------------------------------------------------------------

GARMENTS = ("skirt", "dress", "coat")
"""Around both legs."""


@entry
def skirts(run: Run, people: People = People(80, held_out=6, pose_views=2), sheet: Path | None = None) -> None:
    """People whose masks show a skirt, with it and without, from other cameras and in novel poses.

    Needs the extra `lpips`.

    Options:
    sheet: two views of the pose of the photos and one of each other pose: truth, without and with the skirt, refined
    """
    start = people.start()
    networks = {net: load_lpips(net) for net in NETS}

    def measure(seed):
        person = start.subject(seed, (VIEWS,))
        photos, truth, row = person.inputs(VIEWS), person.held_out, {}
        worn = any(name in garment.kind for garment in describe(seed, start.body).garments for name in GARMENTS)
        if find_hem(gaussian_body(photos.body, start.config), photos) is None:
            return {"found": False, "worn": worn}, None
        shown = [truth.images]
        for name, worn_by in (("without", lambda *_: None), ("with", reconstruction.with_skirt)):
            with mock.patch.object(reconstruction, "with_skirt", worn_by):
                avatars = both_ways(start.variables, start.config, photos)
            for how, avatar in avatars.items():
                drawn = draw_views(avatar, truth)
                row |= {f"{task} {how} {name}": scores for task, scores in by_task(drawn, truth, networks).items()}
            shown.append(drawn.images)
        frames = np.asarray(truth.frames)
        views = [*(int(np.flatnonzero(frames == frame)[0]) for frame in range(truth.frame_count)), 1]
        return row | {"found": True, "worn": worn}, [np.concatenate(list(images[views]), axis=1) for images in shown]

    rows = start.rows(run, measure, again=sheet is not None)
    found = [row for row in rows if row["found"]]
    scores = means([{key: cell for key, cell in row.items() if isinstance(cell, dict)} for row in found])
    ways = itertools.product(TASKS, ("feed-forward", "refined"), ("without", "with"))
    lines = [[TASKS[task], how, name, *cells(scores[f"{task} {how} {name}"])] for task, how, name in ways]
    header = ["views", "avatar", "skirt", *(heading for heading, _ in SHOWN.values())]
    wear = lambda rows: sum(row["worn"] for row in rows)
    about = (
        f"{len(found)} of {len(rows)} people of the {start.settings['split']} seeds: those whose masks show a skirt. "
        f"{wear(rows)} of all wear a skirt, dress or coat, and {wear(found)} of these."
    )
    table = markdown_table(header, lines, "lll" + "r" * len(SHOWN))
    run.show(f"{about}\n\n{table}", {"settings": start.settings, "means": scores})
    if sheet:
        write_triples(sheet, {seed: x for seed, x in run.pictures.items() if x}, 1, headers=("truth", "without", "with"))


# The forward pass ---------------------------------------------------------------------------------------------------------


@entry
def forward_pass(
    run: Run, people: People = People(8, held_out=6, poses=0, split="validation"), runs: tuple[str, ...] = ()
) -> None:
    """What other networks gain: the one of --weights with changed logits, and others, before and after the learned iterations.

    Needs the extra `lpips`.

    Options:
    runs: rows, NAME=FILE: weights of `humangs train` or `train_shipped.py`
    """
    start = people.start()
    networks = {"alex": load_lpips("alex")}
    rows: dict[str, tuple[Any, Any]] = {"as it is": (start.variables, start.config)}
    rows |= {name: (changed(start.variables, *change), start.config) for name, change in DECODERS.items()}
    if wrong := [text for text in runs if "=" not in text]:
        raise ValueError(f"--runs {wrong[0]!r}: expected NAME=FILE")
    files = {name: Path(file) for name, file in (text.split("=", 1) for text in runs)}
    for name, file in files.items():
        variables, config = load_weights(file)
        own = {"architecture": config.architecture, "conventions": config.conventions}
        rows[name] = variables, dataclasses.replace(start.config, **own)
    settings = {"runs": {name: file_digest(file) for name, file in files.items()}}

    def measure(seed):
        subject, row = start.subject(seed, (VIEWS,)), {}
        for name, weights in rows.items():
            for how, avatar in both_ways(*weights, subject.inputs(VIEWS)).items():
                drawn = draw_views(avatar, subject.held_out)
                row[f"{name}, {how}"] = scores_of(drawn.images, np.asarray(drawn.alpha), subject.held_out, networks)
        return row

    found = means(start.rows(run, measure, settings))
    lines = [[name, how, *cells(found[f"{name}, {how}"])] for how in ("feed-forward", "refined") for name in rows]
    header = ["network", "avatar", *(heading for key, (heading, _) in SHOWN.items() if not key.startswith("vgg"))]
    table = markdown_table(header, lines, "ll" + "r" * (len(header) - 2))
    run.show(f"{start.about()}\n\n{table}", {"settings": start.settings | settings, "means": found})


def changed(variables: Any, layer: str, outputs: slice, factor: float, added: float) -> Any:
    """Variables of the network with other logits of the decoder."""
    decoder = variables["params"]["decoder"]
    kernel, bias = decoder[layer]["kernel"], decoder[layer]["bias"]
    own = {"kernel": kernel.at[:, outputs].multiply(factor), "bias": bias.at[outputs].multiply(factor).at[outputs].add(added)}
    return variables | {"params": variables["params"] | {"decoder": decoder | {layer: own}}}
