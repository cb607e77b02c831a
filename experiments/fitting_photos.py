"""Cameras and poses that are a little off, refined by masks and keypoints."""

import dataclasses
import functools
import time
from pathlib import Path
from typing import Any, Literal, get_args

import jax
import jax.numpy as jnp
import numpy as np

from experiments.harness import Run, entry, means
from experiments.results import markdown_table
from humangs_jax.apps.check import draw_body
from humangs_jax.avatar.video import contact_sheet
from humangs_jax.body.landmarks import landmark_model, pose_landmarks
from humangs_jax.body.library import load_body
from humangs_jax.body.model import pose_body, shape_body
from humangs_jax.core.pytree import replace
from humangs_jax.data.keypoints.keypoints import COCO_17, Keypoints
from humangs_jax.fitting.refine import overlap, posed_vertices, refine_capture
from humangs_jax.geometry import quaternion, transform
from humangs_jax.geometry.camera import project
from humangs_jax.people.poses import sample_rotations
from humangs_jax.people.subject import make_subject, seeds_of
from humangs_jax.people.surroundings import cameras_around, spread_azimuths
from humangs_jax.people.writer import View, capture_views, stand
from humangs_jax.rendering.mesh.rasterizer import rasterize_mesh

POSE_STREAM, CAMERA_STREAM, ERROR_STREAM, KEYPOINT_STREAM = 31, 32, 33, 34
SUPERSAMPLING = 2
NOISE_PX = 2.0
"""Standard deviation of keypoints."""
FOCAL, TURN, BEND = 0.05, 2.0, 3.0
"""How far off a start is: share of the focal length, degrees of every camera about a random axis, degrees of every joint."""
Given = Literal["bare", "clothed", "keypoints", "clothed+keypoints"]


def true_captures(seed: int, body: Any, views: int, size: int = 512) -> tuple[Any, Any]:
    """The person of a seed in a random pose from cameras all around, with true parameters: (in clothes, the bare body)."""
    subject = make_subject(seed, body)
    posed = stand(subject, sample_rotations(np.random.default_rng([seed, POSE_STREAM]), subject.build))
    rng = np.random.default_rng([seed, CAMERA_STREAM])
    cameras = cameras_around(rng, posed.vertices, spread_azimuths(rng, views), size)
    clothed = capture_views(subject, body, [posed], [View(0, f"{i:03d}", cameras[i]) for i in range(views)])
    return clothed, dataclasses.replace(clothed, masks=bare_masks(clothed))


def bare_masks(capture: Any) -> np.ndarray:
    """(v, h, w) coverage by the posed body, without clothes."""
    vertices = posed_vertices(capture.body, jnp.asarray(capture.betas), capture.poses)
    height, width = capture.images.shape[1:3]
    s, masks = SUPERSAMPLING, []
    for view, frame in enumerate(capture.frames):
        large = capture.cameras[view].resized(s * width, s * height)
        covered = np.asarray(rasterize_mesh(vertices[int(frame)], capture.body.faces, large).face_ids) >= 0
        masks.append(covered.astype(np.float32).reshape(height, s, width, s).mean(axis=(1, 3)))
    return np.stack(masks)


def augmented(capture: Any, seed: int) -> Any:
    """The capture with focal lengths (all longer or all shorter), cameras (about their own centres) and joints off."""
    rng = np.random.default_rng([seed, ERROR_STREAM])
    about = lambda count, degrees: jnp.asarray(np.radians(degrees) * _directions(rng, count), jnp.float32)
    zoom = 1 + FOCAL * rng.choice([-1, 1])
    K = capture.cameras.K * jnp.asarray([[zoom, 1, 1], [1, zoom, 1], [1, 1, 1]])
    turns = transform.make(quaternion.matrix_from_axis_angle(about(capture.view_count, TURN)), jnp.zeros(3))
    rotations = capture.poses.rotations
    bends = about(rotations.shape[0] * rotations.shape[1], BEND).reshape(rotations.shape)
    turned = quaternion.multiply(quaternion.from_axis_angle(rotations), quaternion.from_axis_angle(bends))
    return dataclasses.replace(
        capture,
        cameras=replace(capture.cameras, K=K, cam_from_world=turns @ capture.cameras.cam_from_world),
        poses=replace(capture.poses, rotations=quaternion.to_axis_angle(turned)),
    )


def noisy_keypoints(truth: Any, seed: int, noise_px: float) -> Any:
    """COCO's 17 keypoints of the true body in every view, with normal errors; none is missing."""
    model, rng = landmark_model(truth.body, COCO_17.names), np.random.default_rng([seed, KEYPOINT_STREAM])
    points = []
    for view, frame in enumerate(truth.frames):
        landmarks, _ = pose_landmarks(model, jnp.asarray(truth.betas), truth.pose(int(frame)))
        pixels = np.asarray(project(truth.cameras[view], landmarks)[0])
        points.append(pixels + noise_px * rng.normal(size=pixels.shape))
    confidences = np.broadcast_to(np.asarray(model.known, np.float32), (truth.view_count, len(model.names)))
    return Keypoints(np.asarray(points, np.float32), confidences, COCO_17)


def mean_overlap(capture: Any, masks: Any) -> float:
    """Mean intersection over union of the posed body and masks (v, h, w) of the views."""
    covered = bare_masks(capture) > 0.5
    return float(np.mean([overlap(body, mask) for body, mask in zip(covered, masks, strict=True)]))


