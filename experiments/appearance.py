"""What eyes see of an avatar: LPIPS of the whole person and of the head, errors in the foreground, what is drawn beside it."""

import contextlib
import dataclasses
import functools
import itertools
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal
from unittest import mock

import jax
import numpy as np

from experiments.harness import Run, entry, means
from experiments.pictures import details, frontal_view, write_triples
from experiments.refinement import with_body_off
from experiments.results import markdown_table, write_json
from experiments.subjects import TASKS, People, file_digest, make_evaluation_subject, shipped_digest, task_views
from humangs_jax.avatar import reconstruct as reconstruction
from humangs_jax.avatar.reconstruct import reconstruct
from humangs_jax.avatar.video import tile
from humangs_jax.data.body_and_masks import MASK_THRESHOLD
from humangs_jax.data.skirt import find_hem
from humangs_jax.data.views import gaussian_body, prepare_inputs, standardize
from humangs_jax.evaluation.cases import draw_views
from humangs_jax.io.images import write_png
from humangs_jax.io.reading import read_json
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
JUDGED, PAIR_ZOOM, PAIRS_A_SHEET = ("face", "hand", "hem"), 2, 12
"""Of `DETAILS`, those that `appearance_votes` is about."""
SHOWN = {
    "psnr": ("PSNR", 2),
    "psnr_fg": ("foreground", 2),
    "alex": ("LPIPS alex", 3),
    "alex_head": ("head", 3),
    "vgg": ("LPIPS vgg", 3),
    "vgg_head": ("head", 3),
    "outside": ("alpha outside", 3),
}
Variant = Literal["iterations alone", "displaced body", "steps on the head", "edges of 2 cm", "edges of 1.5 cm", "default"]
VARIANTS: dict[Variant, dict[str, Any]] = {
    "iterations alone": {"displacement": False, "head_steps": 0},
    "displaced body": {"displacement": True, "head_steps": 0},
    "steps on the head": {"displacement": False, "head_steps": HEAD_STEPS},
    "edges of 2 cm": {"displacement": None, "head_steps": HEAD_STEPS, "longest_edge": 0.02},
    "edges of 1.5 cm": {"displacement": None, "head_steps": HEAD_STEPS, "longest_edge": 0.015},
    "default": {"displacement": None, "head_steps": HEAD_STEPS},
}
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
    variants: tuple[Variant, ...] = ("iterations alone", "default"),
    first_refiner: Path | None = None,
    first_network: Path | None = None,
    details_sheet: Path | None = None,
    pairs: Path | None = None,
) -> None:
    """What eyes see of avatars of four photos, as `humangs reconstruct` makes them, from other cameras.

    Needs the extra `lpips`. Alpha outside: of the area of the true mask.

    Options:
    sizes: sides of the photos in pixels (--size is not used)
    off: millimetres that the body is off, see `refinement`
    variants: how avatars are made
    first_refiner: weights of the learned update for the first variant; default: the shipped ones
    first_network: weights of the network for the first variant; default: those of the others
    details_sheet: faces, hands, hems and shoes: truth and the first two variants, largest size
    pairs: folder of sheets that show the first two variants in random order, for `appearance_votes`
    """
    start = people.start()
    networks = {net: load_lpips(net) for net in NETS}
    settings = start.settings | {"sizes": sizes, "off": off, "variants": variants, "refiner": shipped_digest(SHIPPED)}
    settings |= {"first_refiner": first_refiner and file_digest(first_refiner)}
    settings |= {"first_network": first_network and file_digest(first_network)}
    first = load_weights(first_network)[0] if first_network else start.variables

    def measure(seed):
        row: dict[str, Any] = {}
        person = functools.cache(lambda size: make_evaluation_subject(seed, start.body, (VIEWS,), size, start.held_out))
        for size, wrong in itertools.product(sorted(sizes), off):  # pictures are of the last
            subject = with_body_off(person(size), wrong)
            truth, inputs, drawn = subject.held_out, subject.inputs(VIEWS), {}
            for name in variants:
                network, refiner = (first, first_refiner) if name == variants[0] else (start.variables, None)
                drawn[name] = _drawn(network, start.config, inputs, truth, refiner, **VARIANTS[name])
            for task, views in task_views(truth).items():
                seen = truth.select(views)
                of_task = {name: (images[views], alpha[views]) for name, (images, alpha) in drawn.items()}
                if len(views):
                    scores = {name: scores_of(*images, seen, networks) for name, images in of_task.items()}
                    row[f"{size} {wrong:g} {task}"] = scores
        view = frontal_view(subject.photos, truth, task_views(truth)["novel"].tolist())
        pictures = [truth.images[view], *(images[view] for images, _ in drawn.values())][:3]
        row["loose"] = looseness(person(min(sizes)).inputs(VIEWS), start.config)
        return row, [details(image, truth, view) for image in pictures]

    cases = {str(seed): functools.partial(measure, seed) for seed in start.seeds}
    rows = list(run.rows(cases, settings, again=bool(details_sheet or pairs)).values())
    numbers = {group: means(chosen) for group, chosen in groups_of(rows, variants[0]).items()}
    run.show(appearance_section(numbers, start), {"settings": settings, "means": numbers, "people": len(rows)})
    if details_sheet:
        sheets = {seed: [np.concatenate(list(x), axis=1) for x in shown] for seed, shown in run.pictures.items()}
        write_triples(details_sheet, sheets, 1, headers=("truth", *variants[:2]))
    if pairs:
        write_pairs(pairs, run.pictures, variants[:2])


