"""What `humangs fit --smoothness` makes of sequences with frames that are badly seen: the shipped walk with known keypoints.

    python experiments/fitting/sequences.py --json sequences.json --page docs/fitting.md

Writes the mean error over all 55 joints of the frames that the case leaves alone and of those that it spoils, and the mean error
of the joints' accelerations where no frame is spoilt (how much they tremble), with frames fitted one by one and with smooth
motion, for each smoothness. About 15 minutes on two cores. With --known FILE, numbers of an earlier run of the same people and
keypoints are taken from there, and only what it lacks is computed.
"""

import argparse
import json
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[2]))

FIRST = 4_000_000
FRAMES, OTHER = 7, (0.8, 0.0, 0.5)
"""Frames of the walk, and how far from the person somebody else stands, metres."""
CASES = {
    "all frames seen": (4, 1.0, ()),
    "frame 3 without keypoints": (4, 1.0, (3,)),
    "the last frame without keypoints": (4, 1.0, (6,)),
    "frames 2 to 4 without keypoints": (4, 1.0, (2, 3, 4)),
    "frame 3 seen by one view": (4, 1.0, (3,)),
    "frame 3 is somebody else": (4, 1.0, (3,)),
    "a fifth of frame 3 up to 100 px off": (4, 1.0, (3,)),
    "one camera": (1, 1.0, ()),
    "one camera, frame 3 without keypoints": (1, 1.0, (3,)),
    "4 px of noise": (4, 4.0, ()),
}
"""Views, noise of the detections in pixels of 512, and which frames are spoilt."""


def main() -> None:
    """Command line."""
    from experiments.common.results import add_outputs

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--smoothness",
        type=float,
        nargs="+",
        default=[0.005, 0.02],
        help="expected acceleration, metres per frame squared",
    )
    parser.add_argument("--known", type=Path, help="JSON file of an earlier run, whose numbers are used again")
    parser.add_argument("--people", type=int, default=3, help="of the fitting seeds")
    parser.add_argument("--set", default="wholebody133", choices=("coco17", "wholebody133"), help="which keypoints")
    parser.add_argument("--cases", nargs="*", choices=tuple(CASES), default=tuple(CASES), help="default: all")
    add_outputs(parser, "fit_sequences")
    arguments = parser.parse_args()
    run(arguments)


def run(arguments) -> None:
    """Every case, with frames one by one and with smooth motion."""
    from experiments.common.results import markdown_table, write_outputs
    from experiments.fitting.cases import walking

    model, people = walking(range(FIRST, FIRST + arguments.people), arguments.set, FRAMES, 4)
    known = json.loads(arguments.known.read_text())["numbers"] if arguments.known else {}
    ways = {"alone": 0.0} | {f"smooth {s:g}": s for s in arguments.smoothness}
    numbers = {name: {} for name in arguments.cases}
    for name, found in numbers.items():
        for way, smoothness in ways.items():
            found[way] = known.get(name, {}).get(way) or measure(model, people, name, smoothness)
            print(name, way, found[way], flush=True)
    show = lambda value: "-" if value is None else f"{value:.0f}" if value >= 99.5 else f"{value:.1f}"
    keys = ("others_mm", "spoilt_mm", "tremble_mm")
    rows = [[name, *(show(found[way][key]) for key in keys for way in found)] for name, found in numbers.items()]
    header = ["case"]
    for what in ("frames left alone", "spoilt", "acceleration"):
        header += [f"{what}: one by one", *(f"{s:g}" for s in arguments.smoothness)]
    said = (
        f"{arguments.people} people, {FRAMES} frames, {arguments.set}, one by one and with these values of `--smoothness`; mean "
        f"errors in millimetres, and millimetres per frame squared."
    )
    write_outputs(arguments, "fit_sequences", f"{markdown_table(header, rows)}\n\n{said}", numbers)


def measure(model, people, name: str, smoothness: float) -> dict:
    """Mean errors of the frames left alone, of the spoilt ones and of accelerations, millimetres; the acceleration held to."""
    import jax
    import numpy as np

    from humangs_jax.fitting.landmark_fit import FitConfig, fit_landmarks

    _, _, spoilt = CASES[name]
    seen = spoiled(model, people, name)
    config = FitConfig(smoothness=smoothness)
    fit = jax.vmap(lambda own: fit_landmarks(model, own, config))(seen)
    truth = np.stack([case.joints for case in people])
    errors = 1000 * np.linalg.norm(np.asarray(fit.joints) - truth, axis=-1).mean(-1)
    bad = np.isin(np.arange(FRAMES), spoilt)
    wild = 1000 * np.linalg.norm(np.diff(np.asarray(fit.joints) - truth, 2, axis=1), axis=-1)
    return {
        "others_mm": float(errors[:, ~bad].mean()),
        "spoilt_mm": float(errors[:, bad].mean()) if bad.any() else None,
        "worst_frame_mm": float(errors[:, ~bad].max()),
        "tremble_mm": None if bad.any() else float(wild.mean()),
        "held_to": [float(x) for x in fit.smoothness] if smoothness else None,
    }


def spoiled(model, people, name: str):
    """Observations (people, m, c, ...) of a case."""
    import numpy as np

    from experiments.fitting.cases import observe
    from humangs_jax.core.pytree import replace

    views, noise, spoilt = CASES[name]
    seen = observe(people, FIRST, noise, 0.0, model)
    points, confidences = np.array(seen.points), np.array(seen.confidences)
    rows = list(spoilt)
    if "without" in name:
        confidences[:, rows] = 0
    elif "one view" in name:
        confidences[:, rows, 1:] = 0
    elif "somebody else" in name:
        others = observe([moved(case, OTHER) for case in people[1:] + people[:1]], FIRST + 1, noise, 0.0, model)
        points[:, rows] = np.asarray(others.points)[:, [(row + FRAMES // 2) % FRAMES for row in rows]]
    elif "px off" in name:
        points[:, rows] = np.asarray(observe(people, FIRST, noise, 0.2, model).points)[:, rows]
    from humangs_jax.fitting.residuals.keypoints import expected_noise

    noises = np.stack(
        [expected_noise(p, c) for p, c in zip(points[:, :, :views], confidences[:, :, :views], strict=True)]
    )
    each = {"points": points, "confidences": confidences, "K": seen.K, "cam_from_world": seen.cam_from_world}
    return replace(seen, **{key: value[:, :, :views] for key, value in each.items()}, noise=noises)


def moved(case, by):
    """The case with the person elsewhere."""
    import dataclasses

    import numpy as np

    by = np.asarray(by, np.float32)
    return dataclasses.replace(case, joints=case.joints + by, landmarks=case.landmarks + by)


if __name__ == "__main__":
    main()
