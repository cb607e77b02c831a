"""How far bodies fitted into scans are from the true ones: bare and clothed, with noisy joints given and without any.

    python experiments/fitting/scans.py --subjects 32 --json scans.json [--without-joints] [--images scans.png]

People of the fitting seeds in random poses. A scan is the posed mesh of the dressed person, or of the bare body; each is
turned by a random rotation, scaled by 0.1 to 100 and moved. Given joints are the 17 of COCO with errors of --noise-mm
(before the scaling). The fitted body is put back into the scan's coordinates, from there by the true similarity into metres,
and compared with the true body: a scan has no unit of its own. Two distances: of equal vertices, and of the fitted
vertices from the true surface. A fit has succeeded if its vertices are within 50 mm on average.

--json writes {"bare" and "clothed": {"mean_vertex_mm", "mean_surface_mm", "worst_surface_mm", "success", "seconds_per_scan"},
"settings", "subjects": [...]} after every person. On two free CPU
cores about 3 s a scan and 20 s to compile, without joints four times as long.
"""

import argparse
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[2]))
from experiments.common.results import markdown_table, publish, significant, write_json

POSE_STREAM, JOINT_STREAM, PLACE_STREAM = 31, 33, 34
PAIRS = ("eye", "ear", "shoulder", "elbow", "wrist", "hip", "knee", "ankle")
JOINTS = ("nose", *(f"{side}_{part}" for part in PAIRS for side in ("left", "right")))
KINDS = ("bare", "clothed")
TABLE, SUCCESS = "fit_scans", 50.0
"""Millimetres of vertices on average: people turned round are above 100."""


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--subjects", type=int, default=32)
    parser.add_argument("--first", type=int, default=0, help="first person of the split")
    parser.add_argument("--split", default="fitting", choices=("validation", "test", "fitting"))
    parser.add_argument("--kinds", nargs="+", default=KINDS, choices=KINDS)
    parser.add_argument(
        "--noise-mm", type=float, default=5.0, help="standard deviation of given joints in each direction"
    )
    parser.add_argument("--without-joints", action="store_true", help="search for the pose")
    parser.add_argument("--json", type=Path, help="write the numbers here")
    parser.add_argument("--page", type=Path, help=f"page whose table {TABLE} or {TABLE}_without_joints is written")
    parser.add_argument("--images", type=Path, help="write scans with the fitted body, worst and best people, here")
    arguments = parser.parse_args()
    if arguments.subjects < 1:
        parser.error("--subjects: expected at least 1")
    try:
        report = evaluate(arguments)
    except ValueError as error:
        parser.error(str(error))
    text = table(report, arguments.kinds)
    print(text)
    if arguments.page:
        publish(arguments.page, TABLE + "_without_joints" * arguments.without_joints, text, report)


def evaluate(arguments: argparse.Namespace) -> dict[str, Any]:
    """Fit every scan; the report."""
    from humangs_jax.body.library import load_body
    from humangs_jax.people.seeds import seeds_of

    body, rows, drawn = load_body(), [], []
    settings = {"split": arguments.split, "first": arguments.first, "noise_mm": arguments.noise_mm}
    settings |= {"joints": not arguments.without_joints}
    report: dict[str, Any] = {}
    for seed in seeds_of(arguments.split, arguments.first, arguments.subjects):
        for kind in arguments.kinds:
            row, picture = fit_one(seed, kind, body, arguments)
            rows.append(row)
            drawn.append((row["surface_mm"], kind, picture))
            print(row, flush=True)
        report = {kind: summary([row for row in rows if row["kind"] == kind]) for kind in arguments.kinds}
        report |= {"settings": settings, "subjects": rows}
        if arguments.json:
            write_json(arguments.json, report)
    if arguments.images:
        draw_extremes(arguments.images, drawn, arguments.kinds)
    return report


