"""How much refinement mends cameras and poses that are a little off, on synthetic people of the fitting seeds.

    python experiments/fitting/refine.py --subjects 4 --views 6 --json refine.json [--page docs/fitting.md]

The start: all focal lengths off by 5 %, every camera turned by 2 degrees about a random axis through its centre, every joint
(the root and the fingers, too) by 3 degrees about a random axis; true shape. --exact starts at the truth instead, which should
stay. Photos of 512 px. What it is refined by:

    bare               masks of the body alone
    clothed            masks of the dressed person with hair, as photos have them
    keypoints          COCO's 17, normal errors of --noise-px, no masks
    clothed+keypoints  both

--json writes {"cases": {case: means}, "subjects": [{"seed", "cases": {case: row}}], "settings"} after every person. A row has
`iou_before`, `iou_after` (body against the masks of the case), `bare_iou_before`, `bare_iou_after` (against the true body),
`joints_before_mm`, `joints_after_mm` (mean over the body's 22 joints, in the world), `aligned_before_mm`, `aligned_after_mm`
(after the best rigid motion, since cameras and person moved together look the same), `focal_before_percent`,
`focal_after_percent`, `seconds`, `refined` (1: kept).
--images writes the body over the photos, before and after. About 10 s of CPU time a case and person,
and two minutes of compiling.
"""

import argparse
import dataclasses
import sys
import time
from pathlib import Path
from statistics import mean
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[2]))
from experiments.common.results import check_section, markdown_table, publish, write_json

TABLE = "fit_refinement"
CASES = ("bare", "clothed", "keypoints", "clothed+keypoints")


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--subjects", type=int, default=4, help="how many people")
    parser.add_argument("--first", type=int, default=0, help="index of the first within the split")
    parser.add_argument("--split", choices=("validation", "test", "fitting"), default="fitting", help="whom to look at")
    parser.add_argument("--views", type=int, default=6, help="photos of each")
    parser.add_argument("--size", type=int, default=512, help="side of the photos, pixels")
    parser.add_argument("--noise-px", type=float, default=2.0, help="standard deviation of keypoints")
    parser.add_argument("--cases", nargs="+", choices=CASES, default=list(CASES), help="what to refine by")
    parser.add_argument("--exact", action="store_true", help="start at the truth: nothing should be kept")
    parser.add_argument("--json", type=Path, help="write the numbers here")
    parser.add_argument("--page", type=Path, help=f"page whose table {TABLE} is written")
    parser.add_argument("--images", type=Path, help="folder for pictures of every person before and after")
    arguments = parser.parse_args()
    if min(arguments.subjects, arguments.views) < 1 or arguments.first < 0:
        parser.error("--subjects and --views must be at least 1, --first at least 0")
    try:
        if arguments.page:
            check_section(arguments.page, TABLE)
        report = evaluate(arguments)
    except (ValueError, OSError) as error:
        parser.error(str(error))
    if arguments.page:
        publish(arguments.page, TABLE, section(report), report)


def evaluate(arguments: argparse.Namespace) -> dict[str, Any]:
    """Refine every person in every case, and write what was asked for."""
    from humangs_jax.body.library import load_body
    from humangs_jax.people.seeds import seeds_of

    body, subjects = load_body(), []
    names = ("split", "first", "views", "size", "noise_px", "exact")
    report: dict[str, Any] = {"settings": {name: getattr(arguments, name) for name in names}}
    for seed in seeds_of(arguments.split, arguments.first, arguments.subjects):
        subjects.append({"seed": seed, "cases": refine_subject(seed, body, arguments)})
        for case, row in subjects[-1]["cases"].items():
            print(seed, case, " ".join(f"{name} {value:.3f}" for name, value in row.items()), flush=True)
        rows = {case: [subject["cases"][case] for subject in subjects] for case in arguments.cases}
        report["cases"] = {case: {name: mean(r[name] for r in own) for name in own[0]} for case, own in rows.items()}
        report["subjects"] = subjects
        if arguments.json:
            write_json(arguments.json, report)
    print(section(report))
    return report


def refine_subject(seed: int, body: Any, arguments: argparse.Namespace) -> dict[str, dict[str, float]]:
    """The rows of one person, by case."""
    from experiments.fitting.refine_cases import augmented, noisy_keypoints, true_captures
    from humangs_jax.fitting.refine import refine_capture

    clothed, bare = true_captures(seed, body, arguments.views, arguments.size)
    keypoints = noisy_keypoints(clothed, seed, arguments.noise_px)
    rows = {}
    for case in arguments.cases:
        truth = bare if case == "bare" else clothed
        start = truth if arguments.exact else augmented(truth, seed)
        given = dataclasses.replace(start, masks=None) if case == "keypoints" else start
        begun = time.perf_counter()
        refined = refine_capture(given, keypoints=keypoints if "keypoints" in case else None)
        seconds = time.perf_counter() - begun
        rows[case] = scores(start, refined.capture, truth, bare.masks)
        rows[case] |= {"seconds": seconds, "refined": float(refined.report.kept)}
        if arguments.images:
            draw(arguments.images / f"{seed}_{case}.png", start, refined.capture)
    return rows


def scores(start: Any, refined: Any, truth: Any, bare_masks: Any) -> dict[str, float]:
    """How far start and refined capture are from the truth."""
    from experiments.fitting.refine_cases import joint_errors, mean_overlap

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
    import jax.numpy as jnp
    import numpy as np

    from humangs_jax.apps.check import draw_body
    from humangs_jax.avatar.sheets import contact_sheet

    path.parent.mkdir(parents=True, exist_ok=True)
    views = range(0, start.view_count, 2)
    over = lambda c, i: draw_body(c.body, jnp.asarray(c.betas), c.pose(int(c.frames[i])), c.cameras[i], c.images[i])[0]
    pictures = np.stack([over(capture, i) for capture in (start, refined) for i in views])
    labels = [f"{when} {start.names[i]}" for when in ("before", "after") for i in views]
    contact_sheet(pictures, path, labels=labels, columns=len(views))


def section(report: dict[str, Any]) -> str:
    """The table of the page."""
    header = ("refined by", "IoU with the masks", "with the true body", "joints, mm", "aligned, mm", "focal, %", "s")
    pair = lambda row, name, unit, digits: (
        f"{row[name + '_before' + unit]:.{digits}f} → {row[name + '_after' + unit]:.{digits}f}"
    )
    rows = [
        (
            case,
            *(pair(row, name, "", 3) for name in ("iou", "bare_iou")),
            *(pair(row, name, "_mm", 1) for name in ("joints", "aligned")),
            pair(row, "focal", "_percent", 1),
            f"{row['seconds']:.0f}",
        )
        for case, row in report["cases"].items()
    ]
    settings, people = report["settings"], report["subjects"]
    halved = lambda case, name: sum(
        s["cases"][case][f"{name}_after_mm"] < 0.5 * s["cases"][case][f"{name}_before_mm"] for s in people
    )
    lines = [f"{case}: {halved(case, 'joints')}, {halved(case, 'aligned')} aligned" for case in report["cases"]]
    return (
        f"{len(people)} people ({settings['split']} split from {settings['first']}), {settings['views']} views of "
        f"{settings['size']} px.\n\n{markdown_table(header, rows)}\n\n"
        f"People whose joint error was at least halved: {'; '.join(lines)}."
    )


if __name__ == "__main__":
    main()
