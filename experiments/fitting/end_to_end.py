"""What a fitted body costs in the end: photos and keypoints -> fit -> reconstruct -> refine, beside true body parameters.

    python experiments/fitting/end_to_end.py --people 4 --json end_to_end.json --docs

People of the fitting seeds, four photos of 256 pixels each. Keypoints are the true ones with noise and outliers, at the
accuracy of a detector that sees 512 pixels; cameras are true. Each reconstruction is drawn with the parameters it was made
from, fitted or true, and compared with held-out photos, before and after refinement. --captures keeps the fitted people, with
their held-out photos. About a minute a person after a minute of compilation.
"""

import argparse
import sys
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[2]))

PAGE = Path(__file__).resolve().parents[2] / "docs" / "fitting.md"
FIRST, VIEWS, SIZE = 4_000_000, 4, 256


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--people", type=int, default=4, help="of the fitting seeds")
    parser.add_argument("--noise-px", type=float, default=2.0, help="standard deviation of detections, pixels of 512")
    parser.add_argument(
        "--outliers", type=float, default=0.0, help="share of points displaced by up to 100 pixels of 512"
    )
    parser.add_argument("--set", default="wholebody133", help="coco17, wholebody133 or openpose67")
    parser.add_argument("--seconds", type=float, default=5.0, help="of refinement")
    parser.add_argument("--captures", type=Path, help="folder for the fitted captures, PERSON/ and PERSON/held_out/")
    parser.add_argument("--json", type=Path, required=True, help="numbers")
    parser.add_argument(
        "--images", type=Path, help="folder for PERSON.png: truth, true and fitted parameters, both refined"
    )
    parser.add_argument("--docs", action="store_true", help="write the table into docs/fitting.md")
    arguments = parser.parse_args()
    if arguments.people < 1:
        parser.error(f"--people {arguments.people}: expected at least 1")
    from humangs_jax.core.processes import keep_freed_memory

    keep_freed_memory()
    run(arguments)


def run(arguments) -> None:
    """Every person; numbers are written after each, and those of the same settings are kept."""
    from tqdm import tqdm

    from experiments.common.results import markdown_table, publish, write_json
    from experiments.subjects import HeldOut, make_evaluation_subject
    from humangs_jax.body.library import load_body
    from humangs_jax.io.reading import read_json
    from humangs_jax.network.weights import load_weights

    options = {name: getattr(arguments, name) for name in ("noise_px", "outliers", "set", "seconds")}
    known: Any = read_json(arguments.json) if arguments.json.exists() else {}
    kept = {row["seed"]: row for row in known["people"]} if known.get("settings") == options else {}
    body, (variables, config) = load_body(), load_weights()
    rows, result = [], {}
    for seed in tqdm(range(FIRST, FIRST + arguments.people), desc="people"):
        if seed not in kept:
            subject = make_evaluation_subject(seed, body, [VIEWS], SIZE, HeldOut(views=6, poses=0))
            kept[seed] = {"seed": seed} | compare(variables, config, body, subject, arguments)
        rows.append(kept[seed])
        result = {"people": rows, "settings": options}
        write_json(arguments.json, result)
    cells = [[row["seed"], *(f"{row[key]:.2f}" for key in COLUMNS)] for row in rows]
    cells.append(["mean", *(f"{sum(row[key] for row in rows) / len(rows):.2f}" for key in COLUMNS)])
    text = markdown_table(["person", *COLUMNS.values()], cells)
    print(text)
    if arguments.docs:
        publish(PAGE, "fit_end_to_end", text, result)


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


def compare(variables, config, body, subject, arguments) -> dict:
    """Scores of the reconstructions of one person, before and after refinement."""
    import dataclasses

    import numpy as np

    from humangs_jax.avatar.reconstruct import reconstruct
    from humangs_jax.data.capture import save_capture
    from humangs_jax.evaluation.cases import draw_views
    from humangs_jax.evaluation.scores import score
    from humangs_jax.refinement.config import RefineConfig
    from humangs_jax.refinement.refine import refine

    photos = subject.inputs(VIEWS)
    fitted, millimetres = fit_photos(photos, body, subject.seed, arguments)
    pictures = {}
    for name, inputs in (("true", photos), ("fitted", fitted)):
        views = dataclasses.replace(subject.held_out, poses=inputs.poses, betas=inputs.betas)
        avatar = reconstruct(variables, config, inputs)
        pictures[name] = draw_views(avatar, views).images
        avatar = refine(avatar, inputs, RefineConfig(seconds=arguments.seconds))
        pictures[f"{name}_refined"] = draw_views(avatar, views).images
        if arguments.captures and name == "fitted":
            save_capture(arguments.captures / str(subject.seed), inputs)
            save_capture(arguments.captures / str(subject.seed) / "held_out", views)
    scores = {name: score(drawn, subject.held_out) for name, drawn in pictures.items()}
    if arguments.images:
        from humangs_jax.avatar.sheets import contact_sheet

        arguments.images.mkdir(parents=True, exist_ok=True)
        sheet = np.concatenate([subject.held_out.images[:3], *(drawn[:3] for drawn in pictures.values())])
        contact_sheet(sheet, arguments.images / f"{subject.seed}.png")
    found = {f"{name}_psnr": s.psnr for name, s in scores.items()}
    return found | {f"{name}_foreground": s.psnr_fg for name, s in scores.items()} | {"joints_mm": millimetres}


def fit_photos(photos, body, seed, arguments):
    """The capture with a fitted body, and its mean joint error."""
    import numpy as np

    from experiments.fitting.cases import FitCase, detect
    from humangs_jax.body.landmarks import landmark_model, pose_landmarks
    from humangs_jax.data.keypoints.keypoints import Keypoints
    from humangs_jax.data.keypoints.sets import KEYPOINT_SETS
    from humangs_jax.data.photos import Photos
    from humangs_jax.fitting.fit_capture import fit_photos

    kind = KEYPOINT_SETS[arguments.set]
    model = landmark_model(body, kind.names)
    landmarks, joints = pose_landmarks(model, photos.betas, photos.pose(0))
    K, pose = np.asarray(photos.cameras.K)[None], np.asarray(photos.cameras.cam_from_world)[None]
    rotations, translations = np.asarray(photos.poses.rotations), np.asarray(photos.poses.translation)
    truth = (np.asarray(x)[None] for x in (joints, landmarks))
    case = FitCase(photos.betas, rotations, translations, *truth, K, pose)
    points = detect(case, seed, arguments.noise_px * SIZE / 512, arguments.outliers, 100 * SIZE / 512)[0]
    confidences = np.broadcast_to(np.asarray(model.known, np.float32), points.shape[:-1])
    keypoints = Keypoints(points.astype(np.float32), confidences, kind)
    seen = Photos(photos.images, photos.masks, photos.cameras, photos.frames, photos.names)
    fitted = fit_photos(seen, keypoints, body)
    error = np.linalg.norm(np.asarray(fitted.fit.joints)[0] - np.asarray(joints), axis=-1)
    return fitted.capture, float(1000 * error.mean())


if __name__ == "__main__":
    main()