def fit_one(seed, kind, body, arguments):
    """Scores of one scan, and what a picture of it needs."""
    import jax.numpy as jnp

    from humangs_jax.fitting.scan_fit import body_in_scan, fit_scan
    from humangs_jax.fitting.scan_reading import sample_scan

    true, landmarks, vertices, faces = person(seed, kind, body)
    place, rng = random_place(seed), np.random.default_rng([seed, JOINT_STREAM])
    noisy = place(landmarks + rng.normal(0, arguments.noise_mm / 1000, landmarks.shape))
    joints = None if arguments.without_joints else dict(zip(JOINTS, noisy, strict=True))
    start = time.perf_counter()
    scan = sample_scan(place(vertices), faces)
    fit = fit_scan(scan, body=body, joints=joints, clothed=kind == "clothed")
    seconds = time.perf_counter() - start
    fitted = place.inverse()(body_in_scan(fit))
    vertex = 1000 * np.linalg.norm(fitted - true, axis=1)
    surface = 1000 * distances_to_surface(fitted, true, np.asarray(body.faces))
    row = {"seed": seed, "kind": kind, "vertex_mm": float(vertex.mean()), "surface_mm": float(surface.mean())}
    row |= {"surface_p95_mm": float(np.quantile(surface, 0.95)), "seconds": seconds}
    row |= {"scale_ratio": fit.world_from_scan.scale * place.scale, "converged": bool(fit.report.stages[-1].converged)}
    return row, (f"{kind} {seed}: {row['surface_mm']:.1f} mm", vertices, jnp.asarray(faces), fitted, body.faces)


def person(seed, kind, body):
    """True vertices (n, 3) of the body and landmarks (k, 3), and the scan's vertices and faces, metres."""
    import jax
    import jax.numpy as jnp

    from humangs_jax.body.landmarks import landmark_model, pose_landmarks
    from humangs_jax.body.model import BodyPose, pose_body, shape_body
    from humangs_jax.people.poses import sample_rotations
    from humangs_jax.people.subject import make_subject

    subject = make_subject(seed, body)
    rotations = sample_rotations(np.random.default_rng([seed, POSE_STREAM]), subject.build).astype(np.float32)
    pose, betas = BodyPose(jnp.asarray(rotations), jnp.zeros(3)), jnp.asarray(subject.betas)
    posed = jax.jit(lambda b, p: (pose_body(body, shape_body(body, b), p).vertices, pose_landmarks(model, b, p)[0]))
    model = landmark_model(body, JOINTS)
    true, landmarks = (np.asarray(x, np.float64) for x in posed(betas, pose))
    if kind == "bare":
        return true, landmarks, true, np.asarray(body.faces)
    return true, landmarks, subject.posed_vertices(rotations, np.zeros(3)).astype(np.float64), subject.surface.faces