def looseness(photos: Any, config: Any) -> float:
    """Share of the person in the photos that is beside the body."""
    views = standardize(photos, config.image_size)
    inputs = _prepared(gaussian_body(photos.body, config), views, config)
    mask = np.asarray(views.masks) > MASK_THRESHOLD
    return 1 - float((np.asarray(inputs.depth_maps >= 0) & mask).sum() / mask.sum())


_prepared = jax.jit(prepare_inputs)


def groups_of(rows: list[dict[str, Any]], first: str) -> dict[str, list[dict[str, Any]]]:
    """All people, the loosest, and those whose foreground is worst by the first variant."""
    loosest = sorted(rows, key=lambda row: -row["loose"])[:LOOSEST]
    cell = next(iter(rows[0]))
    worst = sorted(rows, key=lambda row: row[cell][first]["psnr_fg"])[:WORST]
    groups = {"all": rows, f"{LOOSEST} loosest": loosest, f"{WORST} worst": worst}
    return groups if len(rows) > LOOSEST else {"all": rows}


def _drawn(network, config, photos, held_out, refiner, displacement, head_steps, longest_edge=None):
    """Images and alpha of held-out views of an avatar. refiner: weights of the learned update instead of the shipped ones."""
    own = mock.patch.object(learned, "load_refiner", functools.partial(learned.read_refiner, refiner))
    config = config.with_runtime(displacement=displacement, longest_edge=longest_edge)
    how = RefineConfig(iterations=ITERATIONS, steps=0, head_steps=head_steps)
    with own if refiner else contextlib.nullcontext():
        avatar = refine(reconstruct(network, config, photos), photos, how)
    drawn = draw_views(avatar, held_out)
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
    for case in [case for case in numbers["all"] if case != "loose"]:
        size, off, task = case.split()
        for (group, means_of), name in itertools.product(numbers.items(), numbers["all"][case]):
            shown = [f"{means_of[case][name][key]:.{digits}f}" for key, (_, digits) in SHOWN.items()]
            rows.append([f"{size} px", f"{off} mm", TASKS[task], group, name, *shown])
    header = ["photos", "body off", "views", "people", "avatar", *(heading for heading, _ in SHOWN.values())]
    about = f"{len(start.seeds)} people of the {start.settings['split']} seeds, {VIEWS} photos; other cameras."
    return f"{about}\n\n{markdown_table(header, rows, 'lllll' + 'r' * len(SHOWN))}"


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
        person = make_evaluation_subject(seed, start.body, (VIEWS,), start.size, start.held_out)
        photos, truth, row = person.inputs(VIEWS), person.held_out, {}
        worn = any(name in garment.kind for garment in describe(seed, start.body).garments for name in GARMENTS)
        if find_hem(gaussian_body(photos.body, start.config), photos) is None:
            return {"found": False, "worn": worn}, None
        shown = []
        for name, worn_by in (("without", lambda *_: None), ("with", reconstruction.with_skirt)):
            with mock.patch.object(reconstruction, "with_skirt", worn_by):
                first = reconstruct(start.variables, start.config, photos)
            for how, avatar in {
                "feed-forward": first,
                "refined": refine(first, photos, RefineConfig(steps=0, head_steps=0)),
            }.items():
                drawn = draw_views(avatar, truth)
                for task, views in task_views(truth).items():
                    images, alpha = drawn.images[views], np.asarray(drawn.alpha)[views]
                    row[f"{task} {how} {name}"] = scores_of(images, alpha, truth.select(views), networks)
            shown.append(drawn.images)
        views = [next(iter(np.flatnonzero(np.asarray(truth.frames) == frame))) for frame in range(truth.frame_count)]
        return row | {"found": True, "worn": worn}, [
            np.concatenate([images[i] for i in (*views, 1)], axis=1) for images in (truth.images, *shown)
        ]

    cases = {str(seed): functools.partial(measure, seed) for seed in start.seeds}
    rows = list(run.rows(cases, start.settings, again=sheet is not None).values())
    found = [row for row in rows if row["found"]]
    scores = means([{key: cell for key, cell in row.items() if isinstance(cell, dict)} for row in found])
    cell = lambda key: [f"{scores[key][name]:.{digits}f}" for name, (_, digits) in SHOWN.items()]
    lines = [
        [TASKS[task], how, name, *cell(f"{task} {how} {name}")]
        for task, how, name in itertools.product(TASKS, ("feed-forward", "refined"), ("without", "with"))
    ]
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
        rows[name] = (
            variables,
            dataclasses.replace(start.config, architecture=config.architecture, conventions=config.conventions),
        )
    settings = start.settings | {"runs": {name: file_digest(file) for name, file in files.items()}}

    def measure(seed):
        subject = make_evaluation_subject(seed, start.body, (VIEWS,), start.size, start.held_out)
        inputs, row = subject.inputs(VIEWS), {}
        for name, weights in rows.items():
            first = reconstruct(*weights, inputs)
            for how, avatar in {
                "feed-forward": first,
                "refined": refine(first, inputs, RefineConfig(steps=0, head_steps=0)),
            }.items():
                drawn = draw_views(avatar, subject.held_out)
                row[f"{name}, {how}"] = scores_of(drawn.images, np.asarray(drawn.alpha), subject.held_out, networks)
        return row

    found = means(list(run.rows({str(seed): functools.partial(measure, seed) for seed in start.seeds}, settings).values()))
    scores = {key: shown for key, shown in SHOWN.items() if not key.startswith("vgg")}
    cell = lambda name, how: [f"{found[f'{name}, {how}'][key]:.{digits}f}" for key, (_, digits) in scores.items()]
    lines = [[name, how, *cell(name, how)] for how in ("feed-forward", "refined") for name in rows]
    header = ["network", "avatar", *(heading for heading, _ in scores.values())]
    table = markdown_table(header, lines, "ll" + "r" * len(scores))
    run.show(f"{start.about()}\n\n{table}", {"settings": settings, "means": found})


