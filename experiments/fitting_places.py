"""Where a detector puts its landmarks, and what a fitted body costs in the end."""

import dataclasses
import functools
from pathlib import Path
from typing import Literal

import jax.numpy as jnp
import numpy as np

from experiments.fitting import FIRST, FitCase, detect
from experiments.harness import Run, entry, means
from experiments.results import markdown_table
from experiments.subjects import HeldOut, make_evaluation_subject
from humangs_jax.avatar.reconstruct import reconstruct
from humangs_jax.avatar.sheets import contact_sheet
from humangs_jax.body.landmarks import landmark_model, pose_landmarks
from humangs_jax.body.library import load_body
from humangs_jax.core.pytree import replace
from humangs_jax.data.capture import load_capture, save_capture
from humangs_jax.data.keypoints.keypoints import Keypoints
from humangs_jax.data.keypoints.sets import KEYPOINT_SETS, MEDIAPIPE_33, mirrored_name
from humangs_jax.data.photos import Photos
from humangs_jax.detection.blazepose import Networks
from humangs_jax.detection.people import detect_people
from humangs_jax.evaluation.cases import draw_views
from humangs_jax.evaluation.scores import score
from humangs_jax.fitting.fit_capture import fit_photos
from humangs_jax.network.weights import load_weights
from humangs_jax.refinement.config import RefineConfig
from humangs_jax.refinement.refine import refine

CLEAR, SCALE, ITERATIONS, STEP = 0.5, 0.02, 15, 0.01
"""Least visibility; scale of the robust weights and step of the derivatives, metres; iterations of reweighting."""
RIDGE = 1e-3
"""Keeps offsets near 0 along directions that no view shows."""
WRONG = 0.05
"""Median error, a share of the person's height, from which on a view is left out: mirrored, or another person."""


@entry
def landmark_places(run: Run, captures: tuple[Path, ...]) -> None:
    """Where a detector puts its landmarks on bodies that are known: the places of `KeypointSet.places`, measured.

    Every landmark is looked for in every view of the captures, whose bodies and cameras are taken for the truth. The offset from
    the base of its place, in the axes of the bones that carry it, is the one that explains all pixels best (robust least squares
    over all people; left and right are one landmark and its mirror image). Synthetic people come from `humangs synth`.

    Options:
    captures: capture folders, or folders of them
    """
    found = measure([file.parent for each in captures for file in sorted(each.glob("**/capture.json"))])
    name = lambda name: name.removeprefix("left_").replace("_", " ")
    rows = [
        [name(key), *(f"{value:.0f}" for value in row["millimetres"]), f"{row['scatter']:.0f}"]
        for key, row in found["places"].items()
    ]
    header = ["landmark, left or middle", "to the left", "up", "forwards", "scatter, mm"]
    run.show(markdown_table(header, rows), found)


def measure(folders: list[Path]) -> dict:
    """Offsets in millimetres of the left or middle landmarks, by name."""
    networks, rows, views = Networks(), {}, [0, 0]
    for folder in folders:
        for each in view_rows(networks, folder, MEDIAPIPE_33):
            views[0] += 1
            views[1] += bool(each)
            for name, row in each.items():
                rows.setdefault(name, []).append(row)
    places = {}
    for place in MEDIAPIPE_33.places:
        name, other = place.name, mirrored_name(place.name)
        if MEDIAPIPE_33.names.index(name) > MEDIAPIPE_33.names.index(other):
            continue
        mirrored = [(change * [-1, 1, 1], error) for change, error in rows.get(other, ())] if name != other else []
        own = rows.get(name, [])
        if own or mirrored:
            offset, scatter = solved(own + mirrored)
            sides = [solved(side)[0].tolist() for side in (own, mirrored) if side]
            places[name] = {
                "millimetres": np.round(offset, 1).tolist(),
                "scatter": round(scatter, 1),
                "count": len(own) + len(mirrored),
                "sides": np.round(sides, 1).tolist(),
            }
    return {"captures": len(folders), "views": views[0], "views_used": views[1], "places": places}