def random_place(seed):
    """A random similarity: any rotation, scale 0.1 to 100 by its logarithm, centre up to ten metres off before the scaling."""
    from humangs_jax.fitting.similarity import Similarity

    rng = np.random.default_rng([seed, PLACE_STREAM])
    w, x, y, z = (q := rng.normal(size=4)) / np.linalg.norm(q)
    rotation = np.asarray(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
    scale = float(10 ** rng.uniform(-1, 2))
    return Similarity(scale, rotation, scale * rng.uniform(-10, 10, 3))


NEAREST = 6
"""Vertices whose faces are looked at."""


def distances_to_surface(points, vertices, faces):
    """(p,) of points from a mesh, over the faces around the nearest vertices."""
    import trimesh
    from scipy.spatial import KDTree

    around = trimesh.Trimesh(vertices, faces, process=False).vertex_faces
    _, near = KDTree(vertices).query(points, k=NEAREST)
    best = np.full(len(points), np.inf)
    for face in np.moveaxis(around[near].reshape(len(points), -1), 1, 0):
        known = np.flatnonzero(face >= 0)
        closest = trimesh.triangles.closest_point(vertices[faces[face[known]]], points[known])
        best[known] = np.minimum(best[known], np.linalg.norm(closest - points[known], axis=1))
    return best


def summary(rows):
    """Of one kind of scans."""
    mean = lambda name: float(np.mean([row[name] for row in rows]))
    good = [row for row in rows if row["vertex_mm"] < SUCCESS]
    return {
        "scans": len(rows),
        "mean_vertex_mm": mean("vertex_mm"),
        "mean_surface_mm": mean("surface_mm"),
        "worst_surface_mm": max(row["surface_mm"] for row in rows),
        "success": len(good) / len(rows),
        "mean_surface_mm_of_successes": float(np.mean([row["surface_mm"] for row in good])) if good else None,
        "seconds_per_scan": float(np.median([row["seconds"] for row in rows])),
    }


def table(report: dict[str, Any], kinds: Sequence[str]) -> str:
    """One row for each kind: of all scans if joints were given, else of those whose pose was found."""
    if report["settings"]["joints"]:
        header = [
            f"scans, {len(JOINTS)} joints given with {report['settings']['noise_mm']:g} mm of noise",
            "vertices, mean",
        ]
        header += ["surface, mean", "surface, worst person", "seconds a scan"]
        names = ("mean_vertex_mm", "mean_surface_mm", "worst_surface_mm")
        row = lambda kind: [
            *(f"{significant(report[kind][name])} mm" for name in names),
            f"{report[kind]['seconds_per_scan']:.1f}",
        ]
        return markdown_table(header, [[kind, *row(kind)] for kind in kinds])
    header = [
        "scans, no joints",
        f"found (vertices within {SUCCESS:g} mm)",
        "of these: vertices, mean",
        "surface, mean",
    ]
    rows = []
    for kind in kinds:
        all_rows = [r for r in report["subjects"] if r["kind"] == kind]
        found = [r for r in all_rows if r["vertex_mm"] < SUCCESS]
        means = [f"{np.mean([r[x] for r in found]):.1f} mm" if found else "-" for x in ("vertex_mm", "surface_mm")]
        rows.append([kind, f"{len(found)} of {len(all_rows)}", *means])
    return markdown_table(header, rows)


def draw_extremes(path, drawn, kinds):
    """Best and worst scan of each kind: from two sides, the scan grey, the fitted body over it in red."""
    from humangs_jax.io.images import write_png

    rows = []
    for kind in kinds:
        of_kind = sorted((each for each in drawn if each[1] == kind), key=lambda each: each[0])
        for _, _, (title, *picture) in (of_kind[0], of_kind[-1]):
            print("drawn:", title)
            rows.append(draw_overlay(*picture))
    path.parent.mkdir(parents=True, exist_ok=True)
    write_png(path, np.concatenate(rows, axis=0))


def draw_overlay(vertices, faces, fitted, body_faces, size=420):
    """(size, 6 size, 3): from three sides, the scan, and beside it the body with the scan as a veil over it."""
    import jax.numpy as jnp

    from humangs_jax.geometry.camera import intrinsics_from_fov, orbit

    middle = jnp.asarray((vertices.min(axis=0) + vertices.max(axis=0)) / 2, jnp.float32)
    distance = 2.2 * float(np.ptp(vertices, axis=0).max())
    K = intrinsics_from_fov(0.5, size, size)
    cameras = orbit(middle, distance, jnp.asarray([0.0, 1.57, 3.14]), 0.1, K, size, size)
    parts = []
    for view in range(3):
        scan, body = (shaded(v, f, cameras[view]) for v, f in ((vertices, faces), (fitted, body_faces)))
        red = body[0][..., None] * np.asarray([1.0, 0.45, 0.4])
        red = np.where(body[1][..., None], red, 1.0)
        veil = np.where(scan[1][..., None], 0.35 * scan[0][..., None] + 0.65 * red, red)
        parts += [np.where(scan[1][..., None], scan[0][..., None], 1.0) * np.ones(3), veil]
    return np.concatenate(parts, axis=1)


def shaded(vertices, faces, camera):
    """Brightness (h, w) and where there is something (h, w)."""
    import jax.numpy as jnp

    from humangs_jax.rendering.mesh.rasterizer import rasterize_mesh

    faces = np.asarray(faces)
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    normals = np.cross(b - a, c - a)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
    found = np.asarray(
        rasterize_mesh(jnp.asarray(vertices, jnp.float32), jnp.asarray(faces, jnp.int32), camera).face_ids
    )
    facing = np.abs(normals @ np.asarray(camera.cam_from_world)[2, :3])
    return np.where(found >= 0, 0.3 + 0.7 * facing[np.maximum(found, 0)], 1.0), found >= 0


if __name__ == "__main__":
    main()