def changed(variables: Any, layer: str, outputs: slice, factor: float, added: float) -> Any:
    """Variables of the network with other logits of the decoder."""
    decoder = variables["params"]["decoder"]
    kernel, bias = decoder[layer]["kernel"], decoder[layer]["bias"]
    own = {"kernel": kernel.at[:, outputs].multiply(factor), "bias": bias.at[outputs].multiply(factor).at[outputs].add(added)}
    return variables | {"params": variables["params"] | {"decoder": decoder | {layer: own}}}


# A blind comparison -------------------------------------------------------------------------------------------------------


def shuffled(pictures: dict[str, list[np.ndarray]], names: Sequence[str]) -> tuple[list[np.ndarray], list[dict[str, str]]]:
    """Truth, A and B for each person and detail in random order; and for each which of the variants A and B are.

    pictures: by person the details of the truth and of both variants.
    """
    rng, key, tiles = np.random.default_rng(0), [], []
    which = [(seed, i) for seed in pictures for i in range(len(JUDGED))]
    for number in rng.permutation(len(which)):
        seed, detail = which[number]
        flipped = int(rng.integers(2))
        truth, *both = (image[detail].repeat(PAIR_ZOOM, 0).repeat(PAIR_ZOOM, 1) for image in pictures[seed])
        tiles += [truth, both[flipped], both[1 - flipped]]
        key.append({"person": seed, "detail": JUDGED[detail], "A": names[flipped], "B": names[1 - flipped]})
    return tiles, key


def write_pairs(folder: Path, pictures: dict[str, list[np.ndarray]], names: Sequence[str]) -> None:
    """Sheets of `shuffled` pairs, and key.json."""
    tiles, key = shuffled(pictures, names)
    folder.mkdir(parents=True, exist_ok=True)
    for first in range(0, len(key), PAIRS_A_SHEET):
        shown = tiles[3 * first : 3 * (first + PAIRS_A_SHEET)]
        labels = [text for i in range(first, first + len(shown) // 3) for text in (f"{i + 1}", "A", "B")]
        write_png(folder / f"pairs_{first // PAIRS_A_SHEET}.png", tile(np.stack(shown), labels=labels, columns=6))
    write_json(folder / "key.json", key)


@entry
def appearance_votes(run: Run, pairs: Path, votes: Path) -> None:
    """What was preferred in the sheets of `appearance --pairs`.

    Options:
    pairs: the folder
    votes: a text file: A, B or = for each pair, in their order
    """
    key, given = read_json(pairs / "key.json"), votes.read_text().split()
    if len(given) != len(key) or set(given) - set("AB="):
        raise ValueError(f"{votes}: expected A, B or = for each of {len(key)} pairs, got {len(given)} words")
    names = sorted({pair["A"] for pair in key} | {pair["B"] for pair in key})
    chosen = [pair.get(vote, "=") for pair, vote in zip(key, given, strict=True)]
    counted = lambda detail: [
        sum(choice == wanted and detail in (None, pair["detail"]) for choice, pair in zip(chosen, key, strict=True))
        for wanted in (*names, "=")
    ]
    rows = [[title, *counted(detail)] for title, detail in [*((name, name) for name in JUDGED), ("all", None)]]
    table = markdown_table(["detail", *names, "no difference"], rows, "l" + "r" * (len(names) + 1))
    about = f"{len(key)} pairs in random order, judged once each, without knowing which is which; the true image beside them."
    run.show(f"{about}\n\n{table}", {"votes": {title: counts for title, *counts in rows}, "names": names})
