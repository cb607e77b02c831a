"""What the light of the photos (`avatar.light`) gains: avatars with it and without, and the limit of those without.

    python experiments/evaluation/light.py --subjects 16 --json OUT --page docs/evaluation.md
    python experiments/evaluation/light.py --subjects 8 --sheet docs/images/light.jpg

"One pose": four photos of one pose. "Four poses": one photo of each of four poses. Two more poses are unseen. Avatars are those
of the pass and of the four iterations of refinement. "True surface": the generator's own people, drawn in a new pose with the
light that each point has in the photos of one pose. This is the best that an avatar with fixed colors can do.
"""

import argparse
import dataclasses
import sys
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[2]))
from experiments.common.results import markdown_table, publish, write_json
from experiments.evaluation.options import add_people_options, check_people_options, load_network, settings_of
from experiments.evaluation.results import kept_rows
from humangs_jax.evaluation.tables import mean_scores

POSES, RING, HELD_OUT = 6, 12, 3
"""Poses of a person, cameras around each, held-out views of each. The first four poses are those of photos, two are unseen."""
PHOTOS = 4
TABLE = "light"


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add_people_options(parser, subjects=16)
    parser.add_argument("--sheet", type=Path, help="an unseen pose of every person: truth, without and with the light")
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

    from experiments.evaluation.options import seeds_asked_for
    from experiments.evaluation.pictures import write_triples
    from humangs_jax.body.library import load_body

    body, (variables, config, digest) = load_body(), load_network(arguments)
    settings = settings_of(arguments, digest, config.tokens, None)
    rows, seeds = kept_rows(arguments.json, settings, "cells"), seeds_asked_for(arguments, body)
    report: dict[str, Any] = {}
    images = {}
    for seed in tqdm(seeds, desc="people"):
        if seed not in rows or arguments.sheet:
            rows[seed], images[seed] = measure(variables, config, seed, body, arguments.size)
        done = {seed: rows[seed] for seed in seeds if seed in rows}
        means = {
            name: {task: mean_scores(row[name][task] for row in done.values()) for task in cells}
            for name, cells in rows[seed].items()
        }
        people = [{"seed": seed, "cells": row} for seed, row in done.items()]
        report = {"settings": settings, "means": means, "subjects": people, "others": []}
        if arguments.json:
            write_json(arguments.json, report)
    if arguments.sheet:
        write_triples(arguments.sheet, images, 2, ("truth", "fixed colors", "light of the photos"))
    return report


def measure(variables, config, seed, body, size):
    """Scores by avatar and task of one person; an unseen pose, true, and after the iterations without and with the light."""
    import numpy as np

    from experiments.evaluation.pictures import cropped
    from humangs_jax.avatar.reconstruct import reconstruct
    from humangs_jax.evaluation.cases import draw_views
    from humangs_jax.people.cameras import cameras_around, spread_azimuths
    from humangs_jax.people.subject import make_subject
    from humangs_jax.people.writer import View, capture_views, sample_pose
    from humangs_jax.refinement.config import RefineConfig
    from humangs_jax.refinement.refine import refine

    subject, rng = make_subject(seed, body), np.random.default_rng([seed, RING])
    posed = [sample_pose(subject, i) for i in range(POSES)]
    rings = [cameras_around(rng, pose.vertices, spread_azimuths(rng, RING), size) for pose in posed]
    held = [cameras_around(rng, pose.vertices, spread_azimuths(rng, HELD_OUT), size) for pose in posed]
    of_photos = {
        "one pose": [View(0, f"photo_{i}", rings[0][RING // PHOTOS * i]) for i in range(PHOTOS)],
        "four poses": [View(i, f"photo_{i}", rings[i][RING // PHOTOS * i]) for i in range(PHOTOS)],
    }
    views = [View(i, f"{i}_{k}", held[i][k]) for i in range(POSES) for k in range(HELD_OUT)]
    truth, cells = capture_views(subject, body, posed, views), {}
    shown = [next(i for i, view in enumerate(views) if view.frame == POSES - 1)]
    images = [truth.images[shown[0]]]
    without_light = dataclasses.replace(config, conventions=dataclasses.replace(config.conventions, light=False))
    for name, photographed in of_photos.items():
        photos, seen = capture_views(subject, body, posed, photographed), sorted({view.frame for view in photographed})
        for light, how in (("without", without_light), ("with", config)):
            avatar = reconstruct(variables, how, photos)
            iterations = refine(avatar, photos, RefineConfig(steps=0, seconds=None))
            for label, made in (("pass", avatar), ("4 iterations", iterations)):
                cells[f"{name}, {label}, {light}"] = scores_of(made, truth, seen)
            if name == "one pose":
                images += list(draw_views(iterations, truth.select(shown)).images)
    fixed = [
        dataclasses.replace(pose, normals=posed[0].normals, openness=posed[0].openness, lit=posed[0].lit)
        for pose in posed
    ]
    drawn = capture_views(subject, body, fixed, views).images
    cells["true surface"] = scores_of(None, truth, [0], drawn)
    return cells, [cropped(image) for image in images]


def scores_of(avatar, truth, seen, drawn=None):
    """Scores of held-out views in the poses of the photos and in the unseen ones."""
    import numpy as np

    from experiments.evaluation.subjects import score_tasks
    from humangs_jax.evaluation.cases import draw_views

    drawn = draw_views(avatar, truth).images if drawn is None else drawn
    frames, found = np.asarray(truth.frames), {}
    for task, chosen in (("novel", seen), ("animation", [POSES - 2, POSES - 1])):
        views = np.flatnonzero(np.isin(frames, chosen))
        alone = dataclasses.replace(truth.select(views), frames=np.zeros(len(views), int))
        found[task] = score_tasks(drawn[views], alone)["novel"]
    return found


def section(report):
    """The table of the page."""
    rows = []
    shown = lambda scores: [f"{scores[key]:.2f}" for key in ("psnr", "psnr_fg")]
    for name, tasks in report["means"].items():
        photos, avatar, light = name.split(", ") if ", " in name else ("", "true surface, fixed colors", "")
        still = shown(tasks["novel"]) if photos else ["", ""]
        rows.append([photos, avatar, light, *still, *shown(tasks["animation"])])
    header = [
        "photos of",
        "avatar",
        "light",
        "poses of the photos: PSNR",
        "on the person",
        "unseen poses: PSNR",
        "on the person",
    ]
    settings, people = report["settings"], len(report["subjects"])
    about = (
        f"Means over {people} people of the {settings['split']} seeds, four photos of {settings['image_size']} px; dB."
    )
    return f"{about}\n\n{markdown_table(header, rows, 'lllrrrr')}"


if __name__ == "__main__":
    main()