def view_rows(networks, folder, kind):
    """For each view, by name: the change of the image with the offset (2, 3) and the error (2,), in metres at the person."""
    capture = load_capture(folder)
    plain = tuple(place._replace(offset=(0.0, 0.0, 0.0)) for place in kind.places)
    model = landmark_model(capture.body, kind.names, plain)
    moved = [replace(model, points=replace(model.points, rest=model.points.rest + STEP * row)) for row in jnp.eye(3)]
    betas = jnp.asarray(capture.betas)
    for view in range(capture.view_count):
        pose = capture.pose(int(capture.frames[view]))
        people = detect_people(networks, np.asarray(capture.images[view], np.float32))
        if not people:
            yield {}
            continue
        K, transform = (np.asarray(x[view], float) for x in (capture.cameras.K, capture.cameras.cam_from_world))
        points = [np.asarray(pose_landmarks(each, betas, pose)[0], float) for each in (model, *moved)]
        pixels = [projected(each, K, transform) for each in points]
        changes = np.stack([(each - pixels[0]) / STEP for each in pixels[1:]], axis=-1)
        errors, person = people[0].pixels - pixels[0], people[0]
        height = np.ptp(pixels[0], axis=0).max()
        if np.median(np.linalg.norm(errors, axis=-1)) > WRONG * height:
            yield {}
            continue
        scale = K[0, 0] / (points[0] @ transform[2, :3] + transform[2, 3])
        seen = person.visibility > CLEAR
        yield {
            name: (changes[i] / scale[i], errors[i] / scale[i])
            for i, name in enumerate(kind.names)
            if seen[i] and model.known[i]
        }


def projected(points, K, transform):
    """Pixels of points of the world."""
    seen = (points @ transform[:3, :3].T + transform[:3, 3]) @ K.T
    return seen[:, :2] / seen[:, 2:]


def solved(rows):
    """The offset that explains the errors best, and the median length of what is left, millimetres."""
    changes, errors = (np.stack(each) for each in zip(*rows, strict=True))
    weights, offset = np.ones(len(rows)), np.zeros(3)
    for _ in range(ITERATIONS):
        matrix = np.einsum("n,nij,nik->jk", weights, changes, changes) + RIDGE * np.eye(3)
        offset = np.linalg.solve(matrix, np.einsum("n,nij,ni->j", weights, changes, errors))
        left = np.linalg.norm(errors - changes @ offset, axis=-1)
        weights = 1 / (1 + np.square(left / SCALE))
    return 1000 * offset, 1000 * float(np.median(left))


VIEWS, SIZE = 4, 256


COLUMNS = {
    "true_psnr": "PSNR, true parameters",
    "fitted_psnr": "PSNR, fitted",
    "true_foreground": "on the person, true",
    "fitted_foreground": "on the person, fitted",
    "true_refined_psnr": "PSNR, true, refined",
    "fitted_refined_psnr": "PSNR, fitted, refined",
    "true_refined_foreground": "on the person, true, refined",
    "fitted_refined_foreground": "on the person, fitted, refined",
    "joints_mm": "joint error, mm",
}


