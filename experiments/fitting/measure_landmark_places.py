"""Where a detector puts its landmarks on bodies that are known: the places of `KeypointSet.places`, measured.

    python experiments/fitting/measure_landmark_places.py CAPTURES... [--page docs/fitting.md]

Every landmark is looked for in every view of the captures, whose bodies and cameras are taken for the truth. The offset from the
base of its place, in the axes of the bones that carry it, is the one that explains all pixels best (robust least squares over all
people; left and right are one landmark and its mirror image). Synthetic people come from `humangs synth`.
"""

import argparse
import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[2]))
from experiments.common.results import publish

CLEAR, SCALE, ITERATIONS, STEP = 0.5, 0.02, 15, 0.01
"""Least visibility; scale of the robust weights and step of the derivatives, metres; iterations of reweighting."""
RIDGE = 1e-3
"""Keeps offsets near 0 along directions that no view shows."""
WRONG = 0.05
"""Median error, a share of the person's height, from which on a view is left out: mirrored, or another person."""


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("captures", type=Path, nargs="+", help="capture folders, or folders of them")
    parser.add_argument("--page", type=Path, help="page of the docs whose table landmark_places is written")
    arguments = parser.parse_args()
    folders = [f.parent for each in arguments.captures for f in sorted(each.glob("**/capture.json"))]
    found = measure(folders)
    for name, row in found["places"].items():
        print(f"{name:<18} {row['millimetres']!s:<24} scatter {row['scatter']:5.1f} mm  n {row['count']}")
    if arguments.page:
        publish(arguments.page, "landmark_places", table(found), found)


def table(found: dict) -> str:
    """The offsets as a table, for a page."""
    rows = [
        "| landmark, left or middle | to the left | up | forwards | scatter, mm |",
        "| --- | ---: | ---: | ---: | ---: |",
    ]
    for name, row in found["places"].items():
        x, y, z = (f"{value:.0f}" for value in row["millimetres"])
        rows.append(f"| {name.removeprefix('left_').replace('_', ' ')} | {x} | {y} | {z} | {row['scatter']:.0f} |")
    return "\n".join(rows)


def measure(folders: list[Path]) -> dict:
    """Offsets in millimetres of the left or middle landmarks, by name."""
    from humangs_jax.data.keypoints.sets import MEDIAPIPE_33, mirrored_name
    from humangs_jax.detection.blazepose import Networks

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
    import jax.numpy as jnp

    from humangs_jax.body.landmarks import landmark_model, pose_landmarks
    from humangs_jax.core.pytree import replace
    from humangs_jax.data.capture import load_capture
    from humangs_jax.detection.people import detect_people

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


if __name__ == "__main__":
    main()