def joint_errors(capture: Any, truth: Any) -> tuple[float, float]:
    """Mean distance of the body's joints from the true ones, metres: in the world, and after the best rigid motion."""
    estimate, true = (_joints(each)[:, :22].reshape(-1, 3) for each in (capture, truth))
    raw = np.linalg.norm(estimate - true, axis=-1).mean()
    a, b = estimate - estimate.mean(0), true - true.mean(0)
    u, _, vt = np.linalg.svd(b.T @ a)
    rotation = (u * [1, 1, np.linalg.det(u @ vt)]) @ vt
    return float(raw), float(np.linalg.norm(a @ rotation.T - b, axis=-1).mean())


def _joints(capture):
    rest = shape_body(capture.body, jnp.asarray(capture.betas))
    return np.asarray(jax.jit(jax.vmap(lambda pose: pose_body(capture.body, rest, pose).joints))(capture.poses))


def _directions(rng, count):
    vectors = rng.normal(size=(count, 3))
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def scores(start: Any, refined: Any, truth: Any, bare_masks: Any) -> dict[str, float]:
    """How far start and refined capture are from the truth."""
    row = {}
    for when, capture in (("before", start), ("after", refined)):
        world, aligned = joint_errors(capture, truth)
        focal = float((capture.cameras.K / truth.cameras.K)[:, 0, 0].mean())
        row |= {
            f"iou_{when}": mean_overlap(capture, truth.masks),
            f"bare_iou_{when}": mean_overlap(capture, bare_masks),
            f"joints_{when}_mm": 1000 * world,
            f"aligned_{when}_mm": 1000 * aligned,
            f"focal_{when}_percent": 100 * abs(focal - 1),
        }
    return row


def draw(path: Path, start: Any, refined: Any) -> None:
    """Every second view: the body over the photo, before above after."""
    path.parent.mkdir(parents=True, exist_ok=True)
    views = range(0, start.view_count, 2)
    over = lambda c, i: draw_body(c.body, jnp.asarray(c.betas), c.pose(int(c.frames[i])), c.cameras[i], c.images[i])[0]
    pictures = np.stack([over(capture, i) for capture in (start, refined) for i in views])
    labels = [f"{when} {start.names[i]}" for when in ("before", "after") for i in views]
    contact_sheet(pictures, path, labels=labels, columns=len(views))


@entry
def fit_refinement(
    run: Run,
    subjects: int = 4,
    views: int = 6,
    size: int = 512,
    cases: tuple[Given, ...] = get_args(Given),
    images: Path | None = None,
) -> None:
    """How much refinement mends cameras and poses that are a little off, on synthetic people of the fitting seeds.

    The start: all focal lengths off by 5 %, every camera turned by 2 degrees about a random axis through its centre, every joint
    by 3 degrees about a random axis; true shape. Refined by masks of the body alone (bare), of the dressed person with hair
    (clothed), COCO's 17 keypoints with normal errors, or both. IoU with the masks of the case and with the true body; the body's
    22 joints in the world and after the best rigid motion, since cameras and person moved together look the same. About 10 s of
    CPU time a case and person, and two minutes of compiling.

    Options:
    subjects: how many people
    views: photos of each
    size: side of the photos, pixels
    cases: what to refine by
    images: folder for the body over the photos, before and after
    """
    if min(subjects, views) < 1:
        raise ValueError("--subjects and --views must be at least 1")
    body = load_body()

    def measure(seed):
        clothed, bare = true_captures(seed, body, views, size)
        keypoints, row = noisy_keypoints(clothed, seed, NOISE_PX), {}
        for case in cases:
            truth = bare if case == "bare" else clothed
            start = augmented(truth, seed)
            given = dataclasses.replace(start, masks=None) if case == "keypoints" else start
            begun = time.perf_counter()
            refined = refine_capture(given, keypoints=keypoints if "keypoints" in case else None)
            seconds = time.perf_counter() - begun
            row[case] = scores(start, refined.capture, truth, bare.masks)
            row[case] |= {"seconds": seconds, "refined": float(refined.report.kept)}
            if images:
                draw(images / f"{seed}_{case}.png", start, refined.capture)
        return row

    settings = {"views": views, "size": size, "noise_px": NOISE_PX, "cases": cases}
    seeds = seeds_of("fitting", 0, subjects)
    rows = list(run.rows({str(seed): functools.partial(measure, seed) for seed in seeds}, settings).values())
    mean = means(rows)
    pair = lambda row, name, unit="", digits=1: (
        f"{row[f'{name}_before{unit}']:.{digits}f} → {row[f'{name}_after{unit}']:.{digits}f}"
    )
    table = []
    for case, row in mean.items():
        cells = [pair(row, "iou", "", 3), pair(row, "bare_iou", "", 3), pair(row, "joints", "_mm"), pair(row, "aligned", "_mm")]
        table.append([case, *cells, pair(row, "focal", "_percent"), f"{row['seconds']:.0f}"])
    halved = lambda case, name: sum(row[case][f"{name}_after_mm"] < 0.5 * row[case][f"{name}_before_mm"] for row in rows)
    lines = [f"{case}: {halved(case, 'joints')}, {halved(case, 'aligned')} aligned" for case in mean]
    header = ("refined by", "IoU with the masks", "with the true body", "joints, mm", "aligned, mm", "focal, %", "s")
    run.show(
        f"{len(rows)} people of the fitting seeds, {views} views of {size} px.\n\n{markdown_table(header, table)}\n\n"
        f"People whose joint error was at least halved: {'; '.join(lines)}.",
        {"settings": settings, "cases": mean},
    )
