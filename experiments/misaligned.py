"""Measures what refinement gains for people who move between photos that share one pose."""

import dataclasses
import functools
from typing import Any
from unittest import mock

import numpy as np

from experiments.harness import Run, entry
from experiments.results import cells, markdown_table
from experiments.subjects import (
    RING,
    HeldOut,
    People,
    Start,
    frontal_camera,
    make_evaluation_subject,
    ring_positions,
    score_tasks,
)
from humangs_jax.avatar.reconstruct import reconstruct
from humangs_jax.data.capture import Capture
from humangs_jax.evaluation.cases import predict_views
from humangs_jax.evaluation.means import mean_scores
from humangs_jax.refinement import search
from humangs_jax.refinement.config import RefineConfig
from humangs_jax.refinement.refine import refine_with_report
from humangs_jax.synthetic.subject import PosedSubject, make_subject, pose_subject
from humangs_jax.synthetic.surroundings import cameras_around, spread_azimuths
from humangs_jax.synthetic.writer import Stream, View, capture_views, sample_pose

MOVED_STREAM = 77
"""Random stream of a seed, for the movements between photos."""
MOVED_JOINTS = 22
"""Number of joints of trunk, limbs and head, which come first in the body."""
SMALL = 0.02
"""Radians of the first movement whose size in centimetres is measured."""
NEVER = float("inf")
"""Value of `search.STILL` with which no photo is moved."""
SHOWN = {"psnr": ("PSNR", 2), "psnr_fg": ("foreground PSNR", 2), "lpips": ("LPIPS", 3)}
"""{score: its heading and digits in the table}. LPIPS is missing where its weights are not
installed.
"""


@entry
def misaligned(
    run: Run,
    people: People = People(4, held_out=4, poses=0, split="validation"),
    centimetres: tuple[float, ...] = (0.0, 1.0, 2.0, 4.0),
    views: int = 4,
) -> None:
    """Measures what iterations gain where the person has moved between photos that share one pose.

    The shared pose is the mean of those that the photos show. Held-out views show the shared pose.
    "iterations" uses the photos unchanged. "and moved photos" moves them as `refine` does.

    Options:
    centimetres: mean distance of the vertices from where the pose has them
    views: photos that the network and the iterations see
    """
    start, rows = people.start(), {}
    for seed in start.seeds:
        for far in centimetres:
            rows[f"{seed} {far:g}"] = functools.partial(_measured, start, seed, far, views)
    settings = start.settings | {"views": views, "centimetres": centimetres}
    found = run.rows(rows, settings)
    run.show(misaligned_section(found, centimetres), found)


def _measured(start: Start, seed: int, far: float, views: int) -> dict[str, Any]:
    """Returns the scores of held-out views before the iterations, and after them in both ways."""
    photos = moved_photos(start, seed, far, views)
    held = HeldOut(start.held_out.views, 0, 1)
    truth = make_evaluation_subject(seed, start.body, [1], start.size, held).held_out
    avatar = reconstruct(start.variables, start.config, photos)
    alone = RefineConfig(steps=0, head_steps=0)

    def scored(made: Any) -> dict[str, Any]:
        drawn = predict_views(made, truth)
        scores = score_tasks(drawn.images, truth, start.lpips, drawn.alpha)["novel"]
        return {name: scores[name] for name in SHOWN}

    with mock.patch.object(search, "STILL", NEVER):
        still = refine_with_report(avatar, photos, dataclasses.replace(alone, held_out=0.0))
    refined = refine_with_report(avatar, photos, alone)
    return {
        "none": scored(avatar),
        "iterations": scored(still.avatar) | {"kept": still.kept},
        "and moved photos": scored(refined.avatar)
        | {"kept": refined.kept, "moved": refined.moved, "iterations": refined.iterations},
    }


def moved_photos(start: Start, seed: int, far: float, views: int) -> Capture:
    """Returns a capture whose photos show a person in poses around one pose, and which has that
    pose for all of them.
    """
    subject = make_subject(seed, start.body)
    still = sample_pose(subject, 0)
    rng = np.random.default_rng([seed, Stream.CAMERAS])
    ring = cameras_around(rng, still.vertices, spread_azimuths(rng, RING), start.size)
    front = frontal_camera(still, ring)
    places = [
        View(frame, f"photo_{i:02d}", ring[(front + i) % RING])
        for frame, i in enumerate(ring_positions(views))
    ]
    shown = capture_views(subject, start.body, moved_poses(still, far, views), places)
    shared = capture_views(subject, start.body, [still], [View(0, "shared", ring[front])]).poses
    return dataclasses.replace(shown, poses=shared, frames=np.zeros(views, np.int32))


def moved_poses(still: PosedSubject, centimetres: float, count: int) -> list[PosedSubject]:
    """Returns the person in `count` poses around a pose, from which vertices are this far away in
    the mean.

    All joints turn by about the same angle. The mean of the turns is zero, so that a fit to all
    poses finds the pose in the middle.
    """
    if not centimetres:
        return [still] * count
    rng = np.random.default_rng([still.subject.seed, MOVED_STREAM])
    turns = np.zeros((count, *still.rotations.shape))
    turns[:, :MOVED_JOINTS] = rng.normal(size=(count, MOVED_JOINTS, 3))
    turns -= turns.mean(axis=0)
    scale = SMALL
    for _ in range(3):  # the size is nearly in proportion
        poses = [(still.rotations + scale * turn).astype(np.float32) for turn in turns]
        moved = [still.subject.posed_vertices(pose, still.translation) for pose in poses]
        size = 100 * np.linalg.norm(np.stack(moved) - still.vertices, axis=-1).mean()
        scale *= centimetres / size
    poses = [(still.rotations + scale * turn).astype(np.float32) for turn in turns]
    return [pose_subject(still.subject, pose, still.translation) for pose in poses]


def misaligned_section(rows: dict[str, Any], centimetres: tuple[float, ...]) -> str:
    """Formats the table of the page: means over the people, and the least gain of a person."""
    lines = []
    for far in centimetres:
        people = [row for name, row in rows.items() if name.split()[1] == f"{far:g}"]
        for way in people[0]:
            means = cells(mean_scores(row[way] for row in people), SHOWN)
            gains = [row[way]["psnr"] - row["none"]["psnr"] for row in people]
            least = "" if way == "none" else f"{min(gains):.2f}"
            lines.append([f"{far:g} cm", len(people), way, *means, least])
    names = [*(heading for heading, _ in SHOWN.values()), "least gain, dB"]
    return markdown_table(["off by", "people", "refinement", *names], lines, "lrlrrrr")
