"""How far bodies fitted into scans are from the true ones: bare and clothed, with noisy joints
given and without any.
"""

import functools
import itertools
import time
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
import trimesh
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from experiments.harness import Run, entry
from experiments.results import markdown_table, significant
from humangs_jax.body.landmarks import landmark_model, pose_landmarks
from humangs_jax.body.library import load_body
from humangs_jax.body.model import BodyPose, pose_body, shape_body
from humangs_jax.fitting.scan_files import sample_scan
from humangs_jax.fitting.scan_fit import body_in_scan, fit_scan
from humangs_jax.fitting.triangulation import Similarity
from humangs_jax.people.poses import sample_rotations
from humangs_jax.people.subject import make_subject, seeds_of

POSE_STREAM, JOINT_STREAM, PLACE_STREAM = 31, 33, 34
PAIRS = ("eye", "ear", "shoulder", "elbow", "wrist", "hip", "knee", "ankle")
JOINTS = ("nose", *(f"{side}_{part}" for part in PAIRS for side in ("left", "right")))
NOISE_MM = 5.0
"""Standard deviation of the given joints, COCO's 17, in each direction."""
SUCCESS = 50.0
"""Millimetres of vertices on average: people turned round are above 100."""


@entry
def fit_scans(
    run: Run,
    subjects: int = 32,
    kinds: tuple[Literal["bare", "clothed"], ...] = ("bare", "clothed"),
    without_joints: bool = False,
) -> None:
    """How far bodies fitted into scans are from the true ones: bare and clothed, with noisy joints
    given and without any.

    People of the fitting seeds in random poses. A scan is the posed mesh of the dressed person, or
    of the bare body, turned by a random rotation, scaled by 0.1 to 100 and moved. The fitted body
    is put back into the scan's coordinates, from there by the true similarity into metres, and
    compared with the true body. Two distances: of equal vertices, and of the fitted vertices from
    the true surface. A fit has succeeded if its vertices are within 50 mm on average. 3 s a scan,
    without joints four times as long.

    Options:
    without_joints: search for the pose (name the table fit_scans_without_joints)
    """
    if subjects < 1:
        raise ValueError("--subjects: expected at least 1")
    body, each = load_body(), itertools.product(seeds_of("fitting", 0, subjects), kinds)
    cases = {
        f"{kind} {seed}": functools.partial(fit_one, seed, kind, body, without_joints)
        for seed, kind in each
    }
    settings = {"noise_mm": NOISE_MM, "joints": not without_joints}
    rows = run.rows(cases, settings)
    numbers: dict[str, Any] = {
        kind: summary([row for name, row in rows.items() if name.startswith(kind)])
        for kind in kinds
    }
    run.show(scans_table(numbers, without_joints), numbers | {"settings": settings})


def scans_table(numbers: dict[str, Any], without_joints: bool) -> str:
    """One row for each kind: of all scans if joints were given, else of those whose pose was
    found.
    """
    if without_joints:
        header = [
            "scans, no joints",
            f"found (vertices within {SUCCESS:g} mm)",
            "of these: vertices, mean",
            "surface, mean",
        ]
        shown = lambda value: "-" if value is None else f"{value:.1f} mm"
        rows = [
            [kind, f"{round(row['success'] * row['scans'])} of {row['scans']}"]
            + [shown(row[f"mean_{name}_mm_of_successes"]) for name in ("vertex", "surface")]
            for kind, row in numbers.items()
        ]
        return markdown_table(header, rows)
    header = [f"scans, {len(JOINTS)} joints given with {NOISE_MM:g} mm of noise", "vertices, mean"]
    header += ["surface, mean", "surface, worst person", "seconds a scan"]
    names = ("mean_vertex_mm", "mean_surface_mm", "worst_surface_mm")
    cells = lambda row: [
        *(f"{significant(row[name])} mm" for name in names),
        f"{row['seconds_per_scan']:.1f}",
    ]
    return markdown_table(header, [[kind, *cells(row)] for kind, row in numbers.items()])