@entry
def fit_end_to_end(
    run: Run,
    people: int = 4,
    noise_px: float = 2.0,
    outliers: float = 0.0,
    kind: Literal["coco17", "wholebody133", "openpose67"] = "wholebody133",
    seconds: float = 5.0,
    captures: Path | None = None,
    images: Path | None = None,
) -> None:
    """What a fitted body costs in the end: photos and keypoints -> fit -> reconstruct -> refine, beside true body parameters.

    People of the fitting seeds, four photos of 256 pixels each. Keypoints are the true ones with noise and outliers, at the
    accuracy of a detector that sees 512 pixels; cameras are true. Each reconstruction is drawn with the parameters it was made
    from, fitted or true, and compared with held-out photos. About a minute a person after a minute of compilation.

    Options:
    people: of the fitting seeds
    noise_px: standard deviation of detections, pixels of 512
    outliers: share of points displaced by up to 100 pixels of 512
    kind: which keypoints
    seconds: of refinement
    captures: folder for the fitted captures, PERSON/ and PERSON/held_out/
    images: folder for PERSON.png: truth, true and fitted parameters, both refined
    """
    if people < 1:
        raise ValueError(f"--people {people}: expected at least 1")
    body, (variables, config) = load_body(), load_weights()

    def measure(seed):
        subject = make_evaluation_subject(seed, body, [VIEWS], SIZE, HeldOut(views=6, poses=0))
        photos = subject.inputs(VIEWS)
        fitted, millimetres = fitted_capture(photos, body, seed, kind, noise_px, outliers)
        pictures = {}
        for name, inputs in (("true", photos), ("fitted", fitted)):
            views = dataclasses.replace(subject.held_out, poses=inputs.poses, betas=inputs.betas)
            avatar = reconstruct(variables, config, inputs)
            pictures[name] = draw_views(avatar, views).images
            avatar = refine(avatar, inputs, RefineConfig(seconds=seconds))
            pictures[f"{name}_refined"] = draw_views(avatar, views).images
            if captures and name == "fitted":
                save_capture(captures / str(seed), inputs)
                save_capture(captures / str(seed) / "held_out", views)
        if images:
            images.mkdir(parents=True, exist_ok=True)
            sheet = np.concatenate([subject.held_out.images[:3], *(drawn[:3] for drawn in pictures.values())])
            contact_sheet(sheet, images / f"{seed}.png")
        scores = {name: score(drawn, subject.held_out) for name, drawn in pictures.items()}
        row = {f"{name}_psnr": float(s.psnr) for name, s in scores.items()}
        return row | {f"{name}_foreground": float(s.psnr_fg) for name, s in scores.items()} | {"joints_mm": millimetres}

    settings = {"noise_px": noise_px, "outliers": outliers, "set": kind, "seconds": seconds}
    rows = run.rows({str(seed): functools.partial(measure, seed) for seed in range(FIRST, FIRST + people)}, settings)
    shown = rows | {"mean": means(list(rows.values()))}
    cells = [[name, *(f"{row[key]:.2f}" for key in COLUMNS)] for name, row in shown.items()]
    run.show(markdown_table(["person", *COLUMNS.values()], cells), {"settings": settings, "means": shown["mean"]})


def fitted_capture(photos, body, seed, kind, noise_px, outliers):
    """The capture with a fitted body, and its mean joint error."""
    keypoint_set = KEYPOINT_SETS[kind]
    model = landmark_model(body, keypoint_set.names)
    landmarks, joints = pose_landmarks(model, photos.betas, photos.pose(0))
    K, pose = np.asarray(photos.cameras.K)[None], np.asarray(photos.cameras.cam_from_world)[None]
    rotations, translations = np.asarray(photos.poses.rotations), np.asarray(photos.poses.translation)
    truth = (np.asarray(x)[None] for x in (joints, landmarks))
    case = FitCase(photos.betas, rotations, translations, *truth, K, pose)
    points = detect(case, seed, noise_px * SIZE / 512, outliers, 100 * SIZE / 512)[0]
    confidences = np.broadcast_to(np.asarray(model.known, np.float32), points.shape[:-1])
    keypoints = Keypoints(points.astype(np.float32), confidences, keypoint_set)
    seen = Photos(photos.images, photos.masks, photos.cameras, photos.frames, photos.names)
    fitted = fit_photos(seen, keypoints, body)
    error = np.linalg.norm(np.asarray(fitted.fit.joints)[0] - np.asarray(joints), axis=-1)
    return fitted.capture, float(1000 * error.mean())
