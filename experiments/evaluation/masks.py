"""What masks that are too large or too small cost, taken as they are and moved to the edges in the photos (`data.masks`).

    python experiments/evaluation/masks.py --subjects 8 --json OUT --page docs/stability.md
    python experiments/evaluation/masks.py --subjects 2 --sheet docs/images/masks.jpg

Four photos of each person, in front of a room of 120 boxes of random colors, which a mask that is too large lets through. Masks
are dilated or eroded by squares. "Exact": the true masks, and photos that were on white from the start.
"""

import argparse
import dataclasses
import sys
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[2]))
from experiments.common.results import markdown_table, publish, write_json
from experiments.evaluation.options import add_people_options, check_people_options, load_network, settings_of
from experiments.evaluation.results import kept_rows
from humangs_jax.evaluation.tables import mean_scores

PHOTOS = 4
ERRORS = (0, -1, 1, -3, 3)
"""Pixels of 256 that the masks are too large."""
AVATARS = ("pass", "4 iterations")
TABLE = "masks"
BOXES, LARGEST, NOISE = 120, 0.3, 0.03
"""Of a room: how many, their largest side in image heights, standard deviation of the noise on the photo."""


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add_people_options(parser, subjects=8)
    parser.add_argument("--sheet", type=Path, help="of every person: truth, masks as they are, masks that were moved")
    arguments = parser.parse_args()
    check_people_options(parser, arguments)
    report = evaluate(arguments)
    text = section(report)
    print(text)
    if arguments.page:
        publish(arguments.page, TABLE, text, {name: report[name] for name in ("settings", "means")})


def evaluate(arguments) -> dict[str, Any]:
    """Rows of all people, written to the JSON after each."""
    from tqdm import tqdm

    from experiments.evaluation.options import seeds_asked_for, shipped_digest
    from experiments.evaluation.pictures import cropped, write_triples
    from experiments.evaluation.subjects import HeldOut, make_evaluation_subject
    from humangs_jax.body.library import load_body
    from humangs_jax.refinement.learned import SHIPPED

    body, (variables, config, digest) = load_body(), load_network(arguments)
    settings = settings_of(arguments, digest, config.tokens, None) | {"refiner": shipped_digest(SHIPPED)}
    rows, seeds = kept_rows(arguments.json, settings, "cells"), seeds_asked_for(arguments, body)
    report: dict[str, Any] = {}
    images = {}
    for seed in tqdm(seeds, desc="people"):
        if seed not in rows or arguments.sheet:
            subject = make_evaluation_subject(seed, body, [PHOTOS], arguments.size, HeldOut(arguments.held_out, 0, 0))
            rows[seed], drawn = measure(variables, config, subject)
            images[seed] = [cropped(image) for image in drawn]
        done = {seed: rows[seed] for seed in seeds if seed in rows}
        means = {name: mean_scores(row[name] for row in done.values()) for name in rows[seed]}
        people = [{"seed": seed, "cells": row} for seed, row in done.items()]
        report = {"settings": settings, "means": means, "subjects": people, "others": []}
        if arguments.json:
            write_json(arguments.json, report)
    if arguments.sheet:
        write_triples(arguments.sheet, images, 2, ("truth", "masks 3 pixels too large", "moved to the edges"))
    return report


def measure(variables, config, subject):
    """Scores by masks and avatar of one person; a held-out view, true, and after the iterations without and with moved masks."""
    from experiments.evaluation.pictures import frontal_view
    from experiments.evaluation.subjects import score_tasks
    from humangs_jax.avatar.reconstruct import reconstruct
    from humangs_jax.data.masks import masks_at_edges
    from humangs_jax.data.photos import cut_out
    from humangs_jax.evaluation.cases import draw_views
    from humangs_jax.refinement.config import RefineConfig
    from humangs_jax.refinement.refine import refine

    inputs, held_out = subject.inputs(PHOTOS), subject.held_out
    view = frontal_view(inputs, held_out, list(range(held_out.view_count)))
    cells, shown = {}, [held_out.images[view]]

    def score(name, capture):
        avatar = reconstruct(variables, config, capture)
        refined = refine(avatar, capture, RefineConfig(steps=0, seconds=None))
        for title, made in zip(AVATARS, (avatar, refined), strict=True):
            drawn = draw_views(made, held_out)
            cells[f"{name}, {title}"] = score_tasks(drawn.images, held_out, alpha=drawn.alpha)["novel"]
        return drawn.images[view]

    score("exact", inputs)
    photos = in_a_room(inputs.images, inputs.masks, subject.seed)
    for error in ERRORS:
        masks = [grown(mask, round(error * mask.shape[0] / 256)) for mask in inputs.masks]
        moved = [mask for mask, _ in masks_at_edges(list(photos), masks)]
        for how, used in (("as they are", masks), ("moved", moved)):
            used = np.stack(used).astype(np.float32)
            cut = np.stack([cut_out(*pair) for pair in zip(photos, used, strict=True)])
            changed = dataclasses.replace(inputs, images=cut, masks=used)
            image = score(f"{error}, {how}", changed)
            if error == max(ERRORS):
                shown.append(image)
    return cells, shown


def in_a_room(images, masks, seed):
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


def grown(mask, pixels):
    """The mask dilated, or eroded below 0."""
    from scipy.ndimage import grey_dilation, grey_erosion

    side = 2 * abs(pixels) + 1
    return mask if pixels == 0 else (grey_dilation if pixels > 0 else grey_erosion)(mask, (side, side))


def section(report):
    """The table of the page."""
    means = report["means"]
    pair = lambda name, key: [f"{means[f'{name}, {avatar}'][key]:.2f}" for avatar in AVATARS]
    both = lambda name: [*pair(name, "psnr"), *pair(name, "psnr_fg")]
    rows = [["exact", "photos on white", *both("exact")]]
    rows += [
        [f"{error:+d}" if error else "0", how, *both(f"{error}, {how}")]
        for error in ERRORS
        for how in ("as they are", "moved")
    ]
    header = ["masks, pixels of 256", "used", *AVATARS, *(f"on the person, {avatar}" for avatar in AVATARS)]
    settings, people = report["settings"], len(report["subjects"])
    photos = f"{PHOTOS} photos of {settings['image_size']} px"
    about = f"Means over {people} people of the {settings['split']} seeds, {photos}; PSNR in dB."
    return f"{about}\n\n{markdown_table(header, rows, 'llrrrr')}"


if __name__ == "__main__":
    main()