def fit_one(seed, kind, body, without_joints):
    true, landmarks, vertices, faces = person(seed, kind, body)
    place, rng = random_place(seed), np.random.default_rng([seed, JOINT_STREAM])
    noisy = place(landmarks + rng.normal(0, NOISE_MM / 1000, landmarks.shape))
    joints = None if without_joints else dict(zip(JOINTS, noisy, strict=True))
    start = time.perf_counter()
    scan = sample_scan(place(vertices), faces)
    fit = fit_scan(scan, body=body, joints=joints, clothed=kind == "clothed")
    seconds = time.perf_counter() - start
    fitted = place.inverse()(body_in_scan(fit))
    vertex = 1000 * np.linalg.norm(fitted - true, axis=1)
    surface = 1000 * distances_to_surface(fitted, true, np.asarray(body.faces))
    row = {
        "seed": seed,
        "kind": kind,
        "vertex_mm": float(vertex.mean()),
        "surface_mm": float(surface.mean()),
    }
    row |= {"surface_p95_mm": float(np.quantile(surface, 0.95)), "seconds": seconds}
    row["scale_ratio"] = fit.world_from_scan.scale * place.scale
    return row


def person(seed, kind, body):
    """True vertices (n, 3) of the body and landmarks (k, 3), and the scan's vertices and faces,
    metres.
    """
    subject = make_subject(seed, body)
    rotations = sample_rotations(np.random.default_rng([seed, POSE_STREAM]), subject.build).astype(
        np.float32
    )
    pose, betas = BodyPose(jnp.asarray(rotations), jnp.zeros(3)), jnp.asarray(subject.betas)
    posed = jax.jit(
        lambda b, p: (
            pose_body(body, shape_body(body, b), p).vertices,
            pose_landmarks(model, b, p)[0],
        )
    )
    model = landmark_model(body, JOINTS)
    true, landmarks = (np.asarray(x, np.float64) for x in posed(betas, pose))
    if kind == "bare":
        return true, landmarks, true, np.asarray(body.faces)
    return (
        true,
        landmarks,
        subject.posed_vertices(rotations, np.zeros(3)).astype(np.float64),
        subject.surface.faces,
    )


def random_place(seed):
    """A random similarity: any rotation, scale 0.1 to 100 by its logarithm, centre up to ten metres
    off before the scaling.
    """
    rng = np.random.default_rng([seed, PLACE_STREAM])
    w, x, y, z = rng.normal(size=4)
    rotation = Rotation.from_quat([x, y, z, w]).as_matrix()
    scale = float(10 ** rng.uniform(-1, 2))
    return Similarity(scale, rotation, scale * rng.uniform(-10, 10, 3))


NEAREST = 6
"""Vertices whose faces are looked at."""


def distances_to_surface(points, vertices, faces):
    """(p,) of points from a mesh, over the faces around the nearest vertices."""
    around = trimesh.Trimesh(vertices, faces, process=False).vertex_faces
    _, near = KDTree(vertices).query(points, k=NEAREST)
    best = np.full(len(points), np.inf)
    for face in np.moveaxis(around[near].reshape(len(points), -1), 1, 0):
        known = np.flatnonzero(face >= 0)
        closest = trimesh.triangles.closest_point(vertices[faces[face[known]]], points[known])
        best[known] = np.minimum(best[known], np.linalg.norm(closest - points[known], axis=1))
    return best


def summary(rows):
    mean = lambda name, rows: float(np.mean([row[name] for row in rows])) if rows else None
    good = [row for row in rows if row["vertex_mm"] < SUCCESS]
    return {
        "scans": len(rows),
        "mean_vertex_mm": mean("vertex_mm", rows),
        "mean_surface_mm": mean("surface_mm", rows),
        "worst_surface_mm": max(row["surface_mm"] for row in rows),
        "success": len(good) / len(rows),
        "mean_vertex_mm_of_successes": mean("vertex_mm", good),
        "mean_surface_mm_of_successes": mean("surface_mm", good),
        "seconds_per_scan": float(np.median([row["seconds"] for row in rows])),
    }
